"""Simulated records of a scene, for trials by the user; `data_synth` makes the data of the tests independently."""

import jax
import numpy as np
from jaxtyping import Float

from fitact.data.record import MINIMUM_SAMPLES, Record
from fitact.errors import InputError
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
    if not np.all(np.isfinite(channels.get("I", 0.0))):
        raise InputError(
            "scene: the current has an impulse at each ideal jump of the drive; give the drive a rise time"
            " (waveform = 'trapezoid'), or the scene an R_H or a series_resistor"
        )
    return Record.from_arrays(time, V=channels["V"], Vsc=channels.get("Vsc"), I=channels.get("I"), source="simulation")


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
