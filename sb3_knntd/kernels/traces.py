"""
The Q-table and its eligibility traces.

Updates along the eligibility traces need not write to the table. Q += α δ e and e *= γ λ over all entries reduce to one
running sum: with c the product of all decays so far and G = Σ α δ c, an entry whose trace was set to e at c₀ has since
changed by (e/c₀)(G - G₀) (Wiering and Schmidhuber, Fast online Q(λ), 1998). Points that have a trace are called
*active*. For each of their entries, the arrays store x = e/c₀ for each environment and a base, so that

    Q = base + share · Σ_env x G,    share = max_env x / Σ_env x

where share turns the sum of the errors of several environments into a mean. All traces decay at the same rate, so share
changes only when a trace is set. A step costs O(k · n_actions), independent of λ, the length of the episode and the
size of the table.

A hash maps points to places. It is an array of (point, place), shape (size, 2), int64, filled by linear probing. Its
size is a power of two; the point -1 marks a free slot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import inlined, jit

#: Smaller traces are dropped: their effect is below the precision of a float64.
LEAST_TRACE = 1e-18
#: When c falls below this, all values are brought up to date and c is reset to 1: x grows as 1/c, which loses digits.
LEAST_CLOCK = 1e-4
#: Larger values are considered diverged. Sums of values still fit into float32.
LARGEST_VALUE = 1e30
#: Visits are counted up to this number. As an int32 there is room for those of a whole step.
MOST_VISITS = 2**30


class TableArrays(NamedTuple):
    """
    The Q-table.

    :param values: shape (n_rows, n_actions)
    :param visits: number of learning steps that have updated each row, shape (n_rows,), int32
    :param row_points: the point of each row, shape (n_rows,), int64; empty if row i is that of point i
    :param row_slots: hash from points to rows; empty if row i is that of point i
    :param n_rows: number of rows in use, shape (1,), int64; not used if row i is that of point i
    :param initial_value: value of points without a row
    """

    values: np.ndarray
    visits: np.ndarray
    row_points: np.ndarray
    row_slots: np.ndarray
    n_rows: np.ndarray
    initial_value: float


class TraceArrays(NamedTuple):
    """
    The active points and the values of their entries.

    :param active_points: shape (capacity,), int64
    :param active_entries: x of each environment, share and base of each entry, shape (capacity, n_actions, n_envs + 2)
    :param active_slots: hash from points to places in these arrays
    :param n_active: number of active points, shape (1,), int64
    :param clock: c, and G of each environment, shape (1 + n_envs,)
    """

    active_points: np.ndarray
    active_entries: np.ndarray
    active_slots: np.ndarray
    n_active: np.ndarray
    clock: np.ndarray


@inlined
def _probe(point, slots):
    """The slot of a point, or the free slot where it would be inserted."""
    mask = len(slots) - 1
    mixed = np.uint64(point) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(mask))
    while slots[slot, 0] != point and slots[slot, 0] != -1:
        slot = (slot + 1) & mask
    return slot


@inlined
def find(point, slots):
    """The place of a point, -1 if it is not in the hash."""
    slot = _probe(point, slots)
    return slots[slot, 1] if slots[slot, 0] == point else -1


@jit
def insert(point, place, slots):
    """Insert a point and its place into a hash."""
    slot = _probe(point, slots)
    slots[slot, 0] = point
    slots[slot, 1] = place


@jit
def rehash(points, count, slots):
    """Fill a hash with the first ``count`` points, each at its index."""
    slots[:, 0] = -1
    for place in range(count):
        insert(points[place], place, slots)


@inlined
def row_of(point, row_slots):
    """Row of a point in the table, -1 if it has none yet."""
    return point if len(row_slots) == 0 else find(point, row_slots)


@inlined
def active_value(entries, place, action, clock):
    """Value of an active entry."""
    n_envs = len(clock) - 1
    if n_envs == 1:
        return entries[place, action, 2] + entries[place, action, 0] * clock[1]
    gained = 0.0
    for env in range(n_envs):
        gained += entries[place, action, env] * clock[1 + env]
    return entries[place, action, n_envs + 1] + entries[place, action, n_envs] * gained


@inlined
def read_active_row(entries, place, clock, row):
    """Write the values of an active point into ``row``, shape (n_actions,)."""
    if len(clock) == 2:
        here, gained = entries[place], clock[1]
        for action in range(len(row)):
            row[action] = here[action, 2] + here[action, 0] * gained
    else:
        for action in range(len(row)):
            row[action] = active_value(entries, place, action, clock)


@inlined
def stored_value(point, action, values, row_slots, initial_value):
    """The value of an entry in the table."""
    row = row_of(point, row_slots)
    return values[row, action] if row >= 0 else initial_value


@inlined
def read_stored_row(point, values, row_slots, initial_value, row):
    """Write the values of a point in the table into ``row``, shape (n_actions,)."""
    place = row_of(point, row_slots)
    if place >= 0:
        for action in range(len(row)):
            row[action] = values[place, action]
    else:
        for action in range(len(row)):
            row[action] = initial_value


@inlined
def read_row(point, values, row_slots, initial_value, entries, slots, clock, row):
    """
    Write the values of a point into ``row``, shape (n_actions,).

    Takes the arrays of :class:`TableArrays` and :class:`TraceArrays` separately, so that callers read them once before
    a loop over points: numba counts references each time an array is read from a tuple.
    """
    place = find(point, slots)
    if place >= 0:
        read_active_row(entries, place, clock, row)
    else:
        read_stored_row(point, values, row_slots, initial_value, row)


@inlined
def count_visit(point, visits, row_slots):
    """Count a learning step that updates a point, which must have a row in the table."""
    row = row_of(point, row_slots)
    if visits[row] < MOST_VISITS:
        visits[row] += 1


@jit
def activate(point, table, traces):
    """Make a point active, and add a row to the table if it has none; its place."""
    row = row_of(point, table.row_slots)
    if row < 0:
        row = table.n_rows[0]
        table.n_rows[0] += 1
        table.row_points[row] = point
        insert(point, row, table.row_slots)
    place = traces.n_active[0]
    traces.n_active[0] += 1
    traces.active_points[place] = point
    entries, values = traces.active_entries, table.values
    n_envs = entries.shape[2] - 2
    for action in range(entries.shape[1]):
        for env in range(n_envs):
            entries[place, action, env] = 0.0
        entries[place, action, n_envs] = 1.0
        entries[place, action, n_envs + 1] = values[row, action]
    insert(point, place, traces.active_slots)
    return place


@inlined
def set_trace(entries, place, action, env, trace, clock):
    """Set x of an active entry without changing its value."""
    n_envs = len(clock) - 1
    if n_envs == 1:
        entries[place, action, 2] += (entries[place, action, 0] - trace) * clock[1]
        entries[place, action, 0] = trace
    elif entries[place, action, env] != trace:
        value = active_value(entries, place, action, clock)
        entries[place, action, env] = trace
        _reshare(entries, place, action)
        entries[place, action, n_envs + 1] = 0.0
        entries[place, action, n_envs + 1] = value - active_value(entries, place, action, clock)


@jit
def _reshare(entries, place, action):
    n_envs = entries.shape[2] - 2
    largest, together = 0.0, 0.0
    for env in range(n_envs):
        largest = max(largest, entries[place, action, env])
        together += entries[place, action, env]
    entries[place, action, n_envs] = largest / together if together > 0.0 else 1.0


@jit
def write_back(table, traces):
    """Write the values of all active points into the table. The traces do not change."""
    for place in range(traces.n_active[0]):
        row = row_of(traces.active_points[place], table.row_slots)
        for action in range(traces.active_entries.shape[1]):
            table.values[row, action] = active_value(traces.active_entries, place, action, traces.clock)


@jit
def largest_size(table, traces):
    """The largest absolute value in the table."""
    values, clock, largest = table.values, traces.clock, 0.0
    n_rows = len(values) if len(table.row_slots) == 0 else table.n_rows[0]
    for row in range(n_rows):
        for action in range(values.shape[1]):
            largest = max(largest, abs(values[row, action]))
    for place in range(traces.n_active[0]):
        for action in range(values.shape[1]):
            largest = max(largest, abs(active_value(traces.active_entries, place, action, clock)))
    return largest


@jit
def adopt(table, traces):
    """Set the values of the active points to those in the table. The traces do not change."""
    entries, clock = traces.active_entries, traces.clock
    for place in range(traces.n_active[0]):
        row = row_of(traces.active_points[place], table.row_slots)
        for action in range(entries.shape[1]):
            change = table.values[row, action] - active_value(entries, place, action, clock)
            entries[place, action, entries.shape[2] - 1] += change


@jit
def overwrite(point, row, table, traces):
    """Set the values of a point to ``row``, shape (n_actions,), and drop its traces."""
    table.values[row_of(point, table.row_slots)] = row
    place = find(point, traces.active_slots)
    if place >= 0:
        last = traces.n_active[0] - 1
        traces.active_points[place] = traces.active_points[last]
        traces.active_entries[place] = traces.active_entries[last]
        traces.n_active[0] = last
        rehash(traces.active_points, last, traces.active_slots)


@jit
def _rebase(entries, place, clock):
    """Rewrite the bases and the x of an active point for c = 1 and G = 0; whether it still has a trace."""
    n_envs, active = len(clock) - 1, False
    if n_envs == 1:
        here, decay, gained = entries[place], clock[0], clock[1]
        for action in range(len(here)):
            here[action, 2] += here[action, 0] * gained
            trace = here[action, 0] * decay
            here[action, 0] = trace if trace >= LEAST_TRACE else 0.0
            active |= trace >= LEAST_TRACE
        return active
    for action in range(entries.shape[1]):
        entries[place, action, n_envs + 1] = active_value(entries, place, action, clock)
        dropped = False
        for env in range(n_envs):
            trace = entries[place, action, env] * clock[0]
            if trace < LEAST_TRACE:
                dropped = dropped or trace > 0.0
                trace = 0.0
            else:
                active = True
            entries[place, action, env] = trace
        if dropped:
            _reshare(entries, place, action)
    return active


@jit
def flush(table, traces):
    """Bring all values up to date, drop the points whose traces have decayed, and reset c and G."""
    n_envs = len(traces.clock) - 1
    points, entries = traces.active_points, traces.active_entries
    kept = 0
    for place in range(traces.n_active[0]):
        if _rebase(entries, place, traces.clock):
            if kept < place:
                points[kept] = points[place]
                entries[kept] = entries[place]
            kept += 1
        else:
            row = row_of(points[place], table.row_slots)
            for action in range(entries.shape[1]):
                table.values[row, action] = entries[place, action, n_envs + 1]
    traces.n_active[0] = kept
    traces.clock[0] = 1.0
    traces.clock[1:] = 0.0
    rehash(points, kept, traces.active_slots)


@jit
def end_episode(env, table, traces):
    """Drop all traces of an environment."""
    clock = traces.clock
    if len(clock) == 2:
        write_back(table, traces)
        # Remove points in reverse order of insertion, so that no free slot interrupts the probing of another point.
        for place in range(traces.n_active[0] - 1, -1, -1):
            traces.active_slots[_probe(traces.active_points[place], traces.active_slots), 0] = -1
        traces.n_active[0] = 0
        clock[0] = 1.0
    else:
        for place in range(traces.n_active[0]):
            for action in range(traces.active_entries.shape[1]):
                set_trace(traces.active_entries, place, action, env, 0.0, clock)
    clock[1 + env] = 0.0


@jit
def read_rows(points, table, traces, rows):
    """Write the values of points, shape (n,), into ``rows``, shape (n, n_actions), the table's dtype."""
    values, row_slots, initial_value = table.values, table.row_slots, table.initial_value
    entries, slots, clock = traces.active_entries, traces.active_slots, traces.clock
    for i in range(len(points)):
        read_row(points[i], values, row_slots, initial_value, entries, slots, clock, rows[i])
