"""Time until the first answer, as whole processes: `fitact fit` and `fitact run` against scripts with lmfit.

    pip install "fitact[bench]"; python benchmarks/first_answer.py [--rounds 5] [--before PYTHON] [--json]

The commands run in turn on the shipped record, and medians are compared. Cold means that no compiled program is
stored, warm that all are.

- `fit_warm`, `fit_cold`: `fitact fit` against lmfit_fit_script.py;
- `run_warm`, `run_cold`: `fitact run` against lmfit_script.py (fit, lmfit.emcee of `--steps` steps, corner plot);
- `python_cold`: `import fitact` and the first `fitact.fit` against the same by `--before`, the Python of an environment
  with another version of fitact; left out without it;
- `population_*`, `design_*`: `fitact population` of the eight shipped fingers with V, Vsc and I, and
  `fitact design measurement`, against the same by `--before`.
"""

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

from timing import process_seconds, show

HERE = Path(__file__).resolve().parent
RECORD = HERE.parent / "data_synth" / "records" / "finger_direct.csv"
FINGERS = sorted(map(str, (RECORD.parent / "fingers").glob("*.csv.gz")))
FINGER_SCENE = """
[drive]
waveform = "measured"
[measurement]
channels = ["Vsc", "I"]
"""
FIT = "import fitact; s = fitact.Scene.load({!r}); fitact.fit(fitact.read({!r}, s), s)"


def main() -> None:
    parser = argparse.ArgumentParser(description="Time until the first answer, against scripts with lmfit.")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="rounds, of which the median is taken")
    parser.add_argument("--steps", type=int, default=5000, help="steps of lmfit.emcee")
    parser.add_argument("--before", help="Python of an environment with another version of fitact")
    given = parser.parse_args()
    scene, fitact = RECORD.with_suffix(".toml"), str(Path(sys.executable).with_name("fitact"))
    fit = [fitact, "fit", str(RECORD), "--scene", str(scene)]
    run = [fitact, "run", str(RECORD), "--scene", str(scene), "--fresh", "--out", "results"]
    python = ["-c", FIT.format(str(scene), str(RECORD))]
    lmfit_run = [sys.executable, str(HERE / "lmfit_script.py"), str(RECORD), str(given.steps), "corner.png"]
    commands = {
        "lmfit fit": [sys.executable, str(HERE / "lmfit_fit_script.py"), str(RECORD)],
        "fit_warm": fit,
        "fit_cold": fit,
        "lmfit run": lmfit_run,
        "run_warm": run,
        "run_cold": run,
        "python": [sys.executable, *python],
    }
    longer = {
        "population": ["population", *FINGERS, "--scene", "fingers.toml", "--fresh", "--out", "people", "--seed", "1"],
        "design": ["design", "measurement", str(scene), "--record", str(RECORD), "--out", "next"],
    }
    if given.before:
        before = str(Path(given.before).with_name("fitact"))
        commands["python before"] = [given.before, *python]
        for name, arguments in longer.items():
            for state in ("warm", "cold"):
                commands |= {f"{name}_{state}": [fitact, *arguments], f"{name}_before_{state}": [before, *arguments]}
    taken: dict[str, list[float]] = {name: [] for name in commands}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "fingers.toml").write_text(FINGER_SCENE)
        for key, command in commands.items():  # fills the warm cache
            if key.endswith("warm"):
                process_seconds(command, folder, folder / "warm")
        for number in range(given.rounds):
            for key, command in commands.items():
                cache = folder / ("warm" if key.endswith("warm") else f"cold {number} {key}")
                taken[key].append(process_seconds(command, folder, cache))
    median = {key: statistics.median(each) for key, each in taken.items()}
    print(", ".join(f"{key} {value:.2f} s" for key, value in median.items()), file=sys.stderr)
    ratios = {key: median[key] / median[f"lmfit {key[:3]}"] for key in ("fit_warm", "fit_cold", "run_warm", "run_cold")}
    if given.before:
        ratios["python_cold"] = median["python"] / median["python before"]
        for name in longer:
            for state in ("warm", "cold"):
                ratios[f"{name}_{state}"] = median[f"{name}_{state}"] / median[f"{name}_before_{state}"]
    show(ratios, given.json)


if __name__ == "__main__":
    main()
