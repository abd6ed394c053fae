"""Possible changes of a measurement, each with its effort, and the changes that a fit suggests."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy

from fitact.experiment.blind_directions import STRAY, gain_names
from fitact.experiment.experiment import FREQUENCY, CandidateDesign, DesignOption, Gradient, Setting, evaluate_design
from fitact.experiment.fisher import Experiment
from fitact.model.circuit import RC, Channel, FinalCircuit, Probe
from fitact.model.drive import Multitone, Periodic, Trapezoid
from fitact.model.skin import WithSkin, circuit_parameters, constant_skin_circuit, has_time_constants, with_values
from fitact.units import format_engineering

_UNITS = {"Vsc": "V", "I": "A"}
NEEDS = {  # what a suggested change needs
    "current": "a shunt in the loop, and a channel for it",
    "series resistor": "a resistor of known value",
    "better Ci": "a picture of the footprint, and the panel's data sheet",
    "longer record": "time",
}


class Change(NamedTuple):
    """A change of a measurement."""

    name: str
    group: str  # only one change of a group can be made
    effort: float  # 1 means changing a setting of an existing instrument
    apply: Callable[[CandidateDesign], CandidateDesign | None]  # returns None if the change cannot be made

    def __call__(self, design: CandidateDesign) -> CandidateDesign | None:
        """Return the candidate with the change and its effort, or None if it cannot be made."""
        changed = self.apply(design)
        if changed is None:
            return None
        return dataclasses.replace(changed, names=(*design.names, self.name), effort=design.effort + self.effort)


def changes(adc_steps: Mapping[Channel, float] | None = None) -> tuple[Change, ...]:
    """Return all changes; `adc_steps` has the LSB of each channel's ADC (V, A) where it is known."""
    lighter = "a probe of 10 times the impedance", lambda probe: Probe(10.0 * probe.R, probe.C / 10.0)
    no_load = "a probe that does not load the skin", lambda probe: None
    return (
        Change("longer record", "length", 1.0, _longer_record),
        Change("higher sampling rate", "rate", 1.0, _higher_sampling_rate),
        Change("frequency", "frequency", 1.0, lambda d: _frequencies(d, 1)),
        Change("two frequencies", "frequency", 2.0, lambda d: _frequencies(d, 2)),
        Change("three frequencies", "frequency", 3.0, lambda d: _frequencies(d, 3)),
        Change("series resistor", "series resistor", 2.0, _series_resistor),
        Change("lighter probe", "probe", 3.0, lambda d: _other_probe(d, *lighter)),
        Change("no probe load", "probe", 4.0, lambda d: _other_probe(d, *no_load)),
        Change("better Ci", "Ci", 3.0, _better_Ci),
        Change("current", "current", 3.0, lambda d: _add_channel(d, "I", "the loop current I", 20e-9)),
        Change("skin voltage", "skin voltage", 3.0, lambda d: _add_channel(d, "Vsc", "the skin voltage Vsc", 0.1)),
        Change("quieter V", "noise of V", 4.0, _quieter_drive),
        Change("finer converter", "converter", 4.0, lambda d: _higher_adc_resolution(d, adc_steps or {})),
        Change("second panel", "panel", 5.0, _second_panel),
    )


def suggest_measurements(as_it_is: CandidateDesign, gradient: Gradient) -> tuple[DesignOption, ...]:
    """Evaluate the changes that a fit suggests, best first, if they can be made and computed."""
    options = []
    for change in changes():
        candidate = change(as_it_is) if change.name in NEEDS else None
        if candidate is not None and candidate.experiments[0] is not as_it_is.experiments[0]:
            # a failed fit may end at a circuit whose current overflows
            with contextlib.suppress(np.linalg.LinAlgError):
                options.append(evaluate_design(candidate, candidate.start_values, gradient))
    return tuple(sorted(options, key=lambda option: option.force_sd))


def _apply_to_all(
    design: CandidateDesign, text: str, change: Callable[[Experiment], Experiment], *settings: Setting
) -> CandidateDesign:
    return dataclasses.replace(
        design,
        experiments=tuple(map(change, design.experiments)),
        texts=(*design.texts, text),
        settings=(*design.settings, *settings),
    )


