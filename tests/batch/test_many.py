"""Fits of many records at once: the same results as one by one, and failures that do not affect other records."""

import csv
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.optimize

import fitact
from fitact.batch.shared_basis import SharedBasis
from tests.conftest import square_record

COUNT = 20
NAMES = ("Rsc", "Csc", "Ci")
MEDIANS, LOG_SDS = np.log([130e3, 18e-9, 1.35e-9]), np.array([0.5, 0.5, 0.05])
SCENE = fitact.Scene.from_dict(
    {
        "drive": {"waveform": "square", "peak_to_peak": 360.0, "frequency": 100.0},
        "prior": {
            name: {"median": float(np.exp(median)), "relative_sd": float(np.sqrt(np.expm1(sd**2)))}
            for name, median, sd in zip(NAMES, MEDIANS, LOG_SDS, strict=True)
        },
    }
)


def record(number: int, **how) -> fitact.Record:
    scale = np.exp(0.2 * np.sin(np.arange(3) + number))
    skin = {"Rsc": 130e3 * scale[0], "Csc": 18e-9 * scale[1]}
    made = square_record(seed=number, per_period=1000, **{"noise": 0.1} | skin | how)
    return fitact.Record.from_arrays(made.time, Vsc=made["Vsc"], source=f"finger_{number}.csv")


