"""The C code of policies: templates for :class:`string.Template`, which :mod:`sb3_knntd.export.c99` fills in."""

from __future__ import annotations

HEADER = """\
/*
 * The greedy policy of a table of action values at $n_points points, read at the $k nearest.
 * Written by sb3-knntd $version.
 *
 * Observation: $observation, in the units that the policy was trained with. The points are laid over
$ranges
 * Numbers outside of it are accepted: the points nearest to them decide. NaN counts as far below.
 *
 * Action: $action
 *
 * Table: $n_rows of $n_points rows of $n_columns $real, $size. There is no heap; the stack holds some $stack.
 * To get the actions of predict to the last digit, compile it without contracting a * b + c: -ffp-contract=off.
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

typedef $real ${name}_real;

#define ${NAME}_OBSERVATION_SIZE $obs_dim
#define ${NAME}_N_VALUES $n_columns
$action_size
/* $action_comment */
$action_function;

/* $values_comment */
void ${name}_q_values(const ${name}_real observation[${NAME}_OBSERVATION_SIZE],
$indent${name}_real values[${NAME}_N_VALUES]);

#ifdef __cplusplus
}
#endif

#endif
"""

SOURCE = """\
/* Written by sb3-knntd $version: see the header. */
#include "$header"

#include <math.h>

#define OBS_DIM $obs_dim
#define N_NEIGHBORS $k
#define N_COLUMNS $n_columns
#define N_ROWS $n_rows

typedef ${name}_real real;
/* The number of a point. */
typedef $index point_t;

static const real low[OBS_DIM] = {$low};
static const real width[OBS_DIM] = {$width};
$geometry
$table
static void scale(const real *observation, real *scaled)
{
    int j;
    for (j = 0; j < OBS_DIM; ++j) {
        real x = $two * ((observation[j] - low[j]) / width[j]) - $one;
        if (!(x > -$limit))
            x = -$limit;
        if (x > $limit)
            x = $limit;
        scaled[j] = x;
    }
}
$search
$row_at
/* The rows of the nearest points, and their weights, whose sum is 1. */
static void perceive(const real *observation, const real **rows, real *weights)
{
    real scaled[OBS_DIM], total = $zero;
    point_t points[N_NEIGHBORS];
    int i;
    scale(observation, scaled);
    find_nearest(scaled, points, weights);
$nearest
    for (i = 0; i < N_NEIGHBORS; ++i) {
        const real square = weights[i];
        weights[i] = $weight;
        total += weights[i];
        rows[i] = row_at(points[i]);
    }
    for (i = 0; i < N_NEIGHBORS; ++i)
        weights[i] /= total;
}

$rules
/* The column from first to end - 1 with the largest value, the first of equal ones$allowed_only. */
static int best_column(const real *values, int first, int end$forbidden_parameter)
{
    int column, best = first;
    for (column = first + 1; column < end; ++column)
        if ($better)
            best = column;
    return best;
}

void ${name}_q_values(const real observation[OBS_DIM], real values[N_COLUMNS])
{
    const real *rows[N_NEIGHBORS];
    real weights[N_NEIGHBORS];
    int i, column;
    perceive(observation, rows, weights);
    for (column = 0; column < N_COLUMNS; ++column)
        values[column] = $zero;
    for (i = 0; i < N_NEIGHBORS; ++i)
        for (column = 0; column < N_COLUMNS; ++column)
            values[column] += weights[i] * rows[i][column];
}
$act"""

LATTICE = """
/* The number of points in each dimension, and of those that differ in later dimensions only. */
static const point_t size[OBS_DIM] = {$sizes};
static const point_t stride[OBS_DIM] = {$strides};
static const real spacing[OBS_DIM] = {$spacings};
"""

SCATTERED = """
#define N_POINTS $n_points

static const real places[N_POINTS][OBS_DIM] = {
$places
};
"""

