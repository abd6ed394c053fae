"""Pages of a population, a plan, a trade-off and the two designs: their content for results made by hand."""

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import fitact
from fitact.cli.app import app
from fitact.design.drive_design import DriveDesign
from fitact.design.drive_option import DriveOption
from fitact.design.drive_people import FingerSample
from fitact.design.measurement import MeasurementDesign, SettingCurve
from fitact.experiment.experiment import DesignOption
from fitact.files import write_json
from fitact.model.steady_cycle import PeriodQuantities
from fitact.model_selection.plan import Omission, Plan, RelativeErrors
from fitact.report.design import write_design_page
from fitact.report.drive_design import write_drive_design_page
from fitact.report.frame import Provenance
from fitact.report.plan import write_plan_page
from fitact.report.population import read_population, write_population_page
from fitact.report.tradeoff import write_tradeoff_page
from fitact.tradeoff.tradeoff import BenchmarkedMethod, Tradeoff
from tests.report.test_report import Page

HOSTILE = "<script>alert(1).csv"
DIGEST = "0123456789abcdef" * 4
ORIGIN = Provenance("fitact something scene.toml --out out", {"device": {"Ci": 1.35e-9}}, {HOSTILE: DIGEST})


def plan() -> Plan:
    def errors(size: float) -> RelativeErrors:
        return RelativeErrors(1.1 * size, 1.3 * size, 1.7 * size, 1.9 * size)

    scene = fitact.Scene.from_dict({"grounding": {"R_H": "500 ohm"}})
    R_H = Omission("R_H", errors(1e-3), errors(1e-2), 2.0, False, "error within the tolerance")
    single = Omission("float64", errors(1e-7), errors(1e-6), 1.6, True, "fits and sampling need its derivatives")
    return Plan(scene, fitact.Scene(), (R_H, single), errors(1e-3), errors(1e-2), 2.0)


def tradeoff(trusted: bool = True) -> Tradeoff:
    def levels(kind: Any) -> tuple[BenchmarkedMethod, ...]:
        cost = {"kind": kind, "ratio": 1.0, "dominated_by": ""}
        best = BenchmarkedMethod(f"best {kind}", 0.0, 2e-6, 3e-6, 0.7, 8000, {"cold_seconds": 5.0}, **cost)
        cost |= {"ratio": 2.0, "dominated_by": best.name}
        worse = BenchmarkedMethod(f"worse {kind}", 0.123, 4e-6, details={"cold_seconds": 6.0}, **cost)
        return best, worse

    every = tuple(level for kind in ("answer", "response", "likelihood", "uncertainty") for level in levels(kind))
    machine = {"cpu": "a processor", "cores": 2, "load": 0.51234, "python": "3.11"}
    notes = () if trusted else ("emcee has not converged",)
    return Tradeoff(every, f"{HOSTILE}: 4,000 samples, drive square", 0.046, trusted, machine, notes)


def option(name: str, force_sd: float, effort: float, **settings: float) -> DesignOption:
    gain = math.log(0.05 / force_sd)
    sd = {"Rsc": 1.1 * force_sd, "Csc": 1.2 * force_sd, "Ci": 1.3 * force_sd}
    return DesignOption(name, f"{name}, done well", settings, effort, force_sd, 1.0 - force_sd, sd, sd, gain)


def measurement(trusted: bool = True) -> MeasurementDesign:
    options = (
        option("current", 0.0003, 3.0),
        option("series resistor", 0.0013, 2.0, series_resistor=166e3),
        option("longer record", 0.05, 1.0),
    )
    curve = SettingCurve("series_resistor", "ohm", (1e3, 1e5, 1e7), (0.03, 0.0014, 0.04))
    warnings = () if trusted else ("the fit is a misfit",)
    return MeasurementDesign(option("now", 0.05, 0.0), options, (curve,), 2.4, trusted, warnings)


