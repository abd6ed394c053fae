"""The table of an experiment: labels, nested levels and covariates, against counts by hand."""

import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fitact
from fitact.cli import options
from fitact.readers.study import LEVELS, covariate_level, is_study, nest_levels

NAMES = ("a.csv", "b.csv", "c.csv", "d.csv")


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes a table beside empty records."""

    def write_table(*lines: str, encoding: str = "utf-8") -> Path:
        for name in NAMES:
            (tmp_path / name).touch()
        path = tmp_path / "study.csv"
        path.write_bytes("\n".join(lines).encode(encoding))
        return path

    return write_table


def test_a_table_is_read(write: Callable[..., Path], tmp_path: Path):
    path = write(
        "record,person,Finger,repetition,age,side",
        "a.csv,P1,index,1,23,left",
        '"b.csv",P1,index,2, 23 ,right',
        "",
        "c.csv,P2,index,1,3.1e1,left",
    )
    study = fitact.Study.from_table(path)
    assert study.records == tuple(tmp_path / name for name in ("a.csv", "b.csv", "c.csv"))
    assert study.labels == {
        "person": ("P1", "P1", "P2"), "finger": ("index", "index", "index"), "repetition": ("1", "2", "1")
    }  # fmt: skip
    assert study.covariates == {"age": (23.0, 23.0, 31.0), "side": (0.0, 1.0, 0.0)}
    assert study.codes == {"side": ("left", "right")}
    assert study.source == str(path)
    assert study.columns["side"] == ("left", "right", "left")
    assert study.columns["person"] == ("P1", "P1", "P2")


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_a_spreadsheets_delimiters_and_decimal_commas(write: Callable[..., Path], delimiter: str):
    lines = ["RECORD;Person;moisture", "a.csv;P1;0,25", "b.csv;P2;1.5", ";;", ""]
    path = write(*(line.replace(";", delimiter) + "\r" for line in lines), encoding="utf-8-sig")
    study = fitact.Study.from_table(path)
    assert study.labels == {"person": ("P1", "P2")}
    assert study.covariates == {"moisture": (0.25, 1.5)}
    assert is_study(path)


def test_paths_lead_from_the_tables_folder_and_folders_are_records(tmp_path: Path):
    (tmp_path / "tables").mkdir()
    (tmp_path / "anna").mkdir()
    (tmp_path / "tables" / "ben.csv").touch()
    table = tmp_path / "tables" / "study.csv"
    table.write_text(f"record\n../anna\n{tmp_path / 'tables' / 'ben.csv'}\n")
    anna, ben = fitact.Study.from_table(table).records
    assert anna.resolve() == tmp_path / "anna"
    assert ben == tmp_path / "tables" / "ben.csv"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["person,age", "P1,23"], "study.csv: the column record is missing; write its name above"),
        ([], "study.csv: the column record is missing"),
        (["record,person"], "study.csv: holds no records; write a row for each"),
        (["record,age,age", "a.csv,1,2"], "study.csv: age occurs twice; give each name once"),
        (["record,person,Person", "a.csv,1,2"], "study.csv: person occurs twice"),
        (["record,age", "a.csv,1", "b.csv,0,5"], "study.csv, line 3: has 3 cells, and the header 2"),
        (["record,", "a.csv,", "b.csv,x"], "study.csv, line 3: x is in a column without a name; name the column"),
        (["record,age", "a.csv,1", ",2"], "study.csv, line 3: record is empty"),
        (["record", "a.csv", "", "e.csv"], "study.csv, line 4: PLACE/e.csv does not exist"),
        (["record", "a.csv", "b.csv", "./a.csv"], "line 4: ./a.csv has a row already (PLACE/study.csv, line 2)"),
        (["record,person", "a.csv,P1", "b.csv, "], "study.csv, line 3: person is empty; write a label"),
        (
            ["record,person,repetition", "a.csv,P1,2", "b.csv,P2,2", "c.csv,P1,2"],
            "study.csv, line 4: has the same person P1 and repetition 2 as PLACE/study.csv, line 2; number the rep",
        ),
        (["record,age", "a.csv,1", "b.csv,"], "study.csv, line 3: age is empty; write its value"),
        (["record,side", "a.csv,left", "b.csv,"], "study.csv, line 3: side is empty"),
        (["record,side", "a.csv,left", "b.csv,right", "c.csv,"], "study.csv, line 4: side is empty"),
        (["record,age", "a.csv,1", "b.csv,old"], "study.csv, line 3: age is old, not a number as in other rows"),
        (["record,age", "a.csv,1", "b.csv,nan"], "study.csv, line 3: age is nan; write a finite number"),
        (["record,hand", "a.csv,l", "b.csv,r", "c.csv,m"], "hand has neither numbers nor two words (l, m, r); write"),
        (["record,room", "a.csv,lab", "b.csv,lab"], "room has neither numbers nor two words (lab)"),
    ],
)
def test_tables_are_refused(write: Callable[..., Path], tmp_path: Path, lines: Sequence[str], words: str):
    with pytest.raises(fitact.InputError) as error:
        fitact.Study.from_table(write(*lines))
    assert words in str(error.value).replace(str(tmp_path), "PLACE")


def test_files_that_are_no_table_are_refused(tmp_path: Path, finger_path: Path):
    (tmp_path / "study.xlsx").write_bytes(b"PK\x03\x04\xff\xfe")
    with pytest.raises(fitact.InputError, match="no text in UTF-8; save the table as CSV in UTF-8"):
        fitact.Study.from_table(tmp_path / "study.xlsx")
    with pytest.raises(fitact.InputError, match="cannot be read"):
        fitact.Study.from_table(tmp_path / "none.csv")
    assert not any(map(is_study, (tmp_path / "study.xlsx", tmp_path / "none.csv", tmp_path, finger_path)))


def test_a_pattern_takes_labels_and_covariates_from_names():
    names = ["x/P1_r1_left_20.5C.csv", "x/P1_r2_right_21C.csv", "y/P12_r1_left_20.5C.csv"]
    study = fitact.Study.from_pattern("P{person}_r{repetition}_{side}_{temperature}C.csv", names)
    assert study.records == tuple(map(Path, names))
    assert study.labels == {"person": ("1", "1", "12"), "repetition": ("1", "2", "1")}
    assert study.covariates == {"side": (0.0, 1.0, 0.0), "temperature": (20.5, 21.0, 20.5)}
    assert study.codes == {"side": ("left", "right")}


def test_a_pattern_with_folders_is_compared_with_the_ends_of_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    study = fitact.Study.from_pattern("{person}/r{repetition}.csv", ["far/anna/r1.csv", "anna/r2.csv", "r01.csv"])
    assert study.labels == {"person": ("anna", "anna", tmp_path.name), "repetition": ("1", "2", "01")}


@pytest.mark.parametrize(
    ("pattern", "names", "words"),
    [
        ("P{person}.csv", ["P1.csv", "Q2.csv", "Q3.csv"], "Q2.csv: does not match the pattern P{person}.csv"),
        ("P{person}.csv", ["P1.csv.gz"], "P1.csv.gz: does not match"),
        ("P{person}xcsv", ["P1.csv"], "P1.csv: does not match"),
        ("P{person}?csv", ["P1.csv"], "P1.csv: does not match"),
        ("{person}.csv", ["x/P1.csv", "y/P1.csv", "x/../x/P1.csv"], "x/P1.csv: is given twice"),
        ("{person}.csv", [], "no records are given"),
        ("P1.csv", ["P1.csv"], "pattern P1.csv: write names in braces"),
        ("{}.csv", ["P1.csv"], "write names in braces"),
        ("{record}.csv", ["P1.csv"], "write names in braces"),
        ("{person.csv", ["P1.csv"], "write names in braces"),
        ("{person}{side}.csv", ["P1.csv"], "write text between two names"),
        ("{person}_{Person}.csv", ["1_2.csv"], "person occurs twice"),
        ("{hand}.csv", ["a.csv", "b.csv", "c.csv"], "{hand}.csv: hand has neither numbers nor two words"),
        ("{repetition}_{age}.csv", ["1_2.csv", "1_3.csv"], "1_3.csv: has the same repetition 1 as 1_2.csv; number"),
    ],
)
def test_names_that_do_not_follow_the_pattern_are_refused(pattern: str, names: Sequence[str], words: str):
    with pytest.raises(fitact.InputError) as error:
        fitact.Study.from_pattern(pattern, names)
    assert words in str(error.value)


ONE_PERSON = "all records are of one person, so differences between people are not estimated"
TOUCHES = "each person has one record, so differences between people contain those between touches"
SESSIONS = "each finger has one session, so differences between fingers contain those between sessions"
FINGERS = "each person has one finger, so differences between people contain those between fingers"


@pytest.mark.parametrize(
    ("labels", "levels", "omitted"),
    [
        pytest.param({"person": "ABCD"}, {"person": [0, 1, 2, 3]}, [TOUCHES], id="one record each"),
        pytest.param({"person": "ABAB"}, {"person": [0, 1, 0, 1], "repetition": [0, 1, 2, 3]}, [], id="two records"),
        pytest.param(
            {"person": "ABBC"}, {"person": [0, 1, 1, 2], "repetition": [0, 1, 2, 3]}, [], id="one person repeats"
        ),
        pytest.param({"person": "AAAA"}, {"repetition": [0, 1, 2, 3]}, [ONE_PERSON], id="one person"),
        pytest.param(
            {"person": "AAAA", "finger": "iitt"},
            {"finger": [0, 0, 1, 1], "repetition": [0, 1, 2, 3]},
            [ONE_PERSON],
            id="two fingers of one person",
        ),
        pytest.param(
            {"person": "AABB", "finger": "itit"},
            {"person": [0, 0, 1, 1], "finger": [0, 1, 2, 3]},
            ["each finger has one record, so differences between fingers contain those between touches"],
            id="fingers within people",
        ),
        pytest.param(
            {"person": "AABB", "finger": "iiii", "repetition": "1212"},
            {"person": [0, 0, 1, 1], "repetition": [0, 1, 2, 3]},
            [FINGERS],
            id="one finger of each",
        ),
        pytest.param(
            {"finger": "AABB", "session": "1111"},
            {"finger": [0, 0, 1, 1], "repetition": [0, 1, 2, 3]},
            [SESSIONS],
            id="one session each",
        ),
        pytest.param(
            {"finger": "AABB", "session": "1211"},
            {"finger": [0, 0, 1, 1], "session": [0, 1, 2, 2], "repetition": [0, 1, 2, 3]},
            [],
            id="two sessions of one",
        ),
        pytest.param({"repetition": "1234"}, {"repetition": [0, 1, 2, 3]}, [], id="repetitions alone"),
        pytest.param(
            {"person": ["1", "01", "1", "01"]}, {"person": [0, 1, 0, 1], "repetition": [0, 1, 2, 3]}, [], id="texts"
        ),
        pytest.param({}, {"finger": [0, 1, 2, 3]}, [], id="no labels"),
        pytest.param({"person": "A"}, {"person": [0]}, [], id="one record"),
    ],
)
def test_levels_are_those_that_the_labels_separate(
    labels: Mapping[str, Sequence[str]], levels: Mapping[str, list[int]], omitted: list[str]
):
    count = len(next(iter(levels.values())))
    nesting = nest_levels(labels, count)
    assert {level.name: level.unit_numbers.tolist() for level in nesting.levels} == levels
    assert list(levels) == [name for name in LEVELS if name in levels]
    assert list(nesting.omitted) == omitted
    assert len(nesting.levels[-1].units) == count
    for level in nesting.levels:
        assert np.issubdtype(level.unit_numbers.dtype, np.integer)
        assert len(level.units) == max(levels[level.name]) + 1


def test_units_have_the_labels_from_the_top():
    people, fingers, touches = nest_levels({"finger": "itii", "person": ["P1", "P1", "P2", "P2"]}, 4).levels
    assert people.units == ("P1", "P2")
    assert fingers.units == ("P1, i", "P1, t", "P2, i")
    assert touches.units == ("P1, i, 1", "P1, t, 1", "P2, i, 1", "P2, i, 2")
    assert nest_levels({}, 2).levels[0].units == ("1", "2")
    assert nest_levels({}, 2, ["a.csv", "b.csv"]).levels[0].units == ("a.csv", "b.csv")


def test_units_of_a_study_without_labels_have_the_names_of_its_records(write: Callable[..., Path], tmp_path: Path):
    assert fitact.Study.from_table(write("record", "a.csv", "b.csv")).nest().levels[0].units == ("a.csv", "b.csv")
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "a.csv").touch()
    alike = fitact.Study.from_table(write("record", "a.csv", "x/a.csv"))
    assert alike.nest().levels[0].units == (str(tmp_path / "a.csv"), str(tmp_path / "x" / "a.csv"))


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ({"hand": "ab"}, "hand is no level; use person, finger, session, repetition"),
        ({"person": "abc"}, "labels of person: 3 for 2 records; give one for each"),
        ({"person": ["a", ""]}, "record 2: person is empty"),
        ({"person": "aa", "repetition": "11"}, "record 2: has the same person a and repetition 1 as record 1"),
    ],
)
def test_labels_are_refused(labels: Mapping[str, Sequence[str]], words: str):
    with pytest.raises(fitact.InputError, match=words):
        nest_levels(labels, 2)


@pytest.mark.parametrize(
    ("values", "level"), [([1, 1, 1, 1], "person"), ([1, 1, 1, 2], "person"), ([1, 2, 2, 1], "finger"),
                          ([1, 1, 2, 1], "repetition")],
)  # fmt: skip
def test_a_covariate_belongs_to_the_highest_level_in_which_it_is_constant(values: list[float], level: str):
    """Units: person 0, 0, 0, 1; finger 0, 1, 1, 2; each record a repetition."""
    assert covariate_level(values, nest_levels({"person": "AAAB", "finger": "ittt"}, 4)) == level


def test_a_study_describes_itself(write: Callable[..., Path]):
    path = write(
        "record,person,session,age,side,room",
        "a.csv,P1,1,23,left,20",
        "b.csv,P1,1,23,right,20",
        "c.csv,P2,1,31.5,right,20",
        "d.csv,P3,1,31.5,left,20",
    )
    study = fitact.Study.from_table(path)
    note = "each person has one session, so differences between people contain those between sessions"
    assert str(study).splitlines() == [
        f"{path}: 4 records of 3 people, 1 to 2 repetitions each",
        "levels: person (3), repetition (4)",
        "age: 2 values from 23 to 31.5, one for each person",
        "side: left = 0, right = 1, varies within a person",
        "room: 20 for all records",
        f"note: {note}",
    ]
    assert repr(study) == "<fitact.Study: 4 records of 3 people, 1 to 2 repetitions each>"
    assert study.to_dict() == {
        "source": str(path),
        "records": 4,
        "levels": [{"name": "person", "units": 3}, {"name": "repetition", "units": 4}],
        "omitted": [note],
        "covariates": [
            {"name": "age", "level": "person", "min": 23.0, "max": 31.5, "codes": []},
            {"name": "side", "level": "repetition", "min": 0.0, "max": 1.0, "codes": ["left", "right"]},
            {"name": "room", "level": "person", "min": 20.0, "max": 20.0, "codes": []},
        ],
    }


@pytest.mark.parametrize(
    ("lines", "first"),
    [
        (["record", "a.csv", "b.csv"], "2 records of 2 fingers"),
        (["record,person", "a.csv,P", "b.csv,P"], "2 records"),
        (["record,person,finger", "a.csv,P,i", "b.csv,Q,i", "c.csv,P,t", "d.csv,Q,t"], "4 records of 2 people, 2 fin"),
    ],
)
def test_the_first_line_counts(write: Callable[..., Path], lines: Sequence[str], first: str):
    assert repr(fitact.Study.from_table(write(*lines))).startswith(f"<fitact.Study: {first}")


def test_options_load_a_study(write: Callable[..., Path]):
    path = write("record,person", "a.csv,P1", "b.csv,P2")
    assert options.load_study(None, path, None) == fitact.Study.from_table(path)
    assert options.load_study([Path("P1.csv")], None, None) is None
    loaded = options.load_study([Path("P1.csv")], None, "P{person}.csv")
    assert loaded is not None
    assert loaded.labels == {"person": ("1",)}


@pytest.mark.parametrize("command", ["population", "campaign"])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no records are given; name files (RECORD...), or a table of them with --table FILE"),
        (["--pattern", "P{person}.csv"], "no records are given"),
        (["a.csv", "--table", "study.csv"], "--table study.csv: names and labels all records (also given: a.csv)"),
        (["--table", "study.csv", "--pattern", "{person}"], "(also given: --pattern {person})"),
        (["--table", "none.csv"], "none.csv: cannot be read"),
        (["a.csv", "--pattern", "P{person}.csv"], "a.csv: does not match the pattern"),
    ],
)
def test_commands_refuse(
    command: str, arguments: list[str], words: str, write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    write("record,person", "a.csv,P1", "b.csv,P2")
    assert run(monkeypatch, tmp_path, command, *arguments, "--out", "out") == 2
    assert words in capsys.readouterr().err


def test_a_table_excludes_covariates(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    write("record,person", "a.csv,P1", "b.csv,P2")
    assert run(monkeypatch, tmp_path, "population", "--table", "study.csv", "--covariates", "people.csv") == 2
    assert "--covariates people.csv: study.csv has a column for each" in capsys.readouterr().err


def test_inspect_shows_a_table(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    study = fitact.Study.from_table(write("record,person", "a.csv,P1", "b.csv,P2"))
    assert run(monkeypatch, tmp_path, "inspect", "study.csv") == 0
    assert capsys.readouterr().out == f"{study}\n".replace(study.source, "study.csv")
    assert run(monkeypatch, tmp_path, "inspect", "study.csv", "--json") == 0
    assert json.loads(capsys.readouterr().out) == study.to_dict() | {"source": "study.csv"}
    assert run(monkeypatch, tmp_path, "inspect", "study.csv", "--out", "a.svg") == 2
    assert "--out a.svg: draws a record" in capsys.readouterr().err


def run(monkeypatch: pytest.MonkeyPatch, folder: Path, *arguments: Any) -> int:
    """Run a command in that folder, and return its exit status."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["fitact", *arguments])
    with pytest.raises(SystemExit) as end:
        fitact.cli.main()
    return int(end.value.code or 0)


def test_a_table_is_read_without_slow_imports(write: Callable[..., Path]):
    code = (
        f"import sys, fitact; fitact.Study.from_table({str(write('record', 'a.csv'))!r});"
        "print([name for name in ('jax', 'pandas', 'scipy', 'matplotlib.figure') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
