"""Fit of a population: its parameters are sampled from records of several fingers."""

import hashlib
import importlib.metadata
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fitact.blas import limit_to_one_thread
from fitact.compiled import BatchEvaluator, double_precision
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.fitting.fit import fit
from fitact.fitting.result import Fit
from fitact.populations.contact_area import ContactAreaTest
from fitact.populations.covariates import Covariates
from fitact.populations.exact_likelihood import correct_draws
from fitact.populations.finger import SHARED_PARAMETER, SKIN, Finger
from fitact.populations.hierarchy import AREA, Hierarchy, laplace
from fitact.populations.next_finger import NewFingerModel
from fitact.populations.population import Population, evaluate_parameters, log_medians
from fitact.populations.record_files import RecordFiles
from fitact.populations.within_finger import WithinFinger
from fitact.prior.prior import Prior
from fitact.progress import track_progress
from fitact.readers.study import Nesting, Study, nest_levels
from fitact.sampling.convergence import Convergence, diagnose_weights
from fitact.sampling.ensemble import Target, reject_nonfinite, run_ensembles
from fitact.sampling.importance import draw_adaptively, systematic_resample
from fitact.sampling.proposal import Proposal
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.tracking.track import Track
from fitact.tracking.tracked_finger import TrackedFinger

_CHAIN_FILE = "chain.h5"

# what is given of one finger: a track, or what `fit` takes
FingerData: TypeAlias = Record | Spectrum | Sequence[Record | Spectrum] | Track | TrackedFinger


def population(
    records: Sequence[FingerData] | Study,
    scene: Scene | None = None,
    *,
    labels: Mapping[str, Sequence[str]] | None = None,
    covariates: Mapping[str, Sequence[float]] | None = None,
    at: Mapping[str, float] | None = None,
    folder: str | os.PathLike[str] | None = None,
    seed: int = 0,
    max_steps: int = 20_000,
    progress: bool = True,
) -> Population:
    """Sample the distribution of fingers on one panel, from records of persons, fingers and touches, until converged.

    log Rsc and log Csc of a touch are the sum of medians and of normal effects of its person, finger, session and
    repetition, as far as `labels` tell these apart; without labels each record is another finger. At each level Rsc and
    Csc are correlated. All share the panel's Ci. With the scene's `[population] contact_area = "varies"`, Ci, Csc and
    1/Rsc scale with each touch's own log-normal contact area, which has effects at the same levels. Medians and Ci have
    the scene's prior, log-standard deviations a half-normal prior of scale 0.5, and a correlation r has the density 3/4
    (1 - r^2). The effects are integrated out; the rest is sampled by weighted draws, or by emcee where these fail.

    Args:
        records: records, spectra or tracks on one panel, or sequences of records that are fitted jointly; they are read
            one after the other and not kept. A finger of a track is its average over time; the tracks together give
            the variation within fingers. A `Study` has labels and covariates, too.
        scene: scene of all records; its prior of Rsc and Csc is the prior of their medians.
        labels: one text per record under each of "person", "finger", "session" and "repetition" that is known.
        covariates: one number per record under each name, such as skin moisture; the medians of log Rsc and log Csc,
            and of the area if it varies, change linearly with each, with a normal prior of scale 0.5 per standard
            deviation of the covariate.
        at: covariates of the next finger; default: their mean.
        folder: folder for emcee's chain, if it is needed; a chain of the same records there is resumed.
        seed: the same seed gives the same draws, whether or not sampling was interrupted.
        max_steps: largest number of emcee's steps, after which the result is marked as not converged.
        progress: whether to report on standard error.

    Ctrl-C ends the sampling; the result is then marked as not converged.

    Raises:
        InputError: there are fewer than two records, one is given twice or refused, the scene's prior does not leave
            Rsc, Csc and Ci free, the records contradict one contact area, two records have the same labels, a covariate
            has no effect to estimate, or the folder's chain has other inputs.
    """
    scene = scene or Scene()
    medians = _prior(scene)
    area_varies = scene.population.contact_area == "varies"
    if area_varies and ("Ri" in scene.prior.specs() or scene.device.Ri is not None):
        raise InputError(
            "scene: [population] contact_area = 'varies' excludes a leak of the insulator, whose Ri would vary, too;"
            " leave [device] Ri and [prior] Ri out, or state contact_area = 'common'"
        )
    if isinstance(records, Study):
        labels = labels or records.labels
        covariates = covariates or records.covariates
        items: Sequence[FingerData] = RecordFiles(records.records, scene)
    else:
        items = records
    nesting = nest_levels(labels or {}, len(items))
    standardized = Covariates.from_values(covariates or {}, len(items))
    next_at = standardized.standardize(at or {})
    factors = (*SKIN, SHARED_PARAMETER, *((AREA,) if area_varies else ()), *scene.thickness_sd())
    # errors of the instruments are the same for all fingers, so that they do not make these differ
    exact = scene.without_instrument_errors()
    fingers, new_finger, tracked = _fit_fingers(items, exact, medians, factors, progress)
    area_test = ContactAreaTest.from_fingers(
        fingers, medians[SHARED_PARAMETER], scene.population.contact_area, math.log1p(scene.tolerance.force)
    )
    if area_test.disagrees:
        raise InputError(f"scene: {area_test.sentence}")
    within = _pool_tracks(fingers, tracked, new_finger, seed)
    averages = [
        finger if within is None or finger.fingerprint in tracked else finger.blur(within.mean_covariance)
        for finger in fingers
    ]
    with double_precision(), limit_to_one_thread():
        hierarchy = Hierarchy.from_fingers(averages, nesting, medians, standardized.z_scores, area_varies=area_varies)
        chain_file = None if folder is None else Path(folder) / _CHAIN_FILE
        fingerprint = _fingerprint(averages, nesting, standardized, scene, seed)
        points, convergence = sample_hierarchy(hierarchy, fingerprint, seed, max_steps, chain_file, progress)
        top = nesting.levels[0].unit_numbers
        points, error = correct_draws(hierarchy, averages, top, points, seed, progress)
    return Population(
        fingers, nesting, hierarchy, points, convergence, error, new_finger, standardized, next_at, scene, seed,
        area_test, within,
    )  # fmt: skip