def drive(trusted: bool = True) -> DriveDesign:
    scene = fitact.Scene.from_dict({"perception": {"threshold_force": "1 mN"}, "device": {"current_limit_rms": "2 mA"}})

    def made(waveform: str, amplitude: float, frequency: float = 100.0, current: float = 2e-4) -> DriveOption:
        at = PeriodQuantities(1e-3, 1e-3, np.full(4, 1e-3), 0.5 * amplitude, 3e-3, 0.1, current, 2.0 * current)
        people = amplitude * np.array([0.3, 0.5, 0.6, 0.7, 0.9])
        return DriveOption(waveform, frequency, scene.device, np.full(3, amplitude), 12.0, people, at)

    people = FingerSample({"Ci": np.full((3, 2), 1.35e-9)}, "the population of 3 fingers", trusted)
    needed = np.array([[200.0, 300.0], [250.0, 400.0], [210.0, math.inf]])
    return DriveDesign(
        scene,
        people,
        0.95,
        None,
        {"sine": made("sine", 500.0), "square": made("square", 400.0, current=math.inf)},
        {"sine": needed, "square": 0.8 * needed},
        {name: tuple(made(name, 500.0, f) for f in (10.0, 100.0, 1000.0)) for name in ("sine", "square")},
        (made("square", 500.0), made("square", 600.0)),
        (made("square", 500.0), made("square", 600.0)),
        1,
    )


def summary(median: float, unit: str) -> dict[str, Any]:
    factors = {"q025": 0.5, "q05": 0.6, "q25": 0.8, "q50": 1.0, "q75": 1.25, "q95": 1.6, "q975": 2.0}
    return {"unit": unit, "mean": median, "sd": 0.1 * median} | {key: median * x for key, x in factors.items()}


def population(trusted: bool = True) -> tuple[xr.DataTree, dict[str, Any]]:
    """Return tree and content in the form that `fitact population` writes, for two fingers."""
    new = {name: summary(x, "ohm" if name == "Rsc" else "F") for name, x in (("Rsc", 124e3), ("Csc", 25e-9))}
    new |= {"g": summary(0.051, "1"), "b": summary(3.5e-3, "s")}
    new |= {name: summary(x, "N") for name, x in (("force_mean", 231e-6), ("force_peak", 709e-6))}
    new |= {name: summary(x, "N") for name, x in (("force_rms", 296e-6), ("friction_mean", 0.25))}
    new = {name: s | {"variance": {"people": 0.875, "ignorance": 0.125}} for name, s in new.items()}
    share = {"first": 0.18, "first_error": 0.02, "total": 0.04, "total_error": 0.01}
    shares = {name: {factor: share for factor in ("Rsc", "Csc", "Ci")} for name in ("force_mean", "force_peak")}
    law = {
        "Rsc": {"median": summary(126e3, "ohm"), "log_sd": summary(0.22, "1")},
        "Csc": {"median": summary(26e-9, "F"), "log_sd": summary(0.41, "1")},
        "Ci": summary(1.42e-9, "F"),
        "correlation": summary(0.37, "1"),
        "covariates": {
            "moisture": {"mean": 0.45, "sd": 0.22, "next_finger": 0.61}
            | {name: {"slope": summary(0.064, "1")} for name in ("Rsc", "Csc")}
        },
    }

    def finger(record: str, result: str, Rsc: float) -> dict[str, Any]:
        values = {"Rsc": summary(Rsc, "ohm"), "Csc": summary(33e-9, "F"), "Ci": summary(1.43e-9, "F")}
        message = "" if result == "successful" else "residuals have a structure"
        units = {"finger": record}
        return {"record": record, "sha256": DIGEST, "result": result, "message": message, "parameters": values} | {
            "units": units
        }

    content = {
        "population": law,
        "levels": [{"level": "finger", "units": 2, "log_sd": {}}],
        "forecasts": {},
        "next_studies": [],
        "new_finger": new,
        "variance_shares": shares,
        "variance_shares_prior": shares,
        "fingers": [finger(HOSTILE, "successful", 146.4e3), finger("second.csv", "misfit", 119.5e3)],
        "convergence": {
            "level": "emcee",
            "sentence": "converged: 4 ensembles" if trusted else "NOT converged: 4 ensembles",
            "converged": trusted,
            "ensembles": 4,
            "walkers": 128,
            "steps": 300,
            "burn": 22,
            "tau_max": 4.21,
            "rhat_max": 1.0046,
            "ess_min": 33803.0,
        },
        "integrals_off": 0.00031,
        "contact_area": {"sentence": "assumed: all fingers have the same contact area; the records disagree"},
        "notes": ["the force is computed"],
        "trusted": trusted,
        "warnings": ["second.csv: residuals have a structure"],
        "seed": 7,
        "scene": {"device": {"Ci": 1.35e-9}},
        "versions": {"fitact": "0.1.0"},
    }
    random = np.random.default_rng(0)

    def drawn(*names: str) -> xr.Dataset:
        return xr.Dataset(
            {n: (("law", "finger"), random.lognormal(np.log(new[n]["q50"]), 0.3, (50, 8))) for n in names}
        )

    quantiles = [0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975]
    force = 1e-4 * np.outer(1.0 + np.array(quantiles), 1.0 + np.arange(9.0))
    in_time = xr.Dataset(
        {"force": (("quantile", "time"), force)},
        {"quantile": quantiles, "time": 1e-3 * np.arange(9)},
        {"friction_coefficient": 0.5, "normal_force": 0.5, "periodic": 1},
    )
    groups = {
        "new_fingers": drawn("Rsc", "Csc", "force_mean", "force_peak"),
        "prior_new_fingers": drawn("force_mean", "force_peak"),
        "force_in_time": in_time,
    }
    return xr.DataTree.from_dict(groups), content


