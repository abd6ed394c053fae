"""Identifiability: Fisher information of the data against the prior, a verdict, and suggested measurements."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.compiled import double_precision
from fitact.experiment.blind_directions import blind_directions, gain_names, is_blind, name_direction
from fitact.experiment.experiment import CandidateDesign, DesignOption
from fitact.experiment.fisher import Experiment
from fitact.experiment.options import NEEDS, suggest_measurements
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.units import format_percent

# smallest fraction of the variance of a parameter from the prior at which the prior counts as an assumption
MIN_PRIOR_FRACTION = 0.1


class NextMeasurement(NamedTuple):
    """Suggested next measurement if not all parameters are identified."""

    structural: bool = False  # whether no record of these channels could determine the blind direction
    remedy: str = ""
    advice: str = ""  # the part of `remedy` without the expected uncertainties of `remedies`
    remedies: tuple[DesignOption, ...] = ()  # the suggested measurements, best first


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """Verdict on the identifiability of the parameters from the data."""

    verdict: str  # "identified", "prior-limited" or "unidentified"
    # prior-whitened Fisher eigenvalues lambda / (1 + lambda), smallest first: 1 determined by the data, 0 by the prior
    eigenvalues: tuple[float, ...]
    blind_direction: dict[str, float]  # direction that the data determine least, a unit vector in the log-parameters
    blind_name: str  # description of that direction
    prior_sd: float  # prior sd of the logarithm of the parameter that changes most in that direction
    force_from_prior: float  # fraction of the variance of the mean force that comes from the prior
    force_sd: float  # standard deviation of the mean force, in its logarithm
    force_contraction: float  # 1 - force_sd / prior sd of the same logarithm
    channels: tuple[str, ...]  # channels recorded beside V
    # the measurement of the data; None with a spectrum
    experiment: Experiment | None = dataclasses.field(default=None, repr=False, compare=False)
    # gradient of the logarithm of the mean force in the free parameters of `experiment`, which others follow
    force_gradient: Float[np.ndarray, " free"] | None = dataclasses.field(default=None, repr=False, compare=False)
    # standard uncertainty of the log mean force from what no suggested measurement changes, now and after one, and the
    # names of the sources
    unchanged: tuple[float, float, str] = (0.0, 0.0, "")

    @functools.cached_property
    def next_measurement(self) -> NextMeasurement:
        """Suggested next measurement, computed on first access."""
        if self.verdict == "identified":
            return NextMeasurement()
        now, after, sources = self.unchanged

        def show(circuit: float, others: float) -> str:
            alone = f" ({format_percent(circuit)})" if others > 0.0 else ""
            return f"± {format_percent(math.hypot(circuit, others))}{alone}"

        brackets = f", in brackets without {sources}" if after > 0.0 else ""
        force = f"Uncertainty of the mean force{brackets}: {show(self.force_sd, now)} now"
        experiment = self.experiment
        if experiment is None or self.force_gradient is None:
            is_gain = self.channels == ("Vsc",)
            advice = "measure from below the corner frequency of the skin to above it."
            advice = "measure the impedance, or record the current I beside Vsc." if is_gain else advice
            return NextMeasurement(is_gain, f"{force}; {advice}", advice[0].upper() + advice[1:])
        with double_precision():
            stray = experiment.stray_capacitance
            blind = blind_directions(experiment.circuit, experiment.free, experiment.channels, stray)
            present = CandidateDesign.from_fit(experiment, self.force_gradient, self.force_sd)
            options = suggest_measurements(present, self.force_gradient)
        figures = [f"{show(option.force_sd, after)} with {option.text}" for option in options]
        expected = f"{force}. Expected after one change: {', '.join(figures)}."
        hints: list[str] = []
        if self.verdict == "unidentified":
            most = max(self.blind_direction, key=lambda name: abs(self.blind_direction[name]))
            what = "Ci and this contact area" if most in FINGER_PARAMETERS else most
            hints.append(f"No prior narrows that direction; state one for {what} under [prior].")
        gains = blind[:, [name in gain_names(experiment.channels) for name in experiment.free]]
        if np.any(np.abs(gains) > 0.1):  # components of a unit vector above this belong to a direction
            hints.append(
                "The free gain is confounded with the circuit; calibrate the probe and sample each edge several times."
            )
        remedy = " ".join((expected, *hints))
        return NextMeasurement(is_blind(blind, experiment.free, self.blind_direction), remedy, " ".join(hints), options)

    @property
    def structural(self) -> bool:
        """Whether no record of these channels, rather than this record alone, could determine the blind direction."""
        return self.next_measurement.structural

    @property
    def remedy(self) -> str:
        """Suggested next measurement, a sentence."""
        return self.next_measurement.remedy

    @property
    def advice(self) -> str:
        """Advice beside the suggested measurements, in sentences; "" for none."""
        return self.next_measurement.advice

    @property
    def remedies(self) -> tuple[DesignOption, ...]:
        """Suggested next measurements, best first; none if all parameters are identified."""
        return self.next_measurement.remedies

    def to_dict(self) -> dict[str, Any]:
        """Return the section of fit.json and summary.json."""
        names = (
            "verdict", "eigenvalues", "blind_direction", "blind_name", "structural", "prior_sd", "force_from_prior",
            "force_sd", "force_contraction", "remedy", "advice", "remedies", "channels",
        )  # fmt: skip
        values = {name: getattr(self, name) for name in names}
        after = self.unchanged[1]
        remedies = [
            each.to_dict() | {"u": math.hypot(each.force_sd, after), "needs": NEEDS[each.name]}
            for each in self.remedies
        ]
        return values | {"remedies": remedies}

    def __str__(self) -> str:
        names = list(self.blind_direction)
        if self.verdict == "identified":
            return f"identified: the data determine {', '.join(names[:-1])} and {names[-1]}."
        direction = ""
        if self.structural:
            moves = ", ".join(f"{name} {value:+.2f}" for name, value in self.blind_direction.items())
            direction = f" (direction in log-parameters: {moves})"
        return (
            f"{self.verdict}: {self.reason}{direction}. The prior sets this"
            f" combination (± {format_percent(math.expm1(self.prior_sd))}) and contributes"
            f" {100.0 * self.force_from_prior:.3g} % of the variance that its posterior gives to the force."
            f" {self.advice}"
        ).rstrip()

    @property
    def reason(self) -> str:
        """Reason why a direction is not identified, as a clause."""
        if self.structural:
            channels = " and ".join(self.channels) + (" alone" if len(self.channels) == 1 else "")
            return f"{channels} cannot determine {self.blind_name}"
        return (
            f"this record does not constrain {self.blind_name}; it is too short, too noisy or has too few frequencies"
        )


def _regress(deviate: Float[np.ndarray, " n"], roots: Float[np.ndarray, "parameters n"]) -> np.ndarray:
    """Return how a quantity follows some of the parameters when all others take their expected values.

    Quantity and parameters are given by factors of their joint covariance.
    """
    sd = np.linalg.norm(roots, axis=1)
    return np.linalg.lstsq((roots / sd[:, None]).T, deviate, rcond=None)[0] / sd


def assess_identifiability(
    names: Sequence[str],
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    prior_factor: Float[np.ndarray, "parameters parameters"],
    force_gradient: Float[np.ndarray, " parameters"],
    free: Sequence[str],
    channels: tuple[str, ...],
    experiment: Experiment | None = None,
    unchanged: tuple[float, float, str] = (0.0, 0.0, ""),
) -> Identifiability:
    """Assess the identifiability of a fit, from factors of its covariance and of the prior covariance.

    `names` are the coordinates of theta. The parameters `free` are assessed; gains and a stray capacitance are
    nuisances with priors of their own. `force_gradient`: gradient of the log mean force in theta. Without the
    `experiment` no measurements are suggested. `unchanged` is that of the result.
    """
    shares, blind, along = information_directions(names, covariance_factor, prior_factor, free)
    direction = dict(zip(free, map(float, blind), strict=True))
    deviate, gradient = covariance_factor.T @ force_gradient, None
    if experiment is not None:
        gradient = _regress(deviate, covariance_factor[[list(names).index(name) for name in experiment.free]])
    force_sd = float(np.linalg.norm(deviate))
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
        experiment=experiment,
        force_gradient=gradient,
        unchanged=unchanged,
    )


def information_directions(
    names: Sequence[str],
    covariance_factor: Float[np.ndarray, "*fits parameters parameters"],
    prior_factor: Float[np.ndarray, "parameters parameters"],
    free: Sequence[str],
) -> tuple[Float[np.ndarray, "*fits free"], Float[np.ndarray, "*fits free"], Float[np.ndarray, "*fits"]]:
    """Return eigenvalues, blind direction and `prior_sd` of the parameters `free` among `names`, for each fit."""
    rows = [list(names).index(name) for name in free]
    prior_root = np.linalg.cholesky((prior_factor @ prior_factor.T)[np.ix_(rows, rows)])
    inverse = np.linalg.inv(prior_root)
    # singular values: posterior sd over prior sd in each direction
    axes, shares, _ = np.linalg.svd(inverse @ covariance_factor[..., rows, :])
    blind = axes[..., 0] @ prior_root.T
    against = blind[..., list(free).index("Ci")] < 0.0 if "Ci" in free else np.zeros(blind.shape[:-1], bool)
    blind *= (np.where(against, -1.0, 1.0) / np.linalg.norm(blind, axis=-1))[..., None]
    along = np.max(np.abs(blind), axis=-1) / np.linalg.norm(blind @ inverse.T, axis=-1)
    return np.clip(1.0 - shares**2, 0.0, 1.0), blind, along


def verdicts(eigenvalues: Float[np.ndarray, "*fits free"], prior_sd: Float[np.ndarray, "*fits"]) -> np.ndarray:
    """Return "identified", "prior-limited" or "unidentified", from the eigenvalues and `prior_sd`."""
    min_eigenvalue = 0.9  # least prior-whitened eigenvalue of an identified direction
    max_prior_factor = 10.0  # a prior is informative if its 95 % interval reaches at most this factor either way
    narrow = prior_sd <= math.log(max_prior_factor) / NormalDist().inv_cdf(0.975)
    limited = np.where(narrow, "prior-limited", "unidentified")
    return np.where(eigenvalues[..., 0] >= min_eigenvalue, "identified", limited)


def prior_variance_fraction(
    covariance_factor: Float[np.ndarray, "*fits n n"],
    prior_factor: Float[np.ndarray, "n n"],
    gradient: Float[np.ndarray, "*fits n"],
) -> Float[np.ndarray, "*fits"]:
    """Return the fraction of the variance of a quantity that comes from the prior, from its gradient."""
    scaled = np.einsum("...ij,...i->...j", covariance_factor, gradient)
    moved = np.einsum("...ij,...j->...i", np.linalg.inv(prior_factor) @ covariance_factor, scaled)
    return np.sum(moved**2, axis=-1) / np.sum(scaled**2, axis=-1)
