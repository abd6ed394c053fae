"""A current that a resistance limits, with a recorded V: it responds to a delayed drive like Vsc, with coloured noise.

Through the fastest time constant tau, noise of V enters I like u[k] = a u[k - 1] + g (n[k] - n[k - 1]), where
a = e^{-h/tau} for the time step h. In I[k] - a I[k - 1], noise of V and of I is therefore a moving average of two
samples, which a recursion whitens exactly (`fitact.likelihood.noise.Whitening`). V between two samples is another such
noise: where V bends, I follows a line between them only to a part of its second difference.
"""

import numpy as np
import scipy
from jaxtyping import Float

from fitact.compiled import pad_samples, pad_weight
from fitact.data.record import Record
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import RowCovariance, estimate_current_noise
from fitact.likelihood.noise import Whitening
from fitact.likelihood.smooth_drive import smooth_drive
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Sampled
from fitact.problem.recorded_current import RecordedCurrent
from fitact.problem.runs import Rows


def estimate_drive(
    channel: ChannelLikelihood, white: Float[np.ndarray, " samples"], record: Record
) -> ChannelLikelihood:
    """Return the channel with the drive that is most probable for its `white` residuals.

    What remains of the noise of V there is independent of the residuals, which otherwise would bias the estimates.
    """
    current, whitening = RecordedCurrent.from_record(record), channel.samples.whitening
    assert whitening is not None
    gains, decays, gain = np.asarray(whitening.gain), np.asarray(whitening.decay), channel.electrical.noise_gain
    rise = estimate_current_noise(gains, decays, white, np.array([1.0, -1.0]))[: len(record)]
    rise = np.roll(rise, -round(float(channel.timing.shift / channel.timing.step)))
    smooth = current.V + np.asarray(gain) * current.variance_V / current.noise_I**2 * rise
    return channel.replace_observable(smooth=pad_samples(smooth))


def colour_noise(channel: ChannelLikelihood, terms: HighpassTerms, record: Record) -> ChannelLikelihood:
    """Return the channel of a current with the noise of a record's V and I as a circuit with these `terms` has it."""
    assert channel.electrical.smooth is not None
    current, size, step = RecordedCurrent.from_record(record), len(record), record.time_step
    steps, own, rounded = round(float(channel.timing.shift) / step), current.noise_I, current.rounded
    fastest = HighpassTerms(terms.weight[-1:], terms.tau[-1:])
    gain, decay = float(fastest.gain_in_step(step)), float(np.exp(-step / terms.tau[-1]))
    driven = gain**2 * np.roll(current.variance_V + interpolation_error(record) ** 2, steps)
    before = np.roll(driven, 1)
    excluded = channel.samples.weights[:size] == 0.0
    covariance = RowCovariance(
        own**2 * (1.0 + decay**2) + driven + before,
        -decay * own**2 - before,
        excluded | np.append(True, excluded[:-1]),
        np.roll(rounded.group, 1),
        (1.0 - decay) ** 2 * np.roll(rounded.variance * rounded.alike, 1),
    )
    recursion = (covariance.used * 1.0, *covariance.recursion(own))
    whitening = Whitening(np.array([1.0, -decay]), *map(pad_weight, recursion))
    smooth = np.asarray(channel.electrical.smooth)
    noise = np.roll(scipy.signal.lfilter([1.0, -1.0], [1.0, -decay], current.V - smooth[:size]), steps)
    drive = Sampled(channel.samples.time, smooth + pad_samples(noise))
    channel = channel.replace_samples(whitening=whitening, observed=pad_samples(current.I))
    return channel.replace_observable(drive=drive, noise_gain=np.asarray(gain))


def interpolation_error(record: Record, part: float = 0.1) -> Rows:
    """Return the error of a line between samples of V, V: a `part` of the largest second difference around each.

    The line through the ends of a parabola is off by 1/8 of it in the middle, and by 1/12 in the mean.
    """
    V = smooth_drive(record["V"], record.noise("V"))
    return part * scipy.ndimage.maximum_filter1d(np.abs(np.diff(V, 2, prepend=V[:1], append=V[-1:])), 3)
