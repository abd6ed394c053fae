"""Warnings and notes about a fit that is otherwise reliable, in sentences."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float

from fitact.data.plausibility import check_plausibility, insulator_voltage
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.data.spectrum import Spectrum
from fitact.fitting.derived import DERIVED_NAMES
from fitact.fitting.laplace import Laplace
from fitact.fitting.profile import compare_with_normal
from fitact.fitting.residual_statistics import is_undersampled
from fitact.inspection.inspection import check_divider
from fitact.instrument.classes import USUAL_STRAY
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.model.circuit import FINGER_PARAMETERS, RC
from fitact.model.skin import constant_skin_circuit
from fitact.problem.drive_choice import DriveModel
from fitact.problem.source import Source
from fitact.problem.starting_point import CurrentEstimate, skin_from_estimates
from fitact.scene.scene import Scene
from fitact.units import format_engineering, format_percent, quantity_unit


def channel_warnings(record: Record, choice: DriveModel, channel: str, figures: dict[str, float]) -> list[str]:
    """Return warnings about one channel; `figures` are from `fitact.fitting.residual_statistics`."""
    warnings = (
        check_divider({name: record[name] for name in ("V", "Vsc")}) if "V" in record and channel == "Vsc" else []
    )
    span = record.time[-1] - record.time[0]
    if record.frequency() is None and choice.periodic:
        warnings.append(
            f"the drive does not repeat within the record ({format_engineering(span, 's')}): the record is shorter than"
            " 1.5 periods or not periodic, so the fit uses only a part of a wave; record two periods or more"
        )
    if is_undersampled(figures):
        warnings.append(
            "V_V is sampled too coarsely to be interpolated (its error in Vsc is"
            f" {format_engineering(figures['interpolation_error'], 'V')}); record faster, or state the waveform in a"
            " scene"
        )
    if figures.get("within_steps", 0.0) > 0.0:
        warnings.append(
            "I spends half of the time within a step of its converter, which tells little of it between edges; amplify"
            " it (its edges may then be clipped), or make the edges of V slower"
        )
    if figures.get("rounding_V", 0.0) > 0.0:
        warnings.append(
            "V_V is rounded to steps larger than its noise; if the fit of I is poor, this is the likely cause: record V"
            " with a smaller range or more bits"
        )
    if figures["rounding_noise"] > 0.0:
        warnings.append(
            f"{channel} is rounded to steps larger than its noise, so the rounding errors are correlated and the stated"
            " standard errors may be wrong by half; record with a smaller range"
        )
    if figures.get("quiet_noise", 0.0) > 3.0 * figures["rms_residual"]:  # more than noise can be
        unit = CHANNEL_UNITS[channel]
        quiet, residual = (format_engineering(figures[name], unit) for name in ("quiet_noise", "rms_residual"))
        warnings.append(
            f"[measurement] quiet contains more than noise: {channel} varies by {quiet} rms there, but the residuals"
            f" are {residual} rms, so the stated errors are too large; choose an interval before the drive starts"
        )
    return warnings + outlier_warnings(channel, figures)


def outlier_warnings(channel: str, figures: dict[str, float]) -> list[str]:
    """Return a warning if samples of a channel are outliers."""
    if not (count := int(figures["outliers"])):
        return []
    which = f"1 sample of {channel} is an outlier" if count == 1 else f"{count} samples of {channel} are outliers"
    return [
        f"{which} for Gaussian noise, the first at"
        f" {format_engineering(figures['first_outlier'], 's')}; [measurement] noise_model = 'student' reduces their"
        " weight"
    ]


def parameter_warnings(likelihood: Likelihood, theta: Float[np.ndarray, " parameters"]) -> list[str]:
    """Return warnings about g and b far from the prior."""
    min_tail = 0.005  # least prior probability further out
    points = np.vstack([theta, likelihood.sample_prior(theta, 2_000, circuit_only=True)])
    warnings = []
    for name, x in zip(("the divider g", "the time constant b"), likelihood.evaluate_g_and_b(points), strict=True):
        fitted, prior = x[0], x[1:]
        if np.ptp(x) > 0.0 and min(np.mean(prior < fitted), np.mean(prior > fitted)) < min_tail:
            warnings.append(
                f"{name} is {fitted / np.median(prior):.3g} times the prior median (prior tail probability below"
                f" {format_percent(min_tail)}); check the probe attenuation (10x), the units of time and voltage, and"
                " peak versus peak-to-peak"
            )
    return warnings


def skewness_warnings(laplace: Laplace, least_sd: float = 0.2, least_share: float = 0.8) -> list[str]:
    """Return a warning if b is known less than its standard error says, towards long or short ones.

    That is possible if it is uncertain by `least_sd` or more: a record may tell no more than that b is long.
    """
    sd = laplace.derived_log_sd[DERIVED_NAMES.index("b")]
    if not sd > least_sd or any(channel.compression is None for channel in laplace.likelihood.channels):
        return []
    roots = compare_with_normal(laplace, "b", z=3.0)
    return [
        f"the time constant b may be much {way} than its standard error of {format_percent(float(sd))} says: three of"
        f" these count as {root:.1f}; sample the posterior, or see the intervals of the fit"
        for way, root in zip(("shorter", "longer"), roots, strict=True)
        if root < 3.0 * least_share
    ]


def plausibility_warnings(
    record: Record | Spectrum, scene: Scene, choice: DriveModel, optimum: CircuitValues, force_peak: float
) -> list[str]:
    """Return a warning if the drive, the contact area, the insulator's field or the force (N) is implausible."""
    peak, insulator_peak = float(np.max(np.abs(choice.voltage))), math.nan
    if "I" in optimum.terms:
        if isinstance(record, Spectrum):
            frequency = scene.drive.lowest_frequency
        else:
            frequency = record.frequency() or 1.0 / float(record.time[-1] - record.time[0])
        circuit = cast(RC, constant_skin_circuit(optimum.circuit))
        insulator_peak = insulator_voltage(peak, optimum.terms["I"], circuit, frequency)
    return check_plausibility(scene, peak, insulator_peak, force_peak)


