"""Comparison of several models of the same samples by cross-validation and information criteria."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.fitting.fit import fit_records
from fitact.fitting.result import Fit
from fitact.model_selection.cross_validation import CrossValidation, cross_validate
from fitact.scene.scene import Scene
from fitact.summary import round_to_sd
from fitact.tables import align_table, join_lines

_CRITERIA = ("log_likelihood", "parameters_counted", "aic", "aicc", "bic")


@dataclasses.dataclass(frozen=True)
class ModelScore:
    """Fit and cross-validation of one model."""

    name: str  # name of its scene
    fit: Fit  # fit to all samples
    cross_validation: CrossValidation  # log predictive densities of held-out blocks

    @property
    def elpd(self) -> float:
        """Expected log predictive density, summed over the held-out blocks."""
        return float(self.cross_validation.log_density.sum())

    @property
    def elpd_se(self) -> float:
        """Standard error of `elpd`."""
        return _standard_error(self.cross_validation.log_density)

    def elpd_difference(self, other: "ModelScore") -> tuple[float, float]:
        """Return the elpd of another model minus the elpd of this one, and the standard error of the difference."""
        difference = other.cross_validation.log_density - self.cross_validation.log_density
        return float(difference.sum()), _standard_error(difference)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Comparison of models of the same samples.

    Attributes:
        models: models in the order of decreasing elpd.
        elpd_threshold: minimum significant difference of the elpd, in standard errors.
        bic_threshold: minimum significant difference of the BIC.
        note: what the comparison rests on, as a sentence after a blank, or "".
    """

    models: tuple[ModelScore, ...]
    elpd_threshold: float = 2.0
    bic_threshold: float = 10.0
    note: str = ""

    @property
    def _candidates(self) -> list[ModelScore]:
        """Models whose elpd does not differ significantly from the best, in the order of increasing BIC."""
        best, *others = self.models
        rows = [(model, *model.elpd_difference(best)) for model in others]
        return sorted([best, *(model for model, short, se in rows if short < self.elpd_threshold * se)], key=_bic)

    @property
    def preferred(self) -> str | None:
        """Preferred model, or None if several cannot be distinguished."""
        first, *others = self._candidates
        return None if others and _bic(others[0]) - _bic(first) < self.bic_threshold else first.name

    @property
    def trusted(self) -> bool:
        """Whether the fit of the preferred model (or of the best, if none is preferred) is reliable."""
        return self._leading_model.fit.trusted

    @property
    def _leading_model(self) -> ModelScore:
        return self.models[0] if self.preferred is None else self._candidates[0]

    @property
    def verdict(self) -> str:
        """Preferred model and the difference to the next, or that none is preferred, in a sentence."""
        leading, preference = self._leading_model, self._describe_preference()
        doubt = "" if self.trusted else f" The fit of {leading.name} is unreliable: {leading.fit.message}"
        return f"{preference}{self.note}{doubt}"

    def _describe_preference(self) -> str:
        first, *others = self._candidates
        if not others:
            second = min(self.models[1:], key=lambda model: model.elpd_difference(first)[0])
            return (
                f"{first.name} is preferred: it predicts the held-out blocks better than {second.name}, by an elpd of"
                f" {_format_elpd_difference(second, first)}."
            )
        rival = others[0]
        worse, better = (rival, first) if rival.elpd_difference(first)[0] >= 0.0 else (first, rival)
        why = (
            f"{better.name} predicts the held-out blocks better by an elpd of only"
            f" {_format_elpd_difference(worse, better)}, and {first.name}"
            f" has a BIC that is lower by {_bic(rival) - _bic(first):.3g}."
        )
        if self.preferred is None:
            return f"{first.name} and {rival.name} cannot be distinguished: {why}"
        return f"{first.name} is preferred because of its BIC: {why}"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings as sentences."""
        failed = [
            f"{m.name}: {m.cross_validation.folds_failed} of {m.cross_validation.folds} fits without one fold did not"
            " converge, so its elpd may be too low; fix parameters or state narrower priors"
            for m in self.models
            if m.cross_validation.folds_failed
        ]
        doubtful = [f"{m.name}: {m.fit.message}" for m in self.models if not m.fit.trusted]
        return (*doubtful, *failed)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `fitact compare`."""
        best = self.models[0]
        rows = []
        for model in self.models:
            short, error = model.elpd_difference(best)
            rows.append(
                {"name": model.name, **{name: model.fit.figures[name] for name in _CRITERIA}}
                | {"elpd": model.elpd, "elpd_se": model.elpd_se, "elpd_below_best": short, "elpd_below_best_se": error}
                | {"result": model.fit.result, "folds_failed": model.cross_validation.folds_failed}
            )
        return {
            "models": rows,
            "preferred": self.preferred,
            "verdict": self.verdict,
            "trusted": self.trusted,
            "blocks": int(best.cross_validation.log_density.size),
            "folds": best.cross_validation.folds,
            "samples": int(best.fit.figures["samples"]),
            "warnings": list(self.warnings),
        }

    def summary(self) -> str:
        """Return a text table and the verdict."""
        best = self.models[0]
        titles = ("model", "log-lik.", "parameters", "AIC", "AICc", "BIC", "elpd", "below the best")
        rows = []
        for model in self.models:
            criteria = [f"{model.fit.figures[name]:.{0 if name == 'parameters_counted' else 2}f}" for name in _CRITERIA]
            difference = "" if model is best else _format_elpd_difference(model, best)
            rows.append((model.name, *criteria, f"{model.elpd:.2f}", difference))
        legend = (
            f"elpd: log predictive density of {best.cross_validation.log_density.size} blocks, in"
            f" {best.cross_validation.folds} held-out folds; below the best: difference ± its standard error."
        )
        return join_lines([*align_table([titles, *rows]), legend, self.verdict], self.warnings)

    __str__ = summary


