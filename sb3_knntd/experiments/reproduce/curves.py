"""Learning curves (steps per episode): computation, table and plot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_knntd.distributed.jobs import stored_as
from sb3_knntd.experiments.reproduce.figure import Results, Table
from sb3_knntd.experiments.reproduce.settings import Setting, compiled, make_model, total_steps
from sb3_knntd.experiments.reproduce.statistics import HIGH, LOW
from sb3_knntd.plots import LINE_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@stored_as("sb3_knntd.reproduce.curves.episode_lengths")
def episode_lengths(algorithm: str, setting: Setting, seed: int) -> list[int]:
    """
    Train for the number of episodes of the setting.

    :param algorithm: ``"knntd"`` or ``"exa"``
    :param setting: an entry of ``paper.yml``
    :param seed: seed of the model and its environment
    :return: steps of each episode
    """
    model = make_model(algorithm, setting, seed, compiled)
    model.learn(total_steps(setting), callback=StopTrainingOnMaxEpisodes(setting["episodes"]))
    env = model.get_env()
    assert env is not None
    (lengths,) = env.env_method("get_episode_lengths")
    return list(lengths)


def curve_tables(results: Results) -> dict[str, Table]:
    """
    :param results: steps of each episode
    :return: a table with one row per episode
    """
    rows = [
        (algorithm, seed, episode, steps)
        for algorithm, curves in results.items()
        for seed, curve in curves.items()
        for episode, steps in enumerate(curve, start=1)
    ]
    return {"table.csv": Table(("algorithm", "seed", "episode", "steps"), rows)}


def draw_curves(axes: Axes, curves: np.ndarray, alpha: float = 0.25) -> None:
    """
    Draw the curve of each seed, their median, and the range between the 10 % and 90 % quantiles.

    :param axes: axes to draw on
    :param curves: steps, or another value, of each episode, shape (n_seeds, n_episodes)
    :param alpha: opacity of the seeds' lines, in [0, 1]
    """
    episodes = np.arange(1, curves.shape[1] + 1)
    axes.plot(episodes, curves.T, color=LINE_COLOR, alpha=alpha, linewidth=0.7)
    low, median, high = np.quantile(curves, (LOW, 0.5, HIGH), axis=0)
    axes.fill_between(episodes, low, high, color=LINE_COLOR, alpha=0.2, linewidth=0, label="10 % to 90 % of seeds")
    axes.plot(episodes, median, color=LINE_COLOR, linewidth=2.2, label="median")
    axes.plot([], [], color=LINE_COLOR, alpha=0.5, linewidth=0.9, label="each seed")
    axes.set(xlabel="episode", ylabel="steps", xlim=(1, len(episodes)))
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
