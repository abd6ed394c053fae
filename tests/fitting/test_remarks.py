"""Warnings of a channel from its figures of merit: each if it applies, and only then."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import fitact
from fitact.fitting.remarks import channel_warnings, prior_warnings
from fitact.problem.starting_point import DriveModel
from tests.conftest import square_record

QUIET = {"interpolation_error": 0.0, "rms_residual": 0.1, "rounding_noise": 0.0, "outliers": 0}
SQUARE = fitact.Square(360.0, 100.0)


def remarks(record: fitact.Record, drive: fitact.Square | fitact.Burst = SQUARE, **figures: float) -> list[str]:
    choice = DriveModel(drive, record["V"], True, False, 0.0, "square", ())
    return channel_warnings(record, choice, "Vsc", QUIET | figures)


def test_a_record_that_shows_its_drive_is_not_remarked_upon():
    assert remarks(square_record()) == []


def test_a_part_of_a_wave():
    whole = square_record()
    part = fitact.Record.from_arrays(whole.time[:1400], V=whole["V"][:1400], Vsc=whole["Vsc"][:1400])
    (found,) = remarks(part)
    assert "does not repeat within the record (6.995 ms)" in found
    assert "1.5 periods" in found
    assert remarks(part, fitact.Burst(SQUARE, 2)) == []  # a burst does not repeat


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({"interpolation_error": 0.1}, ["too coarsely", "100 mV", "state the waveform"]),
        ({"rounding_noise": 0.2}, ["Vsc is rounded", "may be wrong by half"]),
        ({"quiet_noise": 0.31}, ["quiet contains more than noise", "310 mV", "100 mV"]),
        ({"outliers": 3, "first_outlier": 2e-3}, ["3 samples of Vsc", "2 ms", "'student'"]),
    ],
)
def test_each_figure_has_its_remark(figures: dict[str, float], words: list[str]):
    (found,) = remarks(square_record(), **figures)
    for word in words:
        assert word in found


def test_what_lies_within_the_noise_has_none():
    assert remarks(square_record(), quiet_noise=0.29, interpolation_error=1e-3) == []


@pytest.mark.parametrize(("distance", "is_warned"), [(2.9, False), (3.1, True), (-3.1, True)])
def test_data_far_from_the_prior_of_a_part(distance: float, is_warned: bool):
    """The pull of a parameter that the data determine is its distance over the prior's standard deviation."""
    prior = fitact.Prior.from_marginals(
        Rsc=fitact.LogNormal(1e5, 10.0), Ri=fitact.LogNormal(5e6, 4.0), force_scale=fitact.LogNormal(1.0, 2.0)
    )
    sd = float(prior["Ri"].log_sd)
    likelihood = SimpleNamespace(names=prior.names, prior=prior, use_prior=True)
    theta = np.log([1e9, 5e6 * math.exp(distance * sd), 1e6])  # far out, but neither is a part with a value
    found = prior_warnings(likelihood, theta, np.full(3, 1e-3), [])
    assert [each.split(" at ")[0] for each in found] == ["the data put Ri"] * is_warned
    assert all("3.1 standard deviations from its prior; check [prior] Ri" in each for each in found)
