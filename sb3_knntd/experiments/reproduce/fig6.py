"""Figure 6: cart-pole, how many episodes it takes until the pole stays up."""

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

#: Episodes until the policy is near-optimal, says the paper (section 6.2).
CLAIMED_EPISODES = {"knntd": 29, "exa": 5}
#: The pole has stayed up. The environment ends an episode there.
FULL = 1000
#: Episodes after the first full one that tell whether it was luck.
FOLLOWED = 30
#: What to ask of most seeds, and of most episodes.
MOST = 0.9


class Success(NamedTuple):
    """
    :param episode: the first of 1000 steps, counted from 1; infinity for never
    :param share: of the next 30 episodes, how many last 1000 steps, in [0, 1]; 0 for never
    """

    episode: float
    share: float


def success(steps: Sequence[int]) -> Success:
    """
    :param steps: of each episode; the last 30 are there to follow, a first success among them comes too late
    :return: the first success and what came of it
    """
    for episode, length in enumerate(steps[:-FOLLOWED], start=1):
        if length >= FULL:
            followers = steps[episode : episode + FOLLOWED]
            return Success(episode, sum(length >= FULL for length in followers) / FOLLOWED)
    return Success(math.inf, 0.0)


def draw(results: Results, title: str) -> Figure:
    """
    :param results: steps of each episode
    :param title: of the picture
    :return: learning curves of each algorithm, and the paper's claims as lines
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
        # Above the axes it covers no curve, wherever they rise.
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
        sentences.append(
            f"{ALGORITHMS[algorithm].label}: the paper needs {claim}; here the median is {interval(episodes)}, in "
            f"brackets the 10 % and 90 % quantiles; {n_never} of {len(episodes)} seeds never get there; of the "
            f"{FOLLOWED} episodes that follow, {100 * share:.1f} % last {FULL} steps (0 for never). Median at most "
            f"{claim}: {yes_no(quantile(episodes, 0.5) <= claim)}; nine seeds in ten within {2 * claim} "
            f"({n_within} of {len(episodes)}): {yes_no(n_within >= MOST * len(episodes))}; nine in ten of the "
            f"episodes that follow: {yes_no(share >= MOST)}."
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
