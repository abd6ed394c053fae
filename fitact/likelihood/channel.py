"""Likelihood of one channel of one record, with the linear nuisances integrated out.

The channel is  gain * response(t - delay) + A beta + noise,  where t is the time on the drive's clock.
The columns of A are an offset, a drift, mains hum and, for a measured drive, the decays of the unknown charges at
the first sample. Their coefficients have wide normal priors and are integrated out exactly.

For Gaussian noise the likelihood depends only on inner products over the samples. The same formulas therefore apply
to the coordinates of a `fitact.likelihood.compression.Compression` and to the samples themselves.
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from fitact.compiled import array_module, pad_samples, pad_weight, solve_lower
from fitact.likelihood.charge_rows import ChargeRows
from fitact.likelihood.compression import BASELINE_NAMES, Compression, GridCompression, Interpolation
from fitact.likelihood.noise import (
    NoiseModel,
    StudentExpansion,
    Whitening,
    student_curvature,
    student_residual,
    student_weight,
)
from fitact.likelihood.projection import MAX_DELAY, baseline_functions
from fitact.model.circuit import Channel, Circuit, HighpassTerms
from fitact.model.drive import Drive, Sampled
from fitact.model.response import highpass, response_and_rate
from fitact.model.skin import WithSkin

CHARGES = ("charge", "charge_2", "charge_3", "charge_4")  # one for each time constant, the slowest first
LINEAR_NUISANCES = (*BASELINE_NAMES, *CHARGES)
FIRST_CHARGE = len(BASELINE_NAMES)
TIMING_NUISANCES = ("delay", "clock")


class ChannelInputs(eqx.Module):
    """Quantities of a channel that depend on the parameters."""

    circuit: Circuit  # at the parameters
    gain: ArrayLike = 1.0  # of the channel
    delay: ArrayLike = 0.0  # beyond the channel's `shift`, s
    # relative error of the drive's frequency on the recorder's clock; added to the channel's `clock`
    clock: ArrayLike = 0.0
    effects: Float[Array, " effects"] | None = None  # sizes of the channel's `effects`
    friction: dict[str, ArrayLike] | None = None  # free parameters of a `FrictionChannel`, SI
    drive_gain: ArrayLike = 1.0  # ratio between indicated and true V, where it does not act through `gain`
    stray: ArrayLike | None = None  # capacitance from the lead to ground, whose current I contains, F


class ChannelLikelihood(eqx.Module):
    """One channel of one record and its drive, padded by `fitact.compiled`."""

    time: Float[Array, " samples"]  # s
    observed: Float[Array, " samples"]  # V or A
    # inverse noise sd of each sample, relative to the channel's; 0 excludes a sample, None means equal weights
    weight: Float[Array, " samples"] | None
    whitening: Whitening | None  # filter for coloured noise; None means white noise
    noise_floor: ArrayLike  # lower bound of the noise sd, in the channel's unit
    rate: Float[Array, " samples"] | None  # dV/dt at the samples, V/s, if the current follows it
    drive: Drive  # V(t)
    # prior standard deviations of the `LINEAR_NUISANCES`, in the channel's unit (drift: over half the record);
    # 0 excludes a nuisance
    linear_sd: Float[Array, " nuisances"]
    shift: ArrayLike  # start of the drive after the record's t = 0, s
    clock: ArrayLike  # relative error of the drive's frequency
    time_step: ArrayLike  # s
    # prior standard deviations of `TIMING_NUISANCES`, in time steps (clock: over half the record)
    timing_sd: Float[Array, "2"]
    compression: Compression | Interpolation | None  # projection of the record; None means that all samples are summed
    expansion: StudentExpansion | None  # of Student-t noise around an optimum; the compression has weighted samples
    label: str = eqx.field(static=True)  # "", or a name that distinguishes it from other channels, e.g. "I_2"
    channel: Channel = eqx.field(static=True)  # "Vsc", "I" or "Ft"
    steady_state: bool = eqx.field(static=True)  # or from rest
    timing: tuple[str, ...] = eqx.field(static=True)  # the `TIMING_NUISANCES` that are parameters, in their order
    noise: NoiseModel = eqx.field(static=True)  # noise model
    # indices of the `LINEAR_NUISANCES` in use; `linear_sd` of the others is 0
    columns: tuple[int, ...] = eqx.field(static=True)
    # names of the coordinates that act on the channel's gain, each with its power
    gains: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    drive_gains: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())  # the same for the indicated V
    # small errors of the instruments, each in proportion to its size, over the samples (V or A); None means none
    effects: Float[Array, "effects samples"] | None = None
    # name of each effect, and coordinates whose product (each with its power), minus 1, is its size
    effect_sizes: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = eqx.field(static=True, default=())
    # times of the first period (padded, s) and its number of samples, if the signal need be computed only there
    phases: Float[Array, " phases"] | None = None
    period: ArrayLike | None = None
    # stray capacitance whose current I contains, F, unless it is a free parameter; None means none
    stray: ArrayLike | None = None
    # rows of a current whose drive was recorded, with its noise; `drive` is then an estimate of the drive
    charges: ChargeRows | None = None
    smooth: Float[Array, " samples"] | None = None  # recorded drive as a delay shifts it (`smooth_drive`), V

    @property
    def linear_names(self) -> tuple[str, ...]:
        """Names of the linear nuisances, in the order of `LINEAR_NUISANCES`."""
        return LINEAR_NUISANCES

    def qualified_name(self, name: str) -> str:
        """Return the name of a nuisance, followed by the channel's label if there are several channels."""
        return f"{name}_{self.label}" if self.label else name

    @property
    def letter(self) -> str:
        """The label without the number of the record: "" for Vsc, "I", "Ft", "Z" for an impedance, "H" for a gain."""
        return self.label.rstrip("_0123456789")

    def timing_unit(self, name: str) -> ArrayLike:
        """Return the unit of a coordinate of `TIMING_NUISANCES`: in s for a delay, relative for a clock."""
        return self.time_step if name == "delay" else 2.0 * self.time_step / (self.time[-1] - self.time[0])

    def timing_mean(self, name: str) -> ArrayLike:
        """Return the prior mean of a coordinate of `TIMING_NUISANCES`: a current is not late, wherever its rows are."""
        return 0.0 if self.charges is None else -self.shift / self.timing_unit(name)

    def without_compression(self) -> "ChannelLikelihood":
        return dataclasses.replace(self, compression=None, expansion=None)

    def drop_unused_columns(self) -> "ChannelLikelihood":
        """Return the channel without the columns of linear nuisances that are not free."""
        return dataclasses.replace(self, columns=tuple(np.flatnonzero(np.asarray(self.linear_sd)).tolist()))

    @property
    def follows_samples(self) -> bool:
        """Whether the response follows a measured drive from sample to sample."""
        return isinstance(self.drive, Sampled) and not self.steady_state

    @property
    def is_student(self) -> bool:
        """Whether residuals have a Student-t distribution, and not its expansion."""
        return self.noise == "student" and self.expansion is None

    @property
    def count(self) -> ArrayLike:
        if self.compression is not None:
            return self.compression.samples
        if self.charges is not None:
            return self.charges.count
        if self.whitening is not None:
            return array_module(self.whitening.mask).count_nonzero(self.whitening.mask)
        return self.time.size if self.weight is None else array_module(self.weight).count_nonzero(self.weight)

    @property
    def rows(self) -> int:
        """Number of rows (samples or coordinates) in an evaluation."""
        return self.time.size if self.compression is None else self.compression.observed.size

    @property
    def n_samples(self) -> int:
        """Number of samples without padding."""
        time = np.asarray(self.time)
        return 1 + int(np.searchsorted(time, time[-1]))

    @property
    def weights(self) -> Float[np.ndarray, " samples"]:
        return np.ones(self.time.size) if self.weight is None else np.asarray(self.weight)

    @property
    def equally_weighted(self) -> bool:
        """Whether all samples of the record have equal, nonzero weight."""
        return self.weight is None or bool(np.all(self.weights[: self.n_samples] == 1.0))

    def exclude_samples(self, excluded: Bool[np.ndarray, " samples"]) -> "ChannelLikelihood":
        """Return the channel without some of its samples; a compression must be made anew."""
        weight, whitening = np.where(excluded, 0.0, self.weights), self.whitening
        return dataclasses.replace(self, weight=weight, whitening=whitening and whitening.exclude(excluded))

    def exclude_unknown_drive(self) -> "ChannelLikelihood":
        """Return the channel without the samples at the ends that may follow, by a delay, a V beyond the record."""
        if not self.follows_samples:
            return self
        index = np.arange(self.time.size)
        return self.exclude_samples((index < MAX_DELAY) | (index >= self.n_samples - MAX_DELAY))

    def delay_noise(self, steps: int, tau: float) -> "ChannelLikelihood":
        """Return the channel with the noise of its recorded drive `steps` samples later, as its signal is.

        The table of responses lets what was recorded grow by exp(delay / tau); this is taken back. A compression must
        be made anew.
        """
        if self.smooth is None or steps == 0:
            return self
        assert isinstance(self.drive, Sampled)
        smooth, growth = np.asarray(self.smooth), math.exp(-steps * float(self.time_step) / tau)
        noise = growth * np.roll(np.asarray(self.drive.samples) - smooth, steps)
        return dataclasses.replace(self, drive=dataclasses.replace(self.drive, samples=smooth + noise))

    def without_samples(self) -> "ChannelLikelihood":
        """Return the channel with only two samples if it has a compression.

        Code compiled for it then serves records of any length.
        """
        return self if self.compression is None else self.shorten()

    def shorten(self) -> "ChannelLikelihood":
        """Return the channel with only its first and last sample."""
        # by NumPy, since JAX would compile this for every length
        time, observed, drive = np.asarray(self.time), np.asarray(self.observed), self.drive
        if isinstance(drive, Sampled):
            drive = Sampled(np.asarray(drive.time)[:2], np.asarray(drive.samples)[:2], drive.period)
        ends, extremes = time[[0, -1]], np.array([observed.min(), observed.max()])
        rate, smooth = (None if x is None else np.zeros(2) for x in (self.rate, self.smooth))
        effects = None if self.effects is None else np.zeros((len(self.effects), 2))
        shortened = dataclasses.replace(
            self, time=ends, observed=extremes, drive=drive, rate=rate, effects=effects, smooth=smooth
        )
        charges = None if self.charges is None else jax.tree.map(lambda _: np.zeros(2), self.charges)
        return dataclasses.replace(shortened, weight=None, whitening=None, charges=charges, phases=None)

    def thin(self, count: int) -> "ChannelLikelihood":
        """Return the channel with `count` of its samples, the ends among them, and white noise."""
        counted = np.flatnonzero(self.weights[: self.n_samples] > 0.0)
        if counted.size > count:
            counted = np.random.default_rng(0).permutation(counted)[:count]  # any subset serves
        weight = np.zeros(self.n_samples)
        weight[counted] = self.weights[counted]
        part = np.unique(np.concatenate([[0, self.n_samples - 1], counted]))
        return self.select(part, weight[part])

    def select(self, part: Int[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> "ChannelLikelihood":
        """Return the channel with only the samples `part`, with new weights and white noise."""
        time, observed = (pad_samples(np.asarray(x)[part]) for x in (self.time, self.observed))
        rate, effects = (
            None if x is None else pad_samples(np.asarray(x)[..., part]) for x in (self.rate, self.effects)
        )
        return dataclasses.replace(
            self,
            time=time,
            observed=observed,
            rate=rate,
            effects=effects,
            weight=pad_weight(weight),
            whitening=None,
            compression=None,
            expansion=None,
            phases=None,
        )

    def signal(self, inputs: ChannelInputs, extra_delay: ArrayLike = 0.0) -> Float[Array, " samples"]:
        """Return the modelled signal without linear nuisances and noise; `extra_delay` (s) is added to the delay."""
        total = self._response(inputs, extra_delay)
        return total if inputs.effects is None else total + inputs.effects @ self.effects

    def _response(self, inputs: ChannelInputs, extra_delay: ArrayLike) -> Float[Array, " samples"]:
        """Return the `signal` without the effects of instruments."""
        if self.phases is not None and "clock" not in self.timing:
            folded = dataclasses.replace(self, time=self.phases, phases=None)
            return folded._response(inputs, extra_delay)[jnp.arange(self.time.size) % self.period]
        undelayed = self.charges is not None or (
            not self.timing and isinstance(extra_delay, float) and extra_delay == 0.0
        )
        if undelayed and isinstance(self.drive, Sampled) and self.drive.period is None:
            time = self.drive.time  # identical to the samples of V, so that `highpass` needs no search
        else:
            time = self.drive_time(inputs.delay + extra_delay, inputs.clock)
        if self.smooth is not None and not undelayed:
            return inputs.gain * self._delay_smooth_drive(inputs, time)
        total, rate = self._response_and_rate(inputs, time)
        if rate is not None and self.charges is not None:
            total = jnp.interp(
                self.time - (self.shift + inputs.delay), self.time, total + rate * self.charges.sample_rate()
            )
        elif rate is not None and self.rate is not None:
            total = total + rate * self.rate
        return inputs.gain * total

    def _delay_smooth_drive(self, inputs: ChannelInputs, time: Array) -> Float[Array, " samples"]:
        """Return the response at the drive's `time` to the smooth drive, and undelayed to the rest of the drive.

        The response to the rest decays, or grows, until that time, as in the table of responses.
        """
        assert isinstance(self.drive, Sampled)
        smooth = dataclasses.replace(self.drive, samples=self.smooth)
        rest = dataclasses.replace(self.drive, samples=self.drive.samples - self.smooth)
        how: dict[str, Any] = {"steady_state": self.steady_state, "channel": self.channel}
        (total, _), terms = response_and_rate(inputs.circuit, smooth, time, **how), self.terms(inputs)
        for weight, tau in zip(terms.weight, terms.tau, strict=True):
            growth = jnp.exp((self.time - time) / tau)
            total = total + weight * growth * highpass(rest, self.time, tau, steady_state=self.steady_state)
        return total if terms.direct is None else total + terms.direct * rest.value(self.time)

    def _response_and_rate(self, inputs: ChannelInputs, time: Array) -> tuple[Array, ArrayLike | None]:
        """Return the response without what follows dV/dt, and the capacitance that does (F), or None."""
        how: dict[str, Any] = {"steady_state": self.steady_state, "channel": self.channel}
        total, rate = response_and_rate(inputs.circuit, self.drive, time, **how)
        return total, rate if inputs.stray is None else (0.0 if rate is None else rate) + inputs.stray

    def terms(self, inputs: ChannelInputs) -> HighpassTerms:
        """Return the terms of the channel over V, with the stray capacitance."""
        terms = inputs.circuit.channel_terms(self.channel)
        if inputs.stray is None:
            return terms
        return terms._replace(rate=(0.0 if terms.rate is None else terms.rate) + inputs.stray)

    def drive_time(self, delay: ArrayLike, clock: ArrayLike) -> Float[Array, " samples"]:
        """Return the times of the samples on the drive's clock, s."""
        time = self.time - (self.shift + delay)
        return time * (1.0 + self.clock + clock) if "clock" in self.timing else time

    def shapes(self, inputs: ChannelInputs) -> Float[Array, "nuisances samples"]:
        """Return the shapes in time of the linear nuisances, each of height 1."""
        middle, half = 0.5 * (self.time[0] + self.time[-1]), 0.5 * (self.time[-1] - self.time[0])
        return jnp.concatenate([baseline_functions(self.time, middle, half), self.linear_shapes(inputs)])

    def linear_shapes(self, inputs: ChannelInputs) -> Float[Array, "4 samples"]:
        """Return the shapes that follow those of the baseline."""
        return self.decays(inputs.circuit, self.time)

    def decays(self, circuit: Circuit, time: Float[Array, " times"]) -> Float[Array, "4 times"]:
        """Return the decays of unknown charges at the first sample, padded with 0 (constant skins only)."""
        if isinstance(circuit, WithSkin):
            return jnp.zeros((len(CHARGES), time.size))
        since, taus = time - self.time[0], circuit.terms().tau
        decays = jnp.stack([jnp.exp(-since / tau) for tau in taus])
        return jnp.pad(decays, ((0, len(CHARGES) - len(taus)), (0, 0)))

    @property
    def _column_indices(self) -> np.ndarray:
        return np.array(self.columns, dtype=int)

    def residuals_and_shapes(self, inputs: ChannelInputs) -> tuple[Float[Array, " rows"], Float[Array, "columns rows"]]:
        """Return channel minus signal, and the shapes of the `columns`, both whitened, over samples or coordinates."""
        if self.compression is None and self.charges is not None:
            remainder, shapes = self.rows_and_shapes(inputs)
            return self.charges.whiten(remainder), self.charges.whiten(shapes)
        if self.compression is None:
            remainder, shapes = self.observed - self.signal(inputs), self.shapes(inputs)[self._column_indices]
            return self.apply_whitening(remainder), self.apply_whitening(shapes)
        remainder = self.compression.observed - self._compressed_signal(inputs)[0]
        shapes = [self.compression.baseline]
        if isinstance(self.compression, Compression) and not isinstance(self.compression, GridCompression):
            taus = inputs.circuit.channel_terms(self.channel).tau
            shapes += [self.compression.decays(tau, index)[None] for index, tau in enumerate(taus)]
        missing = len(LINEAR_NUISANCES) - sum(map(len, shapes))
        shapes.append(jnp.zeros((missing, remainder.size)))
        return remainder, jnp.concatenate(shapes)[self._column_indices]

    def rows_and_shapes(
        self, inputs: ChannelInputs
    ) -> tuple[Float[Array, " samples"], Float[Array, "columns samples"]]:
        """Return rows minus those of the signal, and the rows of the shapes of the `columns`, before whitening."""
        charges = self.charges
        assert charges is not None
        assert isinstance(self.drive, Sampled)
        total, rate = self._response_and_rate(inputs, self.drive.time)
        if inputs.effects is not None:
            total = total + inputs.effects @ self.effects / inputs.gain
        functions = jnp.concatenate([total[None], self.shapes(inputs)[self._column_indices]])
        signal, *shapes = charges.means(jnp.pad(functions, ((0, 0), (charges.reach, 0))))
        later = signal - inputs.delay * jnp.diff(signal, prepend=signal[:1]) / self.time_step  # a smooth signal
        if rate is not None:
            later = later + rate * (charges.rate - inputs.delay * charges.bend)
        remainder = charges.observed - inputs.gain * later
        return remainder, jnp.reshape(jnp.asarray(shapes), (len(self.columns), remainder.size))

    def _compressed_signal(self, inputs: ChannelInputs) -> tuple[Float[Array, " rows"], Array]:
        """Return the signal in the coordinates of the compression, and whether the compression holds there."""
        compression = self.compression
        assert compression is not None
        if isinstance(compression, Interpolation):
            at_points = {"time": compression.time, "rate": compression.rate, "effects": compression.effects}
            points = dataclasses.replace(self, phases=None, **at_points)
            signal, timing = points.signal(inputs), jnp.stack([jnp.asarray(inputs.delay), jnp.asarray(inputs.clock)])
            return compression.to_rows @ signal, compression.holds(signal, timing)
        terms, delay = self.terms(inputs), self.shift + inputs.delay
        covered = compression.covers(jnp.stack(jnp.broadcast_arrays(*terms.tau)), delay)
        response = inputs.gain * compression.response(terms, delay)
        if self.charges is not None:
            response = response + inputs.gain * inputs.delay * compression.rows_delay_derivative(terms)
        if inputs.effects is not None:
            response = response + inputs.effects @ compression.effects
        return response, jnp.all(covered)

    def apply_whitening(self, values: Float[Array, "*shape samples"]) -> Float[Array, "*shape samples"]:
        """Return values over the samples in units of independent noise of equal sd; 0 for excluded samples."""
        values = values if self.weight is None else values * self.weight
        return values if self.whitening is None else self.whitening(values)

    def whitened_observed(self) -> Float[Array, " rows"]:
        """Return the record, over samples or coordinates, in units of independent noise of equal sd."""
        if self.compression is None and self.charges is not None:
            return self.charges.whiten(self.charges.observed)
        return self.apply_whitening(self.observed) if self.compression is None else self.compression.observed

    def mean(self, values: Float[Array, " samples"]) -> Float[Array, ""]:
        return jnp.mean(values, where=None if self.weight is None else self.weight > 0.0)

    def delay_derivative(self, inputs: ChannelInputs) -> Float[Array, " samples"]:
        """Return the derivative of the signal with respect to a delay (per s) over two steps, for ideal edges."""
        step = self.time_step
        return (self.signal(inputs, step) - self.signal(inputs, -step)) / (2.0 * step)

    def whitened_delay_derivative(self, inputs: ChannelInputs) -> Float[Array, " rows"]:
        """Return the whitened `delay_derivative`, over samples or coordinates."""
        if self.charges is not None:  # whose delay is no optional nuisance
            return jnp.zeros(self.rows)
        if self.compression is None:
            return self.apply_whitening(self.delay_derivative(inputs))
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
        remainder, shapes = self.residuals_and_shapes(inputs)
        if self.expansion is not None and isinstance(self.compression, Compression):
            sigma, log_sigma = self.expansion.normal_sigma(sigma)
            remainder = remainder + log_sigma * self.compression.observed_slope
        A = self.linear_sd[self._column_indices, None] * shapes
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
        curvature = jnp.maximum(self.mean(student_curvature(remainder / sigma)), 0.0)
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
        remainder, beta, factor = self.fit_nuisances(inputs, jnp.exp(log_sigma))
        if self.is_student:
            misfit = jnp.sum(jnp.square(student_residual(remainder * jnp.exp(-log_sigma))))
        elif self.expansion is not None:
            misfit = 2.0 * self.expansion.add_misfit(remainder, jnp.exp(log_sigma))
        else:
            misfit = jnp.sum(jnp.square(remainder)) * jnp.exp(-2.0 * log_sigma)
        misfit = misfit + jnp.sum(jnp.square(beta))
        value = -0.5 * misfit - self.count * log_sigma - jnp.sum(jnp.log(jnp.diagonal(factor)))
        if self.compression is None:
            return value
        return jnp.where(self._compressed_signal(inputs)[1], value, jnp.nan)
