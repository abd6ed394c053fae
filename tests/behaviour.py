"""Record the results that users get from every command, and compare two such recordings.

    python -m tests.behaviour record OUT.json [--only PART] [--quick]
    python -m tests.behaviour compare BEFORE.json AFTER.json [--estimates]
    python -m tests.behaviour store

`record` runs the commands on the shipped records, scenes and spectra, and on files that are refused. `compare` lists
the differences: numbers that differ by more than 1e-9 relative. With --estimates, the limits are 1e-4 standard errors
for estimates (the tolerance of the solver) and a factor of 2 for the solver's steps. `store` records the quick part
again, with which the tests compare.
"""

import argparse
import contextlib
import io
import json
import math
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
RECORDS = ROOT / "data_synth" / "records"
STORED = Path(__file__).parent / "data" / "behaviour.json"
SCENES = ("burst", "fast-edge", "gabriel-dry", "gabriel-wet", "multitone", "natural-ground", "paper", "phone")
PLAIN = ("clean", "clipped", "eight_bit", "hum", "late_trigger", "low_snr", "nonlinear", "two_layers")
OWN_SCENE = ("burst", "chirp", "fractional", "natural_ground")
FINGERS = [f"records/fingers/finger0{i}.csv.gz" for i in range(8)]
FINGER = ["records/finger_direct.csv", "--scene", "records/finger_direct.toml"]
# values that depend on the machine, the time or the version
PASSING = re.compile(r"version|seconds|speedup|(^|[._])time(_s)?$|host|date|created|rate_per|per_second|cost", re.I)
ROUNDING = re.compile(
    r"compression_error|eigenvalues|rms_compression"
)  # rounding errors, compared by order of magnitude
# precision of a model error, which is partly computed in single precision, in an order that processors decide
SINGLE = 4.0 * float(np.finfo(np.float32).eps)


def cases() -> Iterator[tuple[str, list[str]]]:
    """Return the name and arguments of every command; the first word of the name is its part."""
    for name in PLAIN:
        record = f"records/{name}.csv.gz"
        yield f"inspect {name}", ["inspect", record]
        yield f"fit {name}", ["fit", record]
    for name in OWN_SCENE:
        record = [f"records/{name}.csv.gz", "--scene", f"records/{name}.toml"]
        yield f"inspect {name}", ["inspect", record[0]]
        yield f"fit {name}", ["fit", *record]
        yield f"run {name}", ["run", *record, "--seed", "1", "--out", "out"]
    for i, record in enumerate(FINGERS):
        yield f"fit finger {i}", ["fit", record, "--scene", "records/finger_direct.toml"]
    yield "fit full model", ["fit", *FINGER, "--model", "full"]
    yield "fit starts", ["fit", *FINGER, "--starts", "4"]
    yield "fit summed", ["fit", *FINGER, "--tolerance", "0"]
    yield "fit intervals", ["fit", *FINGER, "--intervals"]
    yield "fit jointly", ["fit", *FINGERS[:2], "--scene", "records/finger_direct.toml"]
    for method in ("emcee", "psis", "laplace"):
        yield f"run {method}", ["run", *FINGER, "--seed", "1", "--level", method, "--out", "out"]
    yield "run clipped", ["run", "records/clipped.csv.gz", "--seed", "2", "--out", "out"]
    yield "run without a scene", ["run", FINGER[0], "--seed", "3", "--out", "out"]
    for scene in SCENES:
        yield f"plan {scene}", ["plan", scene]
        yield f"prior {scene}", ["prior", scene, "--seed", "1"]
        yield f"simulate {scene}", ["simulate", scene, "--seed", "1", "--out", "simulated.csv"]
    yield "plan record", ["plan", FINGER[2], "--record", FINGER[0]]
    yield "compare edges", ["compare", FINGER[0], "--scene", FINGER[2], "--scene", "records/trapezoid.toml"]
    for scene in ("paper", "natural-ground", "records/areas.toml"):
        yield f"design measurement {scene}", ["design", "measurement", scene]
    yield "design measurement record", ["design", "measurement", FINGER[2], "--record", FINGER[0]]
    yield "design drive prior", ["design", "drive", "felt.toml", "--seed", "1"]
    yield "design drive fingers", ["design", "drive", "felt.toml", *FINGERS[:4], "--seed", "1"]
    yield "population common", ["population", *FINGERS, "--scene", FINGER[2], "--seed", "1", "--out", "out"]
    yield "population areas", ["population", *FINGERS[:4], "--scene", "records/areas.toml", "--seed", "1"]
    yield "campaign", ["campaign", *FINGERS, FINGER[0], "refused.csv", "--scene", FINGER[2], "--out", "out"]
    yield "campaign posteriors", ["campaign", *FINGERS[:3], "--posteriors", "--seed", "1", "--out", "out"]
    yield "reproduce", ["reproduce", "--out", "out"]
    for kind in ("final", "fractional"):
        yield f"fit spectrum {kind}", ["fit", f"{kind}.csv"]
        yield f"inspect spectrum {kind}", ["inspect", f"{kind}.csv"]
    yield "fit spectrum with its skin", ["fit", "fractional.csv", "--scene", "fractional.toml"]
    for scene in ("unknown key", "unknown section", "wrong unit", "wrong type", "bad waveform", "no such file"):
        yield f"refused scene: {scene}", ["plan", f"scenes/{scene}.toml"]
    for kind in _kinds():
        yield f"refused record: {kind}", ["fit", f"bad/{kind}", *_options(kind)]