def compare(
    records: Record | Spectrum | Sequence[Record | Spectrum], scenes: Mapping[str, Scene] | Sequence[Scene]
) -> Comparison:
    """Fit the model of each scene to the same records, and determine which the data prefer.

    The score is the elpd, i.e. the log predictive density of blocks of samples given all samples outside their fold.
    Blocks are whole periods if a record has twenty, else contiguous intervals, or points of a spectrum. If elpds differ
    by less than 2 standard errors, a BIC that is lower by 10 decides. Each scene applies to all records.

    Args:
        records: one record or spectrum, or several of one finger.
        scenes: two or more scenes, by name; without names they are "scene 1", "scene 2", ...

    Raises:
        InputError: see `fitact.fit`; also for fewer than two scenes, or scenes that do not model the same samples.
    """
    if not isinstance(scenes, Mapping):
        scenes = {f"scene {i}": scene for i, scene in enumerate(scenes, 1)}
    if len(scenes) < 2:
        raise InputError(f"{len(scenes)} scene to compare: give two or more models of the same samples")
    (first, reference), *others = ((name, sorted(set(s.measurement.channels))) for name, s in scenes.items())
    for name, channels in others:
        if channels != reference:
            raise InputError(
                f"{first} models {' and '.join(reference)}, {name} models {' and '.join(channels)}: only"
                " models of the same samples can be compared; give both the same [measurement] channels"
            )
    fits = _fit_same_samples((records,) if isinstance(records, Record | Spectrum) else tuple(records), scenes)
    scores = [ModelScore(name, fitted, cross_validate(fitted)) for name, fitted in fits.items()]
    note, laws = "", {scene.force.model for scene in scenes.values()}
    if len(laws) > 1 and all("force_scale" in fitted.names for fitted in fits.values()):
        note = " As force_scale is free, only the shape of the force in time tells the force laws apart."
    return Comparison(tuple(sorted(scores, key=lambda model: -model.elpd)), note=note)


def _fit_same_samples(records: tuple[Record | Spectrum, ...], scenes: Mapping[str, Scene]) -> dict[str, Fit]:
    """Return the fits of the scenes, repeated with the samples that all of them use if they differ in these."""
    fits = {name: fit_records(records, (scene,) * len(records)) for name, scene in scenes.items()}
    used = {name: [each.samples.likelihood_mask for each in fit.likelihood.channels] for name, fit in fits.items()}
    shared = [np.logical_and.reduce(masks) for masks in zip(*used.values(), strict=True)]
    for name, masks in used.items():
        excluded = [mask & ~common for mask, common in zip(masks, shared, strict=True)]
        if any(map(np.any, excluded)):
            fits[name] = fit_records(records, (scenes[name],) * len(records), excluded=excluded)
    _require_same_samples(fits)
    return fits


def _require_same_samples(fits: Mapping[str, Fit]) -> None:
    (first, reference), *others = fits.items()
    for name, other in others:
        channels = zip(reference.likelihood.channels, other.likelihood.channels, strict=True)
        for trace, pair in zip(reference.traces, channels, strict=True):
            differ = np.count_nonzero(np.not_equal(*(each.samples.likelihood_mask for each in pair)))
            if differ:
                raise InputError(
                    f"{first} and {name} do not use the same samples of {trace.channel}: {differ} enter only"
                    " one of them, since a resistance limits its current; give both the same series resistor and R_H"
                )


def _bic(model: ModelScore) -> float:
    return model.fit.figures["bic"]


def _format_elpd_difference(worse: ModelScore, better: ModelScore) -> str:
    short, error = worse.elpd_difference(better)
    return " ± ".join(round_to_sd((short, error), error))


def _standard_error(values: Float[np.ndarray, " blocks"]) -> float:
    """Return the standard error of the sum of independent values."""
    return math.sqrt(values.size) * float(np.std(values, ddof=1)) if values.size > 1 else math.inf
