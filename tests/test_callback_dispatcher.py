"""SB3's callbacks are called at every step, batched ones when they are due."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd import KNNTD
from sb3_knntd.common.callback_dispatcher import BatchedCallback, CallbackDispatcher


class Waiting(BatchedCallback):
    """Records when it is called, and with which observations."""

    def __init__(self, every: int) -> None:
        super().__init__()
        self.every = every
        self.told: list[tuple[int, int, bool]] = []
        self.seen: list[np.ndarray] = []

    def recorder(self) -> Callable[[np.ndarray], object]:
        return self.seen.append

    def _on_training_start(self) -> None:
        self.due_at = self.n_calls + self.every

    def _on_step(self) -> bool:
        assert self.num_timesteps == self.model.num_timesteps == self.locals["self"].num_timesteps
        assert self.locals["new_obs"] is self.seen[-1]
        self.told.append((self.n_calls, self.num_timesteps, bool(self.locals["dones"].any())))
        self.due_at = self.n_calls + self.every
        return True


class Listening(BaseCallback):
    """Records every call, and may stop training."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.stop_at = stop_at
        self.calls: list[str] = []
        self.ends: list[int] = []

    def _on_rollout_start(self) -> None:
        self.calls.append("start")

    def _on_step(self) -> bool:
        self.calls.append("step")
        if self.locals["dones"].any():
            self.ends.append(self.n_calls)
        return self.n_calls != self.stop_at

    def _on_rollout_end(self) -> None:
        self.calls.append("end")


def expected(ends: list[int], every: int, n_calls: int) -> list[int]:
    """The steps at which a callback is called that waits for ``every`` steps."""
    told = []
    due = every
    for call in range(1, n_calls + 1):
        if call in ends or call >= due:
            told.append(call)
            due = call + every
    return told


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("beside", [False, True])
def test_a_batched_callback_is_called_when_due_and_when_episodes_end(
    make_model: Callable[..., KNNTD], make_venv: Callable[..., VecEnv], n_envs: int, beside: bool
) -> None:
    finding = Listening()
    make_model(make_venv(n_envs)).learn(300 * n_envs, callback=finding)
    assert finding.ends

    one, other = Waiting(7), Waiting(1000)
    listener = Listening()
    callbacks: list[BaseCallback] = [one, CallbackList([other, *([listener] if beside else [])])]
    make_model(make_venv(n_envs)).learn(300 * n_envs, callback=callbacks)
    assert [call for call, _, _ in one.told] == expected(finding.ends, 7, 300)
    assert [call for call, _, _ in other.told] == finding.ends
    assert [(call * n_envs, call in finding.ends) for call, _, _ in one.told] == [told[1:] for told in one.told]
    assert len(one.seen) == len(other.seen) == 300
    assert all(np.array_equal(a, b) for a, b in zip(one.seen, other.seen, strict=True))
    # It counts all steps in either case.
    assert one.n_calls == other.n_calls == 300
    assert one.num_timesteps == other.num_timesteps == 300 * n_envs
    assert listener.calls == ["start", "step", "end"] * (300 if beside else 0)


def test_training_goes_on_where_it_was(make_model: Callable[..., KNNTD]) -> None:
    callback = Waiting(1000)
    model = make_model().learn(30, callback=callback)
    model.learn(20, callback=callback, reset_num_timesteps=False)
    assert (callback.n_calls, callback.num_timesteps, len(callback.seen)) == (50, 50, 50)


def test_training_ends_when_one_says_so(make_model: Callable[..., KNNTD]) -> None:
    class Enough(Waiting):
        def _on_step(self) -> bool:
            self.due_at = 20
            return self.n_calls < 20

    for callbacks in ([Enough(20), Listening()], [Enough(20)], [Listening(stop_at=20), Waiting(1000)]):
        model = make_model().learn(100, callback=callbacks)
        assert model.num_timesteps == 20
        assert all(callback.n_calls == 20 for callback in callbacks)


def test_below_another_callback_it_is_called_whenever_that_one_calls(make_model: Callable[..., KNNTD]) -> None:
    callback = Waiting(1000)
    make_model().learn(100, callback=EveryNTimesteps(25, callback))
    assert [told[:2] for told in callback.told] == [(1, 25), (2, 50), (3, 75), (4, 100)]
    assert len(callback.seen) == 4


@pytest.mark.parametrize("callback", [None, [], CallbackList([]), [CallbackList([])]])
def test_nobody_listens(make_model: Callable[..., KNNTD], callback: Any) -> None:
    assert make_model().learn(50, callback=callback).num_timesteps == 50


def test_the_locals_of_a_step_may_have_any_names() -> None:
    class Recording(BatchedCallback):
        due_at = 100

        def _on_step(self) -> bool:
            calls.append((self.n_calls, self.num_timesteps, self.locals["infos"]))
            return True

    calls: list[tuple[int, int, str]] = []
    dispatcher = CallbackDispatcher(Recording())
    observations = np.zeros((2, 3))
    assert not dispatcher.record_step(observations, any_ended=False)
    assert dispatcher.record_step(observations, any_ended=True)
    assert dispatcher.dispatch({"infos": "of an end"}, 4, any_ended=True)
    assert not dispatcher.record_step(observations, any_ended=False)
    dispatcher.flush(6)
    assert calls == [(2, 4, "of an end")]
    assert (dispatcher.callbacks[0].n_calls, dispatcher.callbacks[0].num_timesteps) == (3, 6)
