"""Reasons against a fit: bounds and orders that the records contradict, records that do not belong together."""

import dataclasses

import pytest

import fitact
from tests.conftest import square_record

NOMINAL = {"drive": {"waveform": "square"}}


@pytest.mark.parametrize(
    ("prior", "result"),
    [
        ({"Ci": {"low": "1 nF", "high": "1.2 nF"}}, "successful"),  # the bound limits only the unidentified direction
        ({"Rsc": {"low": "1 kohm", "high": "2 kohm"}, "Csc": {"low": "1 nF", "high": "2 nF"}}, "on_bound"),
        ({"Csc": {"above": "Ci"}}, "successful"),
        ({"Csc": {"below": "Ci"}}, "on_bound"),
    ],
    ids=["edge of the blind direction", "far box", "order kept", "order broken"],
)
def test_bounds_and_orders_that_the_record_contradicts(prior: dict, result: str):
    assert fitact.fit(square_record(), fitact.Scene.from_dict(NOMINAL | {"prior": prior})).result == result


@pytest.mark.slow
def test_records_of_two_fingers_are_not_one():
    one = square_record()
    other = dataclasses.replace(square_record(Rsc=80e3, seed=8), source="other.csv")
    found = fitact.fit([one, other], fitact.Scene.from_dict(NOMINAL))
    assert not found.trusted
    assert any("other.csv" in warning and "common model fits" in warning for warning in found.warnings)


def test_one_record_twice_is_refused():
    with pytest.raises(fitact.InputError, match="twice"):
        fitact.fit([square_record(), square_record()])
