"""Do the residuals look like the noise that the record itself shows?"""

import math
from collections.abc import Sequence
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc
from jaxtyping import Float

from fitact.data.record import Record, rounding_noise, white_noise
from fitact.inference.start import DriveChoice

_RUNS = 6.0  # standard deviations of the runs test at which residuals count as structured
_COARSE = 0.2  # of the residuals' rms: error of the drive's interpolation from which g and b are off by several sd
_PHASES = (8, 32, 128, 512)  # parts of a period whose means are compared; few show what is slow, many what is brief
_FALSE_ALARM = 1e-6  # of a trace that holds nothing but noise, by all tests of structure together
_TESTS = len(_PHASES) + 2
_LEAST_TESTED = 64  # samples, below which a spectrum says little
_P_VALUES = ("folded_p", "spectrum_p", "line_p")
_EXCESS = 0.1  # excess of the residual variance over the noise's that counts, if it is also significant


def statistics(
    residuals: Float[np.ndarray, " kept"],
    time: Float[np.ndarray, " kept"],
    noise: float,
    freed: float,
    gain: float,
    record: Record,
    channel: str,
    choice: DriveChoice,
) -> dict[str, float]:
    """Figures of merit of a channel's residuals (weighted, in its unit) after `freed` parameters were fitted.

    `noise` is what to expect of the channel, judged without the model; a measured drive adds its own, which
    reaches the channel through `gain` (its unit per V).
    """
    measured = choice.name == "measured"
    expected = math.hypot(noise, gain * record.noise("V") if measured else 0.0)
    freedom = residuals.size - freed
    return {
        "chi2_reduced": float(residuals @ residuals / (freedom * expected**2)),
        "rms_residual": float(np.sqrt(np.mean(residuals**2))),
        "noise_expected": expected,
        "runs_z": runs_z(residuals),
        "folded_p": folded_p(residuals, time, record.frequency() if choice.periodic else None),
        "spectrum_p": spectrum_p(residuals),
        "line_p": line_p(residuals),
        "rounding_noise": rounding_noise(record[channel]),
        "interpolation_error": gain * interpolation_error(record["V"]) if measured else 0.0,
        "samples": residuals.size,
        "degrees_of_freedom": freedom,
    }


def outliers(residuals: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], noise: float) -> dict[str, float]:
    """How many residuals lie further out than normal noise puts one in a thousand such records, and where the first.

    The noise is that of the middle half of them, or the one to expect where that is larger; `first_outlier` is in s.
    """
    core = float(np.median(np.abs(residuals[residuals != 0.0]))) / 0.6744897501960817 if residuals.any() else 0.0
    beyond = np.abs(residuals) > _far(residuals.size) * max(core, noise)
    count = int(np.count_nonzero(beyond))
    return {"outliers": count, **({"first_outlier": float(time[np.argmax(beyond)])} if count else {})}


def _far(count: int) -> float:
    """Standard deviations beyond which one of that many normal numbers lies with a probability of 1e-3."""
    return -NormalDist().inv_cdf(0.5e-3 / count)


def together(figures: Sequence[dict[str, float]]) -> dict[str, float]:
    """Figures of merit of all traces; those with a unit are the first's."""
    freedom = np.array([each["degrees_of_freedom"] for each in figures])
    chi2 = np.array([each["chi2_reduced"] for each in figures])
    return figures[0] | {
        "chi2_reduced": float(chi2 @ freedom / freedom.sum()),
        **{name: min(each[name] for each in figures) for name in ("runs_z", *_P_VALUES)},
        "samples": sum(each["samples"] for each in figures),
        "degrees_of_freedom": float(freedom.sum()),
    }


def is_misfit(figures: dict[str, float]) -> bool:
    """Whether the residuals are larger than the noise, or have structure."""
    significant = 6.0 * math.sqrt(2.0 / figures["degrees_of_freedom"])
    # a rounded channel's residuals come in stretches that repeat, and its noise is known less well
    rounded = figures["rounding_noise"] > 0.0
    excess = figures["chi2_reduced"] > 1.0 + max(1.0 if rounded else _EXCESS, significant)
    return excess or (is_structured(figures) and not rounded) or is_coarse(figures)


def is_structured(figures: dict[str, float]) -> bool:
    """Whether any test tells the residuals from white noise."""
    return figures["runs_z"] < -_RUNS or min(figures[name] for name in _P_VALUES) < _FALSE_ALARM / _TESTS


