"""From one finger to people: the law that fingers follow, sampled."""

import functools
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

from fitact.compiled import BatchEvaluator
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.fit import fit
from fitact.populations.covariates import Covariates
from fitact.populations.finger import SHARED_PARAMETER, SKIN, Finger
from fitact.populations.finger_likelihoods import FingerLikelihoods
from fitact.populations.hierarchy import Hierarchy, laplace
from fitact.populations.next_finger import AREA, NewFingerModel
from fitact.populations.population import MAX_INTEGRATION_ERROR, Population, evaluate_parameters, log_medians
from fitact.prior.prior import Prior
from fitact.progress import track_progress
from fitact.sampling.convergence import Convergence
from fitact.sampling.ensemble import Target, reject_nonfinite, run_ensembles
from fitact.sampling.proposal import Proposal
from fitact.scene.scene import Scene

# in the fingers' tables, and where so few turn out to be too few
_CHAIN_FILES = {64: "chain.h5", 1024: "chain_1024.h5"}


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
    standardized = Covariates.from_values(covariates or {}, len(records))
    next_at = standardized.standardize(at or {})
    area_varies = scene.population.contact_area == "varies"
    factors = (*SKIN, SHARED_PARAMETER, *((AREA,) if area_varies else ()), *scene.population.thickness_sd)
    fingers, new_finger = _fit_fingers(records, scene, factors, progress)
    make_tables = functools.partial(
        FingerLikelihoods.from_fingers, fingers, medians[SHARED_PARAMETER], area_varies=area_varies
    )
    with jax.enable_x64(True):

        def hierarchy(draws: int, terms: int, purpose: int) -> Hierarchy:
            tables = make_tables(draws=draws, terms=terms, seed=[seed, purpose])
            return Hierarchy(tables, medians, area_varies, jnp.asarray(standardized.z_scores))

        for draws, name in _CHAIN_FILES.items():
            sampled = hierarchy(draws, terms=9, purpose=2)
            chain_file = None if folder is None else Path(folder) / name
            fingerprint = _fingerprint(fingers, standardized, scene, seed, draws)
            points, convergence = _sample_hierarchy(sampled, fingerprint, seed, max_steps, chain_file, progress)
            error = _integration_error(sampled, hierarchy(max(draws, 256), terms=13, purpose=3), points)
            if error <= MAX_INTEGRATION_ERROR or not convergence.converged:
                break
    return Population(fingers, sampled, points, convergence, error, new_finger, standardized, next_at, scene, seed)


def delete_chains(folder: str | os.PathLike[str]) -> None:
    """Remove the chains that `population` left in a folder."""
    for name in _CHAIN_FILES.values():
        (Path(folder) / name).unlink(missing_ok=True)


def _sample_hierarchy(
    hierarchy: Hierarchy,
    fingerprint: str,
    seed: int,
    max_steps: int,
    chain_file: Path | None,
    progress: bool,
    walkers: int = 128,
    ensembles: int = 4,
    draws: int = 2500,
) -> tuple[np.ndarray, Convergence]:
    """Sample points (ensembles, some `draws`, coordinates), and say how far they can be trusted."""
    rows = hierarchy.fingers.weight.size
    log_prob = reject_nonfinite(BatchEvaluator(Hierarchy.log_prob, hierarchy, rows, walkers // 2))
    target = Target(
        hierarchy.names,
        log_prob,
        Proposal.from_laplace(*laplace(hierarchy), log_prob),
        lambda points, _: log_medians(evaluate_parameters(hierarchy, points)),
        fingerprint,
    )
    chain, convergence = run_ensembles(target, seed, walkers, ensembles, max_steps, chain_file, progress)
    points = chain.points[:, chain.thinning_slice(convergence.burn, draws)]
    return points.reshape(ensembles, -1, len(hierarchy.names)), convergence


def _prior(scene: Scene) -> Prior:
    """Make the prior of the medians and Ci."""
    prior, names = scene.make_prior(), (*SKIN, SHARED_PARAMETER)
    if not set(names) <= set(prior.names):
        raise InputError("scene: [prior] holds or ties Rsc, Csc or Ci; a population needs a density of each")
    if not {name for pair in (*prior.pairs, *prior.order_constraints) for name in pair[:2]} <= set(names):
        raise InputError("scene: [prior] correlates or orders Rsc, Csc or Ci with others; a population takes that not")
    return Prior(names, tuple(prior[name] for name in names), prior.pairs, prior.order_constraints)


def _fit_fingers(
    records: Sequence[Record], scene: Scene, factors: tuple[str, ...], progress: bool
) -> tuple[tuple[Finger, ...], NewFingerModel]:
    """Fit each by itself; the next finger is under the first one's drive."""
    if len(records) < 2:
        raise InputError(f"{len(records)} records: a population needs one of each of two or more fingers")
    fingers: dict[str, Finger] = {}
    refusals: list[InputError] = []
    new_finger = None
    numbers = range(len(records))
    for number in track_progress(numbers, "fitting the fingers", len(records)) if progress else numbers:
        try:
            record = records[number]
            twin = fingers.get(record.fingerprint)
            if twin is None:
                result = fit(record, scene)
        except InputError as error:
            refusals.append(error)
            continue
        if twin is not None:
            raise InputError(
                f"{record.source} holds the same record as {twin.source}, whose finger would count twice; drop one"
            )
        with jax.enable_x64(True):
            fingers[record.fingerprint] = Finger.from_fit(result)
            new_finger = new_finger or NewFingerModel.from_fit(result, factors)
    if refusals or new_finger is None:
        raise _refusal(refusals)
    return tuple(fingers.values()), new_finger


def _refusal(errors: Sequence[InputError], max_named: int = 5) -> InputError:
    """Make one error of several: the first, and the names of `max_named` other records."""
    # an error begins with the record that it is about
    names = [os.path.basename(str(error).partition(":")[0]) for error in errors[1:]]
    if len(names) > max_named:
        names[max_named:] = [f"{len(names) - max_named} more"]
    return InputError(f"{errors[0]}; also refused: {', '.join(names)}" if names else str(errors[0]))


def _integration_error(
    hierarchy: Hierarchy, finer: Hierarchy, points: Float[np.ndarray, "ensembles draws n"], count: int = 500
) -> float:
    """Estimate by how many of its standard deviations any mean shifts at most with finer tables, by `count` points.

    To first order a mean shifts by its covariance with the change of the log-posterior.
    """
    flat = points.reshape(-1, points.shape[-1])
    flat = flat[np.linspace(0, len(flat) - 1, count).astype(int)]
    coarse, fine = (
        BatchEvaluator(Hierarchy.log_prob, tables, tables.fingers.weight.size)(flat) for tables in (hierarchy, finer)
    )
    return float(np.std(fine - coarse))


def _fingerprint(fingers: Sequence[Finger], covariates: Covariates, scene: Scene, seed: int, draws: int) -> str:
    """Hash what a chain belongs to; any change of it makes another chain."""
    data = [[finger.fingerprint, finger.center, finger.conditional_mean.tolist()] for finger in fingers]
    settings = [importlib.metadata.version("fitact"), data, covariates.z_scores.tolist(), scene.to_json(), seed, draws]
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()
