"""Effect size of structure in residuals, the rivals that would explain it, and the shifts that no residual reveals."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
import scipy.stats
from jaxtyping import Bool, Float

from fitact.uncertainty.channel_series import ChannelSamples, ChannelSeries, Rows, channel_series
from fitact.uncertainty.linear_model import Columns, LinearModel, Nuisance, Posterior
from fitact.uncertainty.rivals import Rival, known_rivals

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


@dataclasses.dataclass(frozen=True)
class EffectSizes:
    """How far what the model lacks may move each quantity."""

    effect_size: dict[str, float]  # relative shift that the structure could stand for; 0 if there is none
    rivals: tuple[dict[str, Any], ...]  # that explain the structure, the best first
    blind_table: tuple[dict[str, Any], ...]  # largest shift by each rival that the residuals do not show
    structure: dict[str, float]  # relative standard uncertainty from what an added nuisance may really be
    alternatives: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)  # names, by that of a nuisance

    @property
    def causes(self) -> list[str]:
        """Names of the rivals that explain the residuals about as well as the best."""
        best = self.rivals[0]["delta_chi2"] if self.rivals else 0.0
        return [rival["name"] for rival in self.rivals if rival["delta_chi2"] >= MIN_LIKENESS * best]

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of fit.json and summary.json."""
        names = ("effect_size", "rivals", "blind_table", "structure")
        return {name: getattr(self, name) for name in names}


NO_EFFECTS = EffectSizes({}, (), (), {})


