"""Search for the k nearest points, ordered by (squared distance, index)."""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import jit


@jit
def _next_coordinate(x, axes, below, above, first, end):
    """
    Find the nearer of the next coordinates below and above x; at equal distance, the lower one.

    :param x: value in one dimension, scaled units
    :param axes: see :func:`nearest_on_lattice`
    :param below: index of the next coordinate below; there is none if it is less than ``first``
    :param above: index of the next coordinate above; there is none if it is ``end``
    :param first: index of the first coordinate of the dimension
    :param end: index after its last coordinate
    :return: the index of the nearer one, and its squared distance
    """
    down = x - axes[below] if below >= first else np.inf
    up = axes[above] - x if above < end else np.inf
    down, up = down * down, up * up
    return (below, down) if down <= up else (above, up)


@jit
def _coordinates_up_to(x, axes, first, end):
    """Count the coordinates of a dimension that are at most x."""
    low, high = first, end
    while low < high:
        middle = (low + high) // 2
        if axes[middle] <= x:
            low = middle + 1
        else:
            high = middle
    return low - first


@jit
def _left_out(x, axes, first, end, before, numbers_before, filled, sums, numbers, count, blur):
    """
    Whether a sum that was left out of a list could be as good as one of the list. Either it comes before the last one
    by (sum, index), which it can where rounding has made sums equal. Or one of the list is so little below it that a
    later sum could round both to the same.

    :param x: value in the last dimension of the list, scaled units
    :param axes: see :func:`nearest_on_lattice`
    :param first: index of the first coordinate of the dimension
    :param end: index after its last coordinate
    :param before: sums of the list of the dimensions before, ascending
    :param numbers_before: indices of that list
    :param filled: its length
    :param sums: the list, ascending
    :param numbers: indices of the list
    :param count: length of the list
    :param blur: largest difference that rounding can undo; 0 in the last dimension
    """
    size, n_up_to_last = end - first, 0
    last, number, place = sums[count - 1], numbers[count - 1], count - 1
    while place > 0 and sums[place] == last:
        place -= 1
    close = last - blur <= sums[place] < last
    above = first + _coordinates_up_to(x, axes, first, end)
    below = above - 1
    while below >= first or above < end:
        coordinate, square = _next_coordinate(x, axes, below, above, first, end)
        if before[0] + square > last + blur:
            break
        for place in range(filled):
            total = before[place] + square
            if total > last + blur:
                break
            listed = total < last or numbers_before[place] * size + coordinate - first <= number
            if total > last or (close and not listed):
                return True
            n_up_to_last += listed
        if coordinate == below:
            below -= 1
        else:
            above += 1
    return n_up_to_last > count


@jit
def _first_on_lattice(scaled, axes, offsets, count, blur):
    """
    Find the ``count`` points with the smallest squared distances.

    The list of the nearest points in the first dimensions is extended by one dimension after the other. Each coordinate
    of the new dimension, by ascending distance, gives a row: the list with the squared distance of that coordinate
    added. Each row is sorted; the rows are merged. No element of a row is less than the first of the row before, so a
    row is opened only when the first element of the last one has been taken.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param axes: see :func:`nearest_on_lattice`
    :param offsets: see :func:`nearest_on_lattice`
    :param count: number of points to find, at most the number of points of the lattice
    :param blur: largest difference between sums that rounding can undo; negative if it is not to be looked for
    :return: squared distances and indices, by (distance, index) but for rounding, shape (count,) each, and whether
        rounding may have left out a point that ties with one of them, see :func:`_left_out`
    """
    # The new and the old list. For each row: the squared distance of its coordinate, its next sum, its coordinate, and
    # its position in the old list.
    floats, integers = np.empty((4, count)), np.empty((4, count), np.int64)
    sums, before, squares, nexts = floats[0], floats[1], floats[2], floats[3]
    numbers, numbers_before, coordinates, places = integers[0], integers[1], integers[2], integers[3]
    sums[0], numbers[0], filled, blurred = 0.0, 0, 1, False
    for j in range(len(scaled)):
        first, end = offsets[j], offsets[j + 1]
        size, x = end - first, scaled[j]
        sums, before, numbers, numbers_before = before, sums, numbers_before, numbers
        above = first + _coordinates_up_to(x, axes, first, end)
        below = above - 1
        # Rows before ``opened`` are exhausted. Rows from ``n_rows`` on are not opened yet.
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
            # Where rounding makes sums equal, a lower index can come later.
            while place > 0 and sums[place - 1] == total and numbers[place - 1] > number:
                sums[place], numbers[place] = total, numbers[place - 1]
                place -= 1
            sums[place], numbers[place] = total, number
            newest = row == n_rows - 1 and places[row] == 0
            places[row] += 1
            nexts[row] = before[places[row]] + squares[row] if places[row] < filled else np.inf
            while opened < n_rows and places[opened] == filled:
                opened += 1
        if blur >= 0.0 and not blurred and n_merged < filled * size:
            near = blur if j < len(scaled) - 1 else 0.0
            blurred = _left_out(x, axes, first, end, before, numbers_before, filled, sums, numbers, n_merged, near)
        filled = n_merged
    return sums, numbers, blurred


