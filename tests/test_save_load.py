"""Files contain the whole model, survive interruption, and are refused if they do not match."""

from __future__ import annotations

import copy
import io
import os
import pathlib
import resource
import zipfile
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS, TD_ONLY, BoxDyna, fitting
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from toy_envs import DriftEnv, GridEnv, PushEnv

from sb3_knntd import KNNTD, ExA, KNNDyna

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeGrid = Callable[..., gym.Env[Any, Any]]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


SCATTERED = np.random.default_rng(5).uniform(DriftEnv.LOW, DriftEnv.HIGH, size=(30, 2))
# Each variant has other state that must be saved.
SETTINGS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "constant epsilon": {"exploration_initial_eps": 0.4, "exploration_final_eps": 0.4},
    "schedules": {"learning_rate": LinearSchedule(0.8, 0.1, 1.0), "trace_decay": LinearSchedule(0.3, 0.9, 1.0)},
    "accumulating": {"traces": "accumulating", "step_size": "paper", "trace_decay": 0.8, "learning_rate": 0.1},
    "greedy, random ties": {"exploration_initial_eps": 0.0, "tie_break": "random"},
    "first ties": {"exploration_initial_eps": 0.1, "tie_break": "first"},
    "scattered": {"points": SCATTERED},
    "half size": {"policy_kwargs": {"dtype": th.float32}},
    "own weights": {"weights": lambda d2: (1.0 + d2) ** -2},
    "no seed": {"seed": None},
}
KNNTD_SETTINGS: dict[str, dict[str, Any]] = {
    "softmax": {"exploration": "softmax", "temperature": LinearSchedule(1.0, 0.2, 1.0)},
    "q_learning": {"target": "q_learning", "exploration_initial_eps": 0.3},
    "expected_sarsa": {"target": "expected_sarsa", "exploration_initial_eps": 0.3},
}
EXA_SETTINGS: dict[str, dict[str, Any]] = {
    "per neighbor": {"exploration": "per_neighbor", "exploration_initial_eps": 0.3},
    "other action points": {"action_points": [[-1.0, -0.13, 0.71, 0.9]]},
}
DYNA_SETTINGS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "full": {"buffer_size": 110, "max_points": 40},
    "schedules": {"learning_rate": LinearSchedule(0.8, 0.1, 1.0), "trace_decay": LinearSchedule(0.3, 0.9, 1.0)},
    "half size": {"policy_kwargs": {"dtype": th.float32}},
    "no seed": {"seed": None},
    "the bounds of the space": {"bounds": None, "spacing": 0.03},
}
MODELS = pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        pytest.param(algorithm, settings, id=f"{algorithm.__name__}-{name}")
        for algorithm, own in (
            (KNNTD, SETTINGS | KNNTD_SETTINGS),
            (ExA, SETTINGS | EXA_SETTINGS),
            (KNNDyna, DYNA_SETTINGS),
            (BoxDyna, DYNA_SETTINGS),
        )
        for name, settings in own.items()
    ],
)


def same_table(first: KNNTD | ExA | KNNDyna, second: KNNTD | ExA | KNNDyna) -> bool:
    return th.equal(first.policy.q_table, second.policy.q_table)


def go_on(algorithm: Algorithm, path: pathlib.Path, venv: VecEnv, n_steps: int) -> KNNTD | ExA | KNNDyna:
    """Load, and continue in an environment that is still in the state it was in."""
    return algorithm.load(path, env=venv, force_reset=False).learn(n_steps, reset_num_timesteps=False)


# ------------------------------------------------------------ saved state


