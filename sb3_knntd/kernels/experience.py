"""What was seen while learning: the range of the observations, their changes and the rewards."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import inlined

#: Rows of ``seen``: the lowest and the highest observation, the number of observations beyond the bounds, and the sum
#: of the absolute changes from one step to the next.
LOW, HIGH, N_BEYOND, CHANGE = range(4)
#: Entries of ``seen_totals``: the number of steps, the number of those that did not end an episode, the lowest and the
#: highest reward.
N_STEPS, N_CHANGES, LEAST_REWARD, MOST_REWARD = range(4)
#: An observation that exceeds the bounds by this share of their width is within: most are rounded to float32.
ROUNDING = 1e-6


class ExperienceArrays(NamedTuple):
    """
    Statistics of all steps that were learned from.

    :param seen: see :data:`LOW`, :data:`HIGH`, :data:`N_BEYOND` and :data:`CHANGE`, shape (4, obs_dim)
    :param seen_totals: see :data:`N_STEPS`, :data:`N_CHANGES`, :data:`LEAST_REWARD`, :data:`MOST_REWARD`, shape (4,)
    """

    seen: np.ndarray
    seen_totals: np.ndarray


@inlined
def record_steps(state, observations, rewards, ended):
    """
    Add a step in every environment to the statistics, and make its observations the current ones.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observations: the observations after the step, shape (n_envs, obs_dim), observation units
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have ended, shape (n_envs,), bool
    """
    seen, totals, current, low, width = (
        state.seen,
        state.seen_totals,
        state.current_observations,
        state.low,
        state.width,
    )
    for env in range(len(rewards)):
        # The first step after loading a file that does not hold the current observations is not compared with any.
        goes_on = not ended[env] and not np.isinf(current[env, 0])
        for j in range(observations.shape[1]):
            value = np.float64(observations[env, j])
            share = (value - low[j]) / width[j]
            seen[LOW, j] = min(seen[LOW, j], value)
            seen[HIGH, j] = max(seen[HIGH, j], value)
            if share < -ROUNDING or share > 1.0 + ROUNDING:
                seen[N_BEYOND, j] += 1.0
            if goes_on:
                seen[CHANGE, j] += abs(value - current[env, j])
            current[env, j] = value
        totals[N_STEPS] += 1.0
        if goes_on:
            totals[N_CHANGES] += 1.0
        totals[LEAST_REWARD] = min(totals[LEAST_REWARD], rewards[env])
        totals[MOST_REWARD] = max(totals[MOST_REWARD], rewards[env])
