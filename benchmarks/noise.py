"""
Noise reduction by the δs filter, its overhead, and its effect on learning.

    python -m benchmarks.noise [--seeds 10] [--first-seed 100] [--only TABLE ...] [--json FILE]

Observations have Gaussian noise with a standard deviation of 3 % of each dimension's range: that of the observation
space where it is finite, and -3 to 3 for CartPole's velocities.

``rmse``      error of the estimates divided by that of the observations, by dimension, while a fixed controller acts on
              the true state: over the last 10,000 of 60,000 steps; for the filter, the unmodified Algorithm 5, and an
              extended Kalman filter that knows the dynamics and the noise
``soon``      the same after fewer steps
``harmless``  returns without noise, with and without the filter: of the same controllers acting on the estimates, and
              of models trained on them
``learning``  returns of KNNTD with noise in training and evaluation, also as shares between random actions (0 %) and
              training without noise (100 %)
``dqn``       the same for DQN, which takes long
``time``      time of a step with and without the filter
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmarks.machine import describe
from sb3_knntd import DeltaFilter, VecDeltaFilter
from sb3_knntd.registry import ALGORITHMS, Role, with_role

#: Standard deviation of the noise divided by a dimension's range.
NOISE = 0.03
#: Number of learning steps of the filter, and of steps over which its error is measured afterwards.
LEARNING, EVALUATION = 50_000, 10_000
#: Numbers of learning steps of the table ``soon``.
SOON = (0, 5_000, 10_000, 20_000)
#: Settings of the unmodified Algorithm 5.
ALGORITHM_5 = {"learning_rate": 0.5, "gain": None, "warmup": 0.0}
EPISODES = 100


class NoisyObservation(gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """
    Adds Gaussian noise to observations, and stores the true ones.

    :param env: environment
    :param scale: standard deviations, shape (obs_dim,), observation units
    :param seed: seed of the noise
    """

    def __init__(self, env: gym.Env[np.ndarray, Any], scale: np.ndarray, seed: int) -> None:
        super().__init__(env)
        self.scale = scale
        self._random = np.random.default_rng(seed)
        #: The observation without noise.
        self.true = np.zeros(len(scale))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._blur(observation), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict]:
        observation, *rest = self.env.step(action)
        return self._blur(observation), *rest  # type: ignore[return-value]

    def _blur(self, observation: np.ndarray) -> np.ndarray:
        self.true = observation
        noise = self.scale * self._random.standard_normal(len(self.scale))
        return (observation + noise).astype(observation.dtype)


def drive(observation: np.ndarray) -> int:
    """Mountain-Car: push in the direction of motion."""
    return 2 if observation[1] >= 0 else 0


def balance(observation: np.ndarray) -> int:
    """CartPole: push in the direction in which the pole falls, and keep the cart near the centre."""
    return int(np.dot([0.3, 0.6, 8.0, 1.6], observation) > 0)


def swing_up(observation: np.ndarray) -> np.ndarray:
    """Pendulum: pump energy until it is near the top, then hold it there."""
    cosine, sine, velocity = observation
    energy = velocity**2 / 6 + 5 * (cosine - 1)
    if cosine > 0.85 and abs(velocity) < 3:
        torque = -12 * np.arctan2(sine, cosine) - 2.5 * velocity
    elif abs(velocity) < 0.01:
        torque = 2.0
    else:
        torque = -4 * np.sign(velocity) * np.sign(energy) if abs(energy) > 0.3 else 0.0
    return np.clip([torque], -2, 2).astype(np.float32)


def angle_of(observation: np.ndarray) -> np.ndarray:
    """Pendulum: the state of an observation."""
    return np.array([np.arctan2(observation[1], observation[0]), observation[2]])


def cosine_of(state: np.ndarray) -> np.ndarray:
    """Pendulum: the observation of a state."""
    return np.array([np.cos(state[0]), np.sin(state[0]), state[1]])


class Case(NamedTuple):
    """
    An environment and its properties.

    :param env_id: id of the environment
    :param names: names of the observation dimensions
    :param ranges: widths of the observation dimensions
    :param controller: a competent policy that maps true observations to actions
    :param algorithm: the algorithm trained on it
    :param state: maps an observation to the environment's state
    :param observe: maps a state to an observation
    :param remark: distinguishes cases with the same environment
    """

    env_id: str
    names: tuple[str, ...]
    ranges: tuple[float, ...]
    controller: Callable[[np.ndarray], Any]
    algorithm: str
    state: Callable[[np.ndarray], np.ndarray] = np.array
    observe: Callable[[Any], np.ndarray] = np.array
    remark: str = ""

    @property
    def scale(self) -> np.ndarray:
        """Standard deviations of the noise."""
        return NOISE * np.array(self.ranges)


CASES = [
    Case("MountainCar-v0", ("position", "velocity"), (1.8, 0.14), drive, "knntd"),
    Case("CartPole-v1", ("position", "velocity", "angle", "angular velocity"), (9.6, 6, 0.8378, 6), balance, "knntd"),
    Case(
        "Pendulum-v1",
        ("cosine", "sine", "angular velocity"),
        (2, 2, 16),
        swing_up,
        "exa",
        angle_of,
        cosine_of,
    ),
]

#: CartPole's observation space is twice as wide as the range of its episodes; this case has half of the noise.
NARROW = CASES[1]._replace(ranges=(4.8, 6, 0.4189, 6), remark=" (range of its episodes)")


class KalmanFilter(gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """
    An extended Kalman filter that knows the dynamics and the noise. Unlike the table, it does not know in which states
    the controller keeps the system.

    :param env: noisy environment
    :param case: properties of the environment
    """

    #: Variance of the process noise divided by that of the observation noise, to account for linearisation errors.
    PROCESS = 1e-4
    #: Step size of the finite differences that linearise the dynamics, as a share of a dimension's range.
    STEP = 1e-5

    def __init__(self, env: gym.Env[np.ndarray, Any], case: Case) -> None:
        super().__init__(env)
        self._case = case
        self._model: Any = gym.make(case.env_id).unwrapped
        self._model.reset()
        self._noise = np.diag(case.scale**2)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict]:
        observation, info = self.env.reset(**arguments)
        self._estimate, self._covariance = observation.astype(np.float64), self._noise
        return observation, info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict]:
        observation, *rest = self.env.step(action)
        steps = self.STEP * np.diag(self._case.ranges)
        jacobian = np.array(
            [
                (self._next(self._estimate + step, action) - self._next(self._estimate - step, action)) / 2 / step.sum()
                for step in steps
            ]
        ).T
        covariance = jacobian @ self._covariance @ jacobian.T + self.PROCESS * self._noise
        gain = covariance @ np.linalg.inv(covariance + self._noise)
        predicted = self._next(self._estimate, action)
        self._estimate = predicted + gain @ (observation - predicted)
        self._covariance = covariance - gain @ covariance
        return self._estimate, *rest  # type: ignore[return-value]

    def _next(self, observation: np.ndarray, action: Any) -> np.ndarray:
        self._model.state = self._case.state(observation)
        self._model.steps_beyond_terminated = None
        self._model.step(action)
        return self._case.observe(self._model.state)


def estimates(env: gym.Env[np.ndarray, Any], case: Case, seed: int, n_steps: int) -> Iterator[tuple[np.ndarray, ...]]:
    """
    Run the controller on the true state.

    :param env: filter around a :class:`NoisyObservation`
    :param case: properties of the environment
    :param seed: seed of the environment
    :param n_steps: number of steps
    :return: for each step the true observation and the estimate
    """
    noisy: Any = env.env
    env.reset(seed=seed)
    for _ in range(n_steps):
        estimate, _, terminated, truncated, _ = env.step(case.controller(noisy.true))
        yield noisy.true, estimate
        if terminated or truncated:
            env.reset()


def error_ratio(filter_name: str, case: Case, seed: int, learning: int = LEARNING) -> np.ndarray:
    """
    :param filter_name: ``"filter"``, ``"algorithm 5"`` or ``"kalman"``
    :param case: the environment and its properties
    :param seed: seed of environment and noise
    :param learning: number of learning steps before the measurement
    :return: root mean square error of the estimates divided by the standard deviation of the noise, shape (obs_dim,)
    """
    noisy = NoisyObservation(gym.make(case.env_id), case.scale, seed)
    if filter_name == "kalman":
        pairs = list(estimates(KalmanFilter(noisy, case), case, seed, EVALUATION))
    else:
        settings: dict[str, Any] = ALGORITHM_5 if filter_name == "algorithm 5" else {}
        pairs = list(estimates(DeltaFilter(noisy, **settings), case, seed, learning + EVALUATION))[learning:]
    true, estimated = np.array(pairs, dtype=np.float64).transpose(1, 0, 2)
    return np.sqrt(np.square(estimated - true).mean(axis=0)) / case.scale


def controller_return(case: Case, seed: int, filtered: bool) -> float:
    """
    :param case: the environment and its properties
    :param seed: seed of the environment
    :param filtered: whether the controller acts on the filter's estimates
    :return: mean return of the controller without noise, over the episodes after ``LEARNING`` steps
    """
    env = DeltaFilter(gym.make(case.env_id)) if filtered else gym.make(case.env_id)
    observation, _ = env.reset(seed=seed)
    returns, total, n_steps = [], 0.0, 0
    while len(returns) < EPISODES:
        observation, reward, terminated, truncated, _ = env.step(case.controller(observation))
        total += float(reward)
        n_steps += 1
        if terminated or truncated:
            observation, _ = env.reset()
            if n_steps >= LEARNING:
                returns.append(total)
            total = 0.0
    return float(np.mean(returns))


def make_noisy(case: Case, n_envs: int, seed: int, noise: bool) -> VecEnv:
    """
    :param case: the environment and its properties
    :param n_envs: number of environments
    :param seed: seed of environments and noise
    :param noise: whether to add noise
    :return: the environments
    """
    if not noise:
        return make_vec_env(case.env_id, n_envs, seed=seed)
    seeds = iter(range(1000 * seed, 1000 * seed + n_envs))
    return make_vec_env(
        case.env_id, n_envs, seed=seed, wrapper_class=lambda env: NoisyObservation(env, case.scale, next(seeds))
    )


def shown(algorithm: str) -> str:
    """
    :param algorithm: name of an algorithm, or of who acts in its place
    :return: what tables call it: an algorithm of this package by its class
    """
    if algorithm in with_role(Role.OWN):
        return ALGORITHMS[algorithm].load().__name__
    return algorithm.upper() if algorithm == "dqn" else algorithm


def learned_return(case: Case, seed: int, noise: bool, filtered: bool, algorithm: str) -> float:
    """
    :param case: the environment and its properties
    :param seed: seed of everything
    :param noise: whether observations have noise, in training and evaluation
    :param filtered: whether they are filtered, in training and evaluation
    :param algorithm: name of an algorithm of this package, ``"dqn"`` or ``"random"``, with its defaults
    :return: mean return after ``LEARNING`` training steps
    """
    th.set_num_threads(1)
    venv, evaluation = make_noisy(case, 1, seed, noise), make_noisy(case, 10, 10_000 + seed, noise)
    if filtered:
        venv = VecDeltaFilter(venv)
        evaluation = venv.for_evaluation(evaluation)
    if algorithm == "random":
        evaluation.action_space.seed(seed)
        return _random_return(evaluation)
    model: BaseAlgorithm
    if algorithm == "dqn":
        model = DQN("MlpPolicy", venv, seed=seed)
    else:
        model = ALGORITHMS[algorithm].load()(ALGORITHMS[algorithm].policy, venv, seed=seed)
    model.learn(LEARNING)
    mean, _ = evaluate_policy(model, evaluation, n_eval_episodes=EPISODES, deterministic=True)
    assert isinstance(mean, float)
    return mean


def _random_return(venv: VecEnv) -> float:
    returns: list[float] = []
    venv.reset()
    while len(returns) < EPISODES:
        _, _, _, infos = venv.step(np.array([venv.action_space.sample() for _ in range(venv.num_envs)]))
        returns += [info["episode"]["r"] for info in infos if "episode" in info]
    return float(np.mean(returns))


def step_times(case: Case, seed: int) -> tuple[float, float]:
    """
    :param case: the environment and its properties
    :param seed: seed of the environment
    :return: seconds of a step in a DummyVecEnv without and with the filter, the minimum of several measurements
    """
    times: list[list[float]] = [[], []]
    venvs = [DummyVecEnv([lambda: gym.make(case.env_id)]) for _ in range(2)]
    venvs[1] = VecDeltaFilter(venvs[1])
    for venv in venvs:
        venv.seed(seed)
        venv.reset()
    action = np.array([venvs[0].action_space.sample()])
    # Many short measurements, so that some are not disturbed by other processes.
    for _ in range(500):
        for index, venv in enumerate(venvs):
            begin = time.perf_counter()
            for _ in range(20):
                venv.step(action)
            times[index].append((time.perf_counter() - begin) / 20)
    return min(times[0]), min(times[1])


def spread(figures: list[float]) -> str:
    """
    :param figures: one value per seed
    :return: their median with the 10 % and 90 % quantiles
    """
    low, median, high = np.quantile(figures, (0.1, 0.5, 0.9))
    return f"{median:.3g} ({low:.3g} to {high:.3g})"


Row = dict[str, Any]


def rmse_table(pool: ProcessPoolExecutor, seeds: range) -> list[Row]:
    """Print and return the table ``rmse``; ``pool`` runs the seeds, as in the tables below."""
    print("| environment | dimension | noise | filter | Algorithm 5 | Kalman filter, dynamics known |")
    print("|---|---|---|---|---|---|")
    rows = []
    for case in (*CASES, NARROW):
        figures = {
            name: np.array(list(pool.map(error_ratio, [name] * len(seeds), [case] * len(seeds), seeds)))
            for name in ("filter", "algorithm 5", "kalman")
        }
        for dimension, name in enumerate(case.names):
            columns = " | ".join(spread(ratios[:, dimension]) for ratios in figures.values())
            print(f"| {case.env_id}{case.remark} | {name} | {case.scale[dimension]:.3g} | {columns} |", flush=True)
        ratios = {name: figure.tolist() for name, figure in figures.items()}
        rows.append({"environment": case.env_id + case.remark, **ratios})
    return rows


def soon_table(pool: ProcessPoolExecutor, seeds: range) -> list[Row]:
    """Print and return the table ``soon``."""
    print(f"| environment | dimension | {' | '.join(f'{learning:,}' for learning in SOON)} |")
    print("|---|---|" + "---|" * len(SOON))
    rows = []
    n = len(seeds)
    for case in CASES:
        figures = [
            np.array(list(pool.map(error_ratio, ["filter"] * n, [case] * n, seeds, [learning] * n)))
            for learning in SOON
        ]
        for dimension, name in enumerate(case.names):
            columns = " | ".join(spread(ratios[:, dimension]) for ratios in figures)
            print(f"| {case.env_id} | {name} | {columns} |", flush=True)
        rows.append({"environment": case.env_id, "filter": [ratios.tolist() for ratios in figures]})
    return rows


def harmless_table(pool: ProcessPoolExecutor, seeds: range) -> list[Row]:
    """Print and return the table ``harmless``."""
    print("| environment | agent | without filter | with filter |\n|---|---|---|---|")
    rows = []
    n = len(seeds)
    for case in CASES:
        algorithm = case.algorithm
        for who in ("controller", algorithm):
            figures = [
                list(pool.map(controller_return, [case] * n, seeds, [filtered] * n))
                if who == "controller"
                else list(pool.map(learned_return, [case] * n, seeds, [False] * n, [filtered] * n, [algorithm] * n))
                for filtered in (False, True)
            ]
            print(f"| {case.env_id} | {shown(who)} | {spread(figures[0])} | {spread(figures[1])} |", flush=True)
            rows.append({"environment": case.env_id, "who": who, "without": figures[0], "with": figures[1]})
    return rows


def learning_table(pool: ProcessPoolExecutor, seeds: range, algorithm: str) -> list[Row]:
    """Print and return the table ``learning`` or ``dqn``."""
    print("| environment | algorithm | random | no noise | noise | noise, filter | share without | share with |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    n = len(seeds)
    for case in CASES[:2]:
        figures = [
            list(pool.map(learned_return, [case] * n, seeds, [noise] * n, [filtered] * n, [who] * n))
            for who, noise, filtered in (
                ("random", False, False),
                (algorithm, False, False),
                (algorithm, True, False),
                (algorithm, True, True),
            )
        ]
        low, high, *reached = (statistics.median(returns) for returns in figures)
        # The share is undefined if nothing is learned without noise.
        shares = [f"{(value - low) / (high - low):.0%}" if high > low else "" for value in reached]
        print(f"| {' | '.join([case.env_id, shown(algorithm), *map(spread, figures), *shares])} |", flush=True)
        rows.append({"environment": case.env_id, "algorithm": algorithm, "returns": figures})
    return rows


def time_table(pool: ProcessPoolExecutor, seeds: range) -> list[Row]:
    """Print and return the table ``time``."""
    print("| environment | without, µs | with, µs |\n|---|---|---|")
    rows = []
    for case in CASES:
        bare, filtered = pool.submit(step_times, case, seeds[0]).result()
        print(f"| {case.env_id} | {1e6 * bare:.1f} | {1e6 * filtered:.1f} |", flush=True)
        rows.append({"environment": case.env_id, "without": bare, "with": filtered})
    return rows


TABLES: dict[str, Callable[[ProcessPoolExecutor, range], list[Row]]] = {
    "rmse": rmse_table,
    "soon": soon_table,
    "harmless": harmless_table,
    "learning": partial(learning_table, algorithm="knntd"),
    "dqn": partial(learning_table, algorithm="dqn"),
    "time": time_table,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=100, help="100 to 109 were not used to choose the defaults")
    parser.add_argument("--workers", type=int, help="number of processes")
    parser.add_argument("--only", nargs="+", choices=TABLES, metavar="TABLE", help=", ".join(TABLES))
    parser.add_argument("--json", metavar="FILE", help="also store the result of every seed")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    stored = {}
    with ProcessPoolExecutor(arguments.workers) as pool:
        for name in arguments.only or TABLES:
            stored[name] = TABLES[name](pool, seeds)
            print()
    print(
        f"Seeds {seeds[0]} to {seeds[-1]}, medians (10 % to 90 %). "
        + ", ".join(f"{key} {value}" for key, value in describe().items())
    )
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump({"machine": describe(), "tables": stored}, file, indent=1)


if __name__ == "__main__":
    main()
