"""Published limits of the current through the body, and how a drive compares with them.

The comparison is no safety assessment: the model has no fault, no stored energy and no current limit of an amplifier.
"""

import math
from typing import Any, NamedTuple

from jax.typing import ArrayLike

from fitact.model.steady_cycle import PeriodQuantities
from fitact.scene.sections import Device
from fitact.summary import round_to_sd
from fitact.units import choose_prefixed_unit, format_engineering

NO_SAFETY_ASSESSMENT = (
    "The comparison with limits is no safety assessment: the model has no fault (a pierced insulator), no energy stored"
    " in the amplifier and no current limit"
)


AC_1, AC_3 = "IEC 60479-1, zone AC-1", "IEC 60479-1, zone AC-3"
ES1 = "IEC 62368-1, class ES1"
PATIENT_LEAKAGE = "IEC 60601-1, patient leakage current"
# standard, meaning of the limit there, quantity of `PeriodQuantities`, limit (A), and range of frequencies (Hz)
PUBLISHED_LIMITS = (
    (AC_1, "upper end: perception possible, usually no startle", "current_rms", 0.5e-3, 15.0, 100.0),
    (AC_3, "lower end, long contact: muscles contract involuntarily", "current_rms", 5e-3, 15.0, 100.0),
    (ES1, "touchable by ordinary persons", "current_rms", 0.5e-3, 0.0, 1e3),
    (ES1, "touchable by ordinary persons", "current_peak", 0.707e-3, 0.0, 1e3),
    (PATIENT_LEAKAGE, "medical equipment, type BF, normal condition", "current_rms", 0.1e-3, 0.0, 1e3),
)
_NAMES = {"current_rms": "rms current", "current_peak": "peak current"}


class LimitComparison(NamedTuple):
    """A quantity at the amplitude of a `DriveOption` beside a limit."""

    source: str  # standard or scene key that states the limit
    name: str  # meaning of the limit
    quantity: str  # rms current, peak current, or field in the insulator
    value: float  # largest one of the fingers drawn, A or V/m; infinite at ideal edges
    limit: float | None  # in the same unit, or None if the scene states none
    unit: str
    frequency_range: tuple[float, float] | None = None  # Hz, of a published limit; None for a limit of the scene
    in_range: bool = True  # whether the drive's frequency lies there

    @property
    def ratio(self) -> float | None:
        """The value over the limit, or None without a limit."""
        return None if self.limit is None else self.value / self.limit

    @property
    def exceeds_published(self) -> bool:
        """Whether the value exceeds a published limit at a frequency for which it is published."""
        published = self.ratio is not None and self.frequency_range is not None and self.in_range
        return published and self.value > (self.limit or 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `limits` in drive.json; null stands for what is unbounded or not stated."""
        return self._asdict() | {"ratio": self.ratio}

    @property
    def row(self) -> tuple[str, ...]:
        """Cells for people: source, meaning, quantity, value, limit, ratio, frequencies."""
        ratio = "" if self.ratio is None else f"{self.ratio:.2g}" if math.isfinite(self.ratio) else "unbounded"
        limit = "not stated" if self.limit is None else format_quantity(self.limit, self.unit)
        return self.source, self.name, self.quantity, format_quantity(self.value, self.unit), limit, ratio, self._range

    @property
    def _range(self) -> str:
        if self.frequency_range is None:
            return ""
        low, high = (format_engineering(frequency, "Hz", 3) for frequency in self.frequency_range)
        given = f"{low} to {high}" if self.frequency_range[0] else f"up to {high}"
        return given if self.in_range else f"{given}, not here"


def compare_with_limits(frequency: float, at_amplitude: PeriodQuantities, device: Device) -> list[LimitComparison]:
    """Compare the body current and the insulator's field at an amplitude with published limits and the scene's."""

    def value(quantity: str) -> float:
        return float(getattr(at_amplitude, quantity))

    rows = [
        LimitComparison(source, name, _NAMES[key], value(key), limit, "A", (low, high), low <= frequency <= high)
        for source, name, key, limit, low, high in PUBLISHED_LIMITS
    ]
    stated = {"current_rms": device.current_limit_rms, "current_peak": device.current_limit_peak}
    for name, limit in stated.items():
        if limit is not None:
            key = f"[device] {name.replace('_', '_limit_')}"
            rows.append(LimitComparison(key, "your limit", _NAMES[name], value(name), limit, "A"))
    field = float(at_amplitude.insulator_peak) / device.insulator_thickness
    source = "data sheet of the insulator" if device.breakdown_field is None else "[device] breakdown_field"
    name = "breakdown field of the material at this thickness"
    return [*rows, LimitComparison(source, name, "insulator field", field, device.breakdown_field, "V/m")]


def format_quantity(value: ArrayLike, unit: str, error: float | None = None) -> str:
    """Format a value for people; with an `error`, to the place of the error's second significant digit."""
    if not math.isfinite(value):
        return "unbounded"
    if unit == "V/m":
        return f"{1e-6 * float(value):.3g} V/µm"  # as in data sheets
    if error is None or not 0.0 < error < math.inf:
        return format_engineering(float(value), unit, 3)
    size, symbol = choose_prefixed_unit(float(value), unit)
    return " ± ".join(f"{x} {symbol}" for x in round_to_sd((float(value) / size, error / size), error / size))
