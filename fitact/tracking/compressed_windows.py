"""Windows of a record, compressed: a fit to a first window in contact gives the model, which all others share."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from fitact.compiled import double_precision
from fitact.data.clipping import clipping_mask
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.fit import fit
from fitact.fitting.result import Fit
from fitact.likelihood.certificate import TOLERANCE, reason_against_table
from fitact.likelihood.compression import Compression
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.likelihood.window_compression import FilterState, MakeRows, TrendInputs, WindowCompressor
from fitact.model.circuit import passes_direct_current
from fitact.problem.recorded_current import Current, RecordedCurrent
from fitact.scene.scene import Scene
from fitact.tracking.windows import Window

NO_CONTACT = 0.1  # part of the usual signal below which the finger is not in contact


class WindowData(NamedTuple):
    """Each channel of a window, or of windows with a leading dimension, in its coordinates."""

    compressions: tuple[Compression, ...]
    trends: tuple[TrendInputs, ...]  # of each channel
    samples: Compression | None  # of the responses at all samples, if the first channel is not compressed in them


class CompressedWindow(NamedTuple):
    """A window's data, or None without data, and what is known of the contact."""

    start: float  # s
    data: WindowData | None
    lowest: float  # least and largest signal of the window's parts over that of the model's circuit; NaN without drive
    highest: float
    clipped: bool  # whether samples are excluded because they are clipped


@dataclasses.dataclass(frozen=True)
class CompressedWindows:
    """Windows of one length; values of windows without data are those of another and are not to be used."""

    start: Float[np.ndarray, " windows"]
    data: WindowData  # stacked
    has_data: Bool[np.ndarray, " windows"]
    contact: Bool[np.ndarray, " windows"]
    clipped: Bool[np.ndarray, " windows"]

    @classmethod
    def from_windows(cls, windows: Sequence[CompressedWindow]) -> "CompressedWindows":
        """Stack the windows, and decide where the finger is in contact with the panel for a whole window."""
        lowest, highest = (np.array([getattr(each, name) for each in windows]) for name in ("lowest", "highest"))
        known = np.isfinite(lowest)
        usual = float(np.median(highest[known & (highest > NO_CONTACT)])) if np.any(known) else 1.0
        contact = ~known | is_in_contact(lowest, highest, usual)
        has_data = np.array([each.data is not None for each in windows])
        start, clipped = (np.array([getattr(each, name) for each in windows]) for name in ("start", "clipped"))
        return cls(start, stack_data(windows), has_data & contact, contact, clipped)


class WindowResponses(NamedTuple):
    """A window with what its compression needs; without responses where it has lost samples or no drive."""

    window: Window
    drive: tuple[np.ndarray, np.ndarray] | None  # V as the channels respond to it; see `WindowCompressor.respond`
    responses: Float[np.ndarray, "nodes samples"] | None
    recorded: list[np.ndarray | MakeRows]  # of each channel
    weights: list[np.ndarray | None]  # of its samples, or None where all are 1
    has_charge: bool  # whether the charge at the start is unknown
    lowest: float  # as in CompressedWindow
    highest: float
    clipped: bool = False


