"""What a record can and cannot tell: the Fisher information against the prior, a verdict in words, and a remedy."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from fitact.experiment.blind_directions import blind_directions, gain_names, name_direction
from fitact.experiment.experiment import DesignOption
from fitact.experiment.fisher import Experiment
from fitact.experiment.options import suggest_measurements
from fitact.units import format_percent


class NextMeasurement(NamedTuple):
    """The next measurement where not all is identified."""

    structural: bool = False  # whether no record of these channels could tell what this one does not
    remedy: str = ""
    remedies: tuple[DesignOption, ...] = ()  # the remedy in figures, best first


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """The verdict on a record."""

    verdict: str  # "identified", "prior-limited" or "unidentified"
    # prior-whitened Fisher eigenvalues lambda / (1 + lambda), smallest first: 1 is known from data, 0 from the prior
    eigenvalues: tuple[float, ...]
    blind_direction: dict[str, float]  # the direction the data see least, a unit vector in the log-parameters
    blind_name: str  # what that direction is, in words
    prior_sd: float  # standard deviation, by the prior, of the parameter that moves most along it, in its logarithm
    force_from_prior: float  # share of the variance of the mean force that comes from the prior
    force_sd: float  # standard deviation of the mean force, in its logarithm
    force_contraction: float  # 1 - that over the prior's
    channels: tuple[str, ...]  # what was recorded beside V
    # the measurement that was done; None: a spectrum's
    experiment: Experiment | None = dataclasses.field(default=None, repr=False, compare=False)
    # that of the logarithm of the mean force in the parameters that are free in `experiment`
    force_gradient: Float[np.ndarray, " free"] | None = dataclasses.field(default=None, repr=False, compare=False)

    @functools.cached_property
    def next_measurement(self) -> NextMeasurement:
        """What to measure next, worked out when it is first asked for."""
        if self.verdict == "identified":
            return NextMeasurement()
        force = f"The mean force is known to ± {format_percent(self.force_sd)}"
        experiment = self.experiment
        if experiment is None or self.force_gradient is None:
            return NextMeasurement(remedy=f"{force}; measure from below the skin's corner to above it.")
        with jax.enable_x64(True):
            structure = blind_directions(experiment.circuit, experiment.free, experiment.channels)
            options = suggest_measurements(experiment, self.force_gradient)
        figures = [f"± {format_percent(option.force_sd)} with {option.text}" for option in options]
        remedy = f"{force}; to be expected is {', '.join(figures[:-1])}, and {figures[-1]}."
        if self.verdict == "unidentified":
            remedy = f"No prior covers that direction: state one for Ci, from the panel's data sheet. {remedy}"
        gains = structure.directions[:, [name in gain_names(structure.channels) for name in structure.names]]
        if np.any(np.abs(gains) > 0.1):  # a component of a unit vector from which it counts as part of a direction
            remedy += (
                " The free gain is confounded with the circuit: calibrate the probe, and resolve the drive's edges."
            )
        return NextMeasurement(structure.contains(self.blind_direction), remedy, options)

    @property
    def structural(self) -> bool:
        """Whether no record of these channels could tell the blind direction, rather than this record alone."""
        return self.next_measurement.structural

    @property
    def remedy(self) -> str:
        """What to measure next, a sentence."""
        return self.next_measurement.remedy

    @property
    def remedies(self) -> tuple[DesignOption, ...]:
        """What to measure next in figures, best first; none where all is identified."""
        return self.next_measurement.remedies

    def to_dict(self) -> dict[str, Any]:
        """Return its part of fit.json and summary.json."""
        names = (
            "verdict", "eigenvalues", "blind_direction", "blind_name", "structural", "prior_sd", "force_from_prior",
            "force_sd", "force_contraction", "remedy", "remedies", "channels",
        )  # fmt: skip
        values = {name: getattr(self, name) for name in names}
        return values | {"remedies": [remedy.to_dict() for remedy in self.remedies]}

    def __str__(self) -> str:
        names = list(self.blind_direction)
        if self.verdict == "identified":
            return f"identified: the record determines {', '.join(names[:-1])} and {names[-1]}."
        if self.structural:
            channels = " and ".join(self.channels) if len(self.channels) > 1 else f"{self.channels[0]} alone"
            reason = f"no record of {channels} can tell {self.blind_name}"
        else:
            reason = f"this record is too short, too noisy or of too few frequencies to tell {self.blind_name}"
        moves = ", ".join(f"{name} {value:+.2f}" for name, value in self.blind_direction.items())
        return (
            f"{self.verdict}: {reason} (logs move together: {moves}); along it the prior speaks"
            f" (± {format_percent(math.expm1(self.prior_sd))}), and {100.0 * self.force_from_prior:.3g} % of the"
            f" force's variance comes from the prior. {self.remedy}"
        )


def assess_identifiability(
    names: Sequence[str],
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    prior_factor: Float[np.ndarray, "parameters parameters"],
    force_gradient: Float[np.ndarray, " parameters"],
    experiment: Experiment,
) -> Identifiability:
    """Judge a fit by roots of theta's covariance (`covariance_root`) and of the prior's.

    `names` are theta's coordinates; those free in `experiment` that are no gains are judged, the others are
    nuisances with priors of their own. `force_gradient` is that of the log mean force in theta.
    """
    free = [name for name in experiment.free if name not in gain_names(experiment.channels)]
    judgement = assess_parameters(names, covariance_factor, prior_factor, force_gradient, free, experiment.channels)
    rows = [list(names).index(name) for name in experiment.free]
    return dataclasses.replace(judgement, experiment=experiment, force_gradient=force_gradient[rows])


def assess_parameters(
    names: Sequence[str],
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    prior_factor: Float[np.ndarray, "parameters parameters"],
    force_gradient: Float[np.ndarray, " parameters"],
    free: Sequence[str],
    channels: tuple[str, ...],
) -> Identifiability:
    """Judge the parameters `free` among `names`, as `assess_identifiability`, by a measurement of another kind."""
    shares, blind, along = information_directions(names, covariance_factor, prior_factor, free)
    direction = dict(zip(free, map(float, blind), strict=True))
    force_sd = float(np.linalg.norm(covariance_factor.T @ force_gradient))
    return Identifiability(
        verdict=str(verdicts(shares, along)),
        eigenvalues=tuple(map(float, shares)),
        blind_direction=direction,
        blind_name=name_direction(direction),
        prior_sd=float(along),
        force_from_prior=float(prior_variance_fraction(covariance_factor, prior_factor, force_gradient)),
        force_sd=force_sd,
        force_contraction=1.0 - force_sd / float(np.linalg.norm(prior_factor.T @ force_gradient)),
        channels=channels,
    )


def information_directions(
    names: Sequence[str],
    covariance_factor: Float[np.ndarray, "*fits parameters parameters"],
    prior_factor: Float[np.ndarray, "parameters parameters"],
    free: Sequence[str],
) -> tuple[Float[np.ndarray, "*fits free"], Float[np.ndarray, "*fits free"], Float[np.ndarray, "*fits"]]:
    """Eigenvalues, the blind direction and `prior_sd` of the parameters `free` among `names`, of one or many fits."""
    rows = [list(names).index(name) for name in free]
    prior_root = np.linalg.cholesky((prior_factor @ prior_factor.T)[np.ix_(rows, rows)])
    inverse = np.linalg.inv(prior_root)
    # of the prior's spread in each direction, the share that the data leave
    axes, shares, _ = np.linalg.svd(inverse @ covariance_factor[..., rows, :])
    blind = axes[..., 0] @ prior_root.T
    against = blind[..., list(free).index("Ci")] < 0.0 if "Ci" in free else np.zeros(blind.shape[:-1], bool)
    blind *= (np.where(against, -1.0, 1.0) / np.linalg.norm(blind, axis=-1))[..., None]
    along = np.max(np.abs(blind), axis=-1) / np.linalg.norm(blind @ inverse.T, axis=-1)
    return np.clip(1.0 - shares**2, 0.0, 1.0), blind, along


def verdicts(
    eigenvalues: Float[np.ndarray, "*fits free"],
    prior_sd: Float[np.ndarray, "*fits"],
    min_eigenvalue: float = 0.9,
    max_prior_factor: float = 10.0,
) -> np.ndarray:
    """ "identified", "prior-limited" or "unidentified", by the eigenvalues and `prior_sd`.

    The data speak in every direction from a smallest prior-whitened eigenvalue of `min_eigenvalue`. A prior whose 95 %
    span more than `max_prior_factor` either way says little.
    """
    narrow = prior_sd <= math.log(max_prior_factor) / NormalDist().inv_cdf(0.975)
    limited = np.where(narrow, "prior-limited", "unidentified")
    return np.where(eigenvalues[..., 0] >= min_eigenvalue, "identified", limited)


def prior_variance_fraction(
    covariance_factor: Float[np.ndarray, "*fits n n"],
    prior_factor: Float[np.ndarray, "n n"],
    gradient: Float[np.ndarray, "*fits n"],
) -> Float[np.ndarray, "*fits"]:
    """The share of a quantity's variance that comes from the prior, by its gradient."""
    along = np.einsum("...ij,...i->...j", covariance_factor, gradient)
    moved = np.einsum("...ij,...j->...i", np.linalg.inv(prior_factor) @ covariance_factor, along)
    return np.sum(moved**2, axis=-1) / np.sum(along**2, axis=-1)
