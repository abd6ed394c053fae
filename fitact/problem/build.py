"""Construction of the likelihood of records and their scenes, and of the starting point of the fit."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float

from fitact.compiled import MAX_PADDED_LENGTH, as_arrays, pad_samples, pad_weight
from fitact.data.clipping import clipping_mask, describe_clipping
from fitact.data.noise import rounding_noise_sd
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.experiment.blind_directions import STRAY
from fitact.instrument.effects import INPUT_RANGE
from fitact.likelihood import certificate
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.compression import HUM_FREQUENCIES
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import Autoregression, estimate_quiet_noise, require_uniform
from fitact.likelihood.observable import (
    CHARGES,
    FIRST_CHARGE,
    LINEAR_NUISANCES,
    SHORT_TAU,
    DriveTiming,
    ElectricalSignal,
)
from fitact.likelihood.padded_samples import PaddedSamples
from fitact.likelihood.smooth_drive import smooth_drive
from fitact.model.circuit import Channel, Circuit, FinalCircuit, passes_direct_current
from fitact.model.drive import Sampled
from fitact.model.skin import WithSkin, constant_skin_circuit, limits_current
from fitact.prior.distributions import Distribution, LogNormal
from fitact.prior.prior import Prior
from fitact.prior.product import multiply
from fitact.problem.current import (
    estimate_from_current,
    estimate_recorded,
    hum_likeness,
    respond_to,
    select_samples,
)
from fitact.problem.drive_choice import DriveModel, choose_drive, frequency_error, has_ideal_edges, has_unresolved_edge
from fitact.problem.friction import make_friction_channel
from fitact.problem.instrument_errors import (
    ErrorCoordinate,
    Member,
    apply_coordinates,
    collect_coordinates,
    largest_gain,
)
from fitact.problem.limited_current import NoisePath, set_drive
from fitact.problem.recorded_current import Current, RecordedCurrent, set_rows
from fitact.problem.runs import long_run_share
from fitact.problem.skin_model import apply_skin_model, count_harmonics, exclude_jumps, require_skin_response
from fitact.problem.source import Source
from fitact.problem.spectra import build_spectrum_channel
from fitact.problem.starting_point import (
    CurrentEstimate,
    Estimate,
    VscEstimate,
    estimate_from_vsc,
    prior_skin_moments,
    start_from_estimates,
)
from fitact.scene.scene import Scene

NOISE_PRIORS = ("sigma", "sigma_I", "sigma_Ft")
MIN_RELATIVE_NOISE = 1e-9  # least noise sd assumed, relative to the range of the channel


class Problem(NamedTuple):
    """Likelihood over the samples, sources of its channels, starting point, and the errors of instruments."""

    likelihood: Likelihood
    sources: tuple[Source, ...]
    start: Float[np.ndarray, " circuit_parameters"]
    coordinates: tuple[ErrorCoordinate, ...]  # of the errors of instruments
    is_wide: bool = False  # whether tables cover as much as possible around `start`

    def compress_likelihood(self, tolerance: float, full: Mapping[int, str]) -> tuple[Likelihood, tuple[str, ...]]:
        """Return the likelihood with compressed channels, and why each of the others is not compressed, or "".

        `full` are channels that are to remain uncompressed, each with the reason.
        """
        at_start, found = self.likelihood.evaluate_circuit(self.start), []
        for i, channel in enumerate(self.likelihood.channels):
            if channel.compression is not None or i in full:
                found.append((channel, full.get(i, "")))
            else:
                found.append(certificate.compress_channel(channel, at_start, tolerance, is_wide=self.is_wide))
        channels, reasons = zip(*found, strict=True)
        return dataclasses.replace(self.likelihood, channels=channels), reasons

    def exclude_samples(self, channel: int, excluded: Bool[np.ndarray, " samples"]) -> Self:
        """Return the problem in which samples of a channel do not enter the likelihood."""
        remaining = self.likelihood.channels[channel].exclude_samples(excluded)
        return self._replace(likelihood=self.likelihood.replace_channel(channel, remaining))


def build_problem(
    records: Sequence[Record | Spectrum],
    scenes: Sequence[Scene | None],
    use_prior: bool = True,
    drives: Sequence[DriveModel | None] = (),
) -> Problem:
    """Build the problem with the circuit and prior of the first scene, and a drive and nuisances for each record.

    Spectra follow the records. `drives` holds the drives of the first records, if they are already chosen.
    """
    first, in_time = scenes[0] or Scene(), [each for each in records if isinstance(each, Record)]
    prior = first.with_channels(*_channels(in_time[0], scenes[0])).make_prior() if in_time else first.make_prior()
    noise: dict[str, Distribution] = {name: prior[name] for name in NOISE_PRIORS if name in prior.names}

    def make_circuit(values: dict[str, float]) -> Circuit:
        if not in_time:
            return count_harmonics(first.make_circuit(values), first.drive.lowest_frequency)
        return apply_skin_model(first.make_rc_circuit(values), in_time, scenes[: len(in_time)])

    likelihood = likelihood_without_channels(first, prior, make_circuit)
    taus = likelihood.evaluate_circuit(likelihood.prior.log_mean).tau
    sources, members = [], []
    for number, (record, scene, drive) in enumerate(itertools.zip_longest(records, scenes, drives)):
        stated, suffix = scene or Scene(), str(number + 1) * (len(records) > 1)
        if isinstance(record, Spectrum):
            spectrum, source = build_spectrum_channel(record, stated, suffix)
            sources.append(source)
            members.append(Member(spectrum, number, stated, 0.0))
            continue
        choice = drive or choose_drive(record, scene)
        for name in _channels(record, scene):
            channel, source, edge_sd = _build_channel(record, stated, choice, name, suffix, likelihood, taus)
            sources.append(source)
            members.append(Member(channel, number, stated, edge_sd))
    coordinates = collect_coordinates(members)
    channels = tuple(_reserve_effects(apply_coordinates(coordinates, i, each)) for i, each in enumerate(members))
    nuisances = {each.name: each.distribution() for each in coordinates} | _load_priors(scenes)
    likelihood = dataclasses.replace(
        likelihood,
        channels=channels,
        prior=_prior_as_arrays(likelihood.prior.replace_marginals(**nuisances)),
        sigma_prior=tuple(noise.get(f"sigma_{each.letter}".rstrip("_")) for each in channels),
        use_prior=use_prior,
    )
    likelihood = _set_drive_noise(likelihood, likelihood.prior.log_mean, sources)
    start = start_from_estimates(likelihood, [source.start for source in sources])
    return Problem(_set_drive_noise(likelihood, start, sources), tuple(sources), start, coordinates)


def _set_drive_noise(
    likelihood: Likelihood, theta: Float[np.ndarray, " circuit_parameters"], sources: Sequence[Source]
) -> Likelihood:
    """Return the likelihood in which the noise of recorded drives is that in the channels of the circuit at theta."""
    circuit = None
    for i, (channel, source) in enumerate(zip(likelihood.channels, sources, strict=True)):
        if isinstance(channel.observable, ElectricalSignal) and channel.electrical.smooth is not None:
            circuit = circuit or likelihood.evaluate_circuit(theta)
            terms = circuit.terms[channel.channel]
            if channel.channel == "I":
                stray = float(likelihood.stray_capacitance(theta, channel) or 0.0)
                record = source.in_time
                path = NoisePath.from_terms(terms, stray, record.time_step)
                channel = set_drive(channel, path, record, RecordedCurrent.from_record(record).smooth)
            else:
                channel = channel.set_noise_gain(terms)
            likelihood = likelihood.replace_channel(i, channel)
    return likelihood


def _reserve_effects(channel: ChannelLikelihood) -> ChannelLikelihood:
    """Return the channel with effects of instruments that are 0, if there are any."""
    if not channel.effect_sizes:
        return channel
    return channel.replace_samples(effects=np.zeros((len(channel.effect_sizes), channel.samples.time.size)))


def _load_priors(scenes: Sequence[Scene | None]) -> dict[str, Distribution]:
    """Return the priors of the input resistance and capacitance that load the skin."""
    loads = [scene.find_load() if scene else None for scene in scenes]
    if len({None if load is None else load.name for load in loads}) > 1:
        raise InputError(
            "scenes: [instrument] Vsc loads the skin differently in different records; records that are fitted jointly"
            " need the same probe"
        )
    load = loads[0]
    stated = {} if load is None else {"probe_resistance": load.resistance, "probe_capacitance": load.capacitance}
    return {name: multiply([(x, 1.0)]) for name, x in stated.items() if x is not None}


def likelihood_without_channels(scene: Scene, prior: Prior, make_circuit: Callable[..., Any]) -> Likelihood:
    """Return the likelihood of a scene before any record; `make_circuit` builds the circuit from values by name."""
    prior, tied, values = prior.drop_marginals(*NOISE_PRIORS), scene.prior.ties(), scene.fixed_values()
    values |= {name: math.exp(prior[name].log_mean) for name in prior.names}
    for name, (other, ratio) in tied.items():
        value = values.get(other, scene.nominal_values()[other])
        if value is None:
            raise InputError(f"scene: [prior] {name} is tied to {other}, which the scene does not define; define it")
        values[name] = ratio * value
    ties = tuple((name, other, ratio) for name, (other, ratio) in tied.items())
    return Likelihood((), as_arrays(make_circuit(values)), _prior_as_arrays(prior), (), ties)


def _prior_as_arrays(prior: Prior) -> Prior:
    """Return the prior with log-normal marginals as arrays, so that compiled functions serve any; unless correlated."""
    if prior.pairs:
        return prior
    marginals = (as_arrays(m) if isinstance(m, LogNormal) else m for m in prior.marginals)
    return dataclasses.replace(prior, marginals=tuple(marginals))


def _channels(record: Record, scene: Scene | None) -> tuple[Channel, ...]:
    """Return the channels to fit: those of the scene; if none are stated Vsc, or I if there is no Vsc."""
    if scene is None or "channels" not in scene.measurement.model_fields_set:
        return ("I",) if "I" in record and "Vsc" not in record else ("Vsc",)
    return tuple(channel for channel in ("Vsc", "I", "Ft") if channel in scene.measurement.channels)


def _build_channel(
    record: Record,
    scene: Scene,
    choice: DriveModel,
    channel: Channel,
    number: str,
    bare: Likelihood,
    taus: Float[np.ndarray, " time_constants"],
) -> tuple[ChannelLikelihood, Source, float]:
    """Return the likelihood of a channel over its samples, its source, and the sd of log(gain) for unresolved edges.

    `bare` has no channels yet, and `taus` are the time constants (s) of its circuit.
    """
    template = bare.template
    _require_whole_drive(record, choice)
    require_skin_response(template, record, choice)
    label = "_".join(filter(None, ("" if channel == "Vsc" else channel, number)))
    notes, warnings = (*record.notes, *choice.notes), (*record.warnings, *choice.warnings)
    begun = _estimate_channel(record, scene, choice, channel, bare, taus)
    weight, clipped = _weight(record, channel, begun.used)
    weight, at_jumps = exclude_jumps(template, record, choice, weight)
    if weight is None and len(record) <= MAX_PADDED_LENGTH:
        weight = np.ones(len(record))
    weight = None if weight is None else pad_weight(weight)
    has_stray = channel == "I" and (scene.stray_capacitance() > 0.0 or STRAY in bare.prior.names)
    can_smooth = _can_smooth(choice, template)
    is_recorded = channel == "I" and choice.name == "measured"  # its noise contains that of V
    # a current that a resistance limits for most of a step and longer responds like Vsc
    is_long = limits_current(template) and taus[-1] >= SHORT_TAU * record.time_step
    is_limited = is_recorded and can_smooth and is_long
    has_rows = is_recorded and not is_limited
    colour, noise = _noise(record, channel, scene)
    model, skew_sd = scene.measurement.noise_model, 0.0
    if is_recorded:
        if model != "white":
            text = "noise_model is that of Vsc; the noise of I with a recorded V is white, and that of V"
            warnings = (*warnings, text)
        colour, noise, model = None, RecordedCurrent.from_record(record).noise_I, "white"
        skew_sd = scene.delay_sd("I", record.time_step) / record.time_step
    elif channel == "Vsc":
        skew_sd = _skew_sd(record, scene, choice, template)
    # edges of a shifted drive are known only to within a step, which affects g; samples of I there are excluded
    has_delay = channel == "Vsc" or is_limited
    free = ("delay",) if has_delay and (choice.shift != 0.0 or skew_sd > 0.0) else ()
    smooth = smooth_recorded_drive(record) if can_smooth and has_delay else None
    shift, step = (np.asarray(each, dtype=float) for each in (choice.shift, record.time_step))
    timing = DriveTiming(shift, np.zeros(()), step, _timing_sd(record, choice, channel, skew_sd), free)
    # without the samples of an unknown drive, a charge that decays within half a step is over
    n_charges = int(np.count_nonzero(taus > 0.5 * record.time_step)) if free else taus.size
    linear_sd, noise_floor = _prior_of_nuisances(record, choice, scene, channel, n_charges * choice.unknown_charge)
    likelihood = ChannelLikelihood(
        samples=PaddedSamples(
            time=pad_samples(record.time),
            observed=pad_samples(record[channel]),
            weight=weight,
            whitening=colour and colour.whitening(np.ones(len(record), bool) if weight is None else weight > 0.0),
            rate=None if begun.slope is None else pad_samples(begun.slope),
        ),
        observable=ElectricalSignal(choice.drive, timing, channel, choice.steady_state, smooth),
        linear_sd=linear_sd,
        noise_floor=noise_floor,
        label=label,
        noise=model,
        columns=tuple(range(len(LINEAR_NUISANCES))),
        stray=np.asarray(scene.stray_capacitance()) if has_stray else None,
    )
    if channel == "Ft":
        likelihood = make_friction_channel(likelihood, record, scene, choice, template, float(taus[0]))
    if free:
        likelihood = likelihood.exclude_unknown_drive()
    # an offset of the friction would be mistaken for the normal force
    optional = ("drift", *_hum(record, choice), "crosstalk" if channel == "Ft" else "offset")
    if channel == "Vsc":
        may_have_clock = choice.periodic and choice.steady_state and choice.name != "measured"
        optional = (*optional, "delay", *["clock"] * may_have_clock)
    start = begun.start
    if is_limited and not passes_direct_current(template):
        belief = prior_skin_moments(bare)
        resistance = 1.0 / float(bare.evaluate_circuit(bare.prior.log_mean).terms["I"].jump)
        current, stray = RecordedCurrent.from_record(record), scene.stray_capacitance()
        start, _ = estimate_recorded(current, stray, [], belief, resistance)
    if has_rows:
        likelihood, start, hum = _make_charge_rows(likelihood, record, scene, bare, taus)
        optional = ("drift", "offset", *(f"hum_{frequency:.0f}Hz" for frequency in hum))
    remarks = (*notes, *at_jumps), (*warnings, *clipped)
    return likelihood, Source(record, scene, choice, noise, optional, start, *remarks), begun.edge_sd


class _ChannelStart(NamedTuple):
    """Estimates from a channel before its likelihood is made."""

    start: Estimate | None = None
    used: Bool[np.ndarray, " samples"] | None = None  # samples of I that a stated drive predicts
    slope: Float[np.ndarray, " samples"] | None = None  # its dV/dt there, V/s
    edge_sd: float = 0.0  # of log(gain), for rounded V and unresolved edges


def _estimate_channel(
    record: Record,
    scene: Scene,
    choice: DriveModel,
    channel: Channel,
    bare: Likelihood,
    taus: Float[np.ndarray, " time_constants"],
) -> _ChannelStart:
    """Estimate the circuit from a channel, unless its estimate comes with rows of charge."""
    template = bare.template
    edge_sd = 0.0 if choice.name != "measured" or channel == "Ft" else rounded_gain_sd(record)
    if channel == "Vsc" and (not limits_current(template) or taus[-1] < record.time_step):  # Vsc jumps with V
        plain = constant_skin_circuit(template)
        highest = (0.5 if isinstance(plain, FinalCircuit) else 1.0) * largest_gain(scene)
        start = estimate_from_vsc(record, choice, highest, has_leak=passes_direct_current(plain))
        return _ChannelStart(start, edge_sd=math.hypot(edge_sd, _unresolved_gain_sd(record, choice, start)))
    if channel == "I" and choice.name != "measured" and not limits_current(template):
        used, slope = select_samples(record, choice)
        if passes_direct_current(template):  # the start comes from Vsc or from draws of the prior
            return _ChannelStart(None, used, slope, edge_sd)
        estimate = estimate_from_current(record, choice, used, slope, prior_skin_moments(bare))
        return _ChannelStart(estimate, used, slope, edge_sd)
    return _ChannelStart(edge_sd=edge_sd)


def _make_charge_rows(
    channel: ChannelLikelihood,
    record: Record,
    scene: Scene,
    bare: Likelihood,
    taus: Float[np.ndarray, " time_constants"],
    usual_hum: float = 3e-7,  # A: 230 V through 4 pF
) -> tuple[ChannelLikelihood, CurrentEstimate | None, list[float]]:
    """Return the channel of a current with a recorded drive, and an estimate of its circuit.

    Also the frequencies (Hz) of hum that the record shows if it is there. Hum that a circuit may explain has a prior of
    ten times the noise, `usual_hum` at most.
    """
    current, stray = RecordedCurrent.from_record(record), scene.stray_capacitance()
    hum = [frequency for frequency in HUM_FREQUENCIES if hum_likeness(current, frequency) < 0.3]
    estimate, nuisances = estimate_recorded(current, stray, hum, prior_skin_moments(bare))
    linear_sd = channel.linear_sd.copy()
    # a charge that has decayed before the first row is not determined, and must not act on the force
    linear_sd[FIRST_CHARGE : FIRST_CHARGE + taus.size][taus[: len(CHARGES)] < 5.0 * record.time_step] = 0.0
    for i, frequency in enumerate(HUM_FREQUENCIES):
        # a record too short to show one hum cannot tell that of 60 Hz from that of 50 Hz either
        if frequency % 50.0 == 0.0 and frequency not in hum:
            linear_sd[2 * i + 2 : 2 * i + 4] = min(10.0 * current.noise_I, usual_hum)
    modelled = Current(estimate.capacitance + stray, estimate.weight, current.start_delay)
    rows, V = current.make_rows(modelled, respond_to(current, estimate, stray), nuisances)
    timing = dataclasses.replace(channel.timing, free=("delay",))
    # a resistance that limits I for a part of a step only makes it later
    lags = int(np.count_nonzero(taus < SHORT_TAU * record.time_step)) if limits_current(bare.template) else 0
    channel = channel.replace_observable(
        drive=Sampled(channel.samples.time, pad_samples(V)), steady_state=False, timing=timing, lags=lags
    )
    channel = dataclasses.replace(
        channel,
        linear_sd=linear_sd,
        # residuals of runs of equal values are no measure of the noise
        noise_floor=np.asarray(current.noise_I * (1.0 if current.is_coarse else 0.5)),
    )
    usable = (lags > 0 or not limits_current(bare.template)) and not passes_direct_current(bare.template)
    return set_rows(channel, rows, V, current.start_delay * record.time_step), estimate if usable else None, hum


def _can_smooth(choice: DriveModel, template: Circuit) -> bool:
    """Return whether a delay may shift a recorded drive without its noise."""
    return choice.name == "measured" and not choice.steady_state and not isinstance(template, WithSkin)


def smooth_recorded_drive(record: Record) -> Float[np.ndarray, " samples"] | None:
    """Return V as a delay shifts it; None if it has no noise."""
    noise = record.noise("V")
    return pad_samples(smooth_drive(record["V"], noise, record.tones)) if noise else None


def _require_whole_drive(record: Record, choice: DriveModel) -> None:
    """Refuse a clipped measured drive; flat tops without noise are not regarded as clipping."""
    if choice.name != "measured":
        return
    white, rounding = record.noise_parts("V")
    if white == 0.0 or rounding > 0.0:
        return
    count = np.count_nonzero(clipping_mask(record["V"]))
    if count:
        raise InputError(
            f"{record.source}: V_V is clipped at {count:,} of {len(record):,} samples, so the drive is not known;"
            " record it within range, or name the waveform in a scene"
        )


def _weight(record: Record, channel: str, used: np.ndarray | None) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return the weights of the samples, 0 where they are clipped or not `used`, and a sentence on the clipped ones."""
    clipped, weight = clipping_mask(record[channel]), None if used is None else used.astype(float)
    if not clipped.any():
        return weight, ()
    return np.where(clipped, 0.0, 1.0 if weight is None else weight), (describe_clipping(channel, clipped),)


