"""Samples of one channel of one record, with what excludes and whitens them."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from fitact.compiled import array_module, pad_samples, pad_weight
from fitact.likelihood.charge_rows import ChargeRows
from fitact.likelihood.noise import Whitening


class PaddedSamples(eqx.Module):
    """Samples of a channel, padded by `fitact.compiled`; of a spectrum, real and imaginary parts in turn."""

    time: Float[Array, " samples"]  # s
    observed: Float[Array, " samples"]  # V, A, N, or the unit of a spectrum
    # inverse noise sd of each sample, relative to the channel's; 0 excludes a sample, None means equal weights
    weight: Float[Array, " samples"] | None = None
    whitening: Whitening | None = None  # filter for coloured noise; None means white noise
    rate: Float[Array, " samples"] | None = None  # dV/dt at the samples, V/s, if the current follows it
    # small errors of the instruments, each in proportion to its size, over the samples (V or A); None means none
    effects: Float[Array, "effects samples"] | None = None
    # rows of a current whose drive was recorded, with its noise; the channel's drive is then an estimate of it
    charges: ChargeRows | None = None
    # times of the first period (padded, s) and its number of samples, if the signal need be computed only there
    phases: Float[Array, " phases"] | None = None
    period: ArrayLike | None = None

    @property
    def size(self) -> int:
        """Number of samples without padding."""
        time = np.asarray(self.time)
        return 1 + int(np.searchsorted(time, time[-1]))

    @property
    def weights(self) -> Float[np.ndarray, " samples"]:
        return np.ones(self.time.size) if self.weight is None else np.asarray(self.weight)

    @property
    def equally_weighted(self) -> bool:
        """Whether all samples of the record have equal, nonzero weight."""
        return self.weight is None or bool(np.all(self.weights[: self.size] == 1.0))

    @property
    def likelihood_mask(self) -> Bool[np.ndarray, " samples"]:
        """Mask of the samples, or rows, that enter the likelihood."""
        if self.charges is not None:
            return np.asarray(self.charges.used) > 0.0
        return (self.weights if self.whitening is None else np.asarray(self.whitening.mask)) > 0.0

    @property
    def scale(self) -> Float[np.ndarray, " samples"]:
        """Factor of each sample, or row, in its own whitened value."""
        if self.charges is not None:
            return np.asarray(self.charges.gain)
        return self.weights * (1.0 if self.whitening is None else self.whitening.scale)

    @property
    def count(self) -> ArrayLike:
        """Number of samples, or of rows, that count."""
        if self.charges is not None:
            return self.charges.count
        if self.whitening is not None:
            return array_module(self.whitening.mask).count_nonzero(self.whitening.mask)
        return self.time.size if self.weight is None else array_module(self.weight).count_nonzero(self.weight)

    @property
    def has_drive_noise(self) -> bool:
        """Whether their noise contains that of a recorded V, as that of a current does."""
        return self.charges is not None or (self.whitening is not None and self.whitening.gain is not None)

    @property
    def middle_and_half(self) -> tuple[Array, Array]:
        """Middle of the record, and half its length, s."""
        return 0.5 * (self.time[0] + self.time[-1]), 0.5 * (self.time[-1] - self.time[0])

    def first_period(self) -> "PaddedSamples":
        """Return the samples at the `phases`, or all if there are none."""
        return self if self.phases is None else dataclasses.replace(self, time=self.phases, phases=None)

    def repeat(self, values: Float[Array, " phases"]) -> Float[Array, " samples"]:
        """Return values at the `first_period` at all samples."""
        return values if self.phases is None else values[jnp.arange(self.time.size) % self.period]

    def apply_whitening(self, values: Float[Array, "*shape samples"]) -> Float[Array, "*shape samples"]:
        """Return values over the samples in units of independent noise of equal sd; 0 for excluded samples."""
        values = values if self.weight is None else values * self.weight
        return values if self.whitening is None else self.whitening(values)

    def mean(self, values: Float[Array, " samples"]) -> Float[Array, ""]:
        return jnp.mean(values, where=None if self.weight is None else self.weight > 0.0)

    def exclude(self, excluded: Bool[np.ndarray, " samples"]) -> "PaddedSamples":
        """Return the samples with weight 0 for some."""
        weight, whitening = np.where(excluded, 0.0, self.weights), self.whitening
        return dataclasses.replace(self, weight=weight, whitening=whitening and whitening.exclude(excluded))

    def select(self, part: Int[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> "PaddedSamples":
        """Return only the samples `part`, with new weights and white noise."""
        kept = jax.tree.map(lambda values: pad_samples(np.asarray(values)[..., part]), self._functions)
        return dataclasses.replace(self, **kept, weight=pad_weight(weight), whitening=None, phases=None)

    def thin(self, count: int) -> "PaddedSamples":
        """Return `count` of the samples, the ends among them, with white noise."""
        counted = np.flatnonzero(self.weights[: self.size] > 0.0)
        if counted.size > count:
            counted = np.random.default_rng(0).permutation(counted)[:count]  # any subset serves
        weight = np.zeros(self.size)
        weight[counted] = self.weights[counted]
        part = np.unique(np.concatenate([[0, self.size - 1], counted]))
        return self.select(part, weight[part])

    def keep_ends(self) -> "PaddedSamples":
        """Return only the first and the last time, with the least and the largest value."""
        # by NumPy, since JAX would compile this for every length
        kept = jax.tree.map(lambda values: np.zeros((*values.shape[:-1], 2)), self._functions)
        observed = np.asarray(self.observed)
        kept |= {"time": np.asarray(self.time)[[0, -1]], "observed": np.array([observed.min(), observed.max()])}
        charges = None if self.charges is None else jax.tree.map(lambda _: np.zeros(2), self.charges)
        return dataclasses.replace(self, **kept, charges=charges, weight=None, whitening=None, phases=None)

    @property
    def _functions(self) -> dict[str, Any]:
        """Fields that have a value at each sample, but for weights and rows."""
        return {name: getattr(self, name) for name in ("time", "observed", "rate", "effects")}
