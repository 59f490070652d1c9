"""Pictures of learning and of what was learned. matplotlib comes with ``pip install "sb3-knntd[extra]"``."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_knntd.knntd import KNNTD

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Resolution of the files, dots per inch.
DPI = 150
#: More actions than this are shown by number on a scale, since their names would not find room.
MOST_NAMED_ACTIONS = 10
#: Observations whose values are read in one go. With thousands of points more would take gigabytes.
BATCH = 512

LINE_COLOR = "#00488d"
BASELINE_COLOR = "#b35900"
UNLEARNED_COLOR = "#e4e4e4"


class Names(NamedTuple):
    """
    What an environment's dimensions and actions are called.

    :param observations: one name for each observation dimension, with its unit
    :param actions: one name for each action
    """

    observations: tuple[str, ...]
    actions: tuple[str, ...]


#: The environments of gymnasium whose spaces KNNTD takes.
NAMES = {
    "MountainCar-v0": Names(("position", "velocity (position per step)"), ("push left", "no push", "push right")),
    "CartPole-v1": Names(
        ("cart position (m)", "cart velocity (m/s)", "pole angle (rad)", "pole angular velocity (rad/s)"),
        ("push left", "push right"),
    ),
    "Acrobot-v1": Names(
        ("cos θ₁", "sin θ₁", "cos θ₂", "sin θ₂", "angular velocity of θ₁ (rad/s)", "angular velocity of θ₂ (rad/s)"),
        ("torque −1 N m", "no torque", "torque +1 N m"),
    ),
}


class ValueGrid(NamedTuple):
    """
    Action values over two dimensions of the observations.

    :param dims: the two dimensions, of the columns and of the rows
    :param extent: (left, right, bottom, top), the range of the two dimensions, observation units
    :param fixed: where the other dimensions stand, observation units
    :param q_values: at the middle of each cell, shape (resolution, resolution, n_actions), rows from bottom up
    :param learned: whether any entry that a cell is read from differs from the initial value,
        shape (resolution, resolution)
    """

    dims: tuple[int, int]
    extent: tuple[float, float, float, float]
    fixed: dict[int, float]
    q_values: np.ndarray
    learned: np.ndarray


def running_median(values: Sequence[float] | np.ndarray, window: int) -> np.ndarray:
    """
    :param values: shape (n,)
    :param window: number of values that a median is over
    :return: the median of each value and the ``window - 1`` before it (fewer at the beginning), shape (n,)
    :raises ValueError: if ``window`` < 1
    """
    if window < 1:
        raise ValueError(f"window must be at least 1; got {window}")
    return np.array([np.median(values[max(0, end - window) : end]) for end in range(1, len(values) + 1)])


def value_grid(
    model: KNNTD, dims: tuple[int, int] = (0, 1), fixed: Mapping[int, float] | None = None, resolution: int = 120
) -> ValueGrid:
    """
    Read the action values over the range of two dimensions.

    :param model: a model of Box observations with at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param fixed: where to hold other dimensions, observation units; those not named stay in the middle of
        their range
    :param resolution: number of cells in each of the two dimensions
    :return: the values. With VecNormalize, observation units are the normalised ones that the model sees
    :raises ValueError: if the observations are not a Box of two or more dimensions, or ``dims``, ``fixed`` or
        ``resolution`` do not fit
    """
    space = model.observation_space
    if not isinstance(space, spaces.Box) or space.shape[0] < 2:
        raise ValueError(f"a value function is drawn over two dimensions of a Box of observations; got {space}")
    n_dims = space.shape[0]
    if len(dims) != 2 or dims[0] == dims[1] or not all(dim in range(n_dims) for dim in dims):
        raise ValueError(f"dims must be two different dimensions of 0 to {n_dims - 1}; got {dims!r}")
    given = dict(fixed or {})
    if not all(dim in range(n_dims) and dim not in dims for dim in given):
        raise ValueError(
            f"fixed must name dimensions of 0 to {n_dims - 1} other than those drawn, {dims}; got {given!r}"
        )
    if resolution < 1:
        raise ValueError(f"resolution must be at least 1; got {resolution}")

    low, high = _range(model)
    held = {dim: float(given.get(dim, (low[dim] + high[dim]) / 2)) for dim in range(n_dims) if dim not in dims}
    middles = (np.arange(resolution) + 0.5) / resolution
    observations = np.empty((resolution, resolution, n_dims))
    for dim, value in held.items():
        observations[..., dim] = value
    across, up = dims
    observations[..., across] = low[across] + middles * (high[across] - low[across])
    observations[..., up] = (low[up] + middles * (high[up] - low[up]))[:, None]

    flat = observations.reshape(-1, n_dims)
    q_values = _q_values(model, flat)
    learned = np.concatenate([_learned(model, batch) for batch in _batches(flat)])
    return ValueGrid(
        (int(across), int(up)),
        (float(low[across]), float(high[across]), float(low[up]), float(high[up])),
        held,
        q_values.reshape(resolution, resolution, -1),
        learned.reshape(resolution, resolution),
    )


def telling_dims(model: KNNTD, resolution: int = 60) -> tuple[int, int]:
    """
    Choose the dimensions worth drawing: with the others in the middle of their range, the value changes most
    along these two.

    :param model: a model of Box observations with at least two dimensions
    :param resolution: number of places looked at in each dimension
    :return: two dimensions, the lower first
    """
    low, high = _range(model)
    if len(low) == 2:
        return 0, 1
    spreads = []
    for dim in range(len(low)):
        line = np.tile((low + high) / 2, (resolution, 1))
        line[:, dim] = np.linspace(low[dim], high[dim], resolution)
        spreads.append(np.ptp(_q_values(model, line).max(axis=1)))
    first, second = sorted(np.argsort(-np.array(spreads), kind="stable")[:2].tolist())
    return first, second


def plot_learning_curve(
    steps: Sequence[float] | np.ndarray,
    returns: Sequence[float] | np.ndarray,
    baseline: float | None = None,
    baseline_label: str = "random policy, mean",
    window: int | None = None,
    axes: Axes | None = None,
) -> Axes:
    """
    Draw the return of each episode, and their running median, over the steps taken.

    :param steps: environment steps at the end of each episode, shape (n_episodes,)
    :param returns: sum of rewards of each episode, shape (n_episodes,)
    :param baseline: return to compare with, drawn as a dashed line
    :param baseline_label: what it is the return of
    :param window: number of episodes that a median is over; by default a tenth of them, 5 at least and 100 at most
    :param axes: where to draw; a new figure if not given
    :return: the axes drawn on; :func:`figure_of` tells their figure
    :raises ValueError: if ``steps`` and ``returns`` differ in length
    """
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    if len(steps) != len(returns):
        raise ValueError(f"steps and returns must be of the same length; got {len(steps)} and {len(returns)}")
    axes = axes if axes is not None else new_figure(7.0, 4.2).add_subplot()
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
        # Above the axes it covers no line, whichever way the curve goes.
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, fontsize="small", borderaxespad=0.2
        )
    return axes


def plot_value_function(
    model: KNNTD,
    dims: tuple[int, int] = (0, 1),
    fixed: Mapping[int, float] | None = None,
    resolution: int = 120,
    axes: tuple[Axes, Axes] | None = None,
    names: Names | None = None,
) -> tuple[Axes, Axes]:
    """
    Draw V(s) = max_a Q(s, a) and the greedy action over two dimensions of the observations. Grey is where the
    k nearest points all stand at the initial value.

    :param model: a model of Box observations with at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param fixed: where to hold other dimensions, observation units; those not named stay in the middle of
        their range
    :param resolution: number of cells in each of the two dimensions
    :param axes: where to draw value and action; a new figure with two axes if not given
    :param names: what dimensions and actions are called; by default those in ``NAMES`` of the model's
        environment, and numbers if it is not there
    :return: the two axes drawn on; :func:`figure_of` tells their figure
    :raises ValueError: if the observations are not a Box of two or more dimensions, or ``dims``, ``fixed``,
        ``resolution`` or ``names`` do not fit
    """
    grid = value_grid(model, dims, fixed, resolution)
    if names is not None and not _fit(names, model):
        raise ValueError(f"names must hold one for each observation dimension and action; got {names!r}")
    names = names or _names_of(model) or _numbered(model)
    if axes is None:
        figure = new_figure(10.5, 4.4)
        left, right = figure.subplots(1, 2, sharex=True, sharey=True, gridspec_kw={"wspace": 0.06})
        if grid.fixed:
            held = ", ".join(f"{names.observations[dim]} = {value:.3g}" for dim, value in grid.fixed.items())
            figure.suptitle(textwrap.fill(f"where {held}", 110), fontsize="medium", color="0.3")
        axes = left, right
    _draw_values(axes[0], grid)
    _draw_actions(axes[1], grid, names.actions)
    for ax in axes:
        ax.set_xlabel(names.observations[grid.dims[0]])
        ax.set_facecolor(UNLEARNED_COLOR)
    axes[0].set_ylabel(names.observations[grid.dims[1]])
    if not grid.learned.all():
        axes[0].annotate(
            "grey: nothing learned",
            (0, 1),
            xytext=(0, 4),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize="small",
            color="0.4",
        )
    return axes


def new_figure(width: float, height: float) -> Figure:
    """
    :param width: inches
    :param height: inches
    :return: a figure that belongs to no window and to no global state; save it with ``figure.savefig(path)``
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def figure_of(axes: Axes) -> Figure:
    """
    :param axes: axes that were drawn on
    :return: the figure that they are part of
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure


def _draw_values(axes: Axes, grid: ValueGrid) -> None:
    values = np.ma.masked_where(~grid.learned, grid.q_values.max(axis=2))
    image = axes.imshow(values, origin="lower", extent=grid.extent, aspect="auto", cmap="viridis")
    figure_of(axes).colorbar(image, ax=axes, label=r"$V(s) = \max_a\,Q(s, a)$")
    axes.set_title("Value")


def _draw_actions(axes: Axes, grid: ValueGrid, names: Sequence[str]) -> None:
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    n_actions = len(names)
    # Evenly spaced in lightness, so that they stay apart in grey and for colour-blind readers.
    colors = ListedColormap(matplotlib.colormaps["cividis"](np.linspace(0.08, 0.95, n_actions)))
    image = axes.imshow(
        np.ma.masked_where(~grid.learned, grid.q_values.argmax(axis=2)),
        origin="lower",
        extent=grid.extent,
        aspect="auto",
        cmap=colors,
        norm=BoundaryNorm(np.arange(n_actions + 1) - 0.5, n_actions),
        interpolation="nearest",
    )
    every = -(-n_actions // MOST_NAMED_ACTIONS)
    bar = figure_of(axes).colorbar(image, ax=axes, ticks=range(0, n_actions, every))
    bar.ax.set_yticklabels(names[::every])
    bar.ax.tick_params(length=0, which="both")
    axes.set_title("Greedy action")


def _range(model: KNNTD) -> tuple[np.ndarray, np.ndarray]:
    bounds = model.policy.perceiver.bounds
    return bounds.low.cpu().numpy(), bounds.high.cpu().numpy()


def _batches(observations: np.ndarray) -> list[np.ndarray]:
    return np.array_split(observations, -(-len(observations) // BATCH))


def _q_values(model: KNNTD, observations: np.ndarray) -> np.ndarray:
    with th.no_grad():
        return np.concatenate([model.policy.q_values(batch).cpu().numpy() for batch in _batches(observations)])


def _learned(model: KNNTD, observations: np.ndarray) -> np.ndarray:
    rows = model.policy.table.rows(model.policy.perceive(observations).indices)
    changed: np.ndarray = (rows != model.initial_value).flatten(1).any(dim=1).cpu().numpy()
    return changed


def _names_of(model: KNNTD) -> Names | None:
    env = model.get_env()
    spec = None if env is None else env.get_attr("spec", 0)[0]
    names = None if spec is None else NAMES.get(spec.id)
    # A wrapper may have given the environment other spaces than its name tells of.
    return names if names is not None and _fit(names, model) else None


def _fit(names: Names, model: KNNTD) -> bool:
    assert isinstance(model.action_space, spaces.Discrete)
    return model.observation_space.shape == (len(names.observations),) and model.action_space.n == len(names.actions)


def _numbered(model: KNNTD) -> Names:
    assert isinstance(model.observation_space, spaces.Box)
    assert isinstance(model.action_space, spaces.Discrete)
    start = model.action_space.start
    return Names(
        tuple(f"observation[{dim}]" for dim in range(model.observation_space.shape[0])),
        tuple(f"action {number}" for number in range(start, start + model.action_space.n)),
    )
