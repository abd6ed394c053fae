"""Which measurement would tell most: the options a user has, and the errors to expect of each."""

from collections.abc import Sequence
from typing import Any

from fitact.data.record import Record
from fitact.model.scene import Scene


def design_measurement(scene: Scene, records: Sequence[Record] = ()) -> Any:
    """The measurement as it stands, and what would tell more of the mean force."""
    raise NotImplementedError
