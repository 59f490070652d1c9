"""From settings to perceptions: each choice is one that the kernels know too, and points can be added."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from knn_td_from_scratch import NearestPoints

from sb3_knntd.kernels.perceive import PerceptionArguments, SearchKind, Weighting, perceive, weigh
from sb3_knntd.perception import Perceiver, PerceptionConfig, make_perceiver, make_weights
from sb3_knntd.perception.weights import InverseQuadratic, KernelWeights

LOW, HIGH = np.array([-1.0, 0.0]), np.array([3.0, 0.5])
SPACE = spaces.Box(LOW, HIGH, dtype=np.float64)
PLACES = np.random.default_rng(0).uniform(LOW, HIGH, (30, 2))
MORE = np.random.default_rng(1).uniform(LOW, HIGH, (7, 2))
OBSERVATIONS = np.random.default_rng(2).uniform(LOW - 0.2, HIGH + 0.2, (50, 2))


def make(**settings: Any) -> Perceiver:
    return make_perceiver(PerceptionConfig(**settings), SPACE)


def perceived_by_kernel(perceiver: Perceiver, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the compiled steps perceive, shapes (batch, k)."""
    arguments, k = perceiver.arguments, perceiver.search.n_neighbors
    assert arguments is not None
    indices, probabilities = np.empty((len(observations), k), np.int64), np.empty((len(observations), k))
    if perceiver.search_is_outside:
        neighbors = perceiver.find(th.from_numpy(observations))
        indices[:], probabilities[:] = neighbors.indices.numpy(), neighbors.squared_distances.numpy()
    for row, observation in enumerate(observations):
        perceive(observation, arguments, indices[row], probabilities[row])
    return indices, probabilities


# --------------------------------------------------------------------------------------------------- weights


@pytest.mark.parametrize("weighting", Weighting, ids=lambda weighting: weighting.name.lower())
@pytest.mark.parametrize("bandwidth", [0.3, 1.0, 2.5])
def test_each_weighting_of_the_kernels_has_a_word_and_the_same_formula(weighting: Weighting, bandwidth: float) -> None:
    weights = make_weights(weighting.name.lower(), bandwidth, 5)
    assert isinstance(weights, KernelWeights)
    assert weights.WEIGHTING is weighting
    squared = np.sort(np.random.default_rng(0).uniform(0.0, 6.0, (40, 5)), axis=1)
    expected = weights(th.from_numpy(squared)).numpy()
    for row in squared:
        weigh(int(weighting), bandwidth, row)
    np.testing.assert_allclose(squared, expected / expected.sum(axis=1, keepdims=True), rtol=1e-12)


@pytest.mark.parametrize(
    ("parent", "members"),
    [
        (KernelWeights, {}),
        (KernelWeights, {"WEIGHTING": 0}),
        (KernelWeights, {"WEIGHTING": None}),
        (InverseQuadratic, {}),
    ],
    ids=["none", "a number", "None", "that of the parent"],
)
def test_weights_that_the_kernels_do_not_know_are_refused(parent: type[KernelWeights], members: dict[str, Any]) -> None:
    """They would be those of another formula in compiled steps."""
    with pytest.raises(TypeError, match=r"Triangular\.WEIGHTING must be set in the class itself.*Weighting\.GAUSSIAN"):
        type("Triangular", (parent,), {"__call__": lambda self, squared: 1.0 - squared.sqrt(), **members})


def test_the_kernels_refuse_numbers_that_they_do_not_know() -> None:
    with pytest.raises(ValueError, match="weighting"):
        weigh(99, 1.0, np.array([0.1, 0.2]))
    arguments = make(points=5, n_neighbors=2).arguments
    assert arguments is not None
    with pytest.raises(ValueError, match="search"):
        perceive(LOW, arguments._replace(search=99), np.empty(2, np.int64), np.empty(2))


# ----------------------------------------------------------------------------------------------- configuration


