"""Quantities over one period of the steady state: AC force, insulator voltage, power and body current.

The power follows from the high-pass responses u, because mean(V u) = mean(u^2): P = sum_k weight_k S(tau_k), where S
is the mean square and the weights belong to the current. So P is finite even if the current has impulses. A leak adds
its conductance times mean(V^2).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.model.circuit import RC, HighpassTerms
from fitact.model.drive import Multitone, Periodic, PiecewiseLinear, Sine
from fitact.model.force import AirGap, Contact, electrostatic_force
from fitact.model.response import highpass, phi, steady_knot_values
from fitact.model.steady import highpass_mean_square, mean_square, voltage_mean_square

HARMONICS = 4  # number of harmonics at which the force is computed


class PeriodQuantities(NamedTuple):
    """Effects of a drive at one finger over a period of the steady state."""

    force_mean: Array  # N
    force_alternating: Array  # AC amplitude, N: sqrt(2) times the rms about the mean
    force_harmonics: Float[Array, " harmonics"]  # amplitudes at the harmonics of the drive's frequency, N
    insulator_peak: Array  # maximum |voltage| across the insulator, V; without a leak it has the mean of V
    real_power: Array  # mean of V I, dissipated in skins and resistances, W
    apparent_power: Array  # rms V times rms I, VA; infinite, like both currents, if the current has impulses
    current_rms: Array  # through the body, A
    current_peak: Array  # A


def period_quantities(circuit: RC, drive: Periodic, contact: Contact | AirGap) -> PeriodQuantities:
    """Compute all `PeriodQuantities`; the force acts on `contact`, eqs. (1) and (22)."""
    period = PeriodGrid.from_drive(drive)
    acting, insulator, current = period.responses(
        circuit.channel_terms(contact.channel), circuit.insulator_terms(), circuit.current_terms()
    )
    force = electrostatic_force(acting, contact)
    mean = period.weight @ force
    rms = jnp.sqrt(mean_square(circuit, drive, "I"))
    turns = jnp.exp(-2j * np.pi * jnp.arange(1, HARMONICS + 1)[:, None] * period.cycles)
    return PeriodQuantities(
        force_mean=mean,
        force_alternating=jnp.sqrt(2.0 * (period.weight @ jnp.square(force - mean))),
        force_harmonics=2.0 * jnp.abs(turns @ (period.weight * force)),
        insulator_peak=period.max_abs(insulator),
        real_power=real_power(circuit, drive),
        apparent_power=jnp.sqrt(period.weight @ jnp.square(period.voltage)) * rms,
        current_rms=rms,
        current_peak=jnp.where(jnp.isinf(rms), jnp.inf, period.max_abs(current)),
    )


def real_power(circuit: RC, drive: Periodic) -> Float[Array, ""]:
    """Return the exact mean of V I, W.

    Without a resistance in the loop, an ideal jump is the limit of ever shorter ramps, which dissipate no energy. Any
    resistance, however small, dissipates C (dV)^2 / 2 per jump, where C is the loop's high-frequency capacitance.
    """
    terms = circuit.current_terms()
    parts = (weight * highpass_mean_square(drive, tau) for weight, tau in zip(terms.weight, terms.tau, strict=True))
    direct = jnp.zeros(()) if terms.direct is None else terms.direct * voltage_mean_square(drive)
    return sum(parts, direct)


class Sensation(NamedTuple):
    """How far a drive is above the detection threshold, from the harmonics that a table of thresholds covers."""

    times_threshold: Array  # root sum of squares of the harmonics' amplitudes over their thresholds
    strongest: Array  # order of the harmonic that contributes most; 0 if the table covers none
    outside: Array  # fraction of the mean square of the alternating force at frequencies outside the table

    @classmethod
    def from_force(
        cls,
        force: Float[Array, " points"],
        weight: Float[Array, " points"],
        cycles: Float[Array, " points"],
        sensitivity: Float[Array, " harmonics"],
    ) -> "Sensation":
        """Compute it from a force at points of a period (N), with their quadrature weights and their places in it.

        `sensitivity` is 1 / threshold (1/N) at multiples 1, 2, ... of the frequency; 0 excludes one.
        """
        turns = jnp.exp(-2j * np.pi * jnp.arange(1, sensitivity.size + 1)[:, None] * cycles)
        amplitude = 2.0 * jnp.abs(turns @ (weight * force))
        power = 2.0 * (weight @ jnp.square(force - weight @ force))
        rounding = 1e-9  # relative amplitude; below it a harmonic is absent
        covered = (sensitivity > 0.0) & (jnp.square(amplitude) > rounding**2 * power)
        ratio = jnp.where(covered, sensitivity * amplitude, 0.0)
        total = jnp.sum(jnp.square(ratio))
        inside = jnp.sum(jnp.where(covered, jnp.square(amplitude), 0.0))
        return cls(
            jnp.sqrt(total),
            jnp.where(total > 0.0, jnp.argmax(ratio) + 1, 0),
            jnp.clip(1.0 - inside / jnp.where(power > 0.0, power, 1.0), 0.0, 1.0),
        )


def sensation(
    circuit: RC, drive: Periodic, contact: Contact | AirGap, sensitivity: Float[Array, " harmonics"]
) -> Sensation:
    """Compute the `Sensation` of the electrostatic force in the steady state; `sensitivity` as in `from_force`."""
    period = PeriodGrid.from_drive(drive, sensitivity.size)
    (acting,) = period.responses(circuit.channel_terms(contact.channel))
    force = electrostatic_force(acting, contact)
    return Sensation.from_force(force, period.weight, period.cycles, sensitivity)


class PeriodGrid(eqx.Module):
    """Points and quadrature weights over one period of a drive."""

    drive: Periodic  # linear pieces, whose ends are points of weight 0, or sines
    local_time: Float[Array, "pieces nodes"]  # from the start of each piece (for sines: of the period), s
    cycles: Float[Array, " points"]  # from the start of the period, in periods
    weight: Float[Array, " points"]  # fraction of the period
    voltage: Float[Array, " points"]  # of the drive, V
    slope: Float[Array, " points"]  # of the drive between its jumps, V/s

    @classmethod
    def from_drive(cls, drive: Periodic, harmonics: int = HARMONICS) -> "PeriodGrid":
        """Make a grid on which the amplitudes of so many harmonics of a squared response are accurate."""
        if not isinstance(drive, PiecewiseLinear):
            fastest = max(drive.orders) if isinstance(drive, Multitone) else 1
            # points per cycle of the fastest sine; the mean of Vsc^4 is exact from 5 on. Vsc^2 has twice its order
            count = max(32 * fastest, 2 * fastest + harmonics + 1)
            cycles = jnp.arange(count) / count
            time = cycles * drive.period
            weight = jnp.full(count, 1.0 / count)
            return cls(drive, time[None], cycles, weight, drive.value(time), drive.slope(time))
        pieces = drive.pieces()
        nodes, weight = _quadrature_rule(harmonics)
        length = jnp.diff(pieces.knots)[:, None]
        slope = jnp.broadcast_to(pieces.slopes()[:, None], (length.size, nodes.size))
        local_time, period = length * nodes, pieces.knots[-1]
        cycles, weights = (pieces.knots[:-1, None] + local_time) / period, length * weight / period
        voltage = pieces.start[:, None] + (pieces.end - pieces.start)[:, None] * nodes
        return cls(drive, local_time, *(x.reshape(-1) for x in (cycles, weights, voltage, slope)))

    def highpass(self, tau: ArrayLike) -> Float[Array, " points"]:
        """Return the response of s tau / (1 + s tau), V."""
        if not isinstance(self.drive, PiecewiseLinear):
            return highpass(self.drive, self.local_time[0], tau)
        pieces = self.drive.pieces()
        share = phi(self.local_time / tau)
        decay = steady_knot_values(pieces, tau)[:, None] * (1.0 - self.local_time / tau * share)
        return (decay + pieces.slopes()[:, None] * self.local_time * share).reshape(-1)

    def responses(self, *channels: HighpassTerms) -> list[Float[Array, " points"]]:
        """Return the responses of channels of one circuit, in their units.

        The channels share their time constants, which one may have more of. Each is evaluated once, in a buffer of its
        own: fused into each sum over the points it would be evaluated many times.
        """
        taus = max((terms.tau for terms in channels), key=len)
        units = lax.optimization_barrier([self.highpass(tau) for tau in taus])
        found = []
        for terms in channels:
            total = jnp.zeros_like(self.voltage) if terms.rate is None else terms.rate * self.slope
            if terms.direct is not None:
                total = total + terms.direct * self.voltage
            found.append(sum((w * u for w, u in zip(terms.weight, units, strict=False)), total))
        return found

    def max_abs(self, values: Float[Array, " points"]) -> Float[Array, ""]:
        """Return max |values|; exact at ends of linear pieces and for a sine, elsewhere too small by up to 1e-4."""
        size = jnp.abs(values)
        if isinstance(self.drive, Sine):
            first = jnp.exp(-2j * np.pi * self.cycles)
            return jnp.abs(self.weight @ values) + 2.0 * jnp.abs((self.weight * first) @ values)
        if isinstance(self.drive, PiecewiseLinear):
            return jnp.max(size)
        top = jnp.argmax(size)  # maximum of the parabola through this point and its neighbours
        before, highest, after = size[top - 1], size[top], size[(top + 1) % size.size]
        bend = before - 2.0 * highest + after
        rise = jnp.square(before - after) / (8.0 * jnp.where(bend < 0.0, bend, -1.0))
        return highest - jnp.where(bend < 0.0, rise, 0.0)


def _quadrature_rule(harmonics: int, nodes: int = 10, parts: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights on a piece of length 1: Gauss-Legendre with `nodes` points in each part."""
    # the parts grow by a factor 4 from the start of the piece, where transients of any length begin
    ends = 4.0 ** -np.arange(parts - 1.0, -1.0, -1.0)
    if harmonics > HARMONICS:  # and none is longer than a cycle of the fastest harmonic, if the piece is a period
        ends = np.union1d(ends, np.arange(1, harmonics + 1) / harmonics)
    x, weights = np.polynomial.legendre.leggauss(nodes)
    length = np.diff(ends, prepend=0.0)[:, None]
    places, inside = ends[:, None] - length * 0.5 * (1.0 - x), 0.5 * length * weights
    return np.concatenate([[0.0], places.ravel(), [1.0]]), np.concatenate([[0.0], inside.ravel(), [0.0]])
