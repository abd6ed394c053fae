"""Plans: the fastest model of a scene within its tolerance, and the error and speed-up of each omission.

The full model has every element of the scene. Each omission is compared with it at the scene's nominal values and over
the prior. Then all combinations of omissions are tried, because errors may add up or cancel.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact import charts
from fitact.model.circuit import FinalCircuit, NaturalGround
from fitact.model.drive import Sampled
from fitact.model_selection import omissions
from fitact.model_selection.model_errors import ReferenceModel
from fitact.model_selection.omissions import drop_parameters
from fitact.model_selection.partial_fractions import ROWS
from fitact.scene.scene import Scene
from fitact.tables import Display, align_row, join_lines
from fitact.units import format_engineering, format_percent

_TITLES = ("Vsc rms", "Vsc peak", "mean force", "peak force")
LEGEND = "Relative errors at the nominal values; in brackets, the 95 % quantile over the prior."

Values = Mapping[str, Float[np.ndarray, " draws"]]


class RelativeErrors(NamedTuple):
    """Relative errors with respect to the full model."""

    Vsc_rms: float
    Vsc_peak: float
    force_mean: float
    force_peak: float

    @property
    def force(self) -> float:
        """Larger of the errors in mean force and peak force."""
        return max(self.force_mean, self.force_peak)


@dataclasses.dataclass(frozen=True)
class Omission:
    """An element that the model might neglect."""

    name: str
    nominal: RelativeErrors  # errors at the scene's nominal values
    q95: RelativeErrors  # 95 % quantiles of the errors over the scene's prior
    speedup: float  # speed-up factor of the full model without this element
    kept: bool  # whether the planned model has it
    because: str  # reason for the decision, as a clause

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `omissions` in the JSON output of `fitact plan`."""
        errors = _errors_by_name(self.nominal, self.q95)
        return {"name": self.name} | errors | {"speedup": self.speedup, "kept": self.kept, "because": self.because}


