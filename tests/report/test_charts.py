"""Data of charts that readers can zoom and inspect: numbers as plotly.js reads them, and no markup."""

import base64
import json
from html.parser import HTMLParser

import jinja2
import numpy as np
import pytest
import scipy.stats
import xarray as xr
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.interactive import Axis
from fitact.charts.picture import draw_plot
from fitact.report.posterior import make_charts

FORCES = ("force_mean", "force_rms", "force_peak")
TIME = Axis.from_values("time", "s", [0.0, 0.02])
VOLTAGE = Axis.from_values("Vsc", "V", [-15.0, 15.0])


def numbers(packed: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["bdata"]), f"<{packed['dtype']}")


def test_values_stand_in_the_unit_that_the_axis_names():
    trace = interactive.line(TIME, VOLTAGE, [0.0, 0.005, 0.02], [1.0, 2.0, -3.0], "record")
    assert TIME.layout()["title"]["text"] == "time / ms"
    np.testing.assert_allclose(numbers(trace["x"]), [0.0, 5.0, 20.0], rtol=1e-15)
    np.testing.assert_array_equal(numbers(trace["y"]), [1.0, 2.0, -3.0])
    assert trace["hovertemplate"].endswith("V<extra></extra>")


def test_limits_of_a_logarithmic_axis_are_exponents_of_the_unit_shown():
    axis = Axis.from_values("Rsc", "ohm", [160e3], log=True, limits=(1e4, 1e6))
    assert axis.layout()["range"] == pytest.approx([1.0, 3.0])
    assert Axis.from_values("Rsc", "ohm", [160e3], limits=(1e4, 1e6)).layout()["range"] == pytest.approx([10.0, 1000.0])


def test_a_long_series_keeps_its_extremes_and_is_bounded():
    values = np.random.default_rng(1).standard_normal(1_000_000)
    values[[123_456, 765_432]] = 50.0, -60.0
    at = interactive.extremes(values)
    assert at.size <= 4000
    assert {123_456, 765_432} <= set(at)
    assert np.all(np.diff(at) > 0)
    assert interactive.extremes(values[:3999]).size == 3999


def test_a_density_is_that_of_the_axis_it_is_drawn_on():
    """For log-normal draws, the density of the logarithm peaks at the median, that of the value at exp(-s^2) of it."""
    draws = scipy.stats.lognorm(s=0.5, scale=160e3).rvs(200_000, random_state=3)
    axis = Axis.from_values("Rsc", "ohm", draws, log=True)
    trace = interactive.density(axis, draws, "posterior")
    edges = numbers(trace["x"]) * axis.size
    for kind, mode in (("log", 160e3), ("linear", 160e3 * np.exp(-0.25))):
        heights = numbers(trace["meta"][kind])
        assert heights.max() == 1.0
        broad = np.sqrt(edges[:-1] * edges[1:])[heights[:-1] > 0.9]
        assert np.exp(np.mean(np.log(broad))) == pytest.approx(mode, rel=0.05)
    below = np.interp(160e3, edges, numbers(trace["customdata"]))
    assert below == pytest.approx(0.5, abs=0.01)
    assert trace["y"] == trace["meta"]["log"]


def test_buttons_switch_what_they_say():
    x = Axis.from_values("Rsc", "ohm", [1e5], log=True)
    heights = Axis("density")
    traces = [interactive.density(x, [1e5, 2e5, 3e5], name) for name in ("prior", "posterior")]
    plots = [interactive.plot(x, (heights, traces))]
    hide = interactive.visibility_button("prior", plots, "prior")["updates"][0]
    assert hide["off"] == {"traces": [0], "restyle": {"visible": False}, "relayout": {}}
    log = interactive.log_axis_button(plots)
    assert log["pressed"]
    assert log["updates"][0]["off"]["relayout"] == {"xaxis.type": "linear", "xaxis.nticks": 6}
    assert log["updates"][0]["off"]["restyle"]["y"] == [trace["meta"]["linear"] for trace in traces]


