"""From one finger to people: the law that fingers follow, sampled."""

import hashlib
import importlib.metadata
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.fit import fit
from fitact.likelihood.likelihood import Batched
from fitact.populations.covariates import Covariates
from fitact.populations.finger import SHARED, SKIN, Finger
from fitact.populations.finger_likelihoods import Fingers
from fitact.populations.hierarchy import Hierarchy, laplace
from fitact.populations.next_finger import AREA, NewFinger
from fitact.populations.population import OFF, Population, laws, log_medians
from fitact.prior.prior import Prior
from fitact.progress import watched
from fitact.sampling.convergence import Convergence
from fitact.sampling.ensemble import Target, finite, run
from fitact.sampling.proposal import Proposal
from fitact.scene.scene import Scene

_WALKERS, _ENSEMBLES = 128, 4
_KEPT = 2500  # points per ensemble
_DRAWS = {64: "chain.h5", 1024: "chain_1024.h5"}  # in the fingers' tables, and where so few turn out to be too few
_LEAST_CHECKED = 256  # other draws that these are checked against
_TERMS, _MORE_TERMS = 9, 13  # of the tables, and of those that they are checked against
_CHECKED = 500  # points at which
_NAMED = 5  # refused records, beside the first


def population(
    records: Sequence[Record],
    scene: Scene | None = None,
    *,
    covariates: Mapping[str, Sequence[float]] | None = None,
    at: Mapping[str, float] | None = None,
    folder: str | os.PathLike[str] | None = None,
    seed: int = 0,
    max_steps: int = 20_000,
    progress: bool = True,
) -> Population:
    """The law that fingers on one panel follow, from a record of each, sampled until converged.

    Rsc and Csc are log-normal over fingers, with a correlation; the panel's Ci is common, or, with the scene's
    `[population] contact_area = "varies"`, scales with each finger's own log-normal area, as Rsc and Csc do. Medians
    and Ci have the scene's prior, log-standard deviations a half-normal one of scale 0.5, the correlation r the
    density 3/4 (1 - r^2). All that is a finger's own is integrated out.

    Args:
        records: one of each finger, on one panel; taken one after the other, none is kept.
        scene: of all; its prior of Rsc and Csc is that of their medians.
        covariates: by name, a number of each finger, such as how moist its skin is; the medians of log Rsc and
            log Csc change linearly with each, by a normal prior of scale 0.5 per standard deviation of it.
        at: covariates of the next finger, where they are not the mean of these.
        folder: where to keep the chain; if it holds one of these records, sampling goes on from there.
        seed: the same seed gives the same draws, whether or not sampling was interrupted.
        max_steps: per ensemble, after which the answer is marked as not converged.
        progress: report on standard error.

    Ctrl-C while sampling ends it with what there is, marked as not converged.

    Raises:
        InputError: there are fewer than two, one is given twice or is refused, the scene's prior does not leave
            Rsc, Csc and Ci free, a covariate tells nothing, or the folder's chain belongs to others.
    """
    scene = scene or Scene()
    medians = _prior(scene)
    known = Covariates.of(covariates or {}, len(records))
    next_at = known.standardised(at or {})
    fingers, new = _fitted(records, scene, progress)
    varies = scene.population.contact_area == "varies"
    with jax.enable_x64(True):

        def hierarchy(draws: int, terms: int, purpose: int) -> Hierarchy:
            tables = Fingers.tabulated(
                fingers, medians[SHARED], area_varies=varies, draws=draws, terms=terms, seed=[seed, purpose]
            )
            return Hierarchy(tables, medians, varies, jnp.asarray(known.standard))

        for draws, name in _DRAWS.items():
            sampled = hierarchy(draws, _TERMS, 2)
            chain_file = None if folder is None else Path(folder) / name
            fingerprint = _fingerprint(fingers, known, scene, seed, draws)
            points, convergence = _sampled(sampled, fingerprint, seed, max_steps, chain_file, progress)
            off = _off(sampled, hierarchy(max(draws, _LEAST_CHECKED), _MORE_TERMS, 3), points)
            if off <= OFF or not convergence.converged:
                break
    return Population(fingers, sampled, points, convergence, off, new, known, next_at, scene, seed)


def forget(folder: str | os.PathLike[str]) -> None:
    """Remove the chains that `population` left in a folder."""
    for name in _DRAWS.values():
        (Path(folder) / name).unlink(missing_ok=True)


