"""Time averages of windows, against dense least squares over all windows' values, and against known variations."""

import json
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.readers.read import write_csv
from fitact.tracking.random_walk import WindowInformation
from fitact.tracking.time_average import TimeAverage, average_windows
from fitact.tracking.tracked_finger import SUMMARY, WINDOW, TrackedFinger
from tests.within_calibration import summarize, window_record

NAMES = ("Ci", "Rsc", "Csc", "R_H", "gain")  # a constant of the finger, and an error of an instrument
PRIOR = (np.array([-20.4, 11.8, -17.7, 6.0, 0.1]), np.diag([0.1, 0.5, 0.5, 0.2, 0.01]) ** 2)
WINDOWS = 30


def simulate(rng: np.random.Generator, moves: np.ndarray) -> WindowInformation:
    """Windows that determine all but a combination with the constants; `moves` are (windows, 5)."""
    factor = rng.normal(size=(WINDOWS, 5, 5)) * 100.0
    values = PRIOR[0] + moves
    target = np.einsum("kij,kj->ki", factor, values) + rng.standard_normal((WINDOWS, 5))
    rows = np.linalg.qr(np.concatenate([factor, target[:, :, None]], axis=2), mode="r")
    return WindowInformation(rows[:, :, :5], rows[:, :, 5])


def average(information: WindowInformation, used: np.ndarray) -> TimeAverage:
    found = average_windows(information, used, NAMES, PRIOR, ("gain",), PRIOR[0], 3.0)
    assert found is not None
    return found


def test_average_is_that_of_least_squares_over_all_windows_and_constants():
    rng = np.random.default_rng(1)
    moves = np.zeros((WINDOWS, 5))
    moves[:, :3] = 0.05 * rng.standard_normal((WINDOWS, 3))
    information, used = simulate(rng, moves), np.arange(WINDOWS) % 7 != 0
    found = average(information, used)
    # unknown: three values of each window, and R_H; the gain stays at its prior's mean
    count, rows, targets = int(used.sum()), [], []
    for place, k in enumerate(np.flatnonzero(used)):
        row = np.zeros((5, 3 * count + 1))
        row[:, 3 * place : 3 * place + 3], row[:, -1] = information.factor[k][:, [1, 2, 0]], information.factor[k][:, 3]
        rows.append(row)
        targets.append(information.target[k] - 0.1 * information.factor[k][:, 4])
    prior = np.zeros((1, 3 * count + 1))
    prior[0, -1] = 1.0 / 0.2
    A, y = np.concatenate([*rows, prior]), np.concatenate([*targets, [6.0 / 0.2]])
    mean = np.zeros((3, 3 * count + 1))
    mean[:, :-1] = np.tile(np.eye(3), count) / count
    covariance = mean @ np.linalg.inv(A.T @ A) @ mean.T
    np.testing.assert_allclose(np.linalg.inv(found.factor.T @ found.factor), covariance, rtol=1e-6)
    expected = mean @ np.linalg.lstsq(A, y, rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(found.factor, found.target), expected, atol=1e-6)
    assert found.sees_area
    assert found.windows == count


@pytest.mark.parametrize("size", [0.0, 0.02])
def test_variation_is_without_bias(size: float):
    """Over 300 records, that of a path is found within four standard errors, and 0 where nothing changes."""
    rng = np.random.default_rng(2)
    moves = np.zeros((WINDOWS, 5))
    moves[:, :3] = size * np.cumsum(rng.standard_normal((WINDOWS, 3)), axis=0)
    expected = np.cov(moves[:, [1, 2, 0]].T, ddof=0)
    found = np.array([average(simulate(rng, moves), np.ones(WINDOWS, bool)).within for _ in range(300)])
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(found.mean(axis=0) - expected) < 4.0 * error)


def test_vsc_alone_leaves_the_area_out():
    paths = np.full((1, 400, 2), np.log([150e3, 20e-9])) + 0.1 * np.sin(np.linspace(0.0, 6.0, 400))[:, None]
    (finger,) = summarize(paths, np.log(1.4e-9), np.random.default_rng(3))
    found = finger.average
    assert not found.sees_area
    assert abs(found.factor[2, 2]) < 1e-3
    slope = -np.linalg.solve(found.factor[:2, :2], found.factor[:2, 2])
    np.testing.assert_allclose(slope, [-1.0, 1.0], atol=1e-6)
    assert np.all(found.within[2] == 0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.within))[:2], np.std(paths[0], axis=0), rtol=0.1)


def test_folder_of_a_track_gives_the_same_finger(tmp_path: Path):
    rng = np.random.default_rng(4)
    paths = np.log([150e3, 20e-9]) + 0.05 * rng.standard_normal((1, 400, 2))
    (finger,) = summarize(paths, np.log(1.4e-9), rng)
    content = {
        "time_average": finger.average.to_dict(),
        "within_finger": {"force_mean": {"time_scale_s": 1.0}},
        "trusted": True,
        "fit": {"result": "successful"},
    }
    (tmp_path / SUMMARY).write_text(json.dumps(content))
    with pytest.raises(fitact.InputError, match="holds no complete track"):
        TrackedFinger.from_folder(tmp_path)  # the window is missing
    write_csv(tmp_path / WINDOW, window_record(paths[0, 0], 1.4e-9, rng))
    found = TrackedFinger.from_folder(tmp_path / "track.parquet")
    assert found.fingerprint == finger.fingerprint
    assert found.source == tmp_path.name
    assert len(found.window) == len(finger.window)
