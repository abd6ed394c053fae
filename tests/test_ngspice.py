"""Vsc and I of every circuit against ngspice, which steps through time and knows no formula of ours."""

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
# our circuit, and the netlist from the node of the drive ("in") to ground; Vsc is between "skin" and "below"
CIRCUITS = {
    "final": (fitact.FinalCircuit(R, C, CI), [*TOUCHING, "R2 below 0 160k", "C2 below 0 22n"]),
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
DRIVES = {
    "trapezoid": (  # from 0 V, so that it starts without a jump
        fitact.Trapezoid(360.0, 100.0, rise_time=EDGE, offset=180.0),
        f"PULSE(0 360 0 {EDGE} {EDGE} {PERIOD / 2 - EDGE} {PERIOD})",
    ),
    "sine": (fitact.Sine(360.0, 100.0), "SIN(0 180 100)"),
    "triangle": (fitact.Triangle(360.0, 100.0), "PWL(0 0 2.5m 180 7.5m -180 12.5m 180 17.5m -180 20m 0)"),
}


def simulate(netlist: list[str], source: str, folder: Path) -> tuple[np.ndarray, ...]:
    """Time, Vsc and I from rest over two periods."""
    deck = ["* fitact", f"Vin in 0 {source}", *netlist, ".options reltol=1e-6 method=gear"]
    deck += [".control", "set wr_vecnames", "set wr_singlescale", "tran 2u 20m 0 2u uic"]
    deck += ["wrdata out.txt v(skin,below) i(Vin)", "quit", ".endc", ".end"]
    (folder / "deck.cir").write_text("\n".join(deck) + "\n")
    subprocess.run(["ngspice", "-b", "deck.cir"], cwd=folder, check=True, capture_output=True, timeout=120)
    table = np.loadtxt(folder / "out.txt", skiprows=1)
    return table[:, 0], table[:, 1], -table[:, 2]


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("circuit", CIRCUITS)
def test_from_rest(circuit: str, drive: str, tmp_path: Path):
    ours, netlist = CIRCUITS[circuit]
    wave, source = DRIVES[drive]
    time, vsc, current = simulate(netlist, source, tmp_path)
    with jax.enable_x64(True):
        expected = np.asarray(fitact.response(ours, wave, time, steady_state=False))
        expected_current = np.asarray(fitact.response(ours, wave, time, steady_state=False, channel="I"))
    phase = (time + 1e-9) % (PERIOD / 4)
    away = (phase > EDGE + 60e-6) & (phase < PERIOD / 4 - 10e-6)
    np.testing.assert_allclose(vsc[away], expected[away], atol=2e-4 * np.ptp(expected))
    np.testing.assert_allclose(current[away], expected_current[away], atol=2e-4 * np.ptp(expected_current[away]))
