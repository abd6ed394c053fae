"""What follows from the parameters: divider, time constant, force and friction, at any theta."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator, as_arrays, pad_samples, pad_weight
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.drive_choice import DriveModel, has_ideal_edges, whole_periods
from fitact.likelihood.channel import CHARGES, LINEAR_NUISANCES
from fitact.likelihood.likelihood import Likelihood
from fitact.model.drive import Drive, Multitone, Periodic, PiecewiseLinear, Sampled, Sine
from fitact.model.force import Geometry, electrostatic_force, friction, mean_force, peak_force, summarize
from fitact.model.response import response
from fitact.model.skin import WithSkin
from fitact.scene.scene import Scene

DERIVED_NAMES = ("g", "b", "force_mean", "force_peak", "force_rms", "friction_mean")


class DerivedQuantities(eqx.Module):
    """Derived quantities of the first record, as functions of theta and the channels' noise; see `derived_from_fit`.

    Means are over one period of a scene's drive in the steady state, else over the largest whole number of
    periods that the record holds (the whole record where it holds none); of a long record with a measured
    drive, over its last whole periods, of some thousand samples. `drive` is the likelihood's, or the last part of a
    long measured one, which begins so early that its unknown charge is gone when the force is evaluated.
    """

    likelihood: Likelihood
    drive: Drive
    time: Float[Array, " times"]  # when the force is evaluated, s
    weight: Float[Array, " times"]  # the share of time each stands for; a weight of 0 counts for the peak only
    geometry: Geometry  # with the circuit, where the force acts
    coefficient: ArrayLike  # of friction
    normal_force: ArrayLike  # N
    steady_state: bool = eqx.field(static=True)
    charge: bool = eqx.field(static=True)  # whether the record's unknown one matters

    def force(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " channels"], deviate: ArrayLike = 0.0
    ) -> Float[Array, " times"]:
        """Electrostatic force in time, N; see `fitact.model.force.Geometry`.

        `deviate` holds standard normal numbers (channels, `LINEAR_NUISANCES`) that draw the charges from their
        posterior; 0: their mean.
        """
        circuit = self.likelihood.circuit(theta)
        contact = self.geometry.contact(circuit)
        voltage = response(circuit, self.drive, self.time, steady_state=self.steady_state, channel=contact.channel)
        if self.charge:
            voltage = voltage + self._charges(theta, sigma, deviate)
        return electrostatic_force(voltage, contact)

    def _charges(self, theta: Array, sigma: Array, deviate: ArrayLike) -> Float[Array, " times"]:
        """What unknown charges at the record's first sample add to the voltage that makes the force.

        Not what one that stays on a gap adds, which no channel shows.
        """
        channel, inputs = self.likelihood.channels[0], self.likelihood.channel_inputs(theta)
        first = jnp.broadcast_to(deviate, (len(self.likelihood.channels), len(LINEAR_NUISANCES)))[0]
        sizes = (channel.sample_nuisances(inputs, sigma[0], first) * channel.linear_sd)[-len(CHARGES) :]
        # a charge shows in each channel as the response to a drive does
        acting = self.geometry.contact(inputs.circuit).channel
        there, here = (inputs.circuit.channel_terms(name).weight for name in (acting, channel.channel))
        ratios = jnp.stack([v / jnp.where(w == 0.0, 1.0, w) for v, w in zip(there, here, strict=False)])
        ratios = jnp.pad(ratios, (0, len(CHARGES) - ratios.size))
        return (sizes * ratios) @ channel.decays(inputs.circuit, self.time) / inputs.gain

    def __call__(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " channels"], deviate: ArrayLike = 0.0
    ) -> Float[Array, " derived"]:
        """All of `DERIVED_NAMES`, in SI units."""
        circuit = self.likelihood.circuit(theta)
        force = summarize(self.force(theta, sigma, deviate), self.weight)
        if self.steady_state and isinstance(self.drive, Periodic):  # rms alone needs quadrature
            exact = circuit, self.drive, self.geometry.contact(circuit)
            force = force._replace(mean=mean_force(*exact))
            if not isinstance(circuit, WithSkin) or isinstance(self.drive, Sine | Multitone):
                force = force._replace(peak=peak_force(*exact))
        felt = friction(force.mean, self.coefficient, self.normal_force)
        return jnp.stack([circuit.g, circuit.b, force.mean, force.peak, force.rms, felt])

    def log_value_and_grad(
        self, theta: Float[np.ndarray, " parameters"], sigma: Float[np.ndarray, " channels"]
    ) -> tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]:
        """Logarithms of all of `DERIVED_NAMES`, and their gradients in theta."""
        with jax.enable_x64(True):
            values, gradient = log_derivatives(self, jnp.asarray(theta), jnp.asarray(sigma))
            return np.asarray(values), np.asarray(gradient)


@eqx.filter_jit
def log_derivatives(derive: DerivedQuantities, theta: Array, sigma: Array) -> tuple[Array, Array]:
    def logs(theta: Array) -> Array:
        return jnp.log(derive(theta, sigma))

    return logs(theta), jax.jacfwd(logs)(theta)


def draw_derived(
    derive: DerivedQuantities, likelihood: Likelihood, points: Float[np.ndarray, "*draws coordinates"], seed: int
) -> Float[np.ndarray, "*draws derived"]:
    """All of `DERIVED_NAMES` at points of a posterior; unknown charges are drawn with each."""
    deviates = nuisance_deviates(likelihood, points, seed)
    return evaluate_draws(_derive_draw, derive, likelihood.channels[0].time.size, points, deviates)


def nuisance_deviates(
    likelihood: Likelihood, points: Float[np.ndarray, "*draws coordinates"], seed: int
) -> Float[np.ndarray, "*draws channels nuisances"]:
    """Standard normal numbers that draw the linear nuisances of each channel, for each of the points."""
    shape = (*points.shape[:-1], len(likelihood.channels), len(LINEAR_NUISANCES))
    return np.random.default_rng([seed, 1]).standard_normal(shape)


def evaluate_draws(
    function: Callable[..., Array],
    model: eqx.Module,
    rows: int,
    points: Float[np.ndarray, "*draws coordinates"],
    deviates: Float[np.ndarray, "*draws channels nuisances"],
) -> np.ndarray:
    """`function` of the model, each point and its deviates; `rows`: numbers that one evaluation runs over."""
    with jax.enable_x64(True):
        return BatchEvaluator(function, model, rows).map_over(points.shape[:-1], points, deviates)


def _derive_draw(derive: DerivedQuantities, point: Array, deviate: Array) -> Array:
    theta, log_sigma = derive.likelihood.split(point)
    return derive(theta, jnp.exp(log_sigma), deviate)


def derived_from_fit(
    likelihood: Likelihood, record: Record, choice: DriveModel, scene: Scene, b: float
) -> DerivedQuantities:
    """The derived quantities of a fit; `record` and `choice` are its first, `b` (s) its slowest time constant."""
    last = None if isinstance(likelihood.template, WithSkin) else _last_periods(record, choice, b)
    # half a step after an ideal jump the peak of a skin that depends on the frequency is taken
    jump_delay = 0.5 * record.time_step if isinstance(likelihood.template, WithSkin) else 0.0
    drive, grid = (choice.drive, _grid(record, choice, jump_delay)) if last is None else last
    steady_state, charge = choice.steady_state and last is None, choice.unknown_charge and last is None
    return DerivedQuantities(likelihood.without_samples(), drive, *_settings(scene, grid), steady_state, charge)


def _settings(scene: Scene, grid: tuple[np.ndarray, np.ndarray]) -> tuple[Array, Array, Geometry, float, float]:
    """When the force is evaluated, by times and their weights, and a scene's geometry and friction."""
    time, weight = jnp.asarray(grid[0]), jnp.asarray(grid[1] / grid[1].sum())
    return time, weight, scene.geometry(), scene.friction.coefficient, scene.friction.normal_force


