import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.data.noise import white_noise_sd
from fitact.readers.read import write_csv

Rows = list[list[str]]


@pytest.fixture(scope="module")
def rows(finger_path: Path) -> Rows:
    return [line.split(",") for line in finger_path.read_text().splitlines()]


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Rows], Path]:
    def write(rows: Rows) -> Path:
        path = tmp_path / "record.csv"
        path.write_text("\n".join(map(",".join, rows)) + "\n")
        return path

    return write


def test_values_are_read_as_written(finger_path: Path, rows: Rows):
    record = fitact.read(finger_path)
    table = np.array(rows[1:], dtype=float)
    for column, values in enumerate([record.time, record["V"], record["Vsc"]]):
        np.testing.assert_array_equal(values, table[:, column])
    assert record.notes == ()


def test_order_comments_gzip_and_extra_columns(tmp_path: Path, finger_path: Path, rows: Rows):
    path = tmp_path / "record.csv.gz"
    lines = ["# a comment", "Vsc_V, note ,Time_s,V_V,", "", *(f"{c},ok,{a},{b}," for a, b, c in rows[1:]), ""]
    path.write_bytes(gzip.compress("\r\n".join(lines).encode("utf-8-sig")))
    record = fitact.read(path)
    assert record.fingerprint == fitact.read(finger_path).fingerprint
    assert len(record.notes) == 1
    assert "note" in record.notes[0]


@pytest.mark.parametrize(
    "head",
    [
        [["time", "V", "Vsc"], ["ms", "kV", "mV"]],
        [["time", "V", "Vsc"], ["(ms)", "(kV)", "(mV)"]],
        [["time_ms", "V_kV", "Vsc_mV"]],
        [["time_ms", "V_kV", "Vsc_mV"], ["ms", "kV", "mV"]],
    ],
)
def test_units_in_the_name_or_in_a_row(write, finger_path: Path, rows: Rows, head: Rows):
    scaled = [[repr(1e3 * float(a)), repr(1e-3 * float(b)), repr(1e3 * float(c))] for a, b, c in rows[1:]]
    record, plain = fitact.read(write(head + scaled)), fitact.read(finger_path)
    np.testing.assert_allclose(record.time, plain.time, rtol=1e-12)
    for channel in ("V", "Vsc"):
        np.testing.assert_allclose(record[channel], plain[channel], rtol=1e-12)


def test_gw_instek_states_the_step_beside_a_nameless_time(tmp_path: Path):
    time, values = np.arange(4000) * 1e-5 - 0.02, np.sin(np.arange(4000))
    header = ["Memory Length,4000,", "Source,CH1,", "Vertical Units,V,", "Sampling Period,1.00000e-05,", "Time, ,"]
    rows = [f"{t:.6e},{v:.6e}," for t, v in zip(time, values, strict=True)]
    path = tmp_path / "A0000CH1.CSV"
    path.write_text("\r\n".join([*header, "Mode,Detail,", "Waveform Data,", *rows, ""]))
    record = fitact.read(path, fitact.Scene.from_dict({"drive": {"waveform": "sine"}}), channels={"Vsc": "CH1"})
    np.testing.assert_allclose(record.time, time, atol=1e-12)
    np.testing.assert_allclose(record["Vsc"], values, atol=1e-6)
    path.write_text("\r\n".join([*header, "Waveform Data,", *rows[:1000], ""]))
    with pytest.raises(fitact.InputError, match=r"states 4,000 rows, but the file has 1,000"):
        fitact.read(path, channels={"Vsc": "CH1"})


def test_pure_noise_is_refused_and_a_single_edge_is_not():
    time, rng = np.arange(400) * 5e-6, np.random.default_rng(3)
    noise = rng.normal(size=400)  # any seed; the significance level of the test is 1e-4
    with pytest.raises(fitact.InputError, match="nothing but noise"):
        fitact.Record.from_arrays(time, V=np.sin(time * 1e3), Vsc=noise)
    edge = np.where(np.arange(400) < 3, -180.0, 180.0) + 0.4 * noise
    assert "V" in fitact.Record.from_arrays(time, V=edge, Vsc=np.sin(time * 1e3))


def test_what_is_written_is_read_again(tmp_path: Path):
    """Times agree to the last bit, values to the 12 digits that are written."""
    rng = np.random.default_rng(0)  # any seed
    time = np.cumsum(rng.uniform(0.9e-5, 1.1e-5, 500)) - 1e-3
    waves = {"V": 360.0 * np.sin(2e3 * time), "Vsc": 15.0 * np.cos(2e3 * time), "I": 1e-6 * np.cos(2e3 * time)}
    write_csv(tmp_path / "record.csv", fitact.Record.from_arrays(time, **waves))
    record = fitact.read(tmp_path / "record.csv")
    np.testing.assert_array_equal(record.time, time)
    for name, values in waves.items():
        np.testing.assert_allclose(record[name], values, rtol=6e-12)


def test_noise_and_frequency_are_judged_without_a_model(finger_path: Path, finger_truth: dict[str, float]):
    record = fitact.read(finger_path)
    assert record.noise("V") == pytest.approx(finger_truth["noise_V"], rel=0.05)
    assert record.noise("Vsc") == pytest.approx(finger_truth["noise_Vsc"], rel=0.05)
    assert record.frequency() == pytest.approx(100.0, rel=1e-4)


