"""Times that were rounded when they were written: a stated sampling rate makes the axis, unless it contradicts them.

The true times are k / rate, written here with too few digits; the records come from scipy's state space.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.cli import main
from tests.conftest import square_record

SCOPY = Path(__file__).parents[3] / "shared" / "real" / "scopes" / "Lab1_Square_7kHz.csv"
REMEDY = "state the sampling rate, as --rate 100kHz (in Python: rate=100e3) or [measurement] sampling_rate in a scene"
START = -3e-3  # s, of the records


def text_of(time: np.ndarray, digits: str) -> str:
    record = square_record()
    rows = zip(time, record["V"], record["Vsc"], strict=True)
    return "time_s,V_V,Vsc_V\n" + "".join(f"{digits % t},{v:.9g},{vsc:.9g}\n" for t, v, vsc in rows)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes 4,000 samples with times of so many digits, without the rows `drop`."""

    def write(rate: float, digits: str = "%.9g", drop: tuple[int, ...] = ()) -> Path:
        lines = text_of(START + np.arange(4000) / rate, digits).splitlines()
        path = tmp_path / "record.csv"
        path.write_text("\n".join(line for i, line in enumerate(lines) if i - 1 not in drop) + "\n")
        return path

    return write


def scene(rate: float) -> fitact.Scene:
    return fitact.Scene.from_dict({"measurement": {"sampling_rate": rate}})


@pytest.mark.parametrize("rate", [48e3, 200e3, 200e3 / 3.0])
@pytest.mark.parametrize("digits", ["%.6f", "%.5f", "%.4f", "%.3f", "%.5g", "%.3g", "%.2e"])
def test_a_stated_rate_makes_the_axis(write, rate: float, digits: str):
    """Fixed decimals and significant digits, from a hundredth of a step to fifty steps; ties occur at 200 kHz."""
    path = write(rate, digits)
    for record in (fitact.read(path, rate=rate), fitact.read(path, scene(rate))):
        np.testing.assert_allclose(record.time - record.time[0], np.arange(4000) / rate, atol=1e-6 / rate)
        assert record.time[0] == pytest.approx(START, rel=1e-9)
    assert fitact.inspect(path, rate=rate).to_dict()["time_step"] == pytest.approx(1.0 / rate, rel=1e-6)


def test_truncated_times_and_times_in_single_precision(tmp_path: Path):
    true = 0.5 + np.arange(4000) / 3e6
    for time in (np.floor(true * 1e6) / 1e6, true.astype(np.float32).astype(float)):  # float32: 6e-8 s at 0.5 s
        path = tmp_path / "record.csv"
        path.write_text(text_of(time, "%.17g"))
        record = fitact.read(path, rate=3e6)
        np.testing.assert_allclose(record.time, time[0] + np.arange(4000) / 3e6, rtol=1e-14)
        assert "uniform times by the stated sampling rate 3 MHz" in record.notes[0]


def test_exact_times_stay_to_the_last_bit(write):
    path = write(200e3)
    plain = fitact.read(path)
    for record in (fitact.read(path, rate=200e3), fitact.read(path, scene(200e3)), fitact.read(path, fitact.Scene())):
        assert record.fingerprint == plain.fingerprint
        assert (record.notes, record.warnings) == ((), ())


@pytest.mark.parametrize("digits", ["%.9g", "%.5f"])
@pytest.mark.parametrize("factor", [0.5, 0.99, 1.001, 1e3])
def test_a_rate_that_contradicts_the_times_is_refused(write, digits: str, factor: float):
    with pytest.raises(fitact.InputError, match=r"^\S+: rate = .* contradicts the times in the file") as error:
        fitact.read(write(200e3, digits), rate=factor * 200e3)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("drop", [(900,), tuple(range(900, 1000)), tuple(range(0, 4000, 7)), (100, 101, 3000)])
def test_lost_samples_are_no_rounding(write, drop: tuple[int, ...]):
    path = write(200e3, drop=drop)
    with pytest.raises(fitact.InputError, match="contradicts the times"):
        fitact.read(path, rate=200e3)
    record = fitact.read(path, scene(200e3))
    np.testing.assert_array_equal(record.time, fitact.read(path).time)


