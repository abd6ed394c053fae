"""Tracks of simulated fingers that change, by the route of data_synth, against their true courses."""

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
import scipy.signal

import fitact
from data_synth.changing import Course, make_course
from data_synth.make import make, simulate_response
from data_synth.recipe import load
from data_synth.scene import make_scene
from fitact.problem import jumps
from fitact.tracking import track_record
from fitact.tracking.solve_windows import _residuals_vary

RATE, DURATION, WINDOW = 50e3, 3.0, 0.08
DRIVE = {"waveform": "trapezoid", "rise_time": "200 us", "frequency": "100 Hz"}
START = (160e3, 22e-9, 1.35e-9)
SCENE = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "measurement": {"channels": ["Vsc", "I"]}})
ALONE = fitact.Scene.from_dict({"drive": {"waveform": "measured"}})
STILL: dict[str, Any] = {
    "time": None, "area": None, "Rsc": None, "Csc": None,
    "walk_area": 0.0, "walk_Rsc": 0.0, "walk_Csc": 0.0, "lifted": (),
}  # fmt: skip
SLIDE = {"time": (0.0, 3.0), "area": (1.0, 1.3), "Rsc": (1.0, 0.6), "lifted": (1.53, 1.71)}


def simulate(
    seed: int = 0, duration: float = DURATION, rate: float = RATE, coloured: float = 0.0, **change: Any
) -> tuple[fitact.Record, Course]:
    """Return a record of a finger that changes, and its course.

    The noise is 0.1 V and 20 nA; that of Vsc is an AR(1) with these innovations and the coefficient `coloured`.
    """
    # corners lie half-way between samples; if all lay on samples, the jumps of I would tell a wrong delay
    drive = DRIVE | {"phase": f"{180.0 * 100.0 / rate} deg"}
    scene = make_scene({"drive": drive, "measurement": {"channels": ["Vsc", "I"]}}, {}, "scene")
    rng = np.random.default_rng(seed)
    course = make_course(STILL | change, START, duration, rng)
    time = np.arange(round(duration * rate)) / rate
    V, Vsc, current = simulate_response(scene, time, None, "scipy", course)
    V = V + 0.1 * rng.standard_normal(time.size)
    Vsc = Vsc + 0.1 * scipy.signal.lfilter([1.0], [1.0, -coloured], rng.standard_normal(time.size))
    current = current + 20e-9 * rng.standard_normal(time.size)
    return fitact.Record.from_arrays(time, V=V, Vsc=Vsc, I=current), course


def errors(track: fitact.Track, course: Course) -> dict[str, np.ndarray]:
    """Return the errors of reliable values in standard uncertainties."""
    Rsc, Csc, Ci = course.values(track.time)
    truth = {"Rsc": Rsc, "Csc": Csc, "Ci": Ci, "g": Ci / (2.0 * Ci + Csc), "b": Rsc * (2.0 * Ci + Csc)}
    truth["contact_area"] = 1e-4 * Ci / START[2]
    return {
        name: (np.log(track.values[name] / values) / track.u[name])[track.reliable]
        for name, values in truth.items()
        if name in track.values
    }


@pytest.fixture(scope="module")
def slide() -> tuple[fitact.Track, Course, fitact.Record]:
    record, course = simulate(**SLIDE)
    return fitact.track(record, SCENE), course, record


def test_slide_is_followed_within_its_bands(slide):
    track, course, _ = slide
    for name, z in errors(track, course).items():
        # g does not change, so that its error is alike along the record
        assert np.sqrt(np.mean(np.square(z))) < 2.0, name
        assert name == "g" or np.mean(np.abs(z) < 1.96) >= 0.93, name
    assert track.trusted
    # values are of use: far narrower than the change, and g, which does not change, as well as the noise allows
    assert np.nanmedian(track.u["contact_area"]) < 4e-3 < 0.1 < track.within_finger["Rsc"]["log_sd"]
    assert np.nanmedian(track.u["g"]) < 1e-4
    assert set(track.verdict[track.reliable]) == {"identified"}


