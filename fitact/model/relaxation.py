"""A fixed grid of time constants, in which responses with no finite set of their own are put together.

Of any network of resistances, capacitances and fractional skins the gain is an integral over high-pass terms
s tau / (1 + s tau), tau > 0 (its distribution of relaxation times). A sum over a grid of tau that is dense in the
logarithm stands for it in time as in frequency, with weights that least squares find from the gain at fixed
frequencies. The weights are thus linear in the gain, and the time constants depend on no parameter.
"""

from typing import Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from fitact.model.circuit import Channel, Terms

_PER_DECADE = 10
_BEYOND = 10.0  # time constants reach so much beyond the frequencies, at both ends
_ALIKE = 1e-13  # relative, what is left out of the map, lest large weights cancel


Map: TypeAlias = tuple[Float[Array, "rows modes"], Float[Array, "modes parts"]]


class Grid(eqx.Module):
    """Time constants, and the least-squares map from a gain at the frequencies `omega` to their weights.

    Attributes:
        tau: s.
        omega: rad/s, at which the gain is asked for.
        vsc: the map for Vsc / V and Vgap / V from real parts, then imaginary ones: the inner matrix's product with
            them goes into the outer one. Multiplied out they would lose the digits that the singular values between
            them span.
        limited: that for I / V where a resistance limits it, whose misfit counts in proportion to the frequency.
        following: where none does; with one row more, for the term that follows dV/dt.
    """

    tau: Float[Array, " terms"]
    omega: Float[Array, " frequencies"]
    vsc: Map
    limited: Map
    following: Map

    @classmethod
    def between(cls, slowest: float, fastest: float) -> Self:
        """For a gain between two angular frequencies (rad/s). Call it in double precision."""
        decades = np.log10(fastest / slowest * _BEYOND**2)
        tau = np.geomspace(1.0 / (_BEYOND * fastest), _BEYOND / slowest, 1 + int(np.ceil(_PER_DECADE * decades)))
        omega = np.geomspace(slowest, fastest, 2 * tau.size)
        x = 1j * omega[:, None] * tau
        terms = x / (1.0 + x)
        share = omega[:, None] / fastest
        limited, (outer, inner) = (_map(columns, share) for columns in (terms, np.hstack([terms, 1j * share])))
        outer[-1] /= fastest
        found = tau, omega, _map(terms, np.ones_like(share)), limited, (outer, inner)
        return cls(*jax.tree.map(jnp.asarray, found))

    def terms(self, channel: Channel, limited: bool, gain: Complex[Array, " frequencies"]) -> Terms:
        """The terms that stand for a channel's `gain` at `omega`; `limited`: whether a resistance limits I."""
        parts = jnp.concatenate([gain.real, gain.imag])
        outer, inner = self.vsc if channel != "I" else self.limited if limited else self.following
        found, size = outer @ (inner @ parts), self.tau.size
        return Terms(found[:size], self.tau, found[size] if found.size > size else None)


def _map(terms: np.ndarray, share: np.ndarray) -> Map:
    """The pseudo-inverse of what the terms are over `share`, in two factors."""
    scaled = terms / share
    modes, sizes, directions = np.linalg.svd(np.concatenate([scaled.real, scaled.imag]), full_matrices=False)
    kept = sizes > _ALIKE * sizes[0]
    return directions[kept].T / sizes[kept], modes[:, kept].T / np.tile(share[:, 0], 2)
