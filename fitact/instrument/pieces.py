"""Pieces of equipment and the distributions of their errors."""

import dataclasses
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
        resistance, capacitance: distributions of its input impedance, ohm and F; None means that it does not load.
        source: where the figures come from.
        is_probe: whether it stands between the circuit and another input, and hides that input's load.
    """

    name: str
    gain: Distribution | None
    resistance: Distribution | None
    capacitance: Distribution | None
    source: str
    is_probe: bool = False

    @classmethod
    def from_class(cls, name: str) -> Self:
        """Return a piece with the errors of its class."""
        kind = CLASSES[name.partition(":")[0]]
        limits = (None if kind.gain is None else (1.0, kind.gain)), kind.resistance, kind.capacitance
        gain, resistance, capacitance = (None if each is None else Uniform.with_tolerance(*each) for each in limits)
        return cls(name, gain, resistance, capacitance, kind.source, name.startswith("probe-"))

    def replace_errors(
        self, gain: Distribution | None, resistance: Distribution | None, capacitance: Distribution | None
    ) -> Self:
        """Return the piece with errors from a certificate, as far as they are not None."""
        return dataclasses.replace(
            self,
            gain=gain or self.gain,
            resistance=resistance or self.resistance,
            capacitance=capacitance or self.capacitance,
            source="certificate",
        )

    def nominal_probe(self) -> Probe:
        """Return the load at its median values."""
        medians = [None if x is None else math.exp(x.log_mean) for x in (self.resistance, self.capacitance)]
        return Probe(math.inf if medians[0] is None else medians[0], medians[1] or 0.0)


def find_load(pieces: Iterable[Piece]) -> Piece | None:
    """Return the piece of a chain whose input loads the circuit: a probe if there is one, else the last input."""
    loading = [piece for piece in pieces if piece.resistance is not None]
    return next((piece for piece in loading if piece.is_probe), loading[-1] if loading else None)