SEARCH_LATTICE = """
static real coordinate(int j, point_t i)
{
    if (size[j] == 1)
        return $zero;
    return i == size[j] - 1 ? $one : (real)i * spacing[j] - $one;
}

/* The last coordinate of a dimension that is at most x; -1 if there is none. */
static point_t last_up_to(int j, real x)
{
    point_t i;
    if (x < coordinate(j, 0))
        return -1;
    if (x >= coordinate(j, size[j] - 1))
        return size[j] - 1;
    i = (point_t)((x + $one) / spacing[j]);
    if (i > size[j] - 1)
        i = size[j] - 1;
    while (i > 0 && coordinate(j, i) > x)
        --i;
    while (i < size[j] - 1 && coordinate(j, i + 1) <= x)
        ++i;
    return i;
}

/* The next coordinate by distance from x, the lower one of equal ones, and its squared distance; -1 after the last. */
static point_t next_coordinate(int j, real x, point_t *below, point_t *above, real *square)
{
    real down = $zero, up = $zero;
    if (*below < 0 && *above >= size[j])
        return -1;
    if (*below >= 0)
        down = x - coordinate(j, *below);
    if (*above < size[j])
        up = coordinate(j, *above) - x;
    down *= down;
    up *= up;
    if (*above >= size[j] || (*below >= 0 && down <= up)) {
        *square = down;
        return (*below)--;
    }
    *square = up;
    return (*above)++;
}

/* The nearest points and their squared distances, by (squared distance, number). Coordinates are chosen in one
 * dimension after the other, in each by ascending distance. Rounded sums keep the order of their terms, so no point
 * with the coordinates chosen so far is nearer than the bound. */
static void find_nearest(const real *scaled, point_t *points, real *squares)
{
    point_t first[OBS_DIM], below[OBS_DIM], above[OBS_DIM], numbers[OBS_DIM];
    real least[OBS_DIM], sums[OBS_DIM];
    int j, place;
    for (place = 0; place < N_NEIGHBORS; ++place) {
        points[place] = 0;
        squares[place] = $far;
    }
    for (j = 0; j < OBS_DIM; ++j) {
        first[j] = last_up_to(j, scaled[j]);
        below[j] = first[j];
        above[j] = first[j] + 1;
        next_coordinate(j, scaled[j], &below[j], &above[j], &least[j]);
    }
    j = 0;
    below[0] = first[0];
    above[0] = first[0] + 1;
    sums[0] = $zero;
    numbers[0] = 0;
    while (j >= 0) {
        real square = $zero, sum, bound;
        point_t number;
        int later;
        const point_t i = next_coordinate(j, scaled[j], &below[j], &above[j], &square);
        if (i < 0) {
            --j;
            continue;
        }
        sum = sums[j] + square;
        number = numbers[j] * size[j] + i;
        bound = sum;
        for (later = j + 1; later < OBS_DIM; ++later)
            bound += least[later];
        if (bound > squares[N_NEIGHBORS - 1]) {
            --j;
            continue;
        }
        if (bound == squares[N_NEIGHBORS - 1] && number > points[N_NEIGHBORS - 1] / stride[j])
            continue;
        if (j < OBS_DIM - 1) {
            ++j;
            below[j] = first[j];
            above[j] = first[j] + 1;
            sums[j] = sum;
            numbers[j] = number;
            continue;
        }
        place = N_NEIGHBORS - 1;
        while (place > 0 && (squares[place - 1] > sum || (squares[place - 1] == sum && points[place - 1] > number))) {
            squares[place] = squares[place - 1];
            points[place] = points[place - 1];
            --place;
        }
        squares[place] = sum;
        points[place] = number;
    }
}
"""

SEARCH_SCATTERED = """
/* The nearest points and their squared distances, by (squared distance, number). */
static void find_nearest(const real *scaled, point_t *points, real *squares)
{
    point_t point;
    int place;
    for (place = 0; place < N_NEIGHBORS; ++place) {
        points[place] = 0;
        squares[place] = $far;
    }
    for (point = 0; point < N_POINTS; ++point) {
        real sum = $zero;
        int j;
        for (j = 0; j < OBS_DIM; ++j) {
            const real difference = scaled[j] - places[point][j];
            sum += difference * difference;
        }
        if (sum >= squares[N_NEIGHBORS - 1])
            continue;
        place = N_NEIGHBORS - 1;
        while (place > 0 && squares[place - 1] > sum) {
            squares[place] = squares[place - 1];
            points[place] = points[place - 1];
            --place;
        }
        squares[place] = sum;
        points[place] = point;
    }
}
"""

TABLE = """
static const real table[N_ROWS][N_COLUMNS] = {
$values
};
"""

ROW_OF_ALL = """
static const real *row_at(point_t point)
{
    return table[point];
}
"""

NUMBERS = """
/* The point of each row, and the row of all other points. */
static const point_t row_points[N_ROWS] = {
$row_points
};
static const real other_row[N_COLUMNS] = {
$other_row
};
"""

ROW_OF_SOME = """
static const real *row_at(point_t point)
{
    long first = 0, end = N_ROWS;
    while (first < end) {
        const long middle = first + (end - first) / 2;
        if (row_points[middle] < point)
            first = middle + 1;
        else
            end = middle;
    }
    return first < N_ROWS && row_points[first] == point ? table[first] : other_row;
}
"""

ACT_DISCRETE = """
int ${name}_action(const real observation[OBS_DIM])
{
    real values[N_COLUMNS];
    $find_forbidden
    ${name}_q_values(observation, values);
    return ${first_action}best_column(values, 0, N_COLUMNS$forbidden);
}
"""

