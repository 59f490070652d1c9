"""Every search agrees with the torch reference: the same points in the same order, and the same distances."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from knn_td_from_scratch import lattice, squared_distances
from toy_envs import StillEnv

from sb3_knntd import KNNTD
from sb3_knntd.kernels.nearest import nearest_of_all
from sb3_knntd.perception import Lattice, Perceiver, Points, Scattered, make_bounds
from sb3_knntd.perception.search import SEARCHES, Neighbors, Search
from sb3_knntd.perception.weights import InverseQuadratic

PROPERTY = settings(max_examples=30, deadline=None, derandomize=True)
SEEDS = st.integers(0, 2**32 - 1)


def unit_bounds(n_dims: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds with which observation units equal scaled units."""
    return -np.ones(n_dims), np.ones(n_dims)


def fitted(name: str, points: Points, k: int) -> Search:
    search = SEARCHES[name](points, k)
    space = spaces.Box(-1.0, 1.0, (points.obs_dim,), np.float64)
    search.fit(make_bounds(unit_bounds(points.obs_dim), space))
    return search


def query(name: str, points: Points, k: int, scaled: np.ndarray) -> Neighbors:
    return fitted(name, points, k).query(th.from_numpy(scaled))


def assert_same(got: Neighbors, expected: Neighbors) -> None:
    """Compare exactly, without tolerance."""
    assert got.indices.dtype == th.int64
    assert got.squared_distances.dtype == th.float64
    np.testing.assert_array_equal(got.indices.numpy(), expected.indices.numpy())
    np.testing.assert_array_equal(got.squared_distances.numpy(), expected.squared_distances.numpy())


def compiled_brute(points: Points, k: int, scaled: np.ndarray) -> Neighbors:
    """The search over all points that the compiled step has in it."""
    columns = fitted("brute", points, k).kernel_arguments().columns
    indices, distances = np.empty((len(scaled), k), np.int64), np.empty((len(scaled), k))
    for row, x in enumerate(scaled):
        nearest_of_all(x, columns, k, indices[row], distances[row])
    return Neighbors(th.from_numpy(indices), th.from_numpy(distances))


def by_hand(places: np.ndarray, k: int, scaled: np.ndarray) -> Neighbors:
    """All distances, sorted by (distance, index), in plain NumPy."""
    squared = np.array([squared_distances(x, places) for x in scaled])
    indices = np.array([np.lexsort((np.arange(len(places)), row))[:k] for row in squared])
    return Neighbors(th.from_numpy(indices), th.from_numpy(np.take_along_axis(squared, indices, axis=1)))


# ------------------------------------------------------------------------------------------------ lattices