def prior_warnings(
    likelihood: Likelihood,
    theta: Float[np.ndarray, " parameters"],
    sd: Float[np.ndarray, " parameters"],
    instruments: Collection[str],
    max_pull: float = 3.0,
) -> list[str]:
    """Return warnings about coordinates that the data put far from their prior, such as errors of `instruments`.

    The skin's parameters have `parameter_warnings`, and the scale of the force is what is measured. `sd` are the
    standard errors. A pull is the distance from the middle of the prior over its standard deviation, the root of the
    difference of prior and posterior variance.
    """
    warnings = []
    parts = set(likelihood.prior.names) - {*FINGER_PARAMETERS, "force_scale"} if likelihood.use_prior else set()
    checked = parts.union(instruments)
    for name in (each for each in likelihood.names if each in checked):
        place, marginal = likelihood.names.index(name), likelihood.prior[name]
        value, spread = float(theta[place]), float(marginal.log_sd)
        learned = math.sqrt(max(spread**2 - float(sd[place]) ** 2, 1e-4 * spread**2))
        pull = (value - float(marginal.log_mean)) / learned
        if abs(pull) > max_pull:
            found = format_engineering(math.exp(value), quantity_unit(name))
            if name in instruments:
                prior = "what the stated instruments allow"
                remedy = (
                    "check the scale of the channels, the attenuation of probes, and the classes under [instrument]"
                )
            else:
                prior, remedy = "its prior", f"check [prior] {name}, and that the circuit and its parts are as stated"
            warnings.append(
                f"the data put {name} at {found}, {abs(pull):.1f} standard deviations from {prior}; {remedy}"
            )
    return warnings


class Remarks(NamedTuple):
    """Sentences for information, and on what may change the result."""

    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def unfitted_channel_notes(record: Record, fitted: Collection[str]) -> list[str]:
    """Return notes about the recorded channels, other than V, that are not among the `fitted` ones."""
    return [
        f"{record.source}: {name} is recorded but not fitted; to use it, add it to [measurement] channels"
        for name in record.channels
        if name not in ("V", *fitted)
    ]


def has_unstated_stray(sources: Sequence[Source], channels: Sequence[str]) -> bool:
    """Return whether a fitted current was taken in the drive lead, and nobody stated the stray capacitance there."""
    return any(
        channel == "I"
        and not source.scene.states_stray_capacitance()
        and source.scene.measurement.current_lead != "ground"
        for source, channel in zip(sources, channels, strict=True)
    )


def estimate_stray_changes(channels: Collection[str], optimum: CircuitValues) -> dict[str, float]:
    """Return the relative change of Rsc, Csc and Ci by a stray capacitance of `USUAL_STRAY`, with V and I alone.

    It is empty for other channels, and for circuits with more than one time constant.
    """
    terms = optimum.terms.get("I")
    if set(channels) != {"I"} or terms is None or terms.rate is None or len(terms.tau) != 1 or terms.direct is not None:
        return {}
    parts = float(terms.weight[0]), float(terms.tau[0])
    now, then = (skin_from_estimates(None, CurrentEstimate(*parts, float(terms.rate) - C)) for C in (0.0, USUAL_STRAY))
    if now is None or then is None:
        return {}
    return {name: b / a - 1.0 for name, a, b in zip(FINGER_PARAMETERS, now, then, strict=True)}


def stray_note(changes: Mapping[str, float]) -> str:
    """Return a note on a stray capacitance that nobody stated; `changes` as of `estimate_stray_changes`."""
    shown = ", ".join(f"{name} by {100.0 * change:+.2g} %" for name, change in changes.items())
    shift = f"; {format_engineering(USUAL_STRAY, 'F')} would change {shown}" if changes else ""
    return (
        "I in the drive lead contains the current of the stray capacitance of panel and cable, which the scene does not"
        f" state{shift}; state [measurement] stray_capacitance, or take I in the ground lead (current_lead = 'ground')"
    )


def describe_assumed_Ci(scene: Scene | None, likelihood: Likelihood, prior_sets_Ci: bool) -> Remarks:
    """Describe a Ci that nobody stated: in a warning if its prior sets results, otherwise in a note."""
    if (scene is not None and scene.states_Ci) or not likelihood.use_prior or "Ci" not in likelihood.names:
        return Remarks()
    prior = likelihood.prior["Ci"]
    factor = math.exp(1.96 * float(prior.log_sd))
    spread = f"± {format_percent(float(prior.log_sd))}" if factor < 2.0 else f"within a factor of {factor:.2g}"
    value = f"{format_engineering(math.exp(prior.log_mean), 'F')} {spread}"
    subject = "no scene was given" if scene is None else "the scene does not state Ci"
    assumed = f"{subject}, so the insulator of the reference paper is assumed (Ci = {value})"
    if not prior_sets_Ci:
        return Remarks(notes=(f"{assumed}; the data determine Ci, so this assumption hardly matters",))
    return Remarks(
        warnings=(
            f"{assumed}; Rsc, Csc, Ci and the force depend on it: state Ci for your panel and contact under [prior]",
        )
    )
