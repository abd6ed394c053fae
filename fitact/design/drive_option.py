"""One drive on one panel: the amplitude at which enough fingers feel it, and its effects at that amplitude."""

import dataclasses
import math
from typing import Any, ClassVar, Self

import numpy as np
import scipy
from jaxtyping import Float

from fitact.compiled import double_precision
from fitact.design.limits import LimitComparison, compare_with_limits, format_quantity
from fitact.model.steady_cycle import PeriodQuantities, Sensation
from fitact.scene.sections import Device, DriveSection
from fitact.units import format_engineering

ASSURANCE = 0.95  # probability that the fraction of fingers is reached at the assured amplitude
FINGER_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def quantile(amplitude: Float[np.ndarray, "*shape"], share: float, axis: int | None = None) -> np.ndarray:
    """Return the amplitude that a fraction `share` of the given ones do not exceed; infinite if too few are finite."""
    with np.errstate(divide="ignore"):
        # the reciprocals interpolate also next to an infinite amplitude
        return np.divide(1.0, np.quantile(1.0 / amplitude, 1.0 - share, axis=axis, method="hazen"))


def quantile_error(amplitude: Float[np.ndarray, " n"], share: float) -> float:
    """Return the standard error of `quantile` over independent draws: the bootstrap's limit (Maritz & Jarrett 1978)."""
    place, count = float(quantile(amplitude, share)), amplitude.size
    if not math.isfinite(place):
        return math.inf
    rank = scipy.stats.beta(0.5 + count * (1.0 - share), 0.5 + count * share)  # of reciprocals, as in `quantile`
    weight, inverse = np.diff(rank.cdf(np.arange(count + 1) / count)), np.sort(1.0 / amplitude)
    return place**2 * math.sqrt(weight @ (inverse - weight @ inverse) ** 2)


@dataclasses.dataclass(frozen=True)
class DriveOption:
    """A waveform at a frequency on an insulator."""

    CRITERIA: ClassVar[dict[str, str]] = {"peak_to_peak": "V", "real_power": "W", "apparent_power": "VA"}

    waveform: str  # name, as in the scene's `[drive]`
    frequency: float  # Hz
    device: Device  # panel with its limits
    # peak-to-peak amplitude (V) that the required fraction of fingers needs, for each population sample
    amplitude: Float[np.ndarray, " laws"]
    assured_error: float  # Monte Carlo standard error of `assured`, V, from the finite number of samples
    people: Float[np.ndarray, " shares"]  # peak-to-peak V up to which `FINGER_QUANTILES` of all fingers feel it
    at_assured: PeriodQuantities  # forces and powers of the median finger, the largest voltage and currents
    # with a table of thresholds: frequency of the force that most fingers feel most (Hz; None if none is in the table),
    # and the median fraction of the alternating force's mean square at frequencies outside the table
    strongest: float | None = None
    outside: float | None = None

    @classmethod
    def from_amplitudes(
        cls,
        waveform: str,
        frequency: float,
        device: Device,
        required_amplitudes: Float[np.ndarray, "laws fingers"],
        unit_quantities: PeriodQuantities,
        share: float,
        felt: Sensation | None = None,
    ) -> Self:
        """Make an option from the amplitude that each finger needs, and the effects of a drive of 1 Vpp on it."""
        amplitude = quantile(required_amplitudes, share, axis=1)
        one_law = amplitude.size == 1
        error = quantile_error(required_amplitudes[0], share) if one_law else quantile_error(amplitude, ASSURANCE)
        people = np.array([quantile(required_amplitudes, q) for q in FINGER_QUANTILES])
        used = _scale_to_amplitude(unit_quantities, float(quantile(amplitude, ASSURANCE)))
        if felt is None:
            return cls(waveform, frequency, device, amplitude, error, people, used)
        order, outside = np.bincount(felt.strongest.ravel()).argmax(), float(np.median(felt.outside))
        strongest = float(order * frequency) if order else None
        return cls(waveform, frequency, device, amplitude, error, people, used, strongest, outside)

    @property
    def assured(self) -> float:
        """Peak-to-peak amplitude (V) that suffices with probability `ASSURANCE`: an upper tolerance limit."""
        return float(quantile(self.amplitude, ASSURANCE))

    def criterion_value(self, criterion: str) -> float:
        """Return the assured amplitude, or the power there, by the names of `CRITERIA` and in their units."""
        return self.assured if criterion == "peak_to_peak" else float(getattr(self.at_assured, criterion))

    @property
    def breakdown_voltage(self) -> float | None:
        """Breakdown voltage of the insulator, V; None if the scene states no breakdown field."""
        field = self.device.breakdown_field
        return None if field is None else field * self.device.insulator_thickness

    @property
    def limits(self) -> list[LimitComparison]:
        """Body current and insulator field at the assured amplitude, beside published and stated limits."""
        return compare_with_limits(self.frequency, self.at_assured, self.device)

    @property
    def violations(self) -> tuple[str, ...]:
        """Limits of the scene that the option exceeds at the assured amplitude, as phrases."""
        if self.outside is not None and self.strongest is None:
            return ("its force has no frequency in the table of thresholds, so no detection is stated",)
        if not math.isfinite(self.assured):
            return ("too few fingers feel it at any amplitude",)
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
        """Return the option in SI units; null stands for what is infinite or not stated."""
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
            "insulator_field": float(self.at_assured.insulator_peak) / self.device.insulator_thickness,
            "breakdown_voltage": self.breakdown_voltage,
            "violations": list(self.violations),
        } | ({} if self.outside is None else {"strongest": self.strongest, "outside": self.outside})


def _scale_to_amplitude(unit_quantities: PeriodQuantities, amplitude: float) -> PeriodQuantities:
    """Scale from 1 Vpp: forces and powers of the median finger, the largest voltage and currents."""
    linear = ("insulator_peak", "current_rms", "current_peak")  # the others grow with the square of the amplitude
    with np.errstate(invalid="ignore"):
        scaled = {
            name: np.max(values) * amplitude if name in linear else np.median(values, axis=(0, 1)) * amplitude**2
            for name, values in unit_quantities._asdict().items()
        }
    return PeriodQuantities(**scaled)


def normalize_drive(drive: DriveSection) -> DriveSection:
    """Scale a drive to 1 V peak to peak, its offset in proportion."""
    height = drive.peak_to_peak
    if drive.amplitudes is not None:  # at least 65 points of the fastest cycle
        time = np.linspace(0.0, 1.0 / drive.lowest_frequency, 16_384, endpoint=False)
        with double_precision():
            height = float(np.ptp(drive.make().value(time)))
    amplitudes = drive.amplitudes and tuple(amplitude / height for amplitude in drive.amplitudes)
    scaled = {"peak_to_peak": 1.0, "offset": drive.offset / height, "amplitudes": amplitudes}
    return drive.model_copy(update=scaled)
