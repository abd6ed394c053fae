"""Populations: against scipy's densities and quadrature, laws in closed form, NUTS, and ngspice's eight fingers."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.linalg
import scipy.special
import scipy.stats
from arviz_stats.base import array_stats

import fitact
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.populations.contact_area import ContactAreaTest
from fitact.populations.covariates import Covariates, read_covariates
from fitact.populations.exact_likelihood import log_weights
from fitact.populations.finger import Finger
from fitact.populations.fit_population import sample_hierarchy
from fitact.populations.hierarchy import Hierarchy
from fitact.populations.next_finger import FACTORS, NewFingerModel, finger_variance_fraction
from fitact.populations.population import evaluate_parameters
from fitact.populations.population_parameters import PopulationParameters
from fitact.populations.sobol import Surrogate, sobol_indices, variance_shares
from fitact.prior.prior import Prior
from fitact.readers.study import Nesting, nest_levels
from tests.population_calibration import FREQUENCY, simulate, steady, vsc, wave

NUTS_CHAINS, NUTS_STEPS = 4, 3000
FINGERS = Path(__file__).parents[2] / "data_synth" / "records" / "fingers"
SCALES = {"Rsc": (11.8, 0.4), "Csc": (-17.7, 0.5), "Ci": (-20.4, 0.1)}  # of logarithms: mean, standard deviation
PRIOR = Prior.from_marginals(**{name: fitact.LogNormal(float(np.exp(mean)), sd) for name, (mean, sd) in SCALES.items()})


def finger_that_says(center: np.ndarray, factor: np.ndarray, target: np.ndarray, source: str = "") -> Finger:
    """A record with a normal likelihood of log Rsc, log Csc and log Ci."""
    return Finger(source, "", "successful", "", {}, None, FINGER_PARAMETERS, center, factor, target)


PEOPLE, SESSIONS = ("P", "P", "P", "Q", "Q", "R", "R", "R", "S"), ("1", "1", "2", "1", "2", "1", "1", "1", "1")


@pytest.mark.parametrize(
    ("varies", "labels", "count"),
    [(False, {}, 0), (False, {"person": PEOPLE}, 2), (True, {"person": PEOPLE, "session": SESSIONS}, 1)],
)
def test_log_posterior_is_that_of_scipys_normal(varies: bool, labels: dict[str, tuple[str, ...]], count: int):
    """Effects of unbalanced levels integrated out: the joint normal of all records, with the stated priors.

    One record says nothing of Ci, as one of Vsc alone, up to a precision that has no effect.
    """
    rng, records = np.random.default_rng(1), len(PEOPLE)
    nesting = nest_levels(labels, records)
    covariates = Covariates.from_values({f"x{i}": rng.uniform(3.0, 7.0, records) for i in range(count)}, records)
    factors = [np.triu(5.0 * rng.standard_normal((3, 3)) + 8.0 * np.eye(3)) for _ in range(records)]
    factors[3][2, 2] = 0.01
    centers = np.array([11.8, -17.7, -20.4]) + 0.3 * rng.standard_normal((records, 3))
    targets = rng.standard_normal((records, 3)) * [1.0, 1.0, 0.1]
    targets[3, 2] = 0.0
    fingers = list(map(finger_that_says, centers, factors, targets))
    loadings = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])[:, : 2 + varies]
    estimates = np.concatenate([c + np.linalg.solve(R, t) for c, R, t in zip(centers, factors, targets, strict=True)])
    errors = scipy.linalg.block_diag(*(np.linalg.inv(R.T @ R) for R in factors))

    def expected(law: PopulationParameters, spreads: np.ndarray) -> float:
        """The stated densities."""
        covariance = errors.copy()
        for level, sd, r in zip(nesting.levels, law.log_sd, law.correlation, strict=True):
            effect = np.diag(sd**2)
            effect[0, 1] = effect[1, 0] = r * sd[0] * sd[1]
            same = level.unit_numbers[:, None] == level.unit_numbers
            covariance += np.kron(same, loadings @ effect @ loadings.T)
        shared = np.append(law.mean[:2], law.log_Ci)
        means = np.concatenate([shared + loadings @ (z @ law.slopes) for z in covariates.z_scores])
        return (
            scipy.stats.multivariate_normal(means, covariance).logpdf(estimates)
            + np.sum(scipy.stats.norm(*np.transpose(list(SCALES.values()))).logpdf(shared))
            + np.sum(scipy.stats.norm(scale=0.5).logpdf(law.slopes))
            + np.sum(scipy.stats.norm.logpdf(spreads))  # in whose coordinates the half-normal is normal
            + np.sum(scipy.stats.beta(2.0, 2.0, loc=-1.0, scale=2.0).logpdf(law.correlation))
            + np.sum(np.log1p(-(law.correlation**2)))  # of the coordinate atanh r
        )

    with jax.enable_x64(True):
        hierarchy = Hierarchy.from_fingers(fingers, nesting, PRIOR, covariates.z_scores, area_varies=varies)
        first, last = hierarchy.origin.size, len(hierarchy.names) - len(nesting.levels)

        def coefficients(point: jax.Array) -> jax.Array:
            law = hierarchy.population_parameters(point)
            return jnp.array([*law.mean[:2], law.log_Ci, *law.slopes.ravel()])

        def evaluate(point: jax.Array) -> tuple:
            volume = jnp.linalg.slogdet(jax.jacfwd(coefficients)(point)[:, :first])[1]
            return hierarchy.log_prob(point), volume, hierarchy.population_parameters(point)

        points = rng.standard_normal((6, len(hierarchy.names)))
        found, volume, laws = jax.tree.map(np.asarray, jax.jit(jax.vmap(evaluate))(points))
    spreads = points[:, first:last].reshape(6, len(nesting.levels), -1)
    np.testing.assert_allclose(laws.log_sd, scipy.stats.halfnorm(scale=0.5).ppf(scipy.stats.norm.cdf(spreads)))
    each = [PopulationParameters(*leaves) for leaves in zip(*laws, strict=True)]
    difference = found - volume - [expected(*pair) for pair in zip(each, spreads, strict=True)]
    assert np.ptp(found) > 3.0
    np.testing.assert_allclose(difference, difference[0], atol=1e-4)


def test_touches_are_drawn_from_their_posterior():
    """Mean and covariance of all touches given the parameters, from the joint normal, by 40,000 draws."""
    rng, records = np.random.default_rng(2), len(PEOPLE)
    nesting = nest_levels({"person": PEOPLE, "session": SESSIONS}, records)
    factors = [np.triu(3.0 * rng.standard_normal((3, 3)) + 5.0 * np.eye(3)) for _ in range(records)]
    centers = np.array([11.8, -17.7, -20.4]) + 0.3 * rng.standard_normal((records, 3))
    fingers = [finger_that_says(c, R, np.zeros(3)) for c, R in zip(centers, factors, strict=True)]
    with jax.enable_x64(True):
        hierarchy = Hierarchy.from_fingers(fingers, nesting, PRIOR, np.zeros((records, 0)), area_varies=True)
        point = 0.5 * rng.standard_normal(len(hierarchy.names))
        law = jax.tree.map(np.asarray, hierarchy.population_parameters(point))
        draws = 40_000
        deviates = [rng.standard_normal((draws, units, 3)) for units in hierarchy.effects.counts]
        drawn = np.asarray(jax.jit(jax.vmap(lambda *z: hierarchy.draw_touches(point, *z)))(*deviates))
    loadings = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    prior = np.zeros((3 * records, 3 * records))
    for level, root in zip(nesting.levels, law.effect_roots(), strict=True):
        same = level.unit_numbers[:, None] == level.unit_numbers
        prior += np.kron(same, loadings @ root @ root.T @ loadings.T)
    mean = np.tile(np.append(law.mean[:2], law.log_Ci), records)
    gain = prior @ np.linalg.inv(prior + scipy.linalg.block_diag(*(np.linalg.inv(R.T @ R) for R in factors)))
    expected, covariance = mean + gain @ (np.concatenate(centers) - mean), prior - gain @ prior
    sd = np.sqrt(np.diag(covariance))
    flat = drawn.reshape(draws, -1)
    # the largest of 27 normal errors, and of 729 with a variance of at most 2, stays below five standard errors
    np.testing.assert_allclose((flat.mean(axis=0) - expected) / sd, 0.0, atol=5.0 / np.sqrt(draws))
    np.testing.assert_allclose((np.cov(flat.T) - covariance) / np.outer(sd, sd), 0.0, atol=5.0 * np.sqrt(2.0 / draws))


@pytest.mark.slow
def test_integral_over_a_finger_is_that_of_quadrature():
    """A finger from scipy's state space, so noisy that it is known no better than fingers differ; noise integrated."""
    simulated = simulate(5, 0, fingers=1, noise=8.0)
    record, scene = simulated.records[0], simulated.scene
    fit = fitact.fit(record, scene)
    assert fit.names == ("Rsc", "Csc", "Ci")
    assert not fit.linear
    g_0, b_0 = (float(fit.derived()[name]["q50"]) for name in ("g", "b"))
    g = g_0 * np.exp(np.linspace(-1.0, 0.9, 400))
    g = g[g < 0.5]
    b = b_0 * np.exp(np.linspace(-1.5, 1.5, 161))
    units = [np.tile(steady("triangle", FREQUENCY, wave("triangle", np.random.default_rng()), 1.0, x), 2) for x in b]
    y, u = record["Vsc"], np.array(units)
    left = y @ y - 2.0 * g[:, None] * (u @ y) + np.square(g)[:, None] * np.sum(u**2, axis=1)
    log_likelihood = -0.5 * y.size * np.log(left / np.min(left))

    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        finger = Finger.from_fit(fit)
        nesting = nest_levels({}, 1)
        hierarchy = Hierarchy.from_fingers([finger], nesting, scene.make_prior(), np.zeros((1, 0)), area_varies=False)
        points = np.array([1.0, 1.0, 1.0, 0.7, 0.7, 0.5]) * rng.standard_normal((8, 6)) - [0, 0, 0, 0.7, 0.7, 0]

        def normal(point: jax.Array) -> tuple:
            law, integrated, coefficients, _ = hierarchy._solve(point)
            return integrated.log_norm - 0.5 * coefficients @ integrated.square @ coefficients, law

        found, laws = jax.tree.map(np.asarray, jax.jit(jax.vmap(normal))(points))
        found = found + log_weights(hierarchy, [finger], np.zeros(1, int), points, 2**11, [1], [0], progress=False)[0]
    expected = []
    for median, sd, r, c in zip(laws.mean, laws.log_sd[:, 0], laws.correlation[:, 0], laws.log_Ci, strict=True):
        skin = np.broadcast_arrays(np.log(g)[:, None] + np.log(b) - c, np.log(1.0 / g - 2.0)[:, None] + c)
        covariance = np.outer(sd, sd) * np.array([[1.0, r], [r, 1.0]])
        density = scipy.stats.multivariate_normal(median, covariance).logpdf(np.stack(skin, axis=-1))
        # d(log Rsc, log Csc) = d(log g, log b) / (1 - 2 g)
        expected.append(scipy.special.logsumexp(log_likelihood + density - np.log(1.0 - 2.0 * g)[:, None]))
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(found - np.mean(found), expected - np.mean(expected), atol=0.05)


