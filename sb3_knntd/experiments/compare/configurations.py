"""Selection of the configuration for an algorithm and an environment."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import rl_zoo3
import yaml
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_knntd.registry import ALGORITHMS, Role, with_role

#: The algorithm of every comparison that the others should do better than.
(FLOOR,) = with_role(Role.FLOOR)
#: RL Zoo's algorithms that take only one type of actions; its others take all.
BASELINES: dict[str, type[spaces.Space[Any]]] = {
    **dict.fromkeys(("dqn", "qrdqn"), spaces.Discrete),
    **dict.fromkeys(("sac", "td3", "tqc", "ddpg", "crossq"), spaces.Box),
}
#: Those of RL Zoo's that are not shown by their names in capitals.
BASELINE_LABELS = {"qrdqn": "QR-DQN", "crossq": "CrossQ"}
#: Problems of gymnasium that environments of this package are forms of: what was tuned for those is good for these.
RELATED = {
    "sb3_knntd/MountainCar-v0": "MountainCar-v0",
    "sb3_knntd/GeneralizedMountainCar-v0": "MountainCar-v0",
    "sb3_knntd/CartPole-v0": "CartPole-v1",
    "sb3_knntd/Acrobot-v0": "Acrobot-v1",
}
#: Entry of a configuration with the number of training steps.
DURATION = "n_timesteps"


class Configuration(NamedTuple):
    """
    The configuration of an algorithm for an environment.

    :param hyperparams: hyperparameters in RL Zoo's format, JSON-serializable
    :param source: origin of the configuration, shown in the report
    :param tuned_steps: number of steps that it was tuned for, ``None`` if unknown
    """

    hyperparams: dict[str, Any]
    source: str
    tuned_steps: int | None = None


def label(algo: str) -> str:
    """
    :param algo: name of an algorithm
    :return: its name in tables and plots
    """
    if algo in ALGORITHMS:
        return ALGORITHMS[algo].label
    return BASELINE_LABELS.get(algo, algo.upper())


def is_own(algo: str) -> bool:
    """
    :param algo: name of an algorithm
    :return: whether it is one that this package is for
    """
    return algo in with_role(Role.OWN)


def fits(algo: str, env_id: str) -> bool:
    """
    :param algo: name of an algorithm
    :param env_id: id of the environment
    :return: whether it supports the action space
    """
    action_space = ALGORITHMS[algo].action_space if algo in ALGORITHMS else BASELINES.get(algo, spaces.Space)
    return isinstance(_spaces(env_id)[1], action_space)


def configuration(algo: str, env_id: str, defaults: bool, conf: Mapping[str, Path]) -> Configuration:
    """
    :param algo: name of an algorithm
    :param env_id: id of the environment
    :param defaults: whether to use the algorithm's default parameters
    :param conf: configuration files in RL Zoo's format by algorithm, used instead of the usual ones
    :return: the file's entry for the environment, else for the environment in :data:`RELATED`, else its entry
        ``default``, else the algorithm's default parameters
    :raises ValueError: if a file in ``conf`` has none of these entries, or is not in RL Zoo's format
    :raises OSError: if a file cannot be read
    """
    plain = Configuration({"policy": _policy(algo, env_id)}, "the algorithm's defaults")
    if algo == FLOOR or (defaults and algo not in conf):
        return plain
    if algo in conf:
        path, source = conf[algo], conf[algo].name
    elif algo in ALGORITHMS:
        packaged = ALGORITHMS[algo].config_path
        if packaged is None:
            return plain
        path, source = packaged, f"{packaged.name} of this package"
    else:
        path, source = Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml", f"{algo}.yml of RL Zoo"
    entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(entries, dict):
        raise ValueError(f"{path} must map environments to hyperparameters, like RL Zoo's files")
    for entry in (env_id, RELATED.get(env_id, env_id), "default"):
        if entry in entries:
            found = json.loads(json.dumps(entries[entry]))
            steps = found.pop(DURATION, None)
            if set(found) <= {"policy"}:
                return plain._replace(hyperparams=found or plain.hyperparams)
            return Configuration(found, f"{source}, {entry}", steps if steps is None else int(steps))
    if algo in conf:
        raise ValueError(f"{path} has neither an entry {env_id!r} nor 'default'")
    return plain


def _policy(algo: str, env_id: str) -> str:
    if algo in ALGORITHMS:
        return ALGORITHMS[algo].policy
    space, _ = _spaces(env_id)
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image_space(space) else "MlpPolicy"


def _spaces(env_id: str) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    env = gym.make(env_id)
    env.close()
    return env.observation_space, env.action_space
