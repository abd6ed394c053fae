"""One drive on one panel: the amplitude at which enough people feel it, and what it then does."""

import dataclasses
import math
from typing import Any, ClassVar, Self

import numpy as np
import scipy.stats
from jax.typing import ArrayLike
from jaxtyping import Float

from fitact.model.steady_cycle import PeriodQuantities
from fitact.scene.sections import Device
from fitact.units import format_engineering

ASSURANCE = 0.95  # the probability that the share of people is reached at the assured amplitude
FINGER_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


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


def format_quantity(value: ArrayLike, unit: str, error: float | None = None) -> str:
    """Format a value for people, with its standard error if that is given."""
    if not math.isfinite(value):
        return "unbounded"
    text = format_engineering(float(value), unit, 3)
    return text if error is None else f"{text} ± {format_engineering(error, unit, 2)}"


@dataclasses.dataclass(frozen=True)
class DriveOption:
    """A waveform at a frequency on an insulator."""

    CRITERIA: ClassVar[dict[str, str]] = {"peak_to_peak": "V", "real_power": "W", "apparent_power": "VA"}

    waveform: str
    frequency: float  # Hz
    device: Device  # the panel, with its limits
    amplitude: Float[np.ndarray, " laws"]  # peak-to-peak, V, that the share of people needs, under each law
    assured_error: float  # of `assured`, V: the standard error that its draws, of laws or of a prior's fingers, leave
    people: Float[np.ndarray, " shares"]  # peak-to-peak, V, up to which `FINGER_QUANTILES` of all fingers feel it
    at_assured: PeriodQuantities  # there: forces and powers of the median finger, voltage and currents the largest

    @classmethod
    def from_amplitudes(
        cls,
        waveform: str,
        frequency: float,
        device: Device,
        required_amplitudes: Float[np.ndarray, "laws fingers"],
        unit_quantities: PeriodQuantities,
        share: float,
    ) -> Self:
        """Evaluate an option by the amplitude that each finger needs, and what a drive of 1 Vpp does at it."""
        amplitude = quantile(required_amplitudes, share, axis=1)
        one_law = amplitude.size == 1
        error = quantile_error(required_amplitudes[0], share) if one_law else quantile_error(amplitude, ASSURANCE)
        people = np.array([quantile(required_amplitudes, q) for q in FINGER_QUANTILES])
        used = _scale_to_amplitude(unit_quantities, float(quantile(amplitude, ASSURANCE)))
        return cls(waveform, frequency, device, amplitude, error, people, used)

    @property
    def assured(self) -> float:
        """The peak-to-peak amplitude that meets the share with a probability of `ASSURANCE`, V."""
        return float(quantile(self.amplitude, ASSURANCE))

    def criterion_value(self, criterion: str) -> float:
        """The assured amplitude, or a power there, by the names of `CRITERIA` and in their units."""
        return self.assured if criterion == "peak_to_peak" else float(getattr(self.at_assured, criterion))

    @property
    def breakdown_voltage(self) -> float | None:
        """The voltage that the insulator holds, V; None: its breakdown field is not stated."""
        field = self.device.breakdown_field
        return None if field is None else field * self.device.insulator_thickness

    @property
    def violations(self) -> tuple[str, ...]:
        """The limits that it breaks at the assured amplitude, as phrases."""
        if not math.isfinite(self.assured):
            return ("too few feel it at any amplitude",)
        checked = (
            ("the voltage over the insulator", "V", self.at_assured.insulator_peak, self.breakdown_voltage),
            ("the rms current", "A", self.at_assured.current_rms, self.device.current_limit_rms),
            ("the peak current", "A", self.at_assured.current_peak, self.device.current_limit_peak),
        )
        return tuple(
            f"{what} is {format_quantity(value, unit)}, above {format_engineering(limit, unit, 3)}"
            for what, unit, value, limit in checked
            if limit is not None and not value <= limit
        )

    def to_dict(self) -> dict[str, Any]:
        """SI units; null for what is infinite, or not stated."""
        low, median, high = (
            float(quantile(self.amplitude, q)) if self.amplitude.size > 1 or q == 0.5 else None
            for q in (0.05, 0.5, 0.95)
        )
        return {
            "waveform": self.waveform,
            "frequency": self.frequency,
            "insulator_thickness": self.device.insulator_thickness,
            "insulator_permittivity": self.device.insulator_permittivity,
            "peak_to_peak": {"unit": "V", "q05": low, "q50": median, "q95": high}
            | {"assured": self.assured, "assured_error": self.assured_error},
            "people": {"unit": "V"} | dict(zip(("q05", "q25", "q50", "q75", "q95"), self.people.tolist(), strict=True)),
            "at_assured": {name: np.asarray(value).tolist() for name, value in self.at_assured._asdict().items()},
            "breakdown_voltage": self.breakdown_voltage,
            "violations": list(self.violations),
        }


def _scale_to_amplitude(unit_quantities: PeriodQuantities, amplitude: float) -> PeriodQuantities:
    """Scale from 1 Vpp: forces and powers of the median finger, voltage and currents the largest."""
    linear = ("insulator_peak", "current_rms", "current_peak")  # the others are quadratic
    with np.errstate(invalid="ignore"):
        scaled = {
            name: np.max(values) * amplitude if name in linear else np.median(values, axis=(0, 1)) * amplitude**2
            for name, values in unit_quantities._asdict().items()
        }
    return PeriodQuantities(**scaled)
