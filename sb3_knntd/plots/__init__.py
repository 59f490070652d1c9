"""Plots of learning curves and learned values. They need matplotlib: ``pip install "sb3-knntd[extra]"``."""

from __future__ import annotations

from sb3_knntd.plots.curves import plot_learning_curve, running_median
from sb3_knntd.plots.figures import BASELINE_COLOR, DPI, LINE_COLOR, UNLEARNED_COLOR, figure_of, new_figure
from sb3_knntd.plots.grids import (
    AVERAGED_PLACES,
    BATCH,
    FINEST,
    ValueGrid,
    check_dims,
    check_fixed,
    telling_dims,
    value_grid,
)
from sb3_knntd.plots.model_maps import Rollout, plot_model_points, plot_rollout, roll_out
from sb3_knntd.plots.names import NAMES, Names, check_names, names_for, names_in
from sb3_knntd.plots.value_maps import (
    MOST_NAMED_ACTIONS,
    caption_of,
    count_panels,
    plot_points,
    plot_routes,
    plot_value_function,
    plot_visits,
)

__all__ = [
    "AVERAGED_PLACES",
    "BASELINE_COLOR",
    "BATCH",
    "DPI",
    "FINEST",
    "LINE_COLOR",
    "MOST_NAMED_ACTIONS",
    "NAMES",
    "UNLEARNED_COLOR",
    "Names",
    "Rollout",
    "ValueGrid",
    "caption_of",
    "check_dims",
    "check_fixed",
    "check_names",
    "count_panels",
    "figure_of",
    "names_for",
    "names_in",
    "new_figure",
    "plot_learning_curve",
    "plot_model_points",
    "plot_points",
    "plot_rollout",
    "plot_routes",
    "plot_value_function",
    "plot_visits",
    "roll_out",
    "running_median",
    "telling_dims",
    "value_grid",
]
