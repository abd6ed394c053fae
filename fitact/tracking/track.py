"""Tracks: parameters, contact area and force as functions of time along a long record."""

import dataclasses
import functools
import math
import os
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fitact import charts, result_text
from fitact.files import write_parquet
from fitact.fitting.result import Fit
from fitact.tables import Display, align_table, join_lines, to_dataframe
from fitact.tracking.time_average import TimeAverage
from fitact.tracking.walk_rates import WalkRates
from fitact.units import format_engineering, format_percent, quantity_unit


@dataclasses.dataclass(frozen=True, repr=False)
class Track(Display):
    """Values over time, one for each window of a record.

    Attributes:
        time: middles of the windows, s.
        values: medians by name, SI: Rsc, Csc, Ci, g, b, contact_area, and force_mean (over the window; NaN where
            samples are clipped).
        u: relative standard uncertainties of `values`, combined.
        sd: the same from the record and the prior alone, without geometry and effects of what the model lacks.
        contact: whether the finger is in contact with the panel during the whole window; without, values are NaN.
        reliable: whether the window has data of its own; values of others are bridged from their neighbours.
        verdict: of identifiability at each time, as for a fit.
        jumps: times before which values changed at once, s.
        rates: of the random walks that join the windows.
        window: length of a window, s.
        fit: the fit to one window, which gave the model.
        constants: what does not change, by name: (median, relative standard uncertainty).
        noise: sd of each channel's noise, V or A.
        average: averages over time for a population; None means that Rsc, Csc and Ci are not all free.
        follows_changes: whether what the fit of one constant finger to a window lacks is that the finger changes.
    """

    time: Float[np.ndarray, " windows"]
    values: dict[str, Float[np.ndarray, " windows"]]
    u: dict[str, Float[np.ndarray, " windows"]]
    sd: dict[str, Float[np.ndarray, " windows"]]
    contact: Bool[np.ndarray, " windows"]
    reliable: Bool[np.ndarray, " windows"]
    verdict: np.ndarray
    jumps: tuple[float, ...]
    rates: WalkRates
    window: float
    fit: Fit
    constants: dict[str, tuple[float, float]]
    noise: dict[str, float]
    average: TimeAverage | None
    follows_changes: bool
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether the model fits, beside changes of the finger, and some windows are reliable."""
        return (self.fit.trusted or self.follows_changes) and bool(np.any(self.reliable))

    def to_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write a row for each window as Parquet; needs `pip install 'fitact[campaign]'`.

        Raises:
            InputError: the path cannot be written, or pyarrow is not installed.
        """
        write_parquet(path, self.to_columns())

    def to_columns(self) -> dict[str, np.ndarray]:
        """Return the columns of track.parquet."""
        columns = {"time_s": self.time}
        for name, values in self.values.items():
            columns |= {name: values, f"{name}_u": self.u[name], f"{name}_sd": self.sd[name]}
        return columns | {"reliable": self.reliable, "contact": self.contact, "verdict": self.verdict}

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with the columns of track.parquet, a row for each window."""
        return to_dataframe(self.to_columns())

    def plot(self, *names: str, ax: Any = None) -> Any:
        """Draw quantities over time with their 95 % bands, all of `values` by default; return the axes.

        `ax`: axes to draw a single quantity on.
        """
        columns = self.to_columns()
        plots = [charts.track_plot(columns, name, self.jumps) for name in names or self.values]
        return charts.show_plots(*plots, ax=ax, caption=result_text.force_sentences(self.fit.force_basis)[0])

    @functools.cached_property
    def within_finger(self) -> dict[str, dict[str, float]]:
        """Variation during the record, by quantity: sd of its logarithm, and the time over which it is alike (s)."""
        return {name: _variation(self.time, self.values[name], self.reliable) for name in self.values}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        rates = {
            name: {"log_sd_per_root_s": float(r), "lower": float(low), "upper": float(high)}
            for name, r, low, high in zip(
                self.rates.names, self.rates.rate, self.rates.lower, self.rates.upper, strict=True
            )
        }
        return {
            "within_finger": self.within_finger,
            "rates": rates,
            "windows": {
                "length_s": self.window,
                "count": self.time.size,
                "reliable": int(np.count_nonzero(self.reliable)),
                "contact": int(np.count_nonzero(self.contact)),
            },
            "start": self._state(0),
            "end": self._state(-1),
            "constants": {name: {"median": value, "u": u} for name, (value, u) in self.constants.items()},
            "noise": self.noise,
            "jumps_s": list(self.jumps),
            "lifted_s": [list(pair) for pair in self.lifted],
            "fit": {"result": self.fit.result, "model": self.fit.model()},
            "identifiability": self.fit.identifiability.to_dict(),
            "time_average": self.average and self.average.to_dict(),
            "trusted": self.trusted,
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    def _state(self, place: int) -> dict[str, Any]:
        """Return the values at the first or last reliable time; of a window with clipped samples without the force."""
        chosen = np.flatnonzero(self.reliable)
        if not chosen.size:
            return {}
        k = chosen[place]
        values = {
            name: {"median": float(each[k]), "u": float(self.u[name][k])}
            for name, each in self.values.items()
            if math.isfinite(each[k])
        }
        return {"time_s": float(self.time[k]), **values, "verdict": str(self.verdict[k])}

    @property
    def lifted(self) -> list[tuple[float, float]]:
        """Stretches without contact, from the end of the last whole window with contact to the start of the next, s."""
        edges = np.flatnonzero(np.diff(np.concatenate([[True], self.contact, [True]]).astype(int)))
        half = 0.5 * self.window
        return [(float(self.time[a] - half), float(self.time[b - 1] + half)) for a, b in edges.reshape(-1, 2)]

    def describe_last(self) -> str:
        """Return a line on the last reliable window."""
        state = self._state(-1)
        if not state:
            return "no window with contact yet"
        cells = [
            f"{name} {format_engineering(state[name]['median'], quantity_unit(name))}"
            f" ± {format_percent(state[name]['u'])}"
            for name in self.values
            if name in state
        ]
        return f"{state['time_s']:.4g} s: {', '.join(cells)}" + ("" if self.contact[-1] else "; no contact now")

    @property
    def _headline(self) -> str:
        windows = f"{self.time.size:,} windows of {format_engineering(self.window, 's')}"
        state = self.fit.identifiability.verdict, "reliable" if self.trusted else "unreliable"
        return ", ".join((os.path.basename(self.fit.record.source), windows, *state))

    def _rows(self) -> list[tuple[str, ...]]:
        first, last = self._state(0), self._state(-1)
        rows: list[tuple[str, ...]] = []
        if first:
            times = (f"at {format_engineering(each['time_s'], 's', 3)}" for each in (first, last))
            rows.append(("", *times, "variation"))
        for name in (each for each in self.values if each in first and each in last):
            unit, within = quantity_unit(name), self.within_finger[name]
            cells = (
                f"{format_engineering(each[name]['median'], unit)} ± {format_percent(each[name]['u'])}"
                for each in (first, last)
            )
            rows.append((name, *cells, format_percent(within["log_sd"]) if math.isfinite(within["log_sd"]) else ""))
        return rows

    def _sentences(self) -> list[str]:
        return [self.fit.message, result_text.force_sentences(self.fit.force_basis)[0]]

    def __str__(self) -> str:
        rows = self._rows()
        parts = align_table(rows) if rows else []
        for name, rate, low, high in zip(
            self.rates.names, self.rates.rate, self.rates.lower, self.rates.upper, strict=True
        ):
            parts.append(
                f"{name.replace('_', ' ')} walks by {format_percent(float(rate))} in 1 s"
                f" (95 %: {format_percent(float(low))} to {format_percent(float(high))})"
            )
        for begin, end in self.lifted:
            parts.append(
                f"no contact from {begin:.4g} s to {end:.4g} s, each within {format_engineering(self.window, 's', 3)}"
            )
        for jump in self.jumps:
            parts.append(f"a jump at {jump:.4g} s")
        parts.append(str(self.fit.identifiability))
        return join_lines(parts, self.warnings, self.notes)


def _variation(time: np.ndarray, values: np.ndarray, reliable: np.ndarray) -> dict[str, float]:
    """Return sd of the logarithm over the reliable times, and the lag (s) at which its autocorrelation falls to 1/e."""
    used = reliable & np.isfinite(values)
    if np.count_nonzero(used) < 3:
        return {"log_sd": math.nan, "time_scale_s": math.nan}
    logs = np.log(values[used])
    log_sd = float(np.std(logs, ddof=1))
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[used][0], time[used][-1] + 0.5 * step, step)
    centered = np.interp(grid, time[used], logs - logs.mean())
    size = 2 ** math.ceil(math.log2(2 * centered.size))
    spectrum = np.abs(np.fft.rfft(centered, size)) ** 2
    correlation = np.fft.irfft(spectrum)[: centered.size]
    below = np.flatnonzero(correlation < correlation[0] / math.e)
    return {"log_sd": log_sd, "time_scale_s": float(step * below[0]) if below.size else float(grid[-1] - grid[0])}
