"""What a record can and cannot tell: the Fisher information against the prior, a verdict in words, and a remedy."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.experiment.blind_directions import Structure, blind_directions, gain_names, name_direction
from fitact.experiment.experiment import Option
from fitact.experiment.fisher import Experiment
from fitact.experiment.options import remedies
from fitact.units import percent

_IDENTIFIED = 0.9  # smallest prior-whitened eigenvalue from which the data speak in every direction
_MOVES = 0.1  # a component of a unit vector from which it counts as part of a direction
_WIDE = math.log(10.0) / 1.959963984540054  # a prior whose 95 % spans more than a factor of 10 either way says little


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """The verdict on a record.

    Attributes:
        verdict: "identified", "prior-limited" or "unidentified".
        eigenvalues: prior-whitened Fisher eigenvalues lambda / (1 + lambda), smallest first; 1 is known from
            the data, 0 from the prior alone.
        blind_direction: the direction the data see least, a unit vector in the log-parameters.
        blind_name: what that direction is, in words.
        structural: whether no record of these channels could tell it; if not, it is this record that does not.
        prior_sd: standard deviation, by the prior, of the parameter that moves most along it, in its logarithm.
        force_from_prior: share of the variance of the mean force that comes from the prior.
        force_sd: standard deviation of the mean force, in its logarithm.
        force_contraction: 1 - that over the prior's.
        remedy: what to measure next.
        remedies: that in figures, best first; none where all is identified.
        channels: what was recorded beside V.
    """

    verdict: str
    eigenvalues: tuple[float, ...]
    blind_direction: dict[str, float]
    blind_name: str
    structural: bool
    prior_sd: float
    force_from_prior: float
    force_sd: float
    force_contraction: float
    remedy: str
    remedies: tuple[Option, ...]
    channels: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As in fit.json and summary.json."""
        return dataclasses.asdict(self) | {"remedies": [remedy.to_dict() for remedy in self.remedies]}

    def __str__(self) -> str:
        names = list(self.blind_direction)
        if self.verdict == "identified":
            return f"identified: the record determines {', '.join(names[:-1])} and {names[-1]}."
        if self.structural:
            channels = " and ".join(self.channels) if len(self.channels) > 1 else f"{self.channels[0]} alone"
            found = f"no record of {channels} can tell {self.blind_name}"
        else:
            found = f"this record is too short, too noisy or of too few frequencies to tell {self.blind_name}"
        moves = ", ".join(f"{name} {value:+.2f}" for name, value in self.blind_direction.items())
        return (
            f"{self.verdict}: {found} (logs move together: {moves}); along it the prior speaks"
            f" (± {percent(math.expm1(self.prior_sd))}), and {100.0 * self.force_from_prior:.3g} % of the force's"
            f" variance comes from the prior. {self.remedy}"
        )


def assess(
    names: Sequence[str],
    root: Float[np.ndarray, "parameters parameters"],
    prior_root: Float[np.ndarray, "parameters parameters"],
    force_gradient: Float[np.ndarray, " parameters"],
    experiment: Experiment,
    offer: bool = True,
) -> Identifiability:
    """Judge a fit by roots of theta's covariance (`covariance_root`) and of the prior's.

    `names` are theta's coordinates; those free in `experiment` that are no gains are judged, the others are
    nuisances with priors of their own. `force_gradient` is that of the log mean force in theta. `offer`: with remedies.
    """
    free = [name for name in experiment.free if name not in gain_names(experiment.channels)]
    found = judge(names, root, prior_root, force_gradient, free, experiment.channels)
    if found.verdict == "identified" or not offer:
        return found
    known = [list(names).index(name) for name in experiment.free]
    structure = blind_directions(experiment.circuit, experiment.free, experiment.channels)
    offered = remedies(experiment, force_gradient[known])
    return dataclasses.replace(
        found,
        structural=structure.hides(found.blind_direction),
        remedy=_remedy(found.verdict, found.force_sd, offered, structure),
        remedies=offered,
    )


