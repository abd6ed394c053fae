"""Variation within fingers, pooled over tracked fingers: its size for each quantity, and draws for the next finger.

A finger's variance is that about its average over a record. Variances of fingers have a gamma distribution, whose mean
and degrees of freedom are unknown; each is measured with the error that the noise of its windows leaves.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from fitact import summary
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.populations.finger import SHARED_PARAMETER
from fitact.populations.next_finger import NewFingerModel
from fitact.tracking.tracked_finger import TrackedFinger
from fitact.units import format_engineering

FORCES = ("force_mean", "force_peak")


class PooledVariance(NamedTuple):
    """Draws of the mean variance of fingers and of its degrees of freedom, and whether it may be 0."""

    variance: Float[np.ndarray, " draws"]
    freedom: Float[np.ndarray, " draws"]
    may_be_zero: bool


def pool_variances(
    found: Float[np.ndarray, " fingers"],
    noise: Float[np.ndarray, " fingers"],
    windows: Float[np.ndarray, " fingers"],
    random: np.random.Generator,
    draws: int,
    *,
    log_sd_scale: float = 0.5,
    largest: float = 3.0,
    negligible: float = 0.01,
    grid_size: int = 241,
) -> PooledVariance:
    """Pool the fingers' variances `found` without bias from `windows` values with errors of variance `noise`.

    The standard deviation of a logarithm has a half-normal prior of scale `log_sd_scale`, as the one between fingers.
    It is one of `grid_size` values up to `largest`, from `negligible` times the largest finger's or its error.
    """
    degrees = np.geomspace(0.5, 30.0, 13)  # of freedom of a finger's variance, of equal prior probability each
    top = float(np.max(np.maximum(found, 0.0) + noise / np.sqrt(windows)))
    log_sd = np.linspace(np.log(negligible) + 0.5 * np.log(top), np.log(largest), grid_size)
    true = 2.0 * np.linspace(log_sd[0] - 4.0, log_sd[-1], 4 * grid_size)  # logarithm of a finger's variance
    # variance of the estimate given the true one; where it is finer than the grid, that of the grid's step
    error = np.sqrt((2.0 * noise[:, None] ** 2 + 4.0 * noise[:, None] * np.exp(true)) / windows[:, None])
    error = np.hypot(error, (true[1] - true[0]) * np.exp(true))
    measured = np.exp(-0.5 * np.square((found[:, None] - np.exp(true)) / error)) / error
    shape = 0.5 * degrees[:, None, None]
    ratio = true - 2.0 * log_sd[:, None]
    gamma = np.exp(shape * (np.log(shape) + ratio - np.exp(ratio)) - scipy.special.gammaln(shape))
    likelihood = np.einsum("nsv,fv->nsf", gamma, measured) / np.maximum(gamma.sum(axis=-1), 1e-300)[..., None]
    logs = np.sum(np.log(np.maximum(likelihood, 1e-300)), axis=-1)
    chi_square_95 = 3.84  # 95 % quantile with one degree of freedom
    may_be_zero = bool(2.0 * (np.max(logs) - np.max(logs[:, 0])) < chi_square_95)
    posterior = logs + log_sd - 0.5 * np.square(np.exp(log_sd) / log_sd_scale)
    weight = np.exp(posterior - np.max(posterior)).ravel()
    chosen = random.choice(weight.size, size=draws, p=weight / weight.sum())
    freedom, place = np.unravel_index(chosen, posterior.shape)
    blurred = log_sd[place] + (log_sd[1] - log_sd[0]) * (random.random(draws) - 0.5)
    return PooledVariance(np.exp(2.0 * blurred), degrees[freedom], may_be_zero)


class WithinFinger(NamedTuple):
    """Variation within fingers, over records of a stated length."""

    covariance: Float[np.ndarray, "3 3"]  # mean over fingers, of log Rsc, log Csc and log Ci
    pooled: dict[str, PooledVariance]  # of the logarithm of each quantity
    size: Float[np.ndarray, " draws"]  # of the force's variance over the one that `covariance` gives
    time_scale: float  # after which the autocorrelation of the mean force has fallen to 1/e, median over fingers, s
    duration: float  # of a record, median over fingers, s
    sees_area: bool  # whether the records show changes of the contact area
    tracked: int  # number of tracked fingers

    @classmethod
    def from_tracks(
        cls,
        tracks: Sequence[TrackedFinger],
        logs: Float[np.ndarray, "fingers 3"],
        finger: NewFingerModel,
        random: np.random.Generator,
        draws: int = 4000,
    ) -> "WithinFinger":
        """Pool tracked fingers whose log Rsc, log Csc and log Ci are `logs`; `finger` gives the force."""
        averages = [each.average for each in tracks]
        within, noise = (np.array([getattr(each, name) for each in averages]) for name in ("within", "noise"))
        windows = np.array([each.windows for each in averages], dtype=float)
        covariance = _nearest_covariance(within.mean(axis=0), noise.mean(axis=0))
        pooled, expected = {}, {}
        others = len(finger.factors) - len(FINGER_PARAMETERS)
        gradients = finger.log_gradients(np.pad(logs, ((0, 0), (0, others))))
        gradients[SHARED_PARAMETER] = np.tile(np.array(finger.factors) == SHARED_PARAMETER, (len(logs), 1)).astype(
            float
        )
        for name in (*FINGER_PARAMETERS, *FORCES):
            slope = gradients[name][:, : len(FINGER_PARAMETERS)]
            found, errors = (np.einsum("fi,fij,fj->f", slope, each, slope) for each in (within, noise))
            expected[name] = float(np.mean(np.einsum("fi,ij,fj->f", slope, covariance, slope)))
            if np.all(errors > 0.0):  # not where the records do not show changes of Ci
                pooled[name] = pool_variances(found, errors, windows, random, draws)
        size = pooled["force_mean"].variance / expected["force_mean"]
        duration = float(np.median([each.duration for each in averages]))
        sees_area = all(each.sees_area for each in averages)
        time_scale = float(np.median([each.time_scale for each in tracks]))
        return cls(covariance, pooled, size, time_scale, duration, sees_area, len(tracks))

    @property
    def mean_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Covariance of log Rsc, log Csc and log Ci within a finger, posterior mean."""
        return self.covariance * float(np.mean(self.size))

    def draw_deviations(
        self, shape: tuple[int, int, int], random: np.random.Generator
    ) -> Float[np.ndarray, "moments laws fingers 3"]:
        """Draw deviations of log Rsc, log Csc and log Ci from a finger's averages, at some moments of each finger."""
        moments, laws, fingers = shape
        chosen = np.arange(laws) % len(self.size)
        half = 0.5 * self.pooled["force_mean"].freedom[chosen, None]
        variance = self.size[chosen, None] * random.gamma(half, 1.0 / half, (laws, fingers))
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.trace(self.covariance) * np.eye(3))
        return np.sqrt(variance)[..., None] * (random.standard_normal((moments, laws, fingers, 3)) @ root.T)

    def to_dict(self) -> dict[str, Any]:
        """Return the entries `within_finger` and `record_s` of population.json."""
        sizes = {
            name: {
                "log_sd": summary.summarize_draws("log_sd", np.sqrt(pooled.variance)),
                "may_be_zero": pooled.may_be_zero,
                "time_scale_s": self.time_scale,
            }
            for name, pooled in self.pooled.items()
        }
        return {"within_finger": sizes, "record_s": self.duration}

    def describe_assumptions(self, fingers: int) -> list[str]:
        """Return sentences on what the variation within a finger contains."""
        length, scale = (format_engineering(each, "s", 3) for each in (self.duration, self.time_scale))
        sentences = [
            f"changes within a finger are those about its average over a record of {length}, with a time scale of"
            f" {scale}; slower changes count as differences between fingers"
        ]
        if self.pooled["force_mean"].may_be_zero:
            sentences.append("the records are compatible with fingers that do not change")
        if not self.sees_area:
            sentences.append(
                "Vsc alone does not determine the contact area, so changes of the area within a finger are left out of"
                " the force; record I, too"
            )
        if fingers > self.tracked:
            sentences.append(
                f"{self.tracked} of {fingers} records were tracked; each other shows its finger at one moment, and the"
                " changes within a finger are subtracted from its part in the differences between fingers"
            )
        return sentences


def _nearest_covariance(
    within: Float[np.ndarray, "3 3"], noise: Float[np.ndarray, "3 3"], part: float = 1e-3
) -> Float[np.ndarray, "3 3"]:
    """Return the nearest covariance, with a small part of the noise's, so that it has a shape where nothing varies."""
    values, axes = np.linalg.eigh(within)
    return (axes * np.maximum(values, 0.0)) @ axes.T + part * noise
