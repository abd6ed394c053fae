"""Pieces of equipment and the distributions of their errors."""

import dataclasses
import functools
import math
from collections.abc import Iterable
from typing import Self

from fitact.instrument.classes import CLASSES
from fitact.model.circuit import Probe
from fitact.prior.distributions import Distribution, Uniform


@dataclasses.dataclass(frozen=True)
class Piece:
    """One piece of equipment, with one error of each kind in all records and channels that name it.

    Attributes:
        name: "class:piece", as in the scene.
        gain: distribution of the factor between indicated and true values; None means exact.
        compensation: the same at high frequency, relative to low frequency.
        nonlinearity: integral non-linearity, as a factor around 1, relative to the range.
        offset: largest offset, relative to the range.
        skew: largest delay against another channel of the instrument, s.
        skew_intervals: the same in sampling intervals.
        resistance, capacitance: distributions of its input impedance, ohm and F; None means that it does not load.
        source: where the figures come from.
        is_probe: whether it stands between the circuit and another input, and hides that input's load.
    """

    name: str
    gain: Distribution | None = None
    compensation: Distribution | None = None
    nonlinearity: Distribution | None = None
    offset: float = 0.0
    skew: float = 0.0
    skew_intervals: float = 0.0
    resistance: Distribution | None = None
    capacitance: Distribution | None = None
    source: str = "certificate"
    is_probe: bool = False

    @classmethod
    @functools.cache
    def from_class(cls, name: str) -> Self:
        """Return a piece with the errors of its class."""
        stated = dict(CLASSES[name.partition(":")[0]])
        for key in stated.keys() & {"gain", "compensation", "nonlinearity", "resistance", "capacitance"}:
            limits = stated[key]
            stated[key] = Uniform.with_tolerance(*(limits if isinstance(limits, tuple) else (1.0, limits)))
        return cls(name, **stated, is_probe=name.startswith("probe-"))

    def nominal_probe(self) -> Probe:
        """Return the load at its median values."""
        medians = [None if x is None else math.exp(x.log_mean) for x in (self.resistance, self.capacitance)]
        return Probe(math.inf if medians[0] is None else medians[0], medians[1] or 0.0)


def find_load(pieces: Iterable[Piece]) -> Piece | None:
    """Return the piece of a chain whose input loads the circuit: a probe if there is one, else the last input."""
    loading = [piece for piece in pieces if piece.resistance is not None]
    return next((piece for piece in loading if piece.is_probe), loading[-1] if loading else None)
