"""Writers of files that programs pack: raw files of SPICE, sheets of Excel and OpenDocument."""

import datetime
import zipfile
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

Cell = str | float | datetime.datetime | None


def header(name: str, flags: str, points: int, variables: list[tuple[str, str]], offset: float = 0.0) -> str:
    lines = [f"\t{i}\t{each}\t{kind}" for i, (each, kind) in enumerate(variables)]
    return (
        f"Title: * finger\nDate: Tue Mar  4 09:15:59 2025\nPlotname: {name}\nFlags: {flags}\n"
        f"No. Variables: {len(variables)}\nNo. Points:     {points}\nOffset: {offset:.16e}\nVariables:\n"
        + "\n".join(lines)
        + "\n"
    )


def raw(
    runs: list[tuple[np.ndarray, dict]], form: str, flags: str = "real forward", offset: float = 0.0,
    name: str = "Transient Analysis",
) -> bytes:  # fmt: skip
    """Return one plot with all runs; `form` is "mixed" (LTspice), "double", "by variable" or "text"."""
    axis = np.concatenate([time for time, _ in runs])
    columns = [np.concatenate([waves[key][1] for _, waves in runs]) for key in runs[0][1]]
    first = ("frequency", "frequency") if "complex" in flags else ("time", "time")
    variables = [first, *((key, kind) for key, (kind, _) in runs[0][1].items())]
    wide = form != "double"
    head = header(name, flags, axis.size, variables, offset).encode("utf-16-le" if wide else "latin-1")
    mark = ("Values:\n" if form == "text" else "Binary:\n").encode("utf-16-le" if wide else "latin-1")
    kind = "<c16" if "complex" in flags else "<f8"
    if form == "text":
        shown = (lambda x: f"{x.real:.12e},{x.imag:.12e}") if "complex" in flags else (lambda x: f"{x:.12e}")
        rows = [
            "\n".join(
                [
                    f"{i}\t\t{shown(axis[i] + 0j if 'complex' in flags else axis[i])}",
                    *(f"\t{shown(c[i])}" for c in columns),
                ]
            )
            for i in range(axis.size)
        ]
        return head + mark + ("\n".join(rows) + "\n").encode("utf-16-le")
    if form == "by variable":
        return head + mark + axis.astype(kind).tobytes() + b"".join(c.astype("<f4").tobytes() for c in columns)
    rest = "<f4" if form == "mixed" and kind == "<f8" else kind
    table = np.zeros(axis.size, [("axis", kind), ("rest", rest, (len(columns),))])
    table["axis"], table["rest"] = axis, np.stack(columns, axis=1)
    return head + mark + table.tobytes()


def _xlsx_cell(cell: Cell, place: str) -> str:
    if isinstance(cell, str):
        return f'<c r="{place}" t="inlineStr"><is><t>{escape(cell)}</t></is></c>'
    if isinstance(cell, datetime.datetime):
        days = (cell - datetime.datetime(1899, 12, 30)) / datetime.timedelta(days=1)
        return f'<c r="{place}" s="1"><v>{days!r}</v></c>'
    return "" if cell is None else f'<c r="{place}"><v>{cell!r}</v></c>'


def write_xlsx(path: Path, *sheets: list[list[Cell]]) -> Path:
    """Write sheets of Office Open XML; style 1 is a date and time."""
    main = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    kinds = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = 'xmlns="http://schemas.openxmlformats.org/package/2006/relationships"'
    numbers = range(1, len(sheets) + 1)
    listed = "".join(f'<sheet name="S{i}" sheetId="{i}" r:id="rId{i}"/>' for i in numbers)
    targets = "".join(f'<Relationship Id="rId{i}" Type="{kinds}/worksheet" Target="sheet{i}.xml"/>' for i in numbers)
    formats = '<cellXfs count="2"><xf numFmtId="0"/><xf numFmtId="22" applyNumberFormat="1"/></cellXfs>'
    parts = {
        "[Content_Types].xml": '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"/>',
        "_rels/.rels": f'<Relationships {package}><Relationship Id="r" Type="{kinds}/officeDocument"'
        ' Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook {main} xmlns:r="{kinds}"><sheets>{listed}</sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships {package}>{targets}<Relationship Id="styles"'
        f' Type="{kinds}/styles" Target="styles.xml"/></Relationships>',
        "xl/styles.xml": f"<styleSheet {main}>{formats}</styleSheet>",
    }
    for i, rows in zip(numbers, sheets, strict=True):
        cells = [
            "".join(_xlsx_cell(cell, f"{chr(ord('A') + column)}{row}") for column, cell in enumerate(each))
            for row, each in enumerate(rows, 1)
        ]
        lines = "".join(f'<row r="{row}">{each}</row>' for row, each in enumerate(cells, 1))
        parts[f"xl/sheet{i}.xml"] = f"<worksheet {main}><sheetData>{lines}</sheetData></worksheet>"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, text in parts.items():
            file.writestr(name, text)
    return path


def write_ods(path: Path, rows: list[list[Cell]]) -> Path:
    spaces = "".join(
        f' xmlns:{name}="urn:oasis:names:tc:opendocument:xmlns:{name}:1.0"' for name in ("office", "table", "text")
    )
    cells = [
        "".join(
            f'<table:table-cell office:value-type="string"><text:p>{escape(cell)}</text:p></table:table-cell>'
            if isinstance(cell, str)
            else f'<table:table-cell office:value-type="float" office:value="{cell!r}"/>'
            for cell in row
        )
        for row in rows
    ]
    lines = "".join(f"<table:table-row>{each}</table:table-row>" for each in cells)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        file.writestr("META-INF/manifest.xml", "<manifest/>")
        file.writestr(
            "content.xml",
            f"<office:document-content{spaces}><office:body><office:spreadsheet><table:table table:name='a'>{lines}"
            "</table:table></office:spreadsheet></office:body></office:document-content>",
        )
    return path
