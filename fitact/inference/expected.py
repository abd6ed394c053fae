"""What an experiment would tell: the errors to expect of parameters and force, before or after it is done.

From the Fisher information of the channels' noise and the prior, in the Laplace approximation, as a fit's own.
Nothing else is taken to be unknown: no offset, drift, delay or charge at the start.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.inference.structure import log_values, with_parameters
from fitact.model.circuit import Channel, Circuit, DirectGround, FinalCircuit, NaturalGround
from fitact.model.drive import Drive, Periodic, Sampled
from fitact.model.force import Geometry, force_constant
from fitact.model.response import highpass, response_and_rate
from fitact.model.skin import WithSkin, has_time_constants, limits_current
from fitact.units import engineering

NOISE_I = 20e-9  # A, of a current channel where none is stated
SERIES_RESISTOR = 100e3  # ohm, the known one that is recommended

_SAMPLES = 4096  # of a long record as many stand for all
_LONG = 8192  # likewise of a long measured drive's beginning, since its every sample costs
_GOLDEN = 0.6180339887498949
_PERIOD = 1024  # times in a period, at which the force is averaged
_EDGE = 10.0  # a step of V so many times the mean one is an edge (a sine's largest is 1.6 times, a triangle's 1),
_BESIDE = 2  # so many samples to either side of which say nothing of a current that follows dV/dt


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


@dataclasses.dataclass(frozen=True)
class Remedy:
    """What might be done about an answer that is not well known, and the errors to expect then.

    Attributes:
        name: what is done.
        force_sd: as in `Expected`, of all data together.
        sd: likewise.
    """

    name: str
    force_sd: float
    sd: dict[str, float]


def expected_sd(experiment: Experiment) -> Expected:
    """The errors to expect of an experiment, in the Laplace approximation.

    Raises:
        InputError: a name in `free` is no parameter of the circuit, or the drive has no steady state asked for.
    """
    e, theta = experiment, log_values(experiment.circuit, experiment.free, experiment.channels)
    with jax.enable_x64(True):
        circuit, geometry = jax.tree.map(jnp.asarray, (e.circuit, e.geometry))  # plain numbers would be compiled in
        sampling = _sampling(e)
        acting: Channel = "Vsc" if e.geometry.model == "paper" else "Vgap"
        of = _by_terms if has_time_constants(circuit) else _by_harmonics
        *seen, (voltage, slope) = of(circuit, e.free, (*e.channels, acting), jnp.asarray(theta), sampling)
        force_constant_slope = _force_constant_slope(circuit, e.free, e.channels, jnp.asarray(theta), geometry)
    weight = sampling.force * voltage
    gradient = np.asarray(force_constant_slope) + 2.0 * (weight @ slope) / (weight @ voltage)
    jacobian = [
        (sampling.away if channel == "I" and not limits_current(circuit) else sampling.data)[:, None]
        / e.noise[channel]
        * response
        for channel, (_, response) in zip(e.channels, seen, strict=True)
    ]
    root = covariance_root(np.concatenate(jacobian), e.prior_root)
    force_sd = float(np.linalg.norm(gradient @ root))
    return Expected(
        sd=dict(zip(e.free, np.linalg.norm(root, axis=1).tolist(), strict=True)),
        force_sd=force_sd,
        force_contraction=1.0 - force_sd / float(np.linalg.norm(gradient @ e.prior_root)),
    )


def covariance_root(
    jacobian: Float[np.ndarray, "samples parameters"], prior_root: Float[np.ndarray, "parameters parameters"]
) -> Float[np.ndarray, "parameters parameters"]:
    """A matrix whose product with its transpose is the Laplace approximation's covariance.

    `jacobian` is that of the whitened residuals, `prior_root` a root of the prior's covariance. From singular
    values: their squares span more digits than a number has.
    """
    _, sizes, directions = np.linalg.svd(jacobian @ prior_root, full_matrices=False)
    return prior_root @ directions.T / np.hypot(1.0, sizes)


def remedies(experiment: Experiment) -> tuple[Remedy, ...]:
    """What might be done to know the mean force better, best first; of that, what can be computed there.

    A fit that failed may have ended at a circuit whose current no double holds.
    """
    found = []
    for name, changed in _changes(experiment):
        with contextlib.suppress(np.linalg.LinAlgError):
            expected = expected_sd(changed)
            found.append(Remedy(name, expected.force_sd, expected.sd))
    return tuple(sorted(found, key=lambda remedy: remedy.force_sd))


def _changes(e: Experiment) -> Iterator[tuple[str, Experiment]]:
    if "I" not in e.channels:
        noise = e.noise.get("I", NOISE_I)
        changed = dataclasses.replace(e, channels=(*e.channels, "I"), noise={**e.noise, "I": noise})
        yield f"the trunk current I recorded to ± {engineering(noise, 'A')}", changed
    resisted = _with_resistor(e.circuit)
    if resisted is not None:
        yield (
            f"a known resistor of {engineering(SERIES_RESISTOR, 'ohm')} in series",
            dataclasses.replace(e, circuit=resisted),
        )
    if "Ci" in e.free:
        halved = np.where([name == "Ci" for name in e.free], 0.5, 1.0)[:, None] * e.prior_root
        yield "Ci known twice as well", dataclasses.replace(e, prior_root=halved)
    yield "four times the record", dataclasses.replace(e, records=4.0 * e.records)


def _with_resistor(circuit: Circuit) -> Circuit | None:
    """The circuit with a known resistor in series; None where it has one."""
    if isinstance(circuit, WithSkin):
        resisted: Any = _with_resistor(circuit.circuit)
        return None if resisted is None else dataclasses.replace(circuit, circuit=resisted)
    if isinstance(circuit, FinalCircuit):
        circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci)
    if not isinstance(circuit, DirectGround | NaturalGround) or circuit.series_resistor is not None:
        return None
    return dataclasses.replace(circuit, series_resistor=SERIES_RESISTOR)


class _Terms(NamedTuple):
    """A channel's high-pass terms, or their derivatives in the parameters."""

    weight: Array
    log_tau: Array
    rate: Array


