"""Records of one scene, drive and time grid, fitted together: each step of least squares is taken for all of them.

Only what is beyond doubt is settled here: a record that asks for a nuisance, was clipped, is not described, or does
not converge within a few steps is left for a fit of its own.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from fitact.batch.shared_basis import SharedBasis
from fitact.data.record import white_noises
from fitact.fitting import derived
from fitact.fitting.derived import Derived
from fitact.fitting.least_squares import EVIDENCE, NUISANCES, bic_gain
from fitact.fitting.problem import PRECISION, Problem, believed_skin, on_the_ridge
from fitact.fitting.residual_statistics import is_misfit, judged
from fitact.fitting.residual_tests import Phases, Structure, counts
from fitact.likelihood.compression import NODES, REACH, chebyshev
from fitact.likelihood.likelihood import Likelihood
from fitact.model.chirp import Chirp
from fitact.model.skin import WithSkin

_LONGEST = 65_536  # samples, above which a fit by itself costs no more
_STEPS = 20
_CONVERGED = 1e-6  # standard errors from the optimum at the end,
_NEAR = 1e-4  # and before the last step, which squares what is left
_ROUNDED = 1e-3  # of the residuals' square: what coordinates may lose of it where noise is very low,
_SUMMED = 32.0 * np.finfo(float).eps  # which is no more than this part of the record's own square (12 eps was seen)
_STRIDE = 1.0  # longest step in a logarithm
_DEPENDENT = 1e-9  # of a column's length: what rounding leaves of one that depends on others
_DOUBT = 3.0  # of the Bayesian information criterion: error of a clock's evidence, whose shape is not exact here
_RESOLVED = 512  # samples that tell whether noise hides the converter's steps
_RAIL = 3  # samples at an extreme, from which it may be a rail
_AT_ONCE = 64  # records, whose samples stay in the processor's cache
_CANDIDATES = (*NUISANCES, "delay", "clock")  # nuisances that a record may ask for


class Settled(NamedTuple):
    """Optima of records fitted together, one a row.

    Attributes:
        clear: where nothing is in doubt; elsewhere the other fields mean nothing.
        coordinates: of the records, as by `SharedBasis.project`.
        theta, sigma, root: as `Fit.theta`, `Fit.sigma` and `Fit.covariance_root`.
        logs, gradients: of `derived.NAMES`, as of `Derived.logs`.
        figures: as `Fit.figures`.
    """

    clear: Bool[np.ndarray, " records"]
    coordinates: Float[np.ndarray, "records coordinates+1"]
    theta: Float[np.ndarray, "records parameters"]
    sigma: Float[np.ndarray, " records"]
    root: Float[np.ndarray, "records parameters parameters"]
    logs: Float[np.ndarray, "records derived"]
    gradients: Float[np.ndarray, "records derived parameters"]
    figures: dict[str, np.ndarray]


class Ends(NamedTuple):
    """Where least squares end, of a record or of many.

    Attributes:
        theta, sigma: as `Fit.theta`, `Fit.sigma`.
        square: sum of the residuals' squares by the coordinates, V^2.
        triangle: of the whitened Jacobian's QR decomposition.
        shares: of `_CANDIDATES` in the residuals' square.
        signal: the response, in the first coordinates of the basis.
        ended: whether at the optimum.
    """

    theta: Float[Array, "*records parameters"]
    sigma: Float[Array, "*records"]
    square: Float[Array, "*records"]
    triangle: Float[Array, "*records parameters parameters"]
    shares: Float[Array, "*records nuisances"]
    signal: Float[Array, "*records rank"]
    ended: Bool[Array, "*records"]


@dataclasses.dataclass(frozen=True)
class Together:
    """What records of one scene, drive and time grid share.

    Attributes:
        likelihood: in the coordinates of `basis`.
        phases: of the samples in the drive's period; None: too little repeats.
        samples: of each.
        freeable: nuisances that a record may ask for.
    """

    likelihood: Likelihood
    derive: Derived
    basis: SharedBasis
    phases: Phases | None
    samples: int
    freeable: tuple[str, ...]

    @classmethod
    def like(cls, problem: Problem) -> "Together | None":
        """For records like that of `problem`; None where such cannot be fitted together. In double precision."""
        likelihood, (source, *others) = problem.likelihood, problem.sources
        (trace, *_), choice, start = likelihood.traces, source.choice, source.start
        if others or start is None or not math.isfinite(start.b) or trace.own > _LONGEST:
            return None
        plain = trace.channel == "Vsc" and trace.noise == "white" and trace.equally_weighted and not trace.timing
        known = not (isinstance(likelihood.template, WithSkin) or isinstance(choice.drive, Chirp))
        own = bool(np.any(np.asarray(trace.linear_sd))) or bool(choice.notes) or choice.shift != 0.0
        if not (plain and known) or own or choice.name == "measured":
            return None
        time = source.record.time
        basis = SharedBasis.around(choice.drive, time, choice.steady_state, start.b)
        shared = dataclasses.replace(trace, compression=basis.compression(time.size), columns=()).without_samples()
        derive = derived.for_fit(likelihood, source.record, choice, source.scene, start.b)
        of_time = Phases.of(time, source.record.frequency() if choice.periodic else None)
        return cls(likelihood.with_trace(0, shared), derive, basis, of_time, time.size, source.freeable)

    def settle(self, observed: Sequence[Float[np.ndarray, " samples"]], whiteness: bool = True) -> Settled:
        """Fit records, and test their residuals for structure (`whiteness`). In double precision."""
        parts = list(_parts(observed))
        seen = [(*_seen(part), self.basis.project(part)) for part in parts]
        noise, height, plain, coordinates = map(np.concatenate, zip(*seen, strict=True))
        found, held = self.optima(coordinates, noise, PRECISION * height)
        theta, sigma, inside, triangle, shares, signal, ended = map(np.asarray, found)
        logs, gradients = map(np.asarray, _derived(self.derive, found.theta, found.sigma))
        if whiteness:
            square, structure = self._left(parts, signal)
            held &= np.abs(inside - square) <= _ROUNDED * square
        else:
            square, structure = inside, None
            held &= _SUMMED * np.vecdot(coordinates, coordinates) <= _ROUNDED * square
        figures = judged(square, self.samples, structure, noise, self.samples - theta.shape[1], self.phases)
        figures |= {"rounding_noise": np.zeros(len(noise)), "interpolation_error": np.zeros(len(noise))}
        clear = held & ended & ~self._asked_for(shares) & plain & ~is_misfit(figures)
        return Settled(clear, coordinates, theta, sigma, np.linalg.inv(triangle), logs, gradients, figures)

    def _left(
        self, parts: Sequence[np.ndarray], signal: Float[np.ndarray, "records rank"]
    ) -> tuple[Float[np.ndarray, " records"], Structure]:
        """Of the samples, when the responses are taken off: the sums of squares, and what structure is left."""
        starts = range(0, len(signal), _AT_ONCE)
        responses = (self.basis.response(signal[start : start + _AT_ONCE]) for start in starts)
        residuals = (np.subtract(part, u, out=u) for part, u in zip(parts, responses, strict=True))
        found = [(np.vecdot(r, r), *Structure.of(r.astype(np.float32), self.phases)) for r in residuals]
        square, *shown = map(np.concatenate, zip(*found, strict=True))
        return square, Structure(*shown)

    def optima(
        self,
        coordinates: Float[np.ndarray, "records coordinates+1"],
        noise: Float[np.ndarray, " records"],
        least: Float[np.ndarray, " records"],
    ) -> tuple[Ends, Bool[np.ndarray, " records"]]:
        """Least squares alone, and which records the table holds; sigma begins at `noise` and ends above `least`, V.

        `coordinates` are those that `basis` projects records on.
        """
        theta, held = self._starts(coordinates)
        of_each = map(jnp.asarray, (coordinates, theta, np.maximum(noise, least), least))
        return _optima(self.likelihood, jnp.asarray(np.append(self.basis.clock, 0.0)), *of_each), held

    def _starts(
        self, coordinates: Float[np.ndarray, "records coordinates+1"]
    ) -> tuple[Float[np.ndarray, "records parameters"], Bool[np.ndarray, " records"]]:
        """The best response of the table's nodes to each, on the ridge, and whether the table holds it."""
        tau, signal, size = self._nodes
        products = coordinates[:, : len(signal)] @ signal
        best = np.argmax(np.where(products > 0.0, products**2 / size, -1.0), axis=1)
        most = products[np.arange(len(best)), best]
        inside = (best > 0) & (best < NODES - 1) & (most > 0.0)
        theta = np.tile(self.likelihood.prior.log_mean, (len(best), 1))
        ridge = on_the_ridge(most / size[best], tau[best], *self._believed)
        for name, logs in zip(("Rsc", "Csc", "Ci"), ridge.T, strict=True):
            if name in self.likelihood.names:
                theta[:, self.likelihood.names.index(name)] = logs
        return theta, inside

    @functools.cached_property
    def _nodes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the table: time constants (s), the responses to the drive (one a column), and their squares."""
        x, _ = chebyshev(NODES)
        signal = self.basis.signal @ np.polynomial.chebyshev.chebvander(x, NODES - 1).T
        return np.exp(self.basis.center + REACH * x), signal, np.einsum("ij,ij->j", signal, signal)

    @functools.cached_property
    def _believed(self) -> tuple[np.ndarray, np.ndarray]:
        return believed_skin(self.likelihood)

    @functools.cached_property
    def prior_root(self) -> Float[np.ndarray, "parameters parameters"]:
        """As of the likelihood."""
        return self.likelihood.prior_root

    def _asked_for(self, shares: Float[np.ndarray, "records nuisances"]) -> Bool[np.ndarray, " records"]:
        """Whether a nuisance may be asked for."""
        gains = [
            bic_gain(share, self.samples, len(NUISANCES.get(name, (0,)))) + (_DOUBT if name == "clock" else 0.0)
            for name, share in zip(_CANDIDATES, shares.T, strict=True)
            if name in self.freeable
        ]
        return np.max(gains, axis=0, initial=-math.inf) > EVIDENCE


def _parts(rows: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    for first in range(0, len(rows), _AT_ONCE):
        part = rows[first : first + _AT_ONCE]
        yield np.concatenate(part).reshape(len(part), -1)  # which takes less than `np.stack`


def _seen(observed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of records: their noise, their height, and whether they show neither a rail nor the steps of a converter."""
    noise, low, high = white_noises(observed), observed.min(axis=1), observed.max(axis=1)
    apart = np.abs(np.diff(observed[:, :_RESOLVED], axis=1))
    fine = np.any((apart > 0.0) & (apart <= noise[:, None]), axis=1)
    railed = [counts(observed == extreme[:, None]) > _RAIL for extreme in (low, high)]
    return noise, high - low, fine & ~np.any(railed, axis=0)


