"""Least squares with optimistix: parameters, covariance, and whether the answer may be trusted."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.data.record import Record
from fitact.inference import derived, summary
from fitact.inference.diagnostics import is_misfit, statistics
from fitact.inference.identifiability import Identifiability, assess
from fitact.inference.likelihood import LINEAR, Likelihood, natural
from fitact.inference.start import DriveChoice, LinearStart, choose_drive, linear_start
from fitact.model.prior import Prior
from fitact.model.scene import Scene
from fitact.units import engineering

_EVIDENCE = 10.0  # a nuisance is freed when it lowers the Bayesian information criterion by this much
_DECREMENT = 1e-3  # how far below the optimum, in log-probability, a fit may end
_IMPLAUSIBLE = 3.0  # prior standard deviations beyond which a parameter is remarked upon


class RESULTS(optx.RESULTS):  # type: ignore[misc]
    """Why a fit ended: optimistix's results, and what else makes an answer untrustworthy."""

    did_not_move = (
        "The fit never left its start although the record asks for another answer; check the units of the record."
    )
    not_at_optimum = "The fit stopped before its optimum; check the units of the record, or give a nearer prior."
    misfit = (
        "The model does not describe the record: its residuals are larger than the noise or have structure;"
        " look at them in the report, and use the drive as measured or a scene that has what is missing."
    )


