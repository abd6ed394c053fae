"""Responses of skins whose conductance rises with voltage, by scipy's solve_ivp at tight tolerances."""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.integrate
from scipy.special import expit

from data_synth.bench import IDEAL, Bench
from data_synth.drive import Drive
from data_synth.errors import RecipeError
from data_synth.network import Network, StateSpace, state_space
from data_synth.response import polynomials, steps

_FLOOR = 1e-13  # absolute tolerance of states, whose peak is some 1e-2
_SOLVER: dict[str, Any] = {"method": "LSODA", "rtol": 1e-10, "atol": _FLOOR}
_SETTLED = 1e-8  # relative change per period of a state that counts as settled
_MOST_PERIODS = 400
_BESIDE = 1e-9  # fraction of a stretch between corners by which the drive is evaluated inside it


class NonlinearSkin(NamedTuple):
    """Circuit, resistance (ohm) of its outer layers at zero voltage, and the law of their conductance.

    nonlinear: the conductance is multiplied by 1 + (v / half_voltage)^2. electroporated: by up to `factor`, with a
    fraction of open pores that relaxes within `time_constant` to 1 / (1 + exp((threshold - |v|) / width)).
    """

    system: StateSpace
    R: np.ndarray
    law: Mapping[str, Any]

    @property
    def remembers(self) -> bool:
        """Whether fractions of open pores are among the states, after the circuit's charges."""
        return self.law["model"] == "electroporated"

    def extra(self, states: np.ndarray, voltage: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the current of each layer beyond v / R (A), and its voltage (V)."""
        size = len(self.system.A)
        v = self.system.C[3:] @ states[:size] + np.multiply.outer(self.system.D[3:, 0], voltage)
        more = (self.law["factor"] - 1.0) * states[size:] if self.remembers else (v / self.law["half_voltage"]) ** 2
        return more * (v.T / self.R).T, v

    def change(self, states: np.ndarray, voltage: np.ndarray) -> np.ndarray:
        """Return the time derivative of the states."""
        size = len(self.system.A)
        current, v = self.extra(states, voltage)
        change = self.system.A @ states[:size] + self.system.B @ np.append(voltage, current)
        if not self.remembers:
            return change
        wanted = expit((np.abs(v) - self.law["threshold"]) / self.law["width"])
        return np.append(change, (wanted - states[size:]) / self.law["time_constant"])


def nonlinear_response(
    circuit: Network, law: Mapping[str, Any], drive: Drive, time: np.ndarray, bench: Bench = IDEAL
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, Vsc (V) and I (A) at `time` (s): periodic drives in the steady state, others from rest.

    Raises:
        RecipeError: no steady state after many periods.
    """
    system = bench.extend(state_space(circuit))
    skin = NonlinearSkin(system, np.array([layer[2] for layer in circuit.layers]), law)
    size = len(system.A)
    grid, place = steps(drive, time)
    state = np.zeros(size + skin.remembers * skin.R.size)
    if drive.period:
        state = _steady_state(skin, drive, state, float(grid[0]))
    states = _states(skin, drive, state, grid)[:-1].T
    taylor = polynomials(drive, grid)
    voltage, slope = taylor[:, 0], taylor[:, 1] / np.diff(grid)
    inputs = np.vstack([voltage, skin.extra(states, voltage)[0]])
    out = system.C[:3] @ states[:size] + system.D[:3] @ inputs + np.outer(system.E[:3], slope)
    if drive.jumps and system.E[2] != 0.0:
        out[2] = np.nan
    return out[0, place], out[1, place], out[2, place]


def _states(skin: NonlinearSkin, drive: Drive, state: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the states at `wanted` (s, increasing), from the state at the first."""

    def change(at: float, state: np.ndarray, start: float, end: float) -> np.ndarray:
        beside = _BESIDE * (end - start)
        return skin.change(state, drive.value(np.clip(at, start + beside, end - beside)))

    corners = drive.corners(wanted[0], wanted[-1])
    ends = np.unique([wanted[0], *corners[(corners > wanted[0]) & (corners < wanted[-1])], wanted[-1]])
    found = [state]
    for first, last in itertools.pairwise(ends):
        within = wanted[(wanted > first) & (wanted <= last)]
        times = np.unique(np.append(within, last))
        solved = scipy.integrate.solve_ivp(change, (first, last), state, t_eval=times, args=(first, last), **_SOLVER)
        found += list(solved.y.T[: within.size])
        state = solved.y[:, -1]
    return np.array(found)


def _steady_state(skin: NonlinearSkin, drive: Drive, state: np.ndarray, start: float) -> np.ndarray:
    """Return the states at `start` (s) after enough periods to settle."""
    assert drive.period is not None
    for _ in range(_MOST_PERIODS):
        before = state
        state = _states(skin, drive, state, np.array([start, start + drive.period]))[-1]
        if np.allclose(state, before, rtol=_SETTLED, atol=10.0 * _FLOOR):
            return state
    raise RecipeError(f"the skin has not settled after {_MOST_PERIODS} periods; start from rest")
