"""Linearised fit: sensitivities of the data to parameters and nuisances, and the estimator that follows."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from fitact.likelihood.likelihood import Likelihood
from fitact.uncertainty.channel_series import ChannelSeries, Rows
from fitact.uncertainty.loop import ChannelModel, Instrument, LoopModel

Columns = Float[np.ndarray, "rows columns"]


class Nuisance(NamedTuple):
    """A nuisance that channels of several records have, each its own."""

    channels: tuple[int, ...]  # indices of the channels
    name: str  # "delay", "clock", or the name of a linear nuisance without "_cos" and "_sin"


@dataclasses.dataclass(frozen=True)
class LinearPosterior:
    """Coordinates of a fit, their optimum and prior, and the quantities that are reported."""

    loop: LoopModel
    likelihood: Likelihood  # gives the values of the circuit's parameters
    theta: Float[np.ndarray, " parameters"]
    prior_factor: Float[np.ndarray, "parameters parameters"]
    quantities: tuple[str, ...]
    gradients: Float[np.ndarray, "quantities parameters"]  # of the logarithms of the quantities


class LinearModel:
    """Whitened sensitivities of all channels at the optimum, followed by a row for the prior of each coordinate."""

    def __init__(
        self, posterior: LinearPosterior, series: Sequence[ChannelSeries], without: Nuisance | None = None
    ) -> None:
        """Compute the sensitivities; the nuisance `without` is left out of the model."""
        self.posterior, self.without = posterior, without
        self.series = tuple(series)
        self.series = tuple(model.with_charge() for model in self.models(posterior.theta))
        dropped = [
            t.place for i, each in enumerate(series) for n, t in each.samples.timing.items() if self._lacks(i, n)
        ]
        self.kept = [i for i in range(posterior.theta.size) if i not in dropped]
        sensitivities, nuisances = self.sensitivities(posterior.theta), self._nuisance_columns()
        width = nuisances.shape[1]
        prior = np.linalg.inv(posterior.prior_factor)
        prior = np.delete(prior, [i for i in range(len(prior)) if i not in self.kept], axis=0)
        self.design = np.block(
            [
                [sensitivities, nuisances],
                [prior[:, self.kept], np.zeros((len(prior), width))],
                # keeps nuisances apart that look alike
                [np.zeros((width, len(self.kept))), 1e-6 * np.eye(width)],
            ]
        )
        self.basis, self.triangle = np.linalg.qr(self.design)

    def _lacks(self, channel: int, name: str) -> bool:
        """Return whether a nuisance of a channel is left out."""
        return self.without is not None and channel in self.without.channels and name == self.without.name

    @functools.cached_property
    def rows(self) -> int:
        """Number of rows of data."""
        return sum(each.time.size for each in self.series)

    @functools.cached_property
    def residuals(self) -> Rows:
        """Whitened residuals orthogonal to all sensitivities; the rows of the prior follow."""
        return self.remainder(np.concatenate([each.whiten(each.residuals) for each in self.series])[:, None])[:, 0]

    @functools.cached_property
    def noise_variance(self) -> Rows:
        """Variance of the noise alone in each row; 0 in the rows of the prior."""
        parts, start = [], 0
        for each in self.series:
            rows = self.residuals[start : start + each.time.size]
            parts.append(np.full(each.time.size, _noise_variance(rows, each)))
            start += each.time.size
        return self.extend(np.concatenate(parts)[:, None])[:, 0]

    def extend(self, columns: Columns) -> Columns:
        """Return columns with zeros in the rows of the prior."""
        return np.pad(columns, ((0, len(self.design) - len(columns)), (0, 0)))

    def remainder(self, columns: Columns) -> Columns:
        """Return the part of columns that is orthogonal to all sensitivities."""
        columns = self.extend(columns) if len(columns) == self.rows else columns
        return columns - self.basis @ (self.basis.T @ columns)

    def shifts(self, columns: Columns) -> Float[np.ndarray, "quantities columns"]:
        """Return how a fit moves the logarithms of the quantities if the data contain each of the columns."""
        return self._estimator @ (self.basis[: self.rows].T @ columns[: self.rows])

    def shift_of_part(
        self, design: Columns, residuals: Rows, noise: Rows
    ) -> tuple[Float[np.ndarray, " quantities"], Float[np.ndarray, " quantities"]]:
        """Return the shifts of a fit to a part of the data, with the whole prior, and their variances from noise."""
        basis, triangle = np.linalg.qr(np.concatenate([design, self.design[self.rows :]]))
        estimator = np.linalg.pinv(triangle, rcond=1e-12) @ basis[: len(design)].T
        weights = self._gradients @ estimator[: len(self.kept)]
        return weights @ residuals, np.square(weights) @ noise

    @functools.cached_property
    def weights(self) -> Float[np.ndarray, "quantities rows"]:
        """Weight of each row in the estimates of the quantities."""
        return self._estimator @ self.basis[: self.rows].T

    @functools.cached_property
    def _estimator(self) -> Float[np.ndarray, "quantities columns"]:
        """Estimates of the quantities from the coordinates of the data in `basis`."""
        return (
            self._gradients @ scipy.linalg.solve_triangular(self.triangle, np.eye(len(self.triangle)))[: len(self.kept)]
        )

    @property
    def _gradients(self) -> Float[np.ndarray, "quantities parameters"]:
        return self.posterior.gradients[:, self.kept]

    def models(self, theta: Float[np.ndarray, " parameters"]) -> list[ChannelModel]:
        """Return the models of all channels at theta."""
        values, move = self.posterior.likelihood.parameter_values(theta), theta - self.posterior.theta
        models = []
        for i, each in enumerate(self.series):
            timing = {
                name: t.total + t.unit * float(move[t.place])
                for name, t in each.samples.timing.items()
                if not self._lacks(i, name)
            }
            sizes = {
                name: math.exp(sum(power * theta[place] for place, power in places))
                for name, places in {"gain": each.samples.gains, **each.samples.effects}.items()
            }
            gain = sizes.pop("gain")
            instrument = Instrument(gain, **timing, effects={name: size - 1.0 for name, size in sizes.items()})
            models.append(ChannelModel(each, self.posterior.loop, values, instrument))
        return models

    def signals(self, theta: Float[np.ndarray, " parameters"]) -> Rows:
        """Return the whitened signals of all channels at theta."""
        return np.concatenate([model.series.whiten(model.signal) for model in self.models(theta)])

    def sensitivities(self, theta: Float[np.ndarray, " parameters"], step: float = 1e-4) -> Columns:
        """Return the derivatives of the whitened signals in the coordinates that are kept, by central differences."""
        changes = step * np.eye(theta.size)[self.kept]
        columns = [self.signals(theta + change) - self.signals(theta - change) for change in changes]
        return np.stack(columns, axis=1) / (2.0 * step)

    def _place(self, channel: int, values: Rows) -> Rows:
        """Return values of one channel among the whitened rows of all."""
        rows = [np.zeros(each.time.size) for each in self.series]
        rows[channel] = self.series[channel].whiten(values)
        return np.concatenate(rows)

    def _nuisance_columns(self) -> Columns:
        columns = []
        for i, each in enumerate(self.series):
            for name, shape in each.shapes().items():
                if not self._lacks(i, name.rsplit("_", name.startswith("hum"))[0]):
                    column = self._place(i, shape)
                    columns.append(column / max(float(np.linalg.norm(column)), 1e-300))
        return np.stack(columns, axis=1) if columns else np.zeros((self.rows, 0))

    def nuisance_part(self, simpler: "LinearModel", nuisance: Nuisance) -> tuple[Columns, Rows]:
        """Return the whitened columns of a nuisance, which a `simpler` model lacks, and what it adds at the optimum."""
        chosen = [(i, self.series[i]) for i in nuisance.channels]
        timing = [each.samples.timing[nuisance.name] for _, each in chosen if nuisance.name in each.samples.timing]
        if timing:
            places, theta = [self.kept.index(t.place) for t in timing], self.posterior.theta
            return self.design[: self.rows, places], self.signals(theta) - simpler.signals(theta)
        shapes = [
            (self._place(i, shape), each.samples.nuisances[name])
            for i, each in chosen
            for name, shape in each.shapes().items()
            if name.startswith(nuisance.name)
        ]
        if not shapes:
            return np.zeros((self.rows, 0)), np.zeros(self.rows)
        columns, values = zip(*shapes, strict=True)
        return np.stack(columns, axis=1), np.stack(columns, axis=1) @ np.array(values)


def _noise_variance(rows: Rows, series: ChannelSeries, quantile: float = 0.25) -> float:
    """Return the variance of white noise: that of the model-free estimate, or of the quiet lines if that is larger.

    Noise that is larger than estimated raises all lines, and structure only some.
    """
    power = np.sort(np.square(np.abs(np.fft.rfft(rows)[1:])))
    counted = np.count_nonzero(series.weight)
    quiet = power[int(quantile * power.size)] / (-np.log1p(-quantile) * max(counted, 1))
    return float(np.clip((series.samples.noise / series.samples.sigma) ** 2, quiet, max(1.0, quiet)))
