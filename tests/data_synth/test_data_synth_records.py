"""Records of data_synth: imperfections and their statistics, recipes, files, command line, fits of shipped records."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
import scipy.stats

import fitact
from data_synth import files, imperfections, keys, make, population, recipe
from data_synth.errors import RecipeError

RECORDS = Path(__file__).parents[2] / "data_synth" / "records"


def even(count: int = 2000, step: float = 1e-5) -> np.ndarray:
    return np.arange(count) * step


# ------------------------------------------------------------------ imperfections

LONG = even(40_000)


def spoilt(
    channel: str = "Vsc", values: np.ndarray | float = 0.0, seed: int = 1, **parts: dict[str, Any]
) -> np.ndarray:
    whole = keys.validate_sections(parts, recipe.KEYS, "test")
    whole["white"] = {name: value or 0.0 for name, value in whole["white"].items()}
    return imperfections.add_imperfections(np.zeros(LONG.size) + values, channel, LONG, whole, seed, 0)


def test_white_noise():
    """The sd agrees to four standard errors, and samples are uncorrelated."""
    noise = spoilt(white={"Vsc": "50 mV"})
    assert np.std(noise) == pytest.approx(0.05, rel=4.0 / np.sqrt(2.0 * LONG.size))
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 4.0 / np.sqrt(LONG.size)
    assert scipy.stats.kstest(noise / 0.05, "norm").pvalue > 1e-4


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_pink_noise(exponent: float):
    """Slope of Welch's periodogram between the corner and the highest frequencies, and the mean of the variance."""
    law = {"Vsc": 0.2, "exponent": exponent, "corner": 200.0}
    drawn = np.array([spoilt(seed=seed, pink=law) for seed in range(8)])
    frequency, power = scipy.signal.welch(drawn, 1e5, nperseg=4000)
    power = power.mean(axis=0)
    above = (frequency > 500.0) & (frequency < 2e4)
    slope = np.polyfit(np.log(frequency[above]), np.log(power[above]), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.05)
    flat = (frequency > 30.0) & (frequency < 150.0)
    assert np.ptp(np.log(power[flat])) < 0.7  # five points of 8 x 19 windows, with an sd of 0.1 each
    assert np.mean(np.square(drawn)) == pytest.approx(0.04, rel=0.1)


def test_hum_has_the_amplitudes_that_are_asked_for():
    """50 Hz and its third harmonic over whole periods of both."""
    values = spoilt(hum={"Vsc": 2.0, "harmonics": [1.0, 0.0, 0.25]})
    lines = 2.0 * np.abs(np.fft.rfft(values)) / LONG.size
    np.testing.assert_allclose(lines[[20, 40, 60]], [2.0, 0.0, 0.5], atol=1e-9)
    assert np.sum(lines > 1e-9) == 2


def test_gain_offset_drift_and_clipping():
    wave = 5.0 * np.sin(600.0 * LONG)
    bent = spoilt(values=wave, gain={"Vsc": 1.1}, offset={"Vsc": -0.5}, drift={"Vsc": 2.0})
    np.testing.assert_allclose(bent, 1.1 * wave - 0.5 + np.linspace(0.0, 2.0, LONG.size), atol=1e-12)
    np.testing.assert_array_equal(spoilt(values=wave, clip={"Vsc": 4.0}), np.minimum(np.maximum(wave, -4.0), 4.0))
    np.testing.assert_array_equal(spoilt("V", wave, clip={"Vsc": 4.0}), wave)


def test_a_converter():
    """Levels one step apart, errors uniform over a step, and saturation at both ends, the lower one a step further."""
    wave, step = np.linspace(-25.0, 25.0, LONG.size), 40.0 / 2**8
    read = spoilt(values=wave, converter={"bits": 8, "Vsc": "40 V"})
    np.testing.assert_array_equal(read / step, np.round(read / step))
    assert (read.min(), read.max()) == (-20.0, 20.0 - step)
    error = (read - wave)[np.abs(wave) < 19.0]
    assert np.abs(error).max() <= 0.5 * step * (1.0 + 1e-9)
    assert np.std(error) == pytest.approx(step / np.sqrt(12.0), rel=1e-2)


