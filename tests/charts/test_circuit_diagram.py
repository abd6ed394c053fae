import runpy
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from fitact.charts.circuit_diagram import Diagram, lay_out_circuit
from fitact.scene.scene import Scene
from fitact.summary import summarize_log_normal

ROOT = Path(__file__).parents[2]
DRAWINGS = runpy.run_path(str(ROOT / "tools" / "draw_circuits.py"))["DRAWINGS"]
MEASURED = {"series_resistor": "100 kohm", "probe_resistance": "10 Mohm", "probe_capacitance": "10 pF"}
STRAY = 90e-12  # F
SCENES = {
    "final": {},
    "unequal": {"grounding": {"R_H": 500.0, "grounding_Rsc": "80 kohm", "grounding_Csc": "44 nF"}},
    "natural": {"grounding": {"connection": "natural", "Z": "14.5 Mohm"}, "measurement": {"channels": ["Vsc", "I"]}},
    "open gap": {"gap": {"thickness": "2 um"}, "measurement": {"channels": ["I"]}},
    "all": {
        "grounding": {"connection": "natural", "Z": "14.5 Mohm", "Z_capacitance": "100 pF"},
        "gap": {"resistance": "1.2 Mohm", "capacitance": "500 pF"},
        "measurement": MEASURED,
    },
    "all direct": {
        "device": {"Ri": "50 Mohm"},
        "grounding": {"R_H": 500.0},
        "gap": {"resistance": "1.2 Mohm", "thickness": "2 um"},
        "measurement": MEASURED,
    },
    "stray": {"measurement": {"channels": ["Vsc", "I"], "stray_capacitance": STRAY}},
    "stray, all": {
        "grounding": {"connection": "natural", "Z": "14.5 Mohm"},
        "measurement": MEASURED | {"channels": ["I"], "stray_capacitance": {"median": STRAY, "relative_sd": 0.1}},
    },
    "stray, I in the ground lead": {
        "measurement": {"channels": ["I"], "stray_capacitance": STRAY, "current_lead": "ground"},
    },
}
SHUNT = 1e-2  # ohm, so small that it changes nothing


def lay_out(scene: Scene) -> Diagram:
    return lay_out_circuit(scene.describe_parts({}), scene.grounding.connection, scene.find_current_lead())


def texts(svg: str) -> list[str]:
    root = ET.fromstring(svg)
    return [
        "\n".join("".join(line.itertext()) for line in text) for text in root.iter("{http://www.w3.org/2000/svg}text")
    ]


def admittances(scene: Scene, omega: float) -> dict[str, complex]:
    measured = scene.measurement
    values = {name: value for name, value in scene.nominal_values().items() if value is not None}
    values |= {"grounding_Rsc": values["Rsc"], "grounding_Csc": values["Csc"]} | values
    values |= {"shunt": SHUNT, "probe_resistance": measured.probe_resistance}
    values |= {"probe_capacitance": measured.probe_capacitance}
    resistances = {"Rsc", "grounding_Rsc", "R_H", "Z", "series_resistor", "Ri", "Rgap", "shunt", "probe_resistance"}
    return {n: 1 / v if n in resistances else 1j * omega * v for n, v in values.items() if v is not None}


def find_nodes(diagram: Diagram) -> dict[tuple[float, float], int]:
    """Return the node of each end of a part or wire; those on one wire are one node."""
    points = [p for ends in (*diagram.parts.values(), *diagram.wires) for p in ends] + list(diagram.terminals.values())
    node = {point: number for number, point in enumerate(dict.fromkeys(points))}
    for start, end in diagram.wires:
        for point in node:
            (ax, ay), (bx, by) = np.subtract(point, start), np.subtract(end, start)
            if abs(ax * by - ay * bx) < 1e-9 and -1e-9 <= ax * bx + ay * by <= bx**2 + by**2 + 1e-9:
                kept, gone = node[start], node[point]
                node = {p: kept if number == gone else number for p, number in node.items()}
    return node


def solve(diagram: Diagram, of: dict[str, complex]) -> tuple[complex, complex]:
    """Return Vsc / V and I / V of what is drawn, by nodal analysis; I is that of the shunt, if there is one."""
    node = find_nodes(diagram)
    numbers = sorted(set(node.values()))
    ends = {name: [numbers.index(node[p]) for p in pair] for name, pair in diagram.parts.items()}
    low, high = ends.pop("source")
    matrix = np.zeros((len(numbers) + 1,) * 2, dtype=complex)
    for name, (a, b) in ends.items():
        matrix[[a, b], [a, b]] += of[name]
        matrix[[a, b], [b, a]] -= of[name]
    matrix[high, -1], matrix[low, -1] = -1.0, 1.0
    matrix[-1, high], matrix[-1, low] = 1.0, -1.0
    matrix[low, low] += 1.0  # where the ground is
    solution = np.linalg.solve(matrix, np.eye(len(matrix))[-1])
    current = solution[-1]
    if "shunt" in ends:
        current = of["shunt"] * np.subtract(*solution[ends["shunt"]])
    plus, minus = (solution[numbers.index(node[diagram.terminals[name]])] for name in ("Vsc+", "Vsc-"))
    return plus - minus, current


