"""Registry of algorithms, used by the command line, RL Zoo and comparisons."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from gymnasium import spaces

from sb3_knntd.common.files import read_description


class Role(Enum):
    """The role of an algorithm in this package."""

    #: an algorithm of this package: available in all commands
    OWN = "own"
    #: an algorithm to compare with: available in ``compare``
    BASELINE = "baseline"
    #: a lower limit of performance: included in every comparison
    FLOOR = "floor"


@dataclass(frozen=True)
class Algorithm:
    """
    An algorithm. Its class is given by an entry point, as in gymnasium's registry, and imported on demand.

    :param name: its name on the command line
    :param entry_point: its class, ``"module:class"``
    :param label: its name in tables and figures
    :param policy: name of its default policy
    :param action_space: type of the supported action spaces, or several types
    :param role: its role in this package
    :param description: additional text in the help; may be empty
    :param config: file of its tuned hyperparameters in ``zoo_configs/``, in RL Zoo's format; ``None`` if it has none
    :param search_space: a :class:`~sb3_knntd.zoo.search_space.SearchSpace`, ``"module:name"``, for ``train --optimize``
        (extra ``[zoo]``); ``None`` if it has none
    :raises ValueError: if its role is ``OWN`` and ``config`` or ``search_space`` is missing
    """

    name: str
    entry_point: str
    label: str
    policy: str
    action_space: type[spaces.Space[Any]] | tuple[type[spaces.Space[Any]], ...]
    role: Role
    description: str = ""
    config: str | None = None
    search_space: str | None = None

    def __post_init__(self) -> None:
        if self.role is Role.OWN and not (self.config and self.search_space):
            raise ValueError(f"{self.name}: an algorithm of role OWN needs config and search_space")

    def load(self) -> type[Any]:
        """
        :return: its class, a subclass of SB3's ``BaseAlgorithm``
        """
        algorithm: type[Any] = _load(self.entry_point)
        return algorithm

    def load_search_space(self) -> Any:
        """
        :return: its :class:`~sb3_knntd.zoo.search_space.SearchSpace`
        :raises ValueError: if it has none
        """
        if self.search_space is None:
            raise ValueError(f"{self.name} has no search space")
        return _load(self.search_space)

    @property
    def config_path(self) -> Path | None:
        """Path of its tuned hyperparameters, ``None`` if it has none."""
        return None if self.config is None else Path(str(files("sb3_knntd.zoo_configs") / self.config))


#: All registered algorithms by name, in display order.
ALGORITHMS: dict[str, Algorithm] = {}


def register(algorithm: Algorithm) -> None:
    """
    Register an algorithm for the command line, RL Zoo and comparisons.

    :param algorithm: the algorithm
    :raises ValueError: if an algorithm of this name is already registered
    """
    if algorithm.name in ALGORITHMS:
        raise ValueError(f"there is an algorithm {algorithm.name!r} already")
    ALGORITHMS[algorithm.name] = algorithm


def with_role(*roles: Role) -> dict[str, Algorithm]:
    """
    :param roles: one or more roles
    :return: the algorithms with these roles, by name
    """
    return {name: algorithm for name, algorithm in ALGORITHMS.items() if algorithm.role in roles}


def for_actions(action_space: spaces.Space[Any]) -> Algorithm:
    """
    :param action_space: action space of an environment
    :return: the first algorithm of this package that supports the space; if none does, the first one, which raises an
        error with advice when it is created
    """
    own = list(with_role(Role.OWN).values())
    return next((algorithm for algorithm in own if isinstance(action_space, algorithm.action_space)), own[0])


def for_saved(path: str | Path) -> Algorithm:
    """
    :param path: a saved model, with or without ``.zip``
    :return: the algorithm of this package that it was saved by; nothing is unpickled to find out
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, or a model of another algorithm
    """
    own = {algorithm.entry_point.partition(":")[2]: algorithm for algorithm in with_role(Role.OWN).values()}
    name = read_description(path).get("algorithm")
    if name not in own:
        raise ValueError(f"{path} must hold a model of {', '.join(own)}; it holds one of {name or 'another algorithm'}")
    return own[name]


def _load(entry_point: str) -> Any:
    module, _, name = entry_point.partition(":")
    return getattr(import_module(module), name)


for _algorithm in (
    Algorithm(
        "knntd",
        "sb3_knntd.knntd:KNNTD",
        "kNN-TD(λ)",
        "KNNPolicy",
        spaces.Discrete,
        Role.OWN,
        config="knntd.yml",
        search_space="sb3_knntd.zoo.search_space:KNNTD_SEARCH_SPACE",
    ),
    Algorithm(
        "exa",
        "sb3_knntd.exa:ExA",
        "Ex⟨a⟩(λ)",
        "KNNPolicy",
        spaces.Box,
        Role.OWN,
        config="exa.yml",
        search_space="sb3_knntd.zoo.search_space:EXA_SEARCH_SPACE",
    ),
    Algorithm(
        "knndyna",
        "sb3_knntd.dyna:KNNDyna",
        "kNN-Dyna",
        "KNNPolicy",
        (spaces.Discrete, spaces.Box),
        Role.OWN,
        config="dyna.yml",
        search_space="sb3_knntd.zoo.search_space:DYNA_SEARCH_SPACE",
    ),
    Algorithm(
        "sarsa",
        "sb3_knntd.experiments.baselines.tile_sarsa:TileSarsa",
        "SARSA(λ), tiles",
        "TilePolicy",
        spaces.Discrete,
        Role.BASELINE,
        "true online SARSA(λ) with tile coding",
        config="sarsa.yml",
    ),
    Algorithm(
        "random",
        "sb3_knntd.experiments.baselines.random_agent:RandomAgent",
        "random",
        "RandomPolicy",
        spaces.Space,
        Role.FLOOR,
    ),
):
    register(_algorithm)
