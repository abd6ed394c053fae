"""A recorded signal that is a mean and a few sinusoids, beside white noise: one sine, or a carrier that is modulated.

Its few parameters are known far better than a sample. A smooth curve through a noisy sine still contains noise at all
frequencies up to some tens of hertz beyond it, which is mistaken for information on a delay.
"""

from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Complex, Float

_SOME = 1 << 16  # samples in which tones are first sought

Samples = Float[np.ndarray, " samples"]


class Tones(NamedTuple):
    """Mean and sinusoids Re(A e^{j w (k - middle)}) at the samples k."""

    mean: float
    phasors: Complex[np.ndarray, " tones"]  # A
    frequencies: Float[np.ndarray, " tones"]  # w, rad per sample
    size: int  # number of samples
    rounding: float = 0.0  # sd of the rounding of the samples

    @classmethod
    def from_samples(
        cls, values: Samples, frequencies: Float[np.ndarray, " tones"], rounding: float = 0.0, rounds: int = 8
    ) -> Self:
        """Fit all parameters by least squares; `frequencies` are a start, better than half a cycle per record."""
        count = frequencies.size
        tones = cls(0.0, np.zeros(count, complex), frequencies, values.size, rounding)
        for number in range(rounds):
            products = np.zeros(2 * [2 + 3 * count])
            for first in range(0, values.size, _SOME):
                last = min(first + _SOME, values.size)
                waves = tones._waves(first, last)
                since = (np.arange(first, last) - tones._middle) / values.size
                slopes = since * (1j * tones.phasors[:, None] * waves).real
                rows = np.vstack([np.ones(last - first), waves.real, -waves.imag, slopes, values[first:last]])
                products += rows @ rows.T
            linear = slice(1 + 2 * count)
            mean, *parts = np.linalg.lstsq(products[linear, linear], products[linear, -1])[0]
            phasors = np.array(parts[:count]) + 1j * np.array(parts[count:])
            tones = tones._replace(mean=float(mean), phasors=phasors)
            if number == 0:  # without phasors, the frequencies had no slopes
                continue
            change = np.linalg.lstsq(products[:-1, :-1], products[:-1, -1])[0][-count:]
            tones = tones._replace(frequencies=tones.frequencies + change / values.size)
            if np.max(np.abs(change)) < 1e-5:
                break
        return tones

    def continue_with(self, values: Samples) -> Self | None:
        """Return the tones of other samples of the signal, or None if they are not the same."""
        tones = self.from_samples(values, self.frequencies, self.rounding)
        return tones if _is_noise(values - tones.values(), self.rounding) else None

    def fit_phasors(self, values: Samples) -> Self:
        """Return the tones of other samples at the same frequencies, by linear least squares."""
        return self.from_samples(values, self.frequencies, rounds=1)

    @property
    def carrier(self) -> float | None:
        """Frequency of the strongest tone (rad per sample), if a delay changes the phases more than a finger does."""
        return float(self.frequencies[self._strongest]) if np.min(self.frequencies) > 0.1 else None

    def carrier_gain(self, values: Samples) -> complex:
        """Return the gain of other samples over the strongest tone."""
        phasors = self.fit_phasors(values).phasors
        return complex(phasors[self._strongest] / self.phasors[self._strongest])

    def values(self) -> Samples:
        """Return the signal at the samples."""
        return self._sum(self.phasors)

    def scale(self, factors: Complex[np.ndarray, " tones"]) -> Samples:
        """Return the tones without the mean, each times a factor, at the samples."""
        return self._sum(self.phasors * factors) - self.mean

    def basis(self) -> Float[np.ndarray, "functions samples"]:
        """Return orthonormal functions of which the signal consists."""
        waves = self._waves(0, self.size)
        return np.linalg.qr(np.vstack([np.ones(self.size), waves.real, waves.imag]).T)[0].T

    def _sum(self, phasors: Complex[np.ndarray, " tones"]) -> Samples:
        parts = (self._waves(first, min(first + _SOME, self.size)) for first in range(0, self.size, _SOME))
        return self.mean + np.concatenate([(phasors @ waves).real for waves in parts])

    @property
    def _strongest(self) -> int:
        return int(np.argmax(np.abs(self.phasors)))

    @property
    def _middle(self) -> float:
        return 0.5 * (self.size - 1)

    def _waves(self, first: int, last: int) -> Complex[np.ndarray, "tones some"]:
        return np.exp(1j * self.frequencies[:, None] * (np.arange(first, last) - self._middle))


