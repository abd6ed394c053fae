"""Common parts of batches: which records can be fitted together, and which of the fits are reliable.

Only clear cases are accepted in a batch. A record that is clipped or rounded, is not described by the model, needs an
unusual nuisance parameter or does not converge within a few steps is fitted separately.
"""

import abc
import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from fitact.batch.gauss_newton import CANDIDATES, GaussNewton, GaussNewtonResult, RecordInputs
from fitact.compiled import empty_aligned
from fitact.data.clipping import clipping_mask
from fitact.data.noise import white_noise_sds
from fitact.data.record import Record
from fitact.fitting.derived import DerivedQuantities
from fitact.fitting.least_squares import MIN_BIC_DECREASE, NUISANCES, bic_decrease
from fitact.fitting.residual_statistics import is_misfit, residual_statistics
from fitact.fitting.residual_tests import PhaseBins, ResidualTestStatistics
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.observable import LINEAR_NUISANCES
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.problem.starting_point import most_probable_skin, prior_skin_moments

SAMPLE_BLOCK = 16  # records whose residuals are tested at once; see `map_blocks`

_Rows = TypeVar("_Rows", np.ndarray, list[Any])


class BatchFit(NamedTuple):
    """Optima of the records of a batch, one in each row.

    Attributes:
        accepted: whether the fit is reliable; otherwise the other fields are invalid.
        inputs: inputs of the least squares.
        theta, sigma, covariance_factor: see `Fit.theta`, `Fit.sigma` and `Fit.covariance_root`.
        prior_factor: see `Likelihood.prior_factor`.
        logs, gradients: see `DerivedQuantities.log_value_and_grad`.
        figures: see `Fit.figures`.
        freed: names of the nuisances that were fitted, as in `Fit.model`.
    """

    accepted: Bool[np.ndarray, " records"]
    inputs: RecordInputs
    theta: Float[np.ndarray, "records parameters"]
    sigma: Float[np.ndarray, " records"]
    covariance_factor: Float[np.ndarray, "records parameters parameters"]
    prior_factor: Float[np.ndarray, "records parameters parameters"]
    logs: Float[np.ndarray, "records derived"]
    gradients: Float[np.ndarray, "records derived parameters"]
    figures: dict[str, np.ndarray]
    freed: np.ndarray


class Screening(NamedTuple):
    """Properties of a channel of each record.

    Attributes:
        noise: model-free noise sd, without rounding.
        height: peak-to-peak value.
        fine: whether noise exceeds the steps of the ADC.
        railed: whether samples are saturated.
    """

    noise: Float[np.ndarray, " records"]
    height: Float[np.ndarray, " records"]
    fine: Bool[np.ndarray, " records"]
    railed: Bool[np.ndarray, " records"]

    @classmethod
    def from_values(cls, values: Float[np.ndarray, "records samples"], settings: GaussNewton) -> "Screening":
        noise, low, high = white_noise_sds(values), values.min(axis=1), values.max(axis=1)
        steps = np.abs(np.diff(values[:, : settings.adc_samples], axis=1))
        fine = np.any((steps > 0.0) & (steps <= noise[:, None]), axis=1)
        extremes = [_count_true(values == extreme[:, None]) > settings.max_rail_samples for extreme in (low, high)]
        railed = np.any(extremes, axis=0)
        railed[railed] = [clipping_mask(row).any() for row in values[railed]]  # takes long, so of few
        return cls(noise, high - low, fine, railed)


