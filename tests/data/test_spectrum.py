"""Files of spectra: layouts of analysers and of frequency-response analysers, real ones too, and what is refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.cli import app
from fitact.data.kramers_kronig import check_kramers_kronig
from fitact.data.readers.spectrum import is_spectrum

FREQUENCY = np.geomspace(1.0, 1e5, 41)
TRUTH = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.4e-9}


def impedance(frequency: np.ndarray, Rsc: float, Csc: float, Ci: float, alpha: float = 1.0) -> np.ndarray:
    """Return the impedance of two layers in series with the insulator; for alpha < 1 the layers are Cole elements."""
    s = 2j * np.pi * frequency
    return 2.0 * Rsc / (1.0 + (s * Rsc * Csc) ** alpha) + 1.0 / (s * Ci)


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
    "quoted.z": (
        '"ZPlotW Data File: Version 3.2c"\n"Raw Data"'
        "\n\"  Freq (Hz)    Ampl     Bias   Time(Sec)   Z'(a)    Z''(b)    GD   Err\"",
        "{f:.9g}, 0.1, 0, 1, {re:.9g}, {im:.9g}, 0, 0",
    ),
    "words.csv": ("frequency,real,imaginary", "{f:.9g},{re:.9g},{im:.9g}"),
    "chip.csv": (",Frequency,Impedance,Phase", "{n},{f:.9g},{size:.9g},{deg_point}"),
    "registers.csv": (
        "Frequency,Impedance,Phase,Real,Imaginary,Magnitude",
        "{f:.9g},{size:.9g},{deg_point},-16103,-1843,16208.12",
    ),
    "powersuite.txt": ("Frequency\t Zre\t Zimg", "{f:.9g}\t {re:.9g}\t {im:.9g}"),
    "primes.csv": ("f, Z', Z''", "{f:.9g}, {re:.9g}, {im:.9g}"),
    "count.i2b": ("Some metadata\nof several lines\n\n41", "{f:.9g} {re:.9g} {im:.9g}"),
    "powersuite.P00": (
        "Procedure : a\n f/Hz       \t Z'/Ohm     \t -Z''/Ohm   \t time/s    \t\n 41",
        " {f:.9g}\t {re:.9g}\t {minus:.9g}\t 1\t ",
    ),
    "ecochemie.dfr": ("VERSION8.0\n 41\n 1", " {f:.9g}\n {re:.9g}\n {minus:.9g}\n 0\n 0\n 0\n 0\n 0\n 0"),
    "ivium.idf": ("\0\0H\nstarttime=\nprimary_data    \n3         \n41        ", "{re:.9g}  {im:.9g}\t{f:.9g} "),
    "lcr.csv": ("FREQUENCY[Hz],Rs[ohm],Xs[ohm]", "{f:.9g},{re:.9g},{im:.9g}"),
    "lcr polar.csv": ("Freq (Hz);Z (ohm);θ (deg)", "{f:.9g};{size:.9g};{deg_point}"),
    "radians.csv": ("f (Hz),|Z| (ohm),phase (rad)", "{f:.9g},{size:.9g},{radians:.12g}"),
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
                radians=math.radians(degrees),
                **{name: f"{x:.12g}".replace(".", ",") for name, x in comma.items()},
            )
        )  # fmt: skip
    path.write_text("\n".join(lines) + "\n" + tail, encoding="latin-1" if path.suffix == ".DTA" else "utf-8")
    return path


def write_layouts(folder: Path) -> list[Path]:
    """Write a spectrum in every layout."""
    z = impedance(FREQUENCY, **TRUTH)
    return [write(folder / name, *layout, z) for name, layout in FILES.items()]


@pytest.mark.parametrize("name", list(FILES))
def test_files_of_analysers(tmp_path: Path, name: str):
    z = impedance(FREQUENCY, **TRUTH)
    tail = "</Segment1>\n<Segment2>\n" if name.endswith(".par") else ""
    path = write(tmp_path / name, *FILES[name], z, tail)
    assert is_spectrum(path)
    read = fitact.read_spectrum(path)
    np.testing.assert_allclose(read.frequency, FREQUENCY, rtol=1e-8)
    np.testing.assert_allclose(read.values, z, rtol=1e-7)


@pytest.mark.parametrize(("unit", "factor"), [("mohm", 1e-3), ("kOHM", 1e3), ("MΩ", 1e6), ("GOhm", 1e9)])
def test_prefixes_of_the_unit(tmp_path: Path, unit: str, factor: float):
    read = fitact.read_spectrum(broken(tmp_path, f"f_Hz,Re(Z)/{unit},Im(Z)/{unit}", *GOOD))
    np.testing.assert_allclose(read.values, factor * (1e5 - 1e5j), rtol=1e-12)


def test_a_table_beyond_long_headers_and_others(tmp_path: Path):
    """Impedances below the long record of an open circuit, where Gamry's program writes them."""
    before = "\n".join(["EXPLAIN", "OCVCURVE\tTABLE", "\tPt\tT\tVf", *(f"\t{n}\t{n}\t-0.1" for n in range(3000))])
    header, row = FILES["gamry.DTA"]
    path = write(tmp_path / "late.DTA", header.replace("EXPLAIN", before), row, impedance(FREQUENCY, **TRUTH))
    assert path.stat().st_size > 30_000
    assert is_spectrum(path)
    assert len(fitact.read_spectrum(path)) == FREQUENCY.size


