"""From one finger to people: the law that fingers follow, sampled; the next finger; what its force depends on."""

import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.inference import summary
from fitact.inference.convergence import Convergence
from fitact.inference.fingers import SHARED, SKIN, Conditional, Fingers, Law
from fitact.inference.fit import Fit, fit
from fitact.inference.hierarchy import Hierarchy, laplace
from fitact.inference.likelihood import Batched
from fitact.inference.new_finger import AREA, NAMES, NewFinger, Spread, variance_shares
from fitact.inference.proposal import Proposal
from fitact.inference.sampling import Target, finite, run
from fitact.model.prior import Prior
from fitact.model.scene import Scene
from fitact.units import engineering

_WALKERS, _ENSEMBLES = 128, 4
_KEPT = 2500  # points per ensemble
_LAWS, _FINGERS = 1000, 32  # that new fingers are drawn from, and of each
_DRAWS = (64, 1024)  # in the fingers' tables, and where so few turn out to be too few
_LEAST_CHECKED = 256  # other draws that these are checked against
_TERMS, _MORE_TERMS = 9, 13  # of the tables, and of those that they are checked against
_CHECKED = 500  # points at which
_OFF = 0.1  # standard deviations of a mean that the tables may shift it by
_SHARES = ("force_mean", "force_peak")


