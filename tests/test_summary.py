"""Summaries against SciPy, numbers for people, and the advice for each result."""

import pytest
import scipy.stats

import fitact
from fitact import summary
from fitact.fitting.outcome import RESULT_NAMES
from fitact.result_text import quantity_table
from fitact.summary import format_estimate, format_interval, summarize_normal
from fitact.what_now import advice_sections, explain


def test_a_log_normal_is_scipys():
    found, law = summary.summarize_log_normal("Rsc", 160e3, 0.7), scipy.stats.lognorm(0.7, scale=160e3)
    assert found["mean"] == pytest.approx(law.mean())
    assert found["sd"] == pytest.approx(law.std())
    for key, share in summary.PROBABILITIES.items():
        assert found[key] == pytest.approx(law.ppf(share))


@pytest.mark.parametrize(
    ("name", "median", "sd", "estimate", "interval"),
    [
        ("Rsc", 160123.0, 8.04e3, "160.1 ± 8.0 kΩ", "146.9 to 173.3 kΩ"),
        ("Rsc", 160123.0, 9.96e2, "160.1 ± 1.0 kΩ", "158.5 to 161.8 kΩ"),  # 0.996 has two digits at 1.0
        ("Ci", 1.35e-9, 6.8e-11, "1.350 ± 0.068 nF", "1.238 to 1.462 nF"),
        ("g", 0.05465142, 7.04e-6, "0.0546514 ± 0.0000070", "0.0546398 to 0.0546630"),
        ("force_mean", 270.2e-6, 123e-6, "270 ± 120 µN", "70 to 470 µN"),
        ("offset", -8.07e-2, 1.4e-3, "-80.7 ± 1.4 mV", "-83.0 to -78.4 mV"),
        ("offset", 1e-3, 5e-3, "1 mV (sd 5 mV)", "-7.2 mV to 9.2 mV"),  # more sd than value
        ("b", 4e-3, 0.0, "4 ms", "4 ms to 4 ms"),
    ],
)
def test_two_digits_of_uncertainty_and_the_estimate_to_the_same_place(name, median, sd, estimate, interval):
    s = summarize_normal(name, median, sd)
    assert format_estimate(s) == estimate
    assert format_interval(s) == interval


def test_parameters_of_the_finger_and_of_the_measurement_stand_apart(finger_posterior: fitact.Posterior):
    rows = quantity_table(finger_posterior.summary())
    headings = [row[0] for row in rows if len(row) == 1]
    assert headings == ["circuit", "computed, not measured", "measurement"]
    names = [row[0] for row in rows]
    assert names.index("measurement") < names.index("charge")
    assert next(row for row in rows if row[0] == "charge")[6].startswith("transient in Vsc at the first sample")


def test_every_result_has_its_advice():
    names = {"refused", "prior-limited", "unidentified", "not converged", "interrupted", "k-hat", "laplace"}
    names |= {name for name in RESULT_NAMES if name != "successful"}
    assert names <= set(advice_sections())
    with pytest.raises(fitact.InputError, match="did you mean 'misfit'"):
        explain("misfitt")
    assert "](" not in "".join(advice_sections().values())  # links lead nowhere in a terminal
