"""What is fitted to what: the likelihood of records and their scenes, and where the fit starts."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact.compiled import LONGEST, padded, padded_weight
from fitact.data.clipping import clipped
from fitact.data.record import Record, rounding_noise, white_noise
from fitact.errors import InputError
from fitact.experiment.fisher import Experiment
from fitact.fitting.current import Comparable, CurrentStart, comparable, current_start
from fitact.fitting.drive_choice import (
    DriveChoice,
    LinearStart,
    as_arrays,
    choose_drive,
    frequency_error,
    has_ideal_edges,
    has_unresolved_edge,
    linear_start,
    shared,
)
from fitact.fitting.skin_model import require_followed, with_level, without_jumps
from fitact.likelihood import certificate as compressed
from fitact.likelihood.channel import CHARGES, LINEAR, Trace
from fitact.likelihood.likelihood import Batched, Likelihood
from fitact.likelihood.noise import Autoregression, NoiseModel, quiet_noise, require_uniform
from fitact.model.circuit import RC, Channel, FinalCircuit
from fitact.model.skin import WithSkin, constant, limits_current, parameters
from fitact.prior.distributions import LogNormal
from fitact.prior.prior import Prior
from fitact.scene.scene import Scene

_OFFSET = 0.02  # of a channel's span: standard deviation of an offset that the record is too short to show
_CHARGE = 10.0  # spans: that of an unknown charge
_HELD = 1e-6  # standard deviation, in its logarithm, of a parameter that is held
PRECISION = 1e-9  # of a channel's span: least noise assumed
_CLOCK = 5.0  # steps at a record's ends: that of the drive's clock, since its frequency is known to one or two, or as
# well as `frequency_error` says
_DRAWS = 256  # of the prior, to start from the best of


class Source(NamedTuple):
    """Where a trace comes from.

    Attributes:
        record, scene, choice: the record, its scene and its drive.
        noise: of the channel, judged without a model.
        freeable: nuisances that the trace can ask for.
        start: what a linear fit says of it; None: nothing.
        notes: what was assumed, in sentences.
        drowned: whether the drive's noise drowns the channel, which then biases the answer.
    """

    record: Record
    scene: Scene
    choice: DriveChoice
    noise: float
    freeable: tuple[str, ...]
    start: LinearStart | CurrentStart | None
    notes: tuple[str, ...]
    drowned: bool


class Problem(NamedTuple):
    """A likelihood over the samples, where its traces come from, and where to start."""

    likelihood: Likelihood
    sources: tuple[Source, ...]
    start: Float[np.ndarray, " parameters"]

    def compressed(self, tolerance: float) -> tuple[Likelihood, tuple[str, ...]]:
        """With compressed traces where that can hold, and the reasons where it cannot."""
        circuit = self.likelihood.circuit(jnp.asarray(self.start))
        pairs = [
            compressed.project(trace, circuit, _shows(source.start), tolerance)
            for trace, source in zip(self.likelihood.traces, self.sources, strict=True)
        ]
        traces, reasons = zip(*pairs, strict=True)
        return dataclasses.replace(self.likelihood, traces=traces), reasons

    def experiment(self, likelihood: Likelihood, theta: np.ndarray, sigma: np.ndarray) -> Experiment:
        """The measurement that was done; of several records, the first as many times."""
        source, records = self.sources[0], len({id(source.record) for source in self.sources})
        pairs = zip(likelihood.traces, self.sources, strict=True)
        of_first = [trace for trace, other in pairs if other.record is source.record]
        fields = parameters(likelihood.template)
        gains = ("gain", "gain_I") if records == 1 else ()
        free = tuple(name for name in likelihood.prior.names if name in fields or name in gains)
        rows = [likelihood.prior.names.index(name) for name in free]
        root, measured = likelihood.prior_root, source.scene.measurement
        noise = {"Vsc": measured.noise_Vsc, "I": measured.noise_I}
        return Experiment(
            circuit=likelihood.circuit(jnp.asarray(theta)),
            free=free,
            prior_root=np.linalg.cholesky((root @ root.T)[np.ix_(rows, rows)]),
            drive=source.choice.drive,
            time=source.record.time - source.choice.shift,
            channels=tuple(trace.channel for trace in of_first),
            noise=noise | {trace.channel: float(s) for trace, s in zip(of_first, sigma, strict=False)},
            steady_state=source.choice.steady_state,
            records=float(records),
            geometry=source.scene.geometry(),
            tied=likelihood.tied,
        )


def _shows(start: LinearStart | CurrentStart | None) -> bool:
    return start is not None and math.isfinite(start.b)


def pose(records: Sequence[Record], scenes: Sequence[Scene | None], believed: bool = True) -> Problem:
    """One circuit and one prior, the first scene's; a drive and nuisances for each record.

    Raises:
        InputError: a record cannot come from this circuit, or lacks a channel that its scene asks for.
    """
    first = scenes[0] or Scene()
    stated, tied = first.make_prior(), first.prior.tied()
    noise = {name: stated[name] for name in ("sigma", "sigma_I") if name in stated.names}
    prior = stated.without(*noise)
    template = with_level(first.make_rc_circuit(circuit_values(first, prior, tied)), records, scenes)
    opened = [
        _open(record, scene, channel, number if len(records) > 1 else None, template)
        for number, (record, scene) in enumerate(zip(records, scenes, strict=True), 1)
        for channel in _channels(record, scene)
    ]
    traces, sources, gains = zip(*opened, strict=True)
    prior = prior.including(
        **{trace.named("gain"): LogNormal(1.0, sd) for trace, sd in zip(traces, gains, strict=True) if sd > 0.0}
    )
    likelihood = Likelihood(
        traces=traces,
        template=as_arrays(template),
        prior=compiled_once(prior),
        sigma_prior=tuple(noise.get("sigma" if trace.channel == "Vsc" else "sigma_I") for trace in traces),
        tied=tuple((name, other, ratio) for name, (other, ratio) in tied.items()),
        believed=believed,
    )
    return Problem(likelihood, sources, _start(likelihood, sources))


def circuit_values(scene: Scene, prior: Prior, tied: dict[str, tuple[str, float]]) -> dict[str, float]:
    """All that is held, free or tied in the scene's circuit, by name."""
    values = scene.fixed() | {name: math.exp(prior[name].log_mean) for name in prior.names}
    for name, (other, ratio) in tied.items():
        value = values.get(other, scene.nominal()[other])
        if value is None:
            raise InputError(f"scene: [prior] {name} is tied to {other}, which the scene does not have; give it there")
        values[name] = ratio * value
    return values


