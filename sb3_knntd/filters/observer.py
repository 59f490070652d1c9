"""Where each environment is now, by what was observed and what the table says of how states change."""

from __future__ import annotations

import warnings

import numpy as np
import torch as th

from sb3_knntd.common.checks import check_finite
from sb3_knntd.filters.table import DeltaTable
from sb3_knntd.kernels import filter as kernel
from sb3_knntd.kernels import jit


class Observer:
    """
    Algorithm 5 of the paper for several environments that share a table, one after the other within a step.

    :param table: what is learned
    :param n_envs: number of environments
    """

    def __init__(self, table: DeltaTable, n_envs: int) -> None:
        self.table = table
        self.n_envs = n_envs
        self.is_compiled = table.arguments.compiled and jit.AVAILABLE and table.perceiver.eyes is not None
        if table.arguments.compiled and not jit.AVAILABLE:
            warnings.warn(f"numba cannot be used ({jit.REASON}): the filter goes by NumPy, slower", stacklevel=2)
        k, obs_dim = table.perceiver.search.n_neighbors, table.obs_dim
        self._references = np.zeros((n_envs, obs_dim))
        self._doubts = np.ones((n_envs, obs_dim))
        self._innovations = np.zeros((n_envs, obs_dim))
        self._follows = np.zeros(n_envs, np.bool_)
        self._states = self._references, self._doubts, self._innovations, self._follows
        self._indices, self._probabilities = np.zeros((n_envs, k), np.int64), np.zeros((n_envs, k))

    def begin(self, rows: list[int], observations: np.ndarray) -> None:
        """
        Begin an episode: the first observation is all that is known.

        :param rows: which environments
        :param observations: their first observations, shape (len(rows), obs_dim)
        :raises ValueError: if an observation is not finite
        """
        check_finite("an observation", observations, rows)
        self._references[rows] = observations
        self._doubts[rows] = 1.0
        self._follows[rows] = False

    def advance(self, observations: np.ndarray, columns: np.ndarray, training: bool) -> np.ndarray:
        """
        One step of all environments.

        :param observations: shape (n_envs, obs_dim)
        :param columns: what stands for the actions that led there, shape (n_envs,), int64
        :param training: whether to learn from it
        :return: the estimated states, shape (n_envs, obs_dim), float64
        :raises ValueError: if an observation is not finite; nothing is learned then
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
        if perceiver.search_is_outside:
            neighbors = perceiver.find(th.from_numpy(self._references))
            self._indices[:], self._probabilities[:] = neighbors.indices.numpy(), neighbors.squared_distances.numpy()
        arguments = table.arguments
        form = (
            table.averaging,
            arguments.reference == "observed",
            table.gain,
            table.fixed_gain,
            table.rate(),
            float(arguments.warmup),
            training,
        )
        kernel.advance(
            perceiver.eyes,
            (table.deltas, table.visits),
            (table.gains, table.variances, table.counts),
            self._states,
            form,
            observations,
            columns,
            self._indices,
            self._probabilities,
            filtered,
        )

    def _advance(self, observations: np.ndarray, columns: np.ndarray, training: bool, filtered: np.ndarray) -> None:
        perception = self.table.perceiver(th.from_numpy(self._references))
        for env in range(self.n_envs):
            entries = perception.indices[env].numpy(), columns[env]
            filtered[env] = self._advance_one(
                env, observations[env], entries, perception.probabilities[env].numpy(), training
            )

    def _advance_one(
        self, env: int, observation: np.ndarray, entries: tuple[np.ndarray, int], shares: np.ndarray, training: bool
    ) -> np.ndarray:
        """The kernel's step for one environment, as NumPy operations."""
        table = self.table
        reference, visits, deltas = self._references[env].copy(), table.visits[entries], table.deltas[entries]
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

        if table.gain == kernel.FIXED:
            correction = table.fixed_gain * innovation
        elif table.gain == kernel.ADAPTIVE:
            if training and trusted:
                self._adapt(env, innovation)
            with np.errstate(divide="ignore"):
                entry_doubt = (shares**2 / visits).sum()
                process = table.gains**2 / (1.0 - table.gains)
            self._doubts[env] = 1.0 - 1.0 / (1.0 + self._doubts[env] + entry_doubt + process)
            correction = self._doubts[env] * innovation
        else:
            correction = shares @ (steps * errors)

        filtered = reference + delta + correction if trusted else observation
        if not trusted:
            self._doubts[env] = 1.0
        self._innovations[env], self._follows[env] = innovation, trusted
        self._references[env] = observation if table.arguments.reference == "observed" else filtered
        return filtered

    def _adapt(self, env: int, innovation: np.ndarray) -> None:
        table = self.table
        table.counts += 1.0
        n = table.counts[0]
        table.variances += max(1.0 / n, kernel.LEAST_PACE) * (innovation**2 - table.variances)
        known = table.variances > 0.0
        if self._follows[env] and n > kernel.ENOUGH:
            products = innovation * self._innovations[env]
            correlations = np.divide(products, table.variances, out=np.zeros_like(products), where=known)
            correlations = correlations.clip(-kernel.LARGEST_CORRELATION, kernel.LARGEST_CORRELATION)
            pace = max(1.0 / (1.0 / kernel.FIRST_PACE + n), kernel.LEAST_PACE)
            table.gains[:] = (table.gains + pace * correlations).clip(kernel.LEAST_GAIN, 1.0)
