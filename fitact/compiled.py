"""Compilation by JAX: programs for many records, kept on disk; few shapes, numbers as arguments.

A function that `jit` decorates takes and returns NumPy arrays. It is compiled once for each structure of its arguments:
classes, shapes of arrays, and values of all else. Programs are stored with `fitact.program_cache`, so that another
process neither traces nor compiles them.

JAX compiles code for each array length. Records are therefore padded to one of a few lengths by repeating the last
sample with weight 0. Times then never decrease, a drive keeps its last value, and the ends, the minimum and the
maximum of a record do not change. Batches are padded to one size.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import math
import os
import pickle
import platform
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.typing import ArrayLike
from jaxtyping import Array

from fitact import program_cache
from fitact.errors import InputError
from fitact.progress import track_progress

_Module = TypeVar("_Module", bound=eqx.Module)
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

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


def pad_rows(values: np.ndarray, size: int) -> np.ndarray:
    """Return rows padded to an integer number of batches of `size` by repeating the last."""
    missing = -len(values) % size
    return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)]) if missing else values


def empty_aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Return an array in double precision, aligned to 64 bytes so that JAX can use it without a copy."""
    size = math.prod(shape)
    memory = np.empty(size + 8)
    first = -memory.ctypes.data % 64 // 8
    return memory[first : first + size].reshape(shape)


def as_arrays(module: _Module) -> _Module:
    """Return the module with its numbers as arrays in double precision, with which NumPy computes outside `jit`."""
    return jax.tree.map(lambda x: np.asarray(x, dtype=float) if isinstance(x, float | jax.Array) else x, module)


def array_module(values: Any) -> Any:
    """Return `jax.numpy` for JAX's arrays, which compiled functions see, and NumPy for all else."""
    return jnp if isinstance(values, jax.Array) else np


def is_array(leaf: Any) -> bool:
    """Return whether a leaf of the arguments of `jit` is an argument of the program."""
    return isinstance(leaf, np.ndarray | jax.Array | np.generic)


@functools.cache
def find_device() -> jax.Device:
    """Return the device on which fitact computes: the first CPU, or that of the environment variable FITACT_DEVICE.

    Its value is a platform of JAX, with a number where there are several devices: "gpu", "gpu:1".

    Raises:
        InputError: JAX finds no such device.
    """
    wanted = os.environ.get("FITACT_DEVICE", "")
    platform, _, number = (wanted or "cpu").partition(":")
    try:
        return jax.devices(platform)[int(number or 0)]
    except (RuntimeError, ValueError, IndexError):
        if not wanted:
            return jax.devices()[0]  # JAX_PLATFORMS leaves out the CPU
        found = ", ".join(f"{each.platform}:{each.id}" for each in jax.devices())
        raise InputError(f"FITACT_DEVICE = {wanted}: JAX finds {found} only; give one of these") from None


@contextlib.contextmanager
def double_precision() -> Iterator[None]:
    """Compute in double precision, on the device of fitact, with the block or the function that is decorated."""
    with jax.enable_x64(True), jax.default_device(find_device()):
        yield


