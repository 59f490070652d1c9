"""Figure 7: cart-pole, an episode of continuous actions and their smoothness."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_knntd.distributed.jobs import stored_as
from sb3_knntd.experiments.reproduce.figure import PaperFigure, Results, Table
from sb3_knntd.experiments.reproduce.settings import Setting, compiled, make_model, total_steps
from sb3_knntd.experiments.reproduce.statistics import HIGH, LOW, interval, quantile, seeds_range, yes_no
from sb3_knntd.plots import BASELINE_COLOR, LINE_COLOR, new_figure
from sb3_knntd.registry import ALGORITHMS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Number of equal intervals of the action range, used to measure how much of it is covered.
PARTS = 20
COLORS = {"knntd": BASELINE_COLOR, "exa": LINE_COLOR}
STATE = ("position", "velocity", "angle", "angular velocity")


class FullEpisodeRecorder(VecEnvWrapper):
    """
    Records the first episode that reaches the time limit.

    :param venv: one cart-pole with a time limit
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        #: Number of finished episodes.
        self.n_episodes = 0
        #: The states and actions (shares of the largest force) of the recorded episode; None before it.
        self.recorded: tuple[list[list[float]], list[float]] | None = None
        self._forces = venv.get_attr("forces")[0] if isinstance(venv.action_space, spaces.Discrete) else None
        self._states: list[list[float]] = []
        self._pushes: list[float] = []

    def reset(self) -> VecEnvObs:
        observations = self.venv.reset()
        self._begin(observations)
        return observations

    def _begin(self, observations: Any) -> None:
        self._states, self._pushes = [observations[0].tolist()], []

    def step_async(self, actions: np.ndarray) -> None:
        action = actions[0]
        push = np.clip(action, -1.0, 1.0).item() if self._forces is None else self._forces[action]
        self._pushes.append(float(push))
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        if dones[0]:
            self.n_episodes += 1
            if infos[0]["TimeLimit.truncated"] and self.recorded is None:
                self.recorded = self._states, self._pushes
            self._begin(observations)
        else:
            self._states.append(observations[0].tolist())  # type: ignore[index]
        return observations, rewards, dones, infos


@stored_as("sb3_knntd.reproduce.fig7.first_full_episode")
def first_full_episode(algorithm: str, setting: Setting, seed: int) -> dict[str, Any]:
    """
    Train until an episode reaches the time limit, or for the number of episodes of the setting.

    :param algorithm: ``"knntd"`` or ``"exa"``
    :param setting: an entry of ``paper.yml``
    :param seed: seed of the model and its environment
    :return: the number of the ``episode``, counted from 1, ``None`` if there is none; its ``states``, shape
        (n_steps, 4), and ``actions``, shape (n_steps,), shares of the largest force
    """
    recorders: list[FullEpisodeRecorder] = []

    def wrap(env: gym.Env[Any, Any]) -> VecEnv:
        recorders.append(FullEpisodeRecorder(compiled(env)))
        return recorders[0]

    model = make_model(algorithm, setting, seed, wrap)
    (recorder,) = recorders

    def continue_training(locals_: dict[str, Any], globals_: dict[str, Any]) -> bool:
        return recorder.recorded is None and recorder.n_episodes < setting["episodes"]

    model.learn(total_steps(setting), callback=continue_training)
    if recorder.recorded is None:
        return {"episode": None, "states": [], "actions": []}
    states, actions = recorder.recorded
    return {"episode": recorder.n_episodes, "states": states, "actions": actions}


def mean_change(actions: list[float]) -> float:
    """
    :param actions: actions of an episode, shares of the largest force, shape (n_steps,)
    :return: mean of abs(a_t - a_(t-1)), from 0 (constant force) to 2 (alternating largest forces)
    """
    return float(np.abs(np.diff(actions)).mean())


def used_share(actions: list[float]) -> float:
    """
    :param actions: actions of an episode, shares of the largest force, shape (n_steps,)
    :return: share of 20 equal intervals of the action range that contain an action
    """
    counts, _ = np.histogram(actions, bins=PARTS, range=(-1.0, 1.0))
    return float((counts > 0).mean())


def tables(results: Results) -> dict[str, Table]:
    """
    :param results: the first full episode of each seed
    :return: a table with one row per seed, and the plotted episodes
    """
    seeds = [
        (algorithm, seed, result["episode"], *_measures(result))
        for algorithm, by_seed in results.items()
        for seed, result in by_seed.items()
    ]
    episodes = [
        (algorithm, seed, step, *state, action)
        for algorithm in results
        if (seed := drawn_seed(results, algorithm)) is not None
        for step, (state, action) in enumerate(
            zip(results[algorithm][seed]["states"], results[algorithm][seed]["actions"], strict=True)
        )
    ]
    units = ("position_m", "velocity_m_per_s", "angle_rad", "angular_velocity_rad_per_s")
    return {
        "table.csv": Table(("algorithm", "seed", "episode", "mean_change", "used_share", "distinct_actions"), seeds),
        "episodes.csv": Table(("algorithm", "seed", "step", *units, "action"), episodes),
    }


def _measures(result: dict[str, Any]) -> tuple[float | None, float | None, int | None]:
    actions = result["actions"]
    return (mean_change(actions), used_share(actions), len(set(actions))) if actions else (None, None, None)


def recorded_actions(results: Results, algorithm: str) -> list[list[float]]:
    """
    :param results: the first full episode of each seed
    :param algorithm: name of the algorithm
    :return: the actions of each seed that has a full episode
    """
    return [result["actions"] for result in results[algorithm].values() if result["actions"]]


