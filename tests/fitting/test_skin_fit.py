"""Fits of frequency-dependent skins on records that are sums of harmonics with explicit impedances."""

from collections.abc import Callable

import jax
import mpmath
import numpy as np
import pytest

import fitact
from fitact.data.simulate import simulate
from fitact.fitting.verdict import is_out_of_bounds
from fitact.model.skin import TimeConstantGrid
from fitact.model.steady import mean_square
from fitact.model_selection.fit_planned import fit_planned

R, C, CI, ALPHA = 130e3, 18e-9, 1.35e-9, 0.8
TRUTH = {"Rsc": R, "Csc": C, "Ci": CI, "alpha": ALPHA}
STEP, PERIOD, SAMPLES = 5e-6, 0.01, 4000
RISE, NOISE_V, NOISE_I = 20e-6, 0.05, 20e-9
TONES, HEIGHTS = (1, 3, 7, 20), (60.0, 50.0, 40.0, 30.0)
HIGHEST = 2**22  # number of harmonics: fewer are inaccurate for I next to an ideal jump
Impedance = Callable[[np.ndarray], np.ndarray]


def cole(alpha: float = ALPHA, R: float = R, C: float = C) -> Impedance:
    return lambda omega: R / (1.0 + (1j * omega * R * C) ** alpha)


def paper(omega: np.ndarray) -> np.ndarray:
    """Return the factors of section 3.1 on R and C, with power laws between 10, 100 and 1000 Hz."""
    log = np.log10(np.clip(omega / (2.0 * np.pi), 10.0, 1000.0))
    resistance = R * 10.0 ** np.interp(log, [1, 2, 3], np.log10([200 / 160, 1.0, 80 / 160]))
    capacitance = C * 10.0 ** np.interp(log, [1, 2, 3], np.log10([44.25 / 22, 1.0, 8.85 / 22]))
    return 1.0 / (1.0 / resistance + 1j * omega * capacitance)


def amplitudes(waveform: str, highest: int = HIGHEST) -> tuple[np.ndarray, np.ndarray]:
    """Return the orders and Fourier coefficients of the drive."""
    if waveform == "multitone":
        return np.array(TONES), -0.5j * np.array(HEIGHTS)
    k = np.arange(1, highest, 2)
    edge = 0.0 if waveform == "square" else RISE / PERIOD
    return k, 360.0 * np.sinc(k * edge) * np.exp(-1j * np.pi * k * edge) / (1j * np.pi * k)


