import jax
import numpy as np
import pytest

import fitact
from fitact.data.simulate import simulate
from tests.conftest import SQUARE, skin_voltage, square_record


def deviation(fit: fitact.Fit, name: str, truth: float) -> float:
    """Return the error in posterior standard deviations."""
    s = fit.derived()[name]
    return (s["q50"] - truth) / s["sd"]


def test_shipped_record_with_its_measured_drive(finger_fit: fitact.Fit, finger_truth: dict[str, float]):
    assert finger_fit.result == "successful"
    assert finger_fit.choice.name == "measured"
    for name in ("g", "b"):
        assert finger_fit.derived()[name]["q50"] == pytest.approx(finger_truth[name], rel=0.01)
        assert abs(deviation(finger_fit, name, finger_truth[name])) < 3.0
    for name, s in finger_fit.parameters().items():
        assert s["q025"] < (finger_truth | {"delay": 0.0})[name] < s["q975"]
    assert finger_fit.linear["offset"] == pytest.approx(0.08, abs=0.005)
    assert finger_fit.figures["chi2_reduced"] == pytest.approx(1.0, abs=0.1)


def test_verdict_on_vsc_alone(finger_fit: fitact.Fit):
    verdict = finger_fit.identifiability
    assert verdict.verdict == "prior-limited"
    np.testing.assert_allclose(list(verdict.blind_direction.values()), np.array([-1, 1, 1]) / np.sqrt(3.0), atol=1e-4)
    assert "contact area" in verdict.blind_name
    assert verdict.eigenvalues[0] < 1e-6
    assert min(verdict.eigenvalues[1:]) > 0.999
    assert verdict.force_from_prior > 0.99
    assert "current" in verdict.remedy


@pytest.mark.slow
def test_shipped_record_with_a_trapezoid_that_lacks_the_overshoot(finger_path, finger_truth):
    scene = fitact.Scene.from_dict({"drive": {"waveform": "trapezoid", "rise_time": "20 us"}})
    fit = fitact.fit(fitact.read(finger_path, scene), scene)
    for name in ("g", "b"):
        assert fit.derived()[name]["q50"] == pytest.approx(finger_truth[name], rel=0.01)


def test_errors_are_those_of_the_linear_theory(finger_fit: fitact.Fit):
    """scipy's least squares on the same record: a and b, with free offset, charge and delay, without a prior.

    The delay is within a step, so that V is a line from the sample before. fitact leaves out the six samples at each
    end, and shifts V without most of its noise of 0.4 V, whose slope acts as a part of a step here.
    """
    scipy_optimize = pytest.importorskip("scipy.optimize")
    record = finger_fit.record
    time, step = record.time - record.time[0], record.time_step

    def vsc(p: np.ndarray) -> np.ndarray:
        g, b, offset, charge, delay = p
        keep = np.exp(-step / b)
        gain = -np.expm1(-step / b) * b / step
        u = np.empty_like(time)
        u[0] = 0.0
        rise = np.diff(record["V"])
        for i, dv in enumerate(rise):
            u[i + 1] = keep * u[i] + gain * dv
        since = (1.0 - delay) * step
        u[1:] = u[:-1] * np.exp(-since / b) - np.expm1(-since / b) * b / step * rise
        return (g * u + offset + charge * np.exp(-time / b))[6:-6]

    start = [0.05, 4e-3, 0.1, -4.0, 0.01]
    found = scipy_optimize.least_squares(
        lambda p: vsc(p) - record["Vsc"][6:-6], start, x_scale=[0.05, 4e-3, 0.1, 1.0, 0.1], xtol=1e-12
    )
    sigma = np.sqrt(2.0 * found.cost / (time.size - 17))
    sd = sigma * np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    for i, name in enumerate(("g", "b")):
        s = finger_fit.derived()[name]
        assert s["q50"] == pytest.approx(found.x[i], abs=0.3 * sd[i])
        assert s["sd"] == pytest.approx(sd[i], rel=0.01)


