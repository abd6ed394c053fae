"""Skins that depend on the frequency in a fit: how a record's circuit is followed, and what it cannot be asked."""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.drive_choice import DriveModel, has_ideal_edges, ideal_edge_mask
from fitact.model.circuit import RC
from fitact.model.drive import Periodic
from fitact.model.skin import MAX_DISPERSION_FREQUENCY, Dispersive, Fractional, TimeConstantGrid, WithSkin
from fitact.scene.scene import Scene


def apply_skin_model(circuit: RC, records: Sequence[Record], scenes: Sequence[Scene | None]) -> RC | WithSkin:
    """The circuit with the first scene's skin, as the records' drives and time steps ask for."""
    scene = scenes[0] or Scene()
    if scene.skin.level == "constant":
        return circuit
    slowest = min(_lowest_omega(record, given or Scene()) for record, given in zip(records, scenes, strict=True))
    if scene.skin.level == "dispersive":
        # a record's own frequency is 0.9 of the stated one at least
        return WithSkin(circuit, Dispersive(math.ceil(2.0 * math.pi * MAX_DISPERSION_FREQUENCY / (0.9 * slowest))))
    # the grid is fitted from below the slowest angular frequency to far above what a time step shows
    fastest = 100.0 / min(record.time_step for record in records)
    alpha = jnp.asarray(scene.fixed_values().get("alpha", scene.skin.alpha))
    return WithSkin(circuit, Fractional(alpha), TimeConstantGrid.from_frequency_range(0.3 * slowest, fastest))


def _lowest_omega(record: Record, scene: Scene) -> float:
    """The lowest angular frequency in a record, rad/s: of what repeats, that; else the inverse of its span."""
    span = float(record.time[-1] - record.time[0])
    if scene.drive.waveform == "measured":
        frequency = record.frequency() if scene.steady_state() else None
    else:
        frequency = scene.drive.lowest_frequency if scene.drive.steady_state else None
    return 1.0 / span if frequency is None else 2.0 * math.pi * frequency


def require_skin_response(circuit: RC | WithSkin, record: Record, choice: DriveModel) -> None:
    """Refuse a drive whose response the skin does not have."""
    if not isinstance(circuit, WithSkin):
        return
    if circuit.grid is None and not (choice.steady_state and isinstance(choice.drive, Periodic)):
        raise InputError(
            f"{record.source}: a dispersive skin is fitted in the steady state of a named periodic drive only; name the"
            " waveform in [drive], or take [skin] level = 'fractional'"
        )
    if choice.unknown_charge:
        raise InputError(
            f"{record.source}: a fractional skin remembers what V was before the record; state [drive] steady_state ="
            " true (V repeated) or false (all was at rest), or name the waveform"
        )


def exclude_jumps(
    circuit: RC | WithSkin, record: Record, choice: DriveModel, weight: Float[np.ndarray, " samples"] | None
) -> tuple[Float[np.ndarray, " samples"] | None, tuple[str, ...]]:
    """The samples' weights, 0 at ideal jumps of a fractional skin's drive, and a sentence about those.

    There the response is that at the highest frequencies, which no record has.
    """
    fractional = isinstance(circuit, WithSkin) and circuit.grid is not None
    if not (fractional and has_ideal_edges(choice.drive)):
        return weight, ()
    out = ideal_edge_mask(choice.drive, record.time - choice.shift, 0.5 * record.time_step)
    note = (
        f"{np.count_nonzero(out):,} of {out.size:,} samples lie at an ideal jump of V, where a fractional skin's"
        " response has no value, and are left out; [drive] rise_time tells how fast the edges are"
    )
    return np.where(out, 0.0, 1.0 if weight is None else weight), (note,) if out.any() else ()
