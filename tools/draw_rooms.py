"""Draw the packages of fitact as rooms, one storey per layer of the import contract: `python tools/draw_rooms.py`.

Names and order come from pyproject.toml, and each package's task from its docstring. Writes docs/rooms.svg.
"""

import ast
import re
import tomllib
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[1]
# packages on the path of a parameter to the force
STREET = ("scene", "prior", "model", "data", "likelihood", "fitting", "sampling")


def read_layers() -> list[list[str]]:
    """Return the layers from top to bottom, each a list of names without the package prefix."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract for contract in contracts if contract["type"] == "layers")["layers"]
    return [[name.strip().removeprefix("fitact.") for name in layer.split("|")] for layer in layers]


def read_task(name: str) -> str:
    """Return the first line of a package's or module's docstring."""
    path = ROOT / "fitact" / name
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
    first = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
    return re.split(r"[:;.]", first)[0]


def draw(layers: list[list[str]]) -> Figure:
    """Return the figure, with a storey per layer and the rooms of `STREET` in colour."""
    height, width = 0.5, 8.0
    figure = Figure(figsize=(width, height * len(layers)), layout="constrained")
    axes = figure.add_subplot(xlim=(0.0, width), ylim=(-len(layers), 0.0))
    axes.axis("off")
    for storey, names in enumerate(layers):
        room = width / len(names)
        for place, name in enumerate(names):
            x, y = place * room + 0.05, -storey - 0.92
            colour = "#d7e8f4" if name in STREET else "#f1f1f1"
            box = FancyBboxPatch((x, y), room - 0.1, 0.84, "round,pad=0,rounding_size=0.08", fc=colour, ec="#777777")
            axes.add_patch(box)
            axes.text(x + 0.12, y + 0.6, name, va="center", weight="bold", size=10)
            axes.text(x + 0.12, y + 0.24, read_task(name), va="center", size=7.5)
    return figure


if __name__ == "__main__":
    mpl.rcParams |= {"svg.hashsalt": "fitact", "svg.fonttype": "none", "font.family": "sans-serif"}
    draw(read_layers()).savefig(ROOT / "docs" / "rooms.svg", metadata={"Date": None})
