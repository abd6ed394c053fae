"""Time axis from a stated sampling rate, for times that were rounded when they were written."""

import dataclasses
import math

import numpy as np

from fitact.data.readers.capture import Capture
from fitact.data.record import is_rounded_grid
from fitact.errors import InputError
from fitact.units import format_engineering


def replace_rounded_times(capture: Capture, rate: float | None, scene_rate: float | None = None) -> Capture:
    """Return the capture with uniform times if they were rounded and a sampling rate (Hz) is stated.

    `rate` must agree with the times. `scene_rate` also serves simulations and designs; where it contradicts times that
    increase, these are used, with a warning.
    """
    exact = 1e-6  # deviation in steps up to which times stay as they are
    if rate is not None and not 0.0 < rate < math.inf:
        raise InputError(f"rate = {rate:g} Hz is no sampling rate; give a positive number of Hz")
    time, stated = capture.time, scene_rate if rate is None else rate
    if stated is None or time.size < 4 or not np.all(np.isfinite(time)):
        return capture
    grid = time[0] + np.arange(time.size) / stated
    deviation = float(np.max(np.abs(time - grid)))
    if deviation * stated <= exact:
        return capture
    shown, off = format_engineering(stated, "Hz"), format_engineering(deviation, "s", 3)
    if is_rounded_grid(time, 1.0 / stated):
        note = f"{capture.source}: uniform times by the stated sampling rate {shown} replace the file's (off by {off})"
        return dataclasses.replace(capture, time=grid, notes=(*capture.notes, note))
    key = "[measurement] sampling_rate" if rate is None else "rate"
    span = f"{time.size:,} samples in {format_engineering(float(time[-1] - time[0]), 's')}"
    sentence = f"{capture.source}: {key} = {shown} contradicts the times in the file ({span}) by up to {off}"
    if rate is None and np.all(np.diff(time) > 0.0):
        warning = f"{sentence}, more than rounding can explain; the times in the file are used"
        return dataclasses.replace(capture, warnings=(*capture.warnings, warning))
    raise InputError(f"{sentence}, more than rounding can explain; state the rate of this file, or correct its times")
