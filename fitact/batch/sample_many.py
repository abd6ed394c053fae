"""Separate posteriors of many records; similar ones are sampled at once, by importance sampling."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fitact.batch.batch_problem import take_rows
from fitact.batch.fit_many import (
    Batch,
    Finger,
    Fits,
    Input,
    Member,
    Row,
    failure_row,
    fit_batch,
    row_from_fit,
    run_in_threads,
    tabulate_records,
)
from fitact.batch.gauss_newton import RecordInputs
from fitact.compiled import jit, map_blocks
from fitact.fitting import derived
from fitact.fitting.derived import DerivedQuantities, derive_draw
from fitact.fitting.fit import fit
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import scale_information
from fitact.likelihood.observable import LINEAR_NUISANCES
from fitact.model.response_table import ResponseTable
from fitact.sampling.convergence import Convergence, ImportanceWeights, diagnose_weights, pareto_smooth
from fitact.sampling.ensemble import sample
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import draw_student_t, student_log_density
from fitact.scene.scene import Scene
from fitact.summary import PROBABILITIES

_BLOCK = 32  # records sampled together, padded to this number
_TRACKED = ("g", "b", "force_mean")
_CONVERGENCE_COLUMNS = ("converged", "level", "ess_min", "k_hat", "rhat_max")


def sample_many(
    records: Iterable[Input],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Fits:
    """Fit each of many records separately and sample its posterior, like `fitact.sample`.

    Rows of `fit_many` are extended by the posterior quantiles of each parameter, each derived quantity and the noise
    (e.g. `Rsc_q05`, `force_mean_q975`), and by `converged`, the method `level`, `ess_min`, `k_hat` of "psis" and
    `rhat_max` of "emcee". Rows that have not converged are not `trusted`.

    Records that are fitted in a batch are sampled 32 at once, by Pareto-smoothed importance sampling around the fit.
    The random numbers of each record depend on `seed` and its content only, so that other records hardly affect it.
    Records whose weights are unreliable, and all others, are sampled separately by emcee, like `fitact.sample` with
    this seed.

    Args:
        records: records, spectra, paths of files, or sequences of them, as in `fit_many`.
        scene: scene of all records.
        channels, scale, rate, segment: channels, sampling rate and segment of the files, as in `fitact.read`.
        seed: seed of the random numbers; the same seed gives the same rows.
        progress: whether to report the progress on standard error.

    Raises:
        InputError: the scene requests an unsupported option.
    """
    make_rows = functools.partial(_sample_rows, scene=scene, seed=seed)
    title = "sampling the posteriors" if progress else ""
    columns = {"channels": channels, "scale": scale, "rate": rate, "segment": segment}
    return tabulate_records(records, scene, columns, make_rows, title)


class _Targets(NamedTuple):
    """Posteriors of records that share a likelihood except for the tables.

    Attributes:
        members, rows: records, and rows of their fits.
        likelihood: common likelihood, some of whose fields `inputs` replace.
        tables: responses at the times of `derive`, if each record has its own drive.
        centers: optima, theta and log sigma.
        factors: factors of the covariances.
    """

    members: list[Member]
    rows: list[Row]
    likelihood: Likelihood
    derive: DerivedQuantities
    inputs: RecordInputs
    tables: ResponseTable | None
    centers: Float[np.ndarray, "records n"]
    factors: Float[np.ndarray, "records n n"]

    def subset(self, indices: Sequence[int]) -> Self:
        rows = np.array(indices)
        return self._replace(
            members=[self.members[i] for i in indices],
            rows=[self.rows[i] for i in indices],
            inputs=take_rows(self.inputs, rows),
            tables=take_rows(self.tables, rows),
            centers=self.centers[rows],
            factors=self.factors[rows],
        )


def _sample_rows(batches: Iterable[Batch], scene: Scene | None, seed: int) -> Iterator[tuple[int, Row]]:
    """Yield the number and the row of each record when it is finished."""
    jobs = (
        job
        for (_, members), targets in run_in_threads(batches, _make_targets)
        for job in _split_blocks(members, targets)
    )
    for (members, _), rows in run_in_threads(jobs, functools.partial(_sample_block, seed=seed)):
        for number, record in members:
            yield number, rows[number] if number in rows else _alone(record, scene, seed)


def _split_blocks(members: list[Member], targets: _Targets | None) -> Iterator[tuple[list[Member], _Targets | None]]:
    """Yield blocks of records to sample together, and records to sample separately."""
    numbers: set[int] = set()
    if targets is not None:
        for first in range(0, len(targets.members), _BLOCK):
            block = targets.subset(range(first, min(first + _BLOCK, len(targets.members))))
            yield block.members, block
        numbers = {number for number, _ in targets.members}
    yield [member for member in members if member[0] not in numbers], None


def _make_targets(batch: Batch) -> _Targets | None:
    """Return the accepted records of a batch, or None."""
    (problem, members), (rows, optima) = batch, fit_batch(batch)
    places = [place for place, (number, _) in enumerate(members) if number in rows]
    if problem is None or optima is None or not places:
        return None
    accepted, size = [members[place] for place in places], optima.theta.shape[1]
    factors = np.pad(optima.covariance_factor, ((0, 0), (0, 1), (0, 1)))
    factors[:, size, size] = (scale_information("white") * (problem.samples - size)) ** -0.5
    centers = np.column_stack([optima.theta, np.log(optima.sigma)])
    tables = problem.tabulate_responses(problem.pad_records(members), optima)
    selected = take_rows((optima.inputs, tables, centers, factors), np.array(places))
    return _Targets(accepted, [rows[number] for number, _ in accepted], problem.likelihood, problem.derive, *selected)


def _sample_block(
    job: tuple[list[Member], _Targets | None],
    seed: int,
    draws: int = 8192,
    derived_draws: int = 2048,
    min_effective: float = 2000.0,
) -> dict[int, Row]:
    """Sample a block, and return the rows of records whose weights are reliable and not too uneven.

    Derived quantities, which cost more, are computed for the first `derived_draws` of the draws.
    """
    members, targets = job
    if targets is None:
        return {}
    full = targets.subset([*range(len(members)), *[len(members) - 1] * (_BLOCK - len(members))])
    generators = [np.random.default_rng([seed, int(record.fingerprint, 16)]) for _, record in full.members]
    z = np.stack([draw_student_t(each, draws, full.centers.shape[1]) for each in generators])
    points = full.centers[:, None] + z @ np.swapaxes(full.factors, 1, 2)
    log_ratios = _evaluate_log_probs(full.likelihood, full.inputs, points) - student_log_density(z)
    deviates = np.stack([each.standard_normal((derived_draws, 1, len(LINEAR_NUISANCES))) for each in generators])
    some = points[:, :derived_draws]
    quantities = _derive_draws(full.derive, full.likelihood, full.inputs, full.tables, some, deviates)
    names, rows = (*full.likelihood.names, "sigma"), {}
    for i, ((number, _), row) in enumerate(zip(members, targets.rows, strict=True)):
        if np.isnan(log_ratios[i]).any():  # outside the table
            continue
        weights = pareto_smooth(log_ratios[i])
        drawn = dict(zip(names, points[i].T, strict=True)) | dict(
            zip(derived.DERIVED_NAMES, quantities[i].T, strict=True)
        )
        tracked = {name: drawn[name] for name in (*names, *_TRACKED)}
        convergence = diagnose_weights("psis", weights, tracked, n_resampled=math.inf)
        if convergence.converged and convergence.ess_min >= min_effective:
            natural = {name: np.exp(values) if name in names else values for name, values in drawn.items()}
            rows[number] = row | _posterior_columns(row, natural, convergence, weights)
    return rows


@functools.partial(jit, fast=True)
def _evaluate_log_probs(
    likelihood: Likelihood, inputs: RecordInputs, points: Float[Array, "records draws n"]
) -> Float[Array, "records draws"]:
    """Return the log-posteriors of the points of each record; NaN outside its table."""

    def evaluate_record(record: tuple[RecordInputs, Array]) -> Array:
        inputs, points = record
        return lax.map(inputs.model(likelihood).log_prob, points, batch_size=256)

    return map_blocks(evaluate_record, (inputs, points), 1)


@functools.partial(jit, fast=True)
def _derive_draws(
    derive: DerivedQuantities,
    likelihood: Likelihood,
    inputs: RecordInputs,
    tables: ResponseTable | None,
    points: Float[Array, "records draws n"],
    deviates: Float[Array, "records draws channels nuisances"],
) -> Float[Array, "records draws derived"]:
    def derive_record(record: tuple[RecordInputs, ResponseTable | None, Array, Array]) -> Array:
        inputs, table, points, deviates = record
        quantities = dataclasses.replace(derive, likelihood=inputs.model(likelihood), drive=table or derive.drive)
        return lax.map(lambda draw: derive_draw(quantities, *draw), (points, deviates), batch_size=8)

    return map_blocks(derive_record, (inputs, tables, points, deviates), 1)


def _posterior_columns(
    row: Row, draws: Mapping[str, np.ndarray], convergence: Convergence, weights: ImportanceWeights | None = None
) -> Row:
    """Return the posterior quantiles of the quantities in a row, and convergence diagnostics."""
    quantiles = np.quantile if weights is None else weights.quantiles
    columns: Row = {}
    for key in row:
        name = "sigma" if key == "noise" else key
        if name in draws:
            values = quantiles(draws[name], list(PROBABILITIES.values()))
            columns |= {f"{key}_{q}": float(value) for q, value in zip(PROBABILITIES, values, strict=True)}
    return columns | {name: getattr(convergence, name) for name in _CONVERGENCE_COLUMNS}


def _alone(record: Finger, scene: Scene | None, seed: int) -> Row:
    """Sample a record separately; return the row of its fit if the sampler fails."""
    try:
        fitted = fit(record, scene)
        row = row_from_fit(fitted)
    except Exception as error:
        return failure_row(record, error)
    try:
        posterior = sample(fitted, seed=seed, progress=False)
        row = add_posterior(row, posterior)
    except Exception as error:
        return row | {"trusted": False, "converged": False, "message": failure_row(record, error)["message"]}
    if posterior.convergence.interrupted:
        raise KeyboardInterrupt
    return row


def add_posterior(row: Row, posterior: Posterior) -> Row:
    """Return the row of a fit extended by its posterior."""
    sigma, *_ = posterior.fit.likelihood.sigma_names
    parameters = posterior.parameters()
    draws = parameters | {"sigma": parameters[sigma]} | posterior.derived()
    if row["trusted"] and not posterior.trusted:
        row = row | {"trusted": False, "message": posterior.convergence.warning}
    return row | _posterior_columns(row, draws, posterior.convergence)
