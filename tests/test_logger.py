"""The logged values, their keys, and when and where they are logged."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor
from toy_envs import DriftEnv

from sb3_knntd import KNNTD, ExA

Algorithm = type[KNNTD | ExA]
MakeModel = Callable[..., KNNTD | ExA]
MakeVenv = Callable[..., VecEnv]
ReadLog = Callable[[pathlib.Path], list[dict[str, float]]]


@pytest.fixture(params=[KNNTD, ExA])
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


SB3_KEYS = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "time/total_timesteps"}
OWN_KEYS = {
    "train/td_error",
    "train/learning_rate",
    "train/exploration_rate",
    "train/visited_points",
    "train/q_mean",
}
# SB3 excludes these from TensorBoard.
TEXT_KEYS = {"time/episodes", "time/time_elapsed", "time/total_timesteps"}


def logged(model: KNNTD | ExA, folder: pathlib.Path) -> KNNTD | ExA:
    model.set_logger(configure(str(folder), ["csv"]))
    return model


@pytest.mark.parametrize("n_envs", [1, 3])
def test_keys(
    make_model: MakeModel, make_venv: MakeVenv, read_log: ReadLog, tmp_path: pathlib.Path, n_envs: int
) -> None:
    logged(make_model(make_venv(n_envs)), tmp_path).learn(120 * n_envs)
    rows = read_log(tmp_path)
    assert rows
    for row in rows:
        assert row.keys() >= SB3_KEYS | OWN_KEYS | TEXT_KEYS
        assert np.isfinite(list(row.values())).all()


def test_values(make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path) -> None:
    model = make_model(
        learning_rate=LinearSchedule(0.8, 0.2, 1.0), exploration_initial_eps=0.6, exploration_fraction=0.5
    )
    # Episodes of 9, 14 and 6 steps: the fifth ends after 9 + 14 + 6 + 9 + 14 steps.
    logged(model, tmp_path).learn(100, log_interval=5)
    first = read_log(tmp_path)[0]
    assert first["time/total_timesteps"] == 52
    assert first["time/episodes"] == 5
    assert first["rollout/ep_len_mean"] == pytest.approx(52 / 5)
    assert first["rollout/ep_rew_mean"] == pytest.approx(
        np.mean([info["r"] for info in list(model.ep_info_buffer)[:5]])
    )
    assert first["train/learning_rate"] == pytest.approx(0.8 - 0.6 * 0.52)
    assert first["train/exploration_rate"] == 0.0
    assert first["time/fps"] > 0
    assert first["train/td_error"] > 0
    assert first["train/q_mean"] < 0


def test_exploration_rate_follows_its_schedule(
    make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path
) -> None:
    model = make_model(exploration_initial_eps=0.6, exploration_final_eps=0.2, exploration_fraction=0.5)
    logged(model, tmp_path).learn(100, log_interval=1)
    for row in read_log(tmp_path):
        progress = row["time/total_timesteps"] / 100
        assert row["train/exploration_rate"] == pytest.approx(max(0.2, 0.6 - 0.4 * progress / 0.5))


def test_visited_points_are_the_updated_ones(make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path) -> None:
    # With an unattainable initial value every updated entry differs from it.
    model = make_model(initial_value=-77.0, exploration_initial_eps=1.0, trace_decay=0.0)
    logged(model, tmp_path).learn(52, log_interval=5)
    moved = int((model.policy.q_table != -77.0).any(dim=1).sum())
    assert 4 < moved <= 48
    assert read_log(tmp_path)[-1]["train/visited_points"] == moved


class SameEpisode(gym.Wrapper[Any, Any, Any, Any]):
    """Every episode is equal to the first."""

    def reset(self, **kwargs: Any) -> Any:
        self.unwrapped.episode = -1  # type: ignore[attr-defined]
        return super().reset(**kwargs)


def test_means_are_of_the_steps_since_the_last_log(
    env_cls: type[DriftEnv], make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path
) -> None:
    # A constant table has the same TD errors in every equal episode.
    model = make_model(
        SameEpisode(env_cls()), learning_rate=0.0, initial_value=-3.0, tie_break="first", exploration_initial_eps=0
    )
    logged(model, tmp_path).learn(36, log_interval=1)
    rows = read_log(tmp_path)
    assert len(rows) == 4
    assert [row["train/q_mean"] for row in rows] == [pytest.approx(-3.0)] * 4
    assert [row["train/td_error"] for row in rows] == [pytest.approx(rows[0]["train/td_error"])] * 4


@pytest.mark.parametrize(
    ("arguments", "episodes"),
    [({"log_interval": 1}, [1, 2, 3, 4, 5, 6, 7, 8]), ({"log_interval": 4}, [4, 8]), ({}, [4, 8])],
    ids=["1", "4", "default"],
)
def test_log_interval_counts_episodes(
    make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path, arguments: dict[str, Any], episodes: list[int]
) -> None:
    logged(make_model(), tmp_path).learn(85, **arguments)
    assert [row["time/episodes"] for row in read_log(tmp_path)] == episodes


def test_no_log_interval_no_log(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    logged(make_model(), tmp_path).learn(85, log_interval=None)
    assert not (tmp_path / "progress.csv").read_text()


def test_means_are_over_the_window(make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path) -> None:
    logged(make_model(stats_window_size=2), tmp_path).learn(60, log_interval=1)
    assert [row["rollout/ep_len_mean"] for row in read_log(tmp_path)][:4] == [9.0, 11.5, 10.0, 7.5]


def test_environments_without_monitor_log_no_episodes(
    env_cls: type[DriftEnv], make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path
) -> None:
    logged(make_model(DummyVecEnv([env_cls])), tmp_path).learn(60)
    row = read_log(tmp_path)[-1]
    assert row.keys() >= OWN_KEYS
    assert "rollout/ep_rew_mean" not in row


def test_vec_monitor_is_read(
    env_cls: type[DriftEnv], make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path
) -> None:
    logged(make_model(VecMonitor(DummyVecEnv([env_cls]))), tmp_path).learn(60)
    assert read_log(tmp_path)[0]["rollout/ep_len_mean"] == pytest.approx((9 + 14 + 6 + 9) / 4)


class WithSuccess(gym.Wrapper[Any, Any, Any, Any]):
    """Every step reports a success."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": True}


