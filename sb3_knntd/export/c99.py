"""C99: a header and a source, for controllers. No heap, no recursion, no library but math.h."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.metadata import version
from math import prod
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_knntd.common.checks import check_word, in_bytes
from sb3_knntd.common.files import replace_file
from sb3_knntd.export.frozen import Exportable, FrozenPolicy
from sb3_knntd.kernels.perceive import Weighting
from sb3_knntd.kernels.selection import Combination
from sb3_knntd.perception.bounds import FARTHEST

#: C's floating types by the name of the option, the suffix of their constants and functions, and NumPy's type.
PRECISIONS: dict[str, tuple[str, str, type[np.floating[Any]]]] = {
    "double": ("double", "", np.float64),
    "float": ("float", "f", np.float32),
}
#: The weight of a squared distance ``square``, where ``nearest`` is the smallest one, see
#: :func:`sb3_knntd.kernels.perceive.weigh`.
WEIGHTS = {
    Weighting.INVERSE_QUADRATIC: "$one / ($one + square / $h2)",
    Weighting.GAUSSIAN: "exp$f(-(square - nearest) / $twice_h2)",
}

HEADER = """\
/*
 * The greedy policy of a table of action values at $n_points points, read at the $k nearest.
 * Written by sb3-knntd $version.
 *
 * Observation: $obs_dim number(s), in the units that the policy was trained with. The points are laid over
$ranges
 * Numbers outside of it are accepted: the points nearest to them decide. NaN counts as far below.
 *
 * Action: $action
 *
 * Table: $n_rows of $n_points rows of $n_columns $real, $size. There is no heap; the stack holds some $stack.
 * To get the actions of predict to the last digit, compile it without contracting a * b + c: -ffp-contract=off.
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

typedef $real ${name}_real;

#define ${NAME}_OBSERVATION_SIZE $obs_dim
#define ${NAME}_N_VALUES $n_columns
$action_size
/* $action_comment */
$action_function;

/* $values_comment */
void ${name}_q_values(const ${name}_real observation[${NAME}_OBSERVATION_SIZE],
                      ${name}_real values[${NAME}_N_VALUES]);

#ifdef __cplusplus
}
#endif

#endif
"""

SOURCE = """\
/* Written by sb3-knntd $version: see the header. */
#include "$header"

#include <math.h>

#define OBS_DIM $obs_dim
#define N_NEIGHBORS $k
#define N_COLUMNS $n_columns
#define N_ROWS $n_rows

typedef ${name}_real real;
/* The number of a point. */
typedef $index point_t;

static const real low[OBS_DIM] = {$low};
static const real width[OBS_DIM] = {$width};
$geometry
$table
static void scale(const real *observation, real *scaled)
{
    int j;
    for (j = 0; j < OBS_DIM; ++j) {
        real x = $two * ((observation[j] - low[j]) / width[j]) - $one;
        if (!(x > -$limit))
            x = -$limit;
        if (x > $limit)
            x = $limit;
        scaled[j] = x;
    }
}
$search
$row_at
/* The rows of the nearest points, and their weights, whose sum is 1. */
static void perceive(const real *observation, const real **rows, real *weights)
{
    real scaled[OBS_DIM], total = $zero;
    point_t points[N_NEIGHBORS];
    int i;
$nearest_declaration
    scale(observation, scaled);
    find_nearest(scaled, points, weights);
$nearest
    for (i = 0; i < N_NEIGHBORS; ++i) {
        const real square = weights[i];
        weights[i] = $weight;
        total += weights[i];
        rows[i] = row_at(points[i]);
    }
    for (i = 0; i < N_NEIGHBORS; ++i)
        weights[i] /= total;
}

/* The column from first to end - 1 with the largest value, the first of equal ones. */
static int best_column(const real *values, int first, int end)
{
    int column, best = first;
    for (column = first + 1; column < end; ++column)
        if (values[column] > values[best])
            best = column;
    return best;
}

