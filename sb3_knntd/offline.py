"""What a model learns without steps of its own: from data, from a controller, and from a table with other points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_knntd.common.checks import check_integer, check_number
from sb3_knntd.datasets import read_transitions, record
from sb3_knntd.editing import actions_of
from sb3_knntd.kernels.traces import LARGEST_VALUE
from sb3_knntd.learners import Transitions
from sb3_knntd.perception.bounds import steps_to_measure
from sb3_knntd.policies import KNNPolicy
from sb3_knntd.saving import SavedAlgorithm

SelfOfflineLearning = TypeVar("SelfOfflineLearning", bound="OfflineLearning")

#: What :meth:`OfflineLearning.imitate` sets: with the defaults, a good start would be lost in the first episodes.
CAREFUL_LEARNING_RATE = "lin_0.1_0.01"
CAREFUL_EPSILON = 0.06


class OfflineLearning(SavedAlgorithm):
    """
    Methods of an algorithm that learns a table from transitions.

    The parameters are those of SB3's BaseAlgorithm.
    """

    _refinable: ClassVar[tuple[str, ...]] = ("points", "bounds")
    policy: KNNPolicy
    lr_schedule: Schedule
    trace_schedule: Schedule
    gamma: Any
    learning_rate: Any
    exploration_initial_eps: Any
    exploration_final_eps: Any
    points: Any
    bounds: Any
    _n_measured: int
    _is_set_up: bool

    if TYPE_CHECKING:

        def _setup_model(self) -> None: ...
        def _must_measure(self) -> bool: ...

    def learn_from(
        self: SelfOfflineLearning,
        dataset: Any,
        columns: Mapping[str, str | Sequence[str]] | None = None,
        passes: int = 10,
    ) -> SelfOfflineLearning:
        """
        Learn off-policy from logged data, by Watkins's Q(λ) with the learning rate and λ of the model; their schedules
        run from the first pass to the last. ``learn`` can go on from there.

        Values that have not been learned yet begin at the lowest return in the data, if that is lower: where there are
        no data, nothing speaks for an action, and it must not be the best one. The range of unbounded observation
        dimensions is measured on the data.

        :param dataset: a Minari dataset, or the name of a local one; an SB3 ReplayBuffer; a ``.npz`` or ``.csv`` file;
            or a mapping of names to arrays, such as a dict or a pandas DataFrame. Rows are in temporal order
        :param columns: for files and mappings: the columns that hold the ``observations``, ``actions``, ``rewards``,
            ``next_observations``, ``terminations`` and ``truncations``; by default those with these names. Observations
            and actions may be lists of columns. Without next observations, a row is followed by the next one, and the
            last row of an episode that was not terminated is left out
        :param passes: how often all data are learned from, >= 1
        :return: the model
        :raises ValueError: if the data do not fit; nothing has been learned
        :raises FloatingPointError: if values would diverge
        """
        passes = check_integer("passes", passes, 1)
        transitions = self._in_our_units(read_transitions(dataset, self.observation_space, self.action_space, columns))
        self._learn_offline(transitions, passes)
        return self

    def imitate(
        self: SelfOfflineLearning,
        controller: Any,
        n_steps: int = 5000,
        margin: float | None = None,
    ) -> SelfOfflineLearning:
        """
        Start from a controller. It is run in the environment, the model learns from these steps what its states are
        worth, and its actions become the greedy ones, see ``policy.imitate``.

        So that ``learn`` improves the controller instead of losing it, ``learning_rate`` is set to "lin_0.1_0.01", and
        ``exploration_initial_eps`` to at most 0.06. Both can be set to other values afterwards.

        :param controller: a function from an observation to an action, an SB3 model or policy, or another object whose
            ``predict`` returns (action, state). Its actions must depend on the observation alone
        :param n_steps: number of steps to run it, over all environments
        :param margin: see ``policy.imitate``
        :return: the model
        :raises ValueError: if an argument is invalid, or the controller returns no action of the action space
        """
        if margin is not None:
            check_number("margin", margin, 0.0, LARGEST_VALUE, above=True)
        transitions = self._run(controller, n_steps)
        self._learn_offline(transitions, 10)
        self.policy.imitate(controller, margin)
        self.learning_rate = CAREFUL_LEARNING_RATE
        self.exploration_initial_eps = min(self.exploration_initial_eps, CAREFUL_EPSILON)
        self.exploration_final_eps = min(self.exploration_final_eps, CAREFUL_EPSILON)
        return self

    def _run(self, controller: Any, n_steps: int) -> Transitions:
        """Run a controller in the environments, which then are no longer where they were."""
        act, n_steps = actions_of(controller), check_integer("n_steps", n_steps, 1)
        if self.env is None:
            raise ValueError("there is no environment to run the controller in: call set_env(env) first")
        self._last_obs = None
        self._abandon_episodes()
        transitions, mean_return = record(self.env, act, n_steps)
        if self.verbose >= 1:
            print(f"The controller's mean return over {n_steps} steps: {mean_return:.4g}")
        return transitions

    def refine(self: SelfOfflineLearning, points: Any = None, bounds: Any = None) -> SelfOfflineLearning:
        """
        Lay the points anew, more or fewer of them or over another range. Each gets the values that the table has at its
        place. Traces are dropped, and a range that was measured stays.

        :param points: as in the constructor; ``None`` leaves them
        :param bounds: as in the constructor; ``None`` leaves them
        :return: the model
        :raises ValueError: if an argument is invalid; the model is as it was
        """
        before = dict(vars(self))
        given = {"points": points, "bounds": bounds}
        changes = {
            name: value for name, value in given.items() if value is not None and not _same(value, getattr(self, name))
        }
        if not changes:
            return self
        streams = self._stream.state(), self._prediction_stream.state()
        self._is_set_up = False
        try:
            for name, value in changes.items():
                setattr(self, name, value)
            self._setup_model()
            self.policy.take_over(before["policy"], measured="bounds" not in changes)
            if not self._must_measure():
                # It is known, also where the new bounds leave it open.
                self._n_measured = steps_to_measure(self.n_envs)
        except BaseException:
            vars(self).clear()
            vars(self).update(before)
            raise
        self._stream.set_state(streams[0])
        self._prediction_stream.set_state(streams[1])
        return self

    def _learn_offline(self, transitions: Transitions, passes: int) -> None:
        policy = self.policy
        # The actions as the table counts them.
        first = int(self.action_space.start) if isinstance(self.action_space, spaces.Discrete) else None
        actions = transitions.actions.reshape(len(transitions.rewards), -1) if first is None else transitions.actions
        transitions = transitions._replace(actions=actions - (first or 0))
        transitions.columns(policy.selector, policy.perceiver.bounds.obs_dim)
        seen = np.concatenate((transitions.observations, transitions.next_observations))
        if self._n_measured < steps_to_measure(self.n_envs) and policy.perceiver.bounds.is_open:
            policy.perceiver.measure(th.from_numpy(seen).to(self.device))
            self._n_measured = steps_to_measure(self.n_envs)
            self._abandon_episodes()
        elif policy.grows:
            self.learner.grow_for(transitions)
        elif policy.perceiver.bounds.adaptive and not policy.perceiver.sees(seen):
            policy.widen(th.from_numpy(seen).to(self.device))
            self._abandon_episodes()
        lowest = min(policy.table.initial_value, _lowest_return(transitions, self.gamma))
        policy.doubt(seen, lowest)
        for number in range(passes):
            progress = 1.0 - number / max(passes - 1, 1)
            self.learner.update(transitions, self.lr_schedule(progress), self.trace_schedule(progress))

    def _in_our_units(self, transitions: Transitions) -> Transitions:
        """Normalise data as the environment of the model does."""
        normalizer = self.get_vec_normalize_env()
        if normalizer is None:
            return transitions
        return transitions._replace(
            observations=np.asarray(normalizer.normalize_obs(transitions.observations)),
            next_observations=np.asarray(normalizer.normalize_obs(transitions.next_observations)),
            rewards=normalizer.normalize_reward(transitions.rewards),
        )


def _same(value: Any, other: Any) -> bool:
    """Whether two arguments are equal, as numbers, words or arrays; a file holds lists for tuples."""
    try:
        return bool(np.array_equal(np.asarray(value), np.asarray(other)))
    except ValueError:  # rows of different lengths
        return False


def _lowest_return(transitions: Transitions, gamma: float) -> float:
    """The lowest discounted return of a state. What follows a step that is cut off is taken to be the average."""
    rewards, lowest, value = transitions.rewards, np.inf, 0.0
    beyond = float(np.mean(rewards)) / (1.0 - gamma) if gamma < 1.0 else 0.0
    for t in range(len(rewards) - 1, -1, -1):
        if transitions.ended[t]:
            value = 0.0 if transitions.terminated[t] else beyond
        value = float(rewards[t]) + gamma * value
        lowest = min(lowest, value)
    return lowest
