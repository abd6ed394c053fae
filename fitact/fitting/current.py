"""Loop current I: selection of the samples that a model can predict, and estimates of the circuit before any fit.

If no resistance limits it, I follows dV/dt. I jumps at an edge of the drive, so a sample there carries little
information. Elsewhere, differentiating a recorded V amplifies its noise.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitact.data.record import Record
from fitact.fitting.drive_choice import DriveModel, drive_slope, unit_response
from fitact.units import format_percent


class CurrentSamples(NamedTuple):
    """Samples of a current that follows dV/dt, as a likelihood uses them."""

    weight: Float[np.ndarray, " samples"]  # relative inverse noise sd, 0 at edges; see `ChannelLikelihood`
    rate: Float[np.ndarray, " samples"]  # dV/dt, V/s
    drive_noise_dominates: bool  # whether V's noise, differentiated, takes too much off what follows dV/dt
    notes: tuple[str, ...]  # sentences for information
    warnings: tuple[str, ...]  # sentences on what may change the result


def select_current_samples(record: Record, choice: DriveModel) -> CurrentSamples:
    """Exclude the samples at edges, and weight the others by their noise, including that of dV/dt."""
    max_attenuation = 1e-3  # largest acceptable relative bias of the capacitive current due to noise of V
    noise = record.noise("V") if choice.name == "measured" else 0.0
    used = ~edge_mask(choice.voltage, noise)
    if choice.name != "measured":
        slope = drive_slope(choice, record.time)
        used &= np.isfinite(slope)  # a record may begin at a jump
    note = f"I: {np.count_nonzero(~used):,} of {used.size:,} samples lie at an edge of the drive and are excluded"
    if choice.name != "measured":
        return CurrentSamples(used.astype(float), np.where(used, slope, 0.0), False, (note,), ())
    rate = np.gradient(choice.voltage) / np.gradient(record.time)  # over two steps, which halves the noise
    spread = noise / (math.sqrt(2.0) * record.time_step)
    weight = used * weigh_current_samples(record["I"], rate, spread / record.noise("I"), used)
    # what noise in a regressor takes off its coefficient
    spread = spread * (rate != 0.0)
    attenuation = float(np.sum((weight * spread) ** 2) / max(float(np.sum((weight * rate) ** 2)), 1e-300))
    if attenuation <= max_attenuation:
        return CurrentSamples(weight, rate, False, (note,), ())
    warning = (
        "noise of V_V, amplified by differentiation, lowers the estimated capacitive part of I by"
        f" {format_percent(attenuation)}; name the waveform in the scene, or record V with less noise"
    )
    return CurrentSamples(weight, rate, True, (note,), (warning,))


def weigh_current_samples(
    current: Float[np.ndarray, " samples"],
    rate: Float[np.ndarray, " samples"],
    spread: float,
    used: Bool[np.ndarray, " samples"],
) -> Float[np.ndarray, " samples"]:
    """Return the weights of samples of I whose dV/dt has noise; `spread` is its sd (V/s) over the sd of I's noise."""
    capacitance = abs(float(current[used] @ rate[used]) / max(float(rate[used] @ rate[used]), 1e-300))
    # a V that stays at one level has no noise there that a derivative could see
    return 1.0 / np.hypot(1.0, capacitance * spread * (rate != 0.0))


def edge_mask(voltage: Float[np.ndarray, " samples"], noise: float) -> Bool[np.ndarray, " samples"]:
    """Return which samples lie within `margin` steps of a sudden change of the drive's slope."""
    margin = 2
    # a change is sudden if it exceeds so many times the median over a block of samples, or the effect of noise
    threshold, block = 8.0, 64
    bend = np.abs(np.diff(voltage, 2, prepend=voltage[0], append=voltage[-1]))
    blocks = np.pad(bend, (0, -bend.size % block), mode="edge").reshape(-1, block)
    median = np.repeat(np.median(blocks, axis=1), block)[: bend.size]
    floor = math.sqrt(6.0) * noise + 1e-9 * float(np.ptp(voltage))
    edges = bend > threshold * np.maximum(median, floor)
    return np.convolve(edges, np.ones(2 * margin + 1), mode="same") > 0.5


class CurrentEstimate(NamedTuple):
    """Coefficients of I = weight s b / (1 + s b) V + capacitance dV/dt from linear fits."""

    weight: float  # S
    b: float  # s
    capacitance: float  # F


def estimate_from_current(record: Record, choice: DriveModel, samples: CurrentSamples) -> CurrentEstimate:
    """Estimate the coefficients of I by linear fits on a grid of time constants."""
    weight, rate = samples.weight, samples.rate
    span = float(record.time[-1] - record.time[0])
    taus = np.geomspace(2.0 * record.time_step, 10.0 * span, 60)

    def fit_at_tau(tau: float) -> tuple[float, float, float]:
        columns = [unit_response(choice, record.time, tau), rate, np.ones_like(rate)]
        if choice.unknown_charge:
            columns.append(np.exp(-(record.time - record.time[0]) / tau))
        design = np.stack(columns, axis=1) * weight[:, None]
        sizes = np.linalg.norm(design, axis=0)
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        amplitudes = np.linalg.lstsq(design / sizes, record["I"] * weight, rcond=None)[0] / sizes
        residuals = record["I"] * weight - design @ amplitudes
        return float(residuals @ residuals), float(amplitudes[0]), float(amplitudes[1])

    best = min(range(taus.size), key=lambda k: fit_at_tau(float(taus[k]))[0])
    if 0 < best < taus.size - 1:
        taus = np.geomspace(taus[best - 1], taus[best + 1], 17)
        best = min(range(taus.size), key=lambda k: fit_at_tau(float(taus[k]))[0])
    _, g, capacitance = fit_at_tau(taus[best])
    return CurrentEstimate(g, float(taus[best]), capacitance)
