"""
The 2008 competition's generalised Mountain-Car: one configuration, that of ``zoo_configs/knntd.yml``, on many problems,
whose offsets, noise and dynamics the learner does not know.

    python -m benchmarks.competition [--problems 30] [--first-problem 0] [--workers N] [--json FILE]

Training on each problem lasts 100 episodes of at most 1000 steps, once with the δs filter and adaptive bounds, with
each of them alone, and with neither. The table shows the steps per episode, medians over the problems, and the share of
problems with a mean of at most 150 steps over the last ten episodes.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_knntd.envs  # noqa: F401
from benchmarks.learning import tuned_settings
from benchmarks.machine import describe
from sb3_knntd import KNNTD, VecDeltaFilter

ENV_ID = "sb3_knntd/GeneralizedMountainCar-v0"
EPISODES, MOST_STEPS = 100, 1000
#: Target for the mean number of steps, and number of final episodes that it is taken over.
WANTED_STEPS, LAST_EPISODES = 150, 10


class Variant(NamedTuple):
    """
    How the observations are processed.

    :param what: name in the table
    :param filtered: whether to use the δs filter
    :param bounds: bounds of learner and filter
    """

    what: str
    filtered: bool
    bounds: str | None


VARIANTS = (
    Variant("filter, adaptive bounds", True, "adaptive"),
    Variant("adaptive bounds", False, "adaptive"),
    Variant("filter", True, None),
    Variant("neither", False, None),
)


class CountEpisodes(BaseCallback):
    """
    Records the lengths of episodes, and stops training after a number of them.

    :param n_episodes: number of episodes
    """

    def __init__(self, n_episodes: int) -> None:
        super().__init__()
        self.n_episodes = n_episodes
        self.lengths: list[int] = []

    def _on_step(self) -> bool:
        self.lengths += [info["episode"]["l"] for info in self.locals["infos"] if "episode" in info]
        return len(self.lengths) < self.n_episodes


def settings() -> dict[str, Any]:
    """
    :return: the algorithm's arguments in ``zoo_configs/knntd.yml``
    """
    return {name: value for name, value in tuned_settings("knntd", ENV_ID).items() if name != "vec_env_wrapper"}


def learn(variant: Variant, problem: int) -> list[int]:
    """
    :param variant: how the observations are processed
    :param problem: number of the problem
    :return: steps of each episode
    """
    th.set_num_threads(1)
    venv: VecEnv = DummyVecEnv([lambda: Monitor(gym.make(ENV_ID, problem=problem, max_episode_steps=MOST_STEPS))])
    if variant.filtered:
        venv = VecDeltaFilter(venv, bounds=variant.bounds)
    model = KNNTD(venv, **{**settings(), "bounds": variant.bounds}, seed=problem)
    count = CountEpisodes(EPISODES)
    model.learn(EPISODES * MOST_STEPS, callback=count)
    return count.lengths


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=30, help="number of problems")
    parser.add_argument("--first-problem", type=int, default=0, help="problems 200 to 207 were used for tuning")
    parser.add_argument("--workers", type=int, help="number of processes, by default one per core")
    parser.add_argument("--json", metavar="FILE", help="also store the steps of all episodes")
    arguments = parser.parse_args()
    problems = range(arguments.first_problem, arguments.first_problem + arguments.problems)
    blocks = [(0, 10), (10, 20), (20, 50), (50, 90), (90, 100)]
    names = " | ".join(f"episodes {first + 1} to {end}" for first, end in blocks)
    print(f"| observations | {names} | at most {WANTED_STEPS} at the end |")
    print("|" + "---|" * (len(blocks) + 2))
    stored = {}
    with ProcessPoolExecutor(arguments.workers) as pool:
        for variant in VARIANTS:
            lengths = np.array(list(pool.map(learn, [variant] * len(problems), problems)))
            medians = " | ".join(f"{np.median(lengths[:, first:end].mean(axis=1)):.0f}" for first, end in blocks)
            share = (lengths[:, -LAST_EPISODES:].mean(axis=1) <= WANTED_STEPS).mean()
            print(f"| {variant.what} | {medians} | {share:.0%} of problems |", flush=True)
            stored[variant.what] = lengths.tolist()
    machine = ", ".join(f"{key} {value}" for key, value in describe().items())
    print(f"\nProblems {problems[0]} to {problems[-1]}. {machine}")
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump({"machine": describe(), "problems": list(problems), "lengths": stored}, file)


if __name__ == "__main__":
    main()
