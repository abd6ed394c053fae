"""Results in a console and in a notebook: one line, a table without markup of others, plots, and data frames."""

import ast
import dataclasses
import subprocess
import sys
from html.parser import HTMLParser
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

import fitact
from fitact.charts import draw_population
from fitact.tables import Display, html_table
from fitact.tracking.walk_rates import WALKS, WalkRates
from tests.report import test_pages

HOSTILE = "<script>alert(1).csv"
INTERNAL = ("Array(", "jax", "<function", "object at 0x", "array(", "Module", "FieldInfo")
FORCE_LAW = "from Vsc with eq. (22) of the reference paper"


@pytest.fixture(autouse=True)
def _figures():
    with mpl.rc_context({"backend": "agg"}):
        yield
        plt.close("all")


@pytest.fixture(scope="module")
def track(finger_fit: fitact.Fit) -> fitact.Track:
    """Return a track made by hand: three windows, the second without contact."""
    values = {name: np.array([1.0, np.nan, 1.2]) * value for name, value in (("Rsc", 1e5), ("force_mean", 3e-4))}
    u = {name: np.array([0.1, np.nan, 0.1]) for name in values}
    names = tuple(WALKS)
    rates = WalkRates(names, np.eye(3), np.full(3, 0.1), np.zeros(3), np.ones(3))
    there = np.array([True, False, True])
    verdict = np.full(3, "prior-limited")
    times = np.array([0.5, 1.5, 2.5])
    shared = (2.0,), rates, 1.0, finger_fit, {}, {"Vsc": 0.1}
    return fitact.Track(times, values, u, u, there, there, verdict, *shared, average=None, follows_changes=False)


@pytest.fixture(scope="module")
def spectrum() -> fitact.Spectrum:
    frequency = np.geomspace(1.0, 1e5, 31)
    omega = 2.0 * np.pi * frequency
    skin = 2.0 / (1.0 / 160e3 + 1j * omega * 22e-9)
    return fitact.Spectrum.from_arrays(frequency, skin + 1.0 / (1j * omega * 1.35e-9), source=HOSTILE)


@pytest.fixture(scope="module")
def results(finger_fit, finger_posterior, track, spectrum) -> dict[str, Display]:
    record = dataclasses.replace(finger_fit.record, source=HOSTILE)
    trace = dataclasses.replace(finger_fit.traces[0], record=record)
    fit = dataclasses.replace(finger_fit, traces=(trace,), warnings=("a <b>warning</b>",))
    return {
        "scene": fitact.Scene.from_dict({"description": HOSTILE, "device": {"Ci": "1.3 nF"}}),
        "record": record,
        "spectrum": spectrum,
        "fit": fit,
        "posterior": dataclasses.replace(finger_posterior, fit=fit),
        "plan": test_pages.plan(),
        "measurement": test_pages.measurement(trusted=False),
        "drive": test_pages.drive(),
        "track": dataclasses.replace(track, fit=fit),
    }


NAMES = ("scene", "record", "spectrum", "fit", "posterior", "plan", "measurement", "drive", "track")


