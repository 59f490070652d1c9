"""The learning step as one call of compiled code that works on the memory of the torch tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th

from sb3_knntd.actions.selection import ActionSelector
from sb3_knntd.common.checks import check_finite
from sb3_knntd.common.interrupts import interrupts_held
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.common.transitions import check_transition
from sb3_knntd.kernels import td
from sb3_knntd.kernels.selection import GREEDY, UNDRAWN, Combination
from sb3_knntd.kernels.state import EpisodeArrays, RandomRows, UpdateConfig, WorkArrays, make_state
from sb3_knntd.kernels.traces import adopt, write_back
from sb3_knntd.learners.base import DIVERGENCE, Learner, Rates, Transitions, check_rates, update_rates
from sb3_knntd.learners.growth import FLOAT32, as_rows
from sb3_knntd.perception import Experience, Perceiver
from sb3_knntd.q_table import ActiveTraces, QTable


class Workplace:
    """
    Builds and owns a kernel state, and rebuilds it when the perception or the table changes.

    :param perceiver: with weights that the kernels implement
    :param table: the Q-table, on the CPU
    :param selector: selects actions
    :param n_envs: number of environments
    :param config: variant of the update
    :param traces: the eligibility traces; ``None`` for those of the table
    :param stream: rows of random numbers, shape (n_envs, 2, n_uniforms); ``None`` if none are needed
    :param experience: where each step is recorded; ``None`` if none are made
    :param greedy: whether to select greedily, the first of equal actions
    """

    def __init__(
        self,
        perceiver: Perceiver,
        table: QTable,
        selector: ActionSelector,
        n_envs: int,
        config: UpdateConfig,
        traces: ActiveTraces | None = None,
        stream: RandomStream | None = None,
        experience: Experience | None = None,
        greedy: bool = False,
    ) -> None:
        self.perceiver = perceiver
        self.table = table
        self.selector = selector
        self.greedy = greedy
        self.selection = selection = selector.kernel_arguments(greedy)
        self.config = config
        self.traces = traces
        self.stream = stream
        self.experience = experience or Experience(perceiver.bounds.obs_dim)
        k, n_factors, n_actions = perceiver.search.n_neighbors, len(selection.factors) - 1, table.n_actions
        self.episodes = EpisodeArrays(
            indices=np.zeros((3, n_envs, k), np.int64),
            probabilities=np.zeros((3, n_envs, k)),
            action_indices=np.zeros((3, n_envs, k, n_factors), np.int64),
            actions=np.zeros((3, n_envs, selection.action_points.shape[1])),
            truncated=np.zeros(n_envs, np.bool_),
            last_observations=np.zeros((n_envs, perceiver.bounds.obs_dim)),
            current_observations=np.full((n_envs, perceiver.bounds.obs_dim), np.inf),
            persistent=np.full((n_envs, n_factors), UNDRAWN),
            lengths=np.zeros(1 + n_envs),
            forbidden=np.zeros((3, n_envs, n_actions), np.bool_),
        )
        self.work = WorkArrays(
            means=np.zeros(n_actions),
            row=np.zeros(n_actions),
            target_values=np.zeros(n_envs),
            corrections=np.zeros(n_envs),
            places=np.zeros((n_envs, k), np.int64),
            sums=np.zeros(3),
            value_bound=np.full(1, np.inf),
            trace_bound=np.zeros(1),
        )
        self.bind()

    def bind(self) -> None:
        """Build the kernel state from the current perception and table."""
        self.versions = self.perceiver.version, self.table.version
        perception = self.perceiver.arguments
        assert perception is not None
        self.selection = self.selector.kernel_arguments(self.greedy)
        traces = self.traces or self.table.traces
        no_rows = RandomRows(np.empty((0, 0, 0, 0)), np.zeros(1, np.int64))
        random = no_rows if self.stream is None else RandomRows(self.stream.rows, self.stream.taken)
        # No bound of the new values is known.
        self.work.value_bound[0] = np.inf
        groups = (
            perception,
            self.selection,
            self.config,
            self.table.arrays(),
            traces.arrays,
            self.episodes,
            random,
            self.work,
            self.experience.arrays(),
        )
        # numba does not support an interruption while it boxes or unboxes a state.
        with interrupts_held():
            # The state does not own its arrays: keep them alive here.
            self.state, self._lent = make_state(*groups), groups

    def follow(self) -> bool:
        """
        Rebuild the kernel state if the perception or the table has changed.

        :return: whether it was rebuilt
        """
        if self.versions == (self.perceiver.version, self.table.version):
            return False
        self.bind()
        return True

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_lent", "state")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.bind()


class CompiledLearner(Learner):
    """
    The same results as :class:`~sb3_knntd.learners.reference.TorchLearner`, on the CPU, in microseconds.

    :param perceiver: with weights that the kernels implement
    :param table: the Q-table
    :param selector: selects actions
    :param stream: rows of random numbers, shape (n_envs, 2, selector.n_uniforms)
    :param n_envs: number of environments
    :param config: variant of the update
    :param experience: where each step is recorded
    """

    def __init__(
        self,
        perceiver: Perceiver,
        table: QTable,
        selector: ActionSelector,
        stream: RandomStream,
        n_envs: int,
        config: UpdateConfig,
        experience: Experience,
    ) -> None:
        super().__init__(perceiver, table, selector, n_envs, config, experience)
        self.stream = stream
        table.start_traces(n_envs)
        self._workplace = Workplace(perceiver, table, selector, n_envs, config, stream=stream, experience=experience)
        self._prepare()

    def _prepare(self) -> None:
        self._learn = td.learn_with(self._workplace.state)
        self._versions = self._workplace.versions
        episodes = self._workplace.episodes
        # All neighbours select the same column for one action from mean values: that of the first.
        of_values = self._workplace.selection.combination == Combination.OF_VALUES
        self._actions: np.ndarray = (
            episodes.action_indices[td.CURRENT, :, 0, 0] if of_values else episodes.actions[td.CURRENT]
        )

    def _bind(self) -> None:
        self._workplace.bind()
        self._prepare()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_learn", "_actions")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    @property
    def actions(self) -> np.ndarray:
        return self._actions

    def configure(self, selector: ActionSelector, config: UpdateConfig) -> None:
        super().configure(selector, config)
        with self.table.lock:
            self._workplace.selector = selector
            self._workplace.config = config
            self._bind()

    def begin(self, observations: np.ndarray, exploration_rate: float) -> None:
        check_finite("an observation", observations, range(self.n_envs))
        seen = as_rows(observations)
        with self.table.lock:
            self.table.drop_traces()
            self._grow(observations, {})
            self._bind()
            if self.perceiver.search_is_outside:
                self._find(seen, td.CURRENT)
            td.begin(self._workplace.state, seen, self.stream.next()[:, 0], exploration_rate)
        self._workplace.work.trace_bound[0] = 0.0
        self.in_episodes = True
        self.rules_version = self.selector.rules.version

    def step(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> None:
        seen = observations if observations.dtype is FLOAT32 and observations.ndim == 2 else as_rows(observations)
        with self.table.lock:
            if self._versions != (self.perceiver.version, self.table.version):
                self._bind()
            if self.perceiver.search_is_outside:
                check_transition(observations, rewards)
                self._find(seen, td.NEXT)
            if not truncated:
                self._step(seen, observations, rewards, ended, truncated, rates)
                return
            try:
                self._take_in(truncated)
                self._step(seen, observations, rewards, ended, truncated, rates)
            finally:
                self._workplace.episodes.truncated[:] = False

    def _step(
        self,
        seen: np.ndarray,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> None:
        # Pass the rates separately: numba takes a quarter of a microsecond longer to unbox a tuple.
        learning_rate, trace_decay, exploration = rates
        outcome = self._learn(seen, rewards, ended, learning_rate, trace_decay, exploration)
        while outcome != td.OK:
            if outcome == td.NEED_RANDOM:
                self.stream.refill()
            elif outcome == td.NEED_CAPACITY:
                self.table.reserve(self._workplace.work.places.size)
                self._bind()
            elif outcome == td.NEED_POINTS:
                self._grow(observations, truncated)
                if self._versions != (self.perceiver.version, self.table.version):
                    self._bind()
            else:
                check_rates(rates, self.selector)
                check_transition(observations, rewards)
                raise FloatingPointError(DIVERGENCE)
            outcome = self._learn(seen, rewards, ended, learning_rate, trace_decay, exploration)

    def update(self, transitions: Transitions, learning_rate: float, trace_decay: float) -> None:
        rates = update_rates(learning_rate, trace_decay)
        columns = transitions.columns(self.selector, self.perceiver.bounds.obs_dim)
        self.grow_for(transitions)
        n, k = len(columns), self.shape[1]
        before, after = (
            as_rows(np.asarray(array)).reshape(n, -1).astype(np.float64)
            for array in (transitions.observations, transitions.next_observations)
        )
        found, distances = np.empty((2, 0, k), np.int64), np.empty((2, 0, k))
        if self.perceiver.search_is_outside:
            neighbors = [self.perceiver.find(th.from_numpy(rows)) for rows in (before, after)]
            found = np.stack([each.indices.numpy() for each in neighbors])
            distances = np.stack([each.squared_distances.numpy() for each in neighbors])
        rewards = np.asarray(transitions.rewards, dtype=np.float64)
        terminated, ended = (np.asarray(array, bool) for array in (transitions.terminated, transitions.ended))
        with self.table.lock:
            own = ActiveTraces(self.table.n_actions, 1)
            write_back(self.table.arrays(), self.table.traces.arrays)
            place = Workplace(self.perceiver, self.table, self.selector, 1, self.config, traces=own)
            done, outcome = 0, td.OK
            try:
                while done < n:
                    done, outcome = td.update(
                        place.state,
                        before,
                        columns,
                        rewards,
                        after,
                        terminated,
                        ended,
                        found,
                        distances,
                        done,
                        rates[0],
                        rates[1],
                    )
                    if outcome == td.NEED_CAPACITY:
                        self.table.make_room(own, k)
                        place.bind()
                    elif outcome != td.OK:
                        raise FloatingPointError(f"transition {done}: {DIVERGENCE}")
            finally:
                self._record(transitions, done)
                write_back(self.table.arrays(), own.arrays)
                adopt(self.table.arrays(), self.table.traces.arrays)
                self._workplace.work.value_bound[0] = np.inf

    def _find(self, seen: np.ndarray, which: int, envs: Any = slice(None)) -> None:
        """Find the neighbours with a search that the kernels do not implement."""
        neighbors = self.perceiver.find(th.from_numpy(seen))
        episodes = self._workplace.episodes
        episodes.indices[which, envs] = neighbors.indices.numpy()
        episodes.probabilities[which, envs] = neighbors.squared_distances.numpy()

    def _take_in(self, truncated: Mapping[int, np.ndarray]) -> None:
        episodes = self._workplace.episodes
        for env, last_observation in truncated.items():
            episodes.truncated[env] = True
            episodes.last_observations[env] = last_observation
        if self.perceiver.search_is_outside:
            envs = list(truncated)
            self._find(episodes.last_observations[envs], td.TERMINAL, envs)

    @property
    def n_traced(self) -> int:
        return self.table.traces.count

    def summary(self) -> dict[str, float]:
        sums = self._workplace.work.sums
        if not sums[2]:
            return {}
        td_error, q_mean = (sums[:2] / sums[2]).tolist()
        sums[:] = 0.0
        return {"td_error": td_error, "q_mean": q_mean}

    def state_dict(self) -> dict[str, Any]:
        episodes = self._workplace.episodes
        with self.table.lock:
            return {
                "indices": th.from_numpy(episodes.indices[td.CURRENT].copy()),
                # All zeros if there are no current episodes.
                "probabilities": th.from_numpy(episodes.probabilities[td.CURRENT] * self.in_episodes),
                "entries": th.from_numpy(episodes.action_indices[td.CURRENT].copy()),
                "held": th.from_numpy(episodes.persistent.copy()),
                "lengths": th.from_numpy(episodes.lengths.copy()),
                "observations": th.from_numpy(episodes.current_observations.copy()),
                "forbidden": th.from_numpy(episodes.forbidden[td.CURRENT].copy()),
                "traces": self.table.traces.state(),
            }

    def _forget(self) -> None:
        self.table.forget_traces()
        self._bind()

    def _take_over(self, state_dict: dict[str, Any]) -> None:
        episodes = self._workplace.episodes
        episodes.indices[td.CURRENT] = state_dict["indices"].numpy()
        episodes.probabilities[td.CURRENT] = state_dict["probabilities"].numpy()
        episodes.action_indices[td.CURRENT] = state_dict["entries"].numpy()
        episodes.persistent[:] = state_dict["held"].numpy()
        episodes.lengths[:] = state_dict["lengths"].numpy()
        episodes.current_observations[:] = self._observations_in(state_dict).numpy()
        episodes.forbidden[td.CURRENT] = state_dict["forbidden"].numpy()
        # Sum in the order of the kernel, for the same rounding.
        actions = episodes.actions[td.CURRENT]
        actions[:] = 0.0
        for (env, neighbor, _), column in np.ndenumerate(episodes.action_indices[td.CURRENT]):
            weight = episodes.probabilities[td.CURRENT, env, neighbor]
            actions[env] += weight * self._workplace.selection.action_points[column]
        self.table.traces.set_state(state_dict["traces"])
        self._bind()


class GreedyReader:
    """
    Reads the greedy actions of a few observations from a table, from any thread and also while a learner updates it.

    :param perceiver: with weights that the kernels implement
    :param table: the Q-table, on the CPU
    :param selector: selects actions
    """

    def __init__(self, perceiver: Perceiver, table: QTable, selector: ActionSelector) -> None:
        config = UpdateConfig(gamma=1.0, normalized=True, accumulating=False, reset_other_actions=False)
        self._workplace = Workplace(perceiver, table, selector, 1, config, greedy=True)
        self._workplace.episodes.persistent[:] = GREEDY
        self._uniforms = np.zeros(selector.n_uniforms)

    def __call__(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param observations: shape (batch, obs_dim), finite, observation units
        :return: the columns that the neighbours select, shape (batch, k, n_factors), and the probabilities of the
            neighbours, shape (batch, k)
        """
        place = self._workplace
        perceiver, n = place.perceiver, len(observations)
        _, _, k, n_factors = place.episodes.action_indices.shape
        seen = observations.astype(np.float64)
        with place.table.lock:
            place.follow()
            if perceiver.search_is_outside:
                neighbors = perceiver.find(th.from_numpy(seen))
                indices, probabilities = neighbors.indices.numpy(), neighbors.squared_distances.numpy()
            else:
                indices, probabilities = np.empty((n, k), np.int64), np.empty((n, k))
            selected = np.empty((n, k, n_factors), np.int64)
            td.recommend(place.state, seen, self._uniforms, indices, probabilities, selected)
        return selected, probabilities
