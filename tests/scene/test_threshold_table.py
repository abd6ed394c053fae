"""The table of thresholds in a scene: interpolation, files, the shipped table, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import fitact


def read(folder: Path, value: str, table: str | None = None) -> fitact.Scene:
    if table is not None:
        (folder / "mine.csv").write_text(table, encoding="utf-8")
    (folder / "scene.toml").write_text(f"[perception]\nthresholds = {value}\n", encoding="utf-8")
    return fitact.Scene.load(folder / "scene.toml")


INLINE = '{frequencies = ["10 Hz", "1 kHz"], forces = ["10 mN", "0.1 mN"], source = "me"}'


def test_thresholds_between_two_frequencies_are_linear_in_log_log(tmp_path: Path):
    table = read(tmp_path, INLINE).perception.thresholds
    threshold = 1.0 / table.sensitivity(np.array([10.0, 100.0, 200.0, 1000.0]))
    assert threshold == pytest.approx([1e-2, 1e-3, 1e-3 / 2.0, 1e-4], rel=1e-12)
    assert not table.sensitivity(np.array([9.999, 1000.1])).any()  # no extrapolation


def test_the_coefficient_of_friction_and_the_multiples_of_the_frequency_count(tmp_path: Path):
    weight = read(tmp_path, INLINE).perception.thresholds.harmonic_sensitivity(300.0, 0.5)
    assert weight.size == 4
    assert weight[:3] == pytest.approx(0.5 * np.array([300.0, 600.0, 900.0]) / 0.1, rel=1e-12)
    assert weight[3] == 0.0


def test_a_file_beside_the_scene_is_read_and_kept_in_the_scene(tmp_path: Path):
    scene = read(tmp_path, '"mine.csv"', "# our lab, 2024\n\nfrequency_Hz, force_N\n20,0.02\n200,1e-3\n")
    table = scene.perception.thresholds
    assert (table.frequencies, table.forces) == ((20.0, 200.0), (0.02, 1e-3))
    assert scene.perception.threshold_source == "mine.csv: our lab, 2024"
    assert fitact.Scene.from_json(scene.to_json()) == scene
    (tmp_path / "again.toml").write_text(str(scene), encoding="utf-8")
    assert fitact.Scene.load(tmp_path / "again.toml") == scene


def test_the_shipped_table_follows_from_the_published_statements(tmp_path: Path):
    """Flat to 40 Hz, then 12 dB per octave, less 6 dB above 100 Hz for the viscous skin; 1 mN at 250 Hz."""
    table = read(tmp_path, '"fingertip"').perception.thresholds
    frequency = np.geomspace(10.0, 250.0, 30)
    displacement = np.minimum(1.0, (40.0 / frequency) ** 2)
    shape = displacement * np.maximum(1.0, frequency / 100.0)
    assert 1.0 / table.sensitivity(frequency) == pytest.approx(1e-3 * shape / shape[-1], rel=0.005)
    assert "reconstructed" in table.source


@pytest.mark.parametrize(
    ("value", "table", "sentence"),
    [
        ('"absent.csv"', None, "no such file; write .*; shipped: fingertip"),
        ('"mine.csv"', "frequency,force\n10,1\n", "must have the columns frequency_Hz,force_N"),
        ('"mine.csv"', "", "must have the columns"),
        (
            '"mine.csv"',
            "frequency_Hz,force_N\n10,1,2\n20,1\n",
            "a frequency in Hz and a force in N in each row, as 250,1e-3",
        ),
        ('"mine.csv"', "frequency_Hz,force_N\n10,1\n20,one\n", "'one'; write plain numbers in Hz and N"),
        ('"mine.csv"', "frequency_Hz,force_N\n10,1\n10,2\n", "must rise from each to the next"),
        ('"mine.csv"', "frequency_Hz,force_N\n10,1\n20,0\n", "greater than 0"),
        ('"mine.csv"', "frequency_Hz,force_N\n10,1\n", "fewer than two frequencies"),
        ('{frequencies = ["1 Hz", "2 Hz"]}', None, "needs frequencies and forces"),
        ('{frequencies = ["1 Hz", "2 Hz"], forces = ["1 N"]}', None, "2 frequencies and 1 forces"),
        ('{frequencies = ["1 Hz", "2 Hz"], forces = ["1 V", "1 N"]}', None, "'1 V' is not in a unit of N"),
        (
            '"mine.csv"',
            "frequency_Hz,force_N\n10,20\n200,1\n",
            "20 N is more than a finger is pressed with; check the unit",
        ),
        ("3", None, "not a table"),
    ],
)
def test_a_bad_table_is_refused_in_one_line(tmp_path: Path, value: str, table: str | None, sentence: str):
    with pytest.raises(fitact.InputError, match=sentence) as refused:
        read(tmp_path, value, table)
    assert "[perception] thresholds" in str(refused.value)
    assert str(refused.value).count("\n") == 0


def test_a_drive_far_below_the_table_is_refused(tmp_path: Path):
    with pytest.raises(fitact.InputError, match="reach to 1000 times the drive's 1 Hz"):
        read(tmp_path, INLINE).perception.thresholds.harmonic_sensitivity(1.0, 0.5)
