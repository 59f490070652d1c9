"""
The search space of ``train --optimize``: for each algorithm a sampler, and a converter from a study's values to
arguments.

The values of a study are numbers and strings. Most have a log scale: 1 - γ and 1 - λ instead of γ and λ, the number of
points per dimension, and the bandwidth in lattice spacings, which makes it independent of the lattice.

If a configuration gives the points per dimension, a study keeps them as prior knowledge; likewise the spacing of points
that grow, and action points.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import optuna
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule

from sb3_knntd.zoo.schedules import with_schedules

Params = dict[str, Any]
Sampler = Callable[[optuna.Trial, int, int, dict[str, Any]], Params]


class SearchSpace(NamedTuple):
    """
    What is searched for an algorithm.

    :param sample: from a trial with the user attributes that it needs to arguments of the algorithm
    :param convert: from values of a study to arguments as a configuration has them
    """

    sample: Sampler
    convert: Callable[[Params], Params]


#: Trial attribute: number of observation dimensions, 0 for finite states, which have no lattice.
OBS_DIM = "obs_dim"

#: Trial attribute: total number of points if the configuration gives them per dimension, otherwise 0.
KEPT_POINTS = "kept_points"

#: Trial attribute: whether the configuration gives the action points per dimension.
KEEPS_ACTION_POINTS = "keeps_action_points"

#: Trial attribute: whether the configuration gives the spacing of points that grow.
KEEPS_SPACING = "keeps_spacing"

#: Approximate largest number of points of a searched lattice, in total and per dimension.
MOST_POINTS = 20_000
MOST_POINTS_PER_DIMENSION = 40

#: Searched spacings of points that grow, scaled units.
SPACINGS = ("auto", 0.04, 0.06, 0.09, 0.13, 0.2, 0.3, 0.45)


def sample_knntd_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    :param trial: trial with the user attributes of :func:`attributes`
    :param n_actions: not used
    :param n_envs: not used
    :param additional_args: not used
    :return: arguments of :class:`~sb3_knntd.KNNTD`
    """
    params = _sample_common(trial)
    params["target"] = trial.suggest_categorical("target", ["sarsa", "q_learning", "expected_sarsa"])
    params["exploration"] = trial.suggest_categorical("exploration", ["epsilon_greedy", "softmax"])
    params["initial_temperature"] = trial.suggest_float("initial_temperature", 0.01, 100.0, log=True)
    return _arguments(trial, convert_knntd_params(params))


def convert_knntd_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: values of a study of :class:`~sb3_knntd.KNNTD`
    :return: arguments in the format of a configuration
    """
    params = _convert_common(sampled_params)
    # Softmax should end nearly greedy, like ε-greedy.
    temperature = params.pop("initial_temperature")
    params["temperature"] = f"lin_{temperature}_{temperature / 100}"
    return params


def sample_exa_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    :param trial: trial with the user attributes of :func:`attributes`
    :param n_actions: not used
    :param n_envs: not used
    :param additional_args: not used
    :return: arguments of :class:`~sb3_knntd.ExA`
    """
    params = _sample_common(trial)
    if not trial.user_attrs[KEEPS_ACTION_POINTS]:
        params["action_points"] = trial.suggest_int("action_points", 2, 15, log=True)
    params["exploration"] = trial.suggest_categorical("exploration", ["shared", "per_neighbor"])
    params["exploration_hold"] = trial.suggest_float("exploration_hold", 1.0, 50.0, log=True)
    return _arguments(trial, convert_exa_params(params))


def convert_exa_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: values of a study of :class:`~sb3_knntd.ExA`
    :return: arguments in the format of a configuration
    """
    return _convert_common(sampled_params)


def sample_dyna_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    :param trial: trial with the user attributes of :func:`attributes`
    :param n_actions: number of action dimensions, 0 for Discrete actions
    :param n_envs: not used
    :param additional_args: not used
    :return: arguments of :class:`~sb3_knntd.KNNDyna`
    """
    params: Params = {
        "learning_rate": trial.suggest_float("learning_rate", 0.02, 1.0, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.1, log=True),
        "one_minus_trace_decay": trial.suggest_float("one_minus_trace_decay", 0.01, 1.0, log=True),
        "simulated_steps": trial.suggest_int("simulated_steps", 10, 1000, log=True),
        "optimism": trial.suggest_float("optimism", 0.0, 10.0),
    }
    if trial.user_attrs[OBS_DIM] and not trial.user_attrs[KEEPS_SPACING]:
        params["spacing"] = trial.suggest_categorical("spacing", SPACINGS)
    if n_actions and not trial.user_attrs[KEEPS_ACTION_POINTS]:
        params["action_points"] = trial.suggest_int("action_points", 2, 9)
    return _arguments(trial, convert_dyna_params(params))


