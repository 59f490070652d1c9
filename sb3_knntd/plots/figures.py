"""Figures without a window, and the colours of all plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Resolution of saved figures, dots per inch.
DPI = 150
LINE_COLOR = "#00488d"
BASELINE_COLOR = "#b35900"
UNLEARNED_COLOR = "#e4e4e4"


def new_figure(width: float, height: float) -> Figure:
    """
    :param width: width, inches
    :param height: height, inches
    :return: a figure without a window that pyplot does not manage; save it with ``figure.savefig(path)``
    :raises ImportError: if matplotlib is not installed
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "sb3-knntd[extra]"') from error

    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def figure_of(axes: Axes) -> Figure:
    """
    :param axes: any axes
    :return: their figure
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure
