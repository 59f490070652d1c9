"""
Train on Mountain-Car with noisy sensors, with and without the δs filter, and plot the filtered signal of one episode.

    python examples/noisy_sensors.py noisy_sensors.png

The standard deviation of the noise is 3 % of the range of position and velocity. The filter knows neither the noise nor
the dynamics; it learns how the state changes while KNNTD learns to act.
"""

import sys
from pathlib import Path

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

import sb3_knntd.envs  # noqa: F401 - registers the environment
from sb3_knntd import KNNTD, VecDeltaFilter
from sb3_knntd.plots import BASELINE_COLOR, LINE_COLOR, new_figure

EPISODES = 50


def noisy_cars(n_envs: int, seed: int) -> VecEnv:
    """
    :param n_envs: number of environments
    :param seed: seed of their noise and initial states
    :return: Mountain-Cars with noisy observations
    """
    return make_vec_env("sb3_knntd/MountainCar-v0", n_envs, seed=seed, env_kwargs={"start": "uniform", "noise": 0.03})


def drive(model: KNNTD, venv: VecEnv) -> tuple[list[int], np.ndarray]:
    """
    :param model: the trained model
    :param venv: one environment, filtered or not
    :return: the lengths of some episodes; and for all their steps the estimate, the sensor reading and the true state,
        shape (n_steps, 3, 2)
    """
    lengths, rows = [0], []
    observation = venv.reset()
    while len(lengths) <= EPISODES:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, dones, infos = venv.step(action)
        lengths[-1] += 1
        if dones[0]:
            lengths.append(0)
        else:
            rows.append((observation[0], infos[0].get("raw_observation", observation[0]), infos[0]["state"]))
    return lengths[:-1], np.array(rows)


def main() -> None:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "noisy_sensors.png")
    steps = 50_000
    raw = KNNTD(noisy_cars(4, seed=0), seed=0).learn(steps)
    lengths, _ = drive(raw, noisy_cars(1, seed=1))
    print(f"without filter: {np.mean(lengths):.0f} steps to the goal")

    venv = VecDeltaFilter(noisy_cars(4, seed=0))
    filtered = KNNTD(venv, seed=0).learn(steps)
    lengths, rows = drive(filtered, venv.for_evaluation(noisy_cars(1, seed=1)))
    print(f"with filter: {np.mean(lengths):.0f} steps to the goal")
    estimated, sensed, truth = rows.transpose(1, 0, 2)
    remaining = np.sqrt(((estimated - truth) ** 2).mean(axis=0) / ((sensed - truth) ** 2).mean(axis=0))
    shares = "{:.2f} of position, {:.2f} of velocity".format(*remaining)
    print(f"error of the estimates relative to the sensors: {shares}")

    figure = new_figure(8.0, 5.0)
    first = slice(0, lengths[0] - 1)
    panels = figure.subplots(2, 1, sharex=True)
    for dimension, name in enumerate(("position", "velocity")):
        axes = panels[dimension]
        axes.plot(sensed[first, dimension], ".", color="0.65", label="sensors")
        axes.plot(truth[first, dimension], color=BASELINE_COLOR, linewidth=1.5, label="truth")
        axes.plot(estimated[first, dimension], color=LINE_COLOR, linewidth=1.5, label="estimate")
        axes.set_ylabel(name)
        axes.grid(color="0.92")
    panels[1].set_xlabel("step")
    panels[0].legend(frameon=False, ncols=3)
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
