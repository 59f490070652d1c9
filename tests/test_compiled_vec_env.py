"""The compiled environments of the paper return what the Python ones return, bit for bit."""

from __future__ import annotations

import pathlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_knntd.envs  # noqa: F401
from sb3_knntd import KNNTD, ExA
from sb3_knntd.envs.mountain_car import MountainCarEnv
from sb3_knntd.vec_envs import CompiledVecEnv

N_ENVS = 5
ENVS: list[tuple[str, dict[str, Any]]] = [
    ("MountainCar", {}),
    ("MountainCar", {"start": "anywhere", "reward": "goal", "max_episode_steps": 40}),
    ("MountainCar", {"start": "uniform", "noise": 0.05, "max_episode_steps": 30}),
    ("CartPole", {"start": "uniform"}),
    ("CartPole", {"n_forces": 3, "reward": "step", "failure_angle": 45.0, "track": 0.5, "max_episode_steps": 60}),
    ("CartPole", {"reward": "failure", "noise": [0.1, 0.0, 0.0, 0.2]}),
    ("ContinuousCartPole", {"start": "uniform"}),
    ("Acrobot", {"max_episode_steps": 50}),
    ("Acrobot", {"dynamics": "nips", "start": "uniform", "reward": "goal", "max_episode_steps": 300}),
]


def pair(name: str, kwargs: dict[str, Any], n_envs: int = N_ENVS) -> list[VecEnv]:
    """The same environments stepped by Python and compiled."""
    return [
        make_vec_env(f"sb3_knntd/{name}-v0", n_envs, seed=4, env_kwargs=kwargs, vec_env_cls=kind)
        for kind in (DummyVecEnv, CompiledVecEnv)
    ]


