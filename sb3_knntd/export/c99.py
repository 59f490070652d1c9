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

from sb3_knntd.actions.peak import LEAST_CURVATURE
from sb3_knntd.common.checks import check_word, in_bytes
from sb3_knntd.common.files import replace_file
from sb3_knntd.export import c_templates as templates
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
#: The last parameter of functions that compare columns, with rules.
FORBIDDEN_PARAMETER = ", const unsigned char *forbidden"


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


def _numbers(count: int) -> str:
    """A count of numbers, in words."""
    return "1 number" if count == 1 else f"{count} numbers"


class _Code:
    """The code of a policy."""

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
        ruled = len(frozen.rules) > 0
        # The last declaration of a function that selects: C99 lets a call follow.
        declared = "unsigned char forbidden[N_COLUMNS];\n    find_forbidden(observation, forbidden);"
        self.common |= {
            "forbidden": ", forbidden" if ruled else "",
            "find_forbidden": declared if ruled else "",
        }

    def fill(self, template: str, **parts: object) -> str:
        """Fill in a template. A part that is empty leaves no empty lines."""
        filled = re.sub(r"\n +(?=\n)", "", Template(template).substitute(self.common, **parts))
        return re.sub(r"\n{3,}", "\n\n", filled)

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
            action = f"{_numbers(len(lows))}, clipped to" + "".join(
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
                    f"{' ' * len(f'void {self.name}_action(')}{self.name}_real action[{self.name.upper()}_ACTION_SIZE])"
                )
        # As on a computer of 64 bits, where a pointer and a long have 8 bytes.
        real, index = np.dtype(self.type).itemsize, 4 if self.index == "int" else 8
        table = self.values.size * real + (0 if self.row_points is None else len(self.row_points) * index)
        searched = frozen.n_neighbors * (8 + real + index) + frozen.obs_dim * (3 * real + 4 * index)
        stack = searched + frozen.n_columns * real
        return self.fill(
            templates.HEADER,
            observation=_numbers(frozen.obs_dim),
            indent=" " * len(f"void {self.name}_q_values("),
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
        uses_nearest = re.search(r"\bnearest\b", self.weight)
        return self.fill(
            templates.SOURCE,
            header=header,
            low=self.numbers(frozen.low.tolist()),
            width=self.numbers((frozen.high - frozen.low).tolist()),
            geometry=self._geometry(),
            table=self._table(),
            search=self.fill(templates.SEARCH_SCATTERED if frozen.lattice is None else templates.SEARCH_LATTICE),
            row_at=templates.ROW_OF_ALL if self.row_points is None else templates.ROW_OF_SOME,
            nearest="    const real nearest = weights[0];" if uses_nearest else "",
            weight=self.fill(self.weight),
            act=self._act(),
            rules=self._rules(),
            allowed_only=" that is allowed" if len(frozen.rules) else "",
            forbidden_parameter=FORBIDDEN_PARAMETER if len(frozen.rules) else "",
            better=templates.BETTER_ALLOWED if len(frozen.rules) else templates.BETTER,
        )

    def _geometry(self) -> str:
        lattice = self.frozen.lattice
        if lattice is None:
            assert self.frozen.places is not None
            return self.fill(templates.SCATTERED, places=self.matrix(self.frozen.places))
        shape = lattice.shape
        spacings = [2.0 / max(count - 1, 1) for count in shape]
        return self.fill(
            templates.LATTICE,
            sizes=", ".join(map(str, shape)),
            strides=", ".join(str(prod(shape[j + 1 :])) for j in range(len(shape))),
            spacings=self.numbers(spacings),
        )

    def _table(self) -> str:
        table = self.fill(templates.TABLE, values=self.matrix(self.values))
        if self.row_points is None:
            return table
        return table + self.fill(
            templates.NUMBERS,
            row_points=self.lines(map(str, self.row_points.tolist())),
            other_row=self.lines([self.number(self.frozen.initial_value)] * self.frozen.n_columns),
        )

    def _rules(self) -> str:
        rules = self.frozen.rules
        if not len(rules):
            return ""
        # No number is beyond the largest one.
        largest = float(np.finfo(self.type).max)
        corners = (np.clip(corner.numpy(), -largest, largest) for corner in (rules.low, rules.high))
        low, high = map(self.matrix, corners)
        columns = ",\n".join(f"    {{{', '.join(map(str, row))}}}" for row in rules.columns.int().tolist())
        return self.fill(templates.RULES, n_rules=len(rules), rule_low=low, rule_high=high, rule_columns=columns)

    def _act(self) -> str:
        frozen, space, first = self.frozen, self.frozen.action_space, self.frozen.first_action
        if first is not None:
            return self.fill(templates.ACT_DISCRETE, first_action=f"{first} + " if first else "")
        assert isinstance(space, spaces.Box)
        n_actions = frozen.columns.points.shape[1]
        points = self.fill(
            templates.ACTION_POINTS,
            n_actions=n_actions,
            action_points=self.matrix(frozen.columns.points),
            lowest=self.numbers(space.low.ravel().tolist()),
            highest=self.numbers(space.high.ravel().tolist()),
        )
        factors = frozen.columns.factors.tolist()
        of_actions = frozen.combination is Combination.OF_ACTIONS
        single = n_actions == 1
        peak = self._peak() if frozen.interpolates else ""
        whole = np.issubdtype(space.dtype, np.integer)
        act = self.fill(
            templates.ACT_BOX,
            n_factors=f"#define N_FACTORS {len(factors) - 1}\n" if of_actions else "",
            scope="static void" if single else "void",
            function="act" if single else f"{self.name}_action",
            choice=self.fill(
                templates.OF_ACTIONS if of_actions else templates.OF_VALUES,
                factors=", ".join(map(str, factors)),
                peak=f" + peak_offset(values, best, j{self.common['forbidden']})" if frozen.interpolates else "",
            ).rstrip(),
            rounding=f"        action[j] = rint{self.f}(action[j]);\n" if whole else "",
        )
        return points + peak + act + (self.fill(templates.ACT_SINGLE) if single else "")

    def _peak(self) -> str:
        counts = [len(points) for points in self.frozen.columns.lists]
        ruled = len(self.frozen.rules) > 0
        return self.fill(
            templates.PEAK,
            counts=", ".join(map(str, counts)),
            steps=", ".join(str(prod(counts[j + 1 :])) for j in range(len(counts))),
            least=self.number(LEAST_CURVATURE),
            half=self.number(0.5),
            forbidden_parameter=FORBIDDEN_PARAMETER if ruled else "",
            forbidden_beside=templates.FORBIDDEN_BESIDE if ruled else "",
        )