def test_jitter_and_a_late_trigger():
    taken = imperfections.sampling_times(LONG, {"jitter": 2e-7, "trigger_error": 3e-5}, 1, 0)
    assert np.mean(taken - LONG) == pytest.approx(3e-5, abs=4.0 * 2e-7 / np.sqrt(LONG.size))
    assert np.std(taken - LONG) == pytest.approx(2e-7, rel=4.0 / np.sqrt(2.0 * LONG.size))


def test_lost_samples_take_their_times_along(tmp_path: Path):
    made = only(make.make(written(tmp_path, "[missing]\nshare = 0.2")))
    whole = only(make.make(written(tmp_path, "")))
    assert 0.75 < made.time.size / whole.time.size < 0.85
    there = np.isin(whole.time, made.time)
    for name in ("V", "Vsc"):
        np.testing.assert_array_equal(made.channels[name], whole.channels[name][there])


# ------------------------------------------------------------------ recipes


TRIANGLE = '[drive]\nwaveform = "triangle"\n[measurement]\nsampling_rate = "20 kHz"\n'


def written(folder: Path, text: str, tables: str = TRIANGLE) -> recipe.Recipe:
    (folder / "scene.toml").write_text(tables)
    named = text if text.startswith("scene") else f'scene = "scene.toml"\n{text}'
    (folder / "some.recipe.toml").write_text(named)
    return recipe.load(folder / "some.recipe.toml")


def only(made: dict[str, make.Synthetic]) -> make.Synthetic:
    (found,) = made.values()
    return found


def test_noise_depends_on_the_seed_and_on_no_other_noise(tmp_path: Path):
    """The difference between two records that differ only in hum is the hum, whatever the other random parts are."""
    noise = '[white]\nVsc = "1 V"\n[pink]\nVsc = "1 V"\n[clock]\njitter = "1 us"\n'
    plain, again, humming, other = (
        only(make.make(written(tmp_path, text))).channels["Vsc"]
        for text in (noise, noise, noise + "[hum]\nVsc = 3.0", "seed = 5\n" + noise)
    )
    np.testing.assert_array_equal(plain, again)
    lines = 2.0 * np.abs(np.fft.rfft(humming - plain)) / plain.size
    assert lines[1] == pytest.approx(3.0, rel=1e-9)
    assert np.sort(lines)[-2] < 1e-9
    assert np.std(other - plain) > 1.0


def test_kinds_channels_and_fingers_have_random_numbers_of_their_own():
    """The correlation of any two streams is below five standard errors; chance exceeds it once in a million pairs."""
    streams = [
        imperfections.generator(1, finger, kind, channel).standard_normal(2000)
        for kind in ("population", "clock", "hum", "pink", "white", "missing", "finger", "session", "repetition")
        for channel in ("V", "Vsc", "I")
        for finger in range(3)
    ]
    together = np.corrcoef(streams) - np.eye(len(streams))
    assert np.abs(together).max() < 5.0 / np.sqrt(2000)


def test_what_is_true_goes_before_what_the_scene_says(tmp_path: Path):
    text = '[truth.skin]\nRsc = "90 kohm"\n[truth.drive]\nwaveform = "square"\nduty = 0.25'
    made = only(make.make(written(tmp_path, text)))
    assert made.truth["truth"]["Rsc"] == {"value": 90e3, "unit": "ohm"}
    assert made.truth["drive"] == {"waveform": "square", "duty": 0.25}
    assert np.mean(made.channels["V"]) == pytest.approx(-90.0)


