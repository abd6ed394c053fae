"""How far draws can be trusted: autocorrelation, agreement of ensembles, stuck walkers, importance weights."""

import dataclasses
from typing import NamedTuple

import emcee
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float, Int
from scipy.special import ndtri

from fitact.units import percent

_LENGTHS = 50.0  # autocorrelation times each ensemble must be long
_RHAT = 1.01
_RANKED = 4000  # draws per ensemble that are enough to see it
_WINDOW = 5.0  # autocorrelation times that are summed for one (Sokal)
_LEAST = 100  # steps, before which nothing is judged
_STAY = 100  # steps in one place, at least, and so many
_STAY_LENGTHS = 10.0  # autocorrelation times that make a walker a stuck one
_KHAT = 0.7  # above which importance weights have no mean worth the name (Vehtari et al. 2024)
_OFF = 0.1  # standard deviations that a Laplace approximation may be off by, in mean or width
_FORBIDDEN = 0.01  # share of its draws that may be impossible


@dataclasses.dataclass(frozen=True)
class Convergence:
    """How far the draws of a level of uncertainty can be trusted; see `fitact.sample`.

    Attributes:
        level: "emcee", "psis" or "laplace".
        converged: whether its own certificate holds.
        seconds: that sampling took, resumed parts included.
        ess_min, ess: effective number of draws, for the mean of every coordinate, of g, b and the mean force.
        tau_max, tau: autocorrelation times of the same, in steps.
        rhat_max: largest split-R-hat over the ensembles.
        acceptance: share of the moves.
        burn, steps: of each ensemble.
        stuck_walkers: those that stayed in one place although others moved on.
        k_hat: Pareto's shape of the importance weights' tail.
        shift, widening: by importance weights, what a Laplace approximation's mean is off by, in standard
            deviations, and its standard deviation, as a share.
        forbidden: share of a Laplace approximation's draws that the prior forbids.
    """

    level: str = "emcee"
    converged: bool = False
    seconds: float = 0.0
    ess_min: float = 0.0
    ess: dict[str, float] = dataclasses.field(default_factory=dict)
    tau_max: float = float("nan")
    tau: dict[str, float] = dataclasses.field(default_factory=dict)
    rhat_max: float = float("nan")
    acceptance: float = float("nan")
    burn: int = 0
    steps: int = 0
    walkers: int = 0
    ensembles: int = 0
    stuck_walkers: tuple[str, ...] = ()
    interrupted: bool = False
    k_hat: float = float("nan")
    shift: dict[str, float] = dataclasses.field(default_factory=dict)
    widening: dict[str, float] = dataclasses.field(default_factory=dict)
    forbidden: float = 0.0

    @property
    def progress(self) -> float:
        """Share of the steps that its autocorrelation time asks for."""
        return min((self.steps - self.burn) / (_LENGTHS * self.tau_max), 1.0) if self.tau_max > 0.0 else 0.0

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
        refused = f"; above {_KHAT} the weights cannot be relied on" if not self.k_hat <= _KHAT else ""
        weights = f"Pareto k-hat {self.k_hat:.2f}{refused}"
        if self.level == "psis":
            verdict = "certified" if self.converged else "REFUSED"
            return f"{verdict}: importance-weighted draws of the fit, {weights}, effective draws {self.ess_min:,.0f}"
        verdict = "Laplace approximation" if self.converged else "REFUSED: Laplace approximation"
        shifted, widened = (max(errors, key=lambda name: abs(errors[name])) for errors in (self.shift, self.widening))
        return (
            f"{verdict}, by importance weights ({weights}) off by {abs(self.shift[shifted]):.2g} sd in the mean"
            f" ({shifted}) and {percent(abs(self.widening[widened]))} in the sd ({widened}) at most;"
            f" the prior forbids {percent(self.forbidden)} of its draws"
        )


