"""A tracked finger as a population takes it: from a track, or from the folder that `fitact track` left."""

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.readers.read import read
from fitact.tracking.time_average import TimeAverage
from fitact.tracking.track import Track

SUMMARY, WINDOW = "summary.json", "window.csv"


class TrackedFinger(NamedTuple):
    """Part of a track that a population needs."""

    source: str  # name of the record, or of the folder
    average: TimeAverage
    time_scale: float  # after which the autocorrelation of the mean force has fallen to 1/e, s
    window: Record  # the window that was fitted
    message: str  # what speaks against the track; "" means nothing

    @property
    def fingerprint(self) -> str:
        """Hash of the numbers."""
        return hashlib.sha256(json.dumps(self.average.to_dict()).encode()).hexdigest()

    @classmethod
    def from_track(cls, track: Track) -> "TrackedFinger":
        """Take what a population needs.

        Raises:
            InputError: the track has no time average of Rsc, Csc and Ci.
        """
        if track.average is None:
            raise InputError(
                f"{track.fit.record.source}: the track has no averages of Rsc, Csc and Ci over time; leave all three"
                " free in the scene, and record three windows or more"
            )
        time_scale = _time_scale(track.within_finger)
        message = "" if track.trusted else track.fit.message
        return cls(track.fit.record.source, track.average, time_scale, track.fit.record, message)

    @classmethod
    def from_folder(cls, path: str | os.PathLike[str]) -> "TrackedFinger":
        """Read the folder of a track, or the folder of one of its files.

        Raises:
            InputError: the folder holds no complete track.
        """
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        try:
            content = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
            average = TimeAverage.from_dict(content["time_average"])
            time_scale = _time_scale(content["within_finger"])
            message = "" if content["trusted"] else f"{content['fit']['result']}: see the track's page"
            return cls(folder.name, average, time_scale, read(folder / WINDOW), message)
        except (OSError, ValueError, TypeError, KeyError) as error:
            missing = isinstance(error, FileNotFoundError) and error.filename
            reason = f"{Path(missing).name} is missing" if missing else repr(error)
            raise InputError(
                f"{folder}: holds no complete track of Rsc, Csc and Ci ({reason}); make it with: fitact track RECORD"
                f" --out {folder}"
            ) from error


def _time_scale(within: Mapping[str, Mapping[str, float | None]]) -> float:
    """Return the time scale of the force, s; of the area or b if windows have clipped samples and thus no force."""
    scales = (within.get(name, {}).get("time_scale_s") for name in ("force_mean", "contact_area", "b"))
    return next((float(scale) for scale in scales if scale is not None and math.isfinite(scale)), math.nan)