def assess_effects(
    channels: Sequence[ChannelSamples],
    posterior: Posterior,
    has_structure: bool,
    added: Sequence[Nuisance],
    rivals: Sequence[Rival] = (),
    max_rows: int = 16_384,
) -> EffectSizes:
    """Return the effect sizes of a fit.

    `has_structure` says whether the residuals are more than noise, and `added` which nuisances the data asked for.
    Without either, only the blind table is computed. At most `max_rows` rows of data are used, of all channels.
    """
    rivals = rivals or known_rivals()
    rows = max(1024, max_rows // (1 if has_structure or added else 4) // len(channels))
    views = [channel_series(each, rows) for each in channels]
    chosen = [[view[0] for view in views], [view[-1] for view in views]]
    models = [LinearModel(posterior, series) for series in chosen[: 1 + any(len(view) > 1 for view in views)]]
    effect = structure = np.zeros(len(posterior.quantities))
    fits: list[RivalFit] = []
    names_of: dict[str, tuple[str, ...]] = {}
    for model in models:
        alternatives = [nuisance_alternatives(model, each, rivals) for each in added]
        if has_structure:
            found = fit_rivals(model, model.residuals, rival_columns(model, rivals))
            found += [each for others in alternatives for each in others if is_significant(each)]
            parts = [split_difference(model), random_phase(model), likely_shift(model, found)]
            effect, fits = np.maximum(effect, np.max(parts, axis=0)), [*fits, *found]
        else:
            alternatives.append(hints(model, rivals))
            for nuisance, others in zip([*added, Nuisance(0, "residuals")], alternatives, strict=True):
                word = nuisance.name.partition("_")[0]
                if causes := tuple(each.rival.name for each in others if word not in each.rival.name):
                    names_of[nuisance.name] = causes
            shifts = [np.max([np.abs(each.shift) for each in a], axis=0) for a in alternatives if a]
            structure = np.maximum(structure, np.sqrt(np.sum(np.square(shifts), axis=0))) if shifts else structure
    names, columns = posterior.quantities, list(rival_columns(models[0], rivals))
    return EffectSizes(
        dict(zip(names, effect.tolist(), strict=True)),
        describe_rivals([each for each in fits if is_possible(each)], names),
        blind_table(models[0], columns, names),
        dict(zip(names, structure.tolist(), strict=True)),
        names_of,
    )


class RivalColumns(NamedTuple):
    """First-order effect of a rival on the whitened data."""

    rival: Rival
    columns: Columns


def rival_columns(model: LinearModel, rivals: Sequence[Rival], step: float = 1e-4) -> Iterator[RivalColumns]:
    """Yield the derivatives of the whitened data in the amplitudes of each rival that has an effect."""
    models = model.models(model.posterior.theta)
    for rival in rivals:
        columns = np.zeros((model.rows, rival.amplitudes))
        for k, unit in enumerate(np.eye(rival.amplitudes) * step * rival.size):
            parts = [each.series.whiten(rival.effect(each, unit) - rival.effect(each, -unit)) for each in models]
            columns[:, k] = np.concatenate(parts) / (2.0 * step * rival.size)
        if np.all(np.isfinite(columns)) and np.linalg.norm(columns) * rival.size > 1e-6:
            yield RivalColumns(rival, columns)


def fit_rivals(
    model: LinearModel, residuals: Rows, columns: Iterable[RivalColumns], refined: int = 8
) -> list[RivalFit]:
    """Return the rivals that explain the residuals significantly and may have the size they would need, best first.

    The best few are fitted by steps of Gauss and Newton.
    """
    linear = [fit_rival(model, residuals, each) for each in columns]
    order = sorted(
        (each for each in linear if each is not None and is_significant(each)), key=lambda each: -each.delta_chi2
    )
    possible = [each for each in order if is_possible(each)]
    found = [refine(model, residuals, each) for each in possible[:refined]] + possible[refined:]
    return sorted(found, key=lambda each: -each.delta_chi2)


def fit_rival(model: LinearModel, residuals: Rows, each: RivalColumns) -> RivalFit | None:
    """Return the rival fitted to residuals to first order; None if it is invisible."""
    rival, columns = each
    left = model.remainder(columns)
    modes, sizes, directions = np.linalg.svd(left, full_matrices=False)
    kept = sizes > 1e-6 * np.linalg.norm(columns)
    if not kept.any():
        return None
    modes, sizes, directions = modes[:, kept], sizes[kept], directions[kept]
    projections = modes.T @ residuals
    variance = model.noise_variance @ modes**2
    delta_chi2 = float(np.sum(projections**2 / variance))
    amplitudes = directions.T @ (projections / sizes)
    shift = -(model.shifts(columns) @ amplitudes)
    errors = np.sqrt(np.square(directions.T / sizes) @ variance)
    visible = float(np.linalg.norm(left @ amplitudes) / np.linalg.norm(columns @ amplitudes))
    return RivalFit(rival, delta_chi2, shift, visible, amplitudes, errors, modes @ projections)


def likely_shift(model: LinearModel, found: Sequence[RivalFit], explained: float = 0.9, wider: float = 0.5) -> Shifts:
    """Return the largest shift by the rivals that explain the residuals about as well as the best.

    If the best explains less than the fraction `explained` of what is more than noise, the cause may not be known, and
    rivals with the fraction `wider` of its decrease of chi-square count as well.
    """
    best = max((each.delta_chi2 for each in found), default=0.0)
    rows = slice(0, model.rows)
    variance = model.noise_variance[rows]
    excess = float(np.sum(model.residuals[rows] ** 2 / variance)) - np.count_nonzero(model.residuals[rows])
    least = (MIN_LIKENESS if best > explained * excess else wider) * best
    shifts = [np.abs(each.shift) for each in found if each.delta_chi2 >= least]
    return np.max([np.zeros(len(model.posterior.quantities)), *shifts], axis=0)


def hints(model: LinearModel, rivals: Sequence[Rival]) -> list[RivalFit]:
    """Return the rivals that the data ask for although the residuals pass their tests.

    A rival counts if the BIC favours it as it would a nuisance, or if it is certain to exist and beyond two standard
    errors. Only those count that explain the residuals about as well as the best.
    """
    linear = (fit_rival(model, model.residuals, each) for each in rival_columns(model, rivals))
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


def is_significant(fitted: RivalFit) -> bool:
    """Return whether a rival explains more than three standard deviations of noise would."""
    return fitted.delta_chi2 > float(scipy.stats.chi2.isf(2.7e-3, fitted.amplitudes.size))


def is_possible(fitted: RivalFit, excess: float = 2.0) -> bool:
    """Return whether a rival has a possible sign, and a size that does not exceed the plausible one by far."""
    if fitted.rival.is_positive and np.any(fitted.amplitudes < -3.0 * fitted.errors):
        return False
    return bool(np.linalg.norm(fitted.amplitudes) < excess * fitted.rival.size)


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
    for _ in range(steps):
        columns = np.concatenate([model.sensitivities(theta), _rival_at(model, rival, theta, amplitudes)], axis=1)
        below = np.pad(prior, ((0, 0), (0, rival.amplitudes)))
        design = np.concatenate([np.concatenate([columns, below]), nuisances], axis=1)
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        step = np.linalg.lstsq(design / scale, left, rcond=1e-12)[0] / scale
        theta[model.kept] += step[:width]
        low = -0.05 if rival.is_positive else -4.0
        amplitudes = np.clip(amplitudes + step[width : width + rival.amplitudes], low * rival.size, 4.0 * rival.size)
        if not np.all(np.abs(theta - origin) < 3.0 + 10.0 * np.abs(origin)):
            return fitted
        change = _rival_signals(model, rival, theta, amplitudes) - start
        left = residuals - np.concatenate([change, prior @ (theta - origin)[model.kept]])
        if nuisances.shape[1]:  # which take up what they can
            left = left - nuisances @ np.linalg.lstsq(nuisances, left, rcond=1e-12)[0]
    variance, reference = model.noise_variance[: model.rows], residuals if reference is None else reference
    delta_chi2 = float(np.sum((reference[: model.rows] ** 2 - left[: model.rows] ** 2) / variance))
    shift = model.posterior.gradients @ (theta - origin)
    far = fitted._replace(delta_chi2=delta_chi2, shift=shift, amplitudes=amplitudes, explained=residuals - left)
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


def split_difference(model: LinearModel) -> Shifts:
    """Return half the largest difference between fits to two parts of the data, less what noise explains."""
    largest = np.zeros(len(model.posterior.quantities))
    for design, residuals, noise, mask in _splits(model):
        (one, variance), (other, more) = (
            model.shift_of_part(design[part], residuals[part], noise[part]) for part in (mask, ~mask)
        )
        square = (one - other) ** 2 - variance - more
        largest = np.maximum(largest, 0.5 * np.sqrt(np.maximum(square, 0.0)))
    return largest


def _splits(model: LinearModel) -> Iterator[tuple[Columns, Rows, Rows, Bool[np.ndarray, " rows"]]]:
    """Yield the design, the residuals and the noise variances with masks that split the rows in two parts."""
    rows = slice(0, model.rows)
    design, residuals, noise = model.design[rows], model.residuals[rows], model.noise_variance[rows]
    phases = [_drive_phase(each) for each in model.series]
    halves = np.concatenate([np.arange(each.time.size) < each.time.size // 2 for each in model.series])
    masks = [halves]
    if all(phase is not None for phase in phases):
        phase = np.concatenate([each for each in phases if each is not None])
        masks += [np.mod(2.0 * phase, 1.0) < 0.5, phase < 0.5]  # early and late in each half-period, rising and falling
    if len(model.series) > 1:
        masks.append(np.concatenate([np.full(each.time.size, i == 0) for i, each in enumerate(model.series)]))
    yield from ((design, residuals, noise, mask) for mask in masks)
    spectra = [_spectrum(model, rows_of, x) for rows_of in _row_slices(model) for x in (design, residuals[:, None])]
    design, residuals = np.concatenate(spectra[::2]), np.concatenate(spectra[1::2])[:, 0]
    line = np.concatenate([(np.arange(n.stop - n.start) + 1) // 2 for n in _row_slices(model)])
    b = model.posterior.quantities.index("b")
    weight = np.concatenate([_spectrum(model, n, model.weights[b][:, None]) for n in _row_slices(model)])[:, 0]
    information = np.cumsum(np.bincount(line, weight**2))
    middle = max(1, int(np.searchsorted(information, 0.5 * information[-1])))
    yield design, residuals, noise, line <= middle


def _row_slices(model: LinearModel) -> list[slice]:
    """Return the rows of each channel."""
    ends = np.cumsum([each.time.size for each in model.series])
    return [slice(end - each.time.size, end) for each, end in zip(model.series, ends.tolist(), strict=True)]


def _spectrum(model: LinearModel, rows: slice, columns: Columns) -> Columns:
    """Return the orthonormal real Fourier transform of rows of one channel, cosine and sine parts in turn."""
    n = rows.stop - rows.start
    lines = scipy.fft.rfft(columns[rows], axis=0, norm="ortho")
    parts = np.stack([lines.real, lines.imag], axis=1).reshape(2 * len(lines), -1) * math.sqrt(2.0)
    parts[0] /= math.sqrt(2.0)
    if n % 2 == 0:
        parts[-2] /= math.sqrt(2.0)
    return np.delete(parts, 1, axis=0)[:n]


def _drive_phase(series: ChannelSeries) -> Rows | None:
    """Return the phase of the drive from 0 to 1, which is 0 where its fundamental rises through zero, or None."""
    if series.samples.frequency is None:
        return None
    turns = series.samples.frequency * series.time
    fundamental = series.voltage @ np.exp(-2j * math.pi * turns)
    return np.mod(turns + np.angle(fundamental) / (2.0 * math.pi) + 0.25, 1.0)


def random_phase(model: LinearModel) -> Shifts:
    """Return the shift that residuals of this power spectrum and random phases would cause, noise taken off."""
    square = np.zeros(len(model.posterior.quantities))
    for rows in _row_slices(model):
        n = rows.stop - rows.start
        power = np.square(np.abs(np.fft.rfft(model.residuals[rows])[1:]))
        noise = n * float(np.max(model.noise_variance[rows]))
        excess = np.where(power > 9.0 * noise, power - noise, 0.0)
        square += 2.0 * np.square(np.abs(np.fft.rfft(model.weights[:, rows])[:, 1:])) @ excess / n**2
    return np.sqrt(square)


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
    chosen = fit_rival(
        simpler, residuals, RivalColumns(Rival(nuisance.name, 1.0, lambda each, _: each.signal), columns)
    )
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


def describe_rivals(
    fits: Sequence[RivalFit], quantities: Sequence[str], same_angle: float = 0.95
) -> tuple[dict[str, Any], ...]:
    """Return the rivals for fit.json, best first, each once; those that look alike belong to one group."""
    best: dict[str, RivalFit] = {}
    for each in sorted(fits, key=lambda each: -each.delta_chi2):
        best.setdefault(each.rival.name, each)
    leaders: list[RivalFit] = []
    entries = []
    for each in best.values():
        alike = (leader for leader in leaders if _cosine(leader.explained, each.explained) > same_angle)
        leader = next(alike, each)
        leaders += [each] if leader is each else []
        entries.append(
            {
                "name": each.rival.name,
                "group": leader.rival.name,
                "delta_chi2": each.delta_chi2,
                "shift": dict(zip(quantities, each.shift.tolist(), strict=True)),
                "visible": each.visible,
            }
        )
    return tuple(entries)


def _cosine(one: Rows, other: Rows) -> float:
    if one.size != other.size:
        return 0.0
    return abs(float(one @ other)) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-300)


def blind_table(
    model: LinearModel, columns: Sequence[RivalColumns], quantities: Sequence[str]
) -> tuple[dict[str, Any], ...]:
    """Return the largest shift of each quantity by a rival that stays below three standard deviations of the noise.

    The amplitude is at most the largest plausible one. The rival that shifts any quantity most stands first.
    """
    table: dict[str, tuple[Shifts, float]] = {}
    noise = math.sqrt(float(np.max(model.noise_variance)))
    for rival, effect in columns:
        left, per_unit = model.remainder(effect), model.shifts(effect)
        _, sizes, directions = np.linalg.svd(left, full_matrices=False)
        unseen = np.minimum(3.0 * noise / np.maximum(sizes, 1e-300), rival.size)
        shift = np.linalg.norm(per_unit @ directions.T * unseen, axis=1)
        visible = float(np.linalg.norm(left) / np.linalg.norm(effect))
        if rival.name not in table or np.max(shift) > np.max(table[rival.name][0]):
            table[rival.name] = shift, visible
    order = sorted(table.items(), key=lambda item: -float(np.max(item[1][0])))
    return tuple(
        {"name": name, "shift": dict(zip(quantities, shift.tolist(), strict=True)), "visible": visible}
        for name, (shift, visible) in order
    )
