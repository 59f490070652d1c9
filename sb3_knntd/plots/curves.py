"""Learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sb3_knntd.common.checks import check_integer
from sb3_knntd.plots.figures import BASELINE_COLOR, LINE_COLOR, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def running_median(values: Sequence[float] | np.ndarray, window: int) -> np.ndarray:
    """
    :param values: shape (n,)
    :param window: number of values in a window
    :return: the median of each value and the ``window - 1`` before it (fewer at the beginning), shape (n,)
    :raises ValueError: if ``window`` < 1
    """
    check_integer("window", window, 1)
    return np.array([np.median(values[max(0, end - window) : end]) for end in range(1, len(values) + 1)])


def plot_learning_curve(
    steps: Sequence[float] | np.ndarray,
    returns: Sequence[float] | np.ndarray,
    baseline: float | None = None,
    baseline_label: str = "random policy, mean",
    window: int | None = None,
    axes: Axes | None = None,
) -> Axes:
    """
    Plot the return of each episode and the running median against the number of environment steps.

    :param steps: number of environment steps at the end of each episode, shape (n_episodes,)
    :param returns: sum of rewards of each episode, shape (n_episodes,)
    :param baseline: return to compare with, drawn as a dashed line
    :param baseline_label: label of the baseline
    :param window: number of episodes of the running median; by default a tenth of all, from 5 to 100
    :param axes: axes to draw on; a new figure if not given
    :return: the axes; see :func:`figure_of` for their figure
    :raises ValueError: if ``steps`` and ``returns`` differ in length
    """
    if len(steps) != len(returns):
        raise ValueError(f"steps and returns must be of the same length; got {len(steps)} and {len(returns)}")
    axes = axes if axes is not None else new_figure(7.0, 4.2).add_subplot()
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    if len(returns) == 0:
        axes.text(0.5, 0.75, "no episode has ended", transform=axes.transAxes, ha="center", va="center")
    else:
        window = window if window is not None else int(np.clip(len(returns) // 10, 5, 100))
        axes.plot(
            steps, returns, "o", color=LINE_COLOR, alpha=0.3, markersize=3.5, markeredgewidth=0, label="each episode"
        )
        axes.plot(
            steps,
            running_median(returns, window),
            color=LINE_COLOR,
            linewidth=2.5,
            label=f"running median of {window} episodes",
        )
    if baseline is not None:
        axes.axhline(baseline, color=BASELINE_COLOR, linestyle="--", linewidth=1.8, label=baseline_label)
    axes.set(xlabel="environment steps", ylabel="episode return")
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.margins(y=0.08)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[1]:
        # Above the axes, the legend cannot cover a line.
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, fontsize="small", borderaxespad=0.2
        )
    return axes
