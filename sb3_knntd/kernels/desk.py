"""
All that lies before the learner while it works, as one object, which compiled functions find by its address: to take
in the object itself costs numba a microsecond, and to take in its arrays one by one several. Its arrays are lent: who
sets the desk keeps them, so that nothing needs to be counted when they are taken up.

perception     ``eyes`` of :func:`sb3_knntd.kernels.perceive.perceive`: low, width, limit, search, axes, offsets,
               columns, weights, bandwidth
choice         rule: ``AVERAGE`` or ``EACH``; target, exploration, random_ties of
               :func:`sb3_knntd.kernels.step.choose`; least_hold, hold_share of :func:`sb3_knntd.kernels.step.hold`;
               blocks (n_blocks + 1,): where the columns of each of the action's parts begin; action_points
               (n_actions, action_dim)
update         gamma, normalized (step), accumulating (traces), reset_others
episodes       indices, probabilities (3, n_envs, k), entries (3, n_envs, k, n_blocks), the columns that each neighbour
               answers for, and actions (3, n_envs, action_dim): of the state that each environment left, ``NOW``, of
               the one it is in, ``THEN``, and of the ``LAST`` one before a truncation; truncated (n_envs,) and
               last_observations (n_envs, obs_dim): which episodes were, and what was seen last; held (n_envs,
               n_blocks): the column that is being explored, ``GREEDY`` or ``UNDRAWN``; lengths (1 + n_envs,): see
               :func:`sb3_knntd.kernels.step.count_steps`
memory         the arrays of :mod:`sb3_knntd.kernels.memory`
chance         uniforms (n_rows, n_envs, 2, n_uniforms): rows of random numbers in [0, 1), for the next action and for
               the one that would have been taken at a truncation; taken (1,): how many of the rows have been
log            sums of the TD errors' sizes and of the values, and how many of each, (3,)
work           means (2, n_actions), corrections (n_envs,), places (n_envs, k), to be used
"""

from __future__ import annotations

from collections import namedtuple

from sb3_knntd.kernels.jit import AVAILABLE, jit

EYES = ("low", "width", "limit", "search", "axes", "offsets", "columns", "weights", "bandwidth")
RULE = ("rule", "target", "exploration", "random_ties", "least_hold", "hold_share", "blocks", "action_points")
FORM = ("gamma", "normalized", "accumulating", "reset_others")
EPISODES = ("indices", "probabilities", "entries", "actions", "truncated", "last_observations", "held", "lengths")
MEMORY = (
    "values",
    "visited",
    "row_points",
    "row_slots",
    "initial",
    "live_points",
    "live",
    "live_slots",
    "counts",
    "pace",
)
CHANCE = ("uniforms", "taken")
WORK = ("sums", "means", "corrections", "places")
FIELDS = (*EYES, *RULE, *FORM, *EPISODES, *MEMORY, *CHANCE, *WORK)

