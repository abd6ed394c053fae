"""Friction as a channel of a fit: its samples, what is known of its sensor, and what it says about the force law."""

import dataclasses
import math

import numpy as np

from fitact.compiled import as_arrays
from fitact.data.record import Record, is_uniform
from fitact.errors import InputError
from fitact.likelihood import certificate
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.friction_observable import FrictionObservable
from fitact.likelihood.observable import FIRST_CHARGE, LINEAR_NUISANCES
from fitact.model.circuit import Circuit
from fitact.model.force import FRICTION_PARAMETERS
from fitact.problem.drive_choice import DriveModel
from fitact.problem.starting_point import estimate_from_vsc
from fitact.scene.scene import Scene


def make_friction_channel(
    channel: ChannelLikelihood, record: Record, scene: Scene, choice: DriveModel, template: Circuit, tau: float
) -> ChannelLikelihood:
    """Return the channel with the friction that the scene describes.

    The samples that the unknown charge of the skin still moves are excluded; `tau` (s) is the slowest time constant of
    the prior.

    Raises:
        InputError: the time steps are not uniform, or the record is too short for the charge to decay.
    """
    if not is_uniform(record.time):
        raise InputError(
            f"{record.source}: Ft needs uniform time steps, because its sensor has a memory; resample the record"
        )
    known = scene.nominal_values() | scene.fixed_values()
    constants = {name: np.asarray(known[name]) for name in FRICTION_PARAMETERS if known[name] is not None}
    linear_sd = np.zeros(len(LINEAR_NUISANCES))
    ringing = sum(name in constants for name in ("sensor_frequency", "sensor_damping"))
    linear_sd[FIRST_CHARGE : FIRST_CHARGE + ringing] = 10.0 * float(np.ptp(record["Ft"]))  # wide
    channel = dataclasses.replace(channel, linear_sd=linear_sd)
    if choice.unknown_charge:
        if "Vsc" in record and math.isfinite(b := estimate_from_vsc(record, choice, 1.0).b):
            tau = b
        since = np.asarray(channel.samples.time) - float(channel.samples.time[0])
        excluded = since < 8.0 * tau  # after which 1 / 3000 of the charge is left
        if np.count_nonzero(~excluded[: len(record)]) < len(record) // 2:
            raise InputError(
                f"{record.source}: Ft is used once the unknown charge of the skin has decayed, {8.0 * tau:.3g} s after"
                " the first sample; record for twice as long"
            )
        channel = channel.exclude_samples(excluded)
    channel, geometry = certificate.fold(channel), as_arrays(scene.geometry())
    voltage = dataclasses.replace(channel.electrical, channel=geometry.contact(template).channel)
    return dataclasses.replace(channel, observable=FrictionObservable(voltage, geometry, constants))