def channels(waveform: str, impedance: Impedance, time: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return V, Vsc and I at the same phases in each period; the highest harmonics are tapered."""
    k, drive = amplitudes(waveform)
    omega, fade = 2.0 * np.pi * k / PERIOD, np.cos(0.5 * np.pi * np.clip(2.0 * k / HIGHEST - 1.0, 0.0, 1.0)) ** 2
    current = drive * fade / (1.0 / (1j * omega * CI) + 2.0 * impedance(omega))
    per_period = round(PERIOD / STEP)

    def summed(amplitude: np.ndarray) -> np.ndarray:
        folded = np.zeros(per_period, complex)  # harmonics that the samples alias
        np.add.at(folded, k % per_period, amplitude * np.exp(1j * omega * time[0]))
        return np.resize(2.0 * np.fft.ifft(folded).real * per_period, time.size)

    return summed(drive * fade), summed(current * impedance(omega)), summed(current)


def record(waveform: str, impedance: Impedance, seed: int = 0, noise: float = 1.0) -> fitact.Record:
    """Return two periods, sampled in the middle of steps, so that no sample lies at a corner."""
    time, rng = (np.arange(SAMPLES) + 0.5) * STEP, np.random.default_rng(seed)
    V, vsc, current = channels(waveform, impedance, time)
    return fitact.Record.from_arrays(
        time,
        V=V,
        Vsc=vsc + noise * NOISE_V * rng.standard_normal(SAMPLES),
        I=current + noise * NOISE_I * rng.standard_normal(SAMPLES),
    )


def scene(waveform: str, level: str = "fractional", *, seen: tuple[str, ...] = ("Vsc",), **sections: object):
    drive: dict[str, object] = {"waveform": waveform}
    if waveform == "multitone":
        drive |= {"frequencies": [100.0 * k for k in TONES], "amplitudes": list(HEIGHTS)}
    if waveform == "trapezoid":
        drive["rise_time"] = RISE
    free = {"alpha": {"low": 0.3, "high": 1.0}} if level == "fractional" else {}
    given = {"skin": {"level": level}, "drive": drive, "measurement": {"channels": seen}, "prior": free}
    return fitact.Scene.from_dict(given | sections)


def assert_recovers(fit: fitact.Fit, **truth: float) -> None:
    """Assert agreement within four standard deviations in every direction."""
    assert fit.result == "successful"
    error = fit.theta - np.log([truth[name] for name in fit.names])
    assert np.linalg.norm(np.linalg.solve(fit.covariance_root, error)) < 4.0 * np.sqrt(error.size)
    assert np.all(np.abs(error) < 4.0 * fit.sd)


@pytest.mark.parametrize("alpha", [1.0, 0.8, 0.5])
def test_a_grid_answers_a_step_as_the_laplace_transform_does(alpha: float):
    time = np.array([0.5, 3.3, 200.0, 3999.0]) * STEP

    def transform(s: mpmath.mpc) -> mpmath.mpc:
        skin = R / (1 + (s * R * C) ** alpha)
        return skin / (2 * skin + 1 / (s * CI)) / s

    expected = [float(mpmath.invertlaplace(transform, t, method="talbot", degree=40)) for t in time]
    with jax.enable_x64(True):
        grid = TimeConstantGrid.from_frequency_range(0.3 / (SAMPLES * STEP), 100.0 / STEP)
        circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), fitact.Fractional(alpha), grid)
        step = fitact.Polyline(np.array([0.0, 1.0]), np.array([1.0, 1.0]))
        ours = jax.jit(lambda: fitact.response(circuit, step, time, steady_state=False))()
    np.testing.assert_allclose(ours, expected, rtol=0.0, atol=1e-9 * max(expected))


@pytest.mark.parametrize("skin", [fitact.Fractional(ALPHA), fitact.Dispersive(), "grid"], ids=str)
def test_mean_square_is_parsevals(skin: fitact.Fractional | fitact.Dispersive | str):
    impedance = paper if isinstance(skin, fitact.Dispersive) else cole()
    k, drive = amplitudes("trapezoid", 2**20)
    omega = 2.0 * np.pi * k / PERIOD
    vsc = drive * impedance(omega) / (1.0 / (1j * omega * CI) + 2.0 * impedance(omega))
    with jax.enable_x64(True):
        grid = TimeConstantGrid.from_frequency_range(0.3 * omega[0], 100.0 / STEP) if skin == "grid" else None
        level = fitact.Fractional(ALPHA) if skin == "grid" else skin
        circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), level, grid)
        ours = jax.jit(lambda: mean_square(circuit, fitact.Trapezoid(360.0, 1.0 / PERIOD, RISE)))()
    np.testing.assert_allclose(ours, 2.0 * np.sum(np.abs(vsc) ** 2), rtol=1e-8)


@pytest.fixture(scope="module")
def trapezoid() -> fitact.Fit:
    return fitact.fit(record("trapezoid", cole()), scene("trapezoid"))


@pytest.mark.slow
def test_a_fractional_skin_is_found_with_its_exponent(trapezoid: fitact.Fit):
    assert_recovers(trapezoid, **TRUTH)
    assert trapezoid.names == ("Rsc", "Csc", "Ci", "alpha")
    found = trapezoid.parameters()["alpha"]
    assert found["unit"] == "1"
    assert found["contraction"] > 0.99
    assert trapezoid.model()["skin"] == "fractional"
    # Vsc does not depend on the area, nor does the exponent
    direction = trapezoid.identifiability.blind_direction
    assert trapezoid.identifiability.structural
    np.testing.assert_allclose(list(direction.values()), np.array([-1.0, 1.0, 1.0, 0.0]) / np.sqrt(3.0), atol=1e-3)
    assert trapezoid.identifiability.eigenvalues[1] > 0.999


@pytest.mark.slow
def test_its_compressed_likelihood_is_the_sum_over_the_samples(trapezoid: fitact.Fit):
    assert trapezoid.compression_error < 1e-5  # inner products hold half the digits of a sum
    assert trapezoid.model()["likelihood"] == "compressed"


def force_of(impedance: Impedance, values: dict[str, float]) -> tuple[float, float]:
    """Return the mean and peak force by eq. (22), with permittivities from eq. (3) for 1 cm^2, 1 um and 200 um."""
    k, drive = amplitudes("trapezoid", 2**22)  # at a corner, the error is inversely proportional to their number
    omega, eps0, area, Ti, Tsc = 2.0 * np.pi * k / PERIOD, 8.85e-12, 1e-4, 1e-6, 200e-6
    vsc = drive * impedance(omega) / (1.0 / (1j * omega * values["Ci"]) + 2.0 * impedance(omega))
    layers = eps0 * area * (1.0 / values["Ci"] + 1.0 / values["Csc"])  # Ti / eps_i + Tsc / eps_sc
    constant = eps0 * area / (2.0 * layers * (Ti + Tsc))
    highest = 2.0 * np.sum((vsc * np.exp(1j * omega * RISE)).real)  # at the end of the rise
    return constant * 2.0 * float(np.sum(np.abs(vsc) ** 2)), constant * highest**2


@pytest.mark.slow
def test_the_force_is_that_of_the_harmonics(trapezoid: fitact.Fit):
    values = dict(zip(trapezoid.names, np.exp(trapezoid.theta), strict=True))
    mean, peak = force_of(cole(values["alpha"], values["Rsc"], values["Csc"]), values)
    derived = trapezoid.derived()
    assert derived["force_mean"]["q50"] == pytest.approx(mean, rel=1e-6)
    assert derived["force_peak"]["q50"] == pytest.approx(peak, rel=1e-4)


@pytest.mark.slow
def test_an_exponent_just_beyond_one_is_noise(trapezoid: fitact.Fit):
    root, sigma = trapezoid.covariance_root, np.array([trapezoid.sigma])

    def out(standard_errors: float) -> bool:
        theta = trapezoid.theta.copy()
        theta[3] = standard_errors * trapezoid.sd[3]
        with jax.enable_x64(True):
            return is_out_of_bounds(trapezoid.likelihood, theta, sigma, root)

    assert [out(x) for x in (-1.0, 2.0, 6.0)] == [False, False, True]


@pytest.mark.slow
def test_sampling_ends_where_the_fit_is(trapezoid: fitact.Fit):
    posterior = fitact.sample(trapezoid, seed=1, progress=False)
    assert posterior.trusted
    drawn = posterior.parameters()["alpha"]
    assert abs(drawn.mean() / np.exp(trapezoid.theta[3]) - 1.0) < 0.1 * trapezoid.sd[3]
    assert drawn.std() / drawn.mean() == pytest.approx(trapezoid.sd[3], rel=0.05)
    assert posterior.summary()["model"]["skin"] == "fractional"


@pytest.mark.slow
def test_summed_samples_give_the_same_fit(trapezoid: fitact.Fit):
    summed = fitact.fit(trapezoid.record, trapezoid.scene, tolerance=0.0)
    assert np.all(np.abs(summed.theta - trapezoid.theta) < 1e-3 * trapezoid.sd)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("waveform", "seen"),
    [
        ("multitone", ("I",)),
        *(
            pytest.param(waveform, seen, marks=pytest.mark.slow)
            for waveform, seen in [
                ("multitone", ("Vsc",)),
                ("multitone", ("Vsc", "I")),
                ("trapezoid", ("I",)),
                ("trapezoid", ("Vsc", "I")),
                ("square", ("Vsc", "I")),
                ("square", ("Vsc",)),
                ("square", ("I",)),
            ]
        ),
    ],
)
def test_recovery(waveform: str, seen: tuple[str, ...]):
    fit = fitact.fit(record(waveform, cole()), scene(waveform, seen=seen))
    assert_recovers(fit, **TRUTH)
    assert fit.compression_error is not None
    if "I" in seen:
        assert fit.identifiability.verdict == "identified"


@pytest.mark.slow
@pytest.mark.parametrize(("waveform", "seen"), [("trapezoid", ("Vsc",)), ("multitone", ("Vsc", "I"))])
def test_recovery_of_the_papers_dispersion(waveform: str, seen: tuple[str, ...]):
    fit = fitact.fit(record(waveform, paper), scene(waveform, "dispersive", seen=seen))
    assert_recovers(fit, **TRUTH)
    assert fit.model()["skin"] == "dispersive"
    assert fit.full_because == ""
    if waveform == "trapezoid":
        values = dict(zip(fit.names, np.exp(fit.theta), strict=True))
        ratio_R, ratio_C = values["Rsc"] / R, values["Csc"] / C

        def impedance(omega: np.ndarray) -> np.ndarray:
            admittance = 1.0 / paper(omega)
            return 1.0 / (admittance.real / ratio_R + 1j * admittance.imag * ratio_C)

        mean, peak = force_of(impedance, values)
        assert fit.derived()["force_mean"]["q50"] == pytest.approx(mean, rel=1e-6)
        assert fit.derived()["force_peak"]["q50"] == pytest.approx(peak, rel=1e-4)


@pytest.mark.slow
def test_an_exponent_of_one_is_the_constant_skin():
    made = record("trapezoid", cole(1.0))
    constant = fitact.fit(made, scene("trapezoid", "constant"))
    held = fitact.fit(made, scene("trapezoid", skin={"level": "fractional", "alpha": 1.0}, prior={}))
    np.testing.assert_allclose(held.theta, constant.theta, rtol=1e-9)
    np.testing.assert_allclose(held.sd, constant.sd, rtol=1e-6)
    for name in ("g", "b", "force_mean", "force_peak"):
        assert held.derived()[name]["q50"] == pytest.approx(constant.derived()[name]["q50"], rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_constant_skin_has_an_exponent_of_one(seed: int):
    assert_recovers(fitact.fit(record("trapezoid", cole(1.0), seed), scene("trapezoid")), **TRUTH | {"alpha": 1.0})


@pytest.mark.slow
def test_a_constant_skin_does_not_describe_a_fractional_one(trapezoid: fitact.Fit):
    fit = fitact.fit(trapezoid.record, scene("trapezoid", "constant"))
    assert not fit.trusted
    assert fit.figures["chi2_reduced"] > 100.0


@pytest.mark.slow
@pytest.mark.parametrize("steady", [True, False], ids=["steady", "from rest"])
def test_a_measured_drive(steady: bool):
    """The waveform begins after so long a pause that the earlier charge has decayed."""
    time = (np.arange(SAMPLES) + 0.5) * STEP
    rng = np.random.default_rng(0)
    on, whole = time.size, time.size * (1 if steady else 256)
    phase = np.mod(time - time[0], PERIOD)  # V begins at 0 from rest
    wave = np.interp(phase, [0.0, 4 * STEP, PERIOD / 2, PERIOD / 2 + 4 * STEP, PERIOD], [-180, 180, 180, -180, -180])
    voltage = np.concatenate([wave if steady else wave + 180.0, np.zeros(whole - on)])
    # linear between samples: the spectrum of the samples times that of a triangle, over all its aliases
    k = np.fft.fftfreq(whole, 1.0 / whole)
    aliases = k[:, None] + whole * np.arange(-64, 65)
    omega = 2.0 * np.pi * aliases / (whole * STEP)
    impedance = cole()(np.where(omega == 0.0, 1.0, np.abs(omega)))
    gain = impedance / (2.0 * impedance + 1.0 / (1j * np.where(omega == 0.0, 1e-9, np.abs(omega)) * CI))
    gain = np.where(omega < 0.0, np.conj(gain), gain) * (omega != 0.0)
    spectrum = np.fft.fft(voltage) * np.sum(np.sinc(aliases / whole) ** 2 * gain, axis=1)
    vsc = np.fft.ifft(spectrum).real[:on] + NOISE_V * rng.standard_normal(on)
    drive = {"waveform": "measured", "steady_state": steady}
    made = fitact.Record.from_arrays(time, V=voltage[:on], Vsc=vsc)
    fit = fitact.fit(made, scene("measured", drive=drive))
    assert_recovers(fit, **TRUTH)
    assert fit.compression_error is not None


@pytest.mark.slow
def test_a_plan_that_leaves_dispersion_out_fits_a_constant_skin():
    held = {"skin": {"level": "fractional", "alpha": 0.99995}, "prior": {}, "tolerance": {"force": 0.002}}
    stated = scene("trapezoid", **held)
    found = fit_planned([simulate(stated, seed=1)], [stated], "planned")
    assert "dispersion" in found.plan.left_out
    assert found.fit.scene.skin.level == "constant"
    held |= {"skin": {"level": "fractional", "alpha": ALPHA}, "tolerance": {"force": 0.99}}
    strongly = scene("trapezoid", **held)
    found = fit_planned([record("trapezoid", cole())], [strongly], "planned")
    assert "dispersion" in found.plan.left_out
    assert found.model == "full"
    assert_recovers(found.fit, **TRUTH)
    freed = fitact.plan(scene("trapezoid", **held | {"prior": {"alpha": {"low": 0.9, "high": 1.0}}}))
    assert "dispersion" not in freed.left_out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"skin": {"level": "constant"}, "prior": {"alpha": {"low": 0.3, "high": 1.0}}}, "level = 'fractional'"),
        ({"prior": {"alpha": {"low": 0.3, "high": 1.2}}}, "at most 1"),
        ({"prior": {"alpha": {"factor": 1.2}}}, "at most 1"),
        ({"prior": {"alpha": {"fixed": 1.1}}}, "at most 1"),
    ],
)
def test_beliefs_that_no_exponent_can_have(given: dict[str, object], message: str):
    with pytest.raises(fitact.InputError, match=message):
        fitact.Scene.from_dict({"skin": {"level": "fractional"}} | given)


def test_drives_that_such_a_skin_cannot_be_fitted_with():
    made = record("trapezoid", cole())
    for level, remedy in [("dispersive", "level = 'fractional'"), ("fractional", "steady_state = true")]:
        with pytest.raises(fitact.InputError, match=remedy):
            fitact.fit(made, scene("measured", level))
    with pytest.raises(fitact.InputError, match="steady_state = false"):
        fitact.fit(made, scene("trapezoid", "dispersive", drive={"steady_state": False}))
    with pytest.raises(fitact.InputError, match="constant"):
        fitact.measure_tradeoff(made, scene("trapezoid"))
