"""What a record can and cannot tell: the Fisher information against the prior, and a verdict in words."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.model.prior import Prior

NAMES = ("Rsc", "Csc", "Ci")
_IDENTIFIED = 0.9  # smallest prior-whitened eigenvalue from which the data speak in every direction
_WIDE = math.log(10.0) / 1.959963984540054  # a prior whose 95 % spans more than a factor of 10 either way says little
_CONTACT_AREA = np.array([-1.0, 1.0, 1.0]) / math.sqrt(3.0)  # R ~ 1/A, C ~ A, in logs


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """The verdict on a record.

    Attributes:
        verdict: "identified", "prior-limited" or "unidentified".
        eigenvalues: prior-whitened Fisher eigenvalues lambda / (1 + lambda), smallest first; 1 is known from
            the data, 0 from the prior alone.
        blind_direction: the direction the data see least, a unit vector in the log-parameters.
        blind_name: what that direction is, in words.
        prior_sd: standard deviation, by the prior, of the parameter that moves most along it, in its logarithm.
        force_from_prior: share of the variance of the mean force that comes from the prior.
        remedy: what to measure next.
    """

    verdict: str
    eigenvalues: tuple[float, ...]
    blind_direction: dict[str, float]
    blind_name: str
    prior_sd: float
    force_from_prior: float
    remedy: str

    def to_dict(self) -> dict[str, Any]:
        """As in fit.json and summary.json."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        if self.verdict == "identified":
            return "identified: the record determines Rsc, Csc and Ci."
        moves = ", ".join(f"{name} {value:+.2f}" for name, value in self.blind_direction.items())
        return (
            f"{self.verdict}: the record cannot see {self.blind_name} (logs move together: {moves}); along it the"
            f" prior alone speaks (± {100.0 * math.expm1(self.prior_sd):.2g} %), and"
            f" {100.0 * self.force_from_prior:.3g} % of the force's variance comes from there. {self.remedy}"
        )


def assess(
    jacobian: Float[np.ndarray, "samples parameters"],
    root: Float[np.ndarray, "parameters parameters"],
    prior: Prior,
    prior_sd: Float[np.ndarray, " parameters"],
    force_gradient: Float[np.ndarray, " parameters"],
) -> Identifiability:
    """Judge a record by the whitened residuals' `jacobian` in theta, and its `covariance_root`.

    The first three coordinates are log Rsc, log Csc, log Ci; the others (gain, delay) are nuisances with
    priors of their own; `prior_sd` is that of all. `force_gradient` is that of the log mean force.
    """
    sd = prior_sd[:3]
    _, roots, vectors = np.linalg.svd(_marginal(jacobian * prior_sd), full_matrices=False)
    values = roots[::-1] ** 2
    shares = values / (1.0 + values)
    blind = sd * vectors[-1]
    blind = blind / np.linalg.norm(blind) * (-1.0 if blind[2] < 0.0 else 1.0)
    along = float(np.max(np.abs(blind)) / math.sqrt(np.sum((blind / sd) ** 2)))
    if shares[0] >= _IDENTIFIED:
        verdict = "identified"
    else:
        verdict = "prior-limited" if along <= _WIDE else "unidentified"
    moved = root @ (root.T @ force_gradient)
    return Identifiability(
        verdict=verdict,
        eigenvalues=tuple(float(share) for share in shares),
        blind_direction=dict(zip(NAMES, map(float, blind), strict=True)),
        blind_name=_name(blind),
        prior_sd=along,
        force_from_prior=float(np.sum((moved / prior_sd) ** 2) / (moved @ force_gradient)),
        remedy="" if verdict == "identified" else _remedy(verdict, prior),
    )


def covariance_root(
    jacobian: Float[np.ndarray, "samples parameters"], prior_sd: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, "parameters parameters"]:
    """A matrix whose product with its transpose is the Laplace approximation's covariance.

    From the singular values of the Jacobian: their squares span more digits than a number has.
    """
    _, roots, vectors = np.linalg.svd(jacobian * prior_sd, full_matrices=False)
    return prior_sd[:, None] * vectors.T / np.hypot(1.0, roots)


def _marginal(scaled: np.ndarray) -> np.ndarray:
    """The Jacobian (per prior sd) of the first three parameters, less what the others can do within their priors."""
    count = scaled.shape[1] - 3
    if count == 0:
        return scaled
    others, _ = np.linalg.qr(np.vstack([scaled[:, 3:], np.eye(count)]))
    first = np.vstack([scaled[:, :3], np.zeros((count, 3))])
    return first - others @ (others.T @ first)


def _name(direction: np.ndarray) -> str:
    if direction @ _CONTACT_AREA > 0.99:
        return "the contact area, which scales 1/Rsc, Csc and Ci alike"
    moves = ", ".join(f"{name} {value:+.2f}" for name, value in zip(NAMES, direction, strict=True))
    return f"the combination ({moves})"


def _remedy(verdict: str, prior: Prior) -> str:
    remedy = (
        "To end it, record the trunk current I as well, or put a known resistor (about 100 kohm) in series;"
        " or measure Ci of the panel better, since its prior sets the scale. More of the same data will not help."
    )
    if verdict == "unidentified":
        remedy = "No prior covers that direction: state one for Ci, from the panel's data sheet. " + remedy
    if prior.gain is not None:
        remedy += " The free gain is confounded with Rsc Ci: calibrate the probe, and resolve the drive's edges."
    return remedy