def judge(
    names: Sequence[str],
    root: Float[np.ndarray, "parameters parameters"],
    prior_root: Float[np.ndarray, "parameters parameters"],
    force_gradient: Float[np.ndarray, " parameters"],
    free: Sequence[str],
    channels: tuple[str, ...],
) -> Identifiability:
    """As `assess`, of the parameters `free` among `names`, with no remedy and no word on what is structural."""
    shares, blind, along = directions(names, root, prior_root, free)
    direction = dict(zip(free, map(float, blind), strict=True))
    force_sd = float(np.linalg.norm(root.T @ force_gradient))
    return Identifiability(
        verdict=str(verdicts(shares, along)),
        eigenvalues=tuple(map(float, shares)),
        blind_direction=direction,
        blind_name=name_direction(direction),
        structural=False,
        prior_sd=float(along),
        force_from_prior=float(from_prior(root, prior_root, force_gradient)),
        force_sd=force_sd,
        force_contraction=1.0 - force_sd / float(np.linalg.norm(prior_root.T @ force_gradient)),
        remedy="",
        remedies=(),
        channels=channels,
    )


def directions(
    names: Sequence[str],
    root: Float[np.ndarray, "*fits parameters parameters"],
    prior_root: Float[np.ndarray, "parameters parameters"],
    free: Sequence[str],
) -> tuple[Float[np.ndarray, "*fits free"], Float[np.ndarray, "*fits free"], Float[np.ndarray, "*fits"]]:
    """Eigenvalues, the blind direction and `prior_sd` of the parameters `free` among `names`, of one or many fits."""
    rows = [list(names).index(name) for name in free]
    believed = np.linalg.cholesky((prior_root @ prior_root.T)[np.ix_(rows, rows)])
    inverse = np.linalg.inv(believed)
    # of the prior's spread in each direction, what is left
    axes, left, _ = np.linalg.svd(inverse @ root[..., rows, :])
    blind = axes[..., 0] @ believed.T
    against = blind[..., list(free).index("Ci")] < 0.0 if "Ci" in free else np.zeros(blind.shape[:-1], bool)
    blind *= (np.where(against, -1.0, 1.0) / np.linalg.norm(blind, axis=-1))[..., None]
    along = np.max(np.abs(blind), axis=-1) / np.linalg.norm(blind @ inverse.T, axis=-1)
    return np.clip(1.0 - left**2, 0.0, 1.0), blind, along


def verdicts(shares: Float[np.ndarray, "*fits free"], along: Float[np.ndarray, "*fits"]) -> np.ndarray:
    """ "identified", "prior-limited" or "unidentified", by the eigenvalues and `prior_sd`."""
    limited = np.where(along <= _WIDE, "prior-limited", "unidentified")
    return np.where(shares[..., 0] >= _IDENTIFIED, "identified", limited)


def from_prior(
    root: Float[np.ndarray, "*fits n n"], prior_root: Float[np.ndarray, "n n"], gradient: Float[np.ndarray, "*fits n"]
) -> Float[np.ndarray, "*fits"]:
    """The share of a quantity's variance that comes from the prior, by its gradient."""
    along = np.einsum("...ij,...i->...j", root, gradient)
    moved = np.einsum("...ij,...j->...i", np.linalg.inv(prior_root) @ root, along)
    return np.sum(moved**2, axis=-1) / np.sum(along**2, axis=-1)


def _remedy(verdict: str, force_sd: float, offered: tuple[Option, ...], structure: Structure) -> str:
    figures = [f"± {percent(remedy.force_sd)} with {remedy.text}" for remedy in offered]
    remedy = (
        f"The mean force is known to ± {percent(force_sd)}; to be expected is {', '.join(figures[:-1])},"
        f" and {figures[-1]}."
    )
    if verdict == "unidentified":
        remedy = f"No prior covers that direction: state one for Ci, from the panel's data sheet. {remedy}"
    gains = structure.directions[:, [name in gain_names(structure.channels) for name in structure.names]]
    if np.any(np.abs(gains) > _MOVES):
        remedy += " The free gain is confounded with the circuit: calibrate the probe, and resolve the drive's edges."
    return remedy
