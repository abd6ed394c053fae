"""Draw the circuits and the wiring of docs/circuit.md and README.md: `python tools/draw_circuits.py`.

Writes docs/circuit*.svg and docs/wiring*.svg; a test fails where these are older than the program that draws them.
"""

import functools
from collections.abc import Callable
from pathlib import Path

from fitact.scene.scene import Scene

ROOT = Path(__file__).parents[1]
_BOTH = {"channels": ["Vsc", "I"]}
_EQUAL = Scene.from_dict({"measurement": _BOTH})
_UNEQUAL = Scene.from_dict({"grounding": {"R_H": "500 ohm", "grounding_Rsc": "80 kohm", "grounding_Csc": "44 nF"}})
_NATURAL = Scene.from_dict({"grounding": {"connection": "natural", "Z": "14.5 Mohm"}, "measurement": _BOTH})
_EVERYTHING = Scene.from_dict(
    {
        "device": {"Ri": "50 Mohm"},
        "gap": {"resistance": "1 Mohm", "thickness": "2 um"},
        "measurement": {
            "series_resistor": "100 kohm",
            "probe_resistance": "10 Mohm",
            "probe_capacitance": "10 pF",
            "stray_capacitance": "100 pF",
        },
    }
)
DRAWINGS: dict[str, Callable[[], str]] = {
    "circuit": functools.partial(_EQUAL.draw_circuit, is_file=True),
    "circuit_unequal": functools.partial(_UNEQUAL.draw_circuit, is_file=True),
    "circuit_natural": functools.partial(_NATURAL.draw_circuit, is_file=True),
    "circuit_additions": functools.partial(_EVERYTHING.draw_circuit, is_file=True),
    "wiring": functools.partial(_EQUAL.draw_wiring, is_file=True),
    "wiring_natural": functools.partial(_NATURAL.draw_wiring, is_file=True),
}

if __name__ == "__main__":
    for name, draw in DRAWINGS.items():
        (ROOT / "docs" / f"{name}.svg").write_text(draw(), encoding="utf-8")
