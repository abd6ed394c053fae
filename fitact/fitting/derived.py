"""What follows from the parameters: divider, time constant, force and friction, at any theta."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import padded, padded_weight
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.drive_choice import DriveChoice, as_arrays, has_ideal_edges, whole_periods
from fitact.likelihood.channel import CHARGES, LINEAR
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import Circuit
from fitact.model.drive import Drive, Periodic, PiecewiseLinear, Sampled, Sine
from fitact.model.force import (
    AirGap,
    Contact,
    Geometry,
    electrostatic_force,
    friction,
    mean_force,
    peak_force,
    summarize,
)
from fitact.model.multitone import Multitone
from fitact.model.response import response
from fitact.model.skin import WithSkin
from fitact.scene.scene import Scene

NAMES = ("g", "b", "force_mean", "force_peak", "force_rms", "friction_mean")

_LONG = 20_000  # samples, above which the force is that of the last periods,
_WINDOW = 4_000  # of at most so many samples where that holds a period,
_LEAD = 20.0  # after so many time constants
_AFTER = 0.5  # steps after an ideal jump, where the peak of a skin that depends on the frequency is taken
_NODES = 64  # Gauss-Legendre nodes along each straight piece of a drive


class Derived(eqx.Module):
    """Derived quantities of the first record, as functions of theta and the traces' noise; built by `for_fit`.

    Means are over one period of a scene's drive in the steady state, else over the largest whole number of
    periods that the record holds (the whole record where it holds none); of a long record with a measured
    drive, over its last whole periods, of some thousand samples.

    Attributes:
        likelihood: names theta's coordinates.
        drive: what makes the force: the likelihood's, or the last part of a long measured one, which begins so
            early that its unknown charge is gone when the force is evaluated.
        time: when the force is evaluated, s.
        weight: the share of time each stands for; a weight of 0 counts for the peak only.
        geometry: with the circuit, where the force acts.
        coefficient, normal_force: of friction; 1, N.
    """

    likelihood: Likelihood
    drive: Drive
    time: Float[Array, " times"]
    weight: Float[Array, " times"]
    geometry: Geometry
    coefficient: ArrayLike
    normal_force: ArrayLike
    steady_state: bool = eqx.field(static=True)
    charge: bool = eqx.field(static=True)  # whether the record's unknown one matters

    def force(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " traces"], deviate: ArrayLike = 0.0
    ) -> Float[Array, " times"]:
        """Electrostatic force in time, N; see `fitact.model.force.Geometry`.

        `deviate` holds standard normal numbers (traces, `LINEAR`) that draw the charges from their posterior; 0:
        their mean.
        """
        circuit = self.likelihood.circuit(theta)
        contact = self.contact(circuit)
        voltage = response(circuit, self.drive, self.time, steady_state=self.steady_state, channel=contact.channel)
        if self.charge:
            voltage = voltage + self._charges(theta, sigma, deviate)
        return electrostatic_force(voltage, contact)

    def _charges(self, theta: Array, sigma: Array, deviate: ArrayLike) -> Float[Array, " times"]:
        """What unknown charges at the record's first sample add to the voltage that makes the force.

        Not what one that stays on a gap adds, which no channel shows.
        """
        trace, seen = self.likelihood.traces[0], self.likelihood.seen(theta)
        first = jnp.broadcast_to(deviate, (len(self.likelihood.traces), len(LINEAR)))[0]
        sizes = (trace.drawn(seen, sigma[0], first) * trace.linear_sd)[-len(CHARGES) :]
        # a charge shows in each channel as the response to a drive does
        acting = self.contact(seen.circuit).channel
        there, here = (seen.circuit.terms_of(channel).weight for channel in (acting, trace.channel))
        ratios = jnp.stack([v / jnp.where(w == 0.0, 1.0, w) for v, w in zip(there, here, strict=False)])
        ratios = jnp.pad(ratios, (0, len(CHARGES) - ratios.size))
        return (sizes * ratios) @ trace.decays(seen.circuit, self.time) / seen.gain

    def contact(self, circuit: Circuit) -> Contact | AirGap:
        """Where the circuit's force acts."""
        return self.geometry.contact(circuit)

    def __call__(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " traces"], deviate: ArrayLike = 0.0
    ) -> Float[Array, " derived"]:
        """All of `NAMES`, in SI units."""
        circuit = self.likelihood.circuit(theta)
        force = summarize(self.force(theta, sigma, deviate), self.weight)
        if self.steady_state and isinstance(self.drive, Periodic):  # rms alone needs quadrature
            exact = circuit, self.drive, self.contact(circuit)
            force = force._replace(mean=mean_force(*exact))
            if not isinstance(circuit, WithSkin) or isinstance(self.drive, Sine | Multitone):
                force = force._replace(peak=peak_force(*exact))
        felt = friction(force.mean, self.coefficient, self.normal_force)
        return jnp.stack([circuit.g, circuit.b, force.mean, force.peak, force.rms, felt])

    def logs(
        self, theta: Float[np.ndarray, " parameters"], sigma: Float[np.ndarray, " traces"]
    ) -> tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]:
        """Logarithms of all of `NAMES`, and their gradients in theta."""
        with jax.enable_x64(True):
            values, gradient = _logs(self, jnp.asarray(theta), jnp.asarray(sigma))
            return np.asarray(values), np.asarray(gradient)


