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
from fitact.experiment.fisher import covariance_root
from fitact.fitting import derived
from fitact.fitting.drive_choice import as_arrays
from fitact.fitting.identifiability import Identifiability, judge
from fitact.fitting.laplace import Laplace
from fitact.fitting.levenberg_marquardt import Minimum, minimise, result_message, result_name
from fitact.fitting.problem import circuit_values, compiled_once
from fitact.likelihood.likelihood import Likelihood
from fitact.model.skin import parameters
from fitact.scene.scene import Scene
from fitact.units import engineering, percent

_LEAST = 1e-6  # of the impedance: no analyser is better
_SETTLED, _ROUNDS = 1e-3, 20
_TAUS = 400  # time constants of the skin that are tried
_STRUCTURED = 4.0  # standard deviations, beyond which neighbouring residuals are alike by no chance


@dataclasses.dataclass(frozen=True)
class SpectrumFit(Laplace):
    """The parameters that an impedance spectrum shows, and a judgement.

    Attributes:
        spectrum: what was fitted.
        noise: standard deviation of the logarithm of |Z|, and of its phase (rad), by what is left.
        residuals: log of measured over fitted impedance: relative size and, imaginary, phase (rad).
        result: name of a member of `RESULTS`; `message` is its sentence.
        figures: chi2_reduced, structure_z and the like.
        identifiability: what the spectrum can and cannot tell.
        scene: whose circuit and prior were fitted, and whose drive makes the force.
        warnings: sentences.
    """

    spectrum: Spectrum
    noise: float
    residuals: Complex[np.ndarray, " points"]
    result: str
    figures: dict[str, float]
    identifiability: Identifiability
    scene: Scene
    warnings: tuple[str, ...]

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer."""
        return self.result == "successful"

    @property
    def message(self) -> str:
        """The result as a sentence."""
        if self.result == "misfit":
            return (
                "The circuit does not describe the spectrum: what is left is larger than its scatter or has structure;"
                " try [skin] level = 'fractional', or leave out frequencies where the panel's own wiring shows."
            )
        return "The fit is at its optimum and leaves only noise." if self.trusted else result_message(self.result)

    def to_dict(self) -> dict[str, Any]:
        """What `fitact fit --json` prints for a spectrum, and fit.json holds."""
        judged = {"result": self.result, "message": self.message, "misfit": self.result == "misfit"}
        return {
            "parameters": self.parameters(),
            "derived": self.derived(),
            "nuisances": {"relative_noise": {"unit": "1", "value": self.noise}},
            "correlation": {"names": list(self.names), "matrix": self.correlation.tolist()},
            "identifiability": self.identifiability.to_dict(),
            "fit": judged | self.figures,
            "model": {"skin": self.scene.skin.level, "channels": ["impedance"], "force": self.derive.geometry.model},
            "warnings": list(self.warnings),
        }

    def summary(self) -> str:
        """A table for people: values with errors, the verdict."""
        low, high = (engineering(float(f), "Hz") for f in self.spectrum.frequency[[0, -1]])
        rows = [f"{len(self.spectrum)} points, {low} to {high}", f"{'':14}{'median':>12}{'± 1 sd':>12}"]
        for name, s in (self.parameters() | self.derived()).items():
            rows.append(f"{name:14}{engineering(float(s['q50']), str(s['unit'])):>12}{summary.width(s):>12}")
        rows += [
            f"noise {percent(self.noise)} of |Z|. {self.message}",
            f"force: {summary.BY_FORCE[self.derive.geometry.model]}, under the scene's {self.scene.drive.waveform}.",
            str(self.identifiability),
        ]
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

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
    given = scene or Scene()
    given.require_available(fit=True)
    with jax.enable_x64(True):
        likelihood = _posed(given)
        derive = derived.for_scene(likelihood, given)
        omega, log_z = jnp.asarray(2.0 * np.pi * spectrum.frequency), jnp.asarray(np.log(spectrum.impedance))
        noise, found = jnp.asarray(1.0), None
        start = jnp.asarray(_start(spectrum, likelihood))
        for _ in range(_ROUNDS):
            before = float(noise)
            found, left, noise = _round(likelihood, omega, log_z, noise, start)
            start = found.theta
            if abs(float(noise) / before - 1.0) < _SETTLED:
                break
        assert found is not None
        theta, residuals, sigma = np.asarray(found.theta), np.asarray(left), float(noise)
        root = covariance_root(np.asarray(found.jacobian)[: -theta.size], likelihood.prior_root)
        figures = _figures(residuals, sigma, theta.size) | {"steps": int(found.steps)}
        _, gradient = derive.logs(theta, np.zeros(0))
    result = result_name(found.result)
    if result == "successful" and figures["structure_z"] > _STRUCTURED:
        result = "misfit"
    return SpectrumFit(
        theta=theta,
        covariance_root=root,
        likelihood=likelihood,
        derive=derive,
        spectrum=spectrum,
        noise=sigma,
        residuals=residuals,
        result=result,
        figures=figures,
        identifiability=_seen(likelihood, root, gradient[derived.NAMES.index("force_mean")]),
        scene=given,
        warnings=(*spectrum.notes, *_warnings(scene)),
    )


def _posed(scene: Scene) -> Likelihood:
    """The scene's circuit and prior, without traces."""
    prior, tied = scene.make_prior().without("sigma", "sigma_I"), scene.prior.tied()
    template: Any = scene.make_circuit(circuit_values(scene, prior, tied))
    return Likelihood(
        traces=(),
        template=as_arrays(template),
        prior=compiled_once(prior),
        sigma_prior=(),
        tied=tuple((name, other, ratio) for name, (other, ratio) in tied.items()),
    )


