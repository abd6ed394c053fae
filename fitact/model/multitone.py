"""Multi-tones: sines at whole multiples of one frequency."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError
from fitact.model.drive import Periodic, Sine, after_rest

HIGHEST = 250  # order, up to which a mean of Vsc^4 over a period's 1024 points is exact
_POINTS = 32  # of a cycle of the highest tone, from which its extremes are sought
_STEPS = 6  # of Newton's, each of which doubles the digits


class Multitone(Periodic):
    """A sum of sines around `offset`; each crosses it upwards at t = 0 (with phase 0).

    Attributes:
        frequency: at which the sum repeats, Hz.
        orders: of the tones: the multiples of `frequency` that they have, each once, 1 to 250.
        amplitudes: from the middle to the crest of each tone, V.
        phases: of each tone, rad; () for none.
        offset: V.
        phase: by which the whole runs ahead, in rad of `frequency`.

    Raises:
        InputError: the orders are no such numbers, or there is not one amplitude and phase for each.
    """

    frequency: ArrayLike
    orders: tuple[int, ...] = eqx.field(static=True)
    amplitudes: tuple[ArrayLike, ...]
    phases: tuple[ArrayLike, ...] = ()
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    def __check_init__(self) -> None:
        orders = self.orders
        if not orders or len(set(orders)) < len(orders) or not all(n in range(1, HIGHEST + 1) for n in orders):
            raise InputError(f"Multitone: orders = {orders}; give different whole numbers from 1 to {HIGHEST}")
        if len(self.amplitudes) != len(orders) or len(self.phases) not in (0, len(orders)):
            raise InputError(
                f"Multitone: {len(orders)} tones, {len(self.amplitudes)} amplitudes, {len(self.phases)} phases;"
                " give one of each for a tone"
            )

    def tones(self) -> tuple[Sine, ...]:
        """The sines that it is the sum of, but for the offset."""
        phases = self.phases or (0.0,) * len(self.orders)
        return tuple(
            Sine(2.0 * jnp.asarray(height), n * jnp.asarray(self.frequency), phase=phase + n * jnp.asarray(self.phase))
            for n, height, phase in zip(self.orders, self.amplitudes, phases, strict=True)
        )

    def phasors(self) -> Complex[Array, " tones"]:
        """A with tone = Im A e^{j order w t} (V), `phase` left out."""
        phases = jnp.stack(list(map(jnp.asarray, self.phases or (0.0,) * len(self.orders))))
        return jnp.stack(list(map(jnp.asarray, self.amplitudes))) * jnp.exp(1j * phases)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        return self.offset + sum((tone.value(time) for tone in self.tones()), jnp.zeros(()))

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        slope = sum((tone.slope(time) for tone in self.tones()), jnp.zeros(()))
        height = sum(map(jnp.abs, map(jnp.asarray, self.amplitudes)))
        return slope if steady_state else after_rest(self, slope, time, height)


def largest_sum(phasors: Complex[Array, " tones"], orders: tuple[int, ...]) -> Float[Array, ""]:
    """The largest |Im sum_k phasors[k] e^{j orders[k] x}|: by Newton's method from many points, the best of all.

    Where it lies is held fixed, which leaves first derivatives right.
    """
    order = jnp.asarray(orders, dtype=float)
    start = jnp.linspace(0.0, 2.0 * np.pi, _POINTS * max(orders), endpoint=False)

    def at(x: Array, derivative: int = 0) -> Array:
        return jnp.imag((phasors * (1j * order) ** derivative) @ jnp.exp(1j * order[:, None] * x))

    def newton(_: int, x: Array) -> Array:
        bend = at(x, 2)
        step = jnp.where(bend == 0.0, 0.0, -at(x, 1) / jnp.where(bend == 0.0, 1.0, bend))
        return x + jnp.clip(step, -start[1], start[1])

    found = lax.stop_gradient(lax.fori_loop(0, _STEPS, newton, lax.stop_gradient(start)))
    return jnp.maximum(jnp.max(jnp.abs(at(start))), jnp.max(jnp.abs(at(found))))
