"""Calling of callbacks during training."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback


class BatchedCallback(BaseCallback):
    """
    A callback that KNNTD and ExA call once for many steps, which takes a hundredth of the time of calling it at every
    step. It is called when it is due and when an episode ends, with the ``n_calls``, ``num_timesteps`` and ``locals``
    of the last step. Other algorithms and callbacks call it at every step.
    """

    #: the value of ``n_calls`` at which it is due; set it when training begins and in each call
    due_at: int

    def recorder(self) -> Callable[[np.ndarray], object] | None:
        """
        :return: a function to call with the observations of every step, shape (n_envs, *obs_shape); ``None`` if the
            callback needs no observations
        """
        return None

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """
        :param locals_: local variables of the step
        """
        self.locals = locals_

    def on_step(self) -> bool:
        """
        :return: whether training continues
        """
        record = self.recorder()
        if record is not None:
            record(self.locals["new_obs"])
        return super().on_step()


class CallbackDispatcher:
    """
    Calls the callbacks of one training: SB3's at every step, batched ones when they are due.

    :param callback: SB3's callback, which may be a list of others
    """

    def __init__(self, callback: BaseCallback) -> None:
        #: all callbacks, including lists of callbacks
        self.callbacks = list(_flatten(callback))
        lists = [each for each in self.callbacks if type(each) is CallbackList]
        self._batched = [each for each in self.callbacks if isinstance(each, BatchedCallback)]
        self._recorders = [record for each in self._batched if (record := each.recorder()) is not None]
        #: the callbacks that are called at every step
        self.every_step = [each for each in self.callbacks if each not in [*self._batched, *lists]]
        self._any_every_step = bool(self.every_step)
        # Lists only count steps; a callback that is called at every step may read their counts.
        self._lists = lists if self._any_every_step else []
        self._counted_late = [*self._batched, *([] if self._any_every_step else lists)]
        self._n_pending = 0
        self._due_in = self._next_due()

    def record_step(self, observations: np.ndarray, any_ended: bool) -> bool:
        """
        Record a step. It is called at every step, and must be cheap.

        :param observations: the observations after the step, shape (n_envs, *obs_shape)
        :param any_ended: whether an episode ended
        :return: whether :meth:`dispatch` must be called for this step
        """
        for record in self._recorders:
            record(observations)
        self._n_pending += 1
        return self._any_every_step or any_ended or self._n_pending >= self._due_in

    def dispatch(self, locals_: dict[str, Any], num_timesteps: int, any_ended: bool) -> bool:
        """
        Call the callbacks that are due.

        :param locals_: local variables of the step, which callbacks read
        :param num_timesteps: number of environment steps
        :param any_ended: whether an episode ended
        :return: whether training continues
        """
        go_on = True
        for each in self._lists:
            each.n_calls += 1
            each.num_timesteps = num_timesteps
        for callback in self.every_step:
            callback.update_locals(locals_)
            go_on = callback.on_step() and go_on
        if any_ended or self._n_pending >= self._due_in:
            self.flush(num_timesteps)
            for batched in self._batched:
                if any_ended or batched.n_calls >= batched.due_at:
                    batched.update_locals(locals_)
                    go_on = batched._on_step() and go_on
            self._due_in = self._next_due()
        return go_on

    def flush(self, num_timesteps: int) -> None:
        """
        Add the recorded steps to the counts of the callbacks that were not called at them.

        :param num_timesteps: number of environment steps
        """
        for each in self._counted_late:
            each.n_calls += self._n_pending
            each.num_timesteps = num_timesteps
        self._n_pending = 0

    def _next_due(self) -> int:
        """The number of steps until the first batched callback is due."""
        return min([batched.due_at - batched.n_calls for batched in self._batched], default=sys.maxsize)


def _flatten(callback: BaseCallback) -> Iterator[BaseCallback]:
    """The callback and, if it is a list, all callbacks in it, without SB3's placeholder for no callback."""
    if not (isinstance(callback, ConvertCallback) and callback.callback is None):
        yield callback
    if type(callback) is CallbackList:
        for each in callback.callbacks:
            yield from _flatten(each)
