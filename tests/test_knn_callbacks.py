"""The package's callbacks: correct output, complete files, and no effect on learning."""

from __future__ import annotations

import copy
import importlib
import io
import multiprocessing
import os
import pathlib
import pickle
import shutil
import signal
import time
import zipfile
from collections.abc import Callable
from multiprocessing.synchronize import Event
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sb3_knntd.callbacks as package
import torch as th
from gymnasium import spaces
from PIL import Image
from sb3_knntd.callbacks import (
    EpisodeVideoCallback,
    HParamCallback,
    PerceptionStatsCallback,
    TableCheckpointCallback,
    ValueMapCallback,
)
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import (
    CloudpickleWrapper,
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_envs import DriftEnv, GridEnv, RecordingVecEnv

from sb3_knntd import KNNTD, ExA, KNNDyna, VecDeltaFilter
from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.plots import figure_of, value_grid

MakeModel = Callable[..., KNNTD]
MakeVenv = Callable[..., VecEnv]


class ContinuousDrift(DriftEnv):
    """The drifting point, pushed by the sum of one or more forces."""

    def __init__(self, action_dim: int = 1, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)

    def step(self, action: Any) -> Any:
        return super().step(1 if abs(np.sum(action)) < 0.3 else 1 + np.sign(np.sum(action)))


def make_exa(env: gym.Env[Any, Any] | VecEnv | None = None, **arguments: Any) -> ExA:
    given = {"points": (8, 6), "bounds": (DriftEnv.LOW, DriftEnv.HIGH), "n_neighbors": 4, "seed": 0, **arguments}
    return ExA(ContinuousDrift() if env is None else env, **given)


def read_events(folder: pathlib.Path | str) -> EventAccumulator:
    return EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0, "tensors": 0}).Reload()


def same_table(first: KNNAlgorithm, second: KNNAlgorithm) -> bool:
    return th.equal(first.policy.q_table, second.policy.q_table)


def steps_in(folder: pathlib.Path, pattern: str) -> list[int]:
    return sorted(int("".join(filter(str.isdigit, path.stem))) for path in folder.glob(pattern))


def test_every_callback_is_exported() -> None:
    assert sorted(package.__all__) == package.__all__
    for name in package.__all__:
        assert issubclass(getattr(package, name), BaseCallback)


# --------------------------------------------------------------- all callbacks

ALGORITHMS: dict[str, Callable[..., KNNAlgorithm]] = {
    "KNNTD": lambda env: KNNTD(env, points=(8, 6), bounds=(DriftEnv.LOW, DriftEnv.HIGH), seed=0),
    "reference": lambda env: KNNTD(
        env, points=(8, 6), bounds=(DriftEnv.LOW, DriftEnv.HIGH), seed=0, policy_kwargs={"compiled": False}
    ),
    "hashed": lambda env: KNNTD(
        env, points=(8, 6), bounds=(DriftEnv.LOW, DriftEnv.HIGH), seed=0, policy_kwargs={"table": "hashed"}
    ),
    "ExA": lambda env: make_exa(env),
    "ExA, reference": lambda env: make_exa(env, policy_kwargs={"compiled": False}),
    "ExA, factored": lambda env: make_exa(env, action_table="factored"),
    "KNNDyna": lambda env: KNNDyna(env, spacing=0.1, simulated_steps=5, seed=0),
    "KNNDyna, Box": lambda env: KNNDyna(env, spacing=0.1, simulated_steps=5, seed=0),
}