def test_lift_off_is_found_within_one_window(slide):
    track, *_ = slide
    ((begin, end),) = track.lifted
    assert 0.0 <= 1.53 - begin <= WINDOW
    assert 0.0 <= end - 1.71 <= WINDOW + 2e-3
    assert np.isnan(track.values["Rsc"][~track.contact]).all()
    assert track.jumps == ()  # a new contact is no jump


def true_force(drive: dict[str, Any], course: Course, track: fitact.Track, k: int) -> float:
    """Return the mean force over a window by the true voltage, with the values of its middle."""
    time = track.time[k] + np.linspace(-0.5, 0.5, 4000, endpoint=False) * track.window
    _, Vsc, _ = simulate_response(make_scene({"drive": drive}, {}, "scene"), time, None, "scipy", course)
    _, Csc, Ci = course.values(track.time[k : k + 1])[:, 0]
    contact = fitact.Contact(1e-4, 1e-6, Ci * 1e-6 / (8.85e-12 * 1e-4), 200e-6, Csc * 200e-6 / (8.85e-12 * 1e-4))
    return float(np.mean(fitact.electrostatic_force(Vsc, contact)))


def test_force_is_that_of_the_true_voltage(slide):
    track, course, _ = slide
    for k in (2, 15, 30):
        # over the whole window Rsc changes by 1 %
        assert track.values["force_mean"][k] == pytest.approx(true_force(DRIVE, course, track, k), rel=2e-3)


def test_columns_and_summary_of_the_contract(slide, tmp_path: Path):
    track, *_ = slide
    track.to_parquet(tmp_path / "track.parquet")
    table = pandas.read_parquet(tmp_path / "track.parquet")
    names = ("Rsc", "Csc", "Ci", "g", "b", "force_mean")
    assert {"time_s", "reliable", "contact", *names, *(f"{name}_u" for name in names)} <= set(table.columns)
    assert len(table) == track.time.size
    content = track.to_dict()
    assert content["within_finger"]["Rsc"].keys() == {"log_sd", "time_scale_s"}
    assert "no contact from 1.5" in str(track)


def test_time_average_is_that_of_the_course(slide):
    track, course, _ = slide
    logs = np.log(course.values(track.time[track.reliable]))
    average = track.average
    assert average.sees_area
    error = np.linalg.solve(average.factor, average.target) - logs.mean(axis=1)
    sd = np.sqrt(np.diag(np.linalg.inv(average.factor.T @ average.factor)))
    assert np.all(np.abs(error) < 4.0 * sd + 5e-4)  # windows see averages, of which these are the middles
    np.testing.assert_allclose(average.within, np.cov(logs, ddof=0), rtol=0.03)
    assert average.duration == pytest.approx(np.ptp(track.time[track.reliable]) + track.window)


def test_fit_of_a_constant_finger_names_the_change(slide):
    *_, record = slide
    part = slice(0, 25_000)  # 0.5 s, in which Rsc falls by 8 % for the area and by 5 % more for the skin
    channels = {name: values[part] for name, values in record.channels.items()}
    fitted = fitact.fit(fitact.Record.from_arrays(record.time[part], **channels), SCENE)
    assert fitted.result in ("misfit", "structure")
    assert fitted.effects.rivals[0]["group"].startswith("a change during the record of")
    assert "during the record: use track" in fitted.message


@pytest.mark.parametrize(("frequencies", "noise_V"), [([100.0, 4100.0], 0.02), ([100.0], 2.0), ([10e3, 9.9e3], 0.1)])
def test_tones_are_read_between_samples_without_their_noise(frequencies: list[float], noise_V: float):
    """Lines cut 0.3 % of a tone of 39 samples per period, and moved g by 0.18 %; noise of a sine, by 24 sd."""
    Rsc, Csc, Ci = 160e3, 24e-9, 1.35e-9
    time, total = 6.25e-6 * np.arange(32_000), 2.0 * Ci + Csc
    omega, rng = 2.0 * np.pi * np.array(frequencies)[:, None], np.random.default_rng(3)
    gain = Ci * Rsc * 1j * omega / (1.0 + Rsc * total * 1j * omega)
    late = time - 0.4 * 6.25e-6
    V, Vsc = (
        90.0 * np.sum(each.imag, axis=0) for each in (np.exp(1j * omega * time), gain * np.exp(1j * omega * late))
    )
    channels = {}
    for name, values, sd in (("V", V, noise_V), ("Vsc", Vsc, 0.02)):
        noisy, lsb = values + sd * rng.standard_normal(time.size), 1.2 * np.ptp(values) / 2**14
        channels[name] = lsb * np.round(noisy / lsb)
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    track = fitact.track(fitact.Record.from_arrays(time, **channels), scene)
    assert track.trusted
    found = track.to_dataframe()
    g, u = found["g"].to_numpy(), found["g_u"].to_numpy()
    assert np.all(np.abs(np.log(g * total / Ci)) < 3.5 * u + 1e-4)
    assert np.all(
        u < (2e-3 if noise_V == 2.0 else 3e-4)
    )  # one sine tells b and the delay as little as its noise allows


