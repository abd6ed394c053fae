"""Sources of error behind the coordinates of a fit, for its uncertainty budget."""

from collections.abc import Sequence

from fitact.fitting.gains import GainCoordinate
from fitact.likelihood.likelihood import Likelihood
from fitact.model.skin import probe_parameters
from fitact.prior.distributions import LogNormal
from fitact.scene.scene import Scene
from fitact.uncertainty.budget import ErrorSource

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
    likelihood: Likelihood, gains: Sequence[GainCoordinate], scene: Scene
) -> tuple[tuple[ErrorSource, ...], ...]:
    """Return the sources of error of each coordinate of theta."""
    by_name = {gain.name: gain for gain in gains}
    load, sources = scene.find_load(), []
    timing_sd = dict(zip(likelihood.timing, map(float, likelihood.timing_sd), strict=True))
    for name in likelihood.names:
        if name in by_name:
            errors = by_name[name].errors
            sources.append(tuple(ErrorSource(each.source, each.distribution, _CALIBRATE) for each in errors))
            continue
        if name in timing_sd:
            remedy = _MEASURE[name.partition("_")[0]]
            sources.append((ErrorSource(f"prior of the {name}", LogNormal(1.0, timing_sd[name]), remedy),))
            continue
        label, remedy = f"prior of {name}", _MEASURE.get(name, "state a narrower prior, if you know more")
        if name in probe_parameters(likelihood.template) and load is not None:
            label = f"input {name.removeprefix('probe_')} ({load.name})"
        sources.append((ErrorSource(label, likelihood.prior[name], remedy),))
    return tuple(sources)
