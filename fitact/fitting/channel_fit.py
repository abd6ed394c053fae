"""Result of a fit for one channel of one record: residuals, nuisances and figures of merit."""

import dataclasses
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from fitact.compiled import jit
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.fitting.residual_statistics import channel_statistics, outliers
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import LAG, estimate_current_noise, mean_filter
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.likelihood.noise import STUDENT_DOF, student_weight
from fitact.likelihood.observable import ChannelInputs
from fitact.likelihood.spectrum_observable import join_complex
from fitact.model.circuit import Channel, Circuit
from fitact.model.skin import WithSkin
from fitact.problem.drive_choice import DriveModel
from fitact.problem.recorded_current import row_figures
from fitact.problem.source import Source
from fitact.problem.spectra import spectrum_statistics

Samples = Float[np.ndarray, " samples"]


@dataclasses.dataclass(frozen=True)
class ChannelFit:
    """Result of a fit for one channel of one record."""

    label: str  # name among the channels of the fit, e.g. "I_2"; "" for Vsc of a single record
    channel: str  # "Vsc", "I" or "impedance"
    record: Record | Spectrum
    choice: DriveModel
    # standard deviation of the noise, estimated from the residuals, V or A; for a spectrum relative to the magnitude
    sigma: float
    linear: dict[str, float]  # free offset, drift, hum and charge at the optimum, V or A
    # data minus fit, V or A; of a spectrum real and imaginary parts in turn; of I with a recorded V the part of it that
    # is noise of I, and not of V
    residuals: Samples
    weight: Samples | None  # relative inverse noise sd; 0 excludes a sample, None means 1
    log_likelihood: float  # log-likelihood of the samples, including all constants
    figures: dict[str, float]  # figures of merit: chi2_reduced, rms_residual, noise_expected, runs_z, ...
    full_because: str  # reason why the likelihood is not compressed, as a clause; "" if it is
    # whitened residuals of I with a recorded V over the time steps, A; NaN where they do not count
    white: Samples | None = None

    @property
    def relative_noise_sd(self) -> Samples:
        """Standard deviation of each sample's noise over the channel's; NaN where a sample was excluded."""
        if self.weight is None:
            return np.ones(self.residuals.size)
        counts = self.weight > 0.0
        return np.where(counts, 1.0 / np.where(counts, self.weight, 1.0), np.nan)

    @property
    def prediction(self) -> np.ndarray:
        """Data minus residuals, V or A, or complex for a spectrum; NaN where a sample was excluded."""
        if isinstance(self.record, Spectrum):
            return self.record.values - join_complex(self.residuals)
        counts = np.isfinite(self.relative_noise_sd)
        return np.where(counts, self.record[self.channel] - self.residuals, np.nan)

    @classmethod
    def from_optimum(
        cls,
        likelihood: Likelihood,
        index: int,
        theta: np.ndarray,
        sigma: float,
        optimum: CircuitValues,
        source: Source,
        reason: str,
    ) -> "ChannelFit":
        """Return the result for channel `index` at theta, where the circuit is `optimum`, with noise `sigma`."""
        channel = likelihood.channels[index].without_compression()
        inputs = likelihood.make_inputs(optimum.circuit, theta, channel)
        # the noise is passed as an array, because jit would compile again for every new number
        residuals, white, beta = sample_residuals(channel, inputs, np.asarray(sigma))
        samples, of_steps = channel.samples, None
        unpadded = slice(samples.size)
        if samples.has_drive_noise:
            residuals = _current_residuals(channel, np.asarray(white))
        if samples.charges is not None:
            of_steps = np.where(samples.likelihood_mask, white, np.nan)[unpadded]
            of_steps = np.append(of_steps[LAG:], np.full(LAG, np.nan))
        residuals, weight = residuals[unpadded], None if samples.equally_weighted else samples.weights[unpadded]
        names = (channel.observable.linear_names[column] for column in channel.columns)
        sizes = zip(map(channel.qualified_name, names), np.asarray(channel.column_sd), beta, strict=True)
        linear = {name: float(sd * size) for name, sd, size in sizes if sd > 0.0}
        counted = samples.likelihood_mask[unpadded]
        white = white[unpadded][counted]
        n_fitted = theta.size * white.size / float(likelihood.count) + len(linear)
        if isinstance(source.record, Spectrum):
            figures = spectrum_statistics(white, n_fitted)
        else:
            # AR(1) noise is estimated only from the residuals
            noise = sigma if channel.noise == "ar1" else source.noise
            of_rows: dict[str, float] = {}
            rounding_share: float | None = None
            if channel.samples.charges is not None:
                white, of_rows, rounding_share = row_figures(white, channel, inputs, source.in_time)
            # a delayed response lies between the samples of V
            b = 0.0 if "delay" in channel.timing.free and channel.samples.charges is None else float(optimum.b)
            whole = white, source.record.time[counted], noise, n_fitted, _gain(optimum, channel)
            how = source.record, channel.channel, source.choice, b, rounding_share
            figures = channel_statistics(*whole, *how, is_curved=channel.may_curve_drive)
            figures |= of_rows
            figures |= _weighted_statistics(channel, residuals, weight, counted, source.record.time, source.noise)
            if samples.has_drive_noise:  # at edges and ends, samples of dV/dt are wrong, and rows are not
                figures |= {"outliers": 0} | outliers(white, source.record.time[counted], source.noise)
                figures["runs_z"] = 0.0  # V that alternates between few levels has skewed noise, whose signs differ
        return cls(
            label=channel.label,
            channel=channel.channel,
            record=source.record,
            choice=source.choice,
            sigma=sigma,
            linear=linear,
            residuals=residuals,
            weight=weight,
            log_likelihood=log_likelihood(channel, residuals, white, sigma),
            figures=figures,
            full_because=reason,
            white=of_steps,
        )


