"""Layouts of spectra: impedances of analysers and LCR meters, and gains of frequency-response analysers."""

import functools
import math
from pathlib import Path

import numpy as np

from tests.layouts.layout import Layout

FREQUENCY = np.geomspace(1.0, 1e5, 41)
TRUTH = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.4e-9}
SHUNT = 50.0  # ohm, over which the gains are measured


def impedance(frequency: np.ndarray, Rsc: float, Csc: float, Ci: float, alpha: float = 1.0) -> np.ndarray:
    """Return the impedance of two layers in series with the insulator; for alpha < 1 the layers are Cole elements."""
    s = 2j * np.pi * frequency
    return 2.0 * Rsc / (1.0 + (s * Rsc * Csc) ** alpha) + 1.0 / (s * Ci)


Z = impedance(FREQUENCY, **TRUTH)
GAIN = SHUNT / (SHUNT + Z)
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
    "parstat.txt": (
        "Potential (V)\tElapsed Time (s)\tFrequency (Hz)\tZre (ohms)\tZim (ohms)\t|Vac| (V)",
        "0\t{n}\t{f:.9g}\t{re:.9g}\t{im:.9g}\t0.01",
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
# who writes these files, and real ones
PROGRAMS: dict[str, tuple[str, ...]] = {
    "plain.csv": ("any table",), "bare.csv": ("impedance.py", "impedance_py/exampleData.csv"),
    "negative.csv": ("any table",), "polar.csv": ("any table",), "words.csv": ("any table",),
    "primes.csv": ("any table",), "radians.csv": ("any table",),
    "gamry.DTA": ("Gamry", "impedance_py/exampleDataGamry.DTA", "pyimpspec/data.dta"),
    "biologic.mpt": ("BioLogic", "impedance_py/exampleDataBioLogic.mpt", "pyimpspec/data.mpt"),
    "autolab.txt": ("Autolab", "impedance_py/exampleDataAutolab.txt"),
    "zplot.z": ("ZPlot", "impedance_py/exampleDataZPlot.z", "pyimpspec/data.z"),
    "quoted.z": ("ZPlot", "impedance_py/exampleDataZPlot_noComments.z"),
    "versastudio.par": ("VersaStudio", "impedance_py/exampleDataVersaStudio.par"),
    "parstat.txt": ("Parstat", "impedance_py/exampleDataParstat.txt"),
    "chip.csv": ("AD5933",), "registers.csv": ("AD5933",), "powersuite.txt": ("PowerSuite",),
    "count.i2b": ("Elchemea", "pyimpspec/data.i2b"), "powersuite.P00": ("PowerSuite", "pyimpspec/data.P00"),
    "ecochemie.dfr": ("Ecochemie", "pyimpspec/data.dfr"),
    "ivium.idf": ("Ivium", "pyimpspec/data.idf", "pyimpspec/data.ids"),
    "chi.txt": ("CH Instruments", "impedance_py/exampleDataCHInstruments.txt"),
    "lcr.csv": ("LCR meters",), "lcr polar.csv": ("LCR meters",),
}  # fmt: skip
DIGILENT = "Frequency (Hz),Channel 1 Magnitude (dB),Channel 2 Magnitude (dB)"
# program, header, row, unit of the frequency in Hz, and real files
GAINS: dict[str, tuple[str, str, str, float, *tuple[str, ...]]] = {
    "digilent.csv": (
        "Digilent WaveForms", f"{DIGILENT},Channel 2 Phase (deg)", "{f},{one},{two},{deg_point}", 1.0,
        "bode/R10k_0.csv", "bode/bode_low_1v4753ohm96_73nf.csv",
    ),
    "moku.csv": (
        "Moku:Go",
        "% Frequency Response Analyzer\n% Frequency (Hz), Channel A Magnitude (dBm), Channel A Phase (deg),"
        " Channel B Magnitude (dBm), Channel B Phase (deg), Math (Ka B / Ka A) Magnitude (dBm)",
        "{f}, {one}, 10, {two}, {later}, 0", 1.0, "bode/MokuGo_47R_100R_shunt.csv",
    ),
    "rohde.csv": (
        "Rohde & Schwarz", "in Sa,Frequency in Hz,Gain in dB,Phase in °,Amplitude in Vpp", "1,{f},{gain},{deg_point},1",
        1.0, "bode/RohdeSchwarz_47R_100R_shunt.csv",
    ),
    "ratio.csv": ("any table", "f (kHz);Gain (V/V);Phase (rad)", "{f};{size};{radians}", 1e3),
    "keysight.csv": (
        "Keysight", "#,Frequency (Hz),Amplitude (Vpp),Gain (dB),Phase (°)", "1,{f},1,{gain},{deg_point}", 1.0,
    ),
    "siglent.csv": ("Siglent", "Frequency(Hz),Amplitude(dB),Phase(deg)", "{f},{gain},{deg_point}", 1.0),
    "picoscope.csv": (
        "PicoScope's FRA", "Frequency Log(Hz), Gain (dB), Phase (deg)", "{log}, {gain}, {deg_point}", 1.0,
    ),
    "swapped.csv": ("Digilent WaveForms", f"{DIGILENT},Channel 1 Phase (deg)", "{f},{two},{one},{deg_point}", 1.0),
    "ltspice polar.txt": ("LTspice's AC analysis", "Freq.\tV(skin)", "{f}\t({gain}dB,{deg_point}°)", 1.0),
    "ltspice.txt": ("LTspice's AC analysis", "Freq.\tV(skin)", "{f}\t{re},{im}", 1.0),
}  # fmt: skip
# what an LCR meter shows, by its handbook: series and parallel equivalents of an impedance
OMEGA, Y = 2.0 * np.pi * FREQUENCY, 1.0 / Z
SHOWN = {
    "Cp": Y.imag / OMEGA, "Cs": -1.0 / (OMEGA * Z.imag), "Lp": -1.0 / (OMEGA * Y.imag), "Ls": Z.imag / OMEGA,
    "Rp": 1.0 / Y.real, "Rs": Z.real, "G": Y.real, "B": Y.imag, "D": Z.real / abs(Z.imag), "Q": abs(Z.imag) / Z.real,
}  # fmt: skip
PAIRS = [
    *((c, other) for c in ("Cp", "Cs") for other in ("D", "Q")), ("Cp", "G"), ("Cp", "Rp"), ("Cs", "Rs"), ("Ls", "Rs"),
    ("Lp", "Rp"), ("Lp", "G"), ("G", "B"),
]  # fmt: skip


def write(path: Path, header: str | None, row: str, z: np.ndarray, tail: str = "", unit: float = 1.0) -> Path:
    """Write a spectrum, with its frequencies in a `unit` (Hz)."""
    lines = [header] if header is not None else []
    for n, (f, value) in enumerate(zip(FREQUENCY, z, strict=True)):
        degrees, gain = math.degrees(np.angle(value)), 20.0 * math.log10(abs(value))
        comma = {"kf": f / 1e3, "kz": abs(value) / 1e3, "deg": degrees}
        lines.append(
            row.format(
                n=n, f=f / unit, re=value.real, im=value.imag, minus=-value.imag, size=abs(value),
                deg_point=f"{degrees:.12g}", radians=math.radians(degrees), gain=f"{gain:.12g}", one=-3.0,
                two=gain - 3.0, later=degrees + 10.0, log=math.log10(f),
                **{name: f"{x:.12g}".replace(".", ",") for name, x in comma.items()},
            )
        )  # fmt: skip
    path.write_text("\n".join(lines) + "\n" + tail, encoding="latin-1" if path.suffix == ".DTA" else "utf-8")
    return path


def write_impedance(name: str, folder: Path) -> Path:
    tail = "</Segment1>\n<Segment2>\n" if name.endswith(".par") else ""
    return write(folder / name, *FILES[name], Z, tail)


def write_gain(name: str, folder: Path) -> Path:
    _, header, row, unit, *_ = GAINS[name]
    return write(folder / name, header, row, GAIN, unit=unit)


def write_pair(first: str, second: str, folder: Path) -> Path:
    """Write what an LCR meter shows of the impedance."""
    path, columns = folder / "meter.csv", (FREQUENCY, SHOWN[first], SHOWN[second])
    np.savetxt(path, np.column_stack(columns), "%.9e", ",", header=f"Frequency,{first},{second}", comments="")
    return path


def _ending(name: str) -> str:
    return ".idf, .ids" if name.endswith(".idf") else Path(name).suffix


SPECTRA: tuple[Layout, ...] = (
    *(
        Layout(
            program,
            _ending(name),
            "impedance",
            functools.partial(write_impedance, name),
            kind="spectrum",
            real=tuple(real),
        )
        for name, (program, *real) in PROGRAMS.items()
    ),
    *(
        Layout("LCR meters", ".csv", "impedance", functools.partial(write_pair, *pair), kind="spectrum")
        for pair in PAIRS
    ),
    *(
        Layout(program, _ending(name), "gain", functools.partial(write_gain, name), kind="spectrum", real=tuple(real))
        for name, (program, _, _, _, *real) in GAINS.items()
    ),
)