@pytest.mark.parametrize(
    ("made", "freed"),
    [
        ({}, set()),
        pytest.param({"offset": 0.2}, {"offset"}, marks=pytest.mark.slow),
        pytest.param({"offset": 0.2, "drift": 2.0}, {"offset", "drift"}, marks=pytest.mark.slow),
        pytest.param({"delay_samples": 2}, {"delay"}, marks=pytest.mark.slow),
    ],
)
def test_nuisances_are_freed_by_evidence_and_leave_g_and_b_unbiased(
    made: dict[str, float], freed: set[str], square_fit: fitact.Fit
):
    fit = fitact.fit(square_record(**made), SQUARE) if made else square_fit
    assert set(fit.model()["freed"]) == freed
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0
    if "delay" in freed:
        assert fit.parameters()["delay"]["q50"] == pytest.approx(
            7.5e-6, abs=2.6e-6
        )  # the edge lies between two samples


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [50.0, 60.0])
def test_hum_of_the_mains_is_modelled(frequency: float):
    """Ignoring 1 V of hum in this record would bias g and b by many standard errors."""
    made = square_record(periods=5)
    hum = 1.0 * np.sin(2.0 * np.pi * frequency * made.time + 0.7)
    fit = fitact.fit(fitact.Record.from_arrays(made.time, V=made["V"], Vsc=made["Vsc"] + hum), SQUARE)
    name = f"hum_{frequency:.0f}Hz"
    assert set(fit.model()["freed"]) == {f"{name}_cos", f"{name}_sin"}
    assert np.hypot(fit.linear[f"{name}_cos"], fit.linear[f"{name}_sin"]) == pytest.approx(1.0, abs=0.01)
    assert fit.trusted
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0


@pytest.mark.slow
def test_gain_is_freed_only_with_its_prior():
    record = square_record()
    assert "gain" not in fitact.fit(record, SQUARE).names
    scene = fitact.Scene.from_dict({"drive": {"waveform": "square"}, "measurement": {"gain_relative_sd": 0.02}})
    fit = fitact.fit(record, scene)
    assert "gain" in fit.names
    s = fit.parameters()["gain"]
    assert s["sd"] == pytest.approx(0.02, rel=0.1)  # the gain is confounded with a, so the posterior is the prior
    assert "gain" in fit.identifiability.remedy


@pytest.mark.slow
def test_ideal_square_in_the_file_is_not_read_as_ramps():
    """The scene's square is used and V is checked against it; without a scene, there is a warning about the edges."""
    record = square_record()
    assert fitact.fit(record, fitact.Scene()).choice.name == "square"
    assert any("sampling interval" in warning for warning in fitact.fit(record).warnings)


def test_partial_scene_does_not_replace_a_recorded_drive(finger_path):
    scene = fitact.Scene.from_dict({"device": {"Ci": "1.4 nF"}})
    fit = fitact.fit(fitact.read(finger_path), scene)
    assert fit.choice.name == "measured"
    assert any("V_V" in note for note in fit.notes)


@pytest.mark.parametrize("waveform", ["square", pytest.param("triangle", marks=pytest.mark.slow)])
def test_record_that_starts_anywhere_without_V(waveform: str, tmp_path):
    record = square_record()
    scene = SQUARE
    if waveform == "triangle":
        scene = fitact.Scene.from_dict({"drive": {"waveform": "triangle"}})
        with jax.enable_x64(True):
            vsc = np.asarray(
                fitact.response(fitact.FinalCircuit(130e3, 18e-9, 1.35e-9), scene.make_drive(), record.time)
            )
        noise = 0.05 * np.random.default_rng(0).normal(size=vsc.size)
        record = fitact.Record.from_arrays(record.time, Vsc=vsc + noise)
    shifted = fitact.Record.from_arrays(record.time - 3.71e-3, Vsc=record["Vsc"])
    fit = fitact.fit(shifted, scene)
    assert fit.result == "successful"
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0
    assert any("shifted" in note for note in fit.notes)


def test_sine_of_unknown_phase_without_V_is_refused():
    scene = fitact.Scene.from_dict({"drive": {"waveform": "sine"}})
    time = np.arange(2000) * 1e-5
    record = fitact.Record.from_arrays(time, Vsc=9.0 * np.sin(2.0 * np.pi * 100.0 * time - 2.5))
    with pytest.raises(fitact.InputError, match="phase"):
        fitact.fit(record, scene)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda V, Vsc: (Vsc, V), "swapped"),
        (lambda V, Vsc: (V / 1e3, Vsc), "unit"),
        (lambda V, Vsc: (V, -Vsc), "polarity"),
    ],
)
def test_what_the_circuit_cannot_give_is_refused(finger_path, change, message: str):
    record = fitact.read(finger_path)
    V, Vsc = change(record["V"], record["Vsc"])
    with pytest.raises(fitact.InputError, match=message):
        fitact.fit(fitact.Record.from_arrays(record.time, V=V, Vsc=Vsc))


