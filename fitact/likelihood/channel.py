"""Likelihood of one channel of one record, with the linear nuisances integrated out.

The channel is  gain * response(t - delay) + A beta + noise,  where t is the time on the drive's clock.
The columns of A are an offset, a drift, mains hum and, for a measured drive, the decays of the unknown charges at
the first sample. Their coefficients have wide normal priors and are integrated out exactly.

For Gaussian noise the likelihood depends only on inner products over the samples. The same formulas therefore apply
to the coordinates of a `fitact.likelihood.compression.Compression` and to the samples themselves.
"""

import dataclasses
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from fitact.compiled import jit, solve_lower
from fitact.likelihood.compression import Compression, GridCompression, Interpolation
from fitact.likelihood.friction_observable import FrictionObservable
from fitact.likelihood.noise import (
    NoiseModel,
    StudentExpansion,
    student_curvature,
    student_residual,
    student_weight,
)
from fitact.likelihood.observable import LINEAR_NUISANCES, SHORT_TAU, ChannelInputs, DriveTiming, ElectricalSignal
from fitact.likelihood.padded_samples import PaddedSamples
from fitact.likelihood.projection import MAX_DELAY, baseline_functions
from fitact.likelihood.spectrum_observable import SpectrumObservable
from fitact.model.circuit import Channel, HighpassTerms
from fitact.model.drive import Sampled