def jit(
    function: Callable[_Arguments, _Result], *, fast: bool = False, double: bool = True
) -> Callable[_Arguments, _Result]:
    """Return a function that runs `function` as a compiled program, on NumPy arrays.

    Without `fast`, the program compiles faster and takes up to five times as long: for what takes milliseconds.
    It computes in double precision or, without `double`, in the current precision of JAX. Arrays are arguments of the
    program; all else in the arguments, Python's floats included, is static. Within another traced function, `function`
    itself is traced.
    """

    @functools.wraps(function)
    def run(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Any:
        leaves, structure = jax.tree.flatten((args, kwargs))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return function(*args, **kwargs)
        x64 = double or bool(jax.config.jax_enable_x64)
        with jax.enable_x64(x64):
            program = _find_program(function, fast, x64, structure, _signature(leaves))
            return program(*map(_as_argument, filter(is_array, leaves)))

    return run


# Decorator of small functions: a call outside a program is one program for each shape, and not one for each operation;
# within a program, each is traced once, and XLA sees its operations as if it were not decorated.
jit_inline = functools.partial(jax.jit, inline=True)


def solve_lower(factor: ArrayLike, values: Array, *, transposed: bool = False) -> Array:
    """Return the solution of a lower triangular system; `jax.scipy.linalg` takes 0.05 s to import."""
    columns = values if values.ndim > 1 else values[:, None]
    root = jnp.asarray(factor, dtype=values.dtype)
    solution = lax.linalg.triangular_solve(root, columns, left_side=True, lower=True, transpose_a=transposed)
    return solution.reshape(values.shape)


class _Program(NamedTuple):
    """An executable on flat lists of arrays."""

    execute: Callable[..., list[Array]]
    result: Any  # structure of the result

    def __call__(self, *arrays: np.ndarray | Array) -> Any:
        return jax.tree.unflatten(self.result, [np.asarray(x) for x in self.execute(*arrays)])


class _Shape(NamedTuple):
    """Shape and type of an array among the arguments."""

    shape: tuple[int, ...]
    dtype: np.dtype


class _Static(NamedTuple):
    """A value among the arguments for which a program is compiled; the class keeps True and 1 apart."""

    kind: type
    value: Any


def _as_argument(leaf: Any) -> np.ndarray | Array:
    is_there = isinstance(leaf, np.ndarray) or (isinstance(leaf, jax.Array) and leaf.devices() == {find_device()})
    return leaf if is_there else np.asarray(leaf)


def _signature(leaves: Sequence[Any]) -> tuple[_Shape | _Static, ...]:
    return tuple(_Shape(leaf.shape, leaf.dtype) if is_array(leaf) else _Static(type(leaf), leaf) for leaf in leaves)


_SHARING = threading.Lock()


def _find_program(*called: Any) -> _Program:
    """Return the program of `_make_program`, which the first thread to need it makes while others wait."""
    with _SHARING:  # or `lru_cache` could return two for the same arguments
        lock, made = _share_program(*called)
    with lock:
        if not made:
            made.append(_make_program(*called))
        return made[0]


@functools.lru_cache(maxsize=2048)
def _share_program(*_: Any) -> tuple[threading.Lock, list[_Program]]:
    return threading.Lock(), []


def _make_program(
    function: Callable[..., Any], fast: bool, x64: bool, structure: Any, signature: tuple[_Shape | _Static, ...]
) -> _Program:
    """Load the program from the disk, or compile it and store it there; `x64` is the current setting of JAX."""
    if find_device().platform != "cpu":
        return _compile(function, fast, structure, signature)[0]
    try:
        described = _describe(function), _describe(jax.tree.unflatten(structure, signature))
    except _NotStorableError:
        return _compile(function, fast, structure, signature)[0]
    parts = _environment(), os.environ.get("XLA_FLAGS", ""), str(fast), str(x64), *described
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    content = program_cache.load(key)
    if content is not None:
        try:
            return _load_program(content)
        except _LOAD_ERRORS:  # a whole file in which there is no program; it is compiled again
            program_cache.remove(key)
    program, compiled = _compile(function, fast, structure, signature)
    if program_cache.cache_folder() is not None:
        try:
            executable, *_ = serialize_executable.serialize(compiled)
            skeleton = jax.tree.unflatten(program.result, range(program.result.num_leaves))
            program_cache.store(key, pickle.dumps((executable, compiled.in_tree.num_leaves, skeleton)))
        except (NotImplementedError, ValueError, TypeError, AttributeError, pickle.PicklingError):  # not serialisable
            pass
    return program


# what reading a pickle may raise, by its documentation, and RuntimeError by XLA
_LOAD_ERRORS = (
    pickle.UnpicklingError, AttributeError, EOFError, ImportError, IndexError, KeyError, TypeError, ValueError,
    RuntimeError,
)  # fmt: skip


def _load_program(content: bytes) -> _Program:
    executable, n_arguments, skeleton = pickle.loads(content)
    _initialize_lapack()
    result = jax.tree.structure(skeleton)
    trees = jax.tree.structure(((0,) * n_arguments, {})), jax.tree.structure([0] * result.num_leaves)
    device = find_device()
    loaded = serialize_executable.deserialize_and_load(executable, *trees, device.client, [device])
    return _Program(loaded, result)


@functools.cache
def _initialize_lapack() -> None:
    """Load LAPACK, without which a deserialised program that calls it crashes."""
    import jaxlib.lapack

    jaxlib.lapack.prepare_lapack_call("potrf", np.dtype(float))


def _compile(
    function: Callable[..., Any], fast: bool, structure: Any, signature: tuple[_Shape | _Static, ...]
) -> tuple[_Program, Any]:
    result = None

    def run_flat(*arrays: Array) -> list[Any]:
        nonlocal result
        given = iter(arrays)
        leaves = [next(given) if isinstance(each, _Shape) else each.value for each in signature]
        args, kwargs = jax.tree.unflatten(structure, leaves)
        outputs, result = jax.tree.flatten(function(*args, **kwargs))
        return outputs

    run_flat.__name__ = run_flat.__qualname__ = function.__name__
    shapes = [jax.ShapeDtypeStruct(*each) for each in signature if isinstance(each, _Shape)]
    options = XLA_OPTIONS | ({} if fast else _FAST_COMPILATION) if find_device().platform == "cpu" else None
    with _outside_users_cache(), jax.default_device(find_device()):
        lowered = jax.jit(run_flat).lower(*shapes)
        try:
            compiled = lowered.compile(compiler_options=options)
        except jax.errors.JaxRuntimeError:  # a version of XLA without these options
            compiled = lowered.compile()
    return _Program(compiled, result), compiled


# Options of XLA for the CPU. Without its newer way to compile loops, programs compile in half the time and run as fast;
# later versions have only that way.
XLA_OPTIONS: dict[str, Any] = {"xla_cpu_parallel_codegen_split_count": 1}
if jax.__version_info__ < (0, 11):
    XLA_OPTIONS |= {"xla_cpu_use_fusion_emitters": False}
_FAST_COMPILATION = {"xla_backend_optimization_level": 0}


@contextlib.contextmanager
def _outside_users_cache() -> Iterator[None]:
    """Keep JAX's own persistent cache, which belongs to the user, from what is compiled in this context.

    JAX decides only once whether its cache is used, so it must decide anew before, and after for the user's programs.
    """
    compilation_cache.reset_cache()
    try:
        with jax._src.config.enable_compilation_cache(False):
            yield
    finally:
        compilation_cache.reset_cache()


_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "optimistix", "lineax")  # on whose versions a program depends


