"""Sources of error behind the coordinates of a fit, for its uncertainty budget."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.fitting.geometry import Contribution
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.instrument.classes import TYPICAL, USUAL_STRAY, typical_gains
from fitact.likelihood.likelihood import Likelihood
from fitact.model.skin import probe_parameters
from fitact.prior.distributions import LogNormal, Uniform
from fitact.problem.instrument_errors import UNRESOLVED_V, ErrorCoordinate, InstrumentError
from fitact.scene.scene import Scene
from fitact.uncertainty.budget import Component
from fitact.uncertainty.effect_size import EffectSizes
from fitact.units import format_engineering

# cheapest ways to reduce an error
_CALIBRATE = "record a dummy circuit of known parts, or both channels on one node, with the same pieces and ranges"
_MEASURE = {
    "Ci": "also record the current I, or measure Ci of this panel at this contact area",
    "probe_resistance": "measure it with an ohmmeter, or record with a second equal probe on and off",
    "probe_capacitance": "measure it, or record with a second equal probe on and off",
    "delay": "sample faster, or record both channels on one node",
    "clock": "record the drive V",
}


def list_error_sources(
    likelihood: Likelihood, coordinates: Sequence[ErrorCoordinate], scene: Scene
) -> tuple[tuple[Component, ...], ...]:
    """Return the sources of error of each coordinate of theta."""
    by_name = {each.name: each for each in coordinates}
    load, plates, sources = scene.find_load(), scene.plates(), []
    loads = () if load is None else probe_parameters(likelihood.template)
    timing_sd = dict(zip(likelihood.timing, map(float, likelihood.timing_sd), strict=True))
    for name in likelihood.names:
        if name in by_name:
            sources.append(tuple(map(_instrument_source, by_name[name].errors)))
            continue
        if name in plates:  # it follows from a geometry, which has sources of its own
            sources.append(())
            continue
        if name in timing_sd:
            remedy = _MEASURE[name.partition("_")[0]]
            sources.append((Component.from_prior(f"prior of the {name}", LogNormal(1.0, timing_sd[name]), remedy),))
            continue
        label, remedy = f"prior of {name}", _MEASURE.get(name, "state a narrower prior, if you know more")
        if load is not None and name in loads:
            label = f"input {name.removeprefix('probe_')} ({load.name})"
        origin = "default Ci" if name == "Ci" and not scene.states_Ci else ""
        component = Component.from_prior(label, likelihood.prior[name], remedy, is_shared=name in loads, origin=origin)
        sources.append((component,))
    return tuple(sources)


def geometry_component(contribution: Contribution) -> Component:
    """Return the component of a thickness, permittivity, area or friction coefficient in a budget."""
    each = contribution
    remedy = "measure it, e.g. by optical coherence tomography" if each.name == "skin_thickness" else "measure it"
    source = f"{summary.describe_quantity(each.name)}{'' if each.stated else ' (default, from the literature)'}"
    size = each.relative_sd, each.sensitivity
    return Component(source, "B", *size, each.distribution, remedy, in_posterior=each.stated, origin=each.origin)


def structure_components(effects: EffectSizes, quantity: str) -> tuple[Component, ...]:
    """Return the components of a quantity that stand for what the model lacks, as far as they are not 0."""
    found = (
        ("structure of the residuals", effects.effect_size.get(quantity, 0.0)),
        ("other causes that fit as well", effects.structure.get(quantity, 0.0)),
    )
    remedy = "see the rivals of the fit, and test the likely one"
    known = None, remedy, False, False, "misfit"  # no distribution, not in the posterior, not shared
    return tuple(Component(name, "B", u, 1.0, *known) for name, u in found if u > 0.0)


class UnstatedError(NamedTuple):
    """A usual error that nobody stated, with its components of the uncertainty of a quantity."""

    source: str
    typical: str  # what is usual
    components: tuple[Component, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return its entry in `not_stated` of fit.json."""
        input_u, u = (math.hypot(*(getattr(each, name) for each in self.components)) for name in ("input_u", "u"))
        return {"source": self.source, "typical": self.typical, "input_u": input_u, "u": u}


def list_unstated_errors(gains: Mapping[str, float], stray: float) -> tuple[UnstatedError, ...]:
    """Return the usual errors that nobody stated, of a quantity.

    `gains`: its sensitivity to the gain of each channel, by channel. `stray`: its relative change by a stray
    capacitance of `USUAL_STRAY`, which any value from 0 to there is taken to be as likely as.
    """
    errors = []
    known = "", False, True  # no advice, beyond the posterior, and the same in all records of a session
    for channel, sensitivity in gains.items():
        components = []
        for name, tolerance in typical_gains(channel).items():
            law, source = Uniform.with_tolerance(1.0, tolerance), f"{channel} gain of a usual {name}, not stated"
            components.append(
                Component(source, "B", float(law.log_sd), sensitivity, law, *known, summary.UNSTATED_GAINS)
            )
        errors.append(UnstatedError(f"{channel} gain", " and ".join(TYPICAL[channel]), tuple(components)))
    if stray:
        typical = f"0 to {format_engineering(USUAL_STRAY, 'F')}"
        source = f"stray capacitance, not stated ({typical})"
        component = Component(source, "B", 3.0**-0.5, stray, None, *known, summary.UNSTATED_STRAY)
        errors.append(UnstatedError("stray capacitance", typical, (component,)))
    return tuple(errors)


def _instrument_source(error: InstrumentError) -> Component:
    is_own = error.source.startswith(UNRESOLVED_V)
    origin = "rounding of V" if is_own else "instruments"
    factor = error.source, error.distribution, _CALIBRATE, error.power
    return Component.from_prior(*factor, is_shared=not is_own, origin=origin)


def noise_information(
    likelihood: Likelihood, solution: LeastSquaresResult
) -> dict[str, Float[np.ndarray, "rows parameters"]]:
    """Return roots of the Fisher information of the noise of all channels of a kind."""
    by_kind: dict[str, list[np.ndarray]] = {}
    for channel, jacobian in zip(likelihood.channels, solution.jacobian, strict=True):
        root = np.asarray(np.linalg.qr(jacobian, mode="r"))
        by_kind.setdefault(f"noise of {summary.describe_channel(channel.letter)}", []).append(root)
    if likelihood.calibration is not None:
        by_kind["calibration record (noise, and tolerances of its parts)"] = [likelihood.calibration_jacobian]
    return {name: np.concatenate(parts) for name, parts in by_kind.items()}


def gain_shifts(
    likelihood: Likelihood, solution: LeastSquaresResult, root: Float[np.ndarray, "parameters parameters"]
) -> dict[str, Float[np.ndarray, " parameters"]]:
    """Return the change of the optimum for a relative error of 1 in the gains of V, Vsc, I and Z, to first order."""
    shifts = {"V": np.zeros(len(root))}
    parts = zip(likelihood.channels, solution.jacobian, solution.signal, solution.sigma, strict=True)
    for channel, jacobian, signal, sigma in parts:
        # the Jacobian is that of data minus model
        shift = -root @ (root.T @ (jacobian[: signal.size].T @ signal)) / sigma
        name = "Z" if channel.channel == "impedance" else channel.channel
        shifts[name] = shifts.get(name, 0.0) + shift
        if name in ("Vsc", "I"):
            shifts["V"] -= shift
        elif name == "Ft" and "force_scale" in likelihood.names:  # its electrostatic part goes with V^2
            column = jacobian[:, likelihood.names.index("force_scale")]
            shifts["V"] -= 2.0 * root @ (root.T @ (jacobian.T @ column))
    return shifts
