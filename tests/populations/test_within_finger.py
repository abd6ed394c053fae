"""Variation within fingers: pooled variances against chi-square laws, blurred fingers against algebra, and runs."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.populations.finger import Finger
from fitact.populations.next_finger import redrawn_variance_fraction
from fitact.populations.record_files import RecordFiles
from fitact.populations.within_finger import PooledVariance, WithinFinger, pool_variances
from fitact.readers.read import write_csv
from tests.within_calibration import CHANGE, Law, complete_places, records_of_changing_fingers

FINGERS, WINDOWS = 8, 40


@pytest.mark.parametrize("freedom", [2.5, 12.0])
def test_pooled_variance_covers(freedom: float):
    """The 80 % interval of the mean variance of eight fingers, over 40 populations, within three binomial sd."""
    rng, inside, noise = np.random.default_rng(5), 0, 1e-4 * np.ones(FINGERS)
    for _ in range(40):
        mean = np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))
        true = mean * rng.chisquare(freedom, FINGERS) / freedom
        errors = np.sqrt((2.0 * noise**2 + 4.0 * noise * true) / WINDOWS)
        found = true + errors * rng.standard_normal(FINGERS)
        pooled = pool_variances(found, noise, np.full(FINGERS, WINDOWS), rng, 1000)
        inside += np.quantile(pooled.variance, 0.1) < mean < np.quantile(pooled.variance, 0.9)
    assert inside == pytest.approx(32, abs=3.0 * np.sqrt(40 * 0.8 * 0.2))


def test_variance_of_fingers_that_do_not_change_is_compatible_with_zero():
    rng, noise, windows = np.random.default_rng(6), 1e-4 * np.ones(FINGERS), np.full(FINGERS, WINDOWS)
    pooled = [
        pool_variances(noise * (rng.chisquare(WINDOWS - 1, FINGERS) / (WINDOWS - 1) - 1.0), noise, windows, rng, 500)
        for _ in range(25)
    ]
    assert np.mean([each.may_be_zero for each in pooled]) >= 0.85  # 95 % expected
    error = 1e-4 * np.sqrt(2.0 / WINDOWS / FINGERS)
    assert np.mean([np.median(each.variance) for each in pooled]) < error


def test_blurred_finger_is_the_sum_of_two_normal_distributions():
    rng = np.random.default_rng(7)
    root = rng.normal(size=(3, 3)) * 0.1  # of log Rsc, log Csc, log Ci
    covariance, mean, within = root @ root.T, np.array([11.8, -17.7, -20.4]), np.diag([0.1, 0.2, 0.05]) ** 2
    within[0, 1] = within[1, 0] = 0.01
    nuisance, center = 0.5, mean + 0.03
    factor = np.zeros((4, 4))
    factor[0] = [2.0, 0.3, 0.2, -0.1]
    factor[1:, 1:] = np.linalg.cholesky(np.linalg.inv(covariance)).T
    target = factor @ np.append(0.0, mean - center)
    names = ("Rsc", "Csc", "Ci", "R_H")
    finger = Finger("", "", "successful", "", {}, None, names, np.append(nuisance, center), factor, target)
    found = finger.blur(within)
    whole = np.linalg.inv(found.factor.T @ found.factor)
    np.testing.assert_allclose(whole, covariance + within, rtol=1e-4)
    np.testing.assert_allclose(found.center + np.linalg.solve(found.factor, found.target), mean, atol=1e-5)


def test_deviations_have_the_pooled_covariance_and_their_part_of_the_variance():
    rng, laws, fingers = np.random.default_rng(8), 500, 32
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.0]]) * 1e-2
    size = np.full(laws, 2.0)
    pooled = {"force_mean": PooledVariance(size, np.full(laws, 5.0), False)}
    within = WithinFinger(covariance, pooled, size, 1.0, 10.0, False, FINGERS)
    moves = within.draw_deviations((2, laws, fingers), rng)
    np.testing.assert_allclose(np.cov(moves.reshape(-1, 3).T), 2.0 * covariance, atol=0.003)
    # an additive quantity: variances of 0.08 within, and of 0.24 between fingers
    moments = moves[..., 0] + np.sqrt(0.24) * rng.standard_normal((laws, fingers))
    assert redrawn_variance_fraction(moments) == pytest.approx(0.25, abs=0.015)


@pytest.mark.slow  # eight tracks of 10 s
def test_population_of_complete_tracks_covers():
    """One population of `tests/within_calibration.py --complete`: all true values within the central 99 %."""
    row = complete_places(0, 1)
    assert row["trusted"]
    for name, place in row["places"].items():
        assert 0.005 < place < 0.995, name


@pytest.mark.slow  # a command for each of four tracks
def test_command_takes_folders_of_tracks_beside_records(tmp_path: Path):
    rng = np.random.default_rng(5)
    law = Law.draw(rng, CHANGE)
    law = law._replace(change=np.array([0.1, 0.06]))
    command = [sys.executable, "-c", "from fitact.cli import main; main()"]
    scene = tmp_path / "scene.toml"
    scene.write_text('[drive]\nwaveform = "triangle"\nfrequency = "100 Hz"\n')
    given = []
    for number, record in enumerate(records_of_changing_fingers(law.fingers(5, rng), law.log_Ci, rng)):
        path = tmp_path / f"{number}.csv"
        write_csv(path, record)
        if number < 4:
            folder = tmp_path / f"track {number}"
            options = ["--scene", str(scene), "--window", "250ms", "--out", str(folder)]
            subprocess.run([*command, "track", str(path), *options], check=True, capture_output=True)
            path = (folder, folder / "track.parquet", folder, folder / "summary.json")[number]
        given.append(str(path))
    done = subprocess.run(
        [*command, "population", *given, "--scene", str(scene), "--seed", "1"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "within a finger, force_mean, log_sd" in done.stdout
    assert "% from changes within a finger" in done.stdout
    assert "4 of 5 records were tracked" in done.stdout
    assert "4.csv: " in done.stdout
    assert "use track" in done.stdout  # of the record that was not tracked


def test_track_without_a_finger_is_refused(tmp_path: Path):
    records = RecordFiles([tmp_path, tmp_path / "summary.json"], None)
    with pytest.raises(fitact.InputError, match="holds no complete track"):
        fitact.population(records)
