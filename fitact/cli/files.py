"""Records that a command was given, each read when it is asked for."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fitact.cli.options import Columns, mapping

if TYPE_CHECKING:
    from fitact.data.record import Record
    from fitact.scene.scene import Scene


class Files(Sequence["Record"]):
    """Records of one scene, with what --channel and --scale say of their columns."""

    def __init__(self, paths: Sequence[Path] | None, scene: "Scene | None", columns: Columns) -> None:
        self._paths, self._scene, self._columns = paths or (), scene, mapping(columns)

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: Any) -> Any:
        from fitact.data.readers.read import read

        return read(self._paths[index], self._scene, **self._columns)