def find_tones(
    values: Samples,
    frequency: float,
    rounding: float = 0.0,
    max_tones: int = 8,
    max_multisine: int = 64,
    cycles: float = 8.0,
    max_distortion: float = 0.03,
) -> Tones | None:
    """Return the few tones of which a signal consists, or None if more remains than white noise and rounding.

    `frequency` is that with which it repeats (cycles per sample), or infinite; `rounding` is the sd of its rounding
    errors. Below a number of `cycles`, a spectrum does not tell a tone from the mean. It hides tones up to
    `max_distortion` of the others, which are added; an edge has many. A multisine has up to `max_multisine` tones of
    similar height, and hardly any lower ones.
    """
    size = some = min(values.size, _SOME)
    found, height = _find_lines(values[:some] - values[:some].mean())
    if not found.size and frequency * some < cycles:
        found, height = _find_harmonics(values[:some], frequency, max_multisine)
    lines, found = np.count_nonzero(height > 1e-3), found[height > max_distortion]
    if found.size > max_tones:
        max_tones = min(found.size + max_tones, max_multisine)
        if np.min(found) > 3.0 * np.pi * frequency:  # the slowest tone may be hidden by the mean
            found = np.append(2.0 * np.pi * frequency, found)
    if lines > max_tones:
        return None
    while 0 < found.size <= max_tones:
        tones = Tones.from_samples(values[:size], found, rounding)
        found, rest = tones.frequencies, values[:size] - tones.values()
        if not _is_noise(rest, rounding):
            added, height = _find_lines(rest[:_SOME])
            cycle, is_carrier = 2.0 * np.pi / size, np.min(found) > 2.0 * np.pi * cycles / some
            apart = np.abs(added[:, None] - found).min(axis=1, initial=np.inf) > cycle
            apart &= height > 0.05
            is_small = is_carrier or np.std(rest) < max_distortion * np.std(values[:size])
            if size > some or not apart.any() or not is_small:
                return None
            found = np.append(found, added[apart])
        elif size == values.size:
            return tones
        else:
            size = min(4 * size, values.size)
    return None


def _find_harmonics(
    values: Samples, frequency: float, most: int
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Return the frequencies (rad per sample) and heights of the harmonics of a `frequency`, relative to the largest.

    They are above the noise, and there are `most` at most.
    """
    harmonics = 2.0 * np.pi * frequency * np.arange(1.0, 1.0 + max(1, min(most, int(0.45 / frequency))))
    tones = Tones.from_samples(values, harmonics, rounds=1)
    size, floor = np.abs(tones.phasors), 6.0 * float(np.std(values - tones.values())) * np.sqrt(2.0 / values.size)
    seen = size >= min(floor, float(size.max()))
    return harmonics[seen], size[seen] / size.max()


def _is_noise(rest: Samples, rounding: float, block: int = 32) -> bool:
    """Return whether the rest of a signal is white noise: neighbours differ as much as all, and means of blocks hardly.

    Rounding errors, of this sd, may be the same for some samples.
    """
    white = float(np.std(np.diff(rest, 3))) / np.sqrt(20.0)
    means = rest[: rest.size // block * block].reshape(-1, block).mean(axis=1)
    is_alike = np.std(rest) < 1.5 * max(white, rounding)
    return bool(is_alike and np.std(means) < max(2.0 * white / np.sqrt(block), rounding))


def _find_lines(values: Samples) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Return the frequencies (rad per sample) of the lines of a spectrum, and their heights relative to the largest.

    They are above its noise and the side lobes. There are none if the largest may be a part of the mean.
    """
    angles, padded = 2.0 * np.pi * np.arange(values.size) / values.size, 1 << (2 * values.size - 1).bit_length()
    lobe = round(3.75 * padded / values.size)  # almost the half width of the window's main lobe, which is four cycles
    # Blackman and Harris, with side lobes of -92 dB (Proc. IEEE 66 (1978) 51)
    weights = 0.35875, -0.48829, 0.14128, -0.01168
    window = sum(weight * np.cos(i * angles) for i, weight in enumerate(weights))
    size = np.abs(np.fft.rfft(window * values, padded))
    if np.argmax(size) < 2 * lobe:
        return np.empty(0), np.empty(0)
    middle, floor = size[1:-1], max(5e-5 * float(size.max()), 6.0 * float(np.median(size)))
    is_line = (middle > size[:-2]) & (middle >= size[2:]) & (middle > floor)
    is_line[: lobe - 1] = False
    lines = np.flatnonzero(is_line) + 1
    return lines * 2.0 * np.pi / padded, size[lines] / size.max()
