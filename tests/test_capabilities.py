"""Each cell of the table of what works where, and the table in the documentation."""

import dataclasses
import functools
import itertools
from pathlib import Path

import pytest

import fitact
from fitact.batch import fit_many
from tests.capabilities import CAPABILITIES, FUNCTIONS, MAX_ERROR, PAGE, Capability, render_table

SPECTRA = ("impedance spectrum", "gain spectrum Vsc / V")  # which share what is compiled


def cells() -> list[object]:
    found = []
    for row, name in itertools.product(CAPABILITIES, FUNCTIONS):
        # each kind of record compiles for ten seconds or more, and a fractional skin is simulated for as long
        is_quick = row.name in SPECTRA or (name in row.refused and row.name != "fractional skin")
        found.append(pytest.param(row, name, id=f"{row.name}-{name}", marks=() if is_quick else pytest.mark.slow))
    return found


@pytest.mark.parametrize(("row", "name"), cells())
def test_a_cell_works_or_is_refused(
    row: Capability, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any seed serves: an error beyond the limit has a probability below 1e-5."""
    monkeypatch.setattr(fit_many, "RecordGroup", functools.partial(fit_many.RecordGroup, min_records=1))  # as if many
    if name in row.refused:
        with pytest.raises(fitact.InputError) as refusal:
            FUNCTIONS[name](row, tmp_path)
        assert row.refused[name] in str(refusal.value)
        assert "\n" not in str(refusal.value)
        return
    errors = FUNCTIONS[name](row, tmp_path)
    assert max(map(abs, errors.values())) < MAX_ERROR, errors


def test_a_track_follows_the_current_alone_with_a_body_resistance(tmp_path: Path) -> None:
    """A window whose first channel is I has no table of the time constant that makes I later."""
    (row,) = (row for row in CAPABILITIES if row.name == "body resistance R_H, Vsc and I")
    errors = FUNCTIONS["track"](dataclasses.replace(row, channels=("I",)), tmp_path)
    assert max(map(abs, errors.values())) < MAX_ERROR, errors


def test_the_table_of_the_documentation_is_that_of_the_cells() -> None:
    assert render_table() in PAGE.read_text(encoding="utf-8"), "write it again: python -m tests.capabilities"
