"""What a user should know about an answer although nothing stands against it, in sentences."""

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.inference.diagnostics import is_coarse
from fitact.inference.start import DriveChoice
from fitact.model.prior import Prior
from fitact.units import engineering

_IMPLAUSIBLE = 0.005  # share of the prior further out than g or b, below which it is remarked upon


def remarks(
    theta: Float[np.ndarray, " parameters"],
    prior: Prior,
    record: Record,
    choice: DriveChoice,
    figures: dict[str, float],
    no_scene: bool,
) -> list[str]:
    """Sentences; `figures` are those of `fitact.inference.diagnostics`."""
    found = []
    if no_scene:
        found.append(
            "no scene was given: the panel is taken to be the paper's (Ci 1.35 nF ± 5 %), and Rsc, Csc, Ci and the"
            " force scale with that; state your panel's Ci under [device] in a scene file"
        )
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
    for name, factor, tail in _plausibility(theta, prior):
        if tail < _IMPLAUSIBLE:
            found.append(
                f"{name} is {factor:.3g} times what the prior expects (less than {100.0 * _IMPLAUSIBLE:.2g} % of it"
                " lies so far out); check the probe's attenuation (x10), the units of time and voltage, and peak"
                " against peak-to-peak"
            )
    return found


def _plausibility(theta: np.ndarray, prior: Prior) -> list[tuple[str, float, float]]:
    """For g and b, which the record knows: name, ratio to the prior's median, share of the prior further out."""
    believed = prior.sample(np.random.default_rng(0), 10_000)  # for two tail areas, so any seed will do
    r, c, i = np.exp(theta[:3])
    total, expected = 2.0 * i + c, 2.0 * believed["Ci"] + believed["Csc"]
    pairs = {
        "the divider g": (i / total, believed["Ci"] / expected),
        "the time constant b": (r * total, believed["Rsc"] * expected),
    }
    return [
        (name, float(value / np.median(draws)), float(min(np.mean(draws < value), np.mean(draws > value))))
        for name, (value, draws) in pairs.items()
    ]
