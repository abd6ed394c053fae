"""Errors of instruments: on which channels they act, and the coordinates that represent them in a fit.

Errors that act alike on all channels are one coordinate, the logarithm of their product.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.spectrum_observable import SpectrumObservable
from fitact.model.drive import Sampled
from fitact.prior.distributions import Distribution, LogNormal
from fitact.prior.product import multiply
from fitact.scene.scene import Scene

GAIN = "gain"
UNRESOLVED_V = "V between two samples or two levels of its converter"
# small errors in proportion to a function of time; those of V reach the channels through the circuit
V_NONLINEARITY = ("nonlinearity_V_even", "nonlinearity_V_odd")
EFFECTS = ("compensation", "nonlinearity_even", "nonlinearity_odd", *V_NONLINEARITY)


class Member(NamedTuple):
    """A channel on which instruments act."""

    channel: ChannelLikelihood
    record: int  # number of its record, from 0
    scene: Scene
    edge_sd: float  # sd of log(gain) that stands for unresolved edges of the drive


class InstrumentError(NamedTuple):
    """One error: of a piece of equipment, or one that stands for the unknown time of edges."""

    source: str
    distribution: Distribution  # of the factor between indicated and true values
    power: float  # in the coordinate


@dataclasses.dataclass(frozen=True)
class ErrorCoordinate:
    """Product of errors that act alike, with its power in each channel and in each record's V."""

    name: str
    kind: str  # `GAIN` or one of `EFFECTS`
    errors: tuple[InstrumentError, ...]
    channel_powers: tuple[float, ...]
    drive_powers: tuple[float, ...]  # of the ratio between indicated and true V

    @property
    def is_stated(self) -> bool:
        """Whether the scene states an instrument's error, and it does not only stand for unresolved edges."""
        return any(not error.source.startswith(UNRESOLVED_V) for error in self.errors)

    def distribution(self) -> Distribution:
        return multiply([(error.distribution, error.power) for error in self.errors])


def log_sd(relative_sd: float) -> float:
    """Return the sd of the logarithm for a relative sd."""
    return LogNormal.with_relative_sd(1.0, relative_sd).spread if relative_sd > 0.0 else 0.0


def largest_gain(scene: Scene, sds: float = 3.0) -> float:
    """Return a gain of Vsc over V that is `sds` standard deviations above 1."""
    measurement, pieces = scene.measurement, (*scene.instrument.pieces("V"), *scene.instrument.pieces("Vsc"))
    variances = [piece.gain.log_sd**2 for piece in pieces if piece.gain is not None]
    return math.exp(sds * math.sqrt(sum(variances) + log_sd(measurement.gain_relative_sd) ** 2))


def apply_coordinates(coordinates: Sequence[ErrorCoordinate], index: int, member: Member) -> ChannelLikelihood:
    """Return the channel of this index with the coordinates that act on it, and on the V of its record."""
    acting = [(each, each.channel_powers[index]) for each in coordinates if each.channel_powers[index]]
    effects = ((kind, tuple((each.name, power) for each, power in acting if each.kind == kind)) for kind in EFFECTS)
    in_drive = [(each.name, power) for each in coordinates if (power := each.drive_powers[member.record])]
    return dataclasses.replace(
        member.channel,
        gains=tuple((each.name, power) for each, power in acting if each.kind == GAIN),
        drive_gains=tuple(in_drive),
        effect_sizes=tuple((kind, sizes) for kind, sizes in effects if sizes),
    )


def collect_coordinates(members: Sequence[Member]) -> tuple[ErrorCoordinate, ...]:
    """Return the coordinates of all errors; an error is shared by all channels that name its piece."""
    coordinates: dict[str, ErrorCoordinate] = {}
    for kind in (GAIN, *EFFECTS):
        for (in_channels, in_drives), errors in _group_errors(members, kind).items():
            sign = math.copysign(1.0, errors[0].power)  # the coordinate has that of its first error
            in_channels, in_drives = (tuple(sign * power for power in each) for each in (in_channels, in_drives))
            errors = [each._replace(power=sign * each.power) for each in errors]
            name = _name_coordinate(kind, members, in_channels, in_drives)
            if name in coordinates:
                name = f"{name}_{sum(other.startswith(name) for other in coordinates) + 1}"
            coordinates[name] = ErrorCoordinate(name, kind, tuple(errors), in_channels, in_drives)
    return tuple(coordinates.values())


