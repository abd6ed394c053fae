"""One uncertainty for each quantity: terminal, notebook, report and JSON show the combined one, in a dozen lines."""

import re

import numpy as np
import pytest

import fitact
from fitact.charts.bars import draw_budgets
from fitact.result_text import budget_table, describe_summary, next_measurements
from fitact.summary import format_estimate, format_interval
from tests.conftest import RECORDS
from tests.report.test_report import Page

MAIN = ("Rsc", "Csc", "Ci", "force_mean")
ESTIMATE = re.compile(r"[\d.]+ ± [\d.]+ ?\S*")


@pytest.fixture(scope="module")
def bench() -> fitact.Posterior:
    """Return V and I of the shipped bench record, with noise, rounding and skew, and two warnings."""
    scene = fitact.Scene.load(RECORDS / "finger_bench.toml")
    record = fitact.read(RECORDS / "finger_bench.csv", scene)
    coarse = 0.5 * np.round(np.array(record["V"][:3000]) / 0.5)  # V, and less than one and a half periods
    short = fitact.Record.from_arrays(record.time[:3000], V=coarse, I=record["I"][:3000])
    return fitact.sample(fitact.fit(short, scene), level="psis", seed=0)


@pytest.fixture(scope="module", params=["demo", "bench"])
def posterior(request, finger_posterior: fitact.Posterior, bench: fitact.Posterior) -> fitact.Posterior:
    return {"demo": finger_posterior, "bench": bench}[request.param]


def test_terminal_notebook_and_report_show_the_combined_uncertainty_of_the_json(posterior: fitact.Posterior, tmp_path):
    content = posterior.summary()
    posterior.report(tmp_path / "report.html")
    words = " ".join(Page((tmp_path / "report.html").read_text()).words)
    texts = {"short": str(posterior), "long": describe_summary(content, verbose=True), "page": words}
    texts["notebook"] = re.sub(r"<[^>]+>", " ", posterior._repr_html_())
    for name in MAIN:
        s = (content["parameters"] | content["derived"])[name]
        assert s["combined"]["u"] ** 2 == pytest.approx(
            s["u"] ** 2 + sum(each["u"] ** 2 for each in content["budget"][name]["not_stated"]), rel=1e-3
        )
        for where, text in texts.items():
            assert format_estimate(s) in text, (name, where)
            assert format_interval(s) in text, (name, where)
        # no other uncertainty of the estimate stands anywhere
        alone = format_estimate({key: x for key, x in s.items() if key != "combined"})
        assert alone == format_estimate(s) or not any(alone in text for text in texts.values()), name


def test_budget_text_and_picture_end_in_the_combined_uncertainty(posterior: fitact.Posterior):
    content = posterior.summary()
    figure = draw_budgets(content)
    titles = [each.get_title(loc="left") for each in figure.axes]
    for name, entry in content["budget"].items():
        u = (content["parameters"] | content["derived"])[name]["combined"]["u"]
        rows = budget_table(name, content)
        assert rows[-1][4] == f"{np.format_float_positional(100.0 * u, 2, fractional=False, trim='-')} %"
        assert f"{name}: u = {100.0 * u:.2g} %" in titles
        shares = [float(row[5].removesuffix(" %")) for row in rows[1:-1] if row[5]]
        assert sum(shares) == pytest.approx(100.0, abs=2.0)
        assert any("not stated" in row[0] for row in rows) == any(each["u"] > 0.032 * u for each in entry["not_stated"])


def test_the_interval_holds_the_draws_with_every_source(posterior: fitact.Posterior):
    """A gain is uniform within its limits; the mixture is made here by hand for g of the demo."""
    content, rng = posterior.summary(), np.random.default_rng(1)
    draws = posterior.derived()["b"]
    assert content["derived"]["b"]["combined"]["q50"] == pytest.approx(np.median(draws), rel=1e-3)
    g, entry = posterior.derived()["g"].ravel(), content["budget"]["g"]
    if [each["source"] for each in entry["not_stated"]] == ["V gain", "Vsc gain"]:
        gains = [1.0 + limit * rng.uniform(-1.0, 1.0, g.size) for limit in (0.03, 0.02, 0.03, 0.02)]
        mixed = g * gains[0] * gains[1] / (gains[2] * gains[3])
        stated = [content["derived"]["g"]["combined"][key] for key in ("q05", "q50", "q95")]
        np.testing.assert_allclose(stated, np.quantile(mixed, [0.05, 0.5, 0.95]), rtol=2e-3)


def test_a_dozen_lines_of_at_most_110_columns_for_the_demo(finger_posterior: fitact.Posterior):
    lines = str(finger_posterior).splitlines()
    assert len(lines) <= 9  # and one for what is read, one for the sampler, one for the report
    assert max(map(len, lines)) <= 110
    assert lines[0].split("  ")[-1] == "uncertainty from"
    assert [line.split()[0] for line in lines[1:5]] == list(MAIN)
    assert lines[5].startswith("Prior-limited: ")
    assert lines[6].startswith("Next: ")
    assert "simulated" in lines[7]


def test_warnings_are_cut_to_two_lines_and_whole_on_request(bench: fitact.Posterior):
    assert len(bench.warnings) >= 2
    text = str(bench)
    assert len(text.splitlines()) <= 9 + 2 * len(bench.warnings)  # with two warnings and the other lines 16
    assert max(map(len, text.splitlines())) <= 110
    assert text.count("\nwarning: ") == len(bench.warnings)
    whole = describe_summary(bench.summary(), verbose=True)
    assert all(f"warning: {each}" in whole for each in bench.warnings)


def test_the_next_measurement_is_a_table_of_expected_uncertainties(finger_posterior: fitact.Posterior):
    content = finger_posterior.summary()
    titles, now, *changes = next_measurements(content)
    assert titles == ("change", "u of force_mean", "of the circuit", "needs")
    expected = {row[0]: row[1] for row in changes}
    u, sources = (content["derived"]["force_mean"]["combined"][key] for key in ("u", "sources"))
    halved = u * np.sqrt(1.0 - 0.75 * sources["spread of skin thickness"])
    assert float(expected["half the uncertainty of the skin thickness"].removesuffix(" %")) == pytest.approx(
        100.0 * halved, rel=0.05
    )
    assert all(float(x.removesuffix(" %")) <= float(now[1].removesuffix(" %")) for x in expected.values())
    assert all(needs for *_, needs in changes)
    assert content["identifiability"]["sentence"].count("%") <= 2  # the figures are in the table


def test_a_default_decides_the_digits(finger_posterior: fitact.Posterior):
    force = finger_posterior.summary()["derived"]["force_mean"]
    shown = ESTIMATE.search(format_estimate(force))[0]
    assert re.fullmatch(r"\d+0 ± \d0 \S+", shown)  # the spread of the skin's thickness has one digit
    exact = {key: x for key, x in force.items() if key != "combined"}
    assert not format_estimate(exact).split(" ")[2].endswith("0")