def test_implausible_values_are_remarked_upon(finger_path):
    record = fitact.read(finger_path)
    in_ms = fitact.Record.from_arrays(record.time * 1e3, V=record["V"], Vsc=record["Vsc"])
    assert any("time constant b" in warning for warning in fitact.fit(in_ms).warnings)
    in_mv = fitact.Record.from_arrays(record.time, V=record["V"], Vsc=record["Vsc"] * 1e-3)
    assert any("divider g" in warning for warning in fitact.fit(in_mv).warnings)


def misfits(record: fitact.Record) -> dict[str, fitact.Record]:
    time, V, Vsc = record.time, record["V"], record["Vsc"]
    lost = np.r_[0:1500, 1700:4000]  # samples that were lost together with their times
    return {
        "lost": fitact.Record.from_arrays(time[: lost.size], V=V[lost], Vsc=Vsc[lost]),
        "saturating": fitact.Record.from_arrays(time, V=V, Vsc=20.0 * np.tanh(Vsc / 20.0)),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lost", "saturating"])
def test_misfit_is_named(finger_path, name: str):
    fit = fitact.fit(misfits(fitact.read(finger_path))[name])
    assert fit.result == "misfit"
    assert not fit.trusted
    assert "Unreliable (misfit)" in str(fit)
    assert "Poor fit" in fit.message


@pytest.mark.slow
def test_short_record_is_answered_with_its_width_and_a_warning(finger_path, finger_truth):
    record = fitact.read(finger_path)
    short = slice(0, 400)  # a fifth of a period, with one edge
    fit = fitact.fit(fitact.Record.from_arrays(record.time[short], V=record["V"][short], Vsc=record["Vsc"][short]))
    assert any("1.5 periods" in warning for warning in fit.warnings)
    assert fit.derived()["b"]["sd"] > 3.0 * 1.4e-6  # the sd from the whole record
    assert abs(deviation(fit, "b", finger_truth["b"])) < 3.0


def test_unidentified_without_an_informative_prior(finger_path):
    wide = {"factor": 1000.0}
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Rsc": wide, "Csc": wide, "Ci": wide}})
    assert fitact.fit(fitact.read(finger_path), scene).identifiability.verdict == "unidentified"


@pytest.mark.parametrize("x64", [True, False])
def test_the_users_precision_is_left_alone_and_does_not_matter(finger_fit, x64: bool):
    before = jax.config.jax_enable_x64
    try:
        jax.config.update("jax_enable_x64", x64)
        fit = fitact.fit(finger_fit.record, finger_fit.scene)
        assert jax.config.jax_enable_x64 is x64
    finally:
        jax.config.update("jax_enable_x64", before)
    np.testing.assert_array_equal(fit.theta, finger_fit.theta)


def test_it_prints_errors_correlations_and_the_verdict(finger_fit: fitact.Fit):
    text = finger_fit.summary(verbose=True)
    for word in ("Rsc", "Csc", "Ci", "Correlations", "prior-limited", "contact area", "Residual variance"):
        assert word in text


def trapezoid_record(step: float, edge: float = 20e-6, noise: float = 0.05) -> fitact.Record:
    """Return a 100 Hz trapezoid, computed by scipy on a fine grid and sampled every `step`."""
    fine = np.arange(140_001) * 1e-6
    phase = (fine + 3.3e-6) % 0.01
    voltage = np.interp(phase, [0.0, edge, 5e-3, 5e-3 + edge, 0.01], [-180.0, 180.0, 180.0, -180.0, -180.0])
    vsc = skin_voltage(fine, voltage, 130e3, 18e-9, 1.35e-9)
    kept = slice(120_000, 140_000, round(step / 1e-6))
    noise_Vsc = noise * np.random.default_rng(1).standard_normal(fine[kept].size)
    return fitact.Record.from_arrays(fine[kept] - 0.12, V=voltage[kept], Vsc=vsc[kept] + noise_Vsc)


@pytest.mark.parametrize(
    "step",
    [
        pytest.param(5e-6, marks=pytest.mark.slow),
        pytest.param(50e-6, marks=pytest.mark.slow),
        pytest.param(100e-6, marks=pytest.mark.slow),
    ],
)
def test_edges_faster_than_the_samples_widen_g(step: float):
    """Linear interpolation of a jump puts its edge in the middle of a step, wherever it was."""
    fit = fitact.fit(trapezoid_record(step))
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("samples", [10, 20])
def test_coarse_samples_of_a_sine_tell_g_and_b(samples: int):
    """Between its samples V is a sinusoid, or cubics; with lines, which miss it, such fits were not trusted."""
    time = np.arange(5 * samples) * 0.01 / samples
    omega = 2.0 * np.pi * 100.0
    gain = 1j * omega * 130e3 * 1.35e-9 / (1.0 + 1j * omega * 130e3 * 20.7e-9)
    vsc = 180.0 * np.imag(gain * np.exp(1j * omega * time)) + 0.05 * np.random.default_rng(0).standard_normal(time.size)
    fit = fitact.fit(fitact.Record.from_arrays(time, V=180.0 * np.sin(omega * time), Vsc=vsc))
    assert fit.trusted
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0


@pytest.mark.parametrize(
    "noise",
    [0.0, *(pytest.param(noise, marks=pytest.mark.slow) for noise in (1e-8, 1e-6, 1e-4))],
)
def test_a_record_without_noise_is_not_called_identified(noise: float):
    fit = fitact.fit(square_record(noise=noise), SQUARE)
    assert fit.identifiability.verdict == "prior-limited"
    assert fit.identifiability.eigenvalues[0] < 1e-3
    assert np.all(np.isfinite(fit.sd))
    assert fit.sd[0] == pytest.approx(0.05, rel=0.01)


def test_coarse_converter(finger_path):
    """8 bits over 40 V: the noise is smaller than an ADC step."""
    record, step = square_record(noise=0.01), 40.0 / 256.0
    rounded = np.round(record["Vsc"] / step) * step
    fit = fitact.fit(fitact.Record.from_arrays(record.time, V=record["V"], Vsc=rounded), SQUARE)
    assert fit.result == "successful"
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 6.0  # rounding errors are not independent


@pytest.mark.parametrize(
    ("drive", "words"), [({"peak_to_peak": 180.0}, "2 times"), ({"frequency": 50.0}, "repeats at 100 Hz")]
)
def test_scene_that_contradicts_the_recorded_drive_is_refused(drive: dict[str, float], words: str):
    scene = fitact.Scene.from_dict({"drive": {"waveform": "square"} | drive})
    with pytest.raises(fitact.InputError, match=words):
        fitact.fit(square_record(), scene)


@pytest.mark.parametrize(
    "shift",
    [
        50e-6,
        -4.99e-3,
        *(pytest.param(shift, marks=pytest.mark.slow) for shift in (-50e-6, 2e-3)),
    ],
)
def test_any_shift_is_found(shift: float):
    record = square_record()
    shifted = fitact.Record.from_arrays(record.time + shift, V=record["V"], Vsc=record["Vsc"])
    fit = fitact.fit(shifted, SQUARE)
    assert fit.result == "successful"
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 2.5
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0


@pytest.mark.slow
def test_from_rest_with_what_was_recorded_before_the_trigger():
    """scipy starts from rest; the record begins half a period before the drive."""
    time = np.arange(-1000, 4000) * 5e-6
    voltage = np.where(time < 0.0, 0.0, np.where((time % 0.01) < 5e-3 - 1e-9, 180.0, -180.0))
    vsc = skin_voltage(time - time[0], voltage, 130e3, 18e-9, 1.35e-9, hold=True)
    vsc = vsc + 0.05 * np.random.default_rng(0).standard_normal(time.size)
    scene = fitact.Scene.from_dict({"drive": {"waveform": "square", "steady_state": False}})
    fit = fitact.fit(fitact.Record.from_arrays(time, V=voltage, Vsc=vsc), scene)
    assert fit.result == "successful"
    assert fit.choice.shift == 0.0
    assert not any("differs" in warning for warning in fit.warnings)
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0


@pytest.mark.slow
def test_a_huge_offset_changes_nothing(finger_path):
    """1 MV has steps of 0.1 nV in double precision, far below the noise."""
    record = fitact.read(finger_path)
    found, moved = (
        fitact.fit(fitact.Record.from_arrays(record.time, V=record["V"], Vsc=record["Vsc"] + offset))
        for offset in (0.0, 1e6)
    )
    assert moved.trusted
    for name in ("g", "b"):
        assert abs(deviation(moved, name, found.derived()[name]["q50"])) < 0.01
        assert moved.derived()[name]["sd"] == pytest.approx(found.derived()[name]["sd"], rel=1e-4)


@pytest.mark.slow
def test_an_offset_that_rounds_the_signal_tells_nothing(finger_path):
    """1e14 V has steps of 16 mV, and the sums over the samples hold no more than half of the digits."""
    record = fitact.read(finger_path)
    fit = fitact.fit(fitact.Record.from_arrays(record.time, V=record["V"], Vsc=record["Vsc"] + 1e14))
    assert fit.derived()["g"]["from_prior"] > 0.99


SWEEP = {"waveform": "chirp", "start_frequency": 20.0, "end_frequency": 500.0, "sweep_time": 0.05}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drive", "shift"), [({"waveform": "burst"}, 0.0), (SWEEP, 1.37e-3)], ids=["burst", "shifted chirp"]
)
def test_burst_and_chirp_against_scipy(drive: dict[str, object], shift: float):
    """scipy on a fine grid with constant (burst) or linear (chirp) interpolation, also with an earlier trigger."""
    fine = np.arange(70_000) * 1e-6
    cycles = 20.0 * fine + 480.0 / (2.0 * 0.05) * fine**2
    if drive is SWEEP:
        voltage = np.where(fine < 0.05, 180.0 * np.sin(2.0 * np.pi * cycles), 0.0)
    else:
        index = np.arange(fine.size)
        voltage = np.where(index < 50_000, np.where(index % 10_000 < 5_000, 180.0, -180.0), 0.0)
    vsc = skin_voltage(fine, voltage, 130e3, 18e-9, 1.35e-9, hold=drive is not SWEEP)[::20]
    vsc = vsc + 0.1 * np.random.default_rng(3).standard_normal(vsc.size)
    record = fitact.Record.from_arrays(fine[::20] + shift, V=voltage[::20], Vsc=vsc)
    fit = fitact.fit(record, fitact.Scene.from_dict({"drive": drive}))
    assert fit.result == "successful"
    assert fit.choice.shift == pytest.approx(shift, abs=20e-6)
    assert abs(deviation(fit, "g", 1.35 / 20.7)) < 4.0
    assert abs(deviation(fit, "b", 130e3 * 20.7e-9)) < 4.0


