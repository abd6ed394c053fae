"""Table of what works where: each capability with each function that fits, on simulated fingers of known truth.

Every channel has noise, rounding and a skew of part of a time step, V among them. A cell of the table works if what the
data determine lies within `MAX_ERROR` standard errors of the truth. A cell that is refused states part of the sentence.

    python -m tests.capabilities

writes the table into docs/what_works.md. tests/test_capabilities.py tries the cells.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import scipy.signal

import data_synth.make
import data_synth.recipe
import data_synth.scene
import fitact
from data_synth.keys import validate_sections
from fitact.batch import campaign
from fitact.batch.fit_many import row_from_fit
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.readers.read import write_csv

PAGE = Path(__file__).parents[1] / "docs" / "what_works.md"
BEGIN, END = "<!-- written by tests/capabilities.py -->\n", "<!-- end -->\n"
MAX_ERROR = 4.5  # standard errors
RATE, DURATION, WINDOW = 50e3, 0.08, 0.02  # Hz, s, s
TRUTH = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.38e-9}
TOTAL = 2.0 * TRUTH["Ci"] + TRUTH["Csc"]
TRUE_VALUES = TRUTH | {"g": TRUTH["Ci"] / TOTAL, "b": TRUTH["Rsc"] * TOTAL, "alpha": 0.8}
DRIVE = {"waveform": "trapezoid", "rise_time": 200e-6, "frequency": 100.0, "phase": 0.1}
NOISE = {"V": 0.1, "Vsc": 0.05, "I": 20e-9, "Ft": 2e-5}  # V, V, A, N
Item = fitact.Record | fitact.Spectrum
Errors = dict[str, float]  # in standard errors, by quantity


@dataclasses.dataclass(frozen=True)
class Capability:
    """A row of the table.

    Attributes:
        channels: of the record; () means that there is none.
        spectra: kinds of the spectra.
        circuit: sections of the true circuit that are not the default; the scene states them, too.
        scene: further sections of the scene.
        noise: of Vsc: "white", "student" or "ar1".
        skew: of Vsc against V, in time steps.
        determined: quantities that the data determine.
        refused: parts of the sentences of functions that refuse it.
    """

    name: str
    channels: tuple[str, ...] = ("Vsc",)
    spectra: tuple[str, ...] = ()
    circuit: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    scene: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    noise: str = "white"
    skew: float = 0.7
    determined: tuple[str, ...] = ("g", "b")
    refused: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def make_scene(self) -> fitact.Scene:
        drive = {"waveform": "measured"} if self.channels else DRIVE
        base = {"drive": drive, "measurement": {"channels": self.channels or ("Vsc",)}}
        return fitact.Scene.from_dict(_merge(base, self.circuit, self.scene))

    def make_finger(self, number: int = 0) -> Any:
        """Return what functions take of one finger: a record, a spectrum, or a list of them."""
        items: list[Item] = [self._make_record(number)] if self.channels else []
        items += [_make_spectrum(kind, number) for kind in self.spectra]
        return items[0] if len(items) == 1 else items

    def _make_record(self, seed: int) -> fitact.Record:
        base = {
            "device": {"Ci": TRUTH["Ci"]},
            "skin": {"Rsc": TRUTH["Rsc"], "Csc": TRUTH["Csc"]},
            "drive": DRIVE,
            "measurement": {"channels": list(self.channels), "sampling_rate": RATE, "duration": DURATION},
        }
        parts = {
            "delay": {"I": 0.3 / RATE, "Vsc": self.skew / RATE},
            "white": NOISE if self.noise == "white" else NOISE | {"Vsc": 0.0},
            "converter": {"bits": 14, "auto": True},
        }
        checked = validate_sections(parts, data_synth.recipe.KEYS, self.name)
        bench = data_synth.scene.make_scene(_merge(base, self.circuit), {}, self.name)
        recipe = data_synth.recipe.Recipe("record", "", bench, checked, tuple(parts), seed, "scipy")
        made = data_synth.make.make(recipe)["record"]
        channels, rng, size = dict(made.channels), np.random.default_rng(seed), made.time.size
        if self.noise != "white":
            white = rng.standard_t(4.0, size) if self.noise == "student" else rng.standard_normal(size)
            pole = 0.9 if self.noise == "ar1" else 0.0
            noise = NOISE["Vsc"] * scipy.signal.lfilter([1.0], [1.0, -pole], white)
            channels["Vsc"] = np.round(channels["Vsc"] + noise, 2)
        return fitact.Record.from_arrays(made.time, **channels, source=f"record {seed}")


def _merge(*all_sections: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    merged: dict[str, dict[str, Any]] = {}
    for sections in all_sections:
        for name, section in sections.items():
            merged[name] = {**merged.get(name, {}), **section}
    return merged


def _make_spectrum(kind: str, seed: int) -> fitact.Spectrum:
    Rsc, Csc, Ci = TRUTH.values()
    frequency = np.geomspace(10.0, 1e5, 41)
    s = 2j * np.pi * frequency
    skin = Rsc / (1.0 + s * Rsc * Csc)
    loop = 2.0 * skin + 1.0 / (s * Ci)
    values = loop if kind == "impedance" else skin / loop
    noise = 3e-3 * np.random.default_rng(seed).standard_normal((2, frequency.size))
    values = values * (1.0 + noise[0] + 1j * noise[1])
    parts = [[float(f"{x:.4g}") for x in part] for part in (values.real, values.imag)]  # as an analyser rounds
    return fitact.Spectrum.from_arrays(
        frequency, np.array(parts[0]) + 1j * np.array(parts[1]), f"{kind} {seed}", channel=kind
    )


IDENTIFIED = ("g", "b", "Rsc", "Csc", "Ci")
PANEL = {"median": TRUTH["Ci"], "relative_sd": 1e-3}  # a Ci so well known that Vsc determines the rest
SENSOR = {"coefficient": 0.6, "normal_force": 0.5, "sensor_frequency": 500.0, "sensor_damping": 0.05}
CAPABILITIES = (
    Capability("Vsc, stated drive", scene={"drive": DRIVE}),
    Capability("Vsc, recorded V with noise"),
    Capability("I, recorded V with noise", ("I",), determined=IDENTIFIED),
    Capability("Vsc and I, recorded V with noise", ("Vsc", "I"), determined=IDENTIFIED),
    Capability(
        "Vsc and friction Ft",
        ("Vsc", "Ft"),
        circuit={"friction": SENSOR},
        refused={"track": "a track does not use the friction"},
    ),
    Capability(
        "impedance spectrum",
        (),
        ("impedance",),
        determined=IDENTIFIED,
        refused={"track": "is a spectrum, and this needs a record in time"},
    ),
    Capability(
        "gain spectrum Vsc / V", (), ("Vsc",), refused={"track": "is a spectrum, and this needs a record in time"}
    ),
    Capability(
        "joint fit of a record and a spectrum",
        spectra=("impedance",),
        determined=IDENTIFIED,
        refused={"track": "a track follows one record"},
    ),
    Capability("coloured noise (`ar1`)", scene={"measurement": {"noise_model": "ar1"}}, noise="ar1"),
    Capability(
        "Student-t noise",
        scene={"measurement": {"noise_model": "student"}},
        noise="student",
        refused={"track": "has no [measurement] noise_model = 'student'"},
    ),
    Capability("stated instruments", scene={"instrument": {"V": ["daq-16bit:D/0"], "Vsc": ["daq-16bit:D/1"]}}),
    Capability(
        "stray capacitance",
        ("Vsc", "I"),
        circuit={"measurement": {"stray_capacitance": 100e-12}},
        determined=IDENTIFIED,
    ),
    Capability("body resistance R_H", circuit={"grounding": {"R_H": 500.0}}),
    Capability(
        "body resistance R_H, Vsc and I",
        ("Vsc", "I"),
        circuit={"grounding": {"R_H": 500.0}},
        determined=IDENTIFIED,
    ),
    Capability(
        "leak Ri of the insulator",
        circuit={"device": {"Ri": 2e6}},
        scene={"prior": {"Ci": PANEL, "Ri": {"factor": 3.0}}},
        determined=("Rsc", "Csc"),
        refused={"track": "a track has no leak of the insulator"},
    ),
    Capability(
        "dispersive skin, stated drive",
        circuit={"skin": {"level": "dispersive"}},
        scene={"drive": DRIVE, "prior": {"Ci": PANEL}},
        determined=("Rsc", "Csc"),
        refused={"track": "has no [skin] level = 'dispersive'"},
    ),
    Capability(
        "fractional skin",
        circuit={"skin": {"level": "fractional", "alpha": 0.8}},
        scene={"drive": {"steady_state": True}, "prior": {"Ci": PANEL, "alpha": {"low": 0.5, "high": 1.0}}},
        skew=0.1,  # of more, a fit says that the residuals show structure, like a delay
        determined=("Rsc", "Csc", "alpha"),
        refused={"track": "has no [skin] level = 'fractional'"},
    ),
)


def try_fit(given: Capability, folder: Path) -> Errors:
    return _row_errors(row_from_fit(fitact.fit(given.make_finger(), given.make_scene())), given.determined)


def try_fit_many(given: Capability, folder: Path) -> Errors:
    (row,) = fitact.fit_many([given.make_finger()], given.make_scene(), progress=False)
    return _row_errors(row, given.determined)


def try_sample_many(given: Capability, folder: Path) -> Errors:
    (row,) = fitact.sample_many([given.make_finger()], given.make_scene(), progress=False)
    errors = _row_errors(row, given.determined)
    for name in given.determined:
        low, middle, high = (
            math.log(row[f"{name}_{quantile}"] / TRUE_VALUES[name]) for quantile in ("q05", "q50", "q95")
        )
        errors[f"{name}_q50"] = middle / ((high - low) / 3.29)  # standard deviations from 5 % to 95 %
    return errors


def try_run_campaign(given: Capability, folder: Path) -> Errors:
    finger = given.make_finger()
    items = finger if isinstance(finger, list) else [finger]
    paths = [_write(item, folder / f"{number}.csv") for number, item in enumerate(items)]
    given_paths = [paths if isinstance(finger, list) else paths[0]]
    # what workers compute, in this process, where programs are compiled already; Dask is the matter of test_campaign.py
    with (
        mock.patch.object(campaign, "_open_client", return_value=contextlib.nullcontext()),
        mock.patch.object(campaign, "_completed_batches", _compute_batches),
    ):
        (row,) = fitact.run_campaign(given_paths, folder / "out", given.make_scene(), progress=False)
    return _row_errors(row, given.determined)


def _compute_batches(_: Any, task: campaign.Task, batches: Iterable[campaign.Batch], *__: Any) -> Iterator[Any]:
    return ((batch, task.rows([paths for _, paths in batch])) for batch in batches)


def try_track(given: Capability, folder: Path) -> Errors:
    track = fitact.track(given.make_finger(), given.make_scene(), window=WINDOW, rates=(0.0, 0.0, 0.0))
    assert track.reliable.all()
    return {
        name: float(np.max(np.abs(np.log(track.values[name] / TRUE_VALUES[name]) / track.u[name])))
        for name in given.determined
    }


def try_population(given: Capability, folder: Path) -> Errors:
    """Return the errors of the medians, and of what is kept of each finger for the population."""
    records = [given.make_finger(number) for number in range(2)]
    found = fitact.population(records, given.make_scene(), seed=1, max_steps=50, progress=False)
    logs = {name: np.log(found.parameters()[name] / value) for name, value in TRUTH.items()}
    errors = {name: float(values.mean() / values.std()) for name, values in logs.items()}
    # of the normal likelihoods that are kept, in independent units
    kept, truth = found.hierarchy, np.log([TRUTH[name] for name in FINGER_PARAMETERS])
    deviations = np.asarray(kept.factors) @ (truth - np.asarray(kept.origin)[:3]) - np.asarray(kept.targets)
    errors["kept"] = float(np.max(np.abs(deviations)))
    return errors


FUNCTIONS = {
    "fit": try_fit,
    "fit_many": try_fit_many,
    "sample_many": try_sample_many,
    "run_campaign": try_run_campaign,
    "track": try_track,
    "population": try_population,
}


def _row_errors(row: Mapping[str, Any], names: Sequence[str]) -> Errors:
    if row["result"] == "refused":
        raise fitact.InputError(row["message"])
    assert "samples" in row, row["message"]
    return {name: math.log(row[name] / TRUE_VALUES[name]) / row[f"{name}_log_sd"] for name in names}


def _write(item: Item, path: Path) -> str:
    if isinstance(item, fitact.Record):
        write_csv(path, item)
        return str(path)
    header, parts = "Z_real_ohm,Z_imag_ohm", (item.values.real, item.values.imag)
    if item.channel == "Vsc":
        header, parts = "gain_dB,phase_deg", (20.0 * np.log10(np.abs(item.values)), np.angle(item.values, deg=True))
    table = np.column_stack([item.frequency, *parts])
    np.savetxt(path, table, "%.8g", ",", header=f"frequency_Hz,{header}", comments="")
    return str(path)


def render_table() -> str:
    """Return the table and the sentences of the refusals in Markdown."""
    reasons = list(dict.fromkeys(reason for row in CAPABILITIES for reason in row.refused.values()))
    lines = [["", *(f"`{name}`" for name in FUNCTIONS)], ["---"] * (1 + len(FUNCTIONS))]
    for row in CAPABILITIES:
        numbers = [reasons.index(row.refused[name]) + 1 if name in row.refused else 0 for name in FUNCTIONS]
        lines.append([row.name, *(f"no ({number})" if number else "yes" for number in numbers)])
    table = "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
    return f"{table}\n" + "".join(f'{number}. "{reason}"\n' for number, reason in enumerate(reasons, 1))


def main() -> None:
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{render_table()}\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
