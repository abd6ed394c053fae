"""Fit a record: parameters, their covariance, and whether the answer may be trusted."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.inference import compressed, derived, summary
from fitact.inference.diagnostics import is_misfit, statistics
from fitact.inference.identifiability import Identifiability, assess, covariance_root
from fitact.inference.least_squares import Solved, result_message, result_name, solve
from fitact.inference.likelihood import CHARGE, LINEAR, Likelihood, natural
from fitact.inference.remarks import remarks
from fitact.inference.start import (
    DriveChoice,
    LinearStart,
    choose_drive,
    has_ideal_edges,
    has_unresolved_edge,
    linear_start,
)
from fitact.model.prior import LogNormal, Prior
from fitact.model.scene import Scene
from fitact.units import engineering

_DECREMENT = 1e-3  # how far below the optimum, in log-probability, a fit may end
_OFFSET = 0.02  # of Vsc's span: standard deviation of an offset that the record is too short to show


@dataclasses.dataclass(frozen=True)
class Fit:
    """The best parameters, their Laplace approximation, and a judgement.

    Attributes:
        theta: the optimum, in the coordinates `names`.
        covariance_root: its product with its transpose is `covariance`; keeps digits where that cannot.
        sigma: standard deviation of Vsc's noise, V, from the residuals.
        linear: the offset, drift, hum and charge that were freed, V, at the optimum.
        residuals: record minus fit, V.
        result: name of a member of `RESULTS`; `message` is its sentence.
        figures: chi2_reduced, rms_residual, noise_expected, runs_z, steps and the like.
        identifiability: what the record can and cannot tell.
        warnings: sentences.
        compression_error: of the compressed log-likelihood near the optimum; None: the samples are summed.
        full_because: why they are, as a clause.
        likelihood, derive, record, scene, choice: what was fitted, to what.
    """

    theta: Float[np.ndarray, " parameters"]
    covariance_root: Float[np.ndarray, "parameters parameters"]
    sigma: float
    linear: dict[str, float]
    residuals: Float[np.ndarray, " samples"]
    result: str
    figures: dict[str, float]
    identifiability: Identifiability
    warnings: tuple[str, ...]
    compression_error: float | None
    full_because: str
    likelihood: Likelihood
    derive: derived.Derived
    record: Record
    scene: Scene
    choice: DriveChoice

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates of theta: logarithms, and the delay in time steps."""
        return self.likelihood.names

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer."""
        return self.result == "successful"

    @property
    def message(self) -> str:
        """The result as a sentence."""
        return "The fit is at its optimum and leaves only noise." if self.trusted else result_message(self.result)

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of theta, in the Laplace approximation."""
        return self.covariance_root @ self.covariance_root.T

    @property
    def sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of theta."""
        return np.linalg.norm(self.covariance_root, axis=1)

    @property
    def point_names(self) -> tuple[str, ...]:
        """Coordinates of the posterior: those of theta, and sigma, in logarithms but for the delay."""
        return (*self.names, "sigma")

    @property
    def point(self) -> Float[np.ndarray, " coordinates"]:
        """The optimum in the coordinates of the posterior."""
        return np.append(self.theta, math.log(self.sigma))

    @property
    def point_root(self) -> Float[np.ndarray, "coordinates coordinates"]:
        """As `covariance_root`, in the coordinates of the posterior; sigma's from its degrees of freedom."""
        size = self.theta.size + 1
        root = np.zeros((size, size))
        root[:-1, :-1] = self.covariance_root
        root[-1, -1] = math.sqrt(0.5 / self.figures["degrees_of_freedom"])
        return root

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlations of theta."""
        return self.covariance / np.outer(self.sd, self.sd)

    def parameters(self) -> dict[str, summary.Summary]:
        """Summaries of the parameters in the Laplace approximation, with their contraction."""
        values, prior_sd = natural(self.likelihood, self.theta), self.likelihood.prior.log_sd
        out = {}
        for i, name in enumerate(self.names):
            if name == "delay":
                out[name] = summary.normal(
                    name, float(values[name]), float(self.sd[i]) * float(self.likelihood.time_step)
                )
            else:
                out[name] = summary.log_normal(name, float(values[name]), float(self.sd[i]))
                out[name]["contraction"] = float(1.0 - self.sd[i] / prior_sd[i])
        return out

    def derived(self) -> dict[str, summary.Summary]:
        """Summaries of divider, time constant, force and friction in the Laplace approximation."""
        values, gradient = _log_derived(self.derive, self.theta, self.sigma)
        sd = np.linalg.norm(gradient @ self.covariance_root, axis=1)
        return {
            name: summary.log_normal(name, math.exp(value), float(s))
            for name, value, s in zip(derived.NAMES, values, sd, strict=True)
        }

    def model(self) -> dict[str, Any]:
        """What was fitted, by name."""
        return {
            "circuit": "final",
            "skin": "constant",
            "response": "exact",
            "drive": self.choice.name,
            "steady_state": self.choice.steady_state,
            "freed": [*self.linear, *self.names[3:]],
            "likelihood": "full" if self.compression_error is None else "compressed",
            "compression_error": self.compression_error,
            "full_because": self.full_because,
        }

    def _likelihood(self) -> str:
        if self.compression_error is None:
            return f"summed over the samples each time, since {self.full_because}"
        return f"compressed to {self.likelihood.rows} numbers, off by {self.compression_error:.1g} at most"

    def to_dict(self) -> dict[str, Any]:
        """What `fitact fit --json` prints and fit.json holds."""
        fitted = {"result": self.result, "message": self.message, "misfit": self.result == "misfit"}
        nuisances = {"sigma": self.sigma, **self.linear}
        return {
            "parameters": self.parameters(),
            "derived": self.derived(),
            "nuisances": {name: {"unit": "V", "value": value} for name, value in nuisances.items()},
            "correlation": {"names": list(self.names), "matrix": self.correlation.tolist()},
            "identifiability": self.identifiability.to_dict(),
            "fit": fitted | self.figures,
            "model": self.model(),
            "warnings": list(self.warnings),
        }

    def summary(self) -> str:
        """A table for people: values with errors, correlations, the verdict."""
        rows = [f"{'':14}{'median':>12}{'± 1 sd':>12}{'contraction':>14}"]
        for name, s in (self.parameters() | self.derived()).items():
            median = engineering(float(s["q50"]), str(s["unit"]))
            contraction = f"{s['contraction']:14.3f}" if "contraction" in s else ""
            rows.append(f"{name:14}{median:>12}{summary.width(s):>12}{contraction}")
        nuisances = {"noise": self.sigma, **self.linear}
        pairs = [(i, j) for i in range(len(self.names)) for j in range(i)]
        rows += [
            "nuisances: " + ", ".join(f"{name} {engineering(value, 'V')}" for name, value in nuisances.items()),
            "correlations of the logs: "
            + ", ".join(f"{self.names[j]}-{self.names[i]} {self.correlation[i, j]:+.3f}" for i, j in pairs),
            f"reduced chi-square {self.figures['chi2_reduced']:.3f}. {self.message}",
            f"log-likelihood: {self._likelihood()}.",
            str(self.identifiability),
        ]
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

    __str__ = summary


def fit(record: Record, scene: Scene | None = None, *, tolerance: float = compressed.TOLERANCE) -> Fit:
    """Fit the final circuit to a record by Levenberg-Marquardt in log-parameters, the prior as residuals.

    The drive is the recorded V where there is no scene or its waveform is "measured", else the scene's.
    The start comes from the record; offset, drift, hum of the mains and a delay between the channels are freed
    where the record asks for them, a gain only with the scene's prior. Runs in double precision whatever JAX is
    set to, and leaves that setting alone.

    Args:
        record: with Vsc, and V unless the scene has the drive.
        scene: the device, and what is believed of it.
        tolerance: error of the log-likelihood that compressing the record may cause; 0: sum over the samples
            each time. Where compression does not hold, `Fit.full_because` says why.

    Raises:
        InputError: the record cannot come from this circuit, the scene asks for what is not available, or the
            tolerance is no number of 0 or more.
    """
    given = scene or Scene()
    given.require_available(fit=True)
    if not 0.0 <= tolerance < math.inf:
        raise InputError(f"tolerance = {tolerance}: give an error of the log-likelihood, 0.001 or so, or 0 for none")
    with jax.enable_x64(True):
        choice = choose_drive(record, scene)
        prior = given.make_prior()
        largest = 0.5 if prior.gain is None else 0.5 * math.exp(3.0 * prior.gain.spread)
        start = linear_start(record, choice, largest)
        likelihood = _likelihood(record, choice, _with_edge_time(prior, record, choice, start))
        ridge = _on_the_ridge(start, likelihood.prior)
        theta = np.append(ridge, 0.0) if likelihood.free_delay else ridge
        noise, freeable = record.noise("Vsc"), ("offset", "drift", "delay", *_hum(record, choice))
        try:
            projected, reason = compressed.project(likelihood, start, tolerance)
            solved = solve(projected, theta, noise, freeable)
            certified = _certified(solved, reason, tolerance)
            if certified.error is None and solved.likelihood.compression is not None:
                solved = solve(likelihood, theta, noise, freeable)
                certified = _certified(solved, certified.reason, tolerance)
            return _judged(solved, certified, record, given, choice, scene is None)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"{record.source}: Vsc and V cannot be computed with ({error}); check for a huge offset or a wrong unit"
            ) from error


def _certified(solved: Solved, reason: str, tolerance: float) -> compressed.Certified:
    root = covariance_root(np.asarray(solved.jacobian), solved.likelihood.prior_sd)
    return compressed.certify(solved.likelihood, reason, np.asarray(solved.theta), root, float(solved.sigma), tolerance)


def _hum(record: Record, choice: DriveChoice) -> list[str]:
    """The mains hums that the record can tell from its drive's harmonics, or from a part of a wave."""
    span, frequency = float(record.time[-1] - record.time[0]), record.frequency()

    def apart(hum: float) -> bool:
        if frequency is None:
            return not choice.periodic and hum * span > 2.0
        return abs(hum - frequency * round(hum / frequency)) * span > 0.5

    return [f"hum_{hum:.0f}Hz" for hum in (50.0, 60.0) if apart(hum) and hum * record.time_step < 0.5]