@pytest.mark.parametrize("n_envs", [1, 3])
@MODELS
def test_interrupted_run_equals_the_uninterrupted(
    algorithm: Algorithm,
    make_model: MakeModel,
    make_venv: MakeVenv,
    tmp_path: pathlib.Path,
    settings: dict[str, Any],
    n_envs: int,
) -> None:
    # Odd numbers of steps, to stop in the middle of episodes in all environments.
    whole = make_model(make_venv(n_envs), **settings)
    whole.save(tmp_path / "start")
    whole.learn(101).learn(101, reset_num_timesteps=False)

    venv = make_venv(n_envs)
    # Both start with the same random state, even without a seed.
    algorithm.load(tmp_path / "start", env=venv).learn(101).save(tmp_path / "middle")
    resumed = go_on(algorithm, tmp_path / "middle", venv, 101)
    assert same_table(resumed, whole)
    assert resumed.num_timesteps == whole.num_timesteps
    assert resumed.exploration_rate == whole.exploration_rate
    assert resumed.policy.q_table.count_nonzero() > 50, "too little was learned for a comparison"


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(
    ("algorithm", "env_id", "arguments"),
    [
        (KNNTD, "MountainCar-v0", {"points": (6, 6), "n_neighbors": 4}),
        (KNNTD, "FrozenLake-v1", {}),
        (ExA, "MountainCarContinuous-v0", {"points": (6, 6), "n_neighbors": 4}),
    ],
)
def test_interrupted_run_in_stochastic_environments(
    algorithm: Algorithm, tmp_path: pathlib.Path, env_id: str, arguments: dict[str, Any], n_envs: int
) -> None:
    def make() -> VecEnv:
        return make_vec_env(lambda: gym.make(env_id, max_episode_steps=30), n_envs)

    whole = algorithm(make(), seed=3, **arguments).learn(110).learn(110, reset_num_timesteps=False)
    venv = make()
    algorithm(venv, seed=3, **arguments).learn(110).save(tmp_path / "middle")
    assert same_table(go_on(algorithm, tmp_path / "middle", venv, 110), whole)


@pytest.mark.parametrize("first", [300, 1200])
def test_interrupted_while_and_after_measuring(
    algorithm: Algorithm, cart_pole: str, tmp_path: pathlib.Path, first: int
) -> None:
    def make() -> VecEnv:
        return make_vec_env(cart_pole, 1)

    arguments = fitting(algorithm, {"points": 3, "n_neighbors": 4, "seed": 1})
    whole = algorithm(make(), **arguments).learn(first).learn(1400 - first, reset_num_timesteps=False)
    venv = make()
    algorithm(venv, **arguments).learn(first).save(tmp_path / "middle")
    resumed = go_on(algorithm, tmp_path / "middle", venv, 1400 - first)
    assert same_table(resumed, whole)
    assert resumed.policy.q_table.any()
    assert th.equal(resumed.policy.points, whole.policy.points)


def test_interrupted_run_in_normalised_environments(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    bounds = ([-2.0, -2.0], [2.0, 2.0])
    whole = make_model(VecNormalize(make_venv(2)), bounds=bounds).learn(100).learn(100, reset_num_timesteps=False)
    venv = VecNormalize(make_venv(2))
    make_model(venv, bounds=bounds).learn(100).save(tmp_path / "middle")
    resumed = go_on(algorithm, tmp_path / "middle", venv, 100)
    assert same_table(resumed, whole)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"policy_kwargs": {"dtype": th.float32}},
        {"points": "grow", "spacing": 0.2},
        {"policy_kwargs": {"table": "hashed"}, "search": "auto"},
        {"search": "kd_tree"},
        {"points": np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2)), "search": "brute"},
    ],
)
def test_a_deep_copy_continues_independently(
    algorithm: Algorithm, make_model: MakeModel, arguments: dict[str, Any]
) -> None:
    if issubclass(algorithm, KNNDyna) and not arguments.keys() <= {"policy_kwargs", "points", "spacing"}:
        pytest.skip("KNNDyna has points of its own")
    # Stop in the middle of an episode.
    model = make_model(**arguments).learn(155)
    before, other = model.policy.q_table.clone(), copy.deepcopy(model)
    other.learn(200, reset_num_timesteps=False)
    assert th.equal(model.policy.q_table, before)
    model.learn(200, reset_num_timesteps=False)
    assert th.equal(model.policy.q_table, other.policy.q_table)
    assert not th.equal(model.policy.q_table, before)


