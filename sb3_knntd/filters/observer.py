"""State estimates of the environments, from the observations and the table."""

from __future__ import annotations

import warnings

import numpy as np
import torch as th

from sb3_knntd.common.checks import check_finite
from sb3_knntd.filters.table import DeltaTable
from sb3_knntd.kernels import delta_filter as kernel
from sb3_knntd.kernels import jit


class Observer:
    """
    Algorithm 5 of the paper for several environments that share a table. Within a step it is applied to one after the
    other.

    :param table: the table
    :param n_envs: number of environments
    """

    def __init__(self, table: DeltaTable, n_envs: int) -> None:
        self.table = table
        self.n_envs = n_envs
        self.is_compiled = table.arguments.compiled and jit.AVAILABLE and table.perceiver.arguments is not None
        if table.arguments.compiled and not jit.AVAILABLE:
            warnings.warn(f"numba cannot be used ({jit.REASON}): the filter uses NumPy, which is slower", stacklevel=2)
        k, obs_dim = table.perceiver.search.n_neighbors, table.obs_dim
        self._states = kernel.FilterStates(
            references=np.zeros((n_envs, obs_dim)),
            error_variances=np.ones((n_envs, obs_dim)),
            innovations=np.zeros((n_envs, obs_dim)),
            follows=np.zeros(n_envs, np.bool_),
        )
        self._states_for_kernel = tuple(self._states)
        self._indices, self._probabilities = np.zeros((n_envs, k), np.int64), np.zeros((n_envs, k))

    def begin(self, rows: list[int], observations: np.ndarray) -> None:
        """
        Begin an episode. The first observation is the first estimate.

        :param rows: indices of the environments
        :param observations: their first observations, shape (len(rows), obs_dim)
        :raises ValueError: if an observation is not finite
        """
        check_finite("an observation", observations, rows)
        self._states.references[rows] = observations
        self._states.error_variances[rows] = 1.0
        self._states.follows[rows] = False

    def advance(self, observations: np.ndarray, columns: np.ndarray, training: bool) -> np.ndarray:
        """
        One step of all environments.

        :param observations: shape (n_envs, obs_dim)
        :param columns: columns of the actions that led there, shape (n_envs,), int64
        :param training: whether to learn from the step
        :return: the estimated states, shape (n_envs, obs_dim), float64
        :raises ValueError: if an observation is not finite; then nothing is learned
        """
        check_finite("an observation", observations, range(self.n_envs))
        observations = observations.astype(np.float64)
        if self.table.must_measure(self.n_envs):
            if training:
                self.table.measure(observations)
            self.begin(list(range(self.n_envs)), observations)
            return observations
        filtered = np.empty_like(observations)
        if self.is_compiled:
            self._advance_compiled(observations, columns, training, filtered)
        else:
            self._advance(observations, columns, training, filtered)
        if training:
            self.table.n_steps += self.n_envs
            self.table.follow(filtered)
        return filtered

    def _advance_compiled(
        self, observations: np.ndarray, columns: np.ndarray, training: bool, filtered: np.ndarray
    ) -> None:
        table, perceiver = self.table, self.table.perceiver
        assert perceiver.arguments is not None
        if perceiver.search_is_outside:
            neighbors = perceiver.find(th.from_numpy(self._states.references))
            self._indices[:], self._probabilities[:] = neighbors.indices.numpy(), neighbors.squared_distances.numpy()
        config = kernel.FilterConfig(
            averaging=table.averaging,
            observed=table.arguments.reference == "observed",
            gain_rule=int(table.gain_rule),
            fixed_gain=table.fixed_gain,
            learning_rate=table.rate(),
            warmup=float(table.arguments.warmup),
            training=training,
        )
        kernel.advance(
            tuple(perceiver.arguments),
            table.arrays,
            table.statistics,
            self._states_for_kernel,
            tuple(config),
            observations,
            columns,
            self._indices,
            self._probabilities,
            filtered,
        )

    def _advance(self, observations: np.ndarray, columns: np.ndarray, training: bool, filtered: np.ndarray) -> None:
        perception = self.table.perceiver(th.from_numpy(self._states.references))
        for env in range(self.n_envs):
            entries = perception.indices[env].numpy(), columns[env]
            filtered[env] = self._advance_one(
                env, observations[env], entries, perception.probabilities[env].numpy(), training
            )

    def _advance_one(
        self, env: int, observation: np.ndarray, entries: tuple[np.ndarray, int], shares: np.ndarray, training: bool
    ) -> np.ndarray:
        """The step of the kernel for one environment, as NumPy operations."""
        table, states = self.table, self._states
        reference, visits, deltas = states.references[env].copy(), table.visits[entries], table.deltas[entries]
        trusted = shares @ visits >= table.arguments.warmup
        rate = table.rate()
        rates = np.maximum(1.0 / (visits + shares), kernel.LEAST_RATE) if rate == kernel.COUNT else rate
        steps = (shares * rates)[:, None]

        delta = shares @ deltas
        innovation = observation - reference - delta
        errors = observation - reference - deltas if table.averaging else innovation
        if training:
            table.visits[entries] += shares
            table.deltas[entries] += steps * errors

        if table.gain_rule == kernel.GainRule.OF_UPDATE:
            correction = shares @ (steps * errors)
        elif table.gain_rule == kernel.GainRule.FIXED:
            correction = table.fixed_gain * innovation
        elif table.gain_rule == kernel.GainRule.ADAPTIVE:
            if training and trusted:
                self._adapt(env, innovation)
            with np.errstate(divide="ignore"):
                table_variance = (shares**2 / visits).sum()
                process_variance = table.gains**2 / (1.0 - table.gains)
            error_variance = 1.0 - 1.0 / (1.0 + states.error_variances[env] + table_variance + process_variance)
            states.error_variances[env] = error_variance
            correction = error_variance * innovation
        else:
            raise ValueError(f"unknown gain rule {table.gain_rule!r}")

        filtered = reference + delta + correction if trusted else observation
        if not trusted:
            states.error_variances[env] = 1.0
        states.innovations[env], states.follows[env] = innovation, trusted
        states.references[env] = observation if table.arguments.reference == "observed" else filtered
        return filtered

    def _adapt(self, env: int, innovation: np.ndarray) -> None:
        table = self.table
        table.counts += 1.0
        n = table.counts[0]
        table.variances += max(1.0 / n, kernel.LEAST_GAIN_RATE) * (innovation**2 - table.variances)
        known = table.variances > 0.0
        if self._states.follows[env] and n > kernel.ENOUGH:
            products = innovation * self._states.innovations[env]
            correlations = np.divide(products, table.variances, out=np.zeros_like(products), where=known)
            correlations = correlations.clip(-kernel.LARGEST_CORRELATION, kernel.LARGEST_CORRELATION)
            gain_rate = max(1.0 / (1.0 / kernel.FIRST_GAIN_RATE + n), kernel.LEAST_GAIN_RATE)
            table.gains[:] = (table.gains + gain_rate * correlations).clip(kernel.LEAST_GAIN, 1.0)