def test_people_follow_their_law(tmp_path: Path):
    """Logarithms are normal with the stated sds and correlation; the contact area leaves R C and the divider alone."""
    law = "[population]\nfingers = 4000\nlog_sd_Rsc = 0.3\nlog_sd_Csc = 0.5\ncorrelation = -0.6\n"
    found = {}
    for area in (0.0, 0.2):
        scenes = [each.scene for each in population.draw_touches(written(tmp_path, f"{law}log_sd_area = {area}"))]
        skin = [(each["skin"]["Rsc"], each["skin"]["Csc"], each["device"]["Ci"]) for each in scenes]
        found[area] = np.log(skin).T
    logs = found[0.0][:2]
    error = 4.0 / np.sqrt(2.0 * 4000)
    np.testing.assert_allclose(np.std(logs, axis=1), [0.3, 0.5], rtol=error)
    np.testing.assert_allclose(np.mean(logs, axis=1), np.log([160e3, 22e-9]), atol=4.0 * 0.5 / np.sqrt(4000))
    assert np.corrcoef(logs)[0, 1] == pytest.approx(-0.6, abs=4.0 * (1.0 - 0.36) / np.sqrt(4000))
    area = found[0.2] - found[0.0]
    assert np.std(area[2]) == pytest.approx(0.2, rel=error)
    np.testing.assert_allclose(area, [-area[2], area[2], area[2]], atol=1e-12)


