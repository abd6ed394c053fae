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
        nonlinearity: limits of the integral non-linearity, as a factor around 1, relative to the range.
        resistance, capacitance: distributions of its input impedance, ohm and F; None means that it does not load.
        source: where the figures come from.
        is_probe: whether it stands between the circuit and another input, and hides that input's load.
    """

    name: str
    gain: Distribution | None = None
    compensation: Distribution | None = None
    nonlinearity: Distribution | None = None
    resistance: Distribution | None = None
    capacitance: Distribution | None = None
    source: str = "certificate"
    is_probe: bool = False

    @classmethod
    @functools.cache
    def from_class(cls, name: str) -> Self:
        """Return a piece with the errors of its class."""
        kind = CLASSES[name.partition(":")[0]]
        names = "gain", "compensation", "nonlinearity"
        relative = {name: (1.0, limit) for name in names if (limit := getattr(kind, name))}
        loads = {key: stated for key in ("resistance", "capacitance") if (stated := getattr(kind, key))}
        errors = {key: Uniform.with_tolerance(*limits) for key, limits in (relative | loads).items()}
        return cls(name, **errors, source=kind.source, is_probe=name.startswith("probe-"))

    def error(self, kind: str) -> Distribution | None:
        """Return the distribution of an error, by its name or "nonlinearity_even" or "nonlinearity_odd"."""
        if not kind.startswith("nonlinearity"):
            return getattr(self, kind)
        limits = self.nonlinearity
        # half for each shape, so that their sum stays within the limits
        return None if limits is None else Uniform.with_tolerance(1.0, 0.5 * math.sqrt(3.0) * limits.log_sd)

    def nominal_probe(self) -> Probe:
        """Return the load at its median values."""
        medians = [None if x is None else math.exp(x.log_mean) for x in (self.resistance, self.capacitance)]
        return Probe(math.inf if medians[0] is None else medians[0], medians[1] or 0.0)


def find_load(pieces: Iterable[Piece]) -> Piece | None:
    """Return the piece of a chain whose input loads the circuit: a probe if there is one, else the last input."""
    loading = [piece for piece in pieces if piece.resistance is not None]
    return next((piece for piece in loading if piece.is_probe), loading[-1] if loading else None)
