"""A current that a resistance limits, with a recorded V: it responds to a delayed drive like Vsc, with coloured noise.

Through the fastest time constant tau, noise of V enters I like u[k] = a u[k - 1] + g (n[k] - n[k - 1]), where
a = e^{-h/tau} for the time step h, and through a stray capacitance C besides like C / h (n[k] - n[k - 1]). In
I[k] - a I[k - 1], noise of V and of I is therefore a moving average of two samples, or of three with a stray
capacitance. One of the two factors of the latter is divided off by the filter, and the other one is whitened by a
recursion (`fitact.likelihood.noise.Whitening`).
Between samples, V is taken as lines that have the mean of a parabola over each step; at a corner, which the bend of a
single sample shows, as lines between the samples. What V differs from them is another noise, a part of the second
difference: its mean over a step acts through tau, and its value at a time between samples like noise of V.
"""

import math
from typing import NamedTuple, Self

import numpy as np
import scipy
from jaxtyping import Float

from fitact.compiled import pad_samples, pad_weight
from fitact.data.record import Record
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import RowCovariance, estimate_current_noise
from fitact.likelihood.noise import Whitening
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Sampled
from fitact.problem.recorded_current import RecordedCurrent
from fitact.problem.runs import Rows


class NoisePath(NamedTuple):
    """How noise of V enters a current: the filter (`numerator` in powers of the delay by a sample) / (1 - decay z).

    Slower time constants than the fastest one count as infinite.
    """

    numerator: Float[np.ndarray, "3"]  # S
    decay: float  # of the fastest time constant in a time step
    direct: float  # part of the first sample of the numerator that a stray capacitance has

    @classmethod
    def from_terms(cls, terms: HighpassTerms, stray: float, step: float) -> Self:
        """Return the path through the fastest of `terms` and a `stray` capacitance (F), for time steps (s)."""
        slow, limited = (
            float(HighpassTerms(terms.weight[part], terms.tau[part]).gain_in_step(step))
            for part in (slice(-1), slice(-1, None))
        )
        decay, direct = float(np.exp(-step / terms.tau[-1])), stray / step
        numerator = np.convolve([1.0, -1.0], [limited + direct, -decay * direct])
        numerator += np.array([slow, -decay * slow, 0.0])
        return cls(numerator, decay, direct / (limited + direct))

    @property
    def gain(self) -> float:
        """Gain of the first sample, S."""
        return float(self.numerator[0])

    def respond(self, noise: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """Return what the path makes of noise, A."""
        return scipy.signal.lfilter(self.numerator, [1.0, -self.decay], noise)

    def whitening_taps(
        self, noise: float, own: float, precision: float = 1e-3, longest: int = 64
    ) -> Float[np.ndarray, " taps"]:
        """Return a filter after which the sum of this `noise` of V and of `own` noise of I correlates neighbours only.

        A stray capacitance makes it longer; it ends where it has fallen to `precision`.
        """
        from_I = np.array([1.0, -self.decay, 0.0])
        spectrum = own**2 * np.correlate(from_I, from_I, "full")
        spectrum += noise**2 * np.correlate(self.numerator, self.numerator, "full")
        root = float(min(np.roots(spectrum), key=abs).real)
        needed = 2.0 + (math.log(precision) / math.log(root) if root > precision else 0.0)
        impulse = np.zeros(min(2 ** math.ceil(math.log2(needed)), longest))
        impulse[0] = 1.0
        return scipy.signal.lfilter([1.0, -self.decay], [1.0, -root], impulse)


def estimate_drive(
    channel: ChannelLikelihood, path: NoisePath, white: Float[np.ndarray, " samples"], record: Record
) -> Rows:
    """Return the drive that is most probable for the `white` residuals of a channel, V.

    What remains of the noise of V there is independent of the residuals, which otherwise would bias the estimates.
    """
    current, whitening = RecordedCurrent.from_record(record), channel.samples.whitening
    assert whitening is not None
    gain, decay, taps = (np.asarray(each) for each in (whitening.gain, whitening.decay, whitening.taps))
    noise_I = estimate_current_noise(gain, decay, white, taps)[: len(record)]
    noise_V = np.roll(path.respond(noise_I[::-1])[::-1], -round(float(channel.timing.shift / channel.timing.step)))
    largest = 5.0 * np.sqrt(current.variance_V)  # more is no noise of V, but a misfit
    return current.V + np.clip(current.variance_V / current.noise_I**2 * noise_V, -largest, largest)


def set_drive(
    channel: ChannelLikelihood, path: NoisePath, record: Record, V: Rows, noise: Rows | None = None
) -> ChannelLikelihood:
    """Return the channel of a current with an estimate of the drive (V).

    The noise is that of the record's V, which comes by this `path`, and of its I. `noise` (A) is the response to what
    V lacks of the record's, by default that of the path.
    """
    current, size = RecordedCurrent.from_record(record), len(record)
    steps, own, rounded = round(float(channel.timing.shift) / record.time_step), current.noise_I, current.rounded
    least = float(np.min(current.variance_V))
    taps = path.whitening_taps(math.sqrt(least), own)
    from_V = path.respond(taps)
    # V differs from the chord by 1/12 of the bend in the mean; at a corner, which has the rest of it, slopes by a third
    sizes = np.abs([current.bend, current.bend - current.lasting_bend]) * (current.tones is None)  # those are known
    bend, corner = scipy.ndimage.maximum_filter1d(sizes, 3)
    in_mean, between = 0.1 * min(-math.log(max(path.decay, 1e-9)), 3.0), math.hypot(0.1, path.direct / 3.0)
    alone, varying = (
        path.gain**2 * np.roll(each, steps)
        for each in ((in_mean * corner) ** 2, current.variance_V - least + (between * bend) ** 2)
    )
    before = np.roll(varying, 1)  # the filter is taken to leave the differences of samples
    excluded = channel.samples.weights[:size] == 0.0
    covariance = RowCovariance(
        own**2 * (taps @ taps) + least * (from_V @ from_V) + varying + before + alone,
        own**2 * (taps[1:] @ taps[:-1]) + least * (from_V[1:] @ from_V[:-1]) - before,
        np.convolve(np.append(True, excluded[1:]), np.ones(taps.size))[:size] > 0.5,
        np.roll(rounded.group, 1),
        np.sum(taps) ** 2 * np.roll(rounded.variance * rounded.alike, 1),
    )
    whitening = Whitening(taps, *map(pad_weight, (covariance.used * 1.0, *covariance.recursion(own))))
    noise = np.roll(path.respond(current.V - V), steps) if noise is None else noise
    channel = channel.replace_samples(whitening=whitening, observed=pad_samples(current.I))
    return replace_drive(channel, record, V, noise)


def replace_drive(channel: ChannelLikelihood, record: Record, V: Rows, noise: Rows) -> ChannelLikelihood:
    """Return the channel with the response to V, and besides a fixed response `noise` (A)."""
    lines = V - RecordedCurrent.from_record(record).lasting_bend / 12.0
    drive = Sampled(channel.samples.time, pad_samples(lines + noise))
    return channel.replace_observable(drive=drive, smooth=pad_samples(lines), noise_gain=np.ones(()))
