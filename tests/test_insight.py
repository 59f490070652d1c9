"""Explanations, diagnoses, and the page of a model."""

from __future__ import annotations

import copy
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from playwright.sync_api import Browser, Page, sync_playwright
from stable_baselines3.common.monitor import Monitor
from toy_envs import DriftEnv, PushEnv

from sb3_knntd import KNNTD, ExA, KNNDyna
from sb3_knntd.cli import main
from sb3_knntd.insight import Diagnosis, read_monitor, write_page
from sb3_knntd.insight.diagnosis import LEAST_STEPS
from sb3_knntd.plots import NAMES, Names
from sb3_knntd.registry import ALGORITHMS, Role, with_role

CHROMIUM = Path("/usr/bin/chromium")
SCATTERED = np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], (150, 2))


# ------------------------------------------------------------------------------ what learning counts


class Neighbors:
    """Counts by itself, in a callback, how often each point is among the nearest, and what was observed."""

    def __init__(self, model: KNNTD) -> None:
        self.model, self.counts = model, np.zeros(model.policy.perceiver.points.n_points, np.int64)
        self.before: np.ndarray | None = None
        self.seen: list[np.ndarray] = []
        self.changes: list[np.ndarray] = []

    def __call__(self, local: dict[str, Any], _: dict[str, Any]) -> bool:
        if self.before is None:
            self.before = local["last_obs"]
        np.add.at(self.counts, self.model.policy.perceive(self.before).indices.numpy(), 1)
        after, dones = local["new_obs"].astype(np.float64), local["dones"]
        self.seen.append(after)
        self.changes.append(np.abs(after - self.before)[~dones])
        self.before = after.astype(np.float32)
        return True