def _likelihood(record: Record, choice: DriveChoice, prior: Prior) -> Likelihood:
    height = float(np.ptp(record["Vsc"]))
    charge = 10.0 * height if choice.unknown_charge else 0.0
    # a part of a wave cannot show an offset, so one within an oscilloscope's accuracy is allowed for
    offset = _OFFSET * height if record.frequency() is None and choice.periodic else 0.0
    return Likelihood(
        time=jnp.asarray(record.time),
        observed=jnp.asarray(record["Vsc"]),
        drive=choice.drive,
        prior=prior,
        linear_sd=jnp.zeros(len(LINEAR)).at[0].set(offset).at[CHARGE].set(charge),
        shift=jnp.asarray(choice.shift, dtype=float),
        time_step=jnp.asarray(record.time_step, dtype=float),
        delay_sd=jnp.asarray(_delay_sd(choice), dtype=float),
        compression=None,
        steady_state=choice.steady_state,
        columns=tuple(range(len(LINEAR))),
        free_delay=choice.shift != 0.0,  # then the edges are known to within a step only, which g feels
    )


def _with_edge_time(prior: Prior, record: Record, choice: DriveChoice, start: LinearStart) -> Prior:
    """Where a measured drive jumps within a step, its edge's time is uncertain within it, which acts as a gain."""
    if choice.name != "measured" or not has_unresolved_edge(choice.voltage) or not math.isfinite(start.b):
        return prior
    spread = record.time_step / math.sqrt(12.0) / start.b
    known = 0.0 if prior.gain is None else prior.gain.spread
    return dataclasses.replace(prior, gain=LogNormal(1.0, math.hypot(spread, known)))


