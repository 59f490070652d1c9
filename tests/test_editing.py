"""Working with a table by hand: setting values, starting from a controller, forbidding actions, laying points anew."""

from __future__ import annotations

import pathlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dc_motor import proportional
from gymnasium import spaces
from recorded_runs import LENGTHS, make_venv
from stable_baselines3.common.callbacks import BaseCallback

from sb3_knntd import KNNTD, ExA, KNNDyna

Model = KNNTD | ExA
HASHED = {"policy_kwargs": {"table": "hashed"}}


def make(algorithm: type[Model] = KNNTD, **arguments: Any) -> Model:
    settings: dict[str, Any] = {"points": 8, "n_neighbors": 4, "seed": 0, **arguments}
    return algorithm(make_venv(n_actions=3 if algorithm is KNNTD else 0, **LENGTHS), **settings)


def observe(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 2)).astype(np.float32)


# ------------------------------------------------------------------ set_q, fill


@pytest.mark.parametrize("arguments", [{}, HASHED, {"policy_kwargs": {"compiled": False}}], ids=str)
def test_set_q_sets_a_value_and_no_other(arguments: dict[str, Any]) -> None:
    model = make(**arguments).learn(200)
    observation = observe(1)[0]
    before = model.policy.q_values(observation)[0].clone()
    model.policy.set_q(observation, 1, 12.5)
    after = model.policy.q_values(observation)[0]
    assert float(after[1]) == pytest.approx(12.5)
    assert th.equal(after[[0, 2]], before[[0, 2]])
    assert int(model.predict(observation, deterministic=True)[0]) == 1
    # And training goes on.
    model.learn(50, reset_num_timesteps=False)


def test_set_q_of_many_states_at_once() -> None:
    model, states = make(), observe(20)
    values = np.linspace(-3.0, 5.0, 20)
    model.policy.set_q(states, np.arange(20) % 3, values)
    found = model.policy.q_values(states).numpy()[np.arange(20), np.arange(20) % 3]
    np.testing.assert_allclose(found, values, atol=1e-6)


def test_set_q_of_a_continuous_action() -> None:
    model, state = make(ExA), observe(1)[0]
    model.policy.set_q(state, np.array([1.0], np.float32), 7.0)
    assert float(model.policy.q_values(state)[0, 2]) == pytest.approx(7.0)
    assert float(model.predict(state, deterministic=True)[0][0]) == 1.0


def test_set_q_refuses_what_does_not_fit() -> None:
    model = make()
    before = model.policy.q_table.clone()
    for arguments, name in (
        ((observe(1)[0], 7, 1.0), "actions"),
        ((observe(1)[0], 1, np.nan), "value"),
        ((observe(3), 1, [1.0, 2.0]), "value"),
        ((np.full(2, np.nan, np.float32), 1, 1.0), "observation"),
    ):
        with pytest.raises(ValueError, match=name):
            model.policy.set_q(*arguments)
    assert th.equal(model.policy.q_table, before)


@pytest.mark.parametrize("arguments", [{}, HASHED], ids=str)
def test_fill_sets_every_point(arguments: dict[str, Any]) -> None:
    model = make(**arguments)
    model.policy.fill(lambda points: np.stack([points[:, 0], points[:, 1], -points[:, 0]], axis=1))
    points = model.policy.points
    assert len(points) == 64
    assert th.equal(model.policy.q_table, th.stack((points[:, 0], points[:, 1], -points[:, 0]), dim=1))
    model.policy.fill(lambda points: 3.0 * points[:, :1])
    assert th.equal(model.policy.q_table, (3.0 * model.policy.points[:, :1]).expand(-1, 3))