BAD = {
    "unknown key of the scene": (
        "",
        "[drive]\nfrequncy = 3",
        "[drive] frequncy is not a key; did you mean",
    ),
    "unknown section": ("[noise]\nVsc = 1", "", "[noise] is not a section"),
    "unknown truth": ("[truth.skin]\nRcs = 3", "", "[skin] Rcs is not a key; did you mean 'Rsc'"),
    "no truth": ("truth = 3", "", "truth is not a table"),
    "no scene": ('scene = "other.toml"', "", "other.toml: cannot be read"),
    "unknown key": ("[white]\nVcs = 1", "", "[white] Vcs is not a key; did you mean 'Vsc'"),
    "another dimension": ('[white]\nVsc = "3 ohm"', "", "is not a number with the unit V"),
    "negative": ("[white]\nVsc = -1", "", "must be at least 0"),
    "no resistance": ("[truth.skin]\nRsc = 0", "", "must be above 0"),
    "no words": ('[skin]\nmodel = "thick"', "", "is not a choice"),
    "half a model": ('[skin]\nmodel = "two layers"\nRsc_2 = 3', "", "needs Csc_2"),
    "a key of another model": ('[skin]\nmodel = "nonlinear"\nhalf_voltage = 3\nRsc_2 = 3', "", "does not have Rsc_2"),
    "no route": ('route = "spice"', "", "is not a choice"),
    "half a seed": ("seed = 1.5", "", "whole number"),
    "natural ground without Z": ("", '[grounding]\nconnection = "natural"', "needs Z"),
    "trapezoid without edges": ("", '[drive]\nwaveform = "trapezoid"', "needs rise_time"),
    "measured": ("", '[drive]\nwaveform = "measured"', "[truth.drive]"),
    "current of an ideal square": ("", '[measurement]\nchannels = ["I"]', "impulse"),
    "no samples": ("", '[measurement]\nduration = "1 ns"', "0 samples"),
    "people and fingers": ("[population]\npeople = 3\nfingers = 2", "", "[population] has people and fingers; write"),
    "nobody": ("[population]\nlog_sd_Rsc = 0.3", "", "[population] has neither people nor fingers; state"),
    "levels of fingers": ("[population]\nfingers = 2\nrepetitions = 3", "", "[population] repetitions needs people"),
    "effects of fingers": (
        "[population]\nfingers = 2\nlog_sd_Csc_session = 0.1",
        "",
        "log_sd_Csc_session needs people",
    ),
    "no people": ("[population]\npeople = 0", "", "[population] people = 0; write a whole number of at least 1"),
    "negative effects": ("[population]\npeople = 2\nlog_sd_area_finger = -1", "", "must be at least 0"),
    "a level that is none": ("[population]\npeople = 2\nlog_sd_Rsc_touch = 0.1", "", "did you mean 'log_sd_Rsc"),
    "not TOML": ("[white", "", "cannot be read as TOML"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_refused(name: str, tmp_path: Path):
    text, tables, words = BAD[name]
    with pytest.raises(RecipeError) as error:
        make.make(written(tmp_path, text, tables))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------ files and command line


@pytest.mark.parametrize("end", files.FORMATS)
def test_every_format_is_read_again(end: str, tmp_path: Path):
    """Times and values agree bit for bit, except for the nine digits of a CSV."""
    made = only(make.make(written(tmp_path, "", '[measurement]\nchannels = ["Vsc", "I"]\n[drive]\nwaveform = "sine"')))
    path = tmp_path / f"record.{end}"
    files.write_record(path, made.time, made.channels)
    record = fitact.read(path)
    np.testing.assert_array_equal(record.time, made.time)
    for name, values in made.channels.items():
        np.testing.assert_allclose(record[name], values, rtol=5.1e-9 if "csv" in end else 0.0)
    assert sorted(tmp_path.iterdir()) == sorted([path, tmp_path / "scene.toml", tmp_path / "some.recipe.toml"])


def test_a_format_that_is_none(tmp_path: Path):
    with pytest.raises(RecipeError, match=r"no format.*csv\.gz"):
        files.write_record(tmp_path / "record.xls", even(), {})


RUN = """
import runpy, sys
sys.modules["fitact"] = sys.modules["jax"] = None  # importing them raises
sys.argv = ["data_synth", *sys.argv[1:]]
try:
    runpy.run_module("data_synth", run_name="__main__")
finally:
    print(*sorted(name for name in ("numpy", "scipy", "pint") if name in sys.modules))
"""


def run(*words: str) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).parents[2]
    return subprocess.run([sys.executable, "-c", RUN, *words], cwd=root, capture_output=True, text=True, timeout=300)


def test_help_loads_no_library():
    done = run("make", "--help")
    assert done.returncode == 0
    assert done.stdout.splitlines()[-1] == ""


@pytest.mark.slow
def test_the_committed_records_can_be_made_again_without_fitact(tmp_path: Path):
    """The process cannot import fitact; ngspice's times and the last digits depend on the machine."""
    done = run("committed", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    committed = sorted(path.relative_to(RECORDS) for path in RECORDS.rglob("*.json") if has_recipe(path))
    assert len(committed) > 36
    for path in committed:
        kept = read(RECORDS / path)
        if path.name == "truth.json":
            assert read(tmp_path / path) == kept
            tables = [(folder / path).with_name("study.csv").read_text() for folder in (RECORDS, tmp_path)]
            assert tables[0] == tables[1]
            continue
        if kept["origin"]["route"] == "ngspice" and shutil.which("ngspice") is None:
            assert "ngspice is not installed" in done.stderr
            continue
        made = read(tmp_path / path)
        assert made["truth"] == kept["truth"]
        tables = [table(folder / path.with_name(kept["record"])) for folder in (RECORDS, tmp_path)]
        np.testing.assert_array_equal(tables[0][:, 0], tables[1][:, 0])
        tolerance = 1e-3 if kept["origin"]["route"] == "ngspice" else 1e-7
        np.testing.assert_allclose(tables[0][:, 1:], tables[1][:, 1:], rtol=1e-7, atol=tolerance)


def has_recipe(path: Path) -> bool:
    return (RECORDS / f"{(path.parent if path.parent != RECORDS else path).stem}.recipe.toml").exists()


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def table(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_what_is_refused_ends_in_one_line(tmp_path: Path):
    bad = tmp_path / "bad.toml"
    bad.write_text("[drive]\nduty = 3\n")
    done = run("make", str(bad), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert done.stderr == f"{bad}: [drive] duty must be below 1, and [skin] alpha at most 1\n"
    assert not (tmp_path / "out").exists()


def test_a_scene_is_recorded_as_it_is_with_the_seed_and_format_asked_for(tmp_path: Path):
    """Also by ngspice, if it is requested and installed."""
    path = tmp_path / "plain.toml"
    path.write_text('[drive]\nwaveform = "triangle"\n[measurement]\nduration = "10 ms"\n')
    routes = ["scipy", "ngspice"] if shutil.which("ngspice") else ["scipy"]
    for route in routes:
        out = tmp_path / route
        assert (
            run("make", str(path), "--seed", "3", "--route", route, "--format", "npz", "--out", str(out)).returncode
            == 0
        )
        truth = read(out / "plain.json")
        assert (truth["origin"]["seed"], truth["origin"]["route"]) == (3, route)
    records = [np.load(tmp_path / route / "plain.npz")["Vsc"] for route in routes]
    np.testing.assert_allclose(records[0], records[-1], atol=1e-3)
