"""Effect size of structure in residuals, the rivals that would explain it, and the shifts that no residual reveals."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool

from fitact.uncertainty.channel_series import ChannelSamples, ChannelSeries, Rows, channel_series
from fitact.uncertainty.linear_model import Columns, LinearModel, LinearPosterior, Nuisance
from fitact.uncertainty.rival_fits import (
    MIN_LIKENESS,
    RivalColumns,
    RivalFit,
    Shifts,
    fit_rivals,
    hints,
    is_possible,
    is_significant,
    nuisance_alternatives,
    rival_columns,
)
from fitact.uncertainty.rivals import Rival, known_rivals


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
    posterior: LinearPosterior,
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
    rows = max(1024, max_rows // (1 if has_structure or added else 8) // len(channels))
    views = [channel_series(each, rows) for each in channels]
    chosen = [[view[0] for view in views], [view[-1] for view in views]]
    count = 1 + ((has_structure or bool(added)) and any(len(view) > 1 for view in views))
    models = [LinearModel(posterior, series) for series in chosen[:count]]
    columns = [rival_columns(model, rivals) for model in models]
    effect = structure = np.zeros(len(posterior.quantities))
    fits: list[RivalFit] = []
    names_of: dict[str, tuple[str, ...]] = {}
    for model, effects in zip(models, columns, strict=True):
        alternatives = [nuisance_alternatives(model, each, rivals) for each in added]
        if has_structure:
            found = fit_rivals(model, effects)
            found += [each for others in alternatives for each in others if is_significant(each)]
            parts = [split_difference(model), random_phase(model), likely_shift(model, found)]
            effect, fits = np.maximum(effect, np.max(parts, axis=0)), [*fits, *found]
        else:
            alternatives.append(hints(model, effects))
            for nuisance, others in zip([*added, Nuisance((), "residuals")], alternatives, strict=True):
                word = nuisance.name.partition("_")[0]
                if causes := tuple(each.rival.name for each in others if word not in each.rival.name):
                    names_of[nuisance.name] = causes
            shifts = [np.max([np.abs(each.shift) for each in a], axis=0) for a in alternatives if a]
            structure = np.maximum(structure, np.sqrt(np.sum(np.square(shifts), axis=0))) if shifts else structure
    names = posterior.quantities
    return EffectSizes(
        dict(zip(names, effect.tolist(), strict=True)),
        describe_rivals([each for each in fits if is_possible(each)], names),
        blind_table(models[0], columns[0], names),
        dict(zip(names, structure.tolist(), strict=True)),
        names_of,
    )


def likely_shift(model: LinearModel, found: Sequence[RivalFit], wider: float = 0.5) -> Shifts:
    """Return the largest shift by the rivals that explain the residuals about as well as the best.

    If the best leaves lines in the spectrum, the cause may not be known, and rivals with the fraction `wider` of its
    decrease of chi-square count as well.
    """
    none = np.zeros(len(model.posterior.quantities))
    if not found:
        return none
    best = max(found, key=lambda each: each.delta_chi2)
    leaves_lines = any(np.any(excess > 0.0) for _, excess in excess_power(model, best.left, 16.0))
    least = (wider if leaves_lines else MIN_LIKENESS) * best.delta_chi2
    return np.max([none, *(np.abs(each.shift) for each in found if each.delta_chi2 >= least)], axis=0)


def excess_power(model: LinearModel, residuals: Rows, threshold: float = 9.0) -> Iterator[tuple[slice, Rows]]:
    """Yield for each channel its rows and the power of each line of residuals above that of the noise.

    The power is 0 for lines whose power is below `threshold` times that of the noise.
    """
    for rows in _row_slices(model):
        power = np.square(np.abs(np.fft.rfft(residuals[rows])[1:]))
        noise = (rows.stop - rows.start) * float(np.max(model.noise_variance[rows]))
        yield rows, np.where(power > threshold * noise, power - noise, 0.0)


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
    masks = [np.concatenate([each.is_early for each in model.series])]
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
    for rows, excess in excess_power(model, model.residuals):
        weights = np.square(np.abs(np.fft.rfft(model.weights[:, rows])[:, 1:]))
        square += 2.0 * weights @ excess / (rows.stop - rows.start) ** 2
    return np.sqrt(square)


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
                "explained": 1.0 - float(np.sum(each.left**2) / np.sum((each.left + each.explained) ** 2)),
                "shift": dict(zip(quantities, each.shift.tolist(), strict=True)),
                "visible": each.visible,
                "amplitudes": each.amplitudes.tolist(),
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
    for rival, effect, left, per_unit in columns:
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