def _last_periods(
    record: Record,
    choice: DriveModel,
    b: float,
    max_samples: int = 20_000,
    window: int = 4_000,
    lead_taus: float = 20.0,
) -> tuple[Drive, tuple[np.ndarray, np.ndarray]] | None:
    """The end of a long measured drive, and times and weights of its last whole periods; None: take it all.

    A record is long above `max_samples`; the force is that of the last periods, of at most `window` samples where that
    holds one, after `lead_taus` time constants.
    """
    frequency, time = record.frequency(), record.time
    if not isinstance(choice.drive, Sampled) or frequency is None or time.size <= max_samples:
        return None
    periods = max(1, math.floor(window * record.time_step * frequency))
    begin = int(np.searchsorted(time, time[-1] - periods / frequency + 0.5 * record.time_step))
    lead = int(np.searchsorted(time, time[begin] - lead_taus * b))
    if lead == 0:
        return None
    drive = Sampled(pad_samples(time[lead:]), pad_samples(record["V"][lead:]))
    return drive, (pad_samples(time[begin:]), pad_weight(np.gradient(time)[begin:]))


def derived_from_scene(likelihood: Likelihood, scene: Scene) -> DerivedQuantities:
    """The derived quantities under the scene's own drive in its steady state, for a likelihood without records."""
    drive = scene.make_drive()
    if not (isinstance(drive, Periodic) and scene.drive.steady_state):
        raise InputError(
            f"scene: without a record the force is that of a periodic drive in its steady state, which a"
            f" {scene.drive.waveform} from rest has not; name another waveform in [drive]"
        )
    settings = _settings(scene, _period_grid(drive, 0.0))
    return DerivedQuantities(likelihood, as_arrays(drive), *settings, steady_state=True, charge=False)


def _grid(record: Record, choice: DriveModel, jump_delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and weights, of a period where the drive has one; `jump_delay` as in `_period_grid`."""
    if isinstance(choice.drive, Periodic) and choice.steady_state:
        return _period_grid(choice.drive, jump_delay)
    kept, period = whole_periods(record)
    cells = np.gradient(record.time)
    if period is None:  # the trapezoid rule; over whole periods the ends meet
        cells[[0, -1]] *= 0.5
    return pad_samples(record.time[:kept] - choice.shift, len(record)), pad_weight(cells[:kept], len(record))


def _period_grid(drive: Periodic, jump_delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and weights; at ideal jumps `jump_delay` (s) later, where a fractional skin's Vsc has a value."""
    if not isinstance(drive, PiecewiseLinear):
        return np.arange(1024) / 1024 * float(drive.period), np.ones(1024)
    knots = np.asarray(drive.pieces().knots) - float(drive.phase_time)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    length = np.diff(knots)[:, None]
    inside = knots[:-1, None] + 0.5 * length * (nodes + 1.0)
    # u is monotone along a piece, so peaks sit at the knots
    peaks = knots[:-1] + (jump_delay if has_ideal_edges(drive) else 0.0)
    return np.append(inside, peaks), np.append(0.5 * length * weights, np.zeros(length.size))
