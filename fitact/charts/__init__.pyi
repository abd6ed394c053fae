from .bars import draw_budgets, draw_plan
from .design import draw_design
from .drive_design import draw_drive_design
from .figure import pyplot_figure
from .picture import show_plots
from .population import draw_population
from .posterior import corner_plots, ellipse_plot, force_in_time_plot, force_plots
from .series import Series, spectrum_plot, time_plot, track_plot

__all__ = [
    "Series",
    "corner_plots",
    "draw_budgets",
    "draw_design",
    "draw_drive_design",
    "draw_plan",
    "draw_population",
    "ellipse_plot",
    "force_in_time_plot",
    "force_plots",
    "pyplot_figure",
    "show_plots",
    "spectrum_plot",
    "time_plot",
    "track_plot",
]
