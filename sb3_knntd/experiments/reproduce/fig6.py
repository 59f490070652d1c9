"""Figure 6: cart-pole, episodes until the pole stays up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_knntd.experiments.reproduce.curves import curve_tables, draw_curves, episode_lengths
from sb3_knntd.experiments.reproduce.figure import PaperFigure, Results
from sb3_knntd.experiments.reproduce.statistics import interval, quantile, seeds_range, yes_no
from sb3_knntd.plots import BASELINE_COLOR, new_figure
from sb3_knntd.registry import ALGORITHMS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The paper's number of episodes until the policy is near-optimal (section 6.2).
CLAIMED_EPISODES = {"knntd": 29, "exa": 5}
#: Length of a full episode, the environment's step limit.
FULL = 1000
#: Number of episodes after the first full one that are checked for stability.
FOLLOWED = 30
#: The share of seeds, and of episodes, that counts as most.
MOST = 0.9


class Success(NamedTuple):
    """
    The first full episode of a seed.

    :param episode: number of the first episode of 1000 steps, counted from 1; infinity if there is none
    :param share: share of the next 30 episodes that last 1000 steps, in [0, 1]; 0 if there is no full episode
    """

    episode: float
    share: float


def success(steps: Sequence[int]) -> Success:
    """
    :param steps: steps of each episode; the last 30 only follow a success and are not searched for the first one
    :return: the first success, and the share of successes after it
    """
    for episode, length in enumerate(steps[:-FOLLOWED], start=1):
        if length >= FULL:
            followers = steps[episode : episode + FOLLOWED]
            return Success(episode, sum(length >= FULL for length in followers) / FOLLOWED)
    return Success(math.inf, 0.0)


def draw(results: Results, title: str) -> Figure:
    """
    :param results: steps of each episode
    :param title: title of the figure
    :return: plot of the learning curves of each algorithm and the paper's claims
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    figure = new_figure(10.5, 4.4)
    panels = figure.subplots(1, len(results), sharey=True)
    for axes, (algorithm, curves) in zip(panels, results.items(), strict=True):
        draw_curves(axes, np.array(list(curves.values())))
        claim = CLAIMED_EPISODES[algorithm]
        axes.axvline(claim, color=BASELINE_COLOR, linestyle="--", linewidth=2, label=f"the paper: {claim} episodes")
        axes.set_xscale("log")
        axes.set_xticks([tick for tick in (1, 2, 5, 10, 20, 50, 100) if tick <= axes.get_xlim()[1]])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda episode, _: f"{episode:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set(title=ALGORITHMS[algorithm].label, xlabel="episode (log scale)", ylabel="steps the pole stays up")
        axes.label_outer()
        # Outside the axes, to hide no curve.
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False, fontsize="small")
    figure.suptitle(title)
    return figure


def verdict(results: Results) -> str:
    """
    :param results: steps of each episode
    :return: a paragraph
    """
    sentences = [f"Cart-pole, the first episode of {FULL} steps, over {seeds_range(results['knntd'])}."]
    for algorithm, curves in results.items():
        claim = CLAIMED_EPISODES[algorithm]
        successes = [success(curve) for curve in curves.values()]
        episodes = [each.episode for each in successes]
        n_never, n_within = episodes.count(math.inf), sum(episode <= 2 * claim for episode in episodes)
        share = float(np.mean([each.share for each in successes]))
        label = ALGORITHMS[algorithm].label
        sentences.append(
            f"{label}: the paper needs {claim}; here the median is {interval(episodes)} (10 % and 90 % "
            f"quantiles in brackets). {n_never} of {len(episodes)} seeds never succeed. Of the next {FOLLOWED} "
            f"episodes {100 * share:.1f} % last {FULL} steps (0 % for seeds that never succeed). Median at most "
            f"{claim}: {yes_no(quantile(episodes, 0.5) <= claim)}; nine seeds in ten within {2 * claim} "
            f"({n_within} of {len(episodes)}): {yes_no(n_within >= MOST * len(episodes))}; nine in ten of the next "
            f"episodes: {yes_no(share >= MOST)}."
        )
    return " ".join(sentences)


FIG6 = PaperFigure(
    name="fig6",
    help="cart-pole, episodes until the pole stays up",
    min_episodes=FOLLOWED + 1,
    compute=episode_lengths,
    tables=curve_tables,
    draw=draw,
    verdict=verdict,
)
