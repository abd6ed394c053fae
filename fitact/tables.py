"""Rows of text as aligned columns; knows no result class."""

from collections.abc import Iterable, Sequence


def align_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return one line: the first cell to the left, the others to the right, each `widths` characters wide."""
    first, *others = cells
    columns = (f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True))
    return (f"{first:{widths[0]}}" + "".join(columns)).rstrip()


def align_rows(rows: Iterable[Sequence[str]], widths: Sequence[int]) -> list[str]:
    """Return a line for each row, see `align_row`."""
    return [align_row(row, widths) for row in rows]


def join_lines(rows: Iterable[str], warnings: Iterable[str] = ()) -> str:
    """Return the text of a result: its rows, then its warnings, a line each."""
    return "\n".join([*rows, *(f"warning: {warning}" for warning in warnings)])
