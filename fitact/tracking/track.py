"""Tracks: parameters, contact area and force as functions of time along a long record."""

import dataclasses
import functools
import math
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from fitact import summary
from fitact.errors import InputError
from fitact.files import atomic_write
from fitact.fitting.fit import Fit
from fitact.fitting.identifiability import information_directions, verdicts
from fitact.fitting.verdict import misfit_warnings
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.tables import align_table, join_lines
from fitact.tracking.compressed_windows import CompressedWindows, WindowModel
from fitact.tracking.random_walk import SmoothedWalk, Timing, WindowInformation, find_jumps, smooth
from fitact.tracking.walk_rates import WalkRates, estimate_rates, walk_matrix
from fitact.tracking.window_likelihood import QUANTITIES, evaluate_quantities, linearize
from fitact.uncertainty.rivals import CHANGE
from fitact.units import format_percent, quantity_unit

NEW_CONTACT_VARIANCE = 0.5**2  # of the logarithms, where the finger touches again or a jump is found


@dataclasses.dataclass(frozen=True)
class Track:
    """Values over time, one for each window of a record.

    Attributes:
        time: middles of the windows, s.
        values: medians by name, SI: Rsc, Csc, Ci, g, b, force_mean (over the window), contact_area.
        u: relative standard uncertainties of `values`, combined.
        sd: the same from the record and the prior alone, without geometry and effects of what the model lacks.
        contact: whether the finger is in contact with the panel during the whole window; without, values are NaN.
        reliable: whether the window has data of its own; values of others are bridged from their neighbours.
        verdict: of identifiability at each time, as for a fit.
        jumps: times before which values changed at once, s.
        rates: of the random walks that join the windows.
        window: length of a window, s.
        fit: the fit to one window, which gave the model.
        constants: what does not change, by name: (median, relative standard uncertainty).
        noise: sd of each channel's noise, V or A.
    """

    time: Float[np.ndarray, " windows"]
    values: dict[str, Float[np.ndarray, " windows"]]
    u: dict[str, Float[np.ndarray, " windows"]]
    sd: dict[str, Float[np.ndarray, " windows"]]
    contact: Bool[np.ndarray, " windows"]
    reliable: Bool[np.ndarray, " windows"]
    verdict: np.ndarray
    jumps: tuple[float, ...]
    rates: WalkRates
    window: float
    fit: Fit
    constants: dict[str, tuple[float, float]]
    noise: dict[str, float]
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether the model fits, beside changes of the finger, and some windows are reliable."""
        return (self.fit.trusted or follows_structure(self.fit)) and bool(np.any(self.reliable))

    def to_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write a row for each window as Parquet; needs `pip install 'fitact[campaign]'`.

        Raises:
            InputError: the path cannot be written, or pyarrow is not installed.
        """
        try:
            import pyarrow as pa
            import pyarrow.parquet as pq
        except ImportError as error:
            raise InputError(f"{path}: Parquet needs pyarrow; pip install 'fitact[campaign]'") from error
        with atomic_write(path) as temporary:
            pq.write_table(pa.table(self.to_columns()), temporary)

    def to_columns(self) -> dict[str, np.ndarray]:
        """Return the columns of track.parquet."""
        columns = {"time_s": self.time}
        for name, values in self.values.items():
            columns |= {name: values, f"{name}_u": self.u[name], f"{name}_sd": self.sd[name]}
        return columns | {"reliable": self.reliable, "contact": self.contact, "verdict": self.verdict}

    @functools.cached_property
    def within_finger(self) -> dict[str, dict[str, float]]:
        """Variation during the record, by quantity: sd of its logarithm, and the time over which it is alike (s)."""
        return {name: _variation(self.time, self.values[name], self.u[name], self.reliable) for name in self.values}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        rates = {
            name: {"log_sd_per_root_s": float(r), "lower": float(low), "upper": float(high)}
            for name, r, low, high in zip(
                self.rates.names, self.rates.rate, self.rates.lower, self.rates.upper, strict=True
            )
        }
        return {
            "within_finger": self.within_finger,
            "rates": rates,
            "windows": {
                "length_s": self.window,
                "count": self.time.size,
                "reliable": int(np.count_nonzero(self.reliable)),
                "contact": int(np.count_nonzero(self.contact)),
            },
            "start": self._state(0),
            "end": self._state(-1),
            "constants": {name: {"median": value, "u": u} for name, (value, u) in self.constants.items()},
            "noise": self.noise,
            "jumps_s": list(self.jumps),
            "lifted_s": [list(pair) for pair in self.lifted],
            "fit": {"result": self.fit.result, "model": self.fit.model()},
            "identifiability": self.fit.identifiability.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    def _state(self, place: int) -> dict[str, Any]:
        """Return the values at the first or last reliable time."""
        chosen = np.flatnonzero(self.reliable)
        if not chosen.size:
            return {}
        k = chosen[place]
        values = {name: {"median": float(v[k]), "u": float(self.u[name][k])} for name, v in self.values.items()}
        return {"time_s": float(self.time[k]), **values, "verdict": str(self.verdict[k])}

    @property
    def lifted(self) -> list[tuple[float, float]]:
        """Stretches without contact, from the end of the last whole window with contact to the start of the next, s."""
        edges = np.flatnonzero(np.diff(np.concatenate([[True], self.contact, [True]]).astype(int)))
        half = 0.5 * self.window
        return [(float(self.time[a] - half), float(self.time[b - 1] + half)) for a, b in edges.reshape(-1, 2)]

    def describe_last(self) -> str:
        """Return a line on the last reliable window."""
        state = self._state(-1)
        if not state:
            return "no window with contact yet"
        cells = [
            f"{name} {summary.format_engineering(state[name]['median'], quantity_unit(name))}"
            f" ± {format_percent(state[name]['u'])}"
            for name in self.values
        ]
        return f"{state['time_s']:.4g} s: {', '.join(cells)}" + ("" if self.contact[-1] else "; no contact now")

    def __str__(self) -> str:
        first, last = self._state(0), self._state(-1)
        rows = [["", "at the start", "at the end", "variation"]]
        for name in self.values:
            if not first:
                break
            unit, within = quantity_unit(name), self.within_finger[name]
            cells = [
                f"{summary.format_engineering(each[name]['median'], unit)} ± {format_percent(each[name]['u'])}"
                for each in (first, last)
            ]
            rows.append([name, *cells, format_percent(within["log_sd"]) if math.isfinite(within["log_sd"]) else ""])
        parts = align_table(rows) if first else []
        for name, rate, low, high in zip(
            self.rates.names, self.rates.rate, self.rates.lower, self.rates.upper, strict=True
        ):
            parts.append(
                f"{name.replace('_', ' ')} walks by {format_percent(float(rate))} in 1 s"
                f" (95 %: {format_percent(float(low))} to {format_percent(float(high))})"
            )
        for begin, end in self.lifted:
            parts.append(f"no contact from {begin:.4g} s to {end:.4g} s")
        for jump in self.jumps:
            parts.append(f"a jump at {jump:.4g} s")
        parts.append(str(self.fit.identifiability))
        return join_lines(parts, self.warnings, self.notes)


def solve_windows(
    model: WindowModel, windows: CompressedWindows, *, rates: Sequence[float] | None = None, max_rounds: int = 10
) -> tuple[Track, SmoothedWalk]:
    """Join windows by random walks; `rates` (per root of a second, as in `WALKS`) replaces their estimates."""
    fitted, likelihood = model.fit, model.fit.likelihood.without_samples()
    names = likelihood.names
    walking = tuple(name for name in names if name in FINGER_PARAMETERS)
    order = [names.index(name) for name in (*walking, *(name for name in names if name not in walking))]
    factor = likelihood.prior_factor[order]
    mean = np.append(likelihood.prior.log_mean, np.zeros(len(likelihood.timing)))[order]
    prior = mean, factor @ factor.T
    length = float(model.compressor.time[-1] + model.compressor.time[1])
    sigma = np.array(fitted.laplace.sigmas)
    theta = np.tile(fitted.theta, (windows.start.size, 1))
    back = np.argsort(order)
    timing = _timing(windows, length, np.zeros(windows.start.size, bool))
    jumps = np.zeros(windows.start.size, bool)
    walk: SmoothedWalk | None = None
    found: WalkRates | None = None
    with jax.enable_x64(True):
        theta, windows = _fit_alone(likelihood, windows, theta, sigma, prior, order)
        change = np.zeros((windows.start.size, 3))
        for round_number in range(max_rounds):
            information, squares, _ = _linear_information(likelihood, windows, theta, sigma, order, change)
            sigma = sigma * np.sqrt(_noise_ratio(windows, squares))
            if round_number == 0:
                jumps = find_jumps(information, windows.has_data, windows.contact, walk_matrix(walking)[1])
                timing = _timing(windows, length, jumps)
            if rates is not None:
                fixed = np.asarray(rates, dtype=float)
                found = WalkRates(*walk_matrix(walking), fixed, fixed, fixed)
            elif round_number < 2:
                found = estimate_rates(information, timing, prior, walking)
            before = walk
            assert found is not None
            walk = smooth(information, timing, found.covariance, prior)
            theta = walk.average[:, back]
            change = _change_rates(windows, theta, names, jumps)
            if round_number > 1 and before is not None:
                sd = np.sqrt(np.maximum(np.diagonal(walk.covariance, axis1=1, axis2=2), 1e-300))
                if np.max(np.abs(walk.average - before.average) / sd) < 0.005:
                    break
        assert walk is not None
        assert found is not None
        middle = walk.middle[:, back]
        quantities = evaluate_quantities(fitted.derive, likelihood, windows.compressions, middle, sigma)
    covariance = walk.covariance[:, back][:, :, back]
    return _make_track(model, windows, (middle, covariance), quantities, sigma, found, jumps, length), walk


def _timing(windows: CompressedWindows, length: float, jumps: Bool[np.ndarray, " windows"]) -> Timing:
    """Return lengths, gaps, and where the walk may jump: at `jumps`, and when the finger touches again."""
    touched = windows.contact & ~np.append(True, windows.contact[:-1])
    gaps = np.maximum(np.diff(windows.start, prepend=windows.start[0] - length) - length, 0.0)
    gaps = np.where(gaps > 1e-6 * length, gaps, 0.0)
    lengths = np.full(windows.start.size, length)
    return Timing(lengths, gaps, NEW_CONTACT_VARIANCE * (jumps | touched))


def _fit_alone(
    likelihood: Likelihood,
    windows: CompressedWindows,
    theta: np.ndarray,
    sigma: np.ndarray,
    prior: tuple[np.ndarray, np.ndarray],
    order: list[int],
    rounds: int = 5,
    max_ratio: float = 4.0,
) -> tuple[np.ndarray, CompressedWindows]:
    """Fit each window by itself; one whose residuals are far larger than usual has no usable data.

    So is a window in which contact was made or lost, or samples were lost.
    """
    root = np.linalg.cholesky(np.linalg.inv(prior[1])).T
    back, still = np.argsort(order), np.zeros((len(theta), 3))
    for _ in range(rounds):
        information, squares, finite = _linear_information(likelihood, windows, theta, sigma, order, still)
        factor = np.concatenate([information.factor, np.tile(root, (len(theta), 1, 1))], axis=1)
        target = np.concatenate([information.target, np.tile(root @ prior[0], (len(theta), 1))], axis=1)
        solved = np.einsum("kij,kj->ki", np.linalg.pinv(factor), target)[:, back]
        step = np.clip(solved - theta, -1.0, 1.0)
        theta = np.where((windows.has_data & finite)[:, None], theta + step, theta)
    ratio = squares / _counts(windows)
    usual = np.median(ratio[windows.has_data], axis=0)
    tau, table = likelihood.time_constants(theta), windows.compressions[0]
    covered = np.all(np.abs(np.log(tau) - table.center) <= table.half_width, axis=0)
    fits = np.all(ratio < max_ratio * usual, axis=1) & finite & covered
    kept = windows.has_data & fits
    theta = np.where(kept[:, None], theta, np.median(theta[kept], axis=0))
    # beside a window without contact, contact was made or lost within the window
    lifted = ~windows.contact
    beside = np.append(lifted[1:], False) | np.append(False, lifted[:-1])
    return theta, dataclasses.replace(windows, has_data=kept, contact=windows.contact & (kept | ~beside))


def _change_rates(
    windows: CompressedWindows, theta: np.ndarray, names: Sequence[str], jumps: Bool[np.ndarray, " windows"]
) -> Float[np.ndarray, "windows rates"]:
    """Return the rates of log(Ci), log(Csc) and log(Rsc), 1/s, from window to window; 0 beside lift-offs and jumps."""
    broken = ~windows.contact | jumps
    beside = broken | np.append(broken[1:], False) | np.append(False, broken[:-1])
    rates = [
        np.gradient(theta[:, names.index(name)], windows.start)
        if name in names and len(theta) > 1
        else np.zeros(len(theta))
        for name in ("Ci", "Csc", "Rsc")
    ]
    return np.where(beside[:, None], 0.0, np.stack(rates, axis=1))


def _counts(windows: CompressedWindows) -> Float[np.ndarray, "windows channels"]:
    return np.stack([np.asarray(each.samples) for each in windows.compressions], axis=1)


def _linear_information(
    likelihood: Likelihood,
    windows: CompressedWindows,
    theta: np.ndarray,
    sigma: np.ndarray,
    order: list[int],
    change: Float[np.ndarray, "windows rates"],
) -> tuple[WindowInformation, np.ndarray, Bool[np.ndarray, " windows"]]:
    """Return the information of each window in square-root form, squares of residuals, and whether all is finite."""
    linear = linearize(likelihood, windows.compressions, theta, sigma, windows.drive, change)
    finite = np.isfinite(linear.residuals).all(axis=1) & np.isfinite(linear.jacobian).all(axis=(1, 2))
    used = windows.has_data & finite
    jacobian = np.where(used[:, None, None], linear.jacobian, 0.0)
    target = np.einsum("kij,kj->ki", jacobian, theta) - np.where(used[:, None], linear.residuals, 0.0)
    size = theta.shape[1]
    rows: Any = np.linalg.qr(np.concatenate([jacobian[:, :, order], target[:, :, None]], axis=2), mode="r")
    information = WindowInformation(rows[:, :size, :size], rows[:, :size, size] * used[:, None])
    return information, linear.squares, finite


def _noise_ratio(windows: CompressedWindows, squares: np.ndarray) -> Float[np.ndarray, " channels"]:
    """Return the mean variance of the residuals over that of the noise so far, for each channel."""
    return np.mean((squares / _counts(windows))[windows.has_data], axis=0)


def _make_track(
    model: WindowModel,
    windows: CompressedWindows,
    state: tuple[np.ndarray, np.ndarray],
    quantities: tuple[np.ndarray, np.ndarray],
    sigma: np.ndarray,
    rates: WalkRates,
    jumps: np.ndarray,
    length: float,
) -> Track:
    fitted, likelihood, scene = model.fit, model.fit.likelihood, model.fit.scene
    theta, covariance = state
    names, contact = likelihood.names, windows.contact
    time = windows.start + 0.5 * length
    logs, gradients = quantities
    variance = np.einsum("kqi,kij,kqj->kq", gradients, covariance, gradients)
    values: dict[str, np.ndarray] = {}
    u: dict[str, np.ndarray] = {}
    alone: dict[str, np.ndarray] = {}
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    found = fitted.effects
    effects = {**found.structure, **({} if follows_structure(fitted) else found.effect_size)}
    geometry = fitted.geometry_contributions()

    b = np.exp(logs[:, QUANTITIES.index("b")])
    trend = _trend_uncertainty(b, windows.has_data, time, length / model.parts)

    def add(name: str, log: np.ndarray, spread: np.ndarray, shown: np.ndarray) -> None:
        others = [each.relative_sd * each.sensitivity for each in geometry.get(name, ()) if name not in names]
        spread = np.hypot(spread, trend)
        whole = np.sqrt(np.square(spread) + sum(x**2 for x in (*others, effects.get(name, 0.0))))
        values[name], u[name] = np.where(shown, np.exp(log), np.nan), np.where(shown, whole, np.nan)
        alone[name] = np.where(shown, spread, np.nan)

    for name in FINGER_PARAMETERS:
        if name in names:
            add(name, theta[:, names.index(name)], sd[:, names.index(name)], contact)
    for i, name in enumerate(QUANTITIES):
        shown = contact & windows.has_data if name == "force_mean" else contact
        add(name, logs[:, i], np.sqrt(np.maximum(variance[:, i], 0.0)), shown)
    if "Ci" in names:
        i, area = names.index("Ci"), float(scene.device.contact_area)
        nominal = math.log(area) - math.log(float(scene.nominal_values()["Ci"] or 1.0))
        add("contact_area", theta[:, i] + nominal, sd[:, i], contact)
    free = [name for name in FINGER_PARAMETERS if name in names]
    roots = np.linalg.cholesky(covariance + 1e-30 * np.eye(len(names)))
    shares, _, along = information_directions(names, roots, likelihood.prior_factor, free)
    constants = {
        name: (float(np.exp(theta[-1, i])), float(sd[-1, i]))
        for i, name in enumerate(names)
        if name not in FINGER_PARAMETERS and name not in likelihood.timing
    }
    reliable = windows.has_data
    notes = list(fitted.notes)
    lost = int(np.count_nonzero(contact & ~reliable))
    if lost:
        notes.append(f"{lost:,} of {time.size:,} windows have no data of their own; their values are bridged")
    idle = misfit_warnings(fitted.traces) if follows_structure(fitted) else []
    warnings = [each for each in fitted.warnings if each not in idle]
    noise = dict(zip(likelihood.sigma_names, map(float, sigma), strict=True))
    return Track(
        time, values, u, alone, contact, reliable, verdicts(shares, along),
        tuple(map(float, time[jumps] - 0.5 * length)), rates, length, fitted, constants, noise, tuple(warnings),
        tuple(dict.fromkeys(notes)),
    )  # fmt: skip


def _trend_uncertainty(
    b: Float[np.ndarray, " windows"], used: Bool[np.ndarray, " windows"], time: np.ndarray, period: float
) -> float:
    """Return the relative error that a trend of b leaves in a window: its change over a period of the drive.

    Lags of charges are corrected for. What remains is that different samples of a period determine different
    combinations of the values, which then belong to times that differ by a part of a period.
    """
    if np.count_nonzero(used) < 3:
        return 0.0
    return float(period * abs(np.polyfit(time[used], np.log(b[used]), 1)[0]))


def follows_structure(fitted: Fit, min_part: float = 0.5) -> bool:
    """Return whether a track follows what the residuals of the fitted window show: a finger that changes within it.

    That is where such a change explains at least `min_part` as much as the best cause.
    """
    rivals = fitted.effects.rivals
    changes = (each["delta_chi2"] for each in rivals if each["name"].startswith(CHANGE))
    return any(change >= min_part * rivals[0]["delta_chi2"] for change in changes)


def _variation(time: np.ndarray, values: np.ndarray, u: np.ndarray, reliable: np.ndarray) -> dict[str, float]:
    """Return sd of the logarithm over the reliable times, and the lag (s) at which its autocorrelation falls to 1/e."""
    used = reliable & np.isfinite(values)
    if np.count_nonzero(used) < 3:
        return {"log_sd": math.nan, "time_scale_s": math.nan}
    logs = np.log(values[used])
    log_sd = float(np.std(logs, ddof=1))
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[used][0], time[used][-1] + 0.5 * step, step)
    centered = np.interp(grid, time[used], logs - logs.mean())
    size = 2 ** math.ceil(math.log2(2 * centered.size))
    spectrum = np.abs(np.fft.rfft(centered, size)) ** 2
    correlation = np.fft.irfft(spectrum)[: centered.size]
    below = np.flatnonzero(correlation < correlation[0] / math.e)
    return {"log_sd": log_sd, "time_scale_s": float(step * below[0]) if below.size else float(grid[-1] - grid[0])}