class Rendered(gym.Wrapper):  # type: ignore[type-arg]
    """Renders noise that changes with every step."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
        self.generator = np.random.default_rng(0)

    @property
    def render_mode(self) -> str:
        return "rgb_array"

    def render(self) -> Any:
        return self.generator.integers(0, 255, (40, 60, 3), dtype=np.uint8)


@pytest.mark.parametrize(("name", "n_envs"), list(zip(ALGORITHMS, [1, 2, 3, 3, 2, 1, 2, 1], strict=True)))
def test_all_together_change_nothing_that_is_learned(tmp_path: pathlib.Path, name: str, n_envs: int) -> None:
    env = ContinuousDrift if name.startswith("ExA") or name.endswith("Box") else DriftEnv
    if name == "ExA, factored":
        env = lambda **kwargs: ContinuousDrift(2, **kwargs)  # noqa: E731

    def make_venv() -> VecEnv:
        return make_vec_env(lambda: env(offset=0.1), n_envs)

    watched = ALGORITHMS[name](make_venv())
    watched.set_logger(configure(str(tmp_path / "log"), ["tensorboard", "csv"]))
    callbacks: list[BaseCallback] = [
        ValueMapCallback(draw_freq=100, folder=tmp_path, resolution=10),
        PerceptionStatsCallback(log_freq=50),
        TableCheckpointCallback(tmp_path / "checkpoints", save_freq=40),
        EpisodeVideoCallback(Rendered(env()), video_freq=100, folder=tmp_path),
        HParamCallback(),
        EvalCallback(make_vec_env(env, 1), n_eval_episodes=1, eval_freq=60, verbose=0),
    ]
    watched.learn(150 * n_envs, callback=callbacks, log_interval=1)
    alone = ALGORITHMS[name](make_venv()).learn(150 * n_envs)
    assert same_table(watched, alone)
    assert alone.policy.q_table.any()

    events = read_events(tmp_path / "log")
    assert set(events.Tags()["images"]) == {"map/value", "video/episode"}
    assert {"perception/visited_share", "train/td_error_q50", "eval/mean_reward", "rollout/ep_rew_mean"} <= set(
        events.Tags()["scalars"]
    )
    assert [event.step for event in events.Images("map/value")] == [100 * n_envs, 150 * n_envs]
    assert steps_in(tmp_path, "value_map_*.png") == steps_in(tmp_path, "episode_*.gif") == [100 * n_envs, 150 * n_envs]
    assert steps_in(tmp_path / "checkpoints", "*_steps.zip") == [80 * n_envs, 120 * n_envs, 150 * n_envs]


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: ValueMapCallback(folder=folder),
        lambda folder: PerceptionStatsCallback(),
        lambda folder: TableCheckpointCallback(folder),
    ],
)
def test_another_algorithm_is_refused(tmp_path: pathlib.Path, make: Callable[..., BaseCallback]) -> None:
    dqn = DQN("MlpPolicy", "MountainCar-v0", buffer_size=10, policy_kwargs={"net_arch": [4]})
    with pytest.raises(ValueError, match="needs a model of KNNTD, ExA or KNNDyna; got a DQN"):
        dqn.learn(10, callback=make(tmp_path))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ValueMapCallback(draw_freq=0), "draw_freq must be an integer >= 1; got 0"),
        (lambda: ValueMapCallback(n_routes=-1), "n_routes must be an integer >= 0; got -1"),
        (lambda: ValueMapCallback(resolution=0), "resolution must be an integer from 1 to 4096; got 0"),
        (lambda: PerceptionStatsCallback(log_freq=1.5), "log_freq must be an integer"),  # type: ignore[arg-type]
        (lambda: PerceptionStatsCallback(n_samples=0), "n_samples must be an integer >= 1"),
        (lambda: TableCheckpointCallback("x", save_freq=-3), "save_freq must be an integer"),
        (lambda: TableCheckpointCallback("x", n_last=0), "n_last must be an integer >= 1; got 0"),
        (lambda: EpisodeVideoCallback(Rendered(DriftEnv()), max_steps=0), "max_steps must be an integer >= 1"),
        (lambda: EpisodeVideoCallback(DriftEnv()), r"render_mode='rgb_array'; got None"),
        (lambda: EpisodeVideoCallback(DummyVecEnv([DriftEnv] * 2)), "eval_env must be one environment; got 2"),
        (lambda: ValueMapCallback(resolution=10**9), "resolution must be an integer from 1 to 4096; got 1000000000"),
        (lambda: ValueMapCallback(n_routes=10**400), "n_routes must be an integer >= 0 and < 2"),
        (lambda: ValueMapCallback(dims=None), "dims must be two different dimensions, counted from 0; got None"),
        (lambda: ValueMapCallback(dims=(0, 0.5)), "dims must be two different dimensions"),
        (lambda: ValueMapCallback(fixed=[1.0]), r"fixed must be a dict of dimensions and their values.*\[1.0\]"),
        (lambda: ValueMapCallback(fixed={2: np.nan}), "fixed must be a finite number"),
        (lambda: ValueMapCallback(average="yes"), "average must be True or False; got 'yes'"),
        (lambda: ValueMapCallback(folder=3), "folder must be a path.*got 3"),
        (lambda: ValueMapCallback(names="position"), "names must be plots.Names"),
        (lambda: ValueMapCallback(verbose="much"), "verbose must be an integer >= 0; got 'much'"),
        (lambda: PerceptionStatsCallback(n_samples=True), "n_samples must be an integer >= 1; got True"),
        (lambda: TableCheckpointCallback(None), "save_path must be a path.*got None"),
        (lambda: TableCheckpointCallback("x", save_best="no"), "save_best must be True or False; got 'no'"),
        (lambda: TableCheckpointCallback("x", name_prefix="a/b"), "name_prefix must be part of a file's name.*'a/b'"),
        (lambda: TableCheckpointCallback("x", name_prefix="a\\b"), "name_prefix must be part of a file's name"),
        (lambda: TableCheckpointCallback("x", name_prefix="a\0b"), "name_prefix must be part of a file's name"),
        (lambda: TableCheckpointCallback("x", name_prefix=None), "name_prefix must be part of a file's name.*None"),
        (lambda: EpisodeVideoCallback("CartPole-v1"), "eval_env must be an environment.*'CartPole-v1'"),
        (lambda: EpisodeVideoCallback(Rendered(DriftEnv()), folder=b"x"), "folder must be a path.*b'x'"),
        (lambda: HParamCallback(metrics=[1]), r"metrics must be names of scalars.*\[1\]"),
        (lambda: HParamCallback(metrics=3), "metrics must be names of scalars.*3"),
        (lambda: HParamCallback(metrics=()), "metrics must be names of scalars"),
        (lambda: HParamCallback(metrics="rollout/ep_rew_mean"), "metrics must be names of scalars"),
    ],
)
def test_arguments_that_do_not_fit(make: Callable[[], BaseCallback], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# ------------------------------------------------------------------- throttling


class Ticking(PerceptionStatsCallback):
    """Acts for a given time of a simulated clock that every step advances."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, act_seconds: float, step_seconds: float) -> None:
        super().__init__()
        self.acts: list[int] = []
        monkeypatch.setattr(
            time,
            "perf_counter",
            lambda: self.model.num_timesteps * step_seconds + len(self.acts) * act_seconds,
        )

    def _act(self) -> None:
        self.acts.append(self.n_calls)


def test_by_default_it_uses_its_share_of_the_time(make_model: MakeModel, monkeypatch: pytest.MonkeyPatch) -> None:
    callback = Ticking(monkeypatch, act_seconds=0.2, step_seconds=0.1)
    make_model().learn(4500, callback=callback)
    # A share of 0.2 %: the first act is expected to last 5 ms, due after 2.5 s; it lasts 0.2 s, so the next is due
    # after 100 s.
    first, *others = callback.acts
    assert 25 <= first <= 25 + 128
    np.testing.assert_allclose(others, [2000, 3000, 4000, 4500], atol=128)


