"""Records from routes outside fitact (ngspice, scipy's state space), and fits that many tests use.

A fit of a new structure (circuit, channels, kind of drive, free parameters, length) compiles for about 10 s. A test
therefore uses one of these fits, or their structures, unless it tests the structure.
"""

import itertools
import json
import zlib
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest
import scipy.signal

import fitact
from fitact import compiled

_MOST_MAPS = 35_000  # of the 65,530 memory maps that Linux grants a process by default
_TESTS = itertools.count()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rotate",
        metavar="N/M",
        type=_part,
        help="of the slow tests only part N modulo M, and all M parts in M consecutive N",
    )


def _part(text: str) -> tuple[int, int]:
    number, parts = map(int, text.split("/"))
    return number % parts, parts


def pytest_report_header(config: pytest.Config) -> str | None:
    rotate = config.getoption("rotate")
    return f"slow tests: part {rotate[0]} of 0 to {rotate[1] - 1}" if rotate else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the slow tests but for the part that a hash of their names selects for this run."""
    if rotate := config.getoption("rotate"):
        waiting = {
            item
            for item in items
            if item.get_closest_marker("slow") and zlib.crc32(item.nodeid.encode()) % rotate[1] != rotate[0]
        }
        config.hook.pytest_deselected(items=list(waiting))
        items[:] = [item for item in items if item not in waiting]


@pytest.fixture(autouse=True)
def _room_for_programs():
    """Clear JAX's caches before a process has too many memory maps, at which it would crash."""
    yield
    maps = Path("/proc/self/maps")
    if next(_TESTS) % 20 == 0 and maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPS:  # reading takes 10 ms
        jax.clear_caches()
        compiled._share_program.cache_clear()


hypothesis.settings.register_profile("fitact", max_examples=25, deadline=None, derandomize=True)
hypothesis.settings.load_profile("fitact")

RECORDS = Path(__file__).parents[1] / "data_synth" / "records"


@pytest.fixture(scope="session")
def finger_path() -> Path:
    return RECORDS / "finger_direct.csv"


@pytest.fixture(scope="session")
def finger_scene_path() -> Path:
    return RECORDS / "finger_direct.toml"


@pytest.fixture(scope="session")
def finger_truth() -> dict[str, float]:
    truth = {
        name: entry["value"]
        for name, entry in json.loads((RECORDS / "finger_direct.json").read_text())["truth"].items()
    }
    total = 2.0 * truth["Ci"] + truth["Csc"]
    return truth | {"g": truth["Ci"] / total, "b": truth["Rsc"] * total}


@pytest.fixture(scope="session")
def finger_fit(finger_path: Path, finger_scene_path: Path) -> fitact.Fit:
    scene = fitact.Scene.load(finger_scene_path)
    return fitact.fit(fitact.read(finger_path, scene), scene)


@pytest.fixture(scope="session")
def finger_posterior(finger_fit: fitact.Fit) -> fitact.Posterior:
    return fitact.sample(finger_fit, seed=1, progress=False)


SQUARE = fitact.Scene.from_dict({"drive": {"waveform": "square"}})


@pytest.fixture(scope="session")
def square_fit() -> fitact.Fit:
    """Return the fit of `square_record()`, which is compressed."""
    return fitact.fit(square_record(), SQUARE)


@pytest.fixture(scope="session")
def summed_fit() -> fitact.Fit:
    """Return a fit of so few samples that they are summed."""
    fit = fitact.fit(square_record(per_period=200), SQUARE)
    assert fit.compression_error is None
    return fit


def skin_voltage(
    time: np.ndarray, voltage: np.ndarray, Rsc: float, Csc: float, Ci: float, hold: bool = False
) -> np.ndarray:
    """Return Vsc from rest by scipy.signal.lsim, for a drive that is linear (with hold, constant) between samples."""
    system = ([Rsc * Ci, 0.0], [Rsc * (2.0 * Ci + Csc), 1.0])
    return scipy.signal.lsim(system, voltage, time, interp=not hold)[1]


def square_record(
    noise: float = 0.05,
    offset: float = 0.0,
    drift: float = 0.0,
    delay_samples: int = 0,
    seed: int = 7,
    Rsc: float = 130e3,
    Csc: float = 18e-9,
    Ci: float = 1.35e-9,
    per_period: int = 2000,
    periods: int = 2,
) -> fitact.Record:
    """Return steady-state periods of a 360 Vpp square at 100 Hz, with V sampled exactly at the edges."""
    settle, kept = 12, periods
    time = np.arange((settle + kept) * per_period) * (0.01 / per_period)
    voltage = np.where(np.arange(time.size) % per_period < per_period // 2, 180.0, -180.0)
    vsc = skin_voltage(time, voltage, Rsc, Csc, Ci, hold=True)
    last = slice(settle * per_period, None)
    vsc = np.roll(vsc[last], delay_samples) + noise * np.random.default_rng(seed).standard_normal(kept * per_period)
    time = time[: kept * per_period]
    return fitact.Record.from_arrays(time, V=voltage[last], Vsc=vsc + offset + drift * time / time[-1])
