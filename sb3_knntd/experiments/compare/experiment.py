"""Build models and environments from RL Zoo configurations."""

from __future__ import annotations

import argparse
import copy
import importlib
import tempfile
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from typing import Any

import rl_zoo3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd.experiments.compare.expressions import as_data
from sb3_knntd.registry import ALGORITHMS
from sb3_knntd.zoo import register
from sb3_knntd.zoo.experiment import KNNExperimentManager


def prepare(packages: Sequence[str] = ()) -> None:
    """
    Register all algorithms and environments in this process.

    :param packages: modules that register further environments
    :raises Exception: any exception of importing a package, such as ModuleNotFoundError
    """
    register()
    rl_zoo3.ALGOS.update({name: algorithm.load() for name, algorithm in ALGORITHMS.items()})
    for package in packages:
        importlib.import_module(package)


class Experiment(KNNExperimentManager):
    """
    RL Zoo's experiment manager with given hyperparameters, which stores no results.

    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param hyperparams: configuration in RL Zoo's format
    :param steps: number of environment steps, over which schedules run
    :param seed: seed of the model and its environments
    :param folder: folder for the files that RL Zoo writes
    """

    def __init__(self, algo: str, env_id: str, hyperparams: dict[str, Any], steps: int, seed: int, folder: str) -> None:
        super().__init__(
            argparse.Namespace(),
            algo,
            env_id,
            folder,
            n_timesteps=steps,
            eval_freq=-1,
            seed=seed,
            verbose=0,
            device="cpu",
        )
        self._given = hyperparams

    def read_hyperparameters(self) -> tuple[dict[str, Any], OrderedDict[str, Any]]:
        """
        :return: the given configuration, for preprocessing and for storage
        :raises ValueError: if it contains code
        """
        hyperparams = as_data(copy.deepcopy(self._given)) | {"n_timesteps": self.n_timesteps}
        self.eval_env_kwargs = hyperparams.get("env_kwargs", {})
        return hyperparams, OrderedDict(sorted(self._given.items()))

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        :param n_envs: number of environments
        :param eval_env: whether they are for evaluation
        :param no_log: not used; writing a monitor file would add to the learning time
        :return: the environments with the wrappers of the configuration
        """
        return super().create_envs(n_envs, eval_env, no_log=True)


@contextmanager
def experiment(
    algo: str, env_id: str, hyperparams: dict[str, Any], steps: int, seed: int
) -> Iterator[tuple[Experiment, BaseAlgorithm, list[BaseCallback]]]:
    """
    Build the model and environments of a run. Call :func:`prepare` first.

    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param hyperparams: configuration in RL Zoo's format
    :param steps: number of environment steps, over which schedules run
    :param seed: seed of the model and its environments
    :return: the experiment, its model, and the callbacks of the configuration
    """
    # RL Zoo prints and stores what it builds.
    with tempfile.TemporaryDirectory() as folder:
        with redirect_stdout(StringIO()):
            manager = Experiment(algo, env_id, hyperparams, steps, seed, folder)
            built = manager.setup_experiment()
        assert built is not None
        model, _ = built
        try:
            yield manager, model, manager.callbacks
        finally:
            assert model.env is not None
            model.env.close()
