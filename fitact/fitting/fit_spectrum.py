"""Fit an impedance spectrum: the same circuit, between the drive electrode and ground."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Complex, Float

from fitact import summary
from fitact.compiled import jit
from fitact.data.spectrum import Spectrum
from fitact.experiment.fisher import covariance_factor
from fitact.fitting import derived
from fitact.fitting.geometry import UncertainGeometry
from fitact.fitting.identifiability import assess_parameters
from fitact.fitting.laplace import FitResult, Laplace
from fitact.fitting.minimum import Minimum, minimise, result_name
from fitact.fitting.problem import likelihood_without_channels
from fitact.fitting.remarks import describe_assumed_Ci
from fitact.likelihood.likelihood import Likelihood
from fitact.model.skin import circuit_parameters
from fitact.scene.scene import Scene
from fitact.tables import join_lines
from fitact.units import format_engineering, format_percent

_MIN_NOISE = 1e-6  # smallest relative noise of the impedance; no analyser is better


@dataclasses.dataclass(frozen=True)
class SpectrumFit(FitResult):
    """Fit of a circuit to an impedance spectrum.

    Attributes:
        spectrum: the spectrum.
        noise: standard deviation of log |Z|, and of the phase (rad), from the residuals.
        residuals: log(measured / fitted impedance): real part relative size, imaginary part phase (rad).
    """

    spectrum: Spectrum
    noise: float
    residuals: Complex[np.ndarray, " points"]

    @property
    def message(self) -> str:
        """Sentence for the result."""
        if self.result == "misfit":
            return (
                "Poor fit: the residuals of the spectrum are larger than its scatter or correlated; try [skin] level ="
                " 'fractional', or leave out frequencies at which the wiring of the panel contributes."
            )
        return super().message

    @property
    def uses_stated_drive(self) -> bool:
        """True: a spectrum has no drive, so the force is that of the scene's."""
        return True

    def model(self) -> dict[str, Any]:
        """Return the fitted model by name."""
        return {"skin": self.scene.skin.level, "channels": ["impedance"], "force": self.derive.geometry.model}

    def _nuisances(self) -> dict[str, float]:
        return {"relative_noise": self.noise}

    def summary(self) -> str:
        """Return a table for people: estimates with errors, what the force rests on, and the verdict."""
        low, high = (format_engineering(float(f), "Hz") for f in self.spectrum.frequency[[0, -1]])
        content = self.to_dict()
        rows = [
            f"{len(self.spectrum)} points, {low} to {high}",
            *summary.format_table(content),
            f"Noise {format_percent(self.noise)} of |Z|. {self.message}",
            str(self.identifiability),
            *summary.advice_line(content),
        ]
        return join_lines(rows, self.warnings, self.notes)

    __str__ = summary


def fit_spectrum(spectrum: Spectrum, scene: Scene | None = None) -> SpectrumFit:
    """Fit a circuit to an impedance spectrum by Levenberg-Marquardt in log-parameters with their prior.

    Z = 2 Rsc / (1 + j omega Rsc Csc) + 1 / (j omega Ci) for equal fingers with direct ground; the scene may state any
    other circuit and skin. Residuals are differences of log Z (relative size and phase) with one noise for both,
    which is estimated from them. A spectrum determines all three parameters if it reaches from below the corner
    frequency of the skin, 1 / (2 pi Rsc Csc), to above it.

    Args:
        spectrum: impedance spectrum, e.g. from `fitact.read_spectrum`.
        scene: circuit, prior, and the drive for the force; by default the device of the reference paper.

    Raises:
        InputError: the drive of the scene is not periodic, or its prior frees a parameter that no spectrum has.
    """
    stated = scene or Scene()
    stated.require_available(fit=True)
    with jax.enable_x64(True):
        likelihood = likelihood_without_channels(stated, stated.make_prior(), stated.make_circuit)
        derive = derived.derived_from_scene(likelihood, stated)
        end, residuals, sigma = _solve(spectrum, likelihood)
        theta, jacobian = np.asarray(end.theta), np.asarray(end.jacobian)
        root = covariance_factor(jacobian[: -theta.size], likelihood.prior_factor)
        log_derived = derive.log_value_and_grad(theta, np.zeros(0))
        laplace = Laplace(theta, root, np.zeros(0), likelihood, derive, log_derived)
        figures = _figures(residuals, sigma, theta.size) | {"steps": int(end.steps)}
    gradient = laplace.log_gradient("force_mean")
    free = [name for name in likelihood.names if name in circuit_parameters(likelihood.template)]
    result = result_name(end.result)
    if result == "successful" and figures["structure_z"] > 4.0:  # neighbouring residuals are correlated
        result = "misfit"
    assumed = describe_assumed_Ci(scene, likelihood, laplace.prior_sets_Ci)
    return SpectrumFit(
        laplace,
        result=result,
        figures=figures,
        identifiability=assess_parameters(
            likelihood.names, root, likelihood.prior_factor, gradient, free, ("impedance",)
        ),
        scene=stated,
        warnings=assumed.warnings,
        notes=(
            *spectrum.notes,
            *assumed.notes,
            *UncertainGeometry.from_scene(stated, derive.geometry).notes(stated, likelihood, theta),
        ),
        spectrum=spectrum,
        noise=sigma,
        residuals=residuals,
    )


