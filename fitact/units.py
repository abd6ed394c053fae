"""Quantities with units, for input and output only; internally all numbers are floats in SI units."""

import functools
import math
import re
from typing import Any

import lazy_loader

from fitact.errors import InputError

pint = lazy_loader.load("pint")  # its import takes 0.4 s, and only text input needs it

_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
# accepted units, including spellings in ASCII
PREFIX_FACTORS = {symbol: float(f"1e{n}") for n, symbol in (*_PREFIXES.items(), (-6, "u"), (-6, "μ"), (3, "K"))}
_SYMBOLS = {"ohm": "Ω", "1": ""}

# unit and meaning of each quantity
PARAMETERS = {  # of the circuit and the friction
    "Rsc": ("ohm", "skin resistance Rsc"),
    "Csc": ("F", "skin capacitance Csc"),
    "Ci": ("F", "insulator capacitance Ci"),
    "Ri": ("ohm", "leak resistance of the insulator Ri"),
    "R_H": ("ohm", "body resistance R_H"),
    "grounding_Rsc": ("ohm", "resistance of the grounding skin"),
    "grounding_Csc": ("F", "capacitance of the grounding skin"),
    "Z": ("ohm", "resistance to earth Z"),
    "Z_capacitance": ("F", "capacitance to earth"),
    "series_resistor": ("ohm", "series resistor"),
    "Rgap": ("ohm", "gap resistance Rgap"),
    "Cgap": ("F", "gap capacitance Cgap"),
    "alpha": ("1", "exponent of the fractional skin"),
    "mu": ("1", "coefficient of friction mu"),
    "fN": ("N", "normal force fN"),
    "force_scale": ("1", "measured electrostatic force over the computed one"),
}
NUISANCES = {  # quantities of the measurement; {}: the channel
    "gain": ("1", "gain of {}"),
    "gain_V": ("1", "gain of V"),
    "compensation": ("1", "gain of {} at high frequency over that at low frequency"),
    "compensation_V": ("1", "gain of V at high frequency over that at low frequency"),
    "nonlinearity_even": ("1", "1 + even non-linearity of {}, relative to the range"),
    "nonlinearity_odd": ("1", "1 + odd non-linearity of {}, relative to the range"),
    "nonlinearity_V_even": ("1", "1 + even non-linearity of V, relative to the range"),
    "nonlinearity_V_odd": ("1", "1 + odd non-linearity of V, relative to the range"),
    "probe_resistance": ("ohm", "input resistance that loads the skin"),
    "probe_capacitance": ("F", "input capacitance that loads the skin"),
    "stray_capacitance": ("F", "stray capacitance of panel and cable"),
    "delay": ("s", "delay of {} against V"),
    "clock": ("1", "relative deviation of the drive frequency from the stated one"),
    "sigma": ("V", "noise of {}, standard deviation"),
    "sigma_Z": ("1", "noise of the impedance, relative standard deviation"),
    "sigma_H": ("1", "noise of the gain Vsc/V, relative standard deviation"),
    "offset": ("V", "constant offset of {}"),
    "drift": ("V", "drift of {} over half the record"),
    "hum_50Hz_cos": ("V", "50 Hz hum in {}, cosine part"),
    "hum_50Hz_sin": ("V", "50 Hz hum in {}, sine part"),
    "hum_60Hz_cos": ("V", "60 Hz hum in {}, cosine part"),
    "hum_60Hz_sin": ("V", "60 Hz hum in {}, sine part"),
    "hum_150Hz_cos": ("V", "third harmonic of 50 Hz hum in {}, cosine part"),
    "hum_150Hz_sin": ("V", "third harmonic of 50 Hz hum in {}, sine part"),
    "hum_180Hz_cos": ("V", "third harmonic of 60 Hz hum in {}, cosine part"),
    "hum_180Hz_sin": ("V", "third harmonic of 60 Hz hum in {}, sine part"),
    "charge": ("V", "transient in {} at the first sample, from the unknown initial charge"),
    "charge_2": ("V", "second transient in {} at the first sample"),
    "charge_3": ("V", "third transient in {} at the first sample"),
    "charge_4": ("V", "fourth transient in {} at the first sample"),
    "ringing": ("V", "state of the force sensor at the first sample"),
    "ringing_2": ("V", "rate of the force sensor at the first sample"),
    "crosstalk": ("V", "part of {} in proportion to V, at the largest V"),
    "crosstalk_2": ("V", "part of {} in proportion to dV/dt, at the largest dV/dt"),
    "sensor_frequency": ("Hz", "natural frequency of the force sensor"),
    "sensor_damping": ("1", "damping ratio of the force sensor"),
}
GEOMETRY = {  # what force and friction rest on beside the circuit
    "skin_thickness": ("m", "skin thickness Tsc"),
    "skin_permittivity": ("1", "skin permittivity"),
    "insulator_thickness": ("m", "insulator thickness Ti"),
    "insulator_permittivity": ("1", "insulator permittivity"),
    "contact_area": ("m^2", "contact area A"),
    "friction_coefficient": ("1", "coefficient of friction mu"),
}
DERIVED = {
    "g": ("1", "divider g = Ci / (2 Ci + Csc)"),
    "b": ("s", "time constant b = Rsc (2 Ci + Csc); a leak shortens it"),
    "force_mean": ("N", "electrostatic force, mean"),
    "force_peak": ("N", "electrostatic force, peak"),
    "force_rms": ("N", "electrostatic force, rms"),
    "friction_mean": ("N", "friction mu (force + fN), mean"),
    "times_threshold": ("1", "alternating friction over its detection threshold"),
}
_UNITS = {name: unit for table in (PARAMETERS, NUISANCES, GEOMETRY, DERIVED) for name, (unit, _) in table.items()}
_UNITS |= {
    "Vsc_peak_to_peak": "V", "log_sd": "1", "slope": "1", "correlation": "1", "sensation_level": "dB",
    "force_at_f": "N", "force_at_2f": "N", "friction_at_f": "N", "friction_at_2f": "N",
}  # fmt: skip


