"""Gains of many circuits as weighted time constants, plus harmonics that these do not cover.

All circuits share one compiled program: elements that a circuit lacks get a negligible value.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from fitact.compiled import double_precision, jit
from fitact.model.circuit import INFINITE_RATIO, RC, Channel, DirectGround, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Drive, Multitone, Periodic, Sine
from fitact.model.harmonic import fourier_coefficients
from fitact.model.skin import Fractional, SkinModel, WithSkin, high_frequency_basis

ROWS = 128  # circuits in one evaluation; fewer are padded, so that each program is compiled once
_BLOCK = 64  # frequencies in one program

_fourier_coefficients = jit(fourier_coefficients)
_circuit_at_frequency = jit(WithSkin.circuit_at_frequency)


def complete_circuit(circuit: RC) -> DirectGround | NaturalGround:
    """Return the circuit with all optional elements except a gap; absent elements get a negligible value."""
    absent = 1e-6  # ohm; its transient with any capacitance ends long before the first node

    def resistance(*parts: Any) -> Any:
        return sum((part for part in parts if part is not None), start=absent)

    if isinstance(circuit, FinalCircuit):
        circuit = circuit.as_loop()
    skin, probe = (circuit.Rsc, circuit.Csc, circuit.Ci), circuit.probe or Probe(math.inf, 0.0)
    gap, series = {"Rgap": circuit.Rgap, "Cgap": circuit.Cgap, "Ri": circuit.Ri}, circuit.series_resistor
    if isinstance(circuit, DirectGround):
        return DirectGround(*skin, resistance(circuit.R_H, series), *circuit.body()[1], None, probe, **gap)
    if circuit.Z_capacitance is None:
        return NaturalGround(*skin, absent, 0.0, resistance(circuit.Z, series), probe, **gap)
    return NaturalGround(*skin, circuit.Z, circuit.Z_capacitance, resistance(series), probe, **gap)


def partial_fractions(
    circuit: DirectGround | NaturalGround,
    skin: SkinModel | None,
    drive: Drive,
    precision: type[np.floating[Any]],
    channel: Channel,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights, time constants, and amplitudes of the harmonics that these do not cover, for `ROWS` circuits.

    With a leak, the last time constant is infinite: its weight is that of V, but for its mean in the steady state.
    Gains are computed in blocks, since a vmapped `harmonic_decomposition` takes 3 to 12 times as long to compile.
    """
    if skin is None:
        weight, tau = _constant_skin_terms(circuit, channel)
        return weight, tau, np.zeros((ROWS, 0), dtype=complex)
    assert isinstance(drive, Periodic)
    frequency = float(drive.frequency)
    smooth = isinstance(drive, Sine | Multitone)
    if smooth:
        count = max(drive.orders) if isinstance(drive, Multitone) else 1
    else:
        count = max(1, skin.harmonic_count(frequency))
    omega = 2.0 * np.pi * frequency * np.arange(1, count + 1)
    with double_precision():  # the drive needs double precision in any case
        amplitude = np.asarray(_fourier_coefficients(jax.tree.map(np.asarray, drive), count + -count % _BLOCK))[:count]
    gain = _transfer_function(circuit, skin, omega, channel)
    if smooth:
        return np.zeros((ROWS, 0)), np.zeros((ROWS, 0)), amplitude * gain
    if isinstance(skin, Fractional):
        tau, x, fitted = high_frequency_basis(True, precision is np.float64)
        above = _transfer_function(circuit, skin, omega[-1] * x, channel)
        weight = np.concatenate([above.real, above.imag], axis=1) @ fitted.T
        tau = np.broadcast_to(tau / omega[-1], weight.shape)
    else:  # the skin is constant above 1000 Hz
        weight, tau = _constant_skin_terms(_circuit_at_frequency(WithSkin(circuit, skin), 1000.0), channel)
    x = 1j * omega * tau[..., None]
    return weight, tau, amplitude * (gain - np.einsum("rk,rkh->rh", weight, x / (1.0 + x)))


def _transfer_function(
    circuit: DirectGround | NaturalGround, skin: SkinModel, omega: np.ndarray, channel: Channel
) -> np.ndarray:
    """Return Vsc / V, or Vgap / V, of circuits with a skin model."""
    blocks = np.pad(omega, (0, -omega.size % _BLOCK), mode="edge").reshape(-1, _BLOCK)
    with double_precision():  # in double precision for any result, so that one program serves
        circuits = jax.tree.map(np.float64, WithSkin(circuit, skin))
        parts = [np.asarray(_channel_gain(circuits, block, channel)) for block in blocks]
    return np.concatenate(parts, axis=1)[:, : omega.size]


@jit
def _channel_gain(circuits: WithSkin, omega: Array, channel: Channel) -> Complex[Array, "circuits frequencies"]:
    return jax.vmap(lambda circuit: circuit.channel_gain(channel, omega))(circuits)


def _constant_skin_terms(circuit: Any, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
    """Return the terms for constant skins; Z takes the place of a grounding skin, so that one program serves both."""
    if isinstance(circuit, NaturalGround):
        loop = circuit.series_resistor, circuit.Z, circuit.Z_capacitance
        gap = {"Rgap": circuit.Rgap, "Cgap": circuit.Cgap, "Ri": circuit.Ri}
        circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci, *loop, None, circuit.probe, **gap)
    *terms, direct = _batch_terms(circuit, channel)
    weight, tau = map(np.asarray, terms)
    if direct is None:
        return weight, tau
    return np.column_stack([weight, direct]), np.column_stack([tau, INFINITE_RATIO * tau.max(axis=1)])


@jit
def _batch_terms(circuit: DirectGround, channel: Channel) -> tuple[Array, Array, Array | None]:
    terms = jax.vmap(lambda one: one.channel_terms(channel))(circuit)
    return jnp.stack(terms.weight, axis=1), jnp.stack(terms.tau, axis=1), terms.direct