void ${name}_q_values(const real observation[OBS_DIM], real values[N_COLUMNS])
{
    const real *rows[N_NEIGHBORS];
    real weights[N_NEIGHBORS];
    int i, column;
    perceive(observation, rows, weights);
    for (column = 0; column < N_COLUMNS; ++column)
        values[column] = $zero;
    for (i = 0; i < N_NEIGHBORS; ++i)
        for (column = 0; column < N_COLUMNS; ++column)
            values[column] += weights[i] * rows[i][column];
}
$act"""

LATTICE = """
/* The number of points in each dimension, and of those that differ in later dimensions only. */
static const point_t size[OBS_DIM] = {$sizes};
static const point_t stride[OBS_DIM] = {$strides};
static const real spacing[OBS_DIM] = {$spacings};
"""

SCATTERED = """
#define N_POINTS $n_points

static const real places[N_POINTS][OBS_DIM] = {
$places
};
"""

SEARCH_LATTICE = """
static real coordinate(int j, point_t i)
{
    if (size[j] == 1)
        return $zero;
    return i == size[j] - 1 ? $one : (real)i * spacing[j] - $one;
}

/* The last coordinate of a dimension that is at most x; -1 if there is none. */
static point_t last_up_to(int j, real x)
{
    point_t i;
    if (x < coordinate(j, 0))
        return -1;
    if (x >= coordinate(j, size[j] - 1))
        return size[j] - 1;
    i = (point_t)((x + $one) / spacing[j]);
    if (i > size[j] - 1)
        i = size[j] - 1;
    while (i > 0 && coordinate(j, i) > x)
        --i;
    while (i < size[j] - 1 && coordinate(j, i + 1) <= x)
        ++i;
    return i;
}

/* The next coordinate by distance from x, the lower one of equal ones, and its squared distance; -1 after the last. */
static point_t next_coordinate(int j, real x, point_t *below, point_t *above, real *square)
{
    real down = $zero, up = $zero;
    if (*below < 0 && *above >= size[j])
        return -1;
    if (*below >= 0)
        down = x - coordinate(j, *below);
    if (*above < size[j])
        up = coordinate(j, *above) - x;
    down *= down;
    up *= up;
    if (*above >= size[j] || (*below >= 0 && down <= up)) {
        *square = down;
        return (*below)--;
    }
    *square = up;
    return (*above)++;
}

/* The nearest points and their squared distances, by (squared distance, number). Coordinates are chosen in one
 * dimension after the other, in each by ascending distance. Rounded sums keep the order of their terms, so no point
 * with the coordinates chosen so far is nearer than the bound. */
static void find_nearest(const real *scaled, point_t *points, real *squares)
{
    point_t first[OBS_DIM], below[OBS_DIM], above[OBS_DIM], numbers[OBS_DIM];
    real least[OBS_DIM], sums[OBS_DIM];
    int j, place;
    for (place = 0; place < N_NEIGHBORS; ++place) {
        points[place] = 0;
        squares[place] = $far;
    }
    for (j = 0; j < OBS_DIM; ++j) {
        first[j] = last_up_to(j, scaled[j]);
        below[j] = first[j];
        above[j] = first[j] + 1;
        next_coordinate(j, scaled[j], &below[j], &above[j], &least[j]);
    }
    j = 0;
    below[0] = first[0];
    above[0] = first[0] + 1;
    sums[0] = $zero;
    numbers[0] = 0;
    while (j >= 0) {
        real square = $zero, sum, bound;
        point_t number;
        int later;
        const point_t i = next_coordinate(j, scaled[j], &below[j], &above[j], &square);
        if (i < 0) {
            --j;
            continue;
        }
        sum = sums[j] + square;
        number = numbers[j] * size[j] + i;
        bound = sum;
        for (later = j + 1; later < OBS_DIM; ++later)
            bound += least[later];
        if (bound > squares[N_NEIGHBORS - 1]) {
            --j;
            continue;
        }
        if (bound == squares[N_NEIGHBORS - 1] && number > points[N_NEIGHBORS - 1] / stride[j])
            continue;
        if (j < OBS_DIM - 1) {
            ++j;
            below[j] = first[j];
            above[j] = first[j] + 1;
            sums[j] = sum;
            numbers[j] = number;
            continue;
        }
        place = N_NEIGHBORS - 1;
        while (place > 0 && (squares[place - 1] > sum || (squares[place - 1] == sum && points[place - 1] > number))) {
            squares[place] = squares[place - 1];
            points[place] = points[place - 1];
            --place;
        }
        squares[place] = sum;
        points[place] = number;
    }
}
"""

SEARCH_SCATTERED = """
/* The nearest points and their squared distances, by (squared distance, number). */
static void find_nearest(const real *scaled, point_t *points, real *squares)
{
    point_t point;
    int place;
    for (place = 0; place < N_NEIGHBORS; ++place) {
        points[place] = 0;
        squares[place] = $far;
    }
    for (point = 0; point < N_POINTS; ++point) {
        real sum = $zero;
        int j;
        for (j = 0; j < OBS_DIM; ++j) {
            const real difference = scaled[j] - places[point][j];
            sum += difference * difference;
        }
        if (sum >= squares[N_NEIGHBORS - 1])
            continue;
        place = N_NEIGHBORS - 1;
        while (place > 0 && squares[place - 1] > sum) {
            squares[place] = squares[place - 1];
            points[place] = points[place - 1];
            --place;
        }
        squares[place] = sum;
        points[place] = point;
    }
}
"""

TABLE = """
static const real table[N_ROWS][N_COLUMNS] = {
$values
};
"""

ROW_OF_ALL = """
static const real *row_at(point_t point)
{
    return table[point];
}
"""

NUMBERS = """
/* The point of each row, and the row of all other points. */
static const point_t row_points[N_ROWS] = {
$row_points
};
static const real other_row[N_COLUMNS] = {
$other_row
};
"""

ROW_OF_SOME = """
static const real *row_at(point_t point)
{
    long first = 0, end = N_ROWS;
    while (first < end) {
        const long middle = first + (end - first) / 2;
        if (row_points[middle] < point)
            first = middle + 1;
        else
            end = middle;
    }
    return first < N_ROWS && row_points[first] == point ? table[first] : other_row;
}
"""

ACT_DISCRETE = """
int ${name}_action(const real observation[OBS_DIM])
{
    real values[N_COLUMNS];
    ${name}_q_values(observation, values);
    return ${first_action}best_column(values, 0, N_COLUMNS);
}
"""

ACTION_POINTS = """
#define ACTION_SIZE $n_actions