def test_stationary_record_gives_the_answer_of_a_fit():
    record, course = simulate(duration=1.0)
    fitted, found = fitact.fit(record, SCENE), fitact.track(record, SCENE)
    for i, name in enumerate(each for each in fitted.names if each in found.values):
        assert np.max(np.abs(np.log(found.values[name]) - fitted.theta[i])) < 2.0 * np.max(found.sd[name])
        # each of 12 windows alone knows it to 3.5 times that of all; the walk's rate is not known to be zero
        assert np.median(found.sd[name]) < 0.65 * np.sqrt(12.0) * fitted.sd[i]
    assert np.all(found.rates.lower == 0.0)
    for z in errors(found, course).values():
        assert np.max(np.abs(z)) < 3.5


def test_walk_fixed_at_zero_gives_the_answer_of_a_fit(monkeypatch):
    # windows take the errors at jumps of I as independent
    monkeypatch.setattr(jumps, "_count_alike", lambda places: 1.0)
    record, _ = simulate(duration=0.96)  # a whole number of windows
    fitted = fitact.fit(record, SCENE)
    found = fitact.track(record, SCENE, rates=(0.0, 0.0, 0.0))
    for i, name in enumerate(each for each in fitted.names if each in found.values):
        # the first steps of each window have no row, and each window has an estimate of the drive of its own
        assert np.log(found.values[name]) == pytest.approx(fitted.theta[i], abs=0.5 * fitted.sd[i])
        # windows count residuals that are alike as fewer, of which noise alone leaves some
        assert np.all((found.sd[name] > 0.98 * fitted.sd[i]) & (found.sd[name] < 1.15 * fitted.sd[i]))


def test_windows_with_coloured_noise_give_the_answer_of_a_fit():
    record, _ = simulate(duration=0.96, coloured=0.9)
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "measurement": {"noise_model": "ar1"}})
    fitted = fitact.fit(record, scene)
    found = fitact.track(record, scene, rates=(0.0, 0.0, 0.0))
    logs, sds, _ = fitted.laplace.derived_moments()
    for name, log, sd in zip(("g", "b", "force_mean"), logs, sds, strict=False):
        assert np.log(found.values[name]) == pytest.approx(log, abs=max(0.5 * sd, 1e-3 * (name == "force_mean")))
        # the filter is that of one window, whose coefficient is known to 0.01
        assert np.all((found.sd[name] > 0.8 * sd) & (found.sd[name] < 1.2 * sd))
    assert found.noise["sigma"] == pytest.approx(fitted.sigma, rel=0.1)


def test_vsc_alone_leaves_the_area_to_the_prior():
    record, course = simulate(**SLIDE)
    track = fitact.track(record, ALONE)
    assert set(track.verdict[track.reliable]) == {"prior-limited"}
    found = errors(track, course)
    for name in ("g", "b"):
        assert np.mean(np.abs(found[name]) < 1.96) >= 0.93, name
    assert np.min(track.u["contact_area"][track.reliable]) > 0.04  # the prior of Ci, ± 5 %
    assert track.u["g"][track.reliable].max() < 2e-3