def test_sweeps_of_one_file_are_told_apart(tmp_path: Path):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], impedance(FREQUENCY, **TRUTH))
    rows = path.read_text().splitlines()[1:]
    other = write(path, *FILES["plain.csv"], impedance(FREQUENCY, **TRUTH) / 2.0).read_text().splitlines()[1:]
    path.write_text("\n".join([NAMES, *rows[::-1], *other[::-1], "0,0,0"]))
    found = fitact.read_spectra(path)
    assert [len(each) for each in found] == [41, 41]
    np.testing.assert_allclose(found[1].values, found[0].values / 2.0, rtol=1e-7)
    assert "1 rows without a frequency" in found[0].notes[0]
    with pytest.raises(fitact.InputError, match="holds 2 spectra; choose one"):
        fitact.read_spectrum(path)
    assert fitact.read_spectrum(path, 2).fingerprint == found[1].fingerprint
    with pytest.raises(fitact.InputError, match="there is no number 3"):
        fitact.read_spectrum(path, 3)
    with pytest.raises(fitact.InputError, match="write a number from 1, or all"):
        app(["fit", str(path), "--segment", "x"])


def load(frequency: np.ndarray) -> np.ndarray:
    """Return the impedance of 30 ohm in series with 1 uF."""
    return 30.0 + 1.0 / (2j * np.pi * frequency * 1e-6)


DIGILENT = "Frequency (Hz),Channel 1 Magnitude (dB),Channel 2 Magnitude (dB)"


@pytest.mark.parametrize(
    ("header", "row", "scale"),
    [
        (f"{DIGILENT},Channel 2 Phase (deg)", "{f},{one},{two},{deg}", 1.0),
        (
            "% Frequency Response Analyzer\n% Frequency (Hz), Channel A Magnitude (dBm), Channel A Phase (deg),"
            " Channel B Magnitude (dBm), Channel B Phase (deg), Math (Ka B / Ka A) Magnitude (dBm)",
            "{f}, {one}, 10, {two}, {later}, 0",
            1.0,
        ),
        ("in Sa,Frequency in Hz,Gain in dB,Phase in °,Amplitude in Vpp", "1,{f},{gain},{deg},1", 1.0),
        ("f (kHz);Gain (V/V);Phase (rad)", "{f};{ratio};{rad}", 1e3),
        ("#,Frequency (Hz),Amplitude (Vpp),Gain (dB),Phase (°)", "1,{f},1,{gain},{deg}", 1.0),
        ("Frequency(Hz),Amplitude(dB),Phase(deg)", "{f},{gain},{deg}", 1.0),
        ("Frequency Log(Hz), Gain (dB), Phase (deg)", "{log}, {gain}, {deg}", 1.0),
        (f"{DIGILENT},Channel 1 Phase (deg)", "{f},{two},{one},{deg}", 1.0),
    ],
    ids=["Digilent", "Moku", "R&S", "ratio", "Keysight", "Siglent", "PicoScope", "swapped"],
)  # fmt: skip
def test_frequency_responses(tmp_path: Path, header: str, row: str, scale: float):
    frequency = np.geomspace(10.0, 1e5, 30)
    gain_over_shunt = 50.0 / (50.0 + load(frequency))
    lines = [header]
    for f, h in zip(frequency, gain_over_shunt, strict=True):
        gain, degrees = 20.0 * math.log10(abs(h)), math.degrees(np.angle(h))
        cells = {
            "one": -3.0,
            "two": gain - 3.0,
            "gain": gain,
            "deg": degrees,
            "later": degrees + 10.0,
            "log": math.log10(f),
        }
        lines.append(row.format(f=f / scale, ratio=abs(h), rad=math.radians(degrees), **cells))
    path = tmp_path / "bode.csv"
    path.write_text("\n".join(lines), encoding="latin-1")
    read = fitact.read_spectrum(path)
    assert read.channel == "Vsc"
    np.testing.assert_allclose(read.frequency, frequency, rtol=1e-12)
    np.testing.assert_allclose(read.values, gain_over_shunt, rtol=1e-9)
    assert bool(read.warnings) == ("Channel 1 Phase" in header)
    over_shunt = fitact.read_spectrum(path, shunt=50.0)
    np.testing.assert_allclose(over_shunt.values, load(frequency), rtol=1e-8)


