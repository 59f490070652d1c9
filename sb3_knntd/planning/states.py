"""Planning for a finite number of states: counts of transitions, and exact value iteration."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.common.state_checks import checked_tensor
from sb3_knntd.kernels import planning as kernels
from sb3_knntd.kernels.planning import OutcomeArrays
from sb3_knntd.model import Prediction
from sb3_knntd.planning.base import TOLERANCE, Planner, PlanSettings
from sb3_knntd.policies import KNNPolicy
from sb3_knntd.q_table import DenseTable

#: Largest number of sweeps of a plan: the next one goes on from there.
MOST_SWEEPS = 100


class StatePlanner(Planner):
    """
    Plans over the states of a Discrete, MultiDiscrete or MultiBinary space. The model is exact: it counts what followed
    on each state and action. While exploring, a state and action count as tried once more, with an unknown outcome.

    :param policy: has a dense table with a row for each state
    :param settings: parameters of planning
    """

    def __init__(self, policy: KNNPolicy, settings: PlanSettings) -> None:
        super().__init__(settings)
        self.policy = policy
        n_states, n_actions = policy.perceiver.points.n_points, policy.table.n_actions
        by_action = (n_states, n_actions)
        self._shape = by_action
        #: how often each successor came, the successors, and how many they are
        self._counts = np.zeros((*by_action, 1))
        self._successors = np.zeros((*by_action, 1), np.int32)
        self._tried = np.zeros(by_action)
        self._reward_sums = np.zeros(by_action)
        self._ended = np.zeros(by_action)
        self._values = np.zeros(by_action)
        self._best = np.zeros(n_states)
        self.optimistic = np.zeros((0, n_actions))
        self._optimistic_best = np.zeros(n_states)

    @property
    def n_transitions(self) -> int:
        return int(self._tried.sum())

    @property
    def visited(self) -> np.ndarray:
        states = np.flatnonzero(self.known.any(axis=1))
        visited: np.ndarray = self.policy.points.cpu().numpy()[states]
        return visited

    @property
    def known(self) -> np.ndarray:
        known: np.ndarray = self._tried > 0
        return known

    def begin(self, observation: np.ndarray) -> None:
        """Nothing: all states are points."""

    def _state(self, observation: np.ndarray) -> int:
        return int(self.policy.perceiver.perceive_one(observation).indices[0, 0])

    def add(
        self, observation: np.ndarray, action: np.ndarray, reward: float, next_observation: np.ndarray, terminated: bool
    ) -> None:
        self.rewards.add(reward, terminated)
        table = self.policy.table
        assert isinstance(table, DenseTable)
        at = self._state(observation), self._column(action)
        table.visit(th.tensor([at[0]], device=table.values.device))
        self._tried[at] += 1.0
        self._reward_sums[at] += reward
        if terminated:
            self._ended[at] += 1.0
            return
        successor, counts, successors = self._state(next_observation), self._counts[at], self._successors[at]
        places = np.flatnonzero((successors == successor) | (counts == 0.0))
        if not len(places):
            self._counts = np.concatenate((self._counts, np.zeros_like(self._counts)), axis=2)
            self._successors = np.concatenate((self._successors, np.zeros_like(self._successors)), axis=2)
            places = np.array([len(successors)])
        self._successors[(*at, places[0])] = successor
        self._counts[(*at, places[0])] += 1.0

    def _column(self, action: np.ndarray) -> int:
        columns = self.policy.columns
        return int(columns.nearest(columns.unscale(action[None]))[0, 0]) if columns.lists else int(action[0])

    def plan(self, n_steps: int, seed: int) -> None:
        if not self.n_transitions:
            return
        settings, tried = self.settings, np.maximum(self._tried, 1.0)
        going_on = np.maximum(self._tried - self._ended, 1.0)
        n_states = self._shape[0]
        outcomes = OutcomeArrays(
            successors=self._successors,
            weights=self._counts / going_on[..., None],
            rewards=self._reward_sums / tried,
            discounts=settings.gamma * (1.0 - self._ended / tried),
            unknown=np.zeros(self._shape),
            places=np.empty((*self._shape, 0)),
            reaches=np.zeros(self._shape),
        )
        tolerance = TOLERANCE * self.rewards.largest
        known = self.known
        kernels.iterate_values(self._values, self._best, n_states, known, outcomes, 0.0, False, tolerance, MOST_SWEEPS)
        hopeful = self.rewards.optimistic_value(settings.horizon, settings.optimism)
        share = 1.0 / (1.0 + self._tried)
        hopeful_outcomes = outcomes._replace(
            rewards=(1.0 - share) * outcomes.rewards + share * hopeful, discounts=(1.0 - share) * outcomes.discounts
        )
        if not len(self.optimistic):
            self.optimistic = np.zeros(self._shape)
        kernels.iterate_values(
            self.optimistic,
            self._optimistic_best,
            n_states,
            known,
            hopeful_outcomes,
            hopeful,
            True,
            tolerance,
            MOST_SWEEPS,
        )
        lowest = np.where(known, self._values, np.inf).min(axis=1, keepdims=True)
        published = np.where(known, self._values, np.where(np.isfinite(lowest), lowest, 0.0))
        table = self.policy.table
        assert isinstance(table, DenseTable)
        with table.lock:
            table.values[:] = th.from_numpy(published).to(table.values)

    def predict(self, observation: np.ndarray, action: np.ndarray) -> Prediction:
        at = self._state(observation), self._column(action)
        tried = float(self._tried[at])
        if not tried:
            nothing = np.full(observation.shape, np.nan)
            return Prediction(nothing, np.nan, np.nan, False, np.inf, nothing)
        counts = self._counts[at]
        seen = counts > 0.0
        if not seen.any():
            places, spread = observation, np.zeros(observation.shape)
        else:
            candidates = self.policy.points.cpu().numpy()[self._successors[at][seen]]
            shares = counts[seen] / counts.sum()
            places = shares @ candidates
            spread = np.sqrt(shares @ (candidates - places) ** 2)
        return Prediction(
            observation=places,
            reward=float(self._reward_sums[at] / tried),
            end=float(self._ended[at] / tried),
            known=True,
            distance=0.0,
            error=spread,
        )

    def summary(self) -> dict[str, float]:
        return {"unknown_share": float(1.0 - self.known.mean())}

    _SAVED = ("_counts", "_successors", "_tried", "_reward_sums", "_ended", "_values", "_best", "_optimistic_best")

    def state_dict(self) -> dict[str, Any]:
        arrays = {name.strip("_"): th.from_numpy(getattr(self, name).copy()) for name in self._SAVED}
        return arrays | {
            "optimistic": th.from_numpy(self.optimistic.copy()),
            "rewards": th.from_numpy(self.rewards.numbers.copy()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        n_states, n_actions = self._shape
        successors = checked_tensor(state, "successors", (n_states, n_actions, None), th.int32, 0, n_states - 1)
        shapes: dict[str, tuple[int | None, ...]] = {
            "_counts": tuple(successors.shape),
            "_successors": tuple(successors.shape),
            "_best": (n_states,),
            "_optimistic_best": (n_states,),
        }
        loaded = {}
        for name in self._SAVED:
            kind = th.int32 if name == "_successors" else th.float64
            tensor = checked_tensor(state, name.strip("_"), shapes.get(name, self._shape), kind)
            loaded[name] = tensor.numpy().copy()
        optimistic = checked_tensor(state, "optimistic", (None, n_actions), th.float64)
        if len(optimistic) not in (0, n_states):
            raise ValueError(f"optimistic must have 0 or {n_states} rows; got {len(optimistic)}")
        rewards = checked_tensor(state, "rewards", (4,), th.float64, finite=False)
        for name, array in loaded.items():
            setattr(self, name, array)
        self.optimistic = optimistic.numpy().copy()
        self.rewards.numbers[:] = rewards.numpy()
