"""Run notebooks given as text, two at a time, each in its own folder; leave the executed copies in out/notebooks."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError

TARGET = Path("out/notebooks")
SECONDS = 600  # that a cell may take; a tenth is what it takes on a quiet machine
QUIET = ["--IPKernelApp.log_level=ERROR"]


def run(path: Path) -> tuple[str, float]:
    """Where and why it failed ("" where it did not), and the seconds that it took."""
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
    # under another name where it failed, lest make take it for done
    nbformat.write(notebook, TARGET / f"{path.stem}{'.failed' if failure else ''}.ipynb")
    return failure, time.perf_counter() - began


def main() -> None:
    """Run all, then tell of those that failed."""
    TARGET.mkdir(parents=True, exist_ok=True)
    paths, failures = [Path(argument) for argument in sys.argv[1:]], []
    with ThreadPoolExecutor(2) as pool:
        for path, (failure, seconds) in zip(paths, pool.map(run, paths), strict=True):
            print(f"{path}: {'failed' if failure else 'ran'}, {seconds:.0f} s", flush=True)
            failures += [failure] if failure else []
    sys.exit("\n\n".join(failures) or 0)


if __name__ == "__main__":
    main()