@pytest.mark.parametrize("wave", [np.sin, lambda x: np.sign(np.sin(x)), lambda x: np.sin(x) + 0.8 * np.sin(2 * x)])
@pytest.mark.parametrize("periods", [1.6, 2.0, 3.7, 25.3])
def test_frequency(wave, periods: float):
    time = np.arange(5000) * 1e-5
    values = wave(2.0 * np.pi * periods / 0.05 * time + 0.3) + 0.02 * np.random.default_rng(0).normal(size=5000)
    record = fitact.Record.from_arrays(time, Vsc=values)
    assert record.frequency("Vsc") == pytest.approx(periods / 0.05, rel=3e-3)


def test_no_frequency_in_a_part_of_a_period():
    time = np.arange(500) * 1e-5
    assert fitact.Record.from_arrays(time, Vsc=np.exp(-time / 1e-3)).frequency("Vsc") is None


def test_the_callers_arrays_are_left_alone():
    time = np.arange(100) * 1e-5
    vsc = np.sin(time * 1e4)
    record = fitact.Record.from_arrays(time, Vsc=vsc)
    vsc[0] = 5.0
    assert record["Vsc"][0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        record["Vsc"][0] = 1.0


@pytest.mark.parametrize("spacing", ["linear", "logarithmic"])
def test_a_sweep_is_no_noise(spacing: str):
    """A sweep has no spectral line, but it is smooth."""
    time = np.arange(20_000) / 20e3
    phase = {
        "linear": 100.0 * time + 0.5 * 900.0 * time**2,
        "logarithmic": 100.0 * (10.0**time - 1.0) / np.log(10.0),
    }[spacing]
    sweep = 180.0 * np.sin(2.0 * np.pi * phase)
    assert len(fitact.Record.from_arrays(time, V=sweep, Vsc=0.05 * sweep)) == time.size


def test_what_shows_only_further_down_is_read(tmp_path: Path):
    """A channel that begins late, and a decimal comma that appears late."""
    values = np.sin(0.01 * np.arange(1000)) + (np.arange(1000) > 700)
    late = ["time_s,V_V,Vsc_V", *(f"{1e-5 * i:.6f},{v:.4f}," + f"{v:.3f}" * (i >= 500) for i, v in enumerate(values))]
    (tmp_path / "late.csv").write_text("\n".join(late))
    with pytest.raises(fitact.InputError, match="line 2, column 3: the cell is empty"):  # not that Vsc is missing
        fitact.read(tmp_path / "late.csv")
    shown = ["0" if i < 700 else f"{v:.4f}".replace(".", ",") for i, v in enumerate(values)]
    comma = ["time_us;V_V;Vsc_V", *(f"{10 * i};{v};{v}" for i, v in enumerate(shown))]
    (tmp_path / "comma.csv").write_text("\n".join(comma))
    np.testing.assert_allclose(fitact.read(tmp_path / "comma.csv")["Vsc"][700:], values[700:], atol=5e-5)
    comma.insert(900, "# a remark, so that its part is read line by line")
    (tmp_path / "remark.csv").write_text("\n".join(comma))
    np.testing.assert_allclose(fitact.read(tmp_path / "remark.csv")["Vsc"][700:], values[700:], atol=5e-5)


def test_nothing_shows_no_noise():
    assert np.isnan(white_noise_sd(np.zeros(3)))


def test_large_blocks_are_read_like_small_ones(tmp_path: Path):
    """Blocks above a megabyte are parsed by pandas; every digit and every refusal is that of the other path."""
    time = np.arange(40_000) * 5e-6
    rng = np.random.default_rng(0)  # any numbers
    table = np.column_stack(
        [time, 180.0 * np.sin(628.0 * time), 9.0 * np.cos(628.0 * time) + rng.standard_normal(time.size)]
    )
    path = tmp_path / "large.csv"
    np.savetxt(path, table, delimiter=",", header="time_s,V_V,Vsc_V", comments="", fmt="%.17g")
    assert path.stat().st_size > 1_048_576
    lines = path.read_text().splitlines()
    head, tail = lines[:30_000], lines[30_000:]
    for written in (
        lines, ["# five\" of a comment", *lines], [line + "," for line in lines], [line + "\r" for line in lines],
        [*head, "", *tail, ""], [*head, "# a remark", *tail],
        [line.replace(",", ";").replace(".", ",") for line in lines],
    ):  # fmt: skip
        path.write_text("\n".join(written), newline="\n")
        record = fitact.read(path)
        np.testing.assert_array_equal(np.column_stack([record.time, record["V"], record["Vsc"]]), table)
    for changed, words in (
        (tail[0].rsplit(",", 1)[0] + ",oops", "line 30001, column 3: 'oops' is not a number"),
        (tail[0].rsplit(",", 1)[0], "line 30001: 2 values, but other rows have 3"),
        (tail[0] + ",1", "line 30001: 4 values, but other rows have 3"),
        (tail[0].rsplit(",", 1)[0] + ",", "line 30001, column 3: the cell is empty"),
        (tail[0].rsplit(",", 1)[0] + ",nan", "line 30001: Vsc is nan"),
        (head[1], "line 30001: the time 0 s goes back"),
    ):
        path.write_text("\n".join([*head, changed, *tail[1:]]))
        with pytest.raises(fitact.InputError, match=words):
            fitact.read(path)
