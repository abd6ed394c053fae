"""Responses of skins whose R and C depend on the frequency, in the steady state, by sums of harmonics."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_synth.bench import IDEAL, Bench
from data_synth.drive import Drive, end_values
from data_synth.errors import RecipeError
from data_synth.network import Branch, Network, gains, plain_admittance, state_space
from data_synth.response import response

HARMONICS = 20_000
_BLOCK = 250  # harmonics summed at a time, which bounds memory
_NOTHING = 1e-15  # fraction of the largest harmonic below which one is neglected
# the reference paper, section 3.1
_FREQUENCY = np.array([10.0, 100.0, 1000.0])  # Hz
_RESISTANCE = np.array([200.0, 160.0, 80.0]) / 160.0
_CAPACITANCE = np.array([44.25, 22.0, 8.85]) / 22.0


def harmonic_response(
    circuit: Network,
    skin: Mapping[str, Any],
    drive: Drive,
    time: np.ndarray,
    count: int = HARMONICS,
    bench: Bench = IDEAL,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, Vsc and I at `time` in the steady state, with dispersive or fractional outer skin layers.

    The response of the skin at the highest of `count` harmonics is computed in time, the difference as a sum.

    Raises:
        RecipeError: the drive does not repeat, or jumps (a fractional skin would then need far more harmonics).
    """
    if skin["level"] == "fractional" and drive.jumps:
        raise RecipeError("[skin] level = 'fractional' excludes drives that jump; state a trapezoid with a rise time")
    if drive.period is None:
        raise RecipeError(
            f"[skin] level = '{skin['level']}' needs the steady state; state a periodic drive, not from rest"
        )
    omega = 2.0 * np.pi / drive.period * np.arange(1, count + 1)
    values = {(start, end): (R, C) for start, end, R, C in circuit.layers}

    def admittance(branch: Branch, at: np.ndarray) -> np.ndarray:
        if not branch.layer:
            return plain_admittance(branch, at)
        found = _layer_admittance(*values[branch.start, branch.end], skin, at)
        return found.real + 0j if branch.kind == "R" else 1j * found.imag

    def high_frequency_branch(branch: Branch) -> Branch:
        top = admittance(branch, omega[-1:])[0]
        return branch._replace(value=1.0 / top.real if branch.kind == "R" else top.imag / omega[-1])

    above = circuit._replace(branches=tuple(map(high_frequency_branch, circuit.branches)))
    found = np.array(response(bench.extend(state_space(above)), drive, time))
    heights = 2.0 * fourier_coefficients(drive, count)
    difference = gains(circuit, omega, admittance) - gains(above, omega, plain_admittance)
    missing = (heights * bench.gains(omega) * difference).T
    there = np.flatnonzero(np.any(np.abs(missing) > _NOTHING * np.max(np.abs(missing), axis=0), axis=1))
    for first in range(0, there.size, _BLOCK):
        some = there[first : first + _BLOCK]
        found += (np.exp(1j * np.outer(time, omega[some])) @ missing[some]).real.T
    return found[0], found[1], found[2]


def _layer_admittance(R: float, C: float, skin: Mapping[str, Any], omega: np.ndarray) -> np.ndarray:
    """Return the admittance (S) of an outer layer of `R` ohm and `C` F."""
    if skin["level"] == "fractional":
        return (1.0 + (1j * omega * R * C) ** skin["alpha"]) / R
    where, knots = np.log(np.clip(omega / (2.0 * np.pi), _FREQUENCY[0], _FREQUENCY[-1])), np.log(_FREQUENCY)
    resistance = R * np.exp(np.interp(where, knots, np.log(_RESISTANCE)))
    return 1.0 / resistance + 1j * omega * C * np.exp(np.interp(where, knots, np.log(_CAPACITANCE)))


def fourier_coefficients(drive: Drive, count: int) -> np.ndarray:
    """Return the Fourier coefficients c_1 to c_count (V) of a periodic drive, v = sum c_n exp(2 pi i n t / period)."""
    assert drive.period is not None
    if drive.degree > 1:
        points = 1 << int(np.ceil(np.log2(4.0 * drive.period / drive.longest)))
        found = np.fft.rfft(drive.value(np.arange(points) * drive.period / points))[1:count] / points
        return np.pad(found, (0, count - found.size))
    corners = np.unique(np.mod(drive.corners(0.0, drive.period), drive.period))
    starts, ends = corners, np.append(corners[1:], corners[0] + drive.period)
    first, last = end_values(drive, np.append(starts, ends[-1]))
    omega = 2.0 * np.pi / drive.period * np.arange(1, count + 1)[:, None]
    at_start, at_end = np.exp(-1j * omega * starts), np.exp(-1j * omega * ends)
    straight = (first * at_start - last * at_end) / (1j * omega)
    bent = (last - first) / (ends - starts) * (at_end - at_start) / omega**2
    return np.sum(straight + bent, axis=1) / drive.period
