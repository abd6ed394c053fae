"""Files of records, each read when it is asked for."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fitact.readers.read import read_any
from fitact.scene.scene import Scene
from fitact.tracking.tracked_finger import TrackedFinger


class RecordFiles(Sequence[Any]):
    """Records and spectra of a scene, each read on access with the `columns` (channels, scale, ...) of `fitact.read`.

    A folder stands for the track that `fitact track` left there, and so do its files.
    """

    def __init__(self, paths: Sequence[Path], scene: Scene | None, **columns: Any) -> None:
        self._paths, self._scene, self._columns = paths, scene, columns

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: Any) -> Any:
        path = self._paths[index]
        if path.is_dir() or path.name in ("track.parquet", "summary.json"):
            return TrackedFinger.from_folder(path)
        return read_any(path, self._scene, **self._columns)