@dataclasses.dataclass(frozen=True)
class Population:
    """Draws of the law that fingers follow, and of fingers to come.

    Attributes:
        fits: of each record by itself.
        hierarchy: the law's posterior.
        points: draws in the coordinates of `hierarchy`.
        convergence: how far they can be trusted.
        off: by how much, at most, the integrals over the fingers shift any mean, in standard deviations.
        scene: of all records.
        seed: of every random number here.
    """

    fits: tuple[Fit, ...]
    hierarchy: Hierarchy
    points: Float[np.ndarray, "ensembles draws n"]
    convergence: Convergence
    off: float
    scene: Scene
    seed: int

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer; one finger's misfit is named among the warnings."""
        return self.convergence.converged and self.off <= _OFF

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        found = [f"{_name(fit)}: {fit.message}" for fit in self.fits if not fit.trusted]
        if self.convergence.warning:
            found.append(self.convergence.warning)
        if not self.off <= _OFF:
            found.append(
                f"the integrals over the fingers may shift means by {self.off:.2g} standard deviations; leave out the"
                " records that leave Rsc and Csc most open"
            )
        if self.hierarchy.area_varies and "I" not in self.scene.measurement.channels:
            found.append("Vsc alone does not show the contact area, so its spread is the prior's; record I, too")
        return tuple(found)

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of the law: medians of Rsc (ohm) and Csc (F), Ci (F), log-standard deviations, correlation."""
        law = _laws(self.hierarchy, self.points)
        found = {f"log_sd_{name}": law.log_sd[..., i] for i, name in enumerate(SKIN)}
        found |= {} if law.area is None else {"log_sd_area": law.area}
        return found | {"correlation": law.correlation} | {k: np.exp(x) for k, x in _medians(law).items()}

    def new_fingers(self) -> dict[str, Float[np.ndarray, "laws fingers"]]:
        """Draws of fingers to come, some of each of many laws: Rsc, Csc, g, b, force and friction, SI units."""
        return {name: self._new[..., i] for i, name in enumerate(NAMES)}

    @functools.cached_property
    def _finger(self) -> NewFinger:
        with jax.enable_x64(True):
            return NewFinger.under_drive_of(self.fits[0])

    @functools.cached_property
    def _factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms of Rsc, Csc, Ci and, where it varies, area of new fingers."""
        flat = self.points.reshape(-1, self.points.shape[-1])
        law = _laws(self.hierarchy, flat[np.linspace(0, len(flat) - 1, _LAWS).astype(int), None])
        white = np.random.default_rng([self.seed, 1]).standard_normal((_LAWS, _FINGERS, 3))
        r = law.correlation
        second = r * white[..., 0] + np.sqrt(1.0 - r**2) * white[..., 1]
        skin = law.median + law.log_sd * np.stack([white[..., 0], second], axis=-1)
        factors = [skin[..., 0], skin[..., 1], np.broadcast_to(law.log_Ci, second.shape)]
        if law.area is not None:
            factors.append(law.area * white[..., 2])
        return np.stack(factors, axis=-1)

    @functools.cached_property
    def _new(self) -> Float[np.ndarray, "laws fingers names"]:
        return self._finger.each(self._factors)

    @functools.cached_property
    def _shares(self) -> dict[str, dict[str, dict[str, float]]]:
        factors = self._factors.reshape(-1, self._factors.shape[-1])
        return variance_shares(self._finger, factors, _SHARES, self.seed)

    def to_dict(self) -> dict[str, Any]:
        """What `fitact population --json` prints and population.json holds."""
        draws = self.parameters()
        law: dict[str, Any] = {
            name: {
                "median": summary.of_draws(name, draws[name]),
                "log_sd": summary.of_draws("log_sd", draws[f"log_sd_{name}"]),
            }
            for name in SKIN
        }
        law |= {name: summary.of_draws(name, draws[name]) for name in (SHARED, "correlation")}
        if self.hierarchy.area_varies:
            law[AREA] = {"log_sd": summary.of_draws("log_sd", draws["log_sd_area"])}
        new: dict[str, dict[str, Any]] = {}
        for name, values in self.new_fingers().items():
            spread = Spread.of(values)
            shares = {"people": spread.share_of_people, "ignorance": 1.0 - spread.share_of_people}
            new[name] = summary.of_draws(name, values) | {"variance": shares}
        return {
            "population": law,
            "new_finger": new,
            "variance_shares": self._shares,
            "fingers": [
                {"record": _name(fit), "result": fit.result, "parameters": fit.parameters()} for fit in self.fits
            ],
            "convergence": dataclasses.asdict(self.convergence) | {"sentence": str(self.convergence)},
            "integrals_off": self.off,
            "warnings": list(self.warnings),
            "seed": self.seed,
            "scene": self.scene.model_dump(mode="json", exclude_unset=True),
        }

    def summary(self) -> str:
        """A table for people."""
        content = self.to_dict()
        rows = [f"{len(self.fits)} fingers{'':14}{'median':>12}{'2.5 %':>14}{'97.5 %':>12}"]
        shown = {f"{name}, {key}": s for name in SKIN for key, s in content["population"][name].items()}
        shown |= {name: content["population"][name] for name in (SHARED, "correlation")}
        if self.hierarchy.area_varies:
            shown["contact area, log_sd"] = content["population"][AREA]["log_sd"]
        new = content["new_finger"]
        shown |= {f"next finger, {name}": new[name] for name in NAMES}
        for name, s in shown.items():
            median, low, high = (engineering(float(s[q]), str(s["unit"])) for q in ("q50", "q025", "q975"))
            rows.append(f"{name:26}{median:>12}{low:>14}{high:>12}")
        for name in _SHARES:
            people = 100.0 * new[name]["variance"]["people"]
            parts = (
                f"{factor} {100.0 * share['first']:.0f} % ({100.0 * share['total']:.0f} %)"
                for factor, share in content["variance_shares"][name].items()
            )
            rows.append(f"variance of {name}: {people:.0f} % people, the rest ignorance; {', '.join(parts)}")
        rows.append("factors: the share of the variance that goes once each is known (that stays if only it is not)")
        rows.append(str(self.convergence))
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

    __str__ = summary


def population(
    records: Sequence[Record],
    scene: Scene | None = None,
    *,
    seed: int = 0,
    max_steps: int = 20_000,
    progress: bool = True,
) -> Population:
    """The law that fingers on one panel follow, from a record of each, sampled until converged.

    Rsc and Csc are log-normal over fingers, with a correlation; the panel's Ci is common, or, with the scene's
    `[population] contact_area = "varies"`, scales with each finger's own log-normal area, as Rsc and Csc do. Medians
    and Ci have the scene's prior, log-standard deviations a half-normal one of scale 0.5, the correlation r the
    density 3/4 (1 - r^2). All that is a finger's own is integrated out.

    Args:
        records: one of each finger, on one panel.
        scene: of all; its prior of Rsc and Csc is that of their medians.
        seed: the same seed gives the same draws.
        max_steps: per ensemble, after which the answer is marked as not converged.
        progress: report on standard error.

    Raises:
        InputError: there are fewer than two, one is given twice or is refused, or the scene's prior does not leave
            Rsc, Csc and Ci free.
    """
    scene = scene or Scene()
    medians = _prior(scene)
    _require_fingers(records)
    fits = _fitted(records, scene)
    with jax.enable_x64(True):
        conditionals = [Conditional.around(each) for each in fits]
        varies = scene.population.contact_area == "varies"

        def hierarchy(draws: int, terms: int, purpose: int) -> Hierarchy:
            tables = Fingers.tabulated(
                conditionals, medians[SHARED], area_varies=varies, draws=draws, terms=terms, seed=[seed, purpose]
            )
            return Hierarchy(tables, medians, varies)

        for draws in _DRAWS:
            sampled = hierarchy(draws, _TERMS, 2)
            points, convergence = _sampled(sampled, seed, max_steps, progress)
            off = _off(sampled, hierarchy(max(draws, _LEAST_CHECKED), _MORE_TERMS, 3), points)
            if off <= _OFF or not convergence.converged:
                break
    return Population(fits, sampled, points, convergence, off, scene, seed)


