"""Raw files of LTspice and ngspice, written here after the formats that their manuals describe."""

from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.cli import internal
from fitact.readers.read import read_capture
from tests.layouts.files import raw

STEP, COUNT = 20e-6, 200
TIME = STEP * np.arange(COUNT)
WAVES = {
    "V(drive)": ("voltage", 120.0 * np.sin(2e3 * np.pi * TIME)),
    "V(skin)": ("voltage", 9.0 * np.cos(2e3 * np.pi * TIME)),
    "I(V1)": ("device_current", 2e-6 * np.cos(2e3 * np.pi * TIME)),
}  # fmt: skip
FREQUENCY = np.geomspace(10.0, 1e5, 30)
LAYERS = 1.0 / (1.0 / 160e3 + 2j * np.pi * FREQUENCY * 22e-9)
LOAD = LAYERS + 1.0 / (2j * np.pi * FREQUENCY * 1.35e-9)


FORMS = {
    "mixed": ("real forward", 1e-7), "double": ("real", 0.0), "by variable": ("real forward fastaccess", 1e-7),
    "text": ("real forward", 1e-12),
}  # fmt: skip
ASSIGNED = {"V": "V(drive)", "Vsc": "V(skin)", "I": "I(V1)"}


def check(record: fitact.Record, rtol: float, factor: float = 1.0, start: float = 0.0) -> None:
    np.testing.assert_allclose(record.time, TIME + start, rtol=1e-11, atol=1e-15)
    for channel, name in ASSIGNED.items():
        values = factor * WAVES[name][1]
        np.testing.assert_allclose(record[channel], values, rtol=rtol, atol=rtol * np.max(np.abs(values)))


@pytest.mark.parametrize("form", FORMS)
def test_transient_analyses_are_records(form: str, tmp_path: Path):
    path, (flags, rtol) = tmp_path / "finger.raw", FORMS[form]
    path.write_bytes(raw([(TIME, WAVES)], form, flags))
    check(fitact.read(path, channels=ASSIGNED), rtol)
    assert [(each.name, each.unit) for each in read_capture(path).channels] == [
        ("V(drive)", "V"), ("V(skin)", "V"), ("I(V1)", "A"),
    ]  # fmt: skip
    assert not internal.is_spectrum(path)


def test_the_start_and_marked_points_of_ltspice(tmp_path: Path):
    """A time with a minus is a point that compression must keep; the offset is the time from which on it is saved."""
    path, marked = tmp_path / "finger.raw", np.where(np.arange(COUNT) % 7, TIME, -TIME)
    path.write_bytes(raw([(marked, WAVES)], "mixed", "real forward compressed", 5e-3))
    check(fitact.read(path, channels=ASSIGNED), 1e-7, start=5e-3)


@pytest.mark.parametrize("form", FORMS)
def test_steps_of_ltspice_and_analyses_of_ngspice_are_segments(form: str, tmp_path: Path):
    path, (flags, rtol) = tmp_path / "finger.raw", FORMS[form]
    runs = [(TIME, {name: (kind, n * wave) for name, (kind, wave) in WAVES.items()}) for n in (1, 2, 3)]
    if form == "double":
        point = {"v(drive)": ("voltage", np.zeros(1))}
        path.write_bytes(
            raw([(np.zeros(1), point)], form, flags, name="Operating Point").replace(b"\ttime\ttime", b"\tx\tvoltage")
            + b"".join(raw([run], form, flags) for run in runs)
        )
    else:
        path.write_bytes(raw(runs, form, f"{flags} stepped"))
    with pytest.raises(fitact.InputError, match=r"holds 3 segments .* choose one, as --segment 1"):
        fitact.read(path, channels=ASSIGNED)
    for number in (1, 2, 3):
        check(fitact.read(path, channels=ASSIGNED, segment=number), max(rtol, 1e-15), number)
    with pytest.raises(fitact.InputError, match=r"there is no number 4"):
        fitact.read(path, channels=ASSIGNED, segment=4)


def ac(form: str, steps: int = 1, **responses: np.ndarray) -> bytes:
    kinds = {name: "device_current" if name.startswith("I") else "voltage" for name in responses}
    runs = [
        (FREQUENCY, {name: (kinds[name], n * each) for name, each in responses.items()}) for n in range(1, steps + 1)
    ]
    return raw(runs, form, "complex forward", name="AC Analysis")


@pytest.mark.parametrize("form", ["mixed", "double", "text"])
def test_ac_analyses_are_spectra(form: str, tmp_path: Path):
    """A gain where the skin's node is named or alone, and the impedance at the only source; steps are numbered."""
    path, one = tmp_path / "finger.raw", np.ones(FREQUENCY.size, complex)
    voltages = {"V(drive)": 2.0 * one, "V(vsc)": 2.0 * LAYERS / LOAD, "V(other)": LAYERS / LOAD}
    path.write_bytes(ac(form, **voltages))
    spectrum = fitact.read_spectrum(path)
    assert internal.is_spectrum(path)
    assert spectrum.channel == "Vsc"
    np.testing.assert_allclose(spectrum.values, LAYERS / LOAD, rtol=1e-10)
    assert "the gain is V(vsc) over V(drive)" in spectrum.notes
    path.write_bytes(ac(form, **{"V(skin)": LAYERS / LOAD}))
    np.testing.assert_allclose(fitact.read_spectrum(path).values, LAYERS / LOAD, rtol=1e-10)
    path.write_bytes(ac(form, **{"V(drive)": 2.0 * one, "V(a)": one / LOAD, "V(b)": one / LOAD, "I(V1)": -2.0 / LOAD}))
    spectrum = fitact.read_spectrum(path)
    assert spectrum.channel == "impedance"
    np.testing.assert_allclose(spectrum.values, LOAD, rtol=1e-10)
    path.write_bytes(ac(form, **{"V(drive)": one, "V(a)": one / LOAD, "V(b)": one / LOAD}))
    with pytest.raises(fitact.InputError, match=r"which of the voltages V\(a\), V\(b\) is that of the skin"):
        fitact.read_spectrum(path)
    path.write_bytes(ac(form, steps=2, **{"V(skin)": 0.1 * LAYERS / LOAD}))
    with pytest.raises(fitact.InputError, match="holds 2 spectra; choose one"):
        fitact.read_spectrum(path)
    np.testing.assert_allclose(fitact.read_spectrum(path, 2).values, 0.2 * LAYERS / LOAD, rtol=1e-10)
    with pytest.raises(fitact.InputError, match="is a spectrum, without time"):
        fitact.read(path)


def test_damaged_raw_files_are_refused(tmp_path: Path):
    path, whole = tmp_path / "finger.raw", raw([(TIME, WAVES)], "double", "real")
    for content, words in (
        (whole[:-100], "200 points of 4 variables do not fill 6300 bytes, so it is truncated"),
        (whole.replace(b"No. Points:     200", b"No. Points:     900"), "900 points"),
        (whole.replace(b"No. Variables: 4", b"No. Variables: 5"), "states 5 variables"),
        (whole.replace(b"Binary:", b"Nothing"), "no values follow"),
        (whole.replace(b"\ttime\ttime", b"\tsweep\tvoltage"), "holds no transient analysis"),
    ):
        path.write_bytes(content)
        with pytest.raises(fitact.InputError, match=words):
            fitact.read(path)
