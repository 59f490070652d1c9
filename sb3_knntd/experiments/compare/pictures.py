"""Plots of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_knntd.experiments.compare.configurations import FLOOR, is_own, label
from sb3_knntd.experiments.compare.results import Task
from sb3_knntd.experiments.compare.statistics import AGGREGATES, Estimate
from sb3_knntd.plots import LINE_COLOR, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Size of each plot, inches: one column on a phone, two on larger screens.
SIZE = 4.9, 3.5
FLOOR_COLOR = "0.55"
#: Colours that are distinguishable with colour blindness (Okabe and Ito).
COLORS = ("#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#4d4d00")


def colors(algos: Sequence[str]) -> dict[str, str]:
    """
    :param algos: names of all algorithms of the comparison
    :return: a colour for each algorithm: one for all of this package's, grey for random actions
    """
    fixed = {**{algo: LINE_COLOR for algo in algos if is_own(algo)}, FLOOR: FLOOR_COLOR}
    others = [algo for algo in algos if algo not in fixed]
    return {algo: COLORS[n % len(COLORS)] for n, algo in enumerate(others)} | fixed


def _new_axes(height: float = SIZE[1]) -> tuple[Figure, Axes]:
    figure = new_figure(SIZE[0], height)
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    return figure, axes


def _draw_line(axes: Axes, x: np.ndarray, line: Estimate, algo: str, color: str, steps: bool = False) -> None:
    above = is_own(algo)
    axes.fill_between(x, line.low, line.high, color=color, alpha=0.18, linewidth=0, step="post" if steps else None)
    axes.plot(
        x,
        line.value,
        color=color,
        linewidth=2.4 if above else 1.6,
        zorder=4 if above else 3,
        label=label(algo),
        drawstyle="steps-post" if steps else "default",
    )


def _add_legend(figure: Figure, axes: Axes) -> None:
    # Outside the axes, to hide no curve.
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False, fontsize="small")


def draw_curves(task: Task, lines: Mapping[str, Estimate], palette: Mapping[str, str], against_time: bool) -> Figure:
    """
    :param task: the environment and its runs
    :param lines: mean returns at each point by algorithm
    :param palette: colours by algorithm
    :param against_time: whether the horizontal axis shows seconds of learning (medians over seeds) instead of steps
    :return: learning curves
    """
    figure, axes = _new_axes()
    for algo, line in lines.items():
        x = np.median(task.seconds(algo), axis=0) if against_time else task.steps()
        _draw_line(axes, x, line, algo, palette[algo])
    if task.threshold is not None:
        axes.axhline(task.threshold, color="black", linewidth=0.9, linestyle=(0, (4, 3)), zorder=2)
    if against_time:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda seconds, _: f"{seconds:g}")
    else:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlim(left=0)
    axes.set(xlabel="learning (s)" if against_time else "environment steps", ylabel="return of greedy episodes")
    _add_legend(figure, axes)
    return figure


def draw_efficiency(shares: np.ndarray, lines: Mapping[str, Estimate], palette: Mapping[str, str]) -> Figure:
    """
    :param shares: evaluation points as shares of the training, shape (n_points,)
    :param lines: normalised scores at each point by algorithm
    :param palette: colours by algorithm
    :return: plot of the scores against the share of the training
    """
    figure, axes = _new_axes()
    for algo, line in lines.items():
        _draw_line(axes, 100 * shares, line, algo, palette[algo])
    axes.axhline(1, color="black", linewidth=0.9, linestyle=(0, (4, 3)), zorder=2)
    axes.set(xlabel="share of the training (%)", ylabel="IQM of scores", xlim=(0, 100))
    _add_legend(figure, axes)
    return figure


def draw_profiles(thresholds: np.ndarray, lines: Mapping[str, Estimate], palette: Mapping[str, str]) -> Figure:
    """
    :param thresholds: scores, shape (n,)
    :param lines: share of runs above each score by algorithm
    :param palette: colours by algorithm
    :return: plot of the performance profiles
    """
    figure, axes = _new_axes()
    for algo, line in lines.items():
        _draw_line(axes, thresholds, line, algo, palette[algo], steps=True)
    axes.set(xlabel="final score τ", ylabel="share of runs above τ", ylim=(-0.04, 1.04))
    axes.set_xlim(thresholds[0], thresholds[-1])
    _add_legend(figure, axes)
    return figure


def draw_aggregates(estimates: Mapping[str, Estimate], palette: Mapping[str, str]) -> Figure:
    """
    :param estimates: the :data:`~sb3_knntd.experiments.compare.statistics.AGGREGATES` by algorithm
    :param palette: colours by algorithm
    :return: plot with one panel per aggregate, with intervals
    """
    figure = new_figure(SIZE[0], 1.0 + 0.32 * len(estimates))
    panels = figure.subplots(1, len(AGGREGATES), sharey=True)
    algos = list(estimates)
    for column, (axes, name) in enumerate(zip(panels, AGGREGATES, strict=True)):
        for row, algo in enumerate(algos):
            value, low, high = (part[column] for part in estimates[algo])
            axes.plot([low, high], [row, row], color=palette[algo], linewidth=7, alpha=0.35, solid_capstyle="butt")
            axes.plot(value, row, "|", color=palette[algo], markersize=13, markeredgewidth=2.4)
        axes.set_title(name, fontsize="medium")
        axes.grid(axis="x", color="0.92")
        axes.set_axisbelow(True)
        axes.locator_params(axis="x", nbins=4)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
    panels[0].set_yticks(range(len(algos)), [label(algo) for algo in algos])
    panels[0].set_ylim(len(algos) - 0.5, -0.5)
    figure.supxlabel("final score", fontsize="medium")
    return figure


def draw_improvements(estimates: Mapping[tuple[str, str], Estimate], palette: Mapping[str, str]) -> Figure:
    """
    :param estimates: by pair of algorithms, the probability that the first is better
    :param palette: colours by algorithm
    :return: plot of the probabilities with intervals
    """
    figure, axes = _new_axes(1.0 + 0.36 * len(estimates))
    for row, ((_, second), (value, low, high)) in enumerate(estimates.items()):
        color = palette[second]
        axes.plot([low[0], high[0]], [row, row], color=color, linewidth=7, alpha=0.35, solid_capstyle="butt")
        axes.plot(value[0], row, "|", color=color, markersize=13, markeredgewidth=2.4)
    axes.axvline(0.5, color="black", linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
    names = [f"{label(first)} > {label(second)}" for first, second in estimates]
    axes.set_yticks(range(len(names)), names)
    axes.set(xlim=(-0.03, 1.03), ylim=(len(names) - 0.5, -0.5), xlabel="probability that its final score is higher")
    axes.tick_params(axis="y", length=0)
    return figure