def test_a_long_record_is_drawn_whole_and_its_beginning_sample_by_sample():
    time, rng = np.arange(1_000_000) * 5e-6, np.random.default_rng(2)
    vsc = rng.standard_normal(time.size)
    vsc[700_001] = 40.0
    drawn = {name: (("chain", "draw"), rng.lognormal(size=(2, 50)), {"units": "N"}) for name in FORCES}
    skin = {name: (("chain", "draw"), rng.lognormal(size=(2, 50)), {"units": "F"}) for name in ("Csc", "Ci")}
    seen = {"Vsc": ("time", vsc, {"units": "V"})}
    predicted = {"Vsc": (("chain", "draw", "time"), rng.standard_normal((1, 20, 4000)), {"units": "V"})}
    tree = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset(drawn | skin),
            "combined": xr.Dataset(drawn | skin),
            "prior": xr.Dataset(skin),
            "observed_data": xr.Dataset(seen, {"time": time}),
            "constant_data": xr.Dataset(
                {
                    "Vsc_fit": ("time", np.zeros(time.size)),
                    "V": ("time", 100.0 * np.sign(vsc), {"units": "V"}),
                    "I_recorded": ("time", 1e-6 * vsc, {"units": "A"}),
                },
                {"time": time},
            ),
            "force_in_time": xr.Dataset(
                {"force": (("quantile", "time"), np.ones((3, 5)))},
                {"quantile": [0.05, 0.5, 0.95], "time": np.arange(5.0)},
            ),
            "posterior_predictive": xr.Dataset(predicted, {"time": time[::250]}),
        }
    )
    found = make_charts(tree)
    whole, beginning = (
        {(trace["yaxis"], trace["name"]): trace for trace in each["data"]} for each in found["time"]["plots"]
    )
    titles = [found["time"]["plots"][0]["layout"][f"yaxis{row}"]["title"]["text"] for row in ("", 2, 3, 4)]
    assert titles == ["drive V / V", "skin voltage Vsc / V", "data − fit / V", "loop current I / µA"]
    assert numbers(whole["y2", "data"]["y"]).max() == 40.0
    np.testing.assert_allclose(numbers(beginning["y2", "data"]["x"]), 1e3 * time[:4000], rtol=1e-12)
    np.testing.assert_array_equal(numbers(beginning["y2", "data"]["y"]), vsc[:4000].astype("f4"))
    np.testing.assert_allclose(numbers(beginning["y4", "data"]["y"]), vsc[:4000], rtol=1e-6)
    assert {name for _, name in whole} == {"data", "fit", "5 % predictive", "90 % predictive interval", "data − fit"}
    assert len(json.dumps(found)) < 1e6


def test_nothing_in_a_name_becomes_markup():
    name = "</script><script>alert(1)</script>"
    spec = interactive.chart(interactive.plot(TIME, (VOLTAGE, [interactive.line(TIME, VOLTAGE, [0.0], [1.0], name)])))
    source = '{% from "figures.html" import chart %}{% call chart(spec, "data:,", name) %}a caption{% endcall %}'
    environment = jinja2.Environment(loader=jinja2.PackageLoader("fitact.report"), autoescape=True)
    page = environment.from_string(source).render(spec=spec, name=name)
    found: list[str] = []

    class Scripts(HTMLParser):
        def handle_starttag(self, tag, attrs):
            found.append(tag)

        def handle_data(self, data):
            if self.cdata_elem == "script":
                assert json.loads(data)["plots"][0]["data"][0]["name"] == name

    Scripts().feed(page)
    assert found.count("script") == 1


def test_a_picture_reaches_as_far_as_its_chart():
    x, y = Axis("a", "V", log=True, limits=(0.1, 200.0)), Axis("b", "V")
    plot = interactive.plot(x, (y, [interactive.line(x, y, [1.0, 10.0], [1.0, 2.0], "line", "#000000")]))
    axes = Figure().add_subplot()
    draw_plot(plot, axes)
    assert axes.get_xlim() == pytest.approx((0.1, 200.0))
    assert axes.get_xscale() == "log"
