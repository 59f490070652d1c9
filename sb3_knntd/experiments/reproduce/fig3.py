"""Figure 3: Mountain-Car, steps per episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_knntd.experiments.reproduce.curves import curve_tables, draw_curves, episode_lengths
from sb3_knntd.experiments.reproduce.figure import PaperFigure, Results
from sb3_knntd.experiments.reproduce.statistics import interval, number, quantile, seeds_range, yes_no
from sb3_knntd.plots import BASELINE_COLOR, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The figure's caption: "Stabilized from the episode 44 at 105 steps".
CLAIMED_EPISODE = 44
CLAIMED_STEPS = 105
#: Length of the shortest episode from (-0.5, 0), found by breadth-first search over action sequences.
SHORTEST = 102


def draw(results: Results, title: str) -> Figure:
    """
    :param results: steps of each episode
    :param title: title of the figure
    :return: plot of the learning curves and the paper's claim
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    figure = new_figure(7.5, 4.5)
    axes = figure.add_subplot()
    curves = np.array(list(results["knntd"].values()))
    draw_curves(axes, curves)
    axes.plot(
        (CLAIMED_EPISODE, curves.shape[1]),
        (CLAIMED_STEPS, CLAIMED_STEPS),
        color=BASELINE_COLOR,
        linestyle="--",
        linewidth=2,
        label=f"the paper: {CLAIMED_STEPS} steps from episode {CLAIMED_EPISODE} on",
    )
    axes.set_yscale("log")
    axes.set_yticks((100, 150, 200, 300, 500, 1000))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda steps, _: f"{steps:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("steps to the goal (log scale)")
    axes.set_title(title, loc="left")
    axes.legend(frameon=False)
    return figure


def verdict(results: Results) -> str:
    """
    :param results: steps of each episode
    :return: a paragraph
    """
    curves = np.array(list(results["knntd"].values()))
    then = curves[:, CLAIMED_EPISODE - 1].tolist()
    medians = np.median(curves[:, CLAIMED_EPISODE - 1 :], axis=0)
    n_reached = sum(steps <= CLAIMED_STEPS for steps in then)
    n_stable = int((curves[:, CLAIMED_EPISODE - 1 :].max(axis=1) <= CLAIMED_STEPS).sum())
    return (
        f"Mountain-Car, steps in episode {CLAIMED_EPISODE}: the paper reports {CLAIMED_STEPS} from there on. Here, "
        f"over {seeds_range(results['knntd'])}, the median is {interval(then)} (10 % and 90 % quantiles in brackets). "
        f"The best seed takes {min(then)} steps; the shortest path takes {SHORTEST}. {n_reached} of {len(then)} seeds "
        f"take {CLAIMED_STEPS} or fewer in episode {CLAIMED_EPISODE}, {n_stable} in all episodes from there to "
        f"{curves.shape[1]}, where the medians are between {number(medians.min())} and {number(medians.max())}. "
        f"Median at most {CLAIMED_STEPS}: {yes_no(quantile(then, 0.5) <= CLAIMED_STEPS)}."
    )


FIG3 = PaperFigure(
    name="fig3",
    help="Mountain-Car, steps of each episode",
    min_episodes=CLAIMED_EPISODE,
    compute=episode_lengths,
    tables=curve_tables,
    draw=draw,
    verdict=verdict,
)