def _start(spectrum: Spectrum, likelihood: Likelihood) -> Float[np.ndarray, " parameters"]:
    """Rsc, Csc and Ci from linear fits of 2 Rsc and 1 / Ci at many Rsc Csc, of which the best; the others' prior."""
    omega, z = 2.0 * np.pi * spectrum.frequency, spectrum.impedance
    parts = [np.real, np.imag]
    observed = np.concatenate([part(z / np.abs(z)) for part in parts])
    best = (math.inf, np.ones(2), 1.0)
    for tau in np.geomspace(0.1 / omega[-1], 10.0 / omega[0], _TAUS):
        columns = [1.0 / (1.0 + 1j * omega * tau), 1.0 / (1j * omega)]
        design = np.stack([np.concatenate([part(c / np.abs(z)) for part in parts]) for c in columns], axis=1)
        # columns of like size, so that neither's rounding is the other's
        size = np.linalg.norm(design, axis=0)
        values, miss = scipy.optimize.nnls(design / size, observed)
        best = min(best, (float(miss), values / size, float(tau)), key=lambda found: found[0])
    (twice, elastance), tau = best[1], best[2]
    names, prior = likelihood.names, likelihood.prior
    theta = np.array([prior[name].log_mean for name in names])
    if twice > 0.0 and elastance > 0.0:
        for name, value in {"Rsc": 0.5 * twice, "Csc": 2.0 * tau / twice, "Ci": 1.0 / elastance}.items():
            if name in names:
                theta[names.index(name)] = math.log(value)
    return theta


@eqx.filter_jit
def _round(
    likelihood: Likelihood, omega: Array, log_z: Array, noise: Array, start: Array
) -> tuple[Minimum, Complex[Array, " points"], Array]:
    """The optimum under a noise, what is left there, and the noise that this shows."""

    def left(theta: Array) -> Array:
        ratio = jnp.exp(log_z) * likelihood.circuit(theta).admittance(omega)
        return jnp.log(jnp.abs(ratio)) + 1j * jnp.angle(ratio)

    def residuals(theta: Array) -> tuple[Array, Array, Array]:
        rest = left(theta) / noise
        return rest.real, rest.imag, likelihood.prior_residuals(theta)

    found = minimise(residuals, start)
    rest = left(found.theta)
    freedom = jnp.maximum(2 * omega.size - start.size, 1)
    return found, rest, jnp.maximum(jnp.sqrt(jnp.sum(jnp.abs(rest) ** 2) / freedom), _LEAST)


def _figures(residuals: Complex[np.ndarray, " points"], noise: float, used: int) -> dict[str, float]:
    """Against the scatter of neighbouring points, which no model made.

    `structure_z` is von Neumann's ratio of the mean square successive difference to the mean square, in standard
    deviations of that of white noise (variance (n - 2) / (n^2 - 1) of half of it), of both parts together.
    """
    n, square = residuals.size, float(np.mean(np.abs(residuals) ** 2))
    successive = 0.5 * float(np.mean(np.abs(np.diff(residuals)) ** 2))
    expected = max(math.sqrt(0.5 * successive), _LEAST)
    ratio = 1.0 - successive / square if square > (2.0 * _LEAST) ** 2 else 0.0  # else it is rounding
    return {
        "chi2_reduced": (noise / expected) ** 2,
        "rms_residual": math.sqrt(0.5 * square),
        "noise_expected": expected,
        "structure_z": ratio * math.sqrt(2.0 * (n * n - 1.0) / (n - 2.0)),
        "samples": n,
        "degrees_of_freedom": 2 * n - used,
    }


def _seen(likelihood: Likelihood, root: np.ndarray, force: np.ndarray) -> Identifiability:
    of_circuit = parameters(likelihood.template)
    free = [name for name in likelihood.names if name in of_circuit]
    found = judge(likelihood.names, root, likelihood.prior_root, force, free, ("impedance",))
    if found.verdict == "identified":
        return found
    known = f"The mean force is known to ± {percent(found.force_sd)}"
    return dataclasses.replace(found, remedy=f"{known}; measure from below the skin's corner to above it.")


def _warnings(scene: Scene | None) -> tuple[str, ...]:
    if scene is not None:
        return ()
    return ("no scene was given: the force is that of the paper's panel and drive; state yours in a scene file",)
