"""Vsc and I in time, by matrix exponentials of the state space, with a polynomial drive in each step.

This is exact for straight lines (first-order hold). Sines are polynomials of degree 8 through Chebyshev points of
steps of at most a 16th of a cycle.
"""

import math

import numpy as np
import scipy.linalg
from numpy.polynomial import chebyshev

from data_synth.drive import Drive
from data_synth.network import StateSpace

_SAME = 1e-9  # fraction of a record's step below which two times are equal
_STILL = 1e-12  # smaller singular values belong to charges that no resistance moves


def response(system: StateSpace, drive: Drive, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, Vsc (V) and I (A) at `time` (s, any order): periodic drives in the steady state, others from rest.

    At a jump, values are right limits, and I is NaN if no resistance limits it.
    """
    grid, place = steps(drive, time)
    taylor = polynomials(drive, grid)
    charge = _steady_state(system, drive, float(grid[0])) if drive.period else np.zeros(len(system.A))
    states = _states(system, grid, taylor, charge)[:-1]
    voltage, slope = taylor[:, 0], taylor[:, 1] / np.diff(grid)
    out = states @ system.C.T + np.outer(voltage, system.D[:, 0])
    current = out[:, 2] + system.E[2] * slope
    if drive.jumps and system.E[2] != 0.0:
        ended = np.sum(taylor / _factorials(drive.degree), axis=1)
        before = np.append(drive.value(grid[:1] - 1e-6 * drive.longest), ended[:-1])
        current = np.where(np.abs(voltage - before) > 1e-5 * np.ptp(voltage), np.nan, current)
    return out[place, 0], out[place, 1], current[place]


def frequency_response(system: StateSpace, omega: float) -> tuple[complex, complex, complex]:
    """Return V, Vsc (1) and I (S) per volt of the drive at the angular frequency `omega` (rad/s)."""
    x = np.linalg.solve(1j * omega * np.eye(len(system.A)) - system.A, system.B[:, 0])
    V, Vsc, current = system.C[:3] @ x + system.D[:3, 0] + 1j * omega * system.E[:3]
    return complex(V), complex(Vsc), complex(current)


def steps(drive: Drive, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times (s) of steps without a corner inside, and the indices of `time` among them."""
    start, end = float(time.min()), float(time.max())
    if drive.period is None:
        start = min(start, 0.0)
    apart = np.diff(np.unique(time))
    end += float(np.median(apart))  # each sample begins a step
    corners = drive.corners(start, end)
    corners = corners[(corners > start) & (corners < end)]
    wanted = np.unique(np.concatenate([time, corners, [start, end]]))
    keep = np.append(True, np.diff(wanted) > _SAME * np.median(apart))
    wanted = wanted[keep]
    parts = np.ceil(np.diff(wanted) / drive.longest * (1.0 - 1e-9)).astype(int)
    fine = [wanted[:-1]] if np.all(parts <= 1) else _subdivide_steps(wanted, parts)
    grid = np.append(np.concatenate(fine), wanted[-1])
    place = np.searchsorted(grid, time + _SAME * np.median(apart), side="right") - 1
    return grid, place


def _subdivide_steps(wanted: np.ndarray, parts: np.ndarray) -> list[np.ndarray]:
    ends = zip(wanted[:-1], wanted[1:], parts, strict=True)
    return [np.linspace(start, end, count, endpoint=False) for start, end, count in ends]


def _factorials(degree: int) -> np.ndarray:
    return np.array([math.factorial(order) for order in range(degree + 1)], dtype=float)


def polynomials(drive: Drive, grid: np.ndarray) -> np.ndarray:
    """Return derivatives of V at the start of each step, in units of the step, from points inside it."""
    count = drive.degree + 1
    angle = np.pi * (np.arange(count) + 0.5) / count
    values = drive.value(grid[:-1, None] + 0.5 * (1.0 - np.cos(angle)) * np.diff(grid)[:, None])
    series = np.cos(np.outer(np.arange(count), angle)) * (2.0 - (np.arange(count) == 0)[:, None]) / count
    # derivatives of T_m(2 s - 1) at s = 0; points run from s = 0 on, where T_m is (-1)^m
    ends = [[_chebyshev_derivative(m, order) for m in range(count)] for order in range(count)]
    return values @ (np.array(ends) @ ((-1.0) ** np.arange(count)[:, None] * series)).T


def _chebyshev_derivative(m: int, order: int) -> float:
    """Return d^order/ds^order of T_m(2 s - 1) at s = 0."""
    return 2.0**order * float(chebyshev.chebval(-1.0, chebyshev.chebder(np.eye(m + 1)[m], order)))


def _states(system: StateSpace, grid: np.ndarray, taylor: np.ndarray, charge: np.ndarray) -> np.ndarray:
    """Return the states at the grid's times, starting from `charge`."""
    lengths, which = np.unique(np.diff(grid), return_inverse=True)
    size, count = len(system.A), taylor.shape[1]
    whole = np.zeros((lengths.size, size + count, size + count))
    whole[:, :size, :size] = system.A * lengths[:, None, None]
    whole[:, :size, size] = system.B[:, 0] * lengths[:, None]
    whole[:, size:, size:] = np.eye(count, k=1)
    step = scipy.linalg.expm(whole)[:, :size]
    pushed = np.einsum("nij,nj->ni", step[which, :, size:], taylor)
    states = np.empty((grid.size, size))
    states[0] = charge
    for n, (each, push) in enumerate(zip(which, pushed, strict=True)):
        states[n + 1] = step[each, :, :size] @ states[n] + push
    return states


def _steady_state(system: StateSpace, drive: Drive, start: float) -> np.ndarray:
    """Return the states at `start` (s) of the steady state, the fixed point of the period's map."""
    assert drive.period is not None
    grid, _ = steps(drive, np.array([start, start + drive.period]))
    end = int(np.argmin(np.abs(grid - (start + drive.period))))
    grid = grid[: end + 1]
    reached = _states(system, grid, polynomials(drive, grid), np.zeros(len(system.A)))[-1]
    lost = np.eye(len(system.A)) - scipy.linalg.expm(system.A * drive.period)
    return np.linalg.lstsq(lost, reached, rcond=_STILL)[0]