def test_fill_names_what_is_wrong() -> None:
    with pytest.raises(ValueError, match=r"shape \(64, 3\) or \(64, 1\)"):
        make().policy.fill(lambda points: points)
    with pytest.raises(ValueError, match="not known yet"):
        KNNTD("CartPole-v1").policy.fill(lambda points: points[:, :1])
    with pytest.raises(ValueError, match="set_q"):
        make(points=100_000).policy.fill(lambda points: points[:, :1])


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_planned_values_cannot_be_set(env_id: str) -> None:
    """The next plan would overwrite them."""
    model = KNNDyna(env_id, seed=0, simulated_steps=0).learn(50)
    before, observation = model.policy.q_table.clone(), model.observation_space.sample()
    action = model.action_space.sample()
    attempts = {
        "set_q": lambda: model.policy.set_q(observation, action, 1.0),
        "fill": lambda: model.policy.fill(lambda points: points[:, :1]),
        "imitate": lambda: model.policy.imitate(lambda observation: action),
    }
    for name, attempt in attempts.items():
        with pytest.raises(ValueError, match=rf"{name} .*next plan would overwrite .*learn_from.*forbid"):
            attempt()
    with pytest.raises(ValueError, match="smaller spacing"):
        model.refine(points=10)
    assert th.equal(model.policy.q_table, before)


# --------------------------------------------------------------------- imitate


def push(observation: np.ndarray) -> int:
    """Push Mountain-Car in the direction of its motion."""
    return 2 if observation[1] > 0.0 else 0


@pytest.mark.parametrize(
    "arguments", [{}, {"points": np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2))}]
)
def test_imitate_makes_a_controller_greedy(arguments: dict[str, Any]) -> None:
    model = KNNTD("MountainCar-v0", seed=0, **arguments)
    model.policy.imitate(push)
    states = np.random.default_rng(1).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2)).astype(np.float32)
    same = model.predict(states, deterministic=True)[0] == [push(state) for state in states]
    assert same.mean() > 0.95
    # Far from the boundary, the other actions lack the whole margin.
    values = model.policy.q_values(np.array([-0.5, 0.05], np.float32))[0]
    np.testing.assert_allclose(values, [-1.0, -1.0, 0.0], atol=1e-9)


def test_imitate_a_continuous_controller() -> None:
    model = ExA("MountainCarContinuous-v0", seed=0)
    model.policy.imitate(lambda observation: np.array([1.0 if observation[1] > 0.0 else -1.0], np.float32))
    states = np.random.default_rng(1).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2)).astype(np.float32)
    states = states[np.abs(states[:, 1]) > 0.01]
    np.testing.assert_allclose(model.predict(states, deterministic=True)[0][:, 0], np.sign(states[:, 1]), atol=1e-6)


def test_a_model_imitates_another_one() -> None:
    teacher = KNNTD("MountainCar-v0", seed=0)
    teacher.policy.imitate(push)
    student = KNNTD("MountainCar-v0", points=25)
    student.policy.imitate(teacher)
    states = np.random.default_rng(1).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2)).astype(np.float32)
    same = student.predict(states, deterministic=True)[0] == teacher.predict(states, deterministic=True)[0]
    assert same.mean() > 0.95


def test_what_cannot_be_imitated_is_refused() -> None:
    model = KNNTD("MountainCar-v0")
    with pytest.raises(ValueError, match="controller must be a function"):
        model.policy.imitate(3)
    with pytest.raises(ValueError, match="actions must be from 0 to 2"):
        model.policy.imitate(lambda observation: 5)
    with pytest.raises(ValueError, match="margin"):
        model.policy.imitate(push, margin=-1.0)
    assert not model.policy.q_table.any()


class Scores(BaseCallback):
    """Evaluate the greedy policy at intervals."""

    def __init__(self, env: gym.Env[Any, Any], every: int) -> None:
        super().__init__()
        self.env = env
        self.every = every
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        if self.n_calls % self.every == 0:
            self.returns.append(score(self.env, lambda state: self.model.predict(state, deterministic=True)[0]))
        return True


