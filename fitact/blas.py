"""Limit of the threads of BLAS, which would otherwise compete with each other, and with those of fitact, for the cores.

The matrices are small: the eigenvalues of 44 functions take 0.13 ms with one thread, and 30 to 80 ms with two of which
one waits for a core that another process has.
"""

import contextlib
import functools
import sys
import threading
from collections.abc import Iterator

from threadpoolctl import ThreadpoolController


class _BlasThreadLimit:
    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0

    @contextlib.contextmanager
    def limit_to_one(self) -> Iterator[None]:
        """Limit the whole process until the last of several simultaneous calls has ended."""
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._limits = _find_libraries("scipy.linalg" in sys.modules).limit(limits=1)
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0:
                    self._limits.restore_original_limits()


@functools.cache
def _find_libraries(has_scipy: bool) -> ThreadpoolController:
    """Return the loaded libraries, which takes milliseconds; SciPy has a BLAS of its own, and is imported late."""
    return ThreadpoolController()


limit_to_one_thread = _BlasThreadLimit().limit_to_one
