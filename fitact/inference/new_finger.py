"""The next finger of a population: its force, and what of the spread is people and what is ignorance."""

import dataclasses
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.inference import derived
from fitact.inference.fingers import SHARED, SKIN
from fitact.inference.fit import Fit
from fitact.inference.likelihood import Batched
from fitact.inference.start import whole_periods
from fitact.model.drive import Sampled

AREA = "contact_area"
FACTORS = (*SKIN, SHARED, AREA)  # Rsc and Csc at the median area, Ci of the panel there, the area over the median
NAMES = (*SKIN, *derived.NAMES)
_BATCH = 512  # fingers evaluated at a time
_BASE = 4096  # points of Sobol's sequence


class NewFinger(eqx.Module):
    """What follows from the logarithms of a finger's `FACTORS`: all of `NAMES`, SI units.

    Attributes:
        derive: of a fit, without its record's charge.
        theta, sigma: of the fit; what is not the finger's stays as it is.
    """

    derive: derived.Derived
    theta: Float[Array, " parameters"]
    sigma: Float[Array, " traces"]

    @classmethod
    def under_drive_of(cls, fit: Fit) -> Self:
        """A measured drive that repeats is taken to go on doing so."""
        derive = fit.derive
        if derive.charge:
            kept, period = whole_periods(fit.record)
            if period is not None:
                drive = Sampled(fit.record.time[:kept], fit.record["V"][:kept], period)
                derive = dataclasses.replace(derive, drive=drive, steady_state=True)
            derive = dataclasses.replace(derive, charge=False)
        return cls(derive, jnp.asarray(fit.theta), jnp.asarray([trace.sigma for trace in fit.traces]))

    def __call__(self, factors: Float[Array, " factors"]) -> Float[Array, " names"]:
        """Area scales both capacitances up and the resistance down; without one it is the median's."""
        area = factors[3] if factors.size > 3 else 0.0
        skin = factors[:3] + jnp.array([-1.0, 1.0, 1.0]) * area
        places = np.array([self.derive.likelihood.names.index(name) for name in (*SKIN, SHARED)])
        theta = self.theta.at[places].set(skin)
        return jnp.concatenate([jnp.exp(skin[:2]), self.derive(theta, self.sigma)])

    def each(self, factors: Float[np.ndarray, "*shape factors"]) -> Float[np.ndarray, "*shape names"]:
        """Of many fingers."""
        with jax.enable_x64(True):
            flat = factors.reshape(-1, factors.shape[-1])
            found = Batched(NewFinger.__call__, self, self.derive.time.size, _BATCH)(flat)
        return found.reshape(*factors.shape[:-1], len(NAMES))


class Spread(NamedTuple):
    """The variance of a quantity of the next finger, by the law of total variance.

    Attributes:
        people: E[Var[x | law]], of fingers about their population's mean.
        ignorance: Var[E[x | law]], of that mean, since the law is not known.
    """

    people: float
    ignorance: float

    @classmethod
    def of(cls, values: Float[np.ndarray, "laws fingers"]) -> Self:
        """Of fingers drawn from each law; what the few of each leave in their mean is taken off."""
        people = float(np.mean(np.var(values, axis=1, ddof=1)))
        between = float(np.var(np.mean(values, axis=1), ddof=1))
        return cls(people, max(between - people / values.shape[1], 0.0))

    @property
    def share_of_people(self) -> float:
        """Of the variance."""
        return self.people / (self.people + self.ignorance)


def variance_shares(
    finger: NewFinger, factors: Float[np.ndarray, "fingers factors"], names: tuple[str, ...], seed: int
) -> dict[str, dict[str, dict[str, float]]]:
    """First-order and total shares of each factor in the variance of quantities `names`, with 95 % errors.

    The factors are taken as normal with the mean and covariance of `factors`. Where they depend on each other, first
    is Var(E[y | x]) and total E[Var(y | others)] over the variance of y (Kucherenko, Tarantola, Annoni 2012): Sobol's
    indices, by SALib, of independent normal numbers that build the factors one after the other. That of the first
    holds what x shares with the others, that of the last what is x's alone (Mara, Tarantola 2012).
    """
    import SALib.analyze.sobol
    import SALib.sample.sobol
    from scipy.special import ndtri

    size = factors.shape[1]
    problem = {"num_vars": size, "names": list(FACTORS[:size]), "bounds": [[0.0, 1.0]] * size}
    shares = SALib.sample.sobol.sample(problem, _BASE, calc_second_order=False, seed=seed)
    scores = ndtri(np.clip(shares, 1e-12, 1.0 - 1e-12))
    mean, covariance = factors.mean(axis=0), np.cov(factors.T)
    keys = ("first", "first_error", "total", "total_error")
    found = {name: {factor: dict.fromkeys(keys, 0.0) for factor in FACTORS[:size]} for name in names}
    for turn in range(size):
        order = np.roll(np.arange(size), -turn)
        root = np.linalg.cholesky(covariance[np.ix_(order, order)])
        points = np.empty_like(scores)
        points[:, order] = mean[order] + scores @ root.T
        values = finger.each(points)
        for name in names:
            y = values[:, NAMES.index(name)]
            indices = SALib.analyze.sobol.analyze(problem, y / np.std(y), calc_second_order=False, seed=seed)
            for key, symbol, place in (("first", "S1", 0), ("total", "ST", size - 1)):
                shown = found[name][FACTORS[order[place]]]
                shown |= {key: float(indices[symbol][place])}
                shown |= {f"{key}_error": float(indices[f"{symbol}_conf"][place])}
    return found
