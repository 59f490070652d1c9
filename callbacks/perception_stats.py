"""Statistics of the perception and of the changes of the table."""

from __future__ import annotations

from collections import deque
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_knntd.common.checks import check_integer
from sb3_knntd.kernels.step import UNDRAWN

from .throttled import ThrottledCallback

#: Every so many calls a transition is sampled. A prime, so that it is no multiple of the length of the episodes.
STRIDE = 101
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}


class Transitions(NamedTuple):
    """
    What happened in a step; ``n`` is n_envs, or the number of those of several steps.

    :param observations: shape (n, *obs_shape)
    :param actions: as the environment took them, shape (n, *action_shape)
    :param rewards: shape (n,)
    :param next_observations: the true ones, also where an episode ended, shape (n, *obs_shape)
    :param terminated: whether nothing can follow, shape (n,), bool
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    terminated: np.ndarray


class PerceptionStatsCallback(ThrottledCallback):
    """
    Logs how observations are seen and what learning does, from a sample of the transitions (one call in 102) and at
    training's end:

    ============================== ====================================================================================
    ``perception/visited_share``   share of the points that were learned at
    ``perception/neighbors``       effective number of neighbours, 1/Σp², from 1 to k; the mean over the sample
    ``perception/outside_share``   share of the observations beyond the bounds in some dimension
    ``train/td_error_q05``         5 % quantile of the TD errors of the sample, by the table as it is now; likewise
                                   ``_q50`` and ``_q95``
    ``train/trace_length``         1/(1 - γλ), the sum of a trace's decays: for how many steps a state is credited
    ``train/trace_points``         number of points that have a trace
    ``train/policy_changes``       share of the last log's sample at which the greedy action is another now
    ============================== ====================================================================================

    .. code-block:: python

        KNNTD("MountainCar-v0", tensorboard_log="logs").learn(50_000, callback=PerceptionStatsCallback())

    :param log_freq: log every so many calls (of n_envs steps each); ``None``: as often as takes two thousandths
        of the time, which is once in five seconds or so
    :param n_samples: number of transitions that the sample is of, the last ones
    :param verbose: has no effect
    :raises ValueError: if an argument does not fit
    """

    SHARE: ClassVar[float] = 0.002
    FIRST_SECONDS: ClassVar[float] = 0.005

    def __init__(self, log_freq: int | None = None, n_samples: int = 256, verbose: int = 0) -> None:
        super().__init__("log_freq", log_freq, verbose)
        self.n_samples = check_integer("n_samples", n_samples, 1)
        self._sample: deque[Transitions] = deque()
        self._earlier: tuple[np.ndarray, np.ndarray] | None = None
        # Which action follows is drawn anew: the model's own numbers are not touched.
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
        """Keep the observations, and in the next step what came of them."""
        local = self.locals
        if self._before is None:
            self._before = np.copy(local["new_obs"])
            self._sample_at = self.n_calls + 1
            return
        # Random steps that a range is measured by are no learning.
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
        record("perception/visited_share", table.n_visited / points.n_points)
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
        # As observations mostly are: the float32 next to a bound is not beyond it.
        places = observations.reshape(len(observations), -1).astype(np.float32)
        low, high = (bound.cpu().numpy().astype(np.float32) for bound in (bounds.low, bounds.high))
        return float(((places < low) | (places > high)).any(axis=1).mean())

    def _td_errors(self, sample: Transitions) -> np.ndarray:
        """r + γ times what the next state is worth as a target, less Q(s, a); by the table as it is."""
        model = self.model
        policy, rule = model.policy, model._rule
        with th.no_grad():
            rows, probabilities = policy.perceived_rows(sample.observations)
            if isinstance(model.action_space, spaces.Discrete):
                columns = th.from_numpy(sample.actions - model.action_space.start).to(rows.device)
                entries = columns[:, None, None].expand(*rows.shape[:2], 1)
            else:
                # What ExA's states are worth hangs on no entry (eq. 25).
                entries = th.empty(0, dtype=th.int64, device=rows.device)
            now = rule.value(rows, probabilities, entries)
            rows, probabilities = policy.perceived_rows(sample.next_observations)
            uniforms = th.from_numpy(self._generator.random((len(rows), rule.n_uniforms))).to(rows.device)
            held = th.full((len(rows), len(rule.blocks) - 1), UNDRAWN, device=rows.device)
            then = rule.choose(rows, probabilities, uniforms, model.exploration_rate, held).values
        worth = np.where(sample.terminated, 0.0, then.double().cpu().numpy())
        errors: np.ndarray = sample.rewards + model.gamma * worth - now.double().cpu().numpy()
        return errors


def _transitions(before: np.ndarray, local: dict[str, Any]) -> Transitions:
    """What the callback's locals tell of the step that followed ``before``."""
    after, dones = np.copy(local["new_obs"]), np.copy(local["dones"])
    for index in np.flatnonzero(dones):
        info = local["infos"][index]
        after[index] = info.get("terminal_observation", after[index])
        dones[index] = not info.get("TimeLimit.truncated", False)
    return Transitions(before, np.copy(local["actions"]), np.copy(local["rewards"]), after, dones)