@pytest.mark.slow
def test_force_of_a_new_finger_is_that_of_scipys_response():
    """Mean, and amplitudes at f and 2 f, of a finger with its own area and thicknesses: eqs. (2), (3), (4) and (22)."""
    simulated = simulate(5, 0, fingers=1)
    finger = NewFingerModel.from_fit(fitact.fit(simulated.records[0], simulated.scene), FACTORS)
    Rsc, Csc, Ci, area, skin, insulator = 150e3, 18e-9, 1.2e-9, 1.4, 1.2, 0.7
    found = dict(zip(finger.names, finger.evaluate(np.log([[Rsc, Csc, Ci, area, skin, insulator]]))[0], strict=True))
    Csc, Ci = area * Csc, area * Ci / insulator
    voltage = vsc(Rsc / area, Csc, Ci, np.random.default_rng())
    force = voltage**2 * (Ci * Csc / (Ci + Csc)) / (2.0 * (200e-6 * skin + 1e-6 * insulator))
    tones = 2.0 * np.abs(np.fft.rfft(force)) / force.size
    assert found["Rsc"] == pytest.approx(Rsc / area)
    assert found["Csc"] == pytest.approx(Csc)
    assert found["force_mean"] == pytest.approx(np.mean(force), rel=1e-4)
    assert found["force_at_2f"] == pytest.approx(tones[2], rel=1e-4)
    assert found["friction_at_2f"] == pytest.approx(0.5 * tones[2], rel=1e-4)
    assert found["force_at_f"] == pytest.approx(0.0, abs=1e-9 * tones[2])
    time, traced = finger.force_in_time(np.log([[150e3, 18e-9, 1.2e-9, area, skin, insulator]]), force.size)
    assert time[-1] == pytest.approx((1.0 - 1.0 / force.size) / FREQUENCY)
    np.testing.assert_allclose(traced[0], force, rtol=1e-9, atol=1e-9 * np.max(force))


