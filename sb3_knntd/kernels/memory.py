"""
The table and its traces.

Eligibility traces need not touch the table. Q += α δ e and e *= γ λ over all entries equal one running sum:
with c the product of the decays so far and G = Σ α δ c, an entry whose trace was set to e at c₀ has gained
(e/c₀)(G - G₀) since (Wiering and Schmidhuber, Fast online Q(λ), 1998). The points with a trace are the *live*
ones. Of each of their entries the store holds x = e/c₀ for every environment and a base, so that

    Q = base + share · Σ_env x G,    share = max_env x / Σ_env x

where share makes the errors of several environments a mean (all traces decay alike, so it changes only when
one is set). A step costs O(k · n_actions), whatever λ, the episode's length and the size of the table.

The arrays, as far as a function takes them:

values       the table, (n_rows, n_actions)
visited      which rows have been learned at, a bit each, uint8; empty if every row there is has been
row_points   the point of each row, (n_rows,), int64
row_slots    hash of the rows by point; empty if the points are the rows
initial      value of a point without a row
live_points  the live points, (capacity,), int64
live         their entries, (capacity, n_actions, n_envs + 2): x of each environment, share, base
live_slots   hash of the live points' places
counts       (number of rows made, number of live points), int64
pace         (c, G of each environment), (1 + n_envs,)

A hash is an array (size, 2), int64, of points and places, filled by linear probing; its size is a power of two,
and a point of -1 marks a free slot. Functions take arrays and no tuples of them: numba counts references to each
array it unpacks, at more cost than the arithmetic.
"""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import inlined, jit

#: A trace below this has no weight in a float64 that the trace above it moves; it is let go.
LEAST_TRACE = 1e-18
#: When c falls below this, all debts are paid and c starts at 1: x grows as 1/c, and digits are lost with it.
LEAST_CLOCK = 1e-4


@inlined
def _probe(point, slots):
    """The slot of a point, or the free one where it belongs."""
    mask = len(slots) - 1
    mixed = np.uint64(point) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(mask))
    while slots[slot, 0] != point and slots[slot, 0] != -1:
        slot = (slot + 1) & mask
    return slot


@inlined
def find(point, slots):
    """The place of a point, -1 if it has none."""
    slot = _probe(point, slots)
    return slots[slot, 1] if slots[slot, 0] == point else -1


@jit
def insert(point, place, slots):
    """Give a point a place."""
    slot = _probe(point, slots)
    slots[slot, 0] = point
    slots[slot, 1] = place


@jit
def rehash(points, count, slots):
    """Make a hash of the places of the first ``count`` points."""
    slots[:, 0] = -1
    for place in range(count):
        insert(points[place], place, slots)


@inlined
def row_of(point, row_slots):
    """Row of a point in the table, -1 if it has none yet."""
    return point if len(row_slots) == 0 else find(point, row_slots)


@inlined
def total(live, place, action, pace):
    """Value of a live entry."""
    n_envs = len(pace) - 1
    if n_envs == 1:
        return live[place, action, 2] + live[place, action, 0] * pace[1]
    gained = 0.0
    for env in range(n_envs):
        gained += live[place, action, env] * pace[1 + env]
    return live[place, action, n_envs + 1] + live[place, action, n_envs] * gained


@inlined
def read_live_row(live, place, pace, row):
    """Write the values of a live point's actions into ``row``, shape (n_actions,)."""
    if len(pace) == 2:
        entries, gained = live[place], pace[1]
        for action in range(len(row)):
            row[action] = entries[action, 2] + entries[action, 0] * gained
    else:
        for action in range(len(row)):
            row[action] = total(live, place, action, pace)


@inlined
def read_stored_row(point, values, row_slots, initial, row):
    """Write the values of a point's actions into ``row``, shape (n_actions,), from the table alone."""
    place = row_of(point, row_slots)
    if place >= 0:
        for action in range(len(row)):
            row[action] = values[place, action]
    else:
        for action in range(len(row)):
            row[action] = initial