SETTINGS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "lattice": {"points": (7, 5), "n_neighbors": 4, "search": "lattice"},
    "brute": {"points": (7, 5), "n_neighbors": 4, "search": "brute", "weights": "gaussian", "bandwidth": 0.4},
    "kd_tree": {"points": PLACES, "n_neighbors": 3, "search": "kd_tree"},
    "scattered": {"points": PLACES, "bounds": (LOW - 1.0, HIGH + 1.0)},
    "adaptive": {"points": 6, "bounds": "adaptive"},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_the_kernels_perceive_what_torch_does(name: str) -> None:
    perceiver = make(**SETTINGS[name])
    indices, probabilities = perceived_by_kernel(perceiver, OBSERVATIONS)
    expected = perceiver(th.from_numpy(OBSERVATIONS))
    np.testing.assert_array_equal(indices, expected.indices.numpy())
    np.testing.assert_allclose(probabilities, expected.probabilities.numpy(), rtol=1e-12)


def test_settings_are_those_of_the_equations() -> None:
    perceiver = make(points=(7, 5), n_neighbors=4)
    reference = NearestPoints((7, 5), (LOW, HIGH), 4)
    perception = perceiver(th.from_numpy(OBSERVATIONS))
    for row, observation in enumerate(OBSERVATIONS):
        expected = reference(observation)
        np.testing.assert_array_equal(perception.indices[row].numpy(), expected.indices)
        np.testing.assert_allclose(perception.probabilities[row].numpy(), expected.probabilities, rtol=1e-12)


def test_defaults_are_those_of_the_learners() -> None:
    perceiver = make()
    assert perceiver.points.n_points == 400
    assert perceiver.search.n_neighbors == 5
    assert isinstance(perceiver.weights, InverseQuadratic)
    assert perceiver.weights.bandwidth == 1.0
    assert not perceiver.bounds.is_open
    assert make_perceiver(PerceptionConfig(), SPACE, bounds_from_space=False).bounds.is_open


def test_a_configuration_does_not_change() -> None:
    with pytest.raises(FrozenInstanceError):
        PerceptionConfig().bandwidth = 2.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_neighbors": 0}, "n_neighbors must be an integer >= 1"),
        ({"points": (3, 4, 5)}, "points: one int for each of the 2"),
        ({"points": PLACES, "n_neighbors": 31}, "n_neighbors must be at most the number of points, 30"),
        ({"bounds": "wide"}, "bounds must be None, 'adaptive', or a pair"),
        ({"weights": "linear"}, "weights must be one of 'inverse_quadratic', 'gaussian'"),
        ({"bandwidth": 0.0}, "bandwidth must be a finite number"),
        ({"search": "grid"}, "search must be one of 'auto', 'brute'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_wrong_setting_is_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**settings)


@pytest.mark.parametrize("search", ["brute", "lattice", "kd_tree"])
def test_each_search_names_its_part(search: str) -> None:
    arguments = make(points=(4, 3), search=search, n_neighbors=2).arguments
    assert isinstance(arguments, PerceptionArguments)
    kind = {"brute": SearchKind.ALL_POINTS, "lattice": SearchKind.LATTICE}.get(search, SearchKind.OUTSIDE)
    assert arguments.search == kind
    assert arguments.columns.shape == ((2, 12) if search == "brute" else (0, 0))
    assert arguments.offsets.tolist() == ([0, 4, 7] if search == "lattice" else [])


def test_the_version_tells_of_each_change() -> None:
    perceiver = make(points=PLACES, bounds="adaptive", n_neighbors=3)
    changes: list[Callable[[], Any]] = [
        perceiver.fit,
        lambda: perceiver.measure(th.from_numpy(OBSERVATIONS)),
        lambda: perceiver.widen(th.tensor([[3.5, 0.0]])),
        lambda: perceiver.add_points(MORE),
    ]
    for change in changes:
        version = perceiver.version
        perceiver(th.from_numpy(OBSERVATIONS))
        perceiver.sees(OBSERVATIONS)
        assert perceiver.version == version
        change()
        assert perceiver.version > version


# ------------------------------------------------------------------------------------------- points that are added


@pytest.mark.parametrize("search", ["brute", "kd_tree", "hnsw"])
def test_added_points_are_perceived(search: str) -> None:
    if search == "hnsw":
        pytest.importorskip("voyager")
    perceiver, whole = make(points=PLACES, search=search), make(points=np.concatenate((PLACES, MORE)), search=search)
    added = perceiver.add_points(MORE)
    assert added.tolist() == list(range(30, 37))
    assert perceiver.points.n_points == 37
    assert perceiver(th.from_numpy(MORE)).indices[:, 0].tolist() == added.tolist()
    for got, expected in zip(
        (*perceiver(th.from_numpy(OBSERVATIONS)), *perceived_by_kernel(perceiver, OBSERVATIONS)),
        (*whole(th.from_numpy(OBSERVATIONS)), *perceived_by_kernel(whole, OBSERVATIONS)),
        strict=True,
    ):
        np.testing.assert_array_equal(got, expected)


def test_points_cannot_be_added_to_a_lattice() -> None:
    perceiver = make(points=5)
    with pytest.raises(ValueError, match=r"scattered points only.*lattice.*shape \(n_points, 2\)"):
        perceiver.add_points(MORE)
    assert perceiver.points.n_points == 25


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (MORE[:, :1], r"shape \(n_points, 2\); got shape \(7, 1\)"),
        (MORE[0], r"shape \(n_points, 2\); got shape \(2,\)"),
        (MORE[:0], r"shape \(n_points, 2\); got shape \(0, 2\)"),
        ([[0.0, np.nan]], "finite"),
        ([["a", "b"]], "array of numbers"),
    ],
    ids=["narrow", "flat", "none", "not finite", "words"],
)
def test_what_is_no_list_of_places_is_not_added(points: Any, message: str) -> None:
    perceiver = make(points=PLACES)
    with pytest.raises(ValueError, match=message):
        perceiver.add_points(points)
    assert perceiver.points.n_points == 30