if AVAILABLE:
    from numba.core import cgutils, types
    from numba.experimental import structref
    from numba.extending import intrinsic

    @structref.register
    class DeskType(types.StructRef):
        """numba's type of a desk: that of its fields."""

        def preprocess_fields(self, fields):
            """A field is a variable, whatever constant it was made of."""
            return tuple((name, types.unliteral(field)) for name, field in fields)

    class Desk(structref.StructRefProxy):
        """A desk as Python sees it, made of the values of ``FIELDS`` in their order."""

        def __new__(cls, *fields):
            return structref.StructRefProxy.__new__(cls, *fields)

    structref.define_proxy(Desk, DeskType, FIELDS)

    #: By name, what kinds of desks there are; numba keeps on disk what is compiled for a name, not for a type.
    _KINDS: dict[str, DeskType] = {}

    @intrinsic
    def lend(typing_context, value):
        """
        :param value: an array, a tuple, or anything that has no memory of its own
        :return: the same, whose arrays are somebody else's to keep: nobody counts references to them
        """

        def without_owner(context, builder, kind, value):
            if isinstance(kind, types.Array):
                array = context.make_array(kind)(context, builder, value)
                array.meminfo = cgutils.get_null_value(array.meminfo.type)
                array.parent = cgutils.get_null_value(array.parent.type)
                return array._getvalue()
            if isinstance(kind, types.BaseTuple):
                parts = cgutils.unpack_tuple(builder, value)
                lent = [without_owner(context, builder, *pair) for pair in zip(kind, parts, strict=True)]
                return context.make_tuple(builder, kind, lent)
            return value

        def generate(context, builder, signature, arguments):
            return without_owner(context, builder, value, arguments[0])

        return value(value), generate

    @intrinsic
    def _address_of(typing_context, desk):
        def generate(context, builder, signature, arguments):
            pointer = cgutils.create_struct_proxy(desk)(context, builder, value=arguments[0]).meminfo
            return builder.ptrtoint(pointer, context.get_value_type(types.intp))

        return types.intp(desk), generate

    @intrinsic(prefer_literal=True)
    def desk_at(typing_context, address, kind):
        """
        :param address: where a desk is that somebody keeps
        :param kind: what :func:`place_of` named it
        :return: the desk
        """
        desk = _KINDS[kind.literal_value]

        def generate(context, builder, signature, arguments):
            proxy = cgutils.create_struct_proxy(desk)(context, builder)
            proxy.meminfo = builder.inttoptr(arguments[0], proxy.meminfo.type)
            value = proxy._getvalue()
            # For the variable that it becomes, which counts as one more reference to it.
            context.nrt.incref(builder, desk, value)
            return value

        return desk(address, kind), generate

    @jit
    def _find_address(desk):
        return _address_of(desk)

    def place_of(desk: Desk) -> tuple[int, str]:
        """
        :param desk: a desk; it is there for as long as it is kept
        :return: its address, and the name of its kind
        """
        kind = desk._numba_type_
        _KINDS[kind.name] = kind
        return _find_address(desk), kind.name

else:
    Desk = namedtuple("Desk", FIELDS)  # type: ignore[no-redef, misc]

    def lend(value):  # type: ignore[misc]
        """Nobody counts references here that need not be."""
        return value

    def place_of(desk: Desk) -> tuple[int, str]:
        """A desk is its own address."""
        return desk, ""  # type: ignore[return-value]

    def desk_at(address, kind):  # type: ignore[misc]
        """What :func:`place_of` was given."""
        return address


@jit
def set_desk(eyes, choice, form, episodes, memory, chance, work):
    """A desk of the fields named above; compiled, as that is what numba keeps on disk."""
    low, width, limit, search, axes, offsets, columns, weights, bandwidth = lend(eyes)
    rule, target, exploration, random_ties, least_hold, hold_share, blocks, action_points = lend(choice)
    gamma, normalized, accumulating, reset_others = lend(form)
    indices, probabilities, entries, actions, truncated, last_observations, held, lengths = lend(episodes)
    values, visited, row_points, row_slots, initial, live_points, live, live_slots, counts, pace = lend(memory)
    uniforms, taken = lend(chance)
    sums, means, corrections, places = lend(work)
    return Desk(
        low,
        width,
        limit,
        search,
        axes,
        offsets,
        columns,
        weights,
        bandwidth,
        rule,
        target,
        exploration,
        random_ties,
        least_hold,
        hold_share,
        blocks,
        action_points,
        gamma,
        normalized,
        accumulating,
        reset_others,
        indices,
        probabilities,
        entries,
        actions,
        truncated,
        last_observations,
        held,
        lengths,
        values,
        visited,
        row_points,
        row_slots,
        initial,
        live_points,
        live,
        live_slots,
        counts,
        pace,
        uniforms,
        taken,
        sums,
        means,
        corrections,
        places,
    )
