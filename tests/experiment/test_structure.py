"""Blind directions against coefficients of the transfer functions, impedances, and scipy's null space."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

import fitact
from fitact.experiment.blind_directions import blind_directions, is_blind, name_direction

SKIN = ("Rsc", "Csc", "Ci")
VALUES = (160e3, 22e-9, 1.35e-9)
UNEQUAL = {"grounding_Rsc": 60e3, "grounding_Csc": 44.25e-9}
FINAL = fitact.FinalCircuit(*VALUES)
SERIES = fitact.DirectGround(*VALUES, series_resistor=100e3)
BODY = fitact.DirectGround(*VALUES, R_H=500.0)
FINGERS = fitact.DirectGround(*VALUES, **UNEQUAL)
SHOES = fitact.NaturalGround(*VALUES, Z=14.5e6)
SOLES = fitact.NaturalGround(*VALUES, Z=14.5e6, Z_capacitance=100e-12)

# parameters less coefficients: with one skin's R, C beside Ci, Vsc is s n1 / (1 + s d1), that is 2 coefficients,
# and I is s (n1 + s n2) / (1 + s d1), 3; each further capacitance or, in a loop without one, resistance adds 1 to
# both ends of Vsc (the loop's plain resistance to the denominator only)
CASES = {
    "final": (FINAL, SKIN, ("Vsc",), 3 - 2),
    "final I": (FINAL, SKIN, ("I",), 3 - 3),
    "final Vsc, I": (FINAL, SKIN, ("Vsc", "I"), 0),
    "final gain": (FINAL, (*SKIN, "gain"), ("Vsc",), 4 - 2),
    "final gain_I": (FINAL, (*SKIN, "gain_I"), ("I",), 4 - 3),
    "final both gains": (FINAL, (*SKIN, "gain", "gain_I"), ("Vsc", "I"), 1),
    "series": (SERIES, SKIN, ("Vsc",), 0),
    "R_H known": (BODY, SKIN, ("Vsc",), 0),
    "R_H": (BODY, (*SKIN, "R_H"), ("Vsc",), 4 - 3),
    "fingers": (FINGERS, (*SKIN, *UNEQUAL), ("Vsc",), 5 - 4),
    "fingers I": (FINGERS, (*SKIN, *UNEQUAL), ("I",), 5 - 5),
    "other finger known": (FINGERS, SKIN, ("Vsc",), 0),
    "shoes": (SHOES, (*SKIN, "Z"), ("Vsc",), 4 - 3),
    "shoes known": (SHOES, SKIN, ("Vsc",), 0),
    "shoes I": (SHOES, (*SKIN, "Z"), ("I",), 4 - 4),
    "soles": (SOLES, (*SKIN, "Z", "Z_capacitance"), ("Vsc",), 5 - 4),
}


def gain(values: dict[str, float], channel: str, omega: np.ndarray) -> np.ndarray:
    """A channel over V from the impedances of the paper's Figs. 3 and 11."""
    s = 1j * omega

    def layer(R: float, C: float) -> np.ndarray:
        return R / (1.0 + s * R * C)

    touching = layer(values["Rsc"], values["Csc"])
    if "Z" in values:
        back = layer(values["Z"], values.get("Z_capacitance", 0.0))
    else:
        back = layer(values.get("grounding_Rsc", values["Rsc"]), values.get("grounding_Csc", values["Csc"]))
    loop = 1.0 / (s * values["Ci"]) + touching + back + values.get("R_H", 0.0) + values.get("series_resistor", 0.0)
    return values.get("gain", 1.0) * touching / loop if channel == "Vsc" else values.get("gain_I", 1.0) / loop


def given(circuit: fitact.FinalCircuit | fitact.DirectGround | fitact.NaturalGround) -> dict[str, float]:
    return {name: value for name, value in vars(circuit).items() if isinstance(value, float)}


@pytest.mark.parametrize("case", CASES)
def test_as_many_as_parameters_exceed_coefficients(case: str):
    """And the same as scipy's null space of finite differences of the impedances' logarithms."""
    circuit, free, channels, dimension = CASES[case]
    found = blind_directions(circuit, free, channels)
    assert len(found) == dimension
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)

    values, omega, h = dict.fromkeys(free, 1.0) | given(circuit), np.geomspace(1e-1, 1e9, 300), 1e-4

    def logs(theta: np.ndarray) -> np.ndarray:
        moved = values | {name: values[name] * np.exp(t) for name, t in zip(free, theta, strict=True)}
        return np.log(np.concatenate([gain(moved, channel, omega) for channel in channels]))

    slopes = np.stack([(logs(h * e) - logs(-h * e)) / (2.0 * h) for e in np.eye(len(free))], axis=1)
    null = scipy.linalg.null_space(np.concatenate([slopes.real, slopes.imag]), rcond=1e-6)
    assert null.shape[1] == dimension
    if dimension:
        assert scipy.linalg.subspace_angles(null, found.T).max() < 1e-5