def _noise(record: Record, channel: str, scene: Scene) -> tuple[Autoregression | None, float]:
    """Return the noise model (AR(1) with coefficients not yet fitted; None if white) and the noise sd."""
    model, quiet = scene.measurement.noise_model, scene.measurement.quiet
    if model in ("white", "student"):
        return None, record.noise(channel)
    require_uniform(record, model)
    if quiet is None:
        return Autoregression(np.zeros(1), 1.0), record.noise(channel)
    return estimate_quiet_noise(record, channel, quiet)


def _skew_sd(record: Record, scene: Scene, choice: DriveModel, template: Circuit, min_part: float = 0.01) -> float:
    """Return the prior sd of the delay of Vsc against V in time steps; 0 if it is below `min_part` of a step.

    Skins that depend on the frequency, which have no table with a delay, get one by the BIC only.
    """
    if not scene.states_skew("Vsc") and (choice.name != "measured" or isinstance(template, WithSkin)):
        return 0.0
    sd = scene.delay_sd("Vsc", record.time_step) / record.time_step
    return sd if sd > min_part else 0.0


def _prior_of_nuisances(
    record: Record, choice: DriveModel, scene: Scene, channel: str, n_charges: int
) -> tuple[Float[np.ndarray, " nuisances"], np.ndarray]:
    """Return the prior sds of linear nuisances, and the noise floor."""
    peak_to_peak = float(np.ptp(record[channel]))
    linear_sd = np.zeros(len(LINEAR_NUISANCES))
    linear_sd[FIRST_CHARGE : FIRST_CHARGE + n_charges] = 10.0 * peak_to_peak  # wide
    # a fraction of a period cannot determine an offset, so its prior is the accuracy of an oscilloscope (2 %)
    linear_sd[0] = 0.02 * peak_to_peak if record.frequency() is None and choice.periodic else 0.0
    linear_sd[0] = max(linear_sd[0], INPUT_RANGE * peak_to_peak * scene.offset_limit(channel) / math.sqrt(3.0))
    return linear_sd, np.asarray(max(MIN_RELATIVE_NOISE * peak_to_peak, rounding_noise_sd(record[channel])))