def compiled_once(prior: Prior) -> Prior:
    """The prior whose log-normal marginals are no constants of what is compiled, where none are correlated."""
    if prior.pairs:
        return prior
    marginals = (as_arrays(m) if isinstance(m, LogNormal) else m for m in prior.marginals)
    return dataclasses.replace(prior, marginals=tuple(marginals))


def _channels(record: Record, scene: Scene | None) -> tuple[Channel, ...]:
    """What is fitted: the scene's channels, or without a scene Vsc, and I where there is no Vsc."""
    if scene is None:
        return ("I",) if "I" in record and "Vsc" not in record else ("Vsc",)
    return tuple(channel for channel in ("Vsc", "I") if channel in scene.measurement.channels)


def _open(
    record: Record, scene: Scene | None, channel: Channel, number: int | None, template: RC | WithSkin
) -> tuple[Trace, Source, float]:
    """A trace over its samples, its source, and the standard deviation of a gain's logarithm."""
    given, choice = scene or Scene(), choose_drive(record, scene)
    _require_whole_drive(record, choice)
    require_followed(template, record, choice)
    label = "_".join(([channel] if channel != "Vsc" else []) + ([str(number)] if number else []))
    notes, freeable = choice.notes, ("offset", "drift", *_hum(record, choice))
    start: LinearStart | CurrentStart | None = None
    seen: Comparable | None = None
    if channel == "Vsc":
        gain, freeable = _log_sd(given.measurement.gain_relative_sd), (*freeable, "delay")
        if choice.periodic and choice.steady_state and choice.name != "measured":
            freeable = (*freeable, "clock")
        if _jumps(template, record):
            start = linear_start(record, choice, _largest(template) * math.exp(3.0 * gain))
            gain = math.hypot(gain, _edge_time(record, choice, start))
    else:
        gain = _log_sd(given.measurement.gain_I_relative_sd)
        if not limits_current(template):
            seen = comparable(record, choice)
            start, notes = current_start(record, choice, seen), (*notes, *seen.notes)
    weight, left_out = _weight(record, channel, seen)
    weight, at_jumps = without_jumps(template, record, choice, weight)
    if weight is None and len(record) <= LONGEST:
        weight = np.ones(len(record))
    weight = None if weight is None else padded_weight(weight)
    colour, noise = _noise(record, channel, given)
    trace = dataclasses.replace(
        _trace(record, choice, channel, label, template, given.measurement.noise_model),
        weight=None if weight is None else jnp.asarray(weight),
        rate=None if seen is None else shared(padded(seen.rate)),
        whitening=colour and colour.whitening(np.ones(len(record), bool) if weight is None else weight > 0.0),
    )
    drowned = seen is not None and seen.drowned
    source = Source(
        record, given, choice, noise, freeable, start, (*record.notes, *notes, *left_out, *at_jumps), drowned
    )
    return trace, source, gain


