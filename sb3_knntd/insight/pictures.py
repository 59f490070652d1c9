"""The picture of an explanation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from sb3_knntd.insight.neighbor import Neighbor
from sb3_knntd.plots import (
    BASELINE_COLOR,
    LINE_COLOR,
    Names,
    count_panels,
    new_figure,
    plot_value_function,
    telling_dims,
)
from sb3_knntd.policies import TableModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_explanation(
    model: TableModel,
    observation: np.ndarray,
    neighbors: Sequence[Neighbor],
    q_values: np.ndarray,
    title: str,
    names: Names,
    columns: Sequence[str],
    dims: tuple[int, int] | None = None,
    axes: Sequence[Axes] | None = None,
) -> tuple[Axes, ...]:
    """
    Draw an explanation, see :meth:`~sb3_knntd.insight.Explanation.plot`.

    :param model: the model
    :param observation: shape (obs_dim,), observation units
    :param neighbors: its nearest points
    :param q_values: Q(s, ·), shape (n_columns,)
    :param title: what the model does
    :param names: names of the dimensions and actions
    :param columns: names of the columns of the table
    :param dims: the two dimensions, horizontal and vertical; by default those along which the value changes most
    :param axes: axes to draw on; a new figure if not given
    :return: the axes
    :raises ValueError: if ``dims`` or ``axes`` do not fit
    :raises ImportError: if matplotlib is not installed
    """
    has_map = isinstance(model.observation_space, spaces.Box) and len(observation) > 1
    n_maps = count_panels(model) if has_map else 0
    if axes is None:
        axes = _new_axes(n_maps, len(columns))
    elif len(axes) != n_maps + 1:
        raise ValueError(f"axes must be {n_maps + 1}, the last one for the values of the actions; got {len(axes)}")
    *maps, bars = axes
    if has_map:
        dims = telling_dims(model) if dims is None else dims
        fixed = {dim: float(observation[dim]) for dim in set(range(len(observation))) - set(dims)}
        for ax in plot_value_function(model, dims, fixed, axes=maps, names=names):
            _draw_neighbors(ax, observation, neighbors, dims)
    # With Ex⟨a⟩ each neighbour chooses, and the mean values choose nothing.
    chosen = int(q_values.argmax()) if model.policy.selector.averages_values else -1
    _draw_values(bars, q_values, neighbors, columns, chosen)
    bars.set_title(title, fontsize="medium")
    return tuple(axes)


def _new_axes(n_maps: int, n_columns: int) -> Sequence[Axes]:
    height = min(12.0, max(4.4, 1.4 + 0.22 * n_columns))
    figure = new_figure(5.25 * n_maps + 4.5, height)
    grid = figure.add_gridspec(1, n_maps + 1, width_ratios=[5.25] * n_maps + [4.5])
    maps: list[Axes] = []
    for column in range(n_maps):
        share = maps[0] if maps else None
        maps.append(figure.add_subplot(grid[column], sharex=share, sharey=share))
        maps[column].label_outer()
    return [*maps, figure.add_subplot(grid[n_maps])]


def _draw_neighbors(axes: Axes, observation: np.ndarray, neighbors: Sequence[Neighbor], dims: tuple[int, int]) -> None:
    x, y = (observation[dim] for dim in dims)
    limits = axes.get_xlim(), axes.get_ylim()
    for neighbor in neighbors:
        place = [neighbor.point[dim] for dim in dims]
        axes.plot([x, place[0]], [y, place[1]], color="white", linewidth=1, alpha=0.8)
        # The area is proportional to the weight.
        size = 24 * np.sqrt(neighbor.probability)
        fill, edge = (LINE_COLOR, "white") if neighbor.visits else ("white", "0.4")
        axes.plot(*place, "o", markersize=size, markerfacecolor=fill, markeredgecolor=edge, alpha=0.9)
    axes.plot(x, y, "X", color=BASELINE_COLOR, markersize=11, markeredgecolor="white", clip_on=False)
    axes.set(xlim=limits[0], ylim=limits[1])


def _draw_values(
    axes: Axes, values: np.ndarray, neighbors: Sequence[Neighbor], columns: Sequence[str], chosen: int
) -> None:
    places = np.arange(len(values))
    # Forbidden actions have the value -inf, and are not drawn.
    allowed = np.isfinite(values)
    lowest = min(values[allowed].min(), *(each.values[allowed].min() for each in neighbors))
    axes.hlines(places[allowed], lowest, values[allowed], color="0.85")
    for neighbor in neighbors:
        size = 24 * np.sqrt(neighbor.probability)
        axes.plot(
            neighbor.values[allowed],
            places[allowed],
            "o",
            color=LINE_COLOR,
            alpha=0.35,
            markersize=size,
            markeredgewidth=0,
        )
    for place, value in zip(places[allowed], values[allowed], strict=True):
        color = BASELINE_COLOR if place == chosen else "0.35"
        axes.plot(value, place, "|", color=color, markersize=22, markeredgewidth=3)
    axes.set_yticks(places, list(columns))
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.set_xlabel("value (bar: mean, dots: neighbours)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
