"""Fits with frequency-dependent skins: the circuit for given records, and the drives that are refused."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.model.circuit import RC, Circuit
from fitact.model.drive import Periodic
from fitact.model.skin import MAX_DISPERSION_FREQUENCY, Dispersive, Fractional, TimeConstantGrid, WithSkin
from fitact.problem.drive_choice import DriveModel, has_ideal_edges, ideal_edge_mask
from fitact.scene.scene import Scene


def apply_skin_model(circuit: RC, records: Sequence[Record], scenes: Sequence[Scene | None]) -> RC | WithSkin:
    """Return the circuit with the skin of the first scene, resolved for the drives and time steps of the records."""
    scene = scenes[0] or Scene()
    if scene.skin.level == "constant":
        return circuit
    slowest = min(_lowest_omega(record, given or Scene()) for record, given in zip(records, scenes, strict=True))
    if scene.skin.level == "dispersive":
        # the frequency of a record is at least 0.9 times the stated one
        return WithSkin(circuit, Dispersive(math.ceil(2.0 * math.pi * MAX_DISPERSION_FREQUENCY / (0.9 * slowest))))
    # the grid extends from below the lowest angular frequency to far above those that a time step resolves
    fastest = 100.0 / min(record.time_step for record in records)
    alpha = np.asarray(scene.fixed_values().get("alpha", scene.skin.alpha))
    return WithSkin(circuit, Fractional(alpha), TimeConstantGrid.from_frequency_range(0.3 * slowest, fastest))


def count_harmonics(circuit: Circuit, frequency: float) -> Circuit:
    """Return the circuit with the number of harmonics of a dispersive skin, which compiled functions need to know."""
    if not (isinstance(circuit, WithSkin) and isinstance(circuit.skin, Dispersive)):
        return circuit
    return dataclasses.replace(circuit, skin=Dispersive(circuit.skin.harmonic_count(frequency)))


def _lowest_omega(record: Record, scene: Scene) -> float:
    """Return the lowest angular frequency (rad/s): the fundamental of a periodic drive, else 1 / duration."""
    span = float(record.time[-1] - record.time[0])
    if scene.drive.waveform == "measured":
        frequency = record.frequency() if scene.steady_state() else None
    else:
        frequency = scene.drive.lowest_frequency if scene.drive.steady_state else None
    return 1.0 / span if frequency is None else 2.0 * math.pi * frequency


def require_skin_response(circuit: RC | WithSkin, record: Record, choice: DriveModel) -> None:
    """Refuse a drive for which the response of the skin model is not defined."""
    if not isinstance(circuit, WithSkin):
        return
    if circuit.grid is None and not (choice.steady_state and isinstance(choice.drive, Periodic)):
        raise InputError(
            f"{record.source}: a dispersive skin can be fitted only in the steady state of a named periodic drive; name"
            " the waveform in [drive], or use [skin] level = 'fractional'"
        )
    if choice.unknown_charge:
        raise InputError(
            f"{record.source}: the response of a fractional skin depends on V before the record; state [drive]"
            " steady_state = true (V repeated) or steady_state = false (at rest), or name the waveform"
        )


def exclude_jumps(
    circuit: RC | WithSkin, record: Record, choice: DriveModel, weight: Float[np.ndarray, " samples"] | None
) -> tuple[Float[np.ndarray, " samples"] | None, tuple[str, ...]]:
    """Return the weights of the samples, 0 at ideal jumps of the drive of a fractional skin, and a sentence on these.

    The response at a jump depends on the highest frequencies, which no record resolves.
    """
    fractional = isinstance(circuit, WithSkin) and circuit.grid is not None
    if not (fractional and has_ideal_edges(choice.drive)):
        return weight, ()
    at_jump = ideal_edge_mask(choice.drive, record.time - choice.shift, 0.5 * record.time_step)
    note = (
        f"{np.count_nonzero(at_jump):,} of {at_jump.size:,} samples lie at an ideal jump of V, where the response of a"
        " fractional skin is undefined, and are excluded; state the duration of the edges as [drive] rise_time"
    )
    return np.where(at_jump, 0.0, 1.0 if weight is None else weight), (note,) if at_jump.any() else ()
