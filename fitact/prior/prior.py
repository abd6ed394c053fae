"""Joint prior of the log-parameters."""

import graphlib
import itertools
import math
import statistics
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import double_precision, solve_lower
from fitact.errors import InputError
from fitact.prior.distributions import Distribution


class Prior(eqx.Module):
    """Joint prior of named parameters, independent or correlated, as `Prior.from_marginals(Rsc=..., Csc=...)` makes it.

    Correlations apply to the standard normal z of each parameter (a Gaussian copula), so they do not change the
    marginals. If all marginals are log-normal, the logarithms are multivariate normal with these correlations.

    Attributes:
        names: parameters, in the order of the chain.
        marginals: marginal prior of each parameter.
        pairs: (name, other, correlation) of correlated parameters.
        order_constraints: (lower, higher) pairs of parameters whose values must be in this order. The density is zero
            elsewhere and otherwise not renormalised; moments, covariance and residuals ignore the constraints.

    Raises:
        InputError: a pair names unknown parameters, or correlations or order constraints contradict each other.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    marginals: tuple[Distribution, ...]
    pairs: tuple[tuple[str, str, float], ...] = eqx.field(static=True, default=())
    order_constraints: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        for name, other, *_ in (*self.pairs, *self.order_constraints):
            if name == other or not {name, other} <= set(self.names):
                raise InputError(
                    f"[prior] cannot correlate or order {name} and {other}; name two of its free parameters,"
                    f" {', '.join(self.names)}"
                )
        sorter = graphlib.TopologicalSorter[str]()
        for lower, higher in self.order_constraints:
            sorter.add(higher, lower)
        try:
            sorter.prepare()
        except graphlib.CycleError as error:
            stated = " < ".join(error.args[1])
            raise InputError(
                f"[prior] the order {stated} contradicts itself; remove one of these constraints"
            ) from None
        # a sign test alone would accept a matrix that is singular within rounding
        if self.pairs and not np.linalg.eigvalsh(self.correlation)[0] >= 1e-9:
            stated = ", ".join(f"{name}-{other} {value:+g}" for name, other, value in self.pairs)
            raise InputError(
                f"[prior] the correlations {stated} contradict each other (their matrix is not positive definite);"
                " bring them nearer to 0"
            )

    @classmethod
    def from_marginals(
        cls,
        correlation: Mapping[tuple[str, str], float] | None = None,
        order_constraints: tuple[tuple[str, str], ...] = (),
        /,
        **marginals: Distribution,
    ) -> "Prior":
        """Return the prior with these marginals, and the correlations of pairs such as ``{("Rsc", "Csc"): -0.6}``."""
        pairs = tuple((name, other, float(value)) for (name, other), value in (correlation or {}).items())
        return cls(tuple(marginals), tuple(marginals.values()), pairs, order_constraints)

    def replace_marginals(self, **marginals: Distribution) -> "Prior":
        """Return the prior with these marginals replaced or appended."""
        merged = dict(zip(self.names, self.marginals, strict=True)) | marginals
        return Prior(tuple(merged), tuple(merged.values()), self.pairs, self.order_constraints)

    def drop_marginals(self, *names: str) -> "Prior":
        """Return the prior without the parameters of these names."""
        kept = {n: m for n, m in zip(self.names, self.marginals, strict=True) if n not in names}
        return Prior(tuple(kept), tuple(kept.values()), self.pairs, self.order_constraints)

    def __getitem__(self, name: str) -> Distribution:
        return self.marginals[self.names.index(name)]

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlation matrix of the standard normal z."""
        matrix = np.eye(len(self.names))
        for name, other, value in self.pairs:
            i, j = self.names.index(name), self.names.index(other)
            matrix[i, j] = matrix[j, i] = value
        return matrix

    @property
    def log_mean(self) -> Float[np.ndarray, " parameters"]:
        """Mean of each log-parameter."""
        return np.array([marginal.log_mean for marginal in self.marginals])

    @property
    def log_sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviation of each log-parameter."""
        return np.array([marginal.log_sd for marginal in self.marginals])

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of the log-parameters.

        For u(z) = sum_k a_k He_k(z) / sqrt(k!), Mehler's formula gives cov(u_i, u_j) = sum_k a_ik a_jk r_ij^k.
        """
        variance = np.diag(self.log_sd**2)
        if not self.pairs:
            return variance
        z, weight = np.polynomial.hermite_e.hermegauss(96)
        powers = np.arange(1, 24)
        polynomials = np.polynomial.hermite_e.hermevander(z, powers[-1])[:, 1:]
        polynomials = polynomials / np.sqrt(np.cumprod(powers, dtype=float))
        with jax.ensure_compile_time_eval(), double_precision():
            logs = np.array([marginal.from_standard_normal(z) for marginal in self.marginals])
        coefficients = logs @ (polynomials * (weight / math.sqrt(2.0 * math.pi))[:, None])
        joint = np.einsum("ik,jk,ijk->ij", coefficients, coefficients, self.correlation[..., None] ** powers)
        return np.where(np.eye(len(self.names)), variance, joint)

    def log_density(self, u: Float[Array, " parameters"]) -> Float[Array, ""]:
        """Return the log-density of the log-parameters; -inf outside the bounds or the order constraints."""
        value = sum((marginal.log_density(u[i]) for i, marginal in enumerate(self.marginals)), jnp.zeros(()))
        for lower, higher in self.order_constraints:
            value = jnp.where(u[self.names.index(lower)] < u[self.names.index(higher)], value, -jnp.inf)
        if not self.pairs:
            return value
        z = jnp.stack([marginal.to_standard_normal(u[i]) for i, marginal in enumerate(self.marginals)])
        root = np.linalg.cholesky(self.correlation)
        whitened = solve_lower(root, z)
        return value - 0.5 * (whitened @ whitened - z @ z) - np.log(np.diag(root)).sum()

    def residuals(self, u: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """Return the log-parameters whitened by mean and covariance (residuals of the normal prior)."""
        scaled = jnp.array([marginal.standardize(u[i]) for i, marginal in enumerate(self.marginals)])
        if not self.pairs:
            return scaled
        # only correlated marginals are constants of a compiled program
        names = {name for name, other, _ in self.pairs} | {other for _, other, _ in self.pairs}
        places = np.array([place for place, name in enumerate(self.names) if name in names])
        correlated = Prior(tuple(self.names[i] for i in places), tuple(self.marginals[i] for i in places), self.pairs)
        root = np.linalg.cholesky(correlated.covariance)
        return scaled.at[places].set(solve_lower(root, u[places] - correlated.log_mean))

    def sample(self, rng: np.random.Generator, size: int) -> dict[str, Float[np.ndarray, " size"]]:
        """Return draws of the parameters by name; raise InputError if almost none satisfy the order constraints."""
        return self._sample_ordered(lambda: rng.standard_normal((len(self.names), size)), size)

    def sample_qmc(self, size: int) -> dict[str, Float[np.ndarray, " size"]]:
        """Return a deterministic quasi-random sample (Kronecker sequence of M. Roberts, 2018, as standard normals)."""
        axes = np.arange(1, len(self.names) + 1)
        ratio = 2.0
        for _ in range(64):  # fixed-point iteration; each step reduces the error by a factor of 2 or more
            ratio = (1.0 + ratio) ** (1.0 / (axes.size + 1))
        count = itertools.count()

        def scores() -> np.ndarray:
            number = next(count) * size + np.arange(1, size + 1)
            share = (0.5 + number * ratio ** -axes[:, None].astype(float)) % 1.0
            return np.vectorize(statistics.NormalDist().inv_cdf, otypes=[float])(share)

        return self._sample_ordered(scores, size)

    def _sample_ordered(
        self, scores: Callable[[], Float[np.ndarray, "parameters size"]], size: int, max_rounds: int = 1000
    ) -> dict[str, Float[np.ndarray, " size"]]:
        """Return the first `size` parameter sets at `scores()` that satisfy the order constraints."""
        kept, root = {name: np.zeros(0) for name in self.names}, np.linalg.cholesky(self.correlation)
        for _ in range(1 + max_rounds):
            pairs = zip(self.names, self.marginals, root @ scores(), strict=True)
            with double_precision():
                draws = {name: np.exp(np.asarray(marginal.from_standard_normal(z))) for name, marginal, z in pairs}
            in_order = np.ones(size, dtype=bool)
            for low, high in self.order_constraints:
                in_order &= draws[low] < draws[high]
            kept = {name: np.append(kept[name], values[in_order]) for name, values in draws.items()}
            if all(values.size >= size for values in kept.values()):
                return {name: values[:size] for name, values in kept.items()}
        stated = ", ".join(f"{lower} < {higher}" for lower, higher in self.order_constraints)
        raise InputError(f"almost no prior draws satisfy the order {stated}; widen the priors, or remove a constraint")
