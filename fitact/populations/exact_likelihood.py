"""Correction of a population's posterior for the exact likelihoods of the records, which are taken as normal at first.

Given the population parameters, the touches of the records are drawn from their normal posterior. The mean ratio of
exact and normal likelihood over these draws, for each person, is the weight of the parameters. All parameters have the
same random numbers, so that the error of the means hardly changes the posterior; two sets of them tell its size.
"""

from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Float

from fitact.compiled import BatchEvaluator
from fitact.likelihood.likelihood import Likelihood
from fitact.populations.finger import Finger
from fitact.populations.hierarchy import Hierarchy
from fitact.progress import track_progress
from fitact.sampling.convergence import CRITERIA, pareto_smooth
from fitact.sampling.importance import systematic_resample

MAX_INTEGRATION_ERROR = 0.1  # largest shift of a mean by the normal likelihoods, in posterior standard deviations


def correct_draws(
    hierarchy: Hierarchy,
    fingers: Sequence[Finger],
    groups: np.ndarray,
    points: Float[np.ndarray, "ensembles draws n"],
    seed: int,
    progress: bool,
) -> tuple[Float[np.ndarray, "ensembles draws n"], float]:
    """Resample draws of the population parameters by the exact likelihoods, if that matters.

    `groups` has the number of the top level's unit of each finger. Also returns the largest shift of any mean, to first
    order, by what remains of the error, in posterior standard deviations; it is infinite where the weights fail.
    """
    if all(finger.likelihood is None for finger in fingers):
        return points, 0.0
    ensembles, draws, size = points.shape
    corrected = list(range(len(fingers)))

    def weigh(count: int, antithetic_pairs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        places = np.linspace(0, draws - 1, min(draws, max(1, count // ensembles))).astype(int)
        chosen = points[:, places].reshape(-1, size)
        sets = [
            log_weights(hierarchy, fingers, groups, chosen, antithetic_pairs, [seed, 6, number], corrected, progress)
            for number in range(2)
        ]
        log_totals, log_means = (np.array(each) for each in zip(*sets, strict=True))
        return chosen, log_totals, log_means.mean(axis=0)

    _, log_totals, log_means = weigh(200, antithetic_pairs=2)
    error = float(np.std(log_totals.mean(axis=0)))
    if error <= MAX_INTEGRATION_ERROR:
        return points, error
    # most fingers are known so well that their ratios matter to no parameter
    effect = np.std(log_means, axis=0)
    order = np.argsort(effect)
    negligible = np.cumsum(effect[order]) < 0.3 * MAX_INTEGRATION_ERROR
    corrected = sorted(order[~negligible].tolist())
    left_out = float(np.sum(effect[order[negligible]]))
    for antithetic_pairs in (8, 32):
        chosen, log_totals, _ = weigh(1000, antithetic_pairs)
        error = left_out + 0.5 * float(np.std(log_totals[1] - log_totals[0]))
        if error <= MAX_INTEGRATION_ERROR:
            break
    weighted, least_draws = pareto_smooth(log_totals.mean(axis=0)), 100.0
    if not (weighted.k_hat <= CRITERIA.k_hat and 1.0 / np.sum(np.square(weighted.weights)) >= least_draws):
        error = np.inf
    random = np.random.default_rng([seed, 7])
    places = random.permutation(systematic_resample(weighted.weights, len(chosen), float(random.uniform())))
    return chosen[places].reshape(ensembles, -1, size), error


def log_weights(
    hierarchy: Hierarchy,
    fingers: Sequence[Finger],
    groups: np.ndarray,
    points: Float[np.ndarray, "points n"],
    antithetic_pairs: int,
    seed: list[int],
    corrected: Sequence[int],
    progress: bool,
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points corrected"]]:
    """Return the logarithm of the mean ratio of the exact to the normal likelihood at points, up to a constant.

    The ratios of the fingers that are not `corrected` count as 1. Also returns the means for each of the others.
    """
    random, draws = np.random.default_rng(seed), 2 * antithetic_pairs
    components = len(hierarchy.components)

    def draw_deviates(*shape: int) -> np.ndarray:
        z = random.standard_normal((antithetic_pairs, *shape))
        return np.concatenate([z, -z])

    deviates = tuple(draw_deviates(units, components) for units in hierarchy.effects.counts)
    own = [draw_deviates(len(finger.names) - 3 + finger.log_sigma.size) for finger in fingers]
    rows = len(fingers) * hierarchy.origin.size
    draw_touches = BatchEvaluator(Hierarchy.draw_touches, hierarchy, rows, batch=256)
    evaluators = {
        number: BatchEvaluator(Likelihood.log_prob, likelihood, likelihood.rows)
        for number in corrected
        if (likelihood := fingers[number].likelihood) is not None
    }
    chunk = max(1, 2_000_000 // (len(fingers) * draws))  # limits the memory
    starts = range(0, len(points), chunk)
    totals, means = [], []
    for start in track_progress(starts, "integrating over the fingers", len(starts)) if progress else starts:
        some = points[start : start + chunk]
        tiled = [np.tile(each, (len(some), 1, 1)) for each in deviates]
        logs = draw_touches(np.repeat(some, draws, axis=0), *tiled)
        log_ratios = np.zeros((len(some), draws, groups.max() + 1))
        log_means = np.zeros((len(some), len(corrected)))
        for place, number in enumerate(corrected):
            if number not in evaluators:
                continue
            at, normal = fingers[number].place_nuisances(logs[:, number], np.tile(own[number], (len(some), 1)))
            ratio = (evaluators[number](at) - normal).reshape(-1, draws)
            ratio = np.where(np.isfinite(ratio), ratio, -np.inf)
            log_means[:, place] = scipy.special.logsumexp(ratio, axis=1)
            log_ratios[:, :, groups[number]] += ratio
        means.append(log_means)
        totals.append(np.sum(scipy.special.logsumexp(log_ratios, axis=1), axis=1))
    values = np.concatenate(totals)
    return values - np.max(values), np.concatenate(means)
