"""Observables of channels: the signal of a circuit as a function of its parameters, and of delay and clock."""

import dataclasses
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.likelihood.compression import BASELINE_NAMES
from fitact.likelihood.padded_samples import PaddedSamples
from fitact.model.circuit import Channel, Circuit, HighpassTerms
from fitact.model.drive import Drive, Sampled
from fitact.model.response import response_and_rate, superpose_terms
from fitact.model.skin import WithSkin

CHARGES = ("charge", "charge_2", "charge_3", "charge_4")  # one for each time constant, the slowest first
LINEAR_NUISANCES = (*BASELINE_NAMES, *CHARGES)
FIRST_CHARGE = len(BASELINE_NAMES)
TIMING_NUISANCES = ("delay", "clock")
SHORT_TAU = 0.33  # time steps below which a time constant is short: a recorded V does not show what happens within it


class ChannelInputs(eqx.Module):
    """Quantities of a channel that depend on the parameters."""

    circuit: Circuit  # at the parameters
    gain: ArrayLike = 1.0  # of the channel
    delay: ArrayLike = 0.0  # beyond the `shift` of the channel's `DriveTiming`, s
    # relative error of the drive's frequency on the recorder's clock, beyond the `clock` of the channel's `DriveTiming`
    clock: ArrayLike = 0.0
    effects: Float[Array, " effects"] | None = None  # sizes of `PaddedSamples.effects`
    friction: dict[str, ArrayLike] | None = None  # free parameters of a `FrictionObservable`, SI
    drive_gain: ArrayLike = 1.0  # ratio between indicated and true V, where it does not act through `gain`
    stray: ArrayLike | None = None  # capacitance from the lead to ground, whose current I contains, F


class DriveTiming(eqx.Module):
    """Delay of a channel against its drive, and the drive's clock."""

    shift: ArrayLike  # start of the drive after the record's t = 0, s
    clock: ArrayLike  # relative error of the drive's frequency
    step: ArrayLike  # unit of a delay, the time step of the samples, s
    # prior standard deviations of `TIMING_NUISANCES`, in time steps (clock: over half the record)
    sd: Float[Array, "2"]
    free: tuple[str, ...] = eqx.field(static=True, default=())  # the `TIMING_NUISANCES` that are parameters, in order

    def drive_time(self, time: Float[Array, " n"], delay: ArrayLike, clock: ArrayLike) -> Float[Array, " n"]:
        """Return times on the drive's clock, s."""
        since = time - (self.shift + delay)
        return since * (1.0 + self.clock + clock) if "clock" in self.free else since


class Observable(eqx.Module):
    """Quantity that a channel records; all have a `channel`, its name, and a `timing`."""

    @property
    def linear_names(self) -> tuple[str, ...]:
        """Names of the linear nuisances, in the order of `LINEAR_NUISANCES`."""
        return LINEAR_NUISANCES

    @property
    def follows_samples(self) -> bool:
        """Whether the response follows a measured drive from sample to sample."""
        return False

    @property
    def electrical(self) -> "ElectricalSignal":
        """Vsc or I in time, of which it is made; TypeError for a spectrum."""
        raise TypeError(f"{type(self).__name__} is not in time")

    def keep_ends(self) -> Self:
        """Return what `PaddedSamples.keep_ends` needs."""
        return self

    def response(
        self, samples: PaddedSamples, inputs: ChannelInputs, extra_delay: ArrayLike = 0.0
    ) -> Float[Array, " samples"]:
        """Return the modelled signal without linear nuisances, noise and effects of instruments.

        `extra_delay` (s) is added to the delay.
        """
        raise NotImplementedError

    def linear_shapes(self, samples: PaddedSamples, inputs: ChannelInputs) -> Float[Array, "4 samples"]:
        """Return the shapes of the linear nuisances that follow those of the baseline, each of height 1."""
        return jnp.zeros((len(CHARGES), samples.time.size))

    def delay_derivative(self, samples: PaddedSamples, inputs: ChannelInputs) -> Float[Array, " samples"]:
        """Return the derivative of the response with respect to a delay (per s); 0 where none is optional."""
        return jnp.zeros_like(samples.observed)