def test_random_walk_is_recovered_with_its_rates():
    # three records, since one may have a rare walk; any seeds would do at these limits
    inside, rates = [], []
    for seed in (1, 2, 3):
        record, course = simulate(seed, walk_area=0.02, walk_Rsc=0.05, walk_Csc=0.01)
        track = fitact.track(record, SCENE)
        inside += [np.mean(np.abs(z) < 1.96) for z in errors(track, course).values()]
        rates.append(track.rates.rate)
        assert np.all(track.rates.lower > 0.0)
    assert 0.9 < np.mean(inside) <= 1.0
    assert np.mean(rates, axis=0) == pytest.approx([0.02, 0.05, 0.01], rel=0.35)


def test_lost_samples_are_bridged_and_a_jump_is_found():
    walks = {"walk_area": 0.02, "walk_Rsc": 0.02, "walk_Csc": 0.01}  # what is lost of them is uncertain for any seed
    record, course = simulate(4, time=(0.0, 1.8, 1.8004, 3.0), Rsc=(1.0, 1.0, 1.3, 1.3), **walks)
    channels = {name: np.array(values) for name, values in record.channels.items()}
    channels["Vsc"][30_000:36_000] = np.nan  # lost by one channel
    keep = np.ones(record.time.size, bool)
    keep[50_000:60_000] = False  # lost by all, with their times
    blocks = [fitact.readers.stream.Block(record.time[keep], {n: v[keep] for n, v in channels.items()}, 0.0)]
    track = track_record.track_blocks(iter(blocks), "record", 0.0, SCENE)
    lost = ~track.reliable & (track.time < 1.0)  # the window with the jump is none of either state
    assert lost.any()
    assert np.all(np.abs(track.time[lost] - 0.66) < 0.15)
    assert np.max(track.sd["Rsc"][lost]) > 1.05 * np.median(track.sd["Rsc"])
    assert np.any(np.diff(track.time) > 0.2)
    assert [jump for jump in track.jumps if abs(jump - 1.8) <= WINDOW]
    for name in ("Rsc", "b"):
        z = errors(track, course)[name]
        assert np.mean(np.abs(z) < 1.96) > 0.8, name


def write_csv(path: Path, record: fitact.Record) -> None:
    table = {"time_s": record.time, "V_V": record["V"], "Vsc_V": record["Vsc"], "I_A": record["I"]}
    pandas.DataFrame(table).to_csv(path, index=False)


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> tuple[Path, fitact.Record]:
    record, _ = simulate(duration=1.0, time=(0.0, 1.0), area=(1.0, 1.1))
    path = tmp_path_factory.mktemp("track") / "long.csv"
    write_csv(path, record)
    return path, record


def test_file_and_standard_input_give_the_same_as_arrays(short, monkeypatch):
    path, record = short
    expected, from_file = fitact.track(record, SCENE), fitact.track(path, SCENE)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(path.read_bytes())))
    from_stream = fitact.track("-", SCENE)
    for found in (from_file, from_stream):
        assert found.time == pytest.approx(expected.time, abs=1e-12)
        for name, values in expected.values.items():
            assert found.values[name] == pytest.approx(values, rel=1e-9, nan_ok=True), name


