"""Uncertainty of what force and friction rest on beside the circuit: thicknesses, permittivities, area, friction.

Where Ci or Csc follows from stated distributions by eq. (3), these are conditional on the sampled capacitance, so that
data on it update them. All other quantities are independent of the circuit.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.fitting.derived import DERIVED_NAMES
from fitact.likelihood.likelihood import Likelihood
from fitact.model.force import Geometry, force_constant
from fitact.prior.distributions import Distribution, LogNormal
from fitact.scene.scene import Scene

_NAMES = {  # in a few words
    "skin_thickness": "skin thickness", "insulator_thickness": "insulator thickness", "contact_area": "contact area",
    "friction_coefficient": "mu",
}  # fmt: skip
_FORCE = [i for i, name in enumerate(DERIVED_NAMES) if name.startswith("force")]
_MEAN, _FRICTION = DERIVED_NAMES.index("force_mean"), DERIVED_NAMES.index("friction_mean")
_SKIN_THICKNESS_SOURCE = (
    "stratum corneum 173 um on palms (Egawa et al., Acta Derm. Venereol. 87 (2007) 4) to 300 um on a finger pad (Adams"
    " et al., J. R. Soc. Interface 10 (2013) 20120467); 19 % between people (palm epidermis 265 +- 51 um, n = 33,"
    " JID Innov. 4 (2024), PMC11137746)"
)


class Capacitances(NamedTuple):
    """Capacitances that the force law depends on, F."""

    Ci: Any
    Csc: Any
    Cgap: Any = None

    @classmethod
    def from_theta(cls, likelihood: Likelihood, theta: Float[np.ndarray, "*shape parameters"]) -> Self:
        """Return the capacitances at points theta, whether free, tied or fixed."""
        values = likelihood.parameter_values(theta)
        return cls(*map(values.get, cls._fields))


class Contribution(NamedTuple):
    """One source of the uncertainty of a derived quantity or parameter q, among what the force rests on."""

    name: str  # such as "skin_thickness"
    source: str
    origin: str  # the same in two words
    relative_sd: float  # sd of ln x
    sensitivity: float  # Cov(ln q, ln x) / var(ln x); d ln q / d ln x where x is independent of the circuit
    distribution: Distribution
    stated: bool  # in the scene; the draws contain it then


class DerivedMoments(NamedTuple):
    """Laplace approximation of the logarithms of `DERIVED_NAMES`, with the stated distributions."""

    logs: Float[np.ndarray, " derived"]
    gradients: Float[np.ndarray, "derived parameters"]  # in theta, with what theta tells about the geometry
    extra_variance: Float[np.ndarray, " derived"]  # of the geometry at given theta


@dataclasses.dataclass(frozen=True)
class UncertainGeometry:
    """Quantities that force and friction rest on beside the circuit, with stated and assumed distributions.

    Attributes:
        geometry: nominal sizes and the force law.
        values: nominal values of all quantities, SI.
        normal_force: of eq. (2), N.
        stated: distributions that the scene states.
        assumed: distributions from the literature where it states none, with their sources.
        plates: capacitances that follow from `stated`, as in `Scene.plates`.
        friction_is_measured: whether the friction is a channel, so that it does not depend on this geometry.
        value_is_stated: whether the scene states the values of `assumed`.
    """

    geometry: Geometry
    values: Mapping[str, float]
    normal_force: float
    stated: Mapping[str, Distribution]
    assumed: Mapping[str, tuple[Distribution, str]]
    plates: Mapping[str, tuple[dict[str, float], float]]
    friction_is_measured: bool
    value_is_stated: bool

    @classmethod
    def from_scene(cls, scene: Scene, geometry: Geometry | None = None) -> Self:
        """Collect the distributions of a scene; `geometry` with another force law replaces the scene's."""
        values = {name: float(value) for name, value in scene.geometry_values().items() if value is not None}
        stated = scene.geometry_distributions()
        spread = 0.25  # sd of log(thickness): 0.16 for a uniform law between the published means, and 0.19
        assumed = {"skin_thickness": (LogNormal(values["skin_thickness"], spread), _SKIN_THICKNESS_SOURCE)}
        return cls(
            geometry or scene.geometry(),
            values,
            scene.friction.normal_force,
            stated,
            {name: each for name, each in assumed.items() if name not in stated},
            scene.plates(),
            "Ft" in scene.measurement.channels,
            "thickness" in scene.skin.model_fields_set,
        )

    def draw_logs(
        self, capacitances: Capacitances, shape: tuple[int, ...], seed: int
    ) -> dict[str, Float[np.ndarray, "*shape"]]:
        """Return draws of the logarithms of the stated quantities, one for each draw of the capacitances."""
        rng = np.random.default_rng([seed, 4])
        logs = {name: each.from_standard_normal(rng.standard_normal(shape)) for name, each in self.stated.items()}
        members = [name for name in self.stated if any(name in powers for powers, _ in self.plates.values())]
        if not members:
            return logs
        powers, targets = self._plate_equations(members, capacitances)
        laws = [self.stated[name] for name in members]
        if all(isinstance(law, LogNormal) for law in laws):
            free = np.stack([logs[name] for name in members])
            gain = _regression(powers, np.array([law.log_sd for law in laws]) ** 2)
            conditional = free + np.tensordot(gain, targets - np.tensordot(powers, free, 1), 1)
        else:
            flat = _draw_by_importance(laws, powers, targets.reshape(len(targets), -1), rng)
            conditional = flat.reshape(-1, *shape)
        return logs | dict(zip(members, conditional, strict=True))

    def _plate_equations(
        self, names: list[str], capacitances: Capacitances
    ) -> tuple[Float[np.ndarray, "plates names"], Float[np.ndarray, "plates *shape"]]:
        """Return powers and right-hand sides of eq. (3) in the logarithms of the quantities `names`."""
        rows = [[powers.get(name, 0.0) for name in names] for powers, _ in self.plates.values()]
        targets = [np.log(getattr(capacitances, plate) / factor) for plate, (_, factor) in self.plates.items()]
        return np.array(rows).reshape(-1, len(names)), np.array(targets)

    def change_derived(
        self,
        capacitances: Capacitances,
        logs: Mapping[str, Any],
        derived: Float[np.ndarray, "*shape derived"],
    ) -> Float[np.ndarray, "*shape derived"]:
        """Return `DERIVED_NAMES`, computed for the nominal geometry, for other values; the voltage stays the same."""
        sizes = {"area": "contact_area"} | {name: name for name in ("insulator_thickness", "skin_thickness")}
        drawn = {field: np.exp(logs[name]) for field, name in sizes.items() if name in logs}
        constants = [
            np.asarray(force_constant(geometry.contact(capacitances)))  # type: ignore[arg-type]
            for geometry in (self.geometry, dataclasses.replace(self.geometry, **drawn))
        ]
        changed = np.array(derived)
        changed[..., _FORCE] *= (constants[1] / constants[0])[..., None]
        if self.friction_is_measured:
            return changed
        name = "friction_coefficient"
        coefficient = np.exp(logs[name]) if name in logs else self.values[name]
        changed[..., _FRICTION] = coefficient * (changed[..., _MEAN] + self.normal_force)
        return changed

    def approximate(
        self,
        likelihood: Likelihood,
        theta: Float[np.ndarray, " parameters"],
        log_derived: tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]],
    ) -> DerivedMoments:
        """Add the stated distributions to a Laplace approximation at the nominal geometry."""
        if not self.stated:
            return DerivedMoments(*log_derived, np.zeros(len(DERIVED_NAMES)))
        at = Capacitances.from_theta(likelihood, theta)
        center, gain, rest = self._condition(likelihood, at)
        slopes = self._slopes(at, center, np.exp(log_derived[0]))
        derived = self.change_derived(at, center, np.exp(log_derived[0]))
        gradients = np.array(log_derived[1])
        if not self.friction_is_measured:
            gradients[_FRICTION] = derived[_MEAN] / (derived[_MEAN] + self.normal_force) * gradients[_MEAN]
        variance = np.einsum("qi,ij,qj->q", slopes, rest, slopes)
        return DerivedMoments(np.log(derived), gradients + slopes @ gain, variance)

    def _condition(
        self, likelihood: Likelihood, at: Capacitances
    ) -> tuple[dict[str, float], Float[np.ndarray, "stated parameters"], Float[np.ndarray, "stated stated"]]:
        """Return mean of the stated logarithms given theta, its gradient in theta, and their covariance given it."""
        names, laws = list(self.stated), list(self.stated.values())
        mean, variance = (np.array([f(law) for law in laws]) for f in (lambda x: x.log_mean, lambda x: x.log_sd**2))
        gain = np.zeros((len(names), len(likelihood.names)))
        rest = np.diag(variance)
        if self.plates:
            powers, targets = self._plate_equations(names, at)
            regression = _regression(powers, variance)
            mean = mean + regression @ (targets - powers @ mean)
            gain[:, [likelihood.names.index(plate) for plate in self.plates]] = regression
            rest = rest - regression @ powers @ rest
        return dict(zip(names, mean, strict=True)), gain, rest

    def _slopes(
        self, at: Capacitances, center: Mapping[str, float], derived: Float[np.ndarray, " derived"], step: float = 1e-4
    ) -> Float[np.ndarray, "derived quantities"]:
        """Return d ln q / d ln x of `DERIVED_NAMES` at given capacitances, for the quantities of `center`."""
        columns = []
        for name, value in center.items():
            ends = [self.change_derived(at, {**center, name: value + d}, derived) for d in (step, -step)]
            columns.append((np.log(ends[0]) - np.log(ends[1])) / (2.0 * step))
        slopes = np.array(columns).reshape(-1, len(DERIVED_NAMES)).T
        return np.where(np.abs(slopes) < 1e-9, 0.0, slopes)  # rounding, where a quantity cancels

    def contributions(
        self,
        likelihood: Likelihood,
        theta: Float[np.ndarray, " parameters"],
        log_derived: tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]],
        covariance: Float[np.ndarray, "parameters parameters"],
    ) -> dict[str, tuple[Contribution, ...]]:
        """Return the contributions to each parameter and derived quantity, stated and assumed.

        The squares of relative_sd * sensitivity add up to the variance that these sources have in the posterior, and
        that assumed ones would add.
        """
        at = Capacitances.from_theta(likelihood, theta)
        center, gain, rest = self._condition(likelihood, at)
        nominal = np.exp(log_derived[0])
        moments = self.approximate(likelihood, theta, log_derived)
        means = center | {name: law.log_mean for name, (law, _) in self.assumed.items()}
        slopes = self._slopes(at, means, nominal)
        covariances = moments.gradients @ covariance @ gain.T + slopes[:, : len(center)] @ rest
        rows = dict(zip(DERIVED_NAMES, covariances, strict=True))
        rows |= dict(zip(likelihood.names, covariance @ gain.T, strict=True))
        others = dict(zip(DERIVED_NAMES, slopes[:, len(center) :], strict=True))
        table = {}
        for quantity, row in rows.items():
            entries = [
                _contribution(name, "stated in the scene", law, covariance_with / law.log_sd**2, "stated")
                for (name, law), covariance_with in zip(self.stated.items(), row, strict=True)
            ]
            for i, (name, (law, source)) in enumerate(self.assumed.items()):
                slope = others[quantity][i] if quantity in others else 0.0
                kind = "spread of" if self.value_is_stated else "default"
                entries.append(_contribution(name, f"default: {source}", law, slope, kind))
            table[quantity] = tuple(entries)
        return table

    def notes(self, scene: Scene, likelihood: Likelihood, theta: Float[np.ndarray, " parameters"]) -> tuple[str, ...]:
        """Return notes on stated distributions that change nothing, or less than one may expect."""
        at = Capacitances.from_theta(likelihood, theta)
        logs = {name: law.log_mean for name, law in self.stated.items()}
        slopes = self._slopes(at, logs, np.ones(len(DERIVED_NAMES)))
        in_plates = {name for powers, _ in self.plates.values() for name in powers}
        idle = [
            summary.describe_quantity(name)
            for name, column in zip(self.stated, slopes.T, strict=True)
            if name not in in_plates and not column.any()
        ]
        overruled = [name for name in scene.uncertain_plates() if name not in self.plates]
        sentences = [
            f"[prior] {name} is stated, so its prior is that, and not the distribution from thickness, permittivity and"
            " area by eq. (3)"
            for name in overruled
        ]
        if idle:
            sentences.append(
                f"the distribution of {' and '.join(idle)} has no effect: the force law cancels it where the"
                " capacitances are parameters of their own"
            )
        return tuple(sentences)