def score(env: gym.Env[Any, Any], act: Any, n_episodes: int = 20) -> float:
    total = 0.0
    for episode in range(n_episodes):
        observation, over = env.reset(seed=1000 + episode)[0], False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + float(reward), terminated or truncated
    return total / n_episodes


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_motor_that_starts_from_a_controller_is_never_much_worse_and_then_better(seed: int) -> None:
    env = gym.make("DCMotor-v0")
    controller = score(env, proportional)
    model = KNNTD("DCMotor-v0", seed=seed).imitate(proportional)
    scores = Scores(env, 2500)
    model.learn(50_000, callback=scores)
    assert min(scores.returns) >= 1.1 * controller
    assert scores.returns[-1] >= 0.9 * controller


def test_a_pole_that_starts_from_a_controller_is_better_at_once() -> None:
    def weak(observation: np.ndarray) -> int:
        return int(observation[2] > 0.0)

    env = gym.make("CartPole-v1")
    high = np.array([2.4, 3.0, 0.21, 3.0])
    model = KNNTD("CartPole-v1", bounds=(-high, high), seed=0).imitate(weak)
    assert model.exploration_initial_eps == 0.06
    scores = Scores(env, 1000)
    model.learn(4000, callback=scores)
    assert min(scores.returns) >= 0.9 * score(env, weak)
    assert scores.returns[-1] >= 1.1 * score(env, weak)


# ---------------------------------------------------------------------- forbid


class Taken(BaseCallback):
    """Record observations and the actions taken there."""

    def __init__(self) -> None:
        super().__init__()
        self.states: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []

    def _on_step(self) -> bool:
        self.states.append(np.array(self.model._last_obs))
        self.actions.append(np.array(self.locals["actions"]))
        return True

    def inside(self, dimension: int, low: float, high: float) -> np.ndarray:
        """The actions that were taken in a region."""
        states, actions = np.concatenate(self.states), np.concatenate(self.actions)
        chosen: np.ndarray = actions[(low <= states[:, dimension]) & (states[:, dimension] <= high)]
        return chosen


SETTINGS: list[tuple[type[Model], dict[str, Any]]] = [
    (KNNTD, {"target": "sarsa", "exploration_initial_eps": 0.9}),
    (KNNTD, {"target": "expected_sarsa", "exploration_initial_eps": 1.0}),
    (KNNTD, {"target": "q_learning", "exploration": "softmax", "temperature": 10.0}),
    (KNNTD, {"target": "expected_sarsa", "exploration": "softmax", "temperature": 10.0}),
    (ExA, {"exploration": "shared"}),
    (ExA, {"exploration": "per_neighbor"}),
]


@pytest.mark.parametrize(("algorithm", "arguments"), SETTINGS, ids=str)
def test_forbidden_actions_are_never_taken(algorithm: type[Model], arguments: dict[str, Any]) -> None:
    """Neither while training nor in predict, in the compiled step as in the reference, with the same tables."""
    tables = []
    for compiled in (True, False):
        model = make(algorithm, policy_kwargs={"compiled": compiled}, tie_break="first", initial_value=1.0, **arguments)
        forbidden: Any = 2 if algorithm is KNNTD else {0: (0.5, 1.0)}
        model.policy.forbid(forbidden, {0: (-np.inf, 0.0)})
        taken = Taken()
        model.learn(300, callback=taken)
        states = observe(200)
        chosen = [model.predict(states, deterministic=True)[0], model.predict(states, deterministic=False)[0]]
        chosen.append(np.array([model.predict(state, deterministic=True)[0] for state in states]))
        chosen.append(model.policy(th.from_numpy(states)).numpy())
        inside = [taken.inside(0, -np.inf, 0.0), *(each[states[:, 0] <= 0.0] for each in chosen)]
        limit = 2 if algorithm is KNNTD else 1e-9
        assert len(inside[0]) > 20
        assert all((each < limit).all() for each in inside)
        outside = taken.inside(0, 0.01, np.inf)
        assert (outside >= limit).any()
        tables.append(model.policy.q_table.numpy())
    np.testing.assert_allclose(*tables, rtol=1e-9, atol=1e-9)
    assert np.isfinite(tables[0]).all()


