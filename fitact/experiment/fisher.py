"""What an experiment would tell: the errors to expect of parameters and force, before or after it is done.

From the Fisher information of the channels' noise and the prior, in the Laplace approximation, as a fit's own.
Nothing else is taken to be unknown: no offset, drift, delay or charge at the start.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.experiment.blind_directions import log_values, with_parameters
from fitact.model.circuit import Channel, Circuit
from fitact.model.drive import Drive, Periodic, Sampled
from fitact.model.force import Geometry, force_constant
from fitact.model.response import highpass, response_and_rate
from fitact.model.skin import has_time_constants, limits_current, parameters, with_values

FREQUENCY = "frequency"  # the drive's, as the name of a setting

_SAMPLES = 4096  # of a long record as many stand for all
_LONG = 8192  # likewise of a long measured drive's beginning, since its every sample costs
_GOLDEN = 0.6180339887498949
_PERIOD = 1024  # times in a period, at which the force is averaged
_EDGE = 10.0  # a step of V so many times the mean one is an edge (a sine's largest is 1.6 times, a triangle's 1),
_BESIDE = 2  # so many samples to either side of which say nothing of a current that follows dV/dt,
_ASIDE = 0.25  # of a step further, lest rounding decide where edges coincide with samples


Tied: TypeAlias = tuple[tuple[str, str, float], ...]


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A measurement, as it was done or might be.

    Attributes:
        circuit: at the values to expect.
        free: the unknown parameters, fields of the circuit and "gain" (of Vsc) and "gain_I".
        prior_root: its product with its transpose is the prior's covariance of their logarithms.
        drive: what drives the circuit.
        time: of the samples, s, in the drive's time.
        channels: what is recorded beside V.
        noise: standard deviation of each channel's noise, V and A.
        steady_state: or from rest.
        records: how many such records there are.
        geometry: what the force needs beside the circuit; of areas and thicknesses nothing but factors depends.
        own: which of `free` it shares with no other experiment on the same finger.
        tied: (name, other, ratio) of the circuit's fields that follow another one.
    """

    circuit: Circuit
    free: tuple[str, ...]
    prior_root: Float[np.ndarray, "parameters parameters"]
    drive: Drive
    time: Float[np.ndarray, " samples"]
    channels: tuple[Channel, ...]
    noise: Mapping[str, float]
    steady_state: bool = True
    records: float = 1.0
    geometry: Geometry = Geometry()  # noqa: RUF009  (a frozen Module)
    own: tuple[str, ...] = ()
    tied: Tied = ()


@dataclasses.dataclass(frozen=True)
class Expected:
    """Errors to expect of an experiment.

    Attributes:
        sd: standard deviations of the parameters, in their logarithms.
        force_sd: that of the mean force, in its logarithm; small, it is the relative one.
        force_contraction: 1 - that over the prior's.
    """

    sd: dict[str, float]
    force_sd: float
    force_contraction: float


def expected_sd(experiment: Experiment) -> Expected:
    """The errors to expect of an experiment, in the Laplace approximation.

    Raises:
        InputError: a name in `free` is no parameter of the circuit, or the drive has no steady state asked for.
    """
    gradient = force_gradient(experiment)
    root = covariance_root(jacobian(experiment)[0], experiment.prior_root)
    force_sd = float(np.linalg.norm(gradient @ root))
    return Expected(
        sd=dict(zip(experiment.free, np.linalg.norm(root, axis=1).tolist(), strict=True)),
        force_sd=force_sd,
        force_contraction=1.0 - force_sd / float(np.linalg.norm(gradient @ experiment.prior_root)),
    )


def force_gradient(experiment: Experiment) -> Float[np.ndarray, " parameters"]:
    """The derivative of the logarithm of the mean force that an experiment makes, in its log-parameters.

    Raises:
        InputError: as `expected_sd`.
    """
    e, theta = experiment, log_values(experiment.circuit, experiment.free, experiment.channels)
    with jax.enable_x64(True):
        sampling = _sampling(e)
        ((voltage, slope),) = _derivatives(e, e.free, theta, sampling, _ACTING, order=1)
        circuit, geometry = jax.tree.map(jnp.asarray, (e.circuit, e.geometry))  # plain numbers would be compiled in
        of_constant = np.asarray(
            _force_constant_slope(circuit, e.tied, e.free, e.channels, jnp.asarray(theta), geometry)
        )
    weight = sampling.force * voltage
    return of_constant + 2.0 * (weight @ slope) / (weight @ voltage)


