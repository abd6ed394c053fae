"""Vsc and I of every circuit and drive against ngspice, which integrates in time and uses no formula of ours."""

import shutil
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest

import fitact

pytestmark = pytest.mark.skipif(
    shutil.which("ngspice") is None, reason="ngspice is not installed (apt-get install ngspice)"
)

R, C, CI = 160e3, 22e-9, 1.35e-9
PROBE = fitact.Probe(10e6, 10e-12)
PERIOD = 0.01

TOUCHING = ["Ci in skin 1.35n", "R1 skin below 160k", "C1 skin below 22n"]
# our circuit, and the netlist from the drive node ("in") to ground; Vsc is between "skin" and "below"
CIRCUITS = {
    "final": (fitact.FinalCircuit(R, C, CI), [*TOUCHING, "R2 below 0 160k", "C2 below 0 22n"]),
    "simplified with R_H": (
        fitact.DirectGround(R, C, CI, R_H=500.0),
        [*TOUCHING, "RH below b 500", "R2 b 0 160k", "C2 b 0 22n"],
    ),
    "direct ground, unequal skins": (
        fitact.DirectGround(R, C, CI, grounding_Rsc=80e3, grounding_Csc=44.25e-9),
        [*TOUCHING, "R2 below 0 80k", "C2 below 0 44.25n"],
    ),
    "direct ground, R_H, series resistor, probe": (
        fitact.DirectGround(
            R, C, CI, R_H=500.0, grounding_Rsc=80e3, grounding_Csc=44.25e-9, series_resistor=100e3, probe=PROBE
        ),
        [
            *TOUCHING,
            "Rp skin below 10meg",
            "Cp skin below 10p",
            "RH below a 500",
            "Rs a b 100k",
            "R2 b 0 80k",
            "C2 b 0 44.25n",
        ],
    ),
    "natural ground": (fitact.NaturalGround(R, C, CI, Z=14.5e6), [*TOUCHING, "RZ below 0 14.5meg"]),
    "natural ground, Z with capacitance": (
        fitact.NaturalGround(R, C, CI, Z=14.5e6, Z_capacitance=100e-12),
        [*TOUCHING, "RZ below 0 14.5meg", "CZ below 0 100p"],
    ),
}
EDGE = 20e-6
JUMP = 1e-9  # duration of an ideal jump in ngspice, s


def polyline(corners: list[tuple[float, float]]) -> str:
    return "PWL(" + " ".join(f"{time:.12g} {voltage:.12g}" for time, voltage in corners) + ")"


def square_burst() -> str:
    """Three cycles at 200 Hz from 0 to ±180 V and back to 0; every jump takes `JUMP`."""
    levels = [0.0, *[180.0, -180.0] * 3, 0.0]
    corners = [(0.0, 0.0)]
    for time, before, after in zip(BURST_EDGES, levels[:-1], levels[1:], strict=True):
        corners += [(time, before)] * (time > 0.0) + [(time + JUMP, after)]
    return polyline(corners)


BURST_EDGES = [2.5e-3 * i for i in range(7)]
CORNERS = [0.0, 2.5e-3, 7.5e-3, 12.5e-3, 17.5e-3]  # corners of a triangle, where the current jumps, s
SWEEP = 15e-3
# our drive, ngspice's source, and the times of edges
DRIVES = {
    "sine": (fitact.Sine(360.0, 100.0), "SIN(0 180 100)", [0.0]),
    "sine, phase and offset": (
        fitact.Sine(300.0, 100.0, offset=20.0, phase=np.pi / 3.0),
        "B: 20 + 150 * sin(628.318530717959 * time + 1.0471975511966)",
        [0.0],
    ),
    "triangle": (fitact.Triangle(360.0, 100.0), "PWL(0 0 2.5m 180 7.5m -180 12.5m 180 17.5m -180 20m 0)", CORNERS),
    "square": (
        fitact.Square(360.0, 100.0, offset=180.0),
        f"PULSE(0 360 0 {JUMP} {JUMP} {PERIOD / 2 - JUMP} {PERIOD})",
        [5e-3 * i for i in range(5)],
    ),
    "trapezoid, duty 0.3": (  # from 0 V, so that it starts without a jump
        fitact.Trapezoid(360.0, 100.0, rise_time=EDGE, duty=0.3, offset=180.0),
        f"PULSE(0 360 0 {EDGE} {EDGE} {0.3 * PERIOD - EDGE} {PERIOD})",
        [0.0, 3e-3, 10e-3, 13e-3, 20e-3],
    ),
    "square burst": (fitact.Burst(fitact.Square(360.0, 200.0), 3), square_burst(), BURST_EDGES),
    "linear chirp": (
        fitact.Chirp(360.0, 50.0, 800.0, SWEEP),
        f"B: time < {SWEEP} ? 180 * sin(6.28318530717959 * (50 * time + 375 / {SWEEP} * time * time)) : 0",
        [SWEEP],
    ),
    "logarithmic chirp": (
        fitact.Chirp(360.0, 50.0, 800.0, SWEEP, "logarithmic", phase=1.0),
        f"B: time < {SWEEP} ? 180 * sin(1 + 6.28318530717959 * 50 * {SWEEP / np.log(16.0):.15g}"
        f" * (exp(time * {np.log(16.0) / SWEEP:.15g}) - 1)) : 0",
        [0.0, SWEEP],
    ),
    "polyline": (
        fitact.Polyline([0.0, 2e-3, 2e-3, 9e-3, 13e-3], [0.0, 120.0, -60.0, -60.0, 150.0]),
        polyline([(0.0, 0.0), (2e-3, 120.0), (2e-3 + JUMP, -60.0), (9e-3, -60.0), (13e-3, 150.0), (1.0, 150.0)]),
        [2e-3],
    ),
}

