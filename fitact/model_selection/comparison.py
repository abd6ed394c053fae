"""Which of several models of the same samples the data prefer: prediction of what was left out, and criteria."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.fit import Fit, fit
from fitact.model_selection.cross_validation import HeldOut, counted, held_out
from fitact.scene.scene import Scene

_APART = 2.0  # standard errors of a difference, from which predictions differ
_SMALL = 10.0  # of the Bayesian criterion: a difference that tells nothing for sure
_CRITERIA = ("log_likelihood", "parameters_counted", "aic", "aicc", "bic")


@dataclasses.dataclass(frozen=True)
class Scored:
    """One model.

    Attributes:
        name: of its scene.
        fit: to all samples.
        held_out: log densities of blocks left out.
    """

    name: str
    fit: Fit
    held_out: HeldOut

    @property
    def elpd(self) -> float:
        """Log predictive density of all blocks, each left out."""
        return float(self.held_out.log_density.sum())

    @property
    def elpd_se(self) -> float:
        """Its standard error."""
        return _standard_error(self.held_out.log_density)

    def below(self, other: "Scored") -> tuple[float, float]:
        """By how much its elpd falls short of another's, and the standard error of that."""
        difference = other.held_out.log_density - self.held_out.log_density
        return float(difference.sum()), _standard_error(difference)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Models of the same samples, that which predicts best first."""

    models: tuple[Scored, ...]

    @property
    def _standing(self) -> list[Scored]:
        """Those that prediction cannot tell from the best, the lowest Bayesian criterion first."""
        best = self.models[0]
        pairs = [(model, *model.below(best)) for model in self.models]
        standing = [model for model, short, error in pairs if model is best or short < _APART * error]
        return sorted(standing, key=_bic)

    @property
    def preferred(self) -> str | None:
        """The model that the data prefer; None where several cannot be told apart."""
        first, *others = self._standing
        return None if others and _bic(others[0]) - _bic(first) < _SMALL else first.name

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the preferred model's fit, or the best one's where none is preferred."""
        return self._leading.fit.trusted

    @property
    def _leading(self) -> Scored:
        return self.models[0] if self.preferred is None else self._standing[0]

    @property
    def verdict(self) -> str:
        """Which model is preferred, by how much, or that none is, in a sentence."""
        said = self._told()
        return said if self.trusted else f"{said} Do not trust it: of {self._leading.name}, {self._leading.fit.message}"

    def _told(self) -> str:
        first, *others = self._standing
        if not others:
            second = min(self.models[1:], key=lambda model: model.below(first)[0])
            return (
                f"{first.name} is preferred: it predicts what was left out better than {second.name}, by an elpd of"
                f" {_by(second, first)}."
            )
        rival, apart = others[0], _bic(others[0]) - _bic(first)
        worse, better = (rival, first) if rival.below(first)[0] >= 0.0 else (first, rival)
        why = (
            f"{better.name} predicts what was left out better by an elpd of only {_by(worse, better)}, and {first.name}"
            f" has the lower BIC, by {apart:.3g}."
        )
        if self.preferred is None:
            return f"{first.name} and {rival.name} cannot be told apart: {why}"
        return f"{first.name} is preferred, for its BIC: {why}"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        failed = [
            f"{m.name}: {m.held_out.failed} of {m.held_out.folds} fits without a fold did not reach an optimum, so its"
            " elpd may be too low; free less, or state narrower priors"
            for m in self.models
            if m.held_out.failed
        ]
        doubtful = [f"{m.name}: {m.fit.message}" for m in self.models if not m.fit.trusted]
        return (*doubtful, *failed)

    def to_dict(self) -> dict[str, Any]:
        """What `fitact compare --json` prints."""
        best = self.models[0]
        rows = []
        for model in self.models:
            short, error = model.below(best)
            figures = {name: model.fit.figures[name] for name in _CRITERIA}
            rows.append(
                {"name": model.name, **figures, "elpd": model.elpd, "elpd_se": model.elpd_se}
                | {"elpd_below_best": short, "elpd_below_best_se": error}
                | {"result": model.fit.result, "folds_failed": model.held_out.failed}
            )
        return {
            "models": rows,
            "preferred": self.preferred,
            "verdict": self.verdict,
            "trusted": self.trusted,
            "blocks": int(best.held_out.log_density.size),
            "folds": best.held_out.folds,
            "samples": int(best.fit.figures["samples"]),
            "warnings": list(self.warnings),
        }

    def summary(self) -> str:
        """A table for people."""
        width = max(12, *(len(model.name) for model in self.models))
        titles = ("log-lik.", "parameters", "AIC", "AICc", "BIC", "elpd", " below the best")
        rows = [f"{'model':{width}}" + "".join(f"{title:>14}" for title in titles)]
        for model in self.models:
            cells = [f"{model.fit.figures[name]:.2f}" for name in _CRITERIA]
            cells[1] = f"{model.fit.figures['parameters_counted']:.0f}"
            below = "" if model is self.models[0] else _by(model, self.models[0])
            shown = [*cells, f"{model.elpd:.2f}", below]
            rows.append(f"{model.name:{width}}" + "".join(f"{cell:>14}" for cell in shown))
        held = self.models[0].held_out
        rows += [
            f"elpd: log predictive density of {held.log_density.size} blocks, in {held.folds} folds left out; below the"
            " best: by how much, ± its standard error.",
            self.verdict,
        ]
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

    __str__ = summary


