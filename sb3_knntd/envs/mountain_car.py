"""Mountain-Car: drive up a hill with an engine that is weaker than gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_knntd.common.checks import check_word
from sb3_knntd.envs.base import PaperEnv, State
from sb3_knntd.envs.rendering import BLUE, GREEN, GROUND, INK, ORANGE, SKY, STEEL, Canvas, turned

MIN_POSITION = -1.2
MAX_POSITION = 0.6
MAX_SPEED = 0.07
GOAL_POSITION = 0.5
FORCE = 0.001
GRAVITY = 0.0025


def mountain_car_step(state: tuple[float, float], action: int, force: float = FORCE) -> tuple[float, float]:
    """
    One step of the standard Mountain-Car (Sutton and Barto, "Reinforcement Learning", 2nd edition, example 10.1).

    The function can be compiled by numba.

    :param state: position in [-1.2, 0.6] and velocity in [-0.07, 0.07], position units per step
    :param action: 0, 1 or 2: push left, idle, push right
    :param force: velocity that a push adds, position units per step
    :return: the state after the step
    """
    position, velocity = state[0], state[1]
    velocity += force * (action - 1) - GRAVITY * math.cos(3.0 * position)
    velocity = min(max(velocity, -MAX_SPEED), MAX_SPEED)
    position = min(max(position + velocity, MIN_POSITION), MAX_POSITION)
    if position == MIN_POSITION and velocity < 0.0:
        velocity = 0.0
    return position, velocity


class MountainCarEnv(PaperEnv["int | np.integer[Any]"]):
    """
    ## Description

    A car starts in a valley. Its engine is weaker than gravity on the slopes, so it must first drive up the left hill
    to gain enough speed for the right one. This is the task of the paper's figure 3, which claims 105 steps per episode
    from episode 44 on. From the fixed start the shortest path takes 102 steps.

    `gymnasium`'s `MountainCar-v0` has the same dynamics, but other initial states and a limit of 200 steps.

    ## Action Space

    `Discrete(3)`

    | Num | Action               |
    |-----|----------------------|
    | 0   | engine pushes left   |
    | 1   | engine idles         |
    | 2   | engine pushes right  |

    ## Observation Space

    `Box` of shape `(2,)`, float32

    | Num | Observation | Min   | Max  | Unit                 |
    |-----|-------------|-------|------|----------------------|
    | 0   | position    | -1.2  | 0.6  | length               |
    | 1   | velocity    | -0.07 | 0.07 | length per step      |

    ## Dynamics

    *v ← v + 0.001 (action - 1) - 0.0025 cos(3 x)*, clipped to [-0.07, 0.07]; then *x ← x + v*, clipped to [-1.2, 0.6].
    At the wall at -1.2 the velocity becomes 0.

    ## Rewards

    | `reward`           | each step | on reaching the goal |
    |--------------------|-----------|----------------------|
    | `"step"` (default) | -1        | -1                   |
    | `"goal"`           | 0         | 1                    |

    The `reward_threshold` is that of gymnasium's Mountain-Car, a mean return of -110 with `"step"`.

    ## Starting State

    | `start`             | position                | velocity                 |
    |---------------------|-------------------------|--------------------------|
    | `"fixed"` (default) | -0.5                    | 0                        |
    | `"uniform"`         | uniform in [-0.6, -0.4] | 0                        |
    | `"anywhere"`        | uniform in [-1.2, 0.5]  | uniform in [-0.07, 0.07] |
    | a state             | as given                | as given                 |

    ## Episode End

    1. Termination: position ≥ 0.5.
    2. Truncation, as registered: 1000 steps.

    ## Arguments

    | Parameter     | Type                | Default   | Description                                                    |
    |---------------|---------------------|-----------|----------------------------------------------------------------|
    | `start`       | str or 2 numbers    | `"fixed"` | initial state of the episodes                                  |
    | `reward`      | str                 | `"step"`  | reward function                                                |
    | `noise`       | number or 2 numbers | `0.0`     | observation noise: standard deviation / (Max - Min)            |
    | `render_mode` | str                 | `None`    | `"human"` or `"rgb_array"`                                     |

    `reset` takes `options={"state": (position, velocity)}`, or `{"low": ..., "high": ...}` for limits of the
    position. With noise, `info["state"]` is the true state.

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/MountainCar-v0", start="uniform", noise=0.02)

    ```

    ## Version History

    * v0: first version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    drawn_dimensions: ClassVar[slice] = slice(0, 1)

    def __init__(
        self,
        start: str | Sequence[float] = "fixed",
        reward: str = "step",
        noise: float | Sequence[float] = 0.0,
        render_mode: str | None = None,
    ) -> None:
        check_word("reward", reward, ("step", "goal"))
        super().__init__(
            observation_space=spaces.Box(
                np.array([MIN_POSITION, -MAX_SPEED], dtype=np.float32),
                np.array([MAX_POSITION, MAX_SPEED], dtype=np.float32),
            ),
            ranges=(MAX_POSITION - MIN_POSITION, 2.0 * MAX_SPEED),
            starts={
                "fixed": ((-0.5, 0.0), (-0.5, 0.0)),
                "uniform": ((-0.6, 0.0), (-0.4, 0.0)),
                "anywhere": ((MIN_POSITION, -MAX_SPEED), (GOAL_POSITION, MAX_SPEED)),
            },
            start=start,
            noise=noise,
            render_mode=render_mode,
        )
        self.action_space = spaces.Discrete(3)
        self.reward = reward
        self._push = 0

    def step(self, action: int | np.integer[Any]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: 0, 1 or 2
        :return: observation, reward, terminated, truncated (never), info
        :raises ValueError: if the action is invalid
        """
        state = self._known_state()
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0, 1 or 2; got {action!r}")
        self._push = int(action) - 1
        self.state = position, _ = mountain_car_step((state[0], state[1]), int(action))
        arrived = position >= GOAL_POSITION
        reward = float(arrived) if self.reward == "goal" else -1.0
        if self.render_mode == "human":
            self.render()
        return self._observe(), reward, arrived, False, self._info()

    def _on_reset(self) -> None:
        self._push = 0

    def _make_canvas(self, human: bool) -> Canvas:
        return mountain_car_canvas(human, self.metadata["render_fps"], "Mountain-Car")

    def _draw(self, canvas: Canvas, state: State) -> None:
        draw_mountain_car(canvas, state[0], self._push)


def mountain_car_canvas(human: bool, fps: int, caption: str) -> Canvas:
    """
    :param human: whether to open a window
    :param fps: maximum frame rate of the window
    :param caption: title of the window
    :return: a canvas that shows the whole valley, for :func:`draw_mountain_car`
    """
    return Canvas((600, 400), (-0.32, 0.62), 600 / 2.1, human=human, fps=fps, caption=caption)


def draw_mountain_car(canvas: Canvas, position: float, push: int) -> None:
    """
    :param canvas: from :func:`mountain_car_canvas`
    :param position: position of the car, in [-1.2, 0.6]
    :param push: -1, 0 or 1: push left, idle, push right
    """
    canvas.fill(SKY)
    places = np.linspace(-1.4, 0.8, 147).tolist()
    ridge = [(x, _height(x)) for x in places]
    canvas.polygon([(places[0], -1.0), *ridge, (places[-1], -1.0)], GROUND)
    canvas.path(ridge, 0.012, STEEL)

    wall = MIN_POSITION - 0.12
    canvas.bar((wall, _height(wall)), (wall, _height(wall) + 0.16), 0.025, INK)

    top = _height(GOAL_POSITION) + 0.25
    canvas.bar((GOAL_POSITION, _height(GOAL_POSITION)), (GOAL_POSITION, top), 0.012, INK)
    canvas.polygon([(GOAL_POSITION, top), (GOAL_POSITION + 0.12, top - 0.04), (GOAL_POSITION, top - 0.08)], GREEN)

    slope = math.atan(_slope(position))
    ground = (position, _height(position))
    body = [(-0.11, 0.04), (0.11, 0.04), (0.11, 0.08), (0.06, 0.1), (0.03, 0.16), (-0.06, 0.16), (-0.1, 0.1)]
    canvas.polygon(turned(body, slope, ground), BLUE)
    for wheel in turned([(-0.065, 0.038), (0.065, 0.038)], slope, ground):
        canvas.circle(wheel, 0.034, INK)
        canvas.circle(wheel, 0.013, GROUND)
    if push:
        tail, tip = turned([(0.0, 0.21), (0.14 * push, 0.21)], slope, ground)
        canvas.arrow(tail, tip, 0.014, ORANGE)


def _height(position: float) -> float:
    return 0.55 + 0.45 * math.sin(3.0 * position)


def _slope(position: float) -> float:
    return 1.35 * math.cos(3.0 * position)
