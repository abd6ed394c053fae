"""Effects of what the model of a fit lacks: the inputs of `fitact.uncertainty`, and the verdict that follows."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.compiled import double_precision
from fitact.data.spectrum import Spectrum
from fitact.fitting import derived
from fitact.fitting.channel_fit import ChannelFit
from fitact.fitting.laplace import Laplace
from fitact.fitting.least_squares import NUISANCES
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.noise import student_weight
from fitact.likelihood.observable import TIMING_NUISANCES
from fitact.model.skin import circuit_parameters
from fitact.uncertainty.channel_series import ChannelSamples, Timing
from fitact.uncertainty.effect_size import EffectSizes, assess_effects
from fitact.uncertainty.linear_model import LinearPosterior, Nuisance
from fitact.uncertainty.loop import LoopModel
from fitact.uncertainty.rivals import CHANGE, Rival
from fitact.units import format_percent


def assess_fit(
    laplace: Laplace, traces: Sequence[ChannelFit], has_structure: bool, rivals: Sequence[Rival] = ()
) -> EffectSizes | None:
    """Return the effect sizes of a fit; None if they cannot be computed. By default all known rivals are considered."""
    posterior, channels = linear_posterior(laplace), channel_samples(laplace, traces)
    if posterior is None or not channels:
        return None
    added: dict[tuple[str, str], list[int]] = {}
    for i, each in enumerate(channels):
        for name in _added_nuisances(each):
            added.setdefault((each.channel, name), []).append(i)
    groups = [Nuisance(tuple(places), name) for (_, name), places in added.items()]
    try:
        effects = assess_effects(channels, posterior, has_structure, groups, rivals)
    except np.linalg.LinAlgError:
        return None
    return effects if all(map(math.isfinite, effects.effect_size.values())) else None


def linear_posterior(laplace: Laplace) -> LinearPosterior | None:
    """Return what `fitact.uncertainty` needs of a posterior; None for a circuit that it does not know."""
    likelihood = laplace.likelihood
    loop = LoopModel.from_likelihood(likelihood)
    if loop is None:
        return None
    circuit = [name for name in likelihood.prior.names if name in circuit_parameters(likelihood.template)]
    places = [likelihood.names.index(name) for name in circuit]
    gradients = np.concatenate([laplace.log_derived[1], np.eye(laplace.theta.size)[places]])
    names = (*derived.DERIVED_NAMES, *circuit)
    return LinearPosterior(loop, likelihood, laplace.theta, likelihood.prior_factor, names, gradients)


def is_assessed(channel: ChannelLikelihood) -> bool:
    """Return whether effects on a channel are assessed: not on the friction, or a current with a recorded drive."""
    return channel.channel != "Ft" and not channel.samples.has_drive_noise


def channel_samples(laplace: Laplace, traces: Sequence[ChannelFit]) -> list[ChannelSamples]:
    """Return the residuals of all channels, with what is known of their noise and nuisances."""
    with double_precision():
        taus = np.asarray(laplace.likelihood.evaluate_circuit(laplace.theta).tau)
    return [
        _channel_samples(laplace, channel, fitted, taus)
        for channel, fitted in zip(laplace.likelihood.channels, traces, strict=True)
        if is_assessed(channel)
    ]


def _channel_samples(
    laplace: Laplace, channel: ChannelLikelihood, fitted: ChannelFit, taus: Float[np.ndarray, " taus"]
) -> ChannelSamples:
    likelihood, record, choice = laplace.likelihood, fitted.record, fitted.choice
    weight = np.ones(fitted.residuals.size) if fitted.weight is None else fitted.weight
    if channel.noise == "student":
        weight = weight * np.sqrt(np.asarray(student_weight(weight * fitted.residuals / fitted.sigma)))
    suffix = f"_{channel.label}" if channel.label else ""
    linear = {name.removesuffix(suffix): value for name, value in fitted.linear.items()}
    places = {name: place for place, name in enumerate(likelihood.names)}

    def find_places(coordinates: tuple[tuple[str, float], ...]) -> tuple[tuple[int, float], ...]:
        return tuple((places[name], power) for name, power in coordinates)

    rows: dict[str, Any] = {"residuals": fitted.residuals, "weight": weight}
    whitening = channel.samples.whitening
    if isinstance(record, Spectrum):  # real parts, then imaginary parts
        rows = {name: np.concatenate([x[::2], x[1::2]]) for name, x in rows.items()}
        zeros = np.zeros(2 * len(record))
        rows |= {"time": zeros, "voltage": zeros, "frequency": None, "omega": 2.0 * math.pi * record.frequency}
    else:
        frequency = record.frequency() if choice.periodic else None
        smooth = channel.electrical.smooth  # noise of V hides a delay
        voltage = choice.voltage if smooth is None else np.asarray(smooth)[: len(record)]
        rows |= {"time": record.time, "voltage": voltage, "frequency": frequency}
    return ChannelSamples(
        **rows,
        channel=fitted.channel,
        sigma=fitted.sigma,
        noise=fitted.figures["noise_expected"],
        taps=np.ones(1) if whitening is None else np.trim_zeros(np.asarray(whitening.taps), "b"),
        steady_state=choice.steady_state,
        unknown_charge=choice.unknown_charge,
        transient=sum(value for name, value in linear.items() if name.startswith("charge")),
        taus=taus,
        nuisances=linear,
        timing=_free_timing(laplace, channel, choice.shift),
        gains=find_places(channel.gains),
        effects={name: find_places(coordinates) for name, coordinates in channel.effect_sizes},
    )


def _free_timing(laplace: Laplace, channel: ChannelLikelihood, shift: float) -> dict[str, Timing]:
    """Return the free delay and clock of a channel; `shift` (s) is that of the drive before the fit."""
    likelihood, timing = laplace.likelihood, {}
    values, sd = likelihood.to_physical(laplace.theta), dict(zip(likelihood.timing, likelihood.timing_sd, strict=True))
    for name in channel.timing.free:
        key = channel.qualified_name(name)
        total = float(values[key]) - (shift if name == "delay" else 0.0)
        unit = likelihood.timing[key][1]
        is_skew = name == "delay" and channel.observable.follows_samples
        is_expected = is_skew and abs(total) <= 3.0 * float(sd[key]) * unit
        timing[name] = Timing(likelihood.names.index(key), unit, total, is_expected)
    return timing


def _added_nuisances(samples: ChannelSamples) -> list[str]:
    """Return the nuisances of a channel that the data asked for.

    Every channel has an offset, and a skew that its prior expects, which tell nothing.
    """
    added = {name.removesuffix("_cos").removesuffix("_sin") for name in samples.nuisances}
    linear = [group for group in NUISANCES if group in added and group != "offset"]
    timing = samples.timing
    return linear + [name for name in TIMING_NUISANCES if name in timing and not timing[name].is_expected]


def is_tolerable(effects: EffectSizes, laplace: Laplace, force: float, others: float = 0.05) -> bool:
    """Return whether structure can move the mean force by no more than `force`, and all else by no more than `others`.

    Only the divider, the time constant and the parameters that the data determine count.
    """
    from_prior = laplace.variance_from_prior(np.eye(laplace.theta.size))
    determined = [n for n, part in zip(laplace.likelihood.names, from_prior, strict=True) if part < 0.5]
    sizes = effects.effect_size
    return sizes["force_mean"] <= force and all(sizes.get(n, 0.0) <= others for n in ("g", "b", *determined))


def describe_structure(result: str, message: str, effects: EffectSizes, negligible: float = 1e-5) -> str:
    """Return the sentence for residuals that are more than noise, with what they look like and may move."""
    sizes = {name: effects.effect_size.get(name, 0.0) for name in ("g", "b", "force_mean")}
    if max(sizes.values()) < negligible:
        return message
    moved = " and ".join(
        f"{name.replace('force_mean', 'the mean force')} by {format_percent(float(f'{size:.1g}'))}"
        for name, size in sizes.items()
        if size >= negligible
    )
    like = f" (like {' or '.join(effects.causes)})" if effects.causes else ""
    found = f"the residuals show structure{like}; it could move {moved}.{_advise_track(effects)}"
    return f"{message} {found[0].upper()}{found[1:]}" if result == "misfit" else f"{found[0].upper()}{found[1:]}"


def is_change_of_finger(effects: EffectSizes, min_part: float = 0.5) -> bool:
    """Return whether a finger that changes during the record explains at least `min_part` as much as the best cause."""
    changes = (each["delta_chi2"] for each in effects.rivals if each["name"].startswith(CHANGE))
    return any(change >= min_part * effects.rivals[0]["delta_chi2"] for change in changes)


def _advise_track(effects: EffectSizes, min_explained: float = 0.6) -> str:
    """Return a sentence on a finger that changes during the record, if that is the best explanation.

    It names what changes, and by how much, if that explains at least `min_explained` of the residuals' power.
    """
    best = effects.rivals[0] if effects.rivals else None
    if best is None or not best["name"].startswith(CHANGE):
        return ""
    if best["explained"] < min_explained:
        return " The finger may change during the record: use track."
    change = math.expm1(2.0 * best["amplitudes"][0])
    what = best["name"].removeprefix(CHANGE)
    direction = "falls" if change < 0.0 else "rises"
    return f" {what[0].upper()}{what[1:]} {direction} by {format_percent(abs(change))} during the record: use track."


def describe_alternatives(effects: EffectSizes, laplace: Laplace, min_ratio: float = 0.5) -> tuple[str, ...]:
    """Return a note on each added nuisance whose alternatives move a result by `min_ratio` of its error or more."""
    if not effects.alternatives:
        return ()
    sd = dict(zip(derived.DERIVED_NAMES, laplace.derived_log_sd, strict=True))
    moved = [name for name in ("g", "b", "force_mean") if effects.structure[name] > min_ratio * sd[name]]
    if not moved:
        return ()
    sizes = " and ".join(
        f"{name.replace('force_mean', 'the mean force')} by {format_percent(float(f'{effects.structure[name]:.1g}'))}"
        for name in moved
    )
    return tuple(
        f"the {name} that was added may as well be {' or '.join(others)}; this could move {sizes}"
        for name, others in effects.alternatives.items()
    )