def test_nothing_is_done_twice_at_the_end(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    callback = ValueMapCallback(draw_freq=50, folder=tmp_path, resolution=5)
    model = make_model().learn(100, callback=callback)
    times = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert sorted(times) == ["value_map_100.png", "value_map_50.png"]
    # No plot without a step.
    model.learn(0, callback=callback, reset_num_timesteps=False)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == times


@pytest.mark.slow
def test_the_benchmark_measures_every_callback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parent.parent))
    benchmark = importlib.import_module("benchmarks.callbacks")
    monkeypatch.setattr(benchmark, "STEPS", 200)
    step, (least, *rows) = benchmark.measure(seconds=4.0, repeats=1)
    assert [row.name for row in rows] == list(benchmark.make_callbacks(pathlib.Path("nowhere")))
    assert step > 0
    assert all(0 < row.call < 1000 for row in [least, *rows])
    acted = {row.name: row.act for row in rows}
    assert acted["PerceptionStatsCallback"] > 0


# -------------------------------------------------------------------- value map


class Undrawn(ValueMapCallback):
    """Records when it should draw, at 0.1 % of the time."""

    def _act(self) -> None:
        self._visitation.count(self._extent())


@pytest.mark.parametrize(("n_envs", "n_steps"), [(1, 200), (1, 2500), (3, 1500)])
def test_visits_and_trajectories_match_the_observations(
    make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path, n_envs: int, n_steps: int
) -> None:
    venv = RecordingVecEnv(make_venv(n_envs))
    # Narrower than the visited range: visits outside are not shown.
    low, high = np.array([-0.8, -0.02]), np.array([0.2, 0.03])
    callback = Undrawn(folder=tmp_path, resolution=7, n_routes=2)
    make_model(venv, bounds=(low, high)).learn(n_steps, callback=callback)

    steps = venv.steps
    after = [step.observations for step in steps[1:]] + [venv._shown]
    places = np.concatenate(after)
    expected, *_ = np.histogram2d(places[:, 1], places[:, 0], bins=7, range=((low[1], high[1]), (low[0], high[0])))
    np.testing.assert_array_equal(callback._visitation.counts, expected)
    assert expected.sum() < n_steps

    routes: list[list[np.ndarray]] = [[]]
    for step in steps:
        routes[-1].append(step.observations[0])
        if step.terminated[0] or step.truncated[0]:
            routes[-1].append(step.arrived[0])
            routes.append([])
    assert len(callback._visitation.trajectories) == 2
    for drawn, was in zip(callback._visitation.trajectories, routes[-3:-1], strict=True):
        np.testing.assert_array_equal(drawn, was)