def test_added_points_are_saved() -> None:
    perceiver, other = make(points=PLACES), make(points=PLACES[:8])
    perceiver.add_points(MORE)
    state = {name: tensor.clone() for name, tensor in perceiver.state_dict().items()}
    other.load_state_dict(state)
    other.fit()
    assert other.points.n_points == 37
    for got, expected in zip(
        perceived_by_kernel(other, OBSERVATIONS), perceived_by_kernel(perceiver, OBSERVATIONS), strict=True
    ):
        np.testing.assert_array_equal(got, expected)
    # What was loaded is a copy.
    state["points.places"].zero_()
    assert th.equal(other.points.coordinates(other.bounds), perceiver.points.coordinates(perceiver.bounds))


def test_a_state_without_places_leaves_them() -> None:
    """Files of the first version have none: there the points are those that the model is made with."""
    perceiver = make(points=PLACES)
    state = {name: tensor for name, tensor in perceiver.state_dict().items() if name != "points.places"}
    perceiver.load_state_dict(state)
    np.testing.assert_array_equal(
        perceiver.points.coordinates(perceiver.bounds), perceiver.bounds.scale(th.from_numpy(PLACES))
    )


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (th.from_numpy(PLACES[:4]), r"points\.places must have at least n_neighbors=5 rows; got shape \(4, 2\)"),
        (th.tensor(1.0), "at least n_neighbors=5 rows"),
        (th.from_numpy(PLACES.repeat(2, axis=1)), r"points\.places must have shape \(any, 2\)"),
        (th.from_numpy(PLACES).int(), r"points\.places must be of type float"),
        (th.from_numpy(PLACES * np.nan), r"points\.places must be finite"),
        ("places", r"points\.places must be a tensor"),
    ],
    ids=["few", "one number", "wide", "integers", "NaN", "a word"],
)
def test_places_that_do_not_fit_are_not_loaded(places: Any, message: str) -> None:
    perceiver = make(points=PLACES)
    before = perceived_by_kernel(perceiver, OBSERVATIONS)
    with pytest.raises(ValueError, match=message):
        perceiver.load_state_dict({**perceiver.state_dict(), "points.places": places})
    perceiver.fit()
    for got, expected in zip(perceived_by_kernel(perceiver, OBSERVATIONS), before, strict=True):
        np.testing.assert_array_equal(got, expected)


def test_a_lattice_refuses_places() -> None:
    state = make(points=PLACES).state_dict()
    with pytest.raises(RuntimeError, match=r"Unexpected key\(s\).*points\.places"):
        make(points=5).load_state_dict(state)
