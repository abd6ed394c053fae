"""Linear Kramers-Kronig test: is a spectrum that of a linear, causal circuit that does not change?

A series of R, L, C and of many elements R‖C, whose time constants are given, is fitted by linear least squares
(Boukamp, J. Electrochem. Soc. 142 (1995) 1885; Schönleber, Klotz, Ivers-Tiffée, Electrochim. Acta 131 (2014) 20).
impedance.py's `linKK` does not run with NumPy 2; pyimpspec's test takes seconds, and leaves residuals of 10 % where a
capacitor in series blocks direct current, as the insulator here does.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from fitact.data.spectrum import MINIMUM_POINTS, Spectrum
from fitact.units import format_engineering, format_percent

Points = Float[np.ndarray, " points"]


class KramersKronig(NamedTuple):
    """Result of the test."""

    passed: bool
    worst_residual: float  # relative to the magnitude
    band: tuple[float, float]  # longest stretch of frequencies that passes, Hz
    doubt: str = ""  # what fails, a sentence

    def __str__(self) -> str:
        return self.doubt or f"The Kramers-Kronig test passes (largest residual {format_percent(self.worst_residual)})."

    def to_dict(self) -> dict[str, object]:
        """Return `kramers_kronig` of fit.json."""
        return {"passed": self.passed, "worst_residual": self.worst_residual, "band": list(self.band)}


def check_kramers_kronig(spectrum: Spectrum) -> KramersKronig:
    """Test a spectrum; the doubt names the frequencies that fail, and the band that is left."""
    frequency, values = spectrum.frequency, spectrum.values
    residuals, bad = _test(frequency, values, spectrum.channel == "impedance")
    worst = int(np.argmax(np.abs(residuals)))
    if not bad.any():
        return KramersKronig(True, float(np.abs(residuals[worst])), (float(frequency[0]), float(frequency[-1])))
    low, high = _longest_band(frequency, values, spectrum.channel == "impedance", bad)
    where = (
        "most frequencies" if bad.all() else ", ".join(format_engineering(float(f), "Hz") for f in frequency[bad][:4])
    )
    doubt = (
        f"{spectrum.source}: the Kramers-Kronig test fails at {where} (residual"
        f" {format_percent(float(np.abs(residuals[worst])))} at {format_engineering(float(frequency[worst]), 'Hz')}):"
        " something changed during the sweep, or a point is bad"
    )
    if high > low:
        doubt += f"; --band '{format_engineering(low, 'Hz')}..{format_engineering(high, 'Hz')}' keeps what passes"
    return KramersKronig(False, float(np.abs(residuals[worst])), (low, high), doubt)


def _test(
    frequency: Points,
    values: Complex[np.ndarray, " points"],
    is_impedance: bool,
    negligible: float = 5e-3,
    false_alarm: float = 1e-4,
) -> tuple[Complex[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Return the relative residuals of the best fit, and which points fail (all if the residuals have structure).

    Residuals below `negligible` pass. `false_alarm`: probability that pure noise fails, of each of the two tests.
    """
    fits = (
        _fit_elements(frequency, values, count, is_impedance) for count in range(1, max(2, min(values.size - 3, 40)))
    )
    residuals, leverage, _ = min(fits, key=lambda fit: fit[2])
    n, size = values.size, np.abs(residuals) / np.sqrt(1.0 - leverage)
    sigma = max(float(np.median(size)) / math.sqrt(2.0 * math.log(2.0)), 1e-7)  # of real and imaginary part
    # sigma may be a fifth too small
    bad = size > max(1.2 * sigma * math.sqrt(2.0 * math.log(n / false_alarm)), negligible)
    square = float(np.mean(np.abs(residuals[~bad]) ** 2)) if not bad.all() else 0.0
    successive = float(np.mean(np.abs(np.diff(residuals[~bad])) ** 2)) if np.count_nonzero(~bad) > 2 else 2.0 * square
    z = (
        (1.0 - 0.5 * successive / square) * math.sqrt(2.0 * n) if square > (0.5 * negligible) ** 2 else 0.0
    )  # von Neumann
    return residuals, np.ones(n, bool) if 0.5 * math.erfc(z / math.sqrt(2.0)) < false_alarm else bad


def _fit_elements(
    frequency: Points, values: Complex[np.ndarray, " points"], count: int, is_impedance: bool
) -> tuple[Complex[np.ndarray, " points"], Points, float]:
    """Return relative residuals, leverages and the information criterion AICc of a fit of `count` elements R‖C."""
    s = 2j * np.pi * frequency
    taus = np.geomspace(0.3 / np.abs(s[-1]), 3.0 / np.abs(s[0]), count)
    columns = [np.ones_like(s), *(1.0 / (1.0 + s * tau) for tau in taus)] + ([1.0 / s, s] if is_impedance else [])
    relative = np.stack(columns, axis=1) / values[:, None]  # residuals relative to the value, so that its phase is 0
    design = np.concatenate([relative.real, relative.imag])
    design = design / np.linalg.norm(design, axis=0)
    observed = np.concatenate([np.ones(values.size), np.zeros(values.size)])
    modes, sizes, _ = np.linalg.svd(design, full_matrices=False)
    modes = modes[:, sizes > 1e-12 * sizes[0]]
    rest, h = observed - modes @ (modes.T @ observed), np.sum(modes**2, axis=1)
    n, k = observed.size, modes.shape[1]
    spare = max(n - k - 1, 1)
    criterion = n * math.log(max(float(rest @ rest) / n, 1e-16)) + 2.0 * k + 2.0 * k * (k + 1) / spare
    half = values.size
    return rest[:half] + 1j * rest[half:], np.minimum(0.5 * (h[:half] + h[half:]), 0.99), criterion


def _longest_band(
    frequency: Points, values: Complex[np.ndarray, " points"], is_impedance: bool, bad: Bool[np.ndarray, " points"]
) -> tuple[float, float]:
    """Return the ends of the longest stretch that passes; equal ends if none does."""
    n = frequency.size
    if not bad.all():
        ends = [-1, *np.flatnonzero(bad).tolist(), n]
        first, last = max(itertools.pairwise(ends), key=lambda pair: pair[1] - pair[0])
        if last - first > MINIMUM_POINTS:
            return float(frequency[first + 1]), float(frequency[last - 1])
    step = max(n // 10, 1)
    parts = [(i, j) for i in range(0, n, step) for j in range(n, i, -step) if j - i >= max(2 * MINIMUM_POINTS, n // 3)]
    for i, j in sorted(parts, key=lambda part: part[0] - part[1]):
        if not _test(frequency[i:j], values[i:j], is_impedance)[1].any():
            return float(frequency[i]), float(frequency[j - 1])
    return float(frequency[0]), float(frequency[0])
