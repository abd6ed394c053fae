"""Gains of many circuits side by side, as time constants with weights and the harmonics that those miss.

All circuits share one compiled program: what a circuit lacks is filled in with a value too small to matter.
"""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex

from fitact.model.circuit import RC, Channel, DirectGround, Element, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Drive, Multitone, Periodic, Sine
from fitact.model.harmonic import fourier_coefficients
from fitact.model.skin import Fractional, SkinModel, WithSkin, high_frequency_basis

ROWS = 128  # circuits side by side; fewer are filled up, so that each program is compiled once
_BLOCK = 64  # frequencies in one program


def complete_circuit(circuit: RC) -> DirectGround | NaturalGround:
    """Return the circuit with every part that its kind may have but a gap, an absent one too small to matter."""
    absent = 1e-6  # ohm: with any capacitance here over long before the first node

    def resistance(*parts: Any) -> Any:
        return sum((part for part in parts if part is not None), start=absent)

    if isinstance(circuit, FinalCircuit):
        circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci)
    skin, probe = (circuit.Rsc, circuit.Csc, circuit.Ci), circuit.probe or Probe(math.inf, 0.0)
    gap, series = {"Rgap": circuit.Rgap, "Cgap": circuit.Cgap}, circuit.series_resistor
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
    """Return weights, time constants, and amplitudes of the harmonics that they miss, each of `ROWS` circuits.

    The gain at the harmonics is NumPy: a vmapped `harmonic_decomposition` takes 3 to 12 times as long to compile.
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
    with jax.enable_x64(True):  # the drive's, whatever the precision of what follows
        amplitude = np.asarray(_fourier(jax.tree.map(np.asarray, drive), _block_count(count) * _BLOCK))[:count]
    gain = _transfer_function(circuit, skin, omega, channel)
    if smooth:
        return np.zeros((ROWS, 0)), np.zeros((ROWS, 0)), amplitude * gain
    if isinstance(skin, Fractional):
        tau, x, fitted = high_frequency_basis(True, precision is np.float64)
        above = _transfer_function(circuit, skin, omega[-1] * x, channel)
        weight = np.concatenate([above.real, above.imag], axis=1) @ fitted.T
        tau = np.broadcast_to(tau / omega[-1], weight.shape)
    else:  # above 1000 Hz it is constant
        weight, tau = _constant_skin_terms(_evaluate_circuit(WithSkin(circuit, skin), 1000.0), channel)
    x = 1j * omega * tau[..., None]
    return weight, tau, amplitude * (gain - np.einsum("rk,rkh->rh", weight, x / (1.0 + x)))


def _transfer_function(
    circuit: DirectGround | NaturalGround, skin: SkinModel, omega: np.ndarray, channel: Channel
) -> np.ndarray:
    """Vsc / V, or Vgap / V, of circuits whose skins follow a level."""
    s = 1j * omega

    def admittance(element: Element) -> np.ndarray:
        R, C = (np.atleast_2d(np.asarray(x).T).T for x in element)
        return 1.0 / R + s * C

    def skin_admittance(R: ArrayLike, C: ArrayLike) -> np.ndarray:
        missing = _block_count(omega.size) * _BLOCK - omega.size
        blocks = np.pad(omega / (2.0 * np.pi), (0, missing), mode="edge").reshape(-1, _BLOCK)
        constant = Element(*(jnp.asarray(x)[:, None] for x in (R, C)))
        parts = [_evaluate_skin(skin, constant, block) for block in blocks]
        return admittance(Element(*(np.concatenate(x, axis=1)[:, : omega.size] for x in zip(*parts, strict=True))))

    assert circuit.probe is not None
    touching = 1.0 / (skin_admittance(circuit.Rsc, circuit.Csc) + admittance(Element(circuit.probe.R, circuit.probe.C)))
    if isinstance(circuit, NaturalGround):
        other = 1.0 / admittance(Element(circuit.Z, circuit.Z_capacitance))
    else:
        other = 1.0 / skin_admittance(circuit.grounding_Rsc, circuit.grounding_Csc)
    gap: Any = 0.0
    if circuit.Cgap is not None:
        gap = 1.0 / admittance(Element(np.inf if circuit.Rgap is None else circuit.Rgap, circuit.Cgap))
    rest = np.asarray(circuit.resistance())[:, None] + 1.0 / (s * np.asarray(circuit.Ci)[:, None])
    return (touching if channel == "Vsc" else gap) / (touching + other + rest + gap)


def _block_count(count: int) -> int:
    """In how many blocks frequencies are computed, so that programs are compiled for one size."""
    return -(-count // _BLOCK)


@eqx.filter_jit
def _fourier(drive: Drive, harmonics: int) -> Complex[Array, " harmonics"]:
    return fourier_coefficients(drive, harmonics)


@eqx.filter_jit
def _evaluate_skin(skin: SkinModel, element: Element, frequency: Array) -> Element:
    return skin.parallel_rc(element, frequency)


@eqx.filter_jit
def _evaluate_circuit(circuit: WithSkin, frequency: float) -> Any:
    return circuit.circuit_at_frequency(frequency)


def _constant_skin_terms(circuit: Any, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
    """Terms of constant skins. Z stands in the loop where a grounding skin does, so one program serves both."""
    if isinstance(circuit, NaturalGround):
        loop = circuit.series_resistor, circuit.Z, circuit.Z_capacitance
        gap = {"Rgap": circuit.Rgap, "Cgap": circuit.Cgap}
        circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci, *loop, None, circuit.probe, **gap)
    weight, tau = _batch_terms(circuit, channel)
    return np.asarray(weight), np.asarray(tau)


@functools.partial(jax.jit, static_argnums=1)
def _batch_terms(circuit: DirectGround, channel: Channel) -> tuple[Array, Array]:
    terms = jax.vmap(lambda one: one.channel_terms(channel))(circuit)
    return jnp.stack(terms.weight, axis=1), jnp.stack(terms.tau, axis=1)