def _sampled(hierarchy: Hierarchy, seed: int, max_steps: int, progress: bool) -> tuple[np.ndarray, Convergence]:
    """Points (ensembles, draws, coordinates), and how far they can be trusted."""
    log_prob = finite(Batched(Hierarchy.log_prob, hierarchy, hierarchy.fingers.weight.size, _WALKERS // 2))
    proposal = Proposal.around(*laplace(hierarchy), log_prob)
    target = Target(hierarchy.names, log_prob, proposal, lambda points, _: _medians(_laws(hierarchy, points)))
    chain, convergence = run(target, seed, _WALKERS, _ENSEMBLES, max_steps, None, progress)
    points = chain.points[:, chain.thinned(convergence.burn, _KEPT)]
    return points.reshape(_ENSEMBLES, -1, len(hierarchy.names)), convergence


def _prior(scene: Scene) -> Prior:
    """Of the medians and Ci."""
    prior, names = scene.make_prior(), (*SKIN, SHARED)
    if not set(names) <= set(prior.names):
        raise InputError("scene: [prior] holds or ties Rsc, Csc or Ci; a population needs a density of each")
    if not {name for pair in (*prior.pairs, *prior.ordered) for name in pair[:2]} <= set(names):
        raise InputError("scene: [prior] correlates or orders Rsc, Csc or Ci with others; a population takes that not")
    return Prior(names, tuple(prior[name] for name in names), prior.pairs, prior.ordered)


def _require_fingers(records: Sequence[Record]) -> None:
    if len(records) < 2:
        raise InputError(f"{len(records)} records: a population needs one of each of two or more fingers")
    seen: dict[str, str] = {}
    for record in records:
        if record.fingerprint in seen:
            raise InputError(
                f"{record.source} holds the same record as {seen[record.fingerprint]}, whose finger would count"
                " twice; drop one"
            )
        seen[record.fingerprint] = record.source


def _fitted(records: Sequence[Record], scene: Scene) -> tuple[Fit, ...]:
    """Each by itself; where some are refused, the first one's reason and the others' names."""
    fits, refused = [], []
    for record in records:
        try:
            fits.append(fit(record, scene))
        except InputError as error:
            refused.append((os.path.basename(record.source), error))
    if refused:
        others = ", ".join(name for name, _ in refused[1:])
        raise InputError(f"{refused[0][1]}{f'; also refused: {others}' if others else ''}")
    return tuple(fits)


def _off(sampled: Hierarchy, finer: Hierarchy, points: Float[np.ndarray, "ensembles draws n"]) -> float:
    """How many of its standard deviations any mean shifts at most where finer tables take these tables' place.

    To first order a mean shifts by its covariance with the change of the log-posterior.
    """
    flat = points.reshape(-1, points.shape[-1])
    flat = flat[np.linspace(0, len(flat) - 1, _CHECKED).astype(int)]
    found = [Batched(Hierarchy.log_prob, each, each.fingers.weight.size)(flat) for each in (sampled, finer)]
    return float(np.std(found[1] - found[0]))


def _laws(hierarchy: Hierarchy, points: Float[np.ndarray, "chains draws n"]) -> Law:
    """At many points."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.vmap(hierarchy.law)))(points))


def _medians(law: Law) -> dict[str, np.ndarray]:
    """Logarithms of Rsc, Csc and Ci."""
    return {"Rsc": law.median[..., 0], "Csc": law.median[..., 1], SHARED: law.log_Ci}


def _name(fit: Fit) -> str:
    return os.path.basename(fit.record.source)