@jit
def nearest_on_lattice(scaled, axes, offsets, k, indices, distances):
    """
    Find the k nearest points of a lattice without computing the distances to all.

    A squared distance is a sum over the dimensions. A point is not among the k nearest if k others are at least as near
    in each dimension. So a list of k points is enough from one dimension to the next; rounding preserves the order of
    sums. Ties are in the order of the indices, unless rounding could have caused them: then all points that tie with
    the k-th are compared. The result is that of a search over all points.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param axes: the coordinates of all dimensions, concatenated, ascending in each, scaled units
    :param offsets: index of the first coordinate of each dimension, and the total number, shape (obs_dim + 1,), int64
    :param k: number of neighbours, at most the number of points
    :param indices: output, shape (k,), int64
    :param distances: output, squared distances, shape (k,)
    """
    n_points = 1
    for j in range(len(scaled)):
        n_points *= offsets[j + 1] - offsets[j]
    # One more point shows whether the k-th is tied.
    count = min(k + 1, n_points)
    sums, numbers, blurred = _first_on_lattice(scaled, axes, offsets, count, -1.0)
    if count > k and sums[k] == sums[k - 1]:
        blur = 2.0 * len(scaled) * 2.3e-16 * sums[k]
        sums, numbers, blurred = _first_on_lattice(scaled, axes, offsets, count, blur)
        while blurred and count < n_points and sums[count - 1] == sums[k - 1]:
            count = min(2 * count, n_points)
            sums, numbers, _ = _first_on_lattice(scaled, axes, offsets, count, -1.0)
    for i in range(k):
        indices[i] = numbers[i]
        distances[i] = sums[i]


@jit
def nearest_of_all(scaled, columns, k, indices, distances):
    """
    Find the k nearest points by computing all distances.

    :param scaled: observation, scaled units, shape (obs_dim,)
    :param columns: the points' coordinates, scaled units, shape (obs_dim, n_points)
    :param k: number of neighbours, at most the number of points
    :param indices: output, shape (k,), int64
    :param distances: output, squared distances, shape (k,)
    """
    n_dims, n_points = columns.shape
    count = 0
    for point in range(n_points):
        total = 0.0
        for j in range(n_dims):
            difference = scaled[j] - columns[j, point]
            total += difference * difference
        # Indices ascend: a point at the distance of the k-th comes after it.
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
def thin_out(scaled, squared_spacing, chosen, owners):
    """
    Choose points that are further apart than a spacing. In their order, each is chosen unless one chosen before lies
    within the spacing.

    :param scaled: coordinates of the points, scaled units, shape (n_points, obs_dim)
    :param squared_spacing: square of the spacing, scaled units
    :param chosen: output, the chosen points in their order, shape (n_points,), int64; the rest is unused
    :param owners: output, for each point the place in ``chosen`` of the chosen point nearest to it, at equal distance
        the first, shape (n_points,), int64
    :return: number of chosen points
    """
    n_points, n_dims = scaled.shape
    n_chosen = 0
    for point in range(n_points):
        near = False
        for number in range(n_chosen):
            total = 0.0
            for j in range(n_dims):
                difference = scaled[point, j] - scaled[chosen[number], j]
                total += difference * difference
            if total <= squared_spacing:
                near = True
                break
        if not near:
            chosen[n_chosen] = point
            n_chosen += 1
    for point in range(n_points):
        nearest = np.inf
        for number in range(n_chosen):
            total = 0.0
            for j in range(n_dims):
                difference = scaled[point, j] - scaled[chosen[number], j]
                total += difference * difference
            if total < nearest:
                nearest = total
                owners[point] = number
    return n_chosen


@jit
def nearest_on_lattice_batch(scaled, axes, offsets, k, indices, distances):
    """:func:`nearest_on_lattice` for each row of ``scaled``, shape (batch, obs_dim)."""
    for row in range(len(scaled)):
        nearest_on_lattice(scaled[row], axes, offsets, k, indices[row], distances[row])


@jit
def order_candidates(scaled, places, candidates, indices, distances):
    """
    Order candidates by (squared distance, index) and take the first k, for a batch of observations.

    :param scaled: observations, scaled units, shape (batch, obs_dim)
    :param places: the points' coordinates, scaled units, shape (n_points, obs_dim)
    :param candidates: indices of points, at least k, shape (batch, n), int64
    :param indices: output, shape (batch, k), int64
    :param distances: output, squared distances, shape (batch, k)
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