@pytest.mark.parametrize("name", SCENES)
def test_drawing_is_the_circuit_that_is_fitted(name: str):
    scene = Scene.from_dict(SCENES[name])
    circuit, diagram = scene.make_circuit(), lay_out(scene)
    for frequency in (1.0, 100.0, 1e4):
        omega = 2 * np.pi * frequency
        Vsc, current = solve(diagram, admittances(scene, omega))
        assert np.isclose(Vsc, complex(circuit.transfer_function(omega)), rtol=1e-5)
        stray = 1j * omega * scene.stray_capacitance()
        assert np.isclose(current, complex(circuit.admittance(omega)) + stray, rtol=1e-5)


@pytest.mark.parametrize("name", SCENES)
def test_parts_have_their_values_and_no_others_are_drawn(name: str):
    scene = Scene.from_dict(SCENES[name])
    shown = texts(scene.draw_circuit({"Rsc": summarize_log_normal("Rsc", 123456.0, 0.05)}))
    leaks = scene.device.Ri is not None
    expected = {
        "Ci\n1.35 nF" if leaks else "Ci 1.35 nF",
        "Rsc\n123.5\n± 6.2 kΩ",
        "Csc\n22 nF",
        "V",
        "Vsc",
        "I",
        "+",
        "−",
    }
    assert expected <= set(shown)
    everything = " ".join(shown)
    natural = scene.grounding.connection == "natural"
    for part, present in {
        "Ri\n50 MΩ": leaks,
        "R_H 500 Ω": scene.grounding.R_H is not None,
        "Rsc\n80 kΩ": scene.grounding.grounding_Rsc is not None,
        "Csc\n44 nF": scene.grounding.grounding_Csc is not None,
        "Z": natural,
        "14.5 MΩ": natural,
        "100 pF": scene.grounding.Z_capacitance is not None,
        "ground electrode": not natural,
        "earth": natural,
        "gap": scene.nominal_values()["Cgap"] is not None,
        "1.2 MΩ": scene.gap.resistance is not None,
        "series resistor\n100 kΩ": scene.measurement.series_resistor > 0.0,
        "probe\n10 MΩ\n10 pF": scene.measurement.probe_resistance is not None,
        "shunt": "I" in scene.measurement.channels,
        "stray\n90 pF": scene.states_stray_capacitance(),
    }.items():
        assert (part in everything) == present, part


def test_tied_and_fixed_parts_have_the_values_that_the_fit_gives_them():
    prior = {"grounding_Rsc": {"tied": "Rsc", "ratio": 2.0}, "R_H": {"fixed": 700.0}, "Rgap": {"low": 1e5, "high": 1e6}}
    fitted = {"Rsc": summarize_log_normal("Rsc", 100e3, 0.05)}
    parts = Scene.from_dict({"prior": prior, "gap": {"thickness": "2 um"}}).describe_parts(fitted)
    assert (parts["grounding_Rsc"], parts["R_H"], parts["Rgap"]) == ("200\n± 10 kΩ", "700 Ω", "")


@pytest.mark.parametrize("name", SCENES)
def test_wiring_has_what_the_scene_measures(name: str):
    scene = Scene.from_dict(SCENES[name])
    shown = texts(scene.draw_wiring())
    assert {"amplifier", "electrode", "insulator", "finger", "1: V"} <= set(shown)
    assert ({"2 +: Vsc", "2 −: Vsc"} <= set(shown)) == ("Vsc" in scene.measurement.channels)
    assert ("ground electrode" in shown) == (scene.grounding.connection == "direct")
    assert ("earth" in shown) == (scene.grounding.connection == "natural")
    assert any(text.startswith("3") for text in shown) == ("I" in scene.measurement.channels)
    assert ("series\nresistor" in shown) == (scene.measurement.series_resistor > 0.0)


def test_drawing_takes_the_colour_of_its_page_and_has_a_title():
    svg = Scene().draw_circuit()
    root = ET.fromstring(svg)
    assert root.get("role") == "img"
    assert root[0].tag.endswith("title")
    assert root[0].text == "The circuit with direct ground"
    assert "currentColor" in svg
    assert "black" not in svg


def test_importing_the_module_does_not_load_schemdraw():
    code = "import sys, fitact.charts.circuit_diagram; assert 'schemdraw.elements' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", DRAWINGS)
def test_drawings_in_the_documentation_are_up_to_date(name: str):
    assert (ROOT / "docs" / f"{name}.svg").read_text(encoding="utf-8") == DRAWINGS[name]()
