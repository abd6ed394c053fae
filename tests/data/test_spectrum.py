"""Files of spectra: layouts of analysers and of frequency-response analysers, real ones too, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.cli import app
from fitact.data.kramers_kronig import check_kramers_kronig
from fitact.readers.spectrum import is_spectrum
from tests.layouts.layout import REAL
from tests.layouts.spectra import FILES, FREQUENCY, GAINS, SHUNT, TRUTH, Z, impedance, write, write_gain


@pytest.mark.parametrize(("unit", "factor"), [("mohm", 1e-3), ("kOHM", 1e3), ("MΩ", 1e6), ("GOhm", 1e9)])
def test_prefixes_of_the_unit(tmp_path: Path, unit: str, factor: float):
    read = fitact.read_spectrum(broken(tmp_path, f"f_Hz,Re(Z)/{unit},Im(Z)/{unit}", *GOOD))
    np.testing.assert_allclose(read.values, factor * (1e5 - 1e5j), rtol=1e-12)


def test_a_table_beyond_long_headers_and_others(tmp_path: Path):
    """Impedances below the long record of an open circuit, where Gamry's program writes them."""
    before = "\n".join(["EXPLAIN", "OCVCURVE\tTABLE", "\tPt\tT\tVf", *(f"\t{n}\t{n}\t-0.1" for n in range(3000))])
    header, row = FILES["gamry.DTA"]
    path = write(tmp_path / "late.DTA", header.replace("EXPLAIN", before), row, Z)
    assert path.stat().st_size > 30_000
    assert is_spectrum(path)
    assert len(fitact.read_spectrum(path)) == FREQUENCY.size


def test_sweeps_of_one_file_are_told_apart(tmp_path: Path):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], Z)
    rows = path.read_text().splitlines()[1:]
    other = write(path, *FILES["plain.csv"], Z / 2.0).read_text().splitlines()[1:]
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


@pytest.mark.parametrize("name", GAINS)
def test_gains_over_a_shunt_are_impedances(tmp_path: Path, name: str):
    path = write_gain(name, tmp_path)
    assert bool(fitact.read_spectrum(path).warnings) == (name == "swapped.csv")
    over_shunt = fitact.read_spectrum(path, shunt=SHUNT)
    np.testing.assert_allclose(over_shunt.values, Z, rtol=1e-8)


def test_a_band(tmp_path: Path):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], Z)
    part = fitact.read_spectrum(path).select_band(10.0, 1e4)
    assert part.frequency[[0, -1]] == pytest.approx([10.0, 1e4])
    assert "10 Hz to 10 kHz" in part.notes[-1]
    with pytest.raises(fitact.InputError, match="2 of 41 points"):
        fitact.read_spectrum(path).select_band(10.0, 15.0)


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


@pytest.mark.parametrize("noise", [0.0, 1e-3, 3e-2])
def test_kramers_kronig_passes_what_a_circuit_gives(noise: float):
    """For each seed, noise fails with probability 2e-4 at most."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        z = impedance(FREQUENCY, **TRUTH, alpha=rng.uniform(0.7, 1.0))
        z = z * (1.0 + noise * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size)))
        assert check_kramers_kronig(fitact.Spectrum.from_arrays(FREQUENCY, z)).passed


def test_kramers_kronig_names_a_bad_point_and_the_band_without_it():
    z = Z * (1.0 + 1e-3 * np.random.default_rng(1).standard_normal(FREQUENCY.size))
    z[10] *= 1.1
    found = check_kramers_kronig(fitact.Spectrum.from_arrays(FREQUENCY, z))
    assert not found.passed
    assert "17.78 Hz" in found.doubt
    assert found.band[0] in FREQUENCY[11:14]  # those beside it may fail, too
    assert found.band[1] == FREQUENCY[-1]
    assert 0.06 < found.worst_residual < 0.11  # the point pulls the fit towards it


def test_inspect(tmp_path: Path, capfd):
    path = write(tmp_path / "z.csv", *FILES["plain.csv"], Z)
    with pytest.raises(SystemExit):
        app(["inspect", str(path), "--band", "10Hz..10kHz"])
    printed = capfd.readouterr().out
    assert "25 points, 10 Hz to 10 kHz" in printed
    assert "negative (capacitive)" in printed
    assert "The Kramers-Kronig test passes" in printed
    with pytest.raises(SystemExit):
        app(["inspect", str(path), "--json"])
    assert json.loads(capfd.readouterr().out)["kramers_kronig"]["passed"] is True
