"""Hooks of mkdocs: pages from notebooks, and equations as MathML."""

import base64
import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

NOTEBOOKS = Path("notebooks")
EXECUTED = Path("out/notebooks")
_LINK = re.compile(r"\]\((\w+)\.ipynb\)")  # to another notebook
_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add every notebook to the navigation."""
    pages = [f"notebooks/{path.stem}.md" for path in _sources()]
    config.nav = [{"Notebooks": pages} if "Notebooks" in entry else entry for entry in config.nav or []]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook, with the pictures of its executed copy if there is one."""
    for source in _sources():
        executed = EXECUTED / f"{source.stem}.ipynb"
        notebook = nbformat.read(executed, as_version=4) if executed.exists() else jupytext.read(source)
        pictures: dict[str, bytes] = {}
        text = "\n\n".join(_blocks(notebook, source.stem, pictures))
        files.append(File.generated(config, f"notebooks/{source.stem}.md", content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Convert TeX to MathML, which browsers render without a script."""
    return _EQUATION.sub(_mathml, content)


def _mathml(found: re.Match[str]) -> str:
    tex = html.unescape(found[3])
    if found[2] == "(":
        return convert(tex)
    # wide equations scroll, also by keyboard
    return f'<div class="equation" tabindex="0">{convert(tex, display="block")}</div>'


def _sources() -> list[Path]:
    return sorted(NOTEBOOKS.glob("*.py"))


def _blocks(notebook: Any, stem: str, pictures: dict[str, bytes]) -> Iterator[str]:
    """Yield the notebook as Markdown; the title and the heading above a picture describe it."""
    title = heading = ""
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            heading = next((line.lstrip("# ") for line in cell.source.splitlines() if line.startswith("#")), heading)
            title = title or heading
            yield _LINK.sub(r"](\1.md)", cell.source)
        elif cell.cell_type == "code":
            yield f"```python\n{cell.source}\n```"
            described = " ".join(dict.fromkeys((title, heading))).strip() or stem
            for output in cell.get("outputs", []):
                yield from _output(output, f"{stem}_{len(pictures)}", described, pictures)


def _output(output: Any, name: str, heading: str, pictures: dict[str, bytes]) -> Iterator[str]:
    data = output.get("data", {})
    if "image/png" in data:
        pictures[f"{name}.png"] = base64.b64decode(data["image/png"])
        yield f"![{heading}]({name}.png)"
    elif "image/svg+xml" in data:
        pictures[f"{name}.svg"] = data["image/svg+xml"].encode()
        yield f"![{heading}]({name}.svg)"
    else:
        text = _ANSI.sub("", output.get("text") or data.get("text/plain", "")).rstrip()
        if text:
            yield f"``` {{.text .printed}}\n{text}\n```"
