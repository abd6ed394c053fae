"""Gains of the channels: which errors of instruments act on which channels, and the coordinates that represent them.

Errors that act alike on all channels and drives are one coordinate, the logarithm of their product.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fitact.likelihood.channel import ChannelLikelihood
from fitact.prior.distributions import Distribution, LogNormal
from fitact.prior.product import multiply
from fitact.scene.scene import Scene


class GainedChannel(NamedTuple):
    """A channel whose gain may be wrong."""

    channel: ChannelLikelihood
    record: int  # number of its record, from 0
    scene: Scene
    edge_sd: float  # sd of log(gain) that stands for unresolved edges of the drive


class GainError(NamedTuple):
    """One error: of a piece of equipment, or one that stands for the unknown time of edges."""

    source: str
    distribution: Distribution  # of the factor between indicated and true values


@dataclasses.dataclass(frozen=True)
class GainCoordinate:
    """Product of the errors that act alike, raised to a power in the gain of each channel and in each record's V."""

    name: str
    errors: tuple[GainError, ...]
    channel_powers: tuple[float, ...]
    drive_powers: tuple[float, ...]  # of the ratio between indicated and true V

    def distribution(self) -> Distribution:
        return multiply([(error.distribution, 1.0) for error in self.errors])


def log_sd(relative_sd: float) -> float:
    """Return the sd of the logarithm for a relative sd."""
    return LogNormal.with_relative_sd(1.0, relative_sd).spread if relative_sd > 0.0 else 0.0


def largest_gain(scene: Scene, sds: float = 3.0) -> float:
    """Return a gain of Vsc over V that is `sds` standard deviations above 1."""
    measurement, pieces = scene.measurement, (*scene.instrument.pieces("V"), *scene.instrument.pieces("Vsc"))
    variances = [piece.gain.log_sd**2 for piece in pieces if piece.gain is not None]
    return math.exp(sds * math.sqrt(sum(variances) + log_sd(measurement.gain_relative_sd) ** 2))


def apply_gains(gains: Sequence[GainCoordinate], index: int, member: GainedChannel) -> ChannelLikelihood:
    """Return the channel of this index with the gains that act on it, and on the V of its record."""
    in_channel, in_drive = (
        tuple((gain.name, powers[place]) for gain in gains if (powers := getattr(gain, field))[place])
        for field, place in (("channel_powers", index), ("drive_powers", member.record))
    )
    return dataclasses.replace(member.channel, gains=in_channel, drive_gains=in_drive)


def collect_gains(channels: Sequence[GainedChannel]) -> tuple[GainCoordinate, ...]:
    """Return the coordinates of all gain errors; an error is shared by all channels that name its piece."""
    n_records = 1 + max(each.record for each in channels)
    powers: dict[str, list[float]] = {}
    distributions: dict[str, Distribution] = {}
    for i, each in enumerate(channels):
        for source, distribution, in_channel, in_drive in _channel_errors(each):
            distributions[source] = distribution
            row = powers.setdefault(source, [0.0] * (len(channels) + n_records))
            row[i] += in_channel
            row[len(channels) + each.record] = max(row[len(channels) + each.record], in_drive)
    groups: dict[tuple[float, ...], list[GainError]] = {}
    for source, each_power in powers.items():
        if any(each_power):
            groups.setdefault(tuple(each_power), []).append(GainError(source, distributions[source]))
    coordinates: dict[str, GainCoordinate] = {}
    for group, errors in groups.items():
        in_channels, in_drives = group[: len(channels)], group[len(channels) :]
        name = _name_coordinate(channels, in_channels, in_drives)
        if name in coordinates:
            name = f"{name}_{sum(other.startswith(name) for other in coordinates) + 1}"
        coordinates[name] = GainCoordinate(name, tuple(errors), in_channels, in_drives)
    return tuple(coordinates.values())


def _channel_errors(each: GainedChannel) -> Iterable[tuple[str, Distribution, float, float]]:
    """Yield the source and distribution of each gain error, and its powers in the channel and in V."""
    name, section, measurement = each.channel.channel, each.scene.instrument, each.scene.measurement
    for channel, power in ((name, 1.0), ("V", -1.0)):
        for piece in section.pieces(channel):
            if piece.gain is not None:
                yield (
                    f"{section.describe_channels(piece.name)} gain ({piece.name})",
                    piece.gain,
                    power,
                    -min(power, 0.0),
                )
    stated = measurement.gain_relative_sd if name == "Vsc" else measurement.gain_I_relative_sd
    if stated > 0.0:
        key = "gain_relative_sd" if name == "Vsc" else "gain_I_relative_sd"
        yield f"{name} gain ([measurement] {key} = {stated:g})", LogNormal(1.0, log_sd(stated)), 1.0, 0.0
    if each.edge_sd > 0.0:
        label = each.channel.qualified_name("edges of V between two samples")
        yield label, LogNormal(1.0, each.edge_sd), 1.0, 0.0


def _name_coordinate(
    channels: Sequence[GainedChannel], channel_powers: Sequence[float], drive_powers: Sequence[float]
) -> str:
    """Return "gain", "gain_I" or "gain_V", with the record's number if the errors act on only one of several."""
    members = [each for each, power in zip(channels, channel_powers, strict=True) if power]
    records = {each.record for each in members} | {i for i, power in enumerate(drive_powers) if power}
    if any(drive_powers):
        base, count = "gain_V", len(drive_powers)
    else:
        kinds = {each.channel.channel for each in members}
        base = "gain_I" if kinds == {"I"} else "gain"
        count = len({each.record for each in channels if each.channel.channel in kinds})
    return f"{base}_{min(records) + 1}" if len(records) == 1 and count > 1 else base