def compare(records: Record | Sequence[Record], scenes: Mapping[str, Scene] | Sequence[Scene]) -> Comparison:
    """Fit each scene's model to the same records, and say which the data prefer.

    The score is the elpd: the log predictive density of blocks of samples (whole periods where a record has twenty,
    else contiguous stretches), each given all that is outside its fold. Where it cannot tell models apart (2 standard
    errors of the difference), a Bayesian information criterion lower by 10 decides. Each scene stands for all records.

    Args:
        records: one, or several of one finger.
        scenes: two or more, by name; without names they are "scene 1", "scene 2", ...

    Raises:
        InputError: as `fitact.fit`; or fewer than two scenes, or they do not account for the same samples.
    """
    named = dict(scenes) if isinstance(scenes, Mapping) else {f"scene {i}": each for i, each in enumerate(scenes, 1)}
    if len(named) < 2:
        raise InputError(f"{len(named)} scene to compare: give two or more, each a model of the same samples")
    channels = {name: set(scene.measurement.channels) for name, scene in named.items()}
    (first, of_first), *others = channels.items()
    for name, of in others:
        if of != of_first:
            raise InputError(
                f"{first} accounts for {' and '.join(sorted(of_first))}, {name} for {' and '.join(sorted(of))}: only"
                " models of the same samples compare; give both the same [measurement] channels"
            )
    fits = {name: fit(records, scene) for name, scene in named.items()}
    _require_same_samples(fits)
    scored = [Scored(name, each, held_out(each)) for name, each in fits.items()]
    return Comparison(tuple(sorted(scored, key=lambda model: -model.elpd)))


def _require_same_samples(fits: Mapping[str, Fit]) -> None:
    (first, reference), *others = fits.items()
    for name, other in others:
        for trace, of_first, of_other in zip(
            reference.traces, reference.likelihood.traces, other.likelihood.traces, strict=True
        ):
            differ = np.count_nonzero(counted(of_first) != counted(of_other))
            if differ:
                raise InputError(
                    f"{first} and {name} do not account for the same samples of {trace.channel}: {differ} count in one"
                    " only (beside edges where no resistance limits the current; the first of AR(1) noise; those"
                    " between which a clock lies); give both the same series resistor or R_H, and noise_model"
                )


def _bic(model: Scored) -> float:
    return model.fit.figures["bic"]


def _by(worse: Scored, better: Scored) -> str:
    short, error = worse.below(better)
    return f"{short:.2f} ± {error:.2f}"


def _standard_error(values: Float[np.ndarray, " blocks"]) -> float:
    """Of the sum of independent values."""
    return math.sqrt(values.size) * float(np.std(values, ddof=1)) if values.size > 1 else math.inf
