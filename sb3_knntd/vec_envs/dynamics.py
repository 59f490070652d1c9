"""Compiled steps of many of the paper's environments at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sb3_knntd.envs import acrobot, cart_pole, mountain_car
from sb3_knntd.envs.acrobot import AcrobotEnv
from sb3_knntd.envs.base import PaperEnv
from sb3_knntd.envs.cart_pole import CartPoleEnv, ContinuousCartPoleEnv
from sb3_knntd.envs.mountain_car import MountainCarEnv
from sb3_knntd.kernels.jit import inlined, jit

#: How a step ended: not at all, by termination, by the time limit.
GOES_ON, TERMINATED, TRUNCATED = range(3)
#: Columns of the counts: steps of the episode, time limit, and how the last step ended.
ELAPSED, LIMIT, END = range(3)

_mountain_car_step = jit(mountain_car.mountain_car_step)
_cart_pole_step = jit(cart_pole.cart_pole_step)
_cart_pole_failed = jit(cart_pole.cart_pole_failed)
_cart_pole_shaped_reward = jit(cart_pole.cart_pole_shaped_reward)
_acrobot_step = jit(acrobot.acrobot_step)
_acrobot_height = jit(acrobot.acrobot_height)
_SHAPED, _STEP, _FAILURE = range(3)


@jit
def push_discretely(actions, choices, pushes):
    """
    Look up what each action does.

    :param actions: shape (n_envs,), integers
    :param choices: what each number of an action does, shape (n_actions,)
    :param pushes: output, shape (n_envs,)
    :return: index of the first environment whose action is invalid, -1 if there is none
    """
    for env in range(len(actions)):
        if not 0 <= actions[env] < len(choices):
            return env
        pushes[env] = choices[actions[env]]
    return -1


@jit
def push_continuously(actions, choices, pushes):
    """
    Clip each action to [-1, 1].

    :param actions: shape (n_envs, 1)
    :param choices: unused
    :param pushes: output, shape (n_envs,)
    :return: index of the first environment whose action is not finite, -1 if there is none
    """
    for env in range(len(actions)):
        if not np.isfinite(actions[env, 0]):
            return env
        pushes[env] = min(max(np.float64(actions[env, 0]), -1.0), 1.0)
    return -1


@inlined
def _finish(env, reward, terminated, states, bounds, counts, observations, rewards, dones):
    """Write what one environment returns; 1 if its episode has ended, otherwise 0."""
    dim = observations.shape[1]
    for j in range(dim):
        observations[env, j] = min(max(states[env, j], bounds[0, j]), bounds[1, j])
    states[env, dim] += reward
    rewards[env] = reward
    counts[env, ELAPSED] += 1
    if terminated:
        counts[env, END] = TERMINATED
    elif counts[env, ELAPSED] >= counts[env, LIMIT]:
        counts[env, END] = TRUNCATED
    else:
        counts[env, END] = GOES_ON
    dones[env] = counts[env, END] != GOES_ON
    return np.int64(dones[env])


@jit
def step_mountain_cars(pushes, settings, states, bounds, counts, observations, rewards, dones):
    """
    Make a step in each environment. The functions for the other environments have the same arguments.

    :param pushes: what the actions do, shape (n_envs,)
    :param settings: settings of each environment, shape (n_envs, n_settings)
    :param states: the state of each environment, and the return of its episode, shape (n_envs, state_dim + 1); updated
        in place
    :param bounds: lowest and highest observation, shape (2, state_dim)
    :param counts: see ``ELAPSED``, ``LIMIT`` and ``END``, shape (n_envs, 3), int64; updated in place
    :param observations: output, shape (n_envs, state_dim), float32
    :param rewards: output, shape (n_envs,), float32
    :param dones: output, whether episodes have ended, shape (n_envs,), bool
    :return: number of episodes that have ended
    """
    n_ended = 0
    for env in range(len(pushes)):
        state = _mountain_car_step((states[env, 0], states[env, 1]), pushes[env])
        states[env, 0], states[env, 1] = state
        arrived = state[0] >= mountain_car.GOAL_POSITION
        reward = np.float64(arrived) if settings[env, 0] else -1.0
        n_ended += _finish(env, reward, arrived, states, bounds, counts, observations, rewards, dones)
    return n_ended


@jit
def step_cart_poles(pushes, settings, states, bounds, counts, observations, rewards, dones):
    """See :func:`step_mountain_cars`."""
    n_ended = 0
    for env in range(len(pushes)):
        state = _cart_pole_step((states[env, 0], states[env, 1], states[env, 2], states[env, 3]), pushes[env])
        states[env, 0], states[env, 1], states[env, 2], states[env, 3] = state
        failed = _cart_pole_failed(state, settings[env, 1], settings[env, 2])
        if settings[env, 0] == _SHAPED:
            reward = _cart_pole_shaped_reward(state, failed)
        elif settings[env, 0] == _STEP:
            reward = 1.0
        else:
            reward = -1.0 if failed else 0.0
        n_ended += _finish(env, reward, failed, states, bounds, counts, observations, rewards, dones)
    return n_ended


@jit
def step_acrobots(pushes, settings, states, bounds, counts, observations, rewards, dones):
    """See :func:`step_mountain_cars`."""
    n_ended = 0
    for env in range(len(pushes)):
        before = (states[env, 0], states[env, 1], states[env, 2], states[env, 3])
        state = _acrobot_step(before, pushes[env], settings[env, 0] != 0.0)
        states[env, 0], states[env, 1], states[env, 2], states[env, 3] = state
        arrived = _acrobot_height(state) > acrobot.GOAL_HEIGHT
        reward = np.float64(arrived) if settings[env, 1] else np.float64(arrived) - 1.0
        n_ended += _finish(env, reward, arrived, states, bounds, counts, observations, rewards, dones)
    return n_ended


class Dynamics(NamedTuple):
    """
    How the environments of a class are stepped.

    :param step: compiled, see :func:`step_mountain_cars`
    :param push: compiled, :func:`push_discretely` or :func:`push_continuously`
    :param choices: what each number of an action does, shape (n_actions,); empty for continuous actions
    :param settings: of an environment, numbers for ``step``
    :param show: sets the push that an environment draws
    """

    step: Callable[..., int]
    push: Callable[..., int]
    choices: Callable[[Any], np.ndarray]
    settings: Callable[[Any], list[float]]
    show: Callable[[Any, float], None]


def _car_settings(env: MountainCarEnv) -> list[float]:
    return [float(env.reward == "goal")]


def _car_shows(env: MountainCarEnv, push: float) -> None:
    env._push = int(push) - 1


def _pole_settings(env: CartPoleEnv | ContinuousCartPoleEnv) -> list[float]:
    return [float(("shaped", "step", "failure").index(env.reward)), env.track, env._largest_angle]


def _pole_shows(env: CartPoleEnv | ContinuousCartPoleEnv, push: float) -> None:
    env._push = push


def _acrobot_settings(env: AcrobotEnv) -> list[float]:
    return [float(env.dynamics == "nips"), float(env.reward == "goal")]


def _acrobot_shows(env: AcrobotEnv, push: float) -> None:
    env._torque = int(push) - 1


def _itself(env: PaperEnv[Any]) -> np.ndarray:
    """The action of a Discrete(3) space is what the dynamics take."""
    return np.arange(3.0)


def _forces(env: CartPoleEnv) -> np.ndarray:
    return env.forces


def _none(env: PaperEnv[Any]) -> np.ndarray:
    return np.empty(0)


#: How each class of environments is stepped.
DYNAMICS: dict[type[PaperEnv[Any]], Dynamics] = {
    MountainCarEnv: Dynamics(step_mountain_cars, push_discretely, _itself, _car_settings, _car_shows),
    CartPoleEnv: Dynamics(step_cart_poles, push_discretely, _forces, _pole_settings, _pole_shows),
    ContinuousCartPoleEnv: Dynamics(step_cart_poles, push_continuously, _none, _pole_settings, _pole_shows),
    AcrobotEnv: Dynamics(step_acrobots, push_discretely, _itself, _acrobot_settings, _acrobot_shows),
}
