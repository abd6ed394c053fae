"""Cost of the exact response, side by side with scipy.signal.lsim and with one NumPy exp per sample.

    python benchmarks/response.py [--json]

One period of a triangle from rest, 5,000 samples, for which lsim's first-order hold is exact. Rounds are interleaved.
"""

import argparse
from collections.abc import Callable

import jax
import numpy as np
import scipy.signal
from timing import medians, show

import fitact

SAMPLES, ROUNDS = 5000, 40
R, C, CI = 160e3, 22e-9, 1.35e-9
B = R * (2.0 * CI + C)


def contenders() -> dict[str, Callable[[], object]]:
    """Return the timed functions by name, after checking their accuracy."""
    circuit, drive = fitact.FinalCircuit(R, C, CI), fitact.Triangle(360.0, 100.0)
    t = np.arange(SAMPLES) * (0.01 / SAMPLES)
    voltage = np.asarray(drive.value(t))
    on_device = jax.device_put(t)
    rest = jax.jit(lambda c, t: fitact.response(c, drive, t, steady_state=False))
    steady = jax.jit(lambda c, t: fitact.response(c, drive, t))

    bare, nothing = jax.jit(lambda t: jax.numpy.exp(-t / B)), jax.jit(lambda t: t + 1.0)

    def lsim() -> np.ndarray:
        return scipy.signal.lsim(([R * CI, 0.0], [B, 1.0]), voltage, t, interp=True)[1]

    np.testing.assert_allclose(rest(circuit, on_device), lsim(), atol=1e-10)
    return {
        "exact": lambda: rest(circuit, on_device).block_until_ready(),
        "steady": lambda: steady(circuit, on_device).block_until_ready(),
        "jit call": lambda: nothing(on_device).block_until_ready(),
        "exp in JAX": lambda: bare(on_device).block_until_ready(),
        "numpy exp": lambda: np.exp(-t / B),
        "lsim": lsim,
    }


def measure_seconds() -> dict[str, float]:
    """Return the median seconds of each."""
    with jax.enable_x64(True):
        jobs = contenders()
        return medians(jobs, ROUNDS, {name: 50 for name in jobs if name != "lsim"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    times = measure_seconds()
    ratios = {
        "exact_vs_lsim": times["lsim"] / times["exact"],
        "exact_vs_numpy_exp": times["exact"] / times["numpy exp"],
        "steady_vs_numpy_exp": times["steady"] / times["numpy exp"],
        "jit_call_vs_numpy_exp": times["jit call"] / times["numpy exp"],
        "jax_exp_vs_numpy_exp": times["exp in JAX"] / times["numpy exp"],
    }
    as_json = parser.parse_args().json
    if not as_json:
        for name, value in times.items():
            print(f"{name:12}{value * 1e6:10.1f} us")
    show(ratios, as_json)


if __name__ == "__main__":
    main()