def _longer_record(design: CandidateDesign) -> CandidateDesign:
    return _apply_to_all(design, "four times as much data", lambda e: dataclasses.replace(e, records=4 * e.records))


def _higher_sampling_rate(design: CandidateDesign) -> CandidateDesign:
    def raise_rate(e: Experiment) -> Experiment:
        places, end = np.arange(4 * len(e.time)) / 4, e.time[-1] + (e.time[-1] - e.time[-2])
        return dataclasses.replace(e, time=np.interp(places, np.arange(len(e.time) + 1), np.append(e.time, end)))

    return _apply_to_all(design, "four times the sampling rate, with the same noise in each sample", raise_rate)


def _frequencies(design: CandidateDesign, count: int) -> CandidateDesign | None:
    """Replace one record by `count` records, each with its own frequency and the same number of samples.

    Frequencies lie between 1 Hz and the frequency with 100 samples per period, or with 4 rise times per shorter half.
    """
    first, *others = design.experiments
    drive = first.drive
    if others or not (isinstance(drive, Periodic) and first.steady_state and has_time_constants(first.circuit)):
        return None
    low = min(1.0, float(drive.frequency))
    high = 1.0 / (100.0 * float(np.median(np.diff(first.time))))
    if isinstance(drive, Trapezoid):
        high = min(high, float(min(drive.duty, 1.0 - drive.duty) / (4.0 * drive.rise_time)))
    high /= max(drive.orders) if isinstance(drive, Multitone) else 1.0
    start = min(float(drive.frequency), high)
    numbers = [""] + [f"_{number}" for number in range(2, count + 1)]
    settings = (Setting(FREQUENCY + n, FREQUENCY, "Hz", start, low, high, (i,)) for i, n in enumerate(numbers))
    text = {
        1: "the drive at {}",
        2: "two such records, the drive at {} and {}",
        3: "three such records, the drive at {}, {} and {}",
    }[count]
    return _apply_to_all(_replicate_experiment(design, (first,) * count), text, lambda e: e, *settings)


def _replicate_experiment(design: CandidateDesign, experiments: tuple[Experiment, ...]) -> CandidateDesign:
    """Replace a candidate's single experiment by several that share its settings."""
    indices = tuple(range(len(experiments)))
    shared = tuple(dataclasses.replace(setting, experiment_indices=indices) for setting in design.settings)
    return dataclasses.replace(design, experiments=experiments, settings=shared)


def _series_resistor(design: CandidateDesign, default: float = 100e3) -> CandidateDesign | None:
    """Insert a known series resistor, or change a known one; it starts at its present value or at `default`."""
    first = design.experiments[0]
    if "series_resistor" in first.free or not isinstance(constant_skin_circuit(first.circuit), RC):
        return None

    def insert_resistor(e: Experiment) -> Experiment:
        if circuit_parameters(e.circuit).get("series_resistor") is not None:
            return e
        circuit, inner = e.circuit, constant_skin_circuit(e.circuit)
        if isinstance(inner, FinalCircuit):
            inner = inner.as_loop()
            circuit = dataclasses.replace(circuit, circuit=inner) if isinstance(circuit, WithSkin) else inner
        return _with_fields(dataclasses.replace(e, circuit=circuit), series_resistor=default)

    stated = circuit_parameters(first.circuit).get("series_resistor")
    start, indices = default if stated is None else float(stated), tuple(range(len(design.experiments)))
    # resistors from 1 kohm to 100 Mohm can be bought, and the cable's capacitance does not short them
    where = Setting("series_resistor", "series_resistor", "ohm", start, 1e3, 1e8, indices)
    return _apply_to_all(design, "a known resistor of {} in series", insert_resistor, where)


def _with_fields(e: Experiment, **fields: Any) -> Experiment:
    """Return the experiment with other fields of its circuit."""
    return dataclasses.replace(e, circuit=with_values(e.circuit, fields))


