"""Notebooks: their common form, and the error message for a failing cell."""

import ast
import subprocess
import sys
from pathlib import Path

import jupytext
import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]_*.py"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_question_first_and_conclusion_last(path: Path):
    cells = jupytext.read(path).cells
    texts = [cell.source for cell in cells if cell.cell_type == "markdown"]
    question = texts[0].splitlines()[0]
    assert question.startswith("# ")
    assert question.endswith("?")
    assert texts[-1].startswith("## What to take away")
    assert f"| `{path.name}` | {question[2:]} |" in (ROOT / "notebooks" / "README.md").read_text()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_only_the_public_interface(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fitact"):
            assert (node.module, [name.name for name in node.names]) == ("fitact", ["paper"])
        if isinstance(node, ast.Import):
            assert all(not name.name.startswith("fitact.") for name in node.names)


def test_a_failing_cell_is_named(tmp_path: Path):
    (tmp_path / "broken.py").write_text("# %%\nx = 1\n\n# %%\nassert x == 2, 'x is one'\n\n# %%\nx = 3\n")
    command = [sys.executable, ROOT / "tools" / "run_notebooks.py", "broken.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "broken.py, code cell 2 of 3:\n\nassert x == 2, 'x is one'\n\nAssertionError: x is one" in done.stderr
    assert [path.name for path in (tmp_path / "out" / "notebooks").iterdir()] == ["broken.failed.ipynb"]
