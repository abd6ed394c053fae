"""Rows of text as aligned columns; knows no result class."""

from collections.abc import Iterable, Sequence


def align_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return one line: the first cell to the left, the others to the right, each `widths` characters wide."""
    first, *others = cells
    columns = (f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True))
    return (f"{first:{widths[0]}}" + "".join(columns)).rstrip()


def align_table(rows: Iterable[Sequence[str]], gap: int = 3) -> list[str]:
    """Return a line for each row, as wide as its cells need: the first column to the left, the others to the right.

    A row of one cell is a title and sets no width. A cell beyond the first row's columns is a remark, to the left.
    """
    rows = [list(row) for row in rows]
    count = len(rows[0])
    widths = [max(len(row[i]) for row in rows if len(row) > max(i, 1)) for i in range(count)]
    lines = []
    for row in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(row[1:count], widths[1:], strict=False)]
        lines.append((" " * gap).join([f"{row[0]:{widths[0]}}", *cells, *row[count:]]).rstrip())
    return lines


def join_lines(rows: Iterable[str], warnings: Iterable[str] = (), notes: Iterable[str] = ()) -> str:
    """Return the text of a result: its rows, then its notes and its warnings, a line each."""
    remarks = [*(f"note: {note}" for note in notes), *(f"warning: {warning}" for warning in warnings)]
    return "\n".join([*rows, *remarks])