def test_spread_of_the_next_finger_is_people_and_ignorance():
    """Means have a variance of 4, and fingers a variance of 9 about them."""
    rng = np.random.default_rng(2)
    draws = 2.0 * rng.standard_normal((20_000, 1)) + 3.0 * rng.standard_normal((20_000, 8))
    # four standard errors, mostly sqrt(2 / 20,000) of the 4
    assert finger_variance_fraction(draws) == pytest.approx(9.0 / 13.0, abs=4.0 * 0.01 * 36.0 / 169.0)


def test_variance_shares_of_correlated_factors_are_those_of_the_closed_form():
    """y = x . slope of normal x: first (cov(x_i, y))^2 / var(x_i), total slope_i^2 var(x_i | others), over var(y)."""
    slope = np.array([1.0, -2.0, 0.5])
    covariance = np.array([[1.0, 0.6, 0.0], [0.6, 0.8, -0.2], [0.0, -0.2, 0.5]])
    white = np.random.default_rng(3).standard_normal((4000, 3))
    white = (white - white.mean(axis=0)) @ np.linalg.inv(np.linalg.cholesky(np.cov(white.T))).T
    factors = white @ np.linalg.cholesky(covariance).T
    found = sobol_indices(lambda x: (x @ slope)[:, None], FACTORS[:3], factors, ("force_mean",), seed=0)["force_mean"]
    variance = slope @ covariance @ slope
    for i, name in enumerate(FACTORS[:3]):
        first = (covariance[i] @ slope) ** 2 / covariance[i, i] / variance
        total = slope[i] ** 2 / np.linalg.inv(covariance)[i, i] / variance
        assert found[name]["first"] == pytest.approx(first, abs=2.0 * found[name]["first_error"])  # 95 % each
        assert found[name]["total"] == pytest.approx(total, abs=2.0 * found[name]["total_error"])
        assert found[name]["interaction"] == pytest.approx(0.0, abs=2.0 * found[name]["interaction_error"])
        assert found[name]["first_error"] < 0.1


