"""Compile all kernels ahead of the first run: ``python -m sb3_knntd.kernels``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env

import sb3_knntd.envs  # noqa: F401
from sb3_knntd import KNNTD, DeltaFilter, ExA, KNNDyna
from sb3_knntd.vec_envs import CompiledVecEnv


def main() -> None:
    """
    Learn, predict and filter one step with each type of table and of observations, and step the compiled environments.
    """
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
    for name in ("MountainCar", "CartPole", "ContinuousCartPole", "Acrobot"):
        venv = make_vec_env(f"sb3_knntd/{name}-v0", vec_env_cls=CompiledVecEnv)
        venv.reset()
        venv.step(np.array([venv.action_space.sample()]))


if __name__ == "__main__":
    main()