def _timing_sd(record: Record, choice: DriveModel, channel: str, skew_sd: float) -> Float[np.ndarray, "2"]:
    """Return the prior sds of delay and clock, in their units; `skew_sd` is that of a skew, if there is one."""
    # in time steps at the ends of the record; the frequency of the drive is known to one or two steps
    clock_sd = 5.0
    if channel == "Vsc" and choice.name != "measured":
        clock_sd = max(clock_sd, frequency_error(record, choice.name) * record.time.size)
    # samples near an ideal edge determine the delay only to within one step, in the middle of which it starts
    delay_sd = math.sqrt(1.0 / 12.0) if has_ideal_edges(choice.drive) else 5.0
    if skew_sd:
        delay_sd = math.hypot(delay_sd if choice.shift != 0.0 else 0.0, skew_sd)
    return np.array([delay_sd, clock_sd])


def _hum(record: Record, choice: DriveModel) -> list[str]:
    """Return the mains hums that are distinguishable from harmonics of the drive, or from a fraction of its period."""
    span, frequency = float(record.time[-1] - record.time[0]), record.frequency()

    def is_distinguishable(hum: float) -> bool:
        if frequency is None:
            return not choice.periodic and hum * span > 2.0
        return abs(hum - frequency * round(hum / frequency)) * span > 0.5

    frequencies = HUM_FREQUENCIES[:2]
    return [f"hum_{hum:.0f}Hz" for hum in frequencies if is_distinguishable(hum) and hum * record.time_step < 0.5]


def _unresolved_gain_sd(record: Record, choice: DriveModel, start: VscEstimate) -> float:
    """Return the sd of log(gain) that stands for unresolved edges of a measured drive."""
    if choice.name != "measured" or not has_unresolved_edge(record) or not math.isfinite(start.b):
        return 0.0
    return edge_gain_sd(record.time_step, start.b)


def rounded_gain_sd(record: Record, min_part: float = 0.1, least: float = 2e-4) -> float:
    """Return the sd of log(gain) that stands for the rounding of flat levels of V, which their samples share.

    It is 0 if less than `min_part` of the samples have the same value as those around them, and below `least`, which
    is that of 11 bits.
    """
    voltage, (_, rounding) = record["V"], record.noise_parts("V")
    sd = math.sqrt(2.0) * rounding / float(np.ptp(voltage))
    return sd if sd > least and long_run_share(voltage) > min_part else 0.0


def edge_gain_sd(time_step: float, b: Any) -> Any:
    """Return the sd of log(gain) for edges whose time is uncertain by a time step, with the time constant b (s)."""
    return time_step / math.sqrt(12.0) / b