def jacobian(experiment: Experiment, settings: Sequence[str] = ()) -> Float[np.ndarray, "1+settings rows parameters"]:
    """That of what is recorded over its noise, and behind it its derivatives in the logarithms of `settings`.

    A setting is a field of the circuit, or `FREQUENCY`, in which each sample, and each edge, stays where it is in
    the period. Settings need a circuit with time constants.

    Raises:
        InputError: as `expected_sd`.
    """
    e, names = experiment, tuple(dict.fromkeys([*experiment.free, *sorted(settings, key=FREQUENCY.__eq__)]))
    fields = [name for name in names if name != FREQUENCY]
    theta = np.append(log_values(e.circuit, fields, e.channels), np.zeros(len(names) - len(fields)))
    with jax.enable_x64(True):
        sampling = _sampling(e)
        shown = _derivatives(e, names, theta, sampling, _RECORDED, order=2 if settings else 1)
    found = []
    for channel, (_, slope, *curvature) in zip(e.channels, shown, strict=True):
        counts = sampling.away if channel == "I" and not limits_current(e.circuit) else sampling.data
        parts = [slope, *(curvature[0][..., names.index(name)] for name in settings)]
        found.append(np.stack(parts)[..., : len(e.free)] * (counts / e.noise[channel])[:, None])
    return np.concatenate(found, axis=1)


def spans(experiment: Experiment) -> dict[Channel, float]:
    """What each channel's samples reach over, V and A, but for a current within edges."""
    e, theta = experiment, log_values(experiment.circuit, experiment.free, experiment.channels)
    with jax.enable_x64(True):
        sampling = _sampling(e)
        shown = _derivatives(e, e.free, theta, sampling, _RECORDED, order=1)
    kept = sampling.away > 0.0
    return {channel: float(np.ptp(value[kept])) for channel, (value, *_) in zip(e.channels, shown, strict=True)}


def covariance_root(
    jacobian: Float[np.ndarray, "samples parameters"], prior_root: Float[np.ndarray, "parameters parameters"]
) -> Float[np.ndarray, "parameters parameters"]:
    """A matrix whose product with its transpose is the Laplace approximation's covariance.

    `jacobian` is that of the whitened residuals, `prior_root` a root of the prior's covariance. From singular
    values: their squares span more digits than a number has.
    """
    _, sizes, directions = np.linalg.svd(jacobian @ prior_root, full_matrices=False)
    return prior_root @ directions.T / np.hypot(1.0, sizes)


_RECORDED, _ACTING = slice(None, -1), slice(-1, None)  # of the channels, to which that which makes the force is added


def _derivatives(
    e: Experiment, names: tuple[str, ...], theta: np.ndarray, sampling: "_Sampling", which: slice, order: int
) -> list[list[np.ndarray]]:
    """What each channel shows, and its derivatives in the logarithms of `names` up to `order`."""
    circuit = jax.tree.map(jnp.asarray, e.circuit)
    channels: tuple[Channel, ...] = (*e.channels, "Vsc" if e.geometry.model == "paper" else "Vgap")
    if has_time_constants(circuit):
        terms = _terms(circuit, e.tied, names, channels, jnp.asarray(theta), order)
        return [_response([_Terms(*map(np.asarray, part)) for part in of], sampling) for of in terms[which]]
    of = jnp.asarray(sampling.time), jnp.asarray(sampling.slope), sampling.steady_state
    values, slopes = _shown(circuit, e.tied, names, channels, jnp.asarray(theta), sampling.drive, *of)
    return [[np.asarray(value), np.asarray(slope)] for value, slope in zip(values, slopes, strict=True)][which]


