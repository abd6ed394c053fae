"""Interface gap between finger and panel, and the force across it, against impedances, scipy and ngspice."""

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import fitact
from fitact.experiment.blind_directions import blind_directions
from fitact.likelihood.observable import CHARGES
from fitact.model.circuit import gain_at
from fitact.model.force import AirGap
from fitact.units import quantity_unit
from tests.fitting.test_joint import SKIN, TRUTH, assert_true, channels, free, record, scene, wave
from tests.model.test_ngspice import DRIVES, PERIOD, away_from, computed, simulate

R, C, CI = 160e3, 22e-9, 1.35e-9
AREA, THICKNESS = 1e-4, 2e-6
RGAP, CGAP = 2e6, 8.85e-12 * AREA / THICKNESS
OMEGA = 2.0 * np.pi * np.logspace(0, 6, 25)
GAPS = {"conducting": {"Rgap": RGAP, "Cgap": CGAP}, "open": {"Cgap": CGAP}}
BODIES = {
    "direct": (fitact.DirectGround(R, C, CI), 0.0),
    "direct, R_H": (fitact.DirectGround(R, C, CI, R_H=500.0), 500.0),
    "natural": (fitact.NaturalGround(R, C, CI, Z=14.5e6), 14.5e6),
}


def with_gap(body: str, gap: str) -> fitact.DirectGround | fitact.NaturalGround:
    circuit, _ = BODIES[body]
    fields = {name: getattr(circuit, name) for name in ("Rsc", "Csc", "Ci")}
    fields |= {"R_H": circuit.R_H} if isinstance(circuit, fitact.DirectGround) else {"Z": circuit.Z}
    return type(circuit)(**fields, **GAPS[gap])


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("body", BODIES)
def test_gains_are_those_of_the_impedances_in_series(body: str, gap: str):
    skin = 1.0 / (1.0 / R + 1j * OMEGA * C)
    across = 1.0 / (1.0 / GAPS[gap].get("Rgap", np.inf) + 1j * OMEGA * CGAP)
    around = (1 + ("direct" in body)) * skin + across + 1.0 / (1j * OMEGA * CI) + BODIES[body][1]
    circuit = with_gap(body, gap)
    for channel, part in {"Vsc": skin, "Vgap": across, "I": 1.0}.items():
        with jax.enable_x64(True):
            found = (
                np.asarray(circuit.channel_gain(channel, OMEGA)),
                np.asarray(gain_at(circuit.channel_terms(channel), OMEGA)),
            )
        np.testing.assert_allclose(found[0], part / around, rtol=1e-13)
        np.testing.assert_allclose(found[1], part / around, rtol=0.0, atol=1e-13 * np.abs(part / around).max())


@pytest.mark.parametrize(("gap", "rtol"), [({"Rgap": 1e-4, "Cgap": CGAP}, 1e-8), ({"Cgap": 1.0}, 1e-8)])
def test_a_gap_that_conducts_well_or_has_no_thickness_is_none(gap: dict[str, float], rtol: float):
    drive, time = fitact.Square(360.0, 100.0), np.linspace(0.0, 0.02, 200)
    for channel in ("Vsc", "I"):
        with jax.enable_x64(True):
            ours, without = (
                np.asarray(
                    fitact.response(fitact.DirectGround(R, C, CI, R_H=500.0, **each), drive, time, channel=channel)
                )
                for each in (gap, {})
            )
        np.testing.assert_allclose(ours, without, atol=rtol * np.ptp(without))


NETLISTS = {  # the gap lies between the nodes whose voltage the harness records
    "conducting": ["Ci in skin 1.35n", f"Rg skin below {RGAP}", f"Cg skin below {CGAP}"],
    "open": ["Ci in skin 1.35n", f"Cg skin below {CGAP}"],
}
BODY = ["R1 below mid 160k", "C1 below mid 22n", "RH mid b 500", "R2 b 0 160k", "C2 b 0 22n"]


@pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is not installed (apt-get install ngspice)")
@pytest.mark.parametrize("drive", ["trapezoid, duty 0.3", "triangle", "square burst"])
@pytest.mark.parametrize("gap", GAPS)
def test_the_voltage_across_it_against_ngspice(gap: str, drive: str, tmp_path: Path):
    wave, source, edges = DRIVES[drive]
    # ngspice requires a path to ground for every node; this one carries 1e-9 of the current in the gap
    time, vgap, _ = simulate([*NETLISTS[gap], *BODY, "Rleak skin 0 1e15"], source, tmp_path)
    away = away_from(edges, time)
    expected = computed(with_gap("direct, R_H", gap), wave, time, steady_state=False, channel="Vgap")
    np.testing.assert_allclose(vgap[away], expected[away], atol=2e-4 * np.ptp(expected))
    assert time[-1] > 1.9 * PERIOD


def test_force_across_it_by_hand():
    """8.85e-12 * 1e-4 * 100^2 / (2 (2e-6)^2) = 1.10625 N at 100 V."""
    with jax.enable_x64(True):
        assert float(fitact.electrostatic_force(100.0, AirGap(AREA, THICKNESS))) == pytest.approx(1.10625)


@pytest.mark.parametrize("gap", GAPS)
def test_mean_and_peak_force_are_those_of_a_sine(gap: str):
    circuit, amplitude, omega = with_gap("direct", gap), 180.0, 2.0 * np.pi * 100.0
    across = 1.0 / (1.0 / GAPS[gap].get("Rgap", np.inf) + 1j * omega * CGAP)
    vgap = amplitude * abs(across / (across + 2.0 / (1.0 / R + 1j * omega * C) + 1.0 / (1j * omega * CI)))
    peak = 8.85e-12 * AREA * vgap**2 / (2.0 * THICKNESS**2)
    geometry = fitact.Scene.from_dict({"gap": {"thickness": THICKNESS}, "force": {"model": "gap"}}).geometry()
    with jax.enable_x64(True):
        arguments = circuit, fitact.Sine(2.0 * amplitude, 100.0), geometry.contact(circuit)
        assert float(fitact.peak_force(*arguments)) == pytest.approx(peak, rel=1e-12)
        assert float(fitact.mean_force(*arguments)) == pytest.approx(0.5 * peak, rel=1e-12)


def test_a_circuit_without_a_gap_has_no_voltage_across_it():
    for circuit in (fitact.FinalCircuit(R, C, CI), fitact.DirectGround(R, C, CI)):
        with pytest.raises(fitact.InputError, match="no gap between finger and panel; Vgap needs Cgap"):
            fitact.response(circuit, fitact.Sine(1.0, 1.0), 0.0, channel="Vgap")
    with pytest.raises(fitact.InputError, match="Rgap is given without Cgap"):
        fitact.DirectGround(R, C, CI, Rgap=1e6)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"force": {"model": "gap"}}, "'gap' needs a gap; give .gap. thickness or capacitance"),
        ({"gap": {"resistance": 1e6}}, "resistance needs what lies in parallel with it"),
        ({"prior": {"Rgap": {"median": 1e6, "factor": 10}}}, "resistance needs what lies in parallel with it"),
        ({"gap": {"thickness": "-1 um"}}, "greater than 0"),
    ],
)
def test_refused_scenes(content: dict[str, object], sentence: str):
    with pytest.raises(fitact.InputError, match=sentence):
        fitact.Scene.from_dict(content)


def test_thickness_gives_the_capacitance_of_air_and_follows_it_unless_both_are_stated():
    stated = fitact.Scene.from_dict({"gap": {"thickness": "2 um"}, "force": {"model": "gap"}})
    circuit = stated.make_rc_circuit({"Cgap": 0.5 * CGAP})
    assert stated.make_rc_circuit().Cgap == pytest.approx(CGAP, rel=1e-12)
    assert float(stated.geometry().contact(circuit).thickness) == pytest.approx(2.0 * THICKNESS, rel=1e-12)
    both = fitact.Scene.from_dict({"gap": {"thickness": "2 um", "capacitance": "1 nF"}, "force": {"model": "gap"}})
    assert both.make_rc_circuit().Cgap == 1e-9
    assert both.geometry().contact(circuit).thickness == THICKNESS


