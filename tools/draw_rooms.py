"""Draw the packages of fitact as rooms, one storey per layer of the import contract: `python tools/draw_rooms.py`.

Names and order come from pyproject.toml, and each package's task from its docstring. Writes docs/rooms.svg.
"""

import ast
import re
import textwrap
import tomllib
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[1]
# packages on the path of a parameter to the force
STREET = ("scene", "prior", "model", "data", "likelihood", "problem", "fitting", "sampling")


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


def draw(
    layers: list[list[str]], width: float = 8.0, gap: float = 0.04, margin: float = 0.09, letter: float = 0.056
) -> Figure:
    """Return the figure, with a storey per layer and the rooms of `STREET` in colour.

    Each storey is as tall as its longest task needs; `letter` is the mean width of one, as all lengths in inches.
    """
    name_height, line_height = 0.22, 0.145
    storeys = []
    for names in layers:
        room = width / len(names)
        columns = int((room - 2.0 * (gap + margin)) / letter)
        storeys.append([(name, textwrap.wrap(read_task(name), columns)) for name in names])
    heights = [
        2.0 * (gap + margin) + name_height + line_height * max(len(task) for _, task in rooms) for rooms in storeys
    ]
    total = sum(heights)
    figure = Figure(figsize=(width, total))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, width), ylim=(-total, 0.0))
    axes.axis("off")
    top = 0.0
    for rooms, height in zip(storeys, heights, strict=True):
        room = width / len(rooms)
        for place, (name, task) in enumerate(rooms):
            x, y = place * room + gap, top - height + gap
            colour = "#d7e8f4" if name in STREET else "#f1f1f1"
            size = room - 2.0 * gap, height - 2.0 * gap
            axes.add_patch(FancyBboxPatch((x, y), *size, "round,pad=0,rounding_size=0.08", fc=colour, ec="#777777"))
            axes.text(x + margin, top - gap - margin, name, va="top", weight="bold", size=10)
            for number, line in enumerate(task):
                below = gap + margin + name_height + number * line_height
                axes.text(x + margin, top - below, line, va="top", size=7.5)
        top -= height
    return figure


if __name__ == "__main__":
    mpl.rcParams |= {"svg.hashsalt": "fitact", "svg.fonttype": "none", "font.family": "sans-serif"}
    draw(read_layers()).savefig(ROOT / "docs" / "rooms.svg", metadata={"Date": None})
