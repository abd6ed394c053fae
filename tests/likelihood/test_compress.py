"""The compressed likelihood against sums over the samples that are computed independently."""

import dataclasses
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.likelihood import certificate
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import Whitening
from fitact.likelihood.projection import compress
from fitact.model.circuit import HighpassTerms
from tests.conftest import skin_voltage, square_record

TAU = 4e-3
SQUARE = fitact.Scene.from_dict({"drive": {"waveform": "square"}})


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def unit_response(time: np.ndarray, voltage: np.ndarray, tau: float, hold: bool = False) -> np.ndarray:
    """Return scipy's response of s tau / (1 + s tau) from rest, which is a finger with tiny Ci."""
    return skin_voltage(time, voltage, Rsc=tau / (2e-15 + 1e-9), Csc=1e-9, Ci=1e-15, hold=hold) * (1e-9 + 2e-15) / 1e-15


def products(columns: np.ndarray) -> np.ndarray:
    return columns @ columns.T


def check(compression, u: np.ndarray, decay: np.ndarray | None, slow: np.ndarray, y: np.ndarray, tau: float) -> None:
    """Compare every inner product of the model functions and the record with its sum over the samples."""
    theirs = [u, *slow, y] if decay is None else [u, *slow, y, decay]
    ours = [compression.response(HighpassTerms((1.0,), (tau,))), *compression.baseline, compression.observed]
    if decay is not None:
        ours.append(compression.decays(jnp.asarray(tau)))
    expected = products(np.stack(theirs))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(products(np.stack(ours)) / scale, expected / scale, atol=3e-11)


def slow(time: np.ndarray) -> np.ndarray:
    since = time - 0.5 * (time[0] + time[-1])
    angles = [2.0 * np.pi * f * since for f in (50.0, 60.0, 150.0, 180.0)]
    waves = [wave(angle) for angle in angles for wave in (np.cos, np.sin)]
    return np.stack([np.ones_like(time), since / since[-1], *waves])


@pytest.mark.parametrize("factor", [0.12, 0.5, 1.0, 1.7, 8.5])
@pytest.mark.parametrize("kind", ["even", "uneven", "with a gap"])
def test_measured_drive(kind: str, factor: float):
    rng = np.random.default_rng(3)
    grid = np.arange(20001) * 2e-6
    kept = {
        "even": np.arange(20001),
        "uneven": np.unique(np.concatenate([[0, 20000], rng.integers(0, 20001, 9000)])),
        "with a gap": np.r_[0:7000, 9000:20001],
    }[kind]
    time, voltage = grid[kept], np.cumsum(rng.standard_normal(kept.size))
    y = rng.standard_normal(kept.size)
    tau = factor * TAU
    # the same polyline on the even grid that scipy requires
    u = unit_response(grid, np.interp(grid, time, voltage), tau)[kept]
    compression = compress(
        fitact.Sampled(time, voltage), time, y, steady_state=False, expected_terms=HighpassTerms((0.05,), (TAU,))
    )
    check(compression, u, np.exp(-(time - time[0]) / tau), slow(time), y, tau)


@pytest.mark.parametrize("frequency", [100.0, 300.0, 101.37])
def test_settled_square(frequency: float):
    """Periods of 2000 samples, of 2000/3 samples, and one that does not fit the sampling grid."""
    time = np.arange(30000) * 5e-6
    drive = fitact.Square(360.0, frequency)
    half = 0.5 / frequency
    cycles = np.round(time * frequency * 1e9) / 1e9
    since = np.where(cycles % 1.0 < 0.5, cycles % 1.0, cycles % 1.0 - 0.5) / frequency
    sign = np.where(cycles % 1.0 < 0.5, 1.0, -1.0)
    y = np.random.default_rng(4).standard_normal(time.size)
    compression = compress(drive, time, y, steady_state=True, expected_terms=HighpassTerms((0.05,), (TAU,)))
    for tau in (0.2 * TAU, TAU, 3.0 * TAU):
        u = sign * 360.0 / (1.0 + np.exp(-half / tau)) * np.exp(-since / tau)
        check(compression, u, None, slow(time), y, tau)


def test_square_from_rest():
    time = np.arange(3000) * 1e-5
    voltage = np.where(np.arange(3000) % 1000 < 500, 180.0, -180.0)
    y = np.random.default_rng(5).standard_normal(time.size)
    compression = compress(
        fitact.Square(360.0, 100.0), time, y, steady_state=False, expected_terms=HighpassTerms((0.05,), (TAU,))
    )
    check(compression, unit_response(time, voltage, TAU, hold=True), None, slow(time), y, TAU)


