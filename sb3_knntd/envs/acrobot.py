"""Acrobot: swing up a double pendulum with a motor only at the elbow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_knntd.common.checks import check_word
from sb3_knntd.envs.base import PaperEnv, State
from sb3_knntd.envs.rendering import BLUE, GREEN, INK, ORANGE, SKY, STEEL, Canvas, turned

GRAVITY = 9.8
LINK_LENGTH = 1.0
LINK_MASS = 1.0
LINK_CENTER = 0.5
LINK_INERTIA = 1.0
TIME_STEP = 0.2
MAX_ROTATION_1 = 4.0 * math.pi
MAX_ROTATION_2 = 9.0 * math.pi
GOAL_HEIGHT = 1.0

FULL_TURN = 2.0 * math.pi
#: Classical Runge-Kutta: for each stage its weight, and the fraction of a step to the next stage.
STAGES = ((1.0, 0.5), (2.0, 0.5), (2.0, 1.0), (1.0, 0.0))


def acrobot_step(
    state: tuple[float, float, float, float], action: int, nips: bool = False
) -> tuple[float, float, float, float]:
    """
    One step of 0.2 s of the Acrobot, by fourth-order Runge-Kutta.

    The equations are those of Sutton and Barto, "Reinforcement Learning", or with ``nips`` those printed in Sutton,
    "Generalization in reinforcement learning: successful examples using sparse coarse coding" (1996), which lack
    a term. The function can be compiled by numba.

    :param state: angle of the first link from the downward vertical and of the second link relative to the first, rad
        in [-π, π], and their angular velocities, rad/s in [-4π, 4π] and [-9π, 9π]
    :param action: 0, 1 or 2 for a torque of -1, 0 or 1 N m at the elbow
    :param nips: whether to use the equations of 1996
    :return: the state after the step
    """
    torque = action - 1.0
    inertia_2 = LINK_MASS * LINK_CENTER**2 + LINK_INERTIA
    inertia_1 = LINK_MASS * (LINK_CENTER**2 + LINK_LENGTH**2 + LINK_CENTER**2) + 2.0 * LINK_INERTIA
    coupling = LINK_MASS * LINK_LENGTH * LINK_CENTER
    angle_1, angle_2, rotation_1, rotation_2 = state[0], state[1], state[2], state[3]
    total_1, total_2, total_3, total_4 = 0.0, 0.0, 0.0, 0.0
    for weight, reach in STAGES:
        cos, sin = math.cos(angle_2), math.sin(angle_2)
        d_1 = inertia_1 + 2.0 * coupling * cos
        d_2 = inertia_2 + coupling * cos
        phi_2 = LINK_MASS * LINK_CENTER * GRAVITY * math.sin(angle_1 + angle_2)
        phi_1 = (
            -coupling * rotation_2 * (rotation_2 + 2.0 * rotation_1) * sin
            + LINK_MASS * (LINK_CENTER + LINK_LENGTH) * GRAVITY * math.sin(angle_1)
            + phi_2
        )
        moment = torque + d_2 / d_1 * phi_1 - phi_2
        if not nips:
            moment -= coupling * rotation_1 * rotation_1 * sin
        turn_2 = moment / (inertia_2 - d_2 * d_2 / d_1)
        turn_1 = -(d_2 * turn_2 + phi_1) / d_1

        total_1 += weight * rotation_1
        total_2 += weight * rotation_2
        total_3 += weight * turn_1
        total_4 += weight * turn_2
        span = reach * TIME_STEP
        # Update the angles first: their slope is the angular velocity before this stage changes it.
        angle_1, angle_2 = state[0] + span * rotation_1, state[1] + span * rotation_2
        rotation_1, rotation_2 = state[2] + span * turn_1, state[3] + span * turn_2

    angle_1 = state[0] + TIME_STEP / 6.0 * total_1
    angle_2 = state[1] + TIME_STEP / 6.0 * total_2
    rotation_1 = state[2] + TIME_STEP / 6.0 * total_3
    rotation_2 = state[3] + TIME_STEP / 6.0 * total_4
    return (
        angle_1 - FULL_TURN * round(angle_1 / FULL_TURN),
        angle_2 - FULL_TURN * round(angle_2 / FULL_TURN),
        min(max(rotation_1, -MAX_ROTATION_1), MAX_ROTATION_1),
        min(max(rotation_2, -MAX_ROTATION_2), MAX_ROTATION_2),
    )


def acrobot_height(state: tuple[float, float, float, float]) -> float:
    """
    :param state: as in :func:`acrobot_step`
    :return: height of the free end above the support, m in [-2, 2]
    """
    return -LINK_LENGTH * (math.cos(state[0]) + math.cos(state[0] + state[1]))


class AcrobotEnv(PaperEnv["int | np.integer[Any]"]):
    """
    ## Description

    Two links hang from a support. The motor at the joint between them is too weak to lift them directly. It must swing
    the free end above a line one link length above the support.

    `gymnasium`'s `Acrobot-v1` has the same dynamics, but its observations contain sines and cosines, six numbers
    instead of four. Here the observation is the state itself, which keeps a table over a grid small.

    ## Action Space

    `Discrete(3)`

    | Num | Action                        | Unit |
    |-----|-------------------------------|------|
    | 0   | torque of -1 at the elbow     | N m  |
    | 1   | no torque                     | N m  |
    | 2   | torque of 1 at the elbow      | N m  |

    ## Observation Space

    `Box` of shape `(4,)`, float32

    | Num | Observation                                     | Min  | Max | Unit  |
    |-----|-------------------------------------------------|------|-----|-------|
    | 0   | θ1, angle of the first link, 0 when it hangs    | -π   | π   | rad   |
    | 1   | θ2, angle of the second link from the first     | -π   | π   | rad   |
    | 2   | angular velocity of θ1                          | -4π  | 4π  | rad/s |
    | 3   | angular velocity of θ2                          | -9π  | 9π  | rad/s |

    ## Dynamics

    Links of 1 m and 1 kg, centres of mass in their middles, moments of inertia 1 kg m², gravity 9.8 m/s², one
    fourth-order Runge-Kutta step of 0.2 s. `dynamics="book"` uses the equations of Sutton and Barto's book, `"nips"`
    those of the paper of 1996, which lack a term.

    ## Rewards

    | `reward`           | each step | on reaching the goal |
    |--------------------|-----------|----------------------|
    | `"step"` (default) | -1        | 0                    |
    | `"goal"`           | 0         | 1                    |

    The `reward_threshold` is that of gymnasium's Acrobot, a mean return of -100 with `"step"`.

    ## Starting State

    | `start`             | state                                    |
    |---------------------|------------------------------------------|
    | `"fixed"` (default) | hanging at rest: (0, 0, 0, 0)            |
    | `"uniform"`         | each of the four uniform in [-0.1, 0.1]  |
    | a state             | as given                                 |

    ## Episode End

    1. Termination: the free end is more than 1 m above the support, -cos θ1 - cos(θ1 + θ2) > 1.
    2. Truncation, as registered: 500 steps.

    ## Arguments

    | Parameter     | Type                | Default   | Description                                                    |
    |---------------|---------------------|-----------|----------------------------------------------------------------|
    | `dynamics`    | str                 | `"book"`  | `"book"` or `"nips"`                                           |
    | `start`       | str or 4 numbers    | `"fixed"` | initial state of the episodes                                  |
    | `reward`      | str                 | `"step"`  | reward function                                                |
    | `noise`       | number or 4 numbers | `0.0`     | observation noise: standard deviation / (Max - Min)            |
    | `render_mode` | str                 | `None`    | `"human"` or `"rgb_array"`                                     |

    `reset` takes `options={"state": (θ1, θ2, dθ1, dθ2)}`, or `{"low": ..., "high": ...}` for limits of all four. With
    noise, `info["state"]` is the true state.

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/Acrobot-v0", start="uniform", dynamics="nips")

    ```

    ## Version History

    * v0: first version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 15}

    def __init__(
        self,
        dynamics: str = "book",
        start: str | Sequence[float] = "fixed",
        reward: str = "step",
        noise: float | Sequence[float] = 0.0,
        render_mode: str | None = None,
    ) -> None:
        check_word("dynamics", dynamics, ("book", "nips"))
        check_word("reward", reward, ("step", "goal"))
        limits = (math.pi, math.pi, MAX_ROTATION_1, MAX_ROTATION_2)
        high = np.array(limits, dtype=np.float32)
        super().__init__(
            observation_space=spaces.Box(-high, high),
            ranges=[2.0 * limit for limit in limits],
            starts={"fixed": ((0.0,) * 4, (0.0,) * 4), "uniform": ((-0.1,) * 4, (0.1,) * 4)},
            start=start,
            noise=noise,
            render_mode=render_mode,
        )
        self.action_space = spaces.Discrete(3)
        self.dynamics = dynamics
        self.reward = reward
        self._torque = 0

    def step(self, action: int | np.integer[Any]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: 0, 1 or 2
        :return: observation, reward, terminated, truncated (never), info
        :raises ValueError: if the action is invalid
        """
        angle_1, angle_2, rotation_1, rotation_2 = self._known_state()
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0, 1 or 2; got {action!r}")
        self._torque = int(action) - 1
        self.state = state = acrobot_step(
            (angle_1, angle_2, rotation_1, rotation_2), int(action), self.dynamics == "nips"
        )
        arrived = acrobot_height(state) > GOAL_HEIGHT
        reward = float(arrived) if self.reward == "goal" else float(arrived) - 1.0
        if self.render_mode == "human":
            self.render()
        return self._observe(), reward, arrived, False, self._info()

    def _on_reset(self) -> None:
        self._torque = 0

    def _fold(self, observed: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        observed[:2] -= FULL_TURN * np.round(observed[:2] / FULL_TURN)
        return observed

    def _make_canvas(self, human: bool) -> Canvas:
        return Canvas(
            (500, 500), (0.0, 0.0), 500 / 4.6, human=human, fps=self.metadata["render_fps"], caption="Acrobot"
        )

    def _draw(self, canvas: Canvas, state: State) -> None:
        canvas.fill(SKY)
        for dash in np.arange(-2.25, 2.2, 0.15).tolist():
            canvas.bar((dash, GOAL_HEIGHT), (dash + 0.08, GOAL_HEIGHT), 0.025, GREEN, rounded=False)
        # Angles are counter-clockwise from the downward vertical.
        elbow = turned([(0.0, -LINK_LENGTH)], state[0])[0]
        tip = turned([(0.0, -LINK_LENGTH)], state[0] + state[1], elbow)[0]
        canvas.polygon([(-0.3, 0.0), (0.3, 0.0), (0.3, 0.05), (-0.3, 0.05)], STEEL)
        canvas.bar((0.0, 0.0), elbow, 0.16, INK)
        canvas.bar(elbow, tip, 0.13, BLUE)
        canvas.circle((0.0, 0.0), 0.055, SKY)
        canvas.circle(elbow, 0.05, SKY)
        canvas.circle(tip, 0.035, SKY)
        if self._torque:
            arc = [
                (elbow[0] + 0.2 * math.cos(turn), elbow[1] + 0.2 * math.sin(turn))
                for turn in np.linspace(math.pi - 1.0, math.pi + 1.2, 16)[:: self._torque].tolist()
            ]
            canvas.path(arc[:-3], 0.03, ORANGE)
            ahead = (arc[-1][0] - arc[-4][0], arc[-1][1] - arc[-4][1])
            stretch = 0.12 / math.hypot(*ahead)
            canvas.arrow(arc[-4], (arc[-4][0] + stretch * ahead[0], arc[-4][1] + stretch * ahead[1]), 0.05, ORANGE)