@eqx.filter_jit
def _optima(likelihood: Likelihood, clock: Array, *of_each: Array) -> Ends:
    return jax.vmap(lambda *of: _optimum(likelihood, clock, *of))(*of_each)


def _optimum(likelihood: Likelihood, clock: Array, observed: Array, start: Array, noise: Array, least: Array) -> Ends:
    """Gauss-Newton from a start near the optimum, the noise being that of the residuals."""
    trace = likelihood.traces[0]
    assert trace.compression is not None
    table = dataclasses.replace(trace.compression, observed=observed)
    model = likelihood.with_trace(0, dataclasses.replace(trace, compression=table))
    size = start.size

    def linearised(theta: Array, sigma: Array) -> tuple[Array, Array]:
        def whitened(theta: Array) -> Array:
            return jnp.concatenate([*model.residuals(theta, sigma[None]), model.prior_residuals(theta)])

        columns = jax.vmap(lambda along: jax.jvp(whitened, (theta,), (along,)), out_axes=(None, -1))
        return columns(jnp.eye(size))

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        theta, sigma, _, steps = state
        residuals, jacobian = linearised(theta, sigma)
        triangle, along = _triangular(jacobian, residuals)
        move = -_solved(triangle, along)
        move = move * jnp.minimum(1.0, _STRIDE / jnp.max(jnp.abs(move)))
        spread = sigma * jnp.linalg.norm(residuals[:-size]) / jnp.sqrt(trace.count - size)
        return theta + move, jnp.maximum(spread, least), jnp.linalg.norm(along), steps + 1

    def goes_on(state: tuple[Array, ...]) -> Array:
        return (state[2] > _NEAR) & (state[3] < _STEPS)

    theta, sigma, _, _ = lax.while_loop(goes_on, step, (start, noise, jnp.array(jnp.inf), jnp.array(0)))
    residuals, jacobian = linearised(theta, sigma)
    left, (triangle, along) = sigma * residuals[:-size], _triangular(jacobian, residuals)
    within = jnp.isfinite(model.log_prior(jnp.append(theta, jnp.log(sigma))))
    ended = (jnp.linalg.norm(along) <= _CONVERGED) & within & table.holds(model.circuit(theta).b)
    candidates = [[table.slow[place] for place in places] for places in NUISANCES.values()]
    candidates += [[trace.slope(model.seen(theta))], [clock]]
    known = _orthonormal(list(jacobian[:-size].T), [])
    shares = [sum(jnp.square(q @ left) for q in _orthonormal(each, known)) for each in candidates]
    square, signal = left @ left, (observed - left)[: table.signal.shape[0]]
    return Ends(theta, sigma, square, triangle, jnp.stack(shares) / square, signal, ended)


