"""Fits of records of a leaky panel, which data_synth makes."""

from typing import Any

import jax
import numpy as np
import pytest

import fitact
from data_synth.make import simulate_response
from data_synth.scene import make_scene
from fitact.likelihood.certificate import compress_channel
from fitact.model.circuit import FinalCircuit
from fitact.problem.build import build_problem

TRUTH = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.35e-9, "Ri": 2e6}
MEAN = {"waveform": "trapezoid", "rise_time": 40e-6, "frequency": 100.0, "offset": 60.0}
FAST = {"waveform": "sine", "frequency": 2000.0}


def leaky_record(drive: dict[str, Any], Ri: float) -> fitact.Record:
    time, rng = np.arange(4000) * 5e-6, np.random.default_rng(0)
    skin = {name: TRUTH[name] for name in ("Rsc", "Csc")}
    tables = make_scene({"device": {"Ri": Ri}, "skin": skin, "drive": drive}, {}, "scene")
    V, Vsc, _ = simulate_response(tables, time)
    return fitact.Record.from_arrays(time, V=V, Vsc=Vsc + 0.1 * rng.standard_normal(time.size))


def leaky_scene(drive: dict[str, Any], Ri: float) -> fitact.Scene:
    prior = {"Ri": {"median": Ri, "factor": 10}}
    return fitact.Scene.from_dict({"device": {"Ri": Ri}, "drive": drive, "prior": prior})


def test_a_drive_with_a_mean_determines_the_leak_up_to_the_area():
    fit = fitact.fit(leaky_record(MEAN, TRUTH["Ri"]), leaky_scene(MEAN, 1.5e6))
    content = fit.to_dict()
    for name, (value, part) in {name: (TRUTH[name], content["parameters"][name]) for name in TRUTH}.items():
        assert abs(np.log(part["q50"] / value)) < 3.0 * part["sd"] / part["mean"], name
    # along the area all four are as uncertain as Ci is by its prior; Ri / Rsc is not
    laplace = np.log(TRUTH["Ri"] / TRUTH["Rsc"])
    assert np.log(content["parameters"]["Ri"]["q50"] / content["parameters"]["Rsc"]["q50"]) == pytest.approx(
        laplace, abs=0.005
    )
    assert content["model"]["likelihood"] == "compressed"
    assert content["fit"]["result"] == "successful"
    assert content["identifiability"]["verdict"] == "prior-limited"
    np.testing.assert_allclose(
        [content["identifiability"]["blind_direction"][name] for name in TRUTH], [-0.5, 0.5, 0.5, -0.5], atol=0.01
    )


def test_a_fast_drive_without_a_mean_leaves_the_leak_at_its_prior():
    fit = fitact.fit(leaky_record(FAST, 2e8), leaky_scene(FAST, 2e8))
    content = fit.to_dict()
    assert content["parameters"]["Ri"]["contraction"] < 0.01
    assert content["identifiability"]["verdict"] == "prior-limited"


@pytest.mark.parametrize("kind", ["folded", "stated", "measured"])
def test_the_compression_is_the_sum_over_the_samples(kind: str):
    # from rest nothing repeats, so that no periods are folded
    drive = {"folded": MEAN, "stated": MEAN | {"steady_state": False}, "measured": {"waveform": "measured"}}[kind]
    record, scene = leaky_record(MEAN, TRUTH["Ri"]), leaky_scene(drive, 1.5e6)
    with jax.enable_x64(True):
        problem = build_problem([record], [scene])
        likelihood, theta = problem.likelihood, problem.start
        (channel,) = likelihood.channels
        compressed, reason = compress_channel(channel, likelihood.evaluate_circuit(theta), 0.01)
        assert reason == ""
        assert compressed.compression.voltage is not None
        for step in (0.0, 0.2):
            change = np.array([1.0, -0.5, 0.3, 0.4, -0.7])[: theta.size]  # the last is the delay of a recorded drive
            inputs = likelihood.channel_inputs(theta + step * change)
            exact, found = (float(each.log_likelihood(inputs, np.log(0.1))) for each in (channel, compressed))
            assert found == pytest.approx(exact, rel=1e-9, abs=1e-3)


@pytest.mark.slow  # a chain of four parameters to the end
def test_posterior_of_a_leaky_panel_holds_the_truth():
    """The 99.9 % intervals hold the truth, for nearly every seed of the noise."""
    record, scene = leaky_record(MEAN, TRUTH["Ri"]), leaky_scene(MEAN, 1.5e6)
    fit = fitact.fit(record, scene)
    posterior = fitact.sample(fit, seed=1)
    assert posterior.trusted
    draws = posterior.to_dataframe()
    for name, value in TRUTH.items():
        low, high = np.quantile(draws[name], [0.0005, 0.9995])
        assert low < value < high, name
        # the data determine the rest so well that the posterior is that of the Laplace approximation
        assert np.std(np.log(draws[name])) == pytest.approx(fit.sd[fit.names.index(name)], rel=0.1), name


def test_what_knows_no_leak_refuses_it():
    record, scene = leaky_record(MEAN, TRUTH["Ri"]), leaky_scene(MEAN, 2e6)
    with pytest.raises(fitact.InputError, match="a track has no leak"):
        fitact.track(record, scene)
    varies = scene.model_dump(exclude_unset=True) | {"population": {"contact_area": "varies"}}
    with pytest.raises(fitact.InputError, match="excludes a leak"):
        fitact.population([record, record], fitact.Scene.from_dict(varies))
    with pytest.raises(fitact.InputError, match=r"\[device\] Ri, a leak, is not modelled with \[skin\] level"):
        fitact.Scene.from_dict({"device": {"Ri": 2e6}, "skin": {"level": "fractional"}})
    assert isinstance(scene.make_rc_circuit(), FinalCircuit)
    assert scene.make_rc_circuit().Ri == 2e6
