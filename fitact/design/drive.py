"""The smallest drive that a given fraction of fingers feel: by waveform, frequency and insulator, within stated limits.

Vsc is linear in the drive and the force is quadratic in Vsc. One response at 1 Vpp thus gives the amplitude that a
finger needs.
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.design.drive_option import ASSURANCE, DriveOption, format_quantity, quantile
from fitact.design.drive_people import FingerSample
from fitact.design.limits import ES1, NO_SAFETY_ASSESSMENT, LimitComparison, format_value
from fitact.errors import InputError
from fitact.model.circuit import RC
from fitact.model.drive import Periodic
from fitact.model.force import Geometry
from fitact.model.skin import with_values
from fitact.model.steady_cycle import PeriodQuantities, period_quantities
from fitact.populations.population import Population
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.tables import align_table, join_lines
from fitact.units import format_engineering

WAVEFORMS = ("sine", "triangle", "square", "trapezoid")
_UNBOUNDED = "the current is unbounded at ideal edges"
_LEGEND = (
    "* waveform of the scene. Set: the peak-to-peak amplitude to set, {set}; ±: Monte Carlo error of this number only."
    " {others} Other columns, at the amplitude to set: power for the median finger; largest body current and insulator"
    " voltage of all fingers drawn."
)


@dataclasses.dataclass(frozen=True)
class DriveDesign:
    """Drives that a given fraction of fingers feel on a panel.

    Attributes:
        scene: panel, drive and threshold.
        people: fingers that are to feel it.
        share: fraction of them.
        options: waveforms at the scene's frequency.
        needed: peak-to-peak amplitude (V) at which each finger feels that waveform; infinite if it never does.
        by_frequency: the same waveforms from 10 Hz to 1 kHz.
        by_thickness, by_permittivity: the scene's own drive on other insulators, with Ci by eq. (3).
        seed: seed of the fingers drawn.
    """

    scene: Scene
    people: FingerSample
    share: float
    options: dict[str, DriveOption]
    needed: dict[str, Float[np.ndarray, "laws fingers"]]
    by_frequency: dict[str, tuple[DriveOption, ...]]
    by_thickness: tuple[DriveOption, ...]
    by_permittivity: tuple[DriveOption, ...]
    seed: int

    @property
    def own(self) -> str:
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
    def recommended(self) -> DriveOption | None:
        """Option to set: the smallest amplitude within the stated limits at a finite current; None if there is none."""
        settable = [o for o in self.options.values() if not o.violations and math.isfinite(o.at_assured.current_rms)]
        return min(settable, key=lambda option: option.assured, default=None) if self.trusted else None

    @property
    def recommendation(self) -> str:
        """Sentence that says which amplitude to set, for whom and with which assurance."""
        option, fraction = self.recommended, f"{100.0 * self.share:g} %"
        if not self.trusted:
            return "No amplitude is recommended, because the fit of the population is not reliable."
        if option is None:
            broken = "; ".join(f"{name}: {' and '.join(_obstacles(o))}" for name, o in self.options.items())
            return f"No amplitude is recommended, because no waveform meets all conditions ({broken})."
        drive, volts = _normalize_drive(self.scene.drive), option.assured
        assurance = (
            f"with {100.0 * ASSURANCE:g} % probability, at least {fraction} of fingers then feel it"
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
        return (self.recommended or self.options[self.own]).limits

    @property
    def exposure(self) -> str:
        """Sentences on the body current and the insulator's field at the recommended amplitude."""
        option = self.recommended or self.options[self.own]
        if not math.isfinite(option.assured):
            return "No amplitude suffices, so there are no body current and insulator field to compare."
        at, where = option.at_assured, "this amplitude" if self.recommended else f"the {option.waveform}'s amplitude"
        current = "the body current is unbounded, because the edges are ideal; state [drive] rise_time"
        if math.isfinite(at.current_rms):
            rms, peak = (format_value(float(x), "A") for x in (at.current_rms, at.current_peak))
            current = f"the largest body current of the fingers drawn is {rms} rms, {peak} peak"
            compared = next((x for x in self.limits if x.source == ES1 and x.in_range), None)
            if compared is not None:
                limit = format_value(compared.limit or math.nan, "A")
                current += f"; its rms value is {compared.ratio:.2g} times the {ES1} limit of {limit}"
        field = format_value(float(at.insulator_peak) / option.device.insulator_thickness, "V/m")
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
            "threshold": self.scene.perception.model_dump(exclude_none=True, exclude={"source"})
            | {"source": self.scene.perception.source, "frequency": "all", "sentence": self.threshold},
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
        option = self.recommended
        volts = None if option is None else option.assured
        offset = _normalize_drive(self.scene.drive).offset
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
            sentences.append("the population fit is not reliable; see fitact population")
        sentences += self.people.warnings
        if self.scene.perception.source is None:
            sentences.append(
                f"the threshold ({self._threshold_value}, the same at all frequencies) is an example, because"
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
            for each in (self.limits if self.recommended else ())
            if each.exceeds_published
        ]
        thickness = self.scene.population.thickness_sd
        if thickness:
            sentences.append(
                f"all fingers and panels have the same thicknesses here, although [population] varies"
                f" {' and '.join(thickness)}"
            )
        return tuple(sentences)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that inform."""
        limits = ("breakdown_field", "current_limit_rms", "current_limit_peak")
        absent = [name for name in limits if getattr(self.scene.device, name) is None]
        unstated = f"[device] does not state {', '.join(absent)}, so no waveform was excluded for exceeding"
        unbounded = [name for name, o in self.options.items() if math.isinf(o.at_assured.current_rms)]
        return (
            f"the force is computed with [force] model = '{self.scene.force.model}', not measured; the amplitude to"
            " set is proportional to 1 / sqrt(force).",
            f"{NO_SAFETY_ASSESSMENT}.",
            *([f"{unstated} {'it' if len(absent) == 1 else 'them'}."] if absent else []),
            *(f"{name}: not recommended, {_UNBOUNDED}; state [drive] rise_time." for name in unbounded),
        )

    def summary(self) -> str:
        """Return the recommendation, the tables for people, and notes and warnings."""
        lines = [self.recommendation, self.question, self.exposure, "", *align_table(self.table), self.legend]
        limits = align_table([(source, *cells) for source, _, *cells in self.limits_table])
        lines += ["", *limits, "", *self.excluded, *self.sentences]
        return join_lines(lines, self.warnings, self.notes)

    __str__ = summary

    @property
    def _threshold_value(self) -> str:
        force, change = self.scene.perception.threshold_force, self.scene.perception.friction_change
        if force is not None:
            return f"{format_engineering(force, 'N')} amplitude of the alternating electrostatic force"
        return f"friction that alternates by {100.0 * (change or 0.0):.3g} % of its mean"

    @property
    def threshold(self) -> str:
        """Threshold with its source and frequency, for people."""
        source = self.scene.perception.source
        origin = "example: [perception] states no source" if source is None else f"source: {source}"
        return f"{self._threshold_value}, the same at all frequencies ({origin})"

    @property
    def question(self) -> str:
        """Sentence on who is to feel what."""
        fingers = f"{100.0 * self.share:g} % of fingers"
        return f"To be felt by {fingers}: {self.threshold}. Fingers: {self.people.source}."

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles, then a row for each waveform, for people."""
        here = format_engineering(self.options[self.own].frequency, "Hz", 3)
        titles = here, "set", "median", "90 % interval", "real", "apparent", "I rms", "I peak", "insulator"
        return titles, *(_cells(name, option, name == self.own) for name, option in self.options.items())

    @property
    def limits_table(self) -> tuple[tuple[str, ...], ...]:
        """Titles, then a row for each limit, for people."""
        titles = "source", "meaning", "quantity", "here", "limit", "ratio", "published for"
        return titles, *(each.row for each in self.limits)

    @property
    def excluded(self) -> tuple[str, ...]:
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
        sentences.append(
            "frequency with the lowest amplitude to set, 10 Hz to 1 kHz, for a frequency-independent threshold:"
            f" {easiest}"
        )
        return *sentences, f"{self.own}, {_thinnest_insulator(self.by_thickness)}"


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
    return option.violations or (_UNBOUNDED,)


