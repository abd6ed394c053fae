"""Cross-validation of a fit by held-out blocks of a record.

Neighbouring samples share the errors of a model and, for coloured noise, the noise; therefore blocks are held out, not
samples. For each fold, the model is refitted to the samples outside the fold. The posterior of the parameters and
linear nuisances is approximated as Gaussian (Laplace). The predictive density of each held-out block is integrated
over it, exactly for Gaussian noise. The noise standard deviation is taken from the refit.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from fitact.blas import limit_to_one_thread
from fitact.compiled import double_precision, jit, pad_samples
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.fitting.least_squares import least_squares
from fitact.fitting.result import Fit
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import STUDENT_DOF, student_curvature, student_weight


class CrossValidation(NamedTuple):
    """Predictive densities of the held-out blocks."""

    log_density: Float[np.ndarray, " blocks"]  # log density of each block, given all samples outside its fold
    folds: int  # number of refits
    folds_failed: int  # number of refits that did not converge


def block_indices(record: Record | Spectrum) -> Int[np.ndarray, " samples"]:
    """Return the block of each sample: whole periods if there are `min_periods`, else intervals of equal length.

    Each point of a spectrum is a block, of real and imaginary part.
    """
    if isinstance(record, Spectrum):
        return np.repeat(np.arange(len(record)), 2)
    blocks, min_periods = 40, 20  # so many blocks suffice for the standard error of their sum
    frequency, since = record.frequency(), record.time - record.time[0]
    periods = 0 if frequency is None else math.floor((since[-1] + record.time_step) * frequency + 1e-6)
    if frequency is None or periods < min_periods:
        return np.arange(len(record)) * min(blocks, len(record)) // len(record)
    period = np.floor((since + 0.5 * record.time_step) * frequency).astype(int)
    return np.minimum(period, periods - 1) // -(-periods // blocks)


def cross_validate(fit: Fit, folds: int = 10) -> CrossValidation:
    """Return log densities of the blocks of a fit's records, each predicted from the samples outside its fold."""
    starts, total = {}, 0
    for record in fit.records:
        starts[id(record)] = total
        total += int(block_indices(record)[-1]) + 1
    blocks = [pad_samples(starts[id(trace.record)] + block_indices(trace.record)) for trace in fit.traces]
    # random folds, so that no fold holds the same part of every period; any seed serves
    folds = min(folds, total)
    fold = np.random.default_rng(0).permutation(total) % folds
    log_density, failed = np.zeros(total), 0
    with double_precision(), limit_to_one_thread():
        likelihood = fit.likelihood.without_compression()
        sigma = np.array([trace.sigma for trace in fit.traces])
        for number in range(folds):
            training = [fold[block] != number for block in blocks]
            without = _mask_samples(likelihood, training)
            refit = least_squares(without, fit.theta, sigma)
            failed += refit.result != "successful"
            model = _LinearisedModel.from_refit(likelihood, without, refit.theta, refit.sigma, training)
            for held_out in np.flatnonzero(fold == number):
                log_density[held_out] = model.log_density([block == held_out for block in blocks])
    return CrossValidation(log_density, folds, failed)


def _mask_samples(likelihood: Likelihood, masks: list[np.ndarray]) -> Likelihood:
    """Return the likelihood of the masked samples of each channel only."""
    for i, (trace, mask) in enumerate(zip(likelihood.channels, masks, strict=True)):
        charges, whitening = trace.samples.charges, trace.samples.whitening
        if charges is not None:  # likewise the recursion
            trace = trace.replace_samples(charges=dataclasses.replace(charges, used=charges.used * mask))
        elif whitening is None:
            trace = trace.replace_samples(weight=trace.samples.weights * mask)
        else:  # the whitening filter still runs over all samples
            trace = trace.replace_samples(whitening=dataclasses.replace(whitening, mask=whitening.mask * mask))
        likelihood = likelihood.replace_channel(i, trace)
    return likelihood


