"""Time until the report of `fitact app`, against `fitact run` on the same file, as whole processes in turn.

    pip install "fitact[app]"; python benchmarks/page.py [--rounds 3] [--delay 5] [--json]

A script sends the requests of a browser: it opens the page, uploads the shipped record and its scene, stores the form,
presses Start, and asks for the progress every 0.2 s, as the page does. All compiled programs are stored. Medians are
compared; standard error shows them in seconds.

- `at_once`: from the start of `fitact app` to the report, with no pause, over the time of `fitact run`;
- `from_start`: from Start to the report, when a person has had the page open for `--delay` seconds before, likewise.
"""

import argparse
import html
import json
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from pathlib import Path

from timing import process_seconds, program_environment, show

RECORD = Path(__file__).resolve().parent.parent / "data_synth" / "records" / "finger_direct.csv"
SCENE = RECORD.with_suffix(".toml")
POLL = 0.2  # s, of the page


def page_seconds(fitact: str, folder: Path, cache: Path, delay: float) -> tuple[float, float]:
    """Return the seconds from opening the page, and from Start, to the report; Start is pressed after `delay`."""
    opened = time.perf_counter()
    server = subprocess.Popen(
        [fitact, "app", "--no-browser", "--out", str(folder)],
        env=program_environment(cache), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        host = address.rpartition("/")[0].rpartition("/")[0]

        def ask(path: str, body: bytes | None = None) -> str:
            request = urllib.request.Request(address + path, body, {"Origin": host} if body is not None else {})
            with urllib.request.urlopen(request) as answer:
                return str(answer.read().decode())

        ask("")
        place = "analyses/" + json.loads(ask(f"files?name={RECORD.name}", RECORD.read_bytes()))["analysis"]
        ask(f"{place}/scene", SCENE.read_bytes())
        form = read_form(ask(place))
        time.sleep(max(opened + delay - time.perf_counter(), 0.0))
        started = time.perf_counter()
        ask(f"{place}/set-up", urllib.parse.urlencode(form).encode())
        ask(f"{place}/actions/start", b"")
        while '"finished"' not in ask(f"{place}/progress"):
            time.sleep(POLL)
        ask(f"{place}/report")
        now = time.perf_counter()
        return now - opened, now - started
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def read_form(page: str) -> dict[str, str]:
    """Return what the form of the page holds, as a browser would send it."""
    stated = re.findall(r'<input [^>]*name="([^"]+)" value="([^"]*)"', page)
    for name, options in re.findall(r'<select [^>]*name="([^"]+)"[^>]*>(.*?)</select>', page, re.DOTALL):
        stated += [(name, choice) for choice in re.findall(r"<option selected>([^<]*)<", options)]
    return {name: html.unescape(value) for name, value in stated}


def main() -> None:
    parser = argparse.ArgumentParser(description="Time until the report of the page, against the command line.")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=3, help="rounds, of which the median is taken")
    parser.add_argument("--delay", type=float, default=5.0, help="seconds between opening the page and Start")
    given = parser.parse_args()
    fitact = str(Path(sys.executable).with_name("fitact"))
    command = [fitact, "run", str(RECORD), "--scene", str(SCENE), "--fresh", "--out", "results"]
    taken: dict[str, list[float]] = {"run": [], "at_once": [], "opened": [], "from_start": []}
    with tempfile.TemporaryDirectory() as name:
        folder, cache = Path(name), Path(name) / "cache"
        process_seconds(command, folder, cache)  # fills the cache
        for _ in range(given.rounds):
            taken["run"].append(process_seconds(command, folder, cache))
            taken["at_once"].append(page_seconds(fitact, folder / "page", cache, 0.0)[0])
            opened, started = page_seconds(fitact, folder / "page", cache, given.delay)
            taken["opened"].append(opened)
            taken["from_start"].append(started)
    median = {key: statistics.median(each) for key, each in taken.items()}
    print(", ".join(f"{key} {value:.2f} s" for key, value in median.items()), file=sys.stderr)
    show({key: median[key] / median["run"] for key in ("at_once", "from_start")}, given.json)


if __name__ == "__main__":
    main()
