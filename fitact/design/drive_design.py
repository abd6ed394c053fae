"""Result of a drive design: the recommended amplitude, the options beside it, limits, and the text for people."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact import charts
from fitact.data.plausibility import STRONGEST_FIELD
from fitact.design.drive_option import ASSURANCE, DriveOption, normalize_drive, quantile
from fitact.design.drive_people import FingerSample
from fitact.design.limits import AC_3, ES1, NO_SAFETY_ASSESSMENT, LimitComparison, format_quantity
from fitact.scene.scene import Scene
from fitact.tables import Display, align_table, join_lines
from fitact.units import format_engineering

_STATED_LIMITS = ("breakdown_field", "current_limit_rms", "current_limit_peak")  # keys of [device]
_UNBOUNDED = "the current is unbounded at ideal edges"
_ALL = ", the same at all frequencies"
_LEGEND = (
    "* waveform of the scene. Set: the peak-to-peak amplitude to set, {set}; ±: Monte Carlo error of this number only."
    " {others} Other columns, at the amplitude to set: power for the median finger; largest body current and insulator"
    " voltage of all fingers drawn."
)


@dataclasses.dataclass(frozen=True, repr=False)
class DriveDesign(Display):
    """Drives that a given fraction of fingers feel on a panel.

    Attributes:
        scene: panel, drive and threshold.
        people: fingers that are to feel it.
        share: fraction of them.
        touches: fraction of the touches in which each of them feels it; None if each has one.
        options: waveforms at the scene's frequency.
        needed: peak-to-peak amplitude (V) at which each finger feels that waveform; infinite if it never does.
        by_frequency: the same waveforms from 10 Hz to 1 kHz.
        by_thickness, by_permittivity: the scene's own drive on other insulators, with Ci by eq. (3).
        seed: seed of the fingers drawn.
    """

    scene: Scene
    people: FingerSample
    share: float
    touches: float | None
    options: dict[str, DriveOption]
    needed: dict[str, Float[np.ndarray, "laws fingers"]]
    by_frequency: dict[str, tuple[DriveOption, ...]]
    by_thickness: tuple[DriveOption, ...]
    by_permittivity: tuple[DriveOption, ...]
    seed: int

    @property
    def scene_waveform(self) -> str:
        """Waveform of the scene."""
        return self.scene.drive.waveform

    @property
    def trusted(self) -> bool:
        """Whether the population fit is reliable; true without a population."""
        return self.people.trusted

    def smallest(self) -> dict[str, str | None]:
        """Return the waveform within the limits that needs the least amplitude or power; None if all exceed a limit."""
        kept = {name: option for name, option in self.options.items() if not option.violations}
        return {
            what: min(kept, key=lambda name: kept[name].criterion_value(what)) if kept else None
            for what in DriveOption.CRITERIA
        }

    @property
    def recommended_option(self) -> DriveOption | None:
        """Option to set: the smallest amplitude within the stated limits at a finite current; None if there is none."""
        settable = [option for option in self.options.values() if not _obstacles(option)]
        return min(settable, key=lambda option: option.assured, default=None) if self.trusted else None

    @property
    def recommendation(self) -> str:
        """Sentence that says which amplitude to set, for whom and with which assurance."""
        option, fraction = self.recommended_option, f"{100.0 * self.share:g} %"
        felt = "feel it" if self.touches is None else f"feel it in {100.0 * self.touches:g} % of touches"
        if not self.trusted:
            return "No amplitude is recommended, because the population is not reliable (its warnings say why)."
        if option is None:
            broken = "; ".join(f"{name}: {' and '.join(_obstacles(o))}" for name, o in self.options.items())
            return f"No amplitude is recommended, because no waveform meets all conditions ({broken})."
        drive, volts = normalize_drive(self.scene.drive), option.assured
        assurance = (
            f"with {100.0 * ASSURANCE:g} % probability, at least {fraction} of {self.people.unit} then {felt}"
            if self.people.has_separate_uncertainty
            else f"{fraction} of the fingers drawn from the scene's prior then feel it; no record supports this"
        )
        offset = f" around an offset of {format_quantity(drive.offset * volts, 'V')}" if drive.offset else ""
        article = "an" if option.waveform[0] in "aeiou" else "a"
        return (
            f"Set {article} {option.waveform} of {format_quantity(0.5 * volts, 'V')} amplitude"
            f" ({format_quantity(volts, 'V')} peak to peak){offset} at {format_engineering(option.frequency, 'Hz', 3)}:"
            f" {assurance}."
        )

    @property
    def limits(self) -> list[LimitComparison]:
        """Limits beside the values at the recommended amplitude, or else at the amplitude of the scene's waveform."""
        return self._shown.limits

    @property
    def _shown(self) -> DriveOption:
        return self.recommended_option or self.options[self.scene_waveform]

    @property
    def exposure(self) -> str:
        """Sentences on the body current and the insulator's field at the recommended amplitude."""
        option = self._shown
        if not math.isfinite(option.assured):
            return "No amplitude suffices, so there are no body current and insulator field to compare."
        at, is_set = option.at_assured, option is self.recommended_option
        where = "this amplitude" if is_set else f"the {option.waveform}'s amplitude"
        current = "the body current is unbounded, because the edges are ideal; state [drive] rise_time"
        if math.isfinite(at.current_rms):
            rms, peak = (format_quantity(float(x), "A") for x in (at.current_rms, at.current_peak))
            current = f"the largest body current of the fingers drawn is {rms} rms, {peak} peak"
            compared = next((x for x in self.limits if x.source == ES1 and x.in_range), None)
            if compared is not None:
                limit = format_quantity(compared.limit or math.nan, "A")
                current += f"; its rms value is {compared.ratio:.2g} times the {ES1} limit of {limit}"
        field = format_quantity(float(at.insulator_peak) / option.device.insulator_thickness, "V/m")
        thickness = format_engineering(option.device.insulator_thickness, "m", 3)
        return f"At {where} {current}. The field in the insulator is at most {field}, for a thickness of {thickness}."

    @property
    def legend(self) -> str:
        """Meaning of the table's columns."""
        if not self.people.has_separate_uncertainty:
            return _LEGEND.format(set="the upper quantile of the prior's fingers", others="Median: the same quantile.")
        level = f"sufficient with {100.0 * ASSURANCE:g} % probability (one-sided tolerance limit)"
        others = "Median and 90 % interval: what is known of the amplitude that just suffices; do not set these."
        return _LEGEND.format(set=level, others=others)

    def curve(self, waveform: str) -> dict[str, Float[np.ndarray, " amplitudes"]]:
        """Return peak-to-peak amplitudes (V), and quantiles of the fraction of fingers who feel them."""
        finite = np.concatenate([needed[np.isfinite(needed)] for needed in self.needed.values()])
        ends = np.quantile(finite, [0.001, 0.999]) if finite.size else np.ones(2)
        amplitude = np.geomspace(ends[0], ends[1], 41)
        felt = np.sort(self.needed[waveform], axis=1)
        shares = np.stack([np.searchsorted(law, amplitude, side="right") for law in felt]) / felt.shape[1]
        low, median, high = np.quantile(shares, [0.05, 0.5, 0.95], axis=0)
        return {"peak_to_peak": amplitude, "q05": low, "q50": median, "q95": high}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of drive.json, which `fitact design drive --json` prints, in SI units."""
        laws, fingers = self.people.shape
        return {
            "recommendation": self._recommendation_content(),
            "share": self.share,
            "touches": self.touches,
            "threshold": self.scene.perception.model_dump(exclude_none=True, exclude={"source"})
            | {
                "source": self.scene.perception.threshold_source,
                "frequency": "all" if self.scene.perception.thresholds is None else "table",
                "sentence": self.threshold,
            },
            "people": {"source": self.people.source, "laws": laws, "fingers": fingers},
            "options": [option.to_dict() for option in self.options.values()],
            "limits": [each.to_dict() for each in self.limits],
            "smallest": self.smallest(),
            "curves": {name: {k: x.tolist() for k, x in self.curve(name).items()} for name in self.options},
            "frequencies": [option.to_dict() for options in self.by_frequency.values() for option in options],
            "thicknesses": [option.to_dict() for option in self.by_thickness],
            "permittivities": [option.to_dict() for option in self.by_permittivity],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "seed": self.seed,
            "scene": self.scene.model_dump(mode="json", exclude_unset=True),
        }

    def _recommendation_content(self) -> dict[str, Any]:
        option = self.recommended_option
        volts = None if option is None else option.assured
        offset = normalize_drive(self.scene.drive).offset
        return {
            "sentence": self.recommendation,
            "waveform": None if option is None else option.waveform,
            "frequency": None if option is None else option.frequency,
            "unit": "V",
            "amplitude": None if volts is None else 0.5 * volts,
            "peak_to_peak": volts,
            "offset": None if volts is None else offset * volts,
            "monte_carlo_error": None if option is None else option.assured_error,
            "fraction": self.share,
            "probability": ASSURANCE if self.people.has_separate_uncertainty else None,
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on conditions that may change the answer."""
        sentences = []
        if not self.people.trusted:
            sentences.append(
                "the population fit is not reliable, or most records are fitted poorly; see fitact population"
            )
        sentences += self.people.warnings
        if self.scene.perception.threshold_source is None:
            sentences.append(
                f"the threshold ({self._threshold_value}) is an example, because"
                " [perception] states no source; state your own threshold, and where it comes from as source = '...'"
            )
        if not self.people.has_separate_uncertainty:
            sentences.append(
                "no records were given, so the scene's prior is used as the population; variability between fingers and"
                " lack of knowledge cannot be separated"
            )
        sentences += [
            f"at the recommended amplitude the {each.quantity} is {each.ratio:.2g} times the limit of {each.source}"
            f" ({each.name})"
            for each in (self.limits if self.recommended_option else ())
            if each.exceeds_published
        ]
        field = float(self._shown.at_assured.insulator_peak) / self.scene.device.insulator_thickness
        if self.scene.device.breakdown_field is None and STRONGEST_FIELD < field < math.inf:
            sentences.append(
                f"the field in the insulator would be {format_quantity(field, 'V/m')}, above the"
                f" {format_quantity(STRONGEST_FIELD, 'V/m')} of the strongest thin films; check the unit of the"
                " threshold and [device] insulator_thickness"
            )
        thickness = self.scene.thickness_sd()
        if thickness:
            sentences.append(
                f"all fingers and panels have the same thicknesses here, although the scene varies"
                f" {' and '.join(thickness)}"
            )
        return tuple(sentences)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that inform."""
        absent = [name for name in _STATED_LIMITS if getattr(self.scene.device, name) is None]
        unstated = f"[device] does not state {', '.join(absent)}, so no waveform was excluded for exceeding"
        unbounded = [name for name, o in self.options.items() if math.isinf(o.at_assured.current_rms)]
        return (
            f"the force is computed with [force] model = '{self.scene.force.model}', not measured; the amplitude to"
            " set is proportional to 1 / sqrt(force).",
            *(
                [
                    "the friction is taken as [friction] coefficient ="
                    f" {float(self.scene.friction.coefficient):.3g} times the force at each frequency."
                ]
                if self.scene.perception.thresholds is not None
                else []
            ),
            f"{NO_SAFETY_ASSESSMENT}.",
            *([f"{unstated} {'it' if len(absent) == 1 else 'them'}."] if absent else []),
            *(f"{name}: not recommended, {_UNBOUNDED}; state [drive] rise_time." for name in unbounded),
        )

    def plot(self) -> Any:
        """Draw who feels an amplitude, and the amplitude over frequency and insulator, and return the axes."""
        figure = charts.draw_drive_design(self.to_dict(), self.scene_waveform, make=charts.pyplot_figure)
        return np.array(figure.axes)

    @property
    def _headline(self) -> str:
        return self.recommendation if self.recommended_option else self.recommendation.partition(" (")[0]

    def _rows(self) -> tuple[tuple[str, ...], ...]:
        return self.table

    def _sentences(self) -> tuple[str, ...]:
        return self.recommendation, self.question, self.exposure, self.legend

    def summary(self) -> str:
        """Return the recommendation, the tables for people, and notes and warnings."""
        lines = [self.recommendation, self.question, self.exposure, "", *align_table(self.table), self.legend]
        limits = align_table([(source, *cells) for source, _, *cells in self.limits_table])
        lines += ["", *limits, "", *self.exclusions, *self.sentences]
        return join_lines(lines, self.warnings, self.notes)

    __str__ = summary

    @property
    def _threshold_value(self) -> str:
        force, change = self.scene.perception.threshold_force, self.scene.perception.friction_change
        if (table := self.scene.perception.thresholds) is not None:
            return f"harmonics of the friction against a table of thresholds from {table.range_text}"
        if force is not None:
            return f"{format_engineering(force, 'N')} amplitude of the alternating electrostatic force{_ALL}"
        return f"friction that alternates by {100.0 * (change or 0.0):.3g} % of its mean{_ALL}"

    @property
    def threshold(self) -> str:
        """Threshold with its source and frequency, for people."""
        source = self.scene.perception.threshold_source
        origin = "example: [perception] states no source" if source is None else f"source: {source}"
        return f"{self._threshold_value} ({origin})"

    @property
    def question(self) -> str:
        """Sentence on who is to feel what."""
        fingers = f"{100.0 * self.share:g} % of {self.people.unit}"
        if self.touches is not None:
            fingers += f" in {100.0 * self.touches:g} % of touches"
        return f"To be felt by {fingers}: {self.threshold}. Fingers: {self.people.source}."

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles, then a row for each waveform, for people."""
        here = format_engineering(self.options[self.scene_waveform].frequency, "Hz", 3)
        titles = here, "set", "median", "90 % interval", "real", "apparent", "I rms", "I peak", "insulator"
        return titles, *(_cells(name, option, name == self.scene_waveform) for name, option in self.options.items())

    @property
    def limits_table(self) -> tuple[tuple[str, ...], ...]:
        """Titles, then a row for each limit, for people."""
        titles = "source", "meaning", "quantity", "here", "limit", "ratio", "published for"
        return titles, *(each.row for each in self.limits)

    @property
    def exclusions(self) -> tuple[str, ...]:
        """Waveforms that exceed a limit of the scene, with that limit."""
        return tuple(f"{name}: excluded, {phrase}" for name, o in self.options.items() for phrase in o.violations)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The smallest drives, the frequency with the lowest amplitude, and the thinnest insulator."""
        smallest, sentences = self.smallest(), []
        for criterion, unit in DriveOption.CRITERIA.items():
            name = smallest[criterion]
            least = name and f"{name}, {format_quantity(self.options[name].criterion_value(criterion), unit)}"
            sentences.append(f"smallest {criterion.replace('_', ' ')}: {least or 'no waveform keeps the limits'}")
        best = {name: min(options, key=lambda option: option.assured) for name, options in self.by_frequency.items()}
        easiest = ", ".join(
            f"{name} {format_engineering(o.frequency, 'Hz', 3)} ({format_quantity(o.assured, 'V')})"
            for name, o in best.items()
        )
        table = self.scene.perception.thresholds
        kind = "a frequency-independent threshold" if table is None else "these thresholds"
        sentences.append(f"frequency with the lowest amplitude to set, 10 Hz to 1 kHz, for {kind}: {easiest}")
        if table is not None:
            felt = ", ".join(f"{name} {_strongest(o)}" for name, o in self.options.items())
            sentences.append(f"frequency of the force that is felt most: {felt}")
        if all(getattr(self.scene.device, name) is None for name in _STATED_LIMITS):
            return tuple(sentences)
        return *sentences, f"{self.scene_waveform}, {_thinnest_insulator(self.by_thickness)}"


def _strongest(option: DriveOption) -> str:
    outside = f"{100.0 * (option.outside or 0.0):.2g} % of the alternating power is outside the table, not counted"
    frequency = "none" if option.strongest is None else format_engineering(option.strongest, "Hz", 3)
    return f"{frequency} ({outside})"


def _cells(name: str, option: DriveOption, is_scene_waveform: bool) -> tuple[str, ...]:
    low, median, high = (format_quantity(quantile(option.amplitude, q), "V") for q in (0.05, 0.5, 0.95))
    between = f"{low} to {high}" if option.amplitude.size > 1 else ""
    shown = {"real_power": "W", "apparent_power": "VA", "current_rms": "A", "current_peak": "A", "insulator_peak": "V"}
    return (
        name + (" *" if is_scene_waveform else ""),
        format_quantity(option.assured, "V", option.assured_error),
        median,
        between,
        *(format_quantity(getattr(option.at_assured, quantity), unit) for quantity, unit in shown.items()),
    )


def _obstacles(option: DriveOption) -> tuple[str, ...]:
    """Return the reasons not to recommend an option, as phrases."""
    if option.violations:
        return option.violations
    if not math.isfinite(option.at_assured.current_rms):
        return (_UNBOUNDED,)
    return tuple(
        f"at {format_quantity(option.assured, 'V')}, the amplitude that it needs, the {each.quantity} is"
        f" {each.ratio:.2g} times the limit of {each.source}"
        for each in option.limits
        if each.exceeds_published and each.source in (ES1, AC_3)
    )


def _thinnest_insulator(options: tuple[DriveOption, ...]) -> str:
    allowed = [option for option in options if not option.violations]
    if not allowed:
        return "insulator: no thickness from a hundredth to ten times the scene's keeps the limits"
    thin = min(allowed, key=lambda option: option.device.insulator_thickness)
    thickness = format_engineering(thin.device.insulator_thickness, "m", 3)
    return f"thinnest insulator tried that keeps the limits: {thickness}, at {format_quantity(thin.assured, 'V')}"