class WindowModel(NamedTuple):
    """Model of all windows, from a fit to one of them."""

    fit: Fit
    likelihood: Likelihood  # with the noise of V that its circuit has
    compressor: WindowCompressor
    parts: int  # parts of a window in which the signal is compared
    drive_rms: float  # V
    current: tuple[RecordedCurrent, Current] | None  # noise of the fitted V and I, and the modelled current
    time_constants: Float[np.ndarray, " taus"]  # s

    def respond(self, windows: Iterable[Window]) -> Iterator[WindowResponses]:
        """Yield the responses to the V of windows; none in one with lost samples or no drive.

        Responses go on from window to window, so that the charge at the start is known, where the finger touched all
        the time.
        """
        step = float(self.compressor.time[1])
        settled = 12.0 * float(np.max(self.time_constants))  # an unknown charge has decayed to 6e-6
        least_rms = 1e-3 * self.drive_rms  # of V
        state: FilterState | None = None
        for window in windows:
            V = window.channels["V"]
            if not window.is_whole or float(np.std(V)) < least_rms:
                state = None
                yield WindowResponses(window, None, None, [], [], False, math.nan, math.nan)
                continue
            if state is not None and abs(window.start - state.end) > 0.5 * step:
                state = None
            has_charge = state is None or state.age < settled
            drive, responses, state = self.compressor.respond(V, window.start, state)
            channels = self.likelihood.channels
            samples = [window.channels[channel.channel] for channel in channels]
            clipped = [clipping_mask(values) for values in samples]
            weights = [np.where(each, 0.0, 1.0) if each.any() else None for each in clipped]
            lowest, highest = self._compare_signal(samples[0], self.compressor.expect(V, responses), weights[0])
            pairs = zip(channels, samples, strict=True)
            recorded = [values if each.samples.charges is None else self._make_rows(window) for each, values in pairs]
            if not is_in_contact(lowest, highest):
                state = None
            is_clipped = any(each is not None for each in weights)
            rest = recorded, weights, has_charge, lowest, highest, is_clipped
            yield WindowResponses(window, drive, responses, *rest)

    def compress(self, given: WindowResponses) -> CompressedWindow:
        """Compress a window; one without responses has no data."""
        data = None
        if given.drive is not None and given.responses is not None:
            V, driven = given.window.channels["V"], (given.drive, given.responses)
            channels = given.recorded, given.weights
            data = WindowData(*self.compressor.compress(V, *channels, *driven, given.has_charge))
        return CompressedWindow(given.window.start, data, given.lowest, given.highest, given.clipped)

    def _make_rows(self, window: Window) -> MakeRows:
        """Return the function that makes the rows of charge of a window."""
        assert self.current is not None
        current, modelled = self.current
        recorded, blocks = current.continue_with(window.channels["V"], window.channels["I"]), max(2000, 16 * self.parts)
        return functools.partial(recorded.fit_rows, modelled, blocks)

    def _compare_signal(
        self, observed: np.ndarray, expected: np.ndarray, weight: np.ndarray | None
    ) -> tuple[float, float]:
        """Return the least and largest signal of a window's parts over the expected one."""
        weighted = expected if weight is None else expected * (weight > 0.0)
        products = np.array_split(np.stack([observed * weighted, expected * weighted]), self.parts, axis=1)
        sizes = np.array([part.sum(axis=1) for part in products])
        driven = sizes[:, 1] > 1e-2 * sizes[:, 1].max()
        signal = sizes[driven, 0] / sizes[driven, 1]
        return float(signal.min()), float(signal.max())


def is_in_contact(lowest: Any, highest: Any, usual: float = 1.0, min_ratio: float = 0.5) -> Any:
    """Return whether the finger touches for a whole window, from its signal over the expected and the usual one.

    If the least signal of its parts is below `min_ratio` of the largest, contact was made or lost within it.
    """
    return (lowest > NO_CONTACT * usual) & (lowest > min_ratio * highest)


def stack_data(windows: Sequence[CompressedWindow]) -> WindowData:
    """Return the data of windows with a leading dimension; a window without data has those of another."""
    filled = next(each.data for each in windows if each.data is not None)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(each.data or filled for each in windows))


