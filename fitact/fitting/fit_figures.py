"""Figures of a fit: data with fit and residuals, and what the data determine."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fitact import charts
from fitact.data.record import CHANNEL_TITLES, CHANNEL_UNITS, Record
from fitact.data.spectrum import Spectrum
from fitact.fitting.channel_fit import ChannelFit
from fitact.fitting.laplace import Laplace


def plot_fit(record: Record | Spectrum, channels: Sequence[ChannelFit]) -> Any:
    """Draw a record or spectrum with those of the fitted channels that are its own, and return the axes."""
    traces = {trace.channel: trace for trace in channels if trace.record is record}
    if isinstance(record, Spectrum):
        return charts.show_plots(
            charts.spectrum_plot(record.frequency, *record.symbol, record.values, traces[record.channel].prediction)
        )
    voltage, series = next(iter(traces.values())).choice.voltage, []
    for name, title in CHANNEL_TITLES.items():
        if name in record:
            stated = voltage if name == "V" and not np.array_equal(voltage, record["V"]) else None
            fitted, white = (traces[name].prediction, traces[name].white) if name in traces else (stated, None)
            each = charts.Series(title, CHANNEL_UNITS[name], record[name], fitted, has_residuals=name in traces)
            series.append(each._replace(white=white))
        elif name == "V":
            series.append(charts.Series(f"{title}, stated", "V", voltage))
    return charts.show_plots(charts.time_plot(record.time, series))


def plot_identifiability(laplace: Laplace, direction: Mapping[str, float], ax: Any = None) -> Any:
    """Draw the 95 % regions of the two parameters that change most in a `direction`, and return the axes."""
    largest = sorted(direction, key=lambda name: -abs(direction[name]))[:2]
    first, second = sorted(largest, key=list(direction).index)
    rows = [laplace.likelihood.names.index(name) for name in (first, second)]
    prior = laplace.likelihood.prior
    laws = {
        name: (mean[rows], (root @ root.T)[np.ix_(rows, rows)])
        for name, mean, root in (
            ("posterior", laplace.theta, laplace.covariance_root),
            ("prior", np.asarray(prior.log_mean), laplace.likelihood.prior_factor),
        )
    }
    moves = np.array([direction[first], direction[second]])
    return charts.show_plots(charts.ellipse_plot((first, second), laws, moves), ax=ax)