@pytest.mark.parametrize(
    ("off", "with_V"),
    [
        pytest.param(1e-3, True, marks=pytest.mark.slow),
        *(pytest.param(off, False, marks=pytest.mark.slow) for off in (1e-3, 1e-4, 0.0)),
    ],
)
def test_a_recorder_whose_clock_is_not_the_generators(off: float, with_V: bool):
    """A named sine at another frequency; an unnoticed difference of 0.1 % biases b by 3 standard errors."""
    time = np.arange(10_000) * 5e-6
    omega = 2.0 * np.pi * 100.0 * (1.0 + off)
    gain = 1j * omega * 130e3 * 1.35e-9 / (1.0 + 1j * omega * 130e3 * 20.7e-9)
    vsc = 180.0 * np.imag(gain * np.exp(1j * omega * time)) + 0.1 * np.random.default_rng(0).standard_normal(time.size)
    channels = {"V": 180.0 * np.sin(omega * time)} if with_V else {}
    fit = fitact.fit(
        fitact.Record.from_arrays(time, Vsc=vsc, **channels), fitact.Scene.from_dict({"drive": {"waveform": "sine"}})
    )
    assert fit.result == "successful"
    assert any("repeats at" in warning for warning in fit.warnings) == (off > 0.0)
    for name, truth in (("g", 1.35 / 20.7), ("b", 130e3 * 20.7e-9)):
        assert abs(deviation(fit, name, truth)) < 4.0


@pytest.mark.slow
def test_another_drive_and_prior_compile_nothing_anew(caplog: pytest.LogCaptureFixture):
    """Most of the time of a first fit is compilation, so numbers must not be constants of the compiled code."""

    def fitted(frequency: float, rise_time: float, Ci: float) -> fitact.Fit:
        drive = {"waveform": "trapezoid", "rise_time": rise_time, "frequency": frequency}
        scene = fitact.Scene.from_dict({"device": {"Ci": Ci}, "drive": drive})
        return fitact.fit(simulate(scene, seed=1), scene)

    fitted(97.0, 2e-4, 1.35e-9)  # neither frequency fits the sampling grid, to which periods would be folded
    caplog.clear()
    with jax.log_compiles():
        assert fitted(91.0, 3e-4, 2e-9).result == "successful"
    compiled = [record.getMessage() for record in caplog.records if record.getMessage().startswith("Compiling")]
    # the drive is evaluated once with numbers, before the fit
    assert [message.split()[1] for message in compiled if "_value" not in message] == []
