"""The documentation site of `make docs`: it needs no other host, and its equations are typeset."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from nbformat import v4

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[str, str]:
    site = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(site)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return {str(page.relative_to(site)): page.read_text(encoding="utf-8") for page in site.rglob("*.html")}


@pytest.mark.slow
def test_a_page_asks_nothing_of_the_network(pages):
    source = r"(?:<(?:script|img|iframe|source)[^>]* src=|<link[^>]* href=|@import |url\()"
    loaded = source + r"""["']?(?:https?:)?//"""
    assert [name for name, page in pages.items() if re.search(loaded, page)] == []


@pytest.mark.slow
def test_every_equation_is_set(pages):
    assert pages["theory.html"].count("<math") > 100
    for name, page in pages.items():
        prose = re.sub(r"<(pre|code|script)\b.*?</\1>", "", page, flags=re.DOTALL)
        assert not re.search(r"arithmatex|\$\$|\\(frac|tau|mathrm)", prose), name


def test_a_notebooks_picture_is_described():
    picture = v4.new_output("display_data", {"image/png": "iVBORw0KGgo="})
    title, section = v4.new_markdown_cell("# What can be seen?"), v4.new_markdown_cell("## Fit")
    notebook = v4.new_notebook(cells=[title, section, v4.new_code_cell("show()", outputs=[picture])])
    blocks = runpy.run_path(str(ROOT / "tools/docs_hooks.py"))["_blocks"]
    pictures: dict[str, bytes] = {}
    text = "\n".join(blocks(notebook, "seen", pictures))
    assert "![What can be seen? Fit](seen_0.png)" in text
    assert list(pictures) == ["seen_0.png"]


@pytest.mark.slow
def test_every_picture_is_described(pages):
    for name, page in pages.items():
        assert all(re.search(r'alt="[^"]{8,}"', picture) for picture in re.findall(r"<img[^>]*>", page)), name


@pytest.mark.slow
def test_constructors_are_shown(pages):
    for page, begins in (
        ("drives", r"Sine\(\s*peak_to_peak"),
        ("scene", r"FinalCircuit\(\s*Rsc"),
        ("fit", r"Fit\(\s*laplace"),
    ):
        assert re.search(begins, re.sub(r"<[^>]+>", "", pages[f"api/{page}.html"])), begins
