"""Summaries of laws that SciPy knows."""

import pytest
import scipy.stats

from fitact import summary


def test_a_log_normal_is_scipys():
    found, law = summary.summarize_log_normal("Rsc", 160e3, 0.7), scipy.stats.lognorm(0.7, scale=160e3)
    assert found["mean"] == pytest.approx(law.mean())
    assert found["sd"] == pytest.approx(law.std())
    for key, share in summary.PROBABILITIES.items():
        assert found[key] == pytest.approx(law.ppf(share))
