"""The first-order high-pass in frequency, in forms that keep their digits at both ends."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float


def highpass_gain(x: ArrayLike) -> Complex[Array, "*shape"]:
    """j x / (1 + j x) for x >= 0, without overflow at either end."""
    below, small, inverse = _ends(x)
    low = small / (1.0 + small**2)  # (x^2 + j x) / (1 + x^2)
    high = 1.0 / (1.0 + inverse**2)
    return jnp.where(below, low * small + 1j * low, high + 1j * high * inverse)


def highpass_amplitude(x: ArrayLike) -> Float[Array, "*shape"]:
    """|j x / (1 + j x)| for x >= 0, in forms whose derivatives do not cancel."""
    below, small, inverse = _ends(x)
    return jnp.where(below, small / jnp.sqrt(1.0 + small**2), 1.0 / jnp.sqrt(1.0 + inverse**2))


def _ends(x: ArrayLike) -> tuple[Array, Array, Array]:
    """Whether x <= 1, x where it is, and 1/x where it is not; 1 elsewhere, which keeps gradients finite."""
    x = jnp.asarray(x)
    below = x <= 1.0
    return below, jnp.where(below, x, 1.0), 1.0 / jnp.where(below, 1.0, x)
