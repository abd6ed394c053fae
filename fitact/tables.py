"""Tables as text, HTML, pandas and xarray objects, and how a result looks in a notebook; knows no result class."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Literal


def align_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return one line: the first cell to the left, the others to the right, each `widths` characters wide."""
    first, *others = cells
    columns = (f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True))
    return (f"{first:{widths[0]}}" + "".join(columns)).rstrip()


def align_table(rows: Iterable[Sequence[str]], gap: int = 3, words: int = 0) -> list[str]:
    """Return a line for each row, as wide as its cells need: the first column to the left, the others to the right.

    The last `words` columns hold words, to the left. A row of one cell is a title and sets no width. A cell beyond the
    first row's columns is a remark, to the left.
    """
    rows = [list(row) for row in rows]
    count = len(rows[0])
    widths = [max(len(row[i]) for row in rows if len(row) > max(i, 1)) for i in range(count)]
    lines = []
    for row in rows:
        sides = [">"] * (count - 1 - words) + ["<"] * words
        columns = zip(row[1:count], sides, widths[1:], strict=False)
        cells = [f"{cell:{side}{width}}" for cell, side, width in columns]
        lines.append((" " * gap).join([f"{row[0]:{widths[0]}}", *cells, *row[count:]]).rstrip())
    return lines


def join_lines(rows: Iterable[str], warnings: Iterable[str] = (), notes: Iterable[str] = ()) -> str:
    """Return the text of a result: its rows, then its notes and its warnings, a line each."""
    remarks = [*(f"note: {note}" for note in notes), *(f"warning: {warning}" for warning in warnings)]
    return "\n".join([*rows, *remarks])


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table of `rows`, titles first, in the colours of its page; a row of one cell is a heading."""
    lines = []
    for number, row in enumerate(rows):
        tag, sides = "td" if number else "th", ["left", *["right;white-space:nowrap"] * (len(rows[0]) - 1), "left"]
        if len(row) == 1:
            lines.append(f'<tr><th colspan="{len(rows[0])}" style="text-align:left">{escape(row[0])}</th></tr>')
            continue
        cells = (
            f'<{tag} style="text-align:{side}">{escape(cell)}</{tag}>' for cell, side in zip(row, sides, strict=False)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<table style="color:inherit">{"".join(lines)}</table>'


def to_dataframe(
    content: Mapping[str, Any],
    orient: Literal["columns", "index"] = "columns",
    levels: Mapping[str, Iterable[Any]] | None = None,
) -> Any:
    """Return a pandas DataFrame of columns, or of rows by name if `orient` is "index".

    `levels`: labels of each level of the index; each combination has a row, those of the last level in turn.
    """
    import pandas as pd  # slow to import, and most results are never a DataFrame

    frame = pd.DataFrame.from_dict(content, orient=orient)
    return frame if levels is None else frame.set_axis(pd.MultiIndex.from_product(levels.values(), names=list(levels)))


def to_dataset(
    variables: Mapping[str, Any],
    coordinates: Mapping[Any, Any] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> Any:
    """Return an `xarray.Dataset`; a variable is a tuple of its dimension or dimensions, values and attributes."""
    import xarray as xr  # slow to import, and only files and ArviZ need it

    return xr.Dataset(variables, coordinates, attributes)


def to_datatree(datasets: Mapping[str, Any]) -> Any:
    """Return an `xarray.DataTree` of datasets by the paths of their groups."""
    import xarray as xr

    return xr.DataTree.from_dict(datasets)


class Display:
    """Appearance of a result in a console and in a notebook, and a `dir()` of public names.

    A class states its `_headline`, and may state rows, sentences and `warnings`.
    """

    @property
    def _headline(self) -> str:
        """One line, which costs little to compute."""
        raise NotImplementedError

    def _rows(self) -> Sequence[Sequence[str]]:
        """Return rows of text for a notebook, titles first."""
        return ()

    def _sentences(self) -> Iterable[str]:
        """Return what a notebook writes below the rows."""
        return ()

    def __repr__(self) -> str:
        return f"<fitact.{type(self).__name__}: {self._headline}>"

    def _repr_html_(self) -> str:
        rows, name = self._rows(), type(self).__name__
        parts = [f"<p><b>{name}</b>: {escape(self._headline)}</p>", html_table(rows) if rows else ""]
        parts += [f"<p>{escape(sentence)}</p>" for sentence in self._sentences()]
        # the one colour is legible on white and on black
        border = "border-left:4px solid #D55E00;padding-left:.6em"
        warnings: Iterable[str] = getattr(self, "warnings", ())
        parts += [f'<p style="{border}"><b>warning</b>: {escape(warning)}</p>' for warning in warnings]
        return f"<div>{''.join(parts)}</div>"

    def __dir__(self) -> list[str]:
        return [name for name in super().__dir__() if not name.startswith("_")]
