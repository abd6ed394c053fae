"""The high-pass response to polynomials: along a piece, u' = v' - z u has a polynomial solution.

With s from 0 to 1 along the piece and z its length in time constants, u = p(s) + (u0 - p(0)) e^{-z s}. For
z <= 1 the solution with p(0) = 0 is a series that converges as that of e^{-z}; for z > 1 the one of least
degree is computed from its highest coefficient down, and nothing cancels either way.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def particular(
    coefficients: Float[Array, "degree pieces"], z: Float[Array, ""]
) -> tuple[Float[Array, "degree+1 pieces"], Float[Array, " pieces"]]:
    """p(s), lowest coefficient first, and p(1), for v = sum_n coefficients[n - 1] s^n on each piece."""
    degree = coefficients.shape[0]
    slopes = coefficients * jnp.arange(1.0, degree + 1.0)[:, None]  # of v', from s^0
    zero = jnp.zeros_like(slopes[0])
    near, far = jnp.minimum(z, 1.0), jnp.maximum(z, 1.0)
    order = jnp.arange(1.0, degree + 1.0)

    def upwards(below: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        n, slope = step
        p = (slope - near * below) / n
        return p, p

    def downwards(above: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        n, slope = step
        p = (slope - n * above) / far
        return p, p

    up = jnp.concatenate([zero[None], lax.scan(upwards, zero, (order, slopes))[1]])
    down = jnp.concatenate([lax.scan(downwards, zero, (order, slopes), reverse=True)[1], zero[None]])
    p = jnp.where(z <= 1.0, up, down)
    return p, jnp.sum(p, axis=0)


def evaluate(
    coefficients: Float[Array, "degree+1 pieces"], piece: Array, s: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """The pieces' polynomials, lowest coefficient first, at s; memory for one coefficient of each time only."""

    def horner(total: Array, row: Array) -> tuple[Array, None]:
        return total * s + row[piece], None

    return lax.scan(horner, jnp.zeros_like(s), coefficients, reverse=True)[0]
