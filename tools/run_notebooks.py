"""Run the notebooks given as text; leave the executed copies in out/notebooks."""

import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

target = Path("out/notebooks")
target.mkdir(parents=True, exist_ok=True)
for path in map(Path, sys.argv[1:]):
    notebook = jupytext.read(path)
    NotebookClient(notebook, timeout=180, resources={"metadata": {"path": str(path.parent)}}).execute()
    nbformat.write(notebook, target / f"{path.stem}.ipynb")
    print(f"{path}: ran")
