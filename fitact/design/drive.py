"""The smallest drive that a share of people feel: by waveform, frequency and insulator, within stated limits.

Vsc is linear in the drive and the force quadratic, so one response at 1 Vpp gives the amplitude that a finger needs.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.design.drive_option import ASSURANCE, DriveOption, quantile, shown
from fitact.design.drive_people import People
from fitact.errors import InputError
from fitact.model.circuit import RC
from fitact.model.drive import Periodic
from fitact.model.force import Geometry
from fitact.model.skin import with_values
from fitact.model.steady_cycle import Cycle, cycle
from fitact.populations.population import Population
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.units import engineering

COMPARED = ("sine", "triangle", "square", "trapezoid")
LEGEND = (
    f"* the scene's own; assured: met with {100.0 * ASSURANCE:g} % probability, ± the standard error of its draws, and"
    " what is drawn there: power by the median finger, current and insulator's voltage at most"
)

_FREQUENCIES = np.geomspace(10.0, 1000.0, 9)  # Hz, at which people feel
_THICKNESSES = np.geomspace(0.01, 10.0, 13)  # over the scene's own, as in the paper's Fig. 12
_PERMITTIVITIES = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)  # likewise
_SHARES = 0.01, 0.99  # beyond, a share is the tail that the law was assumed to have
_BATCH = 1024  # fingers at a time, which bounds memory
_POINTS = 16_384  # of a multi-tone, from which its peak-to-peak is taken: 65 of the fastest cycle there is
_CURVE, _CURVE_ENDS = 41, (0.001, 0.999)  # amplitudes of a drive curve, and the shares of all fingers it reaches


@dataclasses.dataclass(frozen=True)
class DriveDesign:
    """What it takes for a share of people to feel a panel.

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
    people: People
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
            what: min(kept, key=lambda name: kept[name].takes(what)) if kept else None for what in DriveOption.CRITERIA
        }

    def curve(self, waveform: str) -> dict[str, Float[np.ndarray, " amplitudes"]]:
        """The drive curve: peak-to-peak amplitude (V), and the share who feel it: quantiles over the laws."""
        finite = np.concatenate([needed[np.isfinite(needed)] for needed in self.needed.values()])
        ends = np.quantile(finite, _CURVE_ENDS) if finite.size else np.ones(2)
        amplitude = np.geomspace(ends[0], ends[1], _CURVE)
        felt = np.sort(self.needed[waveform], axis=1)
        shares = np.stack([np.searchsorted(law, amplitude, side="right") for law in felt]) / felt.shape[1]
        low, median, high = np.quantile(shares, [0.05, 0.5, 0.95], axis=0)
        return {"peak_to_peak": amplitude, "q05": low, "q50": median, "q95": high}

    def to_dict(self) -> dict[str, Any]:
        """What `fitact design drive --json` prints and drive.json holds, in SI units."""

        def listed(options: Iterable[DriveOption]) -> list[dict[str, Any]]:
            return [option.to_dict() for option in options]

        laws, fingers = self.people.shape
        threshold = self.scene.perception.model_dump(exclude_none=True)
        return {
            "share": self.share,
            "threshold": threshold,
            "people": {"source": self.people.source, "laws": laws, "fingers": fingers},
            "options": listed(self.options.values()),
            "smallest": self.smallest(),
            "curves": {name: {k: x.tolist() for k, x in self.curve(name).items()} for name in self.options},
            "frequencies": listed(option for options in self.by_frequency.values() for option in options),
            "thicknesses": listed(self.by_thickness),
            "permittivities": listed(self.by_permittivity),
            "warnings": list(self.warnings),
            "seed": self.seed,
            "scene": self.scene.model_dump(mode="json", exclude_unset=True),
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        found, device = [], self.scene.device
        if not self.people.trusted:
            found.append("the population is not to be trusted; see fitact population")
        if not self.people.separated:
            found.append(
                "the scene's prior stands for people and for ignorance of them alike; give records of fingers to tell"
                " these apart"
            )
        thickness = self.scene.population.thickness_sd
        if thickness:
            found.append(
                f"people are taken to have one thickness, though [population] spreads {' and '.join(thickness)}"
            )
        limits = ("breakdown_field", "current_limit_rms", "current_limit_peak")
        absent = [name for name in limits if getattr(device, name) is None]
        if absent:
            found.append(f"not checked, since [device] does not state it: {', '.join(absent)}")
        return tuple(found)

    def summary(self) -> str:
        """The question, the table for people, what follows from it, and warnings."""
        rows = [
            f"{name:13}{median:>13}{between:>20}{assured:>17}" + "".join(f"{x:>11}" for x in others)
            for name, median, between, assured, *others in self.table
        ]
        warnings = (f"warning: {warning}" for warning in self.warnings)
        return "\n".join([self.question, *rows, LEGEND, *self.excluded, *self.sentences, *warnings])

    __str__ = summary

    @property
    def question(self) -> str:
        """Who is to feel what."""
        return f"{100.0 * self.share:g} % of people feel {_threshold(self.scene)}; people: {self.people.source}"

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles; then what each waveform takes, for people."""
        here = engineering(self.options[self.own].frequency, "Hz", 3)
        titles = here, "peak-to-peak", "90 %", "assured", "real", "apparent", "rms", "peak", "insulator"
        return titles, *(_cells(name, option, name == self.own) for name, option in self.options.items())

    @property
    def excluded(self) -> tuple[str, ...]:
        """Waveforms that break a limit, and which."""
        return tuple(f"{name}: excluded, {each}" for name, option in self.options.items() for each in option.violations)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The smallest drives, the easiest frequencies and the thinnest insulator."""
        smallest, found = self.smallest(), []
        for what, unit in DriveOption.CRITERIA.items():
            name = smallest[what]
            least = name and f"{name}, {shown(self.options[name].takes(what), unit)}"
            found.append(f"smallest {what.replace('_', ' ')}: {least or 'no waveform keeps the limits'}")
        best = {name: min(options, key=lambda option: option.assured) for name, options in self.by_frequency.items()}
        at = (f"{name} {engineering(o.frequency, 'Hz', 3)} ({shown(o.assured, 'V')})" for name, o in best.items())
        found.append(f"easiest frequency of 10 Hz to 1 kHz, with the same threshold at all: {', '.join(at)}")
        return *found, f"{self.own}, {_thinnest(self.by_thickness)}"


def _threshold(scene: Scene) -> str:
    force, change = scene.perception.threshold_force, scene.perception.friction_change
    if force is not None:
        return f"an alternating force of {engineering(force, 'N')}"
    return f"friction that alternates by {change:.3g} of its mean"


def _cells(name: str, option: DriveOption, own: bool) -> tuple[str, ...]:
    low, median, high = (shown(quantile(option.amplitude, q), "V") for q in (0.05, 0.5, 0.95))
    between = f"{low} to {high}" if option.amplitude.size > 1 else ""
    of = option.at_assured
    assured = shown(option.assured, "V", option.assured_error)
    values = (
        (of.real_power, "W"),
        (of.apparent_power, "VA"),
        (of.current_rms, "A"),
        (of.current_peak, "A"),
        (of.insulator_peak, "V"),
    )
    return name + (" *" if own else ""), median, between, assured, *(shown(x, unit) for x, unit in values)


def _thinnest(options: tuple[DriveOption, ...]) -> str:
    holds = [option for option in options if not option.violations]
    if not holds:
        return "insulator: none from a hundredth to ten times the scene's thickness keeps the limits"
    thin = min(holds, key=lambda option: option.device.insulator_thickness)
    thickness = engineering(thin.device.insulator_thickness, "m", 3)
    return f"thinnest insulator tried that keeps the limits: {thickness}, at {shown(thin.assured, 'V')}"


def design_drive(
    scene: Scene, people: Population | People | None = None, share: float = 0.95, *, seed: int = 0
) -> DriveDesign:
    """The smallest amplitude at which a `share` of people feel the scene's panel, and what it then draws.

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
        people = People.of_prior(scene, seed)
    elif isinstance(people, Population):
        people = People.of_population(people, scene, seed)
    bench = _Bench(scene, people, share)
    own, here = scene.drive.waveform, scene.drive.slowest
    names = tuple(name for name in COMPARED if name != "trapezoid" or scene.drive.rise_time is not None)
    found = {name: bench.of(name, here) for name in (*names, *({own} - set(names)))}
    swept = {name: [f for f in _FREQUENCIES if bench.has_room(name, f)] for name in found}
    insulators = [scene.device.insulator_thickness * ratio for ratio in _THICKNESSES], list(_PERMITTIVITIES)
    return DriveDesign(
        scene,
        people,
        share,
        {name: option for name, (option, _) in found.items()},
        {name: needed for name, (_, needed) in found.items()},
        {name: tuple(bench.of(name, float(f))[0] for f in of) for name, of in swept.items()},
        tuple(bench.of(own, here, thickness=float(x))[0] for x in insulators[0]),
        tuple(bench.of(own, here, permittivity=float(x))[0] for x in insulators[1]),
        seed,
    )


@dataclasses.dataclass(frozen=True)
class _Bench:
    """Tries drives and insulators on people."""

    scene: Scene
    people: People
    share: float

    def of(
        self, waveform: str, frequency: float, *, thickness: float | None = None, permittivity: float | None = None
    ) -> tuple[DriveOption, Float[np.ndarray, "laws fingers"]]:
        """A drive on an insulator (m, relative; None: the scene's), and the amplitude that each finger needs, V."""
        own = self.scene.device
        thickness = own.insulator_thickness if thickness is None else thickness
        permittivity = own.insulator_permittivity if permittivity is None else permittivity
        # eq. (3), from whatever Ci the scene or the people have
        ratio = permittivity / own.insulator_permittivity * (own.insulator_thickness / thickness)
        layer = {"insulator_thickness": thickness, "insulator_permittivity": permittivity, "Ci": ratio * own.Ci}
        device = own.model_copy(update=layer)
        drive = _unit(self.scene.drive).model_copy(update={"waveform": waveform}).make()
        assert isinstance(drive, Periodic)
        drive = eqx.tree_at(lambda wave: wave.frequency, drive, frequency)
        found = self._cycles(drive, thickness, ratio)
        needed = _needed(self.scene, found)
        return DriveOption.of(waveform, frequency, device, needed, found, self.share), needed

    def has_room(self, waveform: str, frequency: float) -> bool:
        """Whether the period has room for both edges."""
        drive = self.scene.drive
        if waveform != "trapezoid" or drive.rise_time is None:
            return True
        return drive.rise_time < min(drive.duty, 1.0 - drive.duty) / frequency

    def _cycles(self, drive: Periodic, thickness: float, ratio: float) -> Cycle:
        """What 1 Vpp does at each finger, with its Ci times `ratio`: arrays (laws, fingers)."""
        flat = {name: values.reshape(-1) for name, values in self.people.values.items()}
        flat["Ci"] = ratio * flat["Ci"]
        template = self.scene.make_rc_circuit({name: values[0] for name, values in flat.items()})
        geometry = dataclasses.replace(self.scene.geometry(), insulator_thickness=thickness)
        with jax.enable_x64(True):
            found = _each(*jax.tree.map(jnp.asarray, (template, geometry, drive, flat)))
            return Cycle(*(np.asarray(x).reshape(*self.people.shape, *x.shape[1:]) for x in found))


def _unit(drive: DriveSection) -> DriveSection:
    """At 1 V from trough to crest, its offset in proportion."""
    height = drive.peak_to_peak
    if drive.amplitudes is not None:
        time = np.linspace(0.0, 1.0 / drive.slowest, _POINTS, endpoint=False)
        with jax.enable_x64(True):
            height = float(np.ptp(drive.make().value(time)))
    scaled = {"peak_to_peak": 1.0, "offset": drive.offset / height}
    tones = drive.amplitudes and tuple(each / height for each in drive.amplitudes)
    return drive.model_copy(update=scaled | {"amplitudes": tones})


@eqx.filter_jit
def _each(template: RC, geometry: Geometry, drive: Periodic, values: dict[str, Float[Array, " fingers"]]) -> Cycle:
    def one(of: dict[str, Array]) -> Cycle:
        circuit = with_values(template, of)
        assert isinstance(circuit, RC)
        return cycle(circuit, drive, geometry.contact(circuit))

    return jax.lax.map(one, values, batch_size=_BATCH)


def _needed(scene: Scene, found: Cycle) -> Float[np.ndarray, "laws fingers"]:
    """The peak-to-peak amplitude (V) at which each finger feels what is `found` at 1 Vpp."""
    alternating, perception = np.asarray(found.force_alternating), scene.perception
    with np.errstate(divide="ignore"):
        if perception.threshold_force is not None:
            return np.sqrt(perception.threshold_force / alternating)
        assert perception.friction_change is not None  # one of the two is required
        # alternating A^2 = change (mean A^2 + fN), which the force's own mean may keep out of reach
        beyond = np.maximum(alternating - perception.friction_change * np.asarray(found.force_mean), 0.0)
        return np.sqrt(perception.friction_change * scene.friction.normal_force / beyond)


def require_designable(scene: Scene, share: float) -> None:
    """Refuse what a drive cannot be designed for; raises as `design_drive`."""
    perception, drive = scene.perception, scene.drive
    if not _SHARES[0] <= share <= _SHARES[1]:
        raise InputError(f"share = {share:g}: give a share of people from {_SHARES[0]} to {_SHARES[1]}, such as 0.95")
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
