"""Uncertainty budget: the contribution of each source of error to the uncertainty of a quantity.

In the Laplace approximation, the error of ln q is a sum of independent errors. The component of an error x with the
standard uncertainty u(x) is Cov(ln q, x) / u(x), and noise contributes its own. Their squares add up to the square of
the combined standard uncertainty of ln q, also where the data have determined a part of x.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, Self

import numpy as np
import scipy
from jaxtyping import Float

from fitact.prior.distributions import Distribution, LogNormal
from fitact.prior.product import multiply


@dataclasses.dataclass(frozen=True)
class Component:
    """Contribution of one source to the uncertainty of the logarithm of a quantity."""

    source: str
    type: Literal["A", "B"]  # A: from repeated observations; B: from other knowledge (JCGM 100:2008, 3.3.4)
    input_u: float  # standard uncertainty of the source, relative
    sensitivity: float  # d ln q / d ln x; the component is its product with `input_u`
    distribution: Distribution | None = None  # of the source; None means normal
    reduce_by: str = ""
    in_posterior: bool = True  # whether the posterior includes it
    is_shared: bool = False  # whether it is the same error in all records of a session
    origin: str = ""  # what it comes from in a few words, such as "data" or "default Ci"; "" means its source

    @classmethod
    def from_prior(cls, source: str, prior: Distribution, reduce_by: str, power: float = 1.0, **known: Any) -> Self:
        """Return the component of the factor with this `prior`, with its power in a parameter, in that parameter."""
        return cls(source, "B", float(prior.log_sd), power, prior, reduce_by, **known)

    @property
    def u(self) -> float:
        """Component of the standard uncertainty of ln q."""
        return abs(self.sensitivity) * self.input_u


@dataclasses.dataclass(frozen=True)
class Budget:
    """Sources of the uncertainty of one quantity.

    Attributes:
        components: sources in the posterior, in what force and friction rest on, and in the structure of residuals.
        unstated: usual errors of instruments that nobody stated.
    """

    components: tuple[Component, ...]
    unstated: tuple[Component, ...] = ()

    @property
    def u(self) -> float:
        """Standard uncertainty of the logarithm of the quantity from `components`."""
        return math.hypot(*(component.u for component in self.components))

    @functools.cached_property
    def combined_budget(self) -> "Budget":
        """Budget in which the unstated errors are components, as one would sign it."""
        return Budget((*self.components, *self.unstated))

    def origins(self) -> dict[str, float]:
        """Return the fractions of the variance by what they come from, to four digits, largest first."""
        parts: dict[str, float] = {}
        for each in self.components:
            name = each.origin or each.source
            parts[name] = parts.get(name, 0.0) + each.u**2
        total = sum(parts.values())
        ranked = sorted(
            ((name, round(x / total, 4)) for name, x in parts.items() if x > 0.0), key=lambda item: -item[1]
        )
        return {name: fraction for name, fraction in ranked if fraction > 0.0}

    def scale_posterior(self, log_sd: float) -> "Budget":
        """Return the budget with the posterior's components scaled to the standard deviation `log_sd` of its draws."""
        expected = math.hypot(*(each.u for each in self.components if each.in_posterior))
        factor = log_sd / expected if expected > 0.0 else 1.0
        scaled = (
            dataclasses.replace(each, sensitivity=factor * each.sensitivity) if each.in_posterior else each
            for each in self.components
        )
        return Budget(tuple(scaled), self.unstated)

    def subtract(self, other: "Budget") -> "Budget":
        """Return the budget of the ratio to another quantity of the same session, in which shared errors cancel."""
        shared = {each.source: each for each in other.components if each.is_shared}
        rows = []
        for each in self.components:
            twin = shared.pop(each.source, None) if each.is_shared else None
            change = 0.0 if twin is None else twin.sensitivity
            rows.append(dataclasses.replace(each, sensitivity=each.sensitivity - change))
        rest = [*shared.values(), *(each for each in other.components if not each.is_shared)]
        rows += [dataclasses.replace(each, sensitivity=-each.sensitivity) for each in rest]
        return Budget(tuple(rows))

    def draw_others(self, deviates: Mapping[str, Float[np.ndarray, "*shape"]]) -> Float[np.ndarray, "*shape"]:
        """Return draws of the factor by which the sources beyond the posterior change the quantity.

        `deviates` are standard normal numbers by source, so that quantities with the same source change together.
        """
        logs: Any = 0.0
        for each in self.components:
            if not each.in_posterior:
                z, x = deviates[each.source], each.distribution
                deviation = each.input_u * z if x is None else np.asarray(x.from_standard_normal(z)) - x.log_mean
                logs = logs + each.sensitivity * deviation
        return np.exp(logs)

    def quantiles(self, probabilities: Iterable[float], *, only_posterior: bool = False) -> Float[np.ndarray, " n"]:
        """Return quantiles of the quantity over its estimate, from the convolution of all components."""
        z = scipy.special.ndtri(np.array(list(probabilities)))
        product = self._posterior_factor if only_posterior else self._factor
        return np.exp(np.asarray(product.from_standard_normal(z)) - product.log_mean)

    @functools.cached_property
    def _factor(self) -> Distribution:
        """Distribution of the quantity over its estimate, by all components."""
        return _convolve(self.components)

    @functools.cached_property
    def _posterior_factor(self) -> Distribution:
        """The same by those components that the posterior includes."""
        chosen = tuple(each for each in self.components if each.in_posterior)
        return self._factor if len(chosen) == len(self.components) else _convolve(chosen)

    def to_dict(self, median: float, interval: tuple[float, float] | None = None) -> dict[str, Any]:
        """Return the entry of a quantity in `budget` of fit.json and summary.json, largest component first."""
        total = self.u
        low, high = interval or (median * self.quantiles((0.025, 0.975))).tolist()
        rows = [
            {
                "source": each.source,
                "type": each.type,
                "input_u": each.input_u,
                "sensitivity": each.sensitivity,
                "u": each.u,
                "share": (each.u / total) ** 2 if total > 0.0 else 0.0,
                "reduce_by": each.reduce_by,
            }
            for each in sorted(self.components, key=lambda each: -each.u)
        ]
        return {"u": total, "interval95": [low, high], "components": rows}


