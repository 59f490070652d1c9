"""Which configuration an algorithm gets for an environment."""

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
BASELINE_LABELS = {"qrdqn": "QR-DQN"}
#: Problems of gymnasium that environments of this package are forms of: what was tuned for those is good for these.
RELATED = {
    "sb3_knntd/MountainCar-v0": "MountainCar-v0",
    "sb3_knntd/GeneralizedMountainCar-v0": "MountainCar-v0",
    "sb3_knntd/CartPole-v0": "CartPole-v1",
    "sb3_knntd/Acrobot-v0": "Acrobot-v1",
}
#: Entries of a configuration that only say how long RL Zoo trains.
DURATION = "n_timesteps"


class Configuration(NamedTuple):
    """
    :param hyperparams: in RL Zoo's form, as JSON gives them back
    :param source: where they are from, for the reader of the report
    :param tuned_steps: for how many steps they were made, ``None`` if they do not say
    """

    hyperparams: dict[str, Any]
    source: str
    tuned_steps: int | None = None


def label(algo: str) -> str:
    """
    :param algo: name of an algorithm
    :return: what it is called in tables and pictures
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
    :param env_id: environment
    :return: whether it can take the environment's actions
    """
    action_space = ALGORITHMS[algo].action_space if algo in ALGORITHMS else BASELINES.get(algo, spaces.Space)
    return isinstance(_spaces(env_id)[1], action_space)


def configuration(algo: str, env_id: str, defaults: bool, conf: Mapping[str, Path]) -> Configuration:
    """
    :param algo: name of an algorithm
    :param env_id: environment
    :param defaults: whether it is to have its own defaults
    :param conf: by algorithm, a file in RL Zoo's form that is to be taken instead
    :return: the entry of the environment in that file, or in RL Zoo's or this package's own, else the entry of the
        environment it is a form of (:data:`RELATED`), else the entry ``default`` there, else the algorithm's defaults
    :raises ValueError: if a file that was named has neither entry, or is none in RL Zoo's form
    :raises OSError: if it cannot be read
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
        raise ValueError(f"{path} must have an entry for each environment, as RL Zoo's files do")
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
