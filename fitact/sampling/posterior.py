"""Posterior: draws, summaries, force and friction, and the file that other programs open."""

import copy
import dataclasses
import functools
import importlib.metadata
import os
from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact import summary
from fitact.data.record import CHANNEL_UNITS
from fitact.files import replacing
from fitact.fitting import derived
from fitact.fitting.channel_fit import TraceFit
from fitact.fitting.fit import Fit
from fitact.likelihood.channel import LINEAR
from fitact.likelihood.likelihood import Batched, Likelihood
from fitact.likelihood.noise import draw_noise
from fitact.model_selection.plan import Plan
from fitact.sampling.chain import Chain
from fitact.sampling.convergence import Convergence
from fitact.units import unit_of

_DRAWS = 2500  # kept per ensemble, spread over its walkers and steps
_CHAINS = 4  # that independent draws are dealt out to
_PREDICTED = 50  # records predicted per ensemble
_PREDICTED_SAMPLES = 4000  # at most that many of the record's samples are predicted


@dataclasses.dataclass(frozen=True)
class Posterior:
    """Draws of the parameters, and what follows from them.

    Attributes:
        fit: what the chain started from.
        points: (ensembles, draws, coordinates): draws in the chain's coordinates, burn-in left out, thinned.
        log_prob: of the points.
        convergence: how far they can be trusted.
        seed: of every random number here.
    """

    fit: Fit
    points: Float[np.ndarray, "ensembles draws n"]
    log_prob: Float[np.ndarray, "ensembles draws"]
    convergence: Convergence
    seed: int

    @classmethod
    def from_chain(cls, fit: Fit, chain: Chain, convergence: Convergence, seed: int) -> Self:
        """Leave out the burn-in and thin."""
        chosen = chain.thinned(convergence.burn, _DRAWS)
        size = chain.points.shape[-1]
        points = chain.points[:, chosen].reshape(convergence.ensembles, -1, size)
        return cls(fit, points, chain.log_prob[:, chosen].reshape(points.shape[:2]), convergence, seed)

    @classmethod
    def from_draws(
        cls,
        fit: Fit,
        points: Float[np.ndarray, "draws n"],
        log_prob: Float[np.ndarray, " draws"],
        convergence: Convergence,
        seed: int,
    ) -> Self:
        """Independent draws, dealt out to as many chains as `sample` has ensembles."""
        points = points.reshape(_CHAINS, -1, points.shape[1])
        return cls(fit, points, log_prob.reshape(points.shape[:2]), convergence, seed)

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of what the fit left free, the nuisances included, in SI units."""
        likelihood, size = self.fit.likelihood, self.fit.theta.size
        draws = likelihood.natural(self.points[..., :size])
        draws |= {name: np.exp(self.points[..., size + i]) for i, name in enumerate(likelihood.sigma_names)}
        for trace, drawn in zip(likelihood.traces, np.moveaxis(self._linear, -2, 0), strict=True):
            for column in trace.columns:
                draws[trace.named(LINEAR[column])] = drawn[..., column] * float(trace.linear_sd[column])
        return draws

    def force(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Per draw: mean, peak and rms of the electrostatic force, and mean friction by eq. (2), N.

        By eq. (22), where the permittivities follow each draw's Csc and Ci through eq. (3); or, with the scene's
        `[force] model = "gap"`, across the gap. Thicknesses, area and friction are the scene's. Means run over whole
        periods of the drive.
        """
        return {name: values for name, values in self.derived().items() if name not in ("g", "b")}

    def derived(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of divider, time constant, force and friction, SI units."""
        return {name: self._derived[..., i] for i, name in enumerate(derived.NAMES)}

    @functools.cached_property
    def _deviates(self) -> np.ndarray:
        """Standard normal numbers that draw the linear nuisances of each trace."""
        shape = (*self.points.shape[:2], len(self.fit.traces), len(LINEAR))
        return np.random.default_rng([self.seed, 1]).standard_normal(shape)

    @functools.cached_property
    def _derived(self) -> np.ndarray:
        return self._each(_derived_of, self.fit.derive, rows=self.fit.likelihood.traces[0].time.size)

    @functools.cached_property
    def _linear(self) -> np.ndarray:
        """Draws of the linear nuisances of each trace, in prior standard deviations."""
        return self._each(_linear_of, self.fit.likelihood, rows=self.fit.likelihood.rows)

    def _each(
        self, function: Callable[..., Array], model: eqx.Module, rows: int, draws: Any = slice(None)
    ) -> np.ndarray:
        """`function` of the chosen draws; `rows`: numbers that one runs over."""
        points, deviates = self.points[:, draws], self._deviates[:, draws]
        flat = points.reshape(-1, points.shape[-1]), deviates.reshape(-1, *deviates.shape[2:])
        with jax.enable_x64(True):
            values = Batched(function, model, rows)(*flat)
        return values.reshape(*points.shape[:2], *values.shape[1:])

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer."""
        return self.fit.trusted and self.convergence.converged

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        found = list(self.fit.warnings)
        if not self.fit.trusted:
            found.append(self.fit.message)
        if self.convergence.warning:
            found.append(self.convergence.warning)
        return tuple(found)

    def summary(self) -> dict[str, Any]:
        """What summary.json holds."""
        return copy.deepcopy(self._summary)

    @functools.cached_property
    def _summary(self) -> dict[str, Any]:
        prior_sd = dict(zip(self.fit.likelihood.prior.names, self.fit.likelihood.prior.log_sd, strict=True))
        parameters = {}
        for name, draws in self.parameters().items():
            parameters[name] = summary.of_draws(name, draws)
            if name in prior_sd:
                parameters[name]["contraction"] = float(1.0 - np.std(np.log(draws), ddof=1) / prior_sd[name])
        return {
            "parameters": parameters,
            "derived": {name: summary.of_draws(name, draws) for name, draws in self.derived().items()},
            "identifiability": self.fit.identifiability.to_dict() | {"sentence": str(self.fit.identifiability)},
            "convergence": dataclasses.asdict(self.convergence) | {"sentence": str(self.convergence)},
            "fit": self.fit.judgement(),
            "model": self.fit.model(),
            "warnings": list(self.warnings),
            "seed": self.seed,
            "record": self._record(),
            "scene": self.fit.scene.model_dump(mode="json", exclude_unset=True),
            "versions": summary.versions(),
        }

    def _record(self) -> dict[str, Any]:
        records = self.fit.records
        return {
            "source": os.path.basename(records[0].source),
            "samples": sum(map(len, records)),
            "sha256": records[0].fingerprint,
            "sources": [{"source": os.path.basename(r.source), "sha256": r.fingerprint} for r in records],
        }

    def __str__(self) -> str:
        return summary.table(self._summary)

    def to_datatree(self) -> Any:
        """An `xarray.DataTree` in ArviZ's groups; chain: the independent ensembles."""
        import xarray as xr

        def dataset(draws: dict[str, np.ndarray]) -> xr.Dataset:
            variables = {
                name: xr.DataArray(values, dims=("chain", "draw"), attrs={"units": unit_of(name)})
                for name, values in draws.items()
            }
            counts = next(iter(draws.values())).shape
            return xr.Dataset(variables, coords={"chain": np.arange(counts[0]), "draw": np.arange(counts[1])})

        rng = np.random.default_rng([self.seed, 2])
        ensembles, count = self.points.shape[:2]
        believed = self.fit.likelihood.prior.sample(rng, ensembles * count)
        prior = {name: draws.reshape(ensembles, count) for name, draws in believed.items()}
        observed, known = xr.Dataset(), xr.Dataset()
        for trace in self.fit.traces:
            time, name = _axis(trace), _name(trace)
            unit = {"units": CHANNEL_UNITS[trace.channel]}
            at = {time: (time, trace.record.time, {"units": "s"})}
            values = trace.record[trace.channel]
            observed = observed.merge(xr.Dataset({name: (time, values, unit)}, coords=at))
            kept = np.isfinite(self._spread(trace))
            fitted = {f"{name}_fit": (time, np.where(kept, values - trace.residuals, np.nan), unit)}
            drive = {_name(trace, "V"): (time, trace.choice.voltage, {"units": "V"})}
            known = known.merge(xr.Dataset(fitted | drive, coords=at))
        statistics = xr.Dataset({"lp": (("chain", "draw"), self.log_prob)}, coords=dataset(prior).coords)
        return xr.DataTree.from_dict(
            {
                "/": xr.Dataset(attrs=self._attributes()),
                "posterior": dataset(self.parameters() | self.derived()),
                "sample_stats": statistics,
                "posterior_predictive": self._predicted,
                "observed_data": observed,
                "constant_data": known,
                "prior": dataset(prior),
            }
        )

    def _attributes(self) -> dict[str, Any]:
        return {
            "inference_library": "fitact",
            "level": self.convergence.level,
            "inference_library_version": importlib.metadata.version("fitact"),
            "record": self._record()["source"],
            "record_sha256": self.fit.record.fingerprint,
            "scene": self.fit.scene.to_json(),
            "seed": self.seed,
        }

    @functools.cached_property
    def _predicted(self) -> Any:
        """Records as the posterior predicts them, noise included, on the record's times (thinned where long)."""
        import xarray as xr

        ensembles, count = self.points.shape[:2]
        draws = np.linspace(0, count - 1, min(_PREDICTED, count)).astype(int)
        rng = np.random.default_rng([self.seed, 3])
        found = xr.Dataset(coords={"chain": np.arange(ensembles), "draw": draws})
        for i, (trace, model) in enumerate(zip(self.fit.traces, self.fit.likelihood.traces, strict=True)):
            stride = -(-len(trace.record) // _PREDICTED_SAMPLES)
            signal = functools.partial(_signal_of, i, stride)
            time = trace.record.time[::stride]
            mean = self._each(signal, self.fit.likelihood, model.time.size, draws)[..., : time.size]
            sigma = np.exp(self.points[:, draws, self.fit.theta.size + i, None])
            noise = draw_noise(rng, model.noise, model.whitening, mean.shape, stride)
            noisy = mean + sigma * self._spread(trace)[::stride] * noise
            axis, unit = _axis(trace), {"units": CHANNEL_UNITS[trace.channel]}
            found[_name(trace)] = ("chain", "draw", axis), noisy.astype(np.float32), unit
            found = found.assign_coords({axis: (axis, time, {"units": "s"})})
        return found

    @staticmethod
    def _spread(trace: TraceFit) -> Float[np.ndarray, " samples"]:
        """Standard deviation of each sample's noise over the trace's; NaN where one was left out."""
        if trace.weight is None:
            return np.ones(len(trace.record))
        kept = trace.weight > 0.0
        return np.where(kept, 1.0 / np.where(kept, trace.weight, 1.0), np.nan)

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF (ArviZ's `from_netcdf` opens it)."""
        tree = self.to_datatree()
        packed = {"zlib": True, "complevel": 4}
        encoding = {node.path: {str(name): packed for name in node.data_vars} for node in tree.subtree}
        with replacing(path) as temporary:
            tree.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)

    def report(self, path: str | os.PathLike[str], plan: Plan | None = None) -> None:
        """Write the report, one self-contained HTML page; with `plan`, whose scene was fitted, what that left out."""
        from fitact.report import write_report

        stated = {} if plan is None else {"plan": {"used": "planned", "sentence": plan.sentence} | plan.to_dict()}
        write_report(path, self.to_datatree(), self.summary() | stated)


def _axis(trace: TraceFit) -> str:
    """The name of a trace's time axis."""
    number = trace.label.rpartition("_")[2]
    return f"time_{number}" if number.isdigit() else "time"


def _name(trace: TraceFit, channel: str = "") -> str:
    """The name of a trace, or of another channel of its record."""
    return (channel or trace.channel) + _axis(trace).removeprefix("time")


def _derived_of(derive: derived.Derived, point: Array, deviate: Array) -> Array:
    theta, log_sigma = derive.likelihood.split(point)
    return derive(theta, jnp.exp(log_sigma), deviate)


def _linear_of(likelihood: Likelihood, point: Array, deviate: Array) -> Array:
    theta, log_sigma = likelihood.split(point)
    parts = zip(likelihood.each(theta), jnp.exp(log_sigma), deviate, strict=True)
    return jnp.stack([trace.drawn(seen, sigma, each) for (trace, seen), sigma, each in parts])


def _signal_of(index: int, stride: int, likelihood: Likelihood, point: Array, deviate: Array) -> Array:
    theta, log_sigma = likelihood.split(point)
    trace, seen = likelihood.traces[index], likelihood.seen(theta, index)
    beta = trace.drawn(seen, jnp.exp(log_sigma[index]), deviate[index])
    return (trace.signal(seen) + (beta * trace.linear_sd) @ trace.shapes(seen))[::stride]
