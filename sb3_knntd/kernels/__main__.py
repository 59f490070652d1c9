"""Compile the kernels ahead of the first run: ``python -m sb3_knntd.kernels``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch as th

from sb3_knntd import KNNTD, DeltaFilter, ExA, KNNDyna


def main() -> None:
    """Learn, predict and filter one step with each type of table and of observations."""
    for env_id, dtype in (
        ("MountainCar-v0", th.float64),
        ("MountainCar-v0", th.float32),
        ("FrozenLake-v1", th.float64),
    ):
        model = KNNTD(env_id, policy_kwargs={"dtype": dtype}).learn(1)
        model.predict(np.asarray(model.observation_space.sample()), deterministic=True)
    ExA("MountainCarContinuous-v0").learn(1)
    # A few plans: the first one only lays the points.
    for env_id in ("MountainCar-v0", "MountainCarContinuous-v0", "FrozenLake-v1"):
        KNNDyna(env_id).learn(100)
    env = DeltaFilter(gym.make("MountainCar-v0"))
    env.reset()
    env.step(0)


if __name__ == "__main__":
    main()
