"""How well a fit predicts samples that it was not given: blocks of a record, left out in turn.

Samples near each other share what a model gets wrong and, where noise is coloured, the noise; so blocks are left out,
not samples. Of each fold the least squares are repeated without it, from the samples themselves. What they leave open
of parameters and linear nuisances together is normal, to Laplace's approximation; over that a block's density is
integrated, exactly where the noise is Gaussian. The noise's standard deviation is the refit's.
"""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitact.compiled import padded
from fitact.data.record import Record
from fitact.fitting.fit import Fit
from fitact.fitting.least_squares import least_squares
from fitact.fitting.levenberg_marquardt import result_name
from fitact.likelihood.channel import Trace
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import FREEDOM, student_curvature, student_weight

_BLOCKS = 40  # of a record: enough for a standard error of their sum
_PERIODS = 20  # whole ones, from which blocks consist of them
_FOLDS = 10
_STUDENT_INFORMATION = (FREEDOM + 1.0) / (FREEDOM + 3.0)  # of a sample, on its location in scales
_STUDENT = math.lgamma(0.5 * (FREEDOM + 1.0)) - math.lgamma(0.5 * FREEDOM) - 0.5 * math.log(FREEDOM * math.pi)


class HeldOut(NamedTuple):
    """What a fit makes of the blocks left out.

    Attributes:
        log_density: of each block, given all samples outside its fold.
        folds: how many refits there were,
        failed: and how many of them did not reach an optimum.
    """

    log_density: Float[np.ndarray, " blocks"]
    folds: int
    failed: int


