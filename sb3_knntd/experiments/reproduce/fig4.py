"""Figure 4: the δs filter on the generalised Mountain-Car, and how much noise it removes while it learns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor

from sb3_knntd.distributed.jobs import stored_as
from sb3_knntd.envs.generalized_mountain_car import NOISE_SHAPE, RANGES, GeneralizedMountainCarEnv
from sb3_knntd.envs.mountain_car import MIN_POSITION
from sb3_knntd.experiments.reproduce.curves import draw_curves
from sb3_knntd.experiments.reproduce.figure import PaperFigure, Results, Table
from sb3_knntd.experiments.reproduce.settings import Setting, make_model, total_steps
from sb3_knntd.experiments.reproduce.statistics import interval, quantile, seeds_range, yes_no
from sb3_knntd.filters import DeltaFilter
from sb3_knntd.plots import BASELINE_COLOR, LINE_COLOR, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIMENSIONS = ("position", "velocity")
SIGNALS = ("true", "raw", "filtered")
#: Number of final episodes over which the error after learning is measured.
LATE = 20
#: Largest number of steps drawn of an episode, to keep single steps visible.
MOST_DRAWN = 120
#: Largest error, relative to the raw signal, that counts as the removal of a high amount of noise.
HALF = 0.5
#: At the left wall the velocity jumps to 0; this many steps before and after that are affected.
BEFORE_WALL, AFTER_WALL = 1, 7
#: Mean of the noise, in units of range / noise divider.
MEAN_NOISE = NOISE_SHAPE[0] / sum(NOISE_SHAPE) - 0.5


class SignalRecorder(gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """
    Records the true, the raw and the filtered signal of each episode.

    The constant error of the problem, its offset and the mean of its noise, is subtracted from the raw and the filtered
    signal, because no filter can detect it.

    :param env: the filter around the generalised Mountain-Car
    """

    def __init__(self, env: DeltaFilter) -> None:
        super().__init__(env)
        #: For each episode and observation the signals in the order of ``SIGNALS``, shape (3, 2).
        self.episodes: list[list[np.ndarray]] = []

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self.episodes.append([])
        self._record(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._record(observation, info)
        return observation, reward, terminated, truncated, info

    def _record(self, observation: np.ndarray, info: dict[str, Any]) -> None:
        core = self.unwrapped
        assert isinstance(core, GeneralizedMountainCarEnv)
        constant = constant_error(core)
        self.episodes[-1].append(np.array([info["state"], info["raw_observation"] - constant, observation - constant]))


def constant_error(env: GeneralizedMountainCarEnv) -> np.ndarray:
    """
    :param env: the environment
    :return: mean error of its observations, with its problem and enabled parts, shape (2,), observation units
    """
    error = np.array(env.parameters.offset) if env.offset else np.zeros(2)
    return error + MEAN_NOISE * np.array(RANGES) / env.parameters.noise_divider if env.noise else error


@stored_as("sb3_knntd.reproduce.fig4.filtered_episodes")
def filtered_episodes(algorithm: str, setting: Setting, seed: int) -> dict[str, Any]:
    """
    Train on filtered observations for the number of episodes of the setting, while the filter also learns.

    :param algorithm: ``"knntd"``
    :param setting: an entry of ``paper.yml``
    :param seed: seed of the model, the environment and its problem
    :return: for each episode its ``steps`` and the root mean square error of the ``raw`` and the ``filtered`` signal,
        shape (n_episodes, 2); the ``signals`` of the first and the last episode by name, each of shape (n_steps + 1, 2)
    """
    recorders: list[SignalRecorder] = []

    def wrap(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        recorders.append(SignalRecorder(DeltaFilter(env, **setting["filter"])))
        return Monitor(recorders[0])

    model = make_model(algorithm, setting, seed, wrap)
    model.learn(total_steps(setting), callback=StopTrainingOnMaxEpisodes(setting["episodes"]))
    (recorder,) = recorders
    # The vectorised environment has already started another episode.
    episodes = [np.array(episode) for episode in recorder.episodes[: setting["episodes"]]]
    errors = np.array([root_mean_square(signals[:, 1:] - signals[:, :1]) for signals in episodes])
    return {
        "steps": [len(signals) - 1 for signals in episodes],
        "raw": errors[:, 0].tolist(),
        "filtered": errors[:, 1].tolist(),
        "signals": {
            when: {name: signals[:, place].tolist() for place, name in enumerate(SIGNALS)}
            for when, signals in (("first", episodes[0]), ("last", episodes[-1]))
        },
    }


def root_mean_square(errors: np.ndarray) -> np.ndarray:
    """
    :param errors: errors, shape (n, ...)
    :return: root mean square over the first axis, shape (...)
    """
    root: np.ndarray = np.sqrt(np.square(errors).mean(axis=0))
    return root


def ratios(result: dict[str, Any]) -> np.ndarray:
    """
    :param result: result of one seed
    :return: error of the filtered signal divided by that of the raw signal, per episode, shape (n_episodes, 2)
    """
    left: np.ndarray = np.array(result["filtered"]) / result["raw"]
    return left


def late_ratio(result: dict[str, Any]) -> np.ndarray:
    """
    :param result: result of one seed
    :return: error of the filtered signal divided by that of the raw signal, over all observations of the last 20
        episodes, shape (2,)
    """
    n_observations = np.array(result["steps"][-LATE:]) + 1
    squares = [
        np.average(np.square(result[name][-LATE:]), axis=0, weights=n_observations) for name in ("filtered", "raw")
    ]
    left: np.ndarray = np.sqrt(squares[0] / squares[1])
    return left


def at_wall(signals: dict[str, list[list[float]]]) -> np.ndarray:
    """
    :param signals: signals of an episode
    :return: mask of the observations from one step before to seven steps after the car is at the left wall, shape
        (n_steps + 1,)
    """
    true = np.array(signals["true"])
    near = np.zeros(len(true), np.bool_)
    for step in np.flatnonzero(true[:, 0] == MIN_POSITION).tolist():
        near[max(step - BEFORE_WALL, 0) : step + AFTER_WALL + 1] = True
    return near


def ratio_off_wall(signals: dict[str, list[list[float]]]) -> np.ndarray:
    """
    :param signals: signals of an episode
    :return: error of the filtered signal divided by that of the raw signal, over the observations not at the wall,
        shape (2,)
    """
    true, raw, filtered = (np.array(signals[name])[~at_wall(signals)] for name in SIGNALS)
    left: np.ndarray = root_mean_square(filtered - true) / root_mean_square(raw - true)
    return left


def tables(results: Results) -> dict[str, Table]:
    """
    :param results: errors and signals of each seed
    :return: a table with one row per episode and dimension, and the plotted episodes
    """
    errors = [
        (seed, episode, steps, dimension, raw, filtered)
        for seed, result in results["knntd"].items()
        for episode, (steps, *both) in enumerate(
            zip(result["steps"], result["raw"], result["filtered"], strict=True), start=1
        )
        for dimension, raw, filtered in zip(DIMENSIONS, *both, strict=True)
    ]
    seed, result = _first(results)
    signals = [
        (seed, episode, step, *(value for state in states for value in state))
        for episode, drawn in zip((1, len(result["steps"])), result["signals"].values(), strict=True)
        for step, states in enumerate(zip(*(drawn[name] for name in SIGNALS), strict=True))
    ]
    columns = [f"{name}_{dimension}" for name in SIGNALS for dimension in DIMENSIONS]
    return {
        "table.csv": Table(("seed", "episode", "steps", "dimension", "raw", "filtered"), errors),
        "episodes.csv": Table(("seed", "episode", "step", *columns), signals),
    }


def _first(results: Results) -> tuple[int, dict[str, Any]]:
    """The plotted seed: the first one, to avoid a selected example."""
    return next(iter(results["knntd"].items()))


def draw(results: Results, title: str) -> Figure:
    """
    :param results: errors and signals of each seed
    :param title: title of the figure
    :return: plot of the signals of one seed in its first (A) and last episode (B), and the errors of all seeds (C)
    """
    figure = new_figure(12.5, 6.4)
    seed, result = _first(results)
    panels = figure.subplots(len(DIMENSIONS), 3)
    lefts = np.array([ratios(each) for each in results["knntd"].values()])
    n_episodes = len(result["steps"])
    for dim, (name, (first, last, all_seeds)) in enumerate(zip(DIMENSIONS, panels, strict=True)):
        last.sharey(first)
        for axes, when, letter, episode in ((first, "first", "A", 1), (last, "last", "B", n_episodes)):
            _draw_signals(axes, result["signals"][when], dim)
            raw, filtered = result["raw"][episode - 1][dim], result["filtered"][episode - 1][dim]
            axes.set_title(
                f"{letter}  {name}, seed {seed}, episode {episode}\nRMSE raw {raw:.2g}, filtered {filtered:.2g}",
                fontsize="medium",
            )
            axes.set(xlabel="step", ylabel=name)
        _draw_ratios(all_seeds, lefts[:, :, dim])
        all_seeds.set_title(f"C  {name}, all seeds", fontsize="medium")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False)
    handles, labels = panels[0][2].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower right", ncols=4, frameon=False)
    figure.suptitle(title)
    return figure


def _draw_signals(axes: Axes, signals: dict[str, list[list[float]]], dim: int) -> None:
    true, raw, filtered = (np.array(signals[name])[: MOST_DRAWN + 1, dim] for name in SIGNALS)
    axes.plot(raw, ".", color="0.6", markersize=5, markeredgewidth=0, label="raw")
    axes.plot(true, color=BASELINE_COLOR, linewidth=1.4, label="true")
    axes.plot(filtered, color=LINE_COLOR, linewidth=1.4, label="filtered")
    axes.spines[["top", "right"]].set_visible(False)


def _draw_ratios(axes: Axes, lefts: np.ndarray) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    draw_curves(axes, lefts, alpha=0.1)
    axes.axhline(1.0, color="black", linestyle="--", linewidth=1.2, label="no filter")
    axes.set_yscale("log")
    axes.set_yticks((0.25, 0.5, 1, 2, 4))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda ratio, _: f"{ratio:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("RMSE filtered / raw (log scale)")


def verdict(results: Results) -> str:
    """
    :param results: errors and signals of each seed
    :return: a paragraph
    """
    by_seed = results["knntd"]
    n_episodes = len(_first(results)[1]["steps"])
    sentences = [
        "Generalised Mountain-Car, root mean square error of the filtered signal divided by that of the raw signal, "
        f"over {seeds_range(by_seed)}, each with its own problem; 10 % and 90 % quantiles in brackets. The mean of the "
        "noise does not count as error. The paper gives no numbers. It says that the filter has not learned in the "
        "first episodes, and that it removes a very high amount of the noise in the last ones."
    ]
    first = np.array([ratios(result)[0] for result in by_seed.values()])
    late = np.array([late_ratio(result) for result in by_seed.values()])
    for dim, name in enumerate(DIMENSIONS):
        before, after = first[:, dim].tolist(), late[:, dim].tolist()
        middle, n_less = quantile(after, 0.5), sum(ratio < 1 for ratio in after)
        sentences.append(
            f"{name.capitalize()}: median {interval(before)} in the first episode, {interval(after)} in the last "
            f"{LATE} of {n_episodes}. Noise is removed (median below 1; true for {n_less} of {len(after)} seeds): "
            f"{yes_no(middle < 1)}; half of it or more: {yes_no(middle <= HALF)}."
        )
    last = [result["signals"]["last"] for result in by_seed.values()]
    off_wall = np.array([ratio_off_wall(signals) for signals in last])
    n_hit = sum(bool(at_wall(signals).any()) for signals in last)
    sentences.append(
        f"When the car hits the left wall, its velocity jumps to 0. {n_hit} of {len(last)} seeds hit it in the last "
        f"episode. Without the steps around it, from {BEFORE_WALL} before to {AFTER_WALL} after, the medians in that "
        f"episode are {interval(off_wall[:, 0].tolist())} for the position and {interval(off_wall[:, 1].tolist())} for "
        "the velocity."
    )
    steps = [float(np.mean(result["steps"][-LATE:])) for result in by_seed.values()]
    sentences.append(
        f"kNN-TD(λ), which learns from the filtered observations, takes {interval(steps)} steps per episode (mean of "
        f"the last {LATE})."
    )
    return " ".join(sentences)


FIG4 = PaperFigure(
    name="fig4",
    help="Mountain-Car with noise, and how much of it the δs filter removes",
    min_episodes=LATE + 1,
    compute=filtered_episodes,
    tables=tables,
    draw=draw,
    verdict=verdict,
)