@dataclasses.dataclass
class Known:
    """A finger of one quantity; counts how often it is asked."""

    quantity: Callable[[np.ndarray], np.ndarray]
    factors: tuple[str, ...]
    names: tuple[str, ...] = ("force_mean",)
    evaluations: int = 0

    def evaluate(self, factors: np.ndarray) -> np.ndarray:
        self.evaluations += len(factors)
        return self.quantity(factors)[:, None]


def test_variance_shares_of_a_product_are_those_of_the_closed_form():
    """y = exp(x . slope), x independent, s = slope sd: first (e^(s_i^2) - 1) over e^(sum s^2) - 1, total likewise."""
    s = np.array([0.3, 0.5, 0.4])
    factors = np.random.default_rng(4).standard_normal((4000, 3))
    factors = (factors - factors.mean(axis=0)) @ np.linalg.inv(np.linalg.cholesky(np.cov(factors.T))).T
    finger = Known(lambda x: np.exp(x @ s), FACTORS[:3])
    found = variance_shares(finger, factors, finger.names, seed=0)["force_mean"]
    assert finger.evaluations <= 4096 * 3 * 5 // 100
    whole = np.expm1(s @ s)
    for name, square in zip(FACTORS[:3], s**2, strict=True):
        first, total = np.expm1(square) / whole, np.expm1(square) * np.exp(s @ s - square) / whole
        for key, value in {"first": first, "total": total, "interaction": total - first}.items():
            assert found[name][key] == pytest.approx(value, abs=2.0 * found[name][f"{key}_error"])
            assert found[name][f"{key}_error"] < 0.12


def test_a_surrogate_that_is_off_says_by_how_much():
    """A quantity with a kink, which no polynomial has: the error is the correlation at 100,000 other points."""
    finger = Known(lambda x: np.exp(np.abs(x[:, 0] - 0.5) + 0.3 * x[:, 1]), FACTORS[:2])
    surrogate = Surrogate.from_model(finger, np.random.default_rng(5).standard_normal((4000, 2)), finger.names)
    points = surrogate.mean + np.random.default_rng(6).standard_normal((100_000, 2)) @ surrogate.covariance_factor.T
    r = np.corrcoef(finger.evaluate(points)[:, 0], surrogate.predict(points)[:, 0])[0, 1]
    assert np.sqrt(1.0 - r**2) > 0.05
    assert surrogate.cross_validation_error[0] == pytest.approx(np.sqrt(1.0 - r**2), rel=0.5)


def test_what_makes_no_population_is_refused():
    simulated = simulate(1, 0, fingers=3)
    first, *others = simulated.records
    with pytest.raises(fitact.InputError, match="two or more fingers or touches"):
        fitact.population([first])
    with pytest.raises(fitact.InputError, match=r"finger 0 .* same record as finger 0"):
        fitact.population([first, first])
    held = fitact.Scene.from_dict({"prior": {"Ci": {"fixed": True}}})
    with pytest.raises(fitact.InputError, match="fixes or ties"):
        fitact.population([first, *others], held)
    correlated = {"R_H": {"median": "500 ohm", "factor": 2}, "correlation": {"R_H-Csc": 0.5}}
    with pytest.raises(fitact.InputError, match="with other parameters"):
        fitact.population([first, *others], fitact.Scene.from_dict({"prior": correlated, "grounding": {"R_H": 500.0}}))


def fingers_that_say(log_Ci: np.ndarray, standard_error: float) -> list[Finger]:
    """Fingers of which only their own log Ci matters, from centers that differ from it."""
    centers = log_Ci + 0.3 * np.random.default_rng(1).standard_normal(log_Ci.size)
    return [
        finger_that_says(
            np.array([11.8, -17.7, center]),
            np.diag([1.0, 1.0, 1.0 / standard_error]),
            np.array([0.0, 0.0, own - center]) / standard_error,
            f"finger {number}",
        )
        for number, (own, center) in enumerate(zip(log_Ci, centers, strict=True))
    ]


