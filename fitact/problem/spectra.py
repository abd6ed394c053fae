"""Impedance spectra and gains of Vsc over V as channels of a fit: likelihood, weights, start and figures of merit."""

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
import scipy
from jaxtyping import Complex, Float

from fitact.compiled import as_arrays, pad_samples, pad_weight
from fitact.data.spectrum import Spectrum
from fitact.likelihood.channel import ChannelLikelihood, compiled_signal
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.observable import LINEAR_NUISANCES, DriveTiming
from fitact.likelihood.padded_samples import PaddedSamples
from fitact.likelihood.spectrum_observable import SpectrumObservable, join_complex
from fitact.model.circuit import Channel
from fitact.model.drive import Sine
from fitact.problem.drive_choice import DriveModel
from fitact.problem.source import Source
from fitact.problem.starting_point import Estimate, SkinEstimate, VscEstimate
from fitact.scene.scene import Scene
from fitact.scene.sections import Measurement

MIN_NOISE = 1e-6  # smallest relative noise; no analyser is better
Points = Float[np.ndarray, " points"]


def build_spectrum_channel(spectrum: Spectrum, scene: Scene, number: str) -> tuple[ChannelLikelihood, Source]:
    """Return the likelihood of a spectrum, and its source; `number` distinguishes it from other records."""
    choice, values, omega = _stated_drive(scene), spectrum.values, 2.0 * math.pi * spectrum.frequency
    parts = np.stack([values.real, values.imag], axis=-1).reshape(-1)
    noise = _scatter(np.log(np.abs(values)))
    skew = scene.skew_limit("Vsc", 0.0) if spectrum.channel == "Vsc" else 0.0
    # unit of a delay: 1 us
    sd = np.array([skew / 1e-6 / math.sqrt(3.0), 1.0])
    timing = DriveTiming(np.zeros(()), np.zeros(()), np.asarray(1e-6), sd, ("delay",) if skew > 0.0 else ())
    kind, padded = cast(Channel, spectrum.channel), pad_samples(parts)
    observable = SpectrumObservable(pad_samples(omega, 2 * omega.size)[: padded.size // 2], timing, kind)
    channel = ChannelLikelihood(
        samples=PaddedSamples(pad_samples(np.arange(parts.size, dtype=float)), padded, _weights(np.abs(values))),
        observable=observable,
        linear_sd=np.zeros(len(LINEAR_NUISANCES)),
        noise_floor=np.asarray(MIN_NOISE),
        label="_".join(filter(None, ("Z" if observable.is_impedance else "H", number))),
        noise="student" if scene.measurement.noise_model == "student" else "white",
        columns=(),
    )
    start = _estimate_skin(omega, values) if observable.is_impedance else _estimate_divider(omega, values)
    return channel, Source(spectrum, scene, choice, noise, (), start, spectrum.notes, spectrum.warnings)


def _weights(sd: Points) -> Float[np.ndarray, " samples"]:
    """Return weights for noise in proportion to `sd`, in the unit of the response."""
    return pad_weight(np.repeat(1.0 / sd, 2))


def _stated_drive(scene: Scene) -> DriveModel:
    """Return the drive of the scene by its name and peak (V); a spectrum has none."""
    stated = scene.drive
    peak = math.fsum(stated.amplitudes or (0.5 * stated.peak_to_peak,)) + abs(stated.offset)
    return DriveModel(as_arrays(Sine(1.0, 1.0)), np.array([peak]), stated.steady_state, False, 0.0, stated.waveform)


def _scatter(logs: Points) -> float:
    """Return an upper estimate of relative white noise from third differences, which smooth spectra hardly have."""
    third = np.abs(np.diff(logs, 3)) / math.sqrt(20.0)
    return max(float(np.median(third)) / 0.6744897501960817, MIN_NOISE)


def _estimate_skin(omega: Points, z: Complex[np.ndarray, " points"]) -> Estimate | None:
    """Estimate Rsc, Csc and Ci from the best linear fit of 2 Rsc and 1/Ci over many time constants Rsc Csc."""
    parts = [np.real, np.imag]
    observed = np.concatenate([part(z / np.abs(z)) for part in parts])
    best = (math.inf, np.ones(2), 1.0)
    for tau in np.geomspace(0.1 / omega[-1], 10.0 / omega[0], num=100):
        columns = [1.0 / (1.0 + 1j * omega * tau), 1.0 / (1j * omega)]
        design = np.stack([np.concatenate([part(c / np.abs(z)) for part in parts]) for c in columns], axis=1)
        size = np.linalg.norm(design, axis=0)  # equal column norms limit rounding errors
        values, miss = scipy.optimize.nnls(design / size, observed)
        best = min(best, (float(miss), values / size, float(tau)), key=lambda fit: fit[0])
    (twice, elastance), tau = best[1], best[2]
    if not (twice > 0.0 and elastance > 0.0):
        return None
    return SkinEstimate(0.5 * twice, 2.0 * tau / twice, 1.0 / elastance)


def _estimate_divider(omega: Points, gain: Complex[np.ndarray, " points"]) -> Estimate | None:
    """Estimate g and b from a s - b s H = H, which is linear in both."""
    s = 1j * omega
    design = np.stack([s, -s * gain], axis=1) / np.abs(s * gain)[:, None]
    observed = gain / np.abs(s * gain)
    columns, rows = (np.concatenate([x.real, x.imag]) for x in (design, observed))
    (a, b), *_ = np.linalg.lstsq(columns, rows, rcond=None)
    return VscEstimate(float(a / b), float(b)) if a > 0.0 and b > 0.0 else None


def update_weights(
    likelihood: Likelihood,
    theta: Float[np.ndarray, " parameters"],
    sources: tuple[Source, ...],
    influences: Sequence[Float[np.ndarray, "rows parameters"]],
) -> tuple[Likelihood, float]:
    """Return the likelihood with weights of the spectra for the responses at theta, and their largest change (log).

    `influences` are the Jacobians of the whitened residuals times a factor of the covariance; the sum of squares of a
    row is the fraction of its noise that the fit has taken up.
    """
    change = 0.0
    for i, (channel, source) in enumerate(zip(likelihood.channels, sources, strict=True)):
        if isinstance(channel.observable, SpectrumObservable):
            inputs = likelihood.make_inputs(likelihood.evaluate_circuit(theta).circuit, theta, channel)
            n = channel.samples.size
            signal, before = np.asarray(compiled_signal(channel, inputs)), channel.samples.weights[:n]
            taken_up = np.minimum(np.sum(influences[i][:n] ** 2, axis=1), 0.9)
            remainder = (np.asarray(channel.samples.observed) - signal)[:n] / np.sqrt(1.0 - taken_up)
            model, residuals = join_complex(signal[:n]), join_complex(remainder)
            sd = _noise_sd(source.scene.measurement, np.abs(model), np.abs(residuals))
            channel = channel.replace_samples(weight=_weights(sd))
            change = max(change, float(np.max(np.abs(np.log(channel.samples.weights[:n] / before)))))
            likelihood = likelihood.replace_channel(i, channel)
    return likelihood, change


def _noise_sd(measurement: Measurement, size: Points, residuals: Points) -> Points:
    """Return the sd of the noise at each point, in units of the relative noise at the geometric mean of the magnitudes.

    Estimated noise is in proportion to the magnitude, with a floor, and an excess in proportion to its square (where
    the current is small), both of their most probable size.
    """
    middle = math.exp(float(np.mean(np.log(size))))
    relative, center, spread = size / middle, math.log(0.01), 3.0

    def combine(floor: float, excess: float) -> Points:
        return relative * np.sqrt(1.0 + (floor / relative) ** 2 + (excess * relative) ** 2)

    def objective(logs: Float[np.ndarray, " 2"]) -> float:
        sd = combine(*np.exp(np.clip(logs, -20.0, 20.0)))
        mean = max(float(np.mean((residuals / sd) ** 2)), (MIN_NOISE * middle) ** 2)
        return size.size * math.log(mean) + 2.0 * np.sum(np.log(sd)) + 0.5 * np.sum(((logs - center) / spread) ** 2)

    if measurement.weighting == "stated":
        sd = np.hypot(measurement.spectrum_relative_sd * size, measurement.spectrum_floor_sd)
    elif measurement.weighting == "estimated":
        starts = [np.array([c, d]) for c in (-7.0, 0.0) for d in (-7.0, 0.0)]
        ends = (scipy.optimize.minimize(objective, start, method="Nelder-Mead") for start in starts)
        sd = combine(*np.exp(min(ends, key=lambda end: end.fun).x))
    else:
        sd = relative if measurement.weighting == "modulus" else np.ones(size.size)
    return sd * middle / math.exp(float(np.mean(np.log(sd))))


def spectrum_statistics(white: Float[np.ndarray, " samples"], n_fitted: float) -> dict[str, float]:
    """Compare weighted residuals (parts in turn) with the scatter of neighbours, which is independent of the model.

    `structure_z`: von Neumann ratio (mean square successive difference over mean square) of real and imaginary parts
    together, as a z-score for white noise, whose variance is (n - 2) / (n^2 - 1) for half of the ratio.
    """
    residuals = join_complex(white)
    n, square = residuals.size, float(np.mean(np.abs(residuals) ** 2))
    successive = 0.5 * float(np.mean(np.abs(np.diff(residuals)) ** 2))
    expected, freedom = max(math.sqrt(0.5 * successive), MIN_NOISE), max(2.0 * n - n_fitted, 1.0)
    ratio = 1.0 - successive / square if square > (2.0 * MIN_NOISE) ** 2 else 0.0  # smaller residuals are rounding
    z = ratio * math.sqrt(2.0 * (n * n - 1.0) / (n - 2.0))
    return {
        "chi2_reduced": n * square / (freedom * expected**2),
        "rms_residual": math.sqrt(0.5 * square),
        "noise_expected": expected,
        "structure_z": z,
        "spectrum_p": 0.5 * math.erfc(z / math.sqrt(2.0)),
        **dict.fromkeys(("folded_p", "line_p"), 1.0),
        **dict.fromkeys(("runs_z", "rounding_noise", "rounding_share", "interpolation_error", "outliers"), 0.0),
        "samples": 2 * n,
        "degrees_of_freedom": freedom,
    }