@pytest.mark.parametrize("kwargs", [{}, {"compiled": False}, {"table": "hashed"}], ids=["compiled", "torch", "hashed"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_visits_and_statistics_are_those_of_the_steps(kwargs: dict[str, Any], n_envs: int) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    venv = DummyVecEnv([lambda offset=offset: DriftEnv(offset) for offset in np.linspace(0, 0.5, n_envs)])
    model = KNNTD(venv, seed=0, points=(12, 9), bounds=([-1.0, -0.05], [0.5, 0.06]), policy_kwargs=kwargs)
    known = Neighbors(model)
    model.learn(300, callback=known)
    counts = np.zeros_like(known.counts)
    rows = model.policy.table.points()
    counts[slice(None) if rows is None else rows.numpy()] = model.policy.visits.numpy()
    np.testing.assert_array_equal(counts, known.counts)

    experience, seen = model.policy.experience, np.concatenate(known.seen)
    assert experience.n_steps == len(seen) == 300
    np.testing.assert_array_equal(experience.low.numpy(), seen.min(axis=0))
    np.testing.assert_array_equal(experience.high.numpy(), seen.max(axis=0))
    beyond = ((seen < [-1.0, -0.05]) | (seen > [0.5, 0.06])).mean(axis=0)
    assert 0.0 < beyond.max() < 1.0
    np.testing.assert_allclose(experience.share_beyond.numpy(), beyond)
    np.testing.assert_allclose(experience.mean_change.numpy(), np.concatenate(known.changes).mean(axis=0))


def test_visits_are_saved_and_kept_apart(tmp_path: Path) -> None:
    model = KNNTD("MountainCar-v0", seed=0).learn(500)
    model.save(tmp_path / "model")
    loaded = KNNTD.load(tmp_path / "model", env=gym.make("MountainCar-v0"), trusted=False)
    assert th.equal(loaded.policy.visits, model.policy.visits)
    assert th.equal(loaded.policy.experience.totals, model.policy.experience.totals)
    loaded.learn(100, reset_num_timesteps=False)
    assert int(loaded.policy.visits.sum() - model.policy.visits.sum()) == 100 * model.policy.n_neighbors
    assert loaded.policy.experience.n_steps == 600


@pytest.mark.parametrize("name", ["saved_knntd_4_envs", "saved_knntd_hashed", "saved_exa"])
def test_files_without_counts_tell_what_was_visited(name: str) -> None:
    """Versions that did not count visits saved whether there were any."""
    cls = ExA if name == "saved_exa" else KNNTD
    model = cls.load(Path(__file__).parent / "data" / f"{name}.zip")
    assert model.policy.table.n_visited == int((model.policy.visits > 0).sum()) > 0
    assert int(model.policy.visits.max()) == 1
    assert len(model.diagnose()) == 0
    assert "Too few steps" in str(model.diagnose())


# ------------------------------------------------------------------------------ explanations


def test_an_explanation_gives_the_numbers_of_the_prediction() -> None:
    model = KNNTD("MountainCar-v0", seed=0).learn(3_000)
    observation = np.array([-0.4, 0.01], np.float32)
    explanation = model.explain(observation)
    perception, q_values = model.policy.perceive(observation), model.policy.q_values(observation)[0].numpy()
    assert [each.index for each in explanation.neighbors] == perception.indices[0].tolist()
    assert [each.probability for each in explanation.neighbors] == perception.probabilities[0].tolist()
    for each in explanation.neighbors:
        np.testing.assert_array_equal(each.point, model.policy.points[each.index])
        np.testing.assert_array_equal(each.values, model.policy.q_table[each.index])
        assert each.visits == model.policy.visits[each.index]
        scaled = 2.0 * (each.point - observation) / [1.8, 0.14]
        assert each.distance == pytest.approx(np.linalg.norm(scaled), rel=1e-5)
    np.testing.assert_array_equal(explanation.q_values, q_values)
    assert explanation.action == model.predict(observation, deterministic=True)[0] == q_values.argmax()
    assert explanation.value == q_values.max()
    assert explanation.margin == pytest.approx(np.sort(q_values)[2] - np.sort(q_values)[1])
    assert explanation.known == 1.0
    assert not explanation.is_outside


@pytest.mark.parametrize("action_table", ["joint", "factored"])
def test_an_explanation_of_a_continuous_action(action_table: str) -> None:
    env = PushEnv(shape=(2,))
    model = ExA(env, seed=0, points=9, action_points=[3, 4], action_table=action_table).learn(800)
    observation = np.array([-0.4, 0.01], np.float32)
    explanation = model.explain(observation)
    np.testing.assert_array_equal(explanation.action, model.predict(observation, deterministic=True)[0])
    assert explanation.value == pytest.approx(float(model.policy.state_values(observation)[0]))
    factors = [slice(0, 3), slice(3, 7)] if action_table == "factored" else [slice(0, 12)]
    ordered = [[np.sort(each.values[part]) for part in factors] for each in explanation.neighbors]
    gaps = [np.mean([values[-1] - values[-2] for values in parts]) for parts in ordered]
    weights = [each.probability for each in explanation.neighbors]
    assert explanation.margin == pytest.approx(np.dot(weights, gaps))
    assert len(explanation.columns) == (7 if action_table == "factored" else 12)
    assert "action[0] = " in str(explanation)


@pytest.mark.parametrize(
    ("env", "observation"),
    [
        ("Pendulum-v1", [np.cos(2.0), np.sin(2.0), 1.0]),
        (PushEnv(shape=(2,)), [-0.4, 0.01]),
        ("CartPole-v1", [0.01, 0.1, 0.02, -0.1]),
        ("FrozenLake-v1", 4),
    ],
)
def test_an_explanation_of_a_planned_action(env: Any, observation: Any) -> None:
    model = KNNDyna(env, seed=0, action_points=5, simulated_steps=20).learn(400)
    seen = np.array(observation, model.observation_space.dtype)
    explanation = model.explain(seen)
    action = model.predict(seen, deterministic=True)[0]
    np.testing.assert_array_equal(explanation.action, action)
    means = sum(each.probability * each.values for each in explanation.neighbors)
    np.testing.assert_allclose(explanation.q_values, means)
    second, best = np.sort(explanation.q_values)[-2:]
    assert explanation.value == pytest.approx(best)
    assert explanation.margin == pytest.approx(best - second)
    named = [f"{number:.4g}" for number in np.atleast_1d(action)]
    assert all(number in str(explanation).splitlines()[1] for number in named) or env == "CartPole-v1"
    *_, bars = explanation.plot()
    assert explanation.action_text in bars.get_title()
    # The bar of the best action, or action point, is marked.
    marked = [line.get_xdata()[0] for line in bars.lines if line.get_marker() == "|" and line.get_color() != "0.35"]
    assert marked == [pytest.approx(best)]
    if isinstance(model.action_space, spaces.Box):
        # The peak is not farther from the best action point than half of the way to the next.
        points = model.policy.columns.points
        halves = [0.5 * np.diff(np.unique(points[:, dim])).max() for dim in range(points.shape[1])]
        assert (np.abs(action - points[explanation.q_values.argmax()]) <= np.array(halves) + 1e-6).all()


@pytest.mark.parametrize("env", ["Pendulum-v1", "CartPole-v1"])
def test_a_planned_table_is_inspected_from_its_file(env: str, tmp_path: Path) -> None:
    KNNDyna(env, seed=0, simulated_steps=10).learn(100).save(tmp_path / "model.zip")
    assert main(["inspect", str(tmp_path / "model.zip"), "--env", env]) == 0
    assert f"<title>KNNDyna on {env}</title>" in (tmp_path / "model.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("case", ["lattice", "continuous", "factored", "planned continuous"])
def test_forbidden_actions_are_not_explained_as_the_best(
    case: str, browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plotly.offline.get_plotlyjs", lambda: NO_PLOTLY)
    cls, env, arguments = MODELS[case]
    model = cls(env, seed=0, **arguments).learn(300)
    bounds = model.policy.perceiver.bounds
    observation = 0.5 * (bounds.low + bounds.high).numpy()
    observation = observation.astype(np.float32).astype(np.float64)
    region = {0: (-np.inf, float(observation[0]))}
    action = model.predict(observation, deterministic=True)[0]
    if case == "lattice":
        model.policy.forbid(int(action), region)
    else:
        ends = (action[0] - 0.6, 10.0) if action[0] > 0.0 else (-10.0, action[0] + 0.6)
        model.policy.forbid({0: ends}, region)
    explanation = model.explain(observation)
    assert np.isneginf(explanation.q_values).any()
    expected = model.predict(observation, deterministic=True)[0]
    assert not np.allclose(expected, action)
    np.testing.assert_allclose(explanation.action, expected)
    assert np.isfinite(explanation.value)
    assert explanation.margin >= 0.0
    explanation.plot()
    write_page(model, tmp_path / "page.html")
    page, _ = opened(browser, tmp_path / "page.html")
    np.testing.assert_allclose(page.evaluate("state => read(state).action", observation.tolist()), expected, atol=1e-6)


def test_the_text_of_an_explanation() -> None:
    model = KNNTD("MountainCar-v0", seed=0, points=10).learn(3_000)
    text = str(model.explain(np.array([-0.4, 0.01])))
    lines = text.splitlines()
    assert lines[0] == "At position = -0.4, velocity (position per step) = 0.01"
    assert lines[1].startswith(("push left, value -", "no push, value -", "push right, value -"))
    assert "better than the second" in lines[1]
    head, *rows = lines[3:]
    assert head.split()[0] == "point"
    assert "push left" in head
    assert len(rows) == model.policy.n_neighbors + 1
    assert rows[-1].split()[:2] == ["mean", "1.000"]
    assert len({len(line) for line in lines[3:]}) == 1
    assert "Beyond" not in text
    assert "never visited" not in text
    names = Names(("x", "v"), ("a", "b", "c"))
    assert str(model.explain(np.array([-0.4, 0.01]), names)).startswith("At x = -0.4, v = 0.01\n")


def test_an_explanation_says_what_was_never_seen() -> None:
    model = KNNTD("MountainCar-v0", seed=0).learn(400)
    explanation = model.explain(np.array([0.55, -0.08]))
    assert explanation.beyond_bounds == (1,)
    assert explanation.beyond_seen == (0, 1)
    assert explanation.known == pytest.approx(0.0)
    assert explanation.is_outside
    text = str(explanation)
    assert "Beyond the bounds in velocity" in text
    assert "Beyond all that was seen in learning in position, velocity" in text
    assert "100% of the weight is on points that were never visited" in text


def test_an_explanation_of_a_state() -> None:
    model = KNNTD("FrozenLake-v1", seed=0).learn(500)
    explanation = model.explain(np.array(4))
    assert explanation.neighbors[0].index == 4
    assert explanation.neighbors[0].probability == 1.0
    assert str(explanation).startswith("At state = 4\naction ")
    (bars,) = explanation.plot()
    assert [label.get_text() for label in bars.get_yticklabels()] == [f"action {n}" for n in range(4)]


@pytest.mark.parametrize("observation", [np.zeros(3), np.zeros((2, 2)), [0.0, np.nan], "left"])
def test_what_is_no_observation_is_refused(observation: Any) -> None:
    model = KNNTD("MountainCar-v0", seed=0)
    with pytest.raises(ValueError, match="observation must be"):
        model.explain(observation)


def test_the_picture_of_an_explanation() -> None:
    model = KNNTD("MountainCar-v0", seed=0).learn(2_000)
    explanation = model.explain(np.array([-0.4, 0.01]))
    values, actions, bars = explanation.plot()
    assert values.get_title() == "Value"
    assert actions.get_title() == "Greedy action"
    assert explanation.action_text in bars.get_title()
    shown = [line.get_xydata()[0].tolist() for line in values.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(shown, [each.point.tolist() for each in explanation.neighbors])
    with pytest.raises(ValueError, match="axes must be 3"):
        explanation.plot(axes=[values])
    with pytest.raises(ValueError, match="dims"):
        explanation.plot(dims=(0, 2))


# ------------------------------------------------------------------------------ diagnoses


class Widened(gym.ObservationWrapper[Any, Any, Any]):
    """Mountain-Car with one more number in its observations: a constant one, or noise."""

    def __init__(self, kind: str) -> None:
        super().__init__(gym.make("MountainCar-v0"))
        low, high = (np.append(bound, end) for bound, end in zip(((-1.2, -0.07), (0.6, 0.07)), (-1, 1), strict=True))
        self.observation_space = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self.kind, self.generator = kind, np.random.default_rng(0)

    def observation(self, observation: Any) -> Any:
        more = self.generator.uniform(-1, 1) if self.kind == "noise" else 0.3
        return np.append(observation, more).astype(np.float32)


class Rewards(gym.RewardWrapper[Any, Any]):
    """Mountain-Car with another reward at each step."""

    def __init__(self, reward: float) -> None:
        super().__init__(gym.make("MountainCar-v0"))
        self.given = reward

    def reward(self, reward: Any) -> float:
        return self.given


class ManyActions(gym.ActionWrapper[Any, Any, Any]):
    """Mountain-Car with 600 actions, of which many do the same."""

    def __init__(self) -> None:
        super().__init__(gym.make("MountainCar-v0"))
        self.action_space = spaces.Discrete(600)

    def action(self, action: Any) -> Any:
        return action % 3


def diagnosed(steps: int, env: Any = "MountainCar-v0", **arguments: Any) -> Diagnosis:
    model = KNNTD(env, seed=0, **arguments)
    with suppress(FloatingPointError):
        model.learn(steps)
    return model.diagnose()


# What fails, the finding, and the parameter that it names.
FAILURES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "diverging": ("diverging", "learning_rate", {"learning_rate": 4.9, "step_size": "paper", "traces": "accumulating"}),
    "narrow bounds": ("beyond_bounds", "bounds", {"bounds": ([-1.2, -0.005], [0.6, 0.005])}),
    "wide bounds": ("unused_range", "bounds", {"bounds": ([-1.2, -2.0], [0.6, 2.0])}),
    "a constant dimension": ("constant_dimension", "points", {"env": lambda: Widened("constant")}),
    "a dimension of noise": ("useless_dimension", "points", {"env": lambda: Widened("noise"), "points": (12, 12, 8)}),
    "no reward": ("initial_values", "initial_value", {"env": lambda: Rewards(0.0)}),
    "optimism": ("optimism", "initial_value", {"initial_value": 1000.0}),
    "too many actions": ("optimism", "initial_value", {"env": lambda: ManyActions()}),
    "a coarse lattice": ("too_coarse", "points", {"points": 2, "n_neighbors": 2}),
    "a fine lattice": ("too_fine", "points", {"points": 800}),
    "a short horizon": ("saturated", "gamma", {"gamma": 0.8}),
    "exploration": ("exploring", "exploration_final_eps", {"exploration_final_eps": 0.5}),
}


@pytest.mark.filterwarnings("ignore:learning_rate=4.9")
@pytest.mark.parametrize("case", FAILURES)
def test_what_fails_is_found(case: str) -> None:
    name, parameter, arguments = FAILURES[case]
    arguments = dict(arguments)
    env = arguments.pop("env", lambda: gym.make("MountainCar-v0"))()
    diagnosis = diagnosed(12_000 if name in ("useless_dimension", "unused_range") else 6_000, env, **arguments)
    found = {finding.name: finding for finding in diagnosis}
    assert name in found, str(diagnosis)
    assert found[name].parameter == parameter
    assert f"- {parameter}: " in str(diagnosis)
    if name in ("beyond_bounds", "unused_range"):
        assert found[name].dims == (1,)
    if name.endswith("dimension"):
        assert found[name].dims == (2,)


ORDINARY: dict[str, tuple[type[KNNTD] | type[ExA], str]] = {
    "knntd-MountainCar-v0": (KNNTD, "MountainCar-v0"),
    "knntd-CartPole-v1": (KNNTD, "CartPole-v1"),
    "knntd-Acrobot-v1": (KNNTD, "Acrobot-v1"),
    "knntd-FrozenLake-v1": (KNNTD, "FrozenLake-v1"),
    "knntd-CliffWalking-v1": (KNNTD, "CliffWalking-v1"),
    "exa-Pendulum-v1": (ExA, "Pendulum-v1"),
    "exa-MountainCarContinuous-v0": (ExA, "MountainCarContinuous-v0"),
}


@pytest.mark.parametrize("case", ORDINARY)
def test_an_ordinary_run_has_no_finding(case: str) -> None:
    cls, env = ORDINARY[case]
    model = cls(env, seed=0)
    model.learn(6_000)
    assert str(model.diagnose()).endswith("Nothing was found.")
    model.learn(6_000)
    assert str(model.diagnose()).endswith("Nothing was found.")


def tuned() -> list[tuple[str, str]]:
    """Algorithm and environment of the tuned settings."""
    found = []
    for algorithm in with_role(Role.OWN).values():
        assert algorithm.config_path is not None
        settings = yaml.safe_load(algorithm.config_path.read_text(encoding="utf-8"))
        found += [(algorithm.name, env) for env in settings if env != "default"]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("name", "env"), tuned())
def test_a_tuned_run_has_no_finding(name: str, env: str, tmp_path: Path) -> None:
    try:
        gym.make(env).close()
    except (gym.error.Error, ImportError) as error:
        pytest.skip(str(error))
    arguments = ["--algo", name, "--env", env, "--seed", "1", "-f", str(tmp_path), "--eval-freq", "-1"]
    assert main(["train", *arguments]) == 0
    (saved,) = tmp_path.rglob(f"{env.split('/')[-1]}.zip")
    diagnosis = ALGORITHMS[name].load().load(saved).diagnose()
    assert str(diagnosis).endswith("Nothing was found.")


@pytest.mark.parametrize(
    ("env", "steps"),
    [("Pendulum-v1", 1_500), ("CartPole-v1", 2_000), ("MountainCarContinuous-v0", 2_000), ("FrozenLake-v1", 2_000)],
)
def test_an_ordinary_run_of_a_planner_has_no_finding(env: str, steps: int) -> None:
    diagnosis = KNNDyna(env, seed=0).learn(steps).diagnose()
    assert str(diagnosis).endswith("Nothing was found.")
    assert diagnosis.n_steps == steps


class Hidden(gym.ObservationWrapper[Any, Any, Any]):
    """Pendulum without its velocity."""

    def __init__(self) -> None:
        super().__init__(gym.make("Pendulum-v1"))
        self.observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def observation(self, observation: Any) -> Any:
        return observation[:2]


NARROW = ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
PLANNING_FAILURES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a hidden state": ("model_error", "env", {"env": Hidden}),
    "no reward": ("same_rewards", "optimism", {"env": lambda: Rewards(0.0)}),
    "narrow bounds": ("beyond_bounds", "bounds", {"bounds": NARROW}),
    "few points": ("max_points", "max_points", {"max_points": 60}),
    "a short horizon": ("saturated", "gamma", {"env": lambda: gym.make("MountainCar-v0"), "gamma": 0.8}),
}


@pytest.mark.parametrize("case", PLANNING_FAILURES)
def test_what_fails_in_planning_is_found(case: str) -> None:
    name, parameter, arguments = PLANNING_FAILURES[case]
    arguments = dict(arguments)
    env = arguments.pop("env", lambda: gym.make("Pendulum-v1"))()
    model = KNNDyna(env, seed=0, simulated_steps=0, **arguments).learn(999)
    assert len(model.diagnose()) == 0
    assert "Too few steps for a diagnosis: it takes 1,000." in str(model.diagnose())
    diagnosis = model.learn(201, reset_num_timesteps=False).diagnose()
    found = {finding.name: finding for finding in diagnosis}
    assert name in found, str(diagnosis)
    assert found[name].parameter == parameter
    # Nothing that it has no parameter for, such as ε, a lattice or an initial value.
    assert {finding.parameter for finding in diagnosis} <= {"env", "optimism", "bounds", "max_points", "gamma"}
    if name == "beyond_bounds":
        assert found[name].dims == (2,)


def test_too_few_steps_tell_nothing() -> None:
    diagnosis = diagnosed(LEAST_STEPS - 1, bounds=([-1.2, -0.001], [0.6, 0.001]))
    assert len(diagnosis) == 0
    assert "Too few steps" in str(diagnosis)


def test_learn_says_what_may_be_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    bounds = ([-1.2, -0.005], [0.6, 0.005])
    KNNTD("MountainCar-v0", seed=0, bounds=bounds, verbose=1).learn(6_000, log_interval=None)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("Check bounds: ")
    assert "beyond [-0.005, 0.005] in velocity" in last
    KNNTD("MountainCar-v0", seed=0, bounds=bounds).learn(6_000)
    assert capsys.readouterr().out == ""
    model = KNNTD("MountainCar-v0", seed=0, verbose=1)
    capsys.readouterr()
    model.learn(6_000, log_interval=None)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("env", "said"), [("Rewardless-v0", ["Check initial_value: "]), ("MountainCar-v0", [])])
def test_the_demo_says_what_may_be_wrong(
    env: str, said: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gym.register("Rewardless-v0", lambda: Rewards(0.0), max_episode_steps=200)
    monkeypatch.setattr("sb3_knntd.experiments.demo.EVAL_EPISODES", 2)
    monkeypatch.setattr("sb3_knntd.experiments.demo.EVAL_ENVS", 2)
    try:
        assert main(["demo", "--env", env, "--steps", "6000", "--out", str(tmp_path)]) == 0
    finally:
        del gym.registry["Rewardless-v0"]
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Check ")]
    assert [line[: len(start)] for line, start in zip(lines, said, strict=True)] == said


def test_a_diagnosis_changes_nothing() -> None:
    models = [KNNTD("MountainCar-v0", seed=0).learn(3_000) for _ in range(2)]
    models[0].diagnose()
    models[0].explain(np.array([-0.4, 0.01])).plot()
    before = copy.deepcopy(models[0].policy.state_dict())
    for model in models:
        model.learn(500, reset_num_timesteps=False)
    assert th.equal(models[0].policy.q_table, models[1].policy.q_table)
    assert before.keys() == models[1].policy.state_dict().keys()


# ------------------------------------------------------------------------------ the page

MODELS: dict[str, tuple[type[KNNTD] | type[ExA] | type[KNNDyna], Any, dict[str, Any]]] = {
    "lattice": (KNNTD, "MountainCar-v0", {}),
    "four dimensions": (KNNTD, "CartPole-v1", {"weights": "gaussian", "bandwidth": 0.4}),
    "scattered": (KNNTD, "MountainCar-v0", {"points": SCATTERED}),
    "hashed": (KNNTD, "MountainCar-v0", {"policy_kwargs": {"table": "hashed"}, "initial_value": -3.0}),
    "continuous": (ExA, "Pendulum-v1", {"action_points": 5}),
    "factored": (ExA, PushEnv(shape=(2,)), {"action_points": [3, 4], "action_table": "factored"}),
    "states": (KNNTD, "FrozenLake-v1", {}),
    "planned": (KNNDyna, "CartPole-v1", {"simulated_steps": 10}),
    "planned continuous": (KNNDyna, "Pendulum-v1", {"simulated_steps": 10, "max_points": 200, "action_points": 5}),
    "planned of two dimensions": (KNNDyna, PushEnv(shape=(2,)), {"simulated_steps": 10}),
}


NO_PLOTLY = "const Plotly = { react(at) { at.data = []; at.on = () => {}; } };"


@pytest.fixture(scope="module")
def browser() -> Any:
    if not CHROMIUM.exists():
        pytest.skip("needs Debian's chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield browser
        browser.close()


def opened(browser: Browser, path: Path, width: int = 1600) -> tuple[Page, list[str]]:
    """A page, and everything that it says in the console or asks the network for."""
    page, said = browser.new_page(viewport={"width": width, "height": 900}), []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: said.append(request.url) if not request.url.startswith("data:") else None)
    page.goto(path.as_uri())
    page.wait_for_load_state("networkidle")
    return page, said


@pytest.mark.parametrize("case", MODELS)
def test_the_page_computes_what_the_model_does(
    case: str, browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is drawn is tested below, and loading it takes seconds.
    monkeypatch.setattr("plotly.offline.get_plotlyjs", lambda: NO_PLOTLY)
    cls, env, arguments = MODELS[case]
    model = cls(env, seed=0, **arguments).learn(300 if cls is KNNDyna else 2_500)
    write_page(model, tmp_path / "page.html")
    page, _ = opened(browser, tmp_path / "page.html")
    if case == "states":
        observations = np.arange(16)
    else:
        bounds = model.policy.perceiver.bounds
        low, high = bounds.low.numpy(), bounds.high.numpy()
        observations = np.random.default_rng(0).uniform(low - 0.1, high + 0.1, (200, len(low)))
    read = page.evaluate(
        "all => all.map(state => { const answer = read(state); return { ...answer, margin: marginOf(answer) }; })",
        observations.reshape(len(observations), -1).tolist(),
    )
    for observation, answer in zip(observations, read, strict=True):
        explanation = model.explain(observation)
        assert [each["point"] for each in answer["neighbors"]] == [each.index for each in explanation.neighbors]
        expected = [(each.probability, each.visits) for each in explanation.neighbors]
        np.testing.assert_allclose([(n["weight"], n["visits"]) for n in answer["neighbors"]], expected, rtol=1e-9)
        np.testing.assert_allclose(answer["means"], explanation.q_values, rtol=1e-9, atol=1e-12)
        assert answer["value"] == pytest.approx(explanation.value, abs=1e-9)
        assert answer["margin"] == pytest.approx(explanation.margin, abs=1e-9)
        # Where two are equal but for rounding, either may be taken.
        if cls is ExA or explanation.margin > 1e-9:
            np.testing.assert_allclose(answer["action"], explanation.action, atol=1e-6)


@pytest.fixture(scope="module")
def inspected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page written by the command, with a learning curve and a finding."""
    folder = tmp_path_factory.mktemp("inspected")
    env = Monitor(gym.make("CartPole-v1"), str(folder / "run"))
    KNNTD(env, seed=0, exploration_final_eps=0.3).learn(6_000).save(folder / "model.zip")
    env.close()
    monitor = str(folder / "run.monitor.csv")
    assert main(["inspect", str(folder / "model.zip"), "--out", str(folder / "page.html"), "--monitor", monitor]) == 0
    return folder / "page.html"


@pytest.mark.parametrize("width", [400, 1600])
def test_the_page_in_a_browser(inspected: Path, browser: Browser, width: int) -> None:
    page, said = opened(browser, inspected, width)
    assert page.title() == page.locator("h1").inner_text() == "KNNTD on CartPole-v1"
    assert "exploration_final_eps: ε is still 0.3" in page.locator("#findings").inner_text()
    # Only the table, which scrolls separately, is wider than the window.
    assert page.evaluate("document.documentElement.scrollWidth") == width
    figures = page.locator(".figure:visible")
    assert figures.count() == 5
    for index in range(figures.count()):
        drawn, box = figures.nth(index).locator("svg.main-svg").first.bounding_box(), figures.nth(index).bounding_box()
        assert drawn
        assert box
        assert drawn["width"] == pytest.approx(box["width"], abs=2)
        assert box["x"] + box["width"] <= width
    sizes = "all => all.map(e => parseFloat(getComputedStyle(e).fontSize))"
    assert min(page.eval_on_selector_all("p, td, th, label", sizes)) >= 14

    # A click on the map moves the state there, and tells why.
    before = page.locator("#neighbors tbody").inner_text()
    plot = page.locator("#value .nsewdrag").first
    box = plot.bounding_box()
    assert box
    plot.click(position={"x": 0.3 * box["width"], "y": 0.6 * box["height"]})
    page.wait_for_function("before => document.querySelector('#neighbors tbody').innerText !== before", arg=before)
    shares = "[across, up].map(dim => (state[dim] - page.low[dim]) / (page.high[dim] - page.low[dim]))"
    np.testing.assert_allclose(page.evaluate(shares), [0.3, 0.4], atol=0.05)
    rows = page.locator("#neighbors tbody tr")
    assert rows.count() == 9
    assert page.locator("#decision b").inner_text() in NAMES["CartPole-v1"].actions

    # The two dimensions can be chosen, and change places if they would be the same.
    page.locator("#across").select_option("3")
    page.locator("#up").select_option("1")
    assert page.evaluate("[across, up]") == [3, 1]
    page.locator("#up").select_option("3")
    assert page.evaluate("[across, up]") == [1, 3]
    # Sliders move the state.
    page.locator("input[type=range]").first.fill("1.2")
    page.wait_for_function("document.querySelector('#sliders output').innerText === '1.2'")
    assert said == [inspected.as_uri()]


def test_what_cannot_be_inspected_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusal(*arguments: str) -> str:
        with pytest.raises(SystemExit) as end:
            main(["inspect", *arguments])
        assert end.value.code == 2
        return capsys.readouterr().err

    assert "no such file" in refusal(str(tmp_path / "nothing.zip"))
    (tmp_path / "text.zip").write_text("text")
    assert "is no saved model" in refusal(str(tmp_path / "text.zip"))
    KNNTD("MountainCar-v0", weights=lambda d: 1 / (1 + d)).save(tmp_path / "function.zip")
    assert "weights" in refusal(str(tmp_path / "function.zip"), "--trusted")
    KNNTD("MountainCar-v0").save(tmp_path / "model.zip")
    assert "no file of SB3's Monitor" in refusal(str(tmp_path / "model.zip"), "--monitor", str(tmp_path / "model.zip"))
    monkeypatch.setattr("sb3_knntd.common.command_line.find_spec", lambda name: None)
    assert 'pip install "sb3-knntd[inspect]"' in refusal(str(tmp_path / "model.zip"))
    assert not (tmp_path / "model.html").exists()


def test_episodes_of_a_monitor_file(tmp_path: Path) -> None:
    env = Monitor(gym.make("MountainCar-v0"), str(tmp_path / "run"))
    KNNTD(env, seed=0).learn(450)
    env.close()
    episodes = read_monitor(tmp_path / "run.monitor.csv")
    assert episodes.env_id == "MountainCar-v0"
    np.testing.assert_array_equal(episodes.steps, [200, 400])
    assert episodes.returns == [-200.0, -200.0]