def _sampled(
    hierarchy: Hierarchy, fingerprint: str, seed: int, max_steps: int, chain_file: Path | None, progress: bool
) -> tuple[np.ndarray, Convergence]:
    """Points (ensembles, draws, coordinates), and how far they can be trusted."""
    log_prob = finite(Batched(Hierarchy.log_prob, hierarchy, hierarchy.fingers.weight.size, _WALKERS // 2))
    proposal = Proposal.around(*laplace(hierarchy), log_prob)
    target = Target(
        hierarchy.names, log_prob, proposal, lambda points, _: log_medians(laws(hierarchy, points)), fingerprint
    )
    chain, convergence = run(target, seed, _WALKERS, _ENSEMBLES, max_steps, chain_file, progress)
    points = chain.points[:, chain.thinned(convergence.burn, _KEPT)]
    return points.reshape(_ENSEMBLES, -1, len(hierarchy.names)), convergence


def _prior(scene: Scene) -> Prior:
    """Of the medians and Ci."""
    prior, names = scene.make_prior(), (*SKIN, SHARED)
    if not set(names) <= set(prior.names):
        raise InputError("scene: [prior] holds or ties Rsc, Csc or Ci; a population needs a density of each")
    if not {name for pair in (*prior.pairs, *prior.ordered) for name in pair[:2]} <= set(names):
        raise InputError("scene: [prior] correlates or orders Rsc, Csc or Ci with others; a population takes that not")
    return Prior(names, tuple(prior[name] for name in names), prior.pairs, prior.ordered)


def _fitted(records: Sequence[Record], scene: Scene, progress: bool) -> tuple[tuple[Finger, ...], NewFinger]:
    """Each by itself, and the next under the first one's drive; where some are refused, the reason and their names."""
    if len(records) < 2:
        raise InputError(f"{len(records)} records: a population needs one of each of two or more fingers")
    fingers: dict[str, Finger] = {}
    refused: list[InputError] = []
    new = None
    numbers = range(len(records))
    for number in watched(numbers, "fitting the fingers", len(records)) if progress else numbers:
        try:
            record = records[number]
            twice = fingers.get(record.fingerprint)
            if twice is None:
                found = fit(record, scene)
        except InputError as error:
            refused.append(error)
            continue
        if twice is not None:
            raise InputError(
                f"{record.source} holds the same record as {twice.source}, whose finger would count twice; drop one"
            )
        with jax.enable_x64(True):
            fingers[record.fingerprint] = Finger.of(found)
            new = new or NewFinger.under_drive_of(found, _factors(scene))
    if refused or new is None:
        # an error begins with the record that it is about
        others = [os.path.basename(str(error).partition(":")[0]) for error in refused[1:]]
        more = [f"{len(others) - _NAMED} more"] if len(others) > _NAMED else []
        also = f"; also refused: {', '.join(others[:_NAMED] + more)}" if others else ""
        raise InputError(f"{refused[0]}{also}")
    return tuple(fingers.values()), new


def _factors(scene: Scene) -> tuple[str, ...]:
    """What makes a new finger."""
    area = (AREA,) if scene.population.contact_area == "varies" else ()
    return (*SKIN, SHARED, *area, *scene.population.thickness_sd)


def _off(sampled: Hierarchy, finer: Hierarchy, points: Float[np.ndarray, "ensembles draws n"]) -> float:
    """How many of its standard deviations any mean shifts at most where finer tables take these tables' place.

    To first order a mean shifts by its covariance with the change of the log-posterior.
    """
    flat = points.reshape(-1, points.shape[-1])
    flat = flat[np.linspace(0, len(flat) - 1, _CHECKED).astype(int)]
    found = [Batched(Hierarchy.log_prob, each, each.fingers.weight.size)(flat) for each in (sampled, finer)]
    return float(np.std(found[1] - found[0]))


def _fingerprint(fingers: Sequence[Finger], known: Covariates, scene: Scene, seed: int, draws: int) -> str:
    """What a chain belongs to; any change of it makes another chain."""
    each = [[finger.fingerprint, finger.center, finger.place.tolist()] for finger in fingers]
    settings = [importlib.metadata.version("fitact"), each, known.standard.tolist(), scene.to_json(), seed, draws]
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()
