"""Source of a channel of a fit: its record or spectrum, scene and drive."""

from typing import NamedTuple

from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.problem.drive_choice import DriveModel
from fitact.problem.starting_point import Estimate
from fitact.scene.scene import Scene


class Source(NamedTuple):
    """Record or spectrum, scene and drive of a channel, with estimates made before the fit."""

    record: Record | Spectrum
    scene: Scene
    choice: DriveModel
    noise: float  # model-free standard deviation of the channel
    optional_nuisances: tuple[str, ...]  # nuisances that the BIC may select
    start: Estimate | None  # estimate from a linear fit, or None
    notes: tuple[str, ...]  # sentences for information
    warnings: tuple[str, ...]  # sentences on what may change the result

    @property
    def in_time(self) -> Record:
        """The record; InputError for a spectrum."""
        return require_record(self.record)


def require_record(record: Record | Spectrum) -> Record:
    """Return a record in time; InputError for a spectrum."""
    if isinstance(record, Spectrum):
        raise InputError(f"{record.source}: is a spectrum, and this needs a record in time; use fitact fit or run")
    return record
