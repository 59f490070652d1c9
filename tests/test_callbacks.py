"""SB3's callbacks get what they expect, and their return values are respected."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_knntd import KNNTD, ExA, KNNDyna

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


class Witness(BaseCallback):
    """Records its calls in order; returns False at call number ``stop_at``."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.stop_at = stop_at
        self.calls: list[str] = []
        self.timesteps: list[int] = []
        self.dones = 0

    def _on_training_start(self) -> None:
        self.calls.append("training_start")
        # SB3's hyperparameter loggers read these here.
        assert "total_timesteps" in self.locals
        assert "log_interval" in self.locals

    def _on_rollout_start(self) -> None:
        self.calls.append("rollout_start")

    def _on_step(self) -> bool:
        self.calls.append("step")
        self.timesteps.append(self.num_timesteps)
        n_envs = self.training_env.num_envs
        assert self.locals["new_obs"].shape == (n_envs, 2)
        assert self.locals["rewards"].shape == self.locals["dones"].shape == (n_envs,)
        assert len(self.locals["infos"]) == n_envs
        self.dones += int(self.locals["dones"].sum())
        return self.n_calls != self.stop_at

    def _on_rollout_end(self) -> None:
        self.calls.append("rollout_end")

    def _on_training_end(self) -> None:
        self.calls.append("training_end")


@pytest.mark.parametrize("n_envs", [1, 3])
def test_order_and_contents_of_calls(make_model: MakeModel, make_venv: MakeVenv, n_envs: int) -> None:
    witness = Witness()
    model = make_model(make_venv(n_envs)).learn(60, callback=witness)
    assert witness.timesteps == list(range(n_envs, 61, n_envs))
    assert witness.calls[:3] == ["training_start", "rollout_start", "step"]
    assert witness.calls[-2:] == ["rollout_end", "training_end"]
    assert witness.calls.count("rollout_start") == witness.calls.count("rollout_end")
    assert witness.dones == len(model.ep_info_buffer or ()) > 0


@pytest.mark.parametrize("n_envs", [1, 3])
def test_returning_false_stops_after_that_step(make_model: MakeModel, make_venv: MakeVenv, n_envs: int) -> None:
    witness = Witness(stop_at=17)
    model = make_model(make_venv(n_envs)).learn(600, callback=witness)
    assert model.num_timesteps == 17 * n_envs
    assert witness.n_calls == 17
    assert witness.calls[-1] == "training_end"


def test_step_is_learned_from_before_the_callback(make_model: MakeModel) -> None:
    # Without exploration the result does not depend on the requested length of the run. KNNDyna plans at step 50.
    stopped = make_model(exploration_initial_eps=0.0).learn(600, callback=Witness(stop_at=50))
    assert stopped.policy.q_table.any()
    assert th.equal(stopped.policy.q_table, make_model(exploration_initial_eps=0.0).learn(50).policy.q_table)


