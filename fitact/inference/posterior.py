"""Posterior: draws, summaries, force and friction, and the file that other programs open."""

import dataclasses
import functools
import importlib.metadata
import os
import platform
from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.files import replacing
from fitact.inference import derived, summary
from fitact.inference.chain import Chain
from fitact.inference.fit import Fit
from fitact.inference.likelihood import LINEAR, Batched, Likelihood, natural
from fitact.units import engineering

_DRAWS = 2500  # kept per ensemble, spread over its walkers and steps
_PREDICTED = 50  # records predicted per ensemble
_PREDICTED_SAMPLES = 4000  # at most that many of the record's samples are predicted
_PACKAGES = ("fitact", "jax", "equinox", "optimistix", "emcee", "numpy", "xarray")


@dataclasses.dataclass(frozen=True)
class Convergence:
    """How far a chain can be trusted; see `fitact.sample`."""

    converged: bool = False
    tau_max: float = float("nan")
    ess_min: float = 0.0
    rhat_max: float = float("nan")
    acceptance: float = float("nan")
    burn: int = 0
    steps: int = 0
    walkers: int = 0
    ensembles: int = 0
    stuck_walkers: int = 0
    interrupted: bool = False

    def __str__(self) -> str:
        verdict = "converged" if self.converged else "interrupted" if self.interrupted else "NOT converged"
        return (
            f"{verdict}: {self.ensembles} ensembles of {self.walkers} walkers, {self.steps} steps ({self.burn} of them"
            f" burn-in), autocorrelation time {self.tau_max:.2f}, effective draws {self.ess_min:,.0f},"
            f" split-R-hat {self.rhat_max:.4f}, accepted {100.0 * self.acceptance:.0f} %"
        )


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
        kept = chain.steps - convergence.burn
        step = max(1, -(-kept * convergence.walkers // _DRAWS))
        chosen = slice(convergence.burn + (kept - 1) % step, None, step)
        size = chain.points.shape[-1]
        points = chain.points[:, chosen].reshape(convergence.ensembles, -1, size)
        return cls(fit, points, chain.log_prob[:, chosen].reshape(points.shape[:2]), convergence, seed)

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of what the fit left free, the nuisances included, in SI units."""
        draws = natural(self.fit.likelihood, self.points[..., :-1]) | {"sigma": np.exp(self.points[..., -1])}
        linear = self._linear * np.asarray(self.fit.likelihood.linear_sd)
        return draws | {name: linear[..., i] for i, name in enumerate(LINEAR) if name in self.fit.linear}

    def force(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Per draw: mean, peak and rms of the electrostatic force by eq. (22), and mean friction by eq. (2), N.

        The permittivities follow each draw's Csc and Ci through eq. (3); thicknesses, area and friction are the
        scene's. Means run over whole periods of the drive.
        """
        return {name: values for name, values in self.derived().items() if name not in ("g", "b")}

    def derived(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of divider, time constant, force and friction, SI units."""
        return {name: self._derived[..., i] for i, name in enumerate(derived.NAMES)}

    @functools.cached_property
    def _deviates(self) -> np.ndarray:
        """Standard normal numbers that draw the linear nuisances."""
        return np.random.default_rng([self.seed, 1]).standard_normal((*self.points.shape[:2], len(LINEAR)))

    @functools.cached_property
    def _derived(self) -> np.ndarray:
        return self._each(_derived_of, self.fit.derive, rows=len(self.fit.record))

    @functools.cached_property
    def _linear(self) -> np.ndarray:
        """Draws of the linear nuisances, in prior standard deviations."""
        return self._each(_linear_of, self.fit.likelihood, rows=self.fit.likelihood.rows)

    def _each(
        self, function: Callable[..., Array], model: eqx.Module, rows: int, draws: Any = slice(None)
    ) -> np.ndarray:
        """`function` of the chosen draws; `rows`: numbers that one runs over."""
        points, deviates = self.points[:, draws], self._deviates[:, draws]
        flat = points.reshape(-1, points.shape[-1]), deviates.reshape(-1, len(LINEAR))
        with jax.enable_x64(True):
            values = Batched(function, model, rows)(*flat)
        return values.reshape(*points.shape[:2], -1)

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
        if self.convergence.interrupted:
            found.append("sampling was interrupted before it had converged; run the same command again to go on")
        elif not self.convergence.converged:
            found.append(f"the chain has not converged; allow more steps ({self.convergence})")
        return tuple(found)

    def summary(self) -> dict[str, Any]:
        """What summary.json holds."""
        fitted, prior_sd = (
            self.fit.to_dict(),
            dict(zip(self.fit.likelihood.prior.names, self.fit.likelihood.prior.log_sd, strict=True)),
        )
        parameters = {}
        for name, draws in self.parameters().items():
            parameters[name] = summary.of_draws(name, draws)
            if name in prior_sd:
                parameters[name]["contraction"] = float(1.0 - np.std(np.log(draws), ddof=1) / prior_sd[name])
        return {
            "parameters": parameters,
            "derived": {name: summary.of_draws(name, draws) for name, draws in self.derived().items()},
            "identifiability": fitted["identifiability"],
            "convergence": dataclasses.asdict(self.convergence),
            "fit": fitted["fit"],
            "model": fitted["model"],
            "warnings": list(self.warnings),
            "seed": self.seed,
            "record": self._record(),
            "scene": self.fit.scene.model_dump(mode="json", exclude_unset=True),
            "versions": _versions(),
        }

    def _record(self) -> dict[str, Any]:
        record = self.fit.record
        return {"source": os.path.basename(record.source), "samples": len(record), "sha256": record.fingerprint}

    def __str__(self) -> str:
        rows = [f"{'':14}{'median':>12}{'5 %':>14}{'95 %':>12}"]
        for name, draws in (self.parameters() | self.derived()).items():
            s = summary.of_draws(name, draws)
            median, low, high = (engineering(float(s[q]), str(s["unit"])) for q in ("q50", "q05", "q95"))
            rows.append(f"{name:14}{median:>12}{low:>14}{high:>12}")
        rows += [str(self.convergence), str(self.fit.identifiability)]
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

    def to_datatree(self) -> Any:
        """An `xarray.DataTree` in ArviZ's groups; chain: the independent ensembles."""
        import xarray as xr

        def dataset(draws: dict[str, np.ndarray]) -> xr.Dataset:
            variables = {
                name: xr.DataArray(values, dims=("chain", "draw"), attrs={"units": summary.UNITS[name]})
                for name, values in draws.items()
            }
            counts = next(iter(draws.values())).shape
            return xr.Dataset(variables, coords={"chain": np.arange(counts[0]), "draw": np.arange(counts[1])})

        record, rng = self.fit.record, np.random.default_rng([self.seed, 2])
        ensembles, count = self.points.shape[:2]
        believed = self.fit.likelihood.prior.sample(rng, ensembles * count)
        prior = {name: draws.reshape(ensembles, count) for name, draws in believed.items()}
        volts = {"units": "V"}
        observed = xr.Dataset(
            {"Vsc": ("time", record["Vsc"], volts)}, coords={"time": ("time", record.time, {"units": "s"})}
        )
        known = {"V": self.fit.choice.voltage, "Vsc_fit": record["Vsc"] - self.fit.residuals}
        known_data = xr.Dataset(
            {name: ("time", values, volts) for name, values in known.items()}, coords=observed.coords
        )
        statistics = xr.Dataset({"lp": (("chain", "draw"), self.log_prob)}, coords=dataset(prior).coords)
        return xr.DataTree.from_dict(
            {
                "/": xr.Dataset(attrs=self._attributes()),
                "posterior": dataset(self.parameters() | self.derived()),
                "sample_stats": statistics,
                "posterior_predictive": self._predicted(),
                "observed_data": observed,
                "constant_data": known_data,
                "prior": dataset(prior),
            }
        )

    def _attributes(self) -> dict[str, Any]:
        return {
            "inference_library": "fitact",
            "inference_library_version": importlib.metadata.version("fitact"),
            "record": self._record()["source"],
            "record_sha256": self.fit.record.fingerprint,
            "scene": self.fit.scene.to_json(),
            "seed": self.seed,
        }

    def _predicted(self) -> Any:
        """Records as the posterior predicts them, noise included, on the record's times (thinned where long)."""
        import xarray as xr

        ensembles, count = self.points.shape[:2]
        draws = np.linspace(0, count - 1, min(_PREDICTED, count)).astype(int)
        stride = -(-len(self.fit.record) // _PREDICTED_SAMPLES)
        mean = self._each(lambda *point: _signal_of(*point)[::stride], self.fit.likelihood, len(self.fit.record), draws)
        sigma = np.exp(self.points[:, draws, -1:])
        noise = np.random.default_rng([self.seed, 3]).standard_normal(mean.shape)
        values = (mean + sigma * noise).astype(np.float32)
        time = self.fit.record.time[::stride]
        return xr.Dataset(
            {"Vsc": (("chain", "draw", "time"), values, {"units": "V"})},
            coords={"chain": np.arange(ensembles), "draw": draws, "time": ("time", time, {"units": "s"})},
        )

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF (ArviZ's `from_netcdf` opens it)."""
        tree = self.to_datatree()
        packed = {"zlib": True, "complevel": 4}
        encoding = {node.path: {str(name): packed for name in node.data_vars} for node in tree.subtree}
        with replacing(path) as temporary:
            tree.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the report, one self-contained HTML page."""
        from fitact.report import write_report

        write_report(path, self.to_datatree(), self.summary())


def _versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in _PACKAGES}


def _derived_of(derive: derived.Derived, point: Array, deviate: Array) -> Array:
    return derive(point[:-1], jnp.exp(point[-1]), deviate)


def _linear_of(likelihood: Likelihood, point: Array, deviate: Array) -> Array:
    return likelihood.drawn(point[:-1], jnp.exp(point[-1]), deviate)


def _signal_of(likelihood: Likelihood, point: Array, deviate: Array) -> Array:
    theta, beta = point[:-1], _linear_of(likelihood, point, deviate)
    return likelihood.signal(theta) + (beta * likelihood.linear_sd) @ likelihood.shapes(theta)
