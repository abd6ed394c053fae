"""Warnings about implausible drives, areas, fields and forces; the fields are computed here from impedances."""

import numpy as np
import pytest

import fitact
from fitact.data.plausibility import check_plausibility, insulator_voltage
from fitact.data.simulate import simulate
from tests.conftest import square_record

GAP = {"gap": {"thickness": "2 um"}, "force": {"model": "gap"}}


def check(content: dict, drive: float = 180.0, insulator: float = 165.0, force: float = 1e-3) -> list[str]:
    return check_plausibility(fitact.Scene.from_dict(content), drive, insulator, force)


@pytest.mark.parametrize(
    ("content", "values", "words"),
    [
        ({}, {"drive": 180e3, "insulator": 165e3, "force": 1e3}, ["drive reaches 180 kV", "unit of V"]),
        ({"device": {"contact_area": 1.0}}, {}, ["contact_area = 10000 cm^2", "a plain number is in m^2"]),
        ({"device": {"insulator_thickness": "1 nm"}}, {}, ["1.65e+05 V/µm, above the 1000 V/µm of the strongest thin"]),
        ({"device": {"breakdown_field": "150 V/um"}}, {}, ["165 V/µm, above the 150 V/µm of [device] breakdown_field"]),
        ({}, {"force": 0.6}, ["reaches 600 mN, more than the finger's normal force of 500 mN", "[skin] thickness"]),
        (GAP, {"force": 2e6}, ["reaches 2 MN", "[gap] thickness"]),
        ({"friction": {"normal_force": "2 N"}}, {"force": 2.1}, ["2.1 N, more than the finger's normal force of 2 N"]),
    ],
)
def test_the_first_cause_alone_is_named(content: dict, values: dict, words: list[str]):
    (warning,) = check(content, **values)
    for word in words:
        assert word in warning


def test_what_is_plausible_or_unknown_has_no_warning():
    assert check({}) == []
    assert check({"device": {"breakdown_field": "166 V/um", "contact_area": "5 cm^2"}}, force=0.5) == []
    assert check({"device": {"breakdown_field": "1 V/um"}}, insulator=np.nan) == []
    assert check({"friction": {"normal_force": 0.0}}) == []  # no load is stated, so nothing is compared with it


@pytest.mark.parametrize("name", ["paper", "natural-ground", "phone", "fast-edge", "burst", "multitone"])
def test_shipped_scenes_are_plausible(name: str):
    assert simulate(fitact.Scene.load(name)).warnings == ()


@pytest.mark.parametrize("frequency", [10.0, 100.0, 1e4])
@pytest.mark.parametrize("ground", ["final", "natural", "resistor"])
def test_the_voltage_over_the_insulator_is_that_of_the_impedances(ground: str, frequency: float):
    s = 2j * np.pi * frequency
    skin, insulator = 160e3 / (1.0 + s * 160e3 * 22e-9), 1.0 / (s * 1.35e-9)
    circuit, others = {
        "final": (fitact.FinalCircuit(160e3, 22e-9, 1.35e-9), 2.0 * skin),
        "natural": (fitact.NaturalGround(160e3, 22e-9, 1.35e-9, 14.5e6), skin + 14.5e6),
        "resistor": (fitact.DirectGround(160e3, 22e-9, 1.35e-9, 500.0, series_resistor=1e5), 2.0 * skin + 100.5e3),
    }[ground]
    found = insulator_voltage(180.0, circuit.current_terms(), circuit, frequency)
    assert found == pytest.approx(180.0 * abs(insulator / (insulator + others)), rel=1e-6)


def test_simulations_and_fits_warn_of_the_insulator():
    """The skins take, at 100 Hz, 9 % of 180 V: the insulator of 1 um has 163 V/um."""
    for limit, doubted in (("150 V/um", True), ("175 V/um", False)):
        scene = fitact.Scene.from_dict({"drive": {"waveform": "square"}, "device": {"breakdown_field": limit}})
        fit = fitact.fit(square_record(), scene)
        for warnings in (simulate(scene).warnings, fit.warnings):
            assert any("V/µm, above the 150 V/µm" in warning for warning in warnings) == doubted


def test_a_fit_with_volts_for_millivolts():
    """A square of 180 kV on the same circuit: g and b stay, and the force is a million times too large."""
    plain = square_record()
    record = fitact.Record.from_arrays(plain.time, V=1e3 * plain["V"], Vsc=1e3 * plain["Vsc"])
    fit = fitact.fit(record)
    said = [warning for warning in fit.warnings if "check the unit" in warning]
    assert len(said) == 1
    assert "the drive reaches 180 kV" in said[0]
