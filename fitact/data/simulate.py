"""Simulated records of a scene, for trials by the user; `data_synth` makes the data of the tests independently."""

import math
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import double_precision
from fitact.data.plausibility import check_plausibility, insulator_voltage
from fitact.data.record import MINIMUM_SAMPLES, Record
from fitact.errors import InputError
from fitact.model.circuit import Circuit
from fitact.model.drive import Drive
from fitact.model.force import electrostatic_force, force_constant, friction
from fitact.model.force_sensor import ForceSensor, square_over_steps
from fitact.model.response import response
from fitact.scene.scene import Scene


def simulate(scene: Scene, seed: int = 0) -> Record:
    """Return a simulated record of V and the measured channels, with noise, by the scene's [measurement].

    I includes the current of a stray capacitance. V has a random stream of its own.
    """
    circuit, drive, measured, time = scene.make_circuit(), scene.make_drive(), scene.measurement, sample_times(scene)
    rng = np.random.default_rng(seed)
    with double_precision():
        steady_state, stray = scene.drive.steady_state, scene.stray_capacitance()
        noise_V = scene.noise_V() * np.random.default_rng([seed, 1]).standard_normal(time.size)
        channels: dict[str, Any] = {"V": np.asarray(drive.value(time)) + noise_V}
        for channel in measured.channels:
            if channel == "Ft":
                clean = _simulate_friction(scene, circuit, drive, time)
            else:
                clean = np.asarray(response(circuit, drive, time, steady_state=steady_state, channel=channel))
            if channel == "I" and stray:
                clean = clean + stray * np.asarray(drive.slope(time, steady_state=steady_state))
            noise = {"Vsc": measured.noise_Vsc, "I": measured.noise_I, "Ft": measured.noise_Ft}[channel]
            channels[channel] = clean + noise * rng.standard_normal(time.size)
        doubts = _check_scene(scene, circuit, drive, time)
    if not np.all(np.isfinite(channels.get("I", 0.0))):
        raise InputError(
            "scene: the current has an impulse at each ideal jump of the drive; give the drive a rise time"
            " (waveform = 'trapezoid')" + ("" if stray else ", or the scene an R_H or a series_resistor")
        )
    return Record.from_arrays(time, **channels, source="simulation", warnings=tuple(doubts))


def _simulate_friction(
    scene: Scene, circuit: Circuit, drive: Drive, time: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, " samples"]:
    """Return the friction by eq. (2) as the sensor of the scene reads it, N."""
    stated, step = scene.friction, float(time[1] - time[0])
    sensor, lead = None, 0
    if stated.sensor_frequency is not None:
        sensor = ForceSensor(stated.sensor_frequency, stated.sensor_damping)
        # so that the sensor has settled at the first sample
        lead = math.ceil(4.0 / (stated.sensor_frequency * (stated.sensor_damping or 1.0)) / step)
    early, contact = time[0] + step * np.arange(-lead, time.size), scene.geometry().contact(circuit)

    def voltage(delay: ArrayLike) -> Array:
        steady_state = scene.drive.steady_state
        return response(circuit, drive, early - delay, steady_state=steady_state, channel=contact.channel)

    if sensor is None:
        square = voltage(0.0) ** 2
    else:
        square = sensor.respond(square_over_steps(voltage, step), step)[lead:]
    force = force_constant(contact) * square
    return np.asarray(friction(force, float(stated.coefficient), stated.normal_force))


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
