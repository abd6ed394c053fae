"""One drive on one panel: the amplitude at which enough people feel it, and what it then does."""

import dataclasses
import math
from typing import Any, ClassVar, Self

import numpy as np
import scipy.stats
from jax.typing import ArrayLike
from jaxtyping import Float

from fitact.model.steady_cycle import Cycle
from fitact.scene.sections import Device
from fitact.units import engineering

ASSURANCE = 0.95  # the probability that the share of people is reached at the assured amplitude
PEOPLE = (0.05, 0.25, 0.5, 0.75, 0.95)


def quantile(amplitude: Float[np.ndarray, "*shape"], share: float, axis: int | None = None) -> np.ndarray:
    """The amplitude that `share` of those given do not exceed; infinite where too few are finite."""
    with np.errstate(divide="ignore"):
        # between reciprocals, which interpolate where infinities do not
        return np.divide(1.0, np.quantile(1.0 / amplitude, 1.0 - share, axis=axis, method="hazen"))


def quantile_error(amplitude: Float[np.ndarray, " n"], share: float) -> float:
    """Standard error of `quantile` over independent draws: that over all bootstrap samples (Maritz & Jarrett 1978)."""
    place, count = float(quantile(amplitude, share)), amplitude.size
    if not math.isfinite(place):
        return math.inf
    rank = scipy.stats.beta(0.5 + count * (1.0 - share), 0.5 + count * share)  # between reciprocals, as `quantile`
    weight, inverse = np.diff(rank.cdf(np.arange(count + 1) / count)), np.sort(1.0 / amplitude)
    return place**2 * math.sqrt(weight @ (inverse - weight @ inverse) ** 2)


def shown(value: ArrayLike, unit: str, error: float | None = None) -> str:
    """For people, with its standard error if that is given."""
    if not math.isfinite(value):
        return "unbounded"
    return engineering(float(value), unit, 3) + ("" if error is None else f" ± {engineering(error, unit, 2)}")


@dataclasses.dataclass(frozen=True)
class DriveOption:
    """A waveform at a frequency on an insulator.

    Attributes:
        waveform: its name.
        frequency: Hz.
        device: the panel, with its limits.
        amplitude: peak-to-peak, V, that the share of people needs, under each law.
        assured_error: of `assured`, V: the standard error that its draws, of laws or of a prior's fingers, leave.
        people: peak-to-peak, V, up to which `PEOPLE` of all fingers feel it.
        at_assured: at the assured amplitude: forces and powers of the median finger, the voltage over the insulator
            and the currents the largest of all fingers.
    """

    CRITERIA: ClassVar[dict[str, str]] = {"peak_to_peak": "V", "real_power": "W", "apparent_power": "VA"}

    waveform: str
    frequency: float
    device: Device
    amplitude: Float[np.ndarray, " laws"]
    assured_error: float
    people: Float[np.ndarray, " shares"]
    at_assured: Cycle

    @classmethod
    def of(
        cls,
        waveform: str,
        frequency: float,
        device: Device,
        needed: Float[np.ndarray, "laws fingers"],
        found: Cycle,
        share: float,
    ) -> Self:
        """From the amplitude that each finger needs, and what a drive of 1 Vpp does at it."""
        amplitude = quantile(needed, share, axis=1)
        assured = float(quantile(amplitude, ASSURANCE))
        error = quantile_error(amplitude, ASSURANCE) if amplitude.size > 1 else quantile_error(needed[0], share)
        people = np.array([quantile(needed, each) for each in PEOPLE])
        return cls(waveform, frequency, device, amplitude, error, people, _at(found, assured))

    @property
    def assured(self) -> float:
        """The peak-to-peak amplitude that meets the share with a probability of `ASSURANCE`, V."""
        return float(quantile(self.amplitude, ASSURANCE))

    def takes(self, what: str) -> float:
        """The assured amplitude, or a power there, by the names of `CRITERIA` and in their units."""
        return self.assured if what == "peak_to_peak" else float(getattr(self.at_assured, what))

    @property
    def breakdown_voltage(self) -> float | None:
        """What the insulator holds, V; None: its breakdown field is not stated."""
        field = self.device.breakdown_field
        return None if field is None else field * self.device.insulator_thickness

    @property
    def violations(self) -> tuple[str, ...]:
        """What stands against it: the limits that it breaks at the assured amplitude, as phrases."""
        if not math.isfinite(self.assured):
            return ("too few feel it at any amplitude",)
        checked = (
            ("the voltage over the insulator", "V", self.at_assured.insulator_peak, self.breakdown_voltage),
            ("the rms current", "A", self.at_assured.current_rms, self.device.current_limit_rms),
            ("the peak current", "A", self.at_assured.current_peak, self.device.current_limit_peak),
        )
        return tuple(
            f"{what} is {shown(value, unit)}, above {engineering(limit, unit, 3)}"
            for what, unit, value, limit in checked
            if limit is not None and not value <= limit
        )

    def to_dict(self) -> dict[str, Any]:
        """SI units; null for what is infinite, or not stated."""
        low, median, high = (
            float(quantile(self.amplitude, q)) if self.amplitude.size > 1 or q == 0.5 else None
            for q in (0.05, 0.5, 0.95)
        )
        shown = {name: np.asarray(value).tolist() for name, value in self.at_assured._asdict().items()}
        return {
            "waveform": self.waveform,
            "frequency": self.frequency,
            "insulator_thickness": self.device.insulator_thickness,
            "insulator_permittivity": self.device.insulator_permittivity,
            "peak_to_peak": {"unit": "V", "q05": low, "q50": median, "q95": high}
            | {"assured": self.assured, "assured_error": self.assured_error},
            "people": {"unit": "V"} | dict(zip(("q05", "q25", "q50", "q75", "q95"), self.people.tolist(), strict=True)),
            "at_assured": shown,
            "breakdown_voltage": self.breakdown_voltage,
            "violations": list(self.violations),
        }


def _at(found: Cycle, amplitude: float) -> Cycle:
    """At another amplitude than 1 Vpp: forces and powers of the median finger, voltage and currents the largest."""
    with np.errstate(invalid="ignore"):
        typical = {name: np.median(getattr(found, name), axis=(0, 1)) * amplitude**2 for name in _QUADRATIC}
        largest = {name: np.max(getattr(found, name)) * amplitude for name in _LINEAR}
    return Cycle(**typical, **largest)


_QUADRATIC = ("force_mean", "force_alternating", "force_harmonics", "real_power", "apparent_power")
_LINEAR = ("insulator_peak", "current_rms", "current_peak")
