"""A recorded drive without most of its noise, by which delays of a part of a time step are computed.

A response between two samples of a noisy V has less noise than at a sample, by up to a half of its variance, so that a
free delay is drawn there; and the slope of V, by which a delay is found, is partly noise. So a delay shifts the smooth
drive only, and the noise of V stays where it was recorded.
"""

import functools
import itertools
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from fitact.compiled import array_module
from fitact.data.tones import Tones
from fitact.model.loop_modes import HighpassTerms

# 2 S - S^2 of the mean S with the weights 1, 4, 6, 4 and 1 of a cubic B-spline, which leaves a cubic as it is
_WEIGHTS = np.array([-1.0, -8.0, 4.0, 72.0, 122.0, 72.0, 4.0, -8.0, -1.0]) / 256.0
_ROUNDS = 5  # of smoothing, each over twice as many samples as the one before
_REACH = len(_WEIGHTS) // 2 * (2**_ROUNDS - 1)  # of all rounds to either side, in samples


def smooth_drive(V: Any, noise: ArrayLike, tones: Tones | None = None, transition: float = 1.5) -> Any:
    """Return V (..., samples) without most of its white noise, of sd `noise` (V): its `tones`, if it has few.

    Else, it is what five rounds of smoothing leave, and the details that each took away (a wavelet transform with
    holes). A detail below 4.5 sd of its noise in the finest, and below 2.5 in the coarsest, which has fewer independent
    values, is left out. One `transition` sd above that is kept, so that an edge stays as it is.
    """
    if tones is not None:
        return tones.values()
    xp, count = array_module(V), V.shape[-1]
    around = [(0, 0)] * (V.ndim - 1) + [(_REACH, _REACH)]
    scales = [each[..., :count] for each in _smooth(xp.pad(V, around, mode="reflect", reflect_type="odd"))]
    smooth = scales[-1]
    for number, sd in enumerate(_noise_of_details(), 1):
        detail, unit = scales[number - 1] - scales[number], xp.maximum(sd * noise, np.finfo(float).tiny)
        above = abs(detail) / unit - (2.0 + 2.5 / number)
        smooth = smooth + detail * xp.clip(above / transition, 0.0, 1.0)
    return smooth


def second_differences(V: Any) -> Any:
    """Return the second differences of V (samples) around each sample."""
    return array_module(V).diff(V, 2, prepend=V[:1], append=V[-1:])


def lasting_bend(V: Any) -> Any:
    """Return the second differences of V (samples) without those of corners: medians of three, 0 at `find_corners`."""
    xp = array_module(V)
    bend = xp.pad(second_differences(V), 1)
    before, here, after = bend[:-2], bend[1:-1], bend[2:]
    median = xp.maximum(xp.minimum(before, after), xp.minimum(xp.maximum(before, after), here))
    starts = find_corners(V)
    return xp.where(starts | xp.pad(starts, (1, 0))[:-1], 0.0, median)


def find_corners(V: Any, max_others: float = 0.125) -> Any:
    """Return at which samples a step begins within which V (samples) has a corner.

    It bends V at both samples around it, and those next to them less, by `max_others` of both together.
    """
    xp = array_module(V)
    bend = xp.pad(second_differences(V), (1, 2))
    before, first, second, after = bend[:-3], bend[1:-2], bend[2:-1], bend[3:]
    others = xp.maximum(abs(before), abs(after))
    return (first * second > 0.0) & (others < max_others * abs(first + second))


def curve_drive(smooth: Any, late: float, lag: float = 0.0) -> Any:
    """Return a smooth drive (samples, V) between whose samples lines are a curve, where it is `late` (time steps).

    A low-pass with the time constant `lag` (time steps) reads the drive later by an exponential distribution.
    """
    return smooth + np.mean(missing_curve(_spread(late, lag))) * lasting_bend(smooth)


def corner_errors(smooth: Any, late: float, lag: float = 0.0) -> Any:
    """Return by how much (V) lines between samples of a smooth drive miss its corners, where each sample reads it.

    A corner at the part x of a step bends the drive by 1 - x and x of its own bend at the two samples around it. At the
    part p, where a response that is `late` (time steps) reads it, the line is off by the lesser of p times the first
    and 1 - p times the second. `lag`: see `curve_drive`.
    """
    xp, bend, lates = array_module(smooth), second_differences(smooth), _spread(late, lag)
    before, after, total = abs(bend) * find_corners(smooth), xp.roll(abs(bend), -1), 0.0
    for steps, part in zip(*np.divmod(-lates, 1.0), strict=True):
        total = total + xp.roll(xp.sign(bend) * xp.minimum(part * before, (1.0 - part) * after), -int(steps))
    return abs(total) / lates.size


def _spread(late: float, lag: float) -> Float[np.ndarray, " lates"]:
    """Return delays (time steps) that represent the distribution of a `late` one behind a low-pass."""
    return late - lag * np.log1p(-(np.arange(16) + 0.5) / 16.0) if lag else np.array([late])


def curve_tones(tones: Tones, late: float, terms: HighpassTerms, step: float = 1.0) -> Float[np.ndarray, " samples"]:
    """Return samples of a drive (V) to which, with lines between them, `terms` respond as they do to its tones.

    Steady responses are compared at the samples, where they are `late` (time steps of `step` s).
    """
    turns, part = 1j * tones.frequencies, late % 1.0
    back = np.exp(-turns)
    direct = complex(0.0 if terms.direct is None else terms.direct)
    exact, made = direct * np.exp(-turns * part), direct * (1.0 - part + part * back)
    for weight, tau in zip(terms.weight, terms.tau, strict=True):
        age = step / float(tau)
        exact = exact + float(weight) * turns / (turns + age) * np.exp(-turns * part)
        before = -np.expm1(-age) / age * (1.0 - back) / (1.0 - np.exp(-age) * back)  # response at a sample
        since = (1.0 - part) * age  # its decay and the rise of the line from the sample before
        made = made + float(weight) * (np.exp(-since) * back * before - np.expm1(-since) / age * (1.0 - back))
    return tones.mean + tones.scale(exact / made)


def missing_curve(late: ArrayLike) -> ArrayLike:
    """Return the part of second differences that lines between samples lack where the drive is `late` (time steps)."""
    part = late % 1.0
    return -0.5 * part * (1.0 - part)


def _smooth(V: Any) -> list[Any]:
    """Return V after each round, from none on, from the sample `_REACH` on; the ends are cut off round by round."""
    last, cut, scales = V, 0, [V[..., _REACH:]]
    for number in range(_ROUNDS):
        distance, middle = 2**number, len(_WEIGHTS) // 2
        count = last.shape[-1] - 2 * middle * distance
        parts = [last[..., i * distance : i * distance + count] for i in range(len(_WEIGHTS))]
        pairs = (_WEIGHTS[i] * (parts[i] + parts[-1 - i]) for i in range(middle))
        last, cut = sum(pairs, _WEIGHTS[middle] * parts[middle]), cut + middle * distance
        scales.append(last[..., _REACH - cut :])
    return scales


@functools.cache
def _noise_of_details() -> tuple[float, ...]:
    """Return the sd of each detail of white noise of sd 1."""
    impulse = np.zeros(4 * _REACH)
    impulse[2 * _REACH] = 1.0
    scales = [each[: 2 * _REACH] for each in _smooth(impulse)]
    return tuple(float(np.linalg.norm(finer - wider)) for finer, wider in itertools.pairwise(scales))
