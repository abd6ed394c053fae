"""Populations of data_synth: effects of each level against a nested analysis of variance, names, the shipped study."""

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fitact
from data_synth import make, population, recipe
from tests.data_synth.test_data_synth_records import RECORDS, read, run, table, written

SIGMAS = 4.0
COUNTS = {"people": 150, "fingers_per_person": 3, "sessions": 3, "repetitions": 3}
SHAPE = tuple(COUNTS.values())
NAMES = ("Rsc", "Csc", "area")
SDS = {  # of NAMES, by level
    "": (0.35, 0.3, 0.15),
    "_finger": (0.2, 0.25, 0.1),
    "_session": (0.1, 0.15, 0.12),
    "_repetition": (0.06, 0.05, 0.08),
}
CORRELATION = -0.4
LAW = {f"log_sd_{n}{level}": sd for level, sds in SDS.items() for n, sd in zip(NAMES, sds, strict=True)}


def draw(folder: Path, seed: int = 0, **law: float) -> list[population.Touch]:
    lines = [f"seed = {seed}", "[population]", *(f"{key} = {value}" for key, value in law.items())]
    return population.draw_touches(written(folder, "\n".join(lines)))


def logs_of(touches: list[population.Touch]) -> np.ndarray:
    """Return the logarithms of Rsc and Csc at the median area, and of the area, over their medians, (touches, 3)."""
    scenes = [touch.scene for touch in touches]
    values = [(each["skin"]["Rsc"], each["skin"]["Csc"], each["device"]["Ci"]) for each in scenes]
    Rsc, Csc, area = np.log(values).T - np.log([[160e3], [22e-9], [1.35e-9]])
    return np.column_stack([Rsc + area, Csc - area, area])


def test_every_level_has_its_variance(tmp_path: Path):
    """Mean products of a balanced nested analysis of variance against their expectations, with their standard errors.

    A level's mean product is that of the means of its units about the mean of the unit above, times the touches in a
    unit. Its expectation is the sum over this level and those below of covariance times touches in a unit.
    """
    values = logs_of(draw(tmp_path, **COUNTS, **LAW, correlation=CORRELATION)).reshape(*SHAPE, 3)
    stated = [np.diag(np.square(sds)) for sds in SDS.values()]
    stated[0][0, 1] = stated[0][1, 0] = CORRELATION * SDS[""][0] * SDS[""][1]
    touches = [math.prod(SHAPE[level + 1 :]) for level in range(4)]
    for level in range(4):
        means = values.mean(axis=tuple(range(level + 1, 4)))
        off = (means - means.mean(axis=level, keepdims=True)).reshape(-1, 3)
        freedom = math.prod(SHAPE[:level]) * (SHAPE[level] - 1)
        found = touches[level] * off.T @ off / freedom
        wanted = sum(touches[k] * stated[k] for k in range(level, 4))
        error = np.sqrt((np.outer(np.diag(wanted), np.diag(wanted)) + wanted**2) / freedom)
        assert np.all(np.abs(found - wanted) < SIGMAS * error), level


def test_effects_belong_to_their_units(tmp_path: Path):
    """Touches of a unit share its effect, and more people leave the first ones as they are."""
    law = {"sessions": 3, "repetitions": 2, "log_sd_Rsc": 0.3, "log_sd_area_session": 0.2}
    few, more = (logs_of(draw(tmp_path, people=n, **law)) for n in (4, 5))
    np.testing.assert_array_equal(few, more[: len(few)])
    Rsc, Csc, area = few.reshape(4, 3, 2, 3).transpose(3, 0, 1, 2)
    assert np.ptp(Rsc, axis=(1, 2)).max() < 1e-12
    assert len(np.unique(Rsc[:, 0, 0])) == 4
    assert np.abs(Csc).max() < 1e-12
    np.testing.assert_array_equal(area[..., 0], area[..., 1])
    assert len(np.unique(area)) == 12


@pytest.mark.parametrize("key", ["fingers", "people"])
def test_fingers_are_drawn_as_before(key: str, tmp_path: Path):
    """Three normal numbers for each finger, to the last digit; people who are touched once are drawn the same way."""
    law = {"log_sd_Rsc": 0.3, "log_sd_Csc": 0.5, "correlation": -0.6, "log_sd_area": 0.2}
    found = draw(tmp_path, seed=4, **{key: 5}, **law)
    assert [each.name for each in found] == [f"finger{n:02}" if key == "fingers" else f"P{n + 1}" for n in range(5)]
    for n, touch in enumerate(found):
        x, y, z = np.random.default_rng([4, n, 0, 0]).standard_normal(3)
        area = math.exp(0.2 * z)
        assert touch.scene["skin"]["Rsc"] == 160e3 * math.exp(0.3 * x) / area
        Csc = 22e-9 * area
        assert touch.scene["skin"]["Csc"] == Csc * math.exp(0.5 * (-0.6 * x + math.sqrt(1.0 - 0.6**2) * y))
        assert touch.scene["device"]["Ci"] == 1.35e-9 * area