def judge_chain(
    names: tuple[str, ...],
    points: Float[np.ndarray, "ensembles steps walkers n"],
    accepted: Int[np.ndarray, "ensembles walkers"],
    derived: dict[str, Float[np.ndarray, "ensembles steps followed"]],
    ranked: int = _RANKED,
) -> Convergence:
    """Autocorrelation times, effective sizes and split-R-hat of ensembles, and of `derived` for some walkers.

    R-hat is that of `ranked` draws of each ensemble.
    """
    ensembles, steps, walkers, _ = points.shape
    if steps < _LEAST:
        return Convergence(steps=steps, walkers=walkers, ensembles=ensembles)
    seen = {name: points[..., i] for i, name in enumerate(names)} | derived
    tau = {name: _tau(values[:, steps // 5 :]) for name, values in seen.items()}
    tau_max = max(tau.values())
    burn = int(min(np.ceil(5.0 * tau_max), steps // 2))
    rhat = max(_rhat(values[:, burn:], ranked) for values in seen.values())
    stuck = _stuck(points[:, burn:], float(np.median(list(tau.values()))))
    count = ensembles * (steps - burn) * walkers
    return Convergence(
        converged=bool(steps - burn > _LENGTHS * tau_max and rhat < _RHAT and not stuck),
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


def _tau(values: Float[np.ndarray, "ensembles steps walkers"]) -> float:
    """The longest of the ensembles' autocorrelation times, over the walkers that move; the length where none does."""
    steps, found = values.shape[1], []
    for ensemble in values:
        moving = ensemble[:, np.ptp(ensemble, axis=0) > 0.0]
        found.append(integrated_time(moving) if moving.size else float(steps))
    return float(np.mean(found))


def integrated_time(values: Float[np.ndarray, "steps walkers"]) -> float:
    """The autocorrelation time in steps, as `emcee.autocorr` finds it, but of all walkers in one transform."""
    series = (values - values.mean(axis=0)).T
    spectrum = np.fft.rfft(series, n=2 * len(values))
    correlation = np.fft.irfft(np.square(np.abs(spectrum)), n=2 * len(values))[:, : len(values)]
    taus = 2.0 * np.cumsum(np.mean(correlation / correlation[:, :1], axis=0)) - 1.0
    return float(taus[emcee.autocorr.auto_window(taus, _WINDOW)])


def _rhat(values: Float[np.ndarray, "ensembles steps walkers"], ranked: int) -> float:
    """Rank-normalised split-R-hat (Vehtari et al. 2021); of long ensembles, of steps evenly apart."""
    draws = values[:, :: max(1, values[0].size // ranked)].reshape(len(values), -1)
    halves = draws[:, : draws.shape[1] // 2 * 2].reshape(2 * len(draws), -1)
    return max(_rhat_of_ranks(halves), _rhat_of_ranks(np.abs(halves - np.median(halves))))


def _rhat_of_ranks(draws: Float[np.ndarray, "chains draws"]) -> float:
    """Of the normal scores of the draws' ranks."""
    rank = np.empty(draws.size)
    rank[np.argsort(draws, axis=None, kind="stable")] = np.arange(1, draws.size + 1)
    scores = ndtri((rank - 0.375) / (draws.size + 0.25)).reshape(draws.shape)
    between, within = np.var(scores.mean(axis=1), ddof=1), np.mean(np.var(scores, axis=1, ddof=1))
    return float(np.sqrt(between / within + 1.0 - 1.0 / draws.shape[1]))


def _stuck(points: Float[np.ndarray, "ensembles steps walkers n"], tau: float) -> tuple[str, ...]:
    """Names of walkers that stayed in one place for many autocorrelation times `tau` of all."""
    moved = np.any(points[:, 1:] != points[:, :-1], axis=-1)
    step = np.arange(moved.shape[1])[:, None]
    last = np.maximum.accumulate(np.where(moved, step, -1), axis=1)
    longest = np.max(step - last, axis=1, initial=0)
    found = np.argwhere(longest > max(_STAY, _STAY_LENGTHS * tau))
    return tuple(f"walker {walker} of ensemble {ensemble}" for ensemble, walker in found)


class Weighted(NamedTuple):
    """Pareto-smoothed importance weights.

    Attributes:
        weights: their sum is 1.
        k_hat: inf where too few draws have any weight.
    """

    weights: Float[np.ndarray, " draws"]
    k_hat: float

    def mean_sd(self, values: Float[np.ndarray, " some"]) -> tuple[float, float]:
        """Weighted mean and standard deviation; of the first draws, where `values` are fewer."""
        weights = self._first(values.size)
        mean = float(weights @ values)
        return mean, float(np.sqrt(weights @ (values - mean) ** 2))

    def effective(self, values: Float[np.ndarray, " some"]) -> float:
        """Effective number of all draws for the mean of `values`, by the first draws where those are fewer."""
        weights = self._first(values.size)
        from_mean = (values - weights @ values) ** 2
        return float(weights @ from_mean / (weights**2 @ from_mean)) * self.weights.size / values.size

    def _first(self, count: int) -> Float[np.ndarray, " some"]:
        return self.weights[:count] / self.weights[:count].sum()


def smoothed(log_weights: Float[np.ndarray, " draws"]) -> Weighted:
    """Pareto-smoothed weights (Vehtari et al. 2024), by ArviZ."""
    possible = np.isfinite(log_weights)
    # the tail that is fitted holds 3 sqrt(n) draws
    if np.count_nonzero(possible) <= 3.0 * np.sqrt(log_weights.size):
        weights = possible / max(np.count_nonzero(possible), 1)
        return Weighted(weights, float("inf"))
    values, k_hat = array_stats.psislw(-log_weights)
    weights = np.exp(values - np.max(values))
    return Weighted(weights / weights.sum(), float(k_hat))


def judge_weights(level: str, weighted: Weighted, seen: dict[str, np.ndarray], kept: int) -> Convergence:
    """Effective sizes of `kept` draws that stand for weighted ones; for Laplace, what it is off by.

    Draws resampled from weighted ones carry the variance of both.
    """
    if level == "psis":
        ess = {name: 1.0 / (1.0 / weighted.effective(values) + 1.0 / kept) for name, values in seen.items()}
        shift, widening = {}, {}
    else:
        ess = dict.fromkeys(seen, float(kept))
        corrected = {name: weighted.mean_sd(values) for name, values in seen.items()}
        shift = {name: (float(np.mean(seen[name])) - mean) / sd for name, (mean, sd) in corrected.items()}
        widening = {name: float(np.std(seen[name])) / sd - 1.0 for name, (_, sd) in corrected.items()}
    off = max(map(abs, (*shift.values(), *widening.values())), default=0.0)
    forbidden = float(np.mean(weighted.weights == 0.0)) if level == "laplace" else 0.0
    return Convergence(
        level=level,
        converged=bool(weighted.k_hat <= _KHAT and off <= _OFF and forbidden <= _FORBIDDEN),
        ess_min=min(ess.values()),
        ess=ess,
        k_hat=weighted.k_hat,
        shift=shift,
        widening=widening,
        forbidden=forbidden,
    )
