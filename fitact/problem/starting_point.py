"""Starting point of a fit: estimates from linear fits to the record, otherwise the best of draws from the prior."""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact.compiled import BatchEvaluator
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.model.skin import WithSkin, circuit_parameters
from fitact.problem.drive_choice import DriveModel, has_ideal_edges


class VscEstimate(NamedTuple):
    """Divider g, time constant b (s) and, with a leak, the gain at zero frequency, from a linear fit."""

    g: float
    b: float
    direct: float = 0.0


class CurrentEstimate(NamedTuple):
    """Coefficients of I = weight s b / (1 + s b) V + capacitance dV/dt from linear fits."""

    weight: float  # S
    b: float  # s
    capacitance: float  # F

    @property
    def Ci(self) -> float:
        """Capacitance at low frequencies, that of the insulator; the weight, less well known, is a small part, F."""
        return self.capacitance + self.weight * self.b


class SkinEstimate(NamedTuple):
    """Rsc (ohm), Csc and Ci (F) from linear fits."""

    Rsc: float
    Csc: float
    Ci: float


Estimate: TypeAlias = VscEstimate | CurrentEstimate | SkinEstimate


def estimate_from_vsc(
    record: Record, choice: DriveModel, max_divider: float = 0.5, *, has_leak: bool = False
) -> VscEstimate:
    """Estimate g and b from Vsc = g V - (1/b) ∫ Vsc dt + line, the circuit's equation integrated once.

    With a leak, (d/b) ∫ V dt with the gain d at zero frequency takes the place of the line's slope. A carrier tells g,
    and hardly b, for which its delay would be mistaken.

    Raises:
        InputError: g is not between 0 and `max_divider` (1/2, or slightly more with a free gain), which this circuit
            cannot give.
    """
    time, vsc, voltage = record.time, record["Vsc"], choice.voltage
    span = time[-1] - time[0]
    integral = _integrate(vsc, time) / span
    line = (_integrate(voltage, time) if has_leak else time - time[0]) / span
    if has_ideal_edges(choice.drive):  # the trapezoid rule fails at samples next to an ideal edge
        inside = np.abs(np.diff(voltage, prepend=voltage[0])) < 1e-9 * np.ptp(voltage)
    else:
        inside = np.ones(time.size, dtype=bool)
    part_size = 1 << 20  # samples, which limits memory
    R = np.zeros((0, 5))
    for first in range(0, time.size, part_size):
        part = slice(first, first + part_size)
        ones = np.ones_like(time[part])
        rows = np.stack([voltage[part], integral[part], ones, line[part], vsc[part]], axis=1)
        R = np.asarray(np.linalg.qr(np.vstack([R, rows[inside[part]]]), mode="r"))
    (g, slope, _, direct), *_ = np.linalg.lstsq(R[:, :4], R[:, 4], rcond=None)
    if choice.name == "measured" and record.tones is not None and record.tones.carrier is not None:
        g, slope = abs(record.tones.carrier_gain(vsc)), 0.0
    if g >= max_divider:
        raise InputError(
            f"{record.source}: Vsc is {g:.3g} times V at a step, but this circuit excludes 1/2 or more;"
            " check for swapped columns or a wrong unit of V_V or Vsc_V"
        )
    if g <= 0.0:
        raise InputError(
            f"{record.source}: Vsc steps against V (divider g = {g:.3g}); check the polarity of the probes, and that"
            " V_V and Vsc_V belong to the same record"
        )
    if not slope < 0.0:
        return VscEstimate(float(g), float("inf"))
    return VscEstimate(float(g), float(span / -slope), float(direct / -slope) if has_leak else 0.0)


