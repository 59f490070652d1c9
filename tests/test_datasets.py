"""Learning from logged data: every form of them, and what is learned."""

from __future__ import annotations

import csv
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
import tank_level  # noqa: F401  registers the tank
import torch as th
from minari.dataset.minari_dataset import EpisodeData
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_knntd import KNNTD, ExA, KNNDyna

Act = Callable[[np.ndarray, np.random.Generator], Any]
Steps = list[tuple[np.ndarray, Any, float, np.ndarray, bool, bool]]


def walk(env_id: str, act: Act, n: int, seed: int = 0) -> tuple[Steps, float]:
    """The steps of a policy, and its mean return."""
    env, random = gym.make(env_id), np.random.default_rng(seed)
    steps, returns, running = [], [], 0.0
    observation, _ = env.reset(seed=seed)
    for _ in range(n):
        action = act(observation, random)
        after, reward, terminated, truncated, _ = env.step(action)
        steps.append((observation, action, float(reward), after, terminated, truncated))
        running += float(reward)
        observation = after
        if terminated or truncated:
            observation, _ = env.reset()
            returns.append(running)
            running = 0.0
    return steps, float(np.mean(returns))


def as_log(steps: Steps) -> dict[str, np.ndarray]:
    names = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")
    return dict(zip(names, map(np.array, zip(*steps, strict=True)), strict=True))


def any_push(observation: np.ndarray, random: np.random.Generator) -> int:
    return int(random.integers(2))


@pytest.fixture(scope="module")
def steps() -> Steps:
    return walk("CartPole-v1", any_push, 600)[0]


def learned(dataset: Any, **arguments: Any) -> th.Tensor:
    model = KNNTD("CartPole-v1", points=5, bounds={1: (-3.0, 3.0), 3: (-3.0, 3.0)}, seed=0)
    assert model.learn_from(dataset, passes=2, **arguments) is model
    return model.policy.q_table.clone()


@pytest.fixture(scope="module")
def expected(steps: Steps) -> th.Tensor:
    return learned(as_log(steps))


@pytest.mark.parametrize("optimize", [False, True])
def test_a_replay_buffer(steps: Steps, expected: th.Tensor, optimize: bool) -> None:
    env = gym.make("CartPole-v1")
    # Smaller than the data: the oldest are overwritten.
    options: dict[str, Any] = {"optimize_memory_usage": optimize, "handle_timeout_termination": not optimize}
    buffer = ReplayBuffer(600 + optimize, env.observation_space, env.action_space, **options)
    for observation, action, reward, after, terminated, truncated in [*steps[:100], *steps]:
        info = {"TimeLimit.truncated": truncated and not terminated}
        done = np.array([terminated or truncated])
        buffer.add(observation[None], after[None], np.array([action]), np.array([reward]), done, [info])
    table = learned(buffer)
    if optimize:
        # One row more than the data holds the last of those before.
        assert table.shape == expected.shape
        assert float((table - expected).abs().max()) < 10.0
    else:
        np.testing.assert_allclose(table, expected, atol=1e-9)


class Episodes:
    """A dataset as Minari's are read."""

    def __init__(self, steps: Steps) -> None:
        ends = np.flatnonzero([step[4] or step[5] for step in steps]) + 1
        self.parts = [part for part in np.split(np.arange(len(steps)), ends) if len(part)]
        self.steps = steps

    def iterate_episodes(self) -> Iterator[EpisodeData]:
        for number, part in enumerate(self.parts):
            log = as_log([self.steps[t] for t in part])
            yield EpisodeData(
                id=number,
                observations=np.concatenate((log["observations"], log["next_observations"][-1:])),
                actions=log["actions"],
                rewards=log["rewards"],
                terminations=log["terminations"],
                truncations=log["truncations"],
                infos={},
            )


def test_a_minari_dataset(steps: Steps, expected: th.Tensor) -> None:
    np.testing.assert_allclose(learned(Episodes(steps)), expected, atol=1e-9)
    with pytest.raises(ValueError, match="columns must be None"):
        learned(Episodes(steps), columns={"rewards": "r"})


