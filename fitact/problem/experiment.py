"""The measurement of a fit as an experiment, for what another one would tell."""

import math

import numpy as np
from jaxtyping import Float

from fitact.data.noise import estimate_noise
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.experiment.blind_directions import STRAY, gain_names
from fitact.experiment.fisher import Experiment
from fitact.instrument.classes import typical_gain_u
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.model.drive import Sampled
from fitact.model.skin import circuit_parameters
from fitact.problem.build import Problem
from fitact.problem.drive_choice import whole_periods


def experiment_from_problem(
    problem: Problem,
    likelihood: Likelihood,
    optimum: CircuitValues,
    theta: np.ndarray,
    sigma: np.ndarray,
    charges: Float[np.ndarray, " charges"],
) -> Experiment | None:
    """Return the measurement of a problem at theta, where the circuit is `optimum`, as an experiment.

    `charges` are what unknown charges add to the first channel at its first sample, without its gain (V, A).
    Several records are repetitions of the first. None with a spectrum, whose information no experiment in time has.
    """
    source, record = problem.sources[0], problem.sources[0].record
    if isinstance(record, Spectrum) or isinstance(problem.sources[-1].record, Spectrum):
        return None
    records = len({id(source.record) for source in problem.sources})
    pairs = zip(likelihood.channels, problem.sources, strict=True)
    electrical = [each for each, other in pairs if other.record is record and each.channel != "Ft"]
    channels = tuple(each.channel for each in electrical)
    fields = circuit_parameters(likelihood.template)
    gains = gain_names(channels)
    free = tuple(name for name in likelihood.prior.names if name in fields or name in gains or name == STRAY)
    rows = [likelihood.prior.names.index(name) for name in free]
    factor, measurement = likelihood.prior_factor, source.scene.measurement
    noise = {"Vsc": measurement.noise_Vsc, "I": measurement.noise_I}
    if source.choice.name == "measured":
        noise["V"] = estimate_noise(record["V"])
    time, drive = record.time, source.choice.drive
    if isinstance(drive, Sampled) and drive.period is None:
        part = slice(_represented_samples(record))
        time, drive = time[part], Sampled(time[part], np.asarray(drive.samples)[part])
    free_delays = [each for each in electrical if "delay" in each.timing.free]
    delay_sd = {each.channel: float(each.timing.sd[0] * each.timing.step) for each in free_delays}
    stray = source.scene.stray_capacitance()
    if STRAY in free:
        stray = math.exp(theta[likelihood.prior.names.index(STRAY)])
    channel, is_unknown = likelihood.channels[0].channel, source.choice.unknown_charge
    steps = _initial_steps(optimum, channel, charges) if is_unknown else ()
    return Experiment(
        circuit=likelihood.finger(optimum.circuit),
        free=free,
        prior_factor=np.linalg.cholesky((factor @ factor.T)[np.ix_(rows, rows)]),
        drive=drive,
        time=time - source.choice.shift,
        channels=channels,
        noise=noise | dict(zip(channels, map(float, sigma), strict=False)),
        steady_state=source.choice.steady_state,
        records=records * len(record) / time.size,
        geometry=source.scene.geometry(),
        stray_capacitance=stray,
        ties=likelihood.tied,
        new_gain_sd={name: source.scene.gain_u(name) or typical_gain_u(name) for name in ("Vsc", "I")},
        delay_sd={name: source.scene.delay_sd(name, record.time_step) for name in ("Vsc", "I")} | delay_sd,
        initial_steps=steps,
    )


def _represented_samples(record: Record, most: int = 8192) -> int:
    """Return how many of the first samples of a recorded drive stand for all: `most`, in whole periods if it has any.

    What does not repeat would pass for further frequencies of the drive.
    """
    count, length = whole_periods(record)
    if length is None or count <= most:
        return min(count, most)
    periods = length * record.frequency()  # type: ignore[operator]  # of a record that repeats
    return math.ceil(count / periods * max(math.floor(most * periods / count), 1))


def _initial_steps(optimum: CircuitValues, channel: str, charges: Float[np.ndarray, " charges"]) -> tuple[float, ...]:
    """Return the steps of V that would leave the charges that a channel shows; 0 for a charge that it does not show."""
    weight = np.array(optimum.terms[channel].weight) if channel in optimum.terms else np.zeros(0)
    is_shown = np.abs(weight) > 1e-9 * np.max(np.abs(weight), initial=0.0)
    return tuple(np.divide(charges[: weight.size], weight, out=np.zeros_like(weight), where=is_shown).tolist())