@pytest.mark.parametrize("kind", ["measured drive", "stated drive"])
def test_coloured_noise(kind: str):
    """All functions and the record are filtered by scipy; a gap of the filter excludes the samples it reaches."""
    rng = np.random.default_rng(8)
    time = 5e-6 * np.arange(20_000)
    voltage = np.where(np.arange(time.size) % 1000 < 500, 180.0, -180.0)
    taps, mask = np.array([1.3, -0.7, 0.2]), np.ones(time.size)
    mask[:2] = mask[9_000:9_003] = 0.0
    weight = np.ones(time.size)
    weight[9_000] = 0.0
    y = rng.standard_normal(time.size)
    drive = fitact.Sampled(time, voltage) if kind == "measured drive" else fitact.Square(360.0, 200.0)
    compression = compress(
        drive,
        time,
        y,
        steady_state=False,
        weight=weight,
        whitening=Whitening(taps, mask),
        expected_terms=HighpassTerms((0.05,), (TAU,)),
    )

    def filtered(values: np.ndarray) -> np.ndarray:
        return scipy.signal.lfilter(taps, 1.0, values * weight) * mask

    u = unit_response(time, voltage, TAU, hold=kind == "stated drive")
    decay = np.exp(-time / TAU) if kind == "measured drive" else None
    check(compression, filtered(u), None if decay is None else filtered(decay), filtered(slow(time)), filtered(y), TAU)
    assert compression.samples == np.count_nonzero(mask)


@pytest.mark.parametrize("delay", [-5.3, -1.0, -0.4, 0.0, 0.7, 1.0, 2.9, 5.6])
def test_delay_of_a_measured_drive(delay: float):
    """The response to the polyline of the samples, shifted on a grid ten times finer; it is restricted around it."""
    rng, step, steps = np.random.default_rng(9), 2e-6, 3_000
    time, fine = step * np.arange(steps), step / 10.0 * np.arange(10 * (steps + 10))
    voltage = np.cumsum(rng.standard_normal(steps))
    voltage[:20] = voltage[-20:] = 0.0  # no matter what V was before and after the record
    y = rng.standard_normal(steps)
    u = unit_response(fine, np.interp(fine, time, voltage), TAU)
    delayed = np.interp(time - delay * step, fine, u)
    compression = compress(
        fitact.Sampled(time, voltage),
        time,
        y,
        steady_state=False,
        noise=np.zeros(steps),
        expected_terms=HighpassTerms((0.05,), (TAU,)),
    )
    narrow = compression.restrict(
        math.log(TAU), 0.1, 1e-10, charge=0.0, delay=((delay - 0.1) * step, (delay + 0.1) * step)
    )
    assert len(narrow.steps) < len(compression.steps)
    for table in (compression, narrow):
        assert table.covers(np.array(TAU), delay * step)
        assert not table.covers(np.array(TAU), (delay + 14.0) * step)
        ours = table.response(HighpassTerms((1.0,), (TAU,)), delay * step)
        expected = products(np.stack([delayed, *slow(time), y]))
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        found = products(np.stack([ours, *table.baseline, table.observed]))
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize("delay", [-3.3, 0.0, 0.7, 1.9])
@pytest.mark.parametrize("tau", [0.01, 0.1, 0.4])
def test_steps_give_the_delayed_response_of_a_short_time_constant(delay: float, tau: float):
    """Responses to a polyline on the finer grid, with a long one beside; `tau` is in time steps."""
    rng, step, steps = np.random.default_rng(9), 2e-6, 3_000
    time, fine = step * np.arange(steps), step / 10.0 * np.arange(10 * (steps + 10))
    voltage, y, tau = np.cumsum(rng.standard_normal(steps)), rng.standard_normal(steps), tau * step
    voltage[:20] = voltage[-20:] = 0.0
    u = sum(w * unit_response(fine, np.interp(fine, time, voltage), t) for w, t in ((0.3, TAU), (0.7, tau)))
    delayed = np.interp(time - delay * step, fine, u)
    noise, terms = rng.standard_normal(steps), HighpassTerms((0.3,), (TAU,))
    table = compress(fitact.Sampled(time, voltage), time, y, steady_state=False, expected_terms=terms, noise=noise)
    table = dataclasses.replace(table, short=1)
    narrow = table.restrict(
        np.log([TAU]), np.full(1, 0.1), 1e-10, charge=0.0, delay=((delay - 0.1) * step, (delay + 0.1) * step)
    )
    for each in (table, narrow):
        assert each.covers(np.array([TAU, tau]), delay * step).all()
        assert not each.covers(np.array([TAU, 2.0 * step]), delay * step)[1]
        ours = each.response(HighpassTerms((0.3, 0.7), (TAU, tau)), delay * step, 0.05)
        expected = products(np.stack([delayed + 0.05 * noise, *slow(time), y]))
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        found = products(np.stack([ours, *each.baseline, each.observed]))
        # what was 4.1 steps ago has decayed to 4e-5
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-6 if tau == 0.4 * step else 1e-9)