ACTION_POINTS = """
#define ACTION_SIZE $n_actions

/* The action of each column. */
static const real action_points[N_COLUMNS][ACTION_SIZE] = {
$action_points
};
static const real lowest[ACTION_SIZE] = {$lowest};
static const real highest[ACTION_SIZE] = {$highest};
"""

#: What precedes the clipping of ``action``: the action of the best column, or the mean of those of the neighbours.
OF_VALUES = """
    real values[N_COLUMNS];
    int j, best;
    $find_forbidden
    ${name}_q_values(observation, values);
    best = best_column(values, 0, N_COLUMNS$forbidden);
    for (j = 0; j < ACTION_SIZE; ++j)
        action[j] = action_points[best][j]$peak;
"""

OF_ACTIONS = """
    static const int factors[N_FACTORS + 1] = {$factors};
    const real *rows[N_NEIGHBORS];
    real weights[N_NEIGHBORS];
    int i, j, factor;
    $find_forbidden
    perceive(observation, rows, weights);
    for (j = 0; j < ACTION_SIZE; ++j)
        action[j] = $zero;
    for (i = 0; i < N_NEIGHBORS; ++i) {
        real selected[ACTION_SIZE] = {$zero};
        for (factor = 0; factor < N_FACTORS; ++factor) {
            const int best = best_column(rows[i], factors[factor], factors[factor + 1]$forbidden);
            for (j = 0; j < ACTION_SIZE; ++j)
                selected[j] += action_points[best][j];
        }
        for (j = 0; j < ACTION_SIZE; ++j)
            action[j] += weights[i] * selected[j];
    }
"""

PEAK = """
/* The number of action points in each dimension, and of columns from one to the next. */
static const int n_points_of[ACTION_SIZE] = {$counts};
static const int step_of[ACTION_SIZE] = {$steps};

/* How far the peak of the parabola through the values of an action point and of those next to it in dimension j is from
 * it, at most half of the way to the next; 0 where there is no peak. */
static real peak_offset(const real *values, int best, int j$forbidden_parameter)
{
    const int step = step_of[j], place = best / step % n_points_of[j];
    const int below = best - step, above = best + step;
    real left, right, slope_left, slope_right, curvature, offset, magnitude;
    if (place == 0 || place == n_points_of[j] - 1$forbidden_beside)
        return $zero;
    left = action_points[best][j] - action_points[below][j];
    right = action_points[above][j] - action_points[best][j];
    slope_left = (values[best] - values[below]) / left;
    slope_right = (values[above] - values[best]) / right;
    curvature = (slope_right - slope_left) / (left + right);
    magnitude = fabs$f(values[best]) > $one ? fabs$f(values[best]) : $one;
    if (!(curvature * ((left + right) * (left + right)) < -$least * magnitude))
        return $zero;
    offset = -$half * ((slope_left * right + slope_right * left) / (left + right)) / curvature;
    if (offset > $half * right)
        return $half * right;
    return offset > -$half * left ? offset : -$half * left;
}
"""

#: What else lets an action point have no peak, with rules.
FORBIDDEN_BESIDE = " || forbidden[below] || forbidden[above]"

ACT_BOX = """
$n_factors
$scope ${function}(const real observation[OBS_DIM], real action[ACTION_SIZE])
{$choice
    for (j = 0; j < ACTION_SIZE; ++j) {
$rounding        if (action[j] < lowest[j])
            action[j] = lowest[j];
        if (action[j] > highest[j])
            action[j] = highest[j];
    }
}
"""

ACT_SINGLE = """
real ${name}_action(const real observation[OBS_DIM])
{
    real action[ACTION_SIZE];
    act(observation, action);
    return action[0];
}
"""

RULES = """
#define N_RULES $n_rules

/* Where columns are forbidden: from these observations, to these, and which. */
static const real rule_low[N_RULES][OBS_DIM] = {
$rule_low
};
static const real rule_high[N_RULES][OBS_DIM] = {
$rule_high
};
static const unsigned char rule_columns[N_RULES][N_COLUMNS] = {
$rule_columns
};

static void find_forbidden(const real *observation, unsigned char *forbidden)
{
    int rule, j, column;
    for (column = 0; column < N_COLUMNS; ++column)
        forbidden[column] = 0;
    for (rule = 0; rule < N_RULES; ++rule) {
        int inside = 1;
        for (j = 0; j < OBS_DIM; ++j)
            inside = inside && rule_low[rule][j] <= observation[j] && observation[j] <= rule_high[rule][j];
        for (column = 0; inside && column < N_COLUMNS; ++column)
            if (rule_columns[rule][column])
                forbidden[column] = 1;
    }
}
"""

#: How columns are compared without rules, and with them.
BETTER = "values[column] > values[best]"
BETTER_ALLOWED = "!forbidden[column] && (forbidden[best] || values[column] > values[best])"