/* The action of each column. */
static const real action_points[N_COLUMNS][ACTION_SIZE] = {
$action_points
};
static const real lowest[ACTION_SIZE] = {$lowest};
static const real highest[ACTION_SIZE] = {$highest};
"""

#: What precedes the clipping of ``action``: the action of the best column, or the mean of those of the neighbours.
OF_VALUES = """
    real values[N_COLUMNS];
    int j, best;
    ${name}_q_values(observation, values);
    best = best_column(values, 0, N_COLUMNS);
    for (j = 0; j < ACTION_SIZE; ++j)
        action[j] = action_points[best][j];
"""

OF_ACTIONS = """
    static const int factors[N_FACTORS + 1] = {$factors};
    const real *rows[N_NEIGHBORS];
    real weights[N_NEIGHBORS];
    int i, j, factor;
    perceive(observation, rows, weights);
    for (j = 0; j < ACTION_SIZE; ++j)
        action[j] = $zero;
    for (i = 0; i < N_NEIGHBORS; ++i) {
        real selected[ACTION_SIZE] = {$zero};
        for (factor = 0; factor < N_FACTORS; ++factor) {
            const int best = best_column(rows[i], factors[factor], factors[factor + 1]);
            for (j = 0; j < ACTION_SIZE; ++j)
                selected[j] += action_points[best][j];
        }
        for (j = 0; j < ACTION_SIZE; ++j)
            action[j] += weights[i] * selected[j];
    }
