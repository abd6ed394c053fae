"""Posterior: draws, summaries, force and friction, and the NetCDF file."""

import copy
import dataclasses
import functools
import importlib.metadata
import math
import os
from collections import defaultdict
from typing import Any, Protocol, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from fitact import charts, result_text, summary
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.files import atomic_write
from fitact.fitting import derived
from fitact.fitting.channel_fit import ChannelFit
from fitact.fitting.geometry import Capacitances
from fitact.fitting.result import Fit
from fitact.fitting.sensation import FeltDrive
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import draw_noise
from fitact.likelihood.spectrum_observable import join_complex
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.model.drive import Periodic
from fitact.sampling.chain import Chain
from fitact.sampling.convergence import Convergence
from fitact.tables import Display, to_dataframe, to_dataset, to_datatree
from fitact.uncertainty.budget import Budget
from fitact.units import quantity_unit


class ReducedModel(Protocol):
    """Model without the elements of the scene that can be neglected, as a report states it; `Plan` is one."""

    @property
    def sentence(self) -> str:
        """Neglected elements and the resulting errors, in a sentence."""

    def to_dict(self) -> dict[str, Any]:
        """Return the omissions as a JSON object."""


@dataclasses.dataclass(frozen=True, repr=False)
class Posterior(Display):
    """Draws of the parameters and of the derived quantities.

    Attributes:
        fit: the fit that was sampled.
        points: (ensembles, draws, coordinates): draws in the coordinates of the chain, without burn-in, thinned.
        log_prob: log-posterior of the points.
        convergence: diagnostics of the sampler.
        seed: seed of all random numbers.
    """

    fit: Fit
    points: Float[np.ndarray, "ensembles draws n"]
    log_prob: Float[np.ndarray, "ensembles draws"]
    convergence: Convergence
    seed: int

    @classmethod
    def from_chain(cls, fit: Fit, chain: Chain, convergence: Convergence, seed: int, draws: int = 2500) -> Self:
        """Discard the burn-in and thin to `draws` of each ensemble, from all walkers and steps."""
        chosen = chain.thinning_slice(convergence.burn, draws)
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
        """Split independent draws into 4 chains, as many as `sample` has ensembles."""
        points = points.reshape(4, -1, points.shape[1])
        return cls(fit, points, log_prob.reshape(points.shape[:2]), convergence, seed)

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Return draws of the free parameters, including nuisances, in SI units."""
        likelihood, size = self.fit.likelihood, self.fit.theta.size
        draws = likelihood.to_physical(self.points[..., :size])
        draws |= {name: np.exp(self.points[..., size + i]) for i, name in enumerate(likelihood.sigma_names)}
        for channel, drawn in zip(likelihood.channels, np.moveaxis(self._linear_draws, -2, 0), strict=True):
            values = drawn * np.asarray(channel.linear_sd)
            names = channel.observable.linear_names
            draws |= {channel.qualified_name(names[column]): values[..., column] for column in channel.columns}
        return draws | {name: np.exp(logs) for name, logs in self._geometry_logs.items()}

    def force(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Return mean, peak and rms of the electrostatic force, and mean friction by eq. (2), of each draw, N.

        The force is computed with eq. (22), with permittivities from Csc and Ci of each draw by eq. (3), or with the
        interface-gap law for `[force] model = "gap"`. Thicknesses, area and friction are those of the scene; they
        are drawn where it states a distribution. Means are over whole periods of the drive.
        """
        return {name: x for name, x in self.derived().items() if name.startswith(("force", "friction"))}

    def derived(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Return draws of divider, time constant, force and friction, SI units.

        With a table of thresholds in the scene also `times_threshold`, see `sensation`.
        """
        draws = {name: self._derived_draws[..., i] for i, name in enumerate(derived.DERIVED_NAMES)}
        felt = self.sensation
        return (
            draws if felt is None or felt.times_threshold is None else draws | {"times_threshold": felt.times_threshold}
        )

    @functools.cached_property
    def sensation(self) -> FeltDrive | None:
        """How far the drive is felt, by the scene's table of thresholds; None if it states none."""
        fit, record, drive = self.fit, self.fit.records[0], self.fit.derive.drive
        frequency = None if isinstance(record, Spectrum) else record.frequency()
        if fit.derive.steady_state and isinstance(drive, Periodic):
            frequency = float(np.asarray(drive.frequency))
        felt = FeltDrive.from_draws(fit.derive, fit.likelihood, fit.scene, frequency, self.points, self.seed)
        if felt is None or felt.times_threshold is None or not self._geometry_logs:
            return felt
        mean, logs = derived.DERIVED_NAMES.index("force_mean"), self._geometry_logs
        scale = self._derived_draws[..., mean] / self._nominal_draws[..., mean]
        if "friction_coefficient" in logs:
            scale = scale * np.exp(logs["friction_coefficient"]) / float(fit.scene.friction.coefficient)
        return dataclasses.replace(felt, times_threshold=scale * felt.times_threshold)

    @functools.cached_property
    def _deviates(self) -> np.ndarray:
        """Standard normal numbers that draw the linear nuisances of each channel."""
        return derived.nuisance_deviates(self.fit.likelihood, self.points, self.seed)

    @functools.cached_property
    def _nominal_draws(self) -> np.ndarray:
        """Draws of the derived quantities at the nominal geometry."""
        return derived.draw_derived(self.fit.derive, self.fit.likelihood, self.points, self.seed)

    @functools.cached_property
    def _derived_draws(self) -> np.ndarray:
        if not self._geometry_logs:
            return self._nominal_draws
        return self.fit.laplace.geometry.change_derived(self._capacitances, self._geometry_logs, self._nominal_draws)

    @functools.cached_property
    def _geometry_logs(self) -> dict[str, np.ndarray]:
        """Draws of the logarithms of what force and friction rest on beside the circuit, as far as stated."""
        return self.fit.laplace.geometry.draw_logs(self._capacitances, self.points.shape[:-1], self.seed)

    @property
    def _capacitances(self) -> Capacitances:
        return Capacitances.from_theta(self.fit.likelihood, self.points[..., : self.fit.theta.size])

    @functools.cached_property
    def _linear_draws(self) -> np.ndarray:
        """Draws of the linear nuisances of each channel, in prior standard deviations."""
        likelihood = self.fit.likelihood
        return derived.evaluate_draws(_draw_linear_nuisances, likelihood, likelihood.rows, self.points, self._deviates)

    @property
    def trusted(self) -> bool:
        """Whether the fit is reliable and the sampler converged."""
        return self.fit.trusted and self.convergence.converged

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what may change the result."""
        message = "" if self.fit.trusted else self.fit.message
        return (*self.fit.warnings, *filter(None, (message, self.convergence.warning)))

    def summary(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        return copy.deepcopy(self._summary)

    @functools.cached_property
    def _summary(self) -> dict[str, Any]:
        drawn, prior = self.parameters(), self.fit.likelihood.prior
        summaries = {name: summary.summarize_draws(name, draws) for name, draws in (drawn | self.derived()).items()}
        for name, fitted in (self.fit.parameters() | self.fit.derived()).items():
            summaries[name]["from_prior"] = fitted["from_prior"]
        for name, draws in (drawn | self.derived()).items():
            mean, sd = float(np.mean(draws)), float(np.std(draws, ddof=1))
            budget = self._budgets.get(_budget_name(name))
            if budget is not None:
                combined = summary.summarize_draws(name, self.combined_draws[name])
                summaries[name]["u"] = budget.u
                sizes = budget.combined_budget.u, budget.combined_budget.origins()
                summaries[name]["combined"] = summary.describe_combined(combined, *sizes)
            elif name not in self.fit.assumed_quantities:
                summaries[name]["u"] = sd / abs(mean) if mean else math.inf
        for name, prior_sd in zip(prior.names, prior.log_sd, strict=True):
            summaries[name]["contraction"] = float(1.0 - np.std(np.log(drawn[name]), ddof=1) / prior_sd)
        for name, law in self.fit.laplace.geometry.stated.items():
            summaries[name]["contraction"] = float(1.0 - np.std(np.log(drawn[name]), ddof=1) / law.log_sd)
        return {
            "parameters": {name: summaries[name] for name in drawn},
            "derived": {name: summaries[name] for name in self.derived()},
            "identifiability": self.fit.identifiability.to_dict() | {"sentence": str(self.fit.identifiability)},
            "convergence": dataclasses.asdict(self.convergence) | {"sentence": str(self.convergence)},
            "fit": self.fit.judgement(),
            "model": self.fit.model(),
            "force_basis": self.fit.force_basis,
            **self._describe_sensation(),
            "budget": self._budget_entries(),
            **self.fit.effects.to_dict(),
            **self.fit.validity(),
            "warnings": list(self.warnings),
            "notes": [*self.fit.notes, *self.fit.effect_notes],
            "seed": self.seed,
            "record": self._record(),
            "scene": self.fit.scene.model_dump(mode="json", exclude_unset=True),
            "versions": summary.versions(),
        }

    def _describe_sensation(self) -> dict[str, Any]:
        """Return `sensation` of summary.json, with the combined uncertainty of the force."""
        felt = self.sensation
        if felt is None:
            return {}
        if felt.times_threshold is not None:
            felt = dataclasses.replace(felt, times_threshold=self.combined_draws["times_threshold"])
        return {"sensation": felt.to_dict()}

    @functools.cached_property
    def _budgets(self) -> dict[str, Budget]:
        """Budgets of the fit, with the standard deviations of the draws."""
        draws = self.parameters() | self.derived()
        budgets = self.fit.budgets.items()
        return {name: each.scale_posterior(float(np.std(np.log(draws[name]), ddof=1))) for name, each in budgets}

    @functools.cached_property
    def _other_deviates(self) -> defaultdict[str, Float[np.ndarray, "ensembles draws"]]:
        """Standard normal numbers of each source of error beyond the posterior, made when first used."""
        rng, shape = np.random.default_rng([self.seed, 5]), self.points.shape[:2]
        return defaultdict(lambda: rng.standard_normal(shape))

    @functools.cached_property
    def combined_draws(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of the quantities with a budget, with all sources of error in it, also usual ones not stated."""
        return {
            name: draws * self._budgets[_budget_name(name)].combined_budget.draw_others(self._other_deviates)
            for name, draws in (self.parameters() | self.derived()).items()
            if _budget_name(name) in self._budgets
        }

    def _budget_entries(self) -> dict[str, Any]:
        """Return `budget` of summary.json; its intervals come from the draws."""
        draws, entries = self.parameters() | self.derived(), {}
        for name, each in self._budgets.items():
            factors = each.draw_others(self._other_deviates)
            low, high = np.quantile(draws[name] * factors, (0.025, 0.975)).tolist()
            entries[name] = each.to_dict(float(np.median(draws[name])), (low, high)) | self.fit.calibration_entry(name)
        return entries

    def _record(self) -> dict[str, Any]:
        records = self.fit.records
        return {
            "source": os.path.basename(records[0].source),
            "samples": sum(map(len, records)),
            "sha256": records[0].fingerprint,
            "sources": [{"source": os.path.basename(r.source), "sha256": r.fingerprint} for r in records],
        }

    def __str__(self) -> str:
        return result_text.describe_summary(self._summary)

    def plot(self) -> Any:
        """Draw parameters (with their prior), pairs of Rsc, Csc and Ci, and the force, and return the axes.

        Quantities with a budget are drawn with their combined uncertainty.
        """
        draws = self.parameters() | self.combined_draws
        pages = charts.corner_plots(draws, self._prior_draws, FINGER_PARAMETERS)
        return charts.show_plots(*pages[0], *pages[1], *charts.force_plots(draws), caption=self._force_law)

    def plot_force(self, ax: Any = None) -> Any:
        """Draw the force over time with its 90 % interval, and return the axes."""
        time, force = self.force_in_time
        quantiles = dict(zip(summary.PROBABILITIES.values(), force, strict=True))
        return charts.show_plots(charts.force_in_time_plot(time, quantiles), ax=ax, caption=self._force_law)

    def plot_budget(self) -> Any:
        """Draw the largest components of each quantity's combined uncertainty, and return the axes."""
        return np.array(charts.draw_budgets(self._summary, make=charts.pyplot_figure).axes)

    @property
    def _force_law(self) -> str:
        return result_text.force_sentences(self.fit.force_basis)[0]

    @functools.cached_property
    def force_in_time(self) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "quantiles times"]]:
        """Times (s), and the quantiles 2.5, 5, 25, 50, 75, 95 and 97.5 % of the force (N) at each.

        The times are one period of a stated drive, the last two of a measured one, or the whole of an aperiodic one.
        The force is that of `force()` for up to 100 draws of each ensemble, with its combined uncertainty.
        """
        first = self.fit.records[0]
        frequency = None if isinstance(first, Spectrum) else first.frequency()
        draws = np.linspace(0, self.points.shape[1] - 1, min(100, self.points.shape[1])).astype(int)
        chosen = self.points[:, draws], self._deviates[:, draws]
        span = math.inf if frequency is None else 2.0 / frequency
        time, force = derived.draw_force(self.fit.derive, self.fit.likelihood, *chosen, span)
        mean = derived.DERIVED_NAMES.index("force_mean")
        force *= (self._derived_draws[:, draws, mean] / self._nominal_draws[:, draws, mean])[..., None]
        # other sources of error at even probabilities, since few draws of a wide factor would move the median
        others = self.combined_draws["force_mean"] / self._derived_draws[..., mean]
        even = np.quantile(
            others, (np.arange(force.shape[0] * force.shape[1]) + 0.5) / (force.shape[0] * force.shape[1])
        )
        force *= np.random.default_rng([self.seed, 6]).permutation(even).reshape(*force.shape[:2], 1)
        return time, np.quantile(force.reshape(-1, time.size), list(summary.PROBABILITIES.values()), axis=0)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with a row a draw and a column a parameter or derived quantity, in SI units.

        The index holds the chain (independent ensemble) and the draw.
        """
        ensembles, count = self.points.shape[:2]
        columns = {name: values.ravel() for name, values in (self.parameters() | self.derived()).items()}
        return to_dataframe(columns, levels={"chain": range(ensembles), "draw": range(count)})

    def to_arviz(self) -> Any:
        """Return ArviZ's object: an `InferenceData`, or from ArviZ 1 on the `xarray.DataTree` itself.

        Raises:
            InputError: ArviZ is not installed.
        """
        return convert_to_arviz(self.to_datatree())

    @property
    def _headline(self) -> str:
        values = self.fit.likelihood.to_physical(self.points[..., : self.fit.theta.size])
        estimates = {name: float(np.median(values[name])) for name in FINGER_PARAMETERS if name in values}
        state = self.fit.identifiability.verdict, "reliable" if self.trusted else "unreliable"
        return ", ".join((self._record()["source"], summary.format_values(estimates), *state))

    def _rows(self) -> list[tuple[str, ...]]:
        return result_text.estimate_table(self._summary)

    def _sentences(self) -> tuple[str, ...]:
        return str(self.convergence), self._force_law

    def to_datatree(self) -> Any:
        """Return an `xarray.DataTree` in ArviZ's groups; chain: the independent ensembles."""

        def dataset(draws: dict[str, np.ndarray]) -> Any:
            dims, coords = ("chain", "draw"), {"chain": np.arange(ensembles), "draw": np.arange(count)}
            variables = {name: (dims, values, {"units": quantity_unit(name)}) for name, values in draws.items()}
            return to_dataset(variables, coords)

        ensembles, count = self.points.shape[:2]
        prior, (instants, force) = self._prior_draws, self.force_in_time
        in_time = to_dataset(
            {"force": (("quantile", "time"), force, {"units": "N"})},
            {"quantile": list(summary.PROBABILITIES.values()), "time": ("time", instants, {"units": "s"})},
            {"law": self._force_law},
        )
        axes: dict[str, Any] = {}
        observed: dict[str, Any] = {}
        constant: dict[str, Any] = {}
        for channel in self.fit.traces:
            if isinstance(channel.record, Spectrum):
                axes |= _spectrum_axis(channel)
                observed |= _spectrum_variables(channel, channel.record.values)
                constant |= _spectrum_variables(channel, channel.prediction, "_fit")
                continue
            time, name = _time_axis_name(channel), _variable_name(channel)
            unit = {"units": CHANNEL_UNITS[channel.channel]}
            axes[time] = (time, channel.record.time, {"units": "s"})
            observed[name] = (time, channel.record[channel.channel], unit)
            constant[f"{name}_fit"] = (time, channel.prediction, unit)
            if channel.white is not None:
                constant[f"{name}_white"] = (time, channel.white, unit)
            constant[_variable_name(channel, "V")] = (time, channel.choice.voltage, {"units": "V"})
            constant |= self._unfitted_channels(channel, channel.record, time)
        attributes = {
            "inference_library": "fitact",
            "level": self.convergence.level,
            "inference_library_version": importlib.metadata.version("fitact"),
            "record": self._record()["source"],
            "record_sha256": self.fit.records[0].fingerprint,
            "scene": self.fit.scene.to_json(),
            "seed": self.seed,
        }
        statistics = to_dataset({"lp": (("chain", "draw"), self.log_prob)}, dataset(prior).coords)
        return to_datatree(
            {
                "/": to_dataset({}, attributes=attributes),
                "posterior": dataset(self.parameters() | self.derived()),
                "combined": dataset(self.combined_draws),
                "sample_stats": statistics,
                "posterior_predictive": self._posterior_predictive,
                "observed_data": to_dataset(observed, axes),
                "constant_data": to_dataset(constant, axes),
                "prior": dataset(prior),
                "force_in_time": in_time,
            }
        )

    def _unfitted_channels(self, trace: ChannelFit, record: Record, time: str) -> dict[str, Any]:
        """Return the channels of a fitted channel's record that were recorded but not fitted, as variables."""
        fitted = {each.channel for each in self.fit.traces if each.record is record}
        others = [name for name in record.channels if name not in fitted]
        if np.array_equal(trace.choice.voltage, record.channels.get("V", trace.choice.voltage)):
            others = [name for name in others if name != "V"]  # which is the drive
        return {
            f"{_variable_name(trace, name)}_recorded": (time, record[name], {"units": CHANNEL_UNITS[name]})
            for name in others
        }

    @functools.cached_property
    def _prior_draws(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        ensembles, count = self.points.shape[:2]
        draws = self.fit.likelihood.prior.sample(np.random.default_rng([self.seed, 2]), ensembles * count)
        return {name: each.reshape(ensembles, count) for name, each in draws.items()}

    @functools.cached_property
    def _posterior_predictive(self) -> Any:
        """Posterior predictive records with noise: 50 of each ensemble, each of about 4000 samples at most."""
        ensembles, count = self.points.shape[:2]
        draws = np.linspace(0, count - 1, min(50, count)).astype(int)
        rng = np.random.default_rng([self.seed, 3])
        predicted = to_dataset({}, {"chain": np.arange(ensembles), "draw": draws})
        for i, (channel, model) in enumerate(zip(self.fit.traces, self.fit.likelihood.channels, strict=True)):
            stride = -(-len(channel.record) // 4000)
            predicting = self.fit.likelihood, i, stride
            sd = channel.relative_noise_sd[::stride]
            chosen = self.points[:, draws], self._deviates[:, draws]
            mean = derived.evaluate_draws(_predict_signal, predicting, model.samples.time.size, *chosen)[..., : sd.size]
            whitening = model.samples.whitening
            if model.samples.has_drive_noise:  # which is in the signal, and not in the record
                whitening = None
                mean = mean - np.median(mean, axis=(0, 1)) + channel.prediction[::stride]
            sigma = np.exp(self.points[:, draws, self.fit.theta.size + i, None])
            noise = draw_noise(rng, model.noise, whitening, mean.shape, stride)
            noisy = mean + sigma * sd * noise
            if isinstance(channel.record, Spectrum):
                shape = "chain", "draw", *_spectrum_axis(channel)
                variables = _spectrum_variables(channel, join_complex(noisy), dims=shape)
                predicted = predicted.assign_coords(_spectrum_axis(channel)).merge(variables)
                continue
            time = channel.record.time[::stride]
            axis, unit = _time_axis_name(channel), {"units": CHANNEL_UNITS[channel.channel]}
            predicted[_variable_name(channel)] = ("chain", "draw", axis), noisy.astype(np.float32), unit
            predicted = predicted.assign_coords({axis: (axis, time, {"units": "s"})})
        return predicted

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF (ArviZ's `from_netcdf` opens it)."""
        tree = self.to_datatree()
        packed = {"zlib": True, "complevel": 4}
        encoding = {node.path: {str(name): packed for name in node.data_vars} for node in tree.subtree}
        with atomic_write(path) as temporary:
            tree.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)

    def report(self, path: str | os.PathLike[str], plan: ReducedModel | None = None) -> None:
        """Write the report as one self-contained HTML page; `plan` adds the simplifications of the fitted scene."""
        from fitact.report import write_report

        stated = {} if plan is None else {"plan": {"used": "planned", "sentence": plan.sentence} | plan.to_dict()}
        write_report(path, self.to_datatree(), self.summary() | stated)


def _budget_name(name: str) -> str:
    """Return the quantity whose budget holds for `name`: the felt friction is proportional to the force."""
    return "force_mean" if name == "times_threshold" else name


def convert_to_arviz(tree: Any) -> Any:
    """Return a DataTree as ArviZ's object; InputError if ArviZ is not installed."""
    try:
        import arviz
    except ImportError as error:
        raise InputError("ArviZ is not installed; install it with: pip install 'fitact[arviz]'") from error
    if int(arviz.__version__.partition(".")[0]) >= 1:  # takes the tree as it is; its `InferenceData` is DataTree
        return tree
    groups = {name: node.to_dataset() for name, node in tree.children.items()}
    return arviz.InferenceData(attrs=tree.attrs, **groups)


def _time_axis_name(channel: ChannelFit, name: str = "time") -> str:
    number = channel.label.rpartition("_")[2]
    return f"{name}_{number}" if number.isdigit() else name


def _spectrum_axis(channel: ChannelFit) -> dict[str, Any]:
    """Return the frequencies of a spectrum by the name of their axis."""
    assert isinstance(channel.record, Spectrum)
    name = _time_axis_name(channel, "frequency")
    return {name: (name, channel.record.frequency, {"units": "Hz"})}


def _spectrum_variables(
    channel: ChannelFit, values: Complex[np.ndarray, "*n points"], suffix: str = "", dims: tuple[str, ...] | None = None
) -> dict[str, Any]:
    """Return real and imaginary part of a spectrum as variables, since NetCDF has no complex numbers."""
    letter, unit = ("Z", "ohm") if channel.channel == "impedance" else ("H", "1")
    name = _time_axis_name(channel, letter)
    parts = {"real": values.real, "imag": values.imag}
    dims = dims or tuple(_spectrum_axis(channel))
    return {f"{name}_{part}{suffix}": (dims, x, {"units": unit}) for part, x in parts.items()}


def _variable_name(trace: ChannelFit, channel: str = "") -> str:
    """Return the variable name of a fitted channel, or of another channel of its record."""
    return (channel or trace.channel) + _time_axis_name(trace).removeprefix("time")


def _draw_linear_nuisances(likelihood: Likelihood, point: Array, deviate: Array) -> Array:
    theta, log_sigma = likelihood.split(point)
    parts = zip(likelihood.channels_and_inputs(theta), jnp.exp(log_sigma), deviate, strict=True)
    return jnp.stack([channel.sample_nuisances(inputs, sigma, each) for (channel, inputs), sigma, each in parts])


def _predict_signal(predicting: tuple[Likelihood, int, int], point: Array, deviate: Array) -> Array:
    """Return the signal of a channel by its index, at every `stride`-th sample."""
    likelihood, index, stride = predicting
    theta, log_sigma = likelihood.split(point)
    channel, inputs = likelihood.channels[index], likelihood.channel_inputs(theta, index)
    beta = channel.sample_nuisances(inputs, jnp.exp(log_sigma[index]), deviate[index])
    return (channel.signal(inputs) + (beta * channel.linear_sd) @ channel.shapes(inputs))[::stride]
