import dataclasses
import functools
import signal
import weakref

import emcee
import jax
import numpy as np
import pytest

import fitact
from fitact.likelihood import certificate
from fitact.sampling import ensemble
from fitact.sampling.convergence import Criteria
from fitact.sampling.proposal import principal_axes
from tests.conftest import RECORDS, square_record


def test_log_normal_prior_along_the_blind_direction(finger_posterior: fitact.Posterior, finger_fit: fitact.Fit):
    """Points with equal g and b form a line in logarithms, on which the precisions and means of the priors add up."""
    prior, along = finger_fit.likelihood.prior, np.array([-1.0, 1.0, 1.0])
    precision = np.sum((along / prior.log_sd) ** 2)
    logs = {
        name: np.log(draws) for name, draws in finger_posterior.parameters().items() if name in ("Rsc", "Csc", "Ci")
    }
    for name in logs:
        assert logs[name].std() == pytest.approx(1.0 / np.sqrt(precision), rel=0.03)
    assert np.mean(logs["Rsc"] + logs["Ci"]) == pytest.approx(np.mean(np.log(160e3 * 1.35e-9)), abs=2e-3)


def test_posterior_on_the_shipped_record(finger_posterior: fitact.Posterior, finger_truth: dict[str, float]):
    assert finger_posterior.trusted
    summary = finger_posterior.summary()
    for name in ("g", "b"):
        s = summary["derived"][name]
        assert s["q50"] == pytest.approx(finger_truth[name], rel=0.01)
        assert abs(s["q50"] - finger_truth[name]) < 3.0 * s["sd"]
    for name in ("Rsc", "Csc", "Ci"):
        s = summary["parameters"][name]
        assert s["q025"] < finger_truth[name] < s["q975"]


def test_convergence_is_what_it_says(finger_posterior: fitact.Posterior):
    c = finger_posterior.convergence
    assert c.converged
    assert c.ensembles >= 4
    assert c.steps - c.burn > 50 * c.tau_max
    assert c.rhat_max < 1.01
    assert set(c.tau) == set(c.ess) == {*finger_posterior.fit.point_names, "g", "b", "force_mean"}
    assert c.ess_min == min(c.ess.values())
    assert c.seconds > 0.0
    assert c.tau_max < 5.0  # the moves that draw from the fit
    assert c.acceptance > 0.6


def test_a_curved_posterior_converges_as_soon_as_others():
    """I determines a curve: across it, the sd is a hundredth of its bend within two sd along it."""
    scene = fitact.Scene.load(RECORDS / "bench_multisine.toml")
    found = fitact.fit(fitact.read(RECORDS / "bench_multisine.csv.gz", scene), scene)
    c = fitact.sample(found, seed=1, max_steps=500, progress=False).convergence
    assert c.converged
    assert c.tau_max < 5.0
    assert c.acceptance > 0.6


def short(fit: fitact.Fit, seed: int, **settings) -> fitact.Posterior:
    return fitact.sample(
        fit, seed=seed, walkers=16, max_steps=settings.pop("max_steps", 100), progress=False, **settings
    )


@pytest.fixture
def endless(monkeypatch):
    """Replace the diagnosis, so that no chain converges."""
    never = functools.partial(ensemble.diagnose_chain, criteria=Criteria(rhat=0.0))
    monkeypatch.setattr(ensemble, "diagnose_chain", never)


def test_same_seed_same_chain(finger_fit: fitact.Fit):
    first, other = short(finger_fit, 3), short(finger_fit, 4)
    assert not np.array_equal(first.points, other.points)
    np.random.seed(0)  # noqa: NPY002  (emcee's global state must not matter)
    np.testing.assert_array_equal(short(finger_fit, 3).points, first.points)


def test_axes_point_where_they_would_on_another_machine():
    factors = np.array([[[-0.5, 0.0, 0.0], [0.5, 0.1, 0.0], [0.5, -0.1, 0.01]], np.diag([1.0, 2.0, 3.0])])
    axes = principal_axes(factors)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2), factors @ np.swapaxes(factors, 1, 2), atol=1e-15)
    for other in (-factors, factors[:, :, ::-1]):
        np.testing.assert_allclose(principal_axes(other), axes, atol=1e-14)
    assert axes[0, 0, 0] > 0.0


def test_resumed_chain_is_the_undisturbed_one(finger_fit: fitact.Fit, tmp_path, endless):
    path = tmp_path / "chain.h5"
    (tmp_path / ".chain.h5.tmp").write_text("what a kill left")
    half = short(finger_fit, 3, max_steps=130, chain_file=path)
    assert half.convergence.steps == 130
    assert list(tmp_path.iterdir()) == [path]
    assert not half.trusted
    assert any("converged" in warning for warning in half.warnings)
    resumed = short(finger_fit, 3, max_steps=200, chain_file=path)
    whole = short(finger_fit, 3, max_steps=200)
    np.testing.assert_array_equal(resumed.points, whole.points)
    backend = emcee.backends.HDFBackend(path, name="ensemble_2", read_only=True)
    assert backend.get_chain().shape == (resumed.convergence.steps, 16, 5)


