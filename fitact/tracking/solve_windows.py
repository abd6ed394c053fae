"""Windows joined by random walks: linearised, filtered and smoothed until nothing changes, and made a track."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fitact.compiled import double_precision
from fitact.data.clipping import clipping_mask, describe_clipping
from fitact.fitting.effects import is_change_of_finger
from fitact.fitting.identifiability import information_directions, verdicts
from fitact.fitting.remarks import outlier_warnings
from fitact.fitting.verdict import misfit_warnings
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.model.skin import circuit_parameters
from fitact.tracking.compressed_windows import CompressedWindows, WindowModel
from fitact.tracking.random_walk import SmoothedWalk, WindowInformation, WindowTimes, find_jumps, smooth
from fitact.tracking.time_average import TimeAverage, average_windows
from fitact.tracking.track import Track
from fitact.tracking.walk_rates import WalkRates, estimate_rates, walk_matrix
from fitact.tracking.window_likelihood import QUANTITIES, Linearization, evaluate_quantities, linearize


def solve_windows(
    model: WindowModel, windows: CompressedWindows, *, rates: Sequence[float] | None = None, max_rounds: int = 10
) -> Track:
    """Join windows by random walks; `rates` (per root of a second, as in `WALKS`) replaces their estimates."""
    fitted, likelihood = model.fit, model.likelihood.without_samples()
    names = likelihood.names
    walking = tuple(name for name in names if name in FINGER_PARAMETERS)
    order = [names.index(name) for name in (*walking, *(name for name in names if name not in walking))]
    factor = likelihood.prior_factor[order]
    mean = np.append(likelihood.prior.log_mean, likelihood.timing_mean)[order]
    prior = mean, factor @ factor.T
    length = float(model.compressor.time[-1] + model.compressor.time[1])
    sigma = np.array(fitted.laplace.sigmas)
    theta = np.tile(fitted.theta, (windows.start.size, 1))
    back = np.argsort(order)
    jumps = np.zeros(windows.start.size, bool)
    walk: SmoothedWalk | None = None
    fixed = None if rates is None else np.asarray(rates, dtype=float)
    found = None if fixed is None else WalkRates(*walk_matrix(walking), fixed, fixed, fixed)
    with double_precision():
        theta, windows = _fit_alone(likelihood, windows, theta, sigma, prior, order)
        change = np.zeros((windows.start.size, 3))
        for round_number in range(max_rounds):
            information, linear, _ = _linear_information(likelihood, windows, theta, sigma, order, change)
            sigma = sigma * np.sqrt(_noise_ratio(windows, linear.squares))
            if round_number == 0:
                jumps = find_jumps(information, windows.has_data, windows.contact, walk_matrix(walking)[1])
            timing = _window_times(windows, length, jumps)
            if found is None or (rates is None and round_number < 2):
                found = estimate_rates(information, timing, prior, walking)
            before = walk
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
        quantities = evaluate_quantities(fitted.derive.geometry, likelihood, windows.data, middle, sigma)
    covariance = walk.covariance[:, back][:, :, back]
    average = _average(likelihood, windows, information, walk, order, prior, length)
    follows = is_change_of_finger(fitted.effects) or _residuals_vary(linear.residuals[windows.has_data])
    return _make_track(model, windows, (middle, covariance), quantities, sigma, found, jumps, length, average, follows)


def _average(
    likelihood: Likelihood,
    windows: CompressedWindows,
    information: WindowInformation,
    walk: SmoothedWalk,
    order: list[int],
    prior: tuple[np.ndarray, np.ndarray],
    length: float,
) -> TimeAverage | None:
    """Return the averages over time without the prior of the finger and the walk."""
    used, names = windows.has_data, [likelihood.names[i] for i in order]
    kept = {*circuit_parameters(likelihood.template), *likelihood.timing}
    errors = [name for name in names if name not in kept]
    span = float(np.ptp(windows.start[used])) + length
    return average_windows(information, used, names, prior, errors, walk.average[used].mean(axis=0), span)


def _window_times(windows: CompressedWindows, length: float, jumps: Bool[np.ndarray, " windows"]) -> WindowTimes:
    """Return lengths, gaps, and where the walk may jump: at `jumps`, and when the finger touches again."""
    jump_variance = 0.5**2  # of the logarithms
    touched = windows.contact & ~np.append(True, windows.contact[:-1])
    gaps = np.maximum(np.diff(windows.start, prepend=windows.start[0] - length) - length, 0.0)
    gaps = np.where(gaps > 1e-6 * length, gaps, 0.0)
    lengths = np.full(windows.start.size, length)
    return WindowTimes(lengths, gaps, jump_variance * (jumps | touched))


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
        information, linear, finite = _linear_information(likelihood, windows, theta, sigma, order, still)
        factor = np.concatenate([information.factor, np.tile(root, (len(theta), 1, 1))], axis=1)
        target = np.concatenate([information.target, np.tile(root @ prior[0], (len(theta), 1))], axis=1)
        solved = np.einsum("kij,kj->ki", np.linalg.pinv(factor), target)[:, back]
        step = np.clip(solved - theta, -1.0, 1.0)
        theta = np.where((windows.has_data & finite)[:, None], theta + step, theta)
    ratio = linear.squares / _counts(windows)
    usual = np.median(ratio[windows.has_data], axis=0)
    tau, table = np.asarray(likelihood.time_constants(theta)), windows.data.compressions[0]
    tau = tau[: len(tau) - table.short - likelihood.channels[0].electrical.lags]  # those of the table
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
    """Return the rates of log(Ci), log(Csc) and log(Rsc), 1/s, within each stretch between lift-offs and jumps."""
    absent = np.zeros(len(theta))
    logs = [theta[:, names.index(name)] if name in names else absent for name in ("Ci", "Csc", "Rsc")]
    values, rates = np.stack(logs, axis=1), np.zeros((len(theta), 3))
    ends = np.flatnonzero(jumps | (windows.contact != np.append(windows.contact[:1], windows.contact[:-1])))
    for stretch in np.split(np.arange(len(theta)), ends):
        if len(stretch) > 1 and windows.contact[stretch[0]]:
            rates[stretch] = np.gradient(values[stretch], windows.start[stretch], axis=0)
    return rates


def _counts(windows: CompressedWindows) -> Float[np.ndarray, "windows channels"]:
    return np.stack([np.asarray(each.samples) for each in windows.data.compressions], axis=1)


def _linear_information(
    likelihood: Likelihood,
    windows: CompressedWindows,
    theta: np.ndarray,
    sigma: np.ndarray,
    order: list[int],
    change: Float[np.ndarray, "windows rates"],
) -> tuple[WindowInformation, Linearization, Bool[np.ndarray, " windows"]]:
    """Return the information of each window in square-root form, what it comes from, and whether all is finite."""
    linear = linearize(likelihood, windows.data, theta, sigma, change)
    finite = np.isfinite(linear.residuals).all(axis=1) & np.isfinite(linear.jacobian).all(axis=(1, 2))
    used = windows.has_data & finite
    jacobian = np.where(used[:, None, None], linear.jacobian, 0.0)
    target = np.einsum("kij,kj->ki", jacobian, theta) - np.where(used[:, None], linear.residuals, 0.0)
    size = theta.shape[1]
    rows: Any = np.linalg.qr(np.concatenate([jacobian[:, :, order], target[:, :, None]], axis=2), mode="r")
    information = WindowInformation(rows[:, :size, :size], rows[:, :size, size] * used[:, None])
    return information, linear, finite


def _residuals_vary(residuals: Float[np.ndarray, "windows rows"], max_common: float = 0.1, fewest: int = 8) -> bool:
    """Return whether windows have little of their residuals in common, as of a finger that wanders within each.

    What the model lacks for a constant finger is in all windows. `max_common` is the largest fraction of the residuals'
    power in their mean, beyond that of residuals that are independent.
    """
    if len(residuals) < fewest:
        return False
    power = float(np.sum(np.mean(np.square(residuals), axis=0)))
    common = float(np.sum(np.square(np.mean(residuals, axis=0)))) / power if power > 0.0 else 1.0
    return common - 1.0 / len(residuals) < max_common


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
    average: TimeAverage | None,
    follows: bool,
) -> Track:
    fitted, likelihood, scene = model.fit, model.likelihood, model.fit.scene
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
    effects = {**found.structure, **({} if follows else found.effect_size)}
    geometry = fitted.geometry_contributions()

    def add(name: str, log: np.ndarray, spread: np.ndarray, shown: np.ndarray) -> None:
        others = [each.relative_sd * each.sensitivity for each in geometry.get(name, ()) if name not in names]
        whole = np.sqrt(np.square(spread) + sum(x**2 for x in (*others, effects.get(name, 0.0))))
        values[name], u[name] = np.where(shown, np.exp(log), np.nan), np.where(shown, whole, np.nan)
        alone[name] = np.where(shown, spread, np.nan)

    for name in FINGER_PARAMETERS:
        if name in names:
            add(name, theta[:, names.index(name)], sd[:, names.index(name)], contact)
    for i, name in enumerate(QUANTITIES):
        shown = contact & windows.has_data & ~windows.clipped if name == "force_mean" else contact
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
    # of one window: what all have is said instead, and a change looks like outliers
    idle = misfit_warnings(fitted.traces) if follows else []
    for each in fitted.traces:
        clipped = clipping_mask(fitted.record[each.channel])
        idle += [*outlier_warnings(each.channel, each.figures), describe_clipping(each.channel, clipped)]
    warnings = [text for text in fitted.warnings if text not in idle]
    if count := int(np.count_nonzero(windows.clipped & windows.has_data)):
        warnings.append(
            f"clipped samples are excluded from {count:,} of {time.size:,} windows, which have no mean force; record"
            " with a wider range"
        )
    noise = dict(zip(likelihood.sigma_names, map(float, sigma), strict=True))
    return Track(
        time, values, u, alone, contact, reliable, verdicts(shares, along),
        tuple(map(float, time[jumps] - 0.5 * length)), rates, length, fitted, constants, noise, average, follows,
        tuple(warnings), tuple(dict.fromkeys(notes)),
    )  # fmt: skip
