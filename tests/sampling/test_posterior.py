import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import fitact
from fitact.files import to_json
from fitact.fitting.geometry import UncertainGeometry
from fitact.fitting.sensation import FeltDrive
from fitact.result_text import describe_summary
from fitact.summary import format_sd, summarize_log_normal


@pytest.fixture(scope="module")
def netcdf(finger_posterior: fitact.Posterior, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("posterior") / "posterior.nc"
    finger_posterior.to_netcdf(path)
    return path


def test_force_of_a_draw_by_hand(finger_posterior: fitact.Posterior):
    """Eq. (22) with eps_i = Ci Ti / (eps0 A), eps_sc = Csc Tsc / (eps0 A), with Vsc from scipy."""
    fit = finger_posterior.fit
    draws, force = finger_posterior.parameters(), finger_posterior.force()
    record = fit.record
    for draw in (0, 1000):
        Rsc, Csc, Ci, charge = (draws[name][1, draw] for name in ("Rsc", "Csc", "Ci", "charge"))
        with jax.enable_x64(True):
            vsc = fitact.response(fitact.FinalCircuit(Rsc, Csc, Ci), fit.derive.drive, record.time, steady_state=False)
        vsc = np.asarray(vsc) + charge * np.exp(-record.time / (Rsc * (2.0 * Ci + Csc)))
        fe = vsc**2 / (2.0 * (1.0 / Ci + 1.0 / Csc) * (1e-6 + 200e-6))
        assert force["force_mean"][1, draw] == pytest.approx(fe.mean(), rel=1e-6)
        assert force["force_rms"][1, draw] == pytest.approx(np.sqrt(np.mean(fe**2)), rel=1e-6)
        assert force["force_peak"][1, draw] == pytest.approx(fe.max(), rel=1e-9)
        assert force["friction_mean"][1, draw] == pytest.approx(0.5 * (fe.mean() + 0.5), rel=1e-9)


def with_scene(fit: fitact.Fit, scene: fitact.Scene) -> fitact.Fit:
    """Return the fit with the friction and the perception of another scene."""
    geometry = UncertainGeometry.from_scene(scene, fit.derive.geometry)
    return dataclasses.replace(fit, scene=scene, laplace=dataclasses.replace(fit.laplace, geometry=geometry))


def test_a_table_of_thresholds_gives_the_sensation_of_each_draw(finger_posterior: fitact.Posterior):
    """The Fourier sum of mu fe over the record, at the multiples of its frequency that the table has."""
    table = {"frequencies": [90.0, 500.0], "forces": [2e-3, 1e-3], "source": "test"}
    content = {"perception": {"thresholds": table}, "friction": {"coefficient": {"median": 0.4, "relative_sd": 0.2}}}
    scene = fitact.Scene.from_dict(finger_posterior.fit.scene.model_dump(exclude_unset=True) | content)
    felt = dataclasses.replace(finger_posterior, fit=with_scene(finger_posterior.fit, scene))
    draws, record, frequency = felt.parameters(), felt.fit.record, felt.fit.record.frequency()
    for draw in (0, 1000):
        Rsc, Csc, Ci, charge, mu = (
            draws[name][1, draw] for name in ("Rsc", "Csc", "Ci", "charge", "friction_coefficient")
        )
        with jax.enable_x64(True):
            vsc = fitact.response(
                fitact.FinalCircuit(Rsc, Csc, Ci), felt.fit.derive.drive, record.time, steady_state=False
            )
        vsc = np.asarray(vsc) + charge * np.exp(-record.time / (Rsc * (2.0 * Ci + Csc)))
        friction = mu * vsc**2 / (2.0 * (1.0 / Ci + 1.0 / Csc) * (1e-6 + 200e-6))
        at = frequency * np.arange(1, 6)
        kept = at[at <= 500.0]
        amplitude = 2.0 * np.abs(np.mean(friction * np.exp(-2j * np.pi * kept[:, None] * record.time), axis=1))
        ratio = amplitude / np.exp(np.interp(np.log(kept), np.log([90.0, 500.0]), np.log([2e-3, 1e-3])))
        assert felt.derived()["times_threshold"][1, draw] == pytest.approx(np.hypot.reduce(ratio), rel=1e-6)
    assert felt.sensation.frequency == pytest.approx(frequency * (1 + np.argmax(ratio)))
    summary = felt.summary()
    level = summary["sensation"]["level"]
    assert level["unit"] == "dB"
    combined = summary["derived"]["times_threshold"]["combined"]
    assert level["q50"] == pytest.approx(20.0 * np.log10(combined["q50"]), abs=1e-3)
    assert summary["derived"]["times_threshold"]["u"] == summary["derived"]["force_mean"]["u"]
    assert "times_threshold" in str(felt)
    text = describe_summary(summary, verbose=True)
    assert "these data do not test that law" in text
    assert summary["sensation"]["sentence"] in text
    assert "times_threshold" not in felt.force()
    assert "sensation" not in finger_posterior.summary()


def test_no_sensation_is_stated_without_a_frequency_in_the_table(finger_posterior: fitact.Posterior):
    fit, table = finger_posterior.fit, {"frequencies": [1.0, 50.0], "forces": [2e-3, 1e-3]}
    scene = fitact.Scene.from_dict({"perception": {"thresholds": table}})
    felt = dataclasses.replace(finger_posterior, fit=with_scene(fit, scene))
    assert felt.sensation.sentence == (
        "Felt: no detection is stated, because the force has no frequency in the table of thresholds (1 Hz to 50 Hz;"
        " no source stated)."
    )
    assert felt.sensation.to_dict().keys() == {"table", "sentence"}
    assert "times_threshold" not in felt.derived()
    alone = FeltDrive.from_draws(fit.derive, fit.likelihood, scene, None, finger_posterior.points, 1)
    assert "because the drive does not repeat" in alone.sentence


def test_scene_drives_force_is_that_of_one_steady_period():
    """Mean square of Vsc for a square wave: 4 V0^2 g^2 tanh(x/4) / x, x = T / b."""
    from fitact.fitting.derived import DERIVED_NAMES
    from tests.conftest import square_record

    fit = fitact.fit(square_record(), fitact.Scene())
    values = {name: s["q50"] for name, s in fit.derived().items()}
    assert set(values) == set(DERIVED_NAMES)
    Csc, Ci = (fit.parameters()[name]["q50"] for name in ("Csc", "Ci"))
    x = 0.01 / values["b"]
    squared = 4.0 * 180.0**2 * values["g"] ** 2 * np.tanh(x / 4.0) / x
    assert values["force_mean"] == pytest.approx(squared / (2.0 * (1.0 / Ci + 1.0 / Csc) * 201e-6), rel=1e-9)
    peak = (360.0 * values["g"] / (1.0 + np.exp(-x / 2.0))) ** 2
    assert values["force_peak"] == pytest.approx(peak / (2.0 * (1.0 / Ci + 1.0 / Csc) * 201e-6), rel=1e-9)


def test_summary_has_what_other_programs_read(finger_posterior: fitact.Posterior):
    summary = json.loads(to_json(finger_posterior.summary()))
    numbers = {"unit", "mean", "sd", "q025", "q05", "q25", "q50", "q75", "q95", "q975"}
    for section, names in {
        "parameters": ("Rsc", "Csc", "Ci", "sigma", "offset"),
        "derived": ("g", "b", "force_mean", "force_peak", "friction_mean"),
    }.items():
        for name in names:
            assert numbers <= set(summary[section][name])
    assert {"Rsc", "Csc", "Ci"} == {n for n, s in summary["parameters"].items() if "contraction" in s}
    assert [summary["parameters"][name]["unit"] for name in ("Rsc", "Csc", "Ci")] == ["ohm", "F", "F"]
    assert {"verdict", "blind_direction", "remedy", "eigenvalues", "force_from_prior"} <= set(
        summary["identifiability"]
    )
    assert {"converged", "tau_max", "ess_min", "rhat_max", "steps", "walkers"} <= set(summary["convergence"])
    assert {"result", "chi2_reduced", "rms_residual", "misfit"} <= set(summary["fit"])
    assert {"circuit", "skin", "response", "likelihood", "compression_error"} <= set(summary["model"])
    assert summary["seed"] == 1
    assert {"fitact", "jax", "optimistix", "emcee", "numpy"} <= set(summary["versions"])
    assert isinstance(summary["warnings"], list)


def test_netcdf_has_arviz_groups_with_units(netcdf: Path, finger_posterior: fitact.Posterior):
    import xarray as xr

    with xr.open_datatree(netcdf, engine="h5netcdf") as tree:
        groups = {
            "posterior",
            "combined",
            "sample_stats",
            "posterior_predictive",
            "observed_data",
            "prior",
            "constant_data",
            "force_in_time",
        }
        assert groups == set(tree.children)
        posterior = tree["posterior"]
        np.testing.assert_array_equal(posterior["Rsc"], finger_posterior.parameters()["Rsc"])
        assert posterior["Rsc"].attrs["units"] == "ohm"
        assert posterior["force_mean"].attrs["units"] == "N"
        assert tree["posterior_predictive"]["Vsc"].dims == ("chain", "draw", "time")
        assert tree.attrs["record_sha256"] == finger_posterior.fit.record.fingerprint


def test_predicted_records_cover_the_record(netcdf: Path):
    import xarray as xr

    with xr.open_datatree(netcdf, engine="h5netcdf") as tree:
        predicted, observed = tree["posterior_predictive"]["Vsc"].values, tree["observed_data"]["Vsc"].values
    low, high = np.quantile(predicted.reshape(-1, observed.size), [0.05, 0.95], axis=0)
    # 90 % up to the finite number of predictions; the binomial sd of the fraction is 0.5 %
    assert np.mean((low < observed) & (observed < high)) == pytest.approx(0.9, abs=0.025)


@pytest.mark.slow
def test_same_seed_same_file(netcdf: Path, finger_fit: fitact.Fit, tmp_path):
    fitact.sample(finger_fit, seed=1, progress=False).to_netcdf(tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == netcdf.read_bytes()


def test_prior_draws_are_the_prior(netcdf: Path, finger_fit: fitact.Fit):
    import xarray as xr

    with xr.open_datatree(netcdf, engine="h5netcdf") as tree:
        logs = np.log(tree["prior"]["Ci"].values)
    assert logs.std() == pytest.approx(finger_fit.likelihood.prior["Ci"].log_sd, rel=0.05)


def test_import_is_light():
    heavy = ["jax", "optimistix", "emcee", "matplotlib", "arviz", "arviz_stats", "xarray", "pint", "scipy"]
    code = f"import sys, fitact; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there():
    for name in fitact.__all__:
        assert getattr(fitact, name) is not None
    with pytest.raises(AttributeError):
        fitact.nonsense  # noqa: B018


def test_a_spread_beyond_numbers_is_open():
    s = summarize_log_normal("b", 1.0, 40.0)
    assert s["q50"] == 1.0
    assert s["sd"] == np.inf
    assert format_sd(s) == "undetermined"