class ChannelLikelihood(eqx.Module):
    """One channel of one record: its samples, what they observe, nuisances and noise."""

    samples: PaddedSamples
    observable: ElectricalSignal | SpectrumObservable | FrictionObservable
    # prior standard deviations of the `LINEAR_NUISANCES`, in the channel's unit (drift: over half the record);
    # 0 excludes a nuisance
    linear_sd: Float[Array, " nuisances"]
    noise_floor: ArrayLike  # lower bound of the noise sd, in the channel's unit
    label: str = eqx.field(static=True)  # "", or a name that distinguishes it from other channels, e.g. "I_2"
    noise: NoiseModel = eqx.field(static=True)  # noise model
    # indices of the `LINEAR_NUISANCES` in use; `linear_sd` of the others is 0
    columns: tuple[int, ...] = eqx.field(static=True)
    # names of the coordinates that act on the channel's gain, each with its power
    gains: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    drive_gains: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())  # the same for the indicated V
    # name of each effect, and coordinates whose product (each with its power), minus 1, is its size
    effect_sizes: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = eqx.field(static=True, default=())
    # stray capacitance whose current I contains, F, unless it is a free parameter; None means none
    stray: ArrayLike | None = None
    compression: Compression | Interpolation | None = None  # None means that all samples are summed
    expansion: StudentExpansion | None = None  # of Student-t noise around an optimum, with weighted samples

    @property
    def channel(self) -> Channel:
        """Name of the channel: "Vsc", "I" or "Ft"; of a spectrum what it holds."""
        return self.observable.channel

    @property
    def timing(self) -> DriveTiming:
        """Delay and clock against the drive."""
        return self.observable.timing

    @property
    def electrical(self) -> ElectricalSignal:
        """Vsc or I in time, of which the observable is made; TypeError for a spectrum."""
        return self.observable.electrical

    @property
    def may_curve_drive(self) -> bool:
        """Whether a recorded drive may be curved between its samples; that of a limited current is estimated."""
        if "delay" not in self.timing.free or not self.observable.follows_samples or self.samples.has_drive_noise:
            return False
        return self.electrical.smooth is not None

    @property
    def shifts_response(self) -> bool:
        """Whether a delay or clock error shifts the response; rows of charge are shifted to first order."""
        return bool(self.timing.free) and self.samples.charges is None

    def count_short(self, tau: Float[np.ndarray, " terms"]) -> int:
        """Return of how many time constants (s) a few steps of the drive give the delayed response.

        They are below `SHORT_TAU` time steps. The way of a table, back from a sample, would lose their digits.
        """
        if not self.shifts_response or not self.observable.follows_samples:
            return 0
        return int(np.count_nonzero(np.asarray(tau) < SHORT_TAU * self.timing.step))

    def count_untabulated(self, tau: Float[np.ndarray, " terms"]) -> int:
        """Return how many of the time constants (s), the fastest, are in no table: short ones, and lags of I."""
        return self.count_short(tau) + self.electrical.lags

    def qualified_name(self, name: str) -> str:
        """Return the name of a nuisance, followed by the channel's label if there are several channels."""
        return f"{name}_{self.label}" if self.label else name

    @property
    def letter(self) -> str:
        """The label without the number of the record: "" for Vsc, "I", "Ft", "Z" for an impedance, "H" for a gain."""
        return self.label.rstrip("_0123456789")

    def timing_unit(self, name: str) -> ArrayLike:
        """Return the unit of a coordinate of `TIMING_NUISANCES`: in s for a delay, relative for a clock."""
        time, step = self.samples.time, self.timing.step
        return step if name == "delay" else 2.0 * step / (time[-1] - time[0])

    def timing_mean(self, name: str) -> ArrayLike:
        """Return the prior mean of a coordinate of `TIMING_NUISANCES`: nothing is late, from wherever a fit starts.

        A stated drive is late by what it was found to be.
        """
        return -self.timing.shift / self.timing_unit(name) if self.observable.follows_samples else 0.0

    def replace_samples(self, **changes: Any) -> Self:
        """Return the channel with other fields of its samples."""
        return dataclasses.replace(self, samples=dataclasses.replace(self.samples, **changes))

    def replace_observable(self, **changes: Any) -> Self:
        """Return the channel with other fields of its observable."""
        return dataclasses.replace(self, observable=dataclasses.replace(self.observable, **changes))

    def replace_timing(self, **changes: Any) -> Self:
        """Return the channel with other fields of its timing."""
        return self.replace_observable(timing=dataclasses.replace(self.timing, **changes))

    def set_noise_gain(self, terms: HighpassTerms) -> Self:
        """Return the channel in which the noise of a recorded V has the gain of a circuit, whose `terms` these are."""
        gain = np.asarray(terms.gain_in_step(self.timing.step), dtype=float)
        return self.replace_observable(noise_gain=gain)

    def without_compression(self) -> Self:
        return dataclasses.replace(self, compression=None, expansion=None)

    def drop_unused_columns(self) -> Self:
        """Return the channel without the columns of linear nuisances that are not free."""
        return dataclasses.replace(self, columns=tuple(np.flatnonzero(np.asarray(self.linear_sd)).tolist()))

    @property
    def is_student(self) -> bool:
        """Whether residuals have a Student-t distribution, and not its expansion."""
        return self.noise == "student" and self.expansion is None

    @property
    def count(self) -> ArrayLike:
        """Number of samples that count."""
        return self.samples.count if self.compression is None else self.compression.samples

    @property
    def rows(self) -> int:
        """Number of rows (samples or coordinates) in an evaluation."""
        return self.samples.time.size if self.compression is None else self.compression.observed.size

    def exclude_samples(self, excluded: Bool[np.ndarray, " samples"]) -> Self:
        """Return the channel without some of its samples; a compression must be made anew."""
        return dataclasses.replace(self, samples=self.samples.exclude(excluded))

    def exclude_unknown_drive(self) -> Self:
        """Return the channel without the samples at the ends that may follow, by a delay, a V beyond the record."""
        if not self.observable.follows_samples:
            return self
        index = np.arange(self.samples.time.size)
        return self.exclude_samples((index < MAX_DELAY) | (index >= self.samples.size - MAX_DELAY))

    def without_samples(self) -> Self:
        """Return the channel with only two samples if it has a compression.

        Code compiled for it then serves records of any length.
        """
        return self if self.compression is None else self.keep_ends()

    def keep_ends(self) -> Self:
        """Return the channel with only its first and last sample."""
        return dataclasses.replace(self, samples=self.samples.keep_ends(), observable=self.observable.keep_ends())

    def select(self, part: Int[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> Self:
        """Return the channel with only the samples `part`, with new weights and white noise."""
        return dataclasses.replace(self.without_compression(), samples=self.samples.select(part, weight))

    def thin(self, count: int) -> Self:
        """Return the channel with `count` of its samples, the ends among them, and white noise."""
        return dataclasses.replace(self.without_compression(), samples=self.samples.thin(count))

    def signal(self, inputs: ChannelInputs, samples: PaddedSamples | None = None) -> Float[Array, " samples"]:
        """Return the modelled signal without linear nuisances and noise, at the channel's or at other `samples`."""
        samples = self.samples if samples is None else samples
        total = self.observable.response(samples, inputs)
        return total if inputs.effects is None else total + inputs.effects @ samples.effects

    def shapes(self, inputs: ChannelInputs) -> Float[Array, "nuisances samples"]:
        """Return the shapes in time of the linear nuisances, each of height 1."""
        baseline = baseline_functions(self.samples.time, *self.samples.middle_and_half)
        return jnp.concatenate([baseline, self.observable.linear_shapes(self.samples, inputs)])

    @property
    def _column_indices(self) -> np.ndarray:
        return np.array(self.columns, dtype=int)

    @property
    def column_sd(self) -> Float[Array, " columns"]:
        """Prior standard deviations of the nuisances of the `columns`; 0 for those that are not free."""
        return self.linear_sd[self._column_indices]

    def residuals_and_shapes(self, inputs: ChannelInputs) -> tuple[Float[Array, " rows"], Float[Array, "columns rows"]]:
        """Return channel minus signal, and the shapes of the `columns`, both whitened, over samples or coordinates."""
        return self._evaluate_rows(inputs)[:2]

    def _evaluate_rows(
        self, inputs: ChannelInputs
    ) -> tuple[Float[Array, " rows"], Float[Array, "columns rows"], ArrayLike]:
        """Return `residuals_and_shapes`, and whether the compression holds."""
        samples, table = self.samples, self.compression
        if table is None:
            whiten = samples.apply_whitening if samples.charges is None else samples.charges.whiten
            rows = self.remainder_and_shapes if samples.charges is None else self.rows_and_shapes
            remainder, shapes = rows(inputs)
            return whiten(remainder), whiten(shapes), True
        shapes = [table.baseline]
        if isinstance(table, Interpolation):
            signal, holds = self._interpolated_signal(table, inputs)
        else:
            terms = self.electrical.terms(inputs)
            signal, holds = self._tabulated_signal(table, inputs, terms)
            if not isinstance(table, GridCompression):
                taus = terms.without_fastest(table.short).tau  # those decay before the first sample that counts
                shapes += [table.decays(tau, index)[None] for index, tau in enumerate(taus)]
        missing = len(LINEAR_NUISANCES) - sum(map(len, shapes))
        shapes.append(jnp.zeros((missing, signal.size)))
        return table.observed - signal, jnp.concatenate(shapes)[self._column_indices], holds

    def remainder_and_shapes(
        self, inputs: ChannelInputs
    ) -> tuple[Float[Array, " samples"], Float[Array, "columns samples"]]:
        """Return channel minus signal, and the shapes of the `columns`, over the samples, before whitening."""
        return self.samples.observed - self.signal(inputs), self.shapes(inputs)[self._column_indices]

    def rows_and_shapes(
        self, inputs: ChannelInputs
    ) -> tuple[Float[Array, " samples"], Float[Array, "columns samples"]]:
        """Return rows minus those of the signal, and the rows of the shapes of the `columns`, before whitening."""
        charges, electrical = self.samples.charges, self.electrical
        assert charges is not None
        assert isinstance(electrical.drive, Sampled)
        pair, jump, rate = electrical.response_and_fall(inputs, electrical.drive.time)
        if inputs.effects is not None:
            pair = pair.at[0].add(inputs.effects @ self.samples.effects / inputs.gain)
        functions = jnp.concatenate([pair, self.shapes(inputs)[self._column_indices]])
        signal, falling, *shapes = charges.means(jnp.pad(functions, ((0, 0), (charges.reach, 0))))
        later = signal + inputs.delay * (falling - jump * charges.rate)
        if rate is not None:
            later = later + rate * (charges.rate - inputs.delay * charges.bend)
        remainder = charges.observed - inputs.gain * later
        return remainder, jnp.reshape(jnp.asarray(shapes), (len(self.columns), remainder.size))

    def _interpolated_signal(self, points: Interpolation, inputs: ChannelInputs) -> tuple[Float[Array, " rows"], Array]:
        """Return the signal in the coordinates of an interpolation, and whether it holds there."""
        at_points = {"time": points.time, "rate": points.rate, "effects": points.effects}
        signal = self.signal(inputs, dataclasses.replace(self.samples, phases=None, **at_points))
        timing = jnp.stack([jnp.asarray(inputs.delay), jnp.asarray(inputs.clock)])
        return points.to_rows @ signal, points.holds(signal, timing)

    def _tabulated_signal(
        self, table: Compression, inputs: ChannelInputs, terms: HighpassTerms
    ) -> tuple[Float[Array, " rows"], Array]:
        """Return the signal in the coordinates of a table, and whether the table covers it."""
        delay = self.timing.shift + inputs.delay
        covered = table.covers(jnp.stack(jnp.broadcast_arrays(*terms.tau)), delay)
        response = inputs.gain * table.response(terms, delay, self.electrical.noise_gain / inputs.gain)
        if self.samples.charges is not None:
            response = response + inputs.gain * inputs.delay * table.rows_delay_derivative(terms)
        if inputs.effects is not None:
            response = response + inputs.effects @ table.effects
        return response, jnp.all(covered)

    def whitened_observed(self) -> Float[Array, " rows"]:
        """Return the record, over samples or coordinates, in units of independent noise of equal sd."""
        samples = self.samples
        if self.compression is not None:
            return self.compression.observed
        if samples.charges is not None:
            return samples.charges.whiten(samples.charges.observed)
        return samples.apply_whitening(samples.observed)

    def whitened_delay_derivative(self, inputs: ChannelInputs) -> Float[Array, " rows"]:
        """Return the whitened derivative of the signal with respect to a delay, over samples or coordinates."""
        if self.samples.charges is not None:  # whose delay is no optional nuisance
            return jnp.zeros(self.rows)
        if self.compression is None:
            return self.samples.apply_whitening(self.observable.delay_derivative(self.samples, inputs))
        if isinstance(self.compression, Interpolation | GridCompression):
            return self.compression.slope
        return inputs.gain * self.compression.delay_derivative(inputs.circuit.channel_terms(self.channel))

    def fit_nuisances(
        self, inputs: ChannelInputs, sigma: ArrayLike
    ) -> tuple[Float[Array, " rows"], Float[Array, " columns"], Float[Array, "columns columns"]]:
        """Fit the linear nuisances, given all other parameters.

        Returns the whitened residuals, the coefficients in prior standard deviations, and the Cholesky factor of
        the posterior precision of the coefficients.
        """
        return self.fit_rows(*self.residuals_and_shapes(inputs), sigma)

    def fit_rows(
        self, remainder: Float[Array, " rows"], shapes: Float[Array, "columns rows"], sigma: ArrayLike
    ) -> tuple[Float[Array, " rows"], Float[Array, " columns"], Float[Array, "columns columns"]]:
        """Return `fit_nuisances` from the whitened `residuals_and_shapes`."""
        if self.expansion is not None and isinstance(self.compression, Compression):
            sigma, log_sigma = self.expansion.normal_sigma(sigma)
            remainder = remainder + log_sigma * self.compression.observed_slope
        A = self.column_sd[:, None] * shapes
        # keeps XLA from computing both again at each use
        remainder, A = lax.optimization_barrier((remainder, A))
        precision = jnp.eye(len(A)) + A @ A.T / sigma**2
        factor = jnp.linalg.cholesky(precision)
        fixed = lax.stop_gradient(factor)  # the derivative of a solution does not need that of the factor
        beta = lax.custom_linear_solve(
            lambda x: precision @ x,
            A @ remainder / sigma**2,
            lambda _, y: solve_lower(fixed, solve_lower(fixed, y), transposed=True),
            symmetric=True,
        )
        if not self.is_student:
            return remainder - beta @ A, beta, factor
        return self._fit_nuisances_student(remainder, A, beta, sigma)

    def _fit_nuisances_student(
        self, residuals: Array, A: Array, beta: Array, sigma: ArrayLike, steps: int = 12
    ) -> tuple[Float[Array, " rows"], Float[Array, " columns"], Float[Array, "columns columns"]]:
        """Return `fit_nuisances` for Student-t noise in Laplace's approximation, starting from the Gaussian `beta`.

        Each of the `steps` of reweighting gains half a digit.
        """
        one = jnp.eye(len(A))

        def step(_: int, beta: Array) -> Array:
            weighted = A * student_weight((residuals - beta @ A) / sigma)
            return jnp.linalg.solve(one + weighted @ A.T / sigma**2, weighted @ residuals / sigma**2)

        beta = lax.fori_loop(0, steps, step, beta)
        remainder = residuals - beta @ A
        curvature = jnp.maximum(self.samples.mean(student_curvature(remainder / sigma)), 0.0)
        return remainder, beta, jnp.linalg.cholesky(one + curvature * A @ A.T / sigma**2)

    def sample_nuisances(
        self, inputs: ChannelInputs, sigma: ArrayLike, deviate: Float[Array, " nuisances"] | None = None
    ) -> Float[Array, " nuisances"]:
        """Return posterior draws of the nuisance coefficients, in prior standard deviations.

        `deviate` holds standard normal numbers; None gives the posterior mean.
        """
        _, beta, factor = self.fit_nuisances(inputs, sigma)
        if deviate is not None:
            beta = beta + solve_lower(factor, deviate[self._column_indices], transposed=True)
        return jnp.zeros(len(LINEAR_NUISANCES)).at[self._column_indices].set(beta)

    def residuals(self, inputs: ChannelInputs, sigma: ArrayLike) -> Float[Array, " rows+columns"]:
        """Return whitened residuals, priors of nuisances included; half their sum of squares is -log-likelihood."""
        remainder, beta, _ = self.fit_nuisances(inputs, sigma)
        whitened = remainder / (sigma if self.expansion is None else self.expansion.normal_sigma(sigma)[0])
        return jnp.concatenate([student_residual(whitened) if self.is_student else whitened, beta])

    def log_likelihood(self, inputs: ChannelInputs, log_sigma: ArrayLike) -> Float[Array, ""]:
        """Return the log-likelihood up to a constant; NaN outside the range of the compression."""
        remainder, shapes, holds = self._evaluate_rows(inputs)
        remainder, beta, factor = self.fit_rows(remainder, shapes, jnp.exp(log_sigma))
        if self.is_student:
            misfit = jnp.sum(jnp.square(student_residual(remainder * jnp.exp(-log_sigma))))
        elif self.expansion is not None:
            misfit = 2.0 * self.expansion.add_misfit(remainder, jnp.exp(log_sigma))
        else:
            misfit = jnp.sum(jnp.square(remainder)) * jnp.exp(-2.0 * log_sigma)
        misfit = misfit + jnp.sum(jnp.square(beta))
        value = -0.5 * misfit - self.count * log_sigma - jnp.sum(jnp.log(jnp.diagonal(factor)))
        return value if self.compression is None else jnp.where(holds, value, jnp.nan)


# programs for any channel
compiled_signal = jit(ChannelLikelihood.signal)
compiled_fit_nuisances = jit(ChannelLikelihood.fit_nuisances)
