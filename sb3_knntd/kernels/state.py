"""
All arrays and numbers that a learning step works on, as one object for compiled functions.

Unboxing one object takes numba a microsecond; unboxing its arrays separately takes several. The fields are those of the
named tuples that the kernels declare beside their functions. To add an array, add a field to one of them, and pass its
value by name where that tuple is created.
"""

from __future__ import annotations

from collections import namedtuple
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from sb3_knntd.kernels.experience import ExperienceArrays
from sb3_knntd.kernels.jit import AVAILABLE, jit
from sb3_knntd.kernels.perceive import PerceptionArguments
from sb3_knntd.kernels.selection import SelectionArguments
from sb3_knntd.kernels.traces import TableArrays, TraceArrays


class UpdateConfig(NamedTuple):
    """
    The variant of the update.

    :param gamma: γ
    :param normalized: whether the step size is α / Σp² instead of α
    :param accumulating: whether traces are accumulating (eq. 15) instead of replacing (eq. 16)
    :param reset_other_actions: whether a replacing trace clears those of the other actions
    """

    gamma: float
    normalized: bool
    accumulating: bool
    reset_other_actions: bool


class EpisodeArrays(NamedTuple):
    """
    The state of the episode in each environment. The first axis of the first four arrays is: the state before the step,
    ``CURRENT``; the state after it, ``NEXT``; and the last state before a truncation, ``TERMINAL``.

    :param indices: neighbours, shape (3, n_envs, k), int64
    :param probabilities: of the neighbours, shape (3, n_envs, k)
    :param action_indices: columns that each neighbour selected, shape (3, n_envs, k, n_factors), int64
    :param actions: means of the action points, shape (3, n_envs, action_dim)
    :param truncated: whether the episode was truncated, shape (n_envs,), bool
    :param last_observations: the last observation before the truncation, shape (n_envs, obs_dim)
    :param current_observations: the observation before the step, shape (n_envs, obs_dim); infinite if unknown
    :param persistent: columns being explored, or ``GREEDY`` or ``UNDRAWN``, shape (n_envs, n_factors), int64
    :param lengths: see :func:`~sb3_knntd.kernels.selection.count_steps`
    :param forbidden: the columns that the rules forbid, shape (3, n_envs, n_actions), bool, with the states as above
    """

    indices: np.ndarray
    probabilities: np.ndarray
    action_indices: np.ndarray
    actions: np.ndarray
    truncated: np.ndarray
    last_observations: np.ndarray
    current_observations: np.ndarray
    persistent: np.ndarray
    lengths: np.ndarray
    forbidden: np.ndarray


class RandomRows(NamedTuple):
    """
    Random numbers in [0, 1).

    :param rows: for the next action and for the one at a truncation, shape (n_rows, n_envs, 2, n_uniforms)
    :param n_taken: number of rows that have been used, shape (1,), int64
    """

    rows: np.ndarray
    n_taken: np.ndarray


class WorkArrays(NamedTuple):
    """
    Work space, bounds, and sums for the log.

    :param means: shape (n_actions,)
    :param row: shape (n_actions,)
    :param target_values: shape (n_envs,)
    :param corrections: shape (n_envs,)
    :param places: shape (n_envs, k), int64
    :param sums: sum of the absolute TD errors, sum of the values, and number of both, shape (3,)
    :param value_bound: upper bound of the absolute values of the table, shape (1,); infinity if unknown
    :param trace_bound: upper bound of the traces, shape (1,)
    """

    means: np.ndarray
    row: np.ndarray
    target_values: np.ndarray
    corrections: np.ndarray
    places: np.ndarray
    sums: np.ndarray
    value_bound: np.ndarray
    trace_bound: np.ndarray


#: The named tuples that declare the fields; field names are unique.
GROUPS = (
    PerceptionArguments,
    SelectionArguments,
    UpdateConfig,
    TableArrays,
    TraceArrays,
    EpisodeArrays,
    RandomRows,
    WorkArrays,
    ExperienceArrays,
)
FIELDS = tuple(field for group in GROUPS for field in group._fields)

