"""What a user may change of a measurement, each change with its effort; and those that a fit's verdict names."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.experiment.experiment import CandidateDesign, DesignOption, Setting, evaluate_design
from fitact.experiment.fisher import FREQUENCY, Experiment
from fitact.model.circuit import RC, Channel, DirectGround, FinalCircuit, Probe
from fitact.model.drive import Multitone, Periodic, Trapezoid
from fitact.model.skin import WithSkin, circuit_parameters, constant_skin_circuit, has_time_constants, with_values
from fitact.units import format_engineering


class Change(NamedTuple):
    """A change of a measurement."""

    name: str
    group: str  # of changes of one thing, of which only one can be made
    effort: float  # turning a knob of an instrument that is there is 1
    apply: Callable[[CandidateDesign], CandidateDesign | None]  # the candidate with it; None: it cannot be made there

    def __call__(self, design: CandidateDesign) -> CandidateDesign | None:
        """The candidate with the change, and its effort; None: it cannot be made there."""
        changed = self.apply(design)
        if changed is None:
            return None
        return dataclasses.replace(changed, names=(*design.names, self.name), effort=design.effort + self.effort)


def changes(adc_steps: Mapping[Channel, float] | None = None) -> tuple[Change, ...]:
    """All changes; `adc_steps` are those of the converter in each channel, V and A, where they are known."""
    return (
        Change("longer record", "length", 1.0, _longer_record),
        Change("higher sampling rate", "rate", 1.0, _higher_sampling_rate),
        Change("frequency", "frequency", 1.0, lambda d: _frequencies(d, 1)),
        Change("two frequencies", "frequency", 2.0, lambda d: _frequencies(d, 2)),
        Change("three frequencies", "frequency", 3.0, lambda d: _frequencies(d, 3)),
        Change("series resistor", "series resistor", 2.0, _series_resistor),
        Change("lighter probe", "probe", 3.0, _lighter_probe),
        Change("no probe load", "probe", 4.0, _no_probe),
        Change("better Ci", "Ci", 3.0, _better_Ci),
        Change("current", "current", 3.0, lambda d: _add_channel(d, "I", "the trunk current I", 20e-9)),
        Change("skin voltage", "skin voltage", 3.0, lambda d: _add_channel(d, "Vsc", "the skin voltage Vsc", 0.1)),
        Change("finer converter", "converter", 4.0, lambda d: _higher_adc_resolution(d, adc_steps or {})),
        Change("second panel", "panel", 5.0, _second_panel),
    )


def suggest_measurements(
    experiment: Experiment,
    gradient: Float[np.ndarray, " circuit_parameters"],
    names: Sequence[str] = ("current", "series resistor", "better Ci", "longer record"),
) -> tuple[DesignOption, ...]:
    """The changes of these `names` as options, best first, where they can be made and computed.

    `gradient` is that of the force's logarithm. A fit that failed may have ended at a circuit whose current no
    double holds.
    """
    as_it_is, options = CandidateDesign((experiment,)), []
    for change in changes():
        candidate = change(as_it_is) if change.name in names else None
        if candidate is not None and candidate.experiments[0] is not experiment:
            with contextlib.suppress(np.linalg.LinAlgError):
                options.append(evaluate_design(candidate, candidate.start_values, gradient))
    return tuple(sorted(options, key=lambda option: option.force_sd))


def _apply_to_all(
    design: CandidateDesign, text: str, change: Callable[[Experiment], Experiment], *settings: Setting
) -> CandidateDesign:
    """The candidate with the same change of all its experiments."""
    return dataclasses.replace(
        design,
        experiments=tuple(map(change, design.experiments)),
        texts=(*design.texts, text),
        settings=(*design.settings, *settings),
    )


def _longer_record(design: CandidateDesign, factor: int = 4) -> CandidateDesign:
    def repeat_record(e: Experiment) -> Experiment:
        return dataclasses.replace(e, records=factor * e.records)

    return _apply_to_all(design, f"{_count(factor)} times the record", repeat_record)


def _higher_sampling_rate(design: CandidateDesign, factor: int = 4) -> CandidateDesign:
    def raise_rate(e: Experiment) -> Experiment:
        at = np.arange(factor * len(e.time)) / factor
        end = e.time[-1] + (e.time[-1] - e.time[-2])
        return dataclasses.replace(e, time=np.interp(at, np.arange(len(e.time) + 1), np.append(e.time, end)))

    text = f"{_count(factor)} times the sampling rate, with the same noise in each sample"
    return _apply_to_all(design, text, raise_rate)


def _count(number: int) -> str:
    return {2: "two", 3: "three", 4: "four"}[number]


def _frequencies(
    design: CandidateDesign,
    count: int,
    *,
    lowest: float = 1.0,
    min_samples_per_period: float = 100.0,
    min_rises: float = 4.0,
) -> CandidateDesign | None:
    """So many records in place of one, each with a frequency of its own, and as many samples as that one.

    They lie between `lowest` (Hz) and where a period has too few samples, or half of one too few rises.
    """
    first, *others = design.experiments
    drive = first.drive
    if others or not (isinstance(drive, Periodic) and first.steady_state and has_time_constants(first.circuit)):
        return None
    low = min(lowest, float(drive.frequency))
    high = 1.0 / (min_samples_per_period * float(np.median(np.diff(first.time))))
    if isinstance(drive, Trapezoid):
        high = min(high, float(min(drive.duty, 1.0 - drive.duty) / (min_rises * drive.rise_time)))
    high /= max(drive.orders) if isinstance(drive, Multitone) else 1.0
    start = min(float(drive.frequency), high)
    numbers = [""] + [f"_{number}" for number in range(2, count + 1)]
    settings = (Setting(FREQUENCY + n, FREQUENCY, "Hz", start, low, high, (i,)) for i, n in enumerate(numbers))
    several = f"{_count(count)} such records, " if count > 1 else ""
    places = ", ".join(["{}"] * (count - 1)) + " and {}" if count > 1 else "{}"
    replicated = _replicate_experiment(design, (first,) * count)
    return _apply_to_all(replicated, f"{several}the drive at {places}", lambda e: e, *settings)


def _replicate_experiment(design: CandidateDesign, experiments: tuple[Experiment, ...]) -> CandidateDesign:
    """The candidate of one experiment with several in its place, which share its settings."""
    indices = tuple(range(len(experiments)))
    shared = tuple(dataclasses.replace(setting, experiment_indices=indices) for setting in design.settings)
    return dataclasses.replace(design, experiments=experiments, settings=shared)


def _series_resistor(
    design: CandidateDesign, default: float = 100e3, low: float = 1e3, high: float = 1e8
) -> CandidateDesign | None:
    """A known resistor in series, or another one in place of a known one; it stands where it is, or at `default`.

    One can buy those between `low` and `high` (ohm), and the cable's capacitance does not short them.
    """
    first = design.experiments[0]
    if "series_resistor" in first.free or not isinstance(constant_skin_circuit(first.circuit), RC):
        return None

    def insert_resistor(e: Experiment) -> Experiment:
        if circuit_parameters(e.circuit).get("series_resistor") is not None:
            return e
        circuit, inner = e.circuit, constant_skin_circuit(e.circuit)
        if isinstance(inner, FinalCircuit):
            inner = DirectGround(inner.Rsc, inner.Csc, inner.Ci)
            circuit = dataclasses.replace(circuit, circuit=inner) if isinstance(circuit, WithSkin) else inner
        return _with_fields(dataclasses.replace(e, circuit=circuit), series_resistor=default)

    stated = circuit_parameters(first.circuit).get("series_resistor")
    start, indices = default if stated is None else float(stated), tuple(range(len(design.experiments)))
    where = Setting("series_resistor", "series_resistor", "ohm", start, low, high, indices)
    return _apply_to_all(design, "a known resistor of {} in series", insert_resistor, where)


def _with_fields(e: Experiment, **fields: Any) -> Experiment:
    """The experiment with other fields of its circuit, within a skin level if it has one."""
    return dataclasses.replace(e, circuit=with_values(e.circuit, fields))


def _lighter_probe(design: CandidateDesign, factor: float = 10.0) -> CandidateDesign | None:
    def lighten_probe(e: Experiment) -> Experiment:
        probe: Any = _probe(e)
        return _with_fields(e, probe=Probe(factor * probe.R, probe.C / factor))

    text = f"a probe of {factor:g} times the impedance"
    return _apply_to_all(design, text, lighten_probe) if _probe(design.experiments[0]) else None


def _no_probe(design: CandidateDesign) -> CandidateDesign | None:
    if _probe(design.experiments[0]) is None:
        return None
    return _apply_to_all(design, "a probe that does not load the skin", lambda e: _with_fields(e, probe=None))


def _probe(e: Experiment) -> Probe | None:
    return getattr(constant_skin_circuit(e.circuit), "probe", None)


def _better_Ci(design: CandidateDesign) -> CandidateDesign | None:
    def halve_Ci_sd(e: Experiment) -> Experiment:
        halves = np.where([name == "Ci" for name in e.free], 0.5, 1.0)
        return dataclasses.replace(e, prior_factor=halves[:, None] * e.prior_factor)

    return _apply_to_all(design, "Ci known twice as well", halve_Ci_sd) if "Ci" in design.experiments[0].free else None


def _add_channel(design: CandidateDesign, channel: Channel, what: str, default_noise: float) -> CandidateDesign | None:
    """The candidate with a channel that is not recorded yet; its noise is the default where none is stated."""
    if channel in design.experiments[0].channels:
        return None
    noise = design.experiments[0].noise.get(channel) or default_noise

    def record_channel(e: Experiment) -> Experiment:
        return dataclasses.replace(e, channels=(*e.channels, channel), noise={**e.noise, channel: noise})

    shown = format_engineering(noise, "V" if channel == "Vsc" else "A")
    return _apply_to_all(design, f"{what} recorded to ± {shown}", record_channel)


def _higher_adc_resolution(
    design: CandidateDesign, adc_steps: Mapping[Channel, float], min_share: float = 0.01
) -> CandidateDesign | None:
    """The noise without that of the converters, where it is more than `min_share` of a channel's."""
    e = design.experiments[0]
    quieter: dict[str, float] = {}
    for channel in e.channels:
        noise = math.sqrt(max(e.noise[channel] ** 2 - adc_steps.get(channel, 0.0) ** 2 / 12.0, 0.0))
        if 0.0 < noise < (1.0 - min_share) * e.noise[channel]:
            quieter[channel] = noise
    if not quieter:
        return None
    unit = {"Vsc": "V", "I": "A"}
    shown = ", ".join(
        f"± {format_engineering(noise, unit[channel])} on {channel}" for channel, noise in quieter.items()
    )

    def lower_noise(e: Experiment) -> Experiment:
        return dataclasses.replace(e, noise={**e.noise, **quieter})

    return _apply_to_all(design, f"converters of finer steps, which leave {shown}", lower_noise)


def _second_panel(design: CandidateDesign, max_ratio: float = 10.0) -> CandidateDesign | None:
    """The same finger on another insulator, whose capacitance is known as well as the first's, and on its own.

    It is at most `max_ratio` times larger or smaller than the first's.
    """
    first, *others = design.experiments
    if others or "Ci" not in first.free:
        return None
    Ci = float(circuit_parameters(first.circuit)["Ci"])
    where = Setting("second_Ci", "Ci", "F", Ci, Ci / max_ratio, Ci * max_ratio, (1,))
    both = _replicate_experiment(design, (first, dataclasses.replace(first, own_parameters=("Ci",))))
    return _apply_to_all(both, "a second panel, of {} known on its own as well as Ci", lambda e: e, where)