def is_coarse(figures: dict[str, float]) -> bool:
    """Whether the straight lines between the drive's samples err by more than the noise hides."""
    return figures["interpolation_error"] > _COARSE * figures["rms_residual"]


def interpolation_error(voltage: Float[np.ndarray, " samples"]) -> float:
    """How far a smooth drive lies from the lines between its samples (V): its bend over a step, beyond the noise's."""
    bend = float(np.median(np.abs(np.diff(voltage, 2))))
    noise = 0.6744897501960817 * math.sqrt(6.0) * white_noise(voltage)
    return math.sqrt(max(bend**2 - 1.5 * noise**2, 0.0)) / 8.0


def runs_z(residuals: Float[np.ndarray, " samples"]) -> float:
    """Wald and Wolfowitz's runs test of signs, in standard deviations; far below zero: signs come in stretches."""
    positive = residuals > np.median(residuals)
    above = int(positive.sum())
    below = positive.size - above
    if above == 0 or below == 0:
        return -math.inf
    runs = 1 + int(np.count_nonzero(positive[1:] != positive[:-1]))
    both = 2.0 * above * below
    mean = both / positive.size + 1.0
    variance = both * (both - positive.size) / (positive.size**2 * (positive.size - 1.0))
    return (runs - mean) / math.sqrt(variance)


def folded_p(residuals: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], frequency: float | None) -> float:
    """Probability that white noise repeats with the drive (Hz) as much as this: the least of F tests, uncorrected.

    Each compares the means of the residuals in as many phases of the period with their scatter. What a wrong
    circuit leaves repeats with the drive, and adds up over the periods. 1 where nothing is expected to repeat.
    """
    if frequency is None or residuals.size < _LEAST_TESTED:
        return 1.0
    phase = np.mod(time * frequency, 1.0)
    place = np.minimum((phase * _PHASES[-1]).astype(int), _PHASES[-1] - 1)
    count, total = (np.bincount(place, x, _PHASES[-1]) for x in (None, residuals))
    square = float(residuals @ residuals)
    found = []
    for phases in _PHASES:
        n, mean = (x.reshape(phases, -1).sum(axis=1) for x in (count, total))
        between, within = np.count_nonzero(n), residuals.size - np.count_nonzero(n)
        if within < residuals.size // 2:  # too few samples in each phase to know their scatter
            break
        share = float(np.sum(mean[n > 0] ** 2 / n[n > 0])) / square if square > 0.0 else 0.0
        # the share of `between` directions in the sum of squares of white noise has a beta distribution
        found.append(float(_beta_cdf(0.5 * within, 0.5 * between, max(1.0 - share, 0.0))))
    return min(found, default=1.0)


@jax.jit
def _beta_cdf(a: float, b: float, x: float) -> jax.Array:
    return betainc(jnp.asarray(a, float), jnp.asarray(b, float), jnp.asarray(x, float))


def spectrum_p(residuals: Float[np.ndarray, " n"]) -> float:
    """Bartlett's test of the cumulative periodogram, by Kolmogorov and Smirnov's law: low where noise is not white."""
    share = _periodogram(residuals)
    if share.size < _LEAST_TESTED // 2:
        return 1.0
    even = np.arange(1, share.size + 1) / share.size
    distance = float(np.max(np.abs(np.cumsum(share) - even))) * math.sqrt(share.size)
    if distance < 0.2:  # where the series converges slowly, to 1
        return 1.0
    k = np.arange(1, 31)
    return float(np.clip(2.0 * np.sum((-1.0) ** (k - 1) * np.exp(-2.0 * (k * distance) ** 2)), 0.0, 1.0))


def line_p(residuals: Float[np.ndarray, " n"]) -> float:
    """Fisher's test: low where one line of the periodogram, as of hum, is too strong for white noise."""
    share = _periodogram(residuals)
    if share.size < _LEAST_TESTED // 2:
        return 1.0
    log_p = math.log(share.size) + (share.size - 1) * math.log1p(-min(float(share.max()), 1.0 - 1e-16))
    return math.exp(min(log_p, 0.0))


def _periodogram(residuals: Float[np.ndarray, " n"]) -> Float[np.ndarray, " lines"]:
    """Shares of the lines between 0 and half the sampling rate; none where there is nothing to share."""
    power = np.abs(np.fft.rfft(residuals)[1 : (residuals.size + 1) // 2]) ** 2
    return power / power.sum() if power.sum() > 0.0 else power[:0]
