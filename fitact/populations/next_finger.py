"""The next finger of a population: its force, and what of the spread is people and what is ignorance."""

import dataclasses
import math
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.fitting import derived
from fitact.fitting.drive_choice import whole_periods
from fitact.fitting.fit import Fit
from fitact.likelihood.likelihood import Batched
from fitact.model.drive import Periodic, Sampled
from fitact.populations.finger import SHARED, SKIN
from fitact.populations.finger_likelihoods import Law

AREA = "contact_area"
THICKNESSES = ("skin_thickness", "insulator_thickness")
FACTORS = (*SKIN, SHARED, AREA, *THICKNESSES)  # Rsc, Csc and Ci at the median area and thickness; the others over it
NAMES = (*SKIN, *derived.NAMES)
HARMONICS = ("force_at_f", "force_at_2f", "friction_at_f", "friction_at_2f")
_BATCH = 512  # fingers evaluated at a time


class NewFinger(eqx.Module):
    """What follows from the logarithms of a finger's `factors`: all of `names`, SI units.

    Attributes:
        derive: of a fit, without its record's charge.
        theta, sigma: of the fit; what is not the finger's stays as it is.
        factors: which of `FACTORS`, in that order.
        frequency: of the drive, Hz; None: it does not repeat.
    """

    derive: derived.Derived
    theta: Float[Array, " parameters"]
    sigma: Float[Array, " traces"]
    factors: tuple[str, ...] = eqx.field(static=True)
    frequency: float | None = eqx.field(static=True)

    @classmethod
    def under_drive_of(cls, fit: Fit, factors: tuple[str, ...]) -> Self:
        """A measured drive that repeats is taken to go on doing so."""
        derive = fit.derive
        if derive.charge:
            kept, period = whole_periods(fit.record)
            if period is not None:
                drive = Sampled(fit.record.time[:kept], fit.record["V"][:kept], period)
                derive = dataclasses.replace(derive, drive=drive, steady_state=True)
            derive = dataclasses.replace(derive, charge=False)
        frequency = None
        if isinstance(derive.drive, Periodic) and derive.steady_state:
            frequency = float(derive.drive.frequency)
        elif isinstance(derive.drive, Sampled) and whole_periods(fit.record)[1] is not None:
            frequency = float(fit.record.frequency() or math.nan)
        with jax.enable_x64(True):
            sigma = jnp.asarray([trace.sigma for trace in fit.traces])
            return cls(derive, jnp.asarray(fit.theta), sigma, factors, frequency)

    @property
    def names(self) -> tuple[str, ...]:
        """Of what follows: `NAMES`, and where the drive repeats the amplitudes at its frequency and twice that."""
        return NAMES if self.frequency is None else (*NAMES, *HARMONICS)

    def of(self, factors: Float[Array, " factors"]) -> tuple[derived.Derived, Float[Array, " parameters"]]:
        """Its geometry and circuit; area and thickness scale the latter by eqs. (3) and (4)."""
        by_name = dict(zip(self.factors, factors, strict=True))
        area, skin, insulator = (by_name.get(name, 0.0) for name in FACTORS[3:])
        at = jnp.stack([by_name["Rsc"] - area, by_name["Csc"] + area, by_name["Ci"] + area - insulator])
        places = np.array([self.derive.likelihood.names.index(name) for name in (*SKIN, SHARED)])
        geometry = self.derive.geometry
        thicker = dataclasses.replace(
            geometry,
            skin_thickness=geometry.skin_thickness * jnp.exp(skin),
            insulator_thickness=geometry.insulator_thickness * jnp.exp(insulator),
        )
        return dataclasses.replace(self.derive, geometry=thicker), self.theta.at[places].set(at)

    def __call__(self, factors: Float[Array, " factors"]) -> Float[Array, " names"]:
        """All of `names`."""
        derive, theta = self.of(factors)
        skin = jnp.exp(theta[np.array([derive.likelihood.names.index(name) for name in SKIN])])
        parts = [skin, derive(theta, self.sigma)]
        if self.frequency is not None:
            turn = jnp.exp(2j * jnp.pi * self.frequency * jnp.outer(jnp.array([1.0, 2.0]), derive.time))
            tones = 2.0 * jnp.abs(turn @ (derive.weight * derive.force(theta, self.sigma)))
            parts += [tones, derive.coefficient * tones]
        return jnp.concatenate(parts)

    def each(self, factors: Float[np.ndarray, "*shape factors"]) -> Float[np.ndarray, "*shape names"]:
        """Of many fingers."""
        with jax.enable_x64(True):
            flat = factors.reshape(-1, factors.shape[-1])
            found = Batched(NewFinger.__call__, self, self.derive.time.size, _BATCH)(flat)
        return found.reshape(*factors.shape[:-1], len(self.names))

    def force_in_time(
        self, factors: Float[np.ndarray, "fingers factors"], count: int
    ) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, "fingers count"]]:
        """Times (s) and force (N) of many fingers over the last period (all of a drive that has none)."""
        with jax.enable_x64(True):
            first, last = float(jnp.min(self.derive.time)), float(jnp.max(self.derive.time))
            span = last - first if self.frequency is None else 1.0 / self.frequency
            time = span * np.arange(count) / count
            start = 0.0 if isinstance(self.derive.drive, Periodic) else last - span
            there = dataclasses.replace(self.derive, time=jnp.asarray(start + time))
            force = Batched(_force, dataclasses.replace(self, derive=there), count, _BATCH)(factors)
        return time, force


def _force(finger: NewFinger, factors: Float[Array, " factors"]) -> Float[Array, " times"]:
    derive, theta = finger.of(factors)
    return derive.force(theta, finger.sigma)


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


def draw_factors(
    law: Law, thickness_sd: dict[str, float], fingers: int, random: np.random.Generator
) -> Float[np.ndarray, "laws fingers factors"]:
    """Logarithms of the factors of some fingers of each law (whose leaves are (laws, 1)).

    `thickness_sd`: log-standard deviation of each of `THICKNESSES` that is a factor.
    """
    white = random.standard_normal((len(law.median), fingers, 3))
    thicknesses = [sd * random.standard_normal(white.shape[:2]) for sd in thickness_sd.values()]
    return np.concatenate([factors_of(law, white), *(each[..., None] for each in thicknesses)], axis=-1)


def factors_of(law: Law, white: Float[np.ndarray, "laws fingers 3"]) -> Float[np.ndarray, "laws fingers factors"]:
    """Logarithms of Rsc, Csc, Ci and, where it varies, area of the fingers that standard normal numbers draw."""
    r = law.correlation
    second = r * white[..., 0] + np.sqrt(1.0 - r**2) * white[..., 1]
    skin = law.median + law.log_sd * np.stack([white[..., 0], second], axis=-1)
    factors = [skin[..., 0], skin[..., 1], np.broadcast_to(law.log_Ci, second.shape)]
    if law.area is not None:
        factors.append(law.area * white[..., 2])
    return np.stack(factors, axis=-1)
