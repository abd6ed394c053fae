"""Speed of the compressed log-likelihood against NumPy over the samples, side by side in one run.

    python benchmarks/likelihood.py [--json]

Prints ratios: the speed per walker of a log-probability of 1,000 walkers against one evaluation over the samples in
plain NumPy (and in NumPy with precomputed constants); the cost at 1e7 samples against 1e4; and the cost of building the
compression against one `np.dot` per column of its basis, for a settled square (whose periods are averaged) and a
measured drive. Medians of interleaved repeats.
"""

import argparse
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from timing import medians, show

import fitact
from fitact.likelihood import projection
from fitact.likelihood.certificate import batched_log_prob
from fitact.model.circuit import HighpassTerms
from fitact.model.response_table import NODES

TRUTH = np.log([160e3, 22e-9, 1.35e-9, 0.1])  # Rsc, Csc, Ci and sigma (V)
SQUARE = fitact.Scene.from_dict({"drive": {"waveform": "square"}})
RATE, FREQUENCY, WALKERS = 250e3, 100.0, 1000


def record(samples: int) -> fitact.Record:
    """Return a settled square wave in white noise."""
    t = np.arange(samples) / RATE
    sign, since = square_phase(t)
    noise = math.exp(TRUTH[3]) * np.random.default_rng(1).standard_normal(samples)
    return fitact.Record.from_arrays(t, V=180.0 * sign, Vsc=skin_voltage(TRUTH, sign, since) + noise)


def square_phase(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sign of the square, and the time since its last edge."""
    index = np.arange(t.size) % int(RATE / FREQUENCY)
    half = int(RATE / FREQUENCY) // 2
    return np.where(index < half, 1.0, -1.0), (index % half) / RATE


def skin_voltage(point: np.ndarray, sign: np.ndarray, since: np.ndarray) -> np.ndarray:
    """Return the closed form of eq. (20) for a settled square."""
    R, C, Ci = np.exp(point[:3])
    g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
    return sign * 360.0 * g / (1.0 + math.exp(-0.5 / FREQUENCY / b)) * np.exp(-since / b)


def plain_log_likelihood(point: np.ndarray, t: np.ndarray, y: np.ndarray) -> float:
    """Return the directly coded log-likelihood (`mod` puts a few samples on the wrong side of an edge)."""
    period = 1.0 / FREQUENCY
    phase = np.mod(t, period)
    sign = np.where(phase < 0.5 * period, 1.0, -1.0)
    residual = y - skin_voltage(point, sign, np.mod(phase, 0.5 * period))
    sigma = math.exp(point[3])
    return float(-0.5 * np.sum((residual / sigma) ** 2) - t.size * math.log(sigma))


def good_log_likelihood(point: np.ndarray, sign: np.ndarray, since: np.ndarray, y: np.ndarray) -> float:
    """Return the same with constants precomputed."""
    residual = y - skin_voltage(point, sign, since)
    return -0.5 * float(residual @ residual) * math.exp(-2.0 * point[3]) - y.size * point[3]


def compressed_log_prob(fit: fitact.Fit, points: np.ndarray) -> Callable[[], np.ndarray]:
    """Return log-probabilities of all points as NumPy arrays."""
    assert fit.model()["likelihood"] == "compressed", fit.full_because
    function = batched_log_prob(fit.likelihood, len(points))
    return lambda: function(points)


def evaluation(samples: int, points: np.ndarray) -> dict[str, float]:
    """Return ratios of one evaluation over the samples to one of many compressed ones; check that they agree."""
    data = record(samples)
    t, y = data.time, data["Vsc"]
    sign, since = square_phase(t)
    fit = fitact.fit(data, SQUARE)
    fast = compressed_log_prob(fit, points)
    ours, theirs = fast()[:2], [good_log_likelihood(point, sign, since, y) for point in points[:2]]
    priors = [float(fit.likelihood.prior.log_density(jnp.asarray(point[:3]))) for point in points[:2]]
    difference = (ours[1] - ours[0]) - (theirs[1] - theirs[0] + priors[1] - priors[0])
    assert abs(difference) < 0.01, f"the compressed log-probability is off by {difference}"
    jobs = {
        "compressed": fast,
        "plain": lambda: plain_log_likelihood(points[0], t, y),
        "good": lambda: good_log_likelihood(points[0], sign, since, y),
    }
    seconds = medians(jobs, 30 if samples < 1_000_000 else 9)
    each = seconds["compressed"] / len(points)
    return {
        f"compressed_vs_numpy_{samples}": seconds["plain"] / each,
        f"compressed_vs_good_numpy_{samples}": seconds["good"] / each,
    }


def growth(points: np.ndarray) -> float:
    """Return the cost of an evaluation at 1e7 samples relative to 1e4."""
    jobs = {
        str(samples): compressed_log_prob(fitact.fit(record(samples), SQUARE), points)
        for samples in (10_000, 10_000_000)
    }
    seconds = medians(jobs, 100)
    return seconds["10000000"] / seconds["10000"]


def build_cost(samples: int) -> dict[str, float]:
    """Return the cost of a compression relative to one `np.dot` per basis column, read from memory."""
    data = record(samples)
    t, y = data.time, data["Vsc"]
    drives = {
        "square": (fitact.Square(360.0, FREQUENCY), True),
        "unfolded_square": (fitact.Square(360.0, 101.37), True),
        "measured": (fitact.Sampled(t, data["V"]), False),
    }
    columns = np.random.default_rng(2).standard_normal((4, samples))  # as many columns as fit in memory
    jobs: dict[str, Callable[[], object]] = {
        name: lambda drive=drive, steady=steady: projection.compress(
            drive, t, y, steady_state=steady, expected_terms=HighpassTerms((0.05,), (4e-3,))
        )
        for name, (drive, steady) in drives.items()
    }
    jobs["dot"] = lambda: [np.dot(column, y) for column in columns]
    seconds = medians(jobs, 5)
    dot = seconds["dot"] / len(columns)
    kinds = {"square": 1, "unfolded_square": 1, "measured": 2}  # responses, and decays of an unknown charge
    return {f"build_{name}_vs_dots": seconds[name] / (dot * kind * NODES) for name, kind in kinds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description="Ratios of the compressed log-likelihood to the full sum.")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="leave out the longest records")
    given = parser.parse_args()
    with jax.enable_x64(True):
        fit = fitact.fit(record(5000), SQUARE)
        root = np.zeros((4, 4))
        root[:3, :3], root[3, 3] = fit.covariance_root, math.sqrt(0.5 / 5000)
        deviates = np.random.default_rng(3).standard_normal((WALKERS, 4))
        points = np.append(fit.theta, math.log(fit.sigma)) + deviates @ root.T
        ratios = evaluation(5000, points)
        ratios |= evaluation(1_000_000, points)
        ratios |= build_cost(1_000_000 if given.quick else 10_000_000)
        if not given.quick:
            ratios["cost_10000000_vs_10000"] = growth(points)
    show(ratios, given.json)


if __name__ == "__main__":
    main()