def test_success_rate(
    env_cls: type[DriftEnv], make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path
) -> None:
    logged(make_model(WithSuccess(env_cls())), tmp_path).learn(60)
    assert read_log(tmp_path)[-1]["rollout/success_rate"] == 1.0


def test_continued_learning_keeps_counting(make_model: MakeModel, read_log: ReadLog, tmp_path: pathlib.Path) -> None:
    model = logged(make_model(), tmp_path).learn(40, log_interval=1)
    model.learn(40, log_interval=1, reset_num_timesteps=False)
    rows = read_log(tmp_path)
    assert [row["time/total_timesteps"] for row in rows] == [9, 23, 29, 38, 52, 58, 67]
    assert [row["time/episodes"] for row in rows] == [1, 2, 3, 4, 5, 6, 7]


def test_steps_of_measuring_are_logged(
    algorithm: Algorithm, cart_pole: str, read_log: ReadLog, tmp_path: pathlib.Path
) -> None:
    logged(algorithm(cart_pole, points=3, n_neighbors=2, seed=0), tmp_path).learn(400)
    rows = read_log(tmp_path)
    assert rows
    assert all(row.keys() >= SB3_KEYS for row in rows)
    assert rows[-1]["train/visited_points"] == 0, "values were learned before the range was known"


@pytest.mark.parametrize(("verbose", "printed"), [(0, False), (1, True)])
def test_verbose_prints_the_table(
    make_model: MakeModel, capsys: pytest.CaptureFixture[str], verbose: int, printed: bool
) -> None:
    make_model(verbose=verbose).learn(60)
    assert ("ep_rew_mean" in capsys.readouterr().out) is printed


# -------------------------------------------------------------- TensorBoard


def read_tensorboard(folder: pathlib.Path) -> dict[str, list[int]]:
    """The steps of every scalar in the folder of a run."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(folder))
    events.Reload()
    return {tag: [event.step for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_tensorboard_has_the_same_keys(algorithm: Algorithm, make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    make_model(tensorboard_log=str(tmp_path)).learn(85)
    assert [folder.name for folder in tmp_path.iterdir()] == [f"{algorithm.__name__}_1"]
    scalars = read_tensorboard(tmp_path / f"{algorithm.__name__}_1")
    expected = (SB3_KEYS | OWN_KEYS) - TEXT_KEYS
    assert scalars.keys() >= expected
    assert not scalars.keys() & TEXT_KEYS
    assert {tuple(scalars[key]) for key in expected} == {(38, 81)}


def test_runs_are_numbered_by_name(algorithm: Algorithm, make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model(tensorboard_log=str(tmp_path))
    model.learn(30)
    model.learn(30)
    model.learn(30, tb_log_name="drift")
    assert sorted(folder.name for folder in tmp_path.iterdir()) == [
        f"{algorithm.__name__}_1",
        f"{algorithm.__name__}_2",
        "drift_1",
    ]


def test_continued_learning_logs_to_the_same_run(
    algorithm: Algorithm, make_model: MakeModel, tmp_path: pathlib.Path
) -> None:
    model = make_model(tensorboard_log=str(tmp_path)).learn(40)
    model.learn(60, reset_num_timesteps=False)
    assert [folder.name for folder in tmp_path.iterdir()] == [f"{algorithm.__name__}_1"]
    assert read_tensorboard(tmp_path / f"{algorithm.__name__}_1")["train/td_error"] == [38, 81]