def test_plan_keeps_the_gap_that_the_force_acts_across_and_says_what_eq_22_would_make_of_it():
    drive = {"waveform": "sine", "peak_to_peak": 360.0}
    planned = fitact.plan(
        fitact.Scene.from_dict({"gap": {"thickness": THICKNESS}, "force": {"model": "gap"}, "drive": drive})
    )
    (gap,) = (each for each in planned.omissions if each.name == "gap")
    assert (gap.kept, gap.because) == (True, "the force acts across it")
    s = 2j * np.pi * 100.0
    skin, insulator, across = 1.0 / (1.0 / R + s * C), 1.0 / (s * CI), 1.0 / (s * CGAP)
    vgap, vsc = abs(across / (2.0 * skin + insulator + across)), abs(skin / (2.0 * skin + insulator))
    layers = 8.85e-12 * AREA * (1.0 / CI + 1.0 / C)  # T_i / eps_i + T_sc / eps_sc
    paper = vsc**2 / (2.0 * layers * (1e-6 + 200e-6))
    assert gap.nominal.force_mean == pytest.approx(abs(paper / (vgap**2 / (2.0 * THICKNESS**2)) - 1.0), rel=1e-9)


@pytest.mark.parametrize(
    ("gap", "measured", "blind"),
    [("conducting", ("Vsc",), 1), ("conducting", ("Vsc", "I"), 0), ("open", ("Vsc",), 2), ("open", ("Vsc", "I"), 1)],
)
def test_what_no_record_can_tell(gap: str, measured: tuple[str, ...], blind: int):
    """Vsc does not depend on the area. An open gap is in series with Ci, and only their series capacitance shows."""
    free = ("Rsc", "Csc", "Ci", *GAPS[gap])
    found = blind_directions(with_gap("direct", gap), free, measured)
    assert len(found) == blind
    if blind == 1 and gap == "open":
        along = dict(zip(free, found[0], strict=True))
        assert along["Rsc"] == pytest.approx(0.0, abs=1e-9)
        assert along["Ci"] / along["Cgap"] == pytest.approx(-CI / CGAP)  # 1/Ci + 1/Cgap is constant


def test_every_unknown_charge_has_a_unit_in_every_channel():
    """There is one unknown charge for each time constant: two skins, the gap and the resistor."""
    circuit = fitact.DirectGround(R, C, CI, series_resistor=100e3, Rgap=RGAP, Cgap=CGAP)
    assert len(circuit.terms().tau) == len(CHARGES) == 4
    assert {quantity_unit(name) for name in CHARGES} == {"V"}
    assert (
        {quantity_unit(f"{name}_I") for name in CHARGES} == {quantity_unit(f"{name}_I_2") for name in CHARGES} == {"A"}
    )


SLIDING = {
    "gap": {"resistance": RGAP, "capacitance": CGAP},
    "prior": free(Rgap=10.0, Cgap=10.0),
    "force": {"model": "gap"},
}


@pytest.mark.slow
def test_fit_of_vsc_and_current_tells_the_gap_and_its_force():
    elements, R0 = [SKIN, SKIN, (RGAP, CGAP)], 100e3
    measurement = {"channels": ["Vsc", "I"], "series_resistor": R0}
    fit = fitact.fit(record(elements, R0), scene(measurement=measurement, **SLIDING))
    assert fit.trusted
    assert fit.identifiability.verdict == "identified"
    assert_true(fit, **TRUTH, Rgap=RGAP, Cgap=CGAP)
    vgap, _ = channels(wave("trapezoid", 180.0, 1000, 14), TRUTH["Ci"], elements[::-1], R0)
    force = 8.85e-12 * AREA * np.mean(vgap[-1000:] ** 2) / (2.0 * THICKNESS**2)
    found = fit.derived()["force_mean"]
    assert abs(found["mean"] - force) < 4.0 * found["sd"] + 1e-4 * force  # the sum over samples has this error
    assert fit.to_dict()["force_basis"]["law"] == "gap"


@pytest.mark.slow
def test_fit_of_vsc_alone_says_that_the_prior_speaks():
    fit = fitact.fit(record([SKIN, SKIN, (RGAP, CGAP)]), scene(**SLIDING))
    assert fit.identifiability.verdict == "prior-limited"
    assert fit.identifiability.structural
    assert fit.identifiability.force_from_prior > 0.5
    assert "the loop current" in fit.identifiability.remedy
