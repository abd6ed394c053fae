"""How far a fitted finger feels the drive above the detection threshold, by the scene's table of thresholds."""

import dataclasses
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact import summary
from fitact.compiled import double_precision
from fitact.fitting.derived import DerivedQuantities, evaluate_draws, nuisance_deviates
from fitact.likelihood.likelihood import Likelihood
from fitact.model.drive import Periodic
from fitact.model.steady_cycle import PeriodGrid, Sensation
from fitact.scene.scene import Scene
from fitact.units import format_engineering, format_percent


class ForceSensation(eqx.Module):
    """The `Sensation` of a fit's force, as a function of a point of the posterior."""

    derive: DerivedQuantities
    cycles: Float[Array, " times"]  # of the times in `derive`, in periods
    sensitivity: Float[Array, " harmonics"]  # 1/N

    @classmethod
    def from_fit(cls, derive: DerivedQuantities, frequency: float, sensitivity: np.ndarray) -> Self:
        """Choose the times: a period of the steady state, or the whole periods of the record that `derive` has."""
        drive = derive.drive
        if derive.steady_state and isinstance(drive, Periodic):
            grid = PeriodGrid.from_drive(drive, sensitivity.size)
            time = np.asarray(grid.cycles) / frequency - float(drive.phase_time)
            derive = dataclasses.replace(derive, time=time, weight=np.asarray(grid.weight))
        return cls(derive, np.asarray(derive.time) * frequency, sensitivity)

    def __call__(self, point: Array, deviate: Array) -> Float[Array, " 3"]:
        """Return the fields of the `Sensation` for friction equal to the force."""
        theta, log_sigma = self.derive.likelihood.split(point)
        force = self.derive.force(theta, jnp.exp(log_sigma), deviate)
        return jnp.stack(Sensation.from_force(force, self.derive.weight, self.cycles, self.sensitivity))


@dataclasses.dataclass(frozen=True)
class FeltDrive:
    """Draws of the drive's sensation, or the reason why none is stated.

    Attributes:
        times_threshold: friction's harmonics over their thresholds, root sum of squares; None if not stated.
        frequency: of the friction that is felt most, Hz.
        outside: median fraction of the mean square of the alternating force at frequencies outside the table.
        table: range and source of the table, for people.
        reason: why none is stated, for people.
    """

    times_threshold: Float[np.ndarray, "ensembles draws"] | None
    frequency: float
    outside: float
    table: str
    reason: str = "the force has no frequency in the table of thresholds"

    @classmethod
    def from_draws(
        cls,
        derive: DerivedQuantities,
        likelihood: Likelihood,
        scene: Scene,
        frequency: float | None,
        points: Float[np.ndarray, "ensembles draws n"],
        seed: int,
    ) -> Self | None:
        """Evaluate points of a posterior at the nominal geometry; None if the scene states no table.

        `frequency` is the drive's (Hz), or None if it does not repeat.
        """
        if scene.perception.thresholds is None:
            return None
        table = scene.perception.thresholds
        text = f"{table.range_text}; {scene.perception.threshold_source or 'no source stated'}"
        if frequency is None:
            return cls(None, 0.0, 1.0, text, "the drive does not repeat")
        sensitivity = table.harmonic_sensitivity(frequency, 1.0)
        with double_precision():
            force = ForceSensation.from_fit(
                derive.tabulate(points[..., : -len(likelihood.channels)].reshape(-1, len(likelihood.names))),
                frequency,
                sensitivity,
            )
        deviates = nuisance_deviates(likelihood, points, seed)
        rows = force.derive.time.size
        drawn = evaluate_draws(ForceSensation.__call__, force, rows, points, deviates)
        order, outside = np.median(drawn[..., 1]), float(np.median(drawn[..., 2]))
        times = drawn[..., 0] * _friction_over_force(likelihood, scene, points)
        return cls(times if order else None, float(order * frequency), outside, text)

    @property
    def sentence(self) -> str:
        """The sensation for people, with the table that it rests on."""
        if self.times_threshold is None:
            return f"Felt: no detection is stated, because {self.reason} ({self.table})."
        level = _level(self.times_threshold)
        low, median, high = (f"{level[key]:.1f}" for key in ("q05", "q50", "q95"))
        most = format_engineering(self.frequency, "Hz", 3)
        excluded = ""
        if self.outside > 0.01:
            excluded = (
                f" {format_percent(self.outside)} of the force's alternating power lies outside the table and is not"
                " counted, so the value is a lower bound."
            )
        return (
            f"Felt: the alternating friction is {float(np.median(self.times_threshold)):.3g} times the detection"
            f" threshold, a sensation level of {median} dB (90 % interval {low} to {high} dB), most at {most}."
            f"{excluded} Thresholds: {self.table}. The interval contains no error of thresholds and force law."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return `sensation` of summary.json; `level` in dB above the threshold."""
        if self.times_threshold is None:
            return {"table": self.table, "sentence": self.sentence}
        figures = {"level": _level(self.times_threshold), "frequency": self.frequency, "outside": self.outside}
        return figures | {"table": self.table, "sentence": self.sentence}


def _friction_over_force(likelihood: Likelihood, scene: Scene, points: np.ndarray) -> Float[np.ndarray, "*draws"]:
    """Return the alternating friction over the computed force: mu force_scale, measured where it was fitted."""
    stated = {"mu": float(scene.friction.coefficient), "force_scale": 1.0} | scene.fixed_values()
    values = stated | likelihood.friction_parameters(np.moveaxis(points, -1, 0))
    return np.asarray(values["mu"] * values["force_scale"])


def _level(times_threshold: Float[np.ndarray, "*shape"]) -> summary.Summary:
    return summary.summarize_draws("sensation_level", 20.0 * np.log10(times_threshold))
