"""The plan: the cheapest model of a scene that keeps its tolerance, and what everything left out of it costs.

The full model has everything that the scene names. Each omission is compared with it at the scene's nominal values
and over its prior; then all combinations of omissions, jointly, since errors may add up or cancel.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.model.circuit import FinalCircuit, NaturalGround
from fitact.model.drive import Sampled
from fitact.model_selection import omissions
from fitact.model_selection.model_errors import Comparison, Reference
from fitact.model_selection.partial_fractions import ROWS
from fitact.scene.scene import Scene
from fitact.units import engineering, percent

_NOT_OF_THE_CIRCUIT = ("sigma", "sigma_I")
_QUANTILE = 0.95
_TITLES = ("Vsc rms", "Vsc peak", "mean force", "peak force")
LEGEND = "Relative errors at the nominal values; in brackets, what 95 % of the prior stay below."

Values = Mapping[str, Float[np.ndarray, " draws"]]


class Errors(NamedTuple):
    """Relative errors, against the full model."""

    Vsc_rms: float
    Vsc_peak: float
    force_mean: float
    force_peak: float

    @property
    def force(self) -> float:
        """The larger of mean and peak force's."""
        return max(self.force_mean, self.force_peak)


@dataclasses.dataclass(frozen=True)
class Omission:
    """Something that the model might do without.

    Attributes:
        name: what it is.
        nominal: errors at the scene's nominal values.
        q95: their 95 % quantiles over the scene's prior.
        speedup: how many times faster the full model is without it.
        kept: whether the planned model has it.
        because: why, as a clause.
    """

    name: str
    nominal: Errors
    q95: Errors
    speedup: float
    kept: bool
    because: str

    def to_dict(self) -> dict[str, Any]:
        """An entry of `omissions` in `fitact plan --json`."""
        errors = _named_errors(self.nominal, self.q95)
        return {"name": self.name} | errors | {"speedup": self.speedup, "kept": self.kept, "because": self.because}


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a scene requires of its model.

    Attributes:
        full: the scene as it was given.
        scene: the scene without what is left out; its circuit and drive are the planned model's.
        omissions: what might be left out, one by one.
        nominal: errors of the planned model at the scene's nominal values.
        q95: their 95 % quantiles over the prior.
        speedup: how many times faster the planned model is than the full one.
    """

    full: Scene
    scene: Scene
    omissions: tuple[Omission, ...]
    nominal: Errors
    q95: Errors
    speedup: float

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the omissions that are made."""
        return tuple(omission.name for omission in self.omissions if not omission.kept)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        tolerance = self.full.tolerance.force
        if self.q95.force <= tolerance:
            return ()
        return (
            f"over the prior the planned model errs by up to {percent(self.q95.force)} of the force (95 %), more than"
            f" the tolerance of {percent(tolerance)}, which it keeps at the nominal values; narrow [prior], or lower"
            " [tolerance] force",
        )

    def model(self) -> dict[str, Any]:
        """The planned model, by name."""
        drive, circuit = self.scene.drive, self.scene.make_rc_circuit()
        edges = {"square": "ideal", "trapezoid": engineering(drive.rise_time or 0.0, "s")}
        return {
            "circuit": _circuit(circuit),
            "skin": self.scene.skin.level,
            "drive": drive.waveform,
            "edges": edges.get(drive.shape if drive.waveform == "burst" else drive.waveform, "none"),
            "regime": "steady state" if drive.steady_state else "from rest",
            "precision": "float64",
            "response": "exact" if self.scene.skin.level == "constant" else "harmonics and time constants",
            "left_out": ", ".join(self.left_out),
            "tolerance": self.full.tolerance.force,
            **_named_errors(self.nominal, self.q95),
            "speedup": self.speedup,
        }

    def to_dict(self) -> dict[str, Any]:
        """What `fitact plan --json` prints."""
        each = [omission.to_dict() for omission in self.omissions]
        return {"omissions": each, "model": self.model(), "warnings": list(self.warnings)}

    def summary(self) -> str:
        """The table for people, what is left out, and warnings."""
        rows = [
            f"{name:17}" + "".join(f"{error:>22}" for error in errors) + f"{speedup:>9}  {decision}".rstrip()
            for name, *errors, speedup, decision in self.table
        ]
        return "\n".join([*rows, LEGEND, self.sentence, *(f"warning: {warning}" for warning in self.warnings)])

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles; then errors and speed of every omission and of the planned model, and why, for people."""
        decisions = [f"{'kept' if each.kept else 'left out'}: {each.because}" for each in self.omissions]
        return (
            ("omission", *_TITLES, "speedup", "decision"),
            *(
                (*_cells(o.name, o.nominal, o.q95, o.speedup), why)
                for o, why in zip(self.omissions, decisions, strict=True)
            ),
            (*_cells("planned model", self.nominal, self.q95, self.speedup), ""),
        )

    @property
    def sentence(self) -> str:
        """What is left out and what that costs."""
        if not self.left_out:
            return "Nothing is left out."
        return (
            f"Left out: {', '.join(self.left_out)}; that changes the peak of Vsc by {percent(self.nominal.Vsc_peak)},"
            f" the mean force by {percent(self.nominal.force_mean)} and the peak force by"
            f" {percent(self.nominal.force_peak)} (tolerance {percent(self.full.tolerance.force)}), and is"
            f" {self.speedup:.2g} times faster."
            " This is judged by the force; parameters are those of the smaller circuit."
        )

    __str__ = summary


def plan(scene: Scene, measured: Sampled | None = None) -> Plan:
    """The cheapest model of a scene that keeps `[tolerance] force`, among all combinations of omissions.

    The tolerance bounds the larger of mean and peak force's error at the scene's nominal values; where 95 % of the
    prior do not keep it, the plan warns. Errors are those over one period of the steady state, or over the scene's
    duration from rest, or over the samples of `measured`, a drive that takes the place of the scene's. Costs are those
    of `fitact.model_selection.omissions.cost`. What saves nothing is kept.

    Raises:
        InputError: the scene has no drive of its own (waveform = 'measured') and `measured` is not given, or asks for
            what is not available.
    """
    scene.require_available()
    if measured is not None:
        scene = omissions.driven(scene)
    values = _values(scene)
    nominal = {name: each[:1] for name, each in values.items()}
    reference = Reference(scene, values, measured)
    names = omissions.named(scene)
    reasons = {name: omissions.required(scene, name) for name in names}
    whole, tolerance = omissions.cost(scene, nominal), scene.tolerance.force
    best = _cheapest(scene, nominal, reference, tuple(name for name in names if not reasons[name]), tolerance)

    def judged(left_out: tuple[str, ...]) -> tuple[Errors, Errors, float]:
        reduced = omissions.without(scene, left_out, prior=False)
        errors = _errors(reference.compare(reduced, _left(values, left_out)))
        return *errors, whole / omissions.cost(reduced, _left(nominal, left_out))

    rows = []
    for name in names:
        at_nominal, q95, speedup = judged((name,))
        because = reasons[name] or _because(name in best, at_nominal.force, tolerance, speedup)
        rows.append(Omission(name, at_nominal, q95, speedup, name not in best, because))
    single = _errors(reference.compare(scene, values, np.float32))
    rows.append(Omission("float64", *single, omissions.SINGLE_SPEEDUP, True, "fits and sampling need its derivatives"))
    return Plan(scene, omissions.without(scene, best), tuple(rows), *judged(best))


def _cheapest(
    scene: Scene, nominal: Values, reference: Reference, names: tuple[str, ...], tolerance: float
) -> tuple[str, ...]:
    """The combination of least cost that keeps the tolerance; of several the one that leaves out, then errs, least."""
    combinations = [c for size in range(len(names) + 1) for c in itertools.combinations(names, size)]
    scenes = {c: omissions.without(scene, c, prior=False) for c in combinations}
    rank = {c: (omissions.cost(reduced, _left(nominal, c)), len(c)) for c, reduced in scenes.items()}
    for _, group in itertools.groupby(sorted(combinations, key=lambda c: rank[c]), key=lambda c: rank[c]):
        force = {c: _errors(reference.compare(scenes[c], _left(nominal, c)))[0].force for c in group}
        found = min(force, key=lambda c: force[c])
        if force[found] <= tolerance:
            return found
    return ()


def _values(scene: Scene) -> dict[str, Float[np.ndarray, " draws"]]:
    """The circuit's parameters: the scene's nominal ones, then draws spread evenly over its prior."""
    prior = scene.make_prior()
    stated = {name: value for name, value in scene.nominal().items() if value is not None}
    believed = {
        name: np.append(np.exp(marginal.log_mean), draws)
        for (name, draws), marginal in zip(prior.spread(ROWS - 1).items(), prior.marginals, strict=True)
    }
    believed |= {name: np.full(ROWS, value) for name, value in scene.fixed().items()}
    believed |= {name: ratio * believed[other] for name, (other, ratio) in scene.prior.tied().items()}
    return {
        name: np.append(stated.get(name, each[0]), each[1:])
        for name, each in believed.items()
        if name not in _NOT_OF_THE_CIRCUIT
    }


def _left(values: Values, names: tuple[str, ...]) -> dict[str, Float[np.ndarray, " draws"]]:
    """Without the parameters that go with these omissions."""
    gone = set().union(*(omissions.parameters(name) for name in names))
    return {name: each for name, each in values.items() if name not in gone}


def _errors(comparison: Comparison) -> tuple[Errors, Errors]:
    """Those at the nominal values, which come first, and the 95 % quantiles of the others."""
    return (
        Errors(*(float(each[0]) for each in comparison)),
        Errors(*(float(np.quantile(each[1:], _QUANTILE)) if len(each) > 1 else 0.0 for each in comparison)),
    )


def _because(left_out: bool, error: float, tolerance: float, speedup: float) -> str:
    if left_out:
        return "keeps the tolerance"
    if error > tolerance:
        return f"{percent(error)} of the force, more than {percent(tolerance)}"
    return "saves nothing" if speedup == 1.0 else "too much together with the others, or saves nothing then"


def _circuit(circuit: Any) -> str:
    if isinstance(circuit, FinalCircuit):
        return "final"
    return "natural" if isinstance(circuit, NaturalGround) else "direct"


def _named_errors(nominal: Errors, q95: Errors) -> dict[str, float]:
    return {
        f"error_{name}{suffix}": getattr(errors, name)
        for suffix, errors in (("", nominal), ("_q95", q95))
        for name in Errors._fields
    }


def _cells(name: str, nominal: Errors, q95: Errors, speedup: float) -> tuple[str, ...]:
    errors = (f"{percent(a)} ({percent(b)})" for a, b in zip(nominal, q95, strict=True))
    return name, *errors, f"{speedup:.2f}x"
