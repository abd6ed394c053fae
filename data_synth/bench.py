"""Instruments around the circuit: first-order low-passes of the drive and of the channels, as parts of its state space.

The responses stay exact: the filters act on the signal in time, not on its samples.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from data_synth.network import StateSpace

_CHANNELS = ("V", "Vsc", "I")  # the first outputs of a state space
_NO_FILTERS: Mapping[str, float | None] = {}


class Bench(NamedTuple):
    """Bandwidths (Hz, None for unlimited), and where V is recorded.

    amplifier: of the amplifier that makes the drive. bandwidth: of the instrument of each channel.
    behind: whether V is recorded behind the series resistor.
    """

    amplifier: float | None = None
    bandwidth: Mapping[str, float | None] = _NO_FILTERS
    behind: bool = False

    @property
    def filters(self) -> bool:
        """Whether a bandwidth is limited."""
        return bool(self.amplifier or any(self.bandwidth.values()))

    def extend(self, system: StateSpace) -> StateSpace:
        """Return the state space with the filters of the amplifier and of the channels."""
        if self.amplifier:
            system = _filter_drive(system, 2.0 * math.pi * self.amplifier)
        for output, name in enumerate(_CHANNELS):
            limit = self.bandwidth.get(name)
            if limit:
                system = _filter_output(system, output, 2.0 * math.pi * limit)
        return system

    def gains(self, omega: np.ndarray) -> np.ndarray:
        """Return the filters' gains of V, Vsc and I, (3, frequencies), at angular frequencies `omega` (rad/s)."""
        limits = [self.bandwidth.get(name) for name in _CHANNELS]
        return _low_pass(self.amplifier, omega) * np.array([_low_pass(limit, omega) for limit in limits])


IDEAL = Bench()


def _low_pass(limit: float | None, omega: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + 1j * omega / (2.0 * math.pi * limit)) if limit else np.ones(omega.shape, dtype=complex)


def _filter_drive(system: StateSpace, rate: float) -> StateSpace:
    """Return the state space behind a pole: u = v with dv/dt = rate (drive - v)."""
    A, B, C, D, E = system
    size = len(A)
    A = np.block([[A, B[:, :1]], [np.zeros((1, size)), -rate]])
    B = np.vstack([B, np.zeros(B.shape[1])])
    B[:, 0] = 0.0
    B[size, 0] = rate
    C = np.column_stack([C, D[:, 0] - rate * E])
    D = np.column_stack([rate * E, D[:, 1:]])
    return StateSpace(A, B, C, D, np.zeros_like(E))


def _filter_output(system: StateSpace, output: int, rate: float) -> StateSpace:
    """Return the state space whose `output` is z with dz/dt = rate (y - z).

    The new state is (z - rate E u) / k, because y contains E du/dt; k scales it like the others.
    """
    A, B, C, D, E = (each.copy() for each in system)
    size, at_once = len(A), rate * E[output]
    k = float(np.linalg.norm(C[output])) or 1.0
    A = np.block([[A, np.zeros((size, 1))], [rate * C[output] / k, -rate]])
    B = np.vstack([B, rate * D[output] / k])
    B[size, 0] -= rate * at_once / k
    C = np.column_stack([C, np.zeros(len(C))])
    C[output], C[output, size] = 0.0, k
    D[output], D[output, 0] = 0.0, at_once
    E[output] = 0.0
    return StateSpace(A, B, C, D, E)
