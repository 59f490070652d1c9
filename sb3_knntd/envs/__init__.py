"""
The paper's environments, and related ones. Importing this module registers them with gymnasium. If nothing imports it,
as in the processes of a SubprocVecEnv, use ``gymnasium.make("sb3_knntd.envs:sb3_knntd/MountainCar-v0")``.
"""

from __future__ import annotations

import gymnasium as gym

from sb3_knntd.envs.acrobot import AcrobotEnv
from sb3_knntd.envs.cart_pole import CartPoleEnv, ContinuousCartPoleEnv
from sb3_knntd.envs.cart_pole_swing_up import CartPoleSwingUpEnv
from sb3_knntd.envs.generalized_mountain_car import GeneralizedMountainCarEnv
from sb3_knntd.envs.mountain_car import MountainCarEnv

__all__ = [
    "AcrobotEnv",
    "CartPoleEnv",
    "CartPoleSwingUpEnv",
    "ContinuousCartPoleEnv",
    "GeneralizedMountainCarEnv",
    "MountainCarEnv",
]

# Id, class, step limit, and reward threshold: that of gymnasium's version if there is one, 80 % of the maximum return
# for the cart-pole's shaped reward, 70 % of it for the swing-up, and the competition's 150 steps for its Mountain-Car.
for _id, _entry_point, _steps, _solved in (
    ("sb3_knntd/MountainCar-v0", "sb3_knntd.envs.mountain_car:MountainCarEnv", 1000, -110.0),
    ("sb3_knntd/CartPole-v0", "sb3_knntd.envs.cart_pole:CartPoleEnv", 1000, 8000.0),
    ("sb3_knntd/ContinuousCartPole-v0", "sb3_knntd.envs.cart_pole:ContinuousCartPoleEnv", 1000, 8000.0),
    ("sb3_knntd/CartPoleSwingUp-v0", "sb3_knntd.envs.cart_pole_swing_up:CartPoleSwingUpEnv", 200, 140.0),
    ("sb3_knntd/Acrobot-v0", "sb3_knntd.envs.acrobot:AcrobotEnv", 500, -100.0),
    (
        "sb3_knntd/GeneralizedMountainCar-v0",
        "sb3_knntd.envs.generalized_mountain_car:GeneralizedMountainCarEnv",
        1000,
        -150.0,
    ),
):
    # gymnasium warns about registering an id twice, for example when the module is reloaded.
    if _id not in gym.registry:
        gym.register(_id, entry_point=_entry_point, max_episode_steps=_steps, reward_threshold=_solved)
