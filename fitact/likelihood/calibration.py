"""Information on the errors of instruments from records of dummy circuits, as a quadratic form in their coordinates."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float


class Calibration(eqx.Module):
    """Log-likelihood -|root (x - center) + offset|^2 / 2 of the coordinates `names`, from other records."""

    root: Float[Array, "rows coordinates"]
    center: Float[Array, " coordinates"]
    offset: Float[Array, " rows"]
    names: tuple[str, ...] = eqx.field(static=True)

    def residuals(self, theta: Float[Array, " parameters"], names: Sequence[str]) -> Float[Array, " rows"]:
        """Return the residuals at theta, whose coordinates are `names`."""
        return self.root @ (theta[self._places(names)] - self.center) + self.offset

    def jacobian(self, names: Sequence[str]) -> Float[np.ndarray, "rows parameters"]:
        """Return the derivatives of the residuals in coordinates `names`."""
        rows = np.zeros((len(self.root), len(names)))
        rows[:, self._places(names)] = self.root
        return rows

    def _places(self, names: Sequence[str]) -> np.ndarray:
        return np.array([list(names).index(name) for name in self.names])
