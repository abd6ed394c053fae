"""What is worth a warning about a record, though it can be used; what cannot be used is refused in `record`."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float

from fitact.data.clipping import clipped
from fitact.data.record import OVERFLOW, is_uniform, rounding_noise
from fitact.units import engineering

_ROUNDED = 1e-6  # of a step: off an even grid by more, time was rounded
_COARSE = 20  # samples a period, below which edges and bends are lost
_MAINS = (50.0, 60.0)  # Hz
_HUM_PERIODS = 4  # of the mains that a record must hold to tell them from drift
_HUM_SHARE = 0.01  # of the channel's range: hum worth a word
_DRIFT_SHARE = 0.02  # of the channel's range, over the record
_CERTAIN = 6.0  # standard errors
_LARGE = {"V": 5e3, "A": 0.1}  # beyond what drives a touch display
_DIVIDERS = (2e-2, 0.5)  # Vsc over V: below, a probe's attenuation may be missing; from 1/2 on, no circuit does it

Samples = Float[np.ndarray, " samples"]


def check_time(time: Samples, frequency: float | None) -> list[str]:
    """Of the time stamps, s, and the rate that they make for a signal of `frequency`."""
    found = []
    step = (time[-1] - time[0]) / (time.size - 1)
    off = float(np.max(np.abs(time - np.linspace(time[0], time[-1], time.size)))) / step
    if off > _ROUNDED and is_uniform(time):
        found.append(f"the time is rounded: off an even grid by {off:.2g} of a step, as float32 leaves it; harmless")
    if not time[0] <= 0.0 <= time[-1]:
        found.append(
            f"the trigger (0 s) lies outside of the record ({engineering(time[0], 's')} to"
            f" {engineering(time[-1], 's')}); a drive that a scene states is found by its phase, not by the trigger"
        )
    if frequency is None:
        found.append("no channel shows 1.5 periods of a wave; record two periods or more")
    elif 1.0 / (frequency * step) < _COARSE:
        found.append(
            f"{1.0 / (frequency * step):.3g} samples a period: what changes faster is lost or aliased; record faster"
        )
    return found


def check_channel(name: str, unit: str, time: Samples, values: Samples, frequency: float | None) -> list[str]:
    """Of one channel; unit V, A or "" where none is known."""
    bad = np.flatnonzero(~np.isfinite(values) | (np.abs(values) >= OVERFLOW))
    if bad.size:
        return [f"{name} is not finite, or a code for overflow, at {bad.size:,} samples; they will be refused"]
    spread = float(np.ptp(values))
    if spread == 0.0:
        return [f"{name} is constant at {values[0]:.6g}; is it connected?"]
    found = []
    railed = int(np.count_nonzero(clipped(values)))
    if railed:
        found.append(
            f"{name} is clipped at {railed:,} samples ({values.min():.4g} to {values.max():.4g}): the oscilloscope's"
            " range or the amplifier is exceeded"
        )
    if rounding_noise(values) > 0.0:
        found.append(f"{name} is rounded to steps wider than its noise; record with a finer range")
    largest = float(np.max(np.abs(values)))
    if largest > _LARGE.get(unit, math.inf):
        found.append(
            f"{name} reaches {engineering(largest, unit)}, more than a touch display takes; is the unit right?"
        )
    found += (f"{name} {sentence}" for sentence in _slow(time, values, spread, frequency))
    return found


def check_divider(channels: Mapping[str, Samples]) -> list[str]:
    """Vsc against V: the size that a probe of another attenuation, or swapped columns, would give it."""
    if not {"V", "Vsc"} <= set(channels) or np.ptp(channels["V"]) == 0.0:
        return []
    ratio = float(np.ptp(channels["Vsc"]) / np.ptp(channels["V"]))
    if _DIVIDERS[0] <= ratio < _DIVIDERS[1]:
        return []
    doubt = (
        "a 10x probe read as 1x (--scale Vsc=10), or a wet finger"
        if ratio < _DIVIDERS[0]
        else "swapped columns or a wrong unit"
    )
    return [f"Vsc spans {ratio:.3g} times V, which suggests {doubt}"]


def _slow(time: Samples, values: Samples, spread: float, frequency: float | None) -> Iterator[str]:
    """Hum and drift beside a periodic signal: by a line of the spectrum, and by the means of the periods."""
    span = float(time[-1] - time[0])
    if frequency is None or not is_uniform(time) or span * frequency < 3.0:
        return
    for mains in _MAINS:
        harmonic = abs(mains / frequency - round(mains / frequency)) * frequency * span < 2.0
        if span * mains < _HUM_PERIODS or harmonic:
            continue  # too short to tell, or of the signal itself
        line = _line(time, values, mains)
        beside = max(abs(_line(time, values, mains + away / span)) for away in (-3.0, 3.0))
        if abs(line) > max(_HUM_SHARE * spread, 3.0 * beside):
            yield f"holds {mains:.0f} Hz of {abs(line):.3g}: mains hum; the fit frees it where the data ask for it"
            values = values - np.real(line * np.exp(2j * np.pi * mains * time))
    step = span / (time.size - 1)
    means, centres = _period_means(values, 1.0 / (frequency * step))
    slope, error = _slope(centres * step, means)
    if abs(slope * span) > _DRIFT_SHARE * spread and abs(slope) > _CERTAIN * error:
        yield f"drifts by {slope * span:.3g} over the record; the fit frees a drift where the data ask for one"


def _period_means(values: Samples, samples: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean over each whole period, and its middle in samples."""
    edges = np.round(np.arange(int(values.size / samples) + 1) * samples).astype(int)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.diff(sums[edges]) / np.diff(edges), 0.5 * (edges[1:] + edges[:-1])


def _slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Of a straight line, and its standard error."""
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    return slope, math.sqrt(float(rest @ rest) / max(y.size - 2, 1) / float(x @ x))


def _line(time: Samples, values: Samples, frequency: float) -> complex:
    """One line of the spectrum under a Hann window: amplitude and phase."""
    window = np.hanning(values.size)
    wave = np.exp(-2j * np.pi * frequency * time)
    return complex(2.0 * np.sum(window * wave * (values - values.mean())) / window.sum())
