"""Time constants and weights of a loop of parallel elements R‖C: a symmetric eigenvalue problem.

Scaled by square roots, the equations of the loop have a symmetric matrix whose eigenvalues are the time constants. The
eigenvalues remain distinct if two elements are equal: the mode that these share then has weight zero. A leak Ri of the
insulator adds no time constant. No entry of a factor is a difference, so that all digits remain for large and small Ri.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import jit_inline


class HighpassTerms(NamedTuple):
    """direct + sum_k weight[k] s tau[k] / (1 + s tau[k]) + rate s."""

    weight: tuple[ArrayLike, ...] | Array
    tau: tuple[ArrayLike, ...] | Array  # s
    rate: ArrayLike | None = None  # s times the weight's unit; None means no such term
    direct: ArrayLike | None = None  # at zero frequency, in the weight's unit; None means that the insulator blocks

    @property
    def jump(self) -> ArrayLike:
        """Height of the response to a jump of 1, beside what follows `rate`."""
        return sum(self.weight, 0.0 if self.direct is None else self.direct)

    def without_fastest(self, count: int) -> "HighpassTerms":
        """Return the terms without those of the `count` last, i.e. shortest, time constants."""
        kept = slice(len(self.tau) - count)
        return self._replace(weight=self.weight[kept], tau=self.tau[kept])

    def follow_fastest(self, count: int) -> "HighpassTerms":
        """Return the terms in which those of the `count` last time constants follow dV/dt, without their lag."""
        if not count:
            return self
        fastest = slice(len(self.tau) - count, None)
        rates = (w * tau for w, tau in zip(self.weight[fastest], self.tau[fastest], strict=True))
        return self.without_fastest(count)._replace(rate=sum(rates, 0.0 if self.rate is None else self.rate))

    def gain_in_step(self, step: float) -> ArrayLike:
        """Return the response to a drive that rises by 1 within a time `step` (s), at its end, beside the `rate`."""
        gains = (w * -np.expm1(-step / tau) * (tau / step) for w, tau in zip(self.weight, self.tau, strict=True))
        return sum(gains, 0.0 if self.direct is None else self.direct)

    def stack(self) -> tuple[Array, Array]:
        """Return the weights and the time constants as arrays."""
        weight, tau = (
            jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, x))) if isinstance(x, tuple) else x
            for x in (self.weight, self.tau)
        )
        return weight, tau


class Modes(NamedTuple):
    """Time constants, their weights in the element voltages and in the current, and the limits at both frequencies."""

    tau: Array  # s
    voltages: Float[Array, "elements modes"]
    current: Array  # S
    rate: ArrayLike | None = None  # of the current, F
    direct: Array | None = None  # voltages of the elements, then of the insulator, over V at zero frequency
    direct_current: Array | None = None  # S

    def element_terms(self, index: int) -> HighpassTerms:
        """Return the terms of the voltage across an element over V."""
        direct = None if self.direct is None else self.direct[index]
        return HighpassTerms(tuple(self.voltages[index]), tuple(self.tau), None, direct)


@jit_inline
def modes_without_resistance(Ci: ArrayLike, Ri: ArrayLike | None, R: Array, C: Array) -> Modes:
    """Solve  T x' + x = L^T 1 (Ci V' + V / Ri),  T = L^T (diag(C) + Ci 1 1^T) L,  with v = L x over the elements.

    L = sqrt(R) (1 + u u^T)^(-1/2) with u = sqrt(R / Ri) is a factor of the inverse of the conductances.
    """
    root, direct, direct_current = jnp.sqrt(R), None, None
    factor, sums, conductance = jnp.diag(root), root, jnp.zeros(())
    if Ri is not None:
        conductance = 1.0 / jnp.asarray(Ri)
        growth = jnp.sqrt(1.0 + jnp.sum(R) * conductance)
        u = root / jnp.sqrt(jnp.asarray(Ri))
        # the diagonal of 1 - u u^T / (growth (1 + growth)), without the difference
        kept = (1.0 + _sum_others(R) * conductance + growth) / (growth * (1.0 + growth))
        mixed = -u[:, None] * u / (growth * (1.0 + growth))
        factor = root[:, None] * jnp.where(jnp.eye(R.size, dtype=bool), kept, mixed)
        sums, direct_current = root / growth, conductance / growth**2
        direct = jnp.append(R * direct_current, 1.0 / growth**2)
    tau, modes = _gram_eigenmodes(jnp.vstack([jnp.sqrt(C)[:, None] * factor, jnp.sqrt(Ci) * sums]))
    drive = (modes.T @ sums) * (Ci / tau - conductance)
    rate = Ci
    for capacitance in C:
        rate = rate * (capacitance / (rate + capacitance))
    return Modes(tau, factor @ modes * drive, drive**2, rate, direct, direct_current)


@jit_inline
def modes_with_resistance(Ci: ArrayLike, Ri: ArrayLike | None, R0: ArrayLike, R: Array, C: Array) -> Modes:
    """Solve  T x' + x = sqrt(C) d V,  T = sqrt(C) P sqrt(C),  with x = sqrt(C) v over the elements and the insulator.

    P holds the resistance between the terminals of each capacitor, and d the fraction of a constant V across it. If
    nothing leaks, this is 1 for Ci, and P is its own R for an element, and for Ci that of the whole loop.
    """
    root = jnp.sqrt(jnp.append(C, Ci))
    # each row is the current of one resistance times its square root, the columns those injected at each capacitor
    resistances = jnp.append(R, R0)
    own = jnp.vstack([jnp.diag(root[:-1]), jnp.zeros_like(C)])
    if Ri is None:
        through_loop = jnp.append(jnp.full_like(R, -1.0), 1.0)[:, None] * root[-1]
        factor = jnp.sqrt(resistances)[:, None] * jnp.hstack([own, through_loop])
        direct, direct_current = None, None
        pull = root[-1] * jnp.append(jnp.zeros_like(R), 1.0)
    else:
        conductance, leak_root = 1.0 / jnp.asarray(Ri), 1.0 / jnp.sqrt(jnp.asarray(Ri))
        total = jnp.sum(resistances)
        share = 1.0 / (1.0 + total * conductance)  # of a constant V across the insulator
        direct_current = conductance * share
        divider = R * direct_current
        # 1 - divider, without the difference
        kept = (1.0 + (_sum_others(R) + R0) * conductance) * share
        through = jnp.where(jnp.eye(R.size, dtype=bool), kept, -divider)
        direct = jnp.append(divider, share)
        rows = jnp.vstack([jnp.hstack([through, jnp.full((R.size, 1), -share)]), direct])
        leak = jnp.append(-leak_root * share * R, leak_root * share * total)
        factor = jnp.vstack([jnp.sqrt(resistances)[:, None] * rows, leak]) * root
        pull = root * direct
    tau, modes = _gram_eigenmodes(factor)
    pulled = modes.T @ pull
    return Modes(tau, -modes[:-1] * pulled / root[:-1, None], pulled**2 / tau, None, direct, direct_current)


def _sum_others(R: Array) -> Array:
    """Return for each element the sum of all others."""
    return jnp.sum(jnp.where(jnp.eye(R.size, dtype=bool), 0.0, R), axis=1)


@jax.custom_jvp
def _gram_eigenmodes(factor: Array) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of factor^T factor; using the factor doubles the digits of small ones."""
    _, sigma, modes = jnp.linalg.svd(factor, full_matrices=False)
    return sigma * sigma, modes.T


@_gram_eigenmodes.defjvp
def _gram_eigenmodes_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the derivative of the singular value decomposition, finite also where modes differ only by rounding.

    Such modes have one time constant, and only their sum matters, which is invariant under their rotation.
    """
    left, sigma, right = jnp.linalg.svd(primals[0], full_matrices=False)
    modes, slope = right.T, left.T @ tangents[0] @ right.T
    gaps = sigma - sigma[:, None]
    distinct = jnp.abs(gaps) > 4.0 * jnp.finfo(sigma.dtype).eps * sigma[0]  # equal ones differ by rounding
    turn = jnp.where(distinct, 1.0 / jnp.where(distinct, gaps * (sigma + sigma[:, None]), 1.0), 0.0)
    scaled = sigma[:, None] * slope
    changes = 2.0 * sigma * jnp.diagonal(slope), modes @ (turn * (scaled + scaled.T))
    return (sigma * sigma, modes), changes
