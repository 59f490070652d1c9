"""Hyperparameters of a run in TensorBoard, next to its results."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.logger import HParam

from sb3_knntd.common.callback_dispatcher import BatchedCallback
from sb3_knntd.common.checks import check_verbose, shown

from .throttled import picture_formats, write

METRICS = ("rollout/ep_rew_mean", "rollout/ep_len_mean", "train/td_error", "train/visited_points", "time/fps")
#: Arguments that are not logged: they do not influence learning.
LEFT_OUT = {"self", "policy", "env", "policy_kwargs", "tensorboard_log", "verbose", "device", "_init_setup_model"}
#: Longer texts are truncated, characters: each is a column of a table.
LONGEST = 60


class HParamCallback(BatchedCallback):
    """
    Writes the hyperparameters of the model to TensorBoard's HParams when training begins. The metrics shown next to
    them are scalars that the run logs.

    .. code-block:: python

        for n_neighbors in (1, 4, 9):
            model = KNNTD("MountainCar-v0", n_neighbors=n_neighbors, tensorboard_log="logs")
            model.learn(50_000, callback=HParamCallback())

    :param metrics: names of the scalars; with EvalCallback, add ``"eval/mean_reward"``
    :param verbose: has no effect
    :raises ValueError: if an argument is invalid; when training begins, if the model does not log to TensorBoard
    """

    def __init__(self, metrics: Sequence[str] = METRICS, verbose: int = 0) -> None:
        super().__init__(check_verbose(verbose))
        is_several = isinstance(metrics, Sequence) and not isinstance(metrics, (str, bytes)) and len(metrics) > 0
        if not (is_several and all(isinstance(metric, str) for metric in metrics)):
            raise ValueError(f"metrics must be names of scalars, e.g. {METRICS[:2]}; got {shown(metrics)}")
        self.metrics = tuple(metrics)

    def _on_training_start(self) -> None:
        self.due_at = sys.maxsize
        outputs = picture_formats(self.logger)
        if not outputs:
            raise ValueError("HParamCallback writes to TensorBoard: give the model tensorboard_log")
        parameters = HParam(describe(self.model), dict.fromkeys(self.metrics, 0.0))
        write(outputs, "hparams", parameters, self.num_timesteps)

    def _on_step(self) -> bool:
        return True


def describe(model: Any) -> dict[str, bool | str | float | None]:
    """
    :param model: any SB3 algorithm
    :return: algorithm, environment, and the arguments of the model, as numbers and short texts
    """
    names = [name for name in inspect.signature(type(model).__init__).parameters if name not in LEFT_OUT]
    arguments = {name: getattr(model, name) for name in names if hasattr(model, name)} | (model.policy_kwargs or {})
    env = model.get_env()
    spec = None if env is None else env.get_attr("spec", 0)[0]
    return {
        "algorithm": type(model).__name__,
        "env": "unknown" if spec is None else spec.id,
        "n_envs": model.n_envs,
        **{name: _short(value) for name, value in arguments.items()},
    }


def _short(value: Any) -> bool | str | float | None:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.number):
        return float(value)
    array = np.asarray(value) if isinstance(value, np.ndarray | list | tuple) else None
    if array is not None and array.size > 8:
        return f"array of shape {array.shape}"
    name = getattr(value, "__name__", None)
    text = str(getattr(value, "value_schedule", value)) if name is None else name
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"
