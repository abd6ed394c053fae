"""The next finger of a population: its force, and the variance between fingers and from the population parameters."""

import dataclasses
import math
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator, array_module, double_precision
from fitact.fitting import derived
from fitact.fitting.result import Fit
from fitact.model.drive import Periodic, Sampled
from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.finger_likelihoods import PopulationParameters
from fitact.problem.drive_choice import whole_periods

AREA = "contact_area"
THICKNESSES = ("skin_thickness", "insulator_thickness")
FACTORS = (*SKIN, SHARED_PARAMETER, AREA, *THICKNESSES)  # the first three are at the median area and thickness
FRICTION = ("mu", "fN", "force_scale")  # parameters of a measured friction on which the computed one depends
NAMES = (*SKIN, *derived.DERIVED_NAMES)
HARMONICS = ("force_at_f", "force_at_2f", "friction_at_f", "friction_at_2f")


class NewFingerModel(eqx.Module):
    """Model of the quantities `names` (SI units) as functions of the logarithms of a finger's `factors`."""

    derive: derived.DerivedQuantities  # of a fit, without the record's initial charge
    theta: Float[Array, " parameters"]  # of the fit; those that are not the finger's stay fixed
    sigma: Float[Array, " traces"]
    factors: tuple[str, ...] = eqx.field(static=True)  # subset of `FACTORS`, in that order
    frequency: float | None = eqx.field(static=True)  # of the drive, Hz; None means that it does not repeat

    @classmethod
    def from_fit(cls, fit: Fit, factors: tuple[str, ...]) -> Self:
        """Make the model from a fit; a measured drive that repeats is continued periodically.

        Friction is computed with the scene's coefficient and normal force, since those that were fitted are one
        finger's.
        """
        derive = fit.derive
        if derive.charge:
            samples, period = whole_periods(fit.record)
            if period is not None:
                drive = Sampled(fit.record.time[:samples], fit.record["V"][:samples], period)
                derive = dataclasses.replace(derive, drive=drive, steady_state=True)
            derive = dataclasses.replace(derive, charge=False)
        frequency = None
        if isinstance(derive.drive, Periodic) and derive.steady_state:
            frequency = float(derive.drive.frequency)
        elif isinstance(derive.drive, Sampled) and whole_periods(fit.record)[1] is not None:
            frequency = float(fit.record.frequency() or math.nan)
        theta, stated = fit.theta.copy(), fit.scene.nominal_values()
        for name in FRICTION:
            if name in fit.names:
                theta[fit.names.index(name)] = math.log(float(stated[name] or 1.0))
        return cls(derive, theta, np.array([trace.sigma for trace in fit.traces]), factors, frequency)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities; with a periodic drive also the amplitudes at its frequency and twice that."""
        return NAMES if self.frequency is None else (*NAMES, *HARMONICS)

    def apply_factors(
        self, factors: Float[Array, " factors"]
    ) -> tuple[derived.DerivedQuantities, Float[Array, " parameters"]]:
        """Return a finger's derived quantities and parameters; area and thickness scale these by eqs. (3) and (4)."""
        by_name = self._factors_by_name(factors)
        skin, insulator = (by_name.get(name, 0.0) for name in THICKNESSES)
        geometry = self.derive.geometry
        thicker = dataclasses.replace(
            geometry,
            skin_thickness=geometry.skin_thickness * jnp.exp(skin),
            insulator_thickness=geometry.insulator_thickness * jnp.exp(insulator),
        )
        return dataclasses.replace(self.derive, geometry=thicker), self._theta(factors)

    def _theta(self, factors: Float[Array, "*shape factors"]) -> Float[Array, "*shape parameters"]:
        by_name, xp = self._factors_by_name(factors), array_module(factors)
        area, insulator = by_name.get(AREA, 0.0), by_name.get(THICKNESSES[1], 0.0)
        logs = {"Rsc": by_name["Rsc"] - area, "Csc": by_name["Csc"] + area, "Ci": by_name["Ci"] + area - insulator}
        others = xp.broadcast_to(self.theta, (*factors.shape[:-1], self.theta.size))
        return xp.stack(
            [logs.get(name, others[..., i]) for i, name in enumerate(self.derive.likelihood.names)], axis=-1
        )

    def _factors_by_name(self, factors: Float[Array, "*shape factors"]) -> dict[str, Array]:
        return {name: factors[..., i] for i, name in enumerate(self.factors)}

    def __call__(self, factors: Float[Array, " factors"]) -> Float[Array, " names"]:
        derive, theta = self.apply_factors(factors)
        skin = jnp.exp(theta[np.array([derive.likelihood.names.index(name) for name in SKIN])])
        parts = [skin, derive(theta, self.sigma)]
        if self.frequency is not None:
            turns = 2.0 * np.pi * self.frequency * jnp.outer(np.array([1.0, 2.0]), derive.time)
            weighted = derive.weight * derive.force(theta, self.sigma)
            tones = 2.0 * jnp.hypot(jnp.cos(turns) @ weighted, jnp.sin(turns) @ weighted)
            parts += [tones, derive.coefficient * tones]
        return jnp.concatenate(parts)

    @double_precision()
    def evaluate(self, factors: Float[np.ndarray, "*shape factors"]) -> Float[np.ndarray, "*shape names"]:
        """Compute the quantities `names` of many fingers."""
        model = self._tabulate(factors)
        evaluator = BatchEvaluator(NewFingerModel.__call__, model, model.derive.time.size, batch=512)
        return evaluator.map_over(factors.shape[:-1], factors)

    def _tabulate(self, factors: Float[np.ndarray, "*shape factors"]) -> Self:
        points = self._theta(factors).reshape(-1, self.theta.size)
        return dataclasses.replace(self, derive=self.derive.tabulate(points))

    def force_in_time(
        self, factors: Float[np.ndarray, "fingers factors"], count: int
    ) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, "fingers count"]]:
        """Compute times (s) and force (N) of many fingers over the last period, or over a whole aperiodic drive."""
        with double_precision():
            first, last = float(np.min(self.derive.time)), float(np.max(self.derive.time))
            span = last - first if self.frequency is None else 1.0 / self.frequency
            time = span * np.arange(count) / count
            start = 0.0 if isinstance(self.derive.drive, Periodic) else last - span
            model = dataclasses.replace(self, derive=dataclasses.replace(self.derive, time=start + time))
            force = BatchEvaluator(_force, model._tabulate(factors), count, batch=512)(factors)
        return time, force


