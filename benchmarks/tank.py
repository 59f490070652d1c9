"""
How well KNNDyna holds a level: the tanks of ``examples/tank_level.py``, beside their PI controller.

    python -m benchmarks.tank [--seeds 10] [--first-seed 100] [--steps 5000]

Each seed trains a model with the default settings. A line shows the mean distance from the set point, cm, over 20
episodes of other seeds, and that of the last 20 steps of an episode. The last line has the medians over the seeds.
"""

from __future__ import annotations

import argparse
import runpy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.machine import describe
from sb3_knntd import KNNDyna

EPISODES, LAST_STEPS, EVALUATION_SEED = 20, 20, 10_000


def distances(make_controller: Any) -> tuple[float, float]:
    """
    :param make_controller: returns an object with SB3's ``predict`` for each episode
    :return: the mean distance from the set point, and that of the last steps, cm
    """
    env = gym.make("Tank-v0")
    overall, last = [], []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=EVALUATION_SEED + episode)
        controller, costs, over = make_controller(), [], False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(controller.predict(observation)[0])
            costs.append(-float(reward))
            over = terminated or truncated
        overall.append(np.mean(costs))
        last.append(np.mean(costs[-LAST_STEPS:]))
    return float(np.mean(overall)), float(np.mean(last))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--steps", type=int, default=5000, help="number of training steps")
    arguments = parser.parse_args()
    example = runpy.run_path(str(Path(__file__).parent.parent / "examples" / "tank_level.py"))
    print("| controller | mean distance, cm | last 20 steps, cm |\n|---|---|---|")
    print("| PI | {:.2f} | {:.2f} |".format(*distances(example["PI"])), flush=True)
    rows = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        model = KNNDyna("Tank-v0", seed=seed).learn(arguments.steps)
        rows.append(distances(lambda model=model: model))
        print("| KNNDyna, seed {} | {:.2f} | {:.2f} |".format(seed, *rows[-1]), flush=True)
    print("| KNNDyna, median | {:.2f} | {:.2f} |".format(*np.median(rows, axis=0)))
    print(f"\n{arguments.steps:,} steps. " + ", ".join(f"{key} {value}" for key, value in describe().items()))


if __name__ == "__main__":
    main()