class _NotStorableError(Exception):
    """An argument or function cannot be described for another process."""


def _describe(value: Any) -> str:
    """Return a text that is equal in two processes only if programs for these arguments are."""
    if isinstance(value, _Shape):
        return f"{value.dtype}{value.shape}"
    if isinstance(value, _Static):
        return _describe(value.value)
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)
    if hasattr(value, "__qualname__"):  # a class or a function
        return _describe_name(value)
    name = _describe_name(type(value))
    if isinstance(value, dict):
        parts = [f"{key!r}:{_describe(item)}" for key, item in value.items()]
    elif isinstance(value, tuple | list):
        parts = list(map(_describe, value))
    elif isinstance(value, eqx.Module):
        parts = [_describe(getattr(value, name)) for name in value.__dataclass_fields__]
    else:
        raise _NotStorableError
    return f"{name}({','.join(parts)})"


def _describe_name(named: Any) -> str:
    """Return the full name of a class or function whose source is part of `_environment`."""
    module, name = named.__module__, named.__qualname__
    if module.partition(".")[0] not in ("fitact", "builtins", "functools", *_LIBRARIES):
        raise _NotStorableError
    found: Any = sys.modules[module]
    for part in name.split("."):
        found = getattr(found, part, None)
    if named not in (found, getattr(found, "__wrapped__", None)):  # a closure, or another function with this name
        raise _NotStorableError
    return f"{module}.{name}"