def test_interrupted_run_goes_on_to_the_same_result(short, tmp_path: Path, monkeypatch):
    path, _ = short
    whole = fitact.track(path, SCENE)
    compress, count = track_record.WindowModel.compress, 0

    def interrupt(*args: Any) -> Any:
        nonlocal count
        count += 1
        if count == 7:
            raise KeyboardInterrupt
        return compress(*args)

    monkeypatch.setattr(track_record.WindowModel, "compress", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fitact.track(path, SCENE, folder=tmp_path)
    assert (tmp_path / track_record.CHECKPOINT).is_file()
    count = 100
    resumed = fitact.track(path, SCENE, folder=tmp_path)
    assert count < 100 + whole.time.size  # six windows were not compressed again, one is for the shapes
    assert not (tmp_path / track_record.CHECKPOINT).exists()
    for name, values in whole.values.items():
        np.testing.assert_array_equal(resumed.values[name], values)


def test_changes_are_corrected_for_beside_lift_offs_too():
    """A finger that taps: most windows are the first or last of a contact. The rms of 61 errors is below 1.5."""
    lifted = (0.5, 0.7, 1.3, 1.6, 2.4, 2.9, 3.5, 3.7, 4.2, 4.3)
    record, course = simulate(0, 5.0, time=(0.0, 5.0), area=(1.0, 1.2), Rsc=(1.0, 0.8), lifted=lifted)
    track = fitact.track(record, SCENE)
    assert len(track.lifted) == 5
    for name, z in errors(track, course).items():
        assert np.sqrt(np.mean(np.square(z))) < 1.5, name


def test_clipped_samples_are_excluded_from_every_window(short):
    _, record = short
    expected = fitact.track(record, SCENE)
    clipped = {**record.channels, "Vsc": np.clip(record["Vsc"], -8.0, 8.0)}
    assert np.mean(clipped["Vsc"] == record["Vsc"]) < 0.9
    found = fitact.track(fitact.Record.from_arrays(record.time, **clipped), SCENE)
    assert any("clipped samples are excluded from 12 of 12 windows" in each for each in found.warnings)
    assert found.trusted
    for name in ("g", "b", "Ci"):
        errors_of_both = np.hypot(found.u[name], expected.u[name])
        assert np.max(np.abs(np.log(found.values[name] / expected.values[name])) / errors_of_both) < 4.0
    # its mean square over the samples that are not clipped is not that of the window
    assert np.isnan(found.values["force_mean"]).all()
    assert "force_mean" not in found.to_dict()["start"]
    assert "force_mean" not in str(found)


def test_v_that_is_lost_leaves_only_its_window_without_data(short, tmp_path: Path):
    path, _ = short
    lines = path.read_text().splitlines(keepends=True)
    for row in (8_001, 8_002):  # the first samples of the third window
        time, _, rest = lines[row].split(",", 2)
        lines[row] = f"{time},nan,{rest}"
    (tmp_path / "lost.csv").write_text("".join(lines))
    found = fitact.track(tmp_path / "lost.csv", SCENE)
    np.testing.assert_array_equal(np.flatnonzero(~found.reliable), [2])
    assert found.contact.all()


def test_residuals_that_all_windows_have_are_no_change_of_the_finger():
    wandering = np.random.default_rng(0).standard_normal((40, 60))
    lacking = np.random.default_rng(1).standard_normal(60)
    assert _residuals_vary(10.0 * wandering)
    assert not _residuals_vary(wandering + lacking)
    assert not _residuals_vary(wandering[:5])


def test_file_that_is_still_written_is_followed(short, tmp_path: Path):
    path, _ = short
    lines = path.read_bytes().splitlines(keepends=True)
    growing, seen = tmp_path / "growing.csv", []
    growing.write_bytes(b"".join(lines[:40_000]))

    def update(track: fitact.Track) -> None:
        seen.append(track.time[-1])
        if len(seen) == 1:
            with growing.open("ab") as file:
                file.write(b"".join(lines[40_000:]))

    update_soon = track_record.UPDATE_INTERVAL
    try:
        track_record.UPDATE_INTERVAL = 0.0
        track = fitact.track(growing, SCENE, follow=1.0, update=update)
    finally:
        track_record.UPDATE_INTERVAL = update_soon
    assert seen == sorted(seen)
    assert track.time[-1] > 0.9 > 0.8 > seen[0]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"window": 0.005}, "shorter than one and a half periods"),
        ({"window": 1e-4}, "at least 20 samples"),
        ({"scene": {"measurement": {"noise_model": "student"}}}, "state 'white' or 'ar1'"),
        ({"scene": {"skin": {"level": "fractional"}}}, "state 'constant'"),
    ],
)
def test_refusals(short, change, sentence):
    path, _ = short
    scene = fitact.Scene.from_dict(change.pop("scene", {}))
    with pytest.raises(fitact.InputError, match=sentence):
        fitact.track(path, scene, **change)


def test_refuses_a_record_without_v_or_with_another_rate(short, tmp_path: Path):
    _, record = short
    table = pandas.DataFrame({"time_s": record.time, "Vsc_V": record["Vsc"]})
    table.to_csv(tmp_path / "no_v.csv", index=False)
    with pytest.raises(fitact.InputError, match="V_V is missing"):
        fitact.track(tmp_path / "no_v.csv")
    time = np.where(np.arange(record.time.size) < 35_000, record.time, record.time[35_000] + 2.0 * (record.time - 0.7))
    changed = fitact.Record.from_arrays(time, **record.channels)
    with pytest.raises(fitact.InputError, match="time step changes"):
        fitact.track(changed, SCENE)


