"""Numeric claims of the reference paper, recomputed and compared.

The reference paper is "Electrostatic Tactile System Analyzing and Modelling" (2018). Its numbers imply three values of
Ci, and results are given for each. Verdicts apply to 1.35 nF, the value in its text, unless the claim says otherwise.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from fitact.compiled import double_precision
from fitact.model.circuit import Circuit, DirectGround, FinalCircuit, NaturalGround
from fitact.model.drive import Drive, Sine, Square, Triangle
from fitact.model.force import Contact, mean_force, plate_capacitance, plate_resistance
from fitact.model.skin import quality_factor, series_equivalent
from fitact.model.steady import mean_square, peak

Value = float | dict[str, float]

TEXT_CI, CI = "1.35 nF", 1.35e-9  # F


class PaperValues(NamedTuple):
    """Values of the reference paper in SI units, and its circuits with them."""

    Rsc: float = 160e3  # of one layer at 100 Hz
    Csc: float = 22e-9  # likewise
    R_H: float = 500.0
    Z: float = 14.5e6
    contact_area: float = 1e-4
    insulator_thickness: float = 1e-6
    insulator_permittivity: float = 3.9
    skin_thickness: float = 200e-6
    frequency: float = 100.0
    peak_to_peak: float = 360.0
    grounding_Rsc: tuple[float, ...] = (80e3, 110e3, 140e3, 170e3, 200e3)  # Fig. 5
    grounding_Csc: tuple[float, ...] = (8.85e-9, 17.7e-9, 26.5e-9, 35.4e-9, 44.2e-9)  # Fig. 6

    def final_circuit(self, Ci: float = CI) -> FinalCircuit:
        """Return the circuit of Fig. 11."""
        return FinalCircuit(self.Rsc, self.Csc, Ci)

    def direct_ground(self, Ci: float = CI, **others: Any) -> DirectGround:
        """Return the circuit of Fig. 3a, with `others` of its fields."""
        return DirectGround(self.Rsc, self.Csc, Ci, **{"R_H": self.R_H} | others)

    def natural_ground(self, Ci: float = CI) -> NaturalGround:
        """Return the circuit of Fig. 3b."""
        return NaturalGround(self.Rsc, self.Csc, Ci, self.Z)


VALUES = PaperValues()
_OMEGA = 2.0 * math.pi * VALUES.frequency
INSULATORS = {
    TEXT_CI: CI,
    "3.45 nF": float(plate_capacitance(VALUES.insulator_permittivity, VALUES.contact_area, VALUES.insulator_thickness)),
    "0.69 nF": 1.0 / (_OMEGA * 2.3e6),
}  # F; from the text, from eq. (3), and from |Z_Ci| = 2.3 Mohm
_SQUARE = Square(peak_to_peak=VALUES.peak_to_peak, frequency=VALUES.frequency)


class Claim(NamedTuple):
    """A statement of the reference paper, compared with the value computed by fitact."""

    id: str  # identifier of the equation or figure
    claim: str  # statement of the reference paper
    paper: float | None  # number in the reference paper, in `unit`, or None
    ours: Value  # value computed by fitact, or values by Ci if it depends on Ci
    unit: str  # SI unit
    verdict: str  # "agrees" or "differs"
    reason: str  # reason for the verdict, and what would make the numbers agree

    def to_dict(self) -> dict[str, Any]:
        """Return the claim in the form of reproduction.json."""
        return self._asdict()


def reproduce() -> tuple[Claim, ...]:
    """Compute and compare all claims, in the order of the reference paper."""
    parts = (
        _element_claims, _grounding_claims, _grounding_finger_claims, _equivalent_claims, _insulator_claims,
        _frequency_claims, _waveform_claims, _equation_claims,
    )  # fmt: skip
    with double_precision():
        return tuple(claim for part in parts for claim in part())


def _make_claim(
    id: str, claim: str, paper: float, ours: Value, unit: str, reason: str, tolerance: float = 0.005
) -> Claim:
    """Return the claim with its verdict, by the relative difference (or the absolute one if the paper claims 0).

    `tolerance` is 0.5 % for the paper's rounding, 1 % for a claimed 0, and 10 % if the paper says "about".
    """
    value = ours[TEXT_CI] if isinstance(ours, dict) else ours
    off = abs(value / paper - 1.0) if paper else abs(value)
    return Claim(id, claim, paper, ours, unit, "agrees" if off <= tolerance else "differs", reason)


def _map_insulators(function: Callable[[float], Any]) -> dict[str, float]:
    return {name: float(function(Ci)) for name, Ci in INSULATORS.items()}


def _element_claims() -> Iterator[Claim]:
    yield _make_claim(
        "eq3_Ci", "Ci of 1 um, permittivity 3.9 and 1 cm^2 is 1.35 nF", CI, INSULATORS["3.45 nF"], "F",
        "eq. (3) with the paper's own values gives 3.45 nF; 1.35 nF would need 2.56 um, a permittivity of 1.53 or"
        " 0.39 cm^2",
    )  # fmt: skip
    end = "the end of the range that the paper gives"
    middle = "the paper states no value for 100 Hz; this one, within its range, gives the paper's result"
    area, thickness = VALUES.contact_area, VALUES.skin_thickness
    for frequency, permittivity, resistivity, Csc, Rsc, why in (  # resistivity in ohm m
        ("10 Hz", 1e4, 1e5, 44.25e-9, 200e3, end),
        ("100 Hz", 5e3, 8e4, 22e-9, 160e3, middle),
        ("1 kHz", 2e3, 4e4, 8.85e-9, 80e3, end),
    ):
        suffix = frequency.replace(" ", "")
        yield _make_claim(
            f"eq3_Csc_{suffix}", f"Csc at {frequency}", Csc, float(plate_capacitance(permittivity, area, thickness)),
            "F", f"permittivity {permittivity:g}: {why}", 0.01,
        )  # fmt: skip
        yield _make_claim(
            f"eq4_Rsc_{suffix}", f"Rsc at {frequency}", Rsc, float(plate_resistance(resistivity, area, thickness)),
            "ohm", f"resistivity {resistivity:g} ohm m: {why}",
        )  # fmt: skip
    yield _make_claim(
        "eq7_ZCi_100Hz", "|1 / (j w Ci)| at 100 Hz is 2.3 Mohm", 2.3e6, _map_insulators(lambda Ci: 1.0 / (_OMEGA * Ci)),
        "ohm", "1.35 nF gives 1.18 Mohm; 2.3 Mohm corresponds to 0.69 nF",
    )  # fmt: skip
    yield _make_claim(
        "eq8_Zsc_100Hz", "|Zsc| at 100 Hz is 65.7 kohm", 65.7e3, abs(_skin_impedance(_OMEGA)), "ohm",
        "65.9 kohm with 22 nF; 65.7 kohm corresponds to 22.1 nF",
    )  # fmt: skip


def _grounding_claims() -> Iterator[Claim]:
    def ratio(measure: Callable[[Circuit], Any], Ci: float = CI) -> float:
        """Return the measure under direct ground over the measure under natural ground."""
        return float(measure(VALUES.direct_ground(Ci)) / measure(VALUES.natural_ground(Ci)))

    def gain(circuit: Circuit) -> Any:
        return jnp.abs(circuit.transfer_function(_OMEGA))

    yield _make_claim(
        "fig4_ratio", "Vsc under direct ground is six times that under natural ground (sine, 100 Hz)", 6.0,
        _map_insulators(lambda Ci: ratio(gain, Ci)), "1",
        "six times needs the 0.69 nF of the paper's |Z_Ci|; with 1.35 nF a square's peaks are"
        f" {ratio(lambda circuit: peak(circuit, _SQUARE)):.1f} times", 0.02,
    )  # fmt: skip
    total = ratio(lambda circuit: 1.0 / abs(complex(circuit.admittance(_OMEGA))))
    yield Claim(
        "text_Ztotal", "Z_dir-total is much larger than Z_nat-total (their ratio at 100 Hz)", None, total, "1",
        "differs", "it is much smaller, so that Vsc is larger under direct ground; probably a misprint",
    )  # fmt: skip


def peaks_over_grounding(Ci: float, name: str, values: tuple[float, ...]) -> np.ndarray:
    """Return peaks of Vsc (V) for the square of Figs. 5 and 6, varying Rsc or Csc of the grounding finger."""
    skin = {"grounding_Rsc": VALUES.Rsc, "grounding_Csc": VALUES.Csc}
    circuits = [VALUES.direct_ground(Ci, **skin | {name: value}) for value in values]
    return np.array([float(peak(circuit, _SQUARE)) for circuit in circuits])


def _grounding_finger_claims() -> Iterator[Claim]:
    def spread(Ci: float) -> float:
        peaks = peaks_over_grounding(Ci, "grounding_Rsc", VALUES.grounding_Rsc)
        return float(np.ptp(peaks) / peaks.mean())

    yield _make_claim(
        "fig5_peak_spread", "the grounding finger's Rsc does not change the peak of Vsc (spread over 80 to 200 kohm)",
        0.0, _map_insulators(spread), "1", "less than 1 % with 1.35 nF; the effect is in the decay, as the paper says",
        0.01,
    )  # fmt: skip

    for id, printed, C in (("fig6_Csc_8p85nF", 13.84, 8.85e-9), ("fig6_Csc_44p2nF", 11.96, 44.2e-9)):
        peaks = {name: float(peaks_over_grounding(Ci, "grounding_Csc", (C,))[0]) for name, Ci in INSULATORS.items()}
        yield _make_claim(
            id, f"the peak of Vsc with a grounding Csc of {C * 1e9:g} nF", printed, peaks, "V",
            "in the circuit as drawn a larger grounding capacitance takes less of the drive, so Vsc rises with it, from"
            " 13.7 to 15.9 V; in the paper it falls",
        )  # fmt: skip


def _equivalent_claims() -> Iterator[Claim]:
    series = series_equivalent(VALUES.Rsc, VALUES.Csc, VALUES.frequency)
    with_body, without = (float(quality_factor(VALUES.Rsc, VALUES.Csc, VALUES.frequency, R)) for R in (VALUES.R_H, 0.0))
    yield _make_claim("eq11_Rx", "Rx at 100 Hz", 27.16e3, float(series.Rx), "ohm", "to the paper's digits")
    yield _make_claim("eq13_Cx", "Cx at 100 Hz", 26.5e-9, float(series.Cx), "F", "to the paper's digits")
    yield _make_claim("eq14_Rx2", "Rx' of both skins", 54.32e3, 2.0 * float(series.Rx), "ohm", "to the paper's digits")
    rounded = "the paper's last digit follows from its rounded Cx' = 13.25 nF"
    yield _make_claim("eq16_Qwith", "Q with R_H", 2.1911, with_body, "1", rounded)
    yield _make_claim("eq17_Qwithout", "Q without R_H", 2.2112, without, "1", rounded)
    yield _make_claim(
        "q_difference", "1 - Qwith / Qwithout is 0.909 %", 0.00909, 1.0 - with_body / without, "1",
        "R_H / (Rx' + R_H) = 0.912 %; the paper took it from rounded numbers",
    )  # fmt: skip

    def relative_change(Ci: float) -> Any:
        return 1.0 - peak(VALUES.direct_ground(Ci), _SQUARE) / peak(VALUES.final_circuit(Ci), _SQUARE)

    yield _make_claim(
        "fig10_RH", "R_H changes Vsc too little to have an effect (of the peak)", 0.0,
        _map_insulators(relative_change), "1",
        "0.14 % of the peak with 1.35 nF; only at the edge, within microseconds, it matters", 0.01,
    )  # fmt: skip


def force_over(permittivity: float, thickness: float) -> float:
    """Return the mean force (N) of Fig. 12 for a 360 Vpp square, with Ci from the insulator by eq. (3)."""
    area, skin_thickness = VALUES.contact_area, VALUES.skin_thickness
    skin_permittivity = float(VALUES.Csc * skin_thickness / plate_capacitance(1.0, area, 1.0))
    contact = Contact(area, thickness, permittivity, skin_thickness, skin_permittivity)
    circuit = VALUES.final_circuit(plate_capacitance(permittivity, area, thickness))
    return float(mean_force(circuit, _SQUARE, contact))


def _insulator_claims() -> Iterator[Claim]:
    values = np.linspace(1.0, 10.0, 19)
    forces = [force_over(eps, VALUES.insulator_thickness) for eps in values]
    exponent = float(np.polyfit(np.log(values), np.log(forces), 1)[0])
    yield _make_claim(
        "fig12_eps", "the force grows about linearly with the permittivity (its exponent, 1 to 10)", 1.0, exponent, "1",
        "it grows faster, since Vsc grows with Ci, too; at a fixed voltage across the finger eq. (1) is nearly linear",
        0.1,
    )  # fmt: skip
    thick, thin = (force_over(VALUES.insulator_permittivity, thickness) for thickness in (0.2e-6, 0.01e-6))
    remainder = thick / thin
    yield _make_claim(
        "fig12_T", "the force falls with the thickness, to almost nothing at 0.2 um (of that at 0.01 um)", 0.0,
        remainder, "1",
        f"it falls throughout; {100 * remainder:.0f} % remains at 0.2 um and 1 % at 0.9 um (the paper's text also says"
        " that it falls until 1 um)", 0.01,
    )  # fmt: skip


def _frequency_claims() -> Iterator[Claim]:
    corner = _map_insulators(lambda Ci: 1.0 / (2.0 * math.pi * VALUES.final_circuit(Ci).b))
    steady = {name: frequency * 0.99 / math.sqrt(1.0 - 0.99**2) for name, frequency in corner.items()}
    for id, claim, frequency, ours, reason, tolerance in (
        ("amplitude_knee", "the amplitude's knee is at about 40 Hz", 40.0, corner,
         "the corner 1 / (2 pi b) of the first-order high-pass", 0.02),
        ("amplitude_steady", "the amplitude is steady from about 300 Hz", 300.0, steady,
         "frequency at 99 % of the limit; the paper does not define 'steady'", 0.1),
        ("phase_knee", "the phase's knee is at about 90 Hz", 90.0, corner,
         "a first-order high-pass has one corner, of amplitude and phase alike; at 90 Hz the lead is still 24 degrees",
         0.1),
        ("phase_steady", "the phase is steady from about 270 Hz", 270.0, steady,
         "frequency at which the lead is 8.1 degrees and the amplitude 99 % of its limit", 0.1),
    ):  # fmt: skip
        yield _make_claim(f"fig14_{id}", claim, frequency, ours, "Hz", reason, tolerance)


def waveforms(peak_to_peak: float) -> dict[str, Drive]:
    """Return the three drives of Fig. 15, by name."""
    kinds = {"sine": Sine, "triangle": Triangle, "square": Square}
    return {name: kind(peak_to_peak=peak_to_peak, frequency=VALUES.frequency) for name, kind in kinds.items()}


def _waveform_claims() -> Iterator[Claim]:
    def peak_to_peak(drive: Drive) -> dict[str, float]:
        return _map_insulators(lambda Ci: 2.0 * peak(VALUES.final_circuit(Ci), drive))

    larger = waveforms(VALUES.peak_to_peak)
    for name, drive in waveforms(30.0).items():
        printed = 30.0 if name == "square" else 15.0
        yield _make_claim(
            f"fig15_{name}", f"a {name} of 30 Vpp and 100 Hz gives Vsc of about {printed:g} Vpp", printed,
            peak_to_peak(drive), "V",
            f"no divider gives half or all of the drive; the ordinate corresponds to a drive of 300 to 360 Vpp"
            f" ({peak_to_peak(larger[name])[TEXT_CI]:.1f} Vpp at 360 Vpp)", 0.1,
        )  # fmt: skip


def _equation_claims() -> Iterator[Claim]:
    """Yield the formulas without a number: as printed in the paper, in complex arithmetic, against fitact."""
    frequency = np.geomspace(10.0, 1000.0, 41)
    w = 2.0 * np.pi * frequency
    Rsc, Csc, R_H, Z = VALUES.Rsc, VALUES.Csc, VALUES.R_H, VALUES.Z
    final, direct, natural = VALUES.final_circuit(), VALUES.direct_ground(), VALUES.natural_ground()
    skin, insulator, X = _skin_impedance(w), 1.0 / (1j * w * CI), 1.0 / (w * Csc)
    series = series_equivalent(Rsc, Csc, frequency)
    both = np.asarray(series.Rx) + 1j / (w * np.asarray(series.Cx))
    a, b = Rsc * CI, 2.0 * Rsc * CI + Rsc * Csc
    H, admittance = final.transfer_function(w), final.admittance(w)
    same = "equal within rounding"
    for id, claim, printed, ours, reason in (
        ("eq5", "Vsc under direct ground", skin / (2 * skin + insulator + R_H), direct.transfer_function(w), same),
        ("eq6", "Vsc under natural ground", skin / (skin + insulator + Z), natural.transfer_function(w), same),
        ("eq10", "the series equivalent, resistance and reactance",
         (Rsc * (1j * X) ** 2 + 1j * Rsc**2 * X) / (Rsc**2 + X**2), both,
         "as printed, its real part is negative, since (jX)^2 = -X^2; the subsequent eqs. (11) to (13) are right"),
        ("eq12", "Xx", w * Csc * Rsc**2 / (1 + (w * Csc * Rsc) ** 2), both.imag, same),
        ("eq15", "Q, series and parallel", Rsc / X, both.imag / both.real, same),
        ("eq18", "V over I", 2 * skin + insulator, 1 / admittance, same),
        ("eq19", "Vsc over I", skin, H / admittance, same),
        ("eq21", "H, eqs. (20) and (21)", 1j * w * a / (1j * w * b + 1.0), H, same),
        ("eq24", "real and imaginary part of H, eqs. (23) and (24)",
         a * w / (1 + (b * w) ** 2) * (b * w + 1j), H, same),
        ("eq25", "|H|", np.sqrt(a**2 * w**2 / (1 + b**2 * w**2)), final.amplitude(w), same),
        ("eq26", "the phase of H", np.arctan(1 / (b * w)), final.phase(w),
         "the formula is right; the text calls it the arctangent of Re over Im"),
        ("eq22", "mean force over mean Vsc^2", *_force_law(), same),
    ):  # fmt: skip
        off = float(np.max(np.abs(np.asarray(ours) / printed - 1.0)))
        yield _make_claim(id, f"{claim} (largest relative difference, 10 to 1000 Hz)", 0.0, off, "1", reason, 1e-9)


def _skin_impedance(omega: Any) -> Any:
    """Return the impedance (ohm) of one skin layer, eq. (8), as printed."""
    return VALUES.Rsc / (1.0 + 1j * omega * VALUES.Rsc * VALUES.Csc)


def _force_law() -> tuple[float, float]:
    """Return eq. (22) as printed, and the mean force over the mean square of Vsc (eq. (1) with v = Vsc)."""
    A, Ti, Tsc, epsilon_i, epsilon_sc = (
        VALUES.contact_area, VALUES.insulator_thickness, VALUES.skin_thickness, VALUES.insulator_permittivity, 5e3
    )  # fmt: skip
    contact, circuit = Contact(A, Ti, epsilon_i, Tsc, epsilon_sc), VALUES.final_circuit()
    printed = 8.85e-12 * A / (2 * (Ti / epsilon_i + Tsc / epsilon_sc) * (Ti + Tsc))
    return printed, float(mean_force(circuit, _SQUARE, contact) / mean_square(circuit, _SQUARE))