def _thinnest_insulator(options: tuple[DriveOption, ...]) -> str:
    allowed = [option for option in options if not option.violations]
    if not allowed:
        return "insulator: no thickness from a hundredth to ten times the scene's keeps the limits"
    thin = min(allowed, key=lambda option: option.device.insulator_thickness)
    thickness = format_engineering(thin.device.insulator_thickness, "m", 3)
    return f"thinnest insulator tried that keeps the limits: {thickness}, at {format_quantity(thin.assured, 'V')}"


def design_drive(
    scene: Scene, people: Population | FingerSample | None = None, share: float = 0.95, *, seed: int = 0
) -> DriveDesign:
    """Find the smallest amplitude at which a fraction `share` of fingers feel the drive on the scene's panel.

    The scene's `[perception]` states the threshold, for the alternating part of the force: the amplitude of the sine
    with the same root mean square. Sine, triangle and square, the trapezoid if the scene has a rise time, and the
    scene's own drive are compared in the steady state. A drive's offset scales with it. No probe is connected.

    Args:
        scene: panel, drive, threshold and, in `[device]`, the limits to keep.
        people: fingers that are to feel it. A population gives Rsc, Csc and Ci; all else is the scene's. None means
            the scene's prior, which does not separate variability between fingers from lack of knowledge.
        share: fraction of fingers, from 0.01 to 0.99.
        seed: the same seed gives the same fingers.

    Raises:
        InputError: the scene states no threshold, or two; its drive is measured or has no steady state; its skin
            depends on the frequency; `share` is out of range.
    """
    require_designable(scene, share)
    unloaded = scene.measurement.model_copy(update={"probe_resistance": None, "probe_capacitance": None})
    scene = scene.model_copy(update={"measurement": unloaded})
    if people is None:
        people = FingerSample.from_prior(scene, seed)
    elif isinstance(people, Population):
        people = dataclasses.replace(FingerSample.from_population(people, scene, seed), warnings=people.warnings)
    bench, device = _DriveEvaluator(scene, people, share), scene.device
    own, here = scene.drive.waveform, scene.drive.lowest_frequency
    names = [name for name in WAVEFORMS if name != "trapezoid" or scene.drive.rise_time is not None]
    tried = {name: bench.evaluate(name, here) for name in dict.fromkeys([*names, own])}
    frequencies = np.geomspace(10.0, 1000.0, 9).tolist()  # Hz, where touch is sensitive
    ratios = np.geomspace(0.01, 10.0, 13).tolist()  # over the scene's thickness, as in Fig. 12 of the reference paper
    return DriveDesign(
        scene,
        people,
        share,
        options={name: option for name, (option, _) in tried.items()},
        needed={name: needed for name, (_, needed) in tried.items()},
        by_frequency={
            name: tuple(bench.evaluate(name, f)[0] for f in frequencies if bench.has_room(name, f)) for name in tried
        },
        by_thickness=tuple(
            bench.evaluate(own, here, thickness=device.insulator_thickness * ratio)[0] for ratio in ratios
        ),
        by_permittivity=tuple(
            bench.evaluate(own, here, permittivity=permittivity)[0] for permittivity in (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
        ),
        seed=seed,
    )


@dataclasses.dataclass(frozen=True)
class _DriveEvaluator:
    """Evaluator of drives and insulators for the fingers drawn."""

    scene: Scene
    people: FingerSample
    share: float

    def evaluate(
        self, waveform: str, frequency: float, *, thickness: float | None = None, permittivity: float | None = None
    ) -> tuple[DriveOption, Float[np.ndarray, "laws fingers"]]:
        """Evaluate a drive on an insulator (m, relative; default: the scene's), and each finger's amplitude, V."""
        own = self.scene.device
        thickness = own.insulator_thickness if thickness is None else thickness
        permittivity = own.insulator_permittivity if permittivity is None else permittivity
        # eq. (3) gives the ratio of Ci only, because the Ci of the scene or the fingers need not follow it
        ratio = permittivity / own.insulator_permittivity * (own.insulator_thickness / thickness)
        layer = {"insulator_thickness": thickness, "insulator_permittivity": permittivity, "Ci": ratio * own.Ci}
        device = own.model_copy(update=layer)
        drive = _normalize_drive(self.scene.drive).model_copy(update={"waveform": waveform}).make()
        assert isinstance(drive, Periodic)
        drive = eqx.tree_at(lambda wave: wave.frequency, drive, frequency)
        quantities = self._unit_quantities(drive, thickness, ratio)
        needed = _required_amplitudes(self.scene, quantities)
        return DriveOption.from_amplitudes(waveform, frequency, device, needed, quantities, self.share), needed

    def has_room(self, waveform: str, frequency: float) -> bool:
        """Return whether the period has room for both edges."""
        drive = self.scene.drive
        return waveform != "trapezoid" or (drive.rise_time or 0.0) < min(drive.duty, 1.0 - drive.duty) / frequency

    def _unit_quantities(self, drive: Periodic, thickness: float, ratio: float) -> PeriodQuantities:
        """Compute the effects of 1 Vpp on each finger, with its Ci times `ratio`: arrays (laws, fingers)."""
        flat = {name: values.reshape(-1) for name, values in self.people.values.items()}
        flat["Ci"] = ratio * flat["Ci"]
        template = self.scene.make_rc_circuit({name: values[0] for name, values in flat.items()})
        geometry = dataclasses.replace(self.scene.geometry(), insulator_thickness=thickness)
        with jax.enable_x64(True):
            quantities = _map_fingers(*jax.tree.map(jnp.asarray, (template, geometry, drive, flat)))
            return PeriodQuantities(*(np.asarray(x).reshape(*self.people.shape, *x.shape[1:]) for x in quantities))


def _normalize_drive(drive: DriveSection) -> DriveSection:
    """Scale a drive to 1 V peak to peak, its offset in proportion."""
    height = drive.peak_to_peak
    if drive.amplitudes is not None:  # at least 65 points of the fastest cycle
        time = np.linspace(0.0, 1.0 / drive.lowest_frequency, 16_384, endpoint=False)
        with jax.enable_x64(True):
            height = float(np.ptp(drive.make().value(time)))
    amplitudes = drive.amplitudes and tuple(amplitude / height for amplitude in drive.amplitudes)
    scaled = {"peak_to_peak": 1.0, "offset": drive.offset / height, "amplitudes": amplitudes}
    return drive.model_copy(update=scaled)


@eqx.filter_jit
def _map_fingers(
    template: RC, geometry: Geometry, drive: Periodic, values: dict[str, Float[Array, " fingers"]]
) -> PeriodQuantities:
    def evaluate_finger(finger_values: dict[str, Array]) -> PeriodQuantities:
        circuit = with_values(template, finger_values)
        assert isinstance(circuit, RC)
        return period_quantities(circuit, drive, geometry.contact(circuit))

    return jax.lax.map(evaluate_finger, values, batch_size=1024)  # the batch bounds memory


def _required_amplitudes(scene: Scene, unit_quantities: PeriodQuantities) -> Float[np.ndarray, "laws fingers"]:
    """Return the peak-to-peak amplitude (V) at which each finger feels a drive with `unit_quantities` at 1 Vpp."""
    alternating, perception = np.asarray(unit_quantities.force_alternating), scene.perception
    with np.errstate(divide="ignore"):
        if perception.threshold_force is not None:
            return np.sqrt(perception.threshold_force / alternating)
        assert perception.friction_change is not None  # one of the two is required
        # alternating A^2 = change (mean A^2 + fN) has no solution if the mean force rises too fast
        reachable = np.maximum(alternating - perception.friction_change * np.asarray(unit_quantities.force_mean), 0.0)
        return np.sqrt(perception.friction_change * scene.friction.normal_force / reachable)


def require_designable(scene: Scene, share: float) -> None:
    """Refuse a scene or share that no drive can be designed for; raises as `design_drive`."""
    perception, drive = scene.perception, scene.drive
    if not 0.01 <= share <= 0.99:  # beyond, the answer is the assumed tail of the distribution
        raise InputError(f"share = {share:g}: give a fraction of fingers from 0.01 to 0.99, such as 0.95")
    if (perception.threshold_force is None) == (perception.friction_change is None):
        raise InputError(
            "scene: [perception] must state one threshold, because fitact knows no generally valid one; write"
            " threshold_force = '...' or friction_change = ..., and its source"
        )
    if perception.friction_change is not None and scene.friction.normal_force == 0.0:
        raise InputError(
            "scene: without [friction] normal_force the change of friction does not depend on the amplitude; give one,"
            " or [perception] threshold_force instead"
        )
    if drive.waveform in ("measured", "burst", "chirp") or not drive.steady_state:
        state = f"waveform = '{drive.waveform}'" if drive.steady_state or drive.waveform != "square" else "steady_state"
        raise InputError(
            f"scene: [drive] {state}: a drive is designed in the steady state; state a sine, triangle, square,"
            " trapezoid or multitone"
        )
    if scene.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{scene.skin.level}': a drive is designed for constant skins; write level ="
            " 'constant', with Rsc and Csc at the drive's frequency"
        )
