"""
Position control of a DC motor that starts from a controller: it is never much worse, and better in the end.

    python examples/dc_motor.py dc_motor.png

The five voltages of a simple driver turn a shaft to a set angle. A proportional controller does that with overshoot.
"""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_knntd import KNNTD
from sb3_knntd.plots import BASELINE_COLOR, LINE_COLOR, new_figure

SECONDS_PER_STEP = 0.02
STEPS = 100
EULER_STEPS = 4
VOLTAGES = np.array([-12.0, -4.0, 0.0, 4.0, 12.0])  # V
TORQUE = 0.05  # Nm/V, over the resistance of the winding
BACK_EMF = 0.3  # V s/rad
FRICTION = 0.005  # Nm s/rad
STICTION = 0.02  # Nm
INERTIA = 0.005  # kg m²


class MotorEnv(gym.Env):
    """
    Observation: the angle from the set angle, rad, and the speed, rad/s. Action: one of five voltages. Reward: minus
    the square of the angle, and a little of that of the voltage.
    """

    def __init__(self):
        limits = np.array([np.pi, 20.0], np.float32)
        self.observation_space = spaces.Box(-limits, limits)
        self.action_space = spaces.Discrete(len(VOLTAGES))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.speed = (options or {}).get("state", self.np_random.uniform([-3.0, -2.0], [3.0, 2.0]))
        return self._observe(), {}

    def step(self, action):
        voltage = VOLTAGES[action]
        seconds = SECONDS_PER_STEP / EULER_STEPS
        for _ in range(EULER_STEPS):
            torque = TORQUE * (voltage - BACK_EMF * self.speed) - FRICTION * self.speed - STICTION * np.sign(self.speed)
            self.speed += seconds * torque / INERTIA
            self.angle += seconds * self.speed
        reward = -(self.angle**2) - 0.0005 * voltage**2
        return self._observe(), float(reward), False, False, {}

    def _observe(self):
        observation = np.array([self.angle, self.speed], np.float32)
        return np.clip(observation, self.observation_space.low, self.observation_space.high)


gym.register("DCMotor-v0", entry_point=MotorEnv, max_episode_steps=STEPS)


def proportional(observation):
    """The voltage nearest to 4 V for each rad from the set angle."""
    return int(np.abs(VOLTAGES + 4.0 * observation[0]).argmin())


def respond(act):
    """
    :param act: from an observation to an action
    :return: the angle at each step from 2 rad, rad
    """
    env = MotorEnv()
    observation, _ = env.reset(options={"state": (2.0, 0.0)})
    angles = []
    for _ in range(STEPS):
        angles.append(observation[0])
        observation, *_ = env.step(act(observation))
    return np.array(angles)


def main():
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "dc_motor.png")
    model = KNNTD(gym.make("DCMotor-v0"), seed=0)
    responses = {"controller": respond(proportional)}

    def greedy(observation):
        return int(model.predict(observation, deterministic=True)[0])

    model.imitate(proportional)
    responses["table that imitates it"] = respond(greedy)
    model.learn(50_000)
    responses["after learning"] = respond(greedy)

    figure = new_figure(7.0, 3.6)
    axes = figure.subplots()
    seconds = SECONDS_PER_STEP * np.arange(STEPS)
    styles = [(BASELINE_COLOR, "-"), (BASELINE_COLOR, ":"), (LINE_COLOR, "-")]
    for (name, angles), (color, line) in zip(responses.items(), styles, strict=True):
        print(f"{name}: mean squared angle {np.mean(angles**2):.3f} rad²")
        axes.plot(seconds, angles, line, color=color, linewidth=1.8, label=name)
    axes.axhline(0.0, color="0.3", linestyle="--", linewidth=1)
    axes.set(xlabel="seconds", ylabel="angle from the set angle (rad)")
    axes.legend(frameon=False)
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
