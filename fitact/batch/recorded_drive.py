"""Least-squares fits of records on one time grid, each with its own recorded drive, in batches."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from fitact.batch.batch_problem import SAMPLE_BLOCK, BatchFit, BatchProblem, Screening, stack_channel
from fitact.batch.gauss_newton import CANDIDATES, GaussNewton, GaussNewtonResult, RecordInputs, find_optima
from fitact.batch.recorded_tables import (
    AGES,
    HALF_WIDTH,
    RECORD_BLOCK,
    TABLE_NODES,
    SharedFunctions,
    Tables,
    make_response_table,
    table_nodes,
)
from fitact.compiled import jit, map_blocks
from fitact.data.noise import rounding_noise_sd
from fitact.data.record import Record
from fitact.fitting.derived import DerivedQuantities
from fitact.fitting.least_squares import MIN_BIC_DECREASE, NUISANCES
from fitact.fitting.residual_statistics import interpolation_errors
from fitact.fitting.residual_tests import PhaseBins, ResidualTestStatistics, sum_rows
from fitact.fitting.result import Fit
from fitact.likelihood.compression import Compression
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.projection import MAX_DELAY, is_exactly_uniform
from fitact.likelihood.smooth_drive import missing_curve
from fitact.model.circuit import passes_direct_current
from fitact.model.force import force_constant
from fitact.model.response_table import ResponseTable, chebyshev
from fitact.model.skin import WithSkin
from fitact.problem.build import MIN_RELATIVE_NOISE, Problem, edge_gain_sd, smooth_recorded_drive
from fitact.problem.drive_choice import has_unresolved_edge, has_unresolved_edges
from fitact.problem.instrument_errors import log_sd


class ModelCoefficients(NamedTuple):
    """Model of a record at its optimum; coefficients multiply the functions of `Tables`."""

    fitted: Float[Array, "*records functions"]  # coefficients of the signal with its nuisances
    voltage: Float[Array, "*records functions"]  # coefficients of the voltage that generates the force
    voltage_slopes: Float[Array, "*records functions parameters"]  # derivatives of these in theta
    logs: Float[Array, "*records 3"]  # logarithms of g, of b, and of the force over the voltage squared
    log_slopes: Float[Array, "*records 3 parameters"]
    gain: Float[Array, "*records"]  # by which noise of the drive enters the channel


@dataclasses.dataclass(frozen=True)
class RecordedDriveProblem(BatchProblem):
    """Records with drives of their own, which repeat like that of a first one.

    Attributes:
        linear_sd: prior sds of the linear nuisances that all records have, relative to the height of Vsc.
        gain_sd: prior sd of log(gain) that the scene states.
        unresolved: whether the drives jump between two samples, for which a gain is free.
        evaluated: samples at which the force is evaluated, of a long record the last ones.
        repeat: the longest multiple of the drive's period up to two thirds of the record, rounded, in samples; None if
            the drive does not repeat.
    """

    large_unit, settings = 128, GaussNewton(block=32)
    shared: SharedFunctions
    linear_sd: Float[np.ndarray, " nuisances"]
    gain_sd: float
    unresolved: bool
    evaluated: slice
    repeat: int | None

    @classmethod
    def from_fit(cls, fitted: Fit, problem: Problem, count: int, max_curve: float = 1e-4) -> Self | None:
        """Make the problem for `count` records like that of a fit to `problem`, or None if batches cannot fit them.

        They have the timing of this one; a delay that nobody expected is for separate fits, and so is a drive that
        curves between its samples by more than `max_curve` of its sd, as fast tones do.
        """
        likelihood, record, choice = fitted.likelihood, fitted.record, fitted.choice
        (trace, *others), time, tau = likelihood.channels, record.time, likelihood.evaluate_circuit(fitted.theta).tau
        if others or not fitted.trusted or choice.name != "measured" or choice.steady_state:
            return None
        is_plain = trace.channel == "Vsc" and trace.noise == "white" and trace.timing.free == ("delay",)
        is_plain &= trace.timing.free == problem.likelihood.channels[0].timing.free
        has_other_model = isinstance(likelihood.template, WithSkin) or len(tau) > 1
        has_other_model |= passes_direct_current(likelihood.template)
        if has_other_model or not is_plain or time.size > cls.settings.max_samples or not is_exactly_uniform(time):
            return None
        delay = float(likelihood.to_physical(fitted.theta).get("delay", 0.0))
        origin = round(float(trace.timing.shift / trace.timing.step))
        smooth, curve = smooth_recorded_drive(record), 0.0
        if smooth is not None and not np.array_equal(smooth, np.asarray(trace.electrical.smooth)):
            curve = float(missing_curve(delay / float(trace.timing.step)))
            if interpolation_errors(smooth, 0.0) > max_curve * np.std(smooth):
                return None
        shared = SharedFunctions.from_times(time, float(tau[0]), origin, curve, record.tones)
        counted = np.flatnonzero(trace.samples.weights[: time.size] == 1.0)
        if abs(origin) > MAX_DELAY - AGES or not np.array_equal(counted, np.arange(MAX_DELAY, time.size - MAX_DELAY)):
            return None
        optional = tuple(name for name in problem.sources[0].optional_nuisances if name not in trace.timing.free)
        linear_sd = np.asarray(problem.likelihood.channels[0].linear_sd) / np.ptp(record["Vsc"])
        places = {
            *np.flatnonzero(linear_sd).tolist(),
            *(place for name in optional for place in NUISANCES.get(name, ())),
        }
        frequency, begin = record.frequency(), int(np.searchsorted(time, float(fitted.derive.time[0])))
        period = math.inf if frequency is None else 1.0 / (frequency * shared.time_step)  # samples
        # only the fields that all records share matter
        fields = dict.fromkeys((field.name for field in dataclasses.fields(Compression) if field.name != "short"), 0.0)
        fields |= {"half_width": HALF_WIDTH, "samples": counted.size, "origin": origin, "time_step": shared.time_step}
        table = Compression(**dict[str, Any]({name: np.asarray(float(value)) for name, value in fields.items()}))
        trace = trace.keep_ends().replace_timing(shift=np.asarray(delay))
        trace = dataclasses.replace(trace, columns=tuple(sorted(places)), compression=table)
        return cls(
            likelihood=likelihood.replace_channel(0, trace),
            derive=fitted.derive,
            phases=PhaseBins.from_times(time[counted], frequency),
            samples=counted.size,
            optional_nuisances=optional,
            unit=cls.choose_unit(count),
            shared=shared,
            linear_sd=linear_sd,
            gain_sd=log_sd(fitted.scene.measurement.gain_relative_sd),
            unresolved=has_unresolved_edge(record),
            evaluated=slice(begin, begin + np.trim_zeros(np.asarray(fitted.derive.weight), "b").size),
            repeat=None if frequency is None else round(max(1, math.floor(2.0 / 3.0 * time.size / period)) * period),
        )

    def includes(self, record: Record) -> bool:
        """Return whether the record has V and Vsc."""
        return "V" in record and "Vsc" in record

    def fit(self, records: Sequence[Record], whiteness: bool = True) -> BatchFit:
        """Fit `unit` records, and optionally test the residuals for structure (`whiteness`), in double precision."""
        V, Vsc = stack_channel(records, "V"), stack_channel(records, "Vsc")
        driven, screened = Screening.from_values(V, self.settings), Screening.from_values(Vsc, self.settings)
        noise_V = _drive_noise(V, driven)
        tables = Tables.from_records(self.shared, V, Vsc, noise_V)
        gain_sd = None
        if "gain" in self.names:
            edges = edge_gain_sd(float(self.shared.time_step), tables.b) if self.unresolved else np.zeros(len(V))
            gain_sd = np.hypot(self.gain_sd, edges)
        inputs, optima = self._find_optima(tables, self.starting_points(tables.g, tables.b), screened, gain_sd)
        raw = inputs._replace(table=tables.fields(in_functions=True))
        optimum = _evaluate_optima(self.derive, self.likelihood, inputs, raw, optima.theta, optima.sigma)
        weight = self.derive.weight[: self.evaluated.stop - self.evaluated.start]
        contact = weight, self.derive.coefficient, self.derive.normal_force
        square, tests, logs, gradients = _evaluate_records(
            self.shared, self.phases, self.evaluated.start, contact, whiteness, tables.b, optimum, V, Vsc, tables.smooth
        )
        expected = np.hypot(screened.noise, optimum.gain * noise_V)
        usable = tables.is_possible & screened.fine & ~screened.railed & self._is_whole_drive(V, driven)
        usable &= np.abs(optima.sum_of_squares - square) <= self.settings.max_rounding_loss * square
        interpolation = optimum.gain * interpolation_errors(V, driven.noise)
        return self.assess_optima(inputs, optima, square, tests, expected, usable, (logs, gradients), interpolation)

    def derive_record(self, record: Record, inputs: RecordInputs) -> DerivedQuantities:
        """Return the derived quantities of a record with these `inputs` and its own drive."""
        V, size = record["V"][None], self.derive.time.size
        noise = _drive_noise(V, Screening.from_values(V, self.settings))
        table = _tabulate_responses(self.shared, self.evaluated.start, size, inputs.table["center"], V[0], noise[0])
        return dataclasses.replace(super().derive_record(record, inputs), drive=table)

    def _is_whole_drive(
        self, V: Float[np.ndarray, "records samples"], driven: Screening
    ) -> Bool[np.ndarray, " records"]:
        """Return which drives are not clipped, and have edges and a period like the first one."""
        largest = np.max(np.abs(np.diff(V)), axis=1)
        whole = ~driven.railed | (driven.noise == 0.0)  # flat tops without noise are not regarded as clipped
        whole &= has_unresolved_edges(largest, driven.height) == self.unresolved
        if self.repeat is not None:
            # `repeat` is rounded, so that V is shifted by up to half a sample
            change = np.max(np.abs(V[:, self.repeat :] - V[:, : -self.repeat]), axis=1)
            whole &= change <= largest + 10.0 * driven.noise
        return whole

    def _find_optima(
        self,
        tables: Tables,
        start: Float[np.ndarray, "records parameters"],
        screened: Screening,
        gain_sd: Float[np.ndarray, " records"] | None,
    ) -> tuple[RecordInputs, GaussNewtonResult]:
        """Solve the least squares, and add nuisances to each record while the BIC favours one."""
        wide, floor = 10.0 * screened.height, MIN_RELATIVE_NOISE * screened.height  # as for a single record
        linear_sd, noise = self.linear_sd * screened.height[:, None], np.maximum(screened.noise, floor)
        fields, clock = tables.fields(), np.zeros(tables.coordinates.shape[1])
        tolerance = self.settings.first_tolerance
        while True:
            inputs = RecordInputs(fields, linear_sd, floor, gain_sd, tables.g)
            optima = find_optima(self.likelihood, self.settings, clock, np.asarray(tolerance), inputs, start, noise)
            gains, linear_sd = self.bic_decreases(optima.r_squared), linear_sd.copy()
            largest = np.max(gains, axis=1)
            for name, gain in zip(CANDIDATES, gains.T, strict=True):
                rows = np.flatnonzero((gain == largest) & (largest > MIN_BIC_DECREASE))
                if name in NUISANCES:  # delays and clocks are not added
                    linear_sd[np.ix_(rows, np.array(NUISANCES[name]))] = wide[rows, None]
            if np.array_equal(linear_sd, inputs.linear_sd) and tolerance == self.settings.loop_tolerance:
                return inputs, optima
            start, noise = optima.theta, optima.sigma  # near the next optimum
            tolerance = self.settings.loop_tolerance


def _drive_noise(V: Float[np.ndarray, "records samples"], driven: Screening) -> Float[np.ndarray, " records"]:
    """Return the sd of the noise of drives with that of their rounding, V."""
    # the ADC's steps, which take long to find, are looked for only where they may exceed the noise
    rounding = [0.0 if fine else rounding_noise_sd(v) for v, fine in zip(V, driven.fine, strict=True)]
    return np.hypot(driven.noise, rounding)


@functools.partial(jit, fast=True)
def _evaluate_optima(
    derive: DerivedQuantities,
    likelihood: Likelihood,
    inputs: RecordInputs,
    in_functions: RecordInputs,
    theta: Float[Array, "records parameters"],
    sigma: Float[Array, " records"],
) -> ModelCoefficients:
    """Evaluate the models of records at their optima; `in_functions` are the inputs in terms of the functions."""
    return jax.vmap(functools.partial(_evaluate_optimum, derive, likelihood))(inputs, in_functions, theta, sigma)


def _evaluate_optimum(
    derive: DerivedQuantities,
    likelihood: Likelihood,
    record: RecordInputs,
    in_functions: RecordInputs,
    theta: Float[Array, " parameters"],
    sigma: Float[Array, ""],
) -> ModelCoefficients:
    model, functions = record.model(likelihood), in_functions.model(likelihood).channels[0]
    channel, inputs = model.channels[0], model.channel_inputs(theta)
    _, beta, _ = channel.fit_nuisances(inputs, sigma)
    remainder, shapes = functions.residuals_and_shapes(inputs)  # of a record that is 0
    fitted = (beta * channel.column_sd) @ shapes - remainder
    assert isinstance(functions.compression, Compression)
    table = functions.compression  # whose rows are coefficients
    drive = make_response_table(table.center, table.signal, table.decay)
    derive = dataclasses.replace(derive, likelihood=model, drive=drive)

    def quantities(theta: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        circuit = model.circuit(theta)
        scale = force_constant(derive.geometry.contact(circuit))
        charges = derive.charges(circuit, theta, sigma[None])
        values = derive.voltage(circuit, theta, charges), jnp.log(jnp.stack([circuit.g, circuit.b, scale]))
        return values, values

    (voltage_slopes, log_slopes), (voltage, logs) = jax.jacfwd(quantities, has_aux=True)(theta)
    gain = jnp.abs(sum(inputs.circuit.channel_terms(channel.channel).weight))
    return ModelCoefficients(fitted, voltage, voltage_slopes, logs, log_slopes, gain)


@functools.partial(jit, fast=True)
def _evaluate_records(
    shared: SharedFunctions,
    phases: PhaseBins | None,
    begin: int,
    contact: tuple[Array, Array, Array],
    whiteness: bool,
    tau: Float[Array, " records"],
    optima: ModelCoefficients,
    V: Float[Array, "records samples"],
    Vsc: Float[Array, "records samples"],
    smooth: Float[Array, "records samples"],
) -> tuple[Array, ResidualTestStatistics | None, Array, Array]:
    """Return the residual sums of squares, statistics of the residual tests, and the moments of `_derive_record`."""

    def evaluate_record(record: tuple[Array, ModelCoefficients, Array, Array, Array]) -> tuple[Array, Array, Array]:
        center, optimum, v, vsc, smooth_v = record
        own = shared.filter_drive(v, vsc, table_nodes(center), smooth_v)
        shared_part, own_part = jnp.split(optimum.fitted, [shared.size])
        model = shared_part @ shared.fitted_functions + sum(c * row for c, row in zip(own_part, own, strict=False))
        # the voltage is not delayed, so that the steps of the drive have no part in it, nor the curve between samples
        times = slice(begin, begin + contact[0].size)
        responses = lax.cond(
            shared.curve == 0.0, lambda: own[:TABLE_NODES], lambda: shared.respond(smooth_v, table_nodes(center))
        )
        forces = _derive_record(responses[:, times], shared.functions[:, times], contact, optimum)
        return shared.select_fitted(own[-1] - model), *forces

    residuals, logs, gradients = map_blocks(evaluate_record, (tau, optima, V, Vsc, smooth), RECORD_BLOCK)
    test = functools.partial(ResidualTestStatistics.from_residuals, phase_bins=phases)
    tests = map_blocks(test, residuals.astype(jnp.float32), SAMPLE_BLOCK) if whiteness else None
    return sum_rows(residuals * residuals), tests, logs, gradients


def _derive_record(
    own: Float[Array, "nodes times"],
    shared: Float[Array, "shared times"],
    contact: tuple[Array, Array, Array],
    optimum: ModelCoefficients,
) -> tuple[Float[Array, " derived"], Float[Array, "derived parameters"]]:
    """Return the logarithms of the quantities of `DERIVED_NAMES`, and their gradients in theta."""
    (weight, coefficient, normal_force), size = contact, len(shared)
    coefficients, slopes = (x[: size + len(own)] for x in (optimum.voltage, optimum.voltage_slopes))
    voltage = coefficients[:size] @ shared + sum(c * row for c, row in zip(coefficients[size:], own, strict=True))
    square = voltage * voltage
    # faster than `argmax`
    peak = jnp.min(jnp.where(square == jnp.max(square), np.arange(square.size), square.size - 1))
    mean, fourth = square @ weight, jnp.square(square) @ weight
    # inner products of the functions with V and V^3 give the slopes of the means of V^2 and V^4
    weighted = jnp.stack([weight * voltage, weight * voltage * square])
    mean_slope, fourth_slope = jnp.concatenate([shared @ weighted.T, own @ weighted.T]).T @ slopes
    peak_slope = jnp.concatenate([shared[:, peak], own[:, peak]]) @ slopes / voltage[peak]
    (log_g, log_b, scale), (g_slope, b_slope, scale_slope) = optimum.logs, optimum.log_slopes
    force, force_slope = jnp.exp(scale) * mean, scale_slope + 2.0 * mean_slope / mean
    total = force + normal_force
    logs = [
        *(log_g, log_b, jnp.log(force), scale + jnp.log(square[peak]), scale + 0.5 * jnp.log(fourth)),
        jnp.log(coefficient * total),
    ]
    gradients = [
        *(g_slope, b_slope, force_slope, scale_slope + 2.0 * peak_slope, scale_slope + 2.0 * fourth_slope / fourth),
        force_slope * force / total,
    ]
    return jnp.stack(logs), jnp.stack(gradients)


@functools.partial(jit, fast=True)
def _tabulate_responses(
    shared: SharedFunctions, begin: int, count: int, center: Array, V: Float[Array, " samples"], noise: Array
) -> ResponseTable:
    """Return the table of a record, padded to `count` times; `noise` is the sd of that of V."""
    series, nodes = chebyshev(TABLE_NODES)[1].T, table_nodes(jnp.exp(center))
    own = shared.respond(shared.smooth_drive(V, noise), nodes)
    decays = (shared.decay @ shared.decay_polynomials(nodes)).T @ shared.functions
    signal, decay = (
        jnp.pad(series.T @ each[:, begin : begin + count], ((0, 0), (0, max(begin + count - V.size, 0)))).T
        for each in (own, decays)
    )
    return make_response_table(center, signal, decay)
