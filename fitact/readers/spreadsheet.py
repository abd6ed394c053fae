"""Sheets of Excel and OpenDocument files, as text for the reader of text files."""

import datetime
import functools
import re
import zipfile
from pathlib import Path
from typing import Any

from fitact.data.spectrum import MINIMUM_POINTS
from fitact.errors import InputError
from fitact.files import read_head
from fitact.readers.extras import import_extra

_OLD_EXCEL = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"


def is_spreadsheet(path: Path) -> bool:
    head = read_head(path)
    if not head.startswith(b"PK\x03\x04"):
        return head.startswith(_OLD_EXCEL)
    try:
        names = zipfile.ZipFile(path).namelist()
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False
    return any(name.startswith("xl/") or name == "content.xml" for name in names)


def read_sheets(path: Path) -> list[bytes]:
    """Return the sheets with rows of numbers, as text: a line for each row, with tabs between the cells.

    Raises:
        InputError: the file is damaged, or python-calamine is not installed.
    """
    state = path.stat()
    return _read_sheets(path, state.st_mtime_ns, state.st_size)


@functools.lru_cache(maxsize=1)  # a file is read to see whether it holds a spectrum, and again
def _read_sheets(path: Path, changed: int, size: int) -> list[bytes]:
    calamine = import_extra("python_calamine", "excel", str(path))
    try:
        with calamine.load_workbook(str(path)) as book:
            kinds = [(sheet.name, sheet.typ == calamine.SheetTypeEnum.WorkSheet) for sheet in book.sheets_metadata]
            sheets = [book.get_sheet_by_name(name) for name, is_table in kinds if is_table]
            tables = [((sheet.start or (0, 0))[0], sheet.to_python()) for sheet in sheets]
    except BaseException as error:  # a panic of its library is no Exception
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: cannot be read ({reason}); save the sheet again, or as CSV") from error
    texts = [_to_text(rows, first) for first, rows in tables if _count_rows(rows) >= MINIMUM_POINTS]
    if not texts:
        raise InputError(f"{path}: no sheet has rows of numbers; write a header such as time_s,V_V,Vsc_V,I_A, and rows")
    return texts


def _count_rows(rows: list[list[Any]]) -> int:
    """Return how many rows hold a number or time of day."""
    return sum(any(not isinstance(cell, str) for cell in row) for row in rows)


def _to_text(rows: list[list[Any]], first: int) -> bytes:
    stamps = {i for row in rows for i, cell in enumerate(row) if isinstance(cell, datetime.datetime)}
    lines = ("\t".join([_show_cell(cell, i in stamps) for i, cell in enumerate(row)]) for row in rows)
    return ("\n" * first + "\n".join(lines)).encode()


def _show_cell(cell: Any, is_stamp: bool) -> str:
    if isinstance(cell, str):
        return re.sub(r"\s", " ", cell)
    if isinstance(cell, datetime.timedelta):
        return str(cell.total_seconds())
    return f"{cell} 00:00:00" if is_stamp and type(cell) is datetime.date else str(cell)  # midnight
