"""Charts of a posterior: each record with its fit, the parameters, and the force."""

from typing import Any

import numpy as np

from fitact.charts import interactive
from fitact.charts.interactive import Chart
from fitact.charts.posterior import corner_plots, force_in_time_plot, force_plots
from fitact.charts.series import Series, spectrum_plot, time_chart
from fitact.data.record import CHANNEL_TITLES
from fitact.model.circuit import FINGER_PARAMETERS


def make_charts(tree: Any, page_columns: int = 10_000) -> dict[str, Chart]:
    """Make the charts of the DataTree of a posterior, by name; `page_columns`: columns for all records of a page.

    A record or spectrum has the name of its axis: time, time_2, frequency, ...
    """
    axes = dict.fromkeys(str(values.dims[0]) for values in tree["observed_data"].data_vars.values())
    columns = min(2000, page_columns // len(axes))  # screens have no more columns
    charts = {
        axis: _spectrum_chart(tree, axis) if axis.startswith("frequency") else _record_chart(tree, axis, columns)
        for axis in axes
    }
    groups = "posterior", "combined", "prior"
    posterior, combined, prior = ({str(name): x.values for name, x in tree[g].items()} for g in groups)
    draws = posterior | combined
    marginals, pairs = corner_plots(draws, prior, FINGER_PARAMETERS)
    switch = interactive.log_axis_button(marginals, label="logarithmic axes")
    switch["updates"] += interactive.log_axis_button(pairs, "xy")["updates"] if pairs else []
    hide = interactive.visibility_button("prior", [*marginals, *pairs], "prior")
    forces, in_time = force_plots(draws), tree["force_in_time"]
    quantiles = dict(zip(in_time["quantile"].values.tolist(), in_time["force"].values, strict=True))
    return charts | {
        "corner": interactive.chart(*marginals, *pairs, controls=[hide, switch]),
        "force": interactive.chart(*forces, controls=[interactive.log_axis_button(forces)]),
        "force_in_time": interactive.chart(force_in_time_plot(in_time["time"].values, quantiles)),
    }


def _record_chart(tree: Any, axis: str, columns: int) -> Chart:
    """Draw all channels of a record on one time axis, with the fits of those that were fitted."""
    observed, constant, predicted = (tree[g] for g in ("observed_data", "constant_data", "posterior_predictive"))
    end, series = axis.removeprefix("time"), []
    drive, titles = constant[f"V{end}"].values, CHANNEL_TITLES.items()
    for channel, title in titles:
        name, recorded = f"{channel}{end}", f"{channel}{end}_recorded"
        if name in observed:
            draws = predicted[name].values.reshape(-1, predicted.sizes[axis])
            ends = np.quantile(draws, [0.05, 0.95], axis=0)
            shown = np.isfinite(ends[0])
            interval = predicted[axis].values[shown], ends[0][shown], ends[1][shown]
            values, unit = observed[name].values, observed[name].attrs["units"]
            white = constant[f"{name}_white"].values if f"{name}_white" in constant else None
            series.append(Series(title, unit, values, constant[f"{name}_fit"].values, interval, white=white))
        elif recorded in constant:
            fit = drive if channel == "V" else None
            values, unit = constant[recorded].values, constant[recorded].attrs["units"]
            series.append(Series(title, unit, values, fit, has_residuals=False))
        elif channel == "V":
            series.append(Series(title, "V", drive))
    return time_chart(observed[axis].values, series, columns)


def _spectrum_chart(tree: Any, axis: str) -> Chart:
    """Draw magnitude and phase of a spectrum over frequency, and the relative residuals."""
    end = axis.removeprefix("frequency")
    is_impedance = f"Z{end}_real" in tree["observed_data"]

    def join(group: str, suffix: str = "") -> np.ndarray:
        letter = "Z" if is_impedance else "H"
        real, imag = (tree[group][f"{letter}{end}_{part}{suffix}"].values for part in ("real", "imag"))
        return real + 1j * imag

    frequency = tree["observed_data"][axis].values
    symbol = ("|Z|", "ohm") if is_impedance else ("|Vsc / V|", "1")
    draws = join("posterior_predictive").reshape(-1, frequency.size)
    data = join("observed_data"), join("constant_data", "_fit"), draws
    return interactive.chart(spectrum_plot(frequency, *symbol, *data))
