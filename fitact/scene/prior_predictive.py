"""Prior predictive distribution of skin voltage and force for a scene, before any data."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact import summary
from fitact.compiled import double_precision, jit
from fitact.model.circuit import FinalCircuit
from fitact.model.drive import Drive, Periodic, PiecewiseLinear
from fitact.model.force import electrostatic_force, mean_force, peak_force
from fitact.model.response import response
from fitact.scene.scene import Scene
from fitact.tables import align_row
from fitact.units import format_engineering


class PriorPredictive(NamedTuple):
    """Draws from the prior, and the predictions of each draw."""

    parameters: dict[str, Float[np.ndarray, " draws"]]  # free, fixed and tied parameters by name, SI
    derived: dict[str, Float[np.ndarray, " draws"]]  # g, b of the final circuit; Vsc_peak_to_peak, force_mean, ..., SI
    time: Float[np.ndarray, " times"]  # two periods of the steady state, or the scene's duration, s
    Vsc: Float[np.ndarray, "draws times"]
    seed: int  # seed of the draws

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `fitact prior`."""
        return {
            "parameters": {name: summary.summarize_draws(name, draws) for name, draws in self.parameters.items()},
            "derived": {name: summary.summarize_draws(name, draws) for name, draws in self.derived.items()},
            "draws": len(self.Vsc),
            "seed": self.seed,
        }

    def __str__(self) -> str:
        """Return a text table with quantiles of each parameter and derived quantity."""
        rows = [["", "5 %", "25 %", "median", "75 %", "95 %"]]
        content = self.to_dict()
        for name, s in (content["parameters"] | content["derived"]).items():
            quantiles = (float(s[key]) for key in ("q05", "q25", "q50", "q75", "q95"))
            rows.append([name, *(format_engineering(x, str(s["unit"]), 3) for x in quantiles)])
        return "\n".join(align_row(row, [18] + 5 * [12]) for row in rows)


def prior_predictive(scene: Scene, draws: int = 2000, seed: int = 0) -> PriorPredictive:
    """Return Vsc and force for `draws` parameter sets from the scene's prior, without noise."""
    parameters = sample_prior(scene, np.random.default_rng(seed), draws)
    drive = scene.make_drive()
    repeats = isinstance(drive, Periodic) and scene.drive.steady_state
    with double_precision():
        time = jnp.asarray(_times(drive, scene.measurement.duration, repeats))
        circuits = {name: jnp.asarray(x) for name, x in parameters.items() if name not in ("sigma", "sigma_I")}
        vsc, derived = _predict_draws(scene.to_json(), drive, repeats, time, circuits)
    order = ("g", "b", "Vsc_peak_to_peak", "force_mean", "force_peak")
    derived = {name: np.asarray(derived[name]) for name in order if name in derived}
    return PriorPredictive(parameters, derived, np.asarray(time), np.asarray(vsc), seed)


def _times(drive: Drive, duration: float, repeats: bool, count: int = 801) -> Float[np.ndarray, " times"]:
    """Return times over two periods, including corners, where peaks lie; or from rest over the `duration` (s)."""
    if not (repeats and isinstance(drive, Periodic)):
        return np.linspace(0.0, duration, count)
    period = float(drive.period)
    times = np.linspace(0.0, 2.0 * period, count)
    if not isinstance(drive, PiecewiseLinear):
        return times
    corners = (np.asarray(drive.pieces().knots) - float(drive.phase_time) + 1e-9 * period) % period
    return np.union1d(times, corners)


def sample_prior(scene: Scene, rng: np.random.Generator, size: int) -> dict[str, Float[np.ndarray, " size"]]:
    """Return prior draws of all free, fixed and tied parameters of the scene, SI."""
    drawn = scene.make_prior().sample(rng, size)
    drawn |= {name: np.full(size, value) for name, value in scene.fixed_values().items()}
    return drawn | {name: ratio * drawn[other] for name, (other, ratio) in scene.prior.ties().items()}


@jit
def _predict_draws(
    scene: str, drive: Drive, repeats: bool, time: Float[Array, " times"], values: dict[str, Float[Array, " draws"]]
) -> tuple[Float[Array, "draws times"], dict[str, Float[Array, " draws"]]]:
    """Return Vsc over time, and derived quantities, of each draw of a scene (as JSON)."""
    stated = Scene.from_json(scene)

    def predict(values: dict[str, Array]) -> tuple[Array, dict[str, Any]]:
        circuit = stated.make_circuit(values)
        vsc = response(circuit, drive, time, steady_state=repeats)
        contact = stated.geometry().contact(stated.make_rc_circuit(values))
        derived = {"g": circuit.g, "b": circuit.b} if isinstance(circuit, FinalCircuit) else {}
        derived["Vsc_peak_to_peak"] = jnp.ptp(vsc)
        if repeats and stated.skin.level == "constant":
            mean, peak = mean_force(circuit, drive, contact), peak_force(circuit, drive, contact)
        else:
            acting = response(circuit, drive, time, steady_state=repeats, channel=contact.channel)
            force = electrostatic_force(acting, contact)
            mean, peak = jnp.trapezoid(force, time) / time[-1], jnp.max(force)
        return vsc, derived | {"force_mean": mean, "force_peak": peak}

    return jax.lax.map(predict, values, batch_size=100)  # bounds the memory for draws with many harmonics
