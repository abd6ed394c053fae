"""How JAX compiles: few shapes for all records and batches, numbers as arrays, and a cache that outlives a process.

JAX compiles for every length anew. So records are filled up to one of a few lengths: the last sample is repeated, with
a weight of 0, so that times still never decrease, a drive stays where it ended, and the ends, the least and the largest
of a record remain its own. Batches are filled up to one size.
"""

import functools
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.progress import track_progress

_Module = TypeVar("_Module", bound=eqx.Module)

MAX_PADDED_LENGTH = 1_048_576  # samples, above which a fit takes longer than compiling


def padded_length(samples: int, per_octave: int = 8, min_step: int = 64) -> int:
    """Return the length that a record of so many samples is filled up to.

    Lengths lie a `per_octave`-th apart at most, which is the most that is added, and `min_step` samples at least, since
    some more cost nothing in a short record.
    """
    if samples > MAX_PADDED_LENGTH:
        return samples
    step = max((1 << (samples - 1).bit_length()) // (2 * per_octave), min_step)
    return -(-samples // step) * step


def pad_samples(
    values: np.ndarray, samples: int | None = None, mode: Literal["edge", "constant"] = "edge"
) -> np.ndarray:
    """Return one value a sample, the last one repeated; `samples`: how many the record has of which these are the first."""
    missing = padded_length(samples or values.shape[-1]) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)], mode=mode) if missing else values


def pad_weight(weight: np.ndarray, samples: int | None = None) -> np.ndarray:
    """Return the weights of samples, with 0 for what is added."""
    return pad_samples(weight, samples, mode="constant")


def pad_rows(values: np.ndarray, size: int, axis: int = 0) -> np.ndarray:
    """Return rows filled up to a whole number of batches of `size`, by repeats of the last."""
    missing = -values.shape[axis] % size
    if not missing:
        return values
    return np.concatenate([values, np.repeat(np.take(values, [-1], axis), missing, axis)], axis)


def as_arrays(module: _Module) -> _Module:
    """Return the module with its numbers as arrays, so that what is compiled for one serves all others of its kind."""
    with jax.enable_x64(True):
        return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, module)


def to_device(values: Float[np.ndarray, " samples"]) -> Float[Array, " samples"]:
    """Return a record's samples for JAX, in the memory that they are in."""
    with jax.enable_x64(True):
        return jax.device_put(values, may_alias=True)


class BatchEvaluator:
    """`function(model, *rows)` over the rows of arrays of one length, a batch at a time.

    Batches have one size, filled up where rows are missing, so that they compile once; it shrinks where `rows`,
    the numbers that one evaluation runs over, are many, so that a batch runs over no more than `max_numbers`, which
    bounds memory. What jit needs of the model is sorted out here once, since a call may take less time than that. Call
    it in double precision.
    """

    def __init__(
        self,
        function: Callable[..., Array],
        model: eqx.Module,
        rows: int,
        batch: int = 32,
        max_numbers: int = 4_000_000,
    ) -> None:
        dynamic, static = eqx.partition(model, eqx.is_array)
        self._dynamic, treedef = jax.tree.flatten(dynamic)
        self._static = _StaticModel(function, static, treedef)
        self._batch = max(1, min(batch, max_numbers // rows))

    def __call__(self, *arrays: np.ndarray, description: str = "") -> np.ndarray:
        """Return the values of the rows; with a `description`, progress is shown under it."""
        count, batch = len(arrays[0]), self._batch
        arrays = tuple(pad_rows(a, batch) for a in arrays)
        starts = range(0, count, batch)
        parts = [
            np.asarray(_evaluate(self._static, self._dynamic, tuple(a[i : i + batch] for a in arrays)))
            for i in (track_progress(starts, description, len(starts)) if description else starts)
        ]
        return (parts[0] if len(parts) == 1 else np.concatenate(parts))[:count]

    def map_over(self, shape: tuple[int, ...], *arrays: np.ndarray) -> np.ndarray:
        """Return the values of rows that stand in a `shape`, in that shape."""
        values = self(*(a.reshape(-1, *a.shape[len(shape) :]) for a in arrays))
        return values.reshape(*shape, *values.shape[1:])


class _StaticModel:
    """A function, and a model but for its arrays; equal where their compiled forms are."""

    def __init__(self, function: Callable[..., Array], model: eqx.Module, arrays: Any) -> None:
        self.function, self.model, self.arrays = function, model, arrays
        leaves, treedef = jax.tree.flatten(model)
        self._key = (function, arrays, tuple(leaves), treedef)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, _StaticModel) and self._key == other._key)


@functools.partial(jax.jit, static_argnums=0)
def _evaluate(static: _StaticModel, dynamic: list[Array], rows: tuple[Array, ...]) -> Array:
    model = eqx.combine(jax.tree.unflatten(static.arrays, dynamic), static.model)
    return jax.vmap(lambda *row: static.function(model, *row))(*rows)


def use_compilation_cache() -> None:
    """Keep what JAX compiles between calls, of this process and its children, in the user's cache.

    A place that cannot be written is passed over, and an environment that names a cache of its own is left alone.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = root / "fitact" / f"jax-{jax.__version__}-{platform.node()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or one that cannot be written
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # the many small ones take a second
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