def test_visits_continue_in_another_learn(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    callback = Undrawn(folder=tmp_path, resolution=3)
    model = make_model(bounds=([-50.0, -50.0], [50.0, 50.0]))
    model.learn(70, callback=callback)
    assert callback._visitation.counts.sum() == 70
    model.learn(50, callback=callback, reset_num_timesteps=False)
    assert callback._visitation.counts.sum() == 120


def test_a_long_episode_is_drawn_from_its_last_part(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    from sb3_knntd.callbacks.visitation import BUFFERED, MAX_CHUNKS

    env = DriftEnv(lengths=[BUFFERED * (MAX_CHUNKS + 3)], ends=["terminated"])
    env = DummyVecEnv([lambda: env])  # type: ignore[assignment]
    callback = Undrawn(folder=tmp_path, resolution=3)
    make_model(env, bounds=([-3.0, -3.0], [3.0, 3.0])).learn(BUFFERED * (MAX_CHUNKS + 3), callback=callback)
    (route,) = callback._visitation.trajectories
    assert BUFFERED * (MAX_CHUNKS - 1) <= len(route) <= BUFFERED * (MAX_CHUNKS + 1) + 1


def test_visits_are_kept_when_the_range_changes(tmp_path: pathlib.Path) -> None:
    model = KNNTD("CartPole-v1", points=3, n_neighbors=4, seed=0)
    callback = Undrawn(dims=(1, 3), draw_freq=900, folder=tmp_path, resolution=10)
    model.learn(2048, callback=callback)
    low, high = (bound.tolist() for bound in (model.policy.perceiver.bounds.low, model.policy.perceiver.bounds.high))
    assert callback._visitation._extent == callback._extent() == (low[1], high[1], low[3], high[3])
    # Up to the count at 900 the range was not known, and what was beyond ±1 was in no cell.
    assert 1148 < callback._visitation.counts.sum() <= 2048


def test_visits_keep_their_places_when_the_range_widens() -> None:
    from sb3_knntd.callbacks.visitation import Visitation

    visitation = Visitation((0, 1), resolution=4, n_trajectories=1)
    visitation.start(np.zeros((1, 2), np.float32))
    for place in ([0.1, 0.1], [0.9, 0.1], [0.9, 0.1], [1.0, 1.0]):
        visitation.recent.append(np.array([place], np.float32))
    visitation.count((0.0, 1.0, 0.0, 1.0))
    np.testing.assert_array_equal(visitation.counts, [[1, 0, 0, 2], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]])
    visitation.recent.append(np.array([[-1.0, 0.6]], np.float32))
    visitation.count((-1.0, 1.0, 0.0, 1.0))
    np.testing.assert_array_equal(visitation.counts, [[0, 0, 1, 2], [0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def test_the_map_shows_the_model(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    callback = ValueMapCallback(folder=tmp_path, resolution=12)
    model = make_model().learn(300, callback=callback)
    value, action, visits, *_ = callback.draw().axes
    grid = value_grid(model, resolution=12)
    np.testing.assert_array_equal(value.images[0].get_array(), np.ma.masked_where(~grid.learned, grid.values))
    np.testing.assert_array_equal(action.images[0].get_array(), np.ma.masked_where(~grid.learned, grid.actions))
    np.testing.assert_array_equal(visits.images[0].get_array().filled(0), callback._visitation.counts)
    # A line, a circle and a cross for each of three episodes.
    assert len(value.lines) == 9
    latest = callback._visitation.trajectories[-1]
    np.testing.assert_array_equal(value.lines[0].get_xydata(), latest)
    assert figure_of(value).get_suptitle() == "step 300; lines: the last 3 episodes"


def test_the_map_of_continuous_actions_has_a_panel_for_each(tmp_path: pathlib.Path) -> None:
    callback = ValueMapCallback(folder=tmp_path, resolution=8)
    model = make_exa(ContinuousDrift(3)).learn(200, callback=callback)
    panels = [axes for axes in callback.draw().axes if axes.get_title()]
    assert [axes.get_title() for axes in panels] == ["Value", *["Greedy action"] * 3, "Visits"]
    grid = value_grid(model, resolution=8)
    assert grid.actions.shape == (8, 8, 3)
    for dim in range(3):
        drawn = panels[1 + dim].images[0]
        np.testing.assert_array_equal(drawn.get_array(), np.ma.masked_where(~grid.learned, grid.actions[..., dim]))
        assert drawn.get_clim() == (-1.0, 1.0)


def test_files_and_tensorboard_hold_the_same_picture(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model(tensorboard_log=str(tmp_path / "log"))
    model.learn(120, callback=ValueMapCallback(draw_freq=60, folder=tmp_path, resolution=10, verbose=1))
    images = read_events(tmp_path / "log" / "KNNTD_1").Images("map/value")
    assert [image.step for image in images] == [60, 120]
    for image in images:
        logged = Image.open(io.BytesIO(image.encoded_image_string)).convert("RGB")
        written = Image.open(tmp_path / f"value_map_{image.step}.png").convert("RGB")
        assert logged.tobytes() == written.tobytes()
        assert len(set(logged.getdata())) > 50


def test_a_map_without_output_is_an_error(make_model: MakeModel) -> None:
    model = make_model()
    with pytest.raises(ValueError, match=r"nowhere to go\. Give the model tensorboard_log, or the callback folder"):
        model.learn(100, callback=ValueMapCallback())
    assert model.num_timesteps == 0


@pytest.mark.parametrize(
    ("env", "arguments", "message"),
    [
        (GridEnv("discrete"), {}, "two dimensions of a Box of observations; got Discrete"),
        (DriftEnv(), {"dims": (0, 2)}, "dims must be two different dimensions of 0 to 1"),
        (DriftEnv(), {"fixed": {0: 1.0}}, "fixed must name dimensions"),
        (DriftEnv(), {"names": (("one",), ("other",))}, "names must hold one for each"),
    ],
)
def test_an_invalid_view_is_refused_at_once(
    tmp_path: pathlib.Path, env: Any, arguments: dict[str, Any], message: str
) -> None:
    from sb3_knntd.plots import Names

    if "names" in arguments:
        arguments = {"names": Names(*arguments["names"])}
    model = KNNTD(env, seed=0)
    with pytest.raises(ValueError, match=message):
        model.learn(100, callback=ValueMapCallback(folder=tmp_path, **arguments))
    assert model.num_timesteps == 0


class SeveralDims(DriftEnv):
    """The drifting point with two additional constant dimensions."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)

    def _observe(self) -> Any:
        return np.concatenate([super()._observe(), [0.25, -0.5]]).astype(np.float32)


def test_averages_are_over_visited_points() -> None:
    model = KNNTD(SeveralDims(), points=5, n_neighbors=1, seed=0)
    points = model.policy.points
    # Nonzero values on one side of dimension 2 only.
    values = th.where(points[:, 2:3] > 0.1, 2.0 + points[:, :1], 0.0) + th.where(
        points[:, 2:3] > 0.1, th.tensor([0.0, 0.5, 0.0]), th.zeros(3)
    )
    model.policy.q_table.copy_(values)
    grid = value_grid(model, dims=(0, 1), average=True, resolution=5)
    assert grid.fixed == {}
    assert grid.averaged == (2, 3)
    np.testing.assert_allclose(grid.values, np.tile(2.5 + np.linspace(-1, 1, 5), (5, 1)))
    np.testing.assert_array_equal(grid.actions, 1)
    held = value_grid(model, dims=(0, 1), fixed={2: -1.0}, average=True, resolution=5)
    assert held.fixed == {2: -1.0}
    assert held.averaged == (3,)
    assert not held.learned.any()


def test_the_value_of_continuous_actions_is_the_mean_of_the_best() -> None:
    model = make_exa(action_points=3).learn(300)
    observations = np.random.default_rng(0).uniform(DriftEnv.LOW, DriftEnv.HIGH, (1, 2))
    rows, probabilities = model.policy.perceived_rows(observations)
    grid = value_grid(model, resolution=1)
    rows, probabilities = model.policy.perceived_rows((DriftEnv.LOW + DriftEnv.HIGH)[None] / 2)
    assert grid.values[0, 0] == pytest.approx(float((probabilities * rows.amax(dim=2)).sum()))
    assert grid.actions[0, 0, 0] == model.predict((DriftEnv.LOW + DriftEnv.HIGH) / 2, deterministic=True)[0][0]


# ------------------------------------------------------------- perception stats


def stats(model: KNNAlgorithm, folder: pathlib.Path, n_steps: int = 400, **arguments: Any) -> list[dict[str, float]]:
    """The logged values, one dict per log."""
    model.set_logger(configure(str(folder), ["tensorboard"]))
    callback = PerceptionStatsCallback(**{"log_freq": n_steps // 2 // model.n_envs, **arguments})
    model.learn(n_steps, callback=callback, log_interval=None)
    events = read_events(folder)
    logs: dict[int, dict[str, float]] = {}
    for tag in events.Tags()["scalars"]:
        for event in events.Scalars(tag):
            logs.setdefault(event.step, {})[tag] = event.value
    return [logs[step] for step in sorted(logs)]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_stats_of_a_table_that_is_not_learned(
    make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path, n_envs: int
) -> None:
    venv = RecordingVecEnv(make_venv(n_envs))
    low, high = np.array([-0.7, -0.02]), np.array([0.1, 0.02])
    model = make_model(venv, learning_rate=0.0, initial_value=2.0, gamma=0.8, trace_decay=0.5, bounds=(low, high))
    first, last = stats(model, tmp_path, 2400 * n_envs, n_samples=10**6)

    sampled = [index for index in range(2400) if index % 102 == 1]
    steps = [venv.steps[index] for index in sampled]
    rewards = np.concatenate([step.rewards for step in steps])
    worth = np.where(np.concatenate([step.terminated for step in steps]), 0.0, 2.0)
    for name, quantile in (("q05", 0.05), ("q50", 0.5), ("q95", 0.95)):
        expected = np.quantile(rewards + 0.8 * worth - 2.0, quantile)
        assert last[f"train/td_error_{name}"] == pytest.approx(expected, rel=1e-5)
    places = np.concatenate([step.observations for step in steps])
    outside = ((places < np.float32(low)) | (places > np.float32(high))).any(axis=1).mean()
    assert 0 < outside < 1
    assert last["perception/outside_share"] == pytest.approx(outside)
    probabilities = model.policy.perceive(places).probabilities
    assert last["perception/neighbors"] == pytest.approx(float((1 / (probabilities**2).sum(dim=1)).mean()))
    assert last["perception/visited_share"] == pytest.approx(model.policy.table.n_visited / 48)
    assert last["train/trace_length"] == pytest.approx(1 / (1 - 0.8 * 0.5))
    assert last["train/policy_changes"] == 0.0
    assert "train/policy_changes" not in first


@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
def test_td_errors_vanish_after_convergence(tmp_path: pathlib.Path, target: str) -> None:
    # One state per episode with a reward that depends only on the state, and no next state: Q is the reward.
    env = GridEnv("discrete", lengths=[1], ends=["terminated"])
    model = KNNTD(env, learning_rate=1.0, target=target, exploration_initial_eps=0.5, seed=0)
    last = stats(model, tmp_path, 4000)[-1]
    assert last["train/td_error_q05"] == last["train/td_error_q95"] == 0.0
    assert last["perception/neighbors"] == 1.0
    assert last["perception/outside_share"] == 0.0


def test_changes_of_the_policy_are_seen(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    class Turn(BaseCallback):
        """Makes another action the best one everywhere, once."""

        def _on_step(self) -> bool:
            if self.n_calls == 300:
                self.model.set_parameters({"policy": self.better(2), "learner": self.model.learner.state_dict()})
            return True

        def better(self, action: int) -> dict[str, Any]:
            state = {key: value.clone() for key, value in self.model.policy.state_dict().items()}
            state["table.values"] = th.eye(3, dtype=th.float64)[action].expand(48, 3).clone()
            return state

    model = make_model(learning_rate=0.0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(800, callback=[PerceptionStatsCallback(log_freq=200), Turn()], log_interval=None)
    changes = [event.value for event in read_events(tmp_path).Scalars("train/policy_changes")]
    assert changes == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("trace_decay", [0.0, 0.8])
def test_points_with_a_trace_are_counted_alike(
    make_model: MakeModel, tmp_path: pathlib.Path, trace_decay: float
) -> None:
    counts = []
    for compiled in (True, False):
        model = make_model(trace_decay=trace_decay, policy_kwargs={"compiled": compiled})
        # 403 steps stop in the middle of an episode.
        last = stats(model, tmp_path / str(compiled), 403, log_freq=403)[-1]
        counts.append(last["train/trace_points"])
    if trace_decay:
        assert counts[0] == counts[1] > 4
    else:
        assert counts[1] == 0


@pytest.mark.parametrize("n_envs", [1, 2])
def test_measuring_steps_are_not_sampled(tmp_path: pathlib.Path, n_envs: int) -> None:
    model = KNNTD(make_vec_env("CartPole-v1", n_envs), points=3, n_neighbors=4, seed=0)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    callback = PerceptionStatsCallback(log_freq=100)
    model.learn(900, callback=callback, log_interval=None)
    assert not callback._sample
    assert not read_events(tmp_path).Tags()["scalars"]
    model.learn(400, callback=callback, log_interval=None, reset_num_timesteps=False)
    assert read_events(tmp_path).Scalars("perception/outside_share")[-1].value < 1.0


def test_stats_of_normalised_environments(make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path) -> None:
    model = make_model(VecNormalize(make_venv(2)), bounds=([-2.0, -2.0], [2.0, 2.0]))
    last = stats(model, tmp_path, 4000)[-1]
    # In normalised units, in which few observations are beyond two standard deviations.
    assert last["perception/outside_share"] < 0.5


# ------------------------------------------------------------------ checkpoints


class Snapshot(BaseCallback):
    """Copies the environments, without their wrappers, after a number of calls, for a run that continues from there."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at
        self.venv: Any = None

    def _on_step(self) -> bool:
        if self.n_calls == self.at:
            self.venv = copy.deepcopy(self.training_env.unwrapped)
        return True


class Shift(VecEnvWrapper):
    """Subtracts the running mean of the observations: a wrapper with a state, saved like VecNormalize."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.mean, self.n = 0.0, 0

    def _shift(self, observations: Any) -> Any:
        self.n += 1
        self.mean += (float(observations.mean()) - self.mean) / self.n
        return observations - np.float32(0.1 * self.mean)

    def reset(self) -> Any:
        return self._shift(self.venv.reset())

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return self._shift(observations), rewards, dones, infos

    def save(self, path: str) -> None:
        with open(path, "wb") as file:
            pickle.dump((self.mean, self.n), file)

    @staticmethod
    def load(path: str, venv: VecEnv) -> Shift:
        shift = Shift(venv)
        with open(path, "rb") as file:
            shift.mean, shift.n = pickle.load(file)
        return shift


WRAPPERS: dict[str, Callable[[VecEnv], VecEnv]] = {
    "bare": lambda venv: venv,
    "VecNormalize": lambda venv: VecNormalize(venv, norm_reward=False),
    "filter and VecNormalize": lambda venv: VecCheckNan(Shift(VecNormalize(venv, norm_reward=False))),
}


@pytest.mark.parametrize("at", [29, 100])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("wrap", WRAPPERS.values(), ids=WRAPPERS)
def test_a_resumed_run_equals_the_uninterrupted(
    make_model: MakeModel,
    make_venv: MakeVenv,
    tmp_path: pathlib.Path,
    wrap: Callable[[VecEnv], VecEnv],
    n_envs: int,
    at: int,
) -> None:
    snapshot, total = Snapshot(at), 200 * n_envs
    callbacks = [TableCheckpointCallback(tmp_path, save_freq=at, n_last=100), snapshot]
    whole = make_model(wrap(make_venv(n_envs)), bounds=([-2.0, -2.0], [2.0, 2.0]))
    whole.learn(total, callback=callbacks)

    checkpoint = tmp_path / f"checkpoint_{at * n_envs}_steps.zip"
    resumed = TableCheckpointCallback.resume(checkpoint, wrap(snapshot.venv), force_reset=False)
    assert resumed.num_timesteps == at * n_envs
    resumed.learn(total - resumed.num_timesteps, reset_num_timesteps=False)
    assert resumed.num_timesteps == whole.num_timesteps
    assert same_table(resumed, whole)
    assert whole.policy.q_table.count_nonzero() > 20


def test_resume_wraps_a_bare_environment(make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path) -> None:
    model = make_model(Shift(VecNormalize(make_venv(2))), bounds=([-2.0, -2.0], [2.0, 2.0]))
    model.learn(100, callback=TableCheckpointCallback(tmp_path))
    for venv in (make_venv(2), Shift(VecNormalize(make_venv(2)))):
        resumed = TableCheckpointCallback.resume(tmp_path, venv)
        outer: Any = resumed.get_env()
        assert isinstance(outer, Shift)
        assert outer.n == model.get_env().n  # type: ignore[union-attr]
        assert isinstance(outer.venv, VecNormalize)
        np.testing.assert_array_equal(outer.venv.obs_rms.mean, model.get_env().venv.obs_rms.mean)  # type: ignore[union-attr]
        resumed.learn(50, reset_num_timesteps=False)
        assert resumed.num_timesteps == 150


def test_resume_restores_the_table_of_a_filter(make_venv: MakeVenv, tmp_path: pathlib.Path) -> None:
    model = KNNTD(VecDeltaFilter(make_venv(2)), points=5, n_neighbors=3, seed=0)
    model.learn(300, callback=TableCheckpointCallback(tmp_path))
    resumed = TableCheckpointCallback.resume(tmp_path, make_venv(2))
    known, learned = resumed.get_env(), model.get_env()
    assert isinstance(known, VecDeltaFilter)
    assert isinstance(learned, VecDeltaFilter)
    th.testing.assert_close(known.table.state_dict(), learned.table.state_dict(), rtol=0, atol=0)
    resumed.learn(100, reset_num_timesteps=False)


def test_callbacks_before_there_are_points(tmp_path: pathlib.Path) -> None:
    """KNNDyna lays its points after a number of steps."""
    model = KNNDyna(DriftEnv(), seed=0)
    model.set_logger(configure(str(tmp_path / "log"), ["csv"]))
    model.learn(12, callback=[PerceptionStatsCallback(log_freq=6), ValueMapCallback(draw_freq=6, folder=tmp_path)])
    assert len(model.policy.points) == 0
    assert steps_in(tmp_path, "value_map_*.png") == [6, 12]


@pytest.mark.parametrize("cls", [KNNTD, ExA, KNNDyna])
def test_resume_finds_the_algorithm(tmp_path: pathlib.Path, cls: type[KNNAlgorithm]) -> None:
    env_id = "MountainCarContinuous-v0" if cls is ExA else "MountainCar-v0"
    model = cls(env_id, seed=0).learn(300, callback=TableCheckpointCallback(tmp_path))
    resumed = TableCheckpointCallback.resume(tmp_path, env_id)
    assert type(resumed) is cls
    assert same_table(resumed, model)
    assert resumed.learn(100, reset_num_timesteps=False).num_timesteps == 400
    # A checkpoint is also a saved model.
    assert same_table(cls.load(tmp_path / "checkpoint_300_steps"), model)


def test_the_last_and_the_best_are_kept(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    class Returns(BaseCallback):
        """Sets the return of every episode."""

        def _on_step(self) -> bool:
            mean = {20: 1.0, 40: 5.0, 60: 2.0, 80: 5.0, 100: 4.0}.get(self.n_calls)
            if mean is not None:
                self.model.ep_info_buffer.clear()  # type: ignore[union-attr]
                self.model.ep_info_buffer.extend([{"r": mean, "l": 1, "t": 0}] * 3)  # type: ignore[union-attr]
            return True

    callback = TableCheckpointCallback(tmp_path, save_freq=20, n_last=2)
    model = make_model().learn(100, callback=[Returns(), callback])
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "checkpoint_100_steps.zip",
        "checkpoint_80_steps.zip",
        "checkpoint_best.zip",
    ]
    assert callback.best_mean_reward == 5.0
    assert KNNTD.load(callback.best_path).num_timesteps == 40
    assert TableCheckpointCallback.resume(callback.best_path, DriftEnv()).num_timesteps == 40

    # The best checkpoint before a crash is still the best after it.
    again = TableCheckpointCallback(tmp_path, save_freq=20)
    model = TableCheckpointCallback.resume(tmp_path, DriftEnv())  # type: ignore[assignment]
    model.learn(60, callback=again, reset_num_timesteps=False)
    assert again.best_mean_reward == 5.0
    assert KNNTD.load(again.best_path).num_timesteps == 40


def test_without_a_return_there_is_no_best(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    make_model().learn(5, callback=TableCheckpointCallback(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint_5_steps.zip"]
    make_model().learn(50, callback=TableCheckpointCallback(tmp_path / "other", save_best=False))
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["checkpoint_50_steps.zip"]


def test_checkpoints_of_another_run_are_not_overwritten(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    make_model().learn(60, callback=TableCheckpointCallback(tmp_path))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"holds a checkpoint of step 60, and this run is at step 0. To go on"):
        make_model().learn(100, callback=TableCheckpointCallback(tmp_path))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    make_model().learn(20, callback=TableCheckpointCallback(tmp_path, name_prefix="other"))
    assert TableCheckpointCallback.resume(tmp_path, DriftEnv(), name_prefix="other").num_timesteps == 20
    assert TableCheckpointCallback.resume(tmp_path, DriftEnv()).num_timesteps == 60


def test_resume_without_a_checkpoint(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no checkpoint checkpoint_\*_steps\.zip in"):
        TableCheckpointCallback.resume(tmp_path / "nowhere", DriftEnv())
    make_model().save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model.zip is no checkpoint"):
        TableCheckpointCallback.resume(tmp_path / "model.zip", DriftEnv())
    make_model().learn(40, callback=TableCheckpointCallback(tmp_path))
    path = tmp_path / "checkpoint_40_steps.zip"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"checkpoint_40_steps.zip is no checkpoint, or was cut off"):
        TableCheckpointCallback.resume(tmp_path, DriftEnv())


def in_child(work: Callable[[Event], Any], seconds: float | None = None) -> int | None:
    """
    Run in a separate process and return its exit code. The process is killed the given time after it has set the event,
    unless it kills itself. It is not forked, because libraries in this process have threads.
    """
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    child = context.Process(target=carry_out, args=(CloudpickleWrapper(work), begun))
    child.start()
    if seconds is not None:
        # Kill the process in any case, so that it does not outlive a failed test.
        begun.wait(60)
        child.join(seconds)
        child.kill()
    child.join()
    return child.exitcode


def carry_out(work: CloudpickleWrapper, begun: Event) -> None:
    work.var(begun)


DEADLY = {
    "fsync": (os, "fsync"),
    "replace": (os, "replace"),
    "write": (zipfile.ZipFile, "writestr"),
    "copy": (shutil, "copyfileobj"),
    "unlink": (pathlib.Path, "unlink"),
}


@pytest.mark.parametrize("nth", [1, 4])
@pytest.mark.parametrize("where", DEADLY)
def test_a_kill_at_any_time_leaves_a_complete_checkpoint(
    make_model: MakeModel, tmp_path: pathlib.Path, where: str, nth: int
) -> None:
    make_model().learn(40, callback=TableCheckpointCallback(tmp_path, n_last=2))
    owner, name = DEADLY[where]

    def work(begun: Event) -> None:
        original, calls = getattr(owner, name), []

        def deadly(*args: Any, **kwargs: Any) -> Any:
            calls.append(1)
            if len(calls) == nth:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*args, **kwargs)

        setattr(owner, name, deadly)
        model = TableCheckpointCallback.resume(tmp_path, DriftEnv())
        # Every checkpoint is the best so far; otherwise nothing would be copied.
        callback = TableCheckpointCallback(tmp_path, save_freq=10, n_last=2)
        model.learn(100, callback=[Rising(), callback], reset_num_timesteps=False)

    assert in_child(work) == -signal.SIGKILL
    resumed = TableCheckpointCallback.resume(tmp_path, DriftEnv())
    assert 40 <= resumed.num_timesteps <= 140
    callback = TableCheckpointCallback(tmp_path, n_last=2)
    resumed.learn(100, callback=callback, reset_num_timesteps=False)
    assert KNNTD.load(callback.best_path).policy.q_table.any()
    # Partially written files are removed.
    assert len(list(tmp_path.iterdir())) == 3


class Rising(BaseCallback):
    """Makes the mean return increase with every step."""

    def _on_step(self) -> bool:
        self.model.ep_info_buffer.append({"r": float(self.num_timesteps), "l": 1, "t": 0})  # type: ignore[union-attr]
        return True


def test_kills_at_random_times(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    make_model().learn(20, callback=TableCheckpointCallback(tmp_path))

    def work(begun: Event) -> None:
        model = TableCheckpointCallback.resume(tmp_path, DriftEnv())
        model.learn(1, reset_num_timesteps=False)
        begun.set()
        model.learn(10**9, callback=TableCheckpointCallback(tmp_path, save_freq=1), reset_num_timesteps=False)

    generator, reached = np.random.default_rng(0), 20
    for _ in range(6):
        assert in_child(work, seconds=0.1 + generator.uniform(0.0, 0.3)) == -signal.SIGKILL
        steps = TableCheckpointCallback.resume(tmp_path, DriftEnv()).num_timesteps
        assert steps >= reached
        reached = steps
    assert reached > 20


# ----------------------------------------------------------------------- videos


def frames_of(gif: Any) -> list[np.ndarray]:
    with Image.open(gif) as image:
        frames = []
        for index in range(image.n_frames):
            image.seek(index)
            frames.append(np.asarray(image.convert("RGB")))
    return frames


def test_a_video_shows_an_episode_of_the_greedy_policy(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model(tensorboard_log=str(tmp_path / "log"))
    env = RecordingVecEnv(DummyVecEnv([lambda: Rendered(DriftEnv(lengths=[9]))]))
    model.learn(100, callback=EpisodeVideoCallback(env, folder=tmp_path, verbose=1))
    for step in env.steps:
        assert step.actions == model.predict(step.observations, deterministic=True)[0]
    # The frame of the reset and those of the nine steps.
    assert len(env.steps) == 9
    frames = frames_of(tmp_path / "episode_100.gif")
    assert len(frames) == 10
    assert frames[0].shape == (40, 60, 3)
    assert np.abs(frames[0].astype(int) - frames[1]).mean() > 10
    (logged,) = read_events(tmp_path / "log" / "KNNTD_1").Images("video/episode")
    assert logged.step == 100
    assert logged.encoded_image_string == (tmp_path / "episode_100.gif").read_bytes()
    with Image.open(tmp_path / "episode_100.gif") as image:
        assert image.info["duration"] == 50


def test_a_video_is_not_larger_or_longer_than_needed(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    class Large(Rendered):
        def __init__(self) -> None:
            super().__init__(DriftEnv(lengths=[10**6]))
            self.metadata = {"render_fps": 100}

        def render(self) -> Any:
            return np.full((480, 640, 3), self.generator.integers(255), dtype=np.uint8)

    callback = EpisodeVideoCallback(Large(), folder=tmp_path, max_steps=16)
    make_model().learn(20, callback=callback)
    frames = frames_of(tmp_path / "episode_20.gif")
    assert len(frames) == 4
    assert frames[0].shape == (240, 320, 3)


def test_videos_of_normalised_environments_use_the_statistics_of_training(
    make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    train = VecNormalize(make_venv(2))
    other = VecNormalize(DummyVecEnv([lambda: Rendered(DriftEnv())]), training=False)
    make_model(train, bounds=([-2.0, -2.0], [2.0, 2.0])).learn(
        100, callback=EpisodeVideoCallback(other, folder=tmp_path)
    )
    np.testing.assert_array_equal(other.obs_rms.mean, train.obs_rms.mean)


def test_a_video_without_output_is_an_error(make_model: MakeModel) -> None:
    with pytest.raises(ValueError, match="the video has nowhere to go"):
        make_model().learn(100, callback=EpisodeVideoCallback(Rendered(DriftEnv())))


# ---------------------------------------------------------------------- HParams


def test_hparams_are_the_arguments_of_the_model(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    from tensorboard.plugins.hparams import plugin_data_pb2

    model = make_model(
        tensorboard_log=str(tmp_path), weights=lambda d2: 1 / (1 + d2), policy_kwargs={"dtype": th.float32}
    )
    model.learn(30, callback=HParamCallback(["rollout/ep_rew_mean", "eval/mean_reward"]))
    metadata = read_events(tmp_path / "KNNTD_1").summary_metadata
    start, experiment = (
        plugin_data_pb2.HParamsPluginData.FromString(metadata[f"_hparams_/{name}"].plugin_data.content)
        for name in ("session_start_info", "experiment")
    )
    written = {
        key: value.number_value if value.HasField("number_value") else value.string_value
        for key, value in start.session_start_info.hparams.items()
    }
    assert written["algorithm"] == "KNNTD"
    assert written["n_envs"] == 1
    assert written["learning_rate"] == 0.3
    assert written["points"] == "(8, 6)"
    assert written["weights"] == "<lambda>"
    assert written["dtype"] == "torch.float32"
    assert written["target"] == "sarsa"
    assert written["seed"] == 0
    assert not {"env", "policy", "tensorboard_log", "verbose"} & set(written) - {"env"}
    names = [metric.name.tag for metric in experiment.experiment.metric_infos]
    assert names == ["rollout/ep_rew_mean", "eval/mean_reward"]


def test_hparams_are_short_enough_for_a_table() -> None:
    from sb3_knntd.callbacks.hparams import describe

    model = KNNTD(
        "MountainCar-v0",
        points=np.random.default_rng(0).uniform(-1, 0.5, (30, 2)),
        bounds=([-1.2, -0.07], [0.6, 0.07]),
        learning_rate=lambda progress: 0.5 * progress,
    )
    described = describe(model)
    assert described["env"] == "MountainCar-v0"
    assert described["points"] == "array of shape (30, 2)"
    assert described["learning_rate"] == "<lambda>"
    assert described["trace_decay"] == 0.9
    assert all(len(str(value)) <= 60 for value in described.values())


def test_hparams_need_tensorboard(make_model: MakeModel) -> None:
    with pytest.raises(ValueError, match="give the model tensorboard_log"):
        make_model().learn(10, callback=HParamCallback())
