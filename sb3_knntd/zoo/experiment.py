"""RL Zoo's experiment, with what it does differently for this package's algorithms."""

from __future__ import annotations

import argparse
import time
from typing import Any

import optuna
from gymnasium import spaces
from optuna.samplers import BaseSampler
from rl_zoo3.exp_manager import ExperimentManager
from sqlalchemy.exc import DBAPIError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd.registry import Role, with_role
from sb3_knntd.zoo.configuration_first import ConfigurationFirst
from sb3_knntd.zoo.schedules import with_schedules
from sb3_knntd.zoo.search_space import attributes, study_values

#: What a table and its traces are made for. As with a network's architecture, training goes on with what the saved
#: model has.
SHAPE = ("points", "bounds", "n_neighbors", "action_points", "action_table")

#: How often, and after how many seconds, a database is tried again.
DATABASE_RETRIES = 3
DATABASE_PAUSE = 1.0


class KNNExperimentManager(ExperimentManager):
    """
    RL Zoo's experiment manager, which with an algorithm of this package

    * takes its configuration from ``sb3_knntd.zoo_configs``,
    * reads schedules of all its arguments (:mod:`sb3_knntd.zoo.schedules`),
    * runs on the CPU, where the step is compiled, unless another device is named,
    * goes on training (``-i``) with the points and neighbours that the saved model has,
    * tries the configuration itself first in a study.

    With the algorithms of RL Zoo it is RL Zoo's.

    :param args: arguments of the command line, stored with the run
    :param algo: name of the algorithm
    :param arguments: RL Zoo's further ones, by position
    :param options: RL Zoo's further ones, by name
    """

    def __init__(self, args: argparse.Namespace, algo: str, *arguments: Any, **options: Any) -> None:
        self._own = with_role(Role.OWN).get(algo)
        self.obs_dim = 0
        if self._own:
            options["config"] = options.get("config") or str(self._own.config_path)
            if options.get("device", "auto") == "auto":
                options["device"] = "cpu"
        super().__init__(args, algo, *arguments, **options)

    # RL Zoo's is a static method; which schedules there are depends on the algorithm.
    def _preprocess_schedules(self, hyperparams: dict[str, Any]) -> dict[str, Any]:  # type: ignore[override]
        return with_schedules(hyperparams) if self._own else super()._preprocess_schedules(hyperparams)

    def _preprocess_action_noise(
        self, hyperparams: dict[str, Any], saved_hyperparams: dict[str, Any], env: VecEnv
    ) -> dict[str, Any]:
        # Here RL Zoo counts the actions for the search space.
        if isinstance(env.observation_space, spaces.Box):
            self.obs_dim = env.observation_space.shape[0]
        return super()._preprocess_action_noise(hyperparams, saved_hyperparams, env)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self._own:
            given = [name for name in SHAPE if name in (self.custom_hyperparams or {})]
            if given:
                raise ValueError(
                    f"{' and '.join(given)} cannot be given with -i: training goes on with what "
                    f"{self.trained_agent} has. Train a new agent without -i"
                )
            hyperparams = {name: value for name, value in hyperparams.items() if name not in SHAPE}
        return super()._load_pretrained_agent(hyperparams, env)

    def _create_sampler(self, sampler_method: str) -> BaseSampler:
        sampler = super()._create_sampler(sampler_method)
        if not self._own:
            return sampler
        return ConfigurationFirst(sampler, study_values(self._own.load(), self._hyperparams))

    def hyperparameters_optimization(self) -> None:
        """Search hyperparameters, alone or as one of several workers on a study."""
        if self.storage is not None and not self.storage.endswith(".log"):
            make_tables(self.storage)
        super().hyperparameters_optimization()

    def objective(self, trial: optuna.Trial) -> float:
        """
        :param trial: trial of a study
        :return: mean return of the last evaluation
        :raises optuna.TrialPruned: if others were better so far, or action values diverge
        """
        if not self._own:
            return super().objective(trial)
        for name, value in attributes(self.obs_dim, self._hyperparams).items():
            trial.set_user_attr(name, value)
        try:
            return super().objective(trial)
        except FloatingPointError as error:
            # As RL Zoo does with the errors that networks raise for it.
            print(error)
            raise optuna.TrialPruned from error


def make_tables(url: str) -> None:
    """
    Make Optuna's tables in a database, if they are not there.

    Optuna takes no lock for it: when several workers start at once on an empty database, all but one fail, and find
    the tables when they try again.

    :param url: the database, in SQLAlchemy's form
    :raises sqlalchemy.exc.DBAPIError: if the database cannot be used
    """
    for retries_left in reversed(range(DATABASE_RETRIES + 1)):
        try:
            optuna.storages.RDBStorage(url).remove_session()
            return
        except DBAPIError:
            if not retries_left:
                raise
            time.sleep(DATABASE_PAUSE)
