"""Separate posteriors of many records; similar ones are sampled in one run of emcee."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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
from fitact.batch.metropolis import GaussianApproximations, sample_posteriors
from fitact.batch.stated_drive import StatedDriveProblem
from fitact.compiled import BatchEvaluator, pad_rows
from fitact.fitting import derived
from fitact.fitting.derived import DerivedQuantities
from fitact.fitting.fit import fit
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import scale_information
from fitact.sampling.convergence import Convergence, diagnose_chain
from fitact.sampling.ensemble import TRACKED_WALKERS, sample
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import PROBES, is_normal
from fitact.scene.scene import Scene
from fitact.summary import PROBABILITIES

_BLOCK = 32  # records sampled together, padded to this number; 16 MB of draws
_TRACKED = ("g", "b", "force_mean")
_CONVERGENCE_COLUMNS = ("converged", "rhat_max", "ess_min", "tau_max", "acceptance", "steps", "walkers", "ensembles")


def sample_many(
    records: Iterable[Input],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Fits:
    """Fit each of many records separately and sample its posterior, like `fitact.sample`.

    Rows of `fit_many` are extended by the posterior quantiles of each parameter, each derived quantity and the noise
    (e.g. `Rsc_q05`, `force_mean_q975`), and by `converged`, `rhat_max`, `ess_min`, `tau_max`, `acceptance`, `steps`
    and `walkers` of each ensemble. Rows that have not converged are not `trusted`.

    Records that are fitted in a batch and have a posterior near its Laplace approximation are sampled together, 32 at
    once, by Metropolis-Hastings moves that propose from this approximation. The random numbers of each record depend on
    `seed` and its content only, so that other records hardly affect it. Records that have not converged, and all
    others, are sampled separately, like `fitact.sample` with this seed.

    Args:
        records: records, spectra, paths of files, or sequences of them, as in `fit_many`.
        scene: scene of all records.
        channels, scale, rate: channels and sampling rate of the files, as in `fitact.read`.
        seed: seed of the random numbers; the same seed gives the same rows.
        progress: whether to report the progress on standard error.

    Raises:
        InputError: the scene requests an unsupported option.
    """
    make_rows = functools.partial(_sample_rows, scene=scene, seed=seed)
    title = "sampling the posteriors" if progress else ""
    return tabulate_records(records, scene, {"channels": channels, "scale": scale, "rate": rate}, make_rows, title)


class _Targets(NamedTuple):
    """Posteriors near their Laplace approximations, of records that share a likelihood except for the tables.

    Attributes:
        members, rows: records, and rows of their fits.
        likelihood: common likelihood; `coordinates` replaces the record in its compression.
    """

    members: list[Member]
    rows: list[Row]
    likelihood: Likelihood
    derive: DerivedQuantities
    coordinates: Float[np.ndarray, "records coordinates"]
    approximations: GaussianApproximations

    def subset(self, indices: Sequence[int]) -> Self:
        chosen = np.array(indices)
        return self._replace(
            members=[self.members[i] for i in indices],
            rows=[self.rows[i] for i in indices],
            coordinates=self.coordinates[chosen],
            approximations=GaussianApproximations(*(field[chosen] for field in self.approximations)),
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
    """Return the accepted records of a batch whose posteriors are nearly normal, or None."""
    (problem, members), (rows, optima) = batch, fit_batch(batch)
    places = [place for place, (number, _) in enumerate(members) if number in rows]
    if not isinstance(problem, StatedDriveProblem) or optima is None or not places:
        return None
    members = [members[place] for place in places]
    theta, sigma, factor = optima.theta[places], optima.sigma[places], optima.covariance_factor[places]
    try:
        approximations = _laplace_approximations(theta, sigma, factor, problem.samples)
        fit_rows = [rows[number] for number, _ in members]
        targets = _Targets(
            members, fit_rows, problem.likelihood, problem.derive, optima.coordinates[places], approximations
        )
        targets = targets._replace(approximations=approximations.refine(_probe_axes(targets)))
        is_near = np.all(is_normal(_probe_axes(targets)), axis=1)
    except np.linalg.LinAlgError:  # one record may make the joint computation fail
        return None
    return targets.subset(np.flatnonzero(is_near).tolist()) if is_near.any() else None


def _laplace_approximations(
    theta: np.ndarray, sigma: np.ndarray, covariance_factor: np.ndarray, samples: int
) -> GaussianApproximations:
    """Compute `Fit.point` and `Fit.point_root` of each record."""
    size = theta.shape[1]
    roots = np.pad(covariance_factor, ((0, 0), (0, 1), (0, 1)))
    roots[:, size, size] = (scale_information("white") * (samples - size)) ** -0.5
    return GaussianApproximations.from_covariance_factors(np.column_stack([theta, np.log(sigma)]), roots)


def _probe_axes(targets: _Targets) -> Float[np.ndarray, "records n probes"]:
    """Evaluate the log-posteriors along the principal axes of their approximations."""
    size = targets.approximations.centers.shape[1]
    z = (np.eye(size)[:, None] * PROBES[:, None]).reshape(-1, size)
    points = targets.approximations.from_standard_normal(np.tile(z, (len(targets.members), 1, 1)))
    return _LogProbs(targets)(points).reshape(-1, size, PROBES.size)


class _LogProbs:
    """Log-posteriors of points of each record; -inf outside its table, which is recorded.

    `chunk_points` of each record are evaluated at once, so that one size is compiled.
    """

    def __init__(self, targets: _Targets, chunk_points: int = 64) -> None:
        self._coordinates, self._chunk_points = targets.coordinates, chunk_points
        rows = chunk_points * targets.coordinates.shape[1]
        self._evaluate = BatchEvaluator(_log_probs, targets.likelihood, rows, _BLOCK)
        self.outside_table = np.zeros(len(targets.members), dtype=bool)

    def __call__(self, points: Float[np.ndarray, "records any n"]) -> Float[np.ndarray, "records any"]:
        count, size = points.shape[1], self._chunk_points
        chunks = np.split(pad_rows(points, size, axis=1), -(-count // size), axis=1)
        values = np.concatenate([self._evaluate(self._coordinates, chunk) for chunk in chunks], axis=1)[:, :count]
        is_outside = np.isnan(values)
        self.outside_table |= is_outside.any(axis=1)
        return np.where(is_outside, -np.inf, values)


def _log_probs(likelihood: Likelihood, coordinates: Array, points: Array) -> Float[Array, " points"]:
    channel = likelihood.channels[0]
    assert channel.compression is not None
    compression = dataclasses.replace(channel.compression, observed=coordinates)
    likelihood = likelihood.replace_channel(0, dataclasses.replace(channel, compression=compression))
    return jax.vmap(likelihood.log_prob)(points)


def _sample_block(
    job: tuple[list[Member], _Targets | None], seed: int, steps: int = 200, rhat_draws: int = 1000
) -> dict[int, Row]:
    """Sample a block, and return the rows of converged records.

    `steps` is the length of each ensemble (nearly normal posteriors need some 120); `rhat_draws` as in
    `diagnose_chain`.
    """
    members, targets = job
    if targets is None:
        return {}
    full = targets.subset([*range(len(members)), *[len(members) - 1] * (_BLOCK - len(members))])
    log_probs = _LogProbs(full)
    seeds = [[seed, int(record.fingerprint, 16)] for _, record in full.members]
    sampled = sample_posteriors(log_probs, full.approximations, steps, seeds)
    # derived quantities cost more than the draws, so only some draws are used
    points = sampled.points[:, :, :, :TRACKED_WALKERS]
    evaluator = BatchEvaluator(_derive, full.derive, full.derive.time.size, batch=1024)
    derived_draws = evaluator.map_over(points.shape[:-1], points)
    names = (*full.likelihood.names, "sigma")
    rows = {}
    for i, ((number, _), row) in enumerate(zip(members, targets.rows, strict=True)):
        quantities = dict(zip(derived.DERIVED_NAMES, np.moveaxis(derived_draws[i], -1, 0), strict=True))
        tracked = {name: quantities[name] for name in _TRACKED}
        convergence = diagnose_chain(names, sampled.points[i], sampled.accepted[i], tracked, rhat_draws)
        if convergence.converged and not log_probs.outside_table[i]:
            draws = dict(zip(names, np.moveaxis(np.exp(sampled.points[i]), -1, 0), strict=True)) | quantities
            draws = {name: values[:, convergence.burn :] for name, values in draws.items()}
            rows[number] = row | _posterior_columns(row, draws, convergence)
    return rows


def _derive(derive: DerivedQuantities, point: Array) -> Float[Array, " derived"]:
    theta, log_sigma = derive.likelihood.split(point)
    return derive(theta, jnp.exp(log_sigma))


def _posterior_columns(row: Row, draws: Mapping[str, np.ndarray], convergence: Convergence) -> Row:
    """Return the posterior quantiles of the quantities in a row, and convergence diagnostics."""
    columns: Row = {}
    for key in row:
        name = "sigma" if key == "noise" else key
        if name in draws:
            values = np.quantile(draws[name], list(PROBABILITIES.values()))
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
