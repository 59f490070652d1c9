"""The algorithms stand in one table: what is in it is offered everywhere, and nothing is left out of it."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from inspect import isabstract
from pathlib import Path

import gymnasium as gym
import pytest
import rl_zoo3
import yaml
from gymnasium import spaces
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_knntd
from sb3_knntd.cli import main
from sb3_knntd.experiments.compare.command import Plan, choose_configurations
from sb3_knntd.experiments.compare.configurations import configuration, fits, is_own, label
from sb3_knntd.experiments.compare.experiment import prepare
from sb3_knntd.online_algorithm import OnlineAlgorithm
from sb3_knntd.registry import ALGORITHMS, Algorithm, Role, for_actions, register, with_role
from sb3_knntd.zoo.search_space import SearchSpace

#: One that a user might add: everything as KNNTD has it.
NEWCOMER = replace(ALGORITHMS["knntd"], name="newcomer", label="Newcomer(λ)", description="a new one")


@pytest.fixture
def newcomer() -> Iterator[str]:
    """The name of an algorithm that is registered for the length of a test."""
    register(NEWCOMER)
    yield NEWCOMER.name
    for table in (ALGORITHMS, rl_zoo3.ALGOS, HYPERPARAMS_SAMPLER, HYPERPARAMS_CONVERTER):
        table.pop(NEWCOMER.name, None)


def subclasses(root: type) -> set[type]:
    """The subclasses in this package that can be instantiated."""
    below = set().union(*map(subclasses, root.__subclasses__()))
    is_here = root.__module__.startswith("sb3_knntd.")
    return below | ({root} if is_here and not isabstract(root) else set())


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    return " ".join(capsys.readouterr().out.split())


def test_every_algorithm_and_every_configuration_is_registered() -> None:
    """A class or a file that is not registered would be offered nowhere."""
    for module in pkgutil.walk_packages(sb3_knntd.__path__, "sb3_knntd."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    registered = {algorithm.load() for algorithm in ALGORITHMS.values()}
    assert subclasses(OnlineAlgorithm) == registered
    packaged = {file.name for file in files("sb3_knntd.zoo_configs").iterdir() if file.name.endswith(".yml")}
    assert packaged - {"paper.yml"} == {algorithm.config for algorithm in ALGORITHMS.values() if algorithm.config}


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)
def test_what_is_registered_is_there_and_fits(algorithm: Algorithm) -> None:
    cls = algorithm.load()
    assert issubclass(cls, BaseAlgorithm)
    envs = [
        env for env in ("CartPole-v1", "Pendulum-v1") if isinstance(gym.make(env).action_space, algorithm.action_space)
    ]
    assert envs
    for env in envs:
        cls(algorithm.policy, env)
    if algorithm.config_path is not None:
        assert yaml.safe_load(algorithm.config_path.read_text(encoding="utf-8"))
    if algorithm.role is Role.OWN:
        assert isinstance(algorithm.load_search_space(), SearchSpace)


def test_compare_offers_what_is_registered(newcomer: str, tmp_path: Path) -> None:
    prepare()
    plan = Plan(["CartPole-v1"], [newcomer], range(1), 100, False, {}, {}, 1, 1, [], tmp_path)
    chosen = choose_configurations(plan, [newcomer])
    assert chosen["CartPole-v1", newcomer] == configuration("knntd", "CartPole-v1", False, {})
    assert (label(newcomer), is_own(newcomer)) == ("Newcomer(λ)", True)
    assert (fits(newcomer, "CartPole-v1"), fits(newcomer, "Pendulum-v1")) == (True, False)
    assert (fits("knndyna", "CartPole-v1"), fits("knndyna", "Pendulum-v1")) == (True, True)


def test_rl_zoo_trains_what_is_registered(newcomer: str, tmp_path: Path) -> None:
    arguments = ["train", "--algo", newcomer, "--env", "CartPole-v1", "-n", "50", "-f", str(tmp_path)]
    assert main([*arguments, "--eval-freq", "-1"]) == 0
    assert (tmp_path / newcomer / "CartPole-v1_1" / "CartPole-v1.zip").is_file()
    assert HYPERPARAMS_SAMPLER[newcomer] is HYPERPARAMS_SAMPLER["knntd"]
    assert HYPERPARAMS_CONVERTER[newcomer] is HYPERPARAMS_CONVERTER["knntd"]


def test_the_help_names_what_is_registered(newcomer: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = help_of("compare", capsys)
    assert (
        "knntd, exa, knndyna, sarsa (true online SARSA(λ) with tile coding), newcomer (a new one), and RL Zoo's"
        in words
    )
    assert newcomer in help_of("train", capsys)


def test_the_demo_takes_the_algorithm_that_fits() -> None:
    assert for_actions(spaces.Discrete(2)).name == "knntd"
    assert for_actions(spaces.Box(-1, 1)).name == "exa"
    # One that nothing fits is left to the first to refuse.
    assert for_actions(spaces.MultiBinary(2)).name == "knntd"
    assert list(with_role(Role.OWN)) == ["knntd", "exa", "knndyna"]


def test_a_mistake_in_registering_is_refused() -> None:
    with pytest.raises(ValueError, match="there is an algorithm 'knntd' already"):
        register(ALGORITHMS["knntd"])
    with pytest.raises(ValueError, match="newcomer: an algorithm of role OWN needs config and search_space"):
        replace(NEWCOMER, search_space=None)
    with pytest.raises(ValueError, match="random has no search space"):
        ALGORITHMS["random"].load_search_space()