IMPULSES = ("sine, phase and offset", "square", "square burst", "linear chirp", "logarithmic chirp", "polyline")


def simulate(netlist: list[str], source: str, folder: Path, start: float = 0.0) -> tuple[np.ndarray, ...]:
    """Return time, Vsc and I over two periods from `start` (s); the circuit is at rest at time 0."""
    drive = f"Bin in 0 V = {source[2:]}" if source.startswith("B:") else f"Vin in 0 {source}"
    # the ammeter in the loop gives the current the same name for every source
    deck = ["* fitact", drive.replace(" in 0 ", " top 0 "), "Vmeter top in 0", *netlist]
    deck += [".options reltol=1e-6 method=gear", ".control", "set wr_vecnames", "set wr_singlescale"]
    deck += [f"tran 4u {start + 2.0 * PERIOD} {start} {2e-6 if start == 0.0 else 5e-6} uic"]
    deck += ["wrdata out.txt v(skin,below) i(Vmeter)", "quit", ".endc", ".end"]
    (folder / "deck.cir").write_text("\n".join(deck) + "\n")
    subprocess.run(["ngspice", "-b", "deck.cir"], cwd=folder, check=True, capture_output=True, timeout=120)
    table = np.loadtxt(folder / "out.txt", skiprows=1)
    return table[:, 0], table[:, 1], table[:, 2]


def computed(circuit: fitact.FinalCircuit, wave: fitact.Sine, time: np.ndarray, **options: object) -> np.ndarray:
    """Return our response; a padded time array avoids new compilations."""
    padded = np.pad(time, (0, 16_000 - time.size), mode="edge")
    with jax.enable_x64(True):
        return np.asarray(fitact.response(circuit, wave, padded, **options))[: time.size]


def away_from(edges: list[float], time: np.ndarray) -> np.ndarray:
    away = np.ones(time.size, dtype=bool)
    for edge in edges:
        away &= (time < edge - 10e-6) | (time > edge + EDGE + 60e-6)
    return away


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("circuit", CIRCUITS)
def test_from_rest(circuit: str, drive: str, tmp_path: Path):
    ours, netlist = CIRCUITS[circuit]
    wave, source, edges = DRIVES[drive]
    time, vsc, current = simulate(netlist, source, tmp_path)
    away = away_from(edges, time)
    expected = computed(ours, wave, time, steady_state=False)
    np.testing.assert_allclose(vsc[away], expected[away], atol=2e-4 * np.ptp(expected))
    if drive not in IMPULSES:  # after impulses, ngspice's current rings
        expected_current = computed(ours, wave, time, steady_state=False, channel="I")[away]
        np.testing.assert_allclose(current[away], expected_current, atol=2e-4 * np.ptp(expected_current))


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_steady_state_after_many_periods(circuit: str, tmp_path: Path):
    ours, netlist = CIRCUITS[circuit]
    wave, source, edges = DRIVES["trapezoid, duty 0.3"]
    periods = 60 if "natural" in circuit else 14  # Z and Ci have a time constant of 20 ms, the skins of 4 ms
    time, vsc, _ = simulate(netlist, source, tmp_path, start=periods * PERIOD)
    away = away_from(edges, time - periods * PERIOD)
    expected = computed(ours, wave, time)
    np.testing.assert_allclose(vsc[away], expected[away], atol=2e-4 * np.ptp(expected))
