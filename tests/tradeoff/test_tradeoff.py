"""The trade-off: the Pareto front by brute force, errors against scipy and normal distributions, labels of the plot."""

import itertools
import json
import math

import jax
import matplotlib.text
import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg

import fitact
from fitact.charts.figure import write_figure
from fitact.report.tradeoff import draw_tradeoff
from fitact.tradeoff import timings, tradeoff
from fitact.tradeoff.tradeoff import BenchmarkedMethod, Tradeoff, dominators
from tests.conftest import skin_voltage, square_record

PAIRS = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12)


@given(PAIRS)
def test_front_is_that_of_the_definition(pairs: list[tuple[int, int]]):
    def dominates(a: tuple[int, int], b: tuple[int, int]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    found = dominators(*(list(map(float, column)) for column in zip(*pairs, strict=True)))
    for pair, by in zip(pairs, found, strict=True):
        assert (by is None) == (not any(dominates(other, pair) for other in pairs))
        if by is not None:
            assert dominates(pairs[by], pair)
            assert found[by] is None  # the dominating method is itself on the front
            rivals = [other for other in pairs if dominates(other, pair)]
            assert pairs[by][0] == min(cost for cost, _ in rivals)


def test_an_error_that_is_no_number_is_on_no_front():
    assert dominators([1.0, 2.0, 3.0], [1e-3, math.inf, 0.0]) == [None, 0, None]


def test_differences_are_in_standard_deviations_of_the_reference():
    """Normal samples shifted by 0.5 sd and widened by 1.2: quantiles move by 0.5 + 0.2 z."""
    z = np.random.default_rng(0).standard_normal(200_001)
    off = timings.posterior_discrepancies({"Rsc": 3.0 + 2.0 * (0.5 + 1.2 * z)}, {"Rsc": 3.0 + 2.0 * z})
    expected = {"mean": 0.5, "sd": 0.2, "q05": 0.5 - 0.2 * 1.644854, "q50": 0.5, "q95": 0.5 + 0.2 * 1.644854}
    assert off == pytest.approx({f"Rsc {name}": value for name, value in expected.items()}, abs=5e-3)


@pytest.fixture(scope="module")
def record() -> fitact.Record:
    return square_record()


@pytest.fixture(scope="module")
def fit(record: fitact.Record) -> fitact.Fit:
    return fitact.fit(record, fitact.Scene.load("paper"))


@pytest.fixture(scope="module")
def responses(fit: fitact.Fit) -> dict[str, timings.BenchmarkResult]:
    with jax.enable_x64(True):
        return {level.name: level for level in timings.benchmark_responses(fit)}


@pytest.mark.slow
def test_errors_of_responses_against_scipy(fit: fitact.Fit, responses: dict[str, timings.BenchmarkResult]):
    assert responses["exact"].error == 0.0
    assert 1e-8 < responses["float32"].error < 1e-5
    values = fit.likelihood.to_physical(fit.theta)
    circuit = [float(values[name]) for name in ("Rsc", "Csc", "Ci")]

    per_period = 2000
    time = np.arange(14 * per_period) * 5e-6
    voltage = np.where(np.arange(time.size) % per_period < per_period // 2, 180.0, -180.0)
    last = slice(12 * per_period, None)
    exact, ramps = (skin_voltage(time, voltage, *circuit, hold=hold)[last] for hold in (True, False))
    # linear between samples, except before the first, which follows an ideal edge
    error = np.sqrt(np.mean((ramps - exact)[per_period // 2 :] ** 2)) / np.sqrt(np.mean(exact**2))
    assert responses["recurrence"].error == pytest.approx(error, rel=0.2)
    assert responses["ODE (scipy)"].error == pytest.approx(responses["recurrence"].error, rel=0.05)

    order = np.arange(1, 200_001, 2)  # odd harmonics of a square, by Parseval
    R, C, Ci = circuit
    gain = scipy.signal.freqs([R * Ci, 0.0], [R * (2.0 * Ci + C), 1.0], 200.0 * np.pi * order)[1]
    power = np.abs(gain / order) ** 2
    for n in (10, 100):
        left_out = math.sqrt(power[order > n].sum() / power.sum())
        assert responses[f"harmonic({n})"].error == pytest.approx(left_out, rel=0.05)


@pytest.mark.slow
def test_costs_of_responses_are_told(responses: dict[str, timings.BenchmarkResult]):
    assert all(level.seconds > 0.0 for level in responses.values())
    assert responses["ODE (scipy)"].gradient_seconds is None
    for name in ("exact", "float32", "recurrence", "harmonic(10)"):
        assert responses[name].gradient_seconds > 0.0
        assert responses[name].compile_seconds > 0.0
        assert responses[name].memory >= 4000 * (4 if name == "float32" else 8)  # memory of the result alone
    assert responses["harmonic(1000)"].seconds > 5.0 * responses["harmonic(10)"].seconds


def some(kind: str, points: list[tuple[float, float]]) -> list[BenchmarkedMethod]:
    by = dominators(*map(list, zip(*points, strict=True)))
    names = [f"a level of {kind} {i}" for i in range(len(points))]
    return [
        BenchmarkedMethod(
            name,
            error,
            cost,
            details={"cold_seconds": 5.0 + cost} if kind == "answer" else {},
            kind=kind,
            ratio=cost / points[0][0],
            dominated_by="" if j is None else names[j],
        )
        for name, (cost, error), j in zip(names, points, by, strict=True)
    ]


@pytest.fixture
def made_up() -> Tradeoff:
    rng = np.random.default_rng(1)
    close = [(float(c), float(e)) for c, e in np.exp(rng.normal(size=(7, 2)))]
    found = [
        *some("answer", [(0.1, 1e-4), (0.5, 1e-3), (1.0, 3e-4)]),
        *some("response", [(1.0, 0.0), *close]),
        *some("likelihood", [(1e-3, 0.0), (1e-6, 1e-9), (1.1e-6, 1.1e-9), (1e-6, 1e-3)]),
        *some("uncertainty", [(1.0, 0.01)]),
    ]
    return Tradeoff(tuple(found), "a record", 0.02, True, tradeoff.describe_machine(), ("A sentence.",))


def test_labels_do_not_overlap(made_up: Tradeoff):
    figure = draw_tradeoff(made_up)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    for axes in figure.axes:
        names = [text for text in axes.texts if text.get_text() != "0"]
        assert all(isinstance(text, matplotlib.text.Annotation) for text in names)
        boxes = [matplotlib.text.Text.get_window_extent(text, renderer) for text in names]  # without the leaders
        assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 for box in boxes)
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    assert sum(len(axes.texts) - 1 for axes in figure.axes) == len(made_up.levels)


def test_it_is_written_and_says_who_dominates(made_up: Tradeoff, tmp_path):
    write_figure(tmp_path / "tradeoff.svg", lambda: draw_tradeoff(made_up))
    assert (tmp_path / "tradeoff.svg").read_text().startswith("<?xml")
    text = str(made_up)
    for level in made_up.levels:
        row = next(line for line in text.splitlines() if line.startswith(level.name + " "))
        assert row.endswith(f"dominated by {level.dominated_by}") == bool(level.dominated_by)
    for kind in ("answer", "response", "likelihood", "uncertainty"):
        front = made_up.front(kind)
        assert front
        assert not any(level.dominated_by for level in front)
    content = json.loads(json.dumps(made_up.to_dict()))
    assert len(content["levels"]) == len(made_up.levels)
    assert {"cpu", "cores", "python", "jax", "platform"} <= set(content["machine"])


def test_without_vsc_there_is_nothing_to_compare():
    scene = fitact.Scene.from_dict({"measurement": {"channels": ["I"]}, "grounding": {"R_H": 500.0}})
    with pytest.raises(fitact.InputError, match="channels"):
        fitact.measure_tradeoff(scene=scene)


@pytest.mark.slow
def test_whole(record: fitact.Record, capsys: pytest.CaptureFixture[str]):
    found = fitact.measure_tradeoff(record, fitact.Scene.load("paper"), tolerances=(1e-1, 1e-3), runs=1)
    assert found.trusted
    for kind, reference in {"response": "exact", "likelihood": "full", "uncertainty": "emcee, full"}.items():
        first, *others = found.methods(kind)
        assert (first.name, first.error, first.ratio) == (reference, 0.0, 1.0)
        assert all(level.error > 0.0 and level.ratio == level.seconds / first.seconds for level in others)
        assert found.front(kind)[0].seconds == min(level.seconds for level in found.methods(kind))
    for level in found.methods("likelihood")[1:]:
        assert level.error < 1e-1
        assert level.seconds < 0.2 * found.methods("likelihood")[0].seconds
    answers = {level.name: level for level in found.methods("answer")}
    assert list(answers) == ["least squares", "laplace", "psis", "emcee"]
    for level in answers.values():
        assert level.error < 5e-3  # a tenth of the force's standard deviation of 5 %
        # a new process imports and compiles
        assert level.details["cold_seconds"] == pytest.approx(level.seconds + level.compile_seconds)
        assert level.compile_seconds > 1.0
    assert all(level.seconds > answers["least squares"].seconds for level in found.methods("answer")[1:])
    assert all(level.error < 0.1 for level in found.methods("uncertainty"))  # the posterior is nearly normal
    out = capsys.readouterr()
    assert out.out == ""
    assert "tradeoff: posterior methods, round 2 of 2" in out.err
