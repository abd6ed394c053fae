"""Limit of the threads of BLAS, which would otherwise compete with the threads of fitact for the cores."""

import contextlib
import threading
from collections.abc import Iterator

from threadpoolctl import threadpool_limits


class _BlasThreadLimit:
    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0

    @contextlib.contextmanager
    def limit_to_one(self) -> Iterator[None]:
        """Limit the whole process until the last of several simultaneous calls has ended."""
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._limits = threadpool_limits(1)
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0:
                    self._limits.restore_original_limits()


limit_to_one_thread = _BlasThreadLimit().limit_to_one
