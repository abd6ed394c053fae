"""Separate posteriors of many records; similar ones are sampled at once, by importance sampling."""

import functools
import math
import operator
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import jax
import numpy as np
import scipy
from jax import lax
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
from fitact.compiled import jit
from fitact.fitting import derived
from fitact.fitting.derived import DerivedQuantities, derive_draw
from fitact.fitting.fit import fit
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import scale_information
from fitact.likelihood.observable import LINEAR_NUISANCES
from fitact.sampling.convergence import Convergence, ImportanceWeights, diagnose_weights, pareto_smooth
from fitact.sampling.ensemble import sample
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import draw_student_t, student_log_density
from fitact.scene.scene import Scene
from fitact.summary import PROBABILITIES

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


class _FittedRecord(NamedTuple):
    """Record that was fitted in a batch, to be sampled.

    Attributes:
        row: row of its fit.
        derive: its derived quantities, with its likelihood.
        center: optimum, theta and log sigma.
        factor: factor of the covariance.
    """

    row: Row
    derive: DerivedQuantities
    center: Float[np.ndarray, " n"]
    factor: Float[np.ndarray, "n n"]


def _sample_rows(batches: Iterable[Batch], scene: Scene | None, seed: int) -> Iterator[tuple[int, Row]]:
    """Yield the number and the row of each record when it is finished."""
    jobs = (
        (member, fitted.get(member[0]))
        for (_, members), fitted in run_in_threads(batches, _list_fitted)
        for member in members
    )
    for ((number, record), _), row in run_in_threads(jobs, functools.partial(_sample_record, seed=seed)):
        yield number, row or _alone(record, scene, seed)


def _list_fitted(batch: Batch) -> dict[int, _FittedRecord]:
    """Return the accepted records of a batch by their number."""
    (problem, members), (rows, optima) = batch, fit_batch(batch)
    fitted: dict[int, _FittedRecord] = {}
    if problem is None or optima is None:
        return fitted
    log_sigma_sd = (scale_information("white") * (problem.samples - optima.theta.shape[1])) ** -0.5
    for place, (number, record) in enumerate(members):
        if number in rows:
            inputs = jax.tree.map(operator.itemgetter(place), optima.inputs)
            derive = problem.derive_record(record, inputs)
            center = np.append(optima.theta[place], np.log(optima.sigma[place]))
            factor = scipy.linalg.block_diag(optima.covariance_factor[place], log_sigma_sd)
            fitted[number] = _FittedRecord(rows[number], derive, center, factor)
    return fitted


def _sample_record(
    job: tuple[Member, _FittedRecord | None],
    seed: int,
    draws: int = 8192,
    derived_draws: int = 2048,
    min_effective: float = 2000.0,
) -> Row | None:
    """Return the row of a record whose weights are reliable and not too uneven, or None.

    Derived quantities, which cost more, are computed for the first `derived_draws` of the draws.
    """
    (_, record), fitted = job
    if fitted is None:
        return None
    random, likelihood = np.random.default_rng([seed, int(record.fingerprint, 16)]), fitted.derive.likelihood
    z = draw_student_t(random, draws, fitted.center.size)
    points = fitted.center + z @ fitted.factor.T
    log_ratios = _evaluate_log_probs(likelihood, points) - student_log_density(z)
    if np.isnan(log_ratios).any():  # outside the table
        return None
    deviates = random.standard_normal((derived_draws, 1, len(LINEAR_NUISANCES)))
    quantities = _derive_draws(fitted.derive, points[:derived_draws], deviates)
    weights, names = pareto_smooth(log_ratios), (*likelihood.names, "sigma")
    drawn = dict(zip((*names, *derived.DERIVED_NAMES), (*points.T, *quantities.T), strict=True))
    tracked = {name: drawn[name] for name in (*names, *_TRACKED)}
    convergence = diagnose_weights("psis", weights, tracked, n_resampled=math.inf)
    if not (convergence.converged and convergence.ess_min >= min_effective):
        return None
    natural = {name: np.exp(values) if name in names else values for name, values in drawn.items()}
    return fitted.row | _posterior_columns(fitted.row, natural, convergence, weights)


@functools.partial(jit, fast=True)
def _evaluate_log_probs(likelihood: Likelihood, points: Float[Array, "draws n"]) -> Float[Array, " draws"]:
    """Return the log-posteriors of points; NaN outside the table."""
    return lax.map(likelihood.log_prob, points, batch_size=256)


@functools.partial(jit, fast=True)
def _derive_draws(
    derive: DerivedQuantities, points: Float[Array, "draws n"], deviates: Float[Array, "draws channels nuisances"]
) -> Float[Array, "draws derived"]:
    return lax.map(lambda draw: derive_draw(derive, *draw), (points, deviates), batch_size=8)


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