@pytest.mark.parametrize(("env_id", "action"), [("MountainCar-v0", 2), ("MountainCarContinuous-v0", {0: (0.5, 1.0)})])
def test_a_planner_never_takes_forbidden_actions(env_id: str, action: Any, tmp_path: pathlib.Path) -> None:
    model = KNNDyna(env_id, seed=0, action_points=5, simulated_steps=10)
    model.policy.forbid(action, {0: (-np.inf, -0.5)})
    taken = Taken()
    model.learn(300, callback=taken)
    model.save(tmp_path / "model")
    loaded = KNNDyna.load(tmp_path / "model")
    states = np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], (200, 2)).astype(np.float32)
    chosen = [each.predict(states, deterministic=True)[0] for each in (model, loaded)]
    chosen.append(np.array([model.predict(state)[0] for state in states]))
    inside = [taken.inside(0, -np.inf, -0.5), *(each[states[:, 0] <= -0.5] for each in chosen)]
    # Halfway to an action point that is forbidden is not allowed either.
    limit = 2 if env_id == "MountainCar-v0" else 0.5
    assert len(inside[0]) > 20
    assert all((each < limit).all() for each in inside)
    assert (taken.inside(0, -0.49, np.inf) >= limit).any()
    assert len(loaded.policy.rules) == 1


def test_a_rule_applies_from_the_next_action_on() -> None:
    model = make(initial_value=1.0)

    class Forbid(Taken):
        def _on_step(self) -> bool:
            if self.n_calls == 50:
                self.model.policy.forbid([0, 2], {})
            return super()._on_step()

    taken = Forbid()
    model.learn(100, callback=taken)
    assert set(np.concatenate(taken.actions[50:]).tolist()) == {1}
    model.policy.allow()
    model.learn(100, callback=(free := Taken()))
    assert set(np.concatenate(free.actions).tolist()) == {0, 1, 2}


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("algorithm", [KNNTD, ExA])
def test_training_under_rules_is_resumed_exactly(
    algorithm: type[Model], compiled: bool, tmp_path: pathlib.Path
) -> None:
    def begin() -> Model:
        model = make(algorithm, policy_kwargs={"compiled": compiled}, initial_value=1.0)
        for region in ({1: (0.0, 0.5)}, {0: (-np.inf, -0.2)}):
            model.policy.forbid(0 if algorithm is KNNTD else {0: (-1.0, -0.5)}, region)
        return model.learn(37)

    whole, broken = begin(), begin()
    broken.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=broken.get_env(), force_reset=False)
    for model in (whole, loaded):
        model.learn(80, reset_num_timesteps=False)
    assert th.equal(whole.policy.q_table, loaded.policy.q_table)


