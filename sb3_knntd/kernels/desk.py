"""
All that lies before the learner while it works, as one object: numba takes in an object of any number of arrays as
fast as one array.

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
log            sums of the TD errors' sizes and of the values, (2,)
work           values (2, n_actions), corrections (n_envs,), places (n_envs, k), to be used
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
    from numba.core import types
    from numba.experimental import structref

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
else:
    Desk = namedtuple("Desk", FIELDS)  # type: ignore[no-redef, misc]


@jit
def set_desk(eyes, choice, form, episodes, memory, chance, work):
    """A desk of the fields named above; compiled, as that is what numba keeps on disk."""
    low, width, limit, search, axes, offsets, columns, weights, bandwidth = eyes
    rule, target, exploration, random_ties, least_hold, hold_share, blocks, action_points = choice
    gamma, normalized, accumulating, reset_others = form
    indices, probabilities, entries, actions, truncated, last_observations, held, lengths = episodes
    values, visited, row_points, row_slots, initial, live_points, live, live_slots, counts, pace = memory
    uniforms, taken = chance
    sums, means, corrections, places = work
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
