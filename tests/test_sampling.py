import dataclasses
import signal

import emcee
import jax
import numpy as np
import pytest
from conftest import square_record

import fitact

BOXES = {
    "80 to 200 kohm": ("80 kohm", "200 kohm"),
    "20 kohm to 1 Mohm": ("20 kohm", "1 Mohm"),
}


@pytest.mark.parametrize("box", BOXES)
def test_uniform_priors_give_the_inverse_square_law_along_the_blind_direction(box: str, tmp_path):
    """p(Rsc) ~ 1/Rsc^2 between its limits: with q the share of 1/Rsc passed, Rsc = 1 / (1/low - q (1/low - 1/high))."""
    low, high = BOXES[box]
    scene = fitact.Scene.from_dict(
        {
            "drive": {"waveform": "square"},
            "prior": {
                "Rsc": {"low": low, "high": high},
                "Csc": {"low": "0.1 nF", "high": "900 nF"},
                "Ci": {"low": "0.01 nF", "high": "100 nF"},
            },
        }
    )
    fit = fitact.fit(square_record(per_period=200), scene)
    assert fit.result == "successful"  # an optimum on the edge of the box is no failure
    # some 50,000 effective draws put the 95 % quantile's standard error at 1.4 %, so nearly every seed passes
    path = tmp_path / "chain.h5"
    convergence = fitact.sample(fit, seed=5, walkers=256, chain_file=path, progress=False).convergence
    assert convergence.converged
    backends = [emcee.backends.HDFBackend(path, name=f"ensemble_{i}", read_only=True) for i in range(4)]
    Rsc = np.exp([backend.get_chain(discard=convergence.burn)[..., 0] for backend in backends])
    a, b = (1.0 / getattr(scene.prior.Rsc, end) for end in ("low", "high"))
    share = np.array([0.05, 0.5, 0.95])
    expected = 1.0 / (a - share * (a - b))
    np.testing.assert_allclose(np.quantile(Rsc, share), expected, rtol=0.05)


def test_log_normal_prior_along_the_blind_direction(finger_posterior: fitact.Posterior, finger_fit: fitact.Fit):
    """The ridge is a line in the logs, the priors normal along it: precision and mean add up."""
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
    assert c.tau_max < 5.0  # the moves that know the fit
    assert c.acceptance > 0.6


def short(fit: fitact.Fit, seed: int, **settings) -> fitact.Posterior:
    return fitact.sample(
        fit, seed=seed, walkers=16, max_steps=settings.pop("max_steps", 100), progress=False, **settings
    )


def test_same_seed_same_chain(finger_fit: fitact.Fit):
    first, again, other = short(finger_fit, 3), short(finger_fit, 3), short(finger_fit, 4)
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)
    np.random.seed(0)  # noqa: NPY002  (emcee's global state must not matter)
    np.testing.assert_array_equal(short(finger_fit, 3).points, first.points)


def test_resumed_chain_is_the_undisturbed_one(finger_fit: fitact.Fit, tmp_path):
    path = tmp_path / "chain.h5"
    half = short(finger_fit, 3, chain_file=path)
    assert half.convergence.steps == 100
    assert not half.trusted
    assert any("converged" in warning for warning in half.warnings)
    resumed = short(finger_fit, 3, max_steps=300, chain_file=path)
    whole = short(finger_fit, 3, max_steps=300)
    np.testing.assert_array_equal(resumed.points, whole.points)
    backend = emcee.backends.HDFBackend(path, name="ensemble_2", read_only=True)
    assert backend.get_chain().shape == (resumed.convergence.steps, 16, 4)


def test_chain_of_another_record_scene_or_seed_is_refused(finger_fit: fitact.Fit, tmp_path):
    path = tmp_path / "chain.h5"
    short(finger_fit, 3, chain_file=path)
    before = path.read_bytes()
    with pytest.raises(fitact.InputError, match="another record, scene, seed"):
        short(finger_fit, 4, chain_file=path)
    with pytest.raises(fitact.InputError, match="another record"):
        short(dataclasses.replace(finger_fit, record=square_record()), 3, chain_file=path)
    assert path.read_bytes() == before
    path.write_bytes(b"nonsense")
    with pytest.raises(fitact.InputError, match="not a chain"):
        short(finger_fit, 3, chain_file=path)


def test_interrupted_sampling_keeps_what_there_is(finger_fit: fitact.Fit, tmp_path, monkeypatch):
    path = tmp_path / "chain.h5"
    step, calls = emcee.moves.StretchMove.propose, []

    def interrupted(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 180:  # of 400 steps a round, three in ten: in the middle of the second
            signal.raise_signal(signal.SIGINT)
        return step(self, *args, **kwargs)

    monkeypatch.setattr(emcee.moves.StretchMove, "propose", interrupted)
    posterior = short(finger_fit, 3, max_steps=300, chain_file=path)
    assert posterior.convergence.interrupted
    assert posterior.convergence.steps == 100
    assert not posterior.trusted
    monkeypatch.undo()
    np.testing.assert_array_equal(
        short(finger_fit, 3, max_steps=300, chain_file=path).points,
        short(finger_fit, 3, max_steps=300).points,
    )


def test_log_probability_is_minus_infinity_for_nonsense(finger_fit: fitact.Fit):
    with jax.enable_x64(True):
        for bad in (np.nan, np.inf):
            point = np.append(finger_fit.theta, np.log(finger_fit.sigma))
            point[0] = bad
            assert float(finger_fit.likelihood.log_prob(point)) == -np.inf


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