def _require_whole_drive(record: Record, choice: DriveChoice) -> None:
    """Refuse a measured drive that was clipped; one whose flat tops carry no noise is taken to be flat."""
    if choice.name != "measured" or white_noise(record["V"]) == 0.0 or rounding_noise(record["V"]) > 0.0:
        return
    count = np.count_nonzero(clipped(record["V"]))
    if count:
        raise InputError(
            f"{record.source}: V_V is clipped at {count:,} of {len(record):,} samples, so what drove the finger is not"
            " known; record it within range, or name the waveform in a scene"
        )


def _weight(record: Record, channel: str, seen: Comparable | None) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """The samples' weights, 0 where they were clipped, and a sentence about those."""
    out, weight = clipped(record[channel]), None if seen is None else seen.weight
    if not out.any():
        return weight, ()
    note = (
        f"{channel} is clipped: {np.count_nonzero(out):,} of {out.size:,} samples lie at its extremes or within two"
        " samples of one that does, and are left out; record with a wider range"
    )
    return np.where(out, 0.0, 1.0 if weight is None else weight), (note,)


def _noise(record: Record, channel: str, scene: Scene) -> tuple[Autoregression | None, float]:
    """The noise's colour, which the fit has still to find where it is AR(1), and its standard deviation."""
    model, quiet = scene.measurement.noise_model, scene.measurement.quiet
    if model in ("white", "student"):
        return None, record.noise(channel)
    require_uniform(record, model)
    return (
        (Autoregression(np.zeros(1), 1.0), record.noise(channel))
        if quiet is None
        else quiet_noise(record, channel, quiet)
    )


def _log_sd(relative_sd: float) -> float:
    return LogNormal.with_relative_sd(1.0, relative_sd).spread if relative_sd > 0.0 else 0.0


def _trace(
    record: Record, choice: DriveChoice, channel: Channel, label: str, template: RC | WithSkin, noise: NoiseModel
) -> Trace:
    height = float(np.ptp(record[channel]))
    charges = len(LINEAR) - len(CHARGES) + np.arange(len(template.terms().tau) if choice.unknown_charge else 0)
    # a part of a wave cannot show an offset, so one within an oscilloscope's accuracy is allowed for
    offset = _OFFSET * height if record.frequency() is None and choice.periodic else 0.0
    named = channel == "Vsc" and choice.name != "measured"
    steps = frequency_error(record, choice.name) * record.time.size if named else 0.0
    return Trace(
        time=shared(padded(record.time)),
        observed=shared(padded(record[channel])),
        weight=None,
        whitening=None,
        least_noise=jnp.asarray(max(PRECISION * height, rounding_noise(record[channel]))),
        rate=None,
        drive=choice.drive,
        linear_sd=jnp.zeros(len(LINEAR)).at[0].set(offset).at[charges].set(_CHARGE * height),
        shift=jnp.asarray(choice.shift, dtype=float),
        time_step=jnp.asarray(record.time_step, dtype=float),
        clock=jnp.zeros(()),
        timing_sd=jnp.array([_delay_sd(choice), max(_CLOCK, steps)]),
        compression=None,
        label=label,
        channel=channel,
        steady_state=choice.steady_state,
        noise=noise,
        columns=tuple(range(len(LINEAR))),
        # a shifted drive's edges are known to within a step only, which g feels; I's samples there are left out
        timing=("delay",) if choice.shift != 0.0 and channel == "Vsc" else (),
    )


def _hum(record: Record, choice: DriveChoice) -> list[str]:
    """The mains hums that the record can tell from its drive's harmonics, or from a part of a wave."""
    span, frequency = float(record.time[-1] - record.time[0]), record.frequency()

    def apart(hum: float) -> bool:
        if frequency is None:
            return not choice.periodic and hum * span > 2.0
        return abs(hum - frequency * round(hum / frequency)) * span > 0.5

    return [f"hum_{hum:.0f}Hz" for hum in (50.0, 60.0) if apart(hum) and hum * record.time_step < 0.5]


def _edge_time(record: Record, choice: DriveChoice, start: LinearStart) -> float:
    """Where a measured drive jumps within a step, its edge's time is uncertain within it, which acts as a gain."""
    if choice.name != "measured" or not has_unresolved_edge(choice.voltage) or not math.isfinite(start.b):
        return 0.0
    return record.time_step / math.sqrt(12.0) / start.b


def _delay_sd(choice: DriveChoice) -> float:
    """Beside an ideal edge the samples leave the delay open within one step, whose middle is the start."""
    return math.sqrt(1.0 / 12.0) if has_ideal_edges(choice.drive) else 5.0


def _jumps(template: RC | WithSkin, record: Record) -> bool:
    """Whether Vsc follows a jump of V, within the record's time step."""
    return not limits_current(template) or float(constant(template).terms().tau[-1]) < record.time_step