def _solve(spectrum: Spectrum, likelihood: Likelihood) -> tuple[Minimum, Complex[np.ndarray, " points"], float]:
    """Return optimum, residuals and noise; iterates until the noise changes by less than `noise_tolerance`."""
    noise_tolerance, max_rounds = 1e-3, 20
    omega, log_z = jnp.asarray(2.0 * np.pi * spectrum.frequency), jnp.asarray(np.log(spectrum.impedance))
    start, noise = jnp.asarray(_start(spectrum, likelihood)), jnp.asarray(1.0)
    for _ in range(max_rounds):
        before = float(noise)
        end, residuals, noise = _solve_round(likelihood, omega, log_z, noise, start)
        start = end.theta
        if abs(float(noise) / before - 1.0) < noise_tolerance:
            break
    return end, np.asarray(residuals), float(noise)


def _start(spectrum: Spectrum, likelihood: Likelihood) -> Float[np.ndarray, " circuit_parameters"]:
    """Estimate Rsc, Csc and Ci from the best linear fit of 2 Rsc and 1/Ci over many Rsc Csc; others from the prior."""
    omega, z = 2.0 * np.pi * spectrum.frequency, spectrum.impedance
    parts = [np.real, np.imag]
    observed = np.concatenate([part(z / np.abs(z)) for part in parts])
    best = (math.inf, np.ones(2), 1.0)
    for tau in np.geomspace(0.1 / omega[-1], 10.0 / omega[0], num=400):
        columns = [1.0 / (1.0 + 1j * omega * tau), 1.0 / (1j * omega)]
        design = np.stack([np.concatenate([part(c / np.abs(z)) for part in parts]) for c in columns], axis=1)
        # equal column norms limit rounding errors
        size = np.linalg.norm(design, axis=0)
        values, miss = scipy.optimize.nnls(design / size, observed)
        best = min(best, (float(miss), values / size, float(tau)), key=lambda fit: fit[0])
    (twice, elastance), tau = best[1], best[2]
    names, prior = likelihood.names, likelihood.prior
    theta = np.array([prior[name].log_mean for name in names])
    if twice > 0.0 and elastance > 0.0:
        for name, value in {"Rsc": 0.5 * twice, "Csc": 2.0 * tau / twice, "Ci": 1.0 / elastance}.items():
            if name in names:
                theta[names.index(name)] = math.log(value)
    return theta


@jit
def _solve_round(
    likelihood: Likelihood, omega: Array, log_z: Array, noise: Array, start: Array
) -> tuple[Minimum, Complex[Array, " points"], Array]:
    """Return the optimum for a given noise, its residuals, and the noise estimated from them."""

    def log_ratio(theta: Array) -> Array:
        ratio = jnp.exp(log_z) * likelihood.circuit(theta).admittance(omega)
        return jnp.log(jnp.abs(ratio)) + 1j * jnp.angle(ratio)

    def residuals(theta: Array) -> tuple[Array, Array, Array]:
        rest = log_ratio(theta) / noise
        return rest.real, rest.imag, likelihood.prior_residuals(theta)

    end = minimise(residuals, start)
    rest = log_ratio(end.theta)
    freedom = jnp.maximum(2 * omega.size - start.size, 1)
    return end, rest, jnp.maximum(jnp.sqrt(jnp.sum(jnp.abs(rest) ** 2) / freedom), _MIN_NOISE)


def _figures(residuals: Complex[np.ndarray, " points"], noise: float, n_fitted: int) -> dict[str, float]:
    """Compare the residuals with the scatter of neighbouring points, which is independent of the model.

    `structure_z`: von Neumann ratio (mean square successive difference over mean square) of real and imaginary parts
    together, as a z-score for white noise, whose variance is (n - 2) / (n^2 - 1) for half of the ratio.
    """
    n, square = residuals.size, float(np.mean(np.abs(residuals) ** 2))
    successive = 0.5 * float(np.mean(np.abs(np.diff(residuals)) ** 2))
    expected = max(math.sqrt(0.5 * successive), _MIN_NOISE)
    ratio = 1.0 - successive / square if square > (2.0 * _MIN_NOISE) ** 2 else 0.0  # smaller residuals are rounding
    return {
        "chi2_reduced": (noise / expected) ** 2,
        "rms_residual": math.sqrt(0.5 * square),
        "noise_expected": expected,
        "structure_z": ratio * math.sqrt(2.0 * (n * n - 1.0) / (n - 2.0)),
        "samples": n,
        "degrees_of_freedom": 2 * n - n_fitted,
    }
