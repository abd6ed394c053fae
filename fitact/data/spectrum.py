"""Spectra: an impedance, or the gain of Vsc over V, at single frequencies."""

import dataclasses
import hashlib
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Complex, Float

from fitact import charts
from fitact.errors import InputError
from fitact.tables import Display, join_lines, to_dataframe
from fitact.units import format_engineering

MINIMUM_POINTS = 5
ChannelName: TypeAlias = Literal["impedance", "Vsc"]


@dataclasses.dataclass(frozen=True, repr=False)
class Spectrum(Display):
    """Impedance V / I between the drive electrode and ground, or gain Vsc / V.

    Attributes:
        frequency: increasing frequencies, Hz.
        values: complex impedance (ohm), whose imaginary part is negative for a capacitance, or gain.
        channel: "impedance", or "Vsc" for a gain.
        source: origin of the data, for messages.
        notes: assumptions, as sentences.
        warnings: sentences on what may change the result.
    """

    frequency: Float[np.ndarray, " points"]
    values: Complex[np.ndarray, " points"]
    channel: ChannelName = "impedance"
    source: str = "spectrum"
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @classmethod
    def from_arrays(
        cls,
        frequency: Float[np.ndarray, " points"],
        values: Complex[np.ndarray, " points"],
        source: str = "spectrum",
        notes: tuple[str, ...] = (),
        channel: ChannelName = "impedance",
        warnings: tuple[str, ...] = (),
    ) -> "Spectrum":
        """Make a spectrum from arrays of equal length (Hz, and ohm or a gain; any order) after checks.

        Raises:
            InputError: the points are too few or not finite, a frequency is not positive or occurs twice, or a value
                is zero, or the impedance is inductive.
        """
        f, z = np.array(frequency, dtype=float), np.array(values, dtype=complex)
        if f.ndim != 1 or f.shape != z.shape:
            raise InputError(f"{source}: frequency has shape {f.shape}, {channel} {z.shape}; give equal shapes")
        if f.size < MINIMUM_POINTS:
            raise InputError(f"{source}: {f.size} points are too few to fit; measure {MINIMUM_POINTS} or more")
        if not (np.isfinite(f).all() and np.isfinite(z).all()):
            raise InputError(f"{source}: holds values that are not finite; remove those points")
        order = np.argsort(f)
        f, z = f[order], z[order]
        if f[0] <= 0.0:
            raise InputError(f"{source}: holds the frequency {f[0]:g} Hz; remove points at 0 Hz and below")
        if np.any(np.diff(f) == 0.0):
            raise InputError(
                f"{source}: {f[:-1][np.diff(f) == 0.0][0]:g} Hz occurs twice; keep one sweep, or average the sweeps"
            )
        if np.any(np.abs(z) == 0.0):
            raise InputError(f"{source}: the {channel} is 0 at {f[np.abs(z) == 0.0][0]:g} Hz; remove that point")
        if channel == "impedance" and np.median(z.imag / np.abs(z)) > 0.02:  # a resistor's may have either sign
            raise InputError(
                f"{source}: the imaginary part is positive (inductive), but a finger's is negative; begin the name of a"
                " column of -Im Z with a minus, e.g. -Z_imag_ohm"
            )
        for array in (f, z):
            array.flags.writeable = False
        return cls(f, z, channel, source, notes, warnings)

    def select_band(self, low: float, high: float) -> "Spectrum":
        """Return the points from `low` to `high` (Hz); InputError if too few are left."""
        kept = (self.frequency >= low) & (self.frequency <= high)
        band = f"{format_engineering(low, 'Hz')} to {format_engineering(high, 'Hz')}"
        if np.count_nonzero(kept) < MINIMUM_POINTS:
            raise InputError(
                f"{self.source}: {np.count_nonzero(kept)} of {len(self)} points lie within {band}, too few to fit;"
                " choose a wider band"
            )
        notes = (*self.notes, f"only the points from {band} are used")
        return dataclasses.replace(self, frequency=self.frequency[kept], values=self.values[kept], notes=notes)

    def __len__(self) -> int:
        return self.frequency.size

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the numbers, by which results identify their data."""
        digest = hashlib.sha256(np.ascontiguousarray(self.frequency).tobytes())
        digest.update(self.channel.encode() + np.ascontiguousarray(self.values).tobytes())
        return digest.hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `fitact inspect`, in Hz and ohm."""
        size, is_impedance = np.abs(self.values), self.channel == "impedance"
        name, unit = ("impedance", "ohm") if is_impedance else ("gain", "1")
        return {
            "source": self.source,
            "format": "impedance spectrum" if is_impedance else "frequency response",
            "channels": [{"name": name, "unit": unit, "min": float(size.min()), "max": float(size.max())}],
            "points": len(self),
            "frequency_min": float(self.frequency[0]),
            "frequency_max": float(self.frequency[-1]),
            "imaginary_part": "negative" if np.mean(self.values.imag) < 0.0 else "positive",
            "notes": list(self.notes),
            "warnings": list(self.warnings),
        }

    def plot(self) -> Any:
        """Draw magnitude and phase over frequency (a Bode diagram), and return the two axes."""
        return charts.show_plots(charts.spectrum_plot(self.frequency, *self.symbol, self.values))

    @property
    def symbol(self) -> tuple[str, str]:
        """Symbol of the magnitude, and its unit."""
        return ("|Z|", "ohm") if self.channel == "impedance" else ("|Vsc / V|", "1")

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with a row a frequency: frequency_Hz, real, imag (ohm, or 1 for a gain)."""
        return to_dataframe({"frequency_Hz": self.frequency, "real": self.values.real, "imag": self.values.imag})

    @property
    def _headline(self) -> str:
        low, high = (format_engineering(float(f), "Hz") for f in self.frequency[[0, -1]])
        is_impedance = self.channel == "impedance"
        small, large = (
            format_engineering(float(z), "ohm") if is_impedance else f"{z:.3g}"
            for z in np.sort(np.abs(self.values))[[0, -1]]
        )
        kind = "impedance spectrum" if is_impedance else "gain of Vsc over V"
        return f"{self.source} ({kind}): {len(self)} points, {low} to {high}, {self.symbol[0]} {small} to {large}"

    def _rows(self) -> list[tuple[str, ...]]:
        name, unit = self.symbol
        rows: list[tuple[str, ...]] = [("frequency", name, "phase")]
        for i in (0, -1):
            size = format_engineering(abs(self.values[i]), unit)
            frequency = format_engineering(float(self.frequency[i]), "Hz")
            rows.append((frequency, size, f"{np.angle(self.values[i], deg=True):.1f}°"))
        return rows

    def _sentences(self) -> tuple[str, ...]:
        sign = "negative (capacitive)" if np.mean(self.values.imag) < 0.0 else "positive"
        return (f"The imaginary part is mostly {sign}.",)

    def __str__(self) -> str:
        return join_lines([self._headline, *self._sentences()], self.warnings, self.notes)