PANEL = fitact.LogNormal.with_relative_sd(1.35e-9, 0.1)


def test_fingers_of_one_area_agree_with_the_assumption():
    """Over 2,000 populations of six fingers the test rejects one in a hundred, as its p-value says."""
    rng, rejected = np.random.default_rng(7), 0
    for _ in range(2000):
        fingers = fingers_that_say(-20.4 + 0.05 * rng.standard_normal(6), 0.05)
        found = ContactAreaTest.from_fingers(fingers, PANEL, "common", 0.0)
        rejected += found.disagrees
    assert rejected == pytest.approx(20, abs=5 * np.sqrt(20))
    assert found.is_tested


def test_fingers_of_different_areas_disagree_and_varies_is_offered():
    """Areas that differ by 30 %: chi-square and the excess by hand."""
    log_Ci = -20.4 + 0.3 * np.random.default_rng(8).standard_normal(40)
    found = ContactAreaTest.from_fingers(fingers_that_say(log_Ci, 0.02), PANEL, "common", 0.01)
    assert found.chi_square == pytest.approx(np.var(log_Ci) * 40 / 0.02**2)
    assert found.log_sd == pytest.approx(np.sqrt(np.var(log_Ci, ddof=1) - 0.02**2))
    assert found.disagrees
    assert "is contradicted by the records: their own Ci differ by" in found.sentence
    farthest = int(np.argmax(np.abs(log_Ci - log_Ci.mean())))
    assert f'finger {farthest} most; write contact_area = "varies", or leave that record out' in found.sentence
    told = found._replace(assumption="varies")
    assert not told.disagrees
    assert "assumed" not in told.sentence
    small = ContactAreaTest.from_fingers(fingers_that_say(-20.4 + 1e-3 * (log_Ci + 20.4), 1e-5), PANEL, "common", 0.01)
    assert small.p_value < 1e-6
    assert not small.disagrees  # a thousandth changes no force by as much as the tolerance


def test_records_of_vsc_alone_cannot_test_the_area():
    found = ContactAreaTest.from_fingers(fingers_that_say(np.full(5, -20.4), 50.0), PANEL, "common", 0.01)
    assert found.to_dict() | {"sentence": ""} == {
        "assumption": "common", "tested": False, "disagrees": None, "fingers": 0, "chi_square": None, "p_value": None,
        "log_sd": None, "sentence": "",
    }  # fmt: skip
    assert "cannot test this" in found.sentence


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,moisture\na.csv,1\n", "needs a column 'record'"),
        ("record,moisture\na.csv,1\n", "no row for b.csv"),
        ("record,moisture\na.csv,1\nb.csv,dry\n", "moisture of b.csv is 'dry'"),
        ("record,moisture\na.csv,1\nb.csv,2\na.csv,1\n", "line 4: a.csv has a row already"),
    ],
)
def test_covariates_that_cannot_be_used_are_refused(tmp_path, text: str, said: str):
    path = tmp_path / "people.csv"
    path.write_text(text)
    with pytest.raises(fitact.InputError, match=said):
        read_covariates(path, [Path("a.csv"), Path("b.csv")])


def test_covariates_are_those_of_the_records_in_their_order(tmp_path):
    path = tmp_path / "people.csv"
    path.write_text("record,moisture,age\nb.csv,0.5,30\nc.csv,9,9\na.csv,0.1,50\n")
    found = read_covariates(path, [Path("x/a.csv"), Path("b.csv")])
    assert found == {"moisture": [0.1, 0.5], "age": [50.0, 30.0]}
    for values, said in (
        ({"moisture": [1.0, 2.0]}, "2 values for 3 records"),
        ({"moisture": [2.0, 2.0, 2.0]}, "same value"),
        ({"a": [1.0, 2.0, 4.0], "b": [2.0, 4.0, 8.0]}, "linearly dependent"),
    ):
        with pytest.raises(fitact.InputError, match=said):
            Covariates.from_values(values, 3)
    known = Covariates.from_values({"moisture": [1.0, 2.0, 3.0]}, 3)
    assert known.standardize({"moisture": 3.0}) == pytest.approx(np.sqrt(1.5))
    with pytest.raises(fitact.InputError, match="not among those of the records"):
        known.standardize({"age": 3.0})


@pytest.mark.slow
def test_refused_records_are_named(tmp_path):
    simulated = simulate(1, 0, fingers=3)
    swapped = [dataclasses.replace(r, channels={"V": r["Vsc"], "Vsc": r["V"]}) for r in simulated.records]
    with pytest.raises(fitact.InputError, match=r"^finger 0.*also refused: finger 2 of population 0$"):
        fitact.population([swapped[0], simulated.records[1], swapped[2]], simulated.scene)


