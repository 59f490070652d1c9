"""Names of the observation dimensions and actions of environments."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_knntd.common.checks import shown
from sb3_knntd.policies import TableModel


class Names(NamedTuple):
    """
    Names of the observation dimensions and actions of an environment.

    :param observations: one name for each observation dimension, with its unit
    :param actions: one name for each action, or for each dimension of the action
    """

    observations: tuple[str, ...]
    actions: tuple[str, ...]


#: Names for the environments of gymnasium whose spaces the algorithms of this package support.
NAMES = {
    "MountainCar-v0": Names(("position", "velocity (position per step)"), ("push left", "no push", "push right")),
    "CartPole-v1": Names(
        ("cart position (m)", "cart velocity (m/s)", "pole angle (rad)", "pole angular velocity (rad/s)"),
        ("push left", "push right"),
    ),
    "Acrobot-v1": Names(
        ("cos θ₁", "sin θ₁", "cos θ₂", "sin θ₂", "angular velocity of θ₁ (rad/s)", "angular velocity of θ₂ (rad/s)"),
        ("torque −1 N m", "no torque", "torque +1 N m"),
    ),
    "Pendulum-v1": Names(("cos θ", "sin θ", "angular velocity (rad/s)"), ("torque (N m)",)),
    "MountainCarContinuous-v0": Names(("position", "velocity (position per step)"), ("force",)),
}


def check_names(names: Any) -> Names | None:
    """
    :param names: value given for ``names``
    :return: the names as tuples, or ``None``
    :raises ValueError: if it is neither ``None`` nor two lists of strings
    """
    if names is None:
        return None
    try:
        checked = Names(*map(tuple, names))
    except TypeError as error:
        raise ValueError(f"names must be plots.Names(observations, actions); got {shown(names)}") from error
    if not all(isinstance(name, str) for name in (*checked.observations, *checked.actions)):
        raise ValueError(f"names must be plots.Names(observations, actions), of words; got {shown(names)}")
    return checked


def names_for(model: TableModel, names: Names | None = None) -> Names:
    """
    :param model: any model
    :param names: names given by the user
    :return: the given names; by default those of the model's environment in ``NAMES``, or numbers if it is not there
    :raises ValueError: if ``names`` does not fit the model's spaces
    """
    names = check_names(names)
    if names is not None and not _fit(names, model):
        raise ValueError(
            f"names must hold one for each observation dimension and one for each action (each action dimension with "
            f"ExA); got {names!r}"
        )
    return names or _names_of(model) or _numbered(model)


def names_in(env_id: str, model: TableModel) -> Names | None:
    """
    :param env_id: gymnasium id of the environment that the model was trained on
    :param model: any model
    :return: the names in ``NAMES``; ``None`` if there are none, or a wrapper has changed the spaces
    """
    names = NAMES.get(env_id)
    return names if names is not None and _fit(names, model) else None


def _names_of(model: TableModel) -> Names | None:
    env = model.get_env()
    spec = None if env is None else env.get_attr("spec", 0)[0]
    return None if spec is None else names_in(spec.id, model)


def _fit(names: Names, model: TableModel) -> bool:
    n_dims = model.policy.perceiver.bounds.obs_dim
    return len(names.observations) == n_dims and len(names.actions) == _count_actions(model)


def _count_actions(model: TableModel) -> int:
    """Number of actions, or of action dimensions."""
    space = model.action_space
    return int(space.n) if isinstance(space, spaces.Discrete) else int(np.prod(space.shape or ()))


def _numbered(model: TableModel) -> Names:
    space, n_actions = model.action_space, _count_actions(model)
    if isinstance(space, spaces.Discrete):
        actions = tuple(f"action {number}" for number in range(space.start, space.start + n_actions))
    else:
        actions = tuple(f"action[{dim}]" for dim in range(n_actions))
    if isinstance(model.observation_space, spaces.Discrete):
        return Names(("state",), actions)
    return Names(tuple(f"observation[{dim}]" for dim in range(model.policy.perceiver.bounds.obs_dim)), actions)