@pytest.mark.parametrize(
    ("counts", "names", "last"),
    [
        ((1, 1, 1, 1), ["P1"], {"person": "P1"}),
        ((2, 1, 1, 2), ["P1_r1", "P1_r2", "P2_r1", "P2_r2"], {"person": "P2", "repetition": "2"}),
        ((1, 2, 2, 1), ["P1_F1_S1", "P1_F1_S2", "P1_F2_S1", "P1_F2_S2"], {"finger": "F2", "session": "S2"}),
        ((11, 2, 2, 2), ["P1_F1_S1_r1"], {"person": "P11", "finger": "F2", "session": "S2", "repetition": "2"}),
    ],
)
def test_names_have_the_levels_of_several_units(
    counts: tuple[int, ...], names: list[str], last: dict[str, str], tmp_path: Path
):
    found = draw(tmp_path, **dict(zip(COUNTS, counts, strict=True)))
    assert [touch.name for touch in found][: len(names)] == names
    assert len(found) == math.prod(counts)
    assert found[-1].labels == {"person": f"P{counts[0]}"} | last


def test_a_touch_has_noise_of_its_own(tmp_path: Path):
    """Without effects, two touches differ by their noise of Vsc, 0.1 V, and by nothing else."""
    first, second = make.make(written(tmp_path, "[population]\npeople = 1\nrepetitions = 2")).values()
    assert first.truth["truth"] == second.truth["truth"]
    np.testing.assert_array_equal(first.channels["V"], second.channels["V"])
    apart = second.channels["Vsc"] - first.channels["Vsc"]
    assert np.std(apart) == pytest.approx(0.1 * math.sqrt(2.0), rel=SIGMAS / math.sqrt(2.0 * apart.size))


def test_a_study_has_a_table_and_a_list_of_true_values(tmp_path: Path):
    written(tmp_path, "[population]\npeople = 2\nrepetitions = 2\nlog_sd_Rsc_repetition = 0.1\nlog_sd_area = 0.1")
    done = run("make", str(tmp_path / "some.recipe.toml"), "--format", "npz", "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "out" / "some"
    names = ["P1_r1", "P1_r2", "P2_r1", "P2_r2"]
    files = [*(f"{name}.{end}" for name in names for end in ("json", "npz")), "study.csv", "truth.json"]
    assert sorted(path.name for path in folder.iterdir()) == files
    rows = rows_of(folder / "study.csv")
    assert rows == [{"record": f"{name}.npz", "person": name[:2], "repetition": name[-1]} for name in names]
    check_list(folder)
    assert len({each["Rsc"] for each in read(folder / "truth.json")}) == 4
    assert len({each["Ci"] for each in read(folder / "truth.json")}) == 2


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def check_list(folder: Path) -> None:
    """Check that study.csv and truth.json repeat what the records' own files state."""
    rows, values = rows_of(folder / "study.csv"), read(folder / "truth.json")
    assert len(rows) > 0
    for row, entry in zip(rows, values, strict=True):
        own: dict[str, Any] = read(folder / f"{entry['name']}.json")
        assert row == {key: own[key] for key in row}
        labels = {key: label for key, label in row.items() if key != "record"}
        true = {name: each["value"] for name, each in own["truth"].items()}
        assert entry == {"name": entry["name"], **labels, **true}


@pytest.mark.parametrize("name", ["areas", "study"])
def test_the_shipped_populations_can_be_made_again(name: str):
    """True values agree to the last digit, and records to seven digits, since machines differ in the last ones."""
    found = make.make(recipe.load(RECORDS / f"{name}.recipe.toml"))
    assert sorted(found) == sorted(path.stem for path in (RECORDS / name).glob("*[0-9].json"))
    for record, made in found.items():
        kept = read(RECORDS / name / f"{record}.json")
        for key in (*made.labels, "truth", "drive"):
            assert kept[key] == made.truth[key]
        assert kept["recipe"].keys() == made.truth["recipe"].keys()
        assert kept["recipe"]["population"] == made.truth["recipe"]["population"]
        columns = [made.time, *made.channels.values()]
        for before, now in zip(table(RECORDS / name / kept["record"]).T, columns, strict=True):
            np.testing.assert_allclose(before, now, rtol=1e-7, atol=1e-7 * np.ptp(now))


def test_the_shipped_study():
    """Six people, three touches each; every channel on levels of 12 bits; below 2 MB."""
    folder = RECORDS / "study"
    check_list(folder)
    assert [row["record"] for row in rows_of(folder / "study.csv")] == [
        f"P{person}_r{touch}.csv.gz" for person in range(1, 7) for touch in range(1, 4)
    ]
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2e6
    time, *channels = table(folder / "P1_r1.csv.gz").T
    assert time.size == 4000
    for values, span in zip(channels, (409.6, 40.96, 409.6e-6), strict=True):
        levels = values / (span / 2**12)
        np.testing.assert_allclose(levels, np.round(levels), atol=1e-4)
        assert np.abs(levels).max() < 2**11 - 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["P1_r1", "P3_r2", "P5_r3"])
def test_the_shipped_study_is_fitted(name: str):
    """Rsc, Csc and Ci within three combined standard uncertainties, and no warning."""
    scene = fitact.Scene.load(RECORDS / "study.toml")
    fit = fitact.fit(fitact.read(RECORDS / "study" / f"{name}.csv.gz", scene), scene)
    assert fit.result == "successful"
    assert not fit.warnings
    truth = read(RECORDS / "study" / f"{name}.json")["truth"]
    for parameter in ("Rsc", "Csc", "Ci"):
        error = float(fit.parameters()[parameter]["q50"]) / truth[parameter]["value"] - 1.0
        assert abs(error) < 3.0 * fit.budgets[parameter].u, parameter