def find_model(windows: Sequence[Window], scene: Scene, step: float, source: str) -> WindowModel:
    """Fit the window whose Vsc (or I) is nearest to the upper quartile over V, and make the tables of its model.

    Raises:
        InputError: no window can be fitted, or the drive does not repeat.
    """
    channels = scene.measurement.channels
    whole = [each for each in windows if each.is_whole and np.ptp(each.channels["V"]) > 0.0]
    if not whole:
        raise InputError(f"{source}: there is no window with a drive and all samples; record V_V beside {channels[0]}")
    ratio = np.array([np.std(each.channels[channels[0]]) / np.std(each.channels["V"]) for each in whole])
    order = np.argsort(np.abs(ratio - np.quantile(ratio, 0.75)))
    first = whole[int(order[0])]
    time = step * np.arange(first.channels["V"].size)
    record = Record.from_arrays(time, **first.channels, source=source)  # type: ignore[arg-type]
    if not np.std(record[channels[0]]) > 3.0 * record.noise(channels[0]):
        raise InputError(
            f"{source}: {channels[0]} shows no signal above its noise in any window; check its column and its unit"
        )
    frequency = record.frequency()
    if frequency is None:
        raise InputError(
            f"{source}: a window of {time[-1] + step:.4g} s holds less than 1.5 periods of V_V; give a longer one, as"
            f" --window {10.0 * time[-1]:.2g}s, and a drive that repeats"
        )
    fitted = fit(record, scene)
    with double_precision():
        circuit = fitted.likelihood.evaluate_circuit(fitted.theta)
        likelihood, noise_V = _set_noise_gains(fitted.likelihood, circuit), record.noise("V")
        late = fitted.likelihood.to_physical(fitted.theta).get("delay", 0.0) / step
        compressor = WindowCompressor.from_channels(
            likelihood.channels, circuit, time.size, step, noise_V, record.tones, float(late)
        )
    parts = max(1, math.floor((time[-1] + step) * frequency))
    current = _describe_current(fitted, record, circuit)
    return WindowModel(fitted, likelihood, compressor, parts, float(np.std(first.channels["V"])), current, circuit.tau)


def _set_noise_gains(likelihood: Likelihood, circuit: CircuitValues) -> Likelihood:
    """Return the likelihood in which the noise of V has the gain of the fitted circuit, and not of the fit's start."""
    for i, channel in enumerate(likelihood.channels):
        if channel.shifts_response:
            likelihood = likelihood.replace_channel(i, channel.set_noise_gain(circuit.terms[channel.channel]))
    return likelihood


def _describe_current(fitted: Fit, record: Record, circuit: CircuitValues) -> tuple[RecordedCurrent, Current] | None:
    """Return the noise of a record's V and I, and what is modelled of I; None without I."""
    for channel in fitted.likelihood.channels:
        if channel.samples.charges is not None:
            inputs = fitted.likelihood.make_inputs(circuit.circuit, fitted.theta, channel)
            return RecordedCurrent.from_record(record), Current.from_channel(channel, inputs)
    return None


def require_compressible(scene: Scene, source: str) -> None:
    """Refuse a scene whose model windows of a few numbers do not represent."""
    noise, level = scene.measurement.noise_model, scene.skin.level
    reasons = {
        "has no leak of the insulator; leave [device] Ri and [prior] Ri out of the scene": (
            passes_direct_current(scene.make_rc_circuit()) or "Ri" in scene.prior.specs()
        ),
        "does not use the friction; leave 'Ft' out of [measurement] channels": "Ft" in scene.measurement.channels,
        f"has no [measurement] noise_model = '{noise}'; state 'white' or 'ar1'": noise not in ("white", "ar1"),
        f"has no [skin] level = '{level}'; state 'constant'": level != "constant",
    }
    if reason := next((reason for reason, applies in reasons.items() if applies), ""):
        raise InputError(f"{source}: a track {reason}, or fit each part of the record on its own")


def require_table(model: WindowModel, source: str) -> None:
    """Refuse a circuit whose responses have no table, so that windows cannot be compressed."""
    likelihood = model.likelihood
    circuit = likelihood.evaluate_circuit(model.fit.theta)
    reasons = [reason_against_table(each, circuit, TOLERANCE) for each in likelihood.channels]
    if any(each.samples.charges is None and each.samples.has_drive_noise for each in likelihood.channels):
        reasons.append("the noise of V in I has a spectrum of its own")
    if len({each.count_untabulated(circuit.tau) for each in likelihood.channels}) > 1:
        reasons.append("a time constant is far below the time step, and the delay of Vsc is not a free parameter")
    if reason := next(filter(None, reasons), ""):
        raise InputError(
            f"{source}: windows cannot be represented by a few numbers, because {reason}; leave out a small resistance"
            " in series (R_H; `fitact plan` states its effect), or give longer windows (--window)"
        )
