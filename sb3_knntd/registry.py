"""The algorithms of this package, each stated once: what the command line, RL Zoo and comparisons know of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from gymnasium import spaces


class Role(Enum):
    """What an algorithm is for."""

    #: one that this package is for: offered by all commands
    OWN = "own"
    #: one to compare with: offered by ``compare``
    BASELINE = "baseline"
    #: the least that any algorithm should reach: in every comparison
    FLOOR = "floor"


@dataclass(frozen=True)
class Algorithm:
    """
    An algorithm. Classes are given by entry points, as in gymnasium's registry, and imported when they are asked for.

    :param name: its name on the command line
    :param entry_point: its class, ``"module:class"``
    :param label: its name in tables and pictures
    :param policy: name of its default policy
    :param action_space: the type of action spaces that it takes
    :param role: what it is for
    :param description: what the help says of it besides its name; empty for nothing
    :param config: file of its tuned settings in ``zoo_configs/``, in RL Zoo's form; ``None`` if it has none
    :param search_space: a :class:`~sb3_knntd.zoo.search_space.SearchSpace`, ``"module:name"``, for ``train --optimize``
        (extra ``[zoo]``); ``None`` if it has none
    :raises ValueError: if it is one of this package's own, and has no tuned settings or no search space
    """

    name: str
    entry_point: str
    label: str
    policy: str
    action_space: type[spaces.Space[Any]]
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
        """Where its tuned settings are, ``None`` if it has none."""
        return None if self.config is None else Path(str(files("sb3_knntd.zoo_configs") / self.config))


#: All that are registered, by name, in the order in which they are shown.
ALGORITHMS: dict[str, Algorithm] = {}


def register(algorithm: Algorithm) -> None:
    """
    Make an algorithm known to the command line, RL Zoo and comparisons.

    :param algorithm: the algorithm
    :raises ValueError: if there is another of its name
    """
    if algorithm.name in ALGORITHMS:
        raise ValueError(f"there is an algorithm {algorithm.name!r} already")
    ALGORITHMS[algorithm.name] = algorithm


def with_role(*roles: Role) -> dict[str, Algorithm]:
    """
    :param roles: one or several
    :return: the algorithms of these roles, by name
    """
    return {name: algorithm for name, algorithm in ALGORITHMS.items() if algorithm.role in roles}


def for_actions(action_space: spaces.Space[Any]) -> Algorithm:
    """
    :param action_space: of an environment
    :return: the first algorithm of this package that takes such actions; if none does, the first of all, which says so
        when it is made
    """
    own = list(with_role(Role.OWN).values())
    return next((algorithm for algorithm in own if isinstance(action_space, algorithm.action_space)), own[0])


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