def delete_chains(folder: str | os.PathLike[str]) -> None:
    """Remove the chain of `population` from a folder."""
    (Path(folder) / _CHAIN_FILE).unlink(missing_ok=True)


def sample_hierarchy(
    hierarchy: Hierarchy, fingerprint: str, seed: int, max_steps: int, chain_file: Path | None, progress: bool
) -> tuple[np.ndarray, Convergence]:
    """Sample points (ensembles, about `draws`, coordinates), with their diagnostics.

    Weighted draws serve if enough of them are effective; otherwise emcee samples.
    """
    walkers, ensembles, draws, weighted_draws, least_effective = 128, 4, 2500, 60_000, 2000
    rows, names = hierarchy.targets.size * hierarchy.origin.size, hierarchy.names
    log_prob = reject_nonfinite(BatchEvaluator(Hierarchy.log_prob, hierarchy, rows, batch=256))
    random = np.random.default_rng([seed, 10])
    widening = np.array([1.15 if name.startswith("spread") else 1.0 for name in names])  # chosen by k-hat
    found = draw_adaptively(log_prob, *laplace(hierarchy), random, weighted_draws, widening=widening)
    if (chain_file is None or not chain_file.exists()) and np.isfinite(found.weighted.k_hat):
        medians = log_medians(evaluate_parameters(hierarchy, found.points))
        quantities = dict(zip(names, found.points.T, strict=True)) | medians
        convergence = diagnose_weights("psis", found.weighted, quantities, ensembles * draws)
        if convergence.converged and convergence.ess_min >= least_effective:
            places = systematic_resample(found.weighted.weights, ensembles * draws, float(random.uniform()))
            return found.points[random.permutation(places)].reshape(ensembles, draws, len(names)), convergence
    target = Target(
        names,
        log_prob,
        Proposal.from_laplace(found.center, found.root, log_prob),
        lambda points, _: log_medians(evaluate_parameters(hierarchy, points)),
        fingerprint,
    )
    chain, convergence = run_ensembles(target, seed, walkers, ensembles, max_steps, chain_file, progress)
    points = chain.points[:, chain.thinning_slice(convergence.burn, draws)]
    return points.reshape(ensembles, -1, len(names)), convergence


