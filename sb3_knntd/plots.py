"""Pictures of learning and of what was learned. matplotlib comes with ``pip install "sb3-knntd[extra]"``."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_knntd.actions.selection import mean_rows
from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.common.checks import check_integer, check_number, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Resolution of the files, dots per inch.
DPI = 150
#: Cells in each dimension of a picture: more than there are dots.
FINEST = 4096
#: More actions than this are shown by number on a scale, since their names would not find room.
MOST_NAMED_ACTIONS = 10
#: Observations whose values are read in one go. With thousands of points more would take gigabytes.
BATCH = 512
#: How many places of the other dimensions an average is over.
AVERAGED_PLACES = 32

LINE_COLOR = "#00488d"
BASELINE_COLOR = "#b35900"
UNLEARNED_COLOR = "#e4e4e4"


class Names(NamedTuple):
    """
    What an environment's dimensions and actions are called.

    :param observations: one name for each observation dimension, with its unit
    :param actions: one name for each action, or for each dimension of the action
    """

    observations: tuple[str, ...]
    actions: tuple[str, ...]


#: The environments of gymnasium whose spaces KNNTD or ExA takes.
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
    "Pendulum-v1": Names(("cos θ", "sin θ", "angular velocity (rad/s)"), ("torque (N m)",)),
    "MountainCarContinuous-v0": Names(("position", "velocity (position per step)"), ("force",)),
}


class ValueGrid(NamedTuple):
    """
    What a model says over two dimensions of the observations.

    :param dims: the two dimensions, of the columns and of the rows
    :param extent: (left, right, bottom, top), the range of the two dimensions, observation units
    :param fixed: where other dimensions are held, observation units
    :param averaged: the dimensions that are averaged over
    :param q_values: at the middle of each cell, shape (resolution, resolution, n_actions), rows from bottom up
    :param values: V(s), shape (resolution, resolution)
    :param actions: the greedy action, shape (resolution, resolution), int64, counted from 0; of ExA its mean, shape
        (resolution, resolution, action_dim), action units
    :param learned: whether any entry that a cell is read from differs from the initial value,
        shape (resolution, resolution)
    """

    dims: tuple[int, int]
    extent: tuple[float, float, float, float]
    fixed: dict[int, float]
    averaged: tuple[int, ...]
    q_values: np.ndarray
    values: np.ndarray
    actions: np.ndarray
    learned: np.ndarray


def check_dims(dims: Any) -> tuple[int, int]:
    """
    :param dims: what was given as ``dims``
    :return: two different dimensions
    :raises ValueError: if it is anything else
    """
    try:
        across, up = (check_integer("dims", dim, 0) for dim in dims)
    except (TypeError, ValueError):
        across = up = 0
    if across == up:
        raise ValueError(f"dims must be two different dimensions, counted from 0; got {shown(dims)}")
    return across, up


def check_fixed(fixed: Any) -> dict[int, float] | None:
    """
    :param fixed: what was given as ``fixed``
    :return: dimensions, and where each is held
    :raises ValueError: if it is anything else, or not finite
    """
    if fixed is None:
        return None
    if not isinstance(fixed, Mapping):
        raise ValueError(f"fixed must give dimensions and where to hold them, {{2: 0.0}} say; got {shown(fixed)}")
    return {check_integer("fixed: a dimension", dim, 0): check_number("fixed", fixed[dim]) for dim in fixed}


def check_names(names: Any) -> Names | None:
    """
    :param names: what was given as ``names``
    :return: the same
    :raises ValueError: if it is neither ``None`` nor two lists of words
    """
    if names is None:
        return None
    try:
        checked = Names(*map(tuple, names))
    except TypeError as error:
        raise ValueError(f"names must be plots.Names(observations, actions); got {shown(names)}") from error
    if not all(isinstance(name, str) for name in (*checked.observations, *checked.actions)):
        raise ValueError(f"names must be plots.Names(observations, actions), of words; got {shown(names)}")
    return checked


def running_median(values: Sequence[float] | np.ndarray, window: int) -> np.ndarray:
    """
    :param values: shape (n,)
    :param window: number of values that a median is over
    :return: the median of each value and the ``window - 1`` before it (fewer at the beginning), shape (n,)
    :raises ValueError: if ``window`` < 1
    """
    check_integer("window", window, 1)
    return np.array([np.median(values[max(0, end - window) : end]) for end in range(1, len(values) + 1)])


def value_grid(
    model: KNNAlgorithm,
    dims: tuple[int, int] = (0, 1),
    fixed: Mapping[int, float] | None = None,
    resolution: int = 120,
    average: bool = False,
) -> ValueGrid:
    """
    Read values and greedy actions over the range of two dimensions.

    :param model: a model of Box observations with at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param fixed: where to hold other dimensions, observation units
    :param resolution: number of cells in each of the two dimensions
    :param average: what is done with the dimensions that ``fixed`` does not name: they are held in the middle of their
        range, or, if true, averaged over 32 places spread over it, of which those count where something was learned.
        The action is then the one that is greedy at most of the places, and with ExA the mean
    :return: the values. With VecNormalize, observation units are the normalised ones that the model sees
    :raises ValueError: if the observations are not a Box of two or more dimensions, or ``dims``, ``fixed`` or
        ``resolution`` do not fit
    """
    held, averaged = _check_view(model, dims, fixed, resolution, average)
    low, high = _range(model)
    n_dims, (across, up) = len(low), dims
    middles = (np.arange(resolution) + 0.5) / resolution
    observations = np.empty((resolution, resolution, n_dims))
    for dim, value in held.items():
        observations[..., dim] = value
    observations[..., across] = low[across] + middles * (high[across] - low[across])
    observations[..., up] = (low[up] + middles * (high[up] - low[up]))[:, None]

    readings = []
    for place in _places(low, high, averaged):
        observations[..., averaged] = place
        readings.append(_read(model, observations.reshape(-1, n_dims)))
    grid = _join(readings, model.policy.table.n_actions)
    return ValueGrid(
        (int(across), int(up)),
        (float(low[across]), float(high[across]), float(low[up]), float(high[up])),
        held,
        averaged,
        *(array.reshape(resolution, resolution, *array.shape[1:]) for array in grid),
    )


def telling_dims(model: KNNAlgorithm, resolution: int = 60) -> tuple[int, int]:
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
        spreads.append(np.ptp(_read(model, line).values))
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
    if len(steps) != len(returns):
        raise ValueError(f"steps and returns must be of the same length; got {len(steps)} and {len(returns)}")
    axes = axes if axes is not None else new_figure(7.0, 4.2).add_subplot()
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

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
    model: KNNAlgorithm,
    dims: tuple[int, int] = (0, 1),
    fixed: Mapping[int, float] | None = None,
    resolution: int = 120,
    axes: Sequence[Axes] | None = None,
    names: Names | None = None,
    average: bool = False,
) -> tuple[Axes, ...]:
    """
    Draw V(s) = max_a Q(s, a) and the greedy action over two dimensions of the observations. Grey is where the
    k nearest points all stand at the initial value.

    :param model: a model of Box observations with at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param fixed: where to hold other dimensions, observation units
    :param resolution: number of cells in each of the two dimensions
    :param axes: where to draw, as many as :func:`count_panels` tells; a new figure if not given
    :param names: what dimensions and actions are called; by default those in ``NAMES`` of the model's
        environment, and numbers if it is not there
    :param average: whether dimensions not in ``fixed`` are averaged over, see :func:`value_grid`; by default they are
        held in the middle of their range
    :return: the axes drawn on: value and action, of ExA one for each dimension of the action; :func:`figure_of` tells
        their figure
    :raises ValueError: if the observations are not a Box of two or more dimensions, or ``dims``, ``fixed``,
        ``resolution``, ``axes`` or ``names`` do not fit
    """
    grid = value_grid(model, dims, fixed, resolution, average)
    names = names_for(model, names)
    n_panels = count_panels(model)
    if axes is None:
        figure = new_figure(5.25 * n_panels, 4.4)
        axes = list(figure.subplots(1, n_panels, sharex=True, sharey=True, gridspec_kw={"wspace": 0.06}))
        caption = caption_of(grid, names)
        if caption:
            figure.suptitle(textwrap.fill(caption, 110), fontsize="medium", color="0.3")
    elif len(axes) != n_panels:
        raise ValueError(f"axes must be {n_panels}, for the value and what there is of the action; got {len(axes)}")
    value_axes, *action_axes = axes
    _draw_values(value_axes, grid)
    if isinstance(model.action_space, spaces.Box):
        for dim, ax in enumerate(action_axes):
            _draw_action_dimension(ax, grid, dim, model.action_space, names.actions[dim])
    else:
        _draw_actions(action_axes[0], grid, names.actions)
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
    return tuple(axes)


def plot_visits(counts: np.ndarray, extent: tuple[float, float, float, float], axes: Axes) -> Axes:
    """
    Draw how often each cell was visited, on a logarithmic scale. Grey is where nobody was.

    :param counts: shape (rows, columns), rows from bottom up
    :param extent: (left, right, bottom, top), observation units
    :param axes: where to draw
    :return: the same axes
    """
    from matplotlib.colors import LogNorm

    image = axes.imshow(
        np.ma.masked_equal(counts, 0),
        origin="lower",
        extent=extent,
        aspect="auto",
        cmap="magma_r",
        norm=LogNorm(1, max(10, int(counts.max()))),
        interpolation="nearest",
    )
    figure_of(axes).colorbar(image, ax=axes, label="steps")
    axes.set_facecolor(UNLEARNED_COLOR)
    axes.set_title("Visits")
    return axes


def plot_routes(routes: Sequence[np.ndarray], dims: tuple[int, int], axes: Axes) -> Axes:
    """
    Draw the ways that episodes took over what the axes already show, the latest brightest. A circle is where an
    episode began, a cross where it ended.

    :param routes: the observations of each episode, shape (n_steps, obs_dim), the latest last
    :param dims: the two dimensions, horizontal and vertical
    :param axes: where to draw; its range is kept
    :return: the same axes
    """
    from matplotlib.patheffects import withStroke

    range_x, range_y = axes.get_xlim(), axes.get_ylim()
    edge = [withStroke(linewidth=2.4, foreground="black")]
    for age, route in enumerate(reversed(routes)):
        x, y = route[:, dims[0]], route[:, dims[1]]
        lines = [
            *axes.plot(x, y, linewidth=1.1, path_effects=edge),
            *axes.plot(x[:1], y[:1], "o", markersize=6, markeredgecolor="black"),
            *axes.plot(x[-1:], y[-1:], "X", markersize=8, markeredgecolor="black"),
        ]
        for line in lines:
            line.set(color="white", alpha=max(0.35, 1.0 - 0.3 * age), zorder=3 - 0.01 * age)
    axes.set(xlim=range_x, ylim=range_y)
    return axes


def count_panels(model: KNNAlgorithm) -> int:
    """
    :param model: any model
    :return: how many axes :func:`plot_value_function` draws on: the value, and the action, of ExA one for each of its
        dimensions
    """
    space = model.action_space
    return 2 if isinstance(space, spaces.Discrete) else 1 + int(np.prod(space.shape or ()))


def caption_of(grid: ValueGrid, names: Names) -> str:
    """
    :param grid: what is drawn
    :param names: what the dimensions are called
    :return: where the dimensions that are not drawn stand; empty if there are none
    """
    parts = [f"{names.observations[dim]} = {value:.3g}" for dim, value in grid.fixed.items()]
    caption = f"where {', '.join(parts)}" if parts else ""
    if grid.averaged:
        mean = f"mean over {', '.join(names.observations[dim] for dim in grid.averaged)}"
        caption = f"{caption}; {mean}" if caption else mean
    return caption


def names_for(model: KNNAlgorithm, names: Names | None = None) -> Names:
    """
    :param model: a model of Box observations
    :param names: what the user wants them to be called
    :return: these, or else those in ``NAMES`` of the model's environment, or else numbers
    :raises ValueError: if ``names`` does not fit the model's spaces
    """
    names = check_names(names)
    if names is not None and not _fit(names, model):
        raise ValueError(
            f"names must hold one for each observation dimension and one for each action (each action dimension with "
            f"ExA); got {names!r}"
        )
    return names or _names_of(model) or _numbered(model)


def new_figure(width: float, height: float) -> Figure:
    """
    :param width: inches
    :param height: inches
    :return: a figure that belongs to no window and to no global state; save it with ``figure.savefig(path)``
    :raises ImportError: if matplotlib is not installed
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "sb3-knntd[extra]"') from error

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
    values = np.ma.masked_where(~grid.learned, grid.values)
    image = axes.imshow(values, origin="lower", extent=grid.extent, aspect="auto", cmap="viridis")
    # ExA's is the mean of the neighbours' best values.
    label = r"$V(s) = \max_a\,Q(s, a)$" if grid.actions.ndim == 2 else "$V(s)$"
    figure_of(axes).colorbar(image, ax=axes, label=label)
    axes.set_title("Value")


