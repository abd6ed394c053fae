"""Vsc against an ODE solver for the node voltages of each circuit, with equations from Kirchhoff's laws."""

from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitact

R, C, CI = 160e3, 22e-9, 1.35e-9
R2, C2, R_H, Z, CZ = 80e3, 44.25e-9, 500.0, 14.5e6, 100e-12
PERIOD, RISE = 0.01, 1e-3
TIME = np.linspace(0.0, 2.0 * PERIOD, 41)

# a trapezoid from 0 V, and a sine; the solver must start a new step at the corners
CORNERS = np.array([n * PERIOD + t for n in range(2) for t in (0.0, RISE, 0.5 * PERIOD, 0.5 * PERIOD + RISE)])
LEVELS = np.array([0.0, 360.0, 360.0, 0.0] * 2 + [0.0])


def trapezoid(time: jax.Array) -> jax.Array:
    return jnp.interp(time, np.append(CORNERS, 2.0 * PERIOD), LEVELS)


def trapezoid_slope(time: jax.Array) -> jax.Array:
    slopes = np.array([360.0 / RISE, 0.0, -360.0 / RISE, 0.0] * 2)
    return jnp.asarray(slopes)[jnp.clip(jnp.searchsorted(CORNERS, time, side="right") - 1, 0, 7)]


def sine(time: jax.Array) -> jax.Array:
    return 180.0 * jnp.sin(2.0 * np.pi * time / PERIOD)


def sine_slope(time: jax.Array) -> jax.Array:
    return 360.0 * np.pi / PERIOD * jnp.cos(2.0 * np.pi * time / PERIOD)


DRIVES = {
    "trapezoid": (fitact.Trapezoid(360.0, 1.0 / PERIOD, RISE, offset=180.0), trapezoid, trapezoid_slope),
    "sine": (fitact.Sine(360.0, 1.0 / PERIOD), sine, sine_slope),
}
Voltage = Callable[[jax.Array], jax.Array]


def final(V: Voltage, slope: Voltage) -> Callable:
    """y holds the upper and the lower skin, which both carry the current Ci (V - y1 - y2)'."""
    nodes = jnp.array([[C + CI, CI], [CI, C + CI]])
    return lambda t, y, _: jnp.linalg.solve(nodes, CI * slope(t) - y / R)


def direct(V: Voltage, slope: Voltage) -> Callable:
    """y holds Ci and the two skins; the voltage across R_H gives the current."""

    def rate(t: jax.Array, y: jax.Array, _: None) -> jax.Array:
        current = (V(t) - jnp.sum(y)) / R_H
        return jnp.stack([current / CI, (current - y[1] / R) / C, (current - y[2] / R2) / C2])

    return rate


def natural(V: Voltage, slope: Voltage) -> Callable:
    """y holds the skin and the environment, both with a capacitance."""
    nodes = jnp.array([[C + CI, CI], [CI, CZ + CI]])
    return lambda t, y, _: jnp.linalg.solve(nodes, CI * slope(t) - y / jnp.array([R, Z]))


# our circuit, its equations, the index of Vsc, and a solver suited to the stiffness
CIRCUITS = {
    "final": (fitact.FinalCircuit(R, C, CI), final, 0, 2, diffrax.Tsit5()),
    "direct ground, unequal skins, R_H": (
        fitact.DirectGround(R, C, CI, R_H=R_H, grounding_Rsc=R2, grounding_Csc=C2),
        direct,
        1,
        3,
        diffrax.Kvaerno5(),
    ),
    "natural ground, Z with capacitance": (
        fitact.NaturalGround(R, C, CI, Z=Z, Z_capacitance=CZ),
        natural,
        0,
        2,
        diffrax.Tsit5(),
    ),
}


@pytest.mark.parametrize("name", CIRCUITS)
@pytest.mark.parametrize("waveform", DRIVES)
def test_from_rest_against_an_ode_solver(name: str, waveform: str):
    circuit, equations, touching, unknowns, solver = CIRCUITS[name]
    drive, voltage, slope = DRIVES[waveform]
    with jax.enable_x64(True):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(equations(voltage, slope)),
            solver,
            t0=0.0,
            t1=TIME[-1],
            dt0=1e-7,
            y0=jnp.zeros(unknowns),
            saveat=diffrax.SaveAt(ts=TIME),
            stepsize_controller=diffrax.ClipStepSizeController(
                diffrax.PIDController(rtol=1e-10, atol=1e-9), jump_ts=CORNERS[1:]
            ),
            max_steps=200_000,
        )
        reference = np.asarray(solution.ys[:, touching])
        ours = np.asarray(fitact.response(circuit, drive, TIME, steady_state=False))
    np.testing.assert_allclose(ours, reference, rtol=0.0, atol=1e-7 * np.abs(reference).max())
