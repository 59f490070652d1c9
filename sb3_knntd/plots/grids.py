"""Values and greedy actions of a model on a grid over two dimensions of the observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_knntd.common.checks import check_integer, check_number, shown
from sb3_knntd.policies import TableModel

#: The largest resolution of a grid; figures have fewer pixels.
FINEST = 4096
#: Number of observations in a batch. With thousands of points, a larger batch would take gigabytes.
BATCH = 512
#: Number of places in the remaining dimensions over which values are averaged.
AVERAGED_PLACES = 32


class ValueGrid(NamedTuple):
    """
    Values and greedy actions of a model on a grid over two dimensions of the observations.

    :param dims: the two dimensions, of the columns and of the rows
    :param extent: (left, right, bottom, top), the range of the two dimensions, observation units
    :param fixed: values of the fixed dimensions, observation units
    :param averaged: the dimensions over which values are averaged
    :param q_values: Q(s, ·) at the centre of each cell, shape (resolution, resolution, n_actions), rows from bottom up
    :param values: V(s), shape (resolution, resolution)
    :param actions: the greedy action, counted from 0, shape (resolution, resolution), int64; with ExA the vector, shape
        (resolution, resolution, action_dim), action units
    :param learned: whether an entry of the k nearest points differs from the initial value,
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
    :param dims: value given for ``dims``
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
    :param fixed: value given for ``fixed``
    :return: the value of each fixed dimension, or ``None``
    :raises ValueError: if it is anything else, or a value is not finite
    """
    if fixed is None:
        return None
    if not isinstance(fixed, Mapping):
        raise ValueError(f"fixed must be a dict of dimensions and their values, e.g. {{2: 0.0}}; got {shown(fixed)}")
    return {check_integer("fixed: a dimension", dim, 0): check_number("fixed", fixed[dim]) for dim in fixed}


def value_grid(
    model: TableModel,
    dims: tuple[int, int] = (0, 1),
    fixed: Mapping[int, float] | None = None,
    resolution: int = 120,
    average: bool = False,
) -> ValueGrid:
    """
    Compute values and greedy actions over the range of two dimensions.

    :param model: a model with Box observations of at least two dimensions
    :param dims: the two dimensions, horizontal and vertical
    :param fixed: values of other dimensions, observation units
    :param resolution: number of cells in each of the two dimensions
    :param average: whether to average over the dimensions not in ``fixed``, at 32 places spread over their range,
        ignoring places where nothing was learned; the action is then the most frequent greedy action, with ExA the
        mean. By default, these dimensions are fixed in the middle of their range
    :return: the values. With VecNormalize, observation units are normalised
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


def telling_dims(model: TableModel, resolution: int = 60) -> tuple[int, int]:
    """
    Choose the two dimensions along which the value changes most, with the others fixed in the middle of their range.

    :param model: a model with Box observations of at least two dimensions
    :param resolution: number of evaluated places in each dimension
    :return: two dimensions, the lower one first
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


def _check_view(
    model: TableModel, dims: tuple[int, int], fixed: Mapping[int, float] | None, resolution: int, average: bool
) -> tuple[dict[int, float], tuple[int, ...]]:
    """Check the arguments of :func:`value_grid`; the values of the fixed dimensions, and the averaged dimensions."""
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
    """Values at a batch of observations; the fields are those of :class:`ValueGrid`."""

    q_values: np.ndarray
    values: np.ndarray
    actions: np.ndarray
    learned: np.ndarray


def _read(model: TableModel, observations: np.ndarray) -> _Reading:
    batches = np.array_split(observations, -(-len(observations) // BATCH))
    return _Reading(*map(np.concatenate, zip(*(_read_batch(model, batch) for batch in batches), strict=True)))


def _read_batch(model: TableModel, observations: np.ndarray) -> _Reading:
    policy = model.policy
    with th.no_grad():
        rows, probabilities = policy.perceived_rows(observations)
        q_values = policy.q_values(observations)
        selector = policy.selector
        values = selector.greedy_value(rows, probabilities)
        actions = selector.greedy_actions(rows, probabilities).cpu().numpy()
        # Forbidden actions are -inf in these rows, whether they have been learned or not.
        learned = ((rows != policy.table.initial_value) & rows.isfinite()).flatten(1).any(dim=1)
    return _Reading(q_values.cpu().numpy(), values.cpu().numpy(), actions, learned.cpu().numpy())


def _places(low: np.ndarray, high: np.ndarray, averaged: tuple[int, ...]) -> np.ndarray:
    """Evenly spread places in the averaged dimensions, shape (n_places, len(averaged))."""
    if not averaged:
        return np.empty((1, 0))
    # The import takes two seconds, and most plots do not need it.
    from scipy.stats import qmc

    dims = list(averaged)
    spread: np.ndarray = qmc.Halton(len(dims), scramble=False).random(AVERAGED_PLACES + 1)[1:]
    places: np.ndarray = low[dims] + spread * (high[dims] - low[dims])
    return places


def _join(readings: Sequence[_Reading], n_actions: int) -> _Reading:
    """The mean over the places where something was learned, or over all places if nothing was."""
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


def _range(model: TableModel) -> tuple[np.ndarray, np.ndarray]:
    bounds = model.policy.perceiver.bounds
    return bounds.low.cpu().numpy(), bounds.high.cpu().numpy()