def convert_dyna_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: values of a study of :class:`~sb3_knntd.KNNDyna`
    :return: arguments in the format of a configuration
    """
    return _convert_complements(sampled_params)


def _sample_common(trial: optuna.Trial) -> Params:
    """Sample what KNNTD and ExA share, all of it in every trial, as multivariate samplers require."""
    params: Params = {
        "initial_learning_rate": trial.suggest_float("initial_learning_rate", 0.05, 1.0, log=True),
        "final_learning_rate_share": trial.suggest_float("final_learning_rate_share", 0.01, 1.0, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True),
        "one_minus_trace_decay": trial.suggest_float("one_minus_trace_decay", 0.01, 1.0, log=True),
        "traces": trial.suggest_categorical("traces", ["replacing", "accumulating"]),
        "initial_value_sign": trial.suggest_categorical("initial_value_sign", [-1, 0, 1]),
        "initial_value_size": trial.suggest_float("initial_value_size", 0.1, 1000.0, log=True),
        # Down to almost 0: if rewards are negative, a table of zeros is optimistic and explores by itself.
        "exploration_initial_eps": trial.suggest_float("exploration_initial_eps", 0.001, 1.0, log=True),
        "exploration_fraction": trial.suggest_float("exploration_fraction", 0.1, 1.0),
    }
    obs_dim: int = trial.user_attrs[OBS_DIM]
    kept_points: int = trial.user_attrs[KEPT_POINTS]
    if kept_points:
        params["bandwidth"] = trial.suggest_float("bandwidth", 0.05, 2.0, log=True)
        most_neighbors = kept_points
    elif obs_dim:
        most = max(3, min(MOST_POINTS_PER_DIMENSION, int(MOST_POINTS ** (1 / obs_dim))))
        fewest = min(5, most - 1)
        params["points_per_dimension"] = trial.suggest_int("points_per_dimension", fewest, most, log=True)
        params["bandwidth_in_spacings"] = trial.suggest_float("bandwidth_in_spacings", 0.5, 10.0, log=True)
        most_neighbors = fewest**obs_dim
    if obs_dim:
        params["n_neighbors"] = trial.suggest_int("n_neighbors", 1, min(8 * obs_dim, most_neighbors), log=True)
        params["weights"] = trial.suggest_categorical("weights", ["inverse_quadratic", "gaussian"])
    return params


def _convert_complements(sampled_params: Params) -> Params:
    params = dict(sampled_params)
    params["gamma"] = 1 - params.pop("one_minus_gamma")
    params["trace_decay"] = 1 - params.pop("one_minus_trace_decay")
    return params


def _convert_common(sampled_params: Params) -> Params:
    params = _convert_complements(sampled_params)
    learning_rate = params.pop("initial_learning_rate")
    params["learning_rate"] = f"lin_{learning_rate}_{learning_rate * params.pop('final_learning_rate_share'):.3g}"
    params["initial_value"] = params.pop("initial_value_sign") * params.pop("initial_value_size")
    if "points_per_dimension" in params:
        params["points"] = params.pop("points_per_dimension")
        # A lattice has a width of 2 in scaled units.
        params["bandwidth"] = params.pop("bandwidth_in_spacings") * 2 / (params["points"] - 1)
    return params


def attributes(obs_dim: int, configuration: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param obs_dim: number of observation dimensions, 0 for finite states
    :param configuration: arguments of the algorithm
    :return: user attributes of a trial that the samplers need
    """
    points = configuration.get("points", "auto")
    n_points = 0
    if np.ndim(points) == 1:
        n_points = math.prod(points)
    elif np.ndim(points) == 2:
        n_points = len(points)
    return {
        OBS_DIM: obs_dim,
        KEPT_POINTS: n_points,
        KEEPS_ACTION_POINTS: isinstance(configuration.get("action_points"), list),
        KEEPS_SPACING: not isinstance(configuration.get("spacing", "auto"), str),
    }


def study_values(algorithm: type[BaseAlgorithm], configuration: Mapping[str, Any]) -> Params:
    """
    Convert arguments to values of a study, the inverse of a converter.

    :param algorithm: an algorithm of this package
    :param configuration: arguments of the algorithm, schedules as functions; missing ones have their defaults
    :return: values of a study, and arguments that a study does not search
    """
    defaults = {name: parameter.default for name, parameter in inspect.signature(algorithm).parameters.items()}
    values = defaults | dict(configuration)
    rate = values["learning_rate"]
    if isinstance(rate, LinearSchedule):
        values |= {
            "initial_learning_rate": rate.start,
            "final_learning_rate_share": rate.end / rate.start if rate.start else 1.0,
        }
    else:
        values |= {"initial_learning_rate": rate, "final_learning_rate_share": 1.0}
    values["one_minus_gamma"] = 1 - values["gamma"]
    if isinstance(values["trace_decay"], float | int):
        values["one_minus_trace_decay"] = 1 - values["trace_decay"]
    if "initial_value" in values:
        values |= {
            "initial_value_sign": int(np.sign(values["initial_value"])),
            "initial_value_size": abs(values["initial_value"]),
        }
    if isinstance(values.get("points"), int):
        values["points_per_dimension"] = values["points"]
        values["bandwidth_in_spacings"] = values["bandwidth"] * (values["points"] - 1) / 2
    if "temperature" in values:
        temperature = values["temperature"]
        values["initial_temperature"] = temperature.start if isinstance(temperature, LinearSchedule) else temperature
    return values


def _arguments(trial: optuna.Trial, params: Params) -> Params:
    """Convert schedules to functions, and store converted arguments with the trial for reference."""
    for name in params.keys() - trial.params.keys():
        trial.set_user_attr(name, params[name])
    return with_schedules(params)


KNNTD_SEARCH_SPACE = SearchSpace(sample_knntd_params, convert_knntd_params)
EXA_SEARCH_SPACE = SearchSpace(sample_exa_params, convert_exa_params)
DYNA_SEARCH_SPACE = SearchSpace(sample_dyna_params, convert_dyna_params)