@pytest.mark.parametrize("algorithm", [KNNTD, ExA])
def test_rules_are_saved(algorithm: type[Model], tmp_path: pathlib.Path) -> None:
    model = make(algorithm).learn(150)
    model.policy.forbid(0 if algorithm is KNNTD else {0: (-1.0, -0.5)}, {1: (0.0, 0.5)})
    model.learn(37, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    states = observe(300)
    for trusted in (True, False):
        loaded = algorithm.load(
            tmp_path / "model", env=make_venv(n_actions=3 if algorithm is KNNTD else 0, **LENGTHS), trusted=trusted
        )
        assert np.array_equal(
            loaded.predict(states, deterministic=True)[0], model.predict(states, deterministic=True)[0]
        )
        assert len(loaded.policy.rules) == 1
    model.policy.save(str(tmp_path / "policy"))
    assert len(type(model.policy).load(str(tmp_path / "policy")).rules) == 1


def test_a_traced_policy_keeps_the_rules() -> None:
    model = make().learn(100)
    model.policy.forbid(1, {0: (-0.5, 0.5)})
    states = th.from_numpy(observe(100))
    traced = th.jit.trace(model.policy.eval(), states[:3])
    assert th.equal(traced(states), model.policy(states))
    assert not (traced(states)[states[:, 0].abs() <= 0.5] == 1).any()


def test_data_of_forbidden_actions_are_learned_from() -> None:
    """Their values are known, but not counted in the targets of other states."""
    for compiled in (True, False):
        model = make(gamma=0.5, policy_kwargs={"compiled": compiled}, n_neighbors=1)
        model.policy.fill(lambda points: np.tile([0.0, 0.0, 100.0], (len(points), 1)))
        model.policy.forbid(2, {})
        states = np.array([[-0.9, -0.9], [0.9, 0.9]], np.float32)
        rows = {"observations": states, "actions": [2, 0], "rewards": [1.0, 3.0], "next_observations": states[::-1]}
        model.learning_rate = 1.0
        model.learn_from({**{key: np.array(value) for key, value in rows.items()}, "truncations": np.ones(2)}, passes=1)
        values = model.policy.q_values(states).numpy()
        assert values[0, 2] == pytest.approx(1.0)
        assert values[1, 0] == pytest.approx(3.0)


def test_rules_that_leave_no_action_are_refused() -> None:
    model = make()
    model.policy.forbid([0, 1], {0: (-0.5, 0.5)})
    model.policy.forbid(2, {0: (0.6, np.inf)})
    with pytest.raises(ValueError, match="no action would be left"):
        model.policy.forbid(2, {1: (0.0, np.inf)})
    assert len(model.policy.rules) == 2
    for action, region, name in (
        (3, {}, "actions"),
        (0, {2: (0.0, 1.0)}, "region"),
        (0, {0: (1.0, 0.0)}, "region"),
        (0, {0: (np.nan, 1.0)}, "region"),
        (0, "left", "region"),
    ):
        with pytest.raises(ValueError, match=name):
            model.policy.forbid(action, region)
    with pytest.raises(ValueError, match="no action point"):
        make(ExA).policy.forbid({0: (0.1, 0.2)}, {})


def test_components_of_a_factored_table_are_forbidden_one_at_a_time() -> None:
    env = gym.make("Pendulum-v1")
    wide = gym.wrappers.TransformAction(env, lambda action: action[:1], spaces.Box(-2.0, 2.0, (2,)))
    model = ExA(wide, action_table="factored", points=5, seed=0)
    model.policy.forbid({1: (1.0, 2.0)}, {2: (0.0, np.inf)})
    taken = Taken()
    model.learn(200, callback=taken)
    assert (taken.inside(2, 0.0, np.inf)[:, 1] <= 1e-6).all()
    with pytest.raises(ValueError, match="one component"):
        model.policy.forbid({0: (1.0, 2.0), 1: (1.0, 2.0)}, {})


def test_an_action_is_forbidden_in_one_state() -> None:
    model = KNNTD("FrozenLake-v1", seed=0)
    model.policy.forbid([1, 2], {0: (4, 4)})
    taken = Taken()
    model.learn(3000, callback=taken)
    states, actions = np.concatenate(taken.states), np.concatenate(taken.actions)
    assert set(actions[states == 4].tolist()) == {0, 3}
    assert set(actions[states == 0].tolist()) == {0, 1, 2, 3}
    assert model.predict(4, deterministic=True)[0] in (0, 3)


def test_the_random_phase_obeys_the_rules() -> None:
    model = KNNTD("CartPole-v1", seed=0)
    model.policy.forbid(0, {2: (0.0, np.inf)})
    taken = Taken()
    model.learn(300, callback=taken)
    assert set(taken.inside(2, 0.0, np.inf).tolist()) == {1}
    assert set(taken.inside(2, -np.inf, -1e-3).tolist()) == {0, 1}


# ---------------------------------------------------------------------- refine


@pytest.fixture(scope="module")
def driver() -> KNNTD:
    """A model that drives Mountain-Car."""
    model = KNNTD("MountainCar-v0", seed=0)
    model.policy.imitate(push)
    return model


@pytest.mark.parametrize("table", ["dense", "hashed"])
@pytest.mark.parametrize("points", [14, 30, (40, 21)], ids=str)
def test_refine_keeps_the_policy(points: Any, table: str) -> None:
    model = KNNTD("MountainCar-v0", seed=0, policy_kwargs={"table": table})
    model.policy.imitate(push)
    states = np.random.default_rng(1).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2)).astype(np.float32)
    before, values = model.predict(states, deterministic=True)[0], model.policy.state_values(states)
    assert model.refine(points=points) is model
    assert len(model.policy.points) == np.prod(np.broadcast_to(points, 2))
    assert (model.predict(states, deterministic=True)[0] == before).mean() > 0.95
    assert float((model.policy.state_values(states) - values).abs().max()) < 0.35
    model.learn(300)