def test_chain_of_another_record_scene_or_seed_is_refused(finger_fit: fitact.Fit, tmp_path):
    path = tmp_path / "chain.h5"
    short(finger_fit, 3, chain_file=path)
    before = path.read_bytes()
    with pytest.raises(fitact.InputError, match="another record, scene, seed"):
        short(finger_fit, 4, chain_file=path)
    trace = dataclasses.replace(finger_fit.traces[0], record=square_record())
    with pytest.raises(fitact.InputError, match="another record"):
        short(dataclasses.replace(finger_fit, traces=(trace,)), 3, chain_file=path)
    assert path.read_bytes() == before
    path.write_bytes(b"nonsense")
    with pytest.raises(fitact.InputError, match="not a chain"):
        short(finger_fit, 3, chain_file=path)


def test_interrupted_sampling_keeps_what_there_is(finger_fit: fitact.Fit, tmp_path, monkeypatch, endless):
    path = tmp_path / "chain.h5"
    step, calls = emcee.moves.StretchMove.propose, []

    def interrupted(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 60:  # of about 120 calls: 3 in 20 of 200 steps of 4 ensembles
            signal.raise_signal(signal.SIGINT)
        return step(self, *args, **kwargs)

    monkeypatch.setattr(emcee.moves.StretchMove, "propose", interrupted)
    posterior = short(finger_fit, 3, max_steps=200, chain_file=path)
    assert posterior.convergence.interrupted
    assert 0 < posterior.convergence.steps < 200
    assert not posterior.trusted
    monkeypatch.setattr(emcee.moves.StretchMove, "propose", step)
    np.testing.assert_array_equal(
        short(finger_fit, 3, max_steps=200, chain_file=path).points,
        short(finger_fit, 3, max_steps=200).points,
    )


def test_an_interrupt_between_rounds_is_not_lost(finger_fit: fitact.Fit, monkeypatch):
    """Also within the callback of a weak reference, where Python drops exceptions; JAX has many."""
    diagnose = ensemble._Run.diagnose

    def interrupted(self):
        if not self.derived:
            thing = np.zeros(1)
            reference = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
            del thing
            assert reference() is None
        return diagnose(self)

    monkeypatch.setattr(ensemble._Run, "diagnose", interrupted)
    posterior = short(finger_fit, 3, max_steps=300)
    assert posterior.convergence.interrupted
    assert posterior.convergence.steps == 100


def test_a_second_interrupt_does_not_wait(finger_fit: fitact.Fit, monkeypatch):
    def stuck(self, *args, **kwargs):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("went on")

    monkeypatch.setattr(emcee.moves.MHMove, "propose", stuck)
    with pytest.raises(KeyboardInterrupt):
        short(finger_fit, 3, max_steps=300)


def test_log_probability_is_minus_infinity_for_nonsense(finger_fit: fitact.Fit):
    with jax.enable_x64(True):
        for bad in (np.nan, np.inf):
            point = np.append(finger_fit.theta, np.log(finger_fit.sigma))
            point[0] = bad
            assert float(finger_fit.likelihood.log_prob(point)) == -np.inf


def test_sampling_passes_over_nonsense(finger_fit: fitact.Fit, monkeypatch):
    """A log-probability with NaN or +inf: emcee would stop, or walkers would be stuck there."""
    log_prob = certificate.batched_log_prob

    def broken(likelihood, walkers):
        values = log_prob(likelihood, walkers)

        def somewhere(points):
            high, low = points[:, 0] > finger_fit.point[0] + 0.05, points[:, 0] < finger_fit.point[0] - 0.05
            return np.where(high, np.inf, np.where(low, np.nan, values(points)))

        return somewhere

    monkeypatch.setattr(certificate, "batched_log_prob", broken)
    posterior = short(finger_fit, 3, max_steps=200)
    assert np.max(np.abs(posterior.points[..., 0] - finger_fit.point[0])) <= 0.05
    assert np.all(np.isfinite(posterior.log_prob))
    assert posterior.convergence.acceptance > 0.3


def test_prior_that_excludes_the_record_is_refused():
    scene = fitact.Scene.from_dict(
        {
            "drive": {"waveform": "square"},
            "prior": {
                "Rsc": {"low": 1e3, "high": 2e3},
                "Csc": {"low": 1e-9, "high": 2e-9},
                "Ci": {"low": 1e-9, "high": 2e-9},
            },
        }
    )
    with pytest.raises(fitact.InputError, match="exclude"):
        fitact.sample(fitact.fit(square_record(), scene), progress=False)