def test_a_table_for_time_constants_far_below_a_late_step_stays_finite():
    """The response 2 steps back from a sample grew by e^{2 / tau}, and an SVD of infinite numbers failed."""
    rng, time = np.random.default_rng(12), 2e-6 * np.arange(2_000)
    voltage, y, tau = np.cumsum(rng.standard_normal(time.size)), rng.standard_normal(time.size), 2e-5
    voltage[:20] = voltage[-20:] = 0.0
    terms, noise = HighpassTerms((1.0,), (tau,)), np.zeros(time.size)
    how = {"steady_state": False, "expected_terms": terms, "noise": noise, "is_wide": True}
    table = compress(fitact.Sampled(time, voltage), time, y, **how)
    narrow = table.restrict(np.log([tau]), np.full(1, 9.0), 1e-7, charge=0.0, delay=(3e-6, 5e-6))
    u = np.interp(time - 4e-6, time, unit_response(time, voltage, tau))
    products = [each.response(terms, 4e-6) @ each.observed for each in (table, narrow)]
    np.testing.assert_allclose(products, u @ y, rtol=0.0, atol=1e-7 * np.linalg.norm(u) * np.linalg.norm(y))


def test_several_time_constants_far_apart():
    time = 2e-6 * np.arange(20_000)
    voltage = np.cumsum(np.random.default_rng(10).standard_normal(time.size))
    y = np.random.default_rng(11).standard_normal(time.size)
    terms = HighpassTerms((0.05, 0.02, 0.01), (TAU, 2e-4, 1.5e-5))
    compression = compress(fitact.Sampled(time, voltage), time, y, steady_state=False, expected_terms=terms)
    for tau in terms.tau:
        u = unit_response(time, voltage, tau)
        check(compression, u, np.exp(-time / tau), slow(time), y, tau)
    # a narrow table for each time constant
    taus = 1.04 * np.array(terms.tau)
    narrow = compression.restrict(np.log(terms.tau), np.full(3, 0.05), 1e-7, charge=1.0, delay=(0.0, 0.0))
    assert narrow.signal.shape[1] < compression.signal.shape[1]
    assert np.all(narrow.covers(taus))
    assert not np.any(narrow.covers(1.04 * taus))
    decays = [np.exp(-time / tau) for tau in taus]
    summed = sum(w * unit_response(time, voltage, tau) for w, tau in zip(terms.weight, taus, strict=True))
    expected = products(np.stack([summed, *decays, *slow(time), y]))
    ours = [narrow.response(HighpassTerms(terms.weight, tuple(taus)))]
    ours += [narrow.decays(tau, index) for index, tau in enumerate(taus)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    found = products(np.stack([*ours, *narrow.baseline, narrow.observed]))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [None, SQUARE], ids=["measured drive", "folded square"])
def test_fit_and_log_probabilities_are_those_of_the_samples(scene):
    record = square_record(offset=0.1, periods=4)
    ours, full = (fitact.fit(record, scene, tolerance=tolerance) for tolerance in (1e-3, 0.0))
    assert ours.model()["likelihood"] == "compressed"
    assert full.model()["likelihood"] == "full"
    assert full.full_because == "the full sum was requested"
    assert ours.compression_error < 1e-3
    np.testing.assert_allclose(ours.theta, full.theta, atol=1e-4 * full.sd.min())
    np.testing.assert_allclose(ours.sd, full.sd, rtol=1e-6)
    assert ours.linear.keys() == full.linear.keys()
    # points further away than those of the diagnostic
    deviates = np.random.default_rng(6).standard_normal((20, full.theta.size))
    points = np.column_stack([full.theta + 3.0 * deviates @ full.covariance_root.T, np.full(20, np.log(full.sigma))])
    a, b = (certificate.batched_log_prob(fit.likelihood, 32)(points) for fit in (ours, full))
    np.testing.assert_allclose(a, b, atol=2e-3)
    assert np.ptp(b) > 10.0


