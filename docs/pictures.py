"""
Draw the figures of docs/algorithm.md and docs/knndyna.md.

    python docs/pictures.py [FOLDER]

The script trains the models with fixed seeds, so the same version draws the same figures.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback

from sb3_knntd import KNNTD, ExA, KNNDyna
from sb3_knntd.plots import (
    BASELINE_COLOR,
    LINE_COLOR,
    NAMES,
    UNLEARNED_COLOR,
    ValueGrid,
    figure_of,
    new_figure,
    plot_model_points,
    plot_rollout,
    value_grid,
)

POSITION, VELOCITY = NAMES["MountainCar-v0"].observations
#: Colour of points that are not neighbours.
POINT_COLOR = "0.75"


def neighbors() -> Figure:
    """An observation between the points of a lattice, its neighbours and their weights."""
    figure = new_figure(10.5, 4.2)
    observation = np.array([-0.43, 0.012], np.float32)
    spacing = 2 / 11
    settings: dict[str, dict[str, Any]] = {
        "n_neighbors=4": {"n_neighbors": 4},
        "n_neighbors=9": {"n_neighbors": 9},
        'n_neighbors=9, weights="gaussian",\nbandwidth: one lattice spacing': {
            "n_neighbors": 9,
            "weights": "gaussian",
            "bandwidth": spacing,
        },
    }
    panels = figure.subplots(1, len(settings), sharex=True, sharey=True)
    for axes, (title, arguments) in zip(panels, settings.items(), strict=True):
        policy = KNNTD("MountainCar-v0", points=(12, 12), **arguments).policy
        points = policy.points.numpy()
        indices, probabilities = (part[0].numpy() for part in policy.perceive(observation))
        axes.plot(*points.T, "o", color=POINT_COLOR, markersize=4)
        for point, probability in zip(points[indices], probabilities, strict=True):
            axes.plot(*zip(observation, point, strict=True), color=LINE_COLOR, linewidth=1, alpha=0.5)
            # The area is proportional to the weight.
            size = 44 * np.sqrt(probability)
            axes.plot(*point, "o", color=LINE_COLOR, markersize=size)
            offset = 0.36 * size + 1
            axes.annotate(
                f"{probability:.2f}", point, xytext=(offset, offset), textcoords="offset points", fontsize="small"
            )
        axes.plot(*observation, "X", color=BASELINE_COLOR, markersize=11, markeredgecolor="white")
        axes.set(title=title, xlabel=POSITION, xlim=(-0.86, -0.02), ylim=(-0.024, 0.046))
        axes.title.set_fontsize("medium")
    panels[0].set_ylabel(VELOCITY)
    return figure


class Trajectory(BaseCallback):
    """Record the observations."""

    def __init__(self) -> None:
        super().__init__()
        self.observations: list[np.ndarray] = []

    def _on_step(self) -> bool:
        self.observations.append(self.locals["new_obs"][0].copy())
        return True


def traces() -> Figure:
    """The traces along one trajectory for several values of λ."""
    figure = new_figure(10.5, 3.9)
    trained = KNNTD("MountainCar-v0", points=(20, 20), n_neighbors=4, seed=0).learn(30_000)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for axes, trace_decay in zip(panels, (0.5, 0.9, 0.98), strict=True):
        # A learning rate of 0 does not change the table, so the trajectory is the same for every λ.
        model = KNNTD(
            "MountainCar-v0",
            points=(20, 20),
            n_neighbors=4,
            seed=0,
            trace_decay=trace_decay,
            learning_rate=0.0,
            exploration_initial_eps=0.0,
        )
        model.policy.load_state_dict(trained.policy.state_dict())
        callback = Trajectory()
        model.learn(75, callback=callback)
        state = model.learner.state_dict()["traces"]
        # The largest trace over the actions.
        eligibility = (state["traces"][..., 0].amax(dim=1) * state["pace"][0]).numpy()
        points = model.policy.points.numpy()
        axes.plot(*points.T, "o", color=POINT_COLOR, markersize=2)
        marks = axes.scatter(
            *points[state["points"]].T, c=eligibility, s=46, cmap="viridis_r", norm=LogNorm(1e-4, 0.3), zorder=3
        )
        x, y = np.transpose(callback.observations)
        axes.plot(x, y, color=BASELINE_COLOR, linewidth=1.5, zorder=4)
        axes.plot(x[-1], y[-1], "X", color=BASELINE_COLOR, markersize=11, markeredgecolor="white", zorder=5)
        axes.set(title=f"λ = {trace_decay}", xlabel=POSITION)
    panels[0].set_ylabel(VELOCITY)
    figure.colorbar(marks, ax=panels, label="eligibility e", aspect=30, extend="min")
    return figure


class Growth(BaseCallback):
    """
    Record the value grid at the end of some episodes.

    :param episodes: numbers of the episodes, counted from 1
    """

    def __init__(self, episodes: tuple[int, ...]) -> None:
        super().__init__()
        self.episodes = episodes
        self.grids: dict[int, tuple[int, ValueGrid]] = {}

    def _on_step(self) -> bool:
        episode = self.model._episode_num
        if episode in self.episodes and episode not in self.grids:
            assert isinstance(self.model, KNNTD)
            self.grids[episode] = self.num_timesteps, value_grid(self.model)
        return True


def growth() -> Figure:
    """The propagation of values from the goal over the episodes of one run."""
    figure = new_figure(10.5, 5.2)
    callback = Growth((1, 10, 50, 400))
    KNNTD("MountainCar-v0", seed=0).learn(60_000, callback=callback)
    panels = figure.subplots(2, len(callback.grids), sharex=True, sharey=True)
    lowest = min(grid.values.min() for _, grid in callback.grids.values())
    actions = ListedColormap(matplotlib.colormaps["cividis"]([0.08, 0.515, 0.95]))
    for (above, below), (episode, (step, grid)) in zip(panels.T, callback.grids.items(), strict=True):
        shown: dict[str, Any] = {"origin": "lower", "extent": grid.extent, "aspect": "auto"}
        values = np.ma.masked_where(~grid.learned, grid.values)
        value_image = above.imshow(values, cmap="viridis", vmin=lowest, vmax=0, **shown)
        greedy = np.ma.masked_where(~grid.learned, grid.actions)
        action_image = below.imshow(greedy, cmap=actions, vmin=-0.5, vmax=2.5, interpolation="nearest", **shown)
        above.set_title(f"episode {episode}\n{step:,} steps", fontsize="medium")
        below.set_xlabel(POSITION)
        for axes in (above, below):
            axes.set_facecolor(UNLEARNED_COLOR)
    for axes in panels[:, 0]:
        axes.set_ylabel(VELOCITY, fontsize="small")
    figure.colorbar(value_image, ax=panels[0], label="V(s)", aspect=12)
    bar = figure.colorbar(action_image, ax=panels[1], ticks=range(3), aspect=12)
    bar.ax.set_yticklabels(NAMES["MountainCar-v0"].actions)
    bar.ax.tick_params(length=0)
    return figure


def continuous_action() -> Figure:
    """The recommendations of the neighbours, and their mean, the action of ExA."""
    figure = new_figure(10.5, 4.2)
    settings: dict[str, Any] = {"points": (15, 15), "n_neighbors": 9, "action_points": 3, "seed": 0}
    policy = ExA("MountainCarContinuous-v0", **settings).learn(20_000).policy
    # The same table with other weights.
    smoother = ExA("MountainCarContinuous-v0", weights="gaussian", bandwidth=2 / 14, **settings).policy
    smoother.load_state_dict(policy.state_dict())
    points, best = policy.points.numpy(), policy.action_points[0][policy.q_table.argmax(dim=1)].numpy()
    recommends: dict[str, Any] = {"cmap": "coolwarm", "vmin": -1, "vmax": 1}
    observation = np.array([-0.62, 0.004], np.float32)
    indices, probabilities = (part[0].numpy() for part in policy.perceive(observation))
    left, right = figure.subplots(1, 2)

    left.scatter(*points.T, c=best, s=14, **recommends)
    marks = left.scatter(*points[indices].T, c=best[indices], s=2200 * probabilities, edgecolor="black", **recommends)
    left.plot(*observation, "X", color="black", markersize=11, markeredgecolor="white")
    action = policy.predict(observation)[0].item()
    left.set(
        title=f"nine neighbours recommend, their mean is {action:.2f}",
        xlabel=POSITION,
        ylabel=VELOCITY,
        xlim=(-1.02, -0.2),
        ylim=(-0.032, 0.04),
    )
    figure.colorbar(marks, ax=left, label="best action of each point")

    velocities = np.linspace(-0.05, 0.05, 400, dtype=np.float32)
    line = np.stack((np.full_like(velocities, observation[0]), velocities), axis=1)
    nearest = best[policy.perceive(line).indices[:, 0].numpy()]
    right.step(velocities, nearest, color="0.6", linewidth=1.2, label="nearest point alone")
    for reader, label, color in ((policy, "mean of nine", LINE_COLOR), (smoother, "Gaussian weights", BASELINE_COLOR)):
        right.plot(velocities, reader.predict(line)[0][:, 0], color=color, linewidth=2.2, label=label)
    right.set(title=f"at position {observation[0]:.2f}", xlabel=VELOCITY, ylabel="force")
    right.grid(color="0.92")
    right.legend(frameon=False)
    return figure


def known_points() -> Figure:
    """The points of KNNDyna after 400 and 1,500 steps, and the number of actions that are known there."""
    figure = new_figure(10.5, 4.2)
    model = KNNDyna("Pendulum-v1", seed=0)
    for n_steps, axes in zip((400, 1100), figure.subplots(1, 2), strict=True):
        model.learn(n_steps, reset_num_timesteps=False)
        plot_model_points(model, dims=(1, 2), axes=axes)
        axes.set_title(f"{axes.get_title().split(',')[0]} after {model.num_timesteps:,} steps")
    return figure


def rollout() -> Figure:
    """An episode, and what KNNDyna's model expects of it from its first observation and its actions."""
    model, env = KNNDyna("Pendulum-v1", seed=0).learn(1_500), gym.make("Pendulum-v1")
    observations, actions, rewards = [env.reset(seed=3)[0]], [], []
    for _ in range(60):
        actions.append(model.predict(observations[-1])[0])
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(float(reward))
    return figure_of(plot_rollout(model, np.array(observations), np.array(actions), rewards)[0])


PICTURES = {
    "neighbors": neighbors,
    "traces": traces,
    "growth": growth,
    "continuous_action": continuous_action,
    "known_points": known_points,
    "rollout": rollout,
}


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        draw().savefig(folder / f"{name}.png")
        print(folder / f"{name}.png")


if __name__ == "__main__":
    main()