def population_with_levels() -> tuple[xr.DataTree, dict[str, Any]]:
    """Return the population of three touches of two people."""
    tree, content = population()

    def level(name: str, units: int, sds: dict[str, float]) -> dict[str, Any]:
        return {"level": name, "units": units, "log_sd": {key: summary(sd, "1") for key, sd in sds.items()}}

    people = level("person", 2, {"Rsc": 0.35, "Csc": 0.3, "g": 0.3, "b": 0.4, "force_mean": 0.6})
    people["intraclass_correlation"] = {name: summary(0.9, "1") for name in people["log_sd"]}
    touches = level("repetition", 3, {name: 0.06 for name in people["log_sd"]})
    forecasts = {
        name: {key: summary(Rsc if key == "Rsc" else s["q50"], s["unit"]) for key, s in content["new_finger"].items()}
        for name, Rsc in (("person", 120e3), ("Ann", 140e3), ("Ben", 100e3))
    }
    now = {"units": 2, "repetitions": 2, "records": 3, "median_u": 0.4, "log_sd_u": 0.25}
    larger = {"units": 4, "repetitions": 2, "records": 8, "median_u": 0.2, "log_sd_u": 0.15}
    fingers = [
        finger | {"units": {"person": person, "repetition": f"{person}, {number}"}}
        for finger, person, number in zip(
            content["fingers"][:1] + content["fingers"], ("Ann", "Ann", "Ben"), "121", strict=True
        )
    ]
    parts = {"variance": {"people": 0.875, "ignorance": 0.125, "levels": {"person": 0.8, "repetition": 0.075}}}
    new = {name: s | parts for name, s in content["new_finger"].items()}
    return tree, content | {
        "levels": [people, touches],
        "forecasts": forecasts,
        "next_studies": [now, larger],
        "fingers": fingers,
        "new_finger": new,
    }


WRITE: dict[str, Callable[[Path, bool], None]] = {
    "plan": lambda path, _: write_plan_page(path, plan(), ORIGIN),
    "tradeoff": lambda path, trusted: write_tradeoff_page(path, tradeoff(trusted), ORIGIN),
    "measurement": lambda path, trusted: write_design_page(path, measurement(trusted), ORIGIN),
    "drive": lambda path, trusted: write_drive_design_page(path, drive(trusted), ORIGIN),
    "population": lambda path, trusted: write_population_page(path, *population(trusted)),
}


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[str, tuple[Page, str]]:
    """Return each page and its words."""
    folder = tmp_path_factory.mktemp("pages")
    for name, write in WRITE.items():
        write(folder / f"{name}.html", True)
    read = {name: Page((folder / f"{name}.html").read_text()) for name in WRITE}
    return {name: (page, words(page)) for name, page in read.items()}


def words(page: Page) -> str:
    return " ".join(" ".join(page.words).split())


@pytest.mark.parametrize("name", WRITE)
def test_a_page_stands_alone_and_closes_its_tags(pages, name: str):
    page, _ = pages[name]
    assert page.open == []
    assert all(address.startswith("data:") for address in page.addresses)
    assert page.styles
    assert not re.search(r"@import|url\(", page.styles)
    assert page.images
    assert all(len(image["alt"] or "") > 40 for image in page.images)


