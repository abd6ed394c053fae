"""Normal effects of nested levels: integrated out of the likelihood of linear models, and drawn given its parameters.

The likelihood of a touch is exp(-|T (1, beta) - G e|^2 / 2), with beta the coefficients that all touches share and e
the sum of the effects of its levels. An effect is L z with standard normal z; each element of z is integrated out by
itself, from the touches up. What is left over a level's unit is the product over the units below it.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class NestedEffects(eqx.Module):
    """Units of nested levels, from the top to the touches; each unit of a level belongs to one of the level above."""

    parents: tuple[Int[Array, " units"], ...]  # for each level below the top
    counts: tuple[int, ...] = eqx.field(static=True)  # number of units of each level

    def integrate(
        self,
        loadings: Float[Array, "touches 3 components"],
        rows: Float[Array, "touches 3 coefficients"],
        roots: Float[Array, "levels components components"],
    ) -> "IntegratedEffects":
        """Integrate the effects out; `loadings` is G, `rows` T, and `roots` the L of each level."""
        bottom = len(self.counts) - 1
        steps: list[_Step] = []
        log_norm = jnp.zeros(())
        G, T = loadings, rows
        for column in roots[bottom].T:  # in rows, which lose no digits where a touch is known far better than its level
            a = G @ column
            r = jnp.sqrt(1.0 + jnp.sum(jnp.square(a), axis=-1, keepdims=True))
            steps.append(_Step(jnp.einsum("ti,tij->tj", a, T), jnp.einsum("ti,tij->tj", a, G), r[:, 0], column))
            share = a / (r * (r + 1.0))  # (1 - 1 / r) / (r^2 - 1) of a
            T = T - share[..., None] * steps[-1].information[:, None]
            G = G - share[..., None] * steps[-1].precision[:, None]
            log_norm = log_norm - jnp.sum(jnp.log(r))
        J, H = jnp.einsum("tij,tik->tjk", G, G), jnp.einsum("tij,tik->tjk", G, T)
        square = jnp.einsum("tij,tik->jk", T, T)
        for level in range(bottom - 1, -1, -1):
            J, H = (jax.ops.segment_sum(each, self.parents[level], num_segments=self.counts[level]) for each in (J, H))
            for column in roots[level].T:
                steps.append(_Step(column @ H, J @ column, jnp.sqrt(1.0 + (J @ column) @ column), column))
                information, precision, r, _ = steps[-1]
                gain = 1.0 / jnp.square(r)[:, None]
                square = square - (gain * information).T @ information
                H = H - precision[:, :, None] * (gain * information)[:, None]
                J = J - precision[:, :, None] * (gain * precision)[:, None]
                log_norm = log_norm - jnp.sum(jnp.log(r))
        return IntegratedEffects(square, log_norm, tuple(steps))

    def draw(
        self,
        integrated: "IntegratedEffects",
        coefficients: Float[Array, " coefficients"],
        deviates: tuple[Float[Array, "units components"], ...],
    ) -> tuple[Float[Array, "units components"], ...]:
        """Draw the sums of the effects down to each level, given all touches; `coefficients` is (1, beta)."""
        components, sums = deviates[0].shape[1], []
        total = jnp.zeros((self.counts[0], components))
        for level, z in enumerate(deviates):
            if level:
                total = total[self.parents[level - 1]]
            first = (len(self.counts) - 1 - level) * components
            for component in range(components - 1, -1, -1):
                information, precision, r, column = integrated.steps[first + component]
                mean = (information @ coefficients - jnp.sum(precision * total, axis=1)) / jnp.square(r)
                total = total + (mean + z[:, component] / r)[:, None] * column
            sums.append(total)
        return tuple(sums)


class _Step(NamedTuple):
    """An element z of the effects of a level, before it is integrated out.

    Given the sum v of the effects that are integrated out later, z has the precision r^2 and the mean
    (information (1, beta) - precision v) / r^2.
    """

    information: Float[Array, "units coefficients"]
    precision: Float[Array, "units components"]
    r: Float[Array, " units"]
    column: Float[Array, " components"]  # of L


class IntegratedEffects(NamedTuple):
    """Likelihood without the effects: log = log_norm - (1, beta) square (1, beta)^T / 2, and what draws them."""

    square: Float[Array, "coefficients coefficients"]
    log_norm: Float[Array, ""]
    steps: tuple[_Step, ...]
