"""
Level control of two tanks with a valve: a custom environment, continuous actions, and the step response of the learned
controller.

    python examples/tank_level.py tank_level.png

The valve feeds the upper tank, which drains into the lower one, which drains away (Torricelli's law). The goal is to
keep the level of the lower tank at a set point, which changes from episode to episode.
"""

import math
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_knntd import ExA
from sb3_knntd.plots import BASELINE_COLOR, LINE_COLOR, new_figure

SECONDS_PER_STEP = 2.0
STEPS = 100
EULER_STEPS = 4
G = 9.81  # m/s²
AREA = 0.02  # m², of either tank
OUTLET = 1.0e-4  # m², of either outlet times its discharge coefficient
PUMP = 2.0e-4  # m³/s, with the valve open
HEIGHT = 0.25  # m
LOWEST, HIGHEST = 0.05, 0.15  # set points, m


class TankEnv(gym.Env):
    """
    Observation: the levels of the upper and the lower tank and the set point, m. Action: the valve opening, from 0 to
    1. Reward: the negative distance of the lower level from the set point, cm.
    """

    def __init__(self):
        low, high = [0.0, 0.0, LOWEST], [HEIGHT, HEIGHT, HIGHEST]
        self.observation_space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
        self.action_space = spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        options = options or {}
        self.upper, self.lower = options.get("levels", self.np_random.uniform(0.0, HEIGHT, 2))
        self.set_point = options.get("set_point", self.np_random.uniform(LOWEST, HIGHEST))
        return self._observe(), {}

    def step(self, action):
        inflow = PUMP * float(np.clip(action[0], 0.0, 1.0))
        seconds = SECONDS_PER_STEP / EULER_STEPS
        for _ in range(EULER_STEPS):
            upper, lower = OUTLET * math.sqrt(2.0 * G * self.upper), OUTLET * math.sqrt(2.0 * G * self.lower)
            self.upper = min(max(self.upper + seconds * (inflow - upper) / AREA, 0.0), HEIGHT)
            self.lower = min(max(self.lower + seconds * (upper - lower) / AREA, 0.0), HEIGHT)
        reward = -100.0 * abs(self.lower - self.set_point)
        return self._observe(), reward, False, False, {}

    def _observe(self):
        return np.array([self.upper, self.lower, self.set_point], np.float32)


# A time limit truncates an episode. The target bootstraps there, as in a continuing task.
gym.register("Tank-v0", entry_point=TankEnv, max_episode_steps=STEPS)


class PI:
    """The standard controller for comparison, with gains from a grid search for the set points below."""

    GAIN = 15.0  # openings per m
    INTEGRAL_SECONDS = 30.0

    def __init__(self):
        self.integral = 0.0

    def predict(self, observation, deterministic=True):
        error = float(observation[2] - observation[1])
        opening = self.GAIN * error + self.integral
        if 0.0 < opening < 1.0:
            self.integral += self.GAIN * error * SECONDS_PER_STEP / self.INTEGRAL_SECONDS
        return np.clip([opening], 0.0, 1.0), None


def respond(controller, set_points):
    """
    :param controller: a model of Tank-v0, or another object with the same ``predict``
    :param set_points: one for every 100 steps, m
    :return: seconds, set point, level of the lower tank and valve opening at each step
    """
    env = TankEnv()
    observation, _ = env.reset(options={"levels": (0.0, 0.0), "set_point": set_points[0]})
    rows = []
    for step in range(STEPS * len(set_points)):
        env.set_point = observation[2] = set_points[step // STEPS]
        action, _ = controller.predict(observation, deterministic=True)
        observation, *_ = env.step(action)
        rows.append((step * SECONDS_PER_STEP, env.set_point, env.lower, action[0]))
    return np.transpose(rows)


def main():
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "tank_level.png")
    # Rewards are negative. With initial values of 0, actions that were never tried would look best.
    settings = {"points": (16, 16, 8), "gamma": 0.9, "trace_decay": 0.7, "initial_value": -50.0}
    model = ExA(gym.make("Tank-v0"), seed=0, **settings)
    model.learn(40_000)

    figure = new_figure(8.0, 4.8)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for name, controller, color in (("PI", PI(), BASELINE_COLOR), ("ExA", model, LINE_COLOR)):
        seconds, set_point, level, opening = respond(controller, [0.08, 0.14, 0.05, 0.11])
        distance = 100 * np.abs(level - set_point).mean()
        print(f"{name}: mean distance from the set point {distance:.2f} cm")
        above.plot(seconds, 100 * level, color=color, linewidth=1.8, label=name)
        below.plot(seconds, opening, color=color, linewidth=1)
    above.step(seconds, 100 * set_point, color="0.3", linestyle="--", linewidth=1.2, label="set point")
    above.set(ylabel="level of the lower tank (cm)")
    above.legend(frameon=False, ncols=3)
    below.set(xlabel="seconds", ylabel="valve opening")
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