@pytest.mark.slow
def test_cost_does_not_grow_with_the_record():
    rows = [fitact.fit(square_record(periods=n), SQUARE).likelihood.rows for n in (1, 40)]
    assert rows[1] <= rows[0] + 2  # a longer record is more accurate and needs one or two more terms
    assert rows[1] < 40


@pytest.mark.slow
def test_points_beyond_the_table_are_summed_over_the_samples():
    fit = fitact.fit(square_record(), SQUARE)
    far = np.append(fit.theta, np.log(fit.sigma)) + np.array([0.7, 0.0, 0.0, 0.0])
    near = np.append(fit.theta, np.log(fit.sigma))
    full = fit.likelihood.without_compression()
    expected = [float(Likelihood.log_prob(full, jnp.asarray(point))) for point in (far, near)]
    np.testing.assert_allclose(
        certificate.batched_log_prob(fit.likelihood, 2)(np.stack([far, near])), expected, rtol=1e-9
    )


@pytest.mark.parametrize(
    ("made", "tolerance", "reason"),
    [
        pytest.param({"per_period": 200}, 1e-3, "shorter than 512 samples", marks=pytest.mark.slow),
        pytest.param({}, 1e-13, "is .* near the optimum", marks=pytest.mark.slow),
    ],
)
def test_samples_are_summed_where_compression_does_not_hold(made: dict[str, int], tolerance: float, reason: str):
    fit = fitact.fit(square_record(**made), SQUARE, tolerance=tolerance)
    assert fit.model()["likelihood"] == "full"
    assert fit.compression_error is None

    assert re.search(reason, fit.full_because)
    assert fit.trusted


@pytest.mark.parametrize(
    ("error", "excess", "reason"),
    [
        (0.9e-3, 0.9e-3, "^$"),
        (1.1e-3, 0.0, "is 0.0011 near the optimum"),
        (0.0, 0.01, "is 0.01 within the prior"),
        (math.nan, 0.0, "outside the range"),
    ],
)
def test_what_speaks_against_a_compression(error: float, excess: float, reason: str):
    assert re.search(reason, certificate._compression_failure(error, excess, 1e-3))


class OnDisk:
    """Array that must not be read in more than one chunk at a time."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.size = values, values.size

    def __getitem__(self, place):
        found = self.values[place]
        assert np.size(found) <= 65_536
        return found


@pytest.mark.parametrize("kind", ["measured", "folded", "not folded", "chirp"])
def test_no_more_than_a_chunk_is_read_at_a_time(kind: str):
    """Records may be larger than memory: the arrays may be memory maps."""
    count = 150_000
    time, y = np.arange(count) * 5e-6, np.random.default_rng(8).standard_normal(count)
    drive = {
        "measured": lambda: fitact.Sampled(time, np.sin(2e3 * time)),
        "folded": lambda: fitact.Square(360.0, 100.0),
        "not folded": lambda: fitact.Square(360.0, 97.00013),
        "chirp": lambda: fitact.Chirp(360.0, 20.0, 200.0, 0.75),
    }[kind]()
    steady = "folded" in kind
    compression = compress(
        drive, OnDisk(time), OnDisk(y), steady_state=steady, expected_terms=HighpassTerms((0.05,), (TAU,))
    )
    assert float(compression.observed @ compression.observed) == pytest.approx(y @ y, rel=1e-12)


@pytest.mark.parametrize("tolerance", [-1.0, float("nan"), float("inf")])
def test_a_tolerance_that_is_none_is_refused(tolerance: float):
    with pytest.raises(fitact.InputError, match="tolerance"):
        fitact.fit(square_record(), SQUARE, tolerance=tolerance)


@pytest.mark.slow
def test_force_of_a_long_record_is_that_of_a_short_one():
    """Above 20,000 samples only the last periods are computed, after the charge has decayed."""
    short, long = (fitact.fit(square_record(periods=n, noise=1e-3)).derived() for n in (9, 30))
    for name in ("force_mean", "force_peak", "force_rms"):
        assert long[name]["q50"] == pytest.approx(short[name]["q50"], rel=2e-4)
