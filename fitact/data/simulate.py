"""Simulated records of a scene, for trials by the user; `data_synth` makes the data of the tests independently."""

import jax
import numpy as np
from jaxtyping import Float

from fitact.data.plausibility import check_plausibility, insulator_voltage
from fitact.data.record import MINIMUM_SAMPLES, Record
from fitact.errors import InputError
from fitact.model.circuit import Circuit
from fitact.model.drive import Drive
from fitact.model.force import electrostatic_force
from fitact.model.response import response
from fitact.scene.scene import Scene


def simulate(scene: Scene, seed: int = 0) -> Record:
    """Return a simulated record of V and the measured channels, with noise, by the scene's [measurement]."""
    circuit, drive, measured, time = scene.make_circuit(), scene.make_drive(), scene.measurement, sample_times(scene)
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        channels = {"V": np.asarray(drive.value(time))}
        for channel in measured.channels:
            clean = np.asarray(response(circuit, drive, time, steady_state=scene.drive.steady_state, channel=channel))
            noise = measured.noise_Vsc if channel == "Vsc" else measured.noise_I
            channels[channel] = clean + noise * rng.standard_normal(time.size)
        doubts = _check_scene(scene, circuit, drive, time)
    if not np.all(np.isfinite(channels.get("I", 0.0))):
        raise InputError(
            "scene: the current has an impulse at each ideal jump of the drive; give the drive a rise time"
            " (waveform = 'trapezoid'), or the scene an R_H or a series_resistor"
        )
    V, Vsc, current = (channels.get(name) for name in ("V", "Vsc", "I"))
    return Record.from_arrays(time, V=V, Vsc=Vsc, I=current, source="simulation", warnings=tuple(doubts))


def _check_scene(scene: Scene, circuit: Circuit, drive: Drive, time: Float[np.ndarray, " samples"]) -> list[str]:
    contact, plain = scene.geometry().contact(circuit), scene.make_rc_circuit()
    voltage = response(circuit, drive, time, steady_state=scene.drive.steady_state, channel=contact.channel)
    peak = float(np.max(np.abs(drive.value(time))))
    insulator = insulator_voltage(peak, plain.current_terms(), plain, scene.drive.lowest_frequency)
    return check_plausibility(scene, peak, insulator, float(np.max(electrostatic_force(voltage, contact))))


def sample_times(scene: Scene, max_samples: int = 100_000_000) -> Float[np.ndarray, " samples"]:
    """Return the sampling times (s) of the scene; raise InputError if they are too few or too many."""
    measured = scene.measurement
    count = round(measured.duration * measured.sampling_rate)
    if not MINIMUM_SAMPLES <= count <= max_samples:
        raise InputError(
            f"scene: [measurement] duration times sampling_rate is {count:,} samples; choose them to give"
            f" {MINIMUM_SAMPLES} to {max_samples:,}"
        )
    return np.arange(count) / measured.sampling_rate