def test_saving_does_not_change_the_model(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    saving = make_model().learn(100)
    saving.save(tmp_path / "seen")
    saving.learn(100, reset_num_timesteps=False)
    assert same_table(saving, make_model().learn(100).learn(100, reset_num_timesteps=False))


class Snapshot(BaseCallback):
    """Copies the environments after a number of calls, for a run that continues from the checkpoint of that step."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at
        self.venv: Any = None

    def _on_step(self) -> bool:
        if self.n_calls == self.at:
            self.venv = copy.deepcopy(self.training_env)
        return True


# Episodes have 9, 14 and 6 steps, so that the first of the three is the last step of an episode.
@pytest.mark.parametrize("at", [29, 100, 120])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("learning_rate", [0.3, LinearSchedule(0.9, 0.0, 1.0), lambda progress: 0.5 * progress**2])
def test_checkpoint_in_the_middle_of_learn(
    algorithm: Algorithm,
    make_model: MakeModel,
    make_venv: MakeVenv,
    tmp_path: pathlib.Path,
    learning_rate: Any,
    n_envs: int,
    at: int,
) -> None:
    arguments = {"learning_rate": learning_rate, "exploration_fraction": 1.0, "exploration_initial_eps": 0.5}
    total = 240 * n_envs
    snapshot = Snapshot(at)
    checkpoints = CheckpointCallback(save_freq=at, save_path=str(tmp_path))
    whole = make_model(make_venv(n_envs), **arguments).learn(total, callback=CallbackList([checkpoints, snapshot]))

    done = at * n_envs
    resumed = go_on(algorithm, tmp_path / f"rl_model_{done}_steps", snapshot.venv, total - done)
    assert resumed.num_timesteps == whole.num_timesteps == total
    assert same_table(resumed, whole)
    # The models are not equal merely because nothing was learned after the checkpoint.
    assert not same_table(whole, algorithm.load(tmp_path / f"rl_model_{done}_steps"))


@pytest.mark.parametrize("at", [29, 100])
def test_checkpoint_keeps_the_counters_of_the_log(
    algorithm: Algorithm,
    make_model: MakeModel,
    make_venv: MakeVenv,
    read_log: Callable[..., Any],
    tmp_path: pathlib.Path,
    at: int,
) -> None:
    def last_row(name: str) -> dict[str, float]:
        row = read_log(tmp_path / name)[-1]
        durations = ("time/fps", "time/time_elapsed", "train/planning_time")
        return {key: value for key, value in row.items() if key not in durations}

    snapshot = Snapshot(at)
    whole = make_model(make_venv())
    whole.set_logger(configure(str(tmp_path / "whole"), ["csv"]))
    checkpoints = CheckpointCallback(save_freq=at, save_path=str(tmp_path))
    whole.learn(160, callback=[checkpoints, snapshot], log_interval=1)

    resumed = algorithm.load(tmp_path / f"rl_model_{at}_steps", env=snapshot.venv, force_reset=False)
    resumed.set_logger(configure(str(tmp_path / "resumed"), ["csv"]))
    resumed.learn(160 - at, reset_num_timesteps=False, log_interval=1)
    assert last_row("resumed") == last_row("whole")


@MODELS
def test_loaded_model_predicts_the_same(
    algorithm: Algorithm,
    make_model: MakeModel,
    observations: np.ndarray,
    tmp_path: pathlib.Path,
    settings: dict[str, Any],
) -> None:
    model = make_model(**settings).learn(150)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert same_table(loaded, model)
    assert loaded.policy.q_table.dtype == model.policy.q_table.dtype
    assert th.equal(loaded.policy.points, model.policy.points)
    assert th.equal(loaded.policy.q_values(observations), model.policy.q_values(observations))
    for kept, given in zip(loaded.policy.perceive(observations), model.policy.perceive(observations), strict=True):
        assert th.equal(kept, given)
    assert np.array_equal(
        loaded.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )


def test_measured_ranges_are_kept_without_the_environment(
    algorithm: Algorithm, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    # Only the file contains the normalisation under which the ranges were measured.
    venv = VecNormalize(make_venv(2))
    model = algorithm(venv, **fitting(algorithm, {"points": 5, "seed": 0})).learn(1200)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    seen = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    assert th.equal(loaded.policy.points, model.policy.points)
    assert th.equal(loaded.policy.q_values(seen), model.policy.q_values(seen))
    assert model.policy.q_values(seen).count_nonzero() > 20


@pytest.mark.parametrize("kind", ["discrete", "multi_discrete"])
def test_exact_tables_are_kept(algorithm: Algorithm, make_grid: MakeGrid, tmp_path: pathlib.Path, kind: str) -> None:
    model = algorithm(make_grid(kind), seed=0).learn(150)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert same_table(loaded, model)
    states = model.policy.points.numpy().squeeze().astype(np.int64)
    assert np.array_equal(loaded.predict(states, deterministic=True)[0], model.predict(states, deterministic=True)[0])


OWN_ARGUMENTS: dict[Algorithm, dict[str, Any]] = {
    KNNTD: {"target": "q_learning", "exploration": "softmax", "temperature": 0.5},
    ExA: {
        "action_points": [[-1.0, 0.2, 1.0]], "action_table": "factored", "exploration": "per_neighbor",
        "exploration_hold": 3.0,
    },
}  # fmt: skip


@TD_ONLY
def test_arguments_are_kept(algorithm: Algorithm, make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    given = {
        "learning_rate": 0.2, "gamma": 0.9, "trace_decay": 0.7, "n_neighbors": 3, "points": [5, 4], "bandwidth": 0.5,
        "weights": "gaussian", "search": "brute", "step_size": "paper", "traces": "accumulating",
        "reset_other_actions": False, "exploration_initial_eps": 0.3, "exploration_final_eps": 0.2,
        "exploration_fraction": 0.9, "tie_break": "first", "initial_value": 2.0, "verbose": 0, "seed": 7,
        **OWN_ARGUMENTS[algorithm],
    }  # fmt: skip
    make_model(**given).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert {name: getattr(loaded, name) for name in given} == given
    assert (loaded.policy.q_table == 2.0).all()


def test_arguments_of_dyna_are_kept(tmp_path: pathlib.Path) -> None:
    given = {
        "learning_rate": 0.1, "gamma": 0.9, "trace_decay": 0.7, "buffer_size": 150, "spacing": 0.3, "max_points": 50,
        "action_points": [[-1.0, 0.2, 1.0]], "simulated_steps": 7, "optimism": 0.5, "reward_function": None,
        "verbose": 0, "seed": 7,
    }  # fmt: skip
    KNNDyna(PushEnv(), **given).learn(200).save(tmp_path / "model")
    loaded = KNNDyna.load(tmp_path / "model")
    assert {name: getattr(loaded, name) for name in given} == given
    assert [points.tolist() for points in loaded.policy.action_points] == given["action_points"]


# ---------------------------------------------------- other environments


@pytest.mark.parametrize(("saved", "loaded"), [(1, 3), (3, 1), (2, 4)])
def test_other_number_of_environments(
    algorithm: Algorithm,
    make_model: MakeModel,
    make_venv: MakeVenv,
    tmp_path: pathlib.Path,
    saved: int,
    loaded: int,
) -> None:
    model = make_model(make_venv(saved)).learn(100)
    model.save(tmp_path / "model")
    other = algorithm.load(tmp_path / "model", env=make_venv(loaded))
    assert same_table(other, model)
    assert other.n_envs == loaded
    other.learn(90, reset_num_timesteps=False)
    assert other.num_timesteps >= model.num_timesteps + 90
    assert not same_table(other, model)
    assert th.isfinite(other.policy.q_table).all()


def test_other_number_of_environments_cannot_be_in_the_same_state(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    make_model(make_venv(1)).learn(100).save(tmp_path / "model")
    # The saved state does not fit three environments, but loading into other environments is allowed. So
    # new episodes start, as after a reset.
    model = algorithm.load(tmp_path / "model", env=make_venv(3), force_reset=False)
    model.learn(90, reset_num_timesteps=False)
    assert model.num_timesteps == 190
    assert th.isfinite(model.policy.q_table).all()


def test_load_without_environment_then_set_one(
    algorithm: Algorithm,
    make_model: MakeModel,
    make_venv: MakeVenv,
    observations: np.ndarray,
    tmp_path: pathlib.Path,
) -> None:
    model = make_model().learn(100)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert loaded.get_env() is None
    assert np.array_equal(loaded.predict(observations)[0], model.predict(observations)[0])
    with pytest.raises(ValueError, match="set_env"):
        loaded.learn(100)
    loaded.set_env(make_venv())
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.num_timesteps == 200
    assert not same_table(loaded, model)


def test_reset_on_load_starts_new_episodes(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    venv = make_venv()
    # The first episode has 9 steps, and 14 the second.
    make_model(venv).learn(4).save(tmp_path / "model")
    resumed = algorithm.load(tmp_path / "model", env=venv)
    resumed.learn(14, reset_num_timesteps=False)
    assert [info["l"] for info in resumed.ep_info_buffer or ()] == [14]


@pytest.mark.parametrize("as_text", [True, False])
@pytest.mark.parametrize(("name", "written"), [("mc", "mc.zip"), ("mc.zip", "mc.zip"), ("sub/folder/mc", None)])
def test_paths(
    algorithm: Algorithm,
    make_model: MakeModel,
    tmp_path: pathlib.Path,
    name: str,
    written: str | None,
    as_text: bool,
) -> None:
    path: Any = str(tmp_path / name) if as_text else tmp_path / name
    model = make_model().learn(20)
    model.save(path)
    assert (tmp_path / (written or f"{name}.zip")).is_file()
    assert same_table(algorithm.load(path), model)


def test_file_objects(algorithm: Algorithm, make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model().learn(20)
    memory = io.BytesIO()
    model.save(memory)
    memory.seek(0)
    assert same_table(algorithm.load(memory), model)
    with open(tmp_path / "model.zip", "wb") as file:
        model.save(file)
    with open(tmp_path / "model.zip", "rb") as file:
        assert same_table(algorithm.load(file), model)


def test_attributes_are_changed_on_load(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    make_model().learn(20).save(tmp_path / "model")
    model = algorithm.load(tmp_path / "model", env=make_venv(), learning_rate=0.0, verbose=0)
    before = model.policy.q_table.clone()
    assert model.lr_schedule(1.0) == 0.0
    model.learn(50)
    if not issubclass(algorithm, KNNDyna):
        assert th.equal(model.policy.q_table, before)
    replaced = algorithm.load(tmp_path / "model", custom_objects={"gamma": 0.5}, print_system_info=True)
    assert replaced.gamma == 0.5


def test_file_permissions_follow_the_umask(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    umask = os.umask(0o022)
    try:
        make_model().save(tmp_path / "model")
    finally:
        os.umask(umask)
    assert (tmp_path / "model.zip").stat().st_mode & 0o777 == 0o644


# ------------------------------------------------------------- interruption


def interrupt(*args: Any, **kwargs: Any) -> Any:
    raise KeyboardInterrupt


@pytest.fixture
def saved(make_model: MakeModel, tmp_path: pathlib.Path) -> pathlib.Path:
    """A file with a model trained for 100 steps, alone in its folder."""
    path = tmp_path / "saved" / "model.zip"
    make_model().learn(100).save(path)
    return path


def check_untouched(algorithm: Algorithm, path: pathlib.Path, before: bytes) -> None:
    assert [file.name for file in path.parent.iterdir()] == [path.name], "something was left behind"
    assert path.read_bytes() == before
    assert algorithm.load(path).num_timesteps == 100


@pytest.mark.parametrize(
    ("module", "function"),
    [(os, "fsync"), (os, "replace"), (zipfile.ZipFile, "writestr"), (th, "save")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_interrupted_save_leaves_the_previous_file(
    algorithm: Algorithm, saved: pathlib.Path, monkeypatch: pytest.MonkeyPatch, module: Any, function: str
) -> None:
    before = saved.read_bytes()
    model = algorithm.load(saved, learning_rate=0.7)
    with monkeypatch.context() as patched:
        patched.setattr(module, function, interrupt)
        with pytest.raises(KeyboardInterrupt):
            model.save(saved)
    check_untouched(algorithm, saved, before)
    # And the next one succeeds.
    model.save(saved)
    assert algorithm.load(saved).learning_rate == 0.7


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_disk_that_is_full_at_some_byte_leaves_the_previous_file(
    algorithm: Algorithm, saved: pathlib.Path, share: float
) -> None:
    before = saved.read_bytes()
    model = algorithm.load(saved, learning_rate=0.7)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * len(before)), hard))
    try:
        with pytest.raises(OSError, match="too large"):
            model.save(saved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    check_untouched(algorithm, saved, before)


def test_first_save_interrupted_leaves_nothing(
    make_model: MakeModel, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model()
    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        model.save(tmp_path / "model")
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------ refusal


def test_missing_file(algorithm: Algorithm, tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        algorithm.load(tmp_path / "nowhere")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99])
def test_cut_off_file(algorithm: Algorithm, saved: pathlib.Path, share: float) -> None:
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"model\.zip"):
        algorithm.load(saved)


def test_file_without_its_last_byte(algorithm: Algorithm, saved: pathlib.Path) -> None:
    saved.write_bytes(saved.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"model\.zip"):
        algorithm.load(saved)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7])
def test_file_with_a_changed_byte(algorithm: Algorithm, saved: pathlib.Path, share: float) -> None:
    content = bytearray(saved.read_bytes())
    content[int(share * len(content))] ^= 0xFF
    saved.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.zip"):
        algorithm.load(saved)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04", b"\x80\x04\x95"])
def test_a_file_that_is_not_a_zip(algorithm: Algorithm, tmp_path: pathlib.Path, content: bytes) -> None:
    (tmp_path / "model.zip").write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.zip"):
        algorithm.load(tmp_path / "model.zip")


@pytest.mark.parametrize("data", [None, b"", b"{", b"[1, 2]", b"\xff\xfe"])
def test_zip_of_something_else(algorithm: Algorithm, tmp_path: pathlib.Path, data: bytes | None) -> None:
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("readme.txt", "holiday pictures")
        if data is not None:
            archive.writestr("data", data)
    with pytest.raises(ValueError, match=r"model\.zip"):
        algorithm.load(tmp_path / "model.zip")


@pytest.mark.parametrize("missing", [".pth", "data"])
def test_zip_without_one_of_its_parts(algorithm: Algorithm, saved: pathlib.Path, missing: str) -> None:
    with zipfile.ZipFile(saved) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    # SB3 writes an empty file of variables, but does not need it.
    names = [name for name in parts if name.endswith(missing) and name != "pytorch_variables.pth"]
    assert names
    for absent in names:
        with zipfile.ZipFile(saved, "w") as archive:
            for name in parts.keys() - {absent}:
                archive.writestr(name, parts[name])
        with pytest.raises(ValueError, match=r"model\.zip"):
            algorithm.load(saved)


def test_file_of_another_algorithm(algorithm: Algorithm, tmp_path: pathlib.Path) -> None:
    DQN("MlpPolicy", "MountainCar-v0", buffer_size=10, policy_kwargs={"net_arch": [4]}).save(tmp_path / "dqn")
    with pytest.raises(ValueError, match=algorithm._algorithm):
        algorithm.load(tmp_path / "dqn")


def test_file_of_another_algorithm_is_not_unpickled(
    algorithm: Algorithm, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    DQN("MlpPolicy", "MountainCar-v0", buffer_size=10, policy_kwargs={"net_arch": [4]}).save(tmp_path / "dqn")
    monkeypatch.setattr("stable_baselines3.common.save_util.json_to_data", interrupt)
    with pytest.raises(ValueError, match=algorithm._algorithm):
        algorithm.load(tmp_path / "dqn")


@pytest.mark.parametrize("env", ["MountainCar-v0", "Acrobot-v1", GridEnv()], ids=["Box", "larger Box", "Discrete"])
def test_file_of_another_space(algorithm: Algorithm, saved: pathlib.Path, env: Any) -> None:
    other = gym.make(env) if isinstance(env, str) else env
    with pytest.raises(ValueError, match=r"[Oo]bservation space"):
        algorithm.load(saved, env=other)


@pytest.mark.parametrize(
    ("algorithm", "space"),
    [(KNNTD, gym.spaces.Discrete(4)), (ExA, gym.spaces.Box(-1.0, 1.0, (2,), np.float64))],
)
def test_file_of_another_action_space(
    algorithm: Algorithm, saved: pathlib.Path, env_cls: type[DriftEnv], space: gym.spaces.Space[Any]
) -> None:
    env = env_cls()
    env.action_space = space  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"[Aa]ction space"):
        algorithm.load(saved, env=DummyVecEnv([lambda: env]))


def test_refused_file_leaves_the_file(algorithm: Algorithm, saved: pathlib.Path) -> None:
    before = saved.read_bytes()
    with pytest.raises(ValueError, match="space"):
        algorithm.load(saved, env=gym.make("Acrobot-v1"))
    check_untouched(algorithm, saved, before)


@pytest.mark.parametrize("compiled", [True, False])
def test_another_number_of_neighbours_can_be_given_when_loading(tmp_path: pathlib.Path, compiled: bool) -> None:
    """The table is kept; new episodes start."""
    arguments: dict[str, Any] = {"points": (9, 9), "policy_kwargs": {"compiled": compiled}, "seed": 0}
    KNNTD("MountainCar-v0", n_neighbors=4, **arguments).learn(300).save(tmp_path / "four")
    venv = make_vec_env("MountainCar-v0", seed=0)
    for force_reset in (True, False):
        model = KNNTD.load(tmp_path / "four", env=venv, n_neighbors=7, force_reset=force_reset)
        assert th.equal(model.policy.q_table, KNNTD.load(tmp_path / "four").policy.q_table)
        model.learn(100, reset_num_timesteps=False)
        assert model.num_timesteps == 400
        assert model.policy.perceive(np.zeros(2)).indices.shape == (1, 7)