def settled(time: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return the steady state for the square of `SCENE`, from logarithms."""
    half = np.floor(time * 200.0 + 1e-9)
    sign, since = np.where(half % 2 == 0.0, 1.0, -1.0), time - half / 200.0
    R, C, Ci = np.exp(theta)
    g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
    return sign * 360.0 * g / (1.0 + np.exp(-0.005 / b)) * np.exp(-since / b)


def optimum(record: fitact.Record, sigma: float, start: np.ndarray = MEDIANS) -> np.ndarray:
    """Return the optimum by MINPACK, from the closed form of a steady-state square."""

    def residuals(theta):
        return np.append((record["Vsc"] - settled(record.time, theta)) / sigma, (theta - MEDIANS) / LOG_SDS)

    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return scipy.optimize.least_squares(residuals, start, method="lm", jac="3-point", **tight).x


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> list:
    """Return clean records with unusual ones of each kind among them."""
    folder = tmp_path_factory.mktemp("records")
    (folder / "broken.csv").write_text("time_s,Vsc_V\n0,1\n1,nan\n")
    given: list = [record(number) for number in range(COUNT)]
    clipped = np.minimum(given[3]["Vsc"], 0.6 * given[3]["Vsc"].max())
    time, vsc = given[4].time, given[4]["Vsc"]
    given[3] = fitact.Record.from_arrays(time, Vsc=clipped, source="clipped")
    given[4] = fitact.Record.from_arrays(time, Vsc=vsc + 2.0, source="offset")
    given[5] = fitact.Record.from_arrays(time, Vsc=vsc + 1.5 * np.sin(2.0 * np.pi * 730.0 * time), source="misfit")
    given[6] = fitact.Record.from_arrays(time * 1.3, Vsc=vsc, source="of another frequency")
    given[7] = folder / "broken.csv"
    given[8] = str(folder)
    return given


@pytest.fixture(scope="module")
def fits(given) -> fitact.Fits:
    return fitact.fit_many(given, SCENE, progress=False)


def test_rows_stand_in_the_order_of_the_records(fits, given):
    assert len(fits) == len(given)
    names = [Path(each.source if isinstance(each, fitact.Record) else each).name for each in given]
    assert [row["record"] for row in fits] == names


@pytest.mark.parametrize("number", [0, 3, 4, 5, 19])
def test_each_row_is_the_fit_of_its_record(fits, given, number):
    row, alone = fits[number], fitact.fit(given[number], SCENE)
    assert (row["result"], row["trusted"]) == (alone.result, alone.trusted)
    assert row["verdict"] == alone.identifiability.verdict
    assert row["freed"] == ", ".join(alone.model()["freed"])
    for i, name in enumerate(NAMES):
        assert row[name] == pytest.approx(np.exp(alone.theta[i]), rel=1e-6)
        assert row[f"{name}_log_sd"] == pytest.approx(alone.sd[i], rel=1e-4)
    force = alone.derived()["force_mean"]
    assert row["force_mean"] == pytest.approx(force["q50"], rel=1e-6)
    assert row["force_from_prior"] == pytest.approx(alone.identifiability.force_from_prior, rel=1e-4)
    assert row["chi2_reduced"] == pytest.approx(alone.figures["chi2_reduced"], rel=1e-9)


def test_a_free_gain_is_named_in_batches_too():
    scene = SCENE.model_copy(update={"measurement": SCENE.measurement.model_copy(update={"gain_relative_sd": 0.02})})
    given = [record(number) for number in range(16)]
    rows, alone = fitact.fit_many(given, scene, progress=False), fitact.fit(given[0], scene)
    assert {row["freed"] for row in rows} == {", ".join(alone.model()["freed"])} == {"gain"}
    assert rows[0]["Ci"] == pytest.approx(np.exp(alone.theta[2]), rel=1e-6)


def with_line(clean: fitact.Record, amplitude: float) -> fitact.Record:
    """Return the record with an added sine; `amplitude` is in units of the noise sd."""
    line = 0.1 * amplitude * np.sin(2.0 * np.pi * 730.0 * clean.time)
    return fitact.Record.from_arrays(clean.time, Vsc=clean["Vsc"] + line, source=clean.source)


def test_without_tests_of_whiteness_only_size_is_judged():
    """A sine of 0.35 sd adds 6 % to the variance, within the error of the noise estimate; one of 1.5 sd adds 110 %."""
    given = [record(number) for number in range(COUNT)]
    given[2], given[3] = with_line(given[2], 0.35), with_line(given[3], 1.5)
    tested = fitact.fit_many(given, SCENE, progress=False)
    untested = fitact.fit_many(given, SCENE, whiteness=False, progress=False)
    assert [tested[2]["result"], tested[3]["result"]] == ["structure", "misfit"]
    assert [untested[2]["result"], untested[3]["result"]] == ["successful", "misfit"]
    assert "not tested" in untested[2]["message"]
    for quick, whole in zip(untested[4:], tested[4:], strict=True):
        assert quick.keys() == whole.keys()
        assert quick["trusted"]
        assert "not tested" in quick["message"]
        for name in ("chi2_reduced", "rms_residual", "force_mean", *NAMES):
            assert quick[name] == pytest.approx(whole[name], rel=1e-9)


@pytest.mark.parametrize("number", [0, 11])
def test_optimum_against_scipy(fits, given, number):
    row = fits[number]
    np.testing.assert_allclose(
        np.log([row[name] for name in NAMES]), optimum(given[number], row["noise"]), rtol=0.0, atol=1e-6
    )


@pytest.mark.slow
def test_noise_so_low_that_coordinates_lose_it():
    """Noise of some billionths of the height: the residuals must be computed from the samples."""
    quiet = [record(number, noise=1e-7) for number in range(16)]
    error = 5.0 / np.sqrt(2.0 * len(quiet[0]))
    for row in fitact.fit_many(quiet, SCENE, progress=False):
        assert (row["noise"], row["rms_residual"]) == pytest.approx((1e-7, 1e-7), rel=error)


@pytest.mark.slow
def test_without_tests_of_whiteness_low_noise_is_told_from_samples():
    """Residuals from coordinates would have errors of several per cent."""
    quiet = [record(number, noise=6e-7, Rsc=20e3) for number in range(16)]
    for each, row in zip(quiet, fitact.fit_many(quiet, SCENE, whiteness=False, progress=False), strict=True):
        near = np.log([row[name] for name in NAMES])  # the fit starts here, because it ends elsewhere from the medians
        left = each["Vsc"] - settled(each.time, optimum(each, row["noise"], near))
        assert row["rms_residual"] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-3)


@pytest.mark.parametrize("samples", [20, 21, 22, 23, 24])
def test_a_basis_of_hardly_more_functions_than_samples_holds_the_responses(samples):
    time = np.append(0.0, np.geomspace(1e-6, 4.9e-3, samples - 1))
    with jax.enable_x64(True):
        basis = SharedBasis.from_drive(fitact.Square(peak_to_peak=360.0, frequency=100.0), time, True, 3e-5)
    response = 360.0 / (1.0 + np.exp(-0.005 / 4e-5)) * np.exp(-time / 4e-5)
    coordinates = basis.project(response[None])
    rank = len(basis.compression.signal)
    assert basis.functions[:, :rank] @ coordinates[0, :rank] == pytest.approx(response, abs=1e-9)


def test_failures_stay_by_themselves(fits):
    assert {row["record"] for row in fits.failures} >= {"broken.csv", "of another frequency"}
    assert {row["result"] for row in fits.failures} == {"refused"}
    assert "too few" in fits[7]["message"]
    assert "directory" in fits[8]["message"]
    assert "76.9" in fits[6]["message"]
    assert fits[5]["result"] == "misfit"
    clean = [row for number, row in enumerate(fits) if number not in (3, 4, 5, 6, 7, 8)]
    assert all(row["trusted"] for row in clean)


def test_what_no_one_foresaw_is_told_as_a_crash(monkeypatch):
    def breaks(*_, **__):
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr("fitact.batch.fit_many.fit", breaks)
    (row,) = fitact.fit_many([record(0)], SCENE, progress=False)
    assert (row["result"], row["trusted"]) == ("crashed", False)
    assert "ZeroDivisionError: of all things" in row["message"]


def test_tables_hold_every_row(fits, tmp_path: Path):
    fits.to_csv(tmp_path / "fits.csv")
    with (tmp_path / "fits.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["record"] for row in rows] == [row["record"] for row in fits]
    assert [float(row["Rsc"]) for row in rows if row["Rsc"]] == [row["Rsc"] for row in fits if "Rsc" in row]
    parquet = pytest.importorskip("pyarrow.parquet")
    fits.to_parquet(tmp_path / "fits.parquet")
    table = parquet.read_table(tmp_path / "fits.parquet").to_pydict()
    assert table["Rsc"] == [row.get("Rsc") for row in fits]
    assert table["trusted"] == [row["trusted"] for row in fits]
    np.testing.assert_array_equal(np.isnan(fits.columns["Rsc"]), [x is None for x in table["Rsc"]])


def test_a_channel_that_is_missing_is_a_row(given):
    scene = fitact.Scene.from_dict({"measurement": {"channels": ["I"]}})
    (row,) = fitact.fit_many(given[:1], scene, progress=False)
    assert row["result"] == "refused"