def _delay_sd(choice: DriveChoice) -> float:
    """Beside an ideal edge the samples leave the delay open within one step, whose middle is the start."""
    return math.sqrt(1.0 / 12.0) if has_ideal_edges(choice.drive) else 5.0


def _on_the_ridge(start: LinearStart, prior: Prior) -> Float[np.ndarray, " parameters"]:
    """The most probable point, by the prior, among those with the start's g and b.

    They are the line (log Rsc, log Csc, log Ci) = point + t (-1, 1, 1).
    """
    mean, sd = prior.log_mean, prior.log_sd
    g = np.clip(start.g, 1e-9, 0.4999)
    b = start.b if np.isfinite(start.b) else math.exp(mean[0] + mean[1])
    ci = math.exp(mean[2])
    point = np.array([math.log(g * b / ci), math.log((1.0 / g - 2.0) * ci), math.log(ci)])
    along, weight = np.array([-1.0, 1.0, 1.0]), sd[:3] ** -2.0
    point = point + along * np.sum(weight * along * (mean[:3] - point)) / np.sum(weight)
    return np.append(point, mean[3:])  # a gain starts from its prior


def _judged(
    solved: Solved,
    certified: compressed.Certified,
    record: Record,
    scene: Scene,
    choice: DriveChoice,
    no_scene: bool,
) -> Fit:
    likelihood, theta, sigma = certified.likelihood, np.asarray(solved.theta), float(solved.sigma)
    jacobian, prior_sd = np.asarray(solved.jacobian), likelihood.prior_sd
    root = covariance_root(jacobian, prior_sd)
    derive = derived.for_fit(likelihood, record, choice, scene, float(likelihood.circuit(theta).b))
    logs, gradient = _log_derived(derive, theta, sigma)
    residuals, beta = (
        np.asarray(x) for x in _over_samples(dataclasses.replace(likelihood, compression=None), theta, sigma)
    )
    linear = {
        LINEAR[column]: float(value * likelihood.linear_sd[column])
        for column, value in zip(likelihood.columns, beta, strict=True)
    }
    divider = float(np.exp(logs[derived.NAMES.index("g")]))
    figures = statistics(residuals, theta.size + len(linear), divider, record, choice)
    figures["steps"] = int(solved.steps)
    identifiability = assess(jacobian, root, likelihood.prior, prior_sd, gradient[derived.NAMES.index("force_mean")])
    return Fit(
        theta=theta,
        covariance_root=root,
        sigma=sigma,
        linear=linear,
        residuals=residuals,
        result=_result(solved, root, figures),
        figures=figures,
        identifiability=identifiability,
        warnings=(*record.notes, *choice.notes, *remarks(theta, likelihood.prior, record, choice, figures, no_scene)),
        compression_error=certified.error,
        full_because=certified.reason,
        likelihood=likelihood,
        derive=derive,
        record=record,
        scene=scene,
        choice=choice,
    )


