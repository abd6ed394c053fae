"""A run that is killed repeatedly gives the same draws as an uninterrupted one."""

import random
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

STEPS = 4000
# a chain that never converges, so that there is time to kill it
SAMPLE = """
import functools
import sys
import fitact
from fitact.sampling import ensemble
from fitact.sampling.convergence import Criteria
ensemble.diagnose_chain = functools.partial(ensemble.diagnose_chain, criteria=Criteria(rhat=0.0))
record, scene, chain, out = sys.argv[1:]
scene = fitact.Scene.load(scene)
fit = fitact.fit(fitact.read(record, scene), scene)
print("fitted", flush=True)
posterior = fitact.sample(fit, seed=3, walkers=32, max_steps={steps}, chain_file=chain, progress=False)
posterior.to_netcdf(out)
"""


def kept(path: Path) -> tuple[int, np.ndarray]:
    """Return the number of steps in a chain file, which must be intact, and the points of the first ensemble."""
    with h5py.File(path, "r") as file:
        steps = {file[f"ensemble_{i}"].attrs["iteration"] for i in range(4)}
        shapes = {file[f"ensemble_{i}"]["chain"].shape[0] for i in range(4)}
        assert steps == shapes
        return int(min(steps)), file["ensemble_0"]["chain"][:]


@pytest.mark.slow
@pytest.mark.parametrize("least", [3, 10])
def test_kills_lose_nothing_that_was_saved(least: int, finger_path: Path, finger_scene_path: Path, tmp_path: Path):
    path, out = tmp_path / "results" / "chain.h5", tmp_path / "results" / "posterior.nc"
    arguments = [SAMPLE.format(steps=STEPS), finger_path, finger_scene_path, path, out]
    command = [sys.executable, "-c", *map(str, arguments)]
    before, points = 0, np.empty((0, 32, 5))
    kills = random.Random(0)
    for kill in range(10):
        if kill >= least and before > 0:
            break
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()  # "fitted"
            time.sleep(kills.uniform(0.0, 4.0))
            process.kill()
        if path.exists():
            steps, now = kept(path)
            assert steps >= before
            np.testing.assert_array_equal(now[:before], points[:before])
            before, points = steps, now
    assert before > 0
    subprocess.run(command, check=True)
    assert {entry.name for entry in path.parent.iterdir()} == {"chain.h5", "posterior.nc"}
    assert kept(path)[0] == STEPS
    undisturbed = [tmp_path / "undisturbed.h5", tmp_path / "undisturbed.nc"]
    subprocess.run([*command[:-2], *map(str, undisturbed)], check=True)
    assert undisturbed[1].read_bytes() == out.read_bytes()
