"""Quantities derived from the parameters: divider, time constant, force and friction, at any theta."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator, as_arrays, double_precision, jit, pad_samples, pad_weight
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.observable import CHARGES, FIRST_CHARGE, LINEAR_NUISANCES, charge_decays
from fitact.model.circuit import Channel, Circuit, charge_ratios
from fitact.model.drive import Drive, Multitone, Periodic, PiecewiseLinear, Sampled, Sine
from fitact.model.force import (
    FRICTION_PARAMETERS,
    Geometry,
    electrostatic_force,
    friction,
    mean_force,
    peak_force,
    summarize,
)
from fitact.model.response import response
from fitact.model.response_table import ResponseTable
from fitact.model.skin import WithSkin
from fitact.problem.build import smooth_recorded_drive
from fitact.problem.drive_choice import DriveModel, has_ideal_edges, whole_periods
from fitact.scene.scene import Scene

DERIVED_NAMES = ("g", "b", "force_mean", "force_peak", "force_rms", "friction_mean")


class UnknownCharges(NamedTuple):
    """Unknown charges at the first sample of a fit, at its optimum and to first order in theta around it."""

    voltages: Float[np.ndarray, " charges"]  # of the channel that was fitted, without its gain, V or A
    slopes: Float[np.ndarray, "charges parameters"]

    @classmethod
    def from_nuisances(
        cls,
        likelihood: Likelihood,
        theta: Float[np.ndarray, " parameters"],
        nuisances: Float[np.ndarray, " columns"],
        slopes: Float[np.ndarray, "columns parameters"],
    ) -> Self:
        """Return the charges of the first channel from its linear nuisances and their derivatives in theta."""
        channel = likelihood.channels[0]
        log_gain = np.array([dict(channel.gains).get(name, 0.0) for name in likelihood.names])
        unit = channel.column_sd / math.exp(log_gain @ theta)
        found = np.zeros((len(LINEAR_NUISANCES), 1 + theta.size))
        found[list(channel.columns)] = unit[:, None] * np.column_stack([nuisances, slopes])
        voltages, slopes = np.split(found[FIRST_CHARGE : FIRST_CHARGE + len(CHARGES)], [1], axis=1)
        return cls(voltages[:, 0], slopes - voltages * log_gain)


class DerivedQuantities(eqx.Module):
    """Derived quantities of the first record, as functions of theta and the noise; see `derived_from_fit`.

    Means are taken over one period of the scene's drive in the steady state. Otherwise they are taken over the largest
    whole number of periods in the record, or over the whole record if it is shorter than a period. For a long record
    with a measured drive, they are taken over its last whole periods, a few thousand samples. `drive` is that of the
    likelihood, or the last part of a long measured drive, which begins so early that the unknown charge has decayed
    when the force is evaluated.
    """

    likelihood: Likelihood
    drive: Drive | ResponseTable  # V(t), or its responses at `time`
    time: Float[Array, " times"]  # times at which the force is evaluated, s
    weight: Float[Array, " times"]  # weight of each time in means; times with weight 0 count only for the peak
    geometry: Geometry  # geometry of the contact
    coefficient: ArrayLike  # coefficient of friction
    normal_force: ArrayLike  # normal force, N
    begin: ArrayLike  # time of the record's first sample, s
    steady_state: bool = eqx.field(static=True)
    charge: bool = eqx.field(static=True)  # whether the unknown charge at the first sample matters
    channel: Channel = eqx.field(static=True)  # the first channel, which shows that charge
    # names of the coordinates that act on the gain of the indicated V, each with its power
    drive_gains: tuple[tuple[str, float], ...] = eqx.field(static=True)

    def without_data(self) -> tuple[Self, list[int]]:
        """Return the quantities without the channels, and the coordinates of theta on which they depend.

        They still serve for `evaluate`, by one program for all records of a circuit.
        """
        likelihood, kept = self.likelihood.for_circuit(*FRICTION_PARAMETERS, *(name for name, _ in self.drive_gains))
        return dataclasses.replace(self, likelihood=likelihood), kept

    def tabulate(self, points: Float[np.ndarray, "n parameters"]) -> Self:
        """Return the quantities with a table for all circuits at the points theta, where it saves time.

        A response in closed form costs as little.
        """
        is_closed = self.steady_state and isinstance(self.drive, Periodic)
        if is_closed or isinstance(self.drive, ResponseTable) or isinstance(self.likelihood.template, WithSkin):
            return self
        tau_range = self.likelihood.tau_range(points)
        table = ResponseTable.from_drive(self.drive, self.time, float(self.begin), tau_range, self.steady_state)
        return self if table is None else dataclasses.replace(self, drive=table)

    def force(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " channels"], deviate: Array | None = None
    ) -> Float[Array, " times"]:
        """Return the electrostatic force at `time`, N; see `fitact.model.force.Geometry`.

        `deviate` holds standard normal numbers (channels, `LINEAR_NUISANCES`) that draw the charges from their
        posterior; None gives their mean.
        """
        circuit = self.likelihood.circuit(theta)
        return self._force(circuit, theta, self.charges(circuit, theta, sigma, deviate))

    def _force(self, circuit: Circuit, theta: Array, charges: Array | None) -> Float[Array, " times"]:
        contact = self.geometry.contact(self.likelihood.finger(circuit))
        return electrostatic_force(self.voltage(circuit, theta, charges), contact)

    def _drive_gain(self, theta: Array) -> ArrayLike:
        """Return the ratio between indicated and true V."""
        names = self.likelihood.names
        return jnp.exp(sum(power * theta[names.index(name)] for name, power in self.drive_gains))

    def charges(
        self, circuit: Circuit, theta: Array, sigma: Array, deviate: Array | None = None
    ) -> Float[Array, " charges"] | None:
        """Return what unknown charges add to the first channel at its first sample, without its gain.

        None if they do not matter. `circuit` is that at theta.
        """
        if not self.charge:
            return None
        channel, first = self.likelihood.channels[0], None if deviate is None else deviate[0]
        inputs = self.likelihood.make_inputs(circuit, theta, channel)
        sizes = channel.sample_nuisances(inputs, sigma[0], first) * channel.linear_sd
        return sizes[FIRST_CHARGE : FIRST_CHARGE + len(CHARGES)] / inputs.gain

    def voltage(self, circuit: Circuit, theta: Array, charges: Array | None) -> Float[Array, " times"]:
        """Return the voltage that generates the force at `time`, V; `circuit` is that at theta."""
        finger = self.likelihood.finger(circuit)
        acting = self.geometry.contact(finger).channel
        if isinstance(self.drive, ResponseTable):
            voltage = self.drive.response(finger.channel_terms(acting))
        else:
            voltage = response(finger, self.drive, self.time, steady_state=self.steady_state, channel=acting)
        if charges is not None:
            voltage = voltage + self._decay(circuit, charges)
        return voltage / self._drive_gain(theta)

    def _decay(self, circuit: Circuit, charges: Array) -> Float[Array, " times"]:
        """Return the contribution of `charges` to the voltage that generates the force.

        A charge that stays on a gap is not included, because no channel shows it.
        """
        acting = self.geometry.contact(circuit).channel
        terms = (circuit.channel_terms(name) for name in (acting, self.channel))
        ratios = jnp.stack(charge_ratios(*terms))
        sizes = charges[: ratios.size] * ratios
        if isinstance(self.drive, ResponseTable):
            return self.drive.decays(circuit.terms().tau, sizes)
        return sizes @ charge_decays(circuit, self.time - self.begin)[: ratios.size]

    def __call__(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " channels"], deviate: Array | None = None
    ) -> Float[Array, " derived"]:
        """Return the quantities of `DERIVED_NAMES`, in SI units."""
        return self.evaluate(theta, self.charges(self.likelihood.circuit(theta), theta, sigma, deviate))

    def evaluate(self, theta: Float[Array, " parameters"], charges: Array | None) -> Float[Array, " derived"]:
        """Return the quantities from theta and the `charges` there."""
        circuit = self.likelihood.circuit(theta)
        force = summarize(self._force(circuit, theta, charges), self.weight)
        finger, scale = self.likelihood.finger(circuit), self._drive_gain(theta) ** -2.0
        if self.steady_state and isinstance(self.drive, Periodic):  # only the rms needs quadrature
            exact = finger, self.drive, self.geometry.contact(finger)
            force = force._replace(mean=scale * mean_force(*exact))
            if not isinstance(circuit, WithSkin) or isinstance(self.drive, Sine | Multitone):
                force = force._replace(peak=scale * peak_force(*exact))
        free = self.likelihood.friction_parameters(theta)
        scaled = force.mean * free.get("force_scale", 1.0)
        friction_mean = friction(scaled, free.get("mu", self.coefficient), free.get("fN", self.normal_force))
        return jnp.stack([finger.g, finger.b, force.mean, force.peak, force.rms, friction_mean])

    def log_value_and_grad(
        self, theta: Float[np.ndarray, " parameters"], charges: UnknownCharges
    ) -> tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]:
        """Return the logarithms of the quantities of `DERIVED_NAMES`, and their gradients in theta."""
        (light, kept), gradients = self.without_data(), np.zeros((len(DERIVED_NAMES), theta.size))
        logs, (gradients[:, kept], by_charge) = log_derivatives(
            light, theta[kept], charges.voltages if self.charge else None
        )
        return logs, gradients if by_charge is None else gradients + by_charge @ charges.slopes


@jit
def log_derivatives(
    derive: DerivedQuantities, theta: Array, charges: Array | None
) -> tuple[Array, tuple[Array, Array | None]]:
    """Return the logarithms of the quantities, and their derivatives in theta and in the charges."""

    def logs(theta: Array, charges: Array | None) -> tuple[Array, Array]:
        logs = jnp.log(derive.evaluate(theta, charges))
        return logs, logs

    gradients, values = jax.jacfwd(logs, argnums=(0, 1), has_aux=True)(theta, charges)
    return values, gradients


def draw_derived(
    derive: DerivedQuantities, likelihood: Likelihood, points: Float[np.ndarray, "*draws coordinates"], seed: int
) -> Float[np.ndarray, "*draws derived"]:
    """Return the quantities of `DERIVED_NAMES` at points of a posterior; unknown charges are drawn for each point."""
    deviates, theta = nuisance_deviates(likelihood, points, seed), points[..., : -len(likelihood.channels)]
    derive = derive.tabulate(theta.reshape(-1, theta.shape[-1]))
    return evaluate_draws(derive_draw, derive, derive.time.size, points, deviates)


def draw_force(
    derive: DerivedQuantities,
    likelihood: Likelihood,
    points: Float[np.ndarray, "*draws coordinates"],
    deviates: Float[np.ndarray, "*draws channels nuisances"],
    span: float = math.inf,
    count: int = 2000,
) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, "*draws count"]]:
    """Return times (s), at most the last `span` of those of the means, and the force (N) at points of a posterior."""
    used = np.asarray(derive.time)[np.asarray(derive.weight) > 0.0]
    first, last = float(used.min()), float(used.max())
    time = np.linspace(max(first, last - span), last, count)
    theta = points[..., : -len(likelihood.channels)].reshape(-1, points.shape[-1] - len(likelihood.channels))
    derive = dataclasses.replace(derive, time=time, weight=np.full(count, 1.0 / count)).tabulate(theta)
    return time, evaluate_draws(_draw_force, derive, count, points, deviates)


def nuisance_deviates(
    likelihood: Likelihood, points: Float[np.ndarray, "*draws coordinates"], seed: int
) -> Float[np.ndarray, "*draws channels nuisances"]:
    """Return standard normal numbers that draw the linear nuisances of each channel, for each point."""
    shape = (*points.shape[:-1], len(likelihood.channels), len(LINEAR_NUISANCES))
    return np.random.default_rng([seed, 1]).standard_normal(shape)


@double_precision()
def evaluate_draws(
    function: Callable[..., Array],
    model: Any,
    rows: int,
    points: Float[np.ndarray, "*draws coordinates"],
    deviates: Float[np.ndarray, "*draws channels nuisances"],
) -> np.ndarray:
    """Evaluate `function(model, point, deviate)` for each draw; one evaluation processes `rows` numbers."""
    return BatchEvaluator(function, model, rows).map_over(points.shape[:-1], points, deviates)


def derive_draw(derive: DerivedQuantities, point: Array, deviate: Array) -> Array:
    """Return the quantities of `DERIVED_NAMES` at a point of the posterior."""
    theta, log_sigma = derive.likelihood.split(point)
    return derive(theta, jnp.exp(log_sigma), deviate)


def _draw_force(derive: DerivedQuantities, point: Array, deviate: Array) -> Array:
    theta, log_sigma = derive.likelihood.split(point)
    return derive.force(theta, jnp.exp(log_sigma), deviate)


def derived_from_fit(
    likelihood: Likelihood, record: Record, choice: DriveModel, scene: Scene, b: float
) -> DerivedQuantities:
    """Return the derived quantities of a fit, from its first record and drive; `b` is its slowest time constant (s).

    The drive is without its noise if the likelihood responds to it so, but as it is at the samples.
    """
    drive, channel = choice.drive, likelihood.channels[0]
    if isinstance(drive, Sampled) and channel.shifts_response and channel.electrical.smooth is not None:
        smooth = smooth_recorded_drive(record) if channel.may_curve_drive else channel.electrical.smooth
        drive = dataclasses.replace(drive, samples=smooth)
    last = None if isinstance(likelihood.template, WithSkin) else _last_periods(record, drive, b)
    # the peak for a frequency-dependent skin is taken half a step after an ideal jump
    jump_delay = 0.5 * record.time_step if isinstance(likelihood.template, WithSkin) else 0.0
    drive, grid = (drive, _grid(record, choice, jump_delay)) if last is None else last
    steady_state, charge = choice.steady_state and last is None, choice.unknown_charge and last is None
    begin = np.asarray(channel.samples.time)[0]
    fixed = begin, steady_state, charge, channel.channel, channel.drive_gains
    return DerivedQuantities(likelihood.without_samples(), drive, *_settings(scene, grid), *fixed)


def _settings(scene: Scene, grid: tuple[np.ndarray, np.ndarray]) -> tuple[Any, Any, Geometry, Any, Any]:
    """Return the times of the force with their weights, and the geometry and friction of the scene."""
    time, weight = grid[0], grid[1] / grid[1].sum()
    friction = scene.friction
    return (
        time,
        weight,
        as_arrays(scene.geometry()),
        np.asarray(friction.coefficient),
        np.asarray(friction.normal_force),
    )


def _last_periods(
    record: Record,
    drive: Drive,
    b: float,
    max_samples: int = 20_000,
    window: int = 4_000,
    lead_taus: float = 20.0,
) -> tuple[Drive, tuple[np.ndarray, np.ndarray]] | None:
    """Return the end of a long measured drive with times and weights of its last whole periods, or None.

    A record is long above `max_samples`. The force is evaluated over the last whole periods in `window` samples, but at
    least one. The drive begins `lead_taus` time constants earlier.
    """
    frequency, time = record.frequency(), record.time
    if not isinstance(drive, Sampled) or frequency is None or time.size <= max_samples:
        return None
    periods = max(1, math.floor(window * record.time_step * frequency))
    begin = int(np.searchsorted(time, time[-1] - periods / frequency + 0.5 * record.time_step))
    lead = int(np.searchsorted(time, time[begin] - lead_taus * b))
    if lead == 0:
        return None
    last = Sampled(pad_samples(time[lead:]), pad_samples(np.asarray(drive.samples)[lead : time.size]))
    return last, (pad_samples(time[begin:]), pad_weight(np.gradient(time)[begin:]))


def derived_from_scene(likelihood: Likelihood, scene: Scene) -> DerivedQuantities:
    """Return the derived quantities for the drive of the scene in the steady state, without records."""
    drive = scene.make_drive()
    if not (isinstance(drive, Periodic) and scene.drive.steady_state):
        raise InputError(
            "scene: without a record, the force is computed for a periodic drive in the steady state; the"
            f" {scene.drive.waveform} of the scene is not one; choose another waveform or steady_state in [drive]"
        )
    settings = _settings(scene, _period_grid(drive, 0.0))
    channel = likelihood.channels[0]
    fixed = np.asarray(0.0), True, False, channel.channel, channel.drive_gains
    return DerivedQuantities(likelihood, as_arrays(drive), *settings, *fixed)


def _grid(record: Record, choice: DriveModel, jump_delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and weights, of one period if the drive has one; `jump_delay` as in `_period_grid`."""
    if isinstance(choice.drive, Periodic) and choice.steady_state:
        return _period_grid(choice.drive, jump_delay)
    n_samples, period = whole_periods(record)
    cells = np.gradient(record.time)
    if period is None:  # trapezoid rule; whole periods need no correction at the ends
        cells[[0, -1]] *= 0.5
    return pad_samples(record.time[:n_samples] - choice.shift, len(record)), pad_weight(cells[:n_samples], len(record))


def _period_grid(drive: Periodic, jump_delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and weights; peaks at ideal jumps are taken `jump_delay` (s) later."""
    if not isinstance(drive, PiecewiseLinear):
        return np.arange(1024) / 1024 * float(drive.period), np.ones(1024)
    knots = np.asarray(drive.pieces().knots) - float(drive.phase_time)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    length = np.diff(knots)[:, None]
    inside = knots[:-1, None] + 0.5 * length * (nodes + 1.0)
    # the voltage is monotone along a piece, so peaks lie at the knots
    peaks = knots[:-1] + (jump_delay if has_ideal_edges(drive) else 0.0)
    return np.append(inside, peaks), np.append(0.5 * length * weights, np.zeros(length.size))