def _prior(scene: Scene) -> Prior:
    """Return the prior of the medians and Ci."""
    prior, names = scene.make_prior(), (*SKIN, SHARED_PARAMETER)
    if not set(names) <= set(prior.names):
        raise InputError("scene: [prior] fixes or ties Rsc, Csc or Ci; a population needs a prior density of each")
    if not {name for pair in (*prior.pairs, *prior.order_constraints) for name in pair[:2]} <= set(names):
        raise InputError(
            "scene: [prior] correlates or orders Rsc, Csc or Ci with other parameters, which fitact population does not"
            " support; remove that"
        )
    return Prior(names, tuple(prior[name] for name in names), prior.pairs, prior.order_constraints)


def _fit_fingers(
    records: Sequence[FingerData],
    scene: Scene,
    prior: Prior,
    factors: tuple[str, ...],
    progress: bool,
) -> tuple[tuple[Finger, ...], NewFingerModel, dict[str, TrackedFinger]]:
    """Fit each record by itself, and model the next finger under the first record's drive; also return the tracks."""
    if len(records) < 2:
        raise InputError(f"{len(records)} records: a population needs records of two or more fingers or touches")
    fingers: dict[str, Finger] = {}
    tracks: dict[str, TrackedFinger] = {}
    refusals: list[InputError] = []
    new_finger = None
    numbers = range(len(records))
    for number in track_progress(numbers, "fitting the fingers", len(records)) if progress else numbers:
        try:
            item = records[number]
            record = TrackedFinger.from_track(item) if isinstance(item, Track) else item
            if not (isinstance(record, TrackedFinger) and new_finger):
                fitted = _fit_one(record, scene)
        except InputError as error:
            refusals.append(error)
            continue
        with double_precision():
            new_finger = new_finger or NewFingerModel.from_fit(fitted, factors)
            tracked = record if isinstance(record, TrackedFinger) else None
            finger = Finger.from_fit(fitted) if tracked is None else Finger.from_track(tracked, prior)
        twin = fingers.get(finger.fingerprint)
        if twin is not None:
            raise InputError(
                f"{finger.source} holds the same record as {twin.source}, whose finger would count twice; drop one"
            )
        fingers[finger.fingerprint] = finger
        if tracked is not None:
            tracks[finger.fingerprint] = tracked
    if refusals or new_finger is None:
        raise _refusal(refusals)
    return tuple(fingers.values()), new_finger, tracks


def _fit_one(record: Any, scene: Scene) -> Fit:
    """Fit records, or the window of a track under its recorded drive."""
    if not isinstance(record, TrackedFinger):
        return fit(record, scene)
    return fit(record.window, scene.model_copy(update={"drive": DriveSection(waveform="measured")}))


def _pool_tracks(
    fingers: Sequence[Finger], tracks: Mapping[str, TrackedFinger], new_finger: NewFingerModel, seed: int
) -> WithinFinger | None:
    """Pool the variation within tracked fingers; None means that no finger was tracked."""
    if not tracks:
        return None
    ordered = [finger for finger in fingers if finger.fingerprint in tracks]
    logs = np.log([[finger.parameters[name]["q50"] for name in (*SKIN, SHARED_PARAMETER)] for finger in ordered])
    random = np.random.default_rng([seed, 5])
    return WithinFinger.from_tracks([tracks[finger.fingerprint] for finger in ordered], logs, new_finger, random)


def _refusal(errors: Sequence[InputError], max_named: int = 5) -> InputError:
    """Combine errors: the first in full, and the names of at most `max_named` other records."""
    # an error message begins with the name of its record
    names = [os.path.basename(str(error).partition(":")[0]) for error in errors[1:]]
    if len(names) > max_named:
        names[max_named:] = [f"{len(names) - max_named} more"]
    return InputError(f"{errors[0]}; also refused: {', '.join(names)}" if names else str(errors[0]))


def _fingerprint(fingers: Sequence[Finger], nesting: Nesting, covariates: Covariates, scene: Scene, seed: int) -> str:
    """Return a hash of all inputs of a chain."""
    data = [[finger.fingerprint, finger.center.tolist(), finger.target.tolist()] for finger in fingers]
    units = [[level.name, level.unit_numbers.tolist()] for level in nesting.levels]
    settings = [importlib.metadata.version("fitact"), data, units, covariates.z_scores.tolist(), scene.to_json(), seed]
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()