def _current_residuals(channel: ChannelLikelihood, white: Samples) -> Samples:
    """Return the part of the residuals of a current with a recorded V that is noise of I, and not of V, A."""
    charges, whitening = channel.samples.charges, channel.samples.whitening
    if charges is not None:
        filtered = mean_filter(float(channel.timing.shift) / float(channel.timing.step))
        gain, decay, used = (np.asarray(each) for each in (charges.gain, charges.decay, charges.used))
        return estimate_current_noise(gain, decay, used * white, *filtered)
    assert whitening is not None
    gain, decay = np.asarray(whitening.gain), np.asarray(whitening.decay)
    return estimate_current_noise(gain, decay, white, np.asarray(whitening.taps))


def _weighted_statistics(
    channel: ChannelLikelihood,
    residuals: Samples,
    weight: Samples | None,
    counted: Bool[np.ndarray, " samples"],
    time: Samples,
    noise: float,
) -> dict[str, float]:
    """Return figures that depend on the weights of the samples and on the noise model."""
    figures: dict[str, float] = {"outliers": 0}
    # samples with weights below 0.7 have mostly noise from the drive's slope, which is not white
    if weight is not None and np.mean((weight > 0.0) & (weight < 0.7)) > 0.01:
        figures |= {"spectrum_p": 1.0, "line_p": 1.0}
    weighted = residuals if weight is None else residuals * weight
    if channel.samples.whitening is not None:  # rms of the residuals before the whitening filter
        figures["rms_residual"] = float(np.sqrt(np.mean(weighted[counted] ** 2)))
    if channel.noise == "spectrum":
        figures["quiet_noise"] = noise
    if channel.noise != "student":  # which expects them
        figures |= outliers(weighted, time, noise)
    return figures


def _gain(optimum: CircuitValues, channel: ChannelLikelihood) -> float:
    """Return the factor by which noise of a measured drive enters the channel."""
    if channel.channel == "Ft" or channel.samples.has_drive_noise:  # whose sensor hardly follows noise; which have it
        return 0.0
    if isinstance(optimum.circuit, WithSkin):  # the gain falls with frequency, and most of the noise is fast
        return float(np.abs(_channel_gain(optimum.circuit, channel.channel, 1.0 / channel.timing.step)))
    return abs(float(optimum.terms[channel.channel].gain_in_step(float(channel.timing.step))))


@jit
def _channel_gain(circuit: Circuit, channel: Channel, omega: Array) -> Array:
    return circuit.channel_gain(channel, omega)


def log_likelihood(channel: ChannelLikelihood, residuals: Samples, white: Samples, sigma: float) -> float:
    """Return the log-likelihood at its maximum over the noise sd; under Student's t, at scale `sigma`."""
    mask = channel.samples.likelihood_mask
    scale = channel.samples.scale[mask]
    if channel.noise == "student":
        z = residuals[mask[: residuals.size]] * scale / sigma
        return float(np.sum(scipy.stats.t.logpdf(z, STUDENT_DOF) + np.log(scale / sigma)))
    return _gaussian_log_likelihood(white) + float(np.sum(np.log(scale)))


def _gaussian_log_likelihood(residuals: Samples) -> float:
    """Return the Gaussian log-likelihood of residuals at its maximum over the noise sd, including all constants."""
    return -0.5 * residuals.size * (math.log(2.0 * math.pi * max(float(np.mean(residuals**2)), 1e-300)) + 1.0)


@jit
def sample_residuals(channel: ChannelLikelihood, inputs: ChannelInputs, sigma: Array) -> tuple[Array, Array, Array]:
    """Return the residuals, the whitened residuals, and the linear nuisances in units of their prior sd."""
    remainder, shapes = channel.remainder_and_shapes(inputs)
    if channel.samples.charges is None:
        whiten = channel.samples.apply_whitening
        white, beta, _ = channel.fit_rows(whiten(remainder), whiten(shapes), sigma)
    else:
        white, beta, _ = channel.fit_nuisances(inputs, sigma)
    residuals = remainder - (beta * channel.column_sd) @ shapes
    if channel.noise == "student":
        white = white * jnp.sqrt(student_weight(white / sigma))
    return residuals, white, beta


def information_criteria(parameters: int, traces: Sequence[ChannelFit]) -> dict[str, float]:
    """Return the information criteria of a fit with so many `parameters` besides linear nuisances and noise."""
    n_parameters = parameters + sum(1 + len(channel.linear) for channel in traces)
    samples = sum(int(channel.figures["samples"]) for channel in traces)
    return criteria(sum(channel.log_likelihood for channel in traces), n_parameters, samples)


def criteria(log_likelihood: float, parameters: int, samples: int) -> dict[str, float]:
    """Return the information criteria AIC, AICc (AIC for few samples; infinite for too few) and BIC.

    Lower is better; only fits to the same samples can be compared. Sources: Akaike, IEEE Trans. Autom. Control 19
    (1974) 716; Hurvich and Tsai, Biometrika 76 (1989) 297; Schwarz, Ann. Statist. 6 (1978) 461.
    """
    aic, spare = 2.0 * parameters - 2.0 * log_likelihood, samples - parameters - 1
    return {
        "log_likelihood": log_likelihood,
        "parameters_counted": parameters,
        "aic": aic,
        "aicc": aic + 2.0 * parameters * (parameters + 1) / spare if spare > 0 else math.inf,
        "bic": parameters * math.log(samples) - 2.0 * log_likelihood,
    }