def drawn_seed(results: Results, algorithm: str) -> int | None:
    """
    :param results: the first full episode of each seed
    :param algorithm: name of the algorithm
    :return: the first seed that has a full episode, ``None`` if there is none
    """
    return next((seed for seed, result in results[algorithm].items() if result["actions"]), None)


def draw(results: Results, title: str) -> Figure:
    """
    :param results: the first full episode of each seed
    :param title: title of the figure
    :return: plot of the trajectory in the state space (A) and the actions (B) of one episode, and of the smoothness of
        all
    """
    figure = new_figure(10.5, 6.6)
    grid = figure.add_gridspec(2, 6)
    pole, cart = figure.add_subplot(grid[0, :3]), figure.add_subplot(grid[0, 3:])
    actions, smoothness = figure.add_subplot(grid[1, :4]), figure.add_subplot(grid[1, 4:])
    _draw_trajectory(pole, results, (2, 3), math.degrees(1.0))
    pole.set(title="A  trajectory of the pole", xlabel="angle (°)", ylabel="angular velocity (°/s)")
    _draw_trajectory(cart, results, (0, 1), 1.0)
    cart.set(title="A  trajectory of the cart", xlabel="position (m)", ylabel="velocity (m/s)")
    _draw_actions(actions, results)
    _draw_smoothness(smoothness, results)
    for axes in (pole, cart, actions, smoothness):
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(axes.get_title(), loc="center", fontsize="medium")
    figure.suptitle(title)
    return figure


def _draw_trajectory(axes: Axes, results: Results, dims: tuple[int, int], scale: float) -> None:
    for algorithm in results:
        seed = drawn_seed(results, algorithm)
        if seed is None:
            continue
        states = scale * np.array(results[algorithm][seed]["states"])[:, dims]
        above = algorithm == "exa"
        axes.plot(
            *states.T,
            color=COLORS[algorithm],
            linewidth=1.0,
            alpha=0.9 if above else 0.35,
            zorder=3 if above else 2,
            label=f"{ALGORITHMS[algorithm].label}, seed {seed}",
        )
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.legend(framealpha=0.85, edgecolor="none", fontsize="small")


def _draw_actions(axes: Axes, results: Results) -> None:
    for algorithm in results:
        seed = drawn_seed(results, algorithm)
        if seed is None:
            continue
        above = algorithm == "exa"
        axes.plot(
            results[algorithm][seed]["actions"],
            color=COLORS[algorithm],
            linewidth=0.8,
            alpha=0.9 if above else 0.3,
            zorder=3 if above else 2,
        )
    axes.set(title="B  actions", xlabel="step", ylabel="force / 10 N", ylim=(-1.05, 1.05))


def _draw_smoothness(axes: Axes, results: Results) -> None:
    names = []
    for place, algorithm in enumerate(results):
        changes = [mean_change(actions) for actions in recorded_actions(results, algorithm)]
        # Spread horizontally in the order of the seeds, so that equal values do not hide each other.
        across = place + np.linspace(-0.25, 0.25, len(changes))
        axes.scatter(across, changes, color=COLORS[algorithm], alpha=0.4, linewidths=0)
        if changes:
            low, median, high = (quantile(changes, share) for share in (LOW, 0.5, HIGH))
            axes.vlines(place, low, high, color=COLORS[algorithm], linewidth=2.5)
            axes.hlines(median, place - 0.35, place + 0.35, color=COLORS[algorithm], linewidth=2.5)
        names.append(f"{ALGORITHMS[algorithm].label}\n{len(changes)} of {len(results[algorithm])} seeds")
    axes.set_xticks(range(len(names)), names)
    axes.set(title="Smoothness, each seed", ylabel="mean change of action per step", xlim=(-0.6, len(names) - 0.4))
    axes.set_ylim(bottom=0)


def verdict(results: Results) -> str:
    """
    :param results: the first full episode of each seed
    :return: a paragraph
    """
    sentences = [
        f"Cart-pole, the first episode that lasts 1000 steps, over {seeds_range(results['exa'])}: mean change of the "
        "action per step, as a share of the largest force."
    ]
    changes = {}
    for algorithm, by_seed in results.items():
        recorded = recorded_actions(results, algorithm)
        changes[algorithm] = [mean_change(actions) for actions in recorded]
        median = f"median {interval(changes[algorithm])}" if recorded else "none"
        label = ALGORITHMS[algorithm].label
        sentences.append(f"{label}: {median}, over the {len(recorded)} of {len(by_seed)} seeds with such an episode.")
    sentences.append("The 10 % and 90 % quantiles are in brackets.")
    if all(changes.values()):
        smoother = quantile(changes["exa"], 0.5) < quantile(changes["knntd"], 0.5)
        sentences.append(f"The paper says that Ex⟨a⟩(λ) controls more smoothly. By these medians: {yes_no(smoother)}.")
    recorded = recorded_actions(results, "exa")
    if recorded:
        used = [100 * used_share(actions) for actions in recorded]
        distinct = [len(set(actions)) for actions in recorded]
        sentences.append(
            "The paper says that its actions almost completely cover the range. Here they cover "
            f"{interval(used)} % of 20 equal intervals, with {interval(distinct)} different actions."
        )
    return " ".join(sentences)


FIG7 = PaperFigure(
    name="fig7",
    help="cart-pole, one episode of continuous actions, and their smoothness",
    min_episodes=1,
    compute=first_full_episode,
    tables=tables,
    draw=draw,
    verdict=verdict,
)
