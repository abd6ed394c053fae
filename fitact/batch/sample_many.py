"""Posteriors of many records, each by itself: alike ones sampled side by side in one run of emcee."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.batch.fit_many import Batch, Fits, Input, Member, Row, failed, in_threads, row_of, settle, tabulated
from fitact.batch.moves import WALKERS, Normals, run
from fitact.batch.shared_basis import Narrow
from fitact.data.record import Record
from fitact.fitting import derived
from fitact.fitting.derived import Derived
from fitact.fitting.fit import fitted
from fitact.likelihood.certificate import precision_of, reach_of
from fitact.likelihood.compression import REACH, SLOW, Compression
from fitact.likelihood.likelihood import Batched, Likelihood
from fitact.likelihood.noise import scale_information
from fitact.sampling.convergence import Convergence, judge_chain
from fitact.sampling.ensemble import FOLLOWED, sample
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import PROBES, is_normal
from fitact.scene.scene import Scene
from fitact.summary import PROBABILITIES

_BLOCK = 32  # records sampled side by side, always so many; 16 MB of draws
_STEPS = 200  # of each ensemble; those near to normal need some 120
_AT_ONCE = 32  # points of each record in an evaluation: half of its walkers, so that one size is compiled
_RANKED = 1000  # draws of an ensemble that R-hat looks at
_APART = 4  # steps between the draws whose derived quantities are summarised, some autocorrelation times
_POINTS = 1024  # of which derived quantities are worked out at a time
_JUDGED = 3  # of `derived.NAMES`: g, b, force_mean
_TOLD = ("converged", "rhat_max", "ess_min", "tau_max", "acceptance", "steps", "walkers", "ensembles")
_B = derived.NAMES.index("b")


def sample_many(
    records: Iterable[Input],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Fits:
    """Fit each of many records by itself and sample its posterior by emcee, as `fitact.sample` does, in one go.

    Rows are those of `fit_many`, and have beside, of every parameter, derived quantity and the noise, the posterior's
    quantiles (`Rsc_q05`, `force_mean_q975`; those of a summary), and `converged`, `rhat_max`, `ess_min`, `tau_max`,
    `acceptance`, `steps` and `walkers` of each ensemble. What has not converged is not `trusted`.

    Records that are fitted together and whose posterior is near its Laplace approximation are sampled together, 32 in
    a run of emcee, and each draws its random numbers from `seed` and its own content, so that it hardly matters for a
    record what else is in the list. What has not converged then, and all others, are sampled by themselves, as
    `fitact.sample` does with that seed.

    Args:
        records: records, or the paths of files; taken one after the other.
        scene: of all of them.
        channels, scale: of files, as in `fitact.read`.
        seed: the same seed gives the same rows.
        progress: report on standard error.

    Raises:
        InputError: the scene asks for what is not available.
    """
    how, doing = functools.partial(_rows, scene=scene, seed=seed), "sampling the posteriors" if progress else ""
    return tabulated(records, scene, {"channels": channels, "scale": scale}, how, doing)


class _Targets(NamedTuple):
    """Posteriors near their Laplace approximations, of records that share a likelihood but for their own table.

    Attributes:
        members, rows: the records, and the rows of their fits.
        likelihood: whose compression is to be replaced by one of `tables`.
    """

    members: list[Member]
    rows: list[Row]
    likelihood: Likelihood
    derive: Derived
    tables: Narrow
    near: Normals

    def taken(self, places: Sequence[int]) -> Self:
        """Some of them."""
        chosen = np.array(places)
        return self._replace(
            members=[self.members[place] for place in places],
            rows=[self.rows[place] for place in places],
            tables=Narrow(*(field[chosen] for field in self.tables)),
            near=Normals(*(field[chosen] for field in self.near)),
        )


def _rows(found: Iterable[Batch], scene: Scene | None, seed: int) -> Iterator[tuple[int, Row]]:
    """Numbers of records and their rows, as they are done."""
    jobs = (job for (_, members), targets in in_threads(found, _targets) for job in _blocks(members, targets))
    for (members, _), rows in in_threads(jobs, functools.partial(_sampled, seed=seed)):
        for number, record in members:
            yield number, rows[number] if number in rows else _alone(record, scene, seed)


def _blocks(members: list[Member], targets: _Targets | None) -> Iterator[tuple[list[Member], _Targets | None]]:
    """Records that are sampled side by side, and those that cannot be."""
    near = [] if targets is None else targets.members
    for first in range(0, len(near), _BLOCK):
        assert targets is not None
        block = targets.taken(range(first, min(first + _BLOCK, len(near))))
        yield block.members, block
    numbers = {number for number, _ in near}
    yield [member for member in members if member[0] not in numbers], None


def _targets(batch: Batch) -> _Targets | None:
    """Of those records of a batch whose fits are beyond doubt; None where there are none."""
    try:
        return _beyond_doubt(batch)
    except np.linalg.LinAlgError:  # one of them spoils what is computed for all
        return None


def _beyond_doubt(batch: Batch) -> _Targets | None:
    (together, members), (rows, found) = batch, settle(batch)
    places = [place for place, (number, _) in enumerate(members) if number in rows]
    if together is None or found is None or not places or not _has_tables(together.likelihood, found.theta[0]):
        return None
    members = [members[place] for place in places]
    sigma, root = found.sigma[places], found.root[places]
    log_b, whole = found.logs[places, _B], together.basis.center
    reach = reach_of(np.linalg.norm(np.einsum("ki,kij->kj", found.gradients[places, _B], root), axis=1))
    low, high = np.maximum(log_b - reach, whole - REACH), np.minimum(log_b + reach, whole + REACH)
    tables = together.basis.narrowed(
        found.coordinates[places], 0.5 * (low + high), 0.5 * (high - low), precision_of(sigma)
    )
    near = _laplace(found.theta[places], sigma, root, together.samples)
    of_fits = [rows[number] for number, _ in members]
    targets = _Targets(members, of_fits, together.likelihood, together.derive, tables, near)
    targets = targets._replace(near=near.refined(_probed(targets)))
    kept = np.flatnonzero(np.all(is_normal(_probed(targets)), axis=1))
    return targets.taken(kept.tolist()) if kept.size else None


def _has_tables(likelihood: Likelihood, theta: Float[np.ndarray, " parameters"]) -> bool:
    """Whether one time constant makes the record, so that a table around it suffices, and walkers are enough."""
    taus = likelihood.circuit(jnp.asarray(theta)).terms_of(likelihood.traces[0].channel).tau
    return len(taus) == 1 and 2 * (len(theta) + 1) <= WALKERS


def _laplace(theta: np.ndarray, sigma: np.ndarray, root: np.ndarray, samples: int) -> Normals:
    """As `Fit.point` and `Fit.point_root`."""
    size = theta.shape[1]
    roots = np.zeros((len(theta), size + 1, size + 1))
    roots[:, :size, :size] = root
    roots[:, size, size] = (scale_information("white") * (samples - size)) ** -0.5
    return Normals.of(np.column_stack([theta, np.log(sigma)]), roots)


def _probed(targets: _Targets) -> Float[np.ndarray, "records n probes"]:
    """Log-posteriors along the axes of their approximations."""
    size = targets.near.centers.shape[1]
    white = (np.eye(size)[:, None] * PROBES[:, None]).reshape(-1, size)
    values = _LogProbs(targets)(targets.near.placed(np.tile(white, (len(targets.members), 1, 1))))
    return values.reshape(-1, size, PROBES.size)


class _LogProbs:
    """Log-posteriors of points of each record; impossible where its table does not reach, which is noted."""

    def __init__(self, targets: _Targets) -> None:
        self._tables = tuple(targets.tables)
        self._evaluate = Batched(_log_probs, targets.likelihood, _AT_ONCE * targets.tables.signal.shape[-1], _BLOCK)
        self.beyond = np.zeros(len(targets.members), dtype=bool)

    def __call__(self, points: Float[np.ndarray, "records any n"]) -> Float[np.ndarray, "records any"]:
        count = points.shape[1]
        points = np.concatenate([points, np.repeat(points[:, -1:], -count % _AT_ONCE, axis=1)], axis=1)
        parts = [self._evaluate(*self._tables, part) for part in np.split(points, points.shape[1] // _AT_ONCE, axis=1)]
        values = np.concatenate(parts, axis=1)[:, :count]
        beyond = np.isnan(values)
        self.beyond |= beyond.any(axis=1)
        return np.where(beyond, -np.inf, values)


def _log_probs(
    likelihood: Likelihood, center: Array, reach: Array, signal: Array, observed: Array, points: Array
) -> Float[Array, " points"]:
    trace, rows, terms = likelihood.traces[0], observed.size, signal.shape[1]
    assert trace.compression is not None
    nothing = jnp.zeros(rows)  # no nuisance is free
    table = Compression(
        center=center,
        reach=reach,
        signal=signal,
        decay=jnp.zeros((rows, terms)),
        slow=jnp.zeros((len(SLOW), rows)),
        rate=nothing,
        slope=nothing,
        observed=observed,
        samples=trace.compression.samples,
    )
    return jax.vmap(likelihood.with_trace(0, dataclasses.replace(trace, compression=table)).log_prob)(points)


def _sampled(job: tuple[list[Member], _Targets | None], seed: int) -> dict[int, Row]:
    """Rows of those that have converged."""
    members, targets = job
    if targets is None:
        return {}
    full = targets.taken([*range(len(members)), *[len(members) - 1] * (_BLOCK - len(members))])
    log_probs = _LogProbs(full)
    seeds = [[seed, int(record.fingerprint, 16)] for _, record in full.members]
    drawn = run(log_probs, full.near, _STEPS, seeds, seed)
    judged = _derived(_judged_of, full.derive, drawn.points[:, :, :, :FOLLOWED])
    names = (*full.likelihood.names, "sigma")
    rows = {}
    for i, ((number, _), row) in enumerate(zip(members, targets.rows, strict=True)):
        followed = dict(zip(derived.NAMES, np.moveaxis(judged[i], -1, 0), strict=False))
        convergence = judge_chain(names, drawn.points[i], drawn.accepted[i], followed, _RANKED)
        if convergence.converged and not log_probs.beyond[i]:
            draws = _draws(names, full.derive, drawn.points[i, :, convergence.burn :])
            rows[number] = row | _quantiles(row, draws) | _told(convergence)
    return rows


def _draws(
    names: tuple[str, ...], derive: Derived, points: Float[np.ndarray, "ensembles steps walkers n"]
) -> dict[str, np.ndarray]:
    """In SI units, by name; of derived quantities fewer, which cost more."""
    draws = dict(zip(names, np.moveaxis(np.exp(points), -1, 0), strict=True))
    return draws | dict(
        zip(derived.NAMES, np.moveaxis(_derived(_derived_of, derive, points[:, ::_APART]), -1, 0), strict=True)
    )


def _derived(
    function: Callable[..., Array], derive: Derived, points: Float[np.ndarray, "*shape n"]
) -> Float[np.ndarray, "*shape some"]:
    flat = points.reshape(-1, points.shape[-1])
    return Batched(function, derive, derive.time.size, _POINTS)(flat).reshape(*points.shape[:-1], -1)


def _derived_of(derive: Derived, point: Array) -> Float[Array, " derived"]:
    theta, log_sigma = derive.likelihood.split(point)
    return derive(theta, jnp.exp(log_sigma))


def _judged_of(derive: Derived, point: Array) -> Float[Array, " judged"]:
    return _derived_of(derive, point)[:_JUDGED]


def _quantiles(row: Row, draws: Mapping[str, np.ndarray]) -> Row:
    """Of what the row has a value of."""
    found: Row = {}
    for key in row:
        name = "sigma" if key == "noise" else key
        if name in draws:
            values = np.quantile(draws[name], list(PROBABILITIES.values()))
            found |= {f"{key}_{q}": float(value) for q, value in zip(PROBABILITIES, values, strict=True)}
    return found


def _told(convergence: Convergence) -> Row:
    return {name: getattr(convergence, name) for name in _TOLD}


def _alone(record: Record, scene: Scene | None, seed: int) -> Row:
    """The row of a record that is sampled by itself; that of its fit alone where the sampler fails."""
    try:
        found = fitted(record, scene, remedies=False)
        row = row_of(found)
    except Exception as error:
        return failed(record.source, error)
    try:
        posterior = sample(found, seed=seed, progress=False)
        row = with_posterior(row, posterior)
    except Exception as error:
        return row | {"trusted": False, "converged": False, "message": failed(record.source, error)["message"]}
    if posterior.convergence.interrupted:
        raise KeyboardInterrupt
    return row


def with_posterior(row: Row, posterior: Posterior) -> Row:
    """A fit's row, and beside what its posterior says."""
    sigma, *_ = posterior.fit.likelihood.sigma_names
    parameters = posterior.parameters()
    draws = parameters | {"sigma": parameters[sigma]} | posterior.derived()
    if row["trusted"] and not posterior.trusted:
        row = row | {"trusted": False, "message": posterior.convergence.warning}
    return row | _quantiles(row, draws) | _told(posterior.convergence)