def test_a_band(tmp_path: Path):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], impedance(FREQUENCY, **TRUTH))
    part = fitact.read_spectrum(path).select_band(10.0, 1e4)
    assert part.frequency[[0, -1]] == pytest.approx([10.0, 1e4])
    assert "10 Hz to 10 kHz" in part.notes[-1]
    with pytest.raises(fitact.InputError, match="2 of 41 points"):
        fitact.read_spectrum(path).select_band(10.0, 15.0)


REAL = Path(__file__).parents[3] / "shared" / "real"
COUNTS = {
    "impedance_py": {"exampleDataGamry.DTA": 72, "exampleDataAutolab.txt": 41, "exampleDataParstat.txt": 31},
    "bode": {"R10k_0.csv": 1001, "MokuGo_47R_100R_shunt.csv": 512},
}


@pytest.mark.skipif(not REAL.exists(), reason="the files of others' instruments are not shipped")
def test_files_of_other_peoples_instruments():
    for path in sorted((REAL / "pyimpspec").iterdir()):
        first = fitact.read_spectra(path)[0]
        assert len(first) == 29, path
        assert first.frequency[-1] == pytest.approx(1e4)
        assert first.values[-1] == pytest.approx(109.009 - 26.5557j, abs=0.01)
    assert len(fitact.read_spectra(REAL / "pyimpspec" / "case-multiple-spectra.csv")) == 4
    for kind, counts in COUNTS.items():
        for name, count in counts.items():
            assert len(fitact.read_spectrum(REAL / kind / name)) == count
    for name in ("exampleDataZPlot.z", "exampleDataZPlot_noComments.z", "exampleDataCHInstruments.txt"):
        assert fitact.read_spectrum(REAL / "impedance_py" / name).channel == "impedance"
    with pytest.raises(fitact.InputError, match="no line names a frequency"):
        fitact.read_spectrum(REAL / "impedance_py" / "exampleDataBioLogic_MissingFreq.mpt")
    low = fitact.read_spectrum(REAL / "bode" / "bode_low_1v4753ohm96_73nf.csv")
    corner = 1.0 / (2.0 * np.pi * 4753.0 * 96.73e-9)
    below = low.frequency < 3e3
    ideal = 1.0 / (1.0 + 1j * low.frequency[below] / corner)
    assert np.abs(low.values[below] / ideal - 1.0).max() < 0.05
    for name in ("MokuGo_47R_100R_shunt.csv", "RohdeSchwarz_47R_100R_shunt.csv"):
        found = fitact.read_spectrum(REAL / "bode" / name, shunt=100.0)
        assert np.median(np.abs(found.values[found.frequency < 1e5])) == pytest.approx(47.5, rel=0.02)


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
    "magnitude without unit": (["f_Hz,magnitude,phase", *GOOD], "may be an impedance in ohm, or a gain"),
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
    with pytest.raises(fitact.InputError, match="is a spectrum, without time"):
        fitact.read(write(tmp_path / "plain.csv", *FILES["plain.csv"], impedance(FREQUENCY, **TRUTH)))
    with pytest.raises(fitact.InputError, match="no line names a frequency"):
        fitact.read_spectrum(finger_path)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 3e-2])
def test_kramers_kronig_passes_what_a_circuit_gives(noise: float):
    """For each seed, noise fails with probability 2e-4 at most."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        z = impedance(FREQUENCY, **TRUTH, alpha=rng.uniform(0.7, 1.0))
        z = z * (1.0 + noise * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size)))
        assert check_kramers_kronig(fitact.Spectrum.from_arrays(FREQUENCY, z)).passed


def test_kramers_kronig_names_a_bad_point_and_the_band_without_it():
    z = impedance(FREQUENCY, **TRUTH) * (1.0 + 1e-3 * np.random.default_rng(1).standard_normal(FREQUENCY.size))
    z[10] *= 1.1
    found = check_kramers_kronig(fitact.Spectrum.from_arrays(FREQUENCY, z))
    assert not found.passed
    assert "17.78 Hz" in found.doubt
    assert found.band[0] in FREQUENCY[11:14]  # those beside it may fail, too
    assert found.band[1] == FREQUENCY[-1]
    assert 0.06 < found.worst_residual < 0.11  # the point pulls the fit towards it


def test_inspect(tmp_path: Path, capfd):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], impedance(FREQUENCY, **TRUTH))
    with pytest.raises(SystemExit):
        app(["inspect", str(path), "--band", "10Hz..10kHz"])
    printed = capfd.readouterr().out
    assert "25 points, 10 Hz to 10 kHz" in printed
    assert "negative (capacitive)" in printed
    assert "The Kramers-Kronig test passes" in printed
    with pytest.raises(SystemExit):
        app(["inspect", str(path), "--json"])
    assert json.loads(capfd.readouterr().out)["kramers_kronig"]["passed"] is True
