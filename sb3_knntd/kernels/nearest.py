"""The k nearest points, by (squared distance, index), without and with a list of the points."""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import jit


@jit
def _before(sums, nodes, a, b):
    """Whether node a comes before node b."""
    return sums[a] < sums[b] or (sums[a] == sums[b] and nodes[a, 0] < nodes[b, 0])


@jit
def _sift_down(order, size, sums, nodes):
    """Let the first node of the heap sink to its place."""
    node, position, child = order[0, 0], 0, 1
    while child < size:
        if child + 1 < size and _before(sums, nodes, order[0, child + 1], order[0, child]):
            child += 1
        if not _before(sums, nodes, order[0, child], node):
            break
        order[0, position] = order[0, child]
        position = child
        child = 2 * position + 1
    order[0, position] = node


@jit
def _sift_up(order, position, sums, nodes):
    """Let a node of the heap rise to its place."""
    node = order[0, position]
    while position > 0:
        parent = (position - 1) // 2
        if not _before(sums, nodes, node, order[0, parent]):
            break
        order[0, position] = order[0, parent]
        position = parent
    order[0, position] = node


@jit
def _extend(x, axes, first, end, dimension, ranked, squares, sides):
    """Rank one more coordinate of a dimension: the next nearest of those on either side."""
    filled, below, above = sides[dimension, 0], sides[dimension, 1], sides[dimension, 2]
    down = x - axes[first + below] if below >= 0 else np.inf
    up = axes[first + above] - x if first + above < end else np.inf
    down, up = down * down, up * up
    if down <= up:
        ranked[first + filled], squares[first + filled] = below, down
        sides[dimension, 1] = below - 1
    else:
        ranked[first + filled], squares[first + filled] = above, up
        sides[dimension, 2] = above + 1
    sides[dimension, 0] = filled + 1


@jit
def _blurred(scaled, axes, offsets, total, ranked, squares, sides):
    """
    Whether two coordinates at different distances could give the same sum, of about ``total``, by rounding. If
    not, equal sums have equal terms, of which the lower coordinate is ranked first: what comes out of the heap
    later has a higher index.
    """
    n_dims = len(scaled)
    least = 2.0 * n_dims * 2.3e-16 * total
    for j in range(n_dims):
        first, end = offsets[j], offsets[j + 1]
        for place in range(first + 1, end):
            if place - first >= sides[j, 0]:
                _extend(scaled[j], axes, first, end, j, ranked, squares, sides)
            if squares[place] > total + least:
                break
            difference = squares[place] - squares[place - 1]
            if 0.0 < difference <= least:
                return True
    return False


