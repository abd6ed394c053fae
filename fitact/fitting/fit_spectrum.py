"""Fit an impedance spectrum: the same circuit, seen between the drive's electrode and ground."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Complex, Float

from fitact import summary
from fitact.data.spectrum import Spectrum
from fitact.experiment.fisher import covariance_factor
from fitact.fitting import derived
from fitact.fitting.identifiability import assess_parameters
from fitact.fitting.laplace import FitResult, Laplace
from fitact.fitting.levenberg_marquardt import Minimum, minimise, result_name
from fitact.fitting.problem import likelihood_without_channels
from fitact.likelihood.likelihood import Likelihood
from fitact.model.skin import circuit_parameters
from fitact.scene.scene import Scene
from fitact.tables import join_lines
from fitact.units import format_engineering, format_percent

_MIN_NOISE = 1e-6  # of the impedance: no analyser is better


@dataclasses.dataclass(frozen=True)
class SpectrumFit(FitResult):
    """The parameters that an impedance spectrum shows, and a judgement.

    Attributes:
        spectrum: what was fitted.
        noise: standard deviation of the logarithm of |Z|, and of its phase (rad), by what is left.
        residuals: log of measured over fitted impedance: relative size and, imaginary, phase (rad).
    """

    spectrum: Spectrum
    noise: float
    residuals: Complex[np.ndarray, " points"]

    @property
    def message(self) -> str:
        """The result as a sentence."""
        if self.result == "misfit":
            return (
                "The circuit does not describe the spectrum: what is left is larger than its scatter or has structure;"
                " try [skin] level = 'fractional', or leave out frequencies where the panel's own wiring shows."
            )
        return super().message

    def model(self) -> dict[str, Any]:
        """What was fitted, by name."""
        return {"skin": self.scene.skin.level, "channels": ["impedance"], "force": self.derive.geometry.model}

    def _nuisances(self) -> dict[str, float]:
        return {"relative_noise": self.noise}

    def summary(self) -> str:
        """A table for people: values with errors, the verdict."""
        low, high = (format_engineering(float(f), "Hz") for f in self.spectrum.frequency[[0, -1]])
        rows = [
            f"{len(self.spectrum)} points, {low} to {high}",
            *self._align_table(14, 12, 12),
            f"noise {format_percent(self.noise)} of |Z|. {self.message}",
            f"force: {summary.FORCE_DESCRIPTIONS[self.derive.geometry.model]}, under the scene's"
            f" {self.scene.drive.waveform}.",
            str(self.identifiability),
        ]
        return join_lines(rows, self.warnings)

    __str__ = summary


def fit_spectrum(spectrum: Spectrum, scene: Scene | None = None) -> SpectrumFit:
    """Fit a circuit to an impedance spectrum by Levenberg-Marquardt in log-parameters with their prior.

    Z = 2 Rsc / (1 + j omega Rsc Csc) + 1 / (j omega Ci) for the paper's final circuit; any circuit and skin that a
    scene states. Differences are those of log Z, of relative size and phase, with one noise for both, which is
    found from what is left. The spectrum alone shows all three parameters where it reaches from below the skin's
    corner 1 / (2 pi Rsc Csc) to above it.

    Args:
        spectrum: as of `fitact.read_spectrum`.
        scene: circuit, prior, and the drive that makes the force; absent: the paper's.

    Raises:
        InputError: the scene's drive is no periodic one, or its prior frees what no spectrum has.
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
    if result == "successful" and figures["structure_z"] > 4.0:  # neighbouring residuals are alike by no chance
        result = "misfit"
    notes = ("no scene was given: the force is that of the paper's panel and drive; state yours in a scene file",)
    return SpectrumFit(
        laplace,
        result=result,
        figures=figures,
        identifiability=assess_parameters(
            likelihood.names, root, likelihood.prior_factor, gradient, free, ("impedance",)
        ),
        scene=stated,
        warnings=(*spectrum.notes, *(notes if scene is None else ())),
        spectrum=spectrum,
        noise=sigma,
        residuals=residuals,
    )


def _solve(
    spectrum: Spectrum, likelihood: Likelihood, noise_tolerance: float = 1e-3, max_rounds: int = 20
) -> tuple[Minimum, Complex[np.ndarray, " points"], float]:
    """The optimum, its residuals and their noise, in rounds until that changes by less than `noise_tolerance`."""
    omega, log_z = jnp.asarray(2.0 * np.pi * spectrum.frequency), jnp.asarray(np.log(spectrum.impedance))
    start, noise = jnp.asarray(_start(spectrum, likelihood)), jnp.asarray(1.0)
    for _ in range(max_rounds):
        before = float(noise)
        end, residuals, noise = _solve_round(likelihood, omega, log_z, noise, start)
        start = end.theta
        if abs(float(noise) / before - 1.0) < noise_tolerance:
            break
    return end, np.asarray(residuals), float(noise)


def _start(
    spectrum: Spectrum, likelihood: Likelihood, n_time_constants: int = 400
) -> Float[np.ndarray, " circuit_parameters"]:
    """Rsc, Csc and Ci from linear fits of 2 Rsc and 1 / Ci at many Rsc Csc, of which the best; the others' prior."""
    omega, z = 2.0 * np.pi * spectrum.frequency, spectrum.impedance
    parts = [np.real, np.imag]
    observed = np.concatenate([part(z / np.abs(z)) for part in parts])
    best = (math.inf, np.ones(2), 1.0)
    for tau in np.geomspace(0.1 / omega[-1], 10.0 / omega[0], n_time_constants):
        columns = [1.0 / (1.0 + 1j * omega * tau), 1.0 / (1j * omega)]
        design = np.stack([np.concatenate([part(c / np.abs(z)) for part in parts]) for c in columns], axis=1)
        # columns of like size, so that neither's rounding is the other's
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


@eqx.filter_jit
def _solve_round(
    likelihood: Likelihood, omega: Array, log_z: Array, noise: Array, start: Array
) -> tuple[Minimum, Complex[Array, " points"], Array]:
    """The optimum under a noise, what is left there, and the noise that this shows."""

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
    """Against the scatter of neighbouring points, which no model made.

    `structure_z` is von Neumann's ratio of the mean square successive difference to the mean square, in standard
    deviations of that of white noise (variance (n - 2) / (n^2 - 1) of half of it), of both parts together.
    """
    n, square = residuals.size, float(np.mean(np.abs(residuals) ** 2))
    successive = 0.5 * float(np.mean(np.abs(np.diff(residuals)) ** 2))
    expected = max(math.sqrt(0.5 * successive), _MIN_NOISE)
    ratio = 1.0 - successive / square if square > (2.0 * _MIN_NOISE) ** 2 else 0.0  # else it is rounding
    return {
        "chi2_reduced": (noise / expected) ** 2,
        "rms_residual": math.sqrt(0.5 * square),
        "noise_expected": expected,
        "structure_z": ratio * math.sqrt(2.0 * (n * n - 1.0) / (n - 2.0)),
        "samples": n,
        "degrees_of_freedom": 2 * n - n_fitted,
    }