def nuts(fits: list[fitact.Fit], prior: Prior) -> dict[str, np.ndarray]:
    """Draws of the law by blackjax, with all that is the fingers' own sampled along, not integrated out."""
    import blackjax

    count = len(fits)
    arrays, (static, *_) = zip(
        *(
            eqx.partition(fit.likelihood.without_compression(), lambda leaf: isinstance(leaf, np.ndarray | jax.Array))
            for fit in fits
        ),
        strict=True,
    )
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrays)

    def log_prob(x: dict[str, jax.Array]) -> jax.Array:
        sd, r, logpdf = jnp.exp(x["log_sd"]), jnp.tanh(x["atanh_r"]), jax.scipy.stats.norm.logpdf
        points = jnp.column_stack([x["skin"], jnp.full(count, x["log_Ci"]), x["log_sigma"]])
        each = jax.vmap(lambda finger, point: eqx.combine(finger, static).log_likelihood(point))(stacked, points)
        first, second = ((x["skin"] - x["median"]) / sd).T
        of_fingers = logpdf(first) + logpdf(second, r * first, jnp.sqrt(1.0 - r**2)) - jnp.sum(x["log_sd"])
        law = logpdf(jnp.append(x["median"], x["log_Ci"]), prior.log_mean, prior.log_sd).sum()
        law += jnp.sum(x["log_sd"] - 0.5 * (sd / 0.5) ** 2) + 2.0 * jnp.log1p(-(r**2))
        return jnp.sum(each) + jnp.sum(of_fingers) + law

    skin = np.array([fit.theta[:2] for fit in fits])
    start = {"median": skin.mean(axis=0), "log_sd": np.log(skin.std(axis=0) + 0.1), "log_Ci": prior.log_mean[2]}
    start |= {"skin": skin, "atanh_r": 0.0, "log_sigma": np.log([fit.sigma for fit in fits])}
    start = jax.tree.map(jnp.asarray, start)
    keys = jax.random.split(jax.random.key(0), NUTS_CHAINS)

    def chain(key: jax.Array) -> dict[str, jax.Array]:
        warm = blackjax.window_adaptation(blackjax.nuts, log_prob, is_mass_matrix_diagonal=False)
        (state, parameters), _ = warm.run(key, start, 1500)
        step = blackjax.nuts(log_prob, **parameters).step

        def one(state, key):
            state, _ = step(key, state)
            return state, state.position

        return jax.lax.scan(one, state, jax.random.split(key, NUTS_STEPS))[1]

    drawn = jax.tree.map(np.asarray, jax.jit(jax.vmap(chain))(keys))
    found = {"log_Ci": drawn["log_Ci"], "atanh_r": drawn["atanh_r"]}
    for i, name in enumerate(("Rsc", "Csc")):
        found |= {f"log_{name}": drawn["median"][..., i], f"log_sd_{name}": drawn["log_sd"][..., i]}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 6])
def test_law_is_that_of_nuts_over_all_parameters(count: int):
    """Fingers are known no better than they differ; means agree within four standard errors, widths within 5 %."""
    simulated = simulate(5, 1, fingers=count, noise=4.0)
    found = fitact.population(simulated.records, simulated.scene, seed=1, progress=False)
    assert found.trusted
    draws = found.parameters()
    seen = {f"log_{name}": np.log(draws[name]) for name in ("Rsc", "Csc", "Ci")}
    seen |= {f"log_sd_{name}": np.log(draws[f"log_sd_{name}"]) for name in ("Rsc", "Csc")}
    seen |= {"atanh_r": np.arctanh(draws["correlation"])}
    with jax.enable_x64(True):
        expected = nuts([fitact.fit(each, simulated.scene) for each in simulated.records], found.hierarchy.prior)
    for name, reference in expected.items():
        assert array_stats.rhat(reference, chain_axis=0, draw_axis=1) < 1.01, name
        effective = float(array_stats.ess(reference, chain_axis=0, draw_axis=1))
        error = np.std(reference) * np.sqrt(1.0 / effective + 1.0 / found.convergence.ess_min)
        shift, wider = np.mean(seen[name]) - np.mean(reference), np.std(seen[name]) / np.std(reference) - 1.0
        off = shift / np.std(reference)
        print(f"{count} fingers, {name}: off by {off:+.3f} sd, {wider:+.1%} wider, {effective:,.0f} effective draws")
        assert abs(shift) < 4.0 * error + found.off * np.std(reference), name
        assert wider == pytest.approx(0.0, abs=0.05), name


