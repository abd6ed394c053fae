"""Compilation by JAX: few shapes for all records and batches, numbers as arrays, and a persistent cache.

JAX compiles code for each array length. Records are therefore padded to one of a few lengths by repeating the last
sample with weight 0. Times then never decrease, a drive keeps its last value, and the ends, the minimum and the
maximum of a record do not change. Batches are padded to one size.
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

MAX_PADDED_LENGTH = 1_048_576  # samples; a fit of more takes longer than the compilation


def padded_length(samples: int, per_octave: int = 8, min_step: int = 64) -> int:
    """Return the length to which a record of `samples` is padded.

    Lengths differ by at least `min_step` samples, since a few more cost nothing in a short record, and otherwise by at
    most the fraction 1 / `per_octave`.
    """
    if samples > MAX_PADDED_LENGTH:
        return samples
    step = max((1 << (samples - 1).bit_length()) // (2 * per_octave), min_step)
    return -(-samples // step) * step


def pad_samples(
    values: np.ndarray, samples: int | None = None, mode: Literal["edge", "constant"] = "edge"
) -> np.ndarray:
    """Return values padded along the samples by the last one; `samples` is the length of the whole record."""
    missing = padded_length(samples or values.shape[-1]) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)], mode=mode) if missing else values


def pad_weight(weight: np.ndarray, samples: int | None = None) -> np.ndarray:
    """Return the weights of samples, padded with 0."""
    return pad_samples(weight, samples, mode="constant")


def pad_rows(values: np.ndarray, size: int, axis: int = 0) -> np.ndarray:
    """Return rows padded to an integer number of batches of `size` by repeating the last."""
    missing = -values.shape[axis] % size
    if not missing:
        return values
    return np.concatenate([values, np.repeat(np.take(values, [-1], axis), missing, axis)], axis)


def as_arrays(module: _Module) -> _Module:
    """Return the module with its numbers as arrays, so that all modules of its type share compiled code."""
    with jax.enable_x64(True):
        return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, module)


def to_device(values: Float[np.ndarray, " samples"]) -> Float[Array, " samples"]:
    """Return the samples of a record as a JAX array, without a copy if possible."""
    with jax.enable_x64(True):
        return jax.device_put(values, may_alias=True)


class BatchEvaluator:
    """Evaluation of `function(model, *rows)` over the rows of arrays of equal length, in batches.

    Batches are padded to one size, so that they compile once. The size is limited such that size x `rows` (numbers per
    evaluation) does not exceed `max_numbers`, which bounds the memory. The model is partitioned for jit only once,
    since a call may take less time than that. Double precision is required.
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
        """Return the values of the rows; a `description` shows the progress."""
        count, batch = len(arrays[0]), self._batch
        arrays = tuple(pad_rows(a, batch) for a in arrays)
        starts = range(0, count, batch)
        parts = [
            np.asarray(_evaluate(self._static, self._dynamic, tuple(a[i : i + batch] for a in arrays)))
            for i in (track_progress(starts, description, len(starts)) if description else starts)
        ]
        return (parts[0] if len(parts) == 1 else np.concatenate(parts))[:count]

    def map_over(self, shape: tuple[int, ...], *arrays: np.ndarray) -> np.ndarray:
        """Return the values of rows that are arranged in `shape`, in this shape."""
        values = self(*(a.reshape(-1, *a.shape[len(shape) :]) for a in arrays))
        return values.reshape(*shape, *values.shape[1:])


class _StaticModel:
    """A function and a model without its arrays; equal if their compiled code is the same."""

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
    """Store code compiled by JAX, in this process and its children, in a cache folder of the user.

    Nothing happens if the folder is not writable, or if an environment variable already names a cache.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = root / "fitact" / f"jax-{jax.__version__}-{platform.node()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home folder, or not writable
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # many small functions add up to a second
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
