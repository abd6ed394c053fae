"""Runs of populations as labs make them: interrupted and resumed, long records, areas that vary, covariates."""

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from calibration import PER_PERIOD, wave
from population_calibration import FREQUENCY, NOISE, simulate, vsc

import fitact

SEED = 3


@pytest.fixture(scope="module")
def few() -> Any:
    return simulate(SEED, 0, fingers=6)


@pytest.mark.slow
def test_a_population_goes_on_where_it_stopped(few, tmp_path):
    """To the draws of an undisturbed run; a chain of another seed is refused."""
    undisturbed = fitact.population(few.records, few.scene, seed=1, progress=False)
    stopped = fitact.population(few.records, few.scene, seed=1, folder=tmp_path, max_steps=30, progress=False)
    assert not stopped.trusted
    again = fitact.population(few.records, few.scene, seed=1, folder=tmp_path, progress=False)
    assert again.trusted
    np.testing.assert_array_equal(again.points, undisturbed.points)
    with pytest.raises(fitact.InputError, match="belongs to another"):
        fitact.population(few.records, few.scene, seed=2, folder=tmp_path, progress=False)


class Counted(Sequence[fitact.Record]):
    """Records made when they are asked for, `times` their samples; how many of them are held at once."""

    def __init__(self, records: Sequence[fitact.Record], times: int) -> None:
        self._records, self._times = records, times
        self._made: list[weakref.ref[fitact.Record]] = []
        self.most = 0

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, index: Any) -> Any:
        short = self._records[index]
        channels = {name: np.tile(short[name], self._times) for name in short.channels}
        rng = np.random.default_rng(index)
        channels["Vsc"] = channels["Vsc"] + 0.3 * rng.standard_normal(channels["Vsc"].size)
        time = np.arange(channels["V"].size) * (short.time[1] - short.time[0])
        record = fitact.Record.from_arrays(time, **channels, source=short.source)
        self._made.append(weakref.ref(record))
        self.most = max(self.most, sum(each() is not None for each in self._made))
        return record


@pytest.mark.slow
def test_records_are_not_held(few):
    """Two at most, the one at hand and the one before; and none of what is left has as many numbers as a record."""
    records = Counted(simulate(SEED, 0, fingers=6, noise=0.0).records, 10)
    found = fitact.population(records, few.scene, seed=1, progress=False)
    assert records.most <= 2
    sizes = [array.size for finger in found.fingers for array in arrays_of(finger.likelihood)]
    assert max(sizes) < 1000 < len(records[0])


def arrays_of(tree: Any) -> list[np.ndarray]:
    import jax

    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


@pytest.mark.slow
def test_slopes_of_a_covariate_and_fingers_at_one_are_covered():
    """Log Rsc falls by 0.15 and log Csc rises by 0.05 with each unit of moisture; and stays easy to sample."""
    rng = np.random.default_rng(11)
    moisture, slopes, spread = rng.uniform(2.0, 8.0, 30), np.array([-0.15, 0.05]), np.array([0.15, 0.2])
    skins = np.log([130e3, 20e-9]) + (moisture - 5.0)[:, None] * slopes + spread * rng.standard_normal((30, 2))
    scene = simulate(SEED, 0, fingers=2).scene
    records = [record(np.exp(skin), 1.35e-9, i, rng) for i, skin in enumerate(skins)]
    found = fitact.population(
        records, scene, covariates={"moisture": moisture}, at={"moisture": 8.0}, seed=1, progress=False
    )
    assert found.trusted
    assert found.convergence.tau_max < 6.0
    draws, new = found.parameters(), found.new_fingers()
    for name, slope, sd in zip(("Rsc", "Csc"), slopes, spread, strict=True):
        low, high = np.quantile(draws[f"slope_{name}_moisture"], [0.005, 0.995])
        assert low < slope < high
        assert high - low < 0.15
        low, high = np.quantile(draws[f"log_sd_{name}"], [0.005, 0.995])
        assert low < sd < high  # what moisture makes is not in it
    expected = np.log(130e3) - 0.45
    assert np.mean(np.log(new["Rsc"])) == pytest.approx(expected, abs=0.25)  # 0.45 less than at the mean


def record(skin: np.ndarray, Ci: float, number: int, rng: np.random.Generator) -> fitact.Record:
    """Two settled periods of a triangle."""
    return fitact.Record.from_arrays(
        np.arange(2 * PER_PERIOD) / (PER_PERIOD * FREQUENCY),
        V=np.tile(wave("triangle", rng), 2),
        Vsc=np.tile(vsc(*skin, Ci, rng), 2) + NOISE * rng.standard_normal(2 * PER_PERIOD),
        source=f"finger {number}",
    )