def _integrate(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the integral from the first sample to each, by the trapezoid rule."""
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(time) * (values[1:] + values[:-1]))])


def start_from_estimates(
    likelihood: Likelihood, estimates: Sequence[Estimate | None], draws: int = 255
) -> Float[np.ndarray, " circuit_parameters"]:
    """Return the starting point: from the linear fits if they apply to the circuit, else the best draw of the prior."""
    vsc = next((estimate for estimate in estimates if isinstance(estimate, VscEstimate)), None)
    current = next((estimate for estimate in estimates if isinstance(estimate, CurrentEstimate)), None)
    theta = np.concatenate([likelihood.prior.log_mean, np.zeros(len(likelihood.names) - len(likelihood.prior.names))])
    if current is not None and not current.capacitance > 0.0 and isinstance(likelihood.template, WithSkin):
        current = None  # at one frequency, the constant skin that fits such a current can be unphysical
    known = next((estimate for estimate in estimates if isinstance(estimate, SkinEstimate)), None)
    if vsc is None and current is None and known is None:
        points = np.vstack([theta, likelihood.sample_prior(theta, draws)])
        return points[int(np.argmin(residual_objective(likelihood, points)))]
    mean, sd = prior_skin_moments(likelihood)
    ratio = 0.0  # of Rsc to the leak Ri
    if vsc is not None and 0.0 < vsc.direct < 0.5:
        ratio = vsc.direct / (1.0 - 2.0 * vsc.direct)
        vsc = vsc._replace(b=vsc.b * (1.0 + 2.0 * ratio))  # without the leak
    skin, logs = known or skin_from_estimates(vsc, current), mean
    if skin is not None:
        logs = np.log(skin)
    elif vsc is not None:
        logs = most_probable_skin(np.asarray(vsc.g), np.asarray(vsc.b), mean, sd)
    if ratio > 0.0 and "Ri" in likelihood.prior.names:
        theta[likelihood.prior.names.index("Ri")] = float(logs[0]) - math.log(ratio)
    for name, value in zip(FINGER_PARAMETERS, logs, strict=True):
        if name in likelihood.prior.names:
            theta[likelihood.prior.names.index(name)] = value
    return theta


def skin_from_estimates(vsc: VscEstimate | None, current: CurrentEstimate | None) -> tuple[float, float, float] | None:
    """Return Rsc, Csc and Ci of the circuit from the estimates of Vsc and I, or None if these do not determine them."""
    if current is None or not current.weight > 0.0:
        return None
    Ci = current.Ci  # weight = 2 g^2 / Rsc, capacitance = g Csc
    if vsc is not None and math.isfinite(vsc.b):
        g, b, _ = vsc
    elif vsc is None and current.capacitance > 0.0:
        g, b = 0.5 * current.weight * current.b / Ci, current.b
    else:
        return None
    return (g * b / Ci, (1.0 / g - 2.0) * Ci, Ci) if g < 0.5 and Ci > 0.0 else None


def prior_skin_moments(likelihood: Likelihood) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior means and sds of log Rsc, log Csc and log Ci; the sd of a fixed parameter is 1e-6."""
    prior, known = likelihood.prior, circuit_parameters(likelihood.template)
    pairs = [
        (prior[name].log_mean, prior[name].log_sd) if name in prior.names else (math.log(float(known[name])), 1e-6)
        for name in FINGER_PARAMETERS
    ]
    mean, sd = np.array(pairs).T
    return mean, sd


def most_probable_skin(
    g: Float[np.ndarray, "*n"], b: Float[np.ndarray, "*n"], mean: np.ndarray, sd: np.ndarray
) -> Float[np.ndarray, "*n 3"]:
    """Return the points of highest prior density with divider `g` and time constant `b` (s; infinite if unknown).

    Points with equal g and b lie on the line (log Rsc, log Csc, log Ci) = point + t (-1, 1, 1).
    """
    g = np.clip(g, 1e-9, 0.4999)
    b = np.where(np.isfinite(b), b, math.exp(mean[0] + mean[1]))
    ci = math.exp(mean[2])
    point = np.stack([np.log(g * b / ci), np.log((1.0 / g - 2.0) * ci), np.full_like(g, math.log(ci))], axis=-1)
    direction, weight = np.array([-1.0, 1.0, 1.0]), sd**-2.0
    return point + direction * np.sum(weight * direction * (mean - point), axis=-1, keepdims=True) / np.sum(weight)


def residual_objective(likelihood: Likelihood, points: Float[np.ndarray, "n parameters"]) -> Float[np.ndarray, " n"]:
    """Return the residual objective of each point, which compares points without knowledge of the noise."""
    return BatchEvaluator(_residual_objective, likelihood, likelihood.rows)(points)


def _residual_objective(
    likelihood: Likelihood, theta: Float[np.ndarray, " circuit_parameters"]
) -> Float[np.ndarray, ""]:
    """Return half the sum over channels of samples times log(sum of squared residuals)."""
    total = jnp.zeros(())
    for channel, inputs in likelihood.channels_and_inputs(theta):
        residuals, *_ = channel.fit_nuisances(inputs, 1e-3 * jnp.ptp(channel.samples.observed))
        total = total + 0.5 * channel.count * jnp.log(jnp.sum(jnp.square(residuals)))
    return total