@pytest.mark.parametrize("case", ["final", "R_H", "fingers", "shoes", "soles", "final both gains"])
def test_constant_directions_leave_the_channels_as_they_are_far_along(case: str):
    circuit, free, channels, _ = CASES[case]
    found = blind_directions(circuit, free, channels)
    values, omega = dict.fromkeys(free, 1.0) | given(circuit), np.geomspace(1e-1, 1e9, 50)
    elsewhere = dataclasses.replace(circuit, **{name: 3.0 * value for name, value in given(circuit).items()})
    elsewhere = dataclasses.replace(elsewhere, Csc=5.0 * elsewhere.Csc)
    np.testing.assert_allclose(blind_directions(elsewhere, free, channels), found, atol=1e-6)
    moved = values | {n: values[n] * np.exp(3.0 * d) for n, d in zip(free, found[0], strict=True)}
    for channel in channels:
        np.testing.assert_allclose(gain(moved, channel, omega), gain(values, channel, omega), rtol=1e-10)


def test_contact_area_is_named():
    found = blind_directions(FINAL, SKIN, ("Vsc",))
    np.testing.assert_allclose(found[0], np.array([-1.0, 1.0, 1.0]) / np.sqrt(3.0), atol=1e-12)
    area = "the contact area, which multiplies 1/Rsc, Csc and Ci by a common factor"
    assert name_direction(dict(zip(SKIN, found[0], strict=True))) == area
    assert is_blind(found, SKIN, {"Rsc": -0.58, "Csc": 0.58, "Ci": 0.57})
    assert not is_blind(found, SKIN, {"Rsc": 0.58, "Csc": 0.58, "Ci": 0.57})
    assert len(blind_directions(FINAL, SKIN, ("Vsc", "I"))) == 0
    assert blind_directions(FINAL, ("Rsc", "Ci", "gain"), ("Vsc",))[0, 1] > 0.0  # that of a larger Ci


def test_free_gain_hides_behind_the_divider_along_a_curved_ridge():
    """gain Ci / (2 Ci + Csc) and Rsc (2 Ci + Csc) stay: with Ci held, Csc moves by (2 Ci + Csc) / Csc of it."""
    found = blind_directions(FINAL, (*SKIN, "gain"), ("Vsc",))
    _, Csc, Ci = VALUES
    expected = np.array([-1.0, (2.0 * Ci + Csc) / Csc, 0.0, 1.0])
    np.testing.assert_allclose(found[1], expected / np.linalg.norm(expected), atol=1e-12)
    assert "gain" in name_direction(dict(zip((*SKIN, "gain"), found[1], strict=True)))
    elsewhere = blind_directions(dataclasses.replace(FINAL, Csc=5.0 * Csc), (*SKIN, "gain"), ("Vsc",))
    assert scipy.linalg.subspace_angles(elsewhere.T, found.T).max() > 0.01


@pytest.mark.parametrize("R_H", [500.0, 1.0, 1e-6])
def test_known_body_however_small_is_no_structure(R_H: float):
    """It sets the scale, at frequencies of its own, even where no record would show it."""
    assert len(blind_directions(fitact.DirectGround(*VALUES, R_H=R_H), SKIN, ("Vsc",))) == 0


def test_equal_fingers_are_a_special_point():
    """There, to first order, I feels only the sum of two skins' changes; elsewhere it tells them apart."""
    equal = fitact.DirectGround(*VALUES, grounding_Rsc=VALUES[0], grounding_Csc=VALUES[1])
    assert len(blind_directions(equal, (*SKIN, *UNEQUAL), ("I",))) == 0


@pytest.mark.parametrize("name", ["Z", "R_H", "gain_I"])
def test_a_name_that_the_circuit_lacks_is_refused(name: str):
    with pytest.raises(fitact.InputError, match=f"{name}.*Rsc, Csc, Ci"):
        blind_directions(FINAL, (*SKIN, name), ("Vsc",))