@functools.cache
def _registry() -> Any:
    registry = pint.UnitRegistry()
    registry.define("@alias ohm = Ohm = OHM = ohms")
    return registry


def parse_quantity(value: object, unit: str) -> float:
    """Return a quantity such as ``"160 kohm"`` as a float in the SI unit `unit`; a bare number is in `unit`."""
    remedy = f"write a number with a unit, such as '1 {unit}'"
    if isinstance(value, str) and (plain := _parse_plain_quantity(value, unit)) is not None:
        value = plain
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{value!r} is not a quantity; {remedy}")
    if isinstance(value, str):
        try:
            quantity = _registry().Quantity(value)
            value = float(quantity.to("" if quantity.unitless else unit).magnitude)  # "10 %" is 0.1
        except pint.DimensionalityError as error:
            wanted = f"in a unit of {unit}; write it as a multiple of {unit}" if unit else "a plain number; write one"
            raise InputError(f"'{value}' is not {wanted}") from error
        except Exception as error:  # pint raises a dozen exceptions, including errors of tokenize
            raise InputError(f"'{value}' is not a quantity; {remedy}") from error
    if not math.isfinite(value):
        raise InputError(f"{value} is not finite; {remedy}")
    return float(f"{value:.15g}")  # 200 um is 2e-4 m, not 1.9999999999999998e-4


def _parse_plain_quantity(text: str, unit: str) -> float | None:
    """Return a number with a prefix and exactly this `unit`, as most scenes have, without pint; else None."""
    base, _, power = unit.partition("^")
    match = (
        re.fullmatch(r"([+-]?\d+(?:\.\d*)?(?:e[+-]?\d+)?) ?(\w?)" + re.escape(unit), text) if base.isalpha() else None
    )
    factors = PREFIX_FACTORS | {"c": 1e-2}
    if match is None or match[2] not in factors:
        return None
    return float(match[1]) * factors[match[2]] ** int(power or 1)


def format_exact(value: float, unit: str) -> str:
    """Return `value` as text that `parse_quantity` reads back exactly, e.g. "1.35 nF" for 1.35e-9 and "F"."""
    # the prefix of a power would be raised, too
    exponent = _prefix_exponent(value) if value and unit and "^" not in unit else 0
    prefix = _PREFIXES[exponent].replace("µ", "u")
    return f"{value / 10.0**exponent:.15g} {prefix}{unit}".rstrip()


def format_engineering(value: float, unit: str, digits: int = 4) -> str:
    """Return `value` as text with an SI prefix: ``format_engineering(1.35e-9, "F") == "1.35 nF"``."""
    size, symbol = choose_prefixed_unit(value, unit)
    number = value / size
    if 10.0**digits <= abs(number) < 1000.0:  # which `g` would write with an exponent
        number, digits = float(f"{number:.{digits}g}"), 4
    return f"{number:.{digits}g} {symbol}".rstrip()


def choose_prefixed_unit(value: float, unit: str) -> tuple[float, str]:
    """Return size and symbol of the prefixed `unit` for `value`, e.g. (1e-9, "nF") for 1.35e-9 and "F"."""
    symbol = _SYMBOLS.get(unit, unit)
    if not math.isfinite(value) or value == 0.0 or not symbol:
        return 1.0, symbol
    power = int(unit.partition("^")[2] or 1)  # which the prefix is raised to, too
    exponent = _prefix_exponent(math.copysign(abs(value) ** (1.0 / power), value))
    return 10.0 ** (power * exponent), _PREFIXES[exponent] + symbol


def _prefix_exponent(value: float) -> int:
    return max(min(_PREFIXES), min(max(_PREFIXES), 3 * math.floor(math.log10(abs(value)) / 3 + 1e-12)))


def quantity_unit(name: str) -> str:
    """Return the SI unit of a quantity; the name of a nuisance may end in a channel label, e.g. "sigma_I_2"."""
    bare = name if name in _UNITS else re.sub(r"_\d+$", "", name)
    unit = _UNITS[bare if bare in _UNITS else re.sub("_(I|Z|H|Ft)$", "", bare)]
    if unit != "V" or not bare.endswith(("_I", "_Ft")):
        return unit
    return "A" if bare.endswith("_I") else "N"


def format_percent(fraction: float) -> str:
    """Return a fraction as text: ``format_percent(0.0123) == "1.2 %"``."""
    return f"{100.0 * fraction:.0f} %" if fraction >= 0.995 else f"{100.0 * fraction:.2g} %"
