"""Score test of the BIC: what part of the residuals an added nuisance would explain, beside all that is fitted.

Regressors are rows of arrays, of NumPy or, in compiled programs, of JAX.
"""

from collections.abc import Mapping
from typing import TypeVar

from jaxtyping import Array, Float

from fitact.compiled import array_module

_Key = TypeVar("_Key")


def explained_squares(
    residuals: Float[Array, " samples"],
    fitted: Float[Array, "n samples"],
    candidates: Mapping[_Key, Float[Array, "_ samples"]],
) -> dict[_Key, Float[Array, ""]]:
    """Return the sum of squares of the residuals that the regressors of each candidate explain, beside the `fitted`."""
    basis = orthonormalise(fitted)
    return {key: ((orthonormalise(added, basis) @ residuals) ** 2).sum() for key, added in candidates.items()}


def orthonormalise(
    rows: Float[Array, "n samples"], others: Float[Array, "m samples"] | None = None, tolerance: float = 1e-9
) -> Float[Array, "n samples"]:
    """Make rows orthonormal, and orthogonal to `others`, which are orthonormal, by Gram-Schmidt, applied twice.

    A row becomes 0 if no more than the fraction `tolerance` of it remains, which may be rounding. Unlike LAPACK, this
    vectorises over many small matrices.
    """
    xp, basis = array_module(rows), rows[:0]
    least, rest = tolerance * xp.linalg.norm(rows, axis=1), rows
    if others is not None:
        for _ in range(2):
            rest = rest - (rest @ others.T) @ others
    for row, min_length in zip(rest, least, strict=True):
        for _ in range(2):
            row = row - (basis @ row) @ basis
        length = xp.linalg.norm(row)
        basis = xp.vstack([basis, row / xp.where(length > min_length, length, xp.inf)])
    return basis
