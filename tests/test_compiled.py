"""Programs: few for a first answer, found again by other processes, apart from the user's own JAX."""

import functools
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitact
from fitact import compiled, program_cache
from fitact.model.circuit import DirectGround, FinalCircuit, Loop
from tests.conftest import RECORDS

RECORD = [str(RECORDS / "finger_direct.csv"), str(RECORDS / "finger_direct.toml")]

# prints how many programs XLA compiled for a first fit and for a first posterior, and the force; `{setup}` runs first
SCRIPT = """
import json, logging, sys
import jax
{setup}
count = 0
class Handler(logging.Handler):
    def emit(self, record):
        global count
        count += "Finished XLA compilation" in record.getMessage()
jax.config.update("jax_log_compiles", True)
log = logging.getLogger("jax._src.dispatch")
log.addHandler(Handler())
log.propagate = False
logging.getLogger("jax._src.interpreters.pxla").propagate = False
import fitact
{after}
scene = fitact.Scene.load(sys.argv[2])
fit = fitact.fit(fitact.read(sys.argv[1], scene), scene)
counts = [count]
if {sample}:
    fitact.sample(fit, seed=1, progress=False)
    counts.append(count)
print(json.dumps(dict(counts=counts, force=fit.derived()["force_mean"]["mean"])))
"""


def run_script(cache: str, setup: str = "", after: str = "", sample: bool = False) -> dict:
    program = SCRIPT.format(setup=setup, after=after, sample=sample)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    run = subprocess.run(
        [sys.executable, "-c", program, *RECORD], env=kept | {"FITACT_CACHE": cache}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def test_a_first_answer_compiles_few_programs_and_the_next_process_none(tmp_path):
    first = run_script(str(tmp_path), sample=True)
    assert 5 <= first["counts"][0] <= 8  # fewer would mean that the counting is broken
    assert first["counts"][1] <= 11
    again = run_script(str(tmp_path), sample=True)
    assert again["counts"] == [0, 0]
    assert again["force"] == first["force"]


def test_the_device_that_is_named_computes(finger_fit: fitact.Fit, tmp_path):
    device = "import os; os.environ['XLA_FLAGS'] = '--xla_force_host_platform_device_count=2';"
    device += "os.environ['FITACT_DEVICE'] = 'cpu:1'"  # JAX's own default is cpu:0
    after = "from fitact.compiled import find_device; assert find_device().id == 1"
    other = run_script(str(tmp_path), setup=device, after=after, sample=True)
    assert other["force"] == pytest.approx(finger_fit.derived()["force_mean"]["mean"], rel=1e-9)


def test_a_device_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setenv("FITACT_DEVICE", "cpu:99")
    compiled.find_device.cache_clear()
    with pytest.raises(fitact.InputError, match=r"FITACT_DEVICE = cpu:99: JAX finds .*cpu:0.* only; give one of these"):
        compiled.find_device()


@pytest.mark.parametrize("when", ["setup", "after"])
def test_a_cache_of_the_user_gets_only_what_is_theirs(when, tmp_path):
    own, theirs = tmp_path / "own", tmp_path / "theirs"
    update = f"jax.config.update('jax_compilation_cache_dir', {str(theirs)!r});"
    update += "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0);"
    program = "import jax.numpy as jnp; jax.jit(lambda x: jnp.sin(x) + 41)(1.0)"
    run_script(str(own), **{when: update + program})
    names = {path.name.rpartition("-")[0] for path in theirs.glob("jit_*")} | {
        path.name.partition("-")[0] for path in theirs.glob("jit_*")
    }
    assert any("lambda" in name for name in names), "the user's program is not in the user's cache"
    assert not any(name in str(names) for name in ("solve_round", "map_rows", "advance_chunk", "evaluate_circuit"))
    assert len(list(own.glob("*.program"))) >= 5


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FITACT_CACHE", str(tmp_path))
    compiled._share_program.cache_clear()
    yield tmp_path
    compiled._share_program.cache_clear()


def _scaled(circuit: FinalCircuit, scale: np.ndarray, count: int) -> dict[str, jax.Array]:
    """Return a pytree from an array, a module and a static number."""
    root = jnp.linalg.cholesky(scale @ scale.T + jnp.eye(len(scale)))  # calls LAPACK
    return {"g": circuit.g * scale, "root": root, "count": jnp.asarray(count)}


scaled = compiled.jit(_scaled)
ARGUMENTS = FinalCircuit(*np.array([160e3, 22e-9, 1.35e-9])), np.eye(3), 2


def test_results_are_numpy_arrays_in_double_precision(cache):
    result = scaled(*ARGUMENTS)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(result))
    assert result["g"].dtype == np.float64
    np.testing.assert_allclose(result["root"], np.sqrt(2.0) * np.eye(3), rtol=1e-15)
    assert int(scaled(*ARGUMENTS[:2], 3)["count"]) == 3  # a static number is part of the program