@jit
def enliven(point, values, visited, row_points, row_slots, live_points, live, live_slots, counts):
    """Make a live place for a point that has none, and with it a row of the table if it has none either."""
    row = row_of(point, row_slots)
    if row < 0:
        row = counts[0]
        counts[0] += 1
        row_points[row] = point
        insert(point, row, row_slots)
    elif len(visited) > 0:
        visited[row >> 3] |= np.uint8(1 << (row & 7))
    place = counts[1]
    counts[1] += 1
    live_points[place] = point
    n_envs = live.shape[2] - 2
    for action in range(live.shape[1]):
        for env in range(n_envs):
            live[place, action, env] = 0.0
        live[place, action, n_envs] = 1.0
        live[place, action, n_envs + 1] = values[row, action]
    insert(point, place, live_slots)
    return place


@inlined
def set_trace(live, place, action, env, trace, pace):
    """Set x of a live entry; its value stays what it is."""
    n_envs = len(pace) - 1
    if n_envs == 1:
        live[place, action, 2] += (live[place, action, 0] - trace) * pace[1]
        live[place, action, 0] = trace
    elif live[place, action, env] != trace:
        value = total(live, place, action, pace)
        live[place, action, env] = trace
        _reshare(live, place, action)
        live[place, action, n_envs + 1] = 0.0
        live[place, action, n_envs + 1] = value - total(live, place, action, pace)


@jit
def _reshare(live, place, action):
    n_envs = live.shape[2] - 2
    largest, together = 0.0, 0.0
    for env in range(n_envs):
        largest = max(largest, live[place, action, env])
        together += live[place, action, env]
    live[place, action, n_envs] = largest / together if together > 0.0 else 1.0


@jit
def publish(values, row_slots, live_points, live, counts, pace):
    """Write the values of all live points into the table, for others to read. Nothing else changes."""
    for place in range(counts[1]):
        row = row_of(live_points[place], row_slots)
        for action in range(live.shape[1]):
            values[row, action] = total(live, place, action, pace)


@jit
def _pay(live, place, pace):
    """Bring the bases of a live point up to date and its x to what they are with c = 1; whether a trace is left."""
    n_envs, alive = len(pace) - 1, False
    if n_envs == 1:
        entries, clock, gained = live[place], pace[0], pace[1]
        for action in range(len(entries)):
            entries[action, 2] += entries[action, 0] * gained
            trace = entries[action, 0] * clock
            entries[action, 0] = trace if trace >= LEAST_TRACE else 0.0
            alive |= trace >= LEAST_TRACE
        return alive
    for action in range(live.shape[1]):
        live[place, action, n_envs + 1] = total(live, place, action, pace)
        lost = False
        for env in range(n_envs):
            trace = live[place, action, env] * pace[0]
            if trace < LEAST_TRACE:
                lost = lost or trace > 0.0
                trace = 0.0
            else:
                alive = True
            live[place, action, env] = trace
        if lost:
            _reshare(live, place, action)
    return alive


@jit
def settle(values, row_slots, live_points, live, live_slots, counts, pace):
    """Pay all debts, let go what has no trace left, and start c and G afresh."""
    n_envs = len(pace) - 1
    kept = 0
    for place in range(counts[1]):
        if _pay(live, place, pace):
            if kept < place:
                live_points[kept] = live_points[place]
                live[kept] = live[place]
            kept += 1
        else:
            row = row_of(live_points[place], row_slots)
            for action in range(live.shape[1]):
                values[row, action] = live[place, action, n_envs + 1]
    counts[1] = kept
    pace[0] = 1.0
    pace[1:] = 0.0
    rehash(live_points, kept, live_slots)


@jit
def end_episode(env, values, row_slots, live_points, live, live_slots, counts, pace):
    """Let go all traces of an environment."""
    if len(pace) == 2:
        publish(values, row_slots, live_points, live, counts, pace)
        # The last inserted first, so that no free slot cuts off the way to one still to be found.
        for place in range(counts[1] - 1, -1, -1):
            live_slots[_probe(live_points[place], live_slots), 0] = -1
        counts[1] = 0
        pace[0] = 1.0
    else:
        for place in range(counts[1]):
            for action in range(live.shape[1]):
                set_trace(live, place, action, env, 0.0, pace)
    pace[1 + env] = 0.0


@jit
def find_rows(points, row_slots, rows):
    """Write the row of each point into ``rows``, -1 where there is none; both of shape (n,)."""
    for i in range(len(points)):
        rows[i] = row_of(points[i], row_slots)
