"""Least-squares fits of records with a common scene, drive and time grid, in batches.

Only clear cases are accepted here. A record that needs a nuisance parameter, is clipped, is not described by the model
or does not converge within a few steps is fitted separately.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from fitact.batch.shared_basis import SharedBasis
from fitact.compiled import jit
from fitact.data.record import white_noise_sds
from fitact.fitting import derived
from fitact.fitting.derived import DerivedQuantities, log_derivatives
from fitact.fitting.least_squares import MIN_BIC_DECREASE, NUISANCES, bic_decrease
from fitact.fitting.problem import MIN_RELATIVE_NOISE, Problem
from fitact.fitting.residual_statistics import is_misfit, residual_statistics
from fitact.fitting.residual_tests import PhaseBins, ResidualTestStatistics, count_true
from fitact.fitting.starting_point import most_probable_skin, prior_skin_moments
from fitact.likelihood.compression import Compression
from fitact.likelihood.likelihood import Likelihood
from fitact.model.chirp import Chirp
from fitact.model.response_table import NODES, TABLE_HALF_WIDTH, chebyshev
from fitact.model.skin import WithSkin

_CANDIDATES = (*NUISANCES, "delay", "clock")  # nuisances that a record may need


@dataclasses.dataclass(frozen=True)
class GaussNewton:
    """Settings of the least squares, and conditions for separate fits.

    Attributes:
        max_samples: record length above which a separate fit costs no more.
        max_steps: maximum number of steps of each record.
        max_log_change: maximum step in a log-parameter.
        loop_tolerance: distance to the optimum before the last step, in standard errors; this step squares it.
        tolerance: distance to the optimum after the last step, in standard errors.
        max_rounding_loss: maximum relative error of the residual sum of squares in the coordinates (very low noise).
        clock_bic_error: error of the BIC difference for a clock error, whose regressor is only approximate here.
        adc_samples: number of samples used to decide whether noise exceeds the LSB of the ADC.
        max_rail_samples: number of samples at an extreme from which saturation is suspected.
    """

    max_samples: int = 65_536
    max_steps: int = 20
    max_log_change: float = 1.0
    loop_tolerance: float = 1e-4
    tolerance: float = 1e-6
    max_rounding_loss: float = 1e-3
    clock_bic_error: float = 3.0
    adc_samples: int = 512
    max_rail_samples: int = 3


class BatchFit(NamedTuple):
    """Optima of the records of a batch, one in each row.

    Attributes:
        accepted: whether the fit is reliable; otherwise the other fields are invalid.
        coordinates: coordinates of the records from `SharedBasis.project`.
        theta, sigma, covariance_factor: see `Fit.theta`, `Fit.sigma` and `Fit.covariance_root`.
        logs, gradients: see `DerivedQuantities.log_value_and_grad`.
        figures: see `Fit.figures`.
    """

    accepted: Bool[np.ndarray, " records"]
    coordinates: Float[np.ndarray, "records coordinates+1"]
    theta: Float[np.ndarray, "records parameters"]
    sigma: Float[np.ndarray, " records"]
    covariance_factor: Float[np.ndarray, "records parameters parameters"]
    logs: Float[np.ndarray, "records derived"]
    gradients: Float[np.ndarray, "records derived parameters"]
    figures: dict[str, np.ndarray]


class GaussNewtonResult(NamedTuple):
    """Result of the least squares, for one record or many.

    Attributes:
        theta, sigma: see `Fit.theta`, `Fit.sigma`.
        sum_of_squares: residual sum of squares from the coordinates, V^2.
        r_factor: factor R of the whitened Jacobian (QR decomposition).
        r_squared: fraction of the residual sum of squares that each of `_CANDIDATES` explains.
        signal: response in the first coordinates of the basis.
        converged: whether the optimum was reached.
    """

    theta: Float[Array, "*records parameters"]
    sigma: Float[Array, "*records"]
    sum_of_squares: Float[Array, "*records"]
    r_factor: Float[Array, "*records parameters parameters"]
    r_squared: Float[Array, "*records nuisances"]
    signal: Float[Array, "*records rank"]
    converged: Bool[Array, "*records"]


@dataclasses.dataclass(frozen=True)
class BatchProblem:
    """Common data of records with the same scene, drive and time grid.

    Attributes:
        likelihood: likelihood in the coordinates of `basis`.
        phases: phase bins of the samples in the drive's period, or None if there are too few periods.
        samples: number of samples of each record.
        optional_nuisances: nuisances that a record may need.
    """

    likelihood: Likelihood
    derive: DerivedQuantities
    basis: SharedBasis
    phases: PhaseBins | None
    samples: int
    optional_nuisances: tuple[str, ...]
    settings: GaussNewton = GaussNewton()

    @classmethod
    def from_problem(cls, problem: Problem) -> "BatchProblem | None":
        """Make the problem for records like the one of `problem`, or None if they cannot be fitted in batches.

        Double precision is required.
        """
        likelihood, (source, *others) = problem.likelihood, problem.sources
        (trace, *_), choice, start = likelihood.channels, source.choice, source.start
        if others or start is None or not math.isfinite(start.b) or trace.n_samples > cls.settings.max_samples:
            return None
        is_plain = trace.channel == "Vsc" and trace.noise == "white" and trace.equally_weighted and not trace.timing
        has_other_model = isinstance(likelihood.template, WithSkin) or isinstance(choice.drive, Chirp)
        has_nuisances = (
            bool(np.any(np.asarray(trace.linear_sd))) or bool(choice.notes or choice.warnings) or choice.shift != 0.0
        )
        if not is_plain or has_other_model or has_nuisances or choice.name == "measured":
            return None
        time = source.record.time
        basis = SharedBasis.from_drive(choice.drive, time, choice.steady_state, start.b)
        shared = dataclasses.replace(trace, compression=basis.compression(time.size), columns=()).without_samples()
        derive = derived.derived_from_fit(likelihood, source.record, choice, source.scene, start.b)
        phases = PhaseBins.from_times(time, source.record.frequency() if choice.periodic else None)
        return cls(likelihood.replace_channel(0, shared), derive, basis, phases, time.size, source.optional_nuisances)

    def fit(self, observed: Sequence[Float[np.ndarray, " samples"]], whiteness: bool = True) -> BatchFit:
        """Fit records, and optionally test the residuals for structure (`whiteness`), in double precision."""
        parts = list(_chunk_records(observed))
        screened = [(*self._screen_records(part), self.basis.project(part)) for part in parts]
        noise, height, plain, coordinates = map(np.concatenate, zip(*screened, strict=True))
        optima, accepted = self.find_optima(coordinates, noise, MIN_RELATIVE_NOISE * height)
        theta, sigma, square_in_basis, r_factor, r_squared, signal, converged = map(np.asarray, optima)
        logs, gradients = map(np.asarray, _log_derived(self.derive, optima.theta, optima.sigma))
        if whiteness:
            square, tests = self._residual_statistics(parts, signal)
            loss = np.abs(square_in_basis - square)
        else:
            square, tests = square_in_basis, None
            # relative to the square of the record; 12 eps was observed
            loss = 32.0 * np.finfo(float).eps * np.vecdot(coordinates, coordinates)
        accepted &= loss <= self.settings.max_rounding_loss * square
        figures = residual_statistics(square, self.samples, tests, noise, self.samples - theta.shape[1], self.phases)
        figures |= {"rounding_noise": np.zeros(len(noise)), "interpolation_error": np.zeros(len(noise))}
        accepted &= converged & ~self._needs_nuisance(r_squared) & plain & ~is_misfit(figures)
        return BatchFit(accepted, coordinates, theta, sigma, np.linalg.inv(r_factor), logs, gradients, figures)

    def _residual_statistics(
        self, parts: Sequence[np.ndarray], signal: Float[np.ndarray, "records rank"]
    ) -> tuple[Float[np.ndarray, " records"], ResidualTestStatistics]:
        """Return the residual sums of squares over the samples, and statistics of the residual tests."""
        responses = map(self.basis.response, _chunk_records(list(signal)))
        residuals = (np.subtract(part, u, out=u) for part, u in zip(parts, responses, strict=True))
        statistics = [
            (np.vecdot(r, r), *ResidualTestStatistics.from_residuals(r.astype(np.float32), self.phases))
            for r in residuals
        ]
        square, *tests = map(np.concatenate, zip(*statistics, strict=True))
        return square, ResidualTestStatistics(*tests)

    def find_optima(
        self,
        coordinates: Float[np.ndarray, "records coordinates+1"],
        noise: Float[np.ndarray, " records"],
        noise_floor: Float[np.ndarray, " records"],
    ) -> tuple[GaussNewtonResult, Bool[np.ndarray, " records"]]:
        """Solve the least squares for `coordinates` in `basis`, and return which records the table covers.

        Sigma starts at `noise` and has the lower bound `noise_floor`, V.
        """
        theta, in_table = self._initial_estimates(coordinates)
        per_record = map(jnp.asarray, (coordinates, theta, np.maximum(noise, noise_floor), noise_floor))
        clock = jnp.asarray(np.append(self.basis.clock, 0.0))
        return _find_optima(self.likelihood, self.settings, clock, *per_record), in_table

    def _initial_estimates(
        self, coordinates: Float[np.ndarray, "records coordinates+1"]
    ) -> tuple[Float[np.ndarray, "records parameters"], Bool[np.ndarray, " records"]]:
        """Return the best node of the table for each record, on the ridge, and whether the table covers it."""
        tau, signal, size = self._table_responses
        products = coordinates[:, : len(signal)] @ signal
        best = np.argmax(np.where(products > 0.0, products**2 / size, -1.0), axis=1)
        highest = products[np.arange(len(best)), best]
        in_table = (best > 0) & (best < NODES - 1) & (highest > 0.0)
        theta = np.tile(self.likelihood.prior.log_mean, (len(best), 1))
        ridge = most_probable_skin(highest / size[best], tau[best], *self._prior_skin_moments)
        for name, logs in zip(("Rsc", "Csc", "Ci"), ridge.T, strict=True):
            if name in self.likelihood.names:
                theta[:, self.likelihood.names.index(name)] = logs
        return theta, in_table

    @functools.cached_property
    def _table_responses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time constants of the nodes (s), their responses to the drive (in columns), and the squared responses."""
        x, _ = chebyshev(NODES)
        signal = self.basis.signal @ np.polynomial.chebyshev.chebvander(x, NODES - 1).T
        return np.exp(self.basis.center + TABLE_HALF_WIDTH * x), signal, np.einsum("ij,ij->j", signal, signal)

    @functools.cached_property
    def _prior_skin_moments(self) -> tuple[np.ndarray, np.ndarray]:
        return prior_skin_moments(self.likelihood)

    @functools.cached_property
    def prior_factor(self) -> Float[np.ndarray, "parameters parameters"]:
        """Cached `prior_factor` of the likelihood."""
        return self.likelihood.prior_factor

    def _needs_nuisance(self, r_squared: Float[np.ndarray, "records nuisances"]) -> Bool[np.ndarray, " records"]:
        gains = [
            bic_decrease(share, self.samples, len(NUISANCES.get(name, (0,))))
            + (self.settings.clock_bic_error if name == "clock" else 0.0)
            for name, share in zip(_CANDIDATES, r_squared.T, strict=True)
            if name in self.optional_nuisances
        ]
        return np.max(gains, axis=0, initial=-math.inf) > MIN_BIC_DECREASE

    def _screen_records(self, observed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return noise and height of records, and whether they show neither saturation nor ADC steps."""
        noise, low, high = white_noise_sds(observed), observed.min(axis=1), observed.max(axis=1)
        steps = np.abs(np.diff(observed[:, : self.settings.adc_samples], axis=1))
        is_fine = np.any((steps > 0.0) & (steps <= noise[:, None]), axis=1)
        limit = self.settings.max_rail_samples
        is_railed = [count_true(observed == extreme[:, None]) > limit for extreme in (low, high)]
        return noise, high - low, is_fine & ~np.any(is_railed, axis=0)


def _chunk_records(rows: Sequence[np.ndarray], size: int = 64) -> Iterator[np.ndarray]:
    """Yield stacks of `size` records, whose samples fit into the processor cache."""
    for first in range(0, len(rows), size):
        part = rows[first : first + size]
        yield np.concatenate(part).reshape(len(part), -1)  # faster than `np.stack`


@jit
def _find_optima(likelihood: Likelihood, settings: GaussNewton, clock: Array, *per_record: Array) -> GaussNewtonResult:
    return jax.vmap(functools.partial(_find_optimum, likelihood, settings, clock))(*per_record)


def _find_optimum(
    likelihood: Likelihood,
    settings: GaussNewton,
    clock: Array,
    observed: Array,
    start: Array,
    noise: Array,
    noise_floor: Array,
) -> GaussNewtonResult:
    """Find the optimum by Gauss-Newton steps from a nearby start, with sigma estimated from the residuals."""
    trace = likelihood.channels[0]
    assert isinstance(trace.compression, Compression)
    table = dataclasses.replace(trace.compression, observed=observed)
    model = likelihood.replace_channel(0, dataclasses.replace(trace, compression=table))
    size = start.size

    def linearise(theta: Array, sigma: Array) -> tuple[Array, Array]:
        def whitened_residuals(theta: Array) -> Array:
            return jnp.concatenate([*model.residuals(theta, sigma[None]), model.prior_residuals(theta)])

        columns = jax.vmap(lambda axis: jax.jvp(whitened_residuals, (theta,), (axis,)), out_axes=(None, -1))
        return columns(jnp.eye(size))

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        theta, sigma, _, steps = state
        residuals, jacobian = linearise(theta, sigma)
        r_factor, projections = _qr_decompose(jacobian, residuals)
        move = -_back_substitute(r_factor, projections)
        move = move * jnp.minimum(1.0, settings.max_log_change / jnp.max(jnp.abs(move)))
        rms = sigma * jnp.linalg.norm(residuals[:-size]) / jnp.sqrt(trace.count - size)
        return theta + move, jnp.maximum(rms, noise_floor), jnp.linalg.norm(projections), steps + 1

    def should_continue(state: tuple[Array, ...]) -> Array:
        return (state[2] > settings.loop_tolerance) & (state[3] < settings.max_steps)

    theta, sigma, _, _ = lax.while_loop(should_continue, step, (start, noise, jnp.array(jnp.inf), jnp.array(0)))
    whitened, jacobian = linearise(theta, sigma)
    residuals, (r_factor, projections) = sigma * whitened[:-size], _qr_decompose(jacobian, whitened)
    is_possible = jnp.isfinite(model.log_prior(jnp.append(theta, jnp.log(sigma))))
    converged = (
        (jnp.linalg.norm(projections) <= settings.tolerance) & is_possible & table.covers(model.circuit(theta).b)
    )
    candidates = [[table.baseline[place] for place in places] for places in NUISANCES.values()]
    candidates += [[trace.whitened_delay_derivative(model.channel_inputs(theta))], [clock]]
    fitted = _orthonormalise(list(jacobian[:-size].T), [])
    shares = [sum(jnp.square(q @ residuals) for q in _orthonormalise(columns, fitted)) for columns in candidates]
    square, signal = residuals @ residuals, (observed - residuals)[: table.signal.shape[0]]
    return GaussNewtonResult(theta, sigma, square, r_factor, jnp.stack(shares) / square, signal, converged)


def _orthonormalise(columns: list[Array], others: list[Array], tolerance: float = 1e-9) -> list[Array]:
    """Make columns orthonormal to `others` and to each other, by Gram-Schmidt, applied twice.

    A column becomes 0 if at most `tolerance` of its length remains, i.e. if it is linearly dependent within rounding.
    """
    basis: list[Array] = []
    for column in columns:
        rest = column
        for _ in range(2):
            for q in (*others, *basis):
                rest = rest - (q @ rest) * q
        length = jnp.linalg.norm(rest)
        basis.append(jnp.where(length > tolerance * jnp.linalg.norm(column), rest / length, 0.0))
    return basis


def _qr_decompose(jacobian: Float[Array, "rows n"], residuals: Array) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Return R and Q^T residuals of a QR decomposition; it vectorises over many small matrices, unlike LAPACK."""
    q = jnp.stack(_orthonormalise(list(jacobian.T), [], tolerance=0.0))
    return jnp.triu(q @ jacobian), q @ residuals


def _back_substitute(r_factor: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    solution = jnp.zeros_like(rhs)
    for i in reversed(range(rhs.size)):
        solution = solution.at[i].set((rhs[i] - r_factor[i] @ solution) / r_factor[i, i])
    return solution


@jit
def _log_derived(derive: DerivedQuantities, theta: Array, sigma: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda theta, sigma: log_derivatives(derive, theta, sigma[None]))(theta, sigma)