class ElectricalSignal(Observable):
    """Vsc or I in time, beside a drive."""

    drive: Drive  # V(t)
    timing: DriveTiming
    channel: Channel = eqx.field(static=True)  # "Vsc", "I", or the voltage that generates a force
    steady_state: bool = eqx.field(static=True)  # or from rest
    smooth: Float[Array, " samples"] | None = None  # recorded drive as a delay shifts it (`smooth_drive`), V
    noise_gain: ArrayLike = 0.0  # of the rest of the drive, for all parameters, gains and delays
    # number of the fastest time constants that are so short that I follows dV/dt instead, later by them
    lags: int = eqx.field(static=True, default=0)

    @property
    def electrical(self) -> "ElectricalSignal":
        return self

    @property
    def follows_samples(self) -> bool:
        """Whether the response follows a measured drive from sample to sample."""
        return isinstance(self.drive, Sampled) and not self.steady_state

    def keep_ends(self) -> Self:
        """Return the first two samples of a measured drive."""
        drive, smooth = self.drive, None if self.smooth is None else np.zeros(2)
        if isinstance(drive, Sampled):
            drive = Sampled(np.asarray(drive.time)[:2], np.asarray(drive.samples)[:2], drive.period)
        return dataclasses.replace(self, drive=drive, smooth=smooth)

    def delay_noise(self, steps: int) -> Self:
        """Return the signal with the noise of its recorded drive `steps` samples later, as the response is."""
        if self.smooth is None or steps == 0:
            return self
        assert isinstance(self.drive, Sampled)
        smooth = np.asarray(self.smooth)
        noise = np.roll(np.asarray(self.drive.samples) - smooth, steps)
        return dataclasses.replace(self, drive=dataclasses.replace(self.drive, samples=smooth + noise))

    def response(
        self, samples: PaddedSamples, inputs: ChannelInputs, extra_delay: ArrayLike = 0.0
    ) -> Float[Array, " samples"]:
        if samples.phases is not None and "clock" not in self.timing.free:
            return samples.repeat(self.response(samples.first_period(), inputs, extra_delay))
        charges = samples.charges
        undelayed = charges is not None or (
            not self.timing.free and isinstance(extra_delay, float) and extra_delay == 0.0
        )
        if undelayed and isinstance(self.drive, Sampled) and self.drive.period is None:
            time = self.drive.time  # identical to the samples of V, so that `highpass` needs no search
        else:
            time = self.timing.drive_time(samples.time, inputs.delay + extra_delay, inputs.clock)
        if self.smooth is not None and not undelayed:
            return self._delay_smooth_drive(samples.time, inputs, time)
        total, rate = self.response_and_rate(inputs, time)
        if rate is not None and charges is not None:
            total = jnp.interp(
                samples.time - (self.timing.shift + inputs.delay), samples.time, total + rate * charges.sample_rate()
            )
        elif rate is not None and samples.rate is not None:
            total = total + rate * samples.rate
        return inputs.gain * total

    def _delay_smooth_drive(self, recorded: Array, inputs: ChannelInputs, time: Array) -> Float[Array, " samples"]:
        """Return the response at the drive's `time` to the smooth drive, with the rest of the drive as `recorded`.

        A parameter, a gain or a delay that made the noise of V smaller would be drawn there. So the noise has a gain
        that is the same for all.
        """
        assert isinstance(self.drive, Sampled)
        smooth = dataclasses.replace(self.drive, samples=self.smooth)
        rest = dataclasses.replace(self.drive, samples=self.drive.samples - self.smooth)
        total, _ = response_and_rate(inputs.circuit, smooth, time, steady_state=self.steady_state, channel=self.channel)
        if inputs.stray is not None:  # mean over a step, as in a table
            later, earlier = (smooth.value(time + part * self.timing.step) for part in (0.5, -0.5))
            total = total + inputs.stray / self.timing.step * (later - earlier)
        return inputs.gain * total + self.noise_gain * rest.value(recorded)

    def response_and_rate(self, inputs: ChannelInputs, time: Array) -> tuple[Array, ArrayLike | None]:
        """Return the response without what follows dV/dt, and the capacitance that does (F), or None."""
        if self.lags:
            terms = self.select_terms(inputs.circuit.channel_terms(self.channel))
            total, rate = superpose_terms(terms, self.drive, time, steady_state=self.steady_state), terms.rate
        else:
            how: dict[str, Any] = {"steady_state": self.steady_state, "channel": self.channel}
            total, rate = response_and_rate(inputs.circuit, self.drive, time, **how)
        return total, rate if inputs.stray is None else (0.0 if rate is None else rate) + inputs.stray

    def response_and_fall(
        self, inputs: ChannelInputs, time: Array
    ) -> tuple[Float[Array, "2 times"], ArrayLike, ArrayLike | None]:
        """Return the response without what follows dV/dt, and minus its derivative in time beside a rise of the drive.

        Also the gain of this rise, and the capacitance that follows dV/dt (F), or None.
        """
        if isinstance(inputs.circuit, WithSkin):
            total, rate = self.response_and_rate(inputs, time)
            return jnp.stack([total, -jnp.diff(total, prepend=total[:1]) / self.timing.step]), 0.0, rate
        terms = self.terms(inputs)
        both = tuple(jnp.stack([w, w / tau])[:, None] for w, tau in zip(terms.weight, terms.tau, strict=True))
        direct = None if terms.direct is None else jnp.stack([terms.direct, 0.0])[:, None]
        pair = superpose_terms(
            HighpassTerms(both, terms.tau, None, direct), self.drive, time, steady_state=self.steady_state
        )
        return pair, terms.jump, terms.rate

    def terms(self, inputs: ChannelInputs) -> HighpassTerms:
        """Return the terms of the channel over V, with the stray capacitance."""
        terms = self.select_terms(inputs.circuit.channel_terms(self.channel))
        if inputs.stray is None:
            return terms
        return terms._replace(rate=(0.0 if terms.rate is None else terms.rate) + inputs.stray)

    def select_terms(self, terms: HighpassTerms) -> HighpassTerms:
        """Return the terms of a circuit as the channel has them, without stray capacitance."""
        return terms.follow_fastest(self.lags)

    def linear_shapes(self, samples: PaddedSamples, inputs: ChannelInputs) -> Float[Array, "4 samples"]:
        """Return the `charge_decays` at the samples."""
        return charge_decays(inputs.circuit, samples.time - samples.time[0])

    def delay_derivative(self, samples: PaddedSamples, inputs: ChannelInputs) -> Float[Array, " samples"]:
        """Return the derivative of the response with respect to a delay (per s) over two steps, for ideal edges."""
        step = self.timing.step
        later, earlier = (self.response(samples, inputs, extra) for extra in (step, -step))
        return (later - earlier) / (2.0 * step)


def charge_decays(circuit: Circuit, since: Float[Array, " times"]) -> Float[Array, "4 times"]:
    """Return the decays of unknown charges `since` the first sample (s), padded with 0 (constant skins only)."""
    if isinstance(circuit, WithSkin):
        return jnp.zeros((len(CHARGES), since.size))
    taus = circuit.terms().tau
    decays = jnp.stack([jnp.exp(-since / tau) for tau in taus])
    return jnp.pad(decays, ((0, len(CHARGES) - len(taus)), (0, 0)))
