"""Run notebooks in text form, two at a time, each in its own folder, and write executed copies to out/notebooks."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError

TARGET = Path("out/notebooks")
SECONDS = 600  # limit per cell, ten times what the slowest takes on a quiet machine
QUIET = ["--IPKernelApp.log_level=ERROR"]


def run(path: Path) -> tuple[str, float]:
    """Run one notebook; return where and why it failed ("" if it did not), and its time in seconds."""
    notebook, began = jupytext.read(path), time.perf_counter()
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
    # a failed one gets another name, so that make does not take it as done
    nbformat.write(notebook, TARGET / f"{path.stem}{'.failed' if failure else ''}.ipynb")
    return failure, time.perf_counter() - began


def main() -> None:
    """Run all notebooks, then report failures."""
    TARGET.mkdir(parents=True, exist_ok=True)
    paths, failures = [Path(argument) for argument in sys.argv[1:]], []
    with ThreadPoolExecutor(2) as pool:
        for path, (failure, seconds) in zip(paths, pool.map(run, paths), strict=True):
            print(f"{path}: {'failed' if failure else 'ran'}, {seconds:.0f} s", flush=True)
            failures += [failure] if failure else []
    sys.exit("\n\n".join(failures) or 0)


if __name__ == "__main__":
    main()