def test_plain_function(make_model: MakeModel) -> None:
    seen: list[tuple[int, bool]] = []

    def callback(local: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append((local["self"].num_timesteps, "infos" in local))
        return len(seen) < 5

    model = make_model().learn(100, callback=callback)
    assert seen == [(step, True) for step in range(1, 6)]
    assert model.num_timesteps == 5


def test_callback_list_stops_if_one_returns_false(make_model: MakeModel) -> None:
    for callback in ([Witness(), Witness(stop_at=8)], CallbackList([Witness(), Witness(stop_at=8)])):
        assert make_model().learn(100, callback=callback).num_timesteps == 8


@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluation(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path, n_envs: int
) -> None:
    callback = EvalCallback(
        make_venv(n_envs),
        n_eval_episodes=6,
        eval_freq=50,
        log_path=str(tmp_path),
        best_model_save_path=str(tmp_path),
        verbose=0,
    )
    model = make_model(make_venv(n_envs)).learn(100 * n_envs, callback=callback)
    results = np.load(tmp_path / "evaluations.npz")
    assert results["timesteps"].tolist() == [50 * n_envs, 100 * n_envs]
    assert results["results"].shape == (2, 6)
    best = algorithm.load(tmp_path / "best_model")
    assert best.policy.q_table.shape[1] == model.policy.q_table.shape[1]
    assert best.num_timesteps in results["timesteps"]
    assert callback.best_mean_reward == pytest.approx(results["results"].mean(axis=1).max())


def test_evaluation_changes_nothing_that_is_learned(
    make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    watching = [
        EvalCallback(make_venv(), n_eval_episodes=2, eval_freq=40, verbose=0),
        CheckpointCallback(save_freq=30, save_path=str(tmp_path)),
    ]
    watched = make_model().learn(150, callback=watching)
    assert th.equal(watched.policy.q_table, make_model().learn(150).policy.q_table)


def test_evaluation_beside_normalised_training(make_model: MakeModel, make_venv: MakeVenv) -> None:
    train, evaluate = VecNormalize(make_venv(2)), VecNormalize(make_venv(1), training=False, norm_reward=False)
    callback = EvalCallback(evaluate, n_eval_episodes=2, eval_freq=50, verbose=0)
    make_model(train, bounds=([-2.0, -2.0], [2.0, 2.0])).learn(100, callback=callback)
    # SB3 copies the statistics of training to the evaluation environment.
    np.testing.assert_array_equal(evaluate.obs_rms.mean, train.obs_rms.mean)
    assert evaluate.obs_rms.mean.any()
    assert np.isfinite(callback.last_mean_reward)


def test_checkpoints(algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path) -> None:
    callback = CheckpointCallback(save_freq=20, save_path=str(tmp_path), name_prefix="drift")
    make_model(make_venv(2)).learn(100, callback=callback)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["drift_40_steps.zip", "drift_80_steps.zip"]
    assert algorithm.load(tmp_path / "drift_40_steps").num_timesteps == 40


def test_checkpoints_beside_those_of_normalisation(
    make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    callback = CheckpointCallback(save_freq=50, save_path=str(tmp_path), save_vecnormalize=True)
    make_model(VecNormalize(make_venv())).learn(50, callback=callback)
    assert (tmp_path / "rl_model_50_steps.zip").is_file()
    assert VecNormalize.load(str(tmp_path / "rl_model_vecnormalize_50_steps.pkl"), make_venv()).obs_rms.mean.any()


@pytest.mark.parametrize("n_envs", [1, 3])
def test_stop_on_max_episodes(make_model: MakeModel, make_venv: MakeVenv, n_envs: int) -> None:
    witness = Witness()
    callback = [witness, StopTrainingOnMaxEpisodes(max_episodes=2)]
    model = make_model(make_venv(n_envs)).learn(5_000, callback=callback)
    # Two episodes in each environment, of 9 and 14 steps, end at the same step.
    assert model.num_timesteps == n_envs * (9 + 14)
    assert witness.dones == 2 * n_envs


@pytest.mark.parametrize(("threshold", "steps"), [(-1e6, 50), (1e6, 200)])
def test_stop_on_reward_threshold(make_model: MakeModel, make_venv: MakeVenv, threshold: float, steps: int) -> None:
    stop = StopTrainingOnRewardThreshold(reward_threshold=threshold, verbose=0)
    callback = EvalCallback(make_venv(), callback_on_new_best=stop, n_eval_episodes=3, eval_freq=50, verbose=0)
    assert make_model().learn(200, callback=callback).num_timesteps == steps


def test_stop_on_no_improvement(make_model: MakeModel, make_venv: MakeVenv) -> None:
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=1, verbose=0)
    callback = EvalCallback(make_venv(), callback_after_eval=stop, n_eval_episodes=3, eval_freq=20, verbose=0)
    # A model that does not learn does not improve: the first evaluation is the best, and the fourth one stops training.
    model = make_model(learning_rate=0.0).learn(1_000, callback=callback)
    assert model.num_timesteps < 200


def test_every_n_timesteps(make_model: MakeModel, make_venv: MakeVenv) -> None:
    witness = Witness()
    make_model(make_venv(2)).learn(120, callback=EveryNTimesteps(n_steps=40, callback=witness))
    assert witness.timesteps == [40, 80, 120]


def test_log_every_n_timesteps(make_model: MakeModel, read_log: Callable[..., Any], tmp_path: pathlib.Path) -> None:
    model = make_model()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, callback=LogEveryNTimesteps(n_steps=25), log_interval=None)
    assert [row["time/total_timesteps"] for row in read_log(tmp_path)] == [25, 50, 75, 100]


@pytest.mark.parametrize("arguments", [{"progress_bar": True}, {"callback": ProgressBarCallback()}])
def test_progress_bar(make_model: MakeModel, arguments: dict[str, Any], capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tqdm")
    pytest.importorskip("rich")
    make_model().learn(60, **arguments)
    assert "60/60" in "".join(capfd.readouterr())


def test_error_in_a_callback_leaves_a_usable_model(
    algorithm: Algorithm, make_model: MakeModel, tmp_path: pathlib.Path
) -> None:
    def fail(local: dict[str, Any], _: dict[str, Any]) -> bool:
        if local["self"].num_timesteps == 50:
            raise KeyboardInterrupt
        return True

    model = make_model()
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=fail)
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model").num_timesteps == 50
    # The first fifty steps are kept, and the next fifty continue from them.
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 100
    assert th.equal(model.policy.q_table, make_model().learn(100).policy.q_table)
