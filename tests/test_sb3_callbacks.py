"""SB3's conventions during training: what callbacks see, and what they may change."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback, EveryNTimesteps
from stable_baselines3.common.logger import HParam
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from toy_envs import DriftEnv, RecordingVecEnv

from sb3_knntd import KNNTD, ExA
from sb3_knntd.common.callback_dispatcher import BatchedCallback

Algorithm = type[KNNTD | ExA]
MakeModel = Callable[..., KNNTD | ExA]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=[KNNTD, ExA])
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


class TransitionRecorder(BaseCallback):
    """Records (s, a, r, s') as SB3 users do."""

    def __init__(self) -> None:
        super().__init__()
        self.transitions: list[tuple[Any, ...]] = []

    def _on_step(self) -> bool:
        local = self.locals
        self.transitions.append((self.model._last_obs, local["actions"], local["rewards"], local["new_obs"]))
        return True


class Act(BaseCallback):
    """Does something once, at a given step, in one of its methods."""

    def __init__(self, at: int, do: Callable[[Any], object], method: str = "_on_step") -> None:
        super().__init__()
        self.at, self.do, self.method = at, do, method

    def _act(self, method: str) -> None:
        if method == self.method and self.model.num_timesteps == self.at:
            self.do(self.model)

    def _on_step(self) -> bool:
        self._act("_on_step")
        return True

    def _on_rollout_start(self) -> None:
        self._act("_on_rollout_start")

    def _on_rollout_end(self) -> None:
        self._act("_on_rollout_end")


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_callback_sees_the_observation_that_was_acted_on(
    make_model: MakeModel, make_venv: MakeVenv, n_envs: int
) -> None:
    venv, recorder = RecordingVecEnv(make_venv(n_envs)), TransitionRecorder()
    make_model(venv).learn(60 * n_envs, callback=recorder)
    assert len(recorder.transitions) == len(venv.steps) == 60
    for (seen, actions, rewards, _), step in zip(recorder.transitions, venv.steps, strict=True):
        np.testing.assert_array_equal(seen, step.observations)
        np.testing.assert_array_equal(actions, step.actions)
        np.testing.assert_array_equal(rewards, step.rewards)
    # Each transition starts where the previous one ended.
    for (_, _, _, led_to), (begins, _, _, _) in zip(recorder.transitions, recorder.transitions[1:], strict=False):
        assert led_to is begins


@pytest.mark.parametrize("method", ["_on_rollout_start", "_on_step", "_on_rollout_end"])
def test_the_next_step_starts_where_a_callback_has_reset_to(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, method: str
) -> None:
    def reset(model: Any) -> None:
        model._last_obs = model.env.reset()

    # Traces kept across the reset would affect every value.
    settings: dict[str, Any] = {"gamma": 1.0, "trace_decay": 1.0, "exploration_final_eps": 0.1}
    venv, recorder = RecordingVecEnv(make_venv(lengths=[1000])), TransitionRecorder()
    model = make_model(venv, **settings).learn(20, callback=[Act(10, reset, method), recorder])
    start = venv.steps[10].observations
    assert not np.array_equal(start, venv.steps[9].arrived)
    np.testing.assert_array_equal(recorder.transitions[10][0], start)

    # The same as if training had stopped there and had started again with reset environments.
    twin = make_model(make_venv(lengths=[1000]), **settings).learn(10)
    twin.set_env(twin.get_env())
    twin.learn(10, reset_num_timesteps=False)
    assert th.equal(model.policy.q_table, twin.policy.q_table)


def test_environments_that_a_callback_has_set_are_reset(make_model: MakeModel, make_venv: MakeVenv) -> None:
    others = RecordingVecEnv(make_venv())
    recorder = TransitionRecorder()
    make_model().learn(20, callback=[Act(10, lambda model: model.set_env(others)), recorder])
    assert len(others.steps) == 10
    np.testing.assert_array_equal(recorder.transitions[10][0], others.steps[0].observations)


def test_a_model_saved_by_a_callback_continues_correctly(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    recorder = TransitionRecorder()
    make_model(make_venv()).learn(20, callback=[CheckpointCallback(10, str(tmp_path)), recorder])
    loaded = algorithm.load(tmp_path / "rl_model_10_steps", force_reset=False)
    assert loaded._last_obs is not None
    np.testing.assert_array_equal(loaded._last_obs, recorder.transitions[10][0])


def test_an_observation_set_by_a_callback_is_saved(
    algorithm: Algorithm, make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    def reset_and_save(model: Any) -> None:
        model._last_obs = model.env.reset()
        model.save(tmp_path / "model")

    venv = RecordingVecEnv(make_venv(lengths=[1000]))
    make_model(venv).learn(20, callback=Act(10, reset_and_save))
    loaded = algorithm.load(tmp_path / "model", env=make_venv(lengths=[1000]), force_reset=False)
    np.testing.assert_array_equal(loaded._last_obs, venv.steps[10].observations)  # type: ignore[arg-type]
    # It begins an episode there, and has no action left from where it was.
    assert not loaded.learner.in_episodes


@pytest.mark.parametrize("stop", [False, KeyboardInterrupt])
def test_training_continues_after_a_callback_stopped_it(
    make_model: MakeModel, make_venv: MakeVenv, stop: bool | type[BaseException]
) -> None:
    def end(local: dict[str, Any], _: dict[str, Any]) -> bool:
        if stop is not False and local["self"].num_timesteps == 10:
            raise stop
        return bool(local["self"].num_timesteps != 10)

    settings: dict[str, Any] = {"exploration_final_eps": 0.1}
    model = make_model(**settings)
    if stop is False:
        model.learn(20, callback=end)
    else:
        with pytest.raises(KeyboardInterrupt):
            model.learn(20, callback=end)
    recorder = TransitionRecorder()
    model.learn(10, callback=recorder, reset_num_timesteps=False)
    whole = TransitionRecorder()
    twin = make_model(**settings).learn(20, callback=whole)
    np.testing.assert_array_equal(recorder.transitions[0][0], whole.transitions[10][0])
    assert th.equal(model.policy.q_table, twin.policy.q_table)


# ------------------------------------------------------------------ counting


class Tick(BaseCallback):
    def _on_step(self) -> bool:
        return True


class CountOf(BaseCallback):
    """Records the counters of the lists when it is called."""

    def __init__(self) -> None:
        super().__init__()
        self.lists: list[CallbackList] = []
        self.noted: list[list[tuple[int, int]]] = []

    def _on_step(self) -> bool:
        self.noted.append([(each.n_calls, each.num_timesteps) for each in self.lists])
        return True


@pytest.mark.parametrize("n_envs", [1, 3])
def test_callback_lists_count_like_their_members(make_model: MakeModel, make_venv: MakeVenv, n_envs: int) -> None:
    inner_count, event_count = CountOf(), Tick()
    inner = CallbackList([inner_count])
    in_event = CallbackList([event_count])
    outer = CallbackList([inner, EveryNTimesteps(5 * n_envs, in_event), CallbackList([])])
    inner_count.lists = [outer, inner, outer.callbacks[2]]  # type: ignore[list-item]
    model = make_model(make_venv(n_envs)).learn(20 * n_envs, callback=outer)
    # When the members are called, their lists have already counted the step.
    assert inner_count.noted == [[(step, step * n_envs)] * 3 for step in range(1, 21)]
    assert (in_event.n_calls, in_event.num_timesteps) == (event_count.n_calls, event_count.num_timesteps)
    assert (in_event.n_calls, in_event.num_timesteps) == (4, 20 * n_envs)
    model.learn(10 * n_envs, callback=outer, reset_num_timesteps=False)
    assert (outer.n_calls, outer.num_timesteps) == (inner.n_calls, inner.num_timesteps) == (30, 30 * n_envs)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_lists_count_where_no_callback_is_called_at_every_step(
    make_model: MakeModel, make_venv: MakeVenv, n_envs: int
) -> None:
    class Batched(BatchedCallback):
        def _on_training_start(self) -> None:
            self.due_at = 1000

        def _on_step(self) -> bool:
            assert (outer.n_calls, outer.num_timesteps) == (self.n_calls, self.num_timesteps)
            return True

    outer = CallbackList([Batched()])
    empty = CallbackList([])
    make_model(make_venv(n_envs)).learn(20 * n_envs, callback=outer)
    make_model(make_venv(n_envs)).learn(20 * n_envs, callback=empty)
    for each in (outer, empty):
        assert (each.n_calls, each.num_timesteps) == (20, 20 * n_envs)


# ---------------------------------------------------------- episode statistics


class ReportingEnv(gym.Wrapper[Any, Any, Any, Any]):
    """Reports an episode and a success at every third step, independent of episode ends."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.steps = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        if self.steps % 3 == 0:
            info["episode"] = {"r": float(self.steps), "l": 3, "t": 0.0}
            info["is_success"] = True
        return observation, reward, terminated, truncated, info


def test_an_episode_reported_before_its_end_counts(env_cls: Any, make_model: MakeModel) -> None:
    model = make_model(ReportingEnv(env_cls(lengths=[1000]))).learn(30)
    assert model.ep_info_buffer is not None
    # SB3's outer Monitor reports only episode ends, and there is none.
    assert [info["r"] for info in model.ep_info_buffer] == [3.0 * lap for lap in range(1, 11)]
    # A success counts at the end of the episode, as in SB3.
    assert not model.ep_success_buffer


# ------------------------------------------------------------------ hyperparameters


class HParamCallback(BaseCallback):
    """The callback of SB3's documentation, copied verbatim."""

    def _on_training_start(self) -> None:
        hparam_dict = {
            "algorithm": self.model.__class__.__name__,
            "learning rate": self.model.learning_rate,
            "gamma": self.model.gamma,  # type: ignore[attr-defined]
        }
        metric_dict = {
            "rollout/ep_len_mean": 0,
            "train/value_loss": 0.0,
        }
        self.logger.record(
            "hparams",
            HParam(hparam_dict, metric_dict),  # type: ignore[arg-type]
            exclude=("stdout", "log", "json", "csv"),
        )

    def _on_step(self) -> bool:
        return True


def test_hyperparameters_are_logged_as_sb3_says(
    algorithm: Algorithm, make_venv: MakeVenv, tmp_path: pathlib.Path
) -> None:
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    plugin = pytest.importorskip("tensorboard.plugins.hparams.plugin_data_pb2")
    model = algorithm(make_venv(), points=(8, 6), seed=0, tensorboard_log=str(tmp_path))
    model.learn(200, callback=HParamCallback())
    (folder,) = tmp_path.iterdir()
    events = accumulators.EventAccumulator(str(folder)).Reload()
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    logged = plugin.HParamsPluginData.FromString(content).session_start_info.hparams
    assert logged["algorithm"].string_value == algorithm.__name__
    assert logged["learning rate"].string_value == ("lin_0.7_0.05" if algorithm is ExA else "lin_0.5_0.05")
    assert logged["gamma"].number_value == 0.99


@pytest.mark.parametrize("name", ["learning_rate", "trace_decay"])
def test_a_string_gives_the_schedule(
    algorithm: Algorithm, make_model: MakeModel, name: str, tmp_path: pathlib.Path
) -> None:
    word, schedule = make_model(**{name: "lin_0.8_0.1"}), make_model(**{name: LinearSchedule(0.8, 0.1, 1.0)})
    assert th.equal(word.learn(200).policy.q_table, schedule.learn(200).policy.q_table)
    assert not th.equal(word.policy.q_table, make_model(**{name: 0.8}).learn(200).policy.q_table)
    word.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=word.get_env())
    assert getattr(loaded, name) == "lin_0.8_0.1"
    assert loaded.lr_schedule(0.5) == pytest.approx(0.45 if name == "learning_rate" else 0.3)


@pytest.mark.parametrize("word", ["lin_", "lin_x", "lin_0.5_-0.1", "lin_0.5_0.1_0", "linear_0.5"])
@pytest.mark.parametrize("name", ["learning_rate", "trace_decay"])
def test_an_invalid_string_is_refused(make_model: MakeModel, name: str, word: str) -> None:
    with pytest.raises(ValueError, match=name):
        make_model(**{name: word})


def test_temperature_as_a_string() -> None:
    softmax: dict[str, Any] = {"exploration": "softmax", "points": (8, 6), "seed": 0}
    word = KNNTD(DriftEnv(), temperature="lin_2_0.1", **softmax).learn(200)
    schedule = KNNTD(DriftEnv(), temperature=LinearSchedule(2.0, 0.1, 1.0), **softmax).learn(200)
    assert th.equal(word.policy.q_table, schedule.policy.q_table)
    with pytest.raises(ValueError, match="temperature"):
        KNNTD(DriftEnv(), temperature="lin_1", **softmax)