def test_a_minari_dataset_by_name(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("h5py", reason="Minari stores data with it")
    pytest.importorskip("jax", reason="Minari creates datasets with it")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = minari.DataCollector(gym.make("CartPole-v1"))
    random, steps = np.random.default_rng(0), []
    observation, _ = env.reset(seed=0)
    for _ in range(300):
        action = int(random.integers(2))
        after, reward, terminated, truncated, _ = env.step(action)
        steps.append((observation, action, float(reward), after, terminated, truncated))
        observation = env.reset()[0] if terminated or truncated else after
    env.create_dataset(dataset_id="cartpole/random-v0", algorithm_name="random")
    np.testing.assert_allclose(learned("cartpole/random-v0"), learned(as_log(steps)), atol=1e-9)


def test_files(steps: Steps, expected: th.Tensor, tmp_path: pathlib.Path) -> None:
    log = as_log(steps)
    np.savez(tmp_path / "log.npz", **log)
    np.testing.assert_allclose(learned(tmp_path / "log.npz"), expected, atol=1e-9)
    names = {"observations": "o", "actions": "a", "rewards": "r", "next_observations": "n", "terminations": "d"}
    np.savez(tmp_path / "named.npz", **{names[name]: array for name, array in log.items() if name in names})
    np.testing.assert_allclose(learned(str(tmp_path / "named.npz"), columns=names), expected, atol=1e-9)
    with (tmp_path / "log.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x", "v", "angle", "turn", "push", "r", "x2", "v2", "angle2", "turn2", "fell"])
        for observation, action, reward, after, terminated, _ in steps:
            writer.writerow([*observation.tolist(), action, reward, *after.tolist(), terminated])
    columns = {
        "observations": ["x", "v", "angle", "turn"],
        "actions": "push",
        "rewards": "r",
        "next_observations": ["x2", "v2", "angle2", "turn2"],
        "terminations": "fell",
    }
    np.testing.assert_allclose(learned(tmp_path / "log.csv", columns=columns), expected, atol=1e-9)


def test_a_log_without_next_observations(steps: Steps) -> None:
    """The next row follows, and a last step whose outcome is not known is left out."""
    log = as_log(steps)
    # The episodes end in turn by termination and by truncation.
    ends = np.flatnonzero(log["terminations"])
    log["truncations"][ends[::2]], log["terminations"][ends[::2]] = True, False
    known = ~log["truncations"]
    known[-1] &= log["terminations"][-1]
    whole = {name: array[known] for name, array in log.items()}
    # The step before one that is left out is the last that is known of its episode.
    before = np.append(~known[1:], True)
    whole["truncations"] = (whole["truncations"] | before[known]) & ~whole["terminations"]
    short = {name: array for name, array in log.items() if name != "next_observations"}
    np.testing.assert_allclose(learned(short), learned(whole), atol=1e-9)


def test_data_that_do_not_fit_are_named_and_teach_nothing(steps: Steps, tmp_path: pathlib.Path) -> None:
    log = as_log(steps)
    (tmp_path / "bad.csv").write_text("x,y\n1,2\n3,four\n")
    model = KNNTD("CartPole-v1", points=5, seed=0)
    wrong: list[tuple[Any, Any, str]] = [
        ({**log, "rewards": np.full(600, np.nan)}, None, "rewards must be finite"),
        ({**log, "observations": log["observations"][:, :2]}, None, "observations must have shape"),
        ({**log, "actions": log["actions"] + 0.5}, None, "actions"),
        ({**log, "actions": log["actions"] + 5}, None, "actions must be from 0 to 1"),
        ({**log, "truncations": log["truncations"][:9]}, None, "9 truncations for 600 rewards"),
        ({"x": log["rewards"]}, None, "there is no 'observations' among 'x'"),
        (log, {"action": "actions"}, "columns must be of"),
        (log, {"actions": "push"}, "there is no 'push'"),
        ({name: array[:0] for name, array in log.items()}, None, "no transitions"),
        (tmp_path / "bad.csv", None, "bad.csv"),
        (tmp_path / "log.txt", None, "must be a .npz or a .csv"),
        (7, None, "dataset must be"),
    ]
    for dataset, columns, message in wrong:
        with pytest.raises(ValueError, match=message):
            model.learn_from(dataset, columns=columns)
    with pytest.raises(ValueError, match="passes"):
        model.learn_from(log, passes=0)
    assert not model.policy.q_table.any()
    assert model.policy.perceiver.bounds.seen_low.isinf().all()


def test_normalised_environments() -> None:
    """Data are in the units of the environment; the model normalises them as its VecNormalize does."""
    steps, _ = walk("CartPole-v1", any_push, 400)
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")]), training=False)
    venv.obs_rms.mean, venv.obs_rms.var = np.full(4, 0.1), np.full(4, 0.04)
    model = KNNTD(venv, points=5, seed=0).learn_from(as_log(steps))
    states = np.array([step[0] for step in steps])
    low, high = (end.numpy() for end in (model.policy.perceiver.bounds.low, model.policy.perceiver.bounds.high))
    scaled = (states - 0.1) / 0.2
    assert (low < scaled.min(axis=0)).all()
    assert (scaled.max(axis=0) < high).all()
    assert (high - low < 2.0 * np.ptp(scaled, axis=0)).all()


