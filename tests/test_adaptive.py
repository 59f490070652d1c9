"""`bounds="adaptive"`: the bounds follow the observations, and the learned values are kept."""

from __future__ import annotations

import itertools
import pathlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_knntd import KNNTD, ExA
from sb3_knntd.perception import make_bounds

LEARNERS: dict[str, dict[str, Any]] = {"compiled": {}, "torch": {"compiled": False}}


class Wander(gym.Env[np.ndarray, Any]):
    """
    A walk whose range grows with time, with two observation dimensions, of which the second is unbounded; actions are
    Discrete or a Box.

    :param first: offset in the sequence of random numbers
    :param continuous: whether actions are a Box
    """

    def __init__(self, first: int = 0, continuous: bool = False) -> None:
        self.observation_space = spaces.Box(np.float32([-40.0, -np.inf]), np.float32([40.0, np.inf]))
        self.action_space = spaces.Box(-1.0, 1.0, (1,)) if continuous else spaces.Discrete(3)
        self.random = np.random.default_rng(first)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = np.zeros(2)
        return self.state.astype(np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.state += self.random.normal(0.0, [0.2, 3.0]) * (1.0 + (self.steps / 700) ** 2) + 0.05 * (
            np.mean(action) - 1.0
        )
        self.state[0] = np.clip(self.state[0], -40.0, 40.0)
        reward = float(np.cos(self.state[0]) - 0.1 * abs(self.state[1]))
        return self.state.astype(np.float32), reward, False, self.steps % 37 == 0, {}


def make_venv(n_envs: int = 1, continuous: bool = False) -> DummyVecEnv:
    return DummyVecEnv([lambda n=n: Monitor(Wander(n, continuous)) for n in range(n_envs)])  # type: ignore[misc]


def make_model(cls: type[KNNTD] | type[ExA], n_envs: int = 1, **arguments: Any) -> KNNTD | ExA:
    venv = make_venv(n_envs, cls is ExA)
    return cls(venv, **{"bounds": "adaptive", "points": (9, 7), "n_neighbors": 5, "seed": 0, **arguments})


def make_random(table: str = "dense", points: Any = (9, 7), **arguments: Any) -> KNNTD:
    """A model with a random table over the box [-1, 2] x [-3, 3]."""
    model = make_model(KNNTD, points=points, policy_kwargs={"table": table}, **arguments)
    assert isinstance(model, KNNTD)
    model.policy.perceiver.measure(th.tensor([[-0.5, -2.0], [1.5, 2.0]]))
    if table == "hashed":
        # Set all rows directly: without learning there is no other way to visit all points of a lattice.
        everything = th.arange(model.policy.perceiver.points.n_points)
        values, visits = th.zeros(len(everything), 3, dtype=th.float64), th.ones(len(everything), dtype=th.int32)
        model.policy.table._refill(everything, values, visits)  # type: ignore[operator]
    values = model.policy.q_table
    values.copy_(th.from_numpy(np.random.default_rng(0).normal(size=values.shape)))
    return model


def box(model: KNNTD | ExA) -> np.ndarray:
    bounds = model.policy.perceiver.bounds
    return np.stack((bounds.low.numpy(), bounds.high.numpy())).copy()


@pytest.mark.parametrize("table", ["dense", "hashed"])
@settings(max_examples=40, deadline=None)
@given(beyond=st.tuples(st.floats(-6.0, 6.0), st.floats(-9.0, 9.0)), seed=st.integers(0, 2**16))
def test_widening_keeps_values_up_to_interpolation_error(table: str, beyond: tuple[float, float], seed: int) -> None:
    model = make_random(table)
    low, high = box(model)
    inside = th.from_numpy(np.random.default_rng(seed).uniform(low, high, (50, 2)))
    before = model.policy.q_values(inside).clone()
    old = make_random(table)
    model.policy.widen(th.tensor([beyond]))
    after = model.policy.q_values(inside)

    # The values are now means of the old function at the neighbouring points.
    now = model.policy.perceive(inside)
    places = model.policy.perceiver.points.coordinates(model.policy.perceiver.bounds, now.indices.flatten())
    places = model.policy.perceiver.bounds.unscale(places)
    around = old.policy.q_values(places).reshape(50, 5, 3)
    if table == "dense":
        th.testing.assert_close(after, (now.probabilities[..., None] * around).sum(dim=1), rtol=1e-9, atol=1e-9)
        assert ((after - before).abs() <= (around - before[:, None]).abs().amax(dim=1) + 1e-9).all()
    else:
        # Points without an old point nearby count as not visited; all others are as in a dense table.
        made = model.policy.table.rows(now.indices) != model.initial_value
        th.testing.assert_close(model.policy.table.rows(now.indices)[made], around[made], rtol=1e-9, atol=1e-9)
        assert model.policy.table.n_visited <= old.policy.table.n_visited


@pytest.mark.parametrize("weights", ["inverse_quadratic", "gaussian"])
def test_many_widenings_keep_a_smooth_function(weights: str) -> None:
    """After ten widenings the error of a plane is below the limit given by the point spacing."""
    model = make_random(points=(60, 60), weights=weights, bandwidth=0.02)
    points = model.policy.points
    model.policy.q_table.copy_((2.0 * points[:, :1] - points[:, 1:]).expand(-1, 3))
    inside = th.from_numpy(np.random.default_rng(0).uniform([-0.5, -2.0], [1.5, 2.0], (200, 2)))
    spacings = []
    for i in range(10):
        reach = 2.5 * 1.3**i
        model.policy.widen(th.tensor([[reach, -2.0 * reach]]))
        low, high = box(model)
        spacings.append(2.0 * (high[0] - low[0]) / 59 + (high[1] - low[1]) / 59)
    errors = model.policy.q_values(inside)[:, 0] - (2.0 * inside[:, 0] - inside[:, 1])
    assert errors.abs().max() < sum(spacings)
    assert errors.abs().mean() < spacings[-1]


def test_an_observation_within_the_bounds_changes_nothing() -> None:
    model = make_random()
    assert model.policy.perceiver.sees(np.array([[0.0, 0.0], [1.9, -2.9]]))
    assert not model.policy.perceiver.sees(np.array([[0.0, 0.0], [1.9, -3.1]]))
    before = box(model)
    model.policy.widen(th.tensor([[0.0, 0.0]]))
    np.testing.assert_array_equal(box(model), before)


@given(x=st.floats(-60.0, 60.0), y=st.floats(-60.0, 60.0))
@settings(max_examples=60, deadline=None)
def test_only_the_side_that_was_exceeded_moves_and_never_past_the_space(x: float, y: float) -> None:
    bounds = make_bounds("adaptive", make_venv().observation_space)
    bounds.measure(th.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    low, high = bounds.low.clone(), bounds.high.clone()
    seen = th.tensor([[x, y]], dtype=th.float64)
    bounds.widen(seen)
    for j, value in enumerate((x, y)):
        assert (bounds.low[j] == low[j]) == (value >= low[j])
        assert (bounds.high[j] == high[j]) == (value <= high[j])
        limit = 40.0 if j == 0 else np.inf
        wanted = 1.25 * max(high[j].item(), value) - 0.25 * min(low[j].item(), value)
        if value > high[j]:
            assert bounds.high[j].item() == pytest.approx(min(limit, wanted))


def test_scattered_points_stay_where_they_are_and_keep_their_values() -> None:
    model = make_random(points=np.random.default_rng(1).uniform(-2.0, 2.0, (30, 2)))
    points, values = model.policy.points.clone(), model.policy.q_table.clone()
    model.policy.widen(th.tensor([[9.0, -30.0]]))
    th.testing.assert_close(model.policy.points, points, rtol=1e-12, atol=1e-12)
    assert th.equal(model.policy.q_table, values)


def test_visited_points_are_those_where_visited_ones_were() -> None:
    model = make_random(points=(40, 40))
    # Only the lower half of the first dimension was visited.
    model.policy.table.visit(th.arange(800))  # type: ignore[operator]
    model.policy.widen(th.tensor([[5.0, 0.0]]))
    visited = model.policy.visits.numpy() > 0
    # The bounds were [-1, 2], so points above 0.5 plus half a spacing are nearer to the upper half.
    np.testing.assert_array_equal(visited, (model.policy.points[:, 0] < 0.5).numpy())


@pytest.mark.parametrize("cls", [KNNTD, ExA])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("kwargs", [{}, {"compiled": False}, {"table": "hashed"}], ids=["compiled", "torch", "hashed"])
def test_bounds_contain_all_observations(
    cls: type[KNNTD] | type[ExA], n_envs: int, kwargs: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    model = make_model(cls, n_envs, policy_kwargs=kwargs, verbose=1)
    reach = []

    def look(local: dict[str, Any], _: dict[str, Any]) -> bool:
        if not model._measuring:
            low, high = box(model)
            assert (local["new_obs"] >= low).all()
            assert (local["new_obs"] <= high).all()
            reach.append(float(high[1] - low[1]))
        return True

    model.learn(1500 + 300 * n_envs, callback=look)
    assert reach == sorted(reach)
    assert reach[-1] > 1.5 * reach[0]
    low, high = box(model)
    assert low[0] >= -40.0
    assert high[0] <= 40.0
    output = capsys.readouterr().out
    assert output.count("Range measured over") == 1
    assert "Range widened at step" in output
    assert th.isfinite(model.policy.q_table).all()


@pytest.mark.parametrize("cls", [KNNTD, ExA])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_compiled_and_torch_learn_the_same(cls: type[KNNTD] | type[ExA], n_envs: int) -> None:
    one, other = (
        make_model(cls, n_envs, policy_kwargs=kwargs, learning_rate=0.1).learn(1800) for kwargs in LEARNERS.values()
    )
    np.testing.assert_array_equal(box(one), box(other))
    th.testing.assert_close(one.policy.q_table, other.policy.q_table, rtol=1e-7, atol=1e-7)
    assert one.policy.table.n_visited == other.policy.table.n_visited


@pytest.mark.parametrize("table", ["dense", "hashed"])
@pytest.mark.parametrize("steps", [700, 1200, 1333])
def test_interrupted_run_equals_the_uninterrupted(tmp_path: pathlib.Path, table: str, steps: int) -> None:
    arguments: dict[str, Any] = {"policy_kwargs": {"table": table}}
    whole = make_model(KNNTD, **arguments).learn(steps).learn(900, reset_num_timesteps=False)
    broken = make_model(KNNTD, **arguments).learn(steps)
    broken.save(tmp_path / "model")
    resumed = KNNTD.load(tmp_path / "model", env=broken.get_env(), force_reset=False)
    np.testing.assert_array_equal(box(resumed), box(broken))
    resumed.learn(900, reset_num_timesteps=False)
    np.testing.assert_array_equal(box(resumed), box(whole))
    assert th.equal(resumed.policy.q_table, whole.policy.q_table)
    observations = np.random.default_rng(0).normal(0.0, 5.0, (20, 2)).astype(np.float32)
    np.testing.assert_array_equal(
        resumed.predict(observations, deterministic=True)[0], whole.predict(observations, deterministic=True)[0]
    )


def test_traces_do_not_outlive_the_points_they_were_set_at() -> None:
    model = make_model(KNNTD, trace_decay=1.0, gamma=1.0)
    counts = []

    def look(local: dict[str, Any], _: dict[str, Any]) -> bool:
        counts.append((not model.learner.in_episodes, model.learner.n_traced))
        return True

    model.learn(1800, callback=look)
    after = [count for (widened, _), (_, count) in itertools.pairwise(counts[1000:]) if widened]
    assert after
    assert max(after) <= 5


def test_normalised_observations_are_followed() -> None:
    venv = VecNormalize(make_venv(2))
    model = KNNTD(venv, bounds="adaptive", points=7, seed=0).learn(3000)
    last = venv.normalize_obs(venv.get_original_obs())
    assert model.policy.perceiver.sees(np.asarray(last))


def test_bounds_stay_within_the_space() -> None:
    model = KNNTD("MountainCar-v0", bounds="adaptive", seed=0)
    model.learn(5000)
    space = model.observation_space
    assert isinstance(space, spaces.Box)
    low, high = box(model)
    assert (low >= space.low).all()
    assert (high <= space.high).all()
    # A random policy covers less than half of the velocities, a better one almost all.
    assert high[1] - low[1] > 0.07


def test_finite_states_have_no_adaptive_bounds() -> None:
    with pytest.raises(ValueError, match=r"bounds must be None for a Discrete observation space.*'adaptive'"):
        KNNTD("FrozenLake-v1", bounds="adaptive")


def test_other_words_are_refused() -> None:
    with pytest.raises(ValueError, match=r"bounds must be None, 'adaptive', or a pair .*; got 'wide'"):
        KNNTD("MountainCar-v0", bounds="wide")


def test_observations_outside_the_space_do_not_widen_the_bounds() -> None:
    """Noise moves observations outside the space's bounds; this must not regrid the table at every step."""
    model = make_random()
    model.policy.perceiver.measure(th.tensor([[-40.0, -2.0], [40.0, 2.0]]))
    values = model.policy.q_table.clone()
    assert model.policy.perceiver.sees(np.array([[-41.0, 0.0], [47.0, 0.0]]))
    assert not model.policy.perceiver.sees(np.array([[-41.0, 9.0]]))
    model.policy.widen(th.tensor([[-41.0, 9.0]]))
    low, high = box(model)
    assert (low[0], high[0]) == (-40.0, 40.0)
    assert high[1] > 9.0
    assert not th.equal(model.policy.q_table, values)
