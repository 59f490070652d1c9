"""ONNX: a graph that does, operation by operation, what the kernels do."""

from __future__ import annotations

from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_knntd.actions.peak import LEAST_CURVATURE, columns_beside
from sb3_knntd.common.checks import in_bytes
from sb3_knntd.common.files import replace_file
from sb3_knntd.export.frozen import Exportable, FrozenPolicy
from sb3_knntd.kernels.perceive import Weighting
from sb3_knntd.kernels.selection import Combination
from sb3_knntd.perception.bounds import FARTHEST
from sb3_knntd.perception.search.tensors import candidate_ranks, window

#: Version of the operators, and of the file format that came with it: old enough for most runtimes.
OPSET, IR_VERSION = 17, 8
#: A protocol buffer cannot be larger.
LARGEST_FILE = 2**31 - 1


def write_onnx(policy: Exportable, path: Path) -> list[Path]:
    """
    Write a model with the input ``observation``, a batch of observations in the shape and dtype of the space, and the
    outputs ``action``, likewise, and ``q_values``, shape (batch, n_columns), double.

    :param policy: the policy
    :param path: file to write
    :return: the file
    :raises ValueError: if the weights are a function, or the policy is too large for the format
    """
    import onnx

    frozen = policy.frozen()
    graph = _Graph(onnx)
    observation, action = frozen.observation_space, frozen.action_space
    n_bytes = frozen.stored()[0].nbytes + (0 if frozen.places is None else frozen.places.nbytes)
    if n_bytes > LARGEST_FILE // 2:
        raise ValueError(f"format='onnx' holds 2 GiB, and this policy takes {in_bytes(n_bytes)}: use 'torchscript'")
    actions, q_values = _outputs(graph, frozen)

    def described(name: str, space: spaces.Space[Any]) -> Any:
        kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(space.dtype))
        return onnx.helper.make_tensor_value_info(name, kind, ["batch", *(space.shape or ())])

    nodes = [*graph.nodes]
    for source, name in ((actions, "action"), (q_values, "q_values")):
        nodes.append(onnx.helper.make_node("Identity", [source], [name]))
    values_info = onnx.helper.make_tensor_value_info("q_values", onnx.TensorProto.DOUBLE, ["batch", frozen.n_columns])
    made = onnx.helper.make_graph(
        nodes,
        "sb3_knntd_policy",
        [described("observation", observation)],
        [described("action", action), values_info],
        graph.constants,
    )
    opset = onnx.helper.make_opsetid("", OPSET)
    model = onnx.helper.make_model(made, producer_name="sb3-knntd", opset_imports=[opset], ir_version=IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    replace_file(path, model.SerializeToString())
    return [path]


class _Graph:
    """Nodes and constants, named by number."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, dtype: Any = np.float64) -> str:
        """Add a constant; its name."""
        name = f"c{len(self.constants)}"
        self.constants.append(self._onnx.numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def numbers(self, *values: int) -> str:
        """Add a constant of integers, shape (n,); its name."""
        return self.constant(values, np.int64)

    def __call__(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node with one output; the name of the output."""
        return self.many(1, operator, *inputs, **attributes)[0]

    def many(self, n_outputs: int, operator: str, *inputs: str, **attributes: Any) -> list[str]:
        """Add a node; the names of its outputs."""
        outputs = [f"n{len(self.nodes)}_{i}" for i in range(n_outputs)]
        self.nodes.append(self._onnx.helper.make_node(operator, list(inputs), outputs, **attributes))
        return outputs

    def cast(self, tensor: str, dtype: Any) -> str:
        """Convert a tensor to another number type."""
        return self("Cast", tensor, to=self._onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def first(self, tensor: str, count: int) -> tuple[str, str]:
        """
        The smallest entries of each row by (value, position), and their positions. Ties are in this order by the
        definition of the operator.
        """
        values, positions = self.many(2, "TopK", tensor, self.numbers(count), axis=1, largest=0, sorted=1)
        return values, positions

    def square_of_difference(self, one: str, other: str) -> str:
        """(one - other)²."""
        difference = self("Sub", one, other)
        return self("Mul", difference, difference)

    def total(self, tensors: list[str]) -> str:
        """The sum, added in the order of the list, as the kernels do, so that it is rounded in the same way."""
        return reduce(lambda total, each: self("Add", total, each), tensors)

    def split(self, tensor: str, n_parts: int) -> list[str]:
        """The slices along axis 1, with that axis removed."""
        parts = self.many(n_parts, "Split", tensor, axis=1)
        return [self("Squeeze", part, self.numbers(1)) for part in parts]


def _outputs(graph: _Graph, frozen: FrozenPolicy) -> tuple[str, str]:
    """The actions, and the values of the columns."""
    flat = graph.cast(graph("Reshape", "observation", graph.numbers(-1, frozen.obs_dim)), np.float64)
    points, squares = _nearest(graph, frozen, _scaled(graph, frozen, flat))
    shares = _shares(graph, frozen, squares)
    rows = _rows(graph, frozen, points)
    parts = zip(shares, graph.split(rows, frozen.n_neighbors), strict=True)
    q_values = graph.total([graph("Mul", share, row) for share, row in parts])
    forbidden = _forbidden(graph, frozen, flat)
    return _actions(graph, frozen, q_values, rows, shares, forbidden), q_values


def _forbidden(graph: _Graph, frozen: FrozenPolicy, flat: str) -> str | None:
    """The forbidden columns, shape (batch, n_columns); ``None`` if nothing is forbidden anywhere."""
    rules = frozen.rules
    if not len(rules):
        return None
    seen = graph("Unsqueeze", flat, graph.numbers(1))
    beyond = graph(
        "Or",
        graph("Less", seen, graph.constant(rules.low.numpy()[None])),
        graph("Greater", seen, graph.constant(rules.high.numpy()[None])),
    )
    # Counts, as there are few operators of booleans.
    n_beyond = graph("ReduceSum", graph.cast(beyond, np.float64), graph.numbers(2), keepdims=0)
    inside = graph.cast(graph("Equal", n_beyond, graph.constant(0.0)), np.float64)
    return graph("Greater", graph("MatMul", inside, graph.constant(rules.columns.numpy())), graph.constant(0.0))


def _scaled(graph: _Graph, frozen: FrozenPolicy, flat: str) -> str:
    offset = graph("Sub", flat, graph.constant(frozen.low))
    share = graph("Div", offset, graph.constant(frozen.high - frozen.low))
    scaled = graph("Sub", graph("Mul", share, graph.constant(2.0)), graph.constant(1.0))
    return graph("Clip", scaled, graph.constant(-FARTHEST), graph.constant(FARTHEST))


def _nearest(graph: _Graph, frozen: FrozenPolicy, scaled: str) -> tuple[str, str]:
    """The nearest points and their squared distances, shape (batch, k)."""
    lattice, k = frozen.lattice, frozen.n_neighbors
    ranks = None if lattice is None else candidate_ranks(lattice.shape, k)
    if lattice is None or ranks is None:
        constants = [graph.constant(column[None]) for column in frozen.scaled_points().T]
        pairs = zip(graph.many(frozen.obs_dim, "Split", scaled, axis=1), constants, strict=True)
        distances = graph.total([graph.square_of_difference(*pair) for pair in pairs])
        nearest, points = graph.first(distances, k)
        return points, nearest
    sums, number = [], graph.constant(0, np.int64)
    columns = graph.many(frozen.obs_dim, "Split", scaled, axis=1)
    for dimension, (x, axis) in enumerate(zip(columns, lattice.axes, strict=True)):
        chosen, size = ranks[:, dimension], len(axis)
        highest = int(chosen.max())
        width, reach = window(size, highest)
        step = graph("Mul", graph("Add", x, graph.constant(1.0)), graph.constant(0.5 * (size - 1)))
        first = graph("Sub", graph("Floor", step), graph.constant(reach))
        first = graph("Clip", first, graph.constant(0.0), graph.constant(size - width))
        coordinates = graph("Add", graph.cast(first, np.int64), graph.constant(np.arange(width)[None], np.int64))
        places = graph("Gather", graph.constant(axis), coordinates, axis=0)
        near, order = graph.first(graph.square_of_difference(x, places), highest + 1)
        sums.append(graph("Gather", near, graph.numbers(*chosen), axis=1))
        order = graph("Gather", order, graph.numbers(*chosen), axis=1)
        before = graph("Mul", number, graph.constant(size, np.int64))
        number = graph("Add", before, graph("GatherElements", coordinates, order, axis=1))
    number, by_number = graph.first(number, len(ranks))
    nearest, by_distance = graph.first(graph("GatherElements", graph.total(sums), by_number, axis=1), k)
    return graph("GatherElements", number, by_distance, axis=1), nearest


def _shares(graph: _Graph, frozen: FrozenPolicy, squares: str) -> list[str]:
    """The weight of each neighbour, of which the sum is 1, shape (batch, 1)."""
    weighting, bandwidth = frozen.kernel_weights("onnx")
    weights = graph.many(frozen.n_neighbors, "Split", WEIGHTS[weighting](graph, squares, bandwidth * bandwidth), axis=1)
    total = graph.total(weights)
    return [graph("Div", weight, total) for weight in weights]


def _inverse_quadratic(graph: _Graph, squares: str, h2: float) -> str:
    one = graph.constant(1.0)
    return graph("Div", one, graph("Add", one, graph("Div", squares, graph.constant(h2))))


def _gaussian(graph: _Graph, squares: str, h2: float) -> str:
    excess = graph("Sub", squares, graph("Gather", squares, graph.numbers(0), axis=1))
    return graph("Exp", graph("Neg", graph("Div", excess, graph.constant(2.0 * h2))))


#: The weights by squared distance, see :func:`sb3_knntd.kernels.perceive.weigh`.
WEIGHTS = {Weighting.INVERSE_QUADRATIC: _inverse_quadratic, Weighting.GAUSSIAN: _gaussian}


def _rows(graph: _Graph, frozen: FrozenPolicy, points: str) -> str:
    """The rows of the nearest points, shape (batch, k, n_columns), double."""
    values, row_points = frozen.stored()
    if row_points is not None:
        points = _search(graph, points, row_points)
        values = np.concatenate((values, np.full((1, frozen.n_columns), frozen.initial_value, values.dtype)))
    return graph.cast(graph("Gather", graph.constant(values, values.dtype), points, axis=0), np.float64)


def _search(graph: _Graph, points: str, row_points: np.ndarray) -> str:
    """The row of each point by binary search, the row after the last one for points without a row."""
    n_rows = len(row_points)
    steps = n_rows.bit_length()
    padded = np.full(2**steps, np.iinfo(np.int64).max)
    padded[:n_rows] = row_points
    known = graph.constant(padded, np.int64)
    row = graph("Mul", points, graph.constant(0, np.int64))
    for step in range(steps - 1, -1, -1):
        later = graph("Add", row, graph.constant(2**step, np.int64))
        beyond = graph("Less", points, graph("Gather", known, later, axis=0))
        row = graph("Where", beyond, row, later)
    found = graph("Equal", points, graph("Gather", known, row, axis=0))
    return graph("Where", found, row, graph.constant(n_rows, np.int64))


def _best(graph: _Graph, values: str, axis: int) -> str:
    """The position of the largest entry along the last axis, the first of equal ones."""
    return graph("ArgMax", values, axis=axis, keepdims=0, select_last_index=0)


def _peak_offsets(graph: _Graph, frozen: FrozenPolicy, values: str, best: str) -> str:
    """
    How far the peak of the parabola through the values of the best column and those beside it is from it in each
    dimension, see :class:`~sb3_knntd.actions.peak.PeakSelector`, shape (batch, action_dim).
    """
    points, offsets = frozen.columns.points, []

    def of_best(of_columns: np.ndarray, dtype: Any = np.float64) -> str:
        """A number of the best column, shape (batch, 1)."""
        return graph("Unsqueeze", graph("Gather", graph.constant(of_columns, dtype), best, axis=0), graph.numbers(1))

    middle = graph("GatherElements", values, graph("Unsqueeze", best, graph.numbers(1)), axis=1)
    size = graph("Max", graph("Abs", middle), graph.constant(1.0))
    for dimension, (below, above) in enumerate(columns_beside(frozen.columns)):
        to_left = points[:, dimension] - points[below, dimension]
        to_right = points[above, dimension] - points[:, dimension]
        left, right, width = of_best(to_left), of_best(to_right), of_best(to_left + to_right)
        low, high = (graph("GatherElements", values, of_best(columns, np.int64), axis=1) for columns in (below, above))
        slope_left = graph("Div", graph("Sub", middle, low), left)
        slope_right = graph("Div", graph("Sub", high, middle), right)
        curvature = graph("Div", graph("Sub", slope_right, slope_left), width)
        weighted = graph("Add", graph("Mul", slope_left, right), graph("Mul", slope_right, left))
        slope = graph("Div", weighted, width)
        offset = graph("Div", graph("Mul", graph.constant(-0.5), slope), curvature)
        limited = graph("Max", offset, graph("Mul", graph.constant(-0.5), left))
        limited = graph("Min", limited, graph("Mul", graph.constant(0.5), right))
        bend = graph("Mul", curvature, graph("Mul", width, width))
        curved = graph("Less", bend, graph("Mul", graph.constant(-LEAST_CURVATURE), size))
        # At the ends, and beside forbidden columns, the parabola is not a number.
        inner = graph("And", of_best((to_left > 0.0) & (to_right > 0.0), bool), graph("Not", graph("IsNaN", offset)))
        has_peak = graph("And", inner, curved)
        offsets.append(graph("Where", has_peak, limited, graph.constant(0.0)))
    return graph("Concat", *offsets, axis=1)


def _actions(
    graph: _Graph, frozen: FrozenPolicy, q_values: str, rows: str, shares: list[str], forbidden: str | None
) -> str:
    space = frozen.action_space
    if forbidden is not None:
        never = graph.constant(-np.inf)
        q_values = graph("Where", forbidden, never, q_values)
        rows = graph("Where", graph("Unsqueeze", forbidden, graph.numbers(1)), never, rows)
    if frozen.first_action is not None:
        numbers = graph("Add", _best(graph, q_values, 1), graph.constant(frozen.first_action, np.int64))
        return graph.cast(numbers, space.dtype)
    assert isinstance(space, spaces.Box)
    points = graph.constant(frozen.columns.points)
    if frozen.combination is Combination.OF_VALUES:
        best = _best(graph, q_values, 1)
        actions = graph("Gather", points, best, axis=0)
        if frozen.interpolates:
            actions = graph("Add", actions, _peak_offsets(graph, frozen, q_values, best))
    else:
        selected = []
        for first, end in frozen.factor_ranges:
            part = graph("Slice", rows, graph.numbers(first), graph.numbers(end), graph.numbers(2))
            column = graph("Add", _best(graph, part, 2), graph.constant(first, np.int64))
            selected.append(graph("Gather", points, column, axis=0))
        each = graph.split(graph.total(selected), frozen.n_neighbors)
        actions = graph.total([graph("Mul", share, action) for share, action in zip(shares, each, strict=True)])
    if np.issubdtype(space.dtype, np.integer):
        actions = graph("Round", actions)
    low, high = (graph.constant(bound.reshape(1, -1)) for bound in (space.low, space.high))
    clipped = graph("Min", graph("Max", actions, low), high)
    return graph("Reshape", graph.cast(clipped, space.dtype), graph.numbers(-1, *space.shape))
