"""The k nearest points, by (squared distance, index), without and with a list of the points."""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import jit


@jit
def _next_coordinate(x, axes, below, above, first, end):
    """
    Which of the next coordinates on either side of x is nearer, the lower of equals, and the square of how far it is.

    :param below: the next one down; none if it is less than ``first``
    :param above: the next one up; none if it is ``end``
    """
    down = x - axes[below] if below >= first else np.inf
    up = axes[above] - x if above < end else np.inf
    down, up = down * down, up * up
    return (below, down) if down <= up else (above, up)


@jit
def _coordinates_up_to(x, axes, first, end):
    """How many of a dimension's coordinates are at most x."""
    low, high = first, end
    while low < high:
        middle = (low + high) // 2
        if axes[middle] <= x:
            low = middle + 1
        else:
            high = middle
    return low - first


@jit
def _first_on_lattice(scaled, axes, offsets, count):
    """
    The ``count`` smallest sums of squares, one for each dimension, and the numbers of their points.

    Dimension by dimension, a list of the first points in the dimensions so far becomes one with the next dimension.
    Each coordinate of that, by rising distance, makes a row: the list with the coordinate's square added. The rows are
    merged, none of which can come to its turn before the last one's first has.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param axes: the coordinates of every dimension one after the other, each rising
    :param offsets: where each dimension's begin, and the end, shape (obs_dim + 1,), int64
    :param count: how many, at most the number of points
    :return: sums and numbers, in their order, of shape (count,) each
    """
    # The list as it was and as it becomes; and of each row its square and the sum that it has next, its coordinate and
    # where in the list it is.
    floats, integers = np.empty((4, count)), np.empty((4, count), np.int64)
    sums, before, squares, nexts = floats[0], floats[1], floats[2], floats[3]
    numbers, numbers_before, coordinates, places = integers[0], integers[1], integers[2], integers[3]
    sums[0], numbers[0], filled = 0.0, 0, 1
    for j in range(len(scaled)):
        first, end = offsets[j], offsets[j + 1]
        size, x = end - first, scaled[j]
        sums, before, numbers, numbers_before = before, sums, numbers_before, numbers
        above = first + _coordinates_up_to(x, axes, first, end)
        below = above - 1
        # Rows from ``opened`` to before ``n_rows`` have begun and are not at their end.
        opened, n_rows, newest = 0, 0, True
        n_merged = min(count, filled * size)
        for i in range(n_merged):
            if newest and n_rows < size:
                coordinate, square = _next_coordinate(x, axes, below, above, first, end)
                if coordinate == below:
                    below -= 1
                else:
                    above += 1
                squares[n_rows], coordinates[n_rows], places[n_rows] = square, coordinate - first, 0
                nexts[n_rows] = before[0] + square
                n_rows += 1
            row, number = opened, numbers_before[places[opened]] * size + coordinates[opened]
            for other in range(opened + 1, n_rows):
                if nexts[other] <= nexts[row]:
                    others = numbers_before[places[other]] * size + coordinates[other]
                    if nexts[other] < nexts[row] or others < number:
                        row, number = other, others
            total, place = nexts[row], i
            # Where rounding has made a tie, a lower number can come late.
            while place > 0 and sums[place - 1] == total and numbers[place - 1] > number:
                sums[place], numbers[place] = total, numbers[place - 1]
                place -= 1
            sums[place], numbers[place] = total, number
            newest = row == n_rows - 1 and places[row] == 0
            places[row] += 1
            nexts[row] = before[places[row]] + squares[row] if places[row] < filled else np.inf
            while opened < n_rows and places[opened] == filled:
                opened += 1
        filled = n_merged
    return sums, numbers


@jit
def _blurred(scaled, axes, offsets, total):
    """
    Whether two coordinates at different distances could give the same sum, of about ``total``, by rounding. If
    not, equal sums have equal terms, and of equals the lower coordinate comes first.
    """
    least = 2.0 * len(scaled) * 2.3e-16 * total
    for j in range(len(scaled)):
        first, end = offsets[j], offsets[j + 1]
        above = first + _coordinates_up_to(scaled[j], axes, first, end)
        below, before = above - 1, -np.inf
        while below >= first or above < end:
            coordinate, square = _next_coordinate(scaled[j], axes, below, above, first, end)
            if square > total + least:
                break
            if 0.0 < square - before <= least:
                return True
            before = square
            if coordinate == below:
                below -= 1
            else:
                above += 1
    return False


@jit
def nearest_on_lattice(scaled, axes, offsets, k, indices, distances):
    """
    The k nearest points of a lattice, without visiting the others.

    A squared distance is a sum over the dimensions, and a point of which k others are at least as near in every
    dimension is not among the first. So a list of k is enough to go from dimension to dimension; rounding keeps sums in
    order. Points that tie are in order of index, unless rounding could have made them tie; then as many are looked
    at as equal the k-th. So the answer is that of a search over all points.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param axes: the coordinates of every dimension one after the other, each rising
    :param offsets: where each dimension's begin, and the end, shape (obs_dim + 1,), int64
    :param k: number of neighbours, at most the number of points
    :param indices: to be filled, shape (k,), int64
    :param distances: to be filled with squared distances, shape (k,)
    """
    n_points = 1
    for j in range(len(scaled)):
        n_points *= offsets[j + 1] - offsets[j]
    # One more tells whether the last has equals.
    count = min(k + 1, n_points)
    sums, numbers = _first_on_lattice(scaled, axes, offsets, count)
    if count > k and sums[k] == sums[k - 1] and _blurred(scaled, axes, offsets, sums[k]):
        while count < n_points and sums[count - 1] == sums[k - 1]:
            count = min(2 * count, n_points)
            sums, numbers = _first_on_lattice(scaled, axes, offsets, count)
    for i in range(k):
        indices[i] = numbers[i]
        distances[i] = sums[i]


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