def comparable(infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Infos without the time since the environments were made."""
    for info in infos:
        info.get("episode", {}).pop("t", None)
    return infos


@pytest.mark.parametrize(("name", "kwargs"), ENVS)
def test_every_step_is_that_of_dummy_vec_env(name: str, kwargs: dict[str, Any]) -> None:
    alone, together = pair(name, kwargs)
    np.testing.assert_array_equal(alone.reset(), together.reset())
    alone.action_space.seed(0)
    n_ended = 0
    for _ in range(600):
        actions = np.array([alone.action_space.sample() for _ in range(N_ENVS)])
        # Larger forces than the largest are clipped.
        actions = 1.2 * actions if name == "ContinuousCartPole" else actions
        *ones, ones_infos = alone.step(actions)
        *others, others_infos = together.step(actions)
        for one, other in zip(ones, others, strict=True):
            assert isinstance(one, np.ndarray)
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
        np.testing.assert_equal(comparable(others_infos), comparable(ones_infos))
        n_ended += int(ones[2].sum())
    assert n_ended > 0 or kwargs == {}
    for method in ("get_episode_rewards", "get_episode_lengths"):
        assert alone.env_method(method) == together.env_method(method)


def test_models_learn_the_same_tables() -> None:
    for algorithm, name in ((KNNTD, "CartPole"), (ExA, "ContinuousCartPole")):
        tables = [algorithm(venv, points=5, seed=1).learn(5000).policy.q_table for venv in pair(name, {})]
        assert tables[0].any()
        np.testing.assert_array_equal(tables[0], tables[1])


def test_environments_can_be_read_and_moved_between_steps() -> None:
    for venv in pair("MountainCar", {"max_episode_steps": 9}, n_envs=2):
        venv.reset()
        for _ in range(4):
            venv.step(np.array([2, 0]))
        states = venv.get_attr("state")
        assert states[0][1] > 0 > states[1][1]
        images = venv.get_images()
        assert images[0] is not None
        assert images[0].shape == (400, 600, 3)
        # The first episode starts anew elsewhere, the second goes on.
        venv.env_method("reset", indices=0, options={"state": (-0.9, 0.0)})
        observations, _, _, _ = venv.step(np.array([2, 2]))
        np.testing.assert_allclose(observations[0], [-0.9, 0.0], atol=0.01)
        *_, infos = [venv.step(np.array([1, 1])) for _ in range(4)][-1]
        venv.get_attr("unwrapped")[1].reward = "goal"
        assert venv.step(np.array([1, 1]))[1].tolist() == [-1.0, 0.0]
        assert "episode" not in infos[0]
        assert infos[1]["episode"]["l"] == 9


def test_pictures_are_those_of_the_environments() -> None:
    for name in ("MountainCar", "CartPole", "Acrobot"):
        pictures = []
        for venv in pair(name, {}, n_envs=1):
            venv.reset()
            for _ in range(3):
                venv.step(np.array([2]))
            pictures.append(venv.render("rgb_array"))
        np.testing.assert_array_equal(*pictures)


def test_monitor_files(tmp_path: pathlib.Path) -> None:
    rows = []
    for kind in (DummyVecEnv, CompiledVecEnv):
        folder = str(tmp_path / kind.__name__)
        kwargs = {"max_episode_steps": 5}
        venv = make_vec_env("sb3_knntd/MountainCar-v0", 2, monitor_dir=folder, vec_env_cls=kind, env_kwargs=kwargs)
        KNNTD(venv, seed=0).learn(40)
        venv.close()
        rows.append(load_results(folder)[["r", "l"]].to_numpy())
    assert len(rows[0]) == 8
    np.testing.assert_array_equal(rows[0], rows[1])


def test_other_algorithms() -> None:
    venv = make_vec_env("sb3_knntd/CartPole-v0", 2, vec_env_cls=CompiledVecEnv)
    model = PPO("MlpPolicy", venv, n_steps=32, batch_size=32, n_epochs=1, device="cpu").learn(128)
    assert len(model.ep_info_buffer or ()) > 0


class Heavier(MountainCarEnv):
    """A subclass may have other dynamics."""


@pytest.mark.parametrize(
    ("env_fns", "says"),
    [
        ([lambda: gym.make("MountainCar-v0")], "MountainCarEnv.*DummyVecEnv"),
        ([Heavier], "Heavier.*DummyVecEnv"),
        ([lambda: gym.make("sb3_knntd/MountainCar-v0", render_mode="human")], "window"),
        ([lambda: gym.wrappers.ClipReward(gym.make("sb3_knntd/MountainCar-v0"), -1, 1)], "ClipReward.*DummyVecEnv"),
        (
            [lambda: gym.make("sb3_knntd/CartPole-v0"), lambda: gym.make("sb3_knntd/CartPole-v0", track=1.0)],
            "same spaces",
        ),
        ([lambda: Monitor(Monitor(gym.make("sb3_knntd/MountainCar-v0")))], "Monitor"),
    ],
)
def test_environments_that_it_would_step_wrongly_are_refused(env_fns: list[Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        CompiledVecEnv(env_fns)


@pytest.mark.parametrize(
    ("name", "actions"),
    [
        ("MountainCar", [0, 3]),
        ("MountainCar", [-1, 0]),
        ("Acrobot", [0.0, 1.0]),
        ("CartPole", [0, 1, 2]),
        ("ContinuousCartPole", [[0.0], [np.nan]]),
        ("ContinuousCartPole", [0.0, 1.0]),
    ],
)
def test_invalid_actions_are_refused_before_a_step_is_made(name: str, actions: Any) -> None:
    venv = pair(name, {}, 2)[1]
    venv.reset()
    before = venv.get_attr("state")
    with pytest.raises(ValueError, match="action"):
        venv.step(np.array(actions))
    assert venv.get_attr("state") == before


def test_rl_zoo_s_time_limit_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """RL Zoo puts a class of its own in the place of gymnasium's."""
    limit = type("PatchedTimeLimit", (gym.wrappers.TimeLimit,), {})
    monkeypatch.setattr("gymnasium.wrappers.TimeLimit", limit)
    alone, together = pair("MountainCar", {"max_episode_steps": 30})
    np.testing.assert_array_equal(alone.reset(), together.reset())
    n_ended = 0
    for _ in range(100):
        one, other = alone.step(np.ones(N_ENVS, np.int64)), together.step(np.ones(N_ENVS, np.int64))
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[2], other[2])
        n_ended += one[2].sum()
    assert n_ended >= 3 * N_ENVS