def test_loading_onto_other_points(driver: KNNTD, tmp_path: pathlib.Path) -> None:
    driver.policy.forbid(1, {0: (0.4, 0.6)})
    driver.save(tmp_path / "model")
    scattered = np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], (900, 2))
    states = np.random.default_rng(1).uniform([-1.2, -0.07], [0.6, 0.07], (500, 2)).astype(np.float32)
    for changes in ({"points": 30}, {"points": scattered}, {"bounds": ([-1.0, -0.06], [0.5, 0.06]), "points": 25}):
        loaded = KNNTD.load(tmp_path / "model", env=gym.make("MountainCar-v0"), **changes)
        same = loaded.predict(states, deterministic=True)[0] == driver.predict(states, deterministic=True)[0]
        assert same.mean() > 0.93
        assert len(loaded.policy.rules) == 1
        loaded.learn(100)
    with pytest.raises(ValueError, match="points"):
        KNNTD.load(tmp_path / "model", points="many")


def test_loading_onto_the_same_points_changes_nothing(tmp_path: pathlib.Path) -> None:
    model = make(points=(8, 6)).learn(137)
    model.save(tmp_path / "model")
    loaded = KNNTD.load(tmp_path / "model", env=make_venv(**LENGTHS), points=(8, 6))
    assert th.equal(loaded.policy.q_table, model.policy.q_table)
    assert loaded.learner.n_traced == model.learner.n_traced > 0


def test_refine_keeps_a_measured_range() -> None:
    model = KNNTD("CartPole-v1", points=4, seed=0).learn(1200)
    bounds = model.policy.perceiver.bounds
    low, visited = bounds.low.clone(), model.policy.table.n_visited
    model.refine(points=6)
    assert th.equal(model.policy.perceiver.bounds.low, low)
    assert model.policy.table.n_visited >= visited
    model.learn(100, reset_num_timesteps=False)
    assert th.equal(model.policy.perceiver.bounds.low, low)
    model.refine(bounds={1: (-3.0, 3.0)})
    assert model.policy.perceiver.bounds.low.tolist() == [pytest.approx(-4.8), -3.0, low[2], low[3]]
    model.learn(100, reset_num_timesteps=False)
    assert model.policy.perceiver.bounds.low.tolist() == [pytest.approx(-4.8), -3.0, low[2], low[3]]


def test_a_refinement_that_fails_leaves_the_model() -> None:
    model = make().learn(100)
    before, policy = model.policy.q_table.clone(), model.policy
    with pytest.raises(ValueError, match="points"):
        model.refine(points=[1, 2, 3])
    assert model.policy is policy
    assert model.points == 8
    assert th.equal(model.policy.q_table, before)
    model.learn(100)
