"""Write the table of what is read into docs/input.md."""

from pathlib import Path

from tests.layouts.layout import Layout
from tests.layouts.records import RECORDS
from tests.layouts.spectra import SPECTRA

PAGE = Path(__file__).parents[2] / "docs" / "input.md"
BEGIN, END = "<!-- written by tests/layouts -->\n", "<!-- end -->\n"


def render_table() -> str:
    """Return the table in Markdown; programs whose other cells are equal share a line."""
    lines: dict[tuple[str, ...], dict[str, list[Layout]]] = {}
    for layout in (*RECORDS, *SPECTRA):
        lines.setdefault(layout.line, {}).setdefault(layout.program, []).append(layout)
    table = ["| kind | written by | taken | needs |", "|---|---|---|---|"]
    for (kind, *cells), programs in lines.items():
        names = []
        for program, layouts in programs.items():
            endings = dict.fromkeys(ending for layout in layouts for ending in layout.endings)
            names.append(" ".join([program, *endings]) + "*" * any(layout.real for layout in layouts))
        table.append(f"| {' | '.join([kind, ', '.join(names), *cells])} |")
    return "\n".join(table)


def main() -> None:
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{render_table()}\n\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