def _there(
    circuit: Circuit, tied: Tied, names: tuple[str, ...], channels: tuple[Channel, ...], theta: Array
) -> tuple[Circuit, list[ArrayLike]]:
    """As `with_parameters`; what is tied follows."""
    there, gains = with_parameters(circuit, names, channels, theta)
    known = parameters(there)
    return with_values(there, {name: ratio * known[other] for name, other, ratio in tied}), gains


class _Terms(NamedTuple):
    """A channel's high-pass terms, or their derivatives in the parameters."""

    weight: Array
    log_tau: Array
    rate: Array


@eqx.filter_jit
def _terms(
    circuit: Circuit,
    tied: Tied,
    names: tuple[str, ...],
    channels: tuple[Channel, ...],
    theta: Float[Array, " names"],
    order: int,
) -> tuple[Any, ...]:
    """For each channel, the last being that which makes the force: terms and their derivatives."""
    fields = tuple(name for name in names if name != FREQUENCY)

    def terms(theta: Array) -> list[_Terms]:
        there, gains = _there(circuit, tied, fields, channels[:-1], theta[: len(fields)])
        # at another frequency the same happens in the period as with all time constants so many times longer
        faster = theta[names.index(FREQUENCY)] if FREQUENCY in names else jnp.zeros(())
        found = []
        for gain, channel in zip((*gains, 1.0), channels, strict=True):
            weight, tau, rate = there.terms_of(channel)
            rate = jnp.asarray(0.0 if rate is None else rate)
            found.append(
                _Terms(gain * jnp.stack(weight), jnp.log(jnp.stack(tau)) + faster, gain * rate * jnp.exp(faster))
            )
        return found

    found, derivative = [terms(theta)], terms
    for _ in range(order):
        derivative = jax.jacfwd(derivative)
        found.append(derivative(theta))
    return tuple(zip(*found, strict=True))


@eqx.filter_jit
def _force_constant_slope(
    circuit: Circuit,
    tied: Tied,
    free: tuple[str, ...],
    channels: tuple[Channel, ...],
    theta: Float[Array, " parameters"],
    geometry: Geometry,
) -> Float[Array, " parameters"]:
    """The derivative of the logarithm of force over the square of the voltage that makes it."""

    def log_force(theta: Array) -> Array:
        return jnp.log(force_constant(geometry.contact(_there(circuit, tied, free, channels, theta)[0])))

    return jax.jacfwd(log_force)(theta)


class _Sampling(NamedTuple):
    """Where the drive's responses are computed, always as many times, so that it compiles once.

    Attributes:
        drive, steady_state: as in `Experiment`.
        time: s.
        slope: dV/dt there, V/s.
        data: the root of the number of samples that each time stands for.
        away: likewise, and 0 near the drive's edges.
        force: which times the force is averaged over.
    """

    drive: Drive
    steady_state: bool
    time: Float[np.ndarray, " times"]
    slope: Float[np.ndarray, " times"]
    data: Float[np.ndarray, " times"]
    away: Float[np.ndarray, " times"]
    force: Float[np.ndarray, " times"]


def _sampling(e: Experiment) -> _Sampling:
    drive, time = _of_one_size(e.drive, np.asarray(e.time, dtype=float))
    drive = jax.tree.map(jnp.asarray, drive)
    k, used = np.arange(_SAMPLES), min(time.size, _SAMPLES)
    # of many samples some, spread evenly and in step with no period
    chosen = np.minimum(k, used - 1) if used < _SAMPLES else (time.size * (_GOLDEN * k % 1.0)).astype(int)
    stands = np.where(k < used, math.sqrt(e.records * np.size(e.time) / used), 0.0)
    periodic = e.steady_state and isinstance(drive, Periodic)
    period = float(drive.period) * (np.arange(_PERIOD) + 0.5) / _PERIOD if periodic else np.full(_PERIOD, time[0])
    times = np.append(time[chosen], period)
    beside = np.arange(-_BESIDE, 1 + _BESIDE) + _ASIDE
    around = time[chosen][:, None] + beside * float(np.median(np.diff(time)))
    voltage, slope = (np.asarray(x) for x in _wave(drive, jnp.asarray(around), jnp.asarray(times), e.steady_state))
    step = np.abs(np.diff(voltage, axis=1))
    away = step.max(axis=1) <= _EDGE * step[:used].mean()
    outside = np.zeros(_PERIOD)
    return _Sampling(
        drive,
        e.steady_state,
        times,
        # that of a measured drive is mostly noise: what follows it is not counted as told
        np.zeros(times.size) if isinstance(drive, Sampled) else np.nan_to_num(slope),
        data=np.append(stands, outside),
        away=np.append(away * stands, outside),
        force=np.append(np.zeros(_SAMPLES), 1.0 + outside) if periodic else np.append(k < used, outside),
    )