@dataclasses.dataclass(frozen=True, repr=False)
class Plan(Display):
    """Planned model of a scene.

    Attributes:
        full: scene as given.
        scene: scene without the neglected elements, with circuit and drive of the planned model.
        omissions: possible omissions, evaluated one by one.
        nominal: errors of the planned model at the scene's nominal values.
        q95: 95 % quantiles of the errors of the planned model over the prior.
        speedup: speed-up factor of the planned model relative to the full one.
    """

    full: Scene
    scene: Scene
    omissions: tuple[Omission, ...]
    nominal: RelativeErrors
    q95: RelativeErrors
    speedup: float

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the neglected elements."""
        return tuple(omission.name for omission in self.omissions if not omission.kept)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings as sentences."""
        tolerance = self.full.tolerance.force
        if self.q95.force <= tolerance:
            return ()
        return (
            f"over the prior the planned model has a force error of up to {format_percent(self.q95.force)} (95 %),"
            f" more than the tolerance of {format_percent(tolerance)}, which holds at the nominal values only;"
            " lower [tolerance] force, or state a narrower [prior] if you know one",
        )

    def model(self) -> dict[str, Any]:
        """Return the properties of the planned model by name."""
        drive, circuit = self.scene.drive, self.scene.make_rc_circuit()
        natural = "natural" if isinstance(circuit, NaturalGround) else "direct"
        edges = {"square": "ideal", "trapezoid": format_engineering(drive.rise_time or 0.0, "s")}
        return {
            "circuit": "final" if isinstance(circuit, FinalCircuit) else natural,
            "skin": self.scene.skin.level,
            "drive": drive.waveform,
            "edges": edges.get(drive.shape if drive.waveform == "burst" else drive.waveform, "none"),
            "regime": "steady state" if drive.steady_state else "from rest",
            "precision": "float64",
            "response": "exact" if self.scene.skin.level == "constant" else "harmonics and time constants",
            "left_out": ", ".join(self.left_out),
            "tolerance": self.full.tolerance.force,
            **_errors_by_name(self.nominal, self.q95),
            "speedup": self.speedup,
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `fitact plan`."""
        rows = [omission.to_dict() for omission in self.omissions]
        return {"omissions": rows, "model": self.model(), "warnings": list(self.warnings)}

    def plot(self) -> Any:
        """Draw the force errors of each omission beside the tolerance, and return the axes."""
        return charts.draw_plan(self.to_dict(), make=charts.pyplot_figure).axes[0]

    @property
    def _headline(self) -> str:
        left_out = f"neglects {', '.join(self.left_out)}" if self.left_out else "neglects nothing"
        return f"{left_out}, force error {format_percent(self.nominal.force)}, {self.speedup:.2g} times faster"

    def _rows(self) -> tuple[tuple[str, ...], ...]:
        return self.table

    def _sentences(self) -> tuple[str, ...]:
        return LEGEND, self.sentence

    def summary(self) -> str:
        """Return the text table, the neglected elements, and warnings."""
        widths = (17, 22, 22, 22, 22, 9)
        rows = [f"{align_row(cells, widths)}  {decision}".rstrip() for *cells, decision in self.table]
        return join_lines([*rows, LEGEND, self.sentence], self.warnings)

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles, then errors, speed-up and decision of each omission and of the planned model, as text."""

        def cells(name: str, row: Omission | Plan, decision: str) -> tuple[str, ...]:
            errors = zip(row.nominal, row.q95, strict=True)
            shown = (f"{format_percent(nominal)} ({format_percent(q95)})" for nominal, q95 in errors)
            return name, *shown, f"{row.speedup:.2f}x", decision

        rows = [cells(o.name, o, f"{'kept' if o.kept else 'neglected'}: {o.because}") for o in self.omissions]
        return ("omission", *_TITLES, "speedup", "decision"), *rows, cells("planned model", self, "")

    @property
    def sentence(self) -> str:
        """Neglected elements and the resulting errors, in a sentence."""
        if not self.left_out:
            return "No element is neglected."
        return (
            f"Neglected: {', '.join(self.left_out)}. This changes the peak of Vsc by"
            f" {format_percent(self.nominal.Vsc_peak)}, the mean force by {format_percent(self.nominal.force_mean)} and"
            f" the peak force by {format_percent(self.nominal.force_peak)} (tolerance"
            f" {format_percent(self.full.tolerance.force)}); the model is {self.speedup:.2g} times faster. The decision"
            " depends on the force only; fitted parameters are those of the reduced circuit."
        )

    __str__ = summary


def plan(scene: Scene, measured: Sampled | None = None) -> Plan:
    """Find the fastest model of a scene within `[tolerance] force`, among all combinations of omissions.

    The tolerance applies to the larger of the errors in mean and peak force at the scene's nominal values. A warning is
    issued if the 95 % quantile over the prior exceeds it. Errors refer to one steady-state period, to the scene's
    duration from rest, or to the samples of `measured`, a drive that replaces the scene's. Costs come from
    `fitact.model_selection.omissions.evaluation_cost`. An element whose omission saves no time is kept.

    Raises:
        InputError: the scene has a measured drive and `measured` is not given, or the scene requests an unsupported
            option.
    """
    scene.require_available()
    if measured is not None:
        scene = omissions.with_measured_drive(scene)
    values = _circuit_values(scene)
    nominal = {name: draws[:1] for name, draws in values.items()}
    reference = ReferenceModel(scene, values, measured)
    names = omissions.applicable_omissions(scene)
    reasons = {name: omissions.reason_to_keep(scene, name) for name in names}
    whole, tolerance = omissions.evaluation_cost(scene, nominal), scene.tolerance.force
    best = _cheapest_omissions(scene, nominal, reference, tuple(name for name in names if not reasons[name]), tolerance)

    def evaluate_omissions(left_out: tuple[str, ...]) -> tuple[RelativeErrors, RelativeErrors, float]:
        reduced = omissions.reduce_scene(scene, left_out, prior=False)
        errors = _summarize_errors(reference.compare(reduced, drop_parameters(values, left_out)))
        return *errors, whole / omissions.evaluation_cost(reduced, drop_parameters(nominal, left_out))

    rows = []
    for name in names:
        at_nominal, q95, speedup = evaluate_omissions((name,))
        because = reasons[name] or _decision_reason(name in best, at_nominal.force, tolerance, speedup)
        rows.append(Omission(name, at_nominal, q95, speedup, name not in best, because))
    single = _summarize_errors(reference.compare(scene, values, np.float32))
    rows.append(Omission("float64", *single, omissions.FLOAT32_SPEEDUP, True, "fits and sampling need its derivatives"))
    return Plan(scene, omissions.reduce_scene(scene, best), tuple(rows), *evaluate_omissions(best))


def _cheapest_omissions(
    scene: Scene, nominal: Values, reference: ReferenceModel, names: tuple[str, ...], tolerance: float
) -> tuple[str, ...]:
    """Return the fastest combination within the tolerance; ties go to fewer omissions, then to smaller errors."""
    combinations = [c for size in range(len(names) + 1) for c in itertools.combinations(names, size)]
    scenes = {c: omissions.reduce_scene(scene, c, prior=False) for c in combinations}
    rank = {c: (omissions.evaluation_cost(scenes[c], drop_parameters(nominal, c)), len(c)) for c in combinations}
    for _, group in itertools.groupby(sorted(combinations, key=rank.__getitem__), key=rank.__getitem__):
        compared = {c: reference.compare(scenes[c], drop_parameters(nominal, c)) for c in group}
        errors = {c: _summarize_errors(each)[0].force for c, each in compared.items()}
        best = min(errors, key=errors.__getitem__)
        if errors[best] <= tolerance:
            return best
    return ()


def _circuit_values(scene: Scene) -> dict[str, Float[np.ndarray, " draws"]]:
    """Return circuit parameters: the scene's nominal values, followed by quasi-random draws from its prior."""
    prior = scene.make_prior()
    nominal = {name: value for name, value in scene.nominal_values().items() if value is not None}
    values = {
        name: np.append(np.exp(marginal.log_mean), draws)
        for (name, draws), marginal in zip(prior.sample_qmc(ROWS - 1).items(), prior.marginals, strict=True)
    }
    values |= {name: np.full(ROWS, value) for name, value in scene.fixed_values().items()}
    values |= {name: ratio * values[other] for name, (other, ratio) in scene.prior.ties().items()}
    for name in ("sigma", "sigma_I"):
        values.pop(name, None)
    return {name: np.append(nominal.get(name, draws[0]), draws[1:]) for name, draws in values.items()}


def _summarize_errors(errors: Float[np.ndarray, "4 circuits"]) -> tuple[RelativeErrors, RelativeErrors]:
    """Return the errors at the nominal values (first column), and the 95 % quantiles of the others."""
    q95 = np.quantile(errors[:, 1:], 0.95, axis=1) if errors.shape[1] > 1 else np.zeros(4)
    return RelativeErrors(*errors[:, 0].tolist()), RelativeErrors(*q95.tolist())


def _decision_reason(left_out: bool, error: float, tolerance: float, speedup: float) -> str:
    if left_out:
        return "error within the tolerance"
    if error > tolerance:
        return f"error of the force {format_percent(error)}, more than {format_percent(tolerance)}"
    return "saves no time" if speedup == 1.0 else "exceeds the tolerance together with the others, or saves no time"


def _errors_by_name(nominal: RelativeErrors, q95: RelativeErrors) -> dict[str, float]:
    return {
        f"error_{name}{suffix}": getattr(errors, name)
        for suffix, errors in (("", nominal), ("_q95", q95))
        for name in RelativeErrors._fields
    }
