"""Accuracy against mpmath over the whole range of parameters, with finite results everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitact
from tests import extremes


@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize(
    "name",
    # `make extremes` tests all points over the whole range
    [
        "transfer",
        *(pytest.param(n, marks=[] if n == "sine" else pytest.mark.slow) for n in extremes.DRIVES),
    ],
)
def test_accuracy(name: str, kind: type):
    """Test every fourth point; `make extremes`, which CI runs, tests all."""
    for _, quantity, what, worst in extremes.sweep(kind, (name,), every=4):
        assert worst.error <= extremes.allowed(kind, what), (quantity, what, worst)
        assert worst.compared >= extremes.ENOUGH // 4, (quantity, what, worst)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["transfer", *extremes.DRIVES])
def test_single_precision_gradients_are_finite(name: str):
    with jax.enable_x64(False):
        _, slopes = extremes.ours(name, extremes.rows_for(np.float32), True)
    for quantity, slope in slopes.items():
        assert np.all(np.isfinite(slope)), quantity


def loops(point: jax.Array) -> dict[str, fitact.DirectGround | fitact.NaturalGround]:
    Rsc, Csc, Ci, _, other_R, other_C, R0 = point
    return {
        "unequal skins": fitact.DirectGround(Rsc, Csc, Ci, grounding_Rsc=other_R, grounding_Csc=other_C),
        "R_H": fitact.DirectGround(Rsc, Csc, Ci, R_H=R0, grounding_Rsc=other_R, grounding_Csc=other_C),
        "natural": fitact.NaturalGround(Rsc, Csc, Ci, Z=R0),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["unequal skins", "R_H", "natural"])
def test_other_circuits(name: str):
    """Results are finite although time constants may differ by 24 decades; |H| against NumPy's complex impedances."""
    rows = extremes.points()[::3]
    others = 10.0 ** np.random.default_rng(5).uniform([0.0, -18.0, 0.0], [12.0, -3.0, 12.0], (len(rows), 3))
    rows = np.column_stack([rows, others])

    def figures(logs: jax.Array, point: jax.Array) -> tuple[jax.Array, jax.Array]:
        point = point * jnp.exp(logs)
        circuit, f = loops(point)[name], point[3]
        drive = fitact.Trapezoid(360.0, f, 0.01 / f)
        gain = jnp.abs(circuit.transfer_function(2.0 * np.pi * f))
        current = fitact.body_current(circuit, drive)
        found = jnp.stack([gain, fitact.mean_square(circuit, drive), fitact.peak(circuit, drive), *current])
        return found, found  # compiled once for both

    with jax.enable_x64(True):
        both = jax.jit(jax.vmap(jax.jacrev(figures, has_aux=True), (None, 0)))(jnp.zeros(7), rows)
    slopes, values = (np.asarray(x) for x in both)
    assert np.all(np.isfinite(values))
    assert np.all(np.isfinite(slopes))

    Rsc, Csc, Ci, f, other_R, other_C, R0 = rows.T
    omega = 2.0 * np.pi * f
    skin = Rsc / (1.0 + 1j * omega * Rsc * Csc)
    grounding = other_R / (1.0 + 1j * omega * other_R * other_C)
    rest = {"unequal skins": grounding, "R_H": grounding + R0, "natural": R0}[name]
    expected = np.abs(skin / (skin + rest + 1.0 / (1j * omega * Ci)))
    np.testing.assert_allclose(values[:, 0], expected, rtol=1e-12)