def _convolve(components: Sequence[Component], min_part: float = 0.1, cells: int = 1024) -> Distribution:
    """Return the distribution of a quantity over its estimate; `cells` is the size of its table.

    Components below `min_part` of the total hardly change the shape, and count as normal.
    """
    total = math.hypot(*(each.u for each in components))
    shaped = [
        each for each in components if each.u > min_part * total and not isinstance(each.distribution, LogNormal | None)
    ]
    if not shaped:
        return LogNormal(1.0, max(total, 1e-300))
    rest = math.sqrt(max(total**2 - sum(each.u**2 for each in shaped), 0.0))
    normal = [(LogNormal(1.0, rest), 1.0)] if rest > 1e-3 * total else []  # a narrower one has no effect
    factors = [(each.distribution, each.sensitivity) for each in shaped if each.distribution is not None]
    return multiply([*normal, *factors], cells=cells)


def laplace_components(
    gradient: Float[np.ndarray, " parameters"],
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    prior_factor: Float[np.ndarray, "parameters parameters"],
    sources: Sequence[Sequence[Component]],
    noise: Mapping[str, Float[np.ndarray, "rows parameters"]],
) -> tuple[Component, ...]:
    """Return the components of a quantity whose logarithm has this `gradient` in the parameters.

    `sources` holds the errors that each parameter is the product of. Parameters with correlated priors are one source.
    `noise` holds a root of the information of each source of noise, such as the Jacobian of its whitened residuals.
    """
    covariance = covariance_factor @ (covariance_factor.T @ gradient)  # of ln q with each parameter
    precision = np.linalg.inv(prior_factor @ prior_factor.T)
    components = [_noise_component(name, float(np.linalg.norm(root @ covariance))) for name, root in noise.items()]
    for block in _independent_blocks(precision):
        part = covariance[block]
        if len(block) > 1:
            names = [each.source for i in block for each in sources[i]]
            u = math.sqrt(part @ precision[np.ix_(block, block)] @ part)
            components.append(Component(f"{' and '.join(names)} (correlated)", "B", u, 1.0))
            continue
        place, variance = block[0], 1.0 / precision[block[0], block[0]]
        stated = sum(each.u**2 for each in sources[place])
        for each in sources[place]:
            u = each.input_u * math.sqrt(variance / stated)  # larger than its own in a fit without prior
            # the product and each of its factors have the same sensitivity
            sensitivity = float(each.sensitivity * part[0] / variance)
            components.append(dataclasses.replace(each, input_u=u, sensitivity=sensitivity))
    return tuple(components)


def _noise_component(name: str, u: float) -> Component:
    remedy = "record longer: four times as much data halves it"
    return Component(name, "A", u, 1.0, None, remedy, origin="data")


def _independent_blocks(precision: Float[np.ndarray, "n n"]) -> list[list[int]]:
    """Return the groups of parameters whose priors are correlated."""
    root = np.sqrt(np.diagonal(precision))
    _, labels = scipy.sparse.csgraph.connected_components(np.abs(precision) > 1e-9 * np.outer(root, root))
    return [np.flatnonzero(labels == label).tolist() for label in np.unique(labels)]
