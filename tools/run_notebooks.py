"""Run notebooks given as text, each in its own folder; leave the executed copies in out/notebooks."""

import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError

TARGET = Path("out/notebooks")
SECONDS = 600  # that a cell may take; a tenth is what it takes on a quiet machine
QUIET = ["--IPKernelApp.log_level=ERROR"]


def run(path: Path) -> str:
    """Where and why it failed; "" where it did not."""
    notebook = jupytext.read(path)
    place = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, timeout=SECONDS, resources=place, extra_arguments=QUIET)
    failure = ""
    try:
        client.execute()
    except (CellControlSignal, DeadKernelError) as error:
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        begun = [cell for cell in code if "iopub.execute_input" in cell.metadata.get("execution", {})]
        number = max(len(begun), 1)
        why = f"{error.ename}: {error.evalue}" if hasattr(error, "ename") else str(error).strip()
        failure = f"{path}, code cell {number} of {len(code)}:\n\n{code[number - 1].source}\n\n{why}"
    nbformat.write(notebook, TARGET / f"{path.stem}.ipynb")
    return failure


def main() -> None:
    """Run all; stop at the first that fails."""
    TARGET.mkdir(parents=True, exist_ok=True)
    for path in map(Path, sys.argv[1:]):
        began = time.perf_counter()
        failure = run(path)
        print(f"{path}: {'failed' if failure else 'ran'}, {time.perf_counter() - began:.0f} s", flush=True)
        if failure:
            sys.exit(failure)


if __name__ == "__main__":
    main()
