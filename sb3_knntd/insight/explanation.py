"""Why a model takes an action: the neighbours of an observation, their weights and their values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_knntd.insight.labels import action_text, column_names
from sb3_knntd.insight.neighbor import Neighbor
from sb3_knntd.insight.pictures import plot_explanation
from sb3_knntd.perception import Bounds
from sb3_knntd.plots import Names, names_for
from sb3_knntd.policies import TableModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: With more columns, the text shows only the best one of each neighbour.
MOST_COLUMNS_SHOWN = 8


@dataclass(frozen=True)
class Explanation:
    """
    Why a model takes an action at an observation.

    :param observation: the observation, shape (obs_dim,)
    :param action: the greedy action, as ``predict`` returns it
    :param value: its value: max Q(s, ·), for Ex⟨a⟩ Σ p(i) max Q(i, ·); for KNNDyna with Box actions that of the best
        action point, and the action is the peak of a parabola near it
    :param margin: how much the second best action is worse: of Q(s, ·), for Ex⟨a⟩ the mean over the neighbours (and
        action dimensions); infinite if there is one action only
    :param q_values: Q(s, ·) = Σ p(i) Q(i, ·), shape (n_columns,); -inf where an action is forbidden
    :param neighbors: the k nearest points, nearest first
    :param beyond_bounds: dimensions in which the observation is beyond the bounds
    :param beyond_seen: dimensions in which it is beyond all observations that were learned from
    :param known: share of the weight on neighbours that learning has updated
    :param names: names of the dimensions and actions
    :param columns: names of the columns of the table
    """

    observation: np.ndarray
    action: Any
    value: float
    margin: float
    q_values: np.ndarray
    neighbors: tuple[Neighbor, ...]
    beyond_bounds: tuple[int, ...]
    beyond_seen: tuple[int, ...]
    known: float
    names: Names
    columns: tuple[str, ...]
    _model: TableModel = field(repr=False, compare=False)

    @property
    def visits(self) -> float:
        """Mean number of updates of the neighbours, by weight."""
        return float(sum(each.probability * each.visits for each in self.neighbors))

    @property
    def action_text(self) -> str:
        """The name of the action, or the value of each of its dimensions with its name."""
        return action_text(self._model, self.action, self.names)

    @property
    def is_outside(self) -> bool:
        """Whether the observation is outside of what was seen, or most of its weight on points never visited."""
        return bool(self.beyond_bounds or self.beyond_seen) or self.known < 0.5

    def __str__(self) -> str:
        names = self.names.observations
        lines = [f"At {', '.join(f'{name} = {x:.4g}' for name, x in zip(names, self.observation, strict=True))}"]
        margin = f", {self.margin:.4g} better than the second" if np.isfinite(self.margin) else ""
        lines += [f"{self.action_text}, value {self.value:.4g}{margin}", *self._cautions(), ""]
        return "\n".join(lines + _table(*self._rows()))

    def _cautions(self) -> list[str]:
        names, lines = self.names.observations, []
        for dims, what in ((self.beyond_bounds, "the bounds"), (self.beyond_seen, "all that was seen in learning")):
            if dims:
                lines.append(f"Beyond {what} in {', '.join(names[dim] for dim in dims)}")
        if self.known < 1.0:
            lines.append(f"{1 - self.known:.0%} of the weight is on points that were never visited")
        return lines

    def _rows(self) -> tuple[list[str], list[list[str]]]:
        """Header and rows of the table of neighbours."""
        head = ["point", *self.names.observations, "distance", "weight", "visits"]
        all_columns = len(self.columns) <= MOST_COLUMNS_SHOWN
        head += [*self.columns] if all_columns else ["best action", "its value"]
        rows = []
        for each in self.neighbors:
            place = [f"{x:.4g}" for x in each.point]
            row = [str(each.index), *place, f"{each.distance:.3f}", f"{each.probability:.3f}", f"{each.visits:,}"]
            rows.append([*row, *self._values(each.values, all_columns)])
        total = ["mean", *([""] * len(self.names.observations)), "", "1.000", f"{self.visits:,.0f}"]
        if all_columns:
            return head, [*rows, [*total, *(f"{value:.4g}" for value in self.q_values)]]
        return head, [*rows, [*total, self.action_text, f"{self.value:.4g}"]]

    def _values(self, values: np.ndarray, all_columns: bool) -> list[str]:
        if all_columns:
            return [f"{value:.4g}" for value in values]
        best = [first + int(values[first:end].argmax()) for first, end in self._model.policy.selector.factor_ranges]
        return [", ".join(self.columns[column] for column in best), f"{values[best].mean():.4g}"]

    def plot(self, dims: tuple[int, int] | None = None, axes: Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """
        Draw the neighbours on the value and the greedy action over two dimensions, with the others as observed; and the
        values of the actions, the mean as bars and those of the neighbours as dots whose area is their weight.

        :param dims: the two dimensions, horizontal and vertical; by default those along which the value changes most
        :param axes: axes to draw on, the last one for the values of the actions; a new figure if not given
        :return: the axes; see :func:`~sb3_knntd.plots.figure_of` for their figure. For observations of one dimension or
            other than a Box, the values of the actions only
        :raises ValueError: if ``dims`` or ``axes`` do not fit
        :raises ImportError: if matplotlib is not installed
        """
        return plot_explanation(
            self._model,
            self.observation,
            self.neighbors,
            self.q_values,
            f"{self.action_text}, value {self.value:.4g}",
            self.names,
            self.columns,
            dims,
            axes,
        )


def explain(model: TableModel, observation: np.ndarray, names: Names | None = None) -> Explanation:
    """
    Explain the action at an observation.

    :param model: a model whose policy is a table
    :param observation: one observation, as ``predict`` takes it
    :param names: names of the dimensions and actions; by default those of the environment, or numbers
    :return: the explanation
    :raises ValueError: if it is not one finite observation, or ``names`` do not fit
    """
    names, policy = names_for(model, names), model.policy
    batch = _batch_of_one(model, observation)
    with policy.table.lock, th.no_grad():
        perception = policy.perceive(batch)
        rows, probabilities = policy.perceived_rows(batch)
        found = policy.perceiver.find(th.as_tensor(batch).to(policy.device))
        selector = policy.selector
        value = float(selector.greedy_value(rows, probabilities)[0])
        q_values = policy.q_values(batch)[0].double().cpu().numpy()
        q_values[policy.rules.forbidden(th.as_tensor(batch))[0].cpu().numpy()] = -np.inf
        visits = policy.table.counts_at(perception.indices)[0]
        bounds, experience = policy.perceiver.bounds, policy.experience
        places = bounds.unscale(policy.perceiver.points.coordinates(bounds, perception.indices[0]))
        action = policy.predict(batch)[0][0]
    neighbors = tuple(
        Neighbor(int(index), place, float(square) ** 0.5, float(probability), row, int(count))
        for index, place, square, probability, row, count in zip(
            perception.indices[0],
            places.cpu().numpy(),
            found.squared_distances[0],
            perception.probabilities[0],
            rows[0].double().cpu().numpy(),
            visits,
            strict=True,
        )
    )
    seen = batch.reshape(-1).astype(np.float64)
    return Explanation(
        observation=seen,
        action=action,
        value=value,
        margin=_margin(model, q_values, neighbors),
        q_values=q_values,
        neighbors=neighbors,
        beyond_bounds=_beyond(seen, bounds.low, bounds.high, bounds),
        beyond_seen=_beyond(seen, experience.low, experience.high, bounds) if experience.n_steps else (),
        known=1.0 - sum(each.probability for each in neighbors if not each.visits),
        names=names,
        columns=column_names(policy, names),
        _model=model,
    )


def _batch_of_one(model: TableModel, observation: np.ndarray) -> np.ndarray:
    shape = model.observation_space.shape or ()
    given = np.asarray(observation)
    if given.shape not in (shape, (1, *shape)) or not np.issubdtype(given.dtype, np.number):
        raise ValueError(
            f"observation must be one observation, numbers of shape {shape}; got {given.dtype}, shape {given.shape}"
        )
    batch: np.ndarray = given.reshape((1, *shape))
    if not np.isfinite(batch).all():
        raise ValueError(f"observation must be finite; got {given.tolist()}")
    return batch


def _beyond(seen: np.ndarray, low: th.Tensor, high: th.Tensor, bounds: Bounds) -> tuple[int, ...]:
    # Observations rounded to float32 can be beyond float64 bounds by rounding.
    slack = 1e-6 * (bounds.high - bounds.low).cpu().numpy()
    beyond = (seen < low.cpu().numpy() - slack) | (seen > high.cpu().numpy() + slack)
    return tuple(np.flatnonzero(beyond).tolist())


def _margin(model: TableModel, q_values: np.ndarray, neighbors: tuple[Neighbor, ...]) -> float:
    """How much the second best action is worse than the best."""
    if model.policy.selector.averages_values:
        return _gap(q_values)
    ranges = model.policy.selector.factor_ranges
    gaps = [sum(_gap(each.values[first:end]) * each.probability for each in neighbors) for first, end in ranges]
    return float(np.mean(gaps))


def _gap(values: np.ndarray) -> float:
    if len(values) < 2:
        return np.inf
    second, best = np.partition(values, -2)[-2:]
    return float(best - second)


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    """The lines of a table with columns aligned to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)) for row in [head, *rows]]
