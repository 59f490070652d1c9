"""
Correct a learned table by hand: forbid an action in a region, and set values at states.

    python examples/correct_table.py correct_table.png

The table has learned Mountain-Car. Then pushing towards the wall on the left is forbidden, and where the car rolls
right through the valley, pushing right is made the best action.
"""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np

from sb3_knntd import KNNTD
from sb3_knntd.plots import new_figure, plot_value_function


def drive(model):
    """
    :param model: a model of Mountain-Car
    :return: the number of steps to the goal from the bottom of the valley, and the leftmost position
    """
    env = gym.make("MountainCar-v0")
    env.reset(seed=0)
    env.unwrapped.state = np.array([-0.5, 0.0])
    observation, over, positions = np.array([-0.5, 0.0], np.float32), False, []
    while not over:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        positions.append(observation[0])
        over = terminated or truncated
    return len(positions), min(positions)


def main():
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "correct_table.png")
    model = KNNTD("MountainCar-v0", seed=0).learn(30_000)
    figure = new_figure(9.5, 10.0)
    panels = figure.subplots(3, 2, sharex=True, sharey=True)

    def show(row, title):
        plot_value_function(model, axes=panels[row])
        panels[row, 1].set_title(title)
        steps, leftmost = drive(model)
        print(f"{title}: {steps} steps, leftmost position {leftmost:.2f}")

    show(0, "as learned")
    model.policy.forbid(0, {0: (-np.inf, -0.9)})
    show(1, "pushing left is forbidden left of -0.9")
    states = np.random.default_rng(0).uniform([-0.7, 0.01], [-0.3, 0.04], (300, 2)).astype(np.float32)
    best = model.policy.q_values(states).max(dim=1).values.numpy()
    model.policy.set_q(states, 2, best + 5.0)
    show(2, "pushing right is worth 5 more than the best")
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
