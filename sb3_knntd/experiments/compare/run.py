"""One run: train an algorithm on an environment with one seed, and measure it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_knntd.distributed.jobs import stored_as
from sb3_knntd.experiments.compare.experiment import experiment, prepare
from sb3_knntd.experiments.compare.machine import machine, peak_memory, versions

#: Before the measurement another model of the same configuration is trained for this many steps or seconds, so that
#: everything is compiled and loaded. KNNTD may start to learn only after 1000 steps.
WARM_UP_STEPS = 1100
WARM_UP_SECONDS = 10.0


@stored_as("sb3_knntd.compare.run.run")
def run(
    env: str,
    algo: str,
    seed: int,
    steps: int,
    hyperparams: dict[str, Any],
    eval_points: int,
    eval_episodes: int,
    packages: Sequence[str] = (),
) -> dict[str, Any]:
    """
    Train and measure. Call it in a separate process, because memory is measured per process.

    :param env: id of the environment
    :param algo: name of the algorithm
    :param seed: seed of the model and its environments
    :param steps: number of environment steps, of all environments of the configuration together
    :param hyperparams: configuration in RL Zoo's format
    :param eval_points: number of evaluations, equally spaced, the last one after the last step
    :param eval_episodes: greedy episodes per evaluation, in separate environments with the same initial states at every
        point and for every algorithm
    :param packages: modules that register environments
    :return: at each evaluation ``steps``, mean ``returns`` and ``stds`` of the episodes, and ``seconds`` of learning so
        far (without evaluation); ``cpu_seconds`` of learning; ``start_seconds`` from building the model to its first
        steps; ``base_memory`` before and ``peak_memory`` after, and ``model_size`` of the saved file, bytes;
        ``versions`` and ``machine``
    """
    th.set_num_threads(1)
    prepare(packages)
    base_memory = peak_memory()
    begun = time.perf_counter()
    with experiment(algo, env, hyperparams, steps, seed) as (_, model, callbacks):
        model.learn(WARM_UP_STEPS, callback=[*callbacks, WarmUp()])
    start_seconds = time.perf_counter() - begun
    with experiment(algo, env, hyperparams, steps, seed) as (manager, model, callbacks):
        evaluation = manager.create_envs(eval_episodes, eval_env=True)
        recorder = Recorder(evaluation, steps, eval_points, eval_episodes, seed)
        model.learn(steps, callback=[*callbacks, recorder])
        evaluation.close()
        model_size = saved_size(model)
    return {
        "steps": recorder.steps,
        "returns": recorder.returns,
        "stds": recorder.stds,
        "seconds": recorder.seconds,
        "cpu_seconds": recorder.cpu_seconds,
        "start_seconds": start_seconds,
        "base_memory": base_memory,
        "peak_memory": peak_memory(),
        "model_size": model_size,
        "versions": versions(),
        "machine": machine(),
    }


def is_result(result: Any) -> bool:
    """
    :param result: content of a result file
    :return: whether it has the format of :func:`run`
    """
    try:
        points = [result[name] for name in ("steps", "returns", "stds", "seconds")]
        numbers = [result[n] for n in ("cpu_seconds", "start_seconds", "base_memory", "peak_memory", "model_size")]
        machine, packages = result["machine"], result["versions"]
        return (
            all(isinstance(part, list) and len(part) == len(points[0]) > 0 for part in points)
            and all(type(number) in (int, float) for part in [numbers, *points] for number in part)
            and all(number > 0 for number in [*result["steps"], *result["seconds"]])
            and all(type(version) is str for version in packages.values())
            and {"processor", "cores", "system"} <= set(machine)
        )
    except (TypeError, KeyError, AttributeError):
        return False


def saved_size(model: BaseAlgorithm) -> int:
    """
    :param model: a model
    :return: size of its saved file, bytes
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.zip"
        model.save(path)
        return path.stat().st_size


class WarmUp(BaseCallback):
    """Stops training when everything is compiled and loaded."""

    def _on_training_start(self) -> None:
        self._end = time.perf_counter() + WARM_UP_SECONDS

    def _on_step(self) -> bool:
        return self.num_timesteps < WARM_UP_STEPS and time.perf_counter() < self._end


class Recorder(BaseCallback):
    """
    Evaluates at equally spaced points with the clock stopped, and stops training at the last one.

    :param env: evaluation environments, with the wrappers of the training environments
    :param total_steps: the last evaluation point
    :param n_points: number of evaluation points
    :param n_episodes: episodes per evaluation
    :param seed: seed of the run, which determines the initial states of the episodes
    """

    def __init__(self, env: VecEnv, total_steps: int, n_points: int, n_episodes: int, seed: int) -> None:
        super().__init__()
        self._env = env
        self._total_steps, self._n_points, self._n_episodes = total_steps, n_points, n_episodes
        # Below 2^30, so that seed plus environment index is a valid seed.
        self._seed = int(np.random.SeedSequence(seed).generate_state(1)[0] >> 2)
        self.steps: list[int] = []
        self.returns: list[float] = []
        self.stds: list[float] = []
        self.seconds: list[float] = []
        self.cpu_seconds = 0.0
        self._elapsed = 0.0

    def _on_training_start(self) -> None:
        self._start_clock()

    def _on_step(self) -> bool:
        if not self._is_due():
            return True
        self._elapsed += time.perf_counter() - self._since
        self.cpu_seconds += time.process_time() - self._cpu_since
        # A step of several environments can pass several points at once.
        while self._is_due():
            self._evaluate()
        self._start_clock()
        return len(self.steps) < self._n_points

    def _is_due(self) -> bool:
        n_done = len(self.steps)
        return n_done < self._n_points and self.num_timesteps >= self._total_steps * (n_done + 1) // self._n_points

    def _start_clock(self) -> None:
        self._since, self._cpu_since = time.perf_counter(), time.process_time()

    def _evaluate(self) -> None:
        training = self.model.get_env()
        assert training is not None
        sync_envs_normalization(training, self._env)
        self._env.seed(self._seed)
        returns, _ = evaluate_policy(self.model, self._env, self._n_episodes, return_episode_rewards=True)
        self.steps.append(self.num_timesteps)
        self.returns.append(float(np.mean(returns)))
        self.stds.append(float(np.std(returns)))
        self.seconds.append(self._elapsed)