def nuts_with_levels(nesting: Nesting, touches: np.ndarray, error: float, steps: int = 4000) -> dict[str, np.ndarray]:
    """Draws by blackjax of an experiment's parameters and of all effects; `touches` are estimates with this error."""
    import blackjax

    numbers = [level.unit_numbers for level in nesting.levels]
    loadings = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    logpdf = jax.scipy.stats.norm.logpdf

    def log_prob(x: dict[str, Any]) -> jax.Array:
        sd, r = jnp.exp(x["log_sd"]), jnp.tanh(x["atanh_r"])
        value = logpdf(x["shared"], PRIOR.log_mean, PRIOR.log_sd).sum()
        value += jnp.sum(x["log_sd"] - 0.5 * (sd / 0.5) ** 2) + 2.0 * jnp.sum(jnp.log1p(-(r**2)))
        # effects of the top level are not centred, since its standard deviation may be 0
        z = x["top"]
        value += logpdf(z).sum()
        effects = sd[0] * jnp.column_stack([z[:, 0], r[0] * z[:, 0] + jnp.sqrt(1.0 - r[0] ** 2) * z[:, 1], z[:, 2]])
        above = x["shared"] + effects @ loadings.T
        for level, each in enumerate(x["units"], 1):
            parents = parent_numbers(numbers[level - 1], numbers[level])
            Rsc, Csc, area = ((each - above[parents]) @ np.linalg.inv(loadings).T / sd[level]).T
            value += jnp.sum(logpdf(Rsc) + logpdf(area) + logpdf(Csc, r[level] * Rsc, jnp.sqrt(1.0 - r[level] ** 2)))
            value -= len(each) * jnp.sum(x["log_sd"][level])
            above = each
        return value + logpdf(touches, above, error).sum()

    def parent_numbers(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
        return np.array([upper[lower == unit][0] for unit in range(lower.max() + 1)])

    units = [np.array([touches[each == unit].mean(axis=0) for unit in range(each.max() + 1)]) for each in numbers[1:]]
    start = {"shared": touches.mean(axis=0), "units": units, "atanh_r": np.zeros(len(numbers))}
    start["top"] = np.zeros((numbers[0].max() + 1, 3))
    start |= {"log_sd": np.full((len(numbers), 3), np.log(0.1))}
    start = jax.tree.map(jnp.asarray, start)

    def chain(key: jax.Array) -> dict[str, jax.Array]:
        warm = blackjax.window_adaptation(blackjax.nuts, log_prob)
        (state, parameters), _ = warm.run(key, start, 1500)
        step = blackjax.nuts(log_prob, **parameters).step

        def one(state, key):
            state, _ = step(key, state)
            return state, {name: state.position[name] for name in ("shared", "log_sd", "atanh_r")}

        return jax.lax.scan(one, state, jax.random.split(key, steps))[1]

    drawn = jax.tree.map(np.asarray, jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(0), NUTS_CHAINS)))
    found = {name: drawn["shared"][..., i] for i, name in enumerate(("log_Rsc", "log_Csc", "log_Ci"))}
    for i, level in enumerate(nesting.levels):
        found |= {f"log_sd_{j}_{level.name}": drawn["log_sd"][..., i, j] for j in range(3)}
        found[f"atanh_r_{level.name}"] = drawn["atanh_r"][..., i]
    return found


@pytest.mark.slow  # NUTS over 267 parameters
def test_levels_are_those_of_nuts_over_all_effects():
    """12 people of 2 sessions of 2 touches, each known to 1 %: means of parameters within 0.1 and 0.2 sd.

    Sessions differ enough that their standard deviations are not 0, where NUTS with centred effects goes wrong.
    """
    rng, error = np.random.default_rng(4), 0.01
    labels = {"person": np.repeat(range(12), 4), "session": np.tile([1, 1, 2, 2], 12)}
    nesting = nest_levels({name: values.astype(str).tolist() for name, values in labels.items()}, 48)
    sds = np.array([[0.35, 0.3, 0.15], [0.2, 0.25, 0.2], [0.06, 0.06, 0.08]])
    effects = sum(
        sd * rng.standard_normal((len(level.units), 3))[level.unit_numbers]
        for sd, level in zip(sds, nesting.levels, strict=True)
    )
    area = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    touches = [11.7, -17.6, -20.4] + effects @ area.T + error * rng.standard_normal((48, 3))
    fingers = [finger_that_says(each, np.eye(3) / error, np.zeros(3)) for each in touches]
    with jax.enable_x64(True):
        hierarchy = Hierarchy.from_fingers(fingers, nesting, PRIOR, np.zeros((48, 0)), area_varies=True)
        points, convergence = sample_hierarchy(hierarchy, "", 1, 20_000, None, False)
        law = jax.tree.map(np.asarray, evaluate_parameters(hierarchy, points))
        expected = nuts_with_levels(nesting, touches, error)
    assert convergence.converged
    assert convergence.level == "psis"
    found = {"log_Rsc": law.mean[..., 0], "log_Csc": law.mean[..., 1], "log_Ci": law.log_Ci}
    for i, level in enumerate(nesting.levels):
        found |= {f"log_sd_{j}_{level.name}": np.log(law.log_sd[..., i, j]) for j in range(3)}
        found[f"atanh_r_{level.name}"] = np.arctanh(law.correlation[..., i])
    for name, reference in expected.items():
        effective = float(array_stats.ess(reference, chain_axis=0, draw_axis=1))
        shift = (np.mean(found[name]) - np.mean(reference)) / np.std(reference)
        wider = np.std(found[name]) / np.std(reference) - 1.0
        print(f"{name}: off by {shift:+.3f} sd, {wider:+.1%} wider, {effective:,.0f} effective draws")
        assert array_stats.rhat(reference, chain_axis=0, draw_axis=1) < 1.02, name
        assert abs(shift) < (0.2 if name.startswith("log_sd") else 0.1), name
        assert wider == pytest.approx(0.0, abs=0.1), name