if AVAILABLE:
    from numba.core import cgutils, types
    from numba.experimental import structref
    from numba.extending import intrinsic

    @structref.register
    class KernelStateType(types.StructRef):
        """numba's type of a kernel state, determined by the types of its fields."""

        def preprocess_fields(self, fields):
            """Replace literal types: a field is a variable even if it was set from a constant."""
            return tuple((name, types.unliteral(field)) for name, field in fields)

    class KernelState(structref.StructRefProxy):
        """A kernel state in Python, created from the values of ``GROUPS`` in their order."""

        def __new__(cls, *fields):
            return structref.StructRefProxy.__new__(cls, *fields)

    structref.define_proxy(KernelState, KernelStateType, FIELDS)

    @intrinsic
    def borrow(typing_context, group):
        """
        :param group: tuple of arrays and numbers
        :return: the same without counting references to the arrays: the caller must keep them alive
        """

        def without_owner(context, builder, kind, value):
            if isinstance(kind, types.Array):
                array = context.make_array(kind)(context, builder, value)
                array.meminfo = cgutils.get_null_value(array.meminfo.type)
                array.parent = cgutils.get_null_value(array.parent.type)
                return array._getvalue()
            if isinstance(kind, types.BaseTuple):
                parts = cgutils.unpack_tuple(builder, value)
                borrowed = [without_owner(context, builder, *pair) for pair in zip(kind, parts, strict=True)]
                return context.make_tuple(builder, kind, borrowed)
            return value

        def generate(context, builder, signature, arguments):
            return without_owner(context, builder, group, arguments[0])

        return group(group), generate

    #: Types of states by name: numba can cache functions of a literal name on disk, but not functions of a type.
    _KINDS: dict[str, KernelStateType] = {}

    @intrinsic
    def _pointer_to(typing_context, state):
        def generate(context, builder, signature, arguments):
            pointer = cgutils.create_struct_proxy(state)(context, builder, value=arguments[0]).meminfo
            return builder.ptrtoint(pointer, context.get_value_type(types.intp))

        return types.intp(state), generate

    @jit
    def _find_address(state):
        return _pointer_to(state)

    @intrinsic(prefer_literal=True)
    def state_at(typing_context, address, kind):
        """
        Get a state from its address. This saves 0.6 µs per step compared with unboxing it, see docs/performance.md.

        :param address: address of a state, which the caller must keep alive
        :param kind: name of its type, from :func:`address_of`
        :return: the state
        """
        state = _KINDS[kind.literal_value]

        def generate(context, builder, signature, arguments):
            proxy = cgutils.create_struct_proxy(state)(context, builder)
            proxy.meminfo = builder.inttoptr(arguments[0], proxy.meminfo.type)
            value = proxy._getvalue()
            # numba decrements the reference count when the variable goes out of scope.
            context.nrt.incref(builder, state, value)
            return value

        return state(address, kind), generate

    def address_of(state: KernelState) -> tuple[int, str]:
        """
        :param state: a state
        :return: its address, valid as long as the state is alive, and the name of its type
        """
        kind = state._numba_type_
        _KINDS[kind.name] = kind
        return _find_address(state), kind.name

else:

    def borrow(group):  # type: ignore[misc]
        """Return the group itself."""
        return group

    def address_of(state):  # type: ignore[misc]
        """Return the state itself in place of its address."""
        return state, ""

    def state_at(address, kind):  # type: ignore[misc]
        """Return the state that :func:`address_of` was called with."""
        return address

    KernelState = namedtuple("KernelState", FIELDS)  # type: ignore[no-redef, misc]


@jit
def _make_state(fields):
    return KernelState(*borrow(fields))


def make_state(*groups: tuple[Any, ...]) -> KernelState:
    """
    :param groups: an instance of each of ``GROUPS``, in their order. The caller must keep their arrays alive
    :return: all their fields as one object
    """
    state: KernelState = _make_state(tuple(chain.from_iterable(groups)))
    return state
