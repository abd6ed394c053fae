"""What a user should know about an answer although nothing stands against it, in sentences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.data.inspection import check_divider
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.residual_statistics import is_undersampled
from fitact.likelihood.likelihood import Likelihood
from fitact.units import format_engineering, format_percent


def channel_warnings(record: Record, choice: DriveModel, channel: str, figures: dict[str, float]) -> list[str]:
    """Sentences about one channel; `figures` are those of `fitact.fitting.residual_statistics`."""
    found = check_divider({name: record[name] for name in ("V", "Vsc")}) if "V" in record and channel == "Vsc" else []
    span = record.time[-1] - record.time[0]
    if record.frequency() is None and choice.periodic:
        found.append(
            f"the record ({format_engineering(span, 's')}) does not show its drive repeating: it is shorter than 1.5"
            " periods or not periodic, so the answer rests on a part of a wave; record two periods or more"
        )
    if is_undersampled(figures):
        found.append(
            "V_V is sampled too coarsely for straight lines between its samples (they err by"
            f" {format_engineering(figures['interpolation_error'], 'V')} in Vsc); record faster, or name the"
            " waveform in a scene"
        )
    if figures["rounding_noise"] > 0.0:
        found.append(
            f"{channel} is rounded to steps wider than its noise, so its errors are not independent and those stated"
            " may be off by half; record with a finer range"
        )
    if figures.get("quiet_noise", 0.0) > 3.0 * figures["rms_residual"]:  # more than noise can be
        unit = CHANNEL_UNITS[channel]
        there, left = (format_engineering(figures[name], unit) for name in ("quiet_noise", "rms_residual"))
        found.append(
            f"[measurement] quiet holds more than noise: {channel} varies by {there} in it, and the fit leaves {left},"
            " so the errors stated are too wide; choose a stretch before the drive starts"
        )
    if figures["outliers"]:
        found.append(
            f"{figures['outliers']:.0f} samples of {channel} lie further from the fit than normal noise would bring"
            f" them, the first at {format_engineering(figures['first_outlier'], 's')}; [measurement] noise_model ="
            " 'student' lets outliers count less"
        )
    return found


def parameter_warnings(
    likelihood: Likelihood, theta: Float[np.ndarray, " parameters"], no_scene: bool, min_tail: float = 0.005
) -> list[str]:
    """Sentences about the answer where less than `min_tail` of the prior lies further out."""
    found = []
    if no_scene:
        found.append(
            "no scene was given: the panel is taken to be the paper's (Ci 1.35 nF ± 5 %), and Rsc, Csc, Ci and the"
            " force scale with that; state your panel's Ci under [device] in a scene file"
        )
    for name, factor, tail in _plausibility(likelihood, theta):
        if tail < min_tail:
            found.append(
                f"{name} is {factor:.3g} times what the prior expects (less than {format_percent(min_tail)} of it"
                " lies so far out); check the probe's attenuation (x10), the units of time and voltage, and peak"
                " against peak-to-peak"
            )
    return found


def _plausibility(likelihood: Likelihood, theta: np.ndarray) -> list[tuple[str, float, float]]:
    """For g and b, which the record knows: name, ratio to the prior's median, share of the prior further out."""
    points = np.vstack([theta, likelihood.sample_prior(theta, 10_000)])
    g, b = (np.asarray(x) for x in _divider(dataclasses.replace(likelihood, channels=()), jnp.asarray(points)))
    return [
        (name, float(x[0] / np.median(x[1:])), float(min(np.mean(x[1:] < x[0]), np.mean(x[1:] > x[0]))))
        for name, x in (("the divider g", g), ("the time constant b", b))
        if np.ptp(x) > 0.0
    ]


@eqx.filter_jit
def _divider(likelihood: Likelihood, theta: Float[Array, "n parameters"]) -> tuple[Array, Array]:
    circuits = jax.vmap(likelihood.circuit)(theta)
    return jax.vmap(lambda circuit: circuit.g)(circuits), jax.vmap(lambda circuit: circuit.b)(circuits)
