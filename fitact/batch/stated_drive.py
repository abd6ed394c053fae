"""Least-squares fits of records with a common scene, stated drive and time grid, in batches."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitact.batch.batch_problem import SAMPLE_BLOCK, BatchFit, BatchProblem, Screening, split_rows, stack_channel
from fitact.batch.gauss_newton import GaussNewtonResult, RecordInputs, find_optima
from fitact.batch.shared_basis import SharedBasis
from fitact.compiled import jit, map_blocks
from fitact.data.record import Record
from fitact.fitting import derived
from fitact.fitting.derived import DerivedQuantities, log_derivatives
from fitact.fitting.residual_tests import PhaseBins, ResidualTestStatistics, sum_rows
from fitact.likelihood.observable import LINEAR_NUISANCES
from fitact.model.chirp import Chirp
from fitact.model.circuit import passes_direct_current
from fitact.model.skin import WithSkin
from fitact.problem.build import MIN_RELATIVE_NOISE, Problem
from fitact.problem.starting_point import VscEstimate

_CHUNK = 64  # records whose samples are processed together, so that they stay in the processor's cache


@dataclasses.dataclass(frozen=True)
class StatedDriveProblem(BatchProblem):
    """Records under one drive, which share a `basis`; a record that needs a nuisance is fitted separately."""

    large_unit = 256
    basis: SharedBasis
    voltage: Float[np.ndarray, " samples"]  # drive at the samples, V

    @classmethod
    def from_problem(cls, problem: Problem, count: int) -> Self | None:
        """Make the problem for `count` records like the one of `problem`, or None if batches cannot fit them.

        Double precision is required.
        """
        likelihood, (source, *others) = problem.likelihood, problem.sources
        (trace, *_), choice, start = likelihood.channels, source.choice, source.start
        if (
            others
            or not isinstance(start, VscEstimate)
            or not math.isfinite(start.b)
            or trace.samples.size > cls.settings.max_samples
        ):
            return None
        is_plain = trace.channel == "Vsc" and trace.noise == "white"
        is_plain &= trace.samples.equally_weighted and not trace.timing.free
        has_other_model = isinstance(likelihood.template, WithSkin) or isinstance(choice.drive, Chirp)
        has_other_model |= passes_direct_current(likelihood.template)
        has_nuisances = (
            bool(np.any(np.asarray(trace.linear_sd))) or bool(choice.notes or choice.warnings) or choice.shift != 0.0
        )
        if not is_plain or has_other_model or has_nuisances or choice.name == "measured":
            return None
        record = source.in_time
        time = record.time
        basis = SharedBasis.from_drive(choice.drive, time, choice.steady_state, start.b)
        shared = dataclasses.replace(trace, compression=basis.compression, columns=()).without_samples()
        return cls(
            likelihood=likelihood.replace_channel(0, shared),
            derive=derived.derived_from_fit(likelihood, record, choice, source.scene, start.b),
            phases=PhaseBins.from_times(time, record.frequency() if choice.periodic else None),
            samples=time.size,
            optional_nuisances=source.optional_nuisances,
            unit=cls.choose_unit(count),
            basis=basis,
            voltage=choice.voltage,
        )

    def includes(self, record: Record, tolerance: float = 0.01) -> bool:
        """Return whether the record has no V, or a V equal to the drive's within a relative rms of `tolerance`."""
        if "Vsc" not in record or "V" not in record:
            return "Vsc" in record
        difference = record["V"] - self.voltage
        return bool(difference @ difference <= tolerance**2 * (self.voltage @ self.voltage))

    def fit(self, records: Sequence[Record], whiteness: bool = True) -> BatchFit:
        """Fit `unit` records, and optionally test the residuals for structure (`whiteness`), in double precision."""
        observed = stack_channel(records, "Vsc")
        screened = [Screening.from_values(part, self.settings) for part in split_rows(observed, _CHUNK)]
        noise, height, fine, railed = map(np.concatenate, zip(*screened, strict=True))
        coordinates = self.basis.project(observed)
        inputs = self.make_inputs(coordinates, MIN_RELATIVE_NOISE * height)
        optima, in_table = self.find_optima(inputs, noise)
        log_derived = _log_derived(self.derive, optima.theta)
        square, tests = optima.sum_of_squares, None
        if whiteness:
            fitted, functions = optima.fitted[:, : len(self.basis.compression.signal)], self.basis.functions
            from_samples, tests = _residual_statistics(functions, self.phases, fitted, observed)
            loss = np.abs(square - from_samples)
        else:
            # relative to the square of the record; 12 eps was observed
            loss = 32.0 * np.finfo(float).eps * np.vecdot(coordinates, coordinates)
        usable = in_table & fine & ~railed & (loss <= self.settings.max_rounding_loss * square)
        return self.assess_optima(inputs, optima, square, tests, noise, usable, log_derived)

    @staticmethod
    def make_inputs(
        coordinates: Float[np.ndarray, "records coordinates+1"], noise_floor: Float[np.ndarray, " records"]
    ) -> RecordInputs:
        """Return the inputs of the least squares for coordinates in `basis`; `noise_floor` in V."""
        return RecordInputs({"observed": coordinates}, np.zeros((len(coordinates), len(LINEAR_NUISANCES))), noise_floor)

    def find_optima(
        self,
        inputs: RecordInputs,
        noise: Float[np.ndarray, " records"],
    ) -> tuple[GaussNewtonResult, Bool[np.ndarray, " records"]]:
        """Solve the least squares, and return which records the table covers; sigma starts at `noise` (V)."""
        tau, signal, size = self._table_responses
        coordinates = inputs.table["observed"]
        products = coordinates[:, : len(signal)] @ signal
        best = np.argmax(np.where(products > 0.0, products**2 / size, -1.0), axis=1)
        highest = products[np.arange(len(best)), best]
        in_table = (best > 0) & (best < len(tau) - 1) & (highest > 0.0)
        start = self.starting_points(highest / size[best], tau[best])
        clock, tolerance = self.basis.clock, np.asarray(self.settings.loop_tolerance)
        noise = np.maximum(noise, inputs.noise_floor)
        return find_optima(self.likelihood, self.settings, clock, tolerance, inputs, start, noise), in_table

    @functools.cached_property
    def _table_responses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time constants across the table (s), their responses to the drive (in columns), and the squared responses."""
        x = np.linspace(-1.0, 1.0, 257)
        table = self.basis.compression
        signal = table.signal @ np.polynomial.chebyshev.chebvander(x, table.signal.shape[1] - 1).T
        return np.exp(table.center + table.half_width * x), signal, np.einsum("ij,ij->j", signal, signal)


@functools.partial(jit, fast=True)
def _residual_statistics(
    functions: Array, phases: PhaseBins | None, fitted: Float[Array, "records rank"], observed: Array
) -> tuple[Float[Array, " records"], ResidualTestStatistics]:
    """Return the residual sums of squares over the samples, and statistics of the residual tests.

    Single precision suffices for the tests, and to notice a loss of digits in the coordinates.
    """
    signal = functions[:, : fitted.shape[1]].astype(jnp.float32).T

    def test_record(record: tuple[Array, Array]) -> tuple[Array, ResidualTestStatistics]:
        coefficients, values = record
        residuals = values.astype(jnp.float32) - coefficients.astype(jnp.float32) @ signal
        return sum_rows(residuals * residuals), ResidualTestStatistics.from_residuals(residuals, phases)

    return map_blocks(test_record, (fitted, observed), SAMPLE_BLOCK)


@functools.partial(jit, fast=True)
def _log_derived(derive: DerivedQuantities, theta: Array) -> tuple[Array, Array]:
    logs, (gradients, _) = jax.vmap(lambda theta: log_derivatives(derive, theta, None))(theta)
    return logs, gradients
