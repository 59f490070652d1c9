"""Planning for continuous observations: points that grow, local linear fits, value iteration and simulated episodes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.common.arrays import load_arrays, reserve, saved_arrays
from sb3_knntd.common.state_checks import checked_integer, checked_tensor, entry
from sb3_knntd.dyna_policies import SpacedPolicy
from sb3_knntd.kernels import planning as kernels
from sb3_knntd.kernels.local_model import OUTCOME, nearest_point
from sb3_knntd.kernels.planning import OutcomeArrays, PlanConfig, SimulationConfig
from sb3_knntd.learners.growth import grow, lay_anew
from sb3_knntd.model import LocalModel, Prediction, TransitionBuffer
from sb3_knntd.perception import GrowingPoints
from sb3_knntd.planning.base import TOLERANCE, Planner, PlanSettings
from sb3_knntd.q_table import DenseTable

#: Number of transitions before the points are laid.
FIRST_PLAN = 25
#: An action is held until the state has moved by this many spacings, at most this many steps. What lies farther than
#: this from all points, in spacings, is not known.
MOVE, MOST_HELD, FAR = 1.5, 20, 1.5
#: Where states change less in a step, scaled units, there is nothing to predict.
LEAST_CHANGE = 1e-9
#: Number of points whose outcomes are found anew in turn at each plan.
TURN = 100
#: Largest number of sweeps of a plan, and of weights read in them: the next plan goes on from there.
MOST_SWEEPS, MOST_READS = 100, 2_000_000
#: Longest simulated episode, share of those that begin like real ones, of those that follow value iteration, and of
#: random actions.
LONGEST, FROM_START, PLANNED, EPSILON = 100, 0.3, 0.25, 0.1


class ValueArrays(NamedTuple):
    """
    The values at the points.

    :param simulated: Q by simulated episodes, which the policy acts by, shape (n_rows, n_actions)
    :param iterated: Q by value iteration, same shape
    :param optimistic: the same with an optimistic value for what is not known
    :param best: of ``iterated``, shape (n_rows,)
    :param optimistic_best: of ``optimistic``, shape (n_rows,)
    :param is_new: whether the point has come since the last plan, shape (n_rows,), bool
    """

    simulated: np.ndarray
    iterated: np.ndarray
    optimistic: np.ndarray
    best: np.ndarray
    optimistic_best: np.ndarray
    is_new: np.ndarray


class LocalPlanner(Planner):
    """
    Plans over points that grow, in three steps: it fits the model where there is new data; iterates values over held
    actions, once with what is not known left out and once with an optimistic value for it; and learns the values of the
    table from simulated episodes.

    :param policy: has points that grow
    :param buffer: the transitions
    :param action_points: see :class:`~sb3_knntd.model.LocalModel`
    :param settings: parameters of planning
    :param reward_function: compiled, from ``model.rewards.compiled_reward``; ``None`` if it is learned
    """

    def __init__(
        self,
        policy: SpacedPolicy,
        buffer: TransitionBuffer,
        action_points: np.ndarray,
        settings: PlanSettings,
        reward_function: Any = None,
    ) -> None:
        super().__init__(settings)
        self._reward_function = reward_function
        points = policy.perceiver.points
        assert isinstance(points, GrowingPoints)
        self.policy, self.points = policy, points
        self.buffer = buffer
        self.model = LocalModel(buffer, action_points)
        self._k, n_actions = policy.n_neighbors, len(action_points)
        self._actions = policy.columns.points
        if not self._actions.shape[1]:
            self._actions = policy.fit_actions(np.arange(n_actions))[:, None].astype(np.float64)
        by_action = (0, n_actions)
        self.outcomes = OutcomeArrays(
            successors=np.zeros((*by_action, self._k), np.int32),
            weights=np.zeros((*by_action, self._k)),
            rewards=np.zeros(by_action),
            discounts=np.zeros(by_action),
            unknown=np.zeros(by_action),
            places=np.zeros((*by_action, buffer.obs_dim)),
            reaches=np.zeros(by_action),
        )
        self.values = ValueArrays(
            simulated=np.zeros(by_action),
            iterated=np.zeros(by_action),
            optimistic=np.zeros(by_action),
            best=np.zeros(0),
            optimistic_best=np.zeros(0),
            is_new=np.zeros(0, np.bool_),
        )
        self._turn = 0
        self._errors = np.zeros(2)

    @property
    def n_transitions(self) -> int:
        return self.buffer.n_transitions

    @property
    def visited(self) -> np.ndarray:
        return self.buffer.observations[: self.buffer.n_transitions]

    @property
    def known(self) -> np.ndarray:
        return self.model.known

    @property
    def error_share(self) -> float:
        known, n = self.known, self.buffer.n_transitions
        if not known.any():
            return 0.0
        data = self.model.data
        change = float(np.sqrt(((data.next_states[:n] - data.states[:n]) ** 2).mean()))
        error = float(self.model.arrays.errors[: self.model.n_points][known].mean())
        return error / change if change > LEAST_CHANGE else 0.0

    @property
    def optimistic(self) -> np.ndarray:  # type: ignore[override]
        return self.values.optimistic[: self.model.n_points]

    # ---------------------------------------------------------------- learning

    def begin(self, observation: np.ndarray) -> None:
        self.buffer.add_start(observation)
        if self.model.n_points:
            self._cover(observation[None])

    def add(
        self, observation: np.ndarray, action: np.ndarray, reward: float, next_observation: np.ndarray, terminated: bool
    ) -> None:
        if self.buffer.is_full:
            self.model.make_room()
        if self._reward_function is not None:
            reward = float(self._reward_function(observation, self._in_units(action), next_observation))
        self.rewards.add(reward, terminated)
        transition = self.buffer.add(observation, action, reward, next_observation, terminated)
        if not self.model.n_points:
            return
        self.model.scale(transition)
        self._compare(transition)
        self.model.enter(transition)
        self._visit(self.model.data.states[transition])
        self._cover(next_observation[None], may_add=not terminated)

    def _in_units(self, action: np.ndarray) -> np.ndarray:
        """An action as reward functions take it."""
        columns = self.policy.columns
        in_units: np.ndarray = columns.unscale(action) if columns.lists else self._actions[int(action[0])]
        return in_units

    def _visit(self, state: np.ndarray) -> None:
        """Count a step at the nearest point."""
        table = self.policy.table
        assert isinstance(table, DenseTable)
        point, _ = nearest_point(state, self.model.arrays.points, self.model.n_points)
        table.visit(th.tensor([point], device=table.values.device))

    def _compare(self, transition: int) -> None:
        """Record how far a new transition is from what the model expects."""
        expected = self.model.predicted_change(transition)
        if expected is not None:
            data = self.model.data
            error = data.next_states[transition] - data.states[transition] - expected
            self._errors += np.sqrt((error**2).mean()), 1.0

    def _cover(self, observations: np.ndarray, may_add: bool = True) -> None:
        """Let points grow over new observations; lay all anew if the range visited has grown."""
        if not self.policy.perceiver.sees(observations):
            self._lay_anew(observations)
        elif may_add:
            self._add_points(grow(self.policy.perceiver, self.policy.table, observations))

    def _lay_anew(self, observations: np.ndarray) -> None:
        """Scale all by the range visited, and lay the points over all that was visited and does not end."""
        policy, buffer, n = self.policy, self.buffer, self.buffer.n_transitions
        n_kept = self.model.n_points
        moved = lay_anew(policy.perceiver, policy.table, observations)
        if moved is not None and n_kept:
            for array in self.values:
                array[moved] = array[: len(moved)].copy()
            n_kept = int(moved.max()) + 1
        candidates = np.concatenate(
            (buffer.starts, buffer.observations[:n], buffer.next_observations[:n][~buffer.terminated[:n]])
        )
        grow(policy.perceiver, policy.table, candidates)
        policy.match_spacing()
        self.model.lay(self._scaled_points(), policy.perceiver.bounds, float(self.points.spacing))
        self._extend(n_kept)
        self.outcomes.reaches[: self.model.n_points] = -1.0
        # Until they are found anew, the successors must be points, also in a saved file.
        self.outcomes.successors[:] = 0

    def _add_points(self, added: np.ndarray) -> None:
        if not len(added):
            return
        first = self.model.n_points
        self.model.add_points(self._scaled_points()[first:])
        self._extend(first)
        for point in added.tolist():
            kernels.mark_near(point, first, self.model.arrays, self.outcomes, OUTCOME)

    def _scaled_points(self) -> np.ndarray:
        scaled: np.ndarray = self.points.coordinates(self.policy.perceiver.bounds).cpu().numpy()
        return scaled

    def _extend(self, first: int) -> None:
        """Give the points from ``first`` on the values of the nearest one before."""
        n = self.model.n_points
        if n > len(self.values.best):
            self.values = reserve(self.values, first, 2 * n)
            self.outcomes = reserve(self.outcomes, first, 2 * n)
        points = self.model.arrays.points
        for point in range(first, n):
            nearest = nearest_point(points[point], points, first)[0] if first else 0
            for array in self.values:
                array[point] = array[nearest] if first else 0
        self.values.is_new[first:n] = True
        self.outcomes.reaches[first:n] = -1.0
        self._publish()

    def _publish(self) -> None:
        """Write the values into the table."""
        table, n = self.policy.table, self.model.n_points
        assert isinstance(table, DenseTable)
        with table.lock:
            table.values[:n] = th.from_numpy(self.values.simulated[:n]).to(table.values)

    # ---------------------------------------------------------------- planning

    def plan(self, n_steps: int, seed: int) -> None:
        buffer = self.buffer
        if not self.model.n_points:
            if buffer.n_transitions < FIRST_PLAN:
                return
            n = buffer.n_transitions
            self._lay_anew(np.concatenate((buffer.observations[:n], buffer.next_observations[:n])))
        n, settings, values, outcomes = self.model.n_points, self.settings, self.values, self.outcomes
        self.model.fit()
        if not self.known.any():
            return
        config, arrays = self._plan_config(), self.model.arrays
        self._turn = kernels.refresh_outcomes(n, TURN, self._turn, arrays, outcomes, config, self._reward_function)
        somewhere = self.known.any(axis=1)
        tolerance = TOLERANCE * self.rewards.largest
        sweeps = int(np.clip(MOST_READS // outcomes.weights[:n].size, 1, MOST_SWEEPS))
        mean = float(values.best[:n][somewhere].mean())
        kernels.iterate_values(values.iterated, values.best, n, arrays.known, outcomes, mean, False, tolerance, sweeps)
        hopeful = self.rewards.optimistic_value(settings.horizon, settings.optimism)
        kernels.iterate_values(
            values.optimistic, values.optimistic_best, n, arrays.known, outcomes, hopeful, True, tolerance, sweeps
        )
        new = np.flatnonzero(values.is_new[:n])
        values.simulated[new] = values.iterated[new]
        values.is_new[:n] = False
        low, high = self.rewards.limits(settings.horizon)
        simulation = SimulationConfig(
            n_steps=n_steps * settings.simulated_steps,
            longest=LONGEST,
            from_start=FROM_START,
            planned=PLANNED,
            epsilon=EPSILON,
            learning_rate=settings.learning_rate,
            trace_decay=settings.trace_decay,
            lowest=low,
            highest=high,
        )
        starts = self.policy.perceiver.bounds.scale(th.from_numpy(buffer.starts)).numpy()
        kernels.simulate(
            values.simulated,
            values.iterated,
            values.best,
            n,
            buffer.n_transitions,
            starts,
            self.model.data,
            arrays,
            config,
            simulation,
            self._reward_function,
            np.array([seed], np.uint64),
            self._k,
        )
        kernels.fill_unknown(values.simulated, n, arrays, config.bandwidth, self._k)
        self._publish()

    def _plan_config(self) -> PlanConfig:
        h, data, n = self.model.spacing, self.model.data, self.buffer.n_transitions
        bounds = self.policy.perceiver.bounds
        states, next_states = data.states[:n], data.next_states[:n]
        return PlanConfig(
            gamma=self.settings.gamma,
            spacing=h,
            bandwidth=self.policy.bandwidth,
            move=MOVE * h,
            most_held=MOST_HELD,
            far=FAR * h,
            # Wide enough for a way out of what was visited to end where nothing is known.
            low=np.minimum(states.min(axis=0), next_states.min(axis=0)) - 2.0 * FAR * h,
            high=np.maximum(states.max(axis=0), next_states.max(axis=0)) + 2.0 * FAR * h,
            offset=bounds.low.numpy(),
            unit=0.5 * (bounds.high - bounds.low).numpy(),
            actions=self._actions,
        )

    def predict(self, observation: np.ndarray, action: np.ndarray) -> Prediction:
        if not self.model.n_points:
            raise ValueError("the model has learned nothing yet: call learn first")
        prediction = self.model.predict(observation, action)
        if self._reward_function is None:
            return prediction
        reward = float(self._reward_function(observation, self._in_units(action), prediction.observation))
        return prediction._replace(reward=reward)

    # ------------------------------------------------------- logging, saving

    def summary(self) -> dict[str, float]:
        figures = {"unknown_share": float(1.0 - self.known.mean())} if self.known.size else {}
        if self._errors[1]:
            figures["model_error"] = float(self._errors[0] / self._errors[1])
        self._errors[:] = 0.0
        return figures

    def state_dict(self) -> dict[str, Any]:
        n = self.model.n_points
        return {
            "buffer": self.buffer.state_dict(),
            "n_points": n,
            "model": self.model.state_dict(),
            "outcomes": saved_arrays(self.outcomes, n),
            "values": saved_arrays(self.values, n),
            "turn": self._turn,
            "rewards": th.from_numpy(self.rewards.numbers.copy()),
            "errors": th.from_numpy(self._errors.copy()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        n = checked_integer(state, "n_points", 0, self.points.n_points)
        rewards = checked_tensor(state, "rewards", (4,), th.float64, finite=False)
        errors = checked_tensor(state, "errors", (2,), th.float64, 0.0)
        turn = checked_integer(state, "turn", 0, max(n, 1))
        self.buffer.load_state_dict(entry(state, "buffer"))
        if n not in (0, self.points.n_points):
            raise ValueError(f"n_points must be 0 or {self.points.n_points}, as many as the policy has; got {n}")
        self.model.set_scale(self.policy.perceiver.bounds, float(self.points.spacing))
        self.model.load_state_dict(entry(state, "model"), n)
        self.outcomes = load_arrays(self.outcomes, entry(state, "outcomes"), n, {"successors": (0, max(n - 1, 0))})
        self.values = load_arrays(self.values, entry(state, "values"), n, {})
        self.rewards.numbers[:], self._errors[:] = rewards.numpy(), errors.numpy()
        self._turn = turn
