"""Who is told of the steps of learning."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback


class PatientCallback(BaseCallback):
    """
    A callback that KNNTD and ExA tell of many steps at once: to tell one of every step takes a hundredth of the time.
    It is told when it is due, and when an episode ends; then ``n_calls``, ``num_timesteps`` and ``locals`` are those of
    the last step, as they always are with other algorithms and beneath other callbacks.
    """

    #: the call at which it wants to be told next, to be set when training begins and whenever it is told
    due_at: int

    def recorder(self) -> Callable[[np.ndarray], object] | None:
        """
        :return: what takes the observations of every step, shape (n_envs, *obs_shape); ``None`` for nothing
        """
        return None

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """
        :param locals_: local variables of the step
        """
        self.locals = locals_

    def on_step(self) -> bool:
        """
        :return: whether to go on
        """
        record = self.recorder()
        if record is not None:
            record(self.locals["new_obs"])
        return super().on_step()


class Audience:
    """
    The callbacks of one training.

    :param callback: SB3's, which may be lists of others
    """

    def __init__(self, callback: BaseCallback) -> None:
        #: all of them, and the lists that they are in
        self.members = list(_members(callback))
        lists = [member for member in self.members if type(member) is CallbackList]
        self._patient = [member for member in self.members if isinstance(member, PatientCallback)]
        self._recorders = [record for member in self._patient if (record := member.recorder()) is not None]
        #: those who are told of every step
        self.listeners = [member for member in self.members if member not in [*self._patient, *lists]]
        self._any_listens = bool(self.listeners)
        # Lists only count, at every step if one of their members may look.
        self._counting_each_step = lists if self._any_listens else []
        self._catching_up = [*self._patient, *([] if self._any_listens else lists)]
        self._n_untold = 0
        self._patience = self._wait()

    def hears(self, observations: np.ndarray, any_ended: bool) -> bool:
        """
        Note a step.

        :param observations: what it led to, shape (n_envs, *obs_shape)
        :param any_ended: whether it ended an episode
        :return: whether somebody is to be told of it
        """
        for record in self._recorders:
            record(observations)
        self._n_untold += 1
        return self._any_listens or any_ended or self._n_untold >= self._patience

    def tell(self, locals_: dict[str, Any], num_timesteps: int) -> bool:
        """
        :param locals_: local variables of the step, ``any_ended`` among them
        :param num_timesteps: number of environment steps
        :return: whether to go on
        """
        go_on = True
        for each in self._counting_each_step:
            each.n_calls += 1
            each.num_timesteps = num_timesteps
        for listener in self.listeners:
            listener.update_locals(locals_)
            go_on = listener.on_step() and go_on
        if locals_["any_ended"] or self._n_untold >= self._patience:
            self.catch_up(num_timesteps)
            for patient in self._patient:
                if locals_["any_ended"] or patient.n_calls >= patient.due_at:
                    patient.update_locals(locals_)
                    go_on = patient._on_step() and go_on
            self._patience = self._wait()
        return go_on

    def catch_up(self, num_timesteps: int) -> None:
        """
        Let those count the steps who were not told of them.

        :param num_timesteps: number of environment steps
        """
        for each in self._catching_up:
            each.n_calls += self._n_untold
            each.num_timesteps = num_timesteps
        self._n_untold = 0

    def _wait(self) -> int:
        """After how many steps the first of them is due."""
        return min([patient.due_at - patient.n_calls for patient in self._patient], default=sys.maxsize)


def _members(callback: BaseCallback) -> Iterator[BaseCallback]:
    """The callback and, if it is a list, all that are in it, but for the one that stands for none."""
    if not (isinstance(callback, ConvertCallback) and callback.callback is None):
        yield callback
    if type(callback) is CallbackList:
        for each in callback.callbacks:
            yield from _members(each)
