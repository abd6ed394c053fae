"""Records of known causes of misfit, simulated by FFT over whole periods, without fitact."""

import dataclasses

import numpy as np

import fitact

PERIOD, ROWS = 0.01, 2000  # s; samples in a period
TIME = np.arange(2 * ROWS) * PERIOD / ROWS
R, C, CI = 160e3, 22e-9, 1.35e-9
G, B = CI / (2.0 * CI + C), R * (2.0 * CI + C)
SCENE = {"drive": {"waveform": "measured", "steady_state": True}}
NATURAL = SCENE | {"grounding": {"connection": "natural", "Z": "300 kohm", "Z_capacitance": "150 pF"}}
SIZES = (0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
# the names under which a cause may stand, since a delay, a low-pass filter and a resistor look alike
CAUSES = {
    "compensation": {"the compensation of a probe"},
    "delay": {"a delay", "a low-pass filter", "a series resistor"},
    "AC coupling": {"AC coupling"},
    "dispersion": {"a constant-phase skin"},
    "resistor": {"a delay", "a low-pass filter", "a series resistor"},
    "ADC": {"the non-linearity of the ADC"},
    "hum": {"hum at 300 Hz"},
}
ONE_SIGN = ("AC coupling", "dispersion", "resistor")


def trapezoid(time: np.ndarray, rise: float = 1e-4, height: float = 360.0) -> np.ndarray:
    phase, half = np.mod(time, PERIOD), 0.5 * PERIOD
    up = np.clip(phase / rise, 0.0, 1.0) - np.clip((phase - half) / rise, 0.0, 1.0)
    return height * (up - 0.5)


def multisine(time: np.ndarray) -> np.ndarray:
    phases = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, 8)
    tones = (100, 200, 300, 500, 700, 1000, 1400, 1900)
    total = sum(np.cos(2.0 * np.pi * f * time + p) for f, p in zip(tones, phases, strict=True))
    return 180.0 * total / np.abs(total).max()


DRIVES = {"trapezoid": trapezoid, "multisine": multisine}


@dataclasses.dataclass(frozen=True)
class Case:
    """One record with one cause of misfit."""

    drive: str
    cause: str
    size: float  # in units of a typical size; negative for the other sign
    seed: int
    noise: float = 0.1  # V
    ground: str = "direct"
    at_rest: bool = False

    def record(self) -> fitact.Record:
        time, V = TIME, DRIVES[self.drive](TIME)
        before = 9 * ROWS if self.at_rest else 0
        padded = np.concatenate([np.zeros(before), V])
        clean = simulate(padded, self.cause, self.size, self.ground)[before:]
        noise = self.noise * np.random.default_rng(self.seed).standard_normal(time.size)
        return fitact.Record.from_arrays(time, V=V, Vsc=clean + noise, source=f"{self}")

    def scene(self) -> fitact.Scene:
        content = NATURAL if self.ground == "natural" else SCENE
        return fitact.Scene.from_dict(content | {"drive": SCENE["drive"] | {"steady_state": not self.at_rest}})


def simulate(V: np.ndarray, cause: str, k: float, ground: str = "direct") -> np.ndarray:
    """Return Vsc for one period of V on a circle, or a V that is long at rest."""
    s = 2j * np.pi * np.fft.rfftfreq(V.size, PERIOD / ROWS)
    alpha = 1.0 - 0.02 * k * (cause == "dispersion")
    skin = R / (1.0 + (s * R * C) ** alpha)
    other = 300e3 / (1.0 + s * 300e3 * 150e-12) if ground == "natural" else skin
    loop = skin + other + 10e3 * k * (cause == "resistor")
    gain = s * CI * skin / (1.0 + s * CI * loop)
    if cause == "compensation":
        gain = gain * (1.0 + 0.02 * k * s * 110e-6 / (1.0 + s * 110e-6))
    if cause == "delay":
        gain = gain * np.exp(-s * 5e-6 * k)
    if cause == "AC coupling":
        gain = gain * s / np.where(s == 0.0, 1.0, s + 2.0 * np.pi * 5.0 * k)
    vsc = np.fft.irfft(gain * np.fft.rfft(V), V.size)
    if cause == "ADC":
        full_scale = 1.2 * np.abs(vsc).max()
        vsc = vsc + 0.003 * k * full_scale * np.sin(4.0 * np.pi * vsc / full_scale + 0.7)
    if cause == "hum":
        vsc = vsc + 0.3 * k * np.cos(2.0 * np.pi * 300.0 * PERIOD / ROWS * np.arange(V.size) + 0.5)
    return vsc


def log_truth(ground: str = "direct") -> np.ndarray:
    """Return the logarithms of g and b."""
    if ground == "direct":
        return np.log([G, B])
    # touching skin and environment in series with Ci: g at high frequency, and the slowest pole
    Z, CZ = 300e3, 150e-12
    g = CI / C / (1.0 + CI / C + CI / CZ)
    skin, earth, coupling = np.poly1d([R * C, 1.0]), np.poly1d([Z * CZ, 1.0]), np.poly1d([CI, 0.0])
    poles = (skin * earth + coupling * (R * earth + Z * skin)).roots
    return np.log([g, 1.0 / np.min(np.abs(poles))])


def two_layers(ci: float, seed: int, count: int = 20_000, step: float = 1e-6, noise: float = 0.05) -> fitact.Record:
    """Return a record of skins of two layers in series, 120 kohm || 30 nF and 40 kohm || 80 nF."""
    time = np.arange(count) * step
    V, s = trapezoid(time), 2j * np.pi * np.fft.rfftfreq(count, step)
    skin = 120e3 / (1.0 + s * 120e3 * 30e-9) + 40e3 / (1.0 + s * 40e3 * 80e-9)
    vsc = np.fft.irfft(s * ci * skin / (1.0 + 2.0 * s * ci * skin) * np.fft.rfft(V), count)
    vsc = vsc + noise * np.random.default_rng(seed).standard_normal(count)
    return fitact.Record.from_arrays(time, V=V, Vsc=vsc)
