"""Traced and exported policies return the actions of ``predict``."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from toy_envs import DriftEnv, PushEnv

from sb3_knntd import KNNTD, ExA, KNNDyna
from sb3_knntd.kernels import jit

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning"),
    pytest.mark.filterwarnings("error::torch.jit.TracerWarning"),
]

SCATTERED = np.random.default_rng(5).uniform(DriftEnv.LOW, DriftEnv.HIGH, size=(300, 2))
ROUND_PLACES = np.round(SCATTERED, 1)  # many of the points coincide, and tie

CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "brute lattice": {"points": (9, 7), "search": "brute"},
    "brute": {"points": SCATTERED, "search": "brute"},
    "grow": {"points": "grow", "spacing": 0.2},
    "few": {"points": "grow", "spacing": 1.0, "n_neighbors": 9, "weights": "gaussian", "bandwidth": 0.2},
    "kd_tree": {"points": SCATTERED, "search": "kd_tree"},
    "ties": {"points": ROUND_PLACES, "search": "kd_tree", "n_neighbors": 6},
    "gaussian": {"weights": "gaussian", "bandwidth": 0.3},
    "function": {"weights": lambda d2: 1.0 / (0.1 + d2)},
    "float32": {"policy_kwargs": {"dtype": th.float32}},
    "torch": {"policy_kwargs": {"compiled": False}},
}


def make_model(algorithm: type[KNNTD | ExA], **arguments: Any) -> KNNTD | ExA:
    env = PushEnv(dtype=np.float32) if algorithm is ExA else DriftEnv()
    return algorithm(env, **{"bounds": (DriftEnv.LOW, DriftEnv.HIGH), "seed": 0, **arguments})


def traced(policy: Any, example: th.Tensor) -> Callable[[th.Tensor], th.Tensor]:
    # Through a file, as in deployment.
    file = io.BytesIO()
    th.jit.save(th.jit.trace(policy.eval(), example), file)
    file.seek(0)
    return th.jit.load(file)  # type: ignore[no-any-return]


def exported(policy: Any, example: th.Tensor) -> Callable[[th.Tensor], th.Tensor]:
    shapes = ({0: th.export.Dim("batch", min=1)}, None)
    return th.export.export(policy.eval(), (example, True), dynamic_shapes=shapes).module()  # type: ignore[return-value]


@pytest.fixture
def places() -> np.ndarray:
    """Two thousand observations inside and outside the bounds, some on points and halfway between them."""
    width = DriftEnv.HIGH - DriftEnv.LOW
    random = np.random.default_rng(7).uniform(DriftEnv.LOW - 0.3 * width, DriftEnv.HIGH + 0.3 * width, size=(2_000, 2))
    on_lattice = DriftEnv.LOW + width * np.random.default_rng(8).integers(0, 17, size=(200, 2)) / 16
    return np.concatenate((random, on_lattice)).astype(np.float32)


@pytest.mark.parametrize("algorithm", [KNNTD, ExA])
@pytest.mark.parametrize("how", [traced, exported])
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_it_acts_like_predict(
    algorithm: type[KNNTD | ExA], how: Callable[..., Any], name: str, places: np.ndarray
) -> None:
    # In the middle of an episode: the latest updates must be included.
    model = make_model(algorithm, **CONFIGURATIONS[name]).learn(1_003)
    policy = how(model.policy, th.from_numpy(places[:2]))
    expected, _ = model.predict(places, deterministic=True)
    assert len(np.unique(expected)) > 1, "a constant policy would make this test empty"
    with th.no_grad():
        arguments = () if how is traced else (True,)
        together = policy(th.from_numpy(places), *arguments).numpy()
        alone = policy(th.from_numpy(places[:1]), *arguments).numpy()
    assert together.dtype == expected.dtype
    np.testing.assert_array_equal(together, expected)
    np.testing.assert_array_equal(alone, expected[:1])


@pytest.mark.parametrize("how", [traced, exported])
@pytest.mark.parametrize("env_cls", [DriftEnv, PushEnv])
def test_a_policy_that_was_planned(env_cls: type[DriftEnv], how: Callable[..., Any], places: np.ndarray) -> None:
    model = KNNDyna(env_cls(), spacing=0.1, simulated_steps=5, seed=0).learn(203)
    policy = how(model.policy, th.from_numpy(places[:2]))
    expected, _ = model.predict(places, deterministic=True)
    assert len(np.unique(expected)) > 1
    with th.no_grad():
        actions = policy(th.from_numpy(places), *(() if how is traced else (True,))).numpy()
    assert actions.dtype == expected.dtype
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-12)


def test_actions_that_do_not_start_at_0_and_whole_ones(places: np.ndarray) -> None:
    class FromFive(DriftEnv):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = spaces.Discrete(3, start=5)

        def step(self, action: Any) -> Any:
            return super().step(action - 5)

    models = [
        KNNTD(FromFive(), points=(9, 7), seed=0),
        ExA(PushEnv(low=-3, high=4, dtype=np.int32), points=(9, 7), seed=0),
        ExA(PushEnv(shape=(2, 1)), action_points=(2, 3), action_table="factored", points=(9, 7), seed=0),
    ]
    for model in models:
        model.learn(2_000)
        expected, _ = model.predict(places, deterministic=True)
        assert len(np.unique(expected)) > 1
        actions = traced(model.policy, th.from_numpy(places[:3]))(th.from_numpy(places))
        # Sums of float64 may differ in their last digit.
        np.testing.assert_allclose(actions.numpy(), expected, rtol=0.0, atol=1e-15)
        assert actions.numpy().dtype == expected.dtype


def test_actions_between_action_points(places: np.ndarray) -> None:
    model = KNNDyna(PushEnv(shape=(2,), dtype=np.float32), simulated_steps=10, seed=0).learn(200)
    expected, _ = model.predict(places)
    assert len(np.unique(expected)) > 3, "there must be other actions than action points"
    actions = traced(model.policy, th.from_numpy(places[:3]))(th.from_numpy(places)).numpy()
    assert actions.dtype == expected.dtype
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-3)
    assert (np.abs(actions - expected) < 1e-6).mean() > 0.99


@pytest.mark.skipif(not jit.AVAILABLE, reason="hashed tables need numba")
@pytest.mark.parametrize("how", [traced, exported])
def test_a_hashed_table_cannot_be_exported(how: Callable[..., Any]) -> None:
    model = make_model(KNNTD, policy_kwargs={"table": "hashed"}).learn(100)
    with pytest.raises(ValueError, match=r"cannot be traced or exported.*policy_kwargs=\{'table': 'dense'\}"):
        how(model.policy, th.zeros(2, 2))


@pytest.mark.parametrize("how", [traced, exported])
def test_weights_without_torch_operations_cannot_be_exported(how: Callable[..., Any]) -> None:
    model = make_model(KNNTD, points=(5, 5), weights=lambda d2: [[1.0] * d2.shape[1]] * d2.shape[0]).learn(100)
    with pytest.raises(ValueError, match="function of torch operations"):
        how(model.policy, th.zeros(2, 2))


def test_a_traced_policy_does_not_change(places: np.ndarray) -> None:
    model = make_model(KNNTD).learn(1_000)
    expected, _ = model.predict(places, deterministic=True)
    policy = traced(model.policy, th.from_numpy(places[:2]))
    model.learn(3_000)
    assert not np.array_equal(model.predict(places, deterministic=True)[0], expected)
    np.testing.assert_array_equal(policy(th.from_numpy(places)).numpy(), expected)