class _LinearisedChannel(NamedTuple):
    """Samples of a channel, linearised about a refit, in coordinates that are standard normal under the prior."""

    z: np.ndarray  # residuals in noise standard deviations
    slope: np.ndarray  # derivatives with respect to the parameters and the linear nuisances of all channels
    log_scale: np.ndarray  # log density of each sample minus log density of z
    is_student: bool  # whether z has a Student-t distribution


class _LinearisedModel(NamedTuple):
    """Linearised channels, and the precision of the coordinates given the samples of the refit and the prior."""

    channels: list[_LinearisedChannel]
    precision: np.ndarray

    @classmethod
    def from_refit(
        cls, full: Likelihood, training: Likelihood, theta: Array, sigma: np.ndarray, masks: list[np.ndarray]
    ) -> "_LinearisedModel":
        residuals, slopes, shapes = _linearise(full, training, theta, sigma)
        ends = np.cumsum([0, *map(len, shapes)])
        channels, precision = [], np.eye(theta.size + ends[-1])
        for i, (trace, mask) in enumerate(zip(full.channels, masks, strict=True)):
            by_nuisances = np.zeros((trace.samples.time.size, ends[-1]))
            by_nuisances[:, ends[i] : ends[i + 1]] = -np.asarray(shapes[i]).T
            slope = np.hstack([np.asarray(slopes[i]) @ full.prior_factor, by_nuisances]) / sigma[i]
            samples, is_student = trace.samples, trace.noise == "student"
            counts = samples.likelihood_mask
            with np.errstate(divide="ignore"):
                log_scale = np.where(counts, np.log(samples.scale / sigma[i]), -np.inf)
            channels.append(_LinearisedChannel(np.asarray(residuals[i]) / sigma[i], slope, log_scale, is_student))
            rows = slope[mask & counts]
            # Fisher information of a sample on its location, in units of the scale
            information = (STUDENT_DOF + 1.0) / (STUDENT_DOF + 3.0) if is_student else 1.0
            precision += information * rows.T @ rows
        return cls(channels, precision)

    def log_density(self, masks: Sequence[np.ndarray]) -> float:
        """Return the log density of the masked samples jointly, integrated over the coordinates."""
        total, score, added = 0.0, np.zeros(len(self.precision)), np.zeros_like(self.precision)
        for (z, slope, log_scale, is_student), mask in zip(self.channels, masks, strict=True):
            chosen = mask & np.isfinite(log_scale)
            z, slope = z[chosen], slope[chosen]
            density = scipy.stats.t.logpdf(z, STUDENT_DOF) if is_student else scipy.stats.norm.logpdf(z)
            total += float(np.sum(density + log_scale[chosen]))
            score -= slope.T @ (np.asarray(student_weight(z)) * z if is_student else z)
            # the negative curvature at an outlier could remove the maximum
            curvature = np.maximum(np.asarray(student_curvature(z)), 0.0) if is_student else np.ones(len(z))
            added += (curvature[:, None] * slope).T @ slope
        wider = self.precision + added
        _, log_ratio = np.linalg.slogdet(np.linalg.solve(self.precision, wider))
        return total + 0.5 * float(score @ np.linalg.solve(wider, score)) - 0.5 * float(log_ratio)


@jit
def _linearise(
    full: Likelihood, training: Likelihood, theta: Array, sigma: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...], tuple[Array, ...]]:
    """Return whitened residuals of all samples at the refit, their derivatives, and the shapes of linear nuisances."""

    def residuals(theta: Array) -> tuple[Array, ...]:
        return tuple(trace.residuals_and_shapes(inputs)[0] for trace, inputs in full.channels_and_inputs(theta))

    remainders, shapes = [], []
    parts = zip(full.channels_and_inputs(theta), training.channels_and_inputs(theta), sigma, strict=True)
    for (trace, inputs), (fitted, _), s in parts:
        remainder, unscaled = trace.residuals_and_shapes(inputs)
        shapes.append(trace.column_sd[:, None] * unscaled)
        remainders.append(remainder - fitted.fit_nuisances(inputs, s)[1] @ shapes[-1])
    return tuple(remainders), jax.jacfwd(residuals)(theta), tuple(shapes)
