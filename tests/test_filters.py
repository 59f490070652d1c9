"""The δs filter: equals Algorithm 5, removes noise, does no harm, and works with SB3's wrappers."""

from __future__ import annotations

import copy
import importlib
import pathlib
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from delta_filter_from_scratch import PaperFilter
from gymnasium import spaces
from knn_td_from_scratch import NearestPoints
from numpy.typing import NDArray
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecMonitor, VecNormalize
from toy_envs import DriftEnv

from sb3_knntd import KNNTD, DeltaFilter, ExA, VecDeltaFilter
from sb3_knntd.kernels import jit

ROOT = pathlib.Path(__file__).parent.parent
BOUNDS = DriftEnv.LOW, DriftEnv.HIGH
PERCEPTION: dict[str, Any] = {"points": (7, 5), "bounds": BOUNDS, "n_neighbors": 4}
PAPER: dict[str, Any] = {"learning_rate": 0.5, "gain": None, "warmup": 0.0}


class Noisy(DriftEnv):
    """A drifting point with noisy observations.

    :param continuous: whether the force is a number in [-1, 1] instead of one of three
    """

    def __init__(self, offset: float = 0.0, noise: float = 0.02, continuous: bool = False, **episodes: Any) -> None:
        super().__init__(offset, **episodes)
        self.random = np.random.default_rng(int(1000 * offset))
        self.noise = noise * (self.HIGH - self.LOW)
        self.continuous = continuous
        if continuous:
            self.action_space = spaces.Box(-1.0, 1.0, (1,))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return super().step(round(1.0 + float(action[0])) if self.continuous else action)

    def _observe(self) -> NDArray[np.float32]:
        return (super()._observe() + self.noise * self.random.standard_normal(2)).astype(np.float32)


class Linear(gym.Env[np.ndarray, int]):
    """A random walk in two dimensions, observed with noise of variance 1.

    :param steps: standard deviations of a step, shape (2,)
    """

    def __init__(self, steps: Any) -> None:
        self.observation_space = spaces.Box(-200.0, 200.0, (2,))
        self.action_space = spaces.Discrete(1)
        self.steps = np.asarray(steps)
        self.random = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.state = np.zeros(2)
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.state = self.state + self.steps * self.random.standard_normal(2)
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> NDArray[np.float32]:
        return (self.state + self.random.standard_normal(2)).astype(np.float32)


class Broken(Noisy):
    """
    Returns a given value in an observation after a number of steps: in that of the last step, or in that of the next
    reset. Episodes have five steps.
    """

    def __init__(self, at: int, in_reset: bool, value: float) -> None:
        super().__init__(lengths=(5,), ends=("terminated",))
        self.at, self.in_reset, self.value, self.n_steps = at, in_reset, value, 0

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = super().reset(**arguments)
        return self._break(observation, True), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        observation, *rest = super().step(action)
        return self._break(observation, False), *rest  # type: ignore[return-value]

    def _break(self, observation: NDArray[np.float32], in_reset: bool) -> NDArray[np.float32]:
        if self.n_steps == self.at and in_reset == self.in_reset:
            observation[1] = self.value
        return observation


def make_venv(n_envs: int = 1, **arguments: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda i=i: Monitor(Noisy(0.23 * i, **arguments)) for i in range(n_envs)])


def walk(venv: VecEnv, n_steps: int, seed: int = 0) -> tuple[list[Any], list[Any], list[Any], list[Any]]:
    """Random actions; returns observations, actions, dones and infos of every step, the reset's observations first."""
    random = np.random.default_rng(seed)
    observations, actions, dones, infos = [venv.reset()], [], [], []
    for _ in range(n_steps):
        if isinstance(venv.action_space, spaces.Discrete):
            actions.append(random.integers(venv.action_space.n, size=venv.num_envs))
        else:
            actions.append(random.uniform(-1.0, 1.0, (venv.num_envs, 1)).astype(np.float32))
        seen, _, done, info = venv.step(actions[-1])
        observations.append(seen)
        dones.append(done)
        infos.append(info)
    return observations, actions, dones, infos


def table_of(filtered: DeltaFilter | VecDeltaFilter) -> dict[str, Any]:
    return copy.deepcopy(filtered.table.state_dict())


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(
        same(value, other[key])
        if isinstance(value, dict)
        else (th.equal(value, other[key]) if isinstance(value, th.Tensor) else value == other[key])
        for key, value in one.items()
    )