_BY_NAME = {
    name: getattr(RESULTS, name)
    for name in ("successful", "did_not_move", "not_at_optimum", "misfit", "nonfinite", "nonlinear_max_steps_reached", "nonlinear_divergence")
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Fit:
    """The best parameters, their Laplace approximation, and a judgement.

    Attributes:
        theta: the optimum, in the coordinates `names`.
        covariance: of theta, in the Laplace approximation.
        sigma: standard deviation of Vsc's noise, V, from the residuals.
        linear: the offset, drift and charge that were freed, V, at the optimum.
        residuals: record minus fit, V.
        result: name of a member of `RESULTS`; `message` is its sentence.
        figures: chi2_reduced, rms_residual, noise_expected, runs_z, steps and the like.
        identifiability: what the record can and cannot tell.
        warnings: sentences.
        likelihood, derive, record, scene, choice: what was fitted, to what.
    """

    theta: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    sigma: float
    linear: dict[str, float]
    residuals: Float[np.ndarray, " samples"]
    result: str
    figures: dict[str, float]
    identifiability: Identifiability
    warnings: tuple[str, ...]
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
        return "The fit is at its optimum and leaves only noise." if self.trusted else RESULTS[_BY_NAME[self.result]]

    @property
    def sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of theta."""
        return np.sqrt(np.diag(self.covariance))

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
                out[name] = summary.normal(name, float(values[name]), float(self.sd[i] * self.likelihood.time_step))
            else:
                out[name] = summary.log_normal(name, float(values[name]), float(self.sd[i]))
                out[name]["contraction"] = float(1.0 - self.sd[i] / prior_sd[i])
        return out

    def derived(self) -> dict[str, summary.Summary]:
        """Summaries of divider, time constant, force and friction in the Laplace approximation."""
        values, gradient = _log_derived(self.derive, self.theta, self.sigma)
        sd = np.sqrt(np.einsum("ki,ij,kj->k", gradient, self.covariance, gradient))
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
            "likelihood": "full",
            "compression_error": None,
        }

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
            value, relative = float(s["q50"]), 100.0 * float(s["sd"]) / abs(float(s["mean"]))
            contraction = f"{s['contraction']:14.3f}" if "contraction" in s else ""
            rows.append(f"{name:14}{engineering(value, str(s['unit'])):>12}{relative:10.3g} %{contraction}")
        nuisances = {"noise": self.sigma, **self.linear}
        pairs = [(i, j) for i in range(len(self.names)) for j in range(i)]
        rows += [
            "nuisances: " + ", ".join(f"{name} {engineering(value, 'V')}" for name, value in nuisances.items()),
            "correlations of the logs: "
            + ", ".join(f"{self.names[j]}-{self.names[i]} {self.correlation[i, j]:+.3f}" for i, j in pairs),
            f"reduced chi-square {self.figures['chi2_reduced']:.3f}. {self.message}",
            str(self.identifiability),
        ]
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

    __str__ = summary


def fit(record: Record, scene: Scene | None = None) -> Fit:
    """Fit the final circuit to a record by Levenberg-Marquardt in log-parameters, the prior as residuals.

    The drive is the recorded V where there is no scene or its waveform is "measured", else the scene's.
    The start comes from the record; offset, drift and a delay between the channels are freed where the
    record asks for them, a gain only with the scene's prior. Runs in double precision whatever JAX is set
    to, and leaves that setting alone.

    Raises:
        InputError: the record cannot come from this circuit, or the scene asks for what is not available.
    """
    given = scene or Scene()
    given.require_available()
    with jax.enable_x64(True):
        choice = choose_drive(record, scene)
        start = linear_start(record, choice)
        likelihood = _likelihood(record, choice, given.make_prior())
        solved = _free_by_evidence(likelihood, _on_the_ridge(start, likelihood.prior), record.noise("Vsc"))
        return _judged(solved, record, given, choice, scene is None)


class _Solved(eqx.Module):
    """Where Levenberg-Marquardt ended."""

    likelihood: Likelihood
    start: Float[Array, " parameters"]
    theta: Float[Array, " parameters"]
    sigma: ArrayLike
    result: Any
    steps: ArrayLike
    residuals: Float[Array, " samples"]
    beta: Float[Array, " 3"]
    jacobian: Float[Array, "samples parameters"]
    shapes: Float[Array, "samples 3"]  # of the linear nuisances
    slope: Float[Array, " samples"]  # of the signal in a further delay
    gradient: Float[Array, " parameters"]  # of minus the log-posterior


def _likelihood(record: Record, choice: DriveChoice, prior: Prior) -> Likelihood:
    charge = 10.0 * np.ptp(record["Vsc"]) if choice.unknown_charge else 0.0
    return Likelihood(
        time=jnp.asarray(record.time),
        observed=jnp.asarray(record["Vsc"]),
        drive=choice.drive,
        prior=prior,
        linear_sd=jnp.array([0.0, 0.0, charge]),
        shift=jnp.asarray(choice.shift, dtype=float),
        time_step=jnp.asarray(record.time_step, dtype=float),
        steady_state=choice.steady_state,
        free_delay=False,
    )


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
    return np.append(point, mean[3:])


def _least_squares(likelihood: Likelihood, start: Array, noise: ArrayLike) -> _Solved:
    """Two rounds: with the noise as given, then with that of the residuals."""
    first = _round(likelihood, start, jnp.asarray(noise, dtype=float))
    second = _round(likelihood, first.theta, first.sigma)
    return eqx.tree_at(lambda x: (x.start, x.steps), second, (start, first.steps + second.steps))


@eqx.filter_jit
def _round(likelihood: Likelihood, start: Array, sigma: Array) -> _Solved:
    def residuals(theta: Array, _: None) -> tuple[Array, Array]:
        return likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)

    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    solution = optx.least_squares(residuals, solver, start, max_steps=256, throw=False)
    theta = solution.value
    (of_data, of_prior), (jacobian, prior_jacobian) = residuals(theta, None), jax.jacfwd(residuals)(theta, None)
    remainder, beta, _ = likelihood.linear(theta, sigma)
    later = jnp.zeros(())
    return _Solved(
        likelihood=likelihood,
        start=start,
        theta=theta,
        sigma=jnp.sqrt(jnp.sum(jnp.square(remainder)) / max(remainder.size - start.size, 1)),
        result=RESULTS.promote(solution.result),
        steps=solution.stats["num_steps"],
        residuals=remainder,
        beta=beta,
        jacobian=jacobian,
        shapes=likelihood.shapes(theta),
        slope=jax.jvp(lambda later: likelihood.signal(theta, later), (later,), (jnp.ones_like(later),))[1],
        gradient=jacobian.T @ of_data + prior_jacobian.T @ of_prior,
    )


def _free_by_evidence(likelihood: Likelihood, start: Float[np.ndarray, " parameters"], noise: float) -> _Solved:
    """Fit; then free offset, drift or delay, one at a time, as long as the record asks for one."""
    solved = _least_squares(likelihood, jnp.asarray(start), noise)
    for _ in range(3):
        gains = _evidence(solved)
        name = max(gains, key=gains.__getitem__, default="")
        if not name or not gains[name] > _EVIDENCE:
            break
        theta = solved.theta
        if name == "delay":
            likelihood = eqx.tree_at(lambda x: x.free_delay, likelihood, replace=True)
            theta = jnp.append(theta, 0.0)
        else:
            sd = likelihood.linear_sd.at[LINEAR.index(name)].set(10.0 * jnp.ptp(likelihood.observed))
            likelihood = eqx.tree_at(lambda x: x.linear_sd, likelihood, sd)
        solved = eqx.tree_at(lambda x: x.start, _least_squares(likelihood, theta, solved.sigma), theta)
    return solved


def _evidence(solved: _Solved) -> dict[str, float]:
    """By how much freeing each nuisance would lower the Bayesian information criterion, to first order."""
    size, linear_sd, shapes = solved.residuals.size, np.asarray(solved.likelihood.linear_sd), np.asarray(solved.shapes)
    candidates = {name: shapes[:, i] for i, name in enumerate(LINEAR[:2]) if linear_sd[i] == 0.0}
    if not solved.likelihood.free_delay:
        candidates["delay"] = np.asarray(solved.slope)
    known = np.concatenate([np.asarray(solved.jacobian)[:size], shapes * (linear_sd > 0.0)], axis=1)
    basis, values, _ = np.linalg.svd(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300), full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    residuals = np.asarray(solved.residuals)
    gains = {}
    for name, column in candidates.items():
        column = column - basis @ (basis.T @ column)
        drop = (column @ residuals) ** 2 / max(column @ column, 1e-300)
        share = min(drop / (residuals @ residuals), 1.0 - 1e-12)
        gains[name] = -size * math.log1p(-share) - math.log(size)
    return gains


def _judged(solved: _Solved, record: Record, scene: Scene, choice: DriveChoice, no_scene: bool) -> Fit:
    likelihood, theta, sigma = solved.likelihood, np.asarray(solved.theta), float(solved.sigma)
    jacobian = np.asarray(solved.jacobian)
    fisher = jacobian.T @ jacobian
    prior_sd = np.append(likelihood.prior.log_sd, np.ones(theta.size - len(likelihood.prior.names)))
    covariance = np.linalg.inv(fisher + np.diag(prior_sd**-2.0))
    derive = derived.for_fit(likelihood, record, choice, scene)
    logs, gradient = _log_derived(derive, theta, sigma)
    linear = {
        name: float(beta * sd)
        for name, beta, sd in zip(LINEAR, solved.beta, likelihood.linear_sd, strict=True)
        if sd > 0.0
    }
    divider = float(np.exp(logs[derived.NAMES.index("g")]))
    figures = statistics(np.asarray(solved.residuals), theta.size + len(linear), divider, record, choice)
    figures["steps"] = int(solved.steps)
    identifiability = assess(fisher, likelihood.prior, gradient[derived.NAMES.index("force_mean")])
    return Fit(
        theta=theta,
        covariance=covariance,
        sigma=sigma,
        linear=linear,
        residuals=np.asarray(solved.residuals),
        result=_result(solved, covariance, figures),
        figures=figures,
        identifiability=identifiability,
        warnings=(*record.notes, *choice.notes, *_warnings(theta, likelihood, record, no_scene)),
        likelihood=likelihood,
        derive=derive,
        record=record,
        scene=scene,
        choice=choice,
    )


def _result(solved: _Solved, covariance: Float[np.ndarray, "n n"], figures: dict[str, float]) -> str:
    """The first of the things that stand against the answer."""
    name = next((name for name, item in _BY_NAME.items() if bool(solved.result == item)), "nonfinite")
    if name != "successful":
        return name
    gradient = np.asarray(solved.gradient)
    decrement = 0.5 * gradient @ covariance @ gradient
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


def _warnings(theta: np.ndarray, likelihood: Likelihood, record: Record, no_scene: bool) -> list[str]:
    found = []
    if no_scene:
        found.append(
            "no scene was given: the panel is taken to be the paper's (Ci 1.35 nF ± 5 %), and Rsc, Csc, Ci and the"
            " force scale with that; state your panel's Ci under [device] in a scene file"
        )
    frequency = record.frequency("V" if "V" in record else "Vsc")
    span = record.time[-1] - record.time[0]
    if frequency is None:
        found.append(
            f"the record ({engineering(span, 's')}) does not show its drive repeating: it is shorter than 1.5 periods"
            " or not periodic, so the answer rests on a part of a wave; record two periods or more"
        )
    prior = likelihood.prior
    for name, value, mean, sd in zip(prior.names, theta, prior.log_mean, prior.log_sd, strict=False):
        if abs(value - mean) > _IMPLAUSIBLE * sd:
            found.append(
                f"{name} lies {abs(value - mean) / sd:.1f} prior standard deviations from what was expected;"
                " check probe attenuation (x10), units, and peak against peak-to-peak"
            )
    return found
