"""Statistics of the perception and of the changes of the table."""

from __future__ import annotations

from collections import deque
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.common.checks import check_integer
from sb3_knntd.kernels.selection import UNDRAWN

from .throttled import ThrottledCallback

#: Number of calls between two samples of transitions. A prime, so that it is unlikely to be a multiple of the episodes'
#: length.
STRIDE = 101
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}


class Transitions(NamedTuple):
    """
    Transitions of one or more steps: ``n`` is n_envs times the number of steps.

    :param observations: shape (n, *obs_shape)
    :param actions: actions of the environment, shape (n, *action_shape)
    :param rewards: shape (n,)
    :param next_observations: observations after the steps, before a reset, shape (n, *obs_shape)
    :param terminated: whether the next state is terminal, shape (n,), bool
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    terminated: np.ndarray


class PerceptionStatsCallback(ThrottledCallback):
    """
    Logs statistics of the perception and of learning every ``log_freq`` calls and at the end of training. They are
    computed from a sample of the transitions (one call in 102):

    ============================== ====================================================================================
    ``perception/visited_share``   share of the points that have been visited
    ``perception/neighbors``       effective number of neighbours, 1/Σp², from 1 to k; the mean over the sample
    ``perception/outside_share``   share of the observations that are outside the bounds in some dimension
    ``train/td_error_q05``         5 % quantile of the TD errors of the sample, with the current table; likewise
                                   ``_q50`` and ``_q95``
    ``train/trace_length``         1/(1 - γλ), the sum of a trace's decays: the effective number of credited steps
    ``train/trace_points``         number of points that have a trace
    ``train/policy_changes``       share of the previous log's sample at which the greedy action has changed
    ============================== ====================================================================================

    .. code-block:: python

        KNNTD("MountainCar-v0", tensorboard_log="logs").learn(50_000, callback=PerceptionStatsCallback())

    :param log_freq: log every ``log_freq`` calls (of n_envs steps each); ``None``: as often as takes 0.2 % of the time,
        about once in five seconds
    :param n_samples: number of transitions in the sample, the most recent ones
    :param verbose: has no effect
    :raises ValueError: if an argument is invalid
    """

    SHARE: ClassVar[float] = 0.002
    FIRST_SECONDS: ClassVar[float] = 0.005

    def __init__(self, log_freq: int | None = None, n_samples: int = 256, verbose: int = 0) -> None:
        super().__init__("log_freq", log_freq, verbose)
        self.n_samples = check_integer("n_samples", n_samples, 1)
        self._sample: deque[Transitions] = deque()
        self._earlier: tuple[np.ndarray, np.ndarray] | None = None
        # A separate generator for the next actions, so that the model's random numbers do not change.
        self._generator = np.random.default_rng(0)

    def _on_training_start(self) -> None:
        self._sample = deque(maxlen=-(-self.n_samples // self.model.n_envs))
        self._before: np.ndarray | None = None
        self._sample_at = self.n_calls + 1
        super()._on_training_start()

    def _on_step(self) -> bool:
        if self.n_calls == self._sample_at:
            self._take()
        return super()._on_step()

    def _next_due(self) -> int:
        return min(super()._next_due(), self._sample_at)

    def _take(self) -> None:
        """Store the observations, and in the next step their transitions."""
        local = self.locals
        if self._before is None:
            self._before = np.copy(local["new_obs"])
            self._sample_at = self.n_calls + 1
            return
        # The random steps that measure the range of observations are not learned from.
        if not self.model._measuring:
            self._sample.append(_transitions(self._before, local))
        self._before = None
        self._sample_at = self.n_calls + STRIDE

    def _act(self) -> None:
        if not self._sample:
            return
        model, record = self.model, self.logger.record
        sample = Transitions(*map(np.concatenate, zip(*self._sample, strict=True)))
        table, points = model.policy.table, model.policy.perceiver.points
        probabilities = model.policy.perceive(sample.observations).probabilities
        # KNNDyna has no points before its first plan.
        record("perception/visited_share", table.n_visited / max(points.n_points, 1))
        record("perception/neighbors", float((1.0 / probabilities.square().sum(dim=1)).mean()))
        record("perception/outside_share", self._outside(sample.observations))
        errors = self._td_errors(sample)
        for name, quantile in QUANTILES.items():
            record(f"train/td_error_{name}", float(np.quantile(errors, quantile)))
        decay = model.gamma * float(model.trace_schedule(model._current_progress_remaining))
        record("train/trace_length", 1.0 / (1.0 - decay) if decay < 1.0 else float("inf"))
        record("train/trace_points", model.learner.n_traced)
        if self._earlier is not None:
            observations, greedy = self._earlier
            changed = model.policy.predict(observations)[0] != greedy
            record("train/policy_changes", float(changed.reshape(len(changed), -1).any(axis=1).mean()))
        self._earlier = sample.observations, model.policy.predict(sample.observations)[0]
        self.logger.dump(self.num_timesteps)

    def _outside(self, observations: np.ndarray) -> float:
        bounds = self.model.policy.perceiver.bounds
        # Most observations are float32, and the float32 nearest to a bound counts as inside.
        places = observations.reshape(len(observations), -1).astype(np.float32)
        low, high = (bound.cpu().numpy().astype(np.float32) for bound in (bounds.low, bounds.high))
        return float(((places < low) | (places > high)).any(axis=1).mean())

    def _td_errors(self, sample: Transitions) -> np.ndarray:
        """r + γ times the target value of the next state, minus Q(s, a), with the current table."""
        model = self.model
        policy = model.policy
        selector = policy.selector
        with th.no_grad():
            rows, probabilities = policy.perceived_rows(sample.observations)
            columns = th.from_numpy(policy.columns_of(sample.actions)).to(rows.device)
            values = selector.value(rows, probabilities, columns[:, None].expand(*rows.shape[:2], -1))
            rows, probabilities = policy.perceived_rows(sample.next_observations)
            uniforms = th.from_numpy(self._generator.random((len(rows), selector.n_uniforms))).to(rows.device)
            nothing = th.full((len(rows), selector.n_factors), UNDRAWN, device=rows.device)
            target_values = selector.select(
                rows, probabilities, uniforms, model.exploration_rate, nothing
            ).target_values
        targets = np.where(sample.terminated, 0.0, target_values.double().cpu().numpy())
        errors: np.ndarray = sample.rewards + model.gamma * targets - values.double().cpu().numpy()
        return errors


def _transitions(before: np.ndarray, local: dict[str, Any]) -> Transitions:
    """The transitions of the current step, from the callback's locals and the observations before it."""
    after, dones = np.copy(local["new_obs"]), np.copy(local["dones"])
    for index in np.flatnonzero(dones):
        info = local["infos"][index]
        after[index] = info.get("terminal_observation", after[index])
        dones[index] = not info.get("TimeLimit.truncated", False)
    return Transitions(before, np.copy(local["actions"]), np.copy(local["rewards"]), after, dones)