def places_of_interest(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Random observations, and observations on points, cell centres, faces, and far outside, in scaled units."""
    axes = Lattice(shape).axes
    d = len(shape)
    on_points = np.stack([rng.choice(axis, 6) for axis in axes], axis=1)
    centres = np.stack([rng.choice((axis[:-1] + axis[1:]) / 2 if len(axis) > 1 else axis, 6) for axis in axes], axis=1)
    anywhere = rng.uniform(-1.3, 1.3, (6, d))
    # A face between two cells or of the whole lattice: one coordinate is that of a point.
    faces = rng.uniform(-1.0, 1.0, (6, d))
    faces[np.arange(6), rng.integers(0, d, 6)] = on_points[np.arange(6), rng.integers(0, d, 6)]
    far = rng.choice([-1e4, 1e4, 0.0, 37.5], (6, d))
    mixed = np.where(rng.random((6, d)) < 0.5, on_points, centres)
    middle, corner = np.zeros((1, d)), np.ones((1, d))
    return np.concatenate((anywhere, on_points, centres, faces, far, mixed, middle, corner))


@st.composite
def lattices(draw: st.DrawFn) -> tuple[tuple[int, ...], int]:
    """A shape of at most 1500 points in 1 to 6 dimensions, and k from 1 to all of them."""
    shape: list[int] = []
    for _ in range(draw(st.integers(1, 6))):
        shape.append(draw(st.integers(1, max(1, min(9, 1500 // math.prod(shape))))))
    n_points = math.prod(shape)
    k = draw(st.one_of(st.just(1), st.just(n_points), st.integers(1, n_points), st.integers(1, min(20, n_points))))
    return tuple(shape), k


@given(case=lattices(), seed=SEEDS)
@PROPERTY
def test_lattice(case: tuple[tuple[int, ...], int], seed: int) -> None:
    shape, k = case
    points, scaled = Lattice(shape), places_of_interest(np.random.default_rng(seed), shape)
    expected = query("brute", points, k, scaled)
    assert_same(query("lattice", points, k, scaled), expected)
    assert_same(query("kd_tree", points, k, scaled), expected)
    assert_same(compiled_brute(points, k, scaled), expected)
    # The reference is checked against a few lines of NumPy.
    assert_same(by_hand(lattice(shape) if 1 not in shape else coordinates(points), k, scaled), expected)


def coordinates(points: Points) -> np.ndarray:
    space = spaces.Box(-1.0, 1.0, (points.obs_dim,), np.float64)
    return points.coordinates(make_bounds(unit_bounds(points.obs_dim), space)).numpy()


@pytest.mark.parametrize("shape", [(1,), (1, 1, 1), (7, 1, 4), (1, 9), (2, 1, 2, 1, 2, 1)])
def test_dimensions_of_one_point(shape: tuple[int, ...]) -> None:
    points, scaled = Lattice(shape), places_of_interest(np.random.default_rng(0), shape)
    for k in range(1, points.n_points + 1):
        assert_same(query("lattice", points, k, scaled), query("brute", points, k, scaled))


@pytest.mark.parametrize(("shape", "k"), [((40, 30), 1200), ((3,) * 6, 729), ((700,), 700), ((40, 30), 700)])
def test_very_many_neighbours(shape: tuple[int, ...], k: int) -> None:
    points, scaled = Lattice(shape), places_of_interest(np.random.default_rng(1), shape)
    assert_same(query("lattice", points, k, scaled), query("brute", points, k, scaled))


@pytest.mark.parametrize("search", ["lattice", "kd_tree"])
def test_distances_that_rounding_makes_equal(search: str) -> None:
    # Far outside, differences between points are lost to rounding, and whole planes of points tie.
    points = Lattice((5, 50))
    scaled = np.array([[1e4, 0.3], [1e4, -1e4], [0.1, 1e4], [1e4, 1e-13], [-9876.5, 0.5 / 49]])
    expected = query("brute", points, 60, scaled)
    assert (np.diff(expected.squared_distances.numpy()) == 0).any()
    assert_same(query(search, points, 60, scaled), expected)


@pytest.mark.parametrize(
    ("shape", "k", "scaled"),
    [
        # The same distances in several dimensions, added in another order.
        ((4, 4, 2, 2, 1), 4, [1.0, -1.0, 0.0, 1.0, 1.0]),
        ((4, 4, 3, 2, 6), 10, [1.0, -1.0, -0.5, -1.0, 0.8]),
        ((6, 1, 1, 6, 6), 33, [-0.6, -1.0, -1.0, 0.6000000000000001, 1.0]),
        # Sums that differ in the last digit, which one more term rounds to the same.
        ((6, 2, 5, 1), 17, [-0.7999999999999994, 0.0, 0.25, -1.0]),
    ],
)
def test_sums_that_rounding_makes_equal(shape: tuple[int, ...], k: int, scaled: list[float]) -> None:
    """A point with a lower index was left out where its distance was equal to that of the last neighbour."""
    rows = np.array([scaled])
    assert_same(query("lattice", Lattice(shape), k, rows), query("brute", Lattice(shape), k, rows))


@given(seed=SEEDS, k=st.integers(1, 30))
@settings(PROPERTY, max_examples=12)
def test_trillions_of_points_in_twelve_dimensions(seed: int, k: int) -> None:
    # The nearest points are among the three nearest coordinates of every dimension, and half a million
    # combinations can be enumerated.
    rng = np.random.default_rng(seed)
    points = Lattice((10,) * 12)
    assert points.n_points == 10**12
    axis = points.axes[0]
    x = rng.uniform(-1.2, 1.2, 12)
    on_point = rng.random(12) < rng.choice([0.0, 0.3, 1.0])
    x[on_point] = rng.choice(axis, on_point.sum())
    coordinates = np.sort(np.argsort(np.abs(axis - x[:, None]), axis=1, kind="stable")[:, :3], axis=1)
    squares = (x[:, None] - axis[coordinates]) ** 2
    totals, numbers = np.zeros(1), np.zeros(1, np.int64)
    for dimension in range(12):
        totals = (totals[:, None] + squares[dimension]).ravel()
        numbers = (numbers[:, None] * 10 + coordinates[dimension]).ravel()
    nearest = np.lexsort((numbers, totals))[:k]

    # The excluded points are farther: the nearest of them has one coordinate of rank three and all others of rank zero.
    ranked = np.sort((x[:, None] - axis) ** 2, axis=1)
    left_out = ranked[:, 0].sum() + (ranked[:, 3] - ranked[:, 0]).min()
    assert totals[nearest[-1]] < left_out * (1 - 1e-12)

    (indices,), (distances,) = query("lattice", points, k, x[None])
    np.testing.assert_array_equal(indices.numpy(), numbers[nearest])
    np.testing.assert_array_equal(distances.numpy(), totals[nearest])


def test_equal_distances_in_many_dimensions() -> None:
    # The centre of a cell has 2^12 points at the same distance; those with the lowest indices must be found.
    (indices,), (distances,) = query("lattice", Lattice((10,) * 12), 25, np.zeros((1, 12)))
    lowest = sorted(int("".join(digits)) for digits in itertools.product("45", repeat=12))[:25]
    np.testing.assert_array_equal(indices.numpy(), lowest)
    assert len(set(distances.tolist())) == 1


IN_THE_MIDDLE = """
import resource
resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30, 6 * 2**30))
import numpy as np
from sb3_knntd.kernels.nearest import nearest_on_lattice
indices, distances = np.empty(5, np.int64), np.empty(5)
nearest_on_lattice(np.zeros(40), np.tile([-1.0, 1.0], 40), 2 * np.arange(41), 5, indices, distances)
assert indices.tolist() == [0, 1, 2, 3, 4], indices
"""


def test_the_middle_of_a_lattice_of_many_dimensions() -> None:
    # An observation of zeros, at which many environments begin, is as far from each of 2^40 points: "auto" gives
    # such a lattice to 40 dimensions. The search must not enumerate them, because they do not fit into memory.
    run = subprocess.run([sys.executable, "-c", IN_THE_MIDDLE], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-500:]


@pytest.mark.parametrize(("n_dims", "points"), [(15, 20), (63, 2), (70, "auto")])
def test_more_points_than_an_index_can_number(n_dims: int, points: Any) -> None:
    # From 2^63 points on an int64 overflows, and different points would share an entry of the table. Such
    # lattices must be refused with a message that says what to change.
    with pytest.raises(ValueError, match="points"):
        KNNTD(StillEnv(n_dims), points=points, bounds=unit_bounds(n_dims))


def test_a_lattice_larger_than_memory_is_not_made() -> None:
    # The points would need more than 8 TB of memory: it is enough that this runs.
    model = KNNTD(StillEnv(12), points=10, n_neighbors=25, bounds=unit_bounds(12))
    assert model.policy.perceiver.points.n_points == 10**12
    assert model.policy.search_name == "lattice"
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 12))
    assert model.policy.perceive(observations).indices.max() > 10**11
    assert model.predict(observations, deterministic=True)[0].shape == (20,)
    assert model.policy.points.shape == (0, 12)
    assert model.policy.q_table.shape == (0, 3)


@pytest.mark.parametrize("compiled", [True, False])
def test_policy_perceives_the_same_with_every_search(compiled: bool) -> None:
    bounds = (np.array([-3.0, 10.0, 0.0]), np.array([1.0, 11.0, 0.07]))
    observations = np.random.default_rng(2).uniform(*bounds, (300, 3)).astype(np.float32)
    perceived = []
    for search in ("brute", "lattice", "kd_tree"):
        model = KNNTD(
            StillEnv(3), points=(9, 4, 6), n_neighbors=7, bounds=bounds, search=search,
            policy_kwargs={"compiled": compiled},
        )  # fmt: skip
        assert model.policy.search_name == search
        perceived.append(model.policy.perceive(observations))
    for indices, probabilities in perceived[1:]:
        assert th.equal(indices, perceived[0].indices)
        assert th.equal(probabilities, perceived[0].probabilities)


# ---------------------------------------------------------------------------------------- scattered points


@given(seed=SEEDS, n_dims=st.integers(1, 6), n_points=st.integers(1, 120), data=st.data())
@PROPERTY
def test_kd_tree(seed: int, n_dims: int, n_points: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    kind = data.draw(st.sampled_from(["anywhere", "duplicated", "grid", "one place"]))
    places = rng.uniform(-1.0, 1.0, (n_points, n_dims))
    if kind == "duplicated":
        places = places[rng.integers(0, 1 + n_points // 4, n_points)]
    elif kind == "grid":
        # Quarters are exact in binary, so that equal distances are exactly equal.
        places = rng.integers(-4, 5, (n_points, n_dims)) / 4
    elif kind == "one place":
        places = np.tile(places[:1], (n_points, 1))
    scaled = np.concatenate((
        rng.uniform(-1.5, 1.5, (8, n_dims)),
        places[rng.integers(0, n_points, 8)],
        rng.integers(-10, 11, (8, n_dims)) / 8,
        rng.choice([-1e4, 0.0, 1e4], (4, n_dims)),
    ))  # fmt: skip
    k = data.draw(st.one_of(st.just(n_points), st.integers(1, n_points), st.integers(1, min(6, n_points))))
    points = Scattered(places)
    expected = by_hand(coordinates(points), k, scaled)
    assert_same(query("brute", points, k, scaled), expected)
    assert_same(query("kd_tree", points, k, scaled), expected)
    assert_same(compiled_brute(points, k, scaled), expected)


@given(seed=SEEDS, n_dims=st.integers(1, 4), sizes=st.lists(st.integers(1, 25), min_size=2, max_size=4), data=st.data())
@PROPERTY
def test_points_that_are_added(seed: int, n_dims: int, sizes: list[int], data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    # Many are at equal distances, or in one place.
    places = rng.integers(-4, 5, (sum(sizes), n_dims)) / 4
    scaled = np.concatenate((rng.uniform(-1.5, 1.5, (8, n_dims)), rng.integers(-10, 11, (8, n_dims)) / 8))
    k = data.draw(st.integers(1, sizes[0]))
    bounds = make_bounds(unit_bounds(n_dims), spaces.Box(-1.0, 1.0, (n_dims,), np.float64))
    for name in ("brute", "kd_tree"):
        points = Scattered(places[: sizes[0]])
        perceiver = Perceiver(bounds, points, SEARCHES[name](points, k), InverseQuadratic())
        first = sizes[0]
        for size in sizes[1:]:
            added = perceiver.add_points(places[first : first + size])
            assert added.tolist() == list(range(first, first + size))
            first += size
            expected = by_hand(places[:first], k, scaled)
            assert_same(perceiver.find(th.from_numpy(scaled)), expected)
            assert_same(compiled_brute(points, k, scaled), expected)


@pytest.mark.parametrize("n_dims", [1, 3])
def test_kd_tree_where_distances_differ_by_rounding_alone(n_dims: int) -> None:
    # Thirds are not exact: the tree's arithmetic may order such points differently.
    shape = (13,) * n_dims
    points = Scattered(lattice(shape)[np.random.default_rng(0).permutation(13**n_dims)])
    scaled = places_of_interest(np.random.default_rng(3), shape)
    for k in (1, 2, 3, 7, 13):
        assert_same(query("kd_tree", points, k, scaled), query("brute", points, k, scaled))


def test_many_rows_are_processed_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    # More distances than are computed at once: the rows must be returned in order.
    monkeypatch.setattr("sb3_knntd.perception.search.brute.MAX_DISTANCES", 7 * 500 + 3)
    points = Scattered(np.random.default_rng(4).uniform(-1.0, 1.0, (500, 2)))
    scaled = np.random.default_rng(5).uniform(-1.0, 1.0, (200, 2))
    assert_same(query("brute", points, 3, scaled), query("kd_tree", points, 3, scaled))


# ---------------------------------------------------------------------------------------------------- hnsw


@pytest.fixture(scope="module")
def scattered() -> tuple[Scattered, np.ndarray]:
    """20,000 points in six dimensions, and a thousand observations."""
    rng = np.random.default_rng(6)
    return Scattered(rng.uniform(-1.0, 1.0, (20_000, 6))), rng.uniform(-1.0, 1.0, (1_000, 6))


def test_hnsw_finds_nearly_all(scattered: tuple[Scattered, np.ndarray]) -> None:
    pytest.importorskip("voyager")
    points, scaled = scattered
    found, true = query("hnsw", points, 16, scaled), query("kd_tree", points, 16, scaled)
    shared = [len(set(a) & set(b)) for a, b in zip(found.indices.tolist(), true.indices.tolist(), strict=True)]
    assert sum(shared) / true.indices.numel() >= 0.99
    # The order and distances of the found points are those of the other searches.
    exact = (found.indices == true.indices).all(dim=1)
    assert exact.float().mean() > 0.9
    assert th.equal(found.squared_distances[exact], true.squared_distances[exact])


def test_hnsw_is_the_same_every_time(scattered: tuple[Scattered, np.ndarray]) -> None:
    pytest.importorskip("voyager")
    points, scaled = Scattered(scattered[0].places[:5_000].numpy()), scattered[1]
    first = query("hnsw", points, 16, scaled)
    assert_same(query("hnsw", points, 16, scaled), first)
    # Single observations and batches give the same result.
    search = fitted("hnsw", points, 16)
    alone = [search.query(th.from_numpy(row[None])) for row in scaled[:50]]
    np.testing.assert_array_equal(np.concatenate([part.indices for part in alone]), first.indices[:50])


def test_hnsw_with_few_points() -> None:
    pytest.importorskip("voyager")
    points = Scattered(np.random.default_rng(7).uniform(-1.0, 1.0, (30, 3)))
    scaled = np.random.default_rng(8).uniform(-1.0, 1.0, (40, 3))
    for k in (1, 4, 30):
        assert_same(query("hnsw", points, k, scaled), query("brute", points, k, scaled))


def test_hnsw_learns_like_an_exact_search() -> None:
    # With so few points it misses none, so the whole run is the same.
    pytest.importorskip("voyager")
    points = np.random.default_rng(9).uniform([-1.2, -0.07], [0.6, 0.07], (200, 2))
    hnsw, exact = (
        KNNTD("MountainCar-v0", points=points, n_neighbors=4, search=search, seed=0).learn(500)
        for search in ("hnsw", "kd_tree")
    )
    assert exact.policy.q_table.count_nonzero() > 20
    assert th.equal(hnsw.policy.q_table, exact.policy.q_table)


def test_hnsw_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "voyager", None)
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2))
    with pytest.raises(ImportError, match=r"pip install 'sb3-knntd\[ann\]'"):
        KNNTD(StillEnv(2), points=places, n_neighbors=4, bounds=unit_bounds(2), search="hnsw")


# -------------------------------------------------------------------------------------------------- choice


def scattered_over(n_points: int, n_dims: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (n_points, n_dims))


@pytest.mark.parametrize(
    ("points", "chosen"),
    [
        pytest.param((20, 15), "lattice", id="lattice"),
        pytest.param((1000, 1000), "lattice", id="large lattice"),
        pytest.param(scattered_over(300, 2), "brute", id="few scattered"),
        pytest.param(scattered_over(10_001, 2), "kd_tree", id="many scattered"),
        pytest.param(scattered_over(10_001, 13), "brute", id="many scattered in many dimensions"),
    ],
)
def test_auto_picks_and_says_so(points: Any, chosen: str, capsys: pytest.CaptureFixture[str]) -> None:
    n_dims = points.shape[1] if isinstance(points, np.ndarray) else len(points)
    n_points = len(points) if isinstance(points, np.ndarray) else math.prod(points)
    for verbose in (0, 1):
        model = KNNTD(StillEnv(n_dims), points=points, n_neighbors=4, bounds=unit_bounds(n_dims), verbose=verbose)
        assert model.search == "auto"
        assert model.policy.search_name == chosen
        line = f"search='{chosen}' over {n_points} points"
        assert (line in capsys.readouterr().out) == (verbose == 1)


def test_lattice_search_of_scattered_points_is_refused() -> None:
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2))
    with pytest.raises(ValueError, match=r"search='lattice' .*scattered.*use 'kd_tree' or 'auto'"):
        KNNTD(StillEnv(2), points=places, n_neighbors=4, bounds=unit_bounds(2), search="lattice")