@pytest.mark.parametrize("name", WRITE)
def test_no_name_of_a_record_becomes_markup(pages, name: str):
    """The name is displayed unchanged; a tag in it would leave tags of the page open."""
    page, text = pages[name]
    assert HOSTILE in text
    assert not any("alert(1)" in script and "\\u003cscript\\u003ealert(1)" not in script for script in page.scripts)


VERDICTS = {
    "plan": "The planned model is within the force tolerance of 1 % at the nominal values, but not over the prior",
    "tradeoff": "Fastest methods on the Pareto fronts: best answer (answer), best response (response)",
    "measurement": "Largest gain per effort: series resistor, done well; uncertainty of the mean force from ± 5 %",
    "drive": "Set a sine of 250 V amplitude (500 V peak to peak) at 100 Hz: with 95 % probability, at least 95 %",
    "population": "Reliable: the posterior is sampled well enough",
}


@pytest.mark.parametrize("name", WRITE)
def test_the_verdict_comes_first_and_how_to_repeat_it_last(pages, name: str):
    _, text = pages[name]
    command = "fitact population" if name == "population" else ORIGIN.command
    places = [text.index(part) for part in (VERDICTS[name], "How to repeat it", command, DIGEST[:16], '"Ci": 1.35e-09')]
    assert places == sorted(places)
    assert "Unreliable:" not in text


AGAINST = {
    "tradeoff": "emcee has not converged.",
    "measurement": "the fit is a misfit.",
    "drive": "the population fit is not reliable",
    "population": "NOT converged: 4 ensembles; the error of the records' likelihoods",
}


@pytest.mark.parametrize("name", AGAINST)
def test_an_untrusted_answer_says_so_at_the_top(name: str, tmp_path: Path):
    WRITE[name](tmp_path / "report.html", False)
    text = words(Page((tmp_path / "report.html").read_text()))
    assert VERDICTS[name] not in text
    assert text.index("Unreliable: do not use these numbers") < text.index(AGAINST[name]) < text.index("Warnings")


SHOWN = {
    "plan": [
        *("R_H", "0.11 % (1.1 %)", "0.13 % (1.3 %)", "0.17 % (1.7 %)", "0.19 % (1.9 %)", "2.00x"),
        *("kept: fits and sampling need its derivatives", "Neglected: R_H.", "Warnings", "steady state"),
    ],
    "tradeoff": [
        *("best response", "2 µs", "3 µs", "0.70 s", "8 kB", "worse uncertainty", "0.12", "4 µs", "0.512"),
        *("errors of uncertainty below 0.046 are not significant", "a processor"),
    ],
    "measurement": [
        *(
            "current, done well ± 0.03 % 0.9997 3 1.71",
            "± 0.13 %",
            "as it stands ± 5 %",
            "before any measurement: ± 240 %",
        ),
        *("No gain from: longer record.", "± 0.033 % ± 0.036 % ± 0.039 %"),
    ],
    "drive": [
        "To be felt by 95 % of fingers: 1 mN amplitude of the alternating electrostatic force, the same at all",
        "sine 500 V ± 12 V 500 V 500 V to 500 V 3 mW 100 mVA 200 µA 400 µA",
        *(
            "square: excluded, the rms current is unbounded, above 2 mA",
            "IEC 62368-1, class ES1 touchable by ordinary persons rms current 200 µA 500 µA 0.4 up to 1 kHz",
        ),
        *(
            "sine 150 V 250 V 300 V 350 V 450 V",
            "[device] does not state breakdown_field, current_limit_peak",
            "insulator field 250 V/µm not stated",
            "recommended",
        ),
    ],
    "population": [
        *(f"{HOSTILE} 146 ± 15 kΩ 33.0 ± 3.3 nF 1.43 ± 0.14 nF successful", "second.csv 120 ± 12 kΩ", "misfit"),
        *("Rsc, median 126 kΩ 63 kΩ 252 kΩ", "Csc, log_sd 0.410 0.205 0.820", "correlation 0.370", "Ci 1.42 nF"),
        *("force, mean 116 µN 139 µN 185 µN 231 µN 289 µN 370 µN 462 µN 88 % 12 %", "18.0 % ± 2.0 % 4.0 % ± 1.0 %"),
        *("moisture 0.45 0.22 0.61", "Rsc, slope in moisture 0.0640", "4 × 128 × 300 (22 burn-in)", "4.21 steps"),
        *(
            "1.0046",
            "33,803",
            "0.00031 standard deviations",
            "second.csv: residuals have a structure",
            "--seed 7",
            "contact area common (assumed)",
            "the records disagree",
        ),
    ],
}