def _contribution(name: str, origin: str, law: Distribution, sensitivity: Any, kind: str) -> Contribution:
    description = summary.describe_quantity(name)
    words = f"{kind} {_NAMES.get(name, description)}"
    size = float(law.log_sd), float(sensitivity)
    return Contribution(name, f"{description} ({origin})", words, *size, law, stated=kind == "stated")


def _regression(
    powers: Float[np.ndarray, "plates names"], variance: Float[np.ndarray, " names"]
) -> Float[np.ndarray, "names plates"]:
    """Return the regression of independent variables on the linear combinations `powers` of them."""
    return np.linalg.solve((powers * variance) @ powers.T, powers * variance).T


def _draw_by_importance(
    laws: list[Distribution],
    powers: Float[np.ndarray, "plates names"],
    targets: Float[np.ndarray, "plates draws"],
    rng: np.random.Generator,
    candidates: int = 512,
    block: int = 1000,
) -> Float[np.ndarray, "names draws"]:
    """Return draws of the logarithms given `targets`, the values of the linear combinations `powers`.

    Each draw is chosen among `candidates` for all variables but the one of the largest spread in each combination,
    which solves the equation; its density is the weight. No variable is in two combinations.
    """
    spreads = np.array([law.log_sd for law in laws])
    solved = np.argmax(np.abs(powers) * spreads, axis=1)
    drawn = np.empty((len(laws), targets.shape[1]))
    for start in range(0, targets.shape[1], block):
        goal = targets[:, start : start + block]
        shape = (candidates, goal.shape[1])
        logs = np.stack([law.from_standard_normal(rng.standard_normal(shape)) for law in laws])
        weight = rng.gumbel(size=shape)  # the largest sum of log-weight and Gumbel number is a weighted choice
        for row, name in enumerate(solved):
            logs[name] = 0.0
            logs[name] = (goal[row] - np.tensordot(powers[row], logs, 1)) / powers[row, name]
            distance = np.abs(logs[name] - laws[name].log_mean) / spreads[name]
            density = np.asarray(laws[name].log_density(logs[name]))
            weight += np.where(np.isfinite(density), density, -1e6 * (1.0 + distance))  # the nearest if none fits
        chosen = np.argmax(weight, axis=0)
        drawn[:, start : start + block] = logs[:, chosen, np.arange(goal.shape[1])]
    return drawn
