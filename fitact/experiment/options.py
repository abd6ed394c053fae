"""What a user may change of a measurement, each change with its effort; and those that a fit's verdict names."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.experiment.experiment import Option, Setting, Trial, judge
from fitact.experiment.fisher import FREQUENCY, Experiment
from fitact.model.circuit import Channel, DirectGround, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Periodic, Trapezoid
from fitact.model.multitone import Multitone
from fitact.model.skin import WithSkin, constant, has_time_constants, parameters
from fitact.units import engineering

NOISE = {"Vsc": 0.1, "I": 20e-9}  # V and A, of a channel that is not recorded yet and has none stated
SERIES_RESISTOR = 100e3  # ohm, of one that is recommended unseen
QUICK = ("current", "series resistor", "better Ci", "longer record")  # what a fit's verdict names

_CAN_HAVE_RESISTOR = (FinalCircuit, DirectGround, NaturalGround)
_RESISTORS = (1e3, 1e8)  # ohm, that one can buy and that the cable's capacitance does not short
_PANELS = 10.0  # a second panel's capacitance, at most so many times larger or smaller
_RESOLVED = 100.0  # samples in a period, at least
_SLOWEST = 1.0  # Hz
_EDGES = 4.0  # rises in half a period, at least
_PROBE = 10.0  # times the impedance of the probe that there is
_MORE = 4  # times the duration or the sampling rate
_FLEETING = 0.01  # of a channel's noise: a converter's part in it that is not worth another


class Change(NamedTuple):
    """A change of a measurement.

    Attributes:
        name: of it.
        group: of changes of one thing, of which only one can be made.
        effort: turning a knob of an instrument that is there is 1.
        apply: the trial with it; None: it cannot be made there.
    """

    name: str
    group: str
    effort: float
    apply: Callable[[Trial], Trial | None]

    def __call__(self, trial: Trial) -> Trial | None:
        """The trial with the change, and its effort; None: it cannot be made there."""
        found = self.apply(trial)
        if found is None:
            return None
        return dataclasses.replace(found, names=(*trial.names, self.name), effort=trial.effort + self.effort)


def changes(steps: Mapping[Channel, float] | None = None) -> tuple[Change, ...]:
    """All changes; `steps` are those of the converter in each channel, V and A, where they are known."""
    return (
        Change("longer record", "length", 1.0, _longer),
        Change("higher sampling rate", "rate", 1.0, _faster),
        Change("frequency", "frequency", 1.0, lambda trial: _frequencies(trial, 1)),
        Change("two frequencies", "frequency", 2.0, lambda trial: _frequencies(trial, 2)),
        Change("three frequencies", "frequency", 3.0, lambda trial: _frequencies(trial, 3)),
        Change("series resistor", "series resistor", 2.0, _series_resistor),
        Change("lighter probe", "probe", 3.0, _lighter_probe),
        Change("no probe load", "probe", 4.0, _no_probe),
        Change("better Ci", "Ci", 3.0, _better_Ci),
        Change("current", "current", 3.0, lambda trial: _channel(trial, "I", "the trunk current I")),
        Change("skin voltage", "skin voltage", 3.0, lambda trial: _channel(trial, "Vsc", "the skin voltage Vsc")),
        Change("finer converter", "converter", 4.0, lambda trial: _finer(trial, steps or {})),
        Change("second panel", "panel", 5.0, _second_panel),
    )


def remedies(experiment: Experiment, gradient: Float[np.ndarray, " parameters"]) -> tuple[Option, ...]:
    """What might be done to know a force better, best first; of that, what takes no search and can be computed there.

    `gradient` is that of the force's logarithm. A fit that failed may have ended at a circuit whose current no
    double holds.
    """
    as_it_is, found = Trial((experiment,)), []
    for change in changes():
        trial = change(as_it_is) if change.name in QUICK else None
        if trial is not None and trial.experiments[0] is not experiment:
            with contextlib.suppress(np.linalg.LinAlgError):
                found.append(judge(trial, trial.starts, gradient))
    return tuple(sorted(found, key=lambda option: option.force_sd))


def _each(trial: Trial, text: str, change: Callable[[Experiment], Experiment], *settings: Setting) -> Trial:
    """The trial with the same change of all its experiments."""
    return dataclasses.replace(
        trial,
        experiments=tuple(map(change, trial.experiments)),
        texts=(*trial.texts, text),
        settings=(*trial.settings, *settings),
    )


def _longer(trial: Trial) -> Trial:
    return _each(
        trial, f"{_count(_MORE)} times the record", lambda e: dataclasses.replace(e, records=_MORE * e.records)
    )


def _faster(trial: Trial) -> Trial:
    def faster(e: Experiment) -> Experiment:
        at = np.arange(_MORE * len(e.time)) / _MORE
        end = e.time[-1] + (e.time[-1] - e.time[-2])
        return dataclasses.replace(e, time=np.interp(at, np.arange(len(e.time) + 1), np.append(e.time, end)))

    return _each(trial, f"{_count(_MORE)} times the sampling rate, with the same noise in each sample", faster)


def _count(number: int) -> str:
    return {2: "two", 3: "three", 4: "four"}[number]


def _frequencies(trial: Trial, count: int) -> Trial | None:
    """So many records in place of one, each with a frequency of its own, and as many samples as that one."""
    first, *others = trial.experiments
    drive = first.drive
    if others or not (isinstance(drive, Periodic) and first.steady_state and has_time_constants(first.circuit)):
        return None
    step, top = float(np.median(np.diff(first.time))), 1.0
    low, high = min(_SLOWEST, float(drive.frequency)), 1.0 / (_RESOLVED * step)
    if isinstance(drive, Multitone):
        top = max(drive.orders)
    if isinstance(drive, Trapezoid):
        high = min(high, float(min(drive.duty, 1.0 - drive.duty) / (_EDGES * drive.rise_time)))
    high /= top
    start = min(float(drive.frequency), high)
    numbers = [""] + [f"_{number}" for number in range(2, count + 1)]
    settings = (Setting(FREQUENCY + n, FREQUENCY, "Hz", start, low, high, (i,)) for i, n in enumerate(numbers))
    several = f"{_count(count)} such records, " if count > 1 else ""
    places = ", ".join(["{}"] * (count - 1)) + " and {}" if count > 1 else "{}"
    return _each(_repeated(trial, (first,) * count), f"{several}the drive at {places}", lambda e: e, *settings)


def _repeated(trial: Trial, experiments: tuple[Experiment, ...]) -> Trial:
    """The trial of one experiment with several in its place, which share its settings."""
    of = tuple(range(len(experiments)))
    shared = tuple(dataclasses.replace(setting, of=of) for setting in trial.settings)
    return dataclasses.replace(trial, experiments=experiments, settings=shared)


def _series_resistor(trial: Trial) -> Trial | None:
    """A known resistor in series, or another one in place of a known one; it stands where it is, or at a default."""
    of = parameters(trial.experiments[0].circuit)
    start, free = of.get("series_resistor"), trial.experiments[0].free
    if "series_resistor" in free or not isinstance(constant(trial.experiments[0].circuit), _CAN_HAVE_RESISTOR):
        return None
    low, high = _RESISTORS
    where = Setting(
        "series_resistor",
        "series_resistor",
        "ohm",
        SERIES_RESISTOR if start is None else float(start),
        low,
        high,
        tuple(range(len(trial.experiments))),
    )
    return _each(trial, "a known resistor of {} in series", _with_resistor, where)


def _with_resistor(e: Experiment) -> Experiment:
    def resisted(circuit: Any) -> Any:
        if isinstance(circuit, FinalCircuit):
            circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci)
        return dataclasses.replace(circuit, series_resistor=SERIES_RESISTOR)

    return e if parameters(e.circuit).get("series_resistor") is not None else _inside(e, resisted)


def _inside(e: Experiment, change: Callable[[Any], Any]) -> Experiment:
    """The experiment with its circuit changed, within a skin level if it has one."""
    circuit: Any = e.circuit
    if isinstance(circuit, WithSkin):
        return dataclasses.replace(e, circuit=dataclasses.replace(circuit, circuit=change(circuit.circuit)))
    return dataclasses.replace(e, circuit=change(circuit))


def _lighter_probe(trial: Trial) -> Trial | None:
    def lighter(circuit: Any) -> Any:
        probe = circuit.probe
        return dataclasses.replace(circuit, probe=Probe(_PROBE * probe.R, probe.C / _PROBE))

    text = f"a probe of {_PROBE:g} times the impedance"
    return _each(trial, text, lambda e: _inside(e, lighter)) if _has_probe(trial) else None


def _no_probe(trial: Trial) -> Trial | None:
    def bare(circuit: Any) -> Any:
        return dataclasses.replace(circuit, probe=None)

    text = "a probe that does not load the skin"
    return _each(trial, text, lambda e: _inside(e, bare)) if _has_probe(trial) else None


def _has_probe(trial: Trial) -> bool:
    return getattr(constant(trial.experiments[0].circuit), "probe", None) is not None


def _better_Ci(trial: Trial) -> Trial | None:
    def better(e: Experiment) -> Experiment:
        halves = np.where([name == "Ci" for name in e.free], 0.5, 1.0)
        return dataclasses.replace(e, prior_root=halves[:, None] * e.prior_root)

    return _each(trial, "Ci known twice as well", better) if "Ci" in trial.experiments[0].free else None


def _channel(trial: Trial, channel: Channel, what: str) -> Trial | None:
    if channel in trial.experiments[0].channels:
        return None
    noise = trial.experiments[0].noise.get(channel) or NOISE[channel]

    def recorded(e: Experiment) -> Experiment:
        return dataclasses.replace(e, channels=(*e.channels, channel), noise={**e.noise, channel: noise})

    unit = "V" if channel == "Vsc" else "A"
    return _each(trial, f"{what} recorded to ± {engineering(noise, unit)}", recorded)


def _finer(trial: Trial, steps: Mapping[Channel, float]) -> Trial | None:
    """The noise without that of the converters, where there is enough of it."""
    e = trial.experiments[0]
    left: dict[str, float] = {
        channel: math.sqrt(max(e.noise[channel] ** 2 - steps[channel] ** 2 / 12.0, 0.0))
        for channel in e.channels
        if channel in steps
    }
    left = {channel: noise for channel, noise in left.items() if 0.0 < noise < (1.0 - _FLEETING) * e.noise[channel]}
    if not left:
        return None
    unit = {"Vsc": "V", "I": "A"}
    shown = ", ".join(f"± {engineering(noise, unit[channel])} on {channel}" for channel, noise in left.items())
    return _each(
        trial,
        f"converters of finer steps, which leave {shown}",
        lambda e: dataclasses.replace(e, noise={**e.noise, **left}),
    )


def _second_panel(trial: Trial) -> Trial | None:
    """The same finger on another insulator, whose capacitance is known as well as the first's, and on its own."""
    first, *others = trial.experiments
    if others or "Ci" not in first.free:
        return None
    Ci = float(parameters(first.circuit)["Ci"])
    where = Setting("second_Ci", "Ci", "F", Ci, Ci / _PANELS, Ci * _PANELS, (1,))
    both = _repeated(trial, (first, dataclasses.replace(first, own=("Ci",))))
    return _each(both, "a second panel, of {} known on its own as well as Ci", lambda e: e, where)
