"""How far draws can be trusted: autocorrelation, agreement of ensembles, stuck walkers, importance weights.

Autocorrelation time and R-hat are those of emcee and ArviZ, written out for all walkers at once: the look at a chain
of 1,500 steps takes 2.6 and 1.4 times as long by theirs, and R-hat in a batch of short chains up to 3 times.
"""

import dataclasses
from typing import NamedTuple

import emcee
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float, Int
from scipy.special import ndtri

from fitact.units import format_percent


@dataclasses.dataclass(frozen=True)
class Criteria:
    """When draws count as converged; see `fitact.sample`."""

    autocorrelation_times: float = 50.0  # that each ensemble is long, at least
    rhat: float = 1.01  # what split-R-hat stays below
    stuck_steps: int = 100  # in one place; above this and the next a walker is stuck
    stuck_autocorrelation_times: float = 10.0
    k_hat: float = 0.7  # above it importance weights have no mean worth the name (Vehtari et al. 2024)
    laplace_error: float = 0.1  # standard deviations that a Laplace approximation may be off by, in mean or sd
    forbidden: float = 0.01  # share of its draws that the prior may forbid


CRITERIA = Criteria()


@dataclasses.dataclass(frozen=True)
class Convergence:
    """How far the draws of a level of uncertainty can be trusted; see `fitact.sample`."""

    level: str = "emcee"  # "emcee", "psis" or "laplace"
    converged: bool = False  # whether its own certificate holds
    seconds: float = 0.0  # that sampling took, resumed parts included
    ess_min: float = 0.0  # effective number of draws, for the mean of every coordinate, of g, b and the mean force
    ess: dict[str, float] = dataclasses.field(default_factory=dict)
    tau_max: float = float("nan")  # autocorrelation times of the same, in steps
    tau: dict[str, float] = dataclasses.field(default_factory=dict)
    rhat_max: float = float("nan")  # largest split-R-hat over the ensembles
    acceptance: float = float("nan")  # share of the moves
    burn: int = 0  # of each ensemble
    steps: int = 0
    walkers: int = 0
    ensembles: int = 0
    stuck_walkers: tuple[str, ...] = ()  # those that stayed in one place although others moved on
    interrupted: bool = False
    k_hat: float = float("nan")  # Pareto's shape of the importance weights' tail
    # by importance weights, what a Laplace approximation is off by in the mean, in sds, and in the sd, as a share
    shift: dict[str, float] = dataclasses.field(default_factory=dict)
    widening: dict[str, float] = dataclasses.field(default_factory=dict)
    forbidden: float = 0.0  # share of a Laplace approximation's draws that the prior forbids

    @property
    def progress(self) -> float:
        """Share of the steps that its autocorrelation time asks for."""
        goal = CRITERIA.autocorrelation_times * self.tau_max
        return min((self.steps - self.burn) / goal, 1.0) if goal > 0.0 else 0.0

    @property
    def warning(self) -> str:
        """What stands against the draws, as a sentence; "": nothing."""
        if self.converged:
            return ""
        if self.level != "emcee":
            return f"{self}; sample with level emcee"
        if self.interrupted:
            return "sampling was interrupted before it had converged; run the same command again to go on"
        stuck = f"; stuck: {', '.join(self.stuck_walkers)}" if self.stuck_walkers else ""
        return f"the chain has not converged; allow more steps ({self}{stuck})"

    def __str__(self) -> str:
        if self.level == "emcee":
            verdict = "converged" if self.converged else "interrupted" if self.interrupted else "NOT converged"
            return (
                f"{verdict}: {self.ensembles} ensembles of {self.walkers} walkers, {self.steps} steps ({self.burn} of"
                f" them burn-in), autocorrelation time {self.tau_max:.2f}, effective draws {self.ess_min:,.0f},"
                f" split-R-hat {self.rhat_max:.4f}, accepted {100.0 * self.acceptance:.0f} %"
            )
        limit = CRITERIA.k_hat
        refused = f"; above {limit} the weights cannot be relied on" if not self.k_hat <= limit else ""
        weights = f"Pareto k-hat {self.k_hat:.2f}{refused}"
        if self.level == "psis":
            verdict = "certified" if self.converged else "REFUSED"
            return f"{verdict}: importance-weighted draws of the fit, {weights}, effective draws {self.ess_min:,.0f}"
        verdict = "Laplace approximation" if self.converged else "REFUSED: Laplace approximation"
        shifted, widened = (max(errors, key=lambda name: abs(errors[name])) for errors in (self.shift, self.widening))
        return (
            f"{verdict}, by importance weights ({weights}) off by {abs(self.shift[shifted]):.2g} sd in the mean"
            f" ({shifted}) and {format_percent(abs(self.widening[widened]))} in the sd ({widened}) at most;"
            f" the prior forbids {format_percent(self.forbidden)} of its draws"
        )


