"""Figures of a fit: data with fit and residuals, and what the data determine."""

from typing import TYPE_CHECKING, Any

import numpy as np

from fitact import charts
from fitact.data.record import CHANNEL_TITLES, CHANNEL_UNITS
from fitact.data.spectrum import Spectrum

if TYPE_CHECKING:
    from fitact.fitting.fit import Fit


def plot_fit(fit: "Fit", number: int = 0) -> Any:
    """Draw the channels of a record of a fit, or a spectrum, and return the axes; see `Fit.plot`."""
    record = fit.records[number]
    traces = {trace.channel: trace for trace in fit.traces if trace.record is record}
    if isinstance(record, Spectrum):
        return charts.show_plots(
            charts.spectrum_plot(record.frequency, *record.symbol, record.values, traces[record.channel].prediction)
        )
    voltage, series = next(iter(traces.values())).choice.voltage, []
    for name, title in CHANNEL_TITLES.items():
        if name in record:
            stated = voltage if name == "V" and not np.array_equal(voltage, record["V"]) else None
            fitted = traces[name].prediction if name in traces else stated
            series.append(charts.Series(title, CHANNEL_UNITS[name], record[name], fitted, has_residuals=name in traces))
        elif name == "V":
            series.append(charts.Series(f"{title}, stated", "V", voltage))
    return charts.show_plots(charts.time_plot(record.time, series))


def plot_identifiability(fit: "Fit", ax: Any = None) -> Any:
    """Draw the 95 % regions of two parameters, and return the axes; see `Fit.plot_identifiability`."""
    direction = fit.identifiability.blind_direction
    largest = sorted(direction, key=lambda name: -abs(direction[name]))[:2]
    first, second = sorted(largest, key=list(direction).index)
    rows = [fit.names.index(name) for name in (first, second)]
    prior = fit.likelihood.prior
    laws = {
        name: (mean[rows], (root @ root.T)[np.ix_(rows, rows)])
        for name, mean, root in (
            ("posterior", fit.theta, fit.covariance_root),
            ("prior", np.asarray(prior.log_mean), fit.likelihood.prior_factor),
        )
    }
    moves = np.array([direction[first], direction[second]])
    return charts.show_plots(charts.ellipse_plot((first, second), laws, moves), ax=ax)
