"""The command `make bench-calibration`: its records, its figures, and records that fits were once wrong about."""

import numpy as np
import pytest

from tests import bench_calibration as benches


def rows_of(below: np.ndarray, error: float = 0.5) -> list[dict]:
    """Return rows whose quantities have these probabilities below the truth, and this error."""
    quantities = [
        {name: {"error": error, "u": 1.0, "below": value} for name in benches.QUANTITIES} for value in below.tolist()
    ]
    setup = {"drive": "triangle", "instrument": "16 bits", "channels": "I", "periods": 2.0, "seconds": 1.0}
    found = {
        "trusted": True,
        "result": "successful",
        "verdict": "identified",
        "bound": dict.fromkeys(benches.FINGER, 0.5),
    }
    return [{"record": i, **setup, **found, "quantities": each} for i, each in enumerate(quantities)]


def test_coverage():
    even = (np.arange(400) + 0.5) / 400
    assert benches.passes(rows_of(even))
    assert not benches.passes(rows_of(0.5 + 0.4 * (even - 0.5)))  # intervals too wide
    assert not benches.passes(rows_of(np.where(even < 0.2, 0.001, even)))  # a fifth of the records outside
    assert not benches.passes([])


def test_exceptions_fail_and_wrong_fits_are_listed():
    rows = rows_of((np.arange(400) + 0.5) / 400, error=4.5)
    assert "reliable and wrong: 400" in benches.counts(rows)
    assert benches.passes(rows)
    failed = {name: rows[0][name] for name in ("drive", "instrument", "channels", "periods", "seconds")}
    rows.append({"record": 400, **failed, "error": "ValueError: none (here:1)"})
    assert "exceptions: 1" in benches.counts(rows)
    assert not benches.passes(rows)
    assert benches.table(rows).count("\n") == len(benches.QUANTITIES)


def test_records():
    """Each has its own seed, and its range is 1.3 times the largest value."""
    first, again = benches.simulate(1, 2), benches.simulate(1, 2)
    assert first.record.fingerprint == again.record.fingerprint
    assert first.truth != benches.simulate(1, 3).truth
    V = first.record["V"]
    assert np.ptp(V) == pytest.approx(2.0 * first.setup["amplitude"], rel=0.01)
    level = np.min(np.diff(np.unique(V)))
    assert 2**16 * level == pytest.approx(2.6 * np.max(np.abs(V)), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 6, 22])
def test_records_that_were_wrong(number: int):
    """Hum beside a harmonic of the drive (2, 6), and a drive with noise of little more than a step of 12 bits (22)."""
    row = benches.measure(number, 1)
    assert row["result"] == "successful"
    assert benches.worst(row) < benches.WRONG
    assert not any("outliers" in each for each in row["warnings"])