_Powers = tuple[tuple[float, ...], tuple[float, ...]]  # in the channels, and in the V of the records


def _group_errors(members: Sequence[Member], kind: str) -> dict[_Powers, list[InstrumentError]]:
    """Return the errors of a kind, grouped by their powers; a group acts on at least one channel or V."""
    powers: dict[str, tuple[list[float], list[float]]] = {}
    distributions: dict[str, Distribution] = {}
    for i, member in enumerate(members):
        for source, distribution, in_channel, in_drive in _channel_errors(member, kind):
            distributions[source] = distribution
            zeros = [0.0] * len(members), [0.0] * (1 + members[-1].record)
            in_channels, in_drives = powers.setdefault(source, zeros)
            in_channels[i] += in_channel
            in_drives[member.record] = in_drive or in_drives[member.record]
    groups: dict[_Powers, list[InstrumentError]] = {}
    for source, (in_channels, in_drives) in powers.items():
        first = next((power for power in (*in_drives, *in_channels) if power), 0.0)
        if first:  # a piece of two channels may cancel
            key = tuple(power / first for power in in_channels), tuple(power / first for power in in_drives)
            groups.setdefault(key, []).append(InstrumentError(source, distributions[source], first))
    return groups


def _channel_errors(member: Member, kind: str) -> Iterable[tuple[str, Distribution, float, float]]:
    """Yield the source and distribution of each error of a kind, and its powers in the channel and in V."""
    name, section, measurement = member.channel.channel, member.scene.instrument, member.scene.measurement
    is_nonlinear, in_V = kind.startswith("nonlinearity"), kind in V_NONLINEARITY
    field, observable = "nonlinearity" if is_nonlinear else kind, member.channel.observable
    is_spectrum = isinstance(observable, SpectrumObservable)
    if is_nonlinear and is_spectrum:  # an analyser filters out the harmonics
        return
    impedance, signal = (("Z", 1.0), ("V", 1.0), ("I", -1.0)), ((name, 1.0), ("V", -1.0))
    friction = (("Ft", 1.0), ("V", 0.0))  # V acts through the square of the voltage
    for channel, power in {"impedance": impedance, "Ft": friction}.get(name, signal):
        if is_nonlinear and in_V != (channel == "V"):
            continue
        if in_V and not isinstance(observable.electrical.drive, Sampled):
            continue
        for piece in section.pieces(channel):
            distribution = getattr(piece, field)
            if distribution is not None:
                # half the non-linearity for each of its shapes, so that their sum stays within the limits
                share = 0.5 if is_nonlinear else 1.0
                label = kind.replace("_V", "").replace("_", ", ")
                in_drive = 1.0 if channel == "V" and kind == GAIN and not is_spectrum else 0.0
                source = f"{section.describe_channels(piece.name)} {label} ({piece.name})"
                yield source, distribution, share * power, in_drive
    if kind != GAIN:
        return
    stated = {"Vsc": measurement.gain_relative_sd, "I": measurement.gain_I_relative_sd}.get(name, 0.0)
    if stated > 0.0:
        key = "gain_relative_sd" if name == "Vsc" else "gain_I_relative_sd"
        yield f"{name} gain ([measurement] {key} = {stated:g})", LogNormal(1.0, log_sd(stated)), 1.0, 0.0
    if member.edge_sd > 0.0:
        label = member.channel.qualified_name(UNRESOLVED_V)
        yield label, LogNormal(1.0, member.edge_sd), 1.0, 0.0


def _name_coordinate(
    kind: str, members: Sequence[Member], in_channels: Sequence[float], in_drives: Sequence[float]
) -> str:
    """Return a name such as "gain", "gain_I" or "gain_V", with the record's number if it is one of several."""
    acting = [each for each, power in zip(members, in_channels, strict=True) if power]
    records = {each.record for each in acting} | {i for i, power in enumerate(in_drives) if power}
    kinds = {each.channel.letter for each in acting}
    suffix = "_V" if any(in_drives) or len(kinds) > 1 else "".join(f"_{kind}" for kind in kinds if kind)
    base = kind if kind in V_NONLINEARITY else kind + suffix
    count = len({each.record for each in members if not kinds or each.channel.letter in kinds})
    return f"{base}_{min(records) + 1}" if len(records) == 1 and count > 1 else base