def _kinds() -> dict[str, tuple]:
    from tests.data.test_bad_input import KINDS

    return KINDS


def _options(kind: str) -> list[str]:
    asked = dict(_kinds()[kind][3]) if len(_kinds()[kind]) > 3 else {}
    options = ["--scene", "stated.toml"] if "scene" in asked else []
    for option, name in (("--channel", "channels"), ("--scale", "scale")):
        for key, value in asked.get(name, {}).items():
            options += [option, f"{key}={value}"]
    return options


def stored_names() -> set[str]:
    """Return the commands that are quick enough for `make test`: one fit, and input that is refused before any fit."""
    return set(json.loads(STORED.read_text(encoding="utf-8")))


def prepare(folder: Path) -> None:
    """Write the input files of the commands, with the same names everywhere."""
    from tests.data.test_bad_input import text_of

    os.chdir(folder)
    Path("records").symlink_to(RECORDS)
    felt = '[perception]\nthreshold_force = "0.1 mN"\n'
    Path("felt.toml").write_text((RECORDS / "finger_direct.toml").read_text() + felt)
    Path("fractional.toml").write_text('[skin]\nlevel = "fractional"\n')
    Path("stated.toml").write_text('[drive]\nwaveform = "square"\npeak_to_peak = "360 V"\nfrequency = "100 Hz"\n')
    Path("refused.csv").write_text("time_s,V_V,Vsc_V\n0,1,x\n")
    Path("scenes").mkdir()
    for name, text in {
        "unknown key": '[skin]\nRcs = "1 kohm"\n',
        "unknown section": "[skinn]\n",
        "wrong unit": '[skin]\nRsc = "22 nF"\n',
        "wrong type": "[device]\nCi = [1, 2]\n",
        "bad waveform": '[drive]\nwaveform = "sawtooth"\n',
    }.items():
        Path("scenes", f"{name}.toml").write_text(text)
    frequency = np.geomspace(1.0, 1e6, 61)
    for name, alpha in (("final", 1.0), ("fractional", 0.85)):
        s = 2j * np.pi * frequency
        z = 2.0 / (1.0 / 160e3 + 22e-9 * s**alpha) + 1.0 / (1.35e-9 * s)
        z *= 1.0 + 1e-3 * (np.random.default_rng(0).standard_normal((frequency.size, 2)) @ [1.0, 1.0j])
        rows = [f"{f:.9g},{x.real:.9g},{x.imag:.9g}" for f, x in zip(frequency, z, strict=True)]
        Path(f"{name}.csv").write_text("\n".join(["f_Hz,Re(Z)/ohm,Im(Z)/ohm", *rows, ""]))
    Path("bad").mkdir()
    table = _table()
    for kind, (_, make, *_) in _kinds().items():
        path = Path("bad", kind)
        if kind == "directory":
            path.mkdir()
        elif kind != "missing file":
            content = make(table) if make else text_of(table)
            path.write_bytes(content if isinstance(content, bytes) else content.encode())


