"""
All arrays and numbers that a learning step works on, as one object for compiled functions.

To take in one object costs numba a microsecond, to take in its arrays one by one several. Its fields are the named
tuples that the kernels declare beside their functions: a new array is a line in one of them, and its value is given by
name where that tuple is made.
"""

from __future__ import annotations

from collections import namedtuple
from itertools import chain
from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import AVAILABLE, jit
from sb3_knntd.kernels.perceive import PerceptionArguments
from sb3_knntd.kernels.selection import SelectionArguments
from sb3_knntd.kernels.traces import TableArrays, TraceArrays


class UpdateConfig(NamedTuple):
    """
    Which form the update has.

    :param gamma: γ
    :param normalized: whether the step is α / Σp² in place of α
    :param accumulating: whether traces accumulate (eq. 15) in place of being replaced (eq. 16)
    :param reset_other_actions: whether a replacing trace clears those of the other actions
    """

    gamma: float
    normalized: bool
    accumulating: bool
    reset_other_actions: bool


class EpisodeArrays(NamedTuple):
    """
    Where each environment is in its episode. The first axis of the first four is that of the state that was left,
    ``CURRENT``, of the one that it led to, ``NEXT``, and of the last one before a truncation, ``TERMINAL``.

    :param indices: neighbours, shape (3, n_envs, k), int64
    :param probabilities: of the neighbours, shape (3, n_envs, k)
    :param action_indices: columns that each neighbour selected, shape (3, n_envs, k, n_factors), int64
    :param actions: means of the action points, shape (3, n_envs, action_dim)
    :param truncated: whether the episode was truncated, shape (n_envs,), bool
    :param last_observations: the last observation before the truncation, shape (n_envs, obs_dim)
    :param persistent: columns that are being explored, ``GREEDY`` or ``UNDRAWN``, shape (n_envs, n_factors), int64
    :param lengths: see :func:`~sb3_knntd.kernels.selection.count_steps`
    """

    indices: np.ndarray
    probabilities: np.ndarray
    action_indices: np.ndarray
    actions: np.ndarray
    truncated: np.ndarray
    last_observations: np.ndarray
    persistent: np.ndarray
    lengths: np.ndarray


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
    Work space, and sums for the log.

    :param means: shape (n_actions,)
    :param row: shape (n_actions,)
    :param target_values: shape (n_envs,)
    :param corrections: shape (n_envs,)
    :param places: shape (n_envs, k), int64
    :param sums: of the sizes of the TD errors, of the values, and the number of both, shape (3,)
    :param value_bound: no value of the table is larger in size, shape (1,); infinity where that is not known
    :param trace_bound: no trace is larger, shape (1,)
    """

    means: np.ndarray
    row: np.ndarray
    target_values: np.ndarray
    corrections: np.ndarray
    places: np.ndarray
    sums: np.ndarray
    value_bound: np.ndarray
    trace_bound: np.ndarray


#: The declarations of the fields, whose names all differ.
GROUPS = (
    PerceptionArguments,
    SelectionArguments,
    UpdateConfig,
    TableArrays,
    TraceArrays,
    EpisodeArrays,
    RandomRows,
    WorkArrays,
)
FIELDS = tuple(field for group in GROUPS for field in group._fields)

if AVAILABLE:
    from numba.core import cgutils, types
    from numba.experimental import structref
    from numba.extending import intrinsic

    @structref.register
    class KernelStateType(types.StructRef):
        """numba's type of a kernel state: that of its fields."""

        def preprocess_fields(self, fields):
            """A field is a variable, whatever constant it was made of."""
            return tuple((name, types.unliteral(field)) for name, field in fields)

    class KernelState(structref.StructRefProxy):
        """A kernel state as Python sees it, made of the values of ``GROUPS`` in their order."""

        def __new__(cls, *fields):
            return structref.StructRefProxy.__new__(cls, *fields)

    structref.define_proxy(KernelState, KernelStateType, FIELDS)

    @intrinsic
    def borrow(typing_context, group):
        """
        :param group: named tuple of arrays and numbers
        :return: the same, whose arrays are not counted references: whoever made them keeps them
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

    #: By name, which kinds of states there are; numba keeps on disk what is compiled for a name, not for a type.
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
        To take in a state by its address saves 0.6 µs of each step, see docs/performance.md.

        :param address: where a state is that somebody keeps
        :param kind: what :func:`address_of` named it
        :return: the state
        """
        state = _KINDS[kind.literal_value]

        def generate(context, builder, signature, arguments):
            proxy = cgutils.create_struct_proxy(state)(context, builder)
            proxy.meminfo = builder.inttoptr(arguments[0], proxy.meminfo.type)
            value = proxy._getvalue()
            # For the variable that it becomes, which counts as one more reference to it.
            context.nrt.incref(builder, state, value)
            return value

        return state(address, kind), generate

    def address_of(state: KernelState) -> tuple[int, str]:
        """
        :param state: a state; it is there for as long as somebody keeps it
        :return: its address, and the name of its kind
        """
        kind = state._numba_type_
        _KINDS[kind.name] = kind
        return _find_address(state), kind.name

else:

    def borrow(group):  # type: ignore[misc]
        """The same: nobody counts references here that need not be."""
        return group

    def address_of(state):  # type: ignore[misc]
        """The state itself, in place of its address."""
        return state, ""

    def state_at(address, kind):  # type: ignore[misc]
        """What :func:`address_of` was given."""
        return address

    KernelState = namedtuple("KernelState", FIELDS)  # type: ignore[no-redef, misc]


@jit
def _make_state(fields):
    return KernelState(*borrow(fields))


def make_state(*groups: tuple) -> KernelState:
    """
    :param groups: a value of each of ``GROUPS``, in their order. Whoever has the state keeps their arrays
    :return: all their fields as one object
    """
    return _make_state(tuple(chain.from_iterable(groups)))
