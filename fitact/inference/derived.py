"""What follows from the parameters: divider, time constant, force and friction, at any theta."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.data.record import Record
from fitact.inference.likelihood import CHARGE, Likelihood
from fitact.inference.start import DriveChoice, whole_periods
from fitact.model.circuit import FinalCircuit
from fitact.model.drive import Periodic, PiecewiseLinear
from fitact.model.force import Contact, electrostatic_force, friction, mean_force, peak_force, summarize
from fitact.model.response import response
from fitact.model.scene import Scene

NAMES = ("g", "b", "force_mean", "force_peak", "force_rms", "friction_mean")

_NODES = 64  # Gauss-Legendre nodes along each straight piece of a drive


class Derived(eqx.Module):
    """Derived quantities as functions of theta; built by `for_fit`.

    Means are over one period of a scene's drive in the steady state, else over the largest whole number of
    periods that the record holds (the whole record where it holds none).

    Attributes:
        likelihood: names theta's coordinates.
        time: when the force is evaluated, s.
        weight: the share of time each stands for; a weight of 0 counts for the peak only.
        area, insulator_thickness, skin_thickness: m^2, m, m.
        coefficient, normal_force: of friction; 1, N.
    """

    likelihood: Likelihood
    time: Float[Array, " times"]
    weight: Float[Array, " times"]
    area: ArrayLike
    insulator_thickness: ArrayLike
    skin_thickness: ArrayLike
    coefficient: ArrayLike
    normal_force: ArrayLike

    def force(
        self, theta: Float[Array, " parameters"], sigma: ArrayLike, deviate: ArrayLike = 0.0
    ) -> Float[Array, " times"]:
        """Electrostatic force in time, N, eq. (22); the permittivities follow Ci and Csc through eq. (3).

        `deviate` holds seven standard normal numbers that draw the charge from its posterior; 0: its mean.
        """
        model, circuit = self.likelihood, self.likelihood.circuit(theta)
        vsc = response(circuit, model.drive, self.time, steady_state=model.steady_state)
        beta = model.drawn(theta, sigma, deviate)
        vsc = vsc + beta[CHARGE] * model.linear_sd[CHARGE] * model.decay(theta, self.time) / model.gain(theta)
        return electrostatic_force(vsc, self.contact(circuit))

    def contact(self, circuit: FinalCircuit) -> Contact:
        """The contact whose permittivities follow from the circuit's capacitances, eq. (3)."""
        return Contact.from_capacitances(
            circuit.Ci, circuit.Csc, self.area, self.insulator_thickness, self.skin_thickness
        )

    def __call__(
        self, theta: Float[Array, " parameters"], sigma: ArrayLike, deviate: ArrayLike = 0.0
    ) -> Float[Array, " derived"]:
        """All of `NAMES`, in SI units."""
        circuit = self.likelihood.circuit(theta)
        force = summarize(self.force(theta, sigma, deviate), self.weight)
        if self.likelihood.steady_state and isinstance(self.likelihood.drive, Periodic):  # rms alone needs quadrature
            contact, drive = self.contact(circuit), self.likelihood.drive
            force = force._replace(mean=mean_force(circuit, drive, contact), peak=peak_force(circuit, drive, contact))
        felt = friction(force.mean, self.coefficient, self.normal_force)
        return jnp.stack([circuit.g, circuit.b, force.mean, force.peak, force.rms, felt])


def for_fit(likelihood: Likelihood, record: Record, choice: DriveChoice, scene: Scene) -> Derived:
    """The derived quantities of a fit's parameters."""
    time, weight = _grid(record, choice)
    return Derived(
        likelihood,
        jnp.asarray(time),
        jnp.asarray(weight / weight.sum()),
        scene.device.contact_area,
        scene.device.insulator_thickness,
        scene.skin.thickness,
        scene.friction.coefficient,
        scene.friction.normal_force,
    )


def _grid(record: Record, choice: DriveChoice) -> tuple[np.ndarray, np.ndarray]:
    drive = choice.drive
    if isinstance(drive, PiecewiseLinear) and choice.steady_state:
        knots = np.asarray(drive.pieces().knots) - float(drive.lead)
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        length = np.diff(knots)[:, None]
        inside = knots[:-1, None] + 0.5 * length * (nodes + 1.0)
        # u is monotone along a piece, so peaks sit at the knots
        return np.append(inside, knots[:-1]), np.append(0.5 * length * weights, np.zeros(length.size))
    if isinstance(drive, Periodic) and choice.steady_state:
        return np.arange(1024) / 1024 * float(drive.period), np.ones(1024)
    kept, period = whole_periods(record)
    cells = np.gradient(record.time)
    if period is None:  # the trapezoid rule; over whole periods the ends meet
        cells[[0, -1]] *= 0.5
    return record.time[:kept] - choice.shift, cells[:kept]