@jit
def nearest_on_lattice(scaled, axes, offsets, k, indices, distances):
    """
    The k nearest points of a lattice, without visiting the others.

    A squared distance is a sum over the dimensions, so that with each dimension's coordinates ranked by
    distance the points come out of a heap in order: a point is followed by those one rank further in one
    dimension. Rounding keeps sums in that order. Points that tie come out by rising index, unless rounding could have
    made them tie; then all that equal the k-th are taken out before the lower indices among them are chosen. So the
    answer is that of a search over all points.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param axes: the coordinates of every dimension one after the other, each rising
    :param offsets: where each dimension's begin, and the end, shape (obs_dim + 1,), int64
    :param k: number of neighbours, at most the number of points
    :param indices: to be filled, shape (k,), int64
    :param distances: to be filled with squared distances, shape (k,)
    """
    n_dims = len(scaled)
    ranked = np.empty(len(axes), np.int64)
    squares = np.empty(len(axes))
    # Of each dimension: how many coordinates are ranked, the next below and above, and its stride.
    sides = np.empty((n_dims, 4), np.int64)
    # A node is a point: its number, the dimension that was moved along last, and its rank in each. Points are
    # reached by moving along rising dimensions only, so each just once.
    capacity = (k + 8) * n_dims + 1
    nodes = np.empty((capacity, n_dims + 2), np.int64)
    sums = np.empty(capacity)
    # Which nodes are in the heap, and which have been taken out.
    order = np.empty((2, capacity), np.int64)

    stride, number, total = 1, 0, 0.0
    for j in range(n_dims - 1, -1, -1):
        first, end = offsets[j], offsets[j + 1]
        low, high = first, end
        while low < high:
            middle = (low + high) // 2
            if axes[middle] <= scaled[j]:
                low = middle + 1
            else:
                high = middle
        sides[j, 0], sides[j, 1], sides[j, 2], sides[j, 3] = 0, low - first - 1, low - first, stride
        _extend(scaled[j], axes, first, end, j, ranked, squares, sides)
        number += ranked[first] * stride
        nodes[0, 2 + j] = 0
        stride *= end - first
    for j in range(n_dims):
        total += squares[offsets[j]]
    nodes[0, 0], nodes[0, 1], sums[0], order[0, 0] = number, 0, total, 0
    n_nodes, n_heap, n_taken = 1, 1, 0

    while n_heap > 0:
        if n_taken >= k:
            if sums[order[0, 0]] != sums[order[1, n_taken - 1]]:
                break
            if n_taken == k and not _blurred(scaled, axes, offsets, sums[order[0, 0]], ranked, squares, sides):
                break
        node = order[0, 0]
        n_heap -= 1
        order[0, 0] = order[0, n_heap]
        _sift_down(order, n_heap, sums, nodes)
        order[1, n_taken] = node
        n_taken += 1
        if n_nodes + n_dims > capacity:
            nodes = np.concatenate((nodes, np.empty_like(nodes)))
            sums = np.concatenate((sums, np.empty_like(sums)))
            order = np.concatenate((order, np.empty_like(order)), axis=1)
            capacity *= 2
        for j in range(nodes[node, 1], n_dims):
            rank = nodes[node, 2 + j] + 1
            if rank >= offsets[j + 1] - offsets[j]:
                continue
            if rank >= sides[j, 0]:
                _extend(scaled[j], axes, offsets[j], offsets[j + 1], j, ranked, squares, sides)
            # Summed afresh in the dimensions' order: adding the difference would round another way.
            total = 0.0
            for i in range(n_dims):
                nodes[n_nodes, 2 + i] = rank if i == j else nodes[node, 2 + i]
                total += squares[offsets[i] + nodes[n_nodes, 2 + i]]
            place = offsets[j] + rank
            nodes[n_nodes, 0] = nodes[node, 0] + (ranked[place] - ranked[place - 1]) * sides[j, 3]
            nodes[n_nodes, 1] = j
            sums[n_nodes] = total
            order[0, n_heap] = n_nodes
            _sift_up(order, n_heap, sums, nodes)
            n_nodes += 1
            n_heap += 1

    # Taken in order of distance; equals among them not always in order of index.
    for i in range(1, n_taken):
        node = order[1, i]
        place = i
        while place > 0 and _before(sums, nodes, node, order[1, place - 1]):
            order[1, place] = order[1, place - 1]
            place -= 1
        order[1, place] = node
    for i in range(k):
        indices[i] = nodes[order[1, i], 0]
        distances[i] = sums[order[1, i]]


@jit
def nearest_of_all(scaled, columns, k, indices, distances):
    """
    The k nearest points by computing every distance.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param columns: the points' coordinates, scaled units, shape (obs_dim, n_points)
    :param k: number of neighbours, at most the number of points
    :param indices: to be filled, shape (k,), int64
    :param distances: to be filled with squared distances, shape (k,)
    """
    n_dims, n_points = columns.shape
    count = 0
    for point in range(n_points):
        total = 0.0
        for j in range(n_dims):
            difference = scaled[j] - columns[j, point]
            total += difference * difference
        # Points come by rising index: one as far as the last of k full places comes after it.
        if count == k and total >= distances[k - 1]:
            continue
        place = count if count < k else k - 1
        while place > 0 and distances[place - 1] > total:
            distances[place] = distances[place - 1]
            indices[place] = indices[place - 1]
            place -= 1
        distances[place] = total
        indices[place] = point
        if count < k:
            count += 1


@jit
def nearest_on_lattice_batch(scaled, axes, offsets, k, indices, distances):
    """:func:`nearest_on_lattice` for each row of ``scaled``, shape (batch, obs_dim)."""
    for row in range(len(scaled)):
        nearest_on_lattice(scaled[row], axes, offsets, k, indices[row], distances[row])


@jit
def order_candidates(scaled, places, candidates, indices, distances):
    """
    The first k of some candidates by (squared distance, index), for each of a batch.

    :param scaled: observations, scaled units, shape (batch, obs_dim)
    :param places: the points' coordinates, scaled units, shape (n_points, obs_dim)
    :param candidates: points, at least k, shape (batch, n), int64
    :param indices: to be filled, shape (batch, k), int64
    :param distances: to be filled with squared distances, shape (batch, k)
    """
    n_dims, k = places.shape[1], indices.shape[1]
    for row in range(len(scaled)):
        for count in range(candidates.shape[1]):
            point = candidates[row, count]
            total = 0.0
            for j in range(n_dims):
                difference = scaled[row, j] - places[point, j]
                total += difference * difference
            place = min(count, k)
            while place > 0 and (
                distances[row, place - 1] > total
                or (distances[row, place - 1] == total and indices[row, place - 1] > point)
            ):
                if place < k:
                    distances[row, place] = distances[row, place - 1]
                    indices[row, place] = indices[row, place - 1]
                place -= 1
            if place < k:
                distances[row, place] = total
                indices[row, place] = point