def test_a_function_is_traced_within_another(cache):
    with jax.enable_x64(True):
        slope = jax.grad(lambda scale: jnp.sum(scaled(ARGUMENTS[0], scale, 2)["g"]))(jnp.eye(3))
    np.testing.assert_allclose(slope, 1.35e-9 / (2.0 * 1.35e-9 + 22e-9), rtol=1e-14)


def test_threads_that_need_the_same_program_compile_it_once(cache, monkeypatch):
    names, together = _count_compilations(monkeypatch), threading.Barrier(4)

    def call(_: int) -> np.ndarray:
        together.wait()
        return scaled(*ARGUMENTS)["root"]

    with ThreadPoolExecutor(4) as pool:
        roots = list(pool.map(call, range(4)))
    assert names == ["_scaled"]
    assert all(np.array_equal(root, roots[0]) for root in roots)


def _count_compilations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    compile_program, names = compiled._compile, []

    def count(function, *args):
        names.append(function.__name__)
        return compile_program(function, *args)

    monkeypatch.setattr(compiled, "_compile", count)
    return names


@pytest.mark.parametrize("damage", ["none", "pickle", "truncated", "processor"])
def test_a_program_from_the_disk_equals_the_compiled_one_and_a_bad_entry_is_compiled_again(damage, cache, monkeypatch):
    terms, circuit = compiled.jit(Loop.channel_terms), DirectGround(*np.array([160e3, 22e-9, 1.35e-9]))
    names, first = _count_compilations(monkeypatch), terms(circuit, "Vsc")  # calls LAPACK
    (entry,) = cache.glob("*.program")
    if damage == "pickle":  # a whole entry that no program is in
        program_cache.store(entry.name.removesuffix(".program"), b"not a program")
    elif damage == "truncated":
        entry.write_bytes(entry.read_bytes()[: entry.stat().st_size // 2])
    elif damage == "processor":
        monkeypatch.setattr(compiled, "processor", lambda: "another one")
        compiled._environment.cache_clear()
    compiled._share_program.cache_clear()
    second = terms(circuit, "Vsc")
    monkeypatch.undo()
    compiled._environment.cache_clear()
    assert len(names) == (1 if damage == "none" else 2)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    assert all(map(np.array_equal, jax.tree.leaves(first), jax.tree.leaves(second)))
    assert len(list(cache.glob("*.program"))) == (2 if damage == "processor" else 1)


def test_functions_that_another_process_cannot_name_stay_in_memory(cache):
    @compiled.jit
    def local(x: np.ndarray) -> jax.Array:
        return 2.0 * x

    assert local(np.ones(1)) == 2.0
    mapped = functools.wraps(_scaled)(lambda *args: _scaled(*args)["g"])  # it only carries the other's name
    assert isinstance(compiled.jit(mapped)(*ARGUMENTS), np.ndarray)
    assert not list(cache.glob("*.program"))


def test_the_key_tells_structures_apart():
    describe = compiled._describe
    texts = [describe(x) for x in (1, 1.0, True, None, "1", (1,), [1], {"a": 1}, FinalCircuit(1.0, 1.0, 1.0))]
    assert len(set(texts)) == len(texts)
    shapes = compiled._signature([np.zeros(3), np.zeros(4), np.zeros(3, np.float32)])
    assert len(set(map(describe, shapes))) == 3


def test_batches_of_rows(cache):
    evaluator = compiled.BatchEvaluator(_row_sum, ARGUMENTS[0], rows=1, batch=4)
    rows = np.arange(22.0).reshape(11, 2)
    np.testing.assert_allclose(evaluator(rows), 160e3 * rows.sum(axis=1), rtol=1e-15)
    np.testing.assert_allclose(evaluator.map_over((11,), rows), evaluator(rows), rtol=0)


def _row_sum(circuit: FinalCircuit, row: jax.Array) -> jax.Array:
    return circuit.Rsc * jnp.sum(row)
