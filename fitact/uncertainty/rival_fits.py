"""Fits of rivals, i.e. of what a model may lack, to the residuals of a fit."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from fitact.uncertainty.channel_series import Rows
from fitact.uncertainty.linear_model import Columns, LinearModel, Nuisance
from fitact.uncertainty.rivals import Rival

Shifts = Float[np.ndarray, " quantities"]
MIN_LIKENESS = 0.9  # of the best decrease of chi-square, from which a rival counts as one


class RivalFit(NamedTuple):
    """A rival fitted to residuals, to first order or by a few steps of Gauss and Newton."""

    rival: Rival
    delta_chi2: float  # decrease of chi-square
    shift: Shifts  # change of the logarithm of each quantity if the rival is added to the model
    visible: float  # fraction of the rival's effect that parameters cannot imitate
    amplitudes: Float[np.ndarray, " amplitudes"]
    errors: Float[np.ndarray, " amplitudes"]  # standard errors of the amplitudes
    explained: Rows  # what it explains of the residuals
    left: Rows  # what it leaves of them


class RivalColumns(NamedTuple):
    """First-order effect of a rival on the whitened data, and on a fit to them."""

    rival: Rival
    columns: Columns
    left: Columns  # part that parameters cannot imitate
    shifts: Float[np.ndarray, "quantities amplitudes"]  # of the fit


def rival_columns(model: LinearModel, rivals: Sequence[Rival], step: float = 1e-4) -> list[RivalColumns]:
    """Return the derivatives of the whitened data in the amplitudes of each rival that has an effect."""
    models, found = model.models(model.posterior.theta), []
    for rival in rivals:
        columns = np.zeros((model.rows, rival.amplitudes))
        for k, unit in enumerate(np.eye(rival.amplitudes) * step * rival.size):
            parts = [each.series.whiten(rival.effect(each, unit) - rival.effect(each, -unit)) for each in models]
            columns[:, k] = np.concatenate(parts) / (2.0 * step * rival.size)
        if np.all(np.isfinite(columns)) and np.linalg.norm(columns) * rival.size > 1e-6:
            found.append((rival, columns))
    return _project_columns(model, found)


def _project_columns(model: LinearModel, effects: Sequence[tuple[Rival, Columns]]) -> list[RivalColumns]:
    """Return effects with what they do to a fit."""
    if not effects:
        return []
    together = np.concatenate([columns for _, columns in effects], axis=1)
    ends = np.cumsum([columns.shape[1] for _, columns in effects])[:-1]
    parts = (np.split(x, ends, axis=1) for x in (model.remainder(together), model.shifts(together)))
    return [RivalColumns(*effect, *projected) for effect, *projected in zip(effects, *parts, strict=True)]


def fit_rivals(model: LinearModel, columns: Sequence[RivalColumns], refined: int = 8) -> list[RivalFit]:
    """Return the rivals that explain the residuals significantly and may have the size they would need, best first.

    The best few are fitted by steps of Gauss and Newton.
    """
    residuals = model.residuals
    linear = [fit_rival(model, residuals, each) for each in columns]
    order = sorted(
        (each for each in linear if each is not None and is_significant(each)), key=lambda each: -each.delta_chi2
    )
    possible = [each for each in order if is_possible(each)]
    found = [refine(model, residuals, each) for each in possible[:refined]] + possible[refined:]
    return sorted(found, key=lambda each: -each.delta_chi2)


def fit_rival(model: LinearModel, residuals: Rows, each: RivalColumns) -> RivalFit | None:
    """Return the rival fitted to residuals to first order; None if it is invisible."""
    rival, columns, left, shifts = each
    modes, sizes, directions = np.linalg.svd(left, full_matrices=False)
    kept = sizes > 1e-6 * np.linalg.norm(columns)
    if not kept.any():
        return None
    modes, sizes, directions = modes[:, kept], sizes[kept], directions[kept]
    projections = modes.T @ residuals
    variance = model.noise_variance @ modes**2
    delta_chi2 = float(np.sum(projections**2 / variance))
    amplitudes = directions.T @ (projections / sizes)
    shift = -(shifts @ amplitudes)
    explained = modes @ projections
    errors = np.sqrt(np.square(directions.T / sizes) @ variance)
    visible = float(np.linalg.norm(left @ amplitudes) / np.linalg.norm(columns @ amplitudes))
    return RivalFit(rival, delta_chi2, shift, visible, amplitudes, errors, explained, residuals - explained)


def is_significant(fitted: RivalFit) -> bool:
    """Return whether a rival explains more than three standard deviations of noise would."""
    return fitted.delta_chi2 > float(scipy.special.chdtri(fitted.amplitudes.size, 2.7e-3))


def is_possible(fitted: RivalFit, excess: float = 2.0) -> bool:
    """Return whether a rival has a possible sign, and a size that does not exceed the plausible one by far."""
    if fitted.rival.is_positive and np.any(fitted.amplitudes < -3.0 * fitted.errors):
        return False
    return bool(np.linalg.norm(fitted.amplitudes) < excess * fitted.rival.size)


@np.errstate(all="ignore")  # a step may lead beyond what numbers can hold
def refine(
    model: LinearModel, residuals: Rows, fitted: RivalFit, reference: Rows | None = None, steps: int = 5
) -> RivalFit:
    """Return the rival fitted by steps of Gauss and Newton, for effects that are not linear in their amplitude.

    The decrease of chi-square is relative to the `reference` residuals, or to the residuals that are fitted.
    """
    rival, origin = fitted.rival, model.posterior.theta
    theta, amplitudes = origin.copy(), np.zeros(rival.amplitudes)
    width = len(model.kept)
    prior, nuisances = model.design[model.rows :, :width], model.design[:, width:]
    start, left = model.signals(origin), residuals
    sensitivities = model.design[: model.rows, :width]
    for number in range(steps):
        if number > 0:
            sensitivities = model.sensitivities(theta)
        columns = np.concatenate([sensitivities, _rival_at(model, rival, theta, amplitudes)], axis=1)
        below = np.pad(prior, ((0, 0), (0, rival.amplitudes)))
        design = np.concatenate([np.concatenate([columns, below]), nuisances], axis=1)
        if not np.all(np.isfinite(design)):
            return fitted
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        step = np.linalg.lstsq(design / scale, left, rcond=1e-12)[0] / scale
        theta[model.kept] += step[:width]
        low = -0.05 if rival.is_positive else -4.0
        amplitudes = np.clip(amplitudes + step[width : width + rival.amplitudes], low * rival.size, 4.0 * rival.size)
        if not np.all(np.abs(theta - origin) < 3.0 + 10.0 * np.abs(origin)):
            return fitted
        change, before = _rival_signals(model, rival, theta, amplitudes) - start, left
        left = residuals - np.concatenate([change, prior @ (theta - origin)[model.kept]])
        if not np.all(np.isfinite(left)):
            return fitted
        if nuisances.shape[1]:  # which take up what they can
            left = left - nuisances @ np.linalg.lstsq(nuisances, left, rcond=1e-12)[0]
        if np.linalg.norm(left - before) < 0.01:  # of a standard deviation
            break
    variance, reference = model.noise_variance[: model.rows], residuals if reference is None else reference
    delta_chi2 = float(np.sum((reference[: model.rows] ** 2 - left[: model.rows] ** 2) / variance))
    shift = model.posterior.gradients @ (theta - origin)
    far = fitted._replace(
        delta_chi2=delta_chi2, shift=shift, amplitudes=amplitudes, explained=residuals - left, left=left
    )
    return far if delta_chi2 > fitted.delta_chi2 - 0.1 * abs(fitted.delta_chi2) and is_possible(far) else fitted


def _rival_signals(model: LinearModel, rival: Rival, theta: np.ndarray, amplitudes: np.ndarray) -> Rows:
    parts = [each.series.whiten(rival.effect(each, amplitudes)) for each in model.models(theta)]
    return np.concatenate(parts)


def _rival_at(model: LinearModel, rival: Rival, theta: np.ndarray, amplitudes: np.ndarray) -> Columns:
    steps = np.eye(rival.amplitudes) * 1e-4 * rival.size
    signals = [
        _rival_signals(model, rival, theta, amplitudes + step) - _rival_signals(model, rival, theta, amplitudes - step)
        for step in steps
    ]
    return np.stack(signals, axis=1) / (2e-4 * rival.size)


def nuisance_alternatives(model: LinearModel, nuisance: Nuisance, rivals: Sequence[Rival]) -> list[RivalFit]:
    """Return the rivals that fit nearly as well as a nuisance that was added to the model, without it.

    Shifts and decreases of chi-square are relative to the fit with the nuisance.
    """
    simpler = LinearModel(model.posterior, model.series, nuisance)
    columns, part = model.nuisance_part(simpler, nuisance)
    if not columns.size:
        return []
    residuals = model.residuals + np.pad(part, (0, len(model.residuals) - model.rows))
    residuals = np.concatenate([residuals[: model.rows], np.zeros(len(simpler.design) - model.rows)])
    itself = Rival(nuisance.name, 1.0, lambda each, _: each.signal)
    chosen = fit_rival(simpler, residuals, *_project_columns(simpler, [(itself, columns)]))
    if chosen is None or not is_significant(chosen):
        return []
    alternatives = []
    for each in rival_columns(simpler, rivals):
        linear = fit_rival(simpler, residuals, each)
        if linear is None or linear.delta_chi2 < 0.5 * chosen.delta_chi2:
            continue
        fitted = linear._replace(delta_chi2=linear.delta_chi2 - chosen.delta_chi2, shift=linear.shift - chosen.shift)
        fitted = refine(simpler, residuals, fitted, model.residuals)
        if fitted.delta_chi2 > (MIN_LIKENESS - 1.0) * chosen.delta_chi2 and is_possible(fitted):
            alternatives.append(fitted)
    return alternatives


def hints(model: LinearModel, columns: Sequence[RivalColumns]) -> list[RivalFit]:
    """Return the rivals that the data ask for although the residuals pass their tests.

    A rival counts if the BIC favours it as it would a nuisance, or if it is certain to exist and beyond two standard
    errors. Only those count that explain the residuals about as well as the best.
    """
    linear = (fit_rival(model, model.residuals, each) for each in columns)
    size = math.log(sum(np.count_nonzero(each.samples.weight) for each in model.series))
    found = [
        each
        for each in linear
        if each is not None
        and is_possible(each)
        and each.delta_chi2 > (4.0 if each.rival.is_certain else 10.0 + each.amplitudes.size * size)
    ]
    best = max((each.delta_chi2 for each in found), default=0.0)
    return [each for each in found if each.delta_chi2 >= MIN_LIKENESS * best]