def _force(finger: NewFingerModel, factors: Float[Array, " factors"]) -> Float[Array, " times"]:
    derive, theta = finger.apply_factors(factors)
    return derive.force(theta, finger.sigma)


def finger_variance_fraction(values: Float[np.ndarray, "laws fingers"]) -> float:
    """Return the fraction of a variance that comes from differences between fingers, by the law of total variance."""
    fingers = float(np.mean(np.var(values, axis=1, ddof=1)))  # E[Var(x | parameters)]
    # Var(E[x | parameters]), corrected for the finite number of fingers
    parameters = float(np.var(np.mean(values, axis=1), ddof=1)) - fingers / values.shape[1]
    return fingers / (fingers + max(parameters, 0.0))


def intrafinger_variance_fraction(moments: Float[np.ndarray, "2 laws fingers"]) -> float:
    """Return the variance within fingers over that of all fingers of the same population parameters, from two moments.

    Half the mean square of the difference of two moments of a finger is the variance within it.
    """
    whole = float(np.mean(np.var(moments, axis=2, ddof=1)))
    return min(0.5 * float(np.mean(np.square(moments[1] - moments[0]))) / whole, 1.0)


def draw_factors(
    parameters: PopulationParameters, thickness_sd: dict[str, float], fingers: int, random: np.random.Generator
) -> Float[np.ndarray, "laws fingers factors"]:
    """Draw logarithms of the factors of `fingers` fingers for each population sample; leaves of these are (laws, 1).

    `thickness_sd` has the log-standard deviation of each of `THICKNESSES` that is a factor.
    """
    z = random.standard_normal((len(parameters.median), fingers, 3))
    thicknesses = [sd * random.standard_normal((*z.shape[:2], 1)) for sd in thickness_sd.values()]
    return np.concatenate([factors_from_normal(parameters, z), *thicknesses], axis=-1)


def factors_from_normal(
    parameters: PopulationParameters, z: Float[np.ndarray, "laws fingers 3"]
) -> Float[np.ndarray, "laws fingers factors"]:
    """Turn standard normal numbers into logarithms of Rsc, Csc, Ci and, if it varies, contact area."""
    r = parameters.correlation
    second = r * z[..., 0] + np.sqrt(1.0 - r**2) * z[..., 1]
    skin = parameters.median + parameters.log_sd * np.stack([z[..., 0], second], axis=-1)
    factors = [skin[..., 0], skin[..., 1], np.broadcast_to(parameters.log_Ci, second.shape)]
    if parameters.area is not None:
        factors.append(parameters.area * z[..., 2])
    return np.stack(factors, axis=-1)
