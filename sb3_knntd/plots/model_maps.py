"""Plots of points and of what is known at them, and of a rollout of KNNDyna's model beside a real episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces

from sb3_knntd.model import Prediction
from sb3_knntd.plots.figures import BASELINE_COLOR, LINE_COLOR, UNLEARNED_COLOR, figure_of, new_figure
from sb3_knntd.plots.grids import check_dims
from sb3_knntd.plots.names import Names, names_for
from sb3_knntd.policies import TableModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Number of panels in a row.
COLUMNS = 3


@runtime_checkable
class PlanningModel(TableModel, Protocol):
    """A model that has learned what follows on an action, such as KNNDyna."""

    known: np.ndarray
    visited: np.ndarray

    def predict_next(self, observation: np.ndarray, action: np.ndarray | int) -> Prediction:
        """What the model expects after a step."""


class Rollout(NamedTuple):
    """
    A rollout of a model.

    :param observations: the first one, and those that the model expects, shape (n_steps + 1, obs_dim), observation
        units
    :param rewards: expected rewards, shape (n_steps,)
    :param known: whether the step is known, shape (n_steps,), bool
    """

    observations: np.ndarray
    rewards: np.ndarray
    known: np.ndarray


def plot_model_points(
    model: TableModel, dims: tuple[int, int] = (0, 1), axes: Axes | None = None, names: Names | None = None
) -> Axes:
    """
    Plot the points of a model over two dimensions of the observations, coloured by the number of actions that are known
    there: by KNNDyna's model; with the other algorithms, those whose value is not the initial one. Points where no
    action is known are grey. With KNNDyna, dots are the observations that its transitions began at.

    :param model: a model with Box observations of at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param axes: axes to draw on; a new figure if not given
    :param names: names of the dimensions and actions; by default those of the model's environment in ``NAMES``, or
        numbers if it is not there
    :return: the axes; see :func:`figure_of` for their figure
    :raises ValueError: if the observations are not a Box of two or more dimensions, or ``dims`` or ``names`` do not fit
    """
    n_dims = _count_dims(model, 2)
    across, up = check_dims(dims)
    if max(across, up) >= n_dims:
        raise ValueError(f"dims must be two different dimensions of 0 to {n_dims - 1}; got {dims!r}")
    names = names_for(model, names)
    axes = axes if axes is not None else new_figure(5.6, 4.4).add_subplot()
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm, ListedColormap

    points, title = model.policy.points.cpu().numpy(), f"{len(model.policy.points):,} points"
    if isinstance(model, PlanningModel):
        visited, known = model.visited, model.known
        axes.plot(visited[:, across], visited[:, up], ".", color="0.55", markersize=1.5, markeredgewidth=0, zorder=1)
        title += f", {len(visited):,} transitions"
    else:
        known = (model.policy.q_table != model.policy.table.initial_value).cpu().numpy()
    counts, n_actions = known.sum(axis=1), known.shape[1]
    # The first of these colours is that of no known action.
    colors = ListedColormap([UNLEARNED_COLOR, *colormaps["viridis_r"](np.linspace(0.12, 1.0, n_actions))])
    drawn = axes.scatter(
        points[:, across],
        points[:, up],
        c=counts,
        s=np.where(counts > 0, 22.0, 14.0),
        cmap=colors,
        norm=BoundaryNorm(np.arange(n_actions + 2) - 0.5, n_actions + 1),
        edgecolors=["white" if count else "0.35" for count in counts],
        linewidths=0.5,
        zorder=2,
    )
    bar = figure_of(axes).colorbar(drawn, ax=axes, label="known actions", ticks=range(n_actions + 1))
    bar.ax.tick_params(length=0, which="both")
    axes.set(xlabel=names.observations[across], ylabel=names.observations[up])
    axes.set_title(title)
    return axes


def roll_out(model: PlanningModel, observation: np.ndarray, actions: np.ndarray) -> Rollout:
    """
    Let a model go from an observation by given actions. It ends before them where the model expects the end of the
    episode, or has never seen the action.

    :param model: a model that has learned
    :param observation: the first observation, shape (obs_dim,), observation units
    :param actions: actions of the environment, shape (n_steps, *action_shape)
    :return: what the model expects
    :raises ValueError: if nothing has been learned yet, or an argument does not fit the spaces
    """
    observations, rewards, known = [np.asarray(observation, dtype=np.float64)], [], []
    for action in actions:
        expected = model.predict_next(observations[-1], action)
        if not np.isfinite(expected.observation).all():
            break
        observations.append(expected.observation)
        rewards.append(expected.reward)
        known.append(expected.known)
        if expected.end > 0.5:
            break
    return Rollout(np.array(observations), np.array(rewards), np.array(known, dtype=np.bool_))


def plot_rollout(
    model: PlanningModel,
    observations: np.ndarray,
    actions: np.ndarray,
    rewards: Sequence[float] | np.ndarray | None = None,
    axes: Sequence[Axes] | None = None,
    names: Names | None = None,
) -> tuple[Axes, ...]:
    """
    Plot a rollout of the model beside a real one with the same first observation and actions. Circles mark the steps
    that the model does not know.

    .. code-block:: python

        env = gym.make("Pendulum-v1")
        observations, actions, rewards = [env.reset(seed=0)[0]], [], []
        for _ in range(100):
            actions.append(model.predict(observations[-1])[0])
            observation, reward, *_ = env.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
        axes = plot_rollout(model, np.array(observations), np.array(actions), rewards)
        figure_of(axes[0]).savefig("rollout.png")

    :param model: a model with Box observations that has learned
    :param observations: those of a real episode, shape (n_steps + 1, obs_dim), observation units
    :param actions: its actions, shape (n_steps, *action_shape)
    :param rewards: its rewards, shape (n_steps,), for one more panel; ``None`` for no such panel
    :param axes: axes to draw on, one for each observation dimension, and one for the rewards if they are given; a new
        figure if not given
    :param names: names of the dimensions and actions; by default those of the model's environment in ``NAMES``, or
        numbers if it is not there
    :return: the axes; see :func:`figure_of` for their figure
    :raises ValueError: if nothing has been learned yet, the observations are not a Box, or an argument does not fit
    """
    if not isinstance(model, PlanningModel):
        raise ValueError(f"model must be a KNNDyna, which has a model of its environment; got a {type(model).__name__}")
    n_dims = _count_dims(model, 1)
    real, given = np.asarray(observations, dtype=np.float64), np.asarray(actions)
    n_steps = len(given)
    if real.shape != (n_steps + 1, n_dims):
        raise ValueError(
            f"observations must have shape (n_steps + 1, {n_dims}), here ({n_steps + 1}, {n_dims}), as there "
            f"are {n_steps} actions; got {real.shape}"
        )
    if rewards is not None and np.shape(rewards) != (n_steps,):
        raise ValueError(f"rewards must have shape ({n_steps},), one for each action; got {np.shape(rewards)}")
    labels = list(names_for(model, names).observations)
    expected = roll_out(model, real[0], given)
    pairs: list[tuple[Any, Any]] = [(real[:, dim], expected.observations[:, dim]) for dim in range(n_dims)]
    if rewards is not None:
        labels.append("reward")
        pairs.append((np.asarray(rewards), expected.rewards))
    if axes is None:
        n_columns = min(COLUMNS, len(labels))
        n_rows = -(-len(labels) // n_columns)
        figure = new_figure(3.8 * n_columns, 2.6 * n_rows + 0.4)
        panels = figure.subplots(n_rows, n_columns, squeeze=False).flatten().tolist()
        for empty in panels[len(labels) :]:
            empty.set_axis_off()
        axes = panels[: len(labels)]
    elif len(axes) != len(labels):
        raise ValueError(f"axes must be {len(labels)}, one for each of {', '.join(labels)}; got {len(axes)}")
    unknown = np.flatnonzero(~expected.known)
    for ax, label, (truth, guess) in zip(axes, labels, pairs, strict=True):
        # A reward belongs to the step that it followed on.
        first = n_steps + 1 - len(truth)
        ax.plot(np.arange(first, n_steps + 1), truth, color=LINE_COLOR, linewidth=1.8, label="environment")
        ax.plot(first + np.arange(len(guess)), guess, "--", color=BASELINE_COLOR, linewidth=1.6, label="model")
        if len(unknown):
            ax.plot(
                unknown + 1,
                guess[unknown + 1 - first],
                "o",
                color=BASELINE_COLOR,
                fillstyle="none",
                markersize=4.5,
                label="model, not known",
            )
        ax.set(xlabel="step", ylabel=label)
        ax.grid(color="0.9")
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, fontsize="small", borderaxespad=0.2)
    return tuple(axes)


def _count_dims(model: TableModel, least: int) -> int:
    space = model.observation_space
    if not isinstance(space, spaces.Box) or space.shape[0] < least:
        raise ValueError(f"observations must be a Box of {least} or more dimensions; got {space}")
    return int(space.shape[0])