def _other_probe(design: CandidateDesign, text: str, change: Callable[[Probe], Probe | None]) -> CandidateDesign | None:
    """Change the probe, or return None if there is none."""
    probe = getattr(constant_skin_circuit(design.experiments[0].circuit), "probe", None)
    return None if probe is None else _apply_to_all(design, text, lambda e: _with_fields(e, probe=change(probe)))


def _better_Ci(design: CandidateDesign) -> CandidateDesign | None:
    def halve_Ci_sd(e: Experiment) -> Experiment:
        halves = np.where([name == "Ci" for name in e.free], 0.5, 1.0)
        return dataclasses.replace(e, prior_factor=halves[:, None] * e.prior_factor)

    return (
        _apply_to_all(design, "half the uncertainty of Ci", halve_Ci_sd) if "Ci" in design.experiments[0].free else None
    )


def _add_channel(design: CandidateDesign, channel: Channel, what: str, default_noise: float) -> CandidateDesign | None:
    """Add a channel that is not recorded yet, with the stated noise or the default."""
    if channel in design.experiments[0].channels:
        return None
    noise = design.experiments[0].noise.get(channel) or default_noise

    def record_channel(e: Experiment) -> Experiment:
        recorded = dataclasses.replace(e, channels=(*e.channels, channel), noise={**e.noise, channel: noise})
        new = {name: e.new_gain_sd.get(channel, 0.0) for name in gain_names((channel,))}
        new |= {STRAY: e.new_stray_sd} if channel == "I" else {}
        new = {name: sd for name, sd in new.items() if sd}
        prior_factor = scipy.linalg.block_diag(e.prior_factor, *new.values())
        return dataclasses.replace(recorded, free=(*e.free, *new), prior_factor=prior_factor)

    shown = format_engineering(noise, _UNITS[channel])
    return _apply_to_all(design, f"{what} also recorded ({shown} rms noise)", record_channel)


def _quieter_drive(design: CandidateDesign) -> CandidateDesign | None:
    """Record the drive with half its noise, or return None if the drive is stated."""
    noise = 0.5 * design.experiments[0].noise.get("V", 0.0)
    if noise == 0.0:
        return None
    text = f"V recorded with half the noise ({format_engineering(noise, 'V')} rms)"
    return _apply_to_all(design, text, lambda e: dataclasses.replace(e, noise={**e.noise, "V": 0.5 * e.noise["V"]}))


def _higher_adc_resolution(design: CandidateDesign, adc_steps: Mapping[Channel, float]) -> CandidateDesign | None:
    """Remove the ADC's quantization noise, if it contributes more than 1 % of a channel's noise."""
    e = design.experiments[0]
    quieter: dict[str, float] = {}
    for channel in e.channels:
        noise = math.sqrt(max(e.noise[channel] ** 2 - adc_steps.get(channel, 0.0) ** 2 / 12.0, 0.0))
        if 0.0 < noise < 0.99 * e.noise[channel]:
            quieter[channel] = noise
    if not quieter:
        return None
    shown = ", ".join(f"{format_engineering(noise, _UNITS[name])} rms on {name}" for name, noise in quieter.items())

    def lower_noise(e: Experiment) -> Experiment:
        return dataclasses.replace(e, noise={**e.noise, **quieter})

    return _apply_to_all(design, f"an ADC with finer steps, which leaves noise of {shown}", lower_noise)


def _second_panel(design: CandidateDesign, max_ratio: float = 10.0) -> CandidateDesign | None:
    """Measure the same finger also on another insulator, with an equally accurate and independent value of Ci."""
    first, *others = design.experiments
    if others or "Ci" not in first.free:
        return None
    Ci = float(circuit_parameters(first.circuit)["Ci"])
    where = Setting("second_Ci", "Ci", "F", Ci, Ci / max_ratio, Ci * max_ratio, (1,))
    both = _replicate_experiment(design, (first, dataclasses.replace(first, own_parameters=("Ci",))))
    return _apply_to_all(both, "a second panel of {}, known independently and as well as Ci", lambda e: e, where)