def _orthonormal(columns: list[Array], others: list[Array], least: float = _DEPENDENT) -> list[Array]:
    """Columns made so against `others` and each other, by Gram and Schmidt, twice.

    0 for one of which no more than `least` of its length is left.
    """
    found: list[Array] = []
    for column in columns:
        rest = column
        for _ in range(2):
            for q in (*others, *found):
                rest = rest - (q @ rest) * q
        length = jnp.linalg.norm(rest)
        found.append(jnp.where(length > least * jnp.linalg.norm(column), rest / length, 0.0))
    return found


def _triangular(jacobian: Float[Array, "rows n"], residuals: Array) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """R and Q' residuals of the QR decomposition: vectorised over many small ones, unlike LAPACK's."""
    q = jnp.stack(_orthonormal(list(jacobian.T), [], least=0.0))
    return jnp.triu(q @ jacobian), q @ residuals


def _solved(triangle: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Of an upper triangle, by substitution."""
    found = jnp.zeros_like(right)
    for i in reversed(range(right.size)):
        found = found.at[i].set((right[i] - triangle[i] @ found) / triangle[i, i])
    return found


@eqx.filter_jit
def _derived(derive: Derived, theta: Array, sigma: Array) -> tuple[Array, Array]:
    """As `Derived.logs`, of each record."""

    def logs(theta: Array, sigma: Array) -> tuple[Array, Array]:
        def of(theta: Array) -> Array:
            return jnp.log(derive(theta, sigma[None]))

        return of(theta), jax.jacfwd(of)(theta)

    return jax.vmap(logs)(theta, sigma)