@dataclasses.dataclass(frozen=True)
class BatchProblem(abc.ABC):
    """Common data of records with the same scene and time grid.

    Attributes:
        likelihood: likelihood in the coordinates of a compression, some of whose fields differ between records.
        phases: phase bins of the samples in the drive's period, or None if there are too few periods.
        samples: number of samples of each record that are fitted.
        optional_nuisances: nuisances that a record may need.
        unit: number of records in a batch, for which programs are compiled: `large_unit`, or `small_unit` if there are
            no more, as in a task of a campaign.
    """

    likelihood: Likelihood
    derive: DerivedQuantities
    phases: PhaseBins | None
    samples: int
    optional_nuisances: tuple[str, ...]
    unit: int
    settings: ClassVar[GaussNewton] = GaussNewton()
    large_unit: ClassVar[int]
    small_unit: ClassVar[int] = 32

    @abc.abstractmethod
    def includes(self, record: Record) -> bool:
        """Return whether the record has the channels and the drive of the batch."""

    @abc.abstractmethod
    def fit(self, records: Sequence[Record], whiteness: bool = True) -> BatchFit:
        """Fit `unit` records, and optionally test the residuals for structure (`whiteness`), in double precision."""

    @classmethod
    def choose_unit(cls, count: int) -> int:
        """Return the `unit` for `count` records."""
        return cls.small_unit if count <= cls.small_unit else cls.large_unit

    def pad_records(self, members: Sequence[tuple[int, Record]]) -> list[Record]:
        """Return `unit` records, the last one repeatedly."""
        records = [record for _, record in members]
        return records + records[-1:] * (self.unit - len(records))

    def derive_record(self, record: Record, inputs: RecordInputs) -> DerivedQuantities:
        """Return the derived quantities of a record with these `inputs`, and its likelihood in them."""
        return dataclasses.replace(self.derive, likelihood=inputs.model(self.likelihood))

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Cached `names` of the likelihood."""
        return self.likelihood.names

    @functools.cached_property
    def prior_factor(self) -> Float[np.ndarray, "parameters parameters"]:
        """Cached `prior_factor` of the likelihood."""
        return self.likelihood.prior_factor

    def starting_points(
        self, g: Float[np.ndarray, " records"], b: Float[np.ndarray, " records"]
    ) -> Float[np.ndarray, "records parameters"]:
        """Return the most probable parameters with divider `g` and time constant `b` (s)."""
        center, moments = self._prior_moments
        theta, ridge = np.tile(center, (len(g), 1)), most_probable_skin(g, b, *moments)
        for name, logs in zip(FINGER_PARAMETERS, ridge.T, strict=True):
            if name in self.names:
                theta[:, self.names.index(name)] = logs
        return theta

    @functools.cached_property
    def _prior_moments(self) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Center of the prior, and the moments of the skin's parameters."""
        log_mean = self.likelihood.prior.log_mean
        center = np.append(log_mean, np.zeros(len(self.names) - log_mean.size))
        return center, prior_skin_moments(self.likelihood)

    def assess_optima(
        self,
        inputs: RecordInputs,
        optima: GaussNewtonResult,
        square: Float[np.ndarray, " records"],
        tests: ResidualTestStatistics | None,
        expected: Float[np.ndarray, " records"],
        usable: Bool[np.ndarray, " records"],
        log_derived: tuple[np.ndarray, np.ndarray],
        interpolation_error: ArrayLike = 0.0,
    ) -> BatchFit:
        """Return the optima of records with their figures of merit, and whether each is accepted.

        `square` are the residual sums of squares, `expected` is the sd of the noise as estimated without the model,
        `usable` says which records have no other reason against them, and `log_derived` are the logarithms of the
        derived quantities with their gradients. Compare `fitact.fitting.residual_statistics.channel_statistics`.
        """
        freedom = self.samples - len(self.names) - np.count_nonzero(inputs.linear_sd, axis=1)
        figures = residual_statistics(square, self.samples, tests, expected, freedom, self.phases)
        figures |= {"rounding_noise": np.zeros(len(square)), "interpolation_error": np.asarray(interpolation_error)}
        accepted = usable & optima.converged & ~is_misfit(figures)
        accepted &= np.max(self.bic_decreases(optima.r_squared), axis=1) <= MIN_BIC_DECREASE
        others = [name for name in self.names if name not in FINGER_PARAMETERS]
        freed = np.array(
            [", ".join([*itertools.compress(LINEAR_NUISANCES, free), *others]) for free in inputs.linear_sd > 0.0]
        )
        factor = np.linalg.inv(optima.r_factor)
        prior = np.array(np.broadcast_to(self.prior_factor, factor.shape))
        if inputs.gain_sd is not None:
            place = self.names.index("gain")
            prior[:, place, place] = inputs.gain_sd
        return BatchFit(accepted, inputs, optima.theta, optima.sigma, factor, prior, *log_derived, figures, freed)

    def bic_decreases(self, r_squared: Float[np.ndarray, "records candidates"]) -> np.ndarray:
        """Return the decrease of the BIC that each of `CANDIDATES` would cause; -inf for one that is not optional."""
        gains = np.full(r_squared.shape, -math.inf)
        for place, name in enumerate(CANDIDATES):
            if name in self.optional_nuisances:
                gain = bic_decrease(r_squared[:, place], self.samples, len(NUISANCES.get(name, (0,))))
                gains[:, place] = gain + (self.settings.clock_bic_error if name == "clock" else 0.0)
        return gains


def _count_true(mask: Bool[np.ndarray, "*rows n"]) -> Int[np.ndarray, "*rows"]:
    """Return the number of true values in each row, summed in the smallest integer type, which is fastest."""
    return mask.view(np.uint8).sum(axis=-1, dtype=np.min_scalar_type(mask.shape[-1])).astype(int)


def stack_channel(records: Sequence[Record], channel: str) -> Float[np.ndarray, "records samples"]:
    """Return a channel of all records; one large array, since many smaller ones take new memory again and again."""
    stacked = empty_aligned((len(records), len(records[0])))
    np.concatenate([record[channel] for record in records], out=stacked.reshape(-1))  # faster than `np.stack`
    return stacked


def split_rows(rows: _Rows, size: int) -> list[_Rows]:
    """Return parts of `size` rows, of an array or a list."""
    return [rows[first : first + size] for first in range(0, len(rows), size)]
