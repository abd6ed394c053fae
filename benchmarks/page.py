"""Time until the report of `fitact app` in Chromium, against `fitact run` on the same file, as whole processes in turn.

    pip install "fitact[app,test]"; python benchmarks/page.py [--rounds 3] [--delay 5] [--json]

Chromium is open before. A driver opens the page, chooses the shipped record and its scene, presses Start as soon as the
page offers it, and waits until the report shows its verdict. All compiled programs are stored. Medians are compared;
standard error shows them in seconds: `run` until the process ends, `run_seen` until Chromium shows its report.

- `at_once`: from the start of `fitact app` to the report, with no pause, over `run_seen`;
- `from_start`: from Start to the report, when a person has had the page open for `--delay` seconds before, likewise;
- `first_page`: from the start of `fitact app` to its first page, s.
"""

import argparse
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from chromium import open_chromium
from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait
from timing import process_seconds, program_environment, show

RECORD = Path(__file__).resolve().parent.parent / "data_synth" / "records" / "finger_direct.csv"
SCENE = RECORD.with_suffix(".toml")
_SEEN = "document.querySelector('.verdict h2') !== null"


def wait(driver: webdriver.Chrome, condition: str) -> None:
    WebDriverWait(driver, 300.0, poll_frequency=0.05).until(lambda _: driver.execute_script(f"return {condition}"))


def run_seconds(driver: webdriver.Chrome, command: list[str], folder: Path, cache: Path) -> dict[str, float]:
    """Return the seconds of `fitact run`, and those until Chromium shows its report."""
    seconds, opened = process_seconds(command, folder, cache), time.perf_counter()
    driver.get((folder / command[-1] / "report.html").as_uri())
    wait(driver, _SEEN)
    return {"run": seconds, "run_seen": seconds + time.perf_counter() - opened}


def page_seconds(driver: webdriver.Chrome, fitact: str, folder: Path, cache: Path, delay: float) -> dict[str, float]:
    """Return the seconds from opening to the first page and to the report, and from Start, pressed after `delay`."""
    opened = time.perf_counter()
    server = subprocess.Popen(
        [fitact, "app", "--no-browser", "--out", str(folder)],
        env=program_environment(cache), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        assert server.stdout is not None
        driver.get(server.stdout.readline().strip())
        shown = time.perf_counter()
        driver.find_element("id", "files").send_keys(f"{RECORD}\n{SCENE}")
        wait(driver, "document.getElementById('start') !== null")
        time.sleep(max(opened + delay - time.perf_counter(), 0.0))
        started = time.perf_counter()
        driver.find_element("id", "start").click()
        wait(driver, "document.body.dataset.state === 'finished'")
        driver.switch_to.frame(driver.find_element("tag name", "iframe"))
        wait(driver, _SEEN)
        now = time.perf_counter()
        driver.switch_to.default_content()
        return {"first_page": shown - opened, "opened": now - opened, "started": now - started}
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description="Time until the report of the page, against the command line.")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=3, help="rounds, of which the median is taken")
    parser.add_argument("--delay", type=float, default=5.0, help="seconds between opening the page and Start")
    given = parser.parse_args()
    fitact = str(Path(sys.executable).with_name("fitact"))
    command = [fitact, "run", str(RECORD), "--scene", str(SCENE), "--fresh", "--out", "results"]
    taken: dict[str, list[float]] = {name: [] for name in ("run", "run_seen", "at_once", "from_start", "first_page")}
    with tempfile.TemporaryDirectory() as name, open_chromium() as driver:
        folder, cache = Path(name), Path(name) / "cache"
        process_seconds(command, folder, cache)  # fills the cache
        for _ in range(given.rounds):
            for key, seconds in run_seconds(driver, command, folder, cache).items():
                taken[key].append(seconds)
            at_once, later = (page_seconds(driver, fitact, folder / "page", cache, each) for each in (0.0, given.delay))
            taken["at_once"].append(at_once["opened"])
            taken["from_start"].append(later["started"])
            taken["first_page"] += [at_once["first_page"], later["first_page"]]
    median = {key: statistics.median(each) for key, each in taken.items()}
    print(", ".join(f"{key} {value:.2f} s" for key, value in median.items()), file=sys.stderr)
    ratios = {key: median[key] / median["run_seen"] for key in ("at_once", "from_start")}
    show(ratios | {"first_page": median["first_page"]}, given.json)


if __name__ == "__main__":
    main()