def diagnose_chain(
    names: tuple[str, ...],
    points: Float[np.ndarray, "ensembles steps walkers n"],
    accepted: Int[np.ndarray, "ensembles walkers"],
    derived: dict[str, Float[np.ndarray, "ensembles steps followed"]],
    rhat_draws: int = 4000,
    criteria: Criteria = CRITERIA,
) -> Convergence:
    """Return autocorrelation times, effective sizes and split-R-hat of ensembles, and of `derived` for some walkers.

    R-hat is that of `rhat_draws` draws of each ensemble.
    """
    ensembles, steps, walkers, _ = points.shape
    if steps < 100:  # of which nothing can be said
        return Convergence(steps=steps, walkers=walkers, ensembles=ensembles)
    quantities = {name: points[..., i] for i, name in enumerate(names)} | derived
    tau = {name: _autocorrelation_time(values[:, steps // 5 :]) for name, values in quantities.items()}
    tau_max = max(tau.values())
    burn = int(min(np.ceil(5.0 * tau_max), steps // 2))
    rhat = max(_split_rhat(values[:, burn:], rhat_draws) for values in quantities.values())
    patience = max(criteria.stuck_steps, criteria.stuck_autocorrelation_times * float(np.median(list(tau.values()))))
    stuck = _stuck_walkers(points[:, burn:], patience)
    long_enough = steps - burn > criteria.autocorrelation_times * tau_max
    count = ensembles * (steps - burn) * walkers
    return Convergence(
        converged=bool(long_enough and rhat < criteria.rhat and not stuck),
        ess_min=count / tau_max,
        ess={name: count / value for name, value in tau.items()},
        tau_max=tau_max,
        tau=tau,
        rhat_max=rhat,
        acceptance=float(np.mean(accepted) / steps),
        burn=burn,
        steps=steps,
        walkers=walkers,
        ensembles=ensembles,
        stuck_walkers=stuck,
    )


def _autocorrelation_time(values: Float[np.ndarray, "ensembles steps walkers"]) -> float:
    """Return the mean over ensembles, each of the walkers that move; the length where none does."""
    moving = (ensemble[:, np.ptp(ensemble, axis=0) > 0.0] for ensemble in values)
    return float(np.mean([integrated_time(walkers) if walkers.size else values.shape[1] for walkers in moving]))


def integrated_time(values: Float[np.ndarray, "steps walkers"]) -> float:
    """The autocorrelation time in steps, as `emcee.autocorr` finds it, but of all walkers in one transform."""
    series = (values - values.mean(axis=0)).T
    spectrum = np.fft.rfft(series, n=2 * len(values))
    correlation = np.fft.irfft(np.square(np.abs(spectrum)), n=2 * len(values))[:, : len(values)]
    taus = 2.0 * np.cumsum(np.mean(correlation / correlation[:, :1], axis=0)) - 1.0
    return float(taus[emcee.autocorr.auto_window(taus, 5.0)])  # Sokal's window: so many autocorrelation times


def _split_rhat(values: Float[np.ndarray, "ensembles steps walkers"], rhat_draws: int) -> float:
    """Rank-normalised split-R-hat (Vehtari et al. 2021); of long ensembles, of steps evenly apart."""
    draws = values[:, :: max(1, values[0].size // rhat_draws)].reshape(len(values), -1)
    halves = draws[:, : draws.shape[1] // 2 * 2].reshape(2 * len(draws), -1)
    return max(_normal_score_rhat(halves), _normal_score_rhat(np.abs(halves - np.median(halves))))


def _normal_score_rhat(draws: Float[np.ndarray, "chains draws"]) -> float:
    rank = np.empty(draws.size)
    rank[np.argsort(draws, axis=None, kind="stable")] = np.arange(1, draws.size + 1)
    scores = ndtri((rank - 0.375) / (draws.size + 0.25)).reshape(draws.shape)
    between, within = np.var(scores.mean(axis=1), ddof=1), np.mean(np.var(scores, axis=1, ddof=1))
    return float(np.sqrt(between / within + 1.0 - 1.0 / draws.shape[1]))


def _stuck_walkers(points: Float[np.ndarray, "ensembles steps walkers n"], patience: float) -> tuple[str, ...]:
    """Name the walkers that stayed in one place for more than `patience` steps."""
    moved = np.any(points[:, 1:] != points[:, :-1], axis=-1)
    step = np.arange(moved.shape[1])[:, None]
    last = np.maximum.accumulate(np.where(moved, step, -1), axis=1)
    longest = np.max(step - last, axis=1, initial=0)
    return tuple(f"walker {walker} of ensemble {ensemble}" for ensemble, walker in np.argwhere(longest > patience))


class ImportanceWeights(NamedTuple):
    """Pareto-smoothed importance weights."""

    weights: Float[np.ndarray, " draws"]  # their sum is 1
    k_hat: float  # inf where too few draws have any weight

    def mean_sd(self, values: Float[np.ndarray, " some"]) -> tuple[float, float]:
        """Weighted mean and standard deviation; of the first draws, where `values` are fewer."""
        weights = self._first_weights(values.size)
        mean = float(weights @ values)
        return mean, float(np.sqrt(weights @ (values - mean) ** 2))

    def effective_size(self, values: Float[np.ndarray, " some"]) -> float:
        """Effective number of all draws for the mean of `values`, by the first draws where those are fewer."""
        weights = self._first_weights(values.size)
        from_mean = (values - weights @ values) ** 2
        return float(weights @ from_mean / (weights**2 @ from_mean)) * self.weights.size / values.size

    def _first_weights(self, count: int) -> Float[np.ndarray, " some"]:
        return self.weights[:count] / self.weights[:count].sum()


def pareto_smooth(log_weights: Float[np.ndarray, " draws"]) -> ImportanceWeights:
    """Smooth weights by Pareto's law (Vehtari et al. 2024), with ArviZ."""
    possible = np.isfinite(log_weights)
    count = np.count_nonzero(possible)
    if count <= 3.0 * np.sqrt(log_weights.size):  # so many draws has the tail that is fitted
        return ImportanceWeights(possible / max(count, 1), float("inf"))
    values, k_hat = array_stats.psislw(-log_weights)
    weights = np.exp(values - np.max(values))
    return ImportanceWeights(weights / weights.sum(), float(k_hat))


def diagnose_weights(
    level: str,
    importance: ImportanceWeights,
    quantities: dict[str, np.ndarray],
    n_resampled: int,
    criteria: Criteria = CRITERIA,
) -> Convergence:
    """Return effective sizes of `n_resampled` draws that stand for weighted ones; for Laplace, what it is off by."""
    shift, widening = {}, {}
    if level == "psis":  # resampled draws carry the variance of both
        effective = {name: importance.effective_size(values) for name, values in quantities.items()}
        ess = {name: 1.0 / (1.0 / size + 1.0 / n_resampled) for name, size in effective.items()}
    else:
        ess = dict.fromkeys(quantities, float(n_resampled))
        corrected = {name: importance.mean_sd(values) for name, values in quantities.items()}
        shift = {name: (float(np.mean(quantities[name])) - mean) / sd for name, (mean, sd) in corrected.items()}
        widening = {name: float(np.std(quantities[name])) / sd - 1.0 for name, (_, sd) in corrected.items()}
    off = max(map(abs, (*shift.values(), *widening.values())), default=0.0)
    forbidden = float(np.mean(importance.weights == 0.0)) if level == "laplace" else 0.0
    accurate = off <= criteria.laplace_error and forbidden <= criteria.forbidden
    return Convergence(
        level=level,
        converged=bool(importance.k_hat <= criteria.k_hat and accurate),
        ess_min=min(ess.values()),
        ess=ess,
        k_hat=importance.k_hat,
        shift=shift,
        widening=widening,
        forbidden=forbidden,
    )