def test_a_clock_with_jitter_is_no_rounding(tmp_path: Path):
    jitter = np.random.default_rng(2).uniform(-0.2, 0.2, 4000)  # steps, any seed: the true times are not on the grid
    path = tmp_path / "record.csv"
    path.write_text(text_of((np.arange(4000) + jitter) / 200e3, "%.12g"))
    record = fitact.read(path, scene(200e3))
    np.testing.assert_allclose(record.time * 200e3, np.arange(4000) + jitter, atol=1e-4)
    assert REMEDY not in " ".join(record.notes)


def test_a_scene_at_another_rate_leaves_times_that_can_be_used(write):
    """The rate of a scene is also that of its simulations and designs, so it may differ from that of a record."""
    record = fitact.read(path := write(200e3), scene(1e6))
    assert record.fingerprint == fitact.read(path).fingerprint
    (warning,) = record.warnings
    assert "[measurement] sampling_rate = 1 MHz contradicts" in warning
    assert warning.endswith("the times in the file are used")
    with pytest.raises(fitact.InputError, match=r"\[measurement\] sampling_rate = 1 MHz contradicts"):
        fitact.read(write(200e3, "%.5f"), scene(1e6))  # these repeat, so they cannot be used


def test_a_rate_is_not_stated_by_its_default(write):
    with pytest.raises(fitact.InputError, match="repeats the time before it"):
        fitact.read(write(200e3, "%.5f"), fitact.Scene())


def test_refusals_and_notes_name_the_remedy(write):
    with pytest.raises(fitact.InputError) as error:
        fitact.read(write(200e3, "%.5f"))
    assert REMEDY in str(error.value)
    record = fitact.read(path := write(150e3, "%.6f"))  # steps of 6 and 7 us
    assert any("not uniform (6e-06 to 7e-06 s)" in note and REMEDY in note for note in record.notes)
    coloured = fitact.Scene.from_dict({"measurement": {"noise_model": "ar1"}})
    with pytest.raises(fitact.InputError, match=r"needs uniform time steps; if .*state the sampling rate"):
        fitact.fit(fitact.read(path, coloured), coloured)
    lost = fitact.read(write(200e3, drop=(900,)))
    assert "not uniform" in lost.notes[0]
    assert REMEDY not in lost.notes[0]


@pytest.mark.parametrize("rate", [0.0, -1.0, np.inf, np.nan])
def test_a_rate_is_a_positive_number(write, rate: float):
    with pytest.raises(fitact.InputError, match="is no sampling rate"):
        fitact.read(write(200e3), rate=rate)


def test_swapped_rows_are_not_put_on_an_axis(tmp_path: Path):
    lines = text_of(np.arange(4000) * 5e-6, "%.6f").splitlines()
    path = tmp_path / "record.csv"
    for i in (1, 1001, 2001):
        lines[i], lines[i + 1] = lines[i + 1], lines[i]
    path.write_text("\n".join(lines))
    with pytest.raises(fitact.InputError, match="contradicts the times"):
        fitact.read(path, rate=200e3)


def test_the_command_line_takes_a_rate_with_a_unit(write, monkeypatch, capsys):
    path = str(write(48e3, "%.4f"))
    for stated, code in (("48kHz", 0), ("48000", 0), ("47kHz", 2), ("fast", 2)):
        monkeypatch.setattr("sys.argv", ["fitact", "inspect", path, "--rate", stated, "--json"])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == code
        out, said = capsys.readouterr()
        assert code or json.loads(out)["time_step"] == pytest.approx(1.0 / 48e3, rel=1e-6)
        assert "--rate: 'fast' is not a quantity" in said or stated != "fast"


if SCOPY.exists():  # files of other people's instruments, which are not in a clone

    def test_a_real_file_that_is_rounded(tmp_path: Path):
        """A file of an ADALM2000 at 10 MHz; three decimals of its milliseconds are 10 samples."""
        names = {"V": "CH1", "Vsc": "CH2"}
        exact = fitact.read(SCOPY, channels=names)
        assert fitact.read(SCOPY, channels=names, rate=1e7).fingerprint == exact.fingerprint
        path = tmp_path / "rounded.csv"
        rows = zip(exact.time, exact["V"], exact["Vsc"], strict=True)
        path.write_text("time_ms,V,Vsc\n" + "".join(f"{1e3 * t:.3f},{v},{vsc}\n" for t, v, vsc in rows))
        with pytest.raises(fitact.InputError, match="--rate"):
            fitact.read(path)
        np.testing.assert_allclose(fitact.read(path, rate=1e7).time, exact.time, rtol=0.0, atol=1e-12)