def _largest(template: RC | WithSkin) -> float:
    """The largest divider the circuit can have."""
    return 0.5 if isinstance(constant(template), FinalCircuit) else 1.0


def _start(likelihood: Likelihood, sources: Sequence[Source]) -> Float[np.ndarray, " parameters"]:
    """From the linear fits, where these hold for the circuit; else the best of draws from the prior."""
    starts = [source.start for source in sources]
    vsc = next((start for start in starts if isinstance(start, LinearStart)), None)
    current = next((start for start in starts if isinstance(start, CurrentStart)), None)
    theta = np.concatenate([likelihood.prior.log_mean, np.zeros(len(likelihood.names) - len(likelihood.prior.names))])
    if current is not None and not current.capacitance > 0.0 and isinstance(likelihood.template, WithSkin):
        current = None  # of one frequency, what a constant skin makes of such a current need be no skin
    if vsc is None and current is None:
        return _best_of_prior(likelihood, theta)
    mean, sd = believed_skin(likelihood)
    skin = _skin_of(vsc, current)
    logs = (
        np.log(skin)
        if skin is not None
        else on_the_ridge(np.asarray(vsc.g), np.asarray(vsc.b), mean, sd)
        if vsc is not None
        else mean
    )
    for name, value in zip(("Rsc", "Csc", "Ci"), logs, strict=True):
        if name in likelihood.prior.names:
            theta[likelihood.prior.names.index(name)] = value
    return theta


def _skin_of(vsc: LinearStart | None, current: CurrentStart | None) -> tuple[float, float, float] | None:
    """Rsc, Csc and Ci of a final circuit from what Vsc and I show of it, if those are of one."""
    if current is None or not current.weight > 0.0:
        return None
    if vsc is not None and math.isfinite(vsc.b):
        g, b = vsc
    elif vsc is None and current.capacitance > 0.0:
        # weight = 2 g^2 / Rsc, capacitance = g Csc = b g (1 - 2 g) / Rsc
        ratio = current.weight * current.b / current.capacitance
        g, b = 0.5 * ratio / (1.0 + ratio), current.b
    else:
        return None
    Rsc = 2.0 * g * g / current.weight
    return (Rsc, (1.0 - 2.0 * g) * b / Rsc, g * b / Rsc) if g < 0.5 else None


def believed_skin(likelihood: Likelihood) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of log Rsc, log Csc and log Ci; what is held has next to none."""
    prior, known = likelihood.prior, parameters(likelihood.template)
    pairs = [
        (prior[name].log_mean, prior[name].log_sd) if name in prior.names else (math.log(float(known[name])), _HELD)
        for name in ("Rsc", "Csc", "Ci")
    ]
    mean, sd = np.array(pairs).T
    return mean, sd


def on_the_ridge(
    g: Float[np.ndarray, "*n"], b: Float[np.ndarray, "*n"], mean: np.ndarray, sd: np.ndarray
) -> Float[np.ndarray, "*n 3"]:
    """The most probable points, by the prior, among those with that divider and time constant (s; infinite: unknown).

    They are the line (log Rsc, log Csc, log Ci) = point + t (-1, 1, 1).
    """
    g = np.clip(g, 1e-9, 0.4999)
    b = np.where(np.isfinite(b), b, math.exp(mean[0] + mean[1]))
    ci = math.exp(mean[2])
    point = np.stack([np.log(g * b / ci), np.log((1.0 / g - 2.0) * ci), np.full_like(g, math.log(ci))], axis=-1)
    along, weight = np.array([-1.0, 1.0, 1.0]), sd**-2.0
    return point + along * np.sum(weight * along * (mean - point), axis=-1, keepdims=True) / np.sum(weight)


def _best_of_prior(likelihood: Likelihood, theta: np.ndarray) -> Float[np.ndarray, " parameters"]:
    """The draw of the prior that leaves least of the traces, whatever their noise."""
    points = np.vstack([theta, likelihood.draws(theta, _DRAWS - 1)])
    return points[int(np.argmin(left(likelihood, points)))]


def left(likelihood: Likelihood, points: Float[np.ndarray, "n parameters"]) -> Float[np.ndarray, " n"]:
    """What points leave of the traces, whatever their noise: for comparing one with another."""
    return Batched(_left, likelihood, likelihood.rows)(points)


def _left(likelihood: Likelihood, theta: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, ""]:
    """What is left of the traces: the sum of the logarithms of the residuals' squares, each for its samples."""
    parts = [
        trace.count * jnp.log(jnp.sum(jnp.square(trace.linear(seen, 1e-3 * jnp.ptp(trace.observed))[0])))
        for trace, seen in likelihood.each(theta)
    ]
    return 0.5 * sum(parts, jnp.zeros(()))