"""

ACT_BOX = """
$n_factors
$scope ${function}(const real observation[OBS_DIM], real action[ACTION_SIZE])
{$choice
    for (j = 0; j < ACTION_SIZE; ++j) {
$rounding        if (action[j] < lowest[j])
            action[j] = lowest[j];
        if (action[j] > highest[j])
            action[j] = highest[j];
    }
}
"""

ACT_SINGLE = """
real ${name}_action(const real observation[OBS_DIM])
{
    real action[ACTION_SIZE];
    act(observation, action);
    return action[0];
}
"""


def write_c(policy: Exportable, path: Path, *, precision: str = "double", rows: str = "auto") -> list[Path]:
    """
    Write a header and a source beside it. All their names begin with that of the file.

    :param policy: the policy
    :param path: the source or the header; the other is written beside it
    :param precision: floating type of the table and of all computations, ``"double"`` or ``"float"``
    :param rows: the rows to store: ``"all"``; ``"changed"``, those that differ from the initial value, whose numbers
        are searched; or ``"auto"``, what takes less memory
    :return: both files
    :raises ValueError: if the weights are a function, or a number is too large for a float
    """
    check_word("precision", precision, PRECISIONS)
    stem = path.stem if path.suffix in (".c", ".h") else path.name
    source, header = path.with_name(f"{stem}.c"), path.with_name(f"{stem}.h")
    code = _Code(policy.frozen(), stem, precision, rows)
    replace_file(header, code.header().encode())
    replace_file(source, code.source(header.name).encode())
    return [source, header]


class _Code:
    """The code of a policy, from the templates above."""

    def __init__(self, frozen: FrozenPolicy, stem: str, precision: str, rows: str) -> None:
        self.frozen = frozen
        self.name = re.sub(r"\W|^(?=\d)", "_", stem, flags=re.ASCII)
        self.real, self.f, self.type = PRECISIONS[precision]
        self.precision = precision
        self.values, self.row_points = frozen.stored(rows)
        # An int has at least 16 bits, a long 32.
        self.index = "int" if frozen.n_points < 2**15 else "long" if frozen.n_points < 2**31 else "long long"
        weighting, bandwidth = frozen.kernel_weights("c")
        squared = bandwidth * bandwidth
        self.common = {
            "version": version("sb3-knntd"),
            "name": self.name,
            "NAME": self.name.upper(),
            "real": self.real,
            "f": self.f,
            "index": self.index,
            "obs_dim": frozen.obs_dim,
            "k": frozen.n_neighbors,
            "n_points": frozen.n_points,
            "n_columns": frozen.n_columns,
            "n_rows": len(self.values),
            "zero": self.number(0.0),
            "one": self.number(1.0),
            "two": self.number(2.0),
            "limit": self.number(FARTHEST),
            # More than any squared distance.
            "far": self.number(frozen.obs_dim * (4.0 * FARTHEST) ** 2),
            "h2": self.number(squared),
            "twice_h2": self.number(2.0 * squared),
        }
        self.weight = WEIGHTS[weighting]

    def fill(self, template: str, **parts: object) -> str:
        """Fill in a template. A part that is empty leaves no empty lines."""
        return re.sub(r"\n{3,}", "\n\n", Template(template).substitute(self.common, **parts))

    def number(self, value: float) -> str:
        """A constant of the floating type."""
        with np.errstate(over="ignore"):
            rounded = self.type(value)
        if not np.isfinite(rounded):
            raise ValueError(f"precision='float': {value:g} is too large for it, use 'double'")
        return f"{str(rounded) if self.f else repr(float(rounded))}{self.f}"

    def numbers(self, values: Iterable[float]) -> str:
        """A row of constants."""
        return ", ".join(map(self.number, values))

    def matrix(self, rows: np.ndarray) -> str:
        """The rows of a two-dimensional array."""
        return ",\n".join(f"    {{{self.numbers(row)}}}" for row in rows.tolist())

    def lines(self, items: Iterable[str], per_line: int = 12) -> str:
        """The entries of a long array."""
        listed = list(items)
        return ",\n".join(f"    {', '.join(listed[i : i + per_line])}" for i in range(0, len(listed), per_line))

    def header(self) -> str:
        """The header."""
        frozen, space = self.frozen, self.frozen.action_space
        ranges = "\n".join(
            f" *   [{j}] {low:.9g} to {high:.9g}"
            for j, (low, high) in enumerate(zip(frozen.low.tolist(), frozen.high.tolist(), strict=True))
        )
        observation = f"const {self.name}_real observation[{self.name.upper()}_OBSERVATION_SIZE]"
        first = frozen.first_action
        if first is not None:
            action = f"an int, {first} to {first + frozen.n_columns - 1}, the environment's."
            size, comment = "", "The greedy action, the lowest of equal ones."
            function = f"int {self.name}_action({observation})"
            of_columns = "The values of all actions, in their order."
        else:
            assert isinstance(space, spaces.Box)
            lows, highs = space.low.ravel().tolist(), space.high.ravel().tolist()
            action = f"{len(lows)} number(s), clipped to" + "".join(
                f"\n *   [{j}] {low:.9g} to {high:.9g}" for j, (low, high) in enumerate(zip(lows, highs, strict=True))
            )
            size = f"#define {self.name.upper()}_ACTION_SIZE {len(lows)}\n"
            of_columns = "The values of the columns of the table, each of an action point."
            if len(lows) == 1:
                function, comment = f"{self.name}_real {self.name}_action({observation})", "The greedy action."
            else:
                comment = "Writes the greedy action."
                function = (
                    f"void {self.name}_action({observation},\n"
                    f"{' ' * (len(self.name) + 13)}{self.name}_real action[{self.name.upper()}_ACTION_SIZE])"
                )
        # As on a computer of 64 bits, where a pointer and a long have 8 bytes.
        real, index = np.dtype(self.type).itemsize, 4 if self.index == "int" else 8
        table = self.values.size * real + (0 if self.row_points is None else len(self.row_points) * index)
        searched = frozen.n_neighbors * (8 + real + index) + frozen.obs_dim * (3 * real + 4 * index)
        stack = searched + frozen.n_columns * real
        return self.fill(
            HEADER,
            ranges=ranges,
            action=action,
            size=in_bytes(table),
            stack=in_bytes(stack),
            action_size=size,
            action_comment=comment,
            action_function=function,
            values_comment=of_columns,
        )

    def source(self, header: str) -> str:
        """The source."""
        frozen = self.frozen
        nearest = "square - nearest" in self.weight
        return self.fill(
            SOURCE,
            header=header,
            low=self.numbers(frozen.low.tolist()),
            width=self.numbers((frozen.high - frozen.low).tolist()),
            geometry=self._geometry(),
            table=self._table(),
            search=self.fill(SEARCH_SCATTERED if frozen.lattice is None else SEARCH_LATTICE),
            row_at=ROW_OF_ALL if self.row_points is None else ROW_OF_SOME,
            nearest_declaration="    real nearest;" if nearest else "",
            nearest="    nearest = weights[0];" if nearest else "",
            weight=self.fill(self.weight),
            act=self._act(),
        )

    def _geometry(self) -> str:
        lattice = self.frozen.lattice
        if lattice is None:
            assert self.frozen.places is not None
            return self.fill(SCATTERED, places=self.matrix(self.frozen.places))
        shape = lattice.shape
        spacings = [2.0 / max(count - 1, 1) for count in shape]
        return self.fill(
            LATTICE,
            sizes=", ".join(map(str, shape)),
            strides=", ".join(str(prod(shape[j + 1 :])) for j in range(len(shape))),
            spacings=self.numbers(spacings),
        )

    def _table(self) -> str:
        table = self.fill(TABLE, values=self.matrix(self.values))
        if self.row_points is None:
            return table
        return table + self.fill(
            NUMBERS,
            row_points=self.lines(map(str, self.row_points.tolist())),
            other_row=self.lines([self.number(self.frozen.initial_value)] * self.frozen.n_columns),
        )

    def _act(self) -> str:
        frozen, space, first = self.frozen, self.frozen.action_space, self.frozen.first_action
        if first is not None:
            return self.fill(ACT_DISCRETE, first_action=f"{first} + " if first else "")
        assert isinstance(space, spaces.Box)
        n_actions = frozen.columns.points.shape[1]
        points = self.fill(
            ACTION_POINTS,
            n_actions=n_actions,
            action_points=self.matrix(frozen.columns.points),
            lowest=self.numbers(space.low.ravel().tolist()),
            highest=self.numbers(space.high.ravel().tolist()),
        )
        factors = frozen.columns.factors.tolist()
        of_actions = frozen.combination is Combination.OF_ACTIONS
        single = n_actions == 1
        whole = np.issubdtype(space.dtype, np.integer)
        act = self.fill(
            ACT_BOX,
            n_factors=f"#define N_FACTORS {len(factors) - 1}\n" if of_actions else "",
            scope="static void" if single else "void",
            function="act" if single else f"{self.name}_action",
            choice=self.fill(OF_ACTIONS if of_actions else OF_VALUES, factors=", ".join(map(str, factors))).rstrip(),
            rounding=f"        action[j] = rint{self.f}(action[j]);\n" if whole else "",
        )
        return points + act + (self.fill(ACT_SINGLE) if single else "")