@pytest.mark.slow
def test_a_misfit_is_named_and_the_population_stays_trusted():
    simulated = simulate(1, 0, fingers=4)
    first, *others = simulated.records
    bent = dataclasses.replace(first, channels={**first.channels, "Vsc": first["Vsc"] + 0.005 * first["Vsc"] ** 2})
    found = fitact.population([bent, *others], simulated.scene, seed=1, progress=False)
    assert [finger.result for finger in found.fingers] == ["misfit", *["successful"] * 3]
    assert [warning.partition(":")[0] for warning in found.warnings] == ["finger 0 of population 0"]
    assert found.trusted
    _check_display(found)


def _check_display(found: fitact.Population) -> None:
    """Assert that a population shows itself in a line and in a notebook, draws itself, and has a table of fingers."""
    assert repr(found).startswith("<fitact.Population: 4 fingers, medians Rsc ")
    assert "\n" not in repr(found)
    page = found._repr_html_()
    assert "from Vsc with eq. (22) of the reference paper" in page
    assert "Array(" not in page
    table = found.to_dataframe()
    assert list(table) == ["result", "Rsc", "Rsc_sd", "Csc", "Csc_sd", "Ci", "Ci_sd"]
    assert table["Csc"].tolist() == [finger.parameters["Csc"]["q50"] for finger in found.fingers]
    with mpl.rc_context({"backend": "agg"}):
        axes = found.plot()
        assert {"Fingers", "Sources of variance"} <= {each.get_title() for each in axes}
        plt.close("all")
    data = found.to_arviz()
    np.testing.assert_array_equal(data["posterior"]["Rsc"].values, found.parameters()["Rsc"])


@pytest.fixture(scope="module")
def eight(tmp_path_factory) -> dict:
    """The output of the command for ngspice's eight fingers, with V, Vsc and I."""
    folder = tmp_path_factory.mktemp("population")
    scene = folder / "scene.toml"
    scene.write_text(
        '[device]\nCi = "1.35 nF"\n[drive]\nwaveform = "trapezoid"\nrise_time = "50 us"\n'
        '[measurement]\nchannels = ["Vsc", "I"]\n[prior]\nCi = {relative_sd = 0.1}\n'
    )
    command = [sys.executable, "-c", "from fitact.cli import main; main()", "population"]
    command += [*map(str, sorted(FINGERS.glob("*.csv.gz"))), "--scene", str(scene), "--seed", "1", "--json"]
    done = subprocess.run([*command, "--out", str(folder / "out")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (folder / "out").iterdir()} == {
        "population.json",
        "population.nc",
        "population.svg",
        "report.html",
    }
    assert json.loads((folder / "out" / "population.json").read_text()) == json.loads(done.stdout)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_eight_fingers_and_their_panel(eight):
    truth = json.loads((FINGERS / "truth.json").read_text())
    for name in ("Rsc", "Csc"):
        logs = np.log([finger[name] for finger in truth])
        law = eight["population"][name]
        assert law["median"]["q025"] < np.exp(np.mean(logs)) < law["median"]["q975"]
        assert law["log_sd"]["q025"] < np.std(logs, ddof=1) < law["log_sd"]["q975"]
    assert eight["population"]["Ci"]["mean"] == pytest.approx(1.42e-9, rel=5e-3)
    assert eight["population"]["Ci"]["sd"] < 1e-5 * 1.42e-9
    assert set(eight["variance_shares"]["force_mean"]) == {"Rsc", "Csc", "Ci"}
    assert set(eight["new_finger"]["force_mean"]["variance"]) == {"people", "ignorance"}
    assert eight["warnings"] == []