# ------------------------------------------------------------------------------------------------- Algorithm 5


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("update", [None, "averaging"])
@pytest.mark.parametrize("reference", ["filtered", "observed"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_equals_algorithm_5(n_envs: int, reference: str, update: str | None, compiled: bool) -> None:
    venv = VecDeltaFilter(
        make_venv(n_envs), reference=reference, update=update, compiled=compiled, **PERCEPTION, **PAPER
    )
    model = PaperFilter(NearestPoints((7, 5), BOUNDS, 4), 3, 2, own_errors=update == "averaging")
    observations, actions, dones, infos = walk(venv, 60)
    last = [raw.copy() for raw in observations[0]]
    for seen, action, done, info in zip(observations[1:], actions, dones, infos, strict=True):
        for env in range(n_envs):
            arrived = info[env]["raw_terminal_observation" if done[env] else "raw_observation"]
            expected = model(last[env], action[env], arrived, 0.5)
            returned = info[env]["terminal_observation"] if done[env] else seen[env]
            np.testing.assert_allclose(returned, expected, rtol=0, atol=1e-6)
            if done[env]:
                np.testing.assert_array_equal(seen[env], info[env]["raw_observation"])
            last[env] = seen[env] if done[env] else (expected if reference == "filtered" else arrived)
    np.testing.assert_allclose(venv.table.deltas, model.delta, rtol=0, atol=1e-9)


def test_the_environment_wrapper_equals_the_vec_wrapper() -> None:
    env, venv = DeltaFilter(Noisy(), **PERCEPTION), VecDeltaFilter(make_venv(), **PERCEPTION)
    observations, actions, dones, infos = walk(venv, 80)
    seen, info = env.reset()
    for row, action, done, vec_info in zip(observations[1:], actions, dones, infos, strict=True):
        seen, _, terminated, truncated, info = env.step(action[0])
        raw = info["raw_observation"]
        assert (terminated or truncated) == done[0]
        if done[0]:
            np.testing.assert_array_equal(seen, vec_info[0]["terminal_observation"])
            np.testing.assert_array_equal(raw, vec_info[0]["raw_terminal_observation"])
            seen, info = env.reset()
            raw = info["raw_observation"]
        np.testing.assert_array_equal(seen, row[0])
        np.testing.assert_array_equal(raw, vec_info[0]["raw_observation"])
        np.testing.assert_array_equal(env.get_original_obs(), raw)
    assert same(table_of(env), table_of(venv))


def test_a_schedule_runs_over_its_steps() -> None:
    arguments = {**PERCEPTION, **PAPER, "learning_rate": lambda progress: progress, "total_timesteps": 40}
    env = DeltaFilter(Noisy(lengths=(100,)), **arguments)
    model = PaperFilter(NearestPoints((7, 5), BOUNDS, 4), 3, 2)
    last, _ = env.reset()
    for step in range(50):
        seen, _, _, _, info = env.step(step % 3)
        last = model(last, step % 3, info["raw_observation"], max(1.0 - step / 40, 0.0))
        np.testing.assert_allclose(seen, last, rtol=0, atol=1e-6)


# --------------------------------------------------------------------------------------- two ways, one answer

SETTINGS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "gain": {"gain": 0.2, "learning_rate": 0.1},
    "gains": {"gain": [0.2, 0.5], "update": "gradient"},
    "observed": {"reference": "observed", "gain": 0.5},
    "warmup": {"warmup": 4.0},
    "gaussian": {"weights": "gaussian", "bandwidth": 0.2},
    "brute": {"search": "brute"},
    "kd_tree": {"search": "kd_tree", "points": np.random.default_rng(5).uniform(*BOUNDS, size=(60, 2))},
    "adaptive": {"bounds": "adaptive"},
}


@pytest.mark.skipif(not jit.AVAILABLE, reason="needs numba")
@pytest.mark.parametrize("name", SETTINGS)
def test_the_compiled_step_equals_numpy(name: str) -> None:
    arguments = {**PERCEPTION, **SETTINGS[name]}
    seen = []
    for compiled in (True, False):
        venv = VecDeltaFilter(make_venv(3), compiled=compiled, **arguments)
        venv.table.n_measured = 900  # few steps are left to measure adaptive bounds
        observations = walk(venv, 400)[0]
        venv.training = False
        seen.append(observations + walk(venv, 20, seed=1)[0])
        assert venv._observer.is_compiled == compiled
    np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-6)
    assert not np.array_equal(seen[0][-1], venv.get_original_obs())