BENCH = """
scene = "scene.toml"
[truth.skin]
Rsc = "160 kohm"
Csc = "22 nF"
[truth.device]
Ci = "1.35 nF"
[truth.drive]
waveform = "trapezoid"
rise_time = "200 us"
frequency = "70 Hz"
phase = "30 deg"
[truth.measurement]
sampling_rate = "50 kHz"
duration = "3 s"
[change]
time = ["0 s", "3 s"]
area = [1.0, 1.15]
Rsc = [1.0, 0.8]
walk_area = 0.005
walk_Rsc = 0.01
walk_Csc = 0.005
[delay]
I = "6 us"
[white]
V = "0.1 V"
I = "20 nA"
[converter]
bits_V = 12
V = "409.6 V"
bits_I = 15
I = "8.192 mA"
"""


def test_v_and_i_of_a_bench_suffice(tmp_path: Path):
    """V is noisy and rounded, and I is late by a third of a step: neither dV/dt nor V at the samples is known."""
    (tmp_path / "scene.toml").write_text('[drive]\nwaveform = "measured"\n[measurement]\nchannels = ["I"]\n')
    (tmp_path / "bench.recipe.toml").write_text(BENCH)
    made = make(load(tmp_path / "bench.recipe.toml"))["bench"]
    given = made.truth["course"]
    course = Course(np.array(given["time_s"]), np.log([given[name] for name in ("Rsc", "Csc", "Ci")]))
    track = fitact.track(
        fitact.Record.from_arrays(made.time, **made.channels), fitact.Scene.load(tmp_path / "scene.toml")
    )
    found = errors(track, course)
    for name in ("Rsc", "Csc", "Ci", "g", "b"):
        assert np.mean(np.abs(found[name]) < 2.5) > 0.9, name
        assert np.nanmedian(track.u[name]) < 6e-3, name
    assert track.reliable.all()
    drive = {"waveform": "trapezoid", "rise_time": "200 us", "frequency": "70 Hz", "phase": "30 deg"}
    assert track.values["force_mean"][20] == pytest.approx(true_force(drive, course, track, 20), rel=1e-2)


@pytest.mark.slow  # 30 records of the model's own law
def test_bands_hold_what_they_state_for_random_walks():
    inside: dict[str, list[float]] = {}
    for seed in range(30):
        record, course = simulate(seed, 6.0, 200e3, walk_area=0.02, walk_Rsc=0.05, walk_Csc=0.01)
        for name, z in errors(fitact.track(record, SCENE), course).items():
            inside.setdefault(name, []).append(float(np.mean(np.abs(z) < 1.96)))
    for name, shares in inside.items():
        # times of a record are alike, so that the records tell the error of the mean
        margin = 2.0 * np.std(shares) / np.sqrt(len(shares))
        assert 0.93 - margin < np.mean(shares) < 0.97 + margin, name


@pytest.mark.slow  # 6 million samples, six times
def test_slides_of_thirty_seconds_are_within_their_bands():
    """Errors of g are alike along a record, in which it does not change; so that one record tells little."""
    change = {"time": (0.0, 30.0), "area": (1.0, 1.3), "Rsc": (1.0, 0.6), "lifted": (17.03, 17.6)}
    inside: dict[str, list[float]] = {}
    for seed in range(6):
        record, course = simulate(seed, 30.0, 200e3, **change)
        track = fitact.track(record, SCENE)
        for name, z in errors(track, course).items():
            inside.setdefault(name, []).append(float(np.mean(np.abs(z) < 1.96)))
        ((begin, end),) = track.lifted
        assert 0.0 <= 17.03 - begin <= track.window
        assert 0.0 <= end - 17.602 <= track.window
        # the rows of I hold the noise of V and kinks, too, which are estimated to some per cent
        assert track.noise["sigma"] == pytest.approx(0.1, rel=0.03)
        assert track.noise["sigma_I"] == pytest.approx(20e-9, rel=0.05)
    assert min(map(np.mean, inside.values())) >= 0.93, inside
