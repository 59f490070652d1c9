"""Plots over two dimensions of the observations: values, greedy actions, visits, trajectories."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from sb3_knntd.plots.figures import UNLEARNED_COLOR, figure_of, new_figure
from sb3_knntd.plots.grids import ValueGrid, value_grid
from sb3_knntd.plots.names import Names, names_for
from sb3_knntd.policies import TableModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Maximum number of actions of which each is named in the colour bar.
MOST_NAMED_ACTIONS = 10


def plot_value_function(
    model: TableModel,
    dims: tuple[int, int] = (0, 1),
    fixed: Mapping[int, float] | None = None,
    resolution: int = 120,
    axes: Sequence[Axes] | None = None,
    names: Names | None = None,
    average: bool = False,
) -> tuple[Axes, ...]:
    """
    Plot V(s) = max_a Q(s, a) and the greedy action over two dimensions of the observations. Cells are grey where all k
    nearest points have the initial value. Points that grow are drawn as dots.

    :param model: a model with Box observations of at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param fixed: values of other dimensions, observation units
    :param resolution: number of cells in each of the two dimensions
    :param axes: axes to draw on, :func:`count_panels` of them; a new figure if not given
    :param names: names of the dimensions and actions; by default those of the model's environment in ``NAMES``, or
        numbers if it is not there
    :param average: whether to average over the dimensions not in ``fixed``, see :func:`value_grid`; by default they are
        fixed in the middle of their range
    :return: the axes of the value and the action (with ExA, of each dimension of the action); see :func:`figure_of` for
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
        raise ValueError(f"axes must be {n_panels}, one for the value and one per action panel; got {len(axes)}")
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
        if model.policy.grows:
            plot_points(model, grid.dims, ax)
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
    Plot the number of visits of each cell on a logarithmic scale. Cells without visits are grey.

    :param counts: number of visits, shape (rows, columns), rows from bottom up
    :param extent: (left, right, bottom, top), observation units
    :param axes: axes to draw on
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


def plot_points(model: TableModel, dims: tuple[int, int], axes: Axes) -> Axes:
    """
    Plot the perception points as dots on top of the axes' content, those of all places in the other dimensions.

    :param model: a model with Box observations of at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param axes: axes to draw on; their range does not change
    :return: the same axes
    """
    range_x, range_y = axes.get_xlim(), axes.get_ylim()
    points = model.policy.points.cpu().numpy()
    axes.plot(points[:, dims[0]], points[:, dims[1]], ".", color="black", markersize=1.5, label="points")
    axes.set(xlim=range_x, ylim=range_y)
    return axes


def plot_routes(routes: Sequence[np.ndarray], dims: tuple[int, int], axes: Axes) -> Axes:
    """
    Plot the trajectories of episodes on top of the axes' content, the latest one brightest. A circle marks the start of
    an episode, a cross its end.

    :param routes: the observations of each episode, shape (n_steps, obs_dim), the latest episode last
    :param dims: the two dimensions, horizontal and vertical
    :param axes: axes to draw on; their range does not change
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


def count_panels(model: TableModel) -> int:
    """
    :param model: any model
    :return: number of axes that :func:`plot_value_function` draws on: one for the value and one for the action, with
        ExA one for each dimension of the action
    """
    space = model.action_space
    return 2 if isinstance(space, spaces.Discrete) else 1 + int(np.prod(space.shape or ()))


def caption_of(grid: ValueGrid, names: Names) -> str:
    """
    :param grid: the plotted values
    :param names: names of the dimensions
    :return: a text with the values of the dimensions that are not plotted; empty if there are none
    """
    parts = [f"{names.observations[dim]} = {value:.3g}" for dim, value in grid.fixed.items()]
    caption = f"where {', '.join(parts)}" if parts else ""
    if grid.averaged:
        mean = f"mean over {', '.join(names.observations[dim] for dim in grid.averaged)}"
        caption = f"{caption}; {mean}" if caption else mean
    return caption


def _draw_values(axes: Axes, grid: ValueGrid) -> None:
    values = np.ma.masked_where(~grid.learned, grid.values)
    image = axes.imshow(values, origin="lower", extent=grid.extent, aspect="auto", cmap="viridis")
    # With ExA, V(s) is the mean of the neighbours' best values.
    label = r"$V(s) = \max_a\,Q(s, a)$" if grid.actions.ndim == 2 else "$V(s)$"
    figure_of(axes).colorbar(image, ax=axes, label=label)
    axes.set_title("Value")


def _draw_actions(axes: Axes, grid: ValueGrid, names: Sequence[str]) -> None:
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    n_actions = len(names)
    # Evenly spaced in lightness: distinguishable in greyscale and for colour-blind readers.
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
