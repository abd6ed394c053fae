"""Impedance spectra: files in the formats of analysers, and fits of spectra computed from complex arithmetic alone."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.cli import app

FREQUENCY = np.geomspace(1.0, 1e5, 41)
TRUTH = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.4e-9}


def impedance(frequency: np.ndarray, Rsc: float, Csc: float, Ci: float, alpha: float = 1.0) -> np.ndarray:
    """Return the impedance of two layers in series with the insulator; for alpha < 1 the layers are Cole elements."""
    s = 2j * np.pi * frequency
    return 2.0 * Rsc / (1.0 + (s * Rsc * Csc) ** alpha) + 1.0 / (s * Ci)


def noisy(z: np.ndarray, noise: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return z * np.exp(noise * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size)))


def spectrum(noise: float = 3e-3, seed: int = 0, frequency: np.ndarray = FREQUENCY, **values: float) -> fitact.Spectrum:
    return fitact.Spectrum.from_arrays(frequency, noisy(impedance(frequency, **(TRUTH | values)), noise, seed))


FILES = {
    "plain.csv": ("frequency_Hz,Z_real_ohm,Z_imag_ohm", "{f:.9g},{re:.9g},{im:.9g}"),
    "bare.csv": (None, "{f:.9g},{re:.9g},{im:.9g}"),
    "negative.csv": ("freq/Hz,Re(Z)/Ohm,-Im(Z)/Ohm", "{f:.9g},{re:.9g},{minus:.9g}"),
    "polar.csv": ("Frequency (kHz);|Z| (kOhm);Phase (deg)", "{kf};{kz};{deg}"),
    "gamry.DTA": (
        "EXPLAIN\nTAG\tEISPOT\nZCURVE\tTABLE\n\tPt\tTime\tFreq\tZreal\tZimag\tZsig\tZmod\tZphz\tIdc\tVdc\tIERange"
        "\n\t#\ts\tHz\tohm\tohm\tV\tohm\t°\tA\tV\t#",
        "\t{n}\t1\t{f:.9g}\t{re:.9g}\t{im:.9g}\t1\t{size:.9g}\t{deg_point}\t0\t0\t5",
    ),
    "biologic.mpt": (
        "EC-Lab ASCII FILE\nNb header lines : 5\n\nDevice : SP-300\n"
        "freq/Hz\tRe(Z)/Ohm\t-Im(Z)/Ohm\t|Z|/Ohm\tPhase(Z)/deg\ttime/s",
        "{f:.9g}\t{re:.9g}\t{minus:.9g}\t{size:.9g}\t{deg_point}\t1",
    ),
    "autolab.txt": (
        "Index,Frequency (Hz),Z' (Ω),-Z'' (Ω),Z (Ω),-Phase (°)",
        "{n},{f:.9g},{re:.9g},{minus:.9g},{size:.9g},1",
    ),
    "zplot.z": (
        '"ZPLOT2 ASCII","2.2"\n"Comment"\n  Freq(Hz)     Ampl  Bias  Time(Sec)   Z\'(a)   Z\'\'(b)  GD Err Range'
        "\nEnd Comments",
        "{f:.9g}, 0.1, 0, 1, {re:.9g}, {im:.9g}, 0, 0, 4",
    ),
    "versastudio.par": (
        "<Segment1>\nType=2\nDefinition=Segment #, Point #, E(V), I(A), Frequency(Hz), E Real, E Imag, I Real, I Imag,"
        " Z Real, Z Imag",
        "0,{n},0,0,{f:.9g},0,0,0,0,{re:.9g},{im:.9g}",
    ),
    "chi.txt": (
        "A.C. Impedance\nInit E (V) = 0\n\nFreq/Hz, Z'/ohm, Z\"/ohm, Z/ohm, Phase/deg\n",
        "{f:.9g}, {re:.9g}, {im:.9g}, {size:.9g}, {deg_point}",
    ),
}


def write(path: Path, header: str | None, row: str, z: np.ndarray, tail: str = "") -> Path:
    lines = [header] if header is not None else []
    for n, (f, value) in enumerate(zip(FREQUENCY, z, strict=True)):
        degrees = math.degrees(np.angle(value))
        comma = {"kf": f / 1e3, "kz": abs(value) / 1e3, "deg": degrees}
        lines.append(
            row.format(
                n=n, f=f, re=value.real, im=value.imag, minus=-value.imag, size=abs(value), deg_point=f"{degrees:.9g}",
                **{name: f"{x:.12g}".replace(".", ",") for name, x in comma.items()},
            )
        )  # fmt: skip
    path.write_text("\n".join(lines) + "\n" + tail, encoding="latin-1" if path.suffix == ".DTA" else "utf-8")
    return path


@pytest.mark.parametrize("name", list(FILES))
def test_files_of_analysers(tmp_path: Path, name: str):
    z = impedance(FREQUENCY, **TRUTH)
    tail = "</Segment1>\n<Segment2>\n" if name.endswith(".par") else ""
    read = fitact.read_spectrum(write(tmp_path / name, *FILES[name], z, tail))
    np.testing.assert_allclose(read.frequency, FREQUENCY, rtol=1e-8)
    np.testing.assert_allclose(read.impedance, z, rtol=1e-7)


@pytest.mark.parametrize(("unit", "factor"), [("mohm", 1e-3), ("kOHM", 1e3), ("MΩ", 1e6), ("GOhm", 1e9)])
def test_prefixes_of_the_unit(tmp_path: Path, unit: str, factor: float):
    read = fitact.read_spectrum(broken(tmp_path, f"f_Hz,Re(Z)/{unit},Im(Z)/{unit}", *GOOD))
    np.testing.assert_allclose(read.impedance, factor * (1e5 - 1e5j), rtol=1e-12)


def broken(tmp_path: Path, header: str, *rows: str) -> Path:
    path = tmp_path / "spectrum.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


GOOD = [f"{f},1e5,-1e5" for f in (1, 10, 100, 1000, 10000)]
NAMES = "frequency_Hz,Z_real_ohm,Z_imag_ohm"
BROKEN = {
    "too few": ([NAMES, *GOOD[:4]], "4 points are too few"),
    "a cell": ([NAMES, *GOOD[:2], "7,x,-1", *GOOD[2:]], "line 4: '7,x,-1' is not a row of numbers"),
    "not finite": ([NAMES, *GOOD, "7,nan,-1"], "not finite"),
    "twice": ([NAMES, *GOOD, "10,1e5,-1e5"], "10 Hz occurs twice"),
    "at 0 Hz": ([NAMES, *GOOD, "0,1e5,-1e5"], "the frequency 0 Hz"),
    "inductive": ([NAMES, *(row.replace("-", "") for row in GOOD)], "with a minus"),
    "zero": ([NAMES, *GOOD, "7,0,0"], "the impedance is 0 at 7 Hz"),
    "no header": (["a,b,c,d", "1,2,3,4"], "no line names a frequency"),
}


@pytest.mark.parametrize("name", list(BROKEN))
def test_bad_files_are_refused(tmp_path: Path, name: str):
    lines, match = BROKEN[name]
    with pytest.raises(fitact.InputError, match=match):
        fitact.read_spectrum(broken(tmp_path, *lines))


def test_a_record_is_no_spectrum_and_a_spectrum_no_record(tmp_path: Path, finger_path: Path):
    with pytest.raises(fitact.InputError, match="impedance spectrum"):
        fitact.read(write(tmp_path / "plain.csv", *FILES["plain.csv"], impedance(FREQUENCY, **TRUTH)))
    with pytest.raises(fitact.InputError, match="no line names a frequency"):
        fitact.read_spectrum(finger_path)


def test_parameters_within_their_errors():
    """Errors of 20 spectra of fingers within a factor of 9. For any seed, one of 60 deviates by 4 sd with p = 0.004."""
    rng = np.random.default_rng(3)
    pulls = []
    for seed in range(20):
        truth = {"Rsc": 130e3 * 3.0 ** rng.uniform(-1, 1), "Csc": 20e-9 * 3.0 ** rng.uniform(-1, 1), "Ci": 1.35e-9}
        found = fitact.fit_spectrum(spectrum(seed=seed, **truth))
        assert found.trusted, found.message
        assert found.identifiability.verdict == "identified"
        pulls.append((found.theta - np.log(list(truth.values()))) / found.sd)
    assert np.max(np.abs(pulls)) < 4.0
    assert 0.5 < np.std(pulls) < 1.5


def test_what_is_left_is_the_noise():
    found = [fitact.fit_spectrum(spectrum(noise=1e-2, seed=seed)).noise for seed in range(10)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(1e-2, rel=0.13)  # 5 sd for 790 degrees of freedom


def test_force_is_that_of_the_circuit_under_the_scenes_drive():
    found = fitact.fit_spectrum(spectrum(noise=0.0))
    scene = fitact.Scene()
    drive = scene.make_drive()
    mean = fitact.mean_force(
        fitact.FinalCircuit(**TRUTH), drive, scene.geometry().contact(fitact.FinalCircuit(**TRUTH))
    )
    assert found.derived()["force_mean"]["q50"] == pytest.approx(float(mean), rel=1e-6)


@pytest.mark.thorough
def test_another_skin_is_a_misfit_until_the_scene_has_it():
    cole = spectrum(noise=1e-3, alpha=0.8)
    assert fitact.fit_spectrum(cole).result == "misfit"
    level = {"skin": {"level": "fractional", "alpha": 0.85}, "prior": {"alpha": {"low": 0.5, "high": 1.0}}}
    found = fitact.fit_spectrum(cole, fitact.Scene.from_dict(level))
    assert found.trusted, found.message
    values = np.exp(found.theta)
    for name, value in (TRUTH | {"alpha": 0.8}).items():
        place = found.names.index(name)
        assert abs(math.log(values[place] / value)) < 4.0 * found.sd[place]


def test_high_frequencies_alone_leave_the_resistance_to_the_prior():
    found = fitact.fit_spectrum(spectrum(frequency=np.geomspace(1e5, 1e6, FREQUENCY.size)))
    assert found.identifiability.verdict != "identified"
    assert "corner frequency of the skin" in found.identifiability.remedy


def test_command_line(tmp_path: Path, capfd):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], noisy(impedance(FREQUENCY, **TRUTH), 1e-3, 2))
    with pytest.raises(SystemExit) as ended:
        app(["fit", str(path), "--json", "--out", str(tmp_path / "out")])
    assert ended.value.code == 0
    printed = json.loads(capfd.readouterr().out)
    assert printed["parameters"]["Ci"]["q50"] == pytest.approx(TRUTH["Ci"], rel=0.01)
    assert json.loads((tmp_path / "out" / "fit.json").read_text()) == printed
    with pytest.raises(SystemExit):
        app(["inspect", str(path)])
    assert "41 points, 1 Hz to 100 kHz" in capfd.readouterr().out
