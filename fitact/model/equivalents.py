"""The paper's series equivalents of the skin and their quality factor."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float


class Series(NamedTuple):
    """A resistance (ohm) in series with a capacitance (F)."""

    Rx: Float[Array, "*shape"]
    Cx: Float[Array, "*shape"]


def series_equivalent(Rsc: ArrayLike, Csc: ArrayLike, frequency: ArrayLike) -> Series:
    """Rx (ohm) and Cx (F) that in series are Rsc‖Csc at `frequency` (Hz, > 0), eqs. (10)-(13).

    Of two equal skins in series Rx' = 2 Rx, eq. (14), and Cx' = Cx / 2.
    """
    q = quality_factor(Rsc, Csc, frequency)
    below = q <= 1.0
    small, inverse = jnp.where(below, q, 1.0), 1.0 / jnp.where(below, 1.0, q)
    # 1 / (1 + q^2) and 1 + q^-2, without the square of what is large
    Rx = Rsc * jnp.where(below, 1.0 / (1.0 + small**2), inverse**2 / (1.0 + inverse**2))
    # C (1 + q^-2), where q is small as 1 / (w^2 R^2 C) + C
    wR = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * Rsc
    Cx = Csc + jnp.where(below, 1.0 / (jnp.where(below, wR, 1.0) * small), Csc * inverse**2)
    return Series(Rx, Cx)


def quality_factor(
    Rsc: ArrayLike, Csc: ArrayLike, frequency: ArrayLike, R_H: ArrayLike = 0.0
) -> Float[Array, "*shape"]:
    """Q of two equal skins in series with `R_H` (ohm) at `frequency` (Hz), eqs. (15)-(17).

    Without R_H it is that of one skin, w Rsc Csc; with it Xx' / (Rx' + R_H) = q / (1 + (1 + q^2) R_H / (2 Rsc)).
    """
    q = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * (jnp.asarray(Rsc) * Csc)
    share = 0.5 * jnp.asarray(R_H) / Rsc
    return q / (1.0 + share + (q * share) * q)
