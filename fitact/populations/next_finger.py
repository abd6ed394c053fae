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
from fitact.populations.hierarchy import AREA
from fitact.problem.drive_choice import whole_periods

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

    def log_gradients(
        self, factors: Float[np.ndarray, "points factors"], step: float = 1e-3
    ) -> dict[str, Float[np.ndarray, "points factors"]]:
        """Return the derivatives of the logarithms of the quantities in the factors."""
        ends = step * np.concatenate([np.eye(len(self.factors)), -np.eye(len(self.factors))])
        with np.errstate(divide="ignore", invalid="ignore"):  # an amplitude may be 0
            upper, lower = np.split(np.log(self.evaluate(factors[:, None] + ends)), 2, axis=1)
            return dict(zip(self.names, np.moveaxis(upper - lower, -1, 0) / (2.0 * step), strict=True))

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


def redrawn_variance_fraction(pairs: Float[np.ndarray, "2 laws fingers"]) -> float:
    """Return the variance of what differs between the members of pairs, over that of all with the same parameters.

    Half the mean square of the difference of two touches of a finger is the variance within it.
    """
    whole = float(np.mean(np.var(pairs, axis=2, ddof=1)))
    return min(0.5 * float(np.mean(np.square(pairs[1] - pairs[0]))) / whole, 1.0)


def draw_thicknesses(
    log_sds: dict[str, float], shape: tuple[int, ...], random: np.random.Generator
) -> Float[np.ndarray, "*shape thicknesses"]:
    """Draw logarithms of thicknesses with the log-standard deviation of each of `THICKNESSES` that is a factor."""
    return np.array(list(log_sds.values())) * random.standard_normal((*shape, len(log_sds)))
