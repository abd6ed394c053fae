"""The smallest drive that a share of people feel: by waveform, frequency and insulator, within stated limits.

Vsc is linear in the drive and the force quadratic, so one response at 1 Vpp gives the amplitude that a finger needs.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.design.drive_option import ASSURANCE, DriveOption, format_quantity, quantile
from fitact.design.drive_people import FingerSample
from fitact.errors import InputError
from fitact.model.circuit import RC
from fitact.model.drive import Periodic
from fitact.model.force import Geometry
from fitact.model.skin import with_values
from fitact.model.steady_cycle import PeriodQuantities, period_quantities
from fitact.populations.population import Population
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.tables import align_rows, join_lines
from fitact.units import format_engineering

WAVEFORMS = ("sine", "triangle", "square", "trapezoid")
LEGEND = (
    f"* the scene's own; assured: met with {100.0 * ASSURANCE:g} % probability, ± the standard error of its draws, and"
    " what is drawn there: power by the median finger, current and insulator's voltage at most"
)


@dataclasses.dataclass(frozen=True)
class DriveDesign:
    """Drives by which a share of people feel a panel.

    Attributes:
        scene: of panel, drive and threshold.
        people: who is to feel it.
        share: of them.
        options: waveforms at the scene's frequency.
        needed: the peak-to-peak amplitude at which each finger feels that waveform, V; infinite: it never does.
        by_frequency: the same waveforms from 10 Hz to 1 kHz.
        by_thickness, by_permittivity: the scene's own drive on other insulators, Ci following eq. (3).
        seed: of the fingers drawn.
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
        """The scene's waveform."""
        return self.scene.drive.waveform

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the people that it is for."""
        return self.people.trusted

    def smallest(self) -> dict[str, str | None]:
        """The waveform that takes least, of those that keep the limits, by amplitude and by power; None: none does."""
        kept = {name: option for name, option in self.options.items() if not option.violations}
        return {
            what: min(kept, key=lambda name: kept[name].criterion_value(what)) if kept else None
            for what in DriveOption.CRITERIA
        }

    def curve(self, waveform: str) -> dict[str, Float[np.ndarray, " amplitudes"]]:
        """The drive curve: peak-to-peak amplitude (V), and the share who feel it: quantiles over the laws."""
        finite = np.concatenate([needed[np.isfinite(needed)] for needed in self.needed.values()])
        ends = np.quantile(finite, [0.001, 0.999]) if finite.size else np.ones(2)
        amplitude = np.geomspace(ends[0], ends[1], 41)
        felt = np.sort(self.needed[waveform], axis=1)
        shares = np.stack([np.searchsorted(law, amplitude, side="right") for law in felt]) / felt.shape[1]
        low, median, high = np.quantile(shares, [0.05, 0.5, 0.95], axis=0)
        return {"peak_to_peak": amplitude, "q05": low, "q50": median, "q95": high}

    def to_dict(self) -> dict[str, Any]:
        """The content of drive.json and of what `fitact design drive --json` prints, in SI units."""
        laws, fingers = self.people.shape
        return {
            "share": self.share,
            "threshold": self.scene.perception.model_dump(exclude_none=True),
            "people": {"source": self.people.source, "laws": laws, "fingers": fingers},
            "options": [option.to_dict() for option in self.options.values()],
            "smallest": self.smallest(),
            "curves": {name: {k: x.tolist() for k, x in self.curve(name).items()} for name in self.options},
            "frequencies": [option.to_dict() for options in self.by_frequency.values() for option in options],
            "thicknesses": [option.to_dict() for option in self.by_thickness],
            "permittivities": [option.to_dict() for option in self.by_permittivity],
            "warnings": list(self.warnings),
            "seed": self.seed,
            "scene": self.scene.model_dump(mode="json", exclude_unset=True),
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        sentences, device = [], self.scene.device
        if not self.people.trusted:
            sentences.append("the population is not to be trusted; see fitact population")
        if not self.people.has_separate_uncertainty:
            sentences.append(
                "the scene's prior stands for people and for ignorance of them alike; give records of fingers to tell"
                " these apart"
            )
        thickness = self.scene.population.thickness_sd
        if thickness:
            sentences.append(
                f"people are taken to have one thickness, though [population] spreads {' and '.join(thickness)}"
            )
        limits = ("breakdown_field", "current_limit_rms", "current_limit_peak")
        absent = [name for name in limits if getattr(device, name) is None]
        if absent:
            sentences.append(f"not checked, since [device] does not state it: {', '.join(absent)}")
        return tuple(sentences)

    def summary(self) -> str:
        """The question, the table for people, what follows from it, and warnings."""
        rows = align_rows(self.table, (13, 13, 20, 17, *[11] * 5))
        return join_lines([self.question, *rows, LEGEND, *self.excluded, *self.sentences], self.warnings)

    __str__ = summary

    @property
    def question(self) -> str:
        """Who is to feel what."""
        force, change = self.scene.perception.threshold_force, self.scene.perception.friction_change
        if force is not None:
            felt = f"an alternating force of {format_engineering(force, 'N')}"
        else:
            felt = f"friction that alternates by {change:.3g} of its mean"
        return f"{100.0 * self.share:g} % of people feel {felt}; people: {self.people.source}"

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles; then what each waveform takes, for people."""
        here = format_engineering(self.options[self.own].frequency, "Hz", 3)
        titles = here, "peak-to-peak", "90 %", "assured", "real", "apparent", "rms", "peak", "insulator"
        return titles, *(_cells(name, option, name == self.own) for name, option in self.options.items())

    @property
    def excluded(self) -> tuple[str, ...]:
        """Waveforms that break a limit, and which."""
        return tuple(f"{name}: excluded, {phrase}" for name, o in self.options.items() for phrase in o.violations)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The smallest drives, the easiest frequencies and the thinnest insulator."""
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
        sentences.append(f"easiest frequency of 10 Hz to 1 kHz, with the same threshold at all: {easiest}")
        return *sentences, f"{self.own}, {_thinnest_insulator(self.by_thickness)}"


def _cells(name: str, option: DriveOption, is_scene_waveform: bool) -> tuple[str, ...]:
    low, median, high = (format_quantity(quantile(option.amplitude, q), "V") for q in (0.05, 0.5, 0.95))
    between = f"{low} to {high}" if option.amplitude.size > 1 else ""
    drawn = {"real_power": "W", "apparent_power": "VA", "current_rms": "A", "current_peak": "A", "insulator_peak": "V"}
    return (
        name + (" *" if is_scene_waveform else ""),
        median,
        between,
        format_quantity(option.assured, "V", option.assured_error),
        *(format_quantity(getattr(option.at_assured, quantity), unit) for quantity, unit in drawn.items()),
    )


def _thinnest_insulator(options: tuple[DriveOption, ...]) -> str:
    allowed = [option for option in options if not option.violations]
    if not allowed:
        return "insulator: none from a hundredth to ten times the scene's thickness keeps the limits"
    thin = min(allowed, key=lambda option: option.device.insulator_thickness)
    thickness = format_engineering(thin.device.insulator_thickness, "m", 3)
    return f"thinnest insulator tried that keeps the limits: {thickness}, at {format_quantity(thin.assured, 'V')}"


def design_drive(
    scene: Scene, people: Population | FingerSample | None = None, share: float = 0.95, *, seed: int = 0
) -> DriveDesign:
    """Find the smallest amplitude at which a `share` of people feel the scene's panel, and what it then draws.

    What counts as felt is the scene's `[perception]`, of the alternating part of the force: the amplitude of the sine
    that has its root mean square. Sine, triangle and square, the trapezoid where the scene has a rise time, and the
    scene's own drive are compared in the steady state; a drive's offset scales with it. No probe is connected.

    Args:
        scene: panel, drive, threshold and, in `[device]`, the limits to keep.
        people: who is to feel it; a population gives Rsc, Csc and Ci, and all else is the scene's. None: the scene's
            prior, which does not tell how people differ from what is not known of them.
        share: of them, from 0.01 to 0.99.
        seed: the same seed gives the same fingers.

    Raises:
        InputError: the scene says not, or twice, what is felt; its drive has no steady state, or is a measured one;
            its skin depends on the frequency; `share` is out of range.
    """
    require_designable(scene, share)
    unloaded = scene.measurement.model_copy(update={"probe_resistance": None, "probe_capacitance": None})
    scene = scene.model_copy(update={"measurement": unloaded})
    if people is None:
        people = FingerSample.from_prior(scene, seed)
    elif isinstance(people, Population):
        people = FingerSample.from_population(people, scene, seed)
    bench, device = _DriveEvaluator(scene, people, share), scene.device
    own, here = scene.drive.waveform, scene.drive.lowest_frequency
    names = [name for name in WAVEFORMS if name != "trapezoid" or scene.drive.rise_time is not None]
    tried = {name: bench.evaluate(name, here) for name in dict.fromkeys([*names, own])}
    frequencies = np.geomspace(10.0, 1000.0, 9).tolist()  # Hz, at which people feel
    ratios = np.geomspace(0.01, 10.0, 13).tolist()  # over the scene's own, as in the paper's Fig. 12
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
    """Tries drives and insulators on people."""

    scene: Scene
    people: FingerSample
    share: float

    def evaluate(
        self, waveform: str, frequency: float, *, thickness: float | None = None, permittivity: float | None = None
    ) -> tuple[DriveOption, Float[np.ndarray, "laws fingers"]]:
        """Try a drive on an insulator (m, relative; None: the scene's); also the amplitude each finger needs, V."""
        own = self.scene.device
        thickness = own.insulator_thickness if thickness is None else thickness
        permittivity = own.insulator_permittivity if permittivity is None else permittivity
        # eq. (3), from whatever Ci the scene or the people have
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
        """Whether the period has room for both edges."""
        drive = self.scene.drive
        return waveform != "trapezoid" or (drive.rise_time or 0.0) < min(drive.duty, 1.0 - drive.duty) / frequency

    def _unit_quantities(self, drive: Periodic, thickness: float, ratio: float) -> PeriodQuantities:
        """Compute what 1 Vpp does at each finger, with its Ci times `ratio`: arrays (laws, fingers)."""
        flat = {name: values.reshape(-1) for name, values in self.people.values.items()}
        flat["Ci"] = ratio * flat["Ci"]
        template = self.scene.make_rc_circuit({name: values[0] for name, values in flat.items()})
        geometry = dataclasses.replace(self.scene.geometry(), insulator_thickness=thickness)
        with jax.enable_x64(True):
            quantities = _map_fingers(*jax.tree.map(jnp.asarray, (template, geometry, drive, flat)))
            return PeriodQuantities(*(np.asarray(x).reshape(*self.people.shape, *x.shape[1:]) for x in quantities))


def _normalize_drive(drive: DriveSection) -> DriveSection:
    """Scale to 1 V from trough to crest, its offset in proportion."""
    height = drive.peak_to_peak
    if drive.amplitudes is not None:  # 65 points of the fastest cycle there is
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

    return jax.lax.map(evaluate_finger, values, batch_size=1024)  # which bounds memory


def _required_amplitudes(scene: Scene, unit_quantities: PeriodQuantities) -> Float[np.ndarray, "laws fingers"]:
    """The peak-to-peak amplitude (V) at which each finger feels what is `unit_quantities` at 1 Vpp."""
    alternating, perception = np.asarray(unit_quantities.force_alternating), scene.perception
    with np.errstate(divide="ignore"):
        if perception.threshold_force is not None:
            return np.sqrt(perception.threshold_force / alternating)
        assert perception.friction_change is not None  # one of the two is required
        # alternating A^2 = change (mean A^2 + fN), which the force's own mean may keep out of reach
        reachable = np.maximum(alternating - perception.friction_change * np.asarray(unit_quantities.force_mean), 0.0)
        return np.sqrt(perception.friction_change * scene.friction.normal_force / reachable)


def require_designable(scene: Scene, share: float) -> None:
    """Refuse what a drive cannot be designed for; raises as `design_drive`."""
    perception, drive = scene.perception, scene.drive
    if not 0.01 <= share <= 0.99:  # beyond, a share is the tail that the law was assumed to have
        raise InputError(f"share = {share:g}: give a share of people from 0.01 to 0.99, such as 0.95")
    if (perception.threshold_force is None) == (perception.friction_change is None):
        raise InputError(
            "scene: [perception] must state what is felt, once; write threshold_force = '1 mN' or friction_change = 0.1"
        )
    if perception.friction_change is not None and scene.friction.normal_force == 0.0:
        raise InputError(
            "scene: without [friction] normal_force the change of friction does not depend on the amplitude; give one,"
            " or [perception] threshold_force instead"
        )
    if drive.waveform in ("measured", "burst", "chirp") or not drive.steady_state:
        state = f"waveform = '{drive.waveform}'" if drive.steady_state or drive.waveform != "square" else "steady_state"
        raise InputError(
            f"scene: [drive] {state}: a drive is designed in the steady state; name a sine, triangle, square, trapezoid"
            " or multitone"
        )
    if scene.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{scene.skin.level}': a drive is designed for constant skins; write level ="
            " 'constant', with Rsc and Csc at the drive's frequency"
        )
