"""Compressed record: coordinates in a table of responses, which represent all samples in a likelihood.

Over a range of time constants, all responses lie, to rounding, in the span of some twenty functions. In coordinates of
these, the difference between record and model has the same length as over all samples. As functions of log tau, the
coordinates are Chebyshev series. `fitact.likelihood.projection` computes them.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from fitact.compiled import array_module
from fitact.model.circuit import HighpassTerms
from fitact.model.response_table import (
    chebyshev,
    chebyshev_polynomials,
    count_terms,
    node_count,
)

HUM_FREQUENCIES = (50.0, 60.0, 150.0, 180.0)  # Hz: mains, and the third harmonics, which are the strongest
BASELINE_NAMES = (
    "offset",
    "drift",
    *(f"hum_{frequency:.0f}Hz_{part}" for frequency in HUM_FREQUENCIES for part in ("cos", "sin")),
)

Columns = Float[np.ndarray, "*records rows functions"]


def function_sizes(rank: int, *, decays: bool, effects: int = 0, ages: int = 0) -> dict[str, int]:
    """Return the functions of a record in the order of their inner products, each name with its number of functions.

    They are named like the fields of `Compression`, and by `BASELINE_NAMES`.
    """
    sizes = {"signal": rank, "decay": rank * decays, "effects": effects, "steps": ages}
    return sizes | dict.fromkeys((*BASELINE_NAMES, "rate", "slope", "observed"), 1)


def place_functions(sizes: Mapping[str, int]) -> dict[str, Int[np.ndarray, " functions"]]:
    """Return the places of the functions among all, by name."""
    counts = list(sizes.values())
    return dict(zip(sizes, np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1]), strict=True))


def split_functions(columns: Columns, sizes: Mapping[str, int]) -> dict[str, Columns]:
    """Return columns by the name of the functions to which they belong."""
    return {name: columns[..., place] for name, place in place_functions(sizes).items()}


def orthogonal_coordinates(functions: Mapping[str, Columns]) -> dict[str, Columns]:
    """Return functions in coordinates of as many orthonormal ones, with the same inner products."""
    _, rows = np.linalg.qr(np.hstack(list(functions.values())))
    return split_functions(rows, {name: each.shape[1] for name, each in functions.items()})


class Compression(eqx.Module):
    """A record in coordinates of its response table.

    A vector of `rows` coordinates represents one value per sample, with the same inner products as over all samples.
    If `center` and `half_width` are arrays, each time constant of a circuit has its own table, and `signal` and `decay`
    hold those of the slowest first.
    """

    center: Float[Array, "*taus"]  # the table covers log tau in `center` ± `half_width` (tau in s)
    half_width: Float[Array, "*taus"]
    # Chebyshev coefficients in log tau of the response to the drive (V); rows beyond the rank are 0
    signal: Float[Array, "rank terms"]
    decay: Float[Array, "rows terms"]  # the same for the decay of an unknown charge from 1 V
    baseline: Float[Array, "shapes rows"]  # the shapes of `BASELINE_NAMES`, of height 1
    rate: Float[Array, " rows"]  # dV/dt, V/s, if the channel follows it, else 0
    # dV/dt, V/s, over two samples, so that a jump appears on both sides; of rows of charge, the derivative of `rate`
    slope: Float[Array, " rows"]
    observed: Float[Array, " rows"]  # the record, V or A
    observed_slope: Float[Array, " rows"]  # derivative of `observed` in log sigma, 0 but for `StudentExpansion`
    samples: Float[Array, ""]  # number of samples
    # dV/dt of a measured drive (V/s) between the samples k - i - 1 and k - i, for the ages i from `origin` on, and the
    # noise of V (V), which only `response` with a `noise_gain` has; empty if the response cannot be delayed
    steps: Float[Array, "ages+1 rows"]
    origin: Float[Array, ""]  # delay of `signal`, in time steps
    time_step: Float[Array, ""]  # s
    effects: Float[Array, "effects rows"] | None = None  # see `ChannelLikelihood.effects`
    voltage: Float[Array, " rows"] | None = None  # V, for circuits on whose skin a constant V acts
    # number of the fastest time constants of the circuit that are so short that `steps` give the response
    short: int = eqx.field(static=True, default=0)

    def covers(self, tau: Array, delay: ArrayLike = 0.0) -> Array:
        """Return whether the table covers the time constant (s) and the delay (s)."""
        xp, none = array_module(tau), np.full(self.short, np.nan)
        center, half_width = (xp.append(x, none) if x.ndim else x for x in (self.center, self.half_width))
        covered = abs(xp.log(tau) - center) <= half_width
        if not len(self.steps):
            return covered
        since = delay / self.time_step - self.origin
        if self.short:  # the response to what was before the first of `steps` has decayed to 3e-4
            covered = covered | (8.0 * tau / self.time_step <= self.reach - since)
        return covered & (abs(since) <= self.reach)

    @property
    def reach(self) -> int:
        """Largest delay from `origin`, in time steps."""
        return len(self.steps) // 2

    def response(
        self, terms: HighpassTerms, delay: ArrayLike = 0.0, noise_gain: ArrayLike = 0.0
    ) -> Float[Array, " rows"]:
        """Return the response of a circuit (compare `fitact.response`) with a `delay` (s), if it has `steps`.

        The noise of V beside `steps` is added with its gain.
        """
        series, slopes = [], jnp.zeros(2 * self.reach)
        for index, (weight, tau) in enumerate(zip(terms.weight, terms.tau, strict=True)):
            if index >= len(terms.tau) - self.short:
                slopes = slopes + weight * self._respond_to_steps(delay, tau)
                continue
            if len(self.steps):
                growth, gains = self._shift(delay, tau)
                weight, slopes = weight * growth, slopes + weight * growth * gains
            series.append(weight * self._series(tau, index))
        total = self.signal @ (jnp.concatenate(series) if self.center.ndim else sum(series, jnp.zeros(())))
        total = jnp.pad(total, (0, self.observed.size - total.size))
        if len(self.steps):
            slopes = slopes if terms.rate is None else slopes + terms.rate * self._weigh_slopes(delay)
            total = total + jnp.append(slopes, noise_gain) @ self.steps
        if terms.direct is not None:
            if self.voltage is None:
                raise TypeError("this compression holds no V, which a leak of the insulator needs")
            total = total + terms.direct * self._shift_voltage(self.voltage, delay)
        return total if terms.rate is None or len(self.steps) else total + terms.rate * self.rate

    def _weigh_slopes(self, delay: ArrayLike) -> Float[Array, " ages"]:
        """Return what to multiply `steps[:-1]` by for the mean dV/dt over a time step around a sample, with a `delay`.

        At the ends of the steps it is that of half a step before.
        """
        since, farthest = delay / self.time_step - self.origin, self.reach - 0.5
        middles = np.arange(2 * self.reach) - farthest
        return jnp.maximum(1.0 - jnp.abs(jnp.clip(since, -farthest, farthest) - middles), 0.0)

    def _shift(self, delay: ArrayLike, tau: ArrayLike) -> tuple[Array, Float[Array, "*nodes ages"]]:
        """Return factors p, q such that the response delayed by `delay` is p (signal + q @ steps[:-1]).

        On the way back from a sample to an earlier time, the response u grows by 1 / decay, and each part of a linear
        step of the drive that has not yet happened is subtracted.
        """
        xp, (since, ends, sign) = array_module(tau), self._shifted_parts(delay)
        gained = -sign * tau * xp.exp(-ends[..., :-1] / tau) * xp.expm1(-xp.diff(ends) / tau)
        return xp.exp(since / tau), gained

    def _respond_to_steps(self, delay: ArrayLike, tau: Array) -> Float[Array, " ages"]:
        """Return what to multiply `steps[:-1]` by for the response of a short time constant, delayed by `delay`."""
        since = delay - self.origin * self.time_step
        ends = jnp.maximum(self.time_step * np.arange(-self.reach, self.reach + 1) - since, 0.0)
        return -tau * jnp.exp(-ends[:-1] / tau) * jnp.expm1(-jnp.diff(ends) / tau)

    def _shift_voltage(self, voltage: Float[Array, " rows"], delay: ArrayLike) -> Float[Array, " rows"]:
        """Return V with a `delay` (s), beside its noise."""
        if not len(self.steps):
            return voltage
        _, ends, sign = self._shifted_parts(delay)
        return voltage + sign * array_module(ends).diff(ends) @ self.steps[:-1]

    def _shifted_parts(self, delay: ArrayLike) -> tuple[Array, Float[Array, " ages+1"], Array]:
        """Return the delay from `origin` (s), the ends of the parts of `steps` that it passes, and minus its sign."""
        since = delay - self.origin * self.time_step
        # with `minimum` and `maximum`, the derivative would vanish at 0
        xp, is_later = array_module(since), since > 0.0
        ages = self.time_step * np.arange(-self.reach, self.reach + 1)
        ends = xp.clip(ages, xp.where(is_later, 0.0, since), xp.where(is_later, since, 0.0))
        return since, ends, xp.where(is_later, -1.0, 1.0)

    def delay_derivative(self, terms: HighpassTerms) -> Float[Array, " rows"]:
        """Return the derivative of the response with respect to a delay (per s): u / tau - V' for each term."""
        return self._falling_response(terms, self.slope)

    def rows_delay_derivative(self, terms: HighpassTerms) -> Float[Array, " rows"]:
        """Return the same of rows of charge, whose `slope` is the derivative of `rate`."""
        change = self._falling_response(terms, self.rate)
        return change if terms.rate is None else change - terms.rate * self.slope

    def _falling_response(self, terms: HighpassTerms, drive_slope: Float[Array, " rows"]) -> Float[Array, " rows"]:
        falling = HighpassTerms(tuple(w / t for w, t in zip(terms.weight, terms.tau, strict=True)), terms.tau)
        return self.response(falling) - terms.jump * drive_slope

    def decays(self, tau: Array, index: int = 0) -> Float[Array, " rows"]:
        """Return e^{-(t - t0) / tau}, where t0 is the first sample; `index` is that of a time constant of the table."""
        series = self._series(tau, index)
        first = index * series.size if self.center.ndim else 0
        return self.decay[:, first : first + series.size] @ series

    def _series(self, tau: Array, index: int) -> Float[Array, " terms"]:
        center, half_width = (x[index] if x.ndim else x for x in (self.center, self.half_width))
        return chebyshev_polynomials((jnp.log(tau) - center) / half_width, self.signal.shape[1] // self.center.size)

    def restrict(
        self, center: ArrayLike, half_width: ArrayLike, precision: float, charge: float, delay: tuple[float, float]
    ) -> "Compression":
        """Return the compression for log tau in `center` ± `half_width` only, with fewer terms and rows.

        Both are numbers, or arrays with one for each time constant.
        Omitted terms change no response, and no decay of a `charge` (V), by more than `precision` (V, root of the
        sum of squares). If `charge` is 0, the decay is omitted. `delay` (s) is the range of delays, unless there are
        short time constants, which need all steps.
        """
        x, to_series = chebyshev(min(node_count(float(np.max(half_width))), self.signal.shape[1]))
        # nodes of the narrow table in the wide one, with NumPy because JAX would compile its loop for every record
        log_tau = (np.asarray(center)[..., None] + np.multiply.outer(half_width, x)).ravel()
        inside = (log_tau - float(self.center)) / float(self.half_width)
        polynomials = np.polynomial.chebyshev.chebvander(inside, self.signal.shape[1] - 1).T
        signal = np.asarray(self.signal @ polynomials)
        signal, voltage, steps, origin = self._move_origin(signal, np.exp(log_tau), delay)
        signal, decay = (
            values.reshape(len(values), -1, x.size) @ to_series.T
            for values in (signal, np.asarray(self.decay @ polynomials))
        )
        terms = count_terms(np.linalg.norm(signal, axis=0) + charge * np.linalg.norm(decay, axis=0), precision)
        basis, series = _significant_modes(signal[..., :terms].reshape(len(signal), -1), precision)
        charges, charge_series = _significant_modes(charge * decay[..., :terms].reshape(len(decay), -1), precision)
        columns = {name: np.asarray(getattr(self, name))[:, None] for name in ("observed_slope", "rate", "slope")}
        functions = [*([] if self.effects is None else self.effects), *([] if voltage is None else [voltage])]
        effects = np.reshape(functions, (-1, self.observed.size))
        found = orthogonal_coordinates(
            {"signal": basis, "steps": steps.T, "decay": charges, "effects": effects.T}
            | {"baseline": np.asarray(self.baseline).T, **columns, "observed": np.asarray(self.observed)[:, None]}
        )
        changed = dataclasses.replace(
            self,
            center=np.asarray(center),
            half_width=np.asarray(half_width),
            signal=found["signal"][: len(series)] @ series,
            decay=found["decay"] @ charge_series / (charge or 1.0),
            baseline=found["baseline"].T,
            steps=found["steps"].T,
            origin=np.asarray(origin),
            **dict[str, Any]({name: found[name][:, 0] for name in (*columns, "observed")}),
        )
        return changed.with_functions(found["effects"].T, self.voltage is not None)

    def with_functions(self, rows: Float[np.ndarray, "functions rows"], has_voltage: bool) -> "Compression":
        """Return the compression with the coordinates of effects, and of V as the last of these functions."""
        effects = rows[: len(rows) - has_voltage]
        voltage = rows[-1] if has_voltage else None
        return dataclasses.replace(self, effects=effects if len(effects) else None, voltage=voltage)

    def _move_origin(
        self, signal: Float[np.ndarray, "rank nodes"], tau: np.ndarray, delay: tuple[float, float]
    ) -> tuple[Float[np.ndarray, "rows nodes"], Float[np.ndarray, " rows"] | None, np.ndarray, float]:
        """Return signals at the nodes `tau` and V, delayed to a new origin in the range `delay`; its steps; itself."""
        signal = np.pad(np.asarray(signal), ((0, self.observed.size - len(signal)), (0, 0)))
        voltage = None if self.voltage is None else np.asarray(self.voltage)
        if not len(self.steps) or self.short:
            return signal, voltage, np.asarray(self.steps), float(self.origin)
        low, high = (edge / float(self.time_step) - float(self.origin) for edge in delay)
        middle = round(0.5 * (low + high))
        ages = 2 if max(high - middle, middle - low) <= 2.0 else self.reach  # two sizes, so that records share programs
        middle = min(max(middle, ages - self.reach), self.reach - ages)
        if abs(middle) * float(self.time_step) > 20.0 * np.min(tau):  # the way back would lose all digits
            return signal, voltage, np.asarray(self.steps), float(self.origin)
        first = middle - ages + self.reach
        origin = float(self.origin) + middle
        since = np.asarray(origin * float(self.time_step))
        growth, gains = self._shift(since, tau[:, None])
        voltage = None if voltage is None else self._shift_voltage(voltage, since)
        signal = growth.T * (signal + np.asarray(self.steps[:-1]).T @ gains.T)
        kept = [*range(first, first + 2 * ages), 2 * self.reach]
        return signal, voltage, np.asarray(self.steps)[kept], origin


def _significant_modes(
    coefficients: Float[np.ndarray, "rows terms"], precision: float
) -> tuple[Float[np.ndarray, "rows rank"], Float[np.ndarray, "rank terms"]]:
    """Return two factors of coefficients; what they omit changes a sum of series by at most `precision`."""
    modes, sizes, series = np.linalg.svd(coefficients, full_matrices=False)
    rank = count_terms(sizes, precision) if sizes[0] > 0.0 else 0
    return modes[:, :rank] * sizes[:rank], series[:rank]


class GridCompression(Compression):
    """A record in coordinates of the responses of a grid, which are the columns of `signal`.

    The model is linear in the weights of the grid. `slope` is the derivative of the signal with respect to a delay.
    """

    def covers(self, tau: Array, delay: ArrayLike = 0.0) -> Bool[Array, "*shape"]:
        """Return True, since the grid belongs to the circuit."""
        return np.ones(np.shape(tau), dtype=bool)

    def response(
        self, terms: HighpassTerms, delay: ArrayLike = 0.0, noise_gain: ArrayLike = 0.0
    ) -> Float[Array, " rows"]:
        """Return the response of a circuit, undelayed; compare `fitact.response`."""
        if terms.direct is not None:
            raise TypeError("a compression on a grid holds no V, which a leak of the insulator needs")
        total = self.signal @ jnp.asarray(terms.weight)
        total = jnp.pad(total, (0, self.observed.size - total.size))
        return total if terms.rate is None else total + terms.rate * self.rate


class Interpolation(eqx.Module):
    """A record in coordinates of a basis of its model's signals; compare `Compression`.

    The model is evaluated at a few samples, the points.
    """

    time: Float[Array, " points"]  # s
    rate: Float[Array, " points"] | None  # dV/dt at the points, V/s, if the channel follows it
    to_rows: Float[Array, "rows points"]  # coordinates from the signal at the points
    surplus: Float[Array, "checks points"]  # root of its mean square is 1 if the interpolation is barely accurate
    lowest: Float[Array, "2"]  # delay (s) and clock error from which on the kept samples suffice
    highest: Float[Array, "2"]
    baseline: Float[Array, "shapes rows"]  # the shapes of `BASELINE_NAMES`, of height 1
    slope: Float[Array, " rows"]  # derivative of the signal with respect to a delay at the optimum, per s
    observed: Float[Array, " rows"]  # the record, V or A
    samples: Float[Array, ""]  # number of samples
    effects: Float[Array, "effects points"] | None = None  # `ChannelLikelihood.effects` at the points

    def covers(self, tau: Array) -> Bool[Array, "*shape"]:
        """Return False, since the interpolation holds only where `holds` says so."""
        return np.zeros(np.shape(tau), dtype=bool)

    def holds(self, signal: Float[Array, " points"], timing: Float[Array, "2"]) -> Array:
        """Return whether the signal at the points is interpolated accurately, for this delay (s) and clock error."""
        within = jnp.all((timing >= self.lowest) & (timing <= self.highest))
        return within & (jnp.mean(jnp.square(self.surplus @ signal)) <= 1.0)