def _of_one_size(drive: Drive, time: np.ndarray) -> tuple[Drive, np.ndarray]:
    """A measured drive with always as many samples, held after its end, and the times within them."""
    if not isinstance(drive, Sampled) or drive.period is not None:
        return drive, time
    knots, samples = np.asarray(drive.time)[:_LONG], np.asarray(drive.samples)[:_LONG]
    missing = _LONG - knots.size
    after = knots[-1] + (1.0 + np.arange(missing)) * (knots[-1] - knots[0])
    return Sampled(np.append(knots, after), np.pad(samples, (0, missing), mode="edge")), time[time <= knots[-1]]


@eqx.filter_jit
def _wave(drive: Drive, around: Array, time: Array, steady_state: bool) -> tuple[Array, Array]:
    return drive.value(around), drive.slope(time, steady_state=steady_state)


@eqx.filter_jit
def _highpass(drive: Drive, time: Array, log_tau: Array, steady_state: bool, order: int) -> tuple[Array, ...]:
    """The response of one term, and its derivatives in log tau up to `order`, 1 or 2."""
    one = jnp.ones_like(log_tau)

    def response(log_tau: Array) -> Array:
        return highpass(drive, time, jnp.exp(log_tau), steady_state=steady_state)

    def first(log_tau: Array) -> tuple[Array, ...]:
        return jax.jvp(response, (log_tau,), (one,))

    if order == 1:
        return first(log_tau)
    values, slopes = jax.jvp(first, (log_tau,), (one,))
    return (*values, slopes[1])


@eqx.filter_jit
def _shown(
    circuit: Circuit,
    tied: Tied,
    free: tuple[str, ...],
    channels: tuple[Channel, ...],
    theta: Array,
    drive: Drive,
    time: Array,
    rising: Array,
    steady_state: bool,
) -> tuple[list[Array], list[Array]]:
    def shown(theta: Array) -> tuple[list[Array], list[Array]]:
        there, gains = _there(circuit, tied, free, channels[:-1], theta)
        found = []
        for gain, channel in zip((*gains, 1.0), channels, strict=True):
            value, rate = response_and_rate(there, drive, time, steady_state=steady_state, channel=channel)
            found.append(gain * (value if rate is None else value + rate * rising))
        return found, found

    slopes, values = jax.jacfwd(shown, has_aux=True)(theta)
    return values, slopes


def _response(terms: Sequence[_Terms], sampling: _Sampling) -> list[np.ndarray]:
    """What a channel shows, by its terms and their derivatives, and its derivatives in the log-parameters.

    Term by term, and the terms' derivatives apart: at once it takes ten times as long to compile.
    """
    time, found = jnp.asarray(sampling.time), [np.multiply.outer(sampling.slope, of.rate) for of in terms]
    for k, (weight, log_tau) in enumerate(zip(terms[0].weight, terms[0].log_tau, strict=True)):
        at = sampling.drive, time, jnp.asarray(log_tau), sampling.steady_state
        u, du, *ddu = (np.asarray(x) for x in _highpass(*at, len(terms) - 1))
        w, tau = terms[1].weight[k], terms[1].log_tau[k]
        found[0] += weight * u
        found[1] += np.outer(u, w) + np.outer(weight * du, tau)
        if ddu:
            both = np.outer(w, tau)
            mixed = both + both.T + weight * terms[2].log_tau[k]
            found[2] += np.multiply.outer(u, terms[2].weight[k]) + np.multiply.outer(du, mixed)
            found[2] += np.multiply.outer(weight * ddu[0], np.outer(tau, tau))
    return found