@pytest.mark.parametrize("name", WRITE)
def test_the_numbers_are_on_the_page(pages, name: str):
    """The numbers follow by hand from those of the results above."""
    _, text = pages[name]
    assert [part for part in SHOWN[name] if part not in text] == []


def test_what_is_drawn_is_what_the_page_says(pages):
    """Charts name every finger and every method; an error of 0 is labelled as such."""
    charts = {name: "".join(page.scripts) for name, (page, _) in pages.items()}
    assert '"second.csv"' in charts["population"]
    assert "best response, 2 \\u00b5s, error 0" in charts["tradeoff"]
    assert "plotly" not in charts["plan"]


def test_a_drive_that_no_limit_allows(tmp_path: Path):
    design = drive()
    write_drive_design_page(
        tmp_path / "drive.html", dataclasses.replace(design, options={"square": design.options["square"]}), ORIGIN
    )
    text = words(Page((tmp_path / "drive.html").read_text()))
    assert text.index("No amplitude is recommended, because no waveform meets") < text.index("What counts as felt")


def test_levels_are_on_the_page(tmp_path: Path):
    """Two people of whom one was recorded twice: groups, spreads, forecasts and larger studies."""
    tree, content = population_with_levels()
    write_population_page(tmp_path / "report.html", tree, content)
    text = words(Page((tmp_path / "report.html").read_text()))
    shown = (
        "Population: 3 touches of 2 people",
        "between people, force_mean, log_sd 0.60",
        "between touches, Rsc, log_sd 0.060",
        "touches of one person, Rsc, correlation 0.90",
        "a new person, typical 120 kΩ",
        "Ann, next touch 140 kΩ",
        "people repetitions records u of the median force u of the spread between people",
        "4 2 8 20 % (0.50) 15 % (0.60)",
        "touch of a new person 2.5 %",
        "between touches between people parameters",
        "8 % 80 % 12 %",
    )
    assert [part for part in shown if part not in text] == []


def test_a_population_is_read_again(tmp_path: Path):
    """A saved population gives the same page; other files are refused."""
    tree, content = population()
    with pytest.raises(fitact.InputError, match=r"holds no complete population .*; make it with: fitact population"):
        read_population(tmp_path)
    (tmp_path / "population.json").write_text(json.dumps(content))
    tree.to_netcdf(tmp_path / "population.nc", engine="h5netcdf")
    write_population_page(tmp_path / "first.html", tree, content)
    write_population_page(tmp_path / "again.html", *read_population(tmp_path))
    assert (tmp_path / "again.html").read_text() == (tmp_path / "first.html").read_text()
    assert app(["report", str(tmp_path), "--json"], standalone_mode=False) is None
    assert (tmp_path / "report.html").read_text() == (tmp_path / "first.html").read_text()
    (tmp_path / "population.json").write_text('{"population": {}}')
    with pytest.raises(fitact.InputError, match="not this version's"):
        read_population(tmp_path)


def test_a_chain_cut_short_is_told_without_figures(tmp_path: Path):
    """Its draws may overflow; JSON has null for non-finite values."""
    tree, content = population(trusted=False)
    tree["new_fingers"]["force_mean"].values[3] = math.inf
    content["new_finger"]["force_mean"] |= {"q975": math.inf, "sd": math.nan}
    content["convergence"]["rhat_max"] = math.nan
    write_population_page(tmp_path / "first.html", tree, content)
    page = Page((tmp_path / "first.html").read_text())
    assert words(page).index("Unreliable: do not use these numbers") < words(page).index(
        "Not drawn: some draws are not finite."
    )
    assert not page.images
    write_json(tmp_path / "population.json", content)
    tree.to_netcdf(tmp_path / "population.nc", engine="h5netcdf")
    write_population_page(tmp_path / "again.html", *read_population(tmp_path))
    assert (tmp_path / "again.html").read_text() == (tmp_path / "first.html").read_text()
