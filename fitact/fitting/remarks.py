"""What a user should know about an answer although nothing stands against it, in sentences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.data.checks import check_divider
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.fitting.drive_choice import DriveChoice
from fitact.fitting.residual_statistics import is_coarse
from fitact.likelihood.likelihood import Likelihood
from fitact.units import engineering, percent

_DRAWS = 10_000
_RESTLESS = 3.0  # times what a fit leaves: noise of the quiet stretch that must hold more than noise
_IMPLAUSIBLE = 0.005  # share of the prior further out than g or b, below which it is remarked upon


def on_trace(record: Record, choice: DriveChoice, channel: str, figures: dict[str, float]) -> list[str]:
    """Of one trace; `figures` are those of `fitact.fitting.residual_statistics`."""
    found = check_divider({name: record[name] for name in ("V", "Vsc")}) if "V" in record and channel == "Vsc" else []
    span = record.time[-1] - record.time[0]
    if record.frequency() is None and choice.periodic:
        found.append(
            f"the record ({engineering(span, 's')}) does not show its drive repeating: it is shorter than 1.5 periods"
            " or not periodic, so the answer rests on a part of a wave; record two periods or more"
        )
    if is_coarse(figures):
        found.append(
            "V_V is sampled too coarsely for straight lines between its samples (they err by"
            f" {engineering(figures['interpolation_error'], 'V')} in Vsc); record faster, or name the"
            " waveform in a scene"
        )
    if figures["rounding_noise"] > 0.0:
        found.append(
            f"{channel} is rounded to steps wider than its noise, so its errors are not independent and those stated"
            " may be off by half; record with a finer range"
        )
    if figures.get("quiet_noise", 0.0) > _RESTLESS * figures["rms_residual"]:
        there, left = (engineering(figures[name], CHANNEL_UNITS[channel]) for name in ("quiet_noise", "rms_residual"))
        found.append(
            f"[measurement] quiet holds more than noise: {channel} varies by {there} in it, and the fit leaves {left},"
            " so the errors stated are too wide; choose a stretch before the drive starts"
        )
    if figures["outliers"]:
        found.append(
            f"{figures['outliers']:.0f} samples of {channel} lie further from the fit than normal noise would bring"
            f" them, the first at {engineering(figures['first_outlier'], 's')}; [measurement] noise_model = 'student'"
            " lets outliers count less"
        )
    return found


def on_parameters(likelihood: Likelihood, theta: Float[np.ndarray, " parameters"], no_scene: bool) -> list[str]:
    """Of the answer, against what was believed."""
    found = []
    if no_scene:
        found.append(
            "no scene was given: the panel is taken to be the paper's (Ci 1.35 nF ± 5 %), and Rsc, Csc, Ci and the"
            " force scale with that; state your panel's Ci under [device] in a scene file"
        )
    for name, factor, tail in _plausibility(likelihood, theta):
        if tail < _IMPLAUSIBLE:
            found.append(
                f"{name} is {factor:.3g} times what the prior expects (less than {percent(_IMPLAUSIBLE)} of it"
                " lies so far out); check the probe's attenuation (x10), the units of time and voltage, and peak"
                " against peak-to-peak"
            )
    return found


def _plausibility(likelihood: Likelihood, theta: np.ndarray) -> list[tuple[str, float, float]]:
    """For g and b, which the record knows: name, ratio to the prior's median, share of the prior further out."""
    points = np.vstack([theta, likelihood.draws(theta, _DRAWS)])
    g, b = (np.asarray(x) for x in _divider(dataclasses.replace(likelihood, traces=()), jnp.asarray(points)))
    return [
        (name, float(x[0] / np.median(x[1:])), float(min(np.mean(x[1:] < x[0]), np.mean(x[1:] > x[0]))))
        for name, x in (("the divider g", g), ("the time constant b", b))
        if np.ptp(x) > 0.0
    ]


@eqx.filter_jit
def _divider(likelihood: Likelihood, theta: Float[Array, "n parameters"]) -> tuple[Array, Array]:
    circuits = jax.vmap(likelihood.circuit)(theta)
    return jax.vmap(lambda circuit: circuit.g)(circuits), jax.vmap(lambda circuit: circuit.b)(circuits)