def _draw_actions(axes: Axes, grid: ValueGrid, names: Sequence[str]) -> None:
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    n_actions = len(names)
    # Evenly spaced in lightness, so that they stay apart in grey and for colour-blind readers.
    colors = ListedColormap(matplotlib.colormaps["cividis"](np.linspace(0.08, 0.95, n_actions)))
    image = axes.imshow(
        np.ma.masked_where(~grid.learned, grid.actions),
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


def _draw_action_dimension(axes: Axes, grid: ValueGrid, dim: int, space: spaces.Box, name: str) -> None:
    image = axes.imshow(
        np.ma.masked_where(~grid.learned, grid.actions[..., dim]),
        origin="lower",
        extent=grid.extent,
        aspect="auto",
        cmap="cividis",
        vmin=float(space.low.reshape(-1)[dim]),
        vmax=float(space.high.reshape(-1)[dim]),
    )
    figure_of(axes).colorbar(image, ax=axes, label=name)
    axes.set_title("Greedy action")


def _check_view(
    model: KNNAlgorithm, dims: tuple[int, int], fixed: Mapping[int, float] | None, resolution: int, average: bool
) -> tuple[dict[int, float], tuple[int, ...]]:
    """Where the dimensions that are not drawn are held, and those that are averaged over."""
    space = model.observation_space
    if not isinstance(space, spaces.Box) or space.shape[0] < 2:
        raise ValueError(f"a value function is drawn over two dimensions of a Box of observations; got {space}")
    n_dims = space.shape[0]
    if max(check_dims(dims)) >= n_dims:
        raise ValueError(f"dims must be two different dimensions of 0 to {n_dims - 1}; got {dims!r}")
    given = check_fixed(fixed) or {}
    if not all(dim in range(n_dims) and dim not in dims for dim in given):
        raise ValueError(
            f"fixed must name dimensions of 0 to {n_dims - 1} other than those drawn, {dims}; got {given!r}"
        )
    check_integer("resolution", resolution, 1, FINEST)
    low, high = _range(model)
    others = [dim for dim in range(n_dims) if dim not in dims]
    held = {dim: float(given.get(dim, (low[dim] + high[dim]) / 2)) for dim in others if dim in given or not average}
    return held, tuple(dim for dim in others if dim not in held)


class _Reading(NamedTuple):
    """What a model says at a batch of observations; the fields are those of :class:`ValueGrid`."""

    q_values: np.ndarray
    values: np.ndarray
    actions: np.ndarray
    learned: np.ndarray


def _read(model: KNNAlgorithm, observations: np.ndarray) -> _Reading:
    batches = np.array_split(observations, -(-len(observations) // BATCH))
    return _Reading(*map(np.concatenate, zip(*(_read_batch(model, batch) for batch in batches), strict=True)))


def _read_batch(model: KNNAlgorithm, observations: np.ndarray) -> _Reading:
    policy = model.policy
    with th.no_grad():
        rows, probabilities = policy.perceived_rows(observations)
        q_values = mean_rows(rows, probabilities)
        selector = policy.selector
        values = selector.greedy_value(rows, probabilities)
        selected = selector.greedy_indices(rows, probabilities)
        actions = selector.actions_of(selected, probabilities).cpu().numpy()
        learned = (rows != model.initial_value).flatten(1).any(dim=1)
    return _Reading(q_values.cpu().numpy(), values.cpu().numpy(), actions, learned.cpu().numpy())


def _places(low: np.ndarray, high: np.ndarray, averaged: tuple[int, ...]) -> np.ndarray:
    """Where the dimensions that are averaged over stand, evenly spread, shape (n_places, len(averaged))."""
    if not averaged:
        return np.empty((1, 0))
    # Two seconds to import, and most pictures are of two dimensions.
    from scipy.stats import qmc

    dims = list(averaged)
    spread: np.ndarray = qmc.Halton(len(dims), scramble=False).random(AVERAGED_PLACES + 1)[1:]
    places: np.ndarray = low[dims] + spread * (high[dims] - low[dims])
    return places


def _join(readings: Sequence[_Reading], n_actions: int) -> _Reading:
    """The mean over the places where something was learned; where nothing was, over all."""
    if len(readings) == 1:
        return readings[0]
    q_values, values, actions, learned = (np.stack(part) for part in zip(*readings, strict=True))
    anywhere = np.asarray(learned.any(axis=0))
    counts = (learned | ~anywhere).astype(np.float64)
    counts /= counts.sum(axis=0)
    if actions.ndim == 2:
        shares = np.stack([(counts * (actions == action)).sum(axis=0) for action in range(n_actions)])
        joined = shares.argmax(axis=0)
    else:
        joined = (counts[..., None] * actions).sum(axis=0)
    return _Reading((counts[..., None] * q_values).sum(axis=0), (counts * values).sum(axis=0), joined, anywhere)


def _range(model: KNNAlgorithm) -> tuple[np.ndarray, np.ndarray]:
    bounds = model.policy.perceiver.bounds
    return bounds.low.cpu().numpy(), bounds.high.cpu().numpy()


def _names_of(model: KNNAlgorithm) -> Names | None:
    env = model.get_env()
    spec = None if env is None else env.get_attr("spec", 0)[0]
    names = None if spec is None else NAMES.get(spec.id)
    # A wrapper may have given the environment other spaces than its name tells of.
    return names if names is not None and _fit(names, model) else None


def _fit(names: Names, model: KNNAlgorithm) -> bool:
    return model.observation_space.shape == (len(names.observations),) and len(names.actions) == _count_actions(model)


def _count_actions(model: KNNAlgorithm) -> int:
    """Number of actions, or of their dimensions."""
    space = model.action_space
    return int(space.n) if isinstance(space, spaces.Discrete) else int(np.prod(space.shape or ()))


def _numbered(model: KNNAlgorithm) -> Names:
    assert isinstance(model.observation_space, spaces.Box)
    space, n_actions = model.action_space, _count_actions(model)
    if isinstance(space, spaces.Discrete):
        actions = tuple(f"action {number}" for number in range(space.start, space.start + n_actions))
    else:
        actions = tuple(f"action[{dim}]" for dim in range(n_actions))
    return Names(tuple(f"observation[{dim}]" for dim in range(model.observation_space.shape[0])), actions)
