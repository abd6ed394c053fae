"""The trunk current: which of its samples can be compared with a model, and what it says before any fit.

Where nothing resistive limits it, I follows dV/dt. At an edge of the drive it jumps, and a sample there says
little; elsewhere dV/dt of a recorded V carries V's noise, many times over.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitact.data.record import Record
from fitact.fitting.drive_choice import DriveChoice, slope_of, unit_response
from fitact.units import percent

_NEAR = 2  # steps from an edge within which samples are left out
_BLOCK = 64  # samples over which the bend of a smooth drive counts as the same
_BEND = 8.0  # times that bend, or its noise: an edge
_ATTENUATION = 1e-3  # relative error of what follows dV/dt, by V's noise, that is not trusted
_TAUS = 60  # time constants tried


class Comparable(NamedTuple):
    """What a likelihood needs of a current that follows dV/dt.

    Attributes:
        weight: of the samples, as in `fitact.likelihood.channel.Trace`.
        rate: dV/dt, V/s.
        drowned: whether V's noise, differentiated, takes too much off what follows dV/dt.
        notes: what was left out or is worth knowing, in sentences.
    """

    weight: Float[np.ndarray, " samples"]
    rate: Float[np.ndarray, " samples"]
    drowned: bool
    notes: tuple[str, ...]


def comparable(record: Record, choice: DriveChoice) -> Comparable:
    """Leave out the samples at edges, and weigh those between them by the noise that dV/dt brings in."""
    noise = record.noise("V") if choice.name == "measured" else 0.0
    kept = ~_at_edges(choice.voltage, noise)
    if choice.name != "measured":
        slope = slope_of(choice, record.time)
        kept &= np.isfinite(slope)  # a record may begin at a jump
    note = f"I: {np.count_nonzero(~kept):,} of {kept.size:,} samples lie at an edge of the drive and are left out"
    if choice.name != "measured":
        return Comparable(kept.astype(float), np.where(kept, slope, 0.0), False, (note,))
    rate = np.gradient(choice.voltage) / np.gradient(record.time)  # over two steps, which halves the noise
    capacitance = abs(float(record["I"][kept] @ rate[kept]) / max(float(rate[kept] @ rate[kept]), 1e-300))
    # a V that stays at one level has no noise there that a derivative could see
    spread = noise / (math.sqrt(2.0) * record.time_step) * (np.gradient(choice.voltage) != 0.0)
    weight = kept / np.hypot(1.0, capacitance * spread / record.noise("I"))
    # what noise in a regressor takes off its coefficient
    attenuation = float(np.sum((weight * spread) ** 2) / max(float(np.sum((weight * rate) ** 2)), 1e-300))
    if attenuation <= _ATTENUATION:
        return Comparable(weight, rate, False, (note,))
    drowned = (
        f"V_V's noise, differentiated, drowns I and takes {percent(attenuation)} off what follows dV/dt;"
        " name the waveform in the scene, or record V with less noise"
    )
    return Comparable(weight, rate, True, (note, drowned))


def _at_edges(voltage: Float[np.ndarray, " samples"], noise: float) -> Bool[np.ndarray, " samples"]:
    """Samples within two steps of where the drive's slope changes suddenly."""
    bend = np.abs(np.diff(voltage, 2, prepend=voltage[0], append=voltage[-1]))
    blocks = np.pad(bend, (0, -bend.size % _BLOCK), mode="edge").reshape(-1, _BLOCK)
    usual = np.repeat(np.median(blocks, axis=1), _BLOCK)[: bend.size]
    floor = math.sqrt(6.0) * noise + 1e-9 * float(np.ptp(voltage))
    edges = bend > _BEND * np.maximum(usual, floor)
    return np.convolve(edges, np.ones(2 * _NEAR + 1), mode="same") > 0.5


class CurrentStart(NamedTuple):
    """I = weight s b / (1 + s b) V + capacitance dV/dt, by linear fits."""

    weight: float  # S
    b: float  # s
    capacitance: float  # F


def current_start(record: Record, choice: DriveChoice, seen: Comparable) -> CurrentStart:
    """By linear fits over a range of time constants."""
    weight, rate = seen.weight, seen.rate
    span = float(record.time[-1] - record.time[0])
    taus = np.geomspace(2.0 * record.time_step, 10.0 * span, _TAUS)

    def fitted(tau: float) -> tuple[float, float, float]:
        columns = [unit_response(choice, record.time, tau), rate, np.ones_like(rate)]
        if choice.unknown_charge:
            columns.append(np.exp(-(record.time - record.time[0]) / tau))
        design = np.stack(columns, axis=1) * weight[:, None]
        sizes = np.linalg.norm(design, axis=0)
        found = np.linalg.lstsq(design / np.where(sizes > 0.0, sizes, 1.0), record["I"] * weight, rcond=None)[0]
        left = record["I"] * weight - design @ (found := found / np.where(sizes > 0.0, sizes, 1.0))
        return float(left @ left), float(found[0]), float(found[1])

    best = min(range(taus.size), key=lambda k: fitted(float(taus[k]))[0])
    if 0 < best < taus.size - 1:
        taus = np.geomspace(taus[best - 1], taus[best + 1], 17)
        best = min(range(taus.size), key=lambda k: fitted(float(taus[k]))[0])
    _, g, capacitance = fitted(taus[best])
    return CurrentStart(g, float(taus[best]), capacitance)
