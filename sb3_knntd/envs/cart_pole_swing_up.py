"""Cart-pole swing-up: swing a hanging pole up by pushing its cart, and balance it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_knntd.common.checks import check_integer
from sb3_knntd.envs.base import PaperEnv, State
from sb3_knntd.envs.cart_pole import (
    JOINT_HEIGHT,
    UNLIMITED,
    Physics,
    cart_pole_step,
    checked_push,
    draw_cart_pole,
    draw_track,
)
from sb3_knntd.envs.rendering import SKY, Canvas

#: The cart-pole of PILCO (Deisenroth and Rasmussen, ICML 2011), a heavier pole than the standard one.
PILCO = Physics(
    gravity=9.82, cart_mass=0.5, pole_mass=0.5, half_length=0.3, max_force=10.0, friction=0.1, time_step=0.01
)
#: Largest distance of the cart from the centre, m.
TRACK = 2.4
#: The pole is up if the cosine of its angle is above this.
UPRIGHT = 0.9
#: Largest deviation of a random start from the pole hanging at rest in the centre: m, m/s, rad, rad/s.
START_RANGE = 0.1
#: Usual velocities of cart (m/s) and pole (rad/s, at the bottom after falling from the top); the noise is a share of
#: them.
USUAL_SPEED, USUAL_ROTATION = 4.0, 10.0


def swing_up_step(
    state: tuple[float, float, float, float], push: float, n_steps: int
) -> tuple[float, float, float, float]:
    """
    Some Euler steps of 0.01 s of PILCO's cart-pole with the same force.

    :param state: position (m), velocity (m/s), the pole's angle from upright (rad) and angular velocity (rad/s)
    :param push: force as a share of 10 N, in [-1, 1]; positive is to the right
    :param n_steps: number of Euler steps
    :return: the state after them
    """
    for _ in range(n_steps):
        state = cart_pole_step(state, push, PILCO)
    return state


def swing_up_reward(state: tuple[float, float, float, float]) -> float:
    """
    :param state: as in :func:`swing_up_step`, after the step
    :return: 1 with the pole upright and the cart in the centre, 0 with the pole hanging or the cart at an end
    """
    return 0.5 * (1.0 + math.cos(state[2])) * math.cos(0.5 * math.pi * state[0] / TRACK)


class CartPoleSwingUpEnv(PaperEnv["npt.NDArray[np.floating[Any]]"]):
    """
    ## Description

    A pole hangs from a cart. Pushing the cart to and fro swings the pole up, and then must balance it. The track is
    short: an episode ends where the cart leaves it.

    This is the usual five-dimensional form of the task, with the constants of PILCO's cart-pole (Deisenroth and
    Rasmussen, "PILCO: a model-based and data-efficient approach to policy search", ICML 2011) and the observation,
    reward, track and length of an episode of D. Ha's
    [estool](https://github.com/hardmaru/estool/blob/master/custom_envs/cartpole_swingup.py).

    ## Action Space

    `Box(-1, 1, (1,))`, float32: the force as a share of 10 N, positive to the right. Larger values are clipped.

    | Num | Action | Min | Max |
    |-----|--------|-----|-----|
    | 0   | force  | -1  | 1   |

    ## Observation Space

    `Box` of shape `(5,)`, float32

    | Num | Observation                     | Min  | Max  | Usual range | Unit  |
    |-----|---------------------------------|------|------|-------------|-------|
    | 0   | position of the cart            | -2.4 | 2.4  | ±2.4        | m     |
    | 1   | velocity of the cart            | none | none | ±4          | m/s   |
    | 2   | cosine of the angle, 1 upright  | -1   | 1    | ±1          |       |
    | 3   | sine of the angle, 1 at right   | -1   | 1    | ±1          |       |
    | 4   | angular velocity                | none | none | ±10         | rad/s |

    "None" is the largest float32. A position beyond its limit, as in the step that leaves the track, is clipped to the
    limit. `info["upright"]` tells whether the pole is up: whether the cosine of its angle is above 0.9.

    ## Dynamics

    Cart 0.5 kg, pole 0.5 kg and 0.6 m long, gravity 9.82 m/s², friction of 0.1 N s/m between cart and track. A step
    holds the force for `frame_skip` Euler steps of 0.01 s, by default for 0.05 s.

    ## Rewards

    (1 + cos *angle*) / 2 × cos(π *position* / 4.8), computed from the state after the step: 1 with the pole upright and
    the cart in the centre, 0 with the pole hanging or the cart at an end of the track. The maximum of a
    return is 200, and the `reward_threshold` a mean return of 140. A pole that is only kept turning gives some 120.

    ## Starting State

    | `start`               | state                                                                            |
    |-----------------------|----------------------------------------------------------------------------------|
    | `"uniform"` (default) | position, velocity, angle, angular velocity each within 0.1 of those of `"fixed"` |
    | `"fixed"`             | (0, 0, π, 0): the pole hangs at rest in the centre                               |
    | a state               | as given; angles from upright                                                    |

    ## Episode End

    1. Termination: the position is beyond ±2.4.
    2. Truncation, as registered: 200 steps, 10 s with the default `frame_skip`.

    ## Arguments

    | Parameter     | Type                | Default     | Description                                           |
    |---------------|---------------------|-------------|-------------------------------------------------------|
    | `start`       | str or 4 numbers    | `"uniform"` | initial state of the episodes                         |
    | `frame_skip`  | int ≥ 1             | `5`         | number of Euler steps of 0.01 s for each step         |
    | `noise`       | number or 5 numbers | `0.0`       | observation noise: standard deviation / usual width   |
    | `render_mode` | str                 | `None`      | `"human"` or `"rgb_array"`                            |

    `reset` takes `options={"state": (position, velocity, angle, angular velocity)}`, or `{"low": ..., "high": ...}`
    for limits of all four. With noise, `info["state"]` is the true state of four numbers.

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/CartPoleSwingUp-v0", start="fixed")

    ```

    ## Version History

    * v0: first version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}

    def __init__(
        self,
        start: str | Sequence[float] = "uniform",
        frame_skip: int = 5,
        noise: float | Sequence[float] = 0.0,
        render_mode: str | None = None,
    ) -> None:
        self.frame_skip = check_integer("frame_skip", frame_skip, 1)
        high = np.array([TRACK, UNLIMITED, 1.0, 1.0, UNLIMITED], dtype=np.float32)
        high_state = np.array([TRACK, UNLIMITED, UNLIMITED, UNLIMITED], dtype=np.float32)
        hanging: State = (0.0, 0.0, math.pi, 0.0)
        super().__init__(
            observation_space=spaces.Box(-high, high),
            ranges=(2.0 * TRACK, 2.0 * USUAL_SPEED, 2.0, 2.0, 2.0 * USUAL_ROTATION),
            starts={
                "uniform": (
                    tuple(number - START_RANGE for number in hanging),
                    tuple(number + START_RANGE for number in hanging),
                ),
                "fixed": (hanging, hanging),
            },
            start=start,
            noise=noise,
            render_mode=render_mode,
            state_space=spaces.Box(-high_state, high_state),
        )
        self.action_space = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
        self._push = 0.0

    def step(
        self, action: npt.NDArray[np.floating[Any]]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: the force as a share of 10 N, shape (1,)
        :return: observation, reward, terminated, truncated (never), info
        :raises ValueError: if the action is not one finite number
        """
        position, velocity, angle, rotation = self._known_state()
        self._push = checked_push(action)
        self.state = state = swing_up_step((position, velocity, angle, rotation), self._push, self.frame_skip)
        if self.render_mode == "human":
            self.render()
        return self._observe(), swing_up_reward(state), abs(state[0]) > TRACK, False, self._info()

    def _exact(self) -> Sequence[float]:
        position, velocity, angle, rotation = self._known_state()
        return position, velocity, math.cos(angle), math.sin(angle), rotation

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "upright": math.cos(self._known_state()[2]) > UPRIGHT}

    def _on_reset(self) -> None:
        self._push = 0.0

    def _make_canvas(self, human: bool) -> Canvas:
        return Canvas(
            (800, 320),
            (0.0, JOINT_HEIGHT),
            800 / (2.0 * TRACK + 1.4),
            human=human,
            fps=self.metadata["render_fps"],
            caption="Cart-pole swing-up",
        )

    def _draw(self, canvas: Canvas, state: State) -> None:
        canvas.fill(SKY)
        draw_track(canvas, TRACK)
        draw_cart_pole(canvas, state[0], state[2], self._push, 2.0 * PILCO.half_length)
