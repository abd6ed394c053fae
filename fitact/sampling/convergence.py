"""Convergence diagnostics: autocorrelation time, split-R-hat, stuck walkers and importance weights.

Autocorrelation time and R-hat follow emcee and ArviZ, but treat all walkers at once. For a chain of 1,500 steps the
functions of emcee and ArviZ take 2.6 and 1.4 times as long.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import emcee
import numpy as np
import scipy
from jaxtyping import Float, Int

from fitact.units import format_percent


@dataclasses.dataclass(frozen=True)
class Criteria:
    """Criteria of convergence; see `fitact.sample`."""

    autocorrelation_times: float = 50.0  # minimum length of each ensemble, in autocorrelation times
    rhat: float = 1.01  # upper bound of split-R-hat
    stuck_steps: int = 100  # a walker is stuck if it stays in one place for more steps than this and the next bound
    stuck_autocorrelation_times: float = 10.0
    k_hat: float = 0.7  # above it, means over importance weights are unreliable (Vehtari et al. 2024)
    laplace_error: float = 0.1  # largest error of a Laplace approximation: of the mean in sd, of the sd relative
    forbidden: float = 0.01  # largest fraction of its draws outside the prior


CRITERIA = Criteria()


@dataclasses.dataclass(frozen=True)
class Convergence:
    """Diagnostics of the draws of one posterior method; see `fitact.sample`."""

    level: str = "emcee"  # "emcee", "psis" or "laplace"
    converged: bool = False  # whether the criteria of the method are met
    seconds: float = 0.0  # run time of the sampling, including resumed parts
    ess_min: float = 0.0  # smallest effective number of draws, over all coordinates, g, b and the mean force
    ess: dict[str, float] = dataclasses.field(default_factory=dict)
    tau_max: float = float("nan")  # largest autocorrelation time of the same quantities, in steps
    tau: dict[str, float] = dataclasses.field(default_factory=dict)
    rhat_max: float = float("nan")  # largest split-R-hat over the ensembles
    acceptance: float = float("nan")  # fraction of accepted moves
    burn: int = 0  # burn-in steps of each ensemble
    steps: int = 0
    walkers: int = 0
    ensembles: int = 0
    stuck_walkers: tuple[str, ...] = ()  # walkers that stayed in one place
    interrupted: bool = False
    k_hat: float = float("nan")  # Pareto shape parameter of the tail of the importance weights
    # errors of a Laplace approximation, estimated with importance weights: of the mean in sd, and of the sd relative
    shift: dict[str, float] = dataclasses.field(default_factory=dict)
    widening: dict[str, float] = dataclasses.field(default_factory=dict)
    forbidden: float = 0.0  # fraction of the draws of a Laplace approximation that lie outside the prior

    @property
    def progress(self) -> float:
        """Fraction of the steps that the autocorrelation time requires."""
        goal = CRITERIA.autocorrelation_times * self.tau_max
        return min((self.steps - self.burn) / goal, 1.0) if goal > 0.0 else 0.0

    @property
    def warning(self) -> str:
        """Reason why the draws are unreliable, or an empty string."""
        if self.converged:
            return ""
        if self.level != "emcee":
            return f"{self}; sample with level emcee instead"
        if self.interrupted:
            return "sampling was interrupted before it converged; run the same command again to resume"
        stuck = f"; stuck: {', '.join(self.stuck_walkers)}" if self.stuck_walkers else ""
        return f"the chain has not converged ({self}{stuck}); allow more steps"

    def __str__(self) -> str:
        if self.level == "emcee":
            verdict = "converged" if self.converged else "interrupted" if self.interrupted else "NOT converged"
            return (
                f"{verdict}: {self.ensembles} ensembles of {self.walkers} walkers, {self.steps} steps (burn-in"
                f" {self.burn}), autocorrelation time {self.tau_max:.2f}, effective draws {self.ess_min:,.0f},"
                f" split-R-hat {self.rhat_max:.4f}, accepted {100.0 * self.acceptance:.0f} %"
            )
        limit = CRITERIA.k_hat
        refused = f" (above {limit} the weights are unreliable)" if not self.k_hat <= limit else ""
        weights = f"Pareto k-hat {self.k_hat:.2f}{refused}"
        if self.level == "psis":
            verdict = "accepted" if self.converged else "REFUSED"
            return f"{verdict}: Pareto-smoothed importance sampling, {weights}, effective draws {self.ess_min:,.0f}"
        verdict = "Laplace approximation" if self.converged else "REFUSED: Laplace approximation"
        shifted, widened = (max(errors, key=lambda name: abs(errors[name])) for errors in (self.shift, self.widening))
        return (
            f"{verdict}, largest error of a mean {abs(self.shift[shifted]):.2g} sd ({shifted}), of an sd"
            f" {format_percent(abs(self.widening[widened]))} ({widened}), from importance weights with {weights};"
            f" {format_percent(self.forbidden)} of the draws lie outside the prior"
        )


def diagnose_chain(
    names: tuple[str, ...],
    points: Float[np.ndarray, "ensembles steps walkers n"],
    accepted: Int[np.ndarray, "ensembles walkers"],
    derived: dict[str, Float[np.ndarray, "ensembles steps followed"]],
    rhat_draws: int = 4000,
    criteria: Criteria = CRITERIA,
) -> Convergence:
    """Return autocorrelation times, effective sizes and split-R-hat of all coordinates and `derived` quantities.

    `names` are those of the coordinates, `accepted` counts accepted moves, and `derived` holds other quantities of some
    walkers only. R-hat uses `rhat_draws` draws of each ensemble.
    """
    ensembles, steps, walkers, _ = points.shape
    if steps < 100:  # too few for any diagnostic
        return Convergence(steps=steps, walkers=walkers, ensembles=ensembles)
    quantities = {name: points[..., i] for i, name in enumerate(names)} | _varying(derived)
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


def _varying(quantities: dict[str, np.ndarray], rounding: float = 1e-12) -> dict[str, np.ndarray]:
    """Return the quantities without those that are constant, such as g if Csc and Ci are fixed: nothing converges."""
    return {name: x for name, x in quantities.items() if not np.ptp(x) <= rounding * np.max(np.abs(x))}


def _autocorrelation_time(values: Float[np.ndarray, "ensembles steps walkers"]) -> float:
    """Return the mean over ensembles, from the walkers that move; the number of steps where none moves."""
    moving = (ensemble[:, np.ptp(ensemble, axis=0) > 0.0] for ensemble in values)
    return float(np.mean([integrated_time(walkers) if walkers.size else values.shape[1] for walkers in moving]))


def integrated_time(values: Float[np.ndarray, "steps walkers"]) -> float:
    """Return the autocorrelation time in steps, as `emcee.autocorr` does, with one transform for all walkers."""
    series = (values - values.mean(axis=0)).T
    spectrum = np.fft.rfft(series, n=2 * len(values))
    correlation = np.fft.irfft(np.square(np.abs(spectrum)), n=2 * len(values))[:, : len(values)]
    taus = 2.0 * np.cumsum(np.mean(correlation / correlation[:, :1], axis=0)) - 1.0
    return float(taus[emcee.autocorr.auto_window(taus, 5.0)])  # Sokal's window of 5 autocorrelation times


def _split_rhat(values: Float[np.ndarray, "ensembles steps walkers"], rhat_draws: int) -> float:
    """Return rank-normalised split-R-hat (Vehtari et al. 2021), from equally spaced steps of a long ensemble."""
    draws = values[:, :: max(1, values[0].size // rhat_draws)].reshape(len(values), -1)
    halves = draws[:, : draws.shape[1] // 2 * 2].reshape(2 * len(draws), -1)
    return max(_normal_score_rhat(halves), _normal_score_rhat(np.abs(halves - np.median(halves))))


def _normal_score_rhat(draws: Float[np.ndarray, "chains draws"]) -> float:
    rank = np.empty(draws.size)
    rank[np.argsort(draws, axis=None, kind="stable")] = np.arange(1, draws.size + 1)
    scores = scipy.special.ndtri((rank - 0.375) / (draws.size + 0.25)).reshape(draws.shape)
    between, within = np.var(scores.mean(axis=1), ddof=1), np.mean(np.var(scores, axis=1, ddof=1))
    return float(np.sqrt(between / within + 1.0 - 1.0 / draws.shape[1]))


def _stuck_walkers(points: Float[np.ndarray, "ensembles steps walkers n"], patience: float) -> tuple[str, ...]:
    """Return the names of walkers that stayed in one place for more than `patience` steps."""
    moved = np.any(points[:, 1:] != points[:, :-1], axis=-1)
    step = np.arange(moved.shape[1])[:, None]
    last = np.maximum.accumulate(np.where(moved, step, -1), axis=1)
    longest = np.max(step - last, axis=1, initial=0)
    return tuple(f"walker {walker} of ensemble {ensemble}" for ensemble, walker in np.argwhere(longest > patience))


class ImportanceWeights(NamedTuple):
    """Pareto-smoothed importance weights."""

    weights: Float[np.ndarray, " draws"]  # their sum is 1
    k_hat: float  # inf where too few draws have a nonzero weight

    def mean_sd(self, values: Float[np.ndarray, " some"]) -> tuple[float, float]:
        """Return the weighted mean and standard deviation of `values`, which belong to the first draws."""
        weights = self._first_weights(values.size)
        mean = float(weights @ values)
        return mean, float(np.sqrt(weights @ (values - mean) ** 2))

    def quantiles(self, values: Float[np.ndarray, " some"], probabilities: Sequence[float]) -> Float[np.ndarray, " n"]:
        """Return weighted quantiles of `values`, which belong to the first draws."""
        return np.quantile(values, probabilities, weights=self._first_weights(values.size), method="inverted_cdf")

    def effective_size(self, values: Float[np.ndarray, " some"]) -> float:
        """Return the effective number of all draws for the mean of `values`, which belong to the first draws."""
        weights = self._first_weights(values.size)
        from_mean = (values - weights @ values) ** 2
        return float(weights @ from_mean / (weights**2 @ from_mean)) * self.weights.size / values.size

    def _first_weights(self, count: int) -> Float[np.ndarray, " some"]:
        return self.weights[:count] / self.weights[:count].sum()


def pareto_smooth(log_weights: Float[np.ndarray, " draws"]) -> ImportanceWeights:
    """Smooth the largest weights with a generalised Pareto distribution (Vehtari et al. 2024), as ArviZ does."""
    from arviz_stats.base import array_stats  # slow to import, and MCMC does without it

    possible = np.isfinite(log_weights)
    count = np.count_nonzero(possible)
    if count <= 3.0 * np.sqrt(log_weights.size):  # size of the tail that is fitted
        return ImportanceWeights(possible / max(count, 1), float("inf"))
    values, k_hat = array_stats.psislw(-log_weights)
    weights = np.exp(values - np.max(values))
    return ImportanceWeights(weights / weights.sum(), float(k_hat))


def diagnose_weights(
    level: str, importance: ImportanceWeights, quantities: dict[str, np.ndarray], n_resampled: float
) -> Convergence:
    """Return the effective sizes of `n_resampled` draws, and for "laplace" the errors of the approximation.

    `n_resampled` is inf where the draws are used with their weights.
    """
    shift, widening, quantities = {}, {}, _varying(quantities)
    if level == "psis":  # the variances of weighting and of resampling add up
        effective = {name: importance.effective_size(values) for name, values in quantities.items()}
        ess = {name: 1.0 / (1.0 / size + 1.0 / n_resampled) for name, size in effective.items()}
    else:
        ess = dict.fromkeys(quantities, float(n_resampled))
        corrected = {name: importance.mean_sd(values) for name, values in quantities.items()}
        shift = {name: (float(np.mean(quantities[name])) - mean) / sd for name, (mean, sd) in corrected.items()}
        widening = {name: float(np.std(quantities[name])) / sd - 1.0 for name, (_, sd) in corrected.items()}
    largest_error = max(map(abs, (*shift.values(), *widening.values())), default=0.0)
    forbidden = float(np.mean(importance.weights == 0.0)) if level == "laplace" else 0.0
    accurate = largest_error <= CRITERIA.laplace_error and forbidden <= CRITERIA.forbidden
    return Convergence(
        level=level,
        converged=bool(importance.k_hat <= CRITERIA.k_hat and accurate),
        ess_min=min(ess.values()),
        ess=ess,
        k_hat=importance.k_hat,
        shift=shift,
        widening=widening,
        forbidden=forbidden,
    )
