"""The learner of KNNDyna: it explores, gives what happens to a planner, and lets it plan."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th

from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.common.state_checks import checked_integer, checked_tensor, entry
from sb3_knntd.common.transitions import check_transition
from sb3_knntd.kernels.state import UpdateConfig
from sb3_knntd.learners.base import Learner, Rates, Transitions
from sb3_knntd.planning.base import Planner
from sb3_knntd.policies import KNNPolicy

#: Number of steps between plans. An episode's end also is a time to plan.
PLAN_EVERY = 25
#: An agent explores or exploits until the episode ends, or for this many steps.
SEGMENT = 200
#: Before the first plan, a random action is held for up to this many steps.
LONGEST_RANDOM_HOLD = 5
#: Values that differ by less than this share are equal.
TIE = 1e-9


class DynaLearner(Learner):
    """
    Explores by optimistic values in half of the episodes, and acts by the policy in the others, since a model must be
    right where the policy goes. While all rewards have been the same and no episode has ended by itself, it only
    explores. Random actions are taken only before the first plan.

    :param policy: acts, and has the table that is planned on
    :param planner: learns the model and plans
    :param stream: random numbers, shape (n_envs, ..., at least 4 in all)
    :param n_envs: number of environments
    :param config: has no effect, part of the signature of learners
    """

    def __init__(
        self, policy: KNNPolicy, planner: Planner, stream: RandomStream, n_envs: int, config: UpdateConfig
    ) -> None:
        super().__init__(policy.perceiver, policy.table, policy.selector, n_envs, config, policy.experience)
        self.policy, self.planner, self._stream = policy, planner, stream
        obs_dim = policy.perceiver.bounds.obs_dim
        self._is_box = policy.columns.points.shape[1] > 0
        self._observations = np.zeros((n_envs, obs_dim))
        self._columns = np.zeros(n_envs, np.int64)
        self._vectors = np.zeros((n_envs, policy.columns.points.shape[1]))
        self._explores = np.zeros(n_envs, np.bool_)
        #: steps until the environment's agent may change between exploring and exploiting, or the random action
        self._rest = np.zeros(n_envs, np.int64)
        self._since_plan = 0
        self._planning_seconds = 0.0
        self._steps_since_summary = 0

    @property
    def actions(self) -> np.ndarray:
        return self._vectors if self._is_box else self._columns

    def scaled_actions(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: columns, shape (n,), or vectors, shape (n, action_dim), action units
        :return: as planners take them: from -1 to 1, shape (n, action_dim), or columns, shape (n, 1)
        """
        return self.policy.columns.scale(actions) if self._is_box else actions.reshape(-1, 1)

    # ---------------------------------------------------------------- learning

    def begin(self, observations: np.ndarray, exploration_rate: float) -> None:
        rows = observations.reshape(self.n_envs, -1).astype(np.float64)
        check_transition(rows, np.zeros(self.n_envs))
        self._observations[:] = rows
        self._rest[:] = 0
        for row in rows:
            self.planner.begin(row)
        self.in_episodes = True
        self.rules_version = self.selector.rules.version
        self._select()

    def step(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> None:
        self.observe(observations, rewards, ended, truncated, dict(truncated))

    def observe(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        last: Mapping[int, np.ndarray],
    ) -> None:
        """
        Learn from the transitions of the last actions, and select the next actions.

        :param observations: the current observations (after a reset where an episode ended), shape (n_envs, *obs_shape)
        :param rewards: shape (n_envs,)
        :param ended: whether the episode ended, shape (n_envs,), bool
        :param truncated: the environments whose episode was truncated
        :param last: the last observation before the reset, shape obs_shape, of each environment whose episode ended
        :raises ValueError: if an observation or reward is not finite; nothing has been learned
        """
        rows = observations.reshape(self.n_envs, -1).astype(np.float64)
        next_rows = rows.copy()
        for env, observation in last.items():
            next_rows[env] = np.asarray(observation).reshape(-1)
        check_transition(rows, rewards)
        check_transition(next_rows, rewards)
        actions = self.scaled_actions(self.actions)
        for env in range(self.n_envs):
            terminated = bool(ended[env]) and env not in truncated
            if terminated and env not in last:
                # Where it ended is not known: that it ended is.
                next_rows[env] = self._observations[env]
            self.planner.add(self._observations[env], actions[env], float(rewards[env]), next_rows[env], terminated)
        before, after, seen_rewards, any_end = map(th.as_tensor, (self._observations, next_rows, rewards, ended))
        self.experience.record(before, after, seen_rewards, any_end, self.perceiver.bounds)
        self._observations[:] = rows
        self._rest -= 1
        for env in np.flatnonzero(ended).tolist():
            self._rest[env] = 0
            self.planner.begin(rows[env])
        self._since_plan += self.n_envs
        self._steps_since_summary += self.n_envs
        if self._since_plan >= PLAN_EVERY or ended.any():
            self.plan(self._since_plan)
        self._select()

    def plan(self, n_steps: int) -> None:
        """
        Plan with what has been learned.

        :param n_steps: the number of steps of the environment that the simulated ones are counted by
        """
        started = time.perf_counter()
        seed = int(self._stream.next().reshape(-1)[0] * 2**53)
        self.planner.plan(n_steps, seed)
        self._since_plan = 0
        self._planning_seconds += time.perf_counter() - started

    def _select(self) -> None:
        """Select the next actions."""
        uniforms = self._stream.next().reshape(self.n_envs, -1)
        if not len(self.planner.optimistic):
            self._select_random(uniforms)
            return
        due = self._rest <= 0
        self._explores[due] = (uniforms[due, 0] < 0.5) | (not self.planner.rewards.differs)
        self._rest[due] = SEGMENT
        table, values = self.table.entries().numpy(), np.empty((self.n_envs, self.table.n_actions))
        for env, observation in enumerate(self._observations):
            source = self.planner.optimistic if self._explores[env] else table
            # If the points are fewer than k, places without a point follow them.
            indices, probabilities = (
                each[0, : len(source)].numpy() for each in self.perceiver.perceive_one(observation)
            )
            values[env] = probabilities @ source[indices]
        values[self.selector.rules.forbidden(th.from_numpy(self._observations)).numpy()] = -np.inf
        self._columns[:] = pick_best(values, uniforms[:, 1])
        if self._is_box:
            self._vectors[:] = self.policy.columns.points[self._columns]
            greedy = np.flatnonzero(~self._explores)
            if len(greedy):
                best = th.from_numpy(self._columns[greedy])
                self._vectors[greedy] = self.selector.peak(th.from_numpy(values[greedy]), best).numpy()  # type: ignore[attr-defined]

    def _select_random(self, uniforms: np.ndarray) -> None:
        forbidden = self.selector.rules.forbidden(th.from_numpy(self._observations)).numpy()
        due = (self._rest <= 0) | forbidden[np.arange(self.n_envs), self._columns]
        self._columns[due] = pick_best(np.where(forbidden, -np.inf, 0.0), uniforms[:, 2])[due]
        self._rest[due] = 1 + (uniforms[due, 3] * LONGEST_RANDOM_HOLD).astype(np.int64)
        self._vectors[:] = self.policy.columns.points[self._columns]

    def update(self, transitions: Transitions, learning_rate: float, trace_decay: float) -> None:
        transitions.columns(self.selector, self._observations.shape[1])
        n = len(transitions.rewards)
        rows, next_rows = (
            np.asarray(each, dtype=np.float64).reshape(n, -1)
            for each in (transitions.observations, transitions.next_observations)
        )
        actions = self.scaled_actions(
            np.asarray(transitions.actions).reshape(n, -1) if self._is_box else transitions.actions
        )
        self._record(transitions, n)
        is_first = True
        for i in range(n):
            if is_first:
                self.planner.begin(rows[i])
            self.planner.add(
                rows[i], actions[i], float(transitions.rewards[i]), next_rows[i], bool(transitions.terminated[i])
            )
            is_first = bool(transitions.ended[i])
            self._since_plan += 1
            if self._since_plan >= PLAN_EVERY:
                self.plan(self._since_plan)

    # -------------------------------------------------------- logging, saving

    @property
    def n_traced(self) -> int:
        return 0

    def summary(self) -> dict[str, float]:
        figures = self.planner.summary()
        figures["n_transitions"] = float(self.planner.n_transitions)
        if self._steps_since_summary:
            figures["planning_time"] = self._planning_seconds / self._steps_since_summary
        self._planning_seconds, self._steps_since_summary = 0.0, 0
        return figures

    def state_dict(self) -> dict[str, Any]:
        return {
            "planner": self.planner.state_dict(),
            "in_episodes": int(self.in_episodes),
            "observations": th.from_numpy(self._observations.copy()),
            "columns": th.from_numpy(self._columns.copy()),
            "vectors": th.from_numpy(self._vectors.copy()),
            "explores": th.from_numpy(self._explores.copy()),
            "rest": th.from_numpy(self._rest.copy()),
            "since_plan": self._since_plan,
        }

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        since_plan = checked_integer(state_dict, "since_plan", 0, 2**62)
        self.planner.load_state_dict(entry(state_dict, "planner"))
        self._since_plan = since_plan
        same = getattr(entry(state_dict, "observations"), "shape", (0,))[:1] == (self.n_envs,)
        self.in_episodes = bool(checked_integer(state_dict, "in_episodes", 0, 1)) and same
        if self.in_episodes:
            self._take_over(state_dict)

    def _forget(self) -> None:
        """Nothing: there are no traces."""

    def _take_over(self, state_dict: dict[str, Any]) -> None:
        n = (self.n_envs,)
        observations = checked_tensor(state_dict, "observations", self._observations.shape, th.float64)
        columns = checked_tensor(state_dict, "columns", n, th.int64, 0, self.table.n_actions - 1)
        vectors = checked_tensor(state_dict, "vectors", self._vectors.shape, th.float64)
        explores = checked_tensor(state_dict, "explores", n, th.bool)
        rest = checked_tensor(state_dict, "rest", n, th.int64)
        for array, tensor in zip(
            (self._observations, self._columns, self._vectors, self._explores, self._rest),
            (observations, columns, vectors, explores, rest),
            strict=True,
        ):
            array[:] = tensor.numpy()
        self.rules_version = self.selector.rules.version


def pick_best(values: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """
    :param values: shape (batch, n_actions)
    :param uniforms: random numbers in [0, 1), shape (batch,)
    :return: a best action of each row, at random among equal ones, shape (batch,), int64
    """
    highest = values.max(axis=1, keepdims=True)
    ties = values >= highest - TIE * np.maximum(np.abs(highest), 1.0)
    ranks = (uniforms * ties.sum(axis=1)).astype(np.int64)
    best: np.ndarray = (ties.cumsum(axis=1) > ranks[:, None]).argmax(axis=1)
    return best