def _table() -> dict[str, np.ndarray]:
    """Return the valid record that test_bad_input damages, from the closed-form steady response to a square."""
    periods, per_period = 20, 200
    time = np.arange(periods * per_period) * (0.01 / per_period)
    a, b = 130e3 * 1.35e-9, 130e3 * (2.0 * 1.35e-9 + 18e-9)
    first = np.arange(time.size) % per_period < per_period // 2
    since = (np.arange(time.size) % (per_period // 2)) * (0.01 / per_period)
    wave = np.where(first, 180.0, -180.0)
    decay = np.exp(-since / b)
    vsc = 2.0 * a / b * wave * decay / (1.0 + math.exp(-0.005 / b))
    rng = np.random.default_rng(5)
    return {
        "time_s": time,
        "V_V": wave + rng.normal(scale=0.3, size=time.size),
        "Vsc_V": vsc + 0.05 * rng.standard_normal(time.size),
    }


def run(arguments: list[str]) -> dict[str, Any]:
    """Run one command in this process; return its exit status, its JSON, its sentences and the numbers in its files."""
    import fitact.cli

    shutil.rmtree("out", ignore_errors=True)
    out, err = io.StringIO(), io.StringIO()
    sys.argv = ["fitact", *arguments, "--json"]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            fitact.cli.main()
        except SystemExit as end:
            code = end.code
    text = out.getvalue()
    said = [line for line in err.getvalue().splitlines() if not re.search(r"\r|\x1b|it/s| s$|: \d+%$", line)]
    content = json.loads(text) if text.strip() else None
    if isinstance(content, dict):  # long, and in an order that rounding may change; other tests look at them
        content = {key: value for key, value in content.items() if key not in ("budget", "blind_table", "rivals")}
    result = {"code": code, "json": content, "said": said}
    if "simulated.csv" in arguments:
        result["columns"] = _columns(np.genfromtxt("simulated.csv", delimiter=",", names=True))
    table = Path("out", "results.parquet")
    if table.exists():
        import pyarrow.parquet

        result["rows"] = sorted(pyarrow.parquet.read_table(table).to_pylist(), key=lambda row: str(row["record"]))
        result["failures"] = sorted(Path("out", "failures.csv").read_text().splitlines())
    return result


def _columns(table: np.ndarray) -> dict[str, list[float]]:
    """Return the first and last value, mean and standard deviation of every column."""
    return {n: [*table[n][[0, -1]].tolist(), float(table[n].mean()), float(table[n].std())] for n in table.dtype.names}


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every leaf of nested objects and lists with its path."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flatten(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from flatten(inner, f"{path}[{i}]")
    else:
        yield path, value


def differences(before: Any, after: Any, estimates: bool = False) -> list[str]:
    """List the differences between two recordings of one command, one per line."""
    old, new = (dict(flatten(x)) for x in (before, after))
    out = [f"{path}: gone" for path in old.keys() - new.keys()] + [f"{path}: new" for path in new.keys() - old.keys()]
    for path in sorted(old.keys() & new.keys()):
        a, b = old[path], new[path]
        if a != b and not PASSING.search(path) and not _is_close(path, a, b, old, estimates):
            out.append(f"{path}: {a!r} -> {b!r}")
    return out


def _is_close(path: str, a: Any, b: Any, old: dict[str, Any], estimates: bool) -> bool:
    if isinstance(a, str) and isinstance(b, str):
        numbers = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
        if re.sub(numbers, "#", a) != re.sub(numbers, "#", b):
            return False
        pairs = zip(re.findall(numbers, a), re.findall(numbers, b), strict=True)
        return all(_is_close(path, float(x), float(y), old, estimates) for x, y in pairs)
    if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in (a, b)):
        return False
    if (math.isnan(a) and math.isnan(b)) or abs(a - b) <= 1e-9 * max(abs(a), abs(b)):
        return True
    if ROUNDING.search(path) or max(abs(a), abs(b)) < 1e-9:
        return max(abs(a), abs(b)) < 1e-3 and min(abs(a), abs(b)) < 1e-3
    if re.search(r"\.error_\w+$", path) and abs(a - b) <= SINGLE:
        return True
    if not estimates:
        return False
    if path.endswith("_p") and abs(a - b) <= 1e-5 * max(a, b):  # of residuals in single precision
        return True
    if path.endswith(".steps"):
        return max(a, b) <= 3 * min(a, b)  # where steps end in rounding, versions of XLA differ
    if re.search(r"\bcorrelation\b", path):
        return abs(a - b) <= 1e-6
    # a standard uncertainty u, relative to its estimate, follows the estimate
    sd = a * a if path.endswith(".u") else old.get(re.sub(r"\.\w+$", ".sd", path))
    return abs(a - b) <= max(1e-4 * abs(sd) if isinstance(sd, float) else 0.0, 1e-6 * max(abs(a), abs(b)))


def record(only: str = "", quick: bool = False) -> dict[str, Any]:
    """Run the commands in a separate folder."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        try:
            prepare(Path(folder))
            results = {}
            for name, arguments in cases():
                if re.match(only, name) and (not quick or name in stored_names()):
                    print(name, file=sys.stderr, flush=True)
                    results[name] = run(arguments)
            return results
        finally:
            os.chdir(here)


def main() -> int:
    """Record or compare; the exit status is 1 if commands differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("record", "compare", "store"))
    parser.add_argument("files", nargs="*")
    parser.add_argument("--only", default="", help="a regular expression that the names of commands begin with")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--estimates", action="store_true")
    asked = parser.parse_args()
    if asked.what == "record":
        target = Path(asked.files[0]).absolute()
        target.write_text(json.dumps(record(asked.only, asked.quick), indent=None, sort_keys=True))
        return 0
    if asked.what == "store":
        STORED.write_text(json.dumps(record(quick=True), sort_keys=True, indent=1) + "\n")
        return 0
    before, after = (json.loads(Path(f).read_text()) for f in asked.files)
    failed = 0
    for name in sorted(before.keys() & after.keys() if asked.only else before.keys() | after.keys()):
        lines = differences(before.get(name), after.get(name), asked.estimates)
        failed += bool(lines)
        print("\n".join([f"== {name}: {len(lines)} differ", *lines[:8]]) if lines else f"   {name}")
    return min(failed, 1)


if __name__ == "__main__":
    raise SystemExit(main())