class Tags(HTMLParser):
    """Parser that checks that tags are closed, and collects them and the words."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words += data + " "


@pytest.mark.parametrize("name", NAMES)
def test_repr_is_one_line_without_internals(results, name: str):
    text = repr(results[name])
    assert "\n" not in text
    assert text.startswith(f"<fitact.{type(results[name]).__name__}: ")
    assert len(text) < 250
    assert not any(word in text for word in INTERNAL)


@pytest.mark.parametrize("name", NAMES)
def test_notebook_shows_a_table_and_no_markup_of_others(results, name: str):
    """Nor colours of its own, apart from borders: it is read on a light and on a dark page."""
    result = results[name]
    text = result._repr_html_()
    page = Tags(text)
    assert page.open == []
    assert page.tags.count("table") == 1
    assert "script" not in page.tags
    assert "b" not in page.tags or "a <b>warning</b>" not in text
    assert not any(word in text for word in INTERNAL)
    assert "background" not in text
    assert "color:#" not in text.replace(" ", "")
    assert all(warning in page.words for warning in getattr(result, "warnings", ()))
    if name in ("fit", "posterior", "track"):
        assert FORCE_LAW in page.words
        assert "prior-limited" in page.words


@pytest.mark.parametrize("name", NAMES)
def test_dir_lists_only_public_names_of_fitact(results, name: str):
    names = dir(results[name])
    assert not any(each.startswith(("_", "model_dump", "model_validate", "parse_")) for each in names)
    assert all(hasattr(results[name], each) for each in names)


def test_unreliable_results_say_so(finger_fit: fitact.Fit, finger_posterior: fitact.Posterior):
    misfit = dataclasses.replace(finger_fit, result="misfit")
    assert "unreliable (misfit)" in repr(misfit)
    assert "unreliable" in repr(dataclasses.replace(finger_posterior, fit=misfit))
    assert "unreliable" not in repr(finger_fit)
    assert len(repr(test_pages.drive(trusted=False))) < 150


def test_table_has_headings_and_cells_in_order():
    page = Tags(html_table([("", "a"), ("<i>",), ("x", "1", "a remark")]))
    assert page.tags == ["table", "tr", "th", "th", "tr", "th", "tr", "td", "td", "td"]
    assert page.words.split() == ["a", "<i>", "x", "1", "a", "remark"]


def numbers(axes: Any, name: str) -> np.ndarray:
    """Return the y values of the line of this name, or of the first line for "data"."""
    (line,) = axes.lines[:1] if name == "data" else (line for line in axes.lines if line.get_label() == name)
    return np.asarray(line.get_ydata())


def test_record_is_drawn_with_its_units_on_one_time_axis(finger_fit: fitact.Fit):
    record = finger_fit.record
    axes = record.plot()
    assert [each.get_ylabel() for each in axes] == ["drive V / V", "skin voltage Vsc / V"]
    assert axes[-1].get_xlabel() == "time / ms"
    assert axes[0].get_shared_x_axes().joined(*axes)
    for each, channel in zip(axes, ("V", "Vsc"), strict=True):
        np.testing.assert_allclose(numbers(each, "data"), record[channel], rtol=1e-6)


def test_long_record_is_drawn_with_its_extremes_and_clipped_samples_are_marked():
    time, random = np.arange(100_000) * 1e-5, np.random.default_rng(1)
    vsc = np.clip(10.0 * np.sin(2.0 * np.pi * 50.0 * time) + 0.1 * random.standard_normal(time.size), -9.0, 9.0)
    (axes,) = [fitact.Record.from_arrays(time, Vsc=vsc).plot()]
    assert numbers(axes, "data").size <= 4000
    clipped = np.abs(numbers(axes, "clipped"))
    assert clipped.min() > 8.5
    assert np.mean(clipped == 9.0) > 0.9


def test_fit_is_drawn_with_its_residuals(finger_fit: fitact.Fit):
    drive, above, below = finger_fit.plot()
    np.testing.assert_allclose(numbers(drive, "data"), finger_fit.record["V"], rtol=1e-6)
    fitted = finger_fit.record["Vsc"] - finger_fit.residuals
    # a delay may shift the first and last six samples beyond V
    np.testing.assert_allclose(numbers(above, "fit"), fitted[6:-6], rtol=1e-6)
    assert below.get_ylabel() == "data − fit / mV"
    (line,) = below.lines
    np.testing.assert_allclose(line.get_ydata(), 1e3 * finger_fit.residuals[6:-6], rtol=1e-5, atol=1e-4)


def test_spectrum_is_drawn_as_a_bode_diagram(spectrum: fitact.Spectrum):
    above, below = spectrum.plot()
    assert (above.get_xscale(), above.get_yscale(), below.get_yscale()) == ("log", "log", "linear")
    scale = {"|Z| / MΩ": 1e6, "|Z| / Ω": 1.0, "|Z| / kΩ": 1e3}[above.get_ylabel()]
    np.testing.assert_allclose(scale * above.lines[0].get_ydata(), np.abs(spectrum.values), rtol=1e-6)
    np.testing.assert_allclose(below.lines[0].get_ydata(), np.angle(spectrum.values, deg=True), rtol=1e-6)


def test_identifiability_is_an_ellipse_of_the_stated_size(finger_fit: fitact.Fit):
    """Its extent is 2.45 standard deviations, the radius of 95 % of a normal distribution in two dimensions."""
    figure, ax = plt.subplots()
    assert finger_fit.plot_identifiability(ax=ax) is ax
    extent = np.ptp(np.log(numbers(ax, "prior, 95 %"))) / 2.0
    (name,) = [n for n in finger_fit.names if ax.get_ylabel().startswith(f"{n} /")]
    prior = finger_fit.likelihood.prior
    assert extent == pytest.approx(np.sqrt(-2.0 * np.log(0.05)) * prior.log_sd[prior.names.index(name)], rel=1e-3)
    assert plt.get_fignums() == [figure.number]


def test_budget_is_drawn_for_each_quantity(finger_fit: fitact.Fit):
    axes = [each for each in finger_fit.plot_budget() if each.get_title(loc="left")]
    assert len(axes) == len(finger_fit.budgets)
    for each, (name, budget) in zip(axes, finger_fit.budgets.items(), strict=True):
        assert each.get_title(loc="left").startswith(f"{name}: u = ")
        widths = [abs(patch.get_width()) for patch in each.patches]
        assert np.hypot.reduce(widths) == pytest.approx(100.0 * budget.combined_budget.u, rel=2e-3)


def test_posterior_is_drawn_with_prior_force_and_law(finger_posterior: fitact.Posterior):
    axes = finger_posterior.plot()
    labels = [each.get_xlabel().partition(" /")[0] for each in axes]
    assert labels == ["Rsc", "Csc", "Ci", "Rsc", "Rsc", "Csc", "mean force", "rms force", "peak force"]
    assert FORCE_LAW in plt.gcf().get_supxlabel()


def test_force_over_time_has_the_moments_of_the_force(finger_posterior: fitact.Posterior):
    """The peak of its median is that of the peak force; the mean over whole periods that of the mean force."""
    time, force = finger_posterior.force_in_time
    draws, median = finger_posterior.force(), force[3]
    assert np.trapezoid(median, time) / np.ptp(time) == pytest.approx(np.median(draws["force_mean"]), rel=0.02)
    assert median.max() == pytest.approx(np.median(draws["force_peak"]), rel=0.02)
    assert np.all(np.diff(force, axis=0) >= 0.0)
    axes = finger_posterior.plot_force()
    assert axes.get_ylabel() == "electrostatic force / mN"
    np.testing.assert_allclose(numbers(axes, "median"), 1e3 * median, rtol=1e-5)
    assert FORCE_LAW in plt.gcf().get_supxlabel()


def test_track_plan_and_designs_are_drawn(results, track: fitact.Track):
    axes = track.plot()
    assert [each.get_ylabel() for each in axes] == ["skin resistance Rsc / kΩ", "electrostatic force, mean / µN"]
    _, ax = plt.subplots()
    assert track.plot("Rsc", ax=ax) is ax
    plan = results["plan"].plot()
    assert [label.get_text() for label in plan.get_yticklabels()] == ["planned model", "float64", "R_H"]
    bars = results["measurement"].plot()[0]
    assert [label.get_text() for label in bars.get_yticklabels()] == [
        "longer record", "series resistor", "current", "now",
    ]  # fmt: skip
    assert len(results["drive"].plot()) == 4


def test_population_is_drawn_in_four_panels():
    figure = draw_population(*test_pages.population(), make=plt.figure)
    assert [each.get_title() for each in figure.axes if each.get_title()] == [
        "Fingers", "Force on different fingers", "The next finger in time", "Sources of variance",
    ]  # fmt: skip


def test_levels_of_a_population_have_panels_of_their_own():
    """Each touch beside those of its person, and two parts of each bar."""
    figure = draw_population(*test_pages.population_with_levels(), make=plt.figure)
    panels = {each.get_title(): each for each in figure.axes if each.get_title()}
    assert list(panels) == [
        "Fingers", "Force on different fingers", "Touches", "Levels", "The next finger in time", "Sources of variance",
    ]  # fmt: skip
    assert [label.get_text() for label in panels["Touches"].get_xticklabels()] == ["Ann", "Ben"]
    widths = np.reshape([bar.get_width() for bar in panels["Levels"].patches], (2, -1))
    np.testing.assert_allclose(widths.sum(axis=0), 1.0)
    assert widths[0, -1] == pytest.approx(0.35**2 / (0.35**2 + 0.06**2))  # Rsc, the uppermost


def test_many_people_have_their_names_below_their_touches():
    """Twelve people: more than the legend has room for, which then names none."""
    tree, content = test_pages.population_with_levels()
    people = [f"P{number}" for number in range(12)]
    finger = content["fingers"][0]
    fingers = [finger | {"units": {"person": name, "repetition": name}} for name in people]
    figure = draw_population(tree, content | {"fingers": fingers}, make=plt.figure)
    panels = {each.get_title(): each for each in figure.axes if each.get_title()}
    assert [label.get_text() for label in panels["Touches"].get_xticklabels()] == people
    texts = [text.get_text() for text in panels["Fingers"].get_legend().get_texts()]
    assert texts == ["new fingers", "records, 95 %"]


def test_data_frames_hold_the_numbers(finger_fit, finger_posterior, track, spectrum):
    record = finger_fit.record.to_dataframe()
    assert list(record) == ["time_s", "V_V", "Vsc_V"]
    np.testing.assert_array_equal(record["Vsc_V"], finger_fit.record["Vsc"])
    np.testing.assert_array_equal(spectrum.to_dataframe()["imag"], spectrum.values.imag)
    table = finger_fit.to_dataframe()
    assert table.loc["Rsc", "q50"] == finger_fit.parameters()["Rsc"]["q50"]
    assert table.loc["force_mean", "unit"] == "N"
    draws = finger_posterior.to_dataframe()
    assert draws.index.names == ["chain", "draw"]
    np.testing.assert_array_equal(draws["force_mean"].loc[1], finger_posterior.force()["force_mean"][1])
    assert list(track.to_dataframe()) == list(track.to_columns())


def test_a_fit_does_not_import_what_draws():
    """Neither does a record; matplotlib and pandas take a second."""
    code = (
        "import sys, numpy as np, fitact; t = np.arange(50) / 50; r = fitact.Record.from_arrays(t, Vsc=np.sin(40 * t));"
        "repr(r), fitact.Fit, fitact.Posterior, fitact.Population, fitact.DriveDesign, fitact.Track;"
        "print([m for m in ('matplotlib.figure', 'pandas', 'schemdraw.elements', 'arviz') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ast.literal_eval(done.stdout) == []
