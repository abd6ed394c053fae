"""Time to open a report in Chromium, and to respond to a button, for the demo and for 1,000,000 samples.

    python benchmarks/report.py [--json]

Opening ends when the first chart, which is scrolled to, is drawn. The response is timed from a press of the slowest
button (linear axes) to the next picture on the screen. Needs Chromium with its driver, and selenium.
"""

import argparse
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from chromium import open_chromium
from timing import medians, show

import fitact

RECORDS = Path(__file__).parents[1] / "data_synth" / "records"
ROUNDS, SAMPLES, RATE = 7, 1_000_000, 200e3


def write_pages(folder: Path) -> dict[str, Path]:
    """Write the pages from independent draws, which differ from the demo's in numbers only."""
    scene = fitact.Scene.load(RECORDS / "finger_direct.toml")
    demo = fitact.fit(fitact.read(RECORDS / "finger_direct.csv", scene), scene)
    known = fitact.Scene.from_dict({"drive": {"waveform": "trapezoid", "rise_time": "50 us"}})
    drive = fitact.Trapezoid(peak_to_peak=360.0, frequency=100.0, rise_time=50e-6)
    time = np.arange(SAMPLES) / RATE
    vsc = np.asarray(fitact.response(fitact.FinalCircuit(160e3, 22e-9, 1.35e-9), drive, jnp.asarray(time)))
    noisy = vsc + 0.05 * np.random.default_rng(1).standard_normal(SAMPLES)
    record = fitact.Record.from_arrays(time, V=np.asarray(drive.value(jnp.asarray(time))), Vsc=noisy)
    pages = {}
    for name, fit in {"demo": demo, "long": fitact.fit(record, known)}.items():
        pages[name] = folder / f"{name}.html"
        fitact.sample(fit, level="laplace", seed=1, progress=False).report(pages[name])
    return pages


DRAWN = "() => document.querySelector('figure.chart .plot .main-svg') !== null"
FRAME = "new Promise((done) => requestAnimationFrame(() => setTimeout(done)))"
WAIT = f"""const done = arguments[arguments.length - 1];
document.querySelector("figure.chart").scrollIntoView();
(async () => {{ while (!({DRAWN})()) await {FRAME}; await {FRAME}; done(); }})();"""
PRESS = f"""const done = arguments[arguments.length - 1];
[...document.querySelectorAll("button")].find((each) => each.textContent === "logarithmic axes").click();
(async () => {{ await {FRAME}; done(); }})();"""
SHOW = """const done = arguments[arguments.length - 1], figure = document.querySelectorAll("figure.chart")[1];
figure.scrollIntoView();
const look = () => figure.querySelectorAll(".main-svg").length ? setTimeout(done, 1000) : setTimeout(look, 20);
look();"""


def measure_pages() -> tuple[dict[str, float], dict[str, int]]:
    """Return median seconds, and bytes of each page."""
    with open_chromium() as driver, tempfile.TemporaryDirectory() as folder:
        pages = write_pages(Path(folder))

        def open_page(name: str) -> None:
            driver.get(pages[name].as_uri())
            driver.execute_async_script(WAIT)

        times = medians({f"{name} opened": lambda name=name: open_page(name) for name in pages}, ROUNDS)
        for name in pages:
            open_page(name)
            driver.execute_async_script(SHOW)
            times |= medians({f"{name} answered": lambda: driver.execute_async_script(PRESS)}, ROUNDS)
        return times, {name: page.stat().st_size for name, page in pages.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    as_json = parser.parse_args().json
    times, sizes = measure_pages()
    if not as_json:
        for name, value in times.items():
            print(f"{name:16}{value:8.2f} s")
        for name, size in sizes.items():
            print(f"{name:16}{size / 1e6:8.2f} MB")
    show(
        {
            "long_vs_demo_opened": times["long opened"] / times["demo opened"],
            "demo_opened_vs_2_s": times["demo opened"] / 2.0,
            "demo_answered_vs_100_ms": times["demo answered"] / 0.1,
            "long_size_vs_5_MB": sizes["long"] / 5e6,
        },
        as_json,
    )


if __name__ == "__main__":
    main()
