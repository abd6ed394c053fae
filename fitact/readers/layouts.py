"""Keywords in headers of oscilloscopes and DAQ programs, in one table, so that one reader serves all formats."""

import re

import numpy as np

from fitact.errors import InputError
from fitact.units import PREFIX_FACTORS

# manufacturer of a file, from its first lines; the first match counts
MAKERS: tuple[tuple[str, re.Pattern[str]], ...] = tuple(
    (maker, re.compile(mark, re.IGNORECASE | re.MULTILINE))
    for maker, mark in (
        ("fitact", r"^\W*time_\w+\W|[,;\t ]time_\w+"),
        ("Siglent", r"^(?:Record Length|Sample Interval),\s*Analog:|^Model Number,\s*SD[SX]"),
        ("Tektronix TDS", r"^Record Length,[^,\n]*,.*,\s*-?[\d.]+"),
        ("Tektronix", r"^Waveform Type,|^TIME,(?:CH|REF|MATH)\d"),
        ("LeCroy", r"^LECROY"),
        ("Digilent WaveForms", r"^#\s*Digilent"),
        ("Rigol", r"Start,Increment|^\"?Number of Data points|^X,CH\d|^,CH\d|\bt(?:0|Inc) ="),
        ("Keysight", r"^x-axis,"),
        ("PicoScope", r"^\W*\((?:[fpnuµμm]?s)\)[,;\t]"),
        ("Saleae", r"^Time \[s\][,;\t]Channel \d"),
        ("GW Instek", r"^Memory Length,"),
        ("Rohde & Schwarz", r"^in s[,;\t]"),
    )
)

TIME_NAMES = frozenset((
    "time", "t", "x", "x-axis", "x_value", "xvalue", "s", "second", "seconds", "timestamp", "source",
    "zeit", "temps", "tiempo", "tempo", "tijd", "czas",
))  # fmt: skip
INDEX_NAMES = frozenset(["sample", "samples", "index", "sequence", "nr", "no", "n", "point", "row"])
# entries in a row of units that are no units, or other units
NOT_UNITS = frozenset((
    "", "sequence", "value", "none", "unknown", "ohm", "w", "watt", "hz", "khz", "db", "dbm", "pa", "%", "°c",
    "deg", "u",
))  # fmt: skip

# keys of a header, in lower case without blanks or punctuation
COUNT_KEYS = (
    "signalhardwarerecordlength",
    "recordlength",
    "memorylength",
    "numberofdatapoints",
    "segmentsize",
    "samples",
)
STEP_KEYS = (
    "sampleinterval", "increment", "tinc", "timestep", "dt", "tinterval", "xinc", "xincrement", "wfincrement",
    "signalresolution", "resolution", "samplingperiod", "hresolution", "clock", "deltax",
)  # fmt: skip
RATE_KEYS = ("samplerate", "samplingrate", "fs", "rate", "samplefrequency", "samplingfrequency")
START_KEYS = (
    "start", "t0", "tstart", "xorg", "xorigin", "starttime", "wfstartoffset", "hardwarexstart", "xstart", "hoffset",
    "x0",
)  # fmt: skip
GRID_KEYS = frozenset(("", *START_KEYS, *STEP_KEYS))
NAME_KEYS = ("multichannelsource", "source", "channeldata", "label", "tracename", "channel")
UNIT_KEYS = ("verticalunits", "verticalunit", "vunit", "units", "yunitlabel")
TIME_UNIT_KEYS = ("horizontalunits",)
ATTENUATION_KEYS = ("probeatten", "probeattenuation", "attenuation")
SEGMENT_KEYS = ("segments",)

_PREFIXES = ("", *"fpnuµμmkM")
_UNIT_SYMBOLS = {
    "s": "s", "S": "s", "sec": "s", "second": "s", "seconds": "s",
    "V": "V", "v": "V", "volt": "V", "volts": "V",
    "A": "A", "amp": "A", "amps": "A", "ampere": "A", "amperes": "A",
    "N": "N", "newton": "N", "newtons": "N",
}  # fmt: skip


def normalize_key(text: str) -> str:
    """Return a normalized key of a header, e.g. "numberofdatapoints" for "Number of Data points ="."""
    return re.sub(r"[^0-9a-zµμ]", "", text.lower())


def parse_unit(text: str) -> tuple[str, float] | None:
    """Return the SI unit (s, V, A or N) and the factor of a unit as written, e.g. ("s", 1e-3) for "(ms)", or None."""
    bare = text.strip().strip("()[]").strip()
    for length in (0, 1):
        prefix, symbol = bare[:length], bare[length:]
        unit = _UNIT_SYMBOLS.get(symbol) or (_UNIT_SYMBOLS.get(symbol.lower()) if len(symbol) > 2 else None)
        if unit and prefix in _PREFIXES:
            return unit, PREFIX_FACTORS[prefix]
    return None


def convert_time(time: np.ndarray, unit_text: str, place: str, remedy: str) -> np.ndarray:
    """Return the time in seconds; no stated unit means seconds."""
    unit = parse_unit(unit_text)
    if unit_text and (unit is None or unit[0] != "s"):
        raise InputError(f"{place}: '{unit_text}' is not a unit of time; {remedy}")
    return time * unit[1] if unit and unit[1] != 1.0 else time


def is_same_grid(time: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two channels have the same sampling times, to a hundredth of a step."""
    step = abs(time[-1] - time[0]) / max(time.size - 1, 1)
    return time.size == other.size and not np.max(np.abs(time - other)) > 0.01 * step


_NAME_AND_UNIT = (
    re.compile(r"^(?P<name>.*?)\s*[(\[](?P<unit>[^)\]]*)[)\]]$"),  # Channel 1 (V), Time [s]
    re.compile(r"^(?P<name>.*?)\s*\bin\s+(?P<unit>\S+)$"),  # C1 in V
    re.compile(r"^(?P<name>.*\S)\s+/\s+(?P<unit>\S+)$"),  # Time / s
    re.compile(r"^(?P<name>.*)_(?P<unit>[^_]+)$"),  # time_ms
)
_STANDARD_NAME = re.compile(r"^(?P<name>time|V|Vsc|I|Ft)(?:_(?P<unit>.+))?$", re.IGNORECASE)


def split_name_and_unit(cell: str) -> tuple[str, str]:
    """Return the name of a column, and its unit as written or ""."""
    contract = _STANDARD_NAME.match(cell)
    if contract:
        return contract["name"], contract["unit"] or ""
    for pattern in _NAME_AND_UNIT:
        match = pattern.match(cell)
        if match and parse_unit(match["unit"]):
            return match["name"].strip(), match["unit"]
    return cell, ""


def is_standard_name(name: str) -> bool:
    return _STANDARD_NAME.fullmatch(name) is not None


def normalize_channel(name: str) -> str:
    """Return the common form of the names "CH2", "Channel 2", "Chan 2" and "2" (Keysight)."""
    bare = re.sub(r"[\s_.-]", "", name.lower())
    return re.sub(r"^(channel|chan|ch|kanal|canal|ampl|column|col|c)(?=[0-9]+$|[a-z]$)", "", bare)