@eqx.filter_jit
def _logs(derive: Derived, theta: Array, sigma: Array) -> tuple[Array, Array]:
    def logs(theta: Array) -> Array:
        return jnp.log(derive(theta, sigma))

    return logs(theta), jax.jacfwd(logs)(theta)


def for_fit(likelihood: Likelihood, record: Record, choice: DriveChoice, scene: Scene, b: float) -> Derived:
    """Of a fit; `record` and `choice` are its first, `b` (s) the slowest time constant that was found."""
    last = None if isinstance(likelihood.template, WithSkin) else _last_periods(record, choice, b)
    after = _AFTER * record.time_step if isinstance(likelihood.template, WithSkin) else 0.0
    drive, (time, weight) = (choice.drive, _grid(record, choice, after)) if last is None else last
    return Derived(
        likelihood.without_samples(),
        drive,
        jnp.asarray(time),
        jnp.asarray(weight / weight.sum()),
        scene.geometry(),
        scene.friction.coefficient,
        scene.friction.normal_force,
        steady_state=choice.steady_state and last is None,
        charge=choice.unknown_charge and last is None,
    )


def _last_periods(record: Record, choice: DriveChoice, b: float) -> tuple[Drive, tuple[np.ndarray, np.ndarray]] | None:
    """The end of a long measured drive, and times and weights of its last whole periods; None: take it all."""
    frequency, time = record.frequency(), record.time
    if not isinstance(choice.drive, Sampled) or frequency is None or time.size <= _LONG:
        return None
    periods = max(1, math.floor(_WINDOW * record.time_step * frequency))
    begin = int(np.searchsorted(time, time[-1] - periods / frequency + 0.5 * record.time_step))
    lead = int(np.searchsorted(time, time[begin] - _LEAD * b))
    if lead == 0:
        return None
    drive = Sampled(padded(time[lead:]), padded(record["V"][lead:]))
    return drive, (padded(time[begin:]), padded_weight(np.gradient(time)[begin:]))


def for_scene(likelihood: Likelihood, scene: Scene) -> Derived:
    """Under the scene's own drive, for a likelihood without records.

    Raises:
        InputError: the drive has no steady state.
    """
    drive = scene.make_drive()
    if not (isinstance(drive, Periodic) and scene.drive.steady_state):
        raise InputError(
            f"scene: without a record the force is that of a periodic drive in its steady state, which a"
            f" {scene.drive.waveform} from rest has not; name another waveform in [drive]"
        )
    time, weight = _of_period(drive, 0.0)
    return Derived(
        likelihood,
        as_arrays(drive),
        jnp.asarray(time),
        jnp.asarray(weight / weight.sum()),
        scene.geometry(),
        scene.friction.coefficient,
        scene.friction.normal_force,
        steady_state=True,
        charge=False,
    )


def _grid(record: Record, choice: DriveChoice, after: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and weights, of a period where the drive has one; `after` as in `_of_period`."""
    if isinstance(choice.drive, Periodic) and choice.steady_state:
        return _of_period(choice.drive, after)
    kept, period = whole_periods(record)
    cells = np.gradient(record.time)
    if period is None:  # the trapezoid rule; over whole periods the ends meet
        cells[[0, -1]] *= 0.5
    return padded(record.time[:kept] - choice.shift, len(record)), padded_weight(cells[:kept], len(record))


def _of_period(drive: Periodic, after: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and weights; at ideal jumps so long `after` them (s), since there a fractional skin's Vsc has no value."""
    if not isinstance(drive, PiecewiseLinear):
        return np.arange(1024) / 1024 * float(drive.period), np.ones(1024)
    knots = np.asarray(drive.pieces().knots) - float(drive.lead)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    length = np.diff(knots)[:, None]
    inside = knots[:-1, None] + 0.5 * length * (nodes + 1.0)
    # u is monotone along a piece, so peaks sit at the knots
    peaks = knots[:-1] + (after if has_ideal_edges(drive) else 0.0)
    return np.append(inside, peaks), np.append(0.5 * length * weights, np.zeros(length.size))
