"""posterior.nc in the installed ArviZ: 0.23 (InferenceData, Python 3.11) or 1.x (DataTree, 3.12 and later)."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import fitact

NAMES = ["Rsc", "Csc", "Ci", "g", "b", "force_mean"]


@pytest.fixture(scope="module")
def arviz() -> Any:
    mpl.use("Agg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 0.23 announces its successor on import
        return pytest.importorskip("arviz")


def test_object_in_memory_is_that_of_the_file(arviz: Any, finger_posterior: fitact.Posterior, tmp_path: Path):
    """And ArviZ's summary has the means and standard deviations of ours."""
    data = finger_posterior.to_arviz()
    finger_posterior.to_netcdf(tmp_path / "posterior.nc")
    stored = arviz.from_netcdf(tmp_path / "posterior.nc")
    assert type(data) is type(stored)
    for name in ("Rsc", "force_mean"):
        np.testing.assert_array_equal(data["posterior"][name].values, stored["posterior"][name].values)
        assert data["posterior"][name].attrs["units"] == stored["posterior"][name].attrs["units"]
    np.testing.assert_array_equal(data["force_in_time"]["force"].values, finger_posterior.force_in_time[1])
    table, ours = arviz.summary(data, var_names=NAMES), finger_posterior.summary()
    for name, summary in (ours["parameters"] | ours["derived"]).items():
        if name in ("Rsc", "Csc", "Ci"):
            assert float(table["mean"][name]) == pytest.approx(summary["mean"], rel=1e-2, abs=1e-3)
            assert float(table["sd"][name]) == pytest.approx(summary["sd"], rel=1e-2, abs=1e-3)


@pytest.fixture(scope="module", params=["emcee", pytest.param("psis", marks=pytest.mark.slow)])
def data(request, arviz: Any, finger_fit: fitact.Fit, tmp_path_factory) -> Any:
    path: Path = tmp_path_factory.mktemp(request.param) / "posterior.nc"
    fitact.sample(finger_fit, level=request.param, seed=1, progress=False).to_netcdf(path)
    return arviz.from_netcdf(path)


def test_summary_is_that_of_the_draws(arviz: Any, data: Any):
    table = arviz.summary(data, var_names=NAMES)
    assert list(table.index) == NAMES
    draws = data["posterior"]["Rsc"].values
    # 1.x rounds to the digits that the Monte Carlo error supports
    assert float(table["mean"].astype(float)["Rsc"]) == pytest.approx(np.mean(draws), rel=1e-2)
    assert float(table["sd"].astype(float)["Rsc"]) == pytest.approx(np.std(draws, ddof=1), rel=1e-2)
    assert np.all(table["r_hat"].astype(float) < 1.01)


@pytest.mark.parametrize(
    ("plots", "names"),
    [
        (("plot_trace_dist", "plot_trace"), NAMES),
        (("plot_dist", "plot_posterior"), NAMES),
        (("plot_pair",), ["Rsc", "Ci"]),
        (("plot_ppc_dist", "plot_ppc"), None),
    ],
)
def test_main_plots(arviz: Any, data: Any, plots: tuple[str, ...], names: list[str] | None):
    """The first name is that of 1.x, the last that of 0.23, where it may be another plot in the other version."""
    plot: Callable[..., Any] = getattr(arviz, plots[0] if hasattr(arviz, "plot_trace_dist") else plots[-1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plot(data, **({} if names is None else {"var_names": names}))
    mpl.pyplot.close("all")