def blocks(record: Record) -> Int[np.ndarray, " samples"]:
    """The block of each sample: whole periods where there are many, else stretches of as many samples."""
    frequency, since = record.frequency(), record.time - record.time[0]
    periods = 0 if frequency is None else math.floor((since[-1] + record.time_step) * frequency + 1e-6)
    if frequency is None or periods < _PERIODS:
        return np.arange(len(record)) * min(_BLOCKS, len(record)) // len(record)
    each = -(-periods // _BLOCKS)
    place = np.floor((since + 0.5 * record.time_step) * frequency).astype(int)
    return np.minimum(place, periods - 1) // each


def counted(trace: Trace) -> Bool[np.ndarray, " samples"]:
    """The samples whose density is a part of the likelihood."""
    return trace.weights > 0.0 if trace.whitening is None else np.asarray(trace.whitening.kept) > 0.0


def held_out(fit: Fit) -> HeldOut:
    """Log densities of the blocks of a fit's records, each predicted without the fold that it belongs to."""
    starts, total = {}, 0
    for record in fit.records:
        starts[id(record)] = total
        total += int(blocks(record)[-1]) + 1
    of_rows = [padded(starts[id(trace.record)] + blocks(trace.record)) for trace in fit.traces]
    # dealt out at random, so that no fold holds the same part of every period; any dealing does
    folds = min(_FOLDS, total)
    fold = np.random.default_rng(0).permutation(total) % folds
    found, failed = np.zeros(total), 0
    with jax.enable_x64(True):
        likelihood = fit.likelihood.summed()
        sigma = jnp.asarray([trace.sigma for trace in fit.traces])
        for number in range(folds):
            kept = [fold[rows] != number for rows in of_rows]
            without = _without(likelihood, kept)
            refit = least_squares(without, jnp.asarray(fit.theta), sigma)
            failed += result_name(refit.result) != "successful"
            near = _Near.of(likelihood, without, refit.theta, np.asarray(refit.sigma), kept)
            for block in np.flatnonzero(fold == number):
                found[block] = near.log_density([rows == block for rows in of_rows])
    return HeldOut(found, folds, failed)


def _without(likelihood: Likelihood, kept: list[np.ndarray]) -> Likelihood:
    """With only some of each trace's samples counting."""
    for i, (trace, some) in enumerate(zip(likelihood.traces, kept, strict=True)):
        if trace.whitening is None:
            trace = dataclasses.replace(trace, weight=jnp.asarray(trace.weights * some))
        else:  # the filter goes on seeing all of them
            whitening = dataclasses.replace(trace.whitening, kept=trace.whitening.kept * some)
            trace = dataclasses.replace(trace, whitening=whitening)
        likelihood = likelihood.with_trace(i, trace)
    return likelihood


class _Near(NamedTuple):
    """All samples about a refit, to first order, in coordinates that are standard normal by the prior.

    Attributes:
        z: residuals of each trace in standard deviations of the noise.
        slope: their derivatives by the parameters and all traces' linear nuisances.
        log_scale: of each sample, what the logarithm of its density has beside that of z.
        student: whether z has Student's distribution.
        precision: of the coordinates, by the samples kept and the prior.
    """

    z: list[np.ndarray]
    slope: list[np.ndarray]
    log_scale: list[np.ndarray]
    student: list[bool]
    precision: np.ndarray

    @classmethod
    def of(
        cls, full: Likelihood, without: Likelihood, theta: Array, sigma: np.ndarray, kept: list[np.ndarray]
    ) -> "_Near":
        left, slopes, shapes = _linearised(full, without, theta, jnp.asarray(sigma))
        widths = [len(each) for each in shapes]
        before = np.cumsum([0, *widths])
        z, slope, scale, student = [], [], [], []
        precision = np.eye(theta.size + before[-1])
        for i, (trace, some) in enumerate(zip(full.traces, kept, strict=True)):
            of_nuisances = np.zeros((trace.time.size, before[-1]))
            of_nuisances[:, before[i] : before[i + 1]] = -np.asarray(shapes[i]).T
            z.append(np.asarray(left[i]) / sigma[i])
            slope.append(np.hstack([np.asarray(slopes[i]) @ full.prior_root, of_nuisances]) / sigma[i])
            student.append(trace.noise == "student")
            counts = counted(trace)
            first = 1.0 if trace.whitening is None else abs(float(trace.whitening.taps[0]))
            with np.errstate(divide="ignore"):
                scale.append(np.where(counts, np.log(trace.weights * first / sigma[i]), -np.inf))
            rows = slope[i][some & counts]
            precision += (_STUDENT_INFORMATION if student[i] else 1.0) * rows.T @ rows
        return cls(z, slope, scale, student, precision)

    def log_density(self, chosen: list[np.ndarray]) -> float:
        """Of the chosen samples together."""
        total, score, added = 0.0, np.zeros(len(self.precision)), np.zeros_like(self.precision)
        for z, slope, scale, student, some in zip(*self[:4], chosen, strict=True):
            some = some & np.isfinite(scale)
            z, slope = z[some], slope[some]
            density = _STUDENT - 0.5 * (FREEDOM + 1.0) * np.log1p(z**2 / FREEDOM) if student else _normal(z)
            total += float(np.sum(density + scale[some]))
            score -= slope.T @ (np.asarray(student_weight(z)) * z if student else z)
            # an outlier's negative curvature would not leave a maximum for sure
            curvature = np.maximum(np.asarray(student_curvature(z)), 0.0) if student else np.ones(len(z))
            added += (curvature[:, None] * slope).T @ slope
        wider = self.precision + added
        _, log_ratio = np.linalg.slogdet(np.linalg.solve(self.precision, wider))
        return total + 0.5 * float(score @ np.linalg.solve(wider, score)) - 0.5 * float(log_ratio)


def _normal(z: np.ndarray) -> np.ndarray:
    return -0.5 * z**2 - 0.5 * math.log(2.0 * math.pi)


@eqx.filter_jit
def _linearised(
    full: Likelihood, without: Likelihood, theta: Array, sigma: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...], tuple[Array, ...]]:
    """What the refit leaves of all samples, weighted; its derivatives in theta; and the linear nuisances' shapes."""

    def remainders(theta: Array) -> tuple[Array, ...]:
        return tuple(trace.before_linear(seen)[0] for trace, seen in full.each(theta))

    left, shapes = [], []
    parts = zip(full.each(theta), without.each(theta), sigma, strict=True)
    for (trace, seen), (fitted, _), s in parts:
        remainder, each = trace.before_linear(seen)
        scaled = trace.linear_sd[np.array(trace.columns, dtype=int), None] * each
        left.append(remainder - fitted.linear(seen, s)[1] @ scaled)
        shapes.append(scaled)
    return tuple(left), jax.jacfwd(remainders)(theta), tuple(shapes)