@eqx.filter_jit
def _terms(
    circuit: Circuit, free: tuple[str, ...], channels: tuple[Channel, ...], theta: Float[Array, " parameters"]
) -> tuple[Any, ...]:
    """For each channel, the last being that which makes the force: terms and their derivatives."""

    def terms(theta: Array) -> list[_Terms]:
        there, gains = with_parameters(circuit, free, channels[:-1], theta)
        found = []
        for gain, channel in zip((*gains, 1.0), channels, strict=True):
            weight, tau, rate = there.terms_of(channel)
            rate = jnp.asarray(0.0 if rate is None else rate)
            found.append(_Terms(gain * jnp.stack(weight), jnp.log(jnp.stack(tau)), gain * rate))
        return found

    return tuple(zip(terms(theta), jax.jacfwd(terms)(theta), strict=True))


@eqx.filter_jit
def _force_constant_slope(
    circuit: Circuit,
    free: tuple[str, ...],
    channels: tuple[Channel, ...],
    theta: Float[Array, " parameters"],
    geometry: Geometry,
) -> Float[Array, " parameters"]:
    """The derivative of the logarithm of force over the square of the voltage that makes it."""

    def log_force(theta: Array) -> Array:
        return jnp.log(force_constant(geometry.contact(with_parameters(circuit, free, channels, theta)[0])))

    return jax.jacfwd(log_force)(theta)


_Seen: TypeAlias = tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times parameters"]]


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
    around = time[chosen][:, None] + np.arange(-_BESIDE, 1 + _BESIDE) * float(np.median(np.diff(time)))
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
def _highpass(drive: Drive, time: Array, log_tau: Array, steady_state: bool) -> tuple[Array, Array]:
    """The response of one term, and its derivative in log tau."""

    def response(log_tau: Array) -> Array:
        return highpass(drive, time, jnp.exp(log_tau), steady_state=steady_state)

    return jax.jvp(response, (log_tau,), (jnp.ones_like(log_tau),))


def _by_terms(
    circuit: Circuit, free: tuple[str, ...], channels: tuple[Channel, ...], theta: Array, sampling: _Sampling
) -> list[_Seen]:
    """What each channel, the last being that which makes the force, shows, and its derivatives in the logarithms."""
    return [_response(terms, sampling) for terms in _terms(circuit, free, channels, theta)]


def _by_harmonics(
    circuit: Circuit, free: tuple[str, ...], channels: tuple[Channel, ...], theta: Array, sampling: _Sampling
) -> list[_Seen]:
    """As `_by_terms`, of a skin without time constants."""
    of = jnp.asarray(sampling.time), jnp.asarray(sampling.slope), sampling.steady_state
    values, slopes = _shown(circuit, free, channels, theta, sampling.drive, *of)
    return [(np.asarray(value), np.asarray(slope)) for value, slope in zip(values, slopes, strict=True)]


@eqx.filter_jit
def _shown(
    circuit: Circuit,
    free: tuple[str, ...],
    channels: tuple[Channel, ...],
    theta: Array,
    drive: Drive,
    time: Array,
    rising: Array,
    steady_state: bool,
) -> tuple[list[Array], list[Array]]:
    def shown(theta: Array) -> tuple[list[Array], list[Array]]:
        there, gains = with_parameters(circuit, free, channels[:-1], theta)
        found = []
        for gain, channel in zip((*gains, 1.0), channels, strict=True):
            value, rate = response_and_rate(there, drive, time, steady_state=steady_state, channel=channel)
            found.append(gain * (value if rate is None else value + rate * rising))
        return found, found

    slopes, values = jax.jacfwd(shown, has_aux=True)(theta)
    return values, slopes


def _response(channel: tuple[_Terms, _Terms], sampling: _Sampling) -> _Seen:
    """What a channel shows, and its derivatives in the log-parameters.

    Term by term, and the terms' derivatives apart: at once it takes ten times as long to compile.
    """
    terms, slopes = (_Terms(*map(np.asarray, part)) for part in channel)
    value, slope = sampling.slope * terms.rate, np.outer(sampling.slope, slopes.rate)
    for k, weight in enumerate(terms.weight):
        term = _highpass(
            sampling.drive, jnp.asarray(sampling.time), jnp.asarray(terms.log_tau[k]), sampling.steady_state
        )
        u, change = (np.asarray(x) for x in term)
        value = value + weight * u
        slope = slope + np.outer(u, slopes.weight[k]) + np.outer(weight * change, slopes.log_tau[k])
    return value, slope