@functools.cache
def _environment() -> str:
    """Return what programs depend on besides their arguments: sources, versions, platform and processor."""
    sources = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        sources.update(str(path.relative_to(root)).encode() + path.read_bytes())
    versions = [sys.version, *map(importlib.metadata.version, _LIBRARIES)]
    matmul = str(jax.config.jax_default_matmul_precision)
    return "\0".join([sources.hexdigest(), *versions, platform.system(), platform.machine(), matmul, processor()])


def processor() -> str:
    """Return lines on the processor with its features, since a program may use instructions that another lacks."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            lines = file.read(16384).partition("\n\n")[0].splitlines()
    except OSError:
        return platform.processor() + platform.machine()
    kept = ("vendor", "cpu family", "model", "stepping", "flags", "features", "cpu part", "cpu variant", "isa")
    return "\n".join(line for line in lines if line.lower().startswith(kept))


def available_cores() -> int:
    """Return the number of cores that this process may use, as far as the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_blocks(function: Callable[..., _Result], rows: Any, block: int) -> _Result:
    """Return `function` of each row of arrays, within a program.

    A CPU computes `block` rows at once, so few that its cache holds them and that XLA does not split its loops among
    threads, which compute other batches. Another device computes all at once.
    """
    if find_device().platform == "cpu":
        return lax.map(function, rows, batch_size=block)
    return jax.vmap(function)(rows)


class BatchEvaluator:
    """Evaluation of `function(model, *rows)` over the rows of arrays of equal length, in batches.

    Batches are padded to one size, so that they compile once. The size is limited such that size x `rows` (numbers per
    evaluation) does not exceed `max_numbers`, which bounds the memory. A model that serves more than once is copied to
    the device.
    """

    def __init__(
        self,
        function: Callable[..., Array],
        model: Any,
        rows: int,
        batch: int = 32,
        max_numbers: int = 4_000_000,
        fast: bool = True,
    ) -> None:
        self._arguments, self._fast = (function, model), fast
        self._arrays = list(map(_as_argument, filter(is_array, jax.tree.leaves(self._arguments))))
        self._is_copied, self._programs = False, dict[tuple[_Shape | _Static, ...], _Program]()
        self._batch = max(1, min(batch, max_numbers // rows))

    def __call__(self, *arrays: np.ndarray, description: str = "") -> np.ndarray:
        """Return the values of the rows; a `description` shows the progress."""
        count, batch = len(arrays[0]), self._batch
        arrays = tuple(pad_rows(a, batch) for a in arrays)
        starts = range(0, count, batch)
        with double_precision():
            if (self._programs or len(starts) > 1) and not self._is_copied:
                self._arrays, self._is_copied = jax.device_put(self._arrays, find_device()), True
            program = self._find_program(*(a[:batch] for a in arrays))
            parts = [
                program(*self._arrays, *(a[i : i + batch] for a in arrays))
                for i in (track_progress(starts, description, len(starts)) if description else starts)
            ]
        return (parts[0] if len(parts) == 1 else np.concatenate(parts))[:count]

    def _find_program(self, *rows: np.ndarray) -> _Program:
        signature = _signature(rows)
        if signature not in self._programs:
            leaves, structure = jax.tree.flatten(((*self._arguments, *rows), {}))
            self._programs[signature] = _find_program(_map_rows, self._fast, True, structure, _signature(leaves))
        return self._programs[signature]

    def map_over(self, shape: tuple[int, ...], *arrays: np.ndarray) -> np.ndarray:
        """Return the values of rows that are arranged in `shape`, in this shape."""
        values = self(*(a.reshape(-1, *a.shape[len(shape) :]) for a in arrays))
        return values.reshape(*shape, *values.shape[1:])


def _map_rows(function: Callable[..., Array], model: Any, *rows: Array) -> Array:
    return jax.vmap(lambda *row: function(model, *row))(*rows)