@eqx.filter_jit
def _over_samples(likelihood: Likelihood, theta: Array, sigma: ArrayLike) -> tuple[Array, Array]:
    """What is left of the record, and the linear nuisances in prior standard deviations."""
    return likelihood.linear(theta, sigma)[:2]


def _result(solved: Solved, root: Float[np.ndarray, "n n"], figures: dict[str, float]) -> str:
    """The first of the things that stand against the answer."""
    name = result_name(solved.result)
    if name != "successful":
        return name
    decrement = 0.5 * float(np.sum((root.T @ np.asarray(solved.gradient)) ** 2))
    if not decrement < _DECREMENT:
        return "did_not_move" if np.array_equal(solved.theta, solved.start) else "not_at_optimum"
    return "misfit" if is_misfit(figures) else "successful"


@eqx.filter_jit
def _log_derived_jit(derive: derived.Derived, theta: Array, sigma: ArrayLike) -> tuple[Array, Array]:
    def logs(theta: Array) -> Array:
        return jnp.log(derive(theta, sigma))

    return logs(theta), jax.jacfwd(logs)(theta)


def _log_derived(derive: derived.Derived, theta: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the derived quantities, and their gradients in theta."""
    with jax.enable_x64(True):
        values, gradient = _log_derived_jit(derive, jnp.asarray(theta), jnp.asarray(sigma))
        return np.asarray(values), np.asarray(gradient)