def test_weights_can_be_a_function() -> None:
    own = VecDeltaFilter(make_venv(2), weights=lambda squared: 1.0 / (1.0 + squared), **PERCEPTION)
    built_in = VecDeltaFilter(make_venv(2), **PERCEPTION)
    np.testing.assert_allclose(walk(own, 100)[0], walk(built_in, 100)[0], rtol=0, atol=1e-6)


def test_without_numba_it_warns_and_works(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = walk(VecDeltaFilter(make_venv(), **PERCEPTION), 50)[0]
    monkeypatch.setattr(jit, "AVAILABLE", False)
    with pytest.warns(UserWarning, match="numba cannot be used"):
        venv = VecDeltaFilter(make_venv(), **PERCEPTION)
    np.testing.assert_allclose(walk(venv, 50)[0], expected, rtol=0, atol=1e-6)


# ------------------------------------------------------------------------------------------- what it is good for


@pytest.mark.parametrize("steps", [(0.1, 0.5), (0.3, 3.0)])
def test_the_adapted_gain_is_that_of_a_kalman_filter(steps: tuple[float, float]) -> None:
    env = DeltaFilter(Linear(steps), points=1, n_neighbors=1)
    env.reset()
    gains = []
    for _ in range(20_000):
        env.step(0)
        gains.append(env.table.gains.copy())
    # Steady state of a random walk, by its Riccati equation; variances over that of the noise.
    process = np.square(steps)
    predicted = (process + np.sqrt(process**2 + 4 * process)) / 2
    np.testing.assert_allclose(np.mean(gains[10_000:], axis=0), predicted / (predicted + 1), rtol=0, atol=0.05)


def test_an_episode_starts_with_the_error_of_one_observation() -> None:
    env = DeltaFilter(Linear((0.01, 0.01)), points=1, n_neighbors=1)
    env.reset()
    for _ in range(5000):
        env.step(0)
    assert (env.table.gains < 0.2).all()
    env.training = False
    first, _ = env.reset()
    seen = [first]
    for step in range(2, 6):
        estimate, _, _, _, info = env.step(0)
        seen.append(info["raw_observation"])
        # Nearly the mean of all observations, as long as the state has hardly changed.
        np.testing.assert_allclose(estimate, np.mean(seen, axis=0), rtol=0, atol=0.25)
        assert len(seen) == step


def test_innovations_of_different_episodes_are_not_correlated() -> None:
    venv = VecDeltaFilter(make_venv(2, lengths=(1,)), **PERCEPTION)
    walk(venv, 300)
    assert venv.table.counts[0] > 100
    np.testing.assert_array_equal(venv.table.gains, 1.0)


@pytest.fixture
def noise(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The benchmark module; benchmarks run from the repository root and are not installed."""
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("benchmarks.noise")


def test_it_removes_noise_early(noise: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noise, "EVALUATION", 5_000)
    assert (noise.error_ratio("filter", noise.CASES[0], seed=0, learning=15_000) < 0.45).all()


@pytest.mark.slow
def test_it_removes_more_than_half_of_the_noise(noise: Any) -> None:
    for case in noise.CASES:
        ratios = np.median([noise.error_ratio("filter", case, seed) for seed in range(10)], axis=0)
        assert (ratios <= 0.45).all(), (case.env_id, ratios)
        plain = np.median([noise.error_ratio("algorithm 5", case, seed) for seed in range(3)], axis=0)
        assert (ratios < plain).all()


@pytest.mark.parametrize("n_envs", [1, 4])
def test_without_noise_observations_pass(n_envs: int) -> None:
    venv = VecDeltaFilter(make_vec_env("MountainCar-v0", n_envs, seed=0))
    venv.reset()
    width = venv.observation_space.high - venv.observation_space.low
    off = []
    for _ in range(4000):
        seen, _, _, _ = venv.step(np.where(venv.get_original_obs()[:, 1] >= 0, 2, 0))
        off.append(np.abs(seen - venv.get_original_obs()) / width)
    assert np.mean(off) < 1e-4
    assert np.max(off) < 0.01


def test_many_environments_learn_as_stably_as_one(noise: Any) -> None:
    case = noise.CASES[0]
    venv = VecDeltaFilter(noise.make_noisy(case, 16, 0, True))
    venv.reset()
    errors = []
    for step in range(1000):
        true = np.array(venv.env_method("get_wrapper_attr", "true"))
        seen, _, dones, _ = venv.step(np.where(true[:, 1] >= 0, 2, 0))
        if step > 800:
            errors.append((seen - np.array(venv.env_method("get_wrapper_attr", "true")))[~dones])
    assert (np.sqrt(np.square(np.concatenate(errors)).mean(axis=0)) < 0.45 * case.scale).all()


# ----------------------------------------------------------------------------------------- a wrapper among others


def test_frozen_it_filters_and_does_not_learn() -> None:
    venv = VecDeltaFilter(make_venv(2), **PERCEPTION)
    walk(venv, 300)
    venv.training = False
    before = table_of(venv)
    observations = walk(venv, 100)[0]
    assert same(before, table_of(venv))
    assert not np.array_equal(observations[-1], venv.get_original_obs())
    venv.training = True
    walk(venv, 10)
    assert not same(before, table_of(venv))


def test_frozen_algorithm_5_still_follows_observations() -> None:
    venv = VecDeltaFilter(make_venv(lengths=(100_000,)), **PERCEPTION, **PAPER)
    walk(venv, 500)
    venv.training = False
    errors = []
    venv.reset()
    for step in range(300):
        seen = venv.step(np.array([step % 3]))[0]
        errors.append(np.abs(seen - venv.get_original_obs()) / (DriftEnv.HIGH - DriftEnv.LOW))
    assert np.mean(errors[200:]) < 0.1


def test_before_warmup_observations_pass_unchanged() -> None:
    venv = VecDeltaFilter(make_venv(), warmup=1e9, **PERCEPTION)
    observations, _, _, infos = walk(venv, 50)
    for seen, info in zip(observations[1:], infos, strict=True):
        np.testing.assert_array_equal(seen[0], info[0]["raw_observation"])
    assert venv.table.visits.sum() == pytest.approx(50)


def test_unbounded_ranges_are_measured_first() -> None:
    env = DeltaFilter(gym.make("CartPole-v1"))
    env.reset(seed=0)
    env.action_space.seed(0)
    seen = []
    for step in range(1200):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        seen.append(observation)
        if step < 1000:
            np.testing.assert_array_equal(observation, info["raw_observation"])
        if step == 999:
            assert not env.table.visits.any()
        if terminated or truncated:
            env.reset()
    low, high = env.table.perceiver.bounds.low.numpy(), env.table.perceiver.bounds.high.numpy()
    reached = np.array(seen[:1000])
    margin = 0.25 * (reached.max(axis=0) - reached.min(axis=0))
    np.testing.assert_allclose(low[[1, 3]], (reached.min(axis=0) - margin)[[1, 3]], rtol=1e-6)
    np.testing.assert_allclose(high[[1, 3]], (reached.max(axis=0) + margin)[[1, 3]], rtol=1e-6)
    np.testing.assert_allclose(high[[0, 2]], env.observation_space.high[[0, 2]], rtol=1e-6)
    assert env.table.visits.any()


def test_adaptive_bounds_keep_learned_values() -> None:
    env = DeltaFilter(Linear((0.1, 0.1)), bounds="adaptive", points=5, n_neighbors=4)
    env.table.n_measured = 999
    env.reset()
    env.step(0)
    table = env.table
    table.deltas[:] = table.perceiver.points.coordinates(table.perceiver.bounds)[:, None].numpy()
    low = table.perceiver.bounds.low.clone()
    table.visits[:] = 3.0
    table.follow(np.array([[50.0, 0.0]]))
    assert table.perceiver.sees(np.array([[50.0, 0.0]]))
    assert th.equal(table.perceiver.bounds.low, low)
    np.testing.assert_allclose(table.visits, 3.0)
    # In the second dimension the values changed only by the interpolation.
    np.testing.assert_allclose(table.deltas[:, 0, 1].reshape(5, 5)[0, [0, 4]], [-1.0, 1.0], atol=0.5)


def test_box_actions_are_mapped_to_the_nearest_points() -> None:
    space = spaces.Box(np.float32([-1, 0]), np.float32([1, 10]))
    env = Noisy()
    env.action_space = space
    table = DeltaFilter(env, action_points=[[-1.0, 0.0, 1.0], [0.0, 2.0, 10.0]]).table
    actions = [[-0.9, 0.1], [-0.4, 0.9], [0.6, 1.1], [0.4, 5.9], [0.4, 6.1]]
    assert table.columns(np.float32(actions)).tolist() == [0, 3, 7, 4, 5]


def test_actions_that_do_not_start_at_zero() -> None:
    env = gym.wrappers.TransformAction(Noisy(), lambda action: action - 5, spaces.Discrete(3, start=5))
    filtered = DeltaFilter(env, **PERCEPTION)
    filtered.reset()
    filtered.step(7)
    assert filtered.table.visits.sum(axis=0).tolist() == pytest.approx([0.0, 0.0, 1.0])


def test_get_original_obs_before_reset() -> None:
    for filtered in (DeltaFilter(Noisy()), VecDeltaFilter(make_venv())):
        with pytest.raises(ValueError, match="call reset first"):
            filtered.get_original_obs()


def test_an_evaluation_filter_shares_the_table() -> None:
    venv = VecDeltaFilter(make_venv(2), **PERCEPTION)
    evaluation = venv.for_evaluation(make_venv(3))
    assert not evaluation.training
    walk(venv, 100)
    before = table_of(venv)
    assert same(before, table_of(evaluation))
    observations = walk(evaluation, 30)[0]
    assert same(before, table_of(venv))
    assert not np.array_equal(observations[-1], evaluation.get_original_obs())
    env = DeltaFilter(Noisy(), **PERCEPTION)
    other = env.for_evaluation(Noisy(0.5))
    assert other.table is env.table
    assert not other.training
    with pytest.raises(ValueError, match="action space"):
        env.for_evaluation(Noisy(continuous=True))


STACKS: dict[str, Callable[[], VecEnv]] = {
    "VecNormalize outside": lambda: VecNormalize(VecDeltaFilter(make_venv(2))),
    "VecFrameStack outside": lambda: VecFrameStack(VecDeltaFilter(make_venv(2)), 3),
    "VecFrameStack inside": lambda: VecDeltaFilter(VecFrameStack(make_venv(2), 3)),
    "VecMonitor outside": lambda: VecMonitor(VecDeltaFilter(DummyVecEnv([Noisy, Noisy]))),
    "VecMonitor inside": lambda: VecDeltaFilter(VecMonitor(DummyVecEnv([Noisy, Noisy]))),
    "Monitor outside": lambda: DummyVecEnv([lambda: Monitor(DeltaFilter(Noisy()))]),
    "Monitor inside": lambda: DummyVecEnv([lambda: DeltaFilter(Monitor(Noisy()))]),
    "all": lambda: VecFrameStack(VecNormalize(VecMonitor(VecDeltaFilter(DummyVecEnv([Noisy])))), 2),
}


@pytest.mark.parametrize("name", STACKS)
def test_stacks_with_other_wrappers(name: str) -> None:
    venv = STACKS[name]()
    observations, _, dones, infos = walk(venv, 60)
    for seen, done, info in zip(observations[1:], dones, infos, strict=True):
        assert seen.shape == (venv.num_envs, *venv.observation_space.shape)
        for env in np.flatnonzero(done):
            assert info[env]["terminal_observation"].shape == venv.observation_space.shape
            assert "episode" in info[env]
    assert np.concatenate(dones).any()


def test_vec_normalize_outside_gets_filtered_observations() -> None:
    venv = VecNormalize(VecDeltaFilter(make_venv(2), **PERCEPTION))
    walk(venv, 200)
    raw = venv.venv.get_original_obs()
    assert not np.array_equal(venv.get_original_obs(), raw)
    assert np.abs(venv.get_original_obs() - raw).max() < 0.5


def test_vec_normalize_inside_works_and_warns() -> None:
    with pytest.warns(UserWarning, match=r"Better VecNormalize\(VecDeltaFilter\(venv\)\)"):
        venv = VecDeltaFilter(VecNormalize(make_venv(2)))
    walk(venv, 100)
    # The space does not give the range of normalised observations.
    assert venv.table.must_measure(2)
    walk(venv, 500)
    assert not venv.table.must_measure(2)
    assert venv.table.visits.any()


@pytest.mark.parametrize(
    ("algorithm", "continuous"),
    [("KNNTD", False), ("DQN", False), ("PPO", False), ("ExA", True), ("SAC", True), ("PPO", True)],
)
def test_works_with_every_algorithm(algorithm: str, continuous: bool) -> None:
    venv = VecDeltaFilter(make_venv(continuous=continuous), **PERCEPTION)
    makers: dict[str, Callable[[], Any]] = {
        "KNNTD": lambda: KNNTD(venv, points=5, seed=0),
        "ExA": lambda: ExA(venv, points=5, seed=0),
        "DQN": lambda: DQN("MlpPolicy", venv, learning_starts=20, seed=0),
        "SAC": lambda: SAC("MlpPolicy", venv, learning_starts=90, seed=0),
        "PPO": lambda: PPO("MlpPolicy", venv, n_steps=50, batch_size=50, n_epochs=1, seed=0),
    }
    model = makers[algorithm]()
    callback = EvalCallback(venv.for_evaluation(make_venv(continuous=continuous)), eval_freq=40, verbose=0)
    model.learn(100, callback=callback)
    assert venv.table.n_steps == 100
    assert np.isfinite(callback.last_mean_reward)


def test_gymnasium_can_recreate_it() -> None:
    env = DeltaFilter(gym.make("MountainCar-v0"), points=6, gain=0.3)
    assert env.spec is not None
    again = gym.make(env.spec)
    assert isinstance(again, DeltaFilter)
    assert again.table.arguments == env.table.arguments


# --------------------------------------------------------------------------------------------- saving and loading


@pytest.mark.parametrize("name", ["defaults", "kd_tree", "gain", "adaptive"])
def test_save_and_load_round_trip(name: str, tmp_path: pathlib.Path) -> None:
    venv = VecDeltaFilter(make_venv(2), **{**PERCEPTION, **SETTINGS[name]})
    venv.table.n_measured = 900
    walk(venv, 300)
    venv.save(tmp_path / "some" / "filter")
    loaded = VecDeltaFilter.load(tmp_path / "some" / "filter", make_venv(2))
    assert loaded.training
    assert same(table_of(venv), table_of(loaded))
    venv.set_venv(make_venv(2))
    np.testing.assert_array_equal(walk(venv, 100)[0], walk(loaded, 100)[0])
    assert same(table_of(venv), table_of(loaded))


def test_a_filter_of_one_kind_loads_into_the_other(tmp_path: pathlib.Path) -> None:
    env = DeltaFilter(Noisy(), training=False, **PERCEPTION)
    env.reset()
    env.save(tmp_path / "filter.zip")
    venv = VecDeltaFilter.load(tmp_path / "filter.zip", make_venv(3))
    assert not venv.training
    assert same(table_of(env), table_of(venv))
    venv.save(tmp_path / "other")
    assert same(table_of(DeltaFilter.load(tmp_path / "other", Noisy())), table_of(venv))


def test_a_saved_filter_does_not_measure_again(tmp_path: pathlib.Path) -> None:
    venv = VecDeltaFilter(make_vec_env("CartPole-v1", 4, seed=0), points=4)
    walk(venv, 400)
    venv.save(tmp_path / "filter")
    loaded = VecDeltaFilter.load(tmp_path / "filter", make_vec_env("CartPole-v1", 2, seed=0))
    assert not loaded.table.must_measure(2)
    assert th.equal(loaded.table.perceiver.bounds.low, venv.table.perceiver.bounds.low)


def test_weights_and_schedules_are_saved(tmp_path: pathlib.Path) -> None:
    arguments: dict[str, Any] = {
        **PERCEPTION,
        "weights": lambda squared: 1.0 / (0.1 + squared),
        "learning_rate": lambda progress: 0.2 * progress,
        "total_timesteps": 500,
    }
    venv = VecDeltaFilter(make_venv(), **arguments)
    walk(venv, 100)
    venv.save(tmp_path / "filter")
    loaded = VecDeltaFilter.load(tmp_path / "filter", make_venv(), trusted=True)
    assert loaded.table.rate() == pytest.approx(0.2 * 0.8)
    venv.set_venv(make_venv())
    np.testing.assert_array_equal(walk(venv, 50)[0], walk(loaded, 50)[0])


def test_pickles_as_vec_normalize_does() -> None:
    venv = VecDeltaFilter(make_venv(2), training=False, **PERCEPTION)
    venv.training = True
    walk(venv, 100)
    loaded = pickle.loads(pickle.dumps(venv))
    loaded.set_venv(make_venv(2))
    venv.set_venv(make_venv(2))
    np.testing.assert_array_equal(walk(venv, 50)[0], walk(loaded, 50)[0])
    assert same(table_of(venv), table_of(loaded))


def test_a_file_of_other_spaces_is_refused(tmp_path: pathlib.Path) -> None:
    VecDeltaFilter(make_venv(), **PERCEPTION).save(tmp_path / "filter")
    with pytest.raises(ValueError, match="action space"):
        VecDeltaFilter.load(tmp_path / "filter", make_venv(continuous=True))
    with pytest.raises(ValueError, match="observation space"):
        DeltaFilter.load(tmp_path / "filter", gym.make("MountainCar-v0"))


def test_another_file_is_refused(tmp_path: pathlib.Path) -> None:
    KNNTD(make_venv(), points=4).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="holds no filter"):
        VecDeltaFilter.load(tmp_path / "model.zip", make_venv())
    VecDeltaFilter(make_venv(), **PERCEPTION).save(tmp_path / "filter.zip")
    with pytest.raises(ValueError, match="not of KNNTD"):
        KNNTD.load(tmp_path / "filter.zip")
    content = (tmp_path / "filter.zip").read_bytes()
    (tmp_path / "half.zip").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="cut off"):
        VecDeltaFilter.load(tmp_path / "half.zip", make_venv())
    with pytest.raises(FileNotFoundError):
        VecDeltaFilter.load(tmp_path / "none.zip", make_venv())


# ------------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("at", "in_reset"), [(0, True), (3, False), (5, False), (5, True)])
def test_nonfinite_observations_are_refused_and_not_learned(at: int, in_reset: bool, value: float) -> None:
    """In the first reset, in the middle and at the end of an episode, and in the next reset."""
    venv = VecDeltaFilter(DummyVecEnv([Noisy, lambda: Broken(at, in_reset, value)]), **PERCEPTION)
    env: Any = DeltaFilter(Broken(at, in_reset, value), **PERCEPTION)
    for filtered, row, step in ((venv, 1, partial(venv.step, np.array([1, 1]))), (env, 0, partial(env.step, 1))):
        moves = [filtered.reset, *[step] * at]
        if filtered is env and in_reset and at:
            moves.append(env.reset)
        for move in moves[:-1]:
            move()
        before = table_of(filtered)
        with pytest.raises(ValueError, match=f"environment {row} returned an observation that is not finite"):
            moves[-1]()
        assert same(before, table_of(filtered))
    env.unwrapped.at = -1
    env.reset()
    assert np.isfinite(env.step(1)[0]).all()


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "learning_rate word": ({"learning_rate": "counts"}, "learning_rate.*'count'"),
    "learning_rate": ({"learning_rate": 1.5}, r"learning_rate must be a finite number in \[0, 1\]; got 1.5"),
    "schedule": ({"learning_rate": lambda progress: 0.1}, "total_timesteps must be given"),
    "total_timesteps": ({"learning_rate": lambda _: 0.1, "total_timesteps": 0}, "total_timesteps must be an integer"),
    "update": ({"update": "mean"}, "update must be one of 'averaging', 'gradient'"),
    "reference": ({"reference": "raw"}, "reference must be one of 'filtered', 'observed'"),
    "gain word": ({"gain": "kalman"}, "gain.*'adaptive'"),
    "gain": ({"gain": 0.0}, r"gain must be 'adaptive', None, a number in \(0, 1\]"),
    "gains": ({"gain": [0.1, 0.2, 0.3]}, "one for each of the 2 observation dimensions"),
    "no gain": ({"gain": None}, "learning_rate='count' makes ever weaker"),
    "adaptive gain": ({"reference": "observed"}, "gain='adaptive' needs reference='filtered'"),
    "warmup": ({"warmup": -1}, "warmup must be a finite number"),
    "compiled": ({"compiled": "yes"}, "compiled must be True or False"),
    "training word": ({"training": "no"}, "training must be True or False; got 'no'"),
    "training number": ({"training": 0.5}, "training must be True or False; got 0.5"),
    "training NaN": ({"training": np.nan}, "training must be True or False; got nan"),
    "training None": ({"training": None}, "training must be True or False; got None"),
    "truth for a number": ({"warmup": True}, "warmup must be a finite number.*True"),
    "bytes for a number": ({"bandwidth": b"1"}, "bandwidth must be a finite number.*b'1'"),
    "words for gains": ({"gain": ["0.1", "0.2"]}, "gain must be 'adaptive'"),
    "truth for a gain": ({"gain": np.True_}, "gain must be 'adaptive'"),
    "complex gain": ({"gain": 0.5j}, "gain must be 'adaptive'"),
    "tiny bandwidth": ({"bandwidth": 1e-320}, "bandwidth must be a finite number"),
    "complex points": ({"points": [[0j, 1j], [1j, 0j]]}, "points.*numbers"),
    "words for bounds": ({"bounds": (["0", "0"], ["1", "1"])}, "bounds must be None"),
    "n_neighbors": ({"n_neighbors": 0}, "n_neighbors must be an integer >= 1"),
    "points": ({"points": (3, 4, 5)}, "points: one int for each of the 2"),
    "too many points": ({"points": 50_000}, "points: a table of 2,500,000,000 points"),
    "bounds": ({"bounds": ([0, 0], [1, -1])}, "bounds: low must be below high"),
    "weights": ({"weights": "linear"}, "weights must be one of"),
    "bandwidth": ({"bandwidth": 0}, "bandwidth must be a finite number"),
    "search": ({"search": "grid"}, "search must be one of"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_argument_is_named(name: str) -> None:
    arguments, message = BAD[name]
    for make in (lambda: DeltaFilter(Noisy(), **arguments), lambda: VecDeltaFilter(make_venv(), **arguments)):
        with pytest.raises(ValueError, match=message):
            make()


def test_bad_action_points_are_named() -> None:
    with pytest.raises(ValueError, match="action_points must be an integer >= 2"):
        DeltaFilter(Noisy(continuous=True), action_points=1)


@pytest.mark.parametrize(
    ("space", "advice"),
    [
        (spaces.Discrete(4), "no differences"),
        (spaces.MultiBinary(4), "no differences"),
        (spaces.Dict({"a": spaces.Box(0.0, 1.0, (2,))}), "FlattenObservation"),
        (spaces.Box(0, 255, (8, 8, 3), np.uint8), "FlattenObservation"),
        (spaces.Box(0, 9, (2,), np.int64), "DtypeObservation"),
    ],
)
def test_unsupported_observation_spaces(space: spaces.Space[Any], advice: str) -> None:
    env = Noisy()
    env.observation_space = space
    for make in (lambda: DeltaFilter(env), lambda: VecDeltaFilter(DummyVecEnv([lambda: env]))):
        with pytest.raises(ValueError, match=rf"Box of shape \(n,\).*{advice}"):
            make()


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.MultiBinary(2), "must be Discrete or Box"),
        (spaces.MultiDiscrete([2, 2]), "must be Discrete or Box"),
        (spaces.Box(-np.inf, np.inf, (1,)), "finite bounds"),
    ],
)
def test_unsupported_action_spaces(space: spaces.Space[Any], message: str) -> None:
    env = Noisy()
    env.action_space = space
    with pytest.raises(ValueError, match=message):
        DeltaFilter(env)


def test_an_action_outside_of_the_space_is_refused() -> None:
    env = DeltaFilter(Noisy(), **PERCEPTION)
    env.reset()
    before = table_of(env)
    with pytest.raises(ValueError, match=r"actions must be in Discrete\(3\); got \[3\]"):
        env.step(3)
    assert same(before, table_of(env))
    env = DeltaFilter(Noisy(continuous=True), **PERCEPTION)
    env.reset()
    with pytest.raises(ValueError, match="actions must be finite"):
        env.step(np.float32([np.nan]))