def test_a_planner_learns_the_same_from_every_form(steps: Steps, tmp_path: pathlib.Path) -> None:
    log = as_log(steps)
    np.savez(tmp_path / "log.npz", **log)
    models = [
        KNNDyna("CartPole-v1", seed=0, simulated_steps=5).learn_from(dataset, passes=2)
        for dataset in (log, tmp_path / "log.npz")
    ]
    assert models[0].learner.planner.n_transitions == len(steps)
    np.testing.assert_array_equal(models[0].policy.q_table, models[1].policy.q_table)
    model = models[0].learn(100)
    assert model.learner.planner.n_transitions == len(steps) + 100
    with pytest.raises(ValueError, match="actions must be from 0 to 1"):
        model.learn_from({**log, "actions": log["actions"] + 5})
    assert model.learner.planner.n_transitions == len(steps) + 100


def test_learning_goes_on_after_data(steps: Steps) -> None:
    model = KNNTD("CartPole-v1", points=5, seed=0).learn_from(as_log(steps))
    bounds, visited = model.policy.perceiver.bounds.low.clone(), model.policy.table.n_visited
    assert visited > 0
    model.learn(300)
    # The data have shown the range.
    assert th.equal(model.policy.perceiver.bounds.low, bounds)
    assert model.num_timesteps == 300
    assert model.policy.table.n_visited >= visited


def test_untried_actions_are_not_hoped_for() -> None:
    """With negative rewards, the initial value of 0 would be the best."""
    steps, _ = walk("Pendulum-v1", lambda observation, random: np.array([2.0], np.float32), 400)
    for kwargs in ({}, {"policy_kwargs": {"table": "hashed"}}):
        model = ExA("Pendulum-v1", points=10, seed=0, **kwargs).learn_from(as_log(steps))
        states = np.array([step[0] for step in steps])
        assert (model.predict(states, deterministic=True)[0] > 1.9).mean() > 0.8


# ------------------------------------------------------ better than the data


def turning(observation: np.ndarray, random: np.random.Generator) -> int:
    """A middling cart-pole controller: against the rotation, and at random in half of the steps."""
    return any_push(observation, random) if random.random() < 0.5 else int(observation[3] + observation[2] > 0.0)


def swing(observation: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A middling pendulum controller: pump energy, then hold, and at random in half of the steps."""
    cos, sin, speed = observation
    if random.random() < 0.5:
        torque = random.uniform(-2.0, 2.0)
    elif cos > 0.8:
        torque = -10.0 * np.arctan2(sin, cos) - 2.0 * speed
    else:
        energy = speed**2 / 6.0 + 5.0 * (cos - 1.0)
        torque = -0.5 * speed * energy if abs(speed) > 0.1 else 2.0
    return np.clip([torque], -2.0, 2.0).astype(np.float32)


def fill(observation: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A middling tank controller: proportional, and at random in three of ten steps."""
    opening = random.uniform() if random.random() < 0.3 else 0.35 + 5.0 * (observation[2] - observation[1])
    return np.clip([opening], 0.0, 1.0).astype(np.float32)


def any_torque(observation: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return random.uniform(-2.0, 2.0, 1).astype(np.float32)


def any_opening(observation: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return random.uniform(0.0, 1.0, 1).astype(np.float32)


TASKS = [
    ("CartPole-v1", any_push, KNNTD, {}, 10_000),
    ("CartPole-v1", turning, KNNTD, {}, 20_000),
    pytest.param("Pendulum-v1", any_torque, ExA, {}, 20_000, marks=pytest.mark.slow),
    ("Pendulum-v1", swing, ExA, {}, 20_000),
    ("Pendulum-v1", any_torque, KNNDyna, {"simulated_steps": 20}, 1_000),
    pytest.param("Tank-v0", any_opening, ExA, {"gamma": 0.9}, 20_000, marks=pytest.mark.slow),
    ("Tank-v0", fill, ExA, {"gamma": 0.9}, 20_000),
]


@pytest.mark.parametrize(("env_id", "act", "algorithm", "arguments", "n"), TASKS)
def test_the_learned_policy_beats_the_one_that_made_the_data(
    env_id: str, act: Act, algorithm: type[KNNTD | ExA | KNNDyna], arguments: dict[str, Any], n: int
) -> None:
    steps, mean_return = walk(env_id, act, n)
    model = algorithm(env_id, seed=0, **arguments).learn_from(as_log(steps))
    model.get_env().seed(7)
    assert evaluate_policy(model, model.get_env(), 10)[0] > mean_return
