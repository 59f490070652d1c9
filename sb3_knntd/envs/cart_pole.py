"""Cart-pole: balance a pole on a cart, with eleven discrete forces or a continuous force."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_knntd.common.checks import check_integer, check_number, check_word
from sb3_knntd.envs.base import ActionT, PaperEnv, State
from sb3_knntd.envs.rendering import BLUE, GROUND, INK, ORANGE, SKY, STEEL, Canvas, turned


class Physics(NamedTuple):
    """
    The constants of a cart-pole.

    :param gravity: m/s²
    :param cart_mass: kg
    :param pole_mass: kg
    :param half_length: distance of the pole's centre of mass from its joint, half of its length, m
    :param max_force: force of a push of 1, N
    :param friction: force on the cart per velocity, N s/m
    :param time_step: s
    """

    gravity: float
    cart_mass: float
    pole_mass: float
    half_length: float
    max_force: float
    friction: float
    time_step: float


#: Barto, Sutton and Anderson, "Neuronlike adaptive elements that can solve difficult learning control problems" (1983),
#: without friction.
STANDARD = Physics(
    gravity=9.8, cart_mass=1.0, pole_mass=0.1, half_length=0.5, max_force=10.0, friction=0.0, time_step=0.02
)

#: Velocities are unbounded. As in gymnasium, their limit is the largest float32 instead of infinity.
UNLIMITED = float(np.finfo(np.float32).max)
#: Usual velocities of cart (m/s) and pole (rad/s); the noise is a share of them.
USUAL_SPEED = 3.0
USUAL_ROTATION = math.radians(60.0)

#: Height of the pole's joint above the track in pictures, m.
JOINT_HEIGHT = 0.3


def cart_pole_step(
    state: tuple[float, float, float, float], push: float, physics: Physics = STANDARD
) -> tuple[float, float, float, float]:
    """
    One Euler step of a cart-pole.

    The function can be compiled by numba.

    :param state: position (m), velocity (m/s), the pole's angle from upright (rad) and angular velocity (rad/s)
    :param push: share of the largest force, in [-1, 1]; positive is to the right
    :param physics: the constants, by default those of the standard cart-pole
    :return: the state after the step
    """
    position, velocity, angle, rotation = state[0], state[1], state[2], state[3]
    gravity, cart_mass, pole_mass, half_length, max_force, friction, time_step = physics
    mass = cart_mass + pole_mass
    moment = pole_mass * half_length
    cos, sin = math.cos(angle), math.sin(angle)
    pushed = (max_force * push - friction * velocity + moment * rotation * rotation * sin) / mass
    turn = (gravity * sin - cos * pushed) / (half_length * (4.0 / 3.0 - pole_mass * cos * cos / mass))
    drive = pushed - moment * turn * cos / mass
    return (
        position + time_step * velocity,
        velocity + time_step * drive,
        angle + time_step * rotation,
        rotation + time_step * turn,
    )


def cart_pole_failed(state: tuple[float, float, float, float], track: float, failure_angle: float) -> bool:
    """
    :param state: as in :func:`cart_pole_step`
    :param track: largest distance of the cart from the centre, m
    :param failure_angle: largest angle of the pole, rad
    :return: whether the cart is off the track or the pole has fallen
    """
    return abs(state[0]) > track or abs(state[2]) > failure_angle


def cart_pole_shaped_reward(state: tuple[float, float, float, float], failed: bool) -> float:
    """
    The reward of the paper's experiment: highest if the pole is upright and at rest and the cart is in the centre.
    Failure costs 10,000.

    :param state: as in :func:`cart_pole_step`, after the step
    :param failed: whether the step failed
    :return: reward, at most 10
    """
    position, angle, rotation = abs(state[0]), abs(state[2]), abs(state[3])
    if failed:
        return -10000.0 - 50.0 * position - 100.0 * angle
    return 10.0 - 10.0 * (10.0 * angle) ** 2 - 5.0 * position - 10.0 * rotation


def checked_push(action: npt.NDArray[np.floating[Any]]) -> float:
    """
    :param action: the force as a share of the largest, one number in an array of shape (1,)
    :return: the number, clipped to [-1, 1]
    :raises ValueError: if it is not one finite number
    """
    try:
        push = float(np.asarray(action).item())
    except (TypeError, ValueError):
        push = math.nan
    if not math.isfinite(push):
        raise ValueError(f"action must be one finite number in an array of shape (1,); got {action!r}")
    return min(max(push, -1.0), 1.0)


def draw_track(canvas: Canvas, track: float) -> None:
    """
    :param canvas: where to draw
    :param track: largest distance of the cart from the centre, m
    """
    canvas.bar((-track, 0.0), (track, 0.0), 0.04, STEEL)
    for metre in range(-math.floor(track), math.floor(track) + 1):
        canvas.bar((metre, -0.06), (metre, -0.16 if metre else -0.24), 0.02, STEEL)
    for side in (-1, 1):
        canvas.bar((side * (track + 0.34), 0.0), (side * (track + 0.34), 0.3), 0.07, INK)


def draw_cart_pole(canvas: Canvas, position: float, angle: float, push: float, length: float) -> None:
    """
    :param canvas: where to draw
    :param position: position of the cart, m
    :param angle: angle of the pole from upright, rad
    :param push: share of the largest force, in [-1, 1]
    :param length: length of the pole, m
    """
    pivot = (position, JOINT_HEIGHT)
    canvas.polygon(turned([(-0.3, 0.1), (0.3, 0.1), (0.3, 0.3), (-0.3, 0.3)], 0.0, (position, 0.0)), INK)
    for wheel in (-0.18, 0.18):
        canvas.circle((position + wheel, 0.09), 0.075, STEEL)
        canvas.circle((position + wheel, 0.09), 0.03, INK)
    canvas.bar(pivot, turned([(0.0, length)], -angle, pivot)[0], 0.075, BLUE)
    canvas.circle(pivot, 0.06, SKY)
    canvas.circle(pivot, 0.035, INK)
    if push:
        canvas.arrow((position, -0.36), (position + 0.75 * push, -0.36), 0.06, ORANGE)


class _CartPoleEnv(PaperEnv[ActionT]):
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 50}

    def __init__(
        self,
        start: str | Sequence[float],
        reward: str,
        failure_angle: float,
        track: float,
        noise: float | Sequence[float],
        render_mode: str | None,
    ) -> None:
        check_word("reward", reward, ("shaped", "step", "failure"))
        self.reward = reward
        self.failure_angle = check_number("failure_angle", failure_angle, 0.0, 90.0, above=True)
        self.track = check_number("track", track, 0.0, above=True)
        self._largest_angle = math.radians(self.failure_angle)
        high = np.array([self.track, UNLIMITED, self._largest_angle, UNLIMITED], dtype=np.float32)
        low_start, fixed_start = (-0.05,) * 4, (0.0, 0.0, 0.0, 0.01)
        super().__init__(
            observation_space=spaces.Box(-high, high),
            ranges=(2.0 * self.track, 2.0 * USUAL_SPEED, 2.0 * self._largest_angle, 2.0 * USUAL_ROTATION),
            starts={"fixed": (fixed_start, fixed_start), "uniform": (low_start, (0.05,) * 4)},
            start=start,
            noise=noise,
            render_mode=render_mode,
        )
        self._push = 0.0

    @abstractmethod
    def _push_of(self, action: ActionT) -> float:
        """
        :param action: action of the agent
        :return: share of the largest force, in [-1, 1]
        :raises ValueError: if the action is invalid
        """

    def step(self, action: ActionT) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """
        :param action: the force on the cart, as described for the action space
        :return: observation, reward, terminated, truncated (never), info
        :raises ValueError: if the action is not in the action space
        """
        position, velocity, angle, rotation = self._known_state()
        self._push = self._push_of(action)
        self.state = state = cart_pole_step((position, velocity, angle, rotation), self._push)
        failed = cart_pole_failed(state, self.track, self._largest_angle)
        if self.reward == "shaped":
            reward = cart_pole_shaped_reward(state, failed)
        elif self.reward == "step":
            reward = 1.0
        else:
            reward = -1.0 if failed else 0.0
        if self.render_mode == "human":
            self.render()
        return self._observe(), reward, failed, False, self._info()

    def _on_reset(self) -> None:
        self._push = 0.0

    def _make_canvas(self, human: bool) -> Canvas:
        # Show the whole track and the whole pole, however short the track is.
        width, height = 800, 220
        scale = min(width / (2.0 * self.track + 1.4), height / 2.3)
        return Canvas(
            (width, height),
            (0.0, 0.5 * height / scale - 0.6),
            scale,
            human=human,
            fps=self.metadata["render_fps"],
            caption="Cart-pole",
        )

    def _draw(self, canvas: Canvas, state: State) -> None:
        position, angle = state[0], state[2]
        canvas.fill(SKY)
        far = self.track + 10.0
        canvas.polygon([(-far, -0.02), (far, -0.02), (far, -1.0), (-far, -1.0)], GROUND)
        draw_track(canvas, self.track)
        pivot = (position, JOINT_HEIGHT)
        for limit in (-self._largest_angle, self._largest_angle):
            # Dashed, to distinguish the limits from the pole.
            for dash in np.arange(0.15, 1.05, 0.12).tolist():
                inner, outer = turned([(0.0, dash), (0.0, dash + 0.05)], -limit, pivot)
                canvas.bar(inner, outer, 0.014, STEEL, rounded=False)
        draw_cart_pole(canvas, position, angle, self._push, 2.0 * STANDARD.half_length)


class CartPoleEnv(_CartPoleEnv["int | np.integer[Any]"]):
    """
    ## Description

    A pole stands on a cart and can fall to the left or to the right. Pushing the cart keeps it upright. This is the
    task of the paper's figure 6 with discrete actions; `sb3_knntd/ContinuousCartPole-v0` is the same task with a
    continuous force.

    `gymnasium`'s `CartPole-v1` has the same dynamics with two forces (`n_forces=2`), a shorter track (`track=2.4`),
    a reward of 1 per step (`reward="step"`) and a limit of 500 steps.

    ## Action Space

    `Discrete(n_forces)`: the force is 10 N × `linspace(-1, 1, n_forces)[action]`, positive to the right.

    ## Observation Space

    `Box` of shape `(4,)`, float32

    | Num | Observation             | Min              | Max             | Usual range | Unit  |
    |-----|-------------------------|------------------|-----------------|-------------|-------|
    | 0   | position of the cart    | -`track`         | `track`         | ±`track`    | m     |
    | 1   | velocity of the cart    | none             | none            | ±3          | m/s   |
    | 2   | angle from upright      | -`failure_angle` | `failure_angle` | the same    | rad   |
    | 3   | angular velocity        | none             | none            | ±π/3        | rad/s |

    "None" is the largest float32. A position or angle beyond its limit, as in the step that fails, is clipped to the
    limit.

    ## Dynamics

    The frictionless equations of Barto, Sutton and Anderson (1983): cart 1 kg, pole 0.1 kg, half length 0.5 m,
    gravity 9.8 m/s², Euler steps of 0.02 s.

    ## Rewards

    | `reward`             | each step           | on failure          |
    |----------------------|---------------------|---------------------|
    | `"shaped"` (default) | *upright*           | *fallen*            |
    | `"step"`             | 1                   | 1                   |
    | `"failure"`          | 0                   | -1                  |

    where *upright* = 10 - 10 (10 |angle|)² - 5 |position| - 10 |angular velocity| and
    *fallen* = -10000 - 50 |position| - 100 |angle|, both computed from the state after the step.
    The `reward_threshold` is a mean return of 8000 with `"shaped"`; the maximum is 10,000.

    ## Starting State

    | `start`             | state                                      |
    |---------------------|--------------------------------------------|
    | `"fixed"` (default) | (0, 0, 0, 0.01), a slow rotation           |
    | `"uniform"`         | each of the four uniform in [-0.05, 0.05]  |
    | a state             | as given                                   |

    ## Episode End

    1. Termination: the angle is beyond ±`failure_angle`, or the position beyond ±`track`.
    2. Truncation, as registered: 1000 steps.

    ## Arguments

    | Parameter       | Type                | Default    | Description                                             |
    |-----------------|---------------------|------------|---------------------------------------------------------|
    | `n_forces`      | int ≥ 2             | `11`       | number of forces (discrete version only)                |
    | `start`         | str or 4 numbers    | `"fixed"`  | initial state of the episodes                           |
    | `reward`        | str                 | `"shaped"` | reward function                                         |
    | `failure_angle` | number in (0, 90]   | `12.0`     | degrees from upright; 45 is also common                 |
    | `track`         | number > 0          | `4.5`      | metres from the centre to either end                    |
    | `noise`         | number or 4 numbers | `0.0`      | observation noise: standard deviation / usual width     |
    | `render_mode`   | str                 | `None`     | `"human"` or `"rgb_array"`                              |

    `reset` takes `options={"state": (position, velocity, angle, angular velocity)}`, or `{"low": ..., "high": ...}`
    for limits of all four. With noise, `info["state"]` is the true state.

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/CartPole-v0", n_forces=3, failure_angle=45)

    ```

    ## Version History

    * v0: first version
    """

    def __init__(
        self,
        n_forces: int = 11,
        start: str | Sequence[float] = "fixed",
        reward: str = "shaped",
        failure_angle: float = 12.0,
        track: float = 4.5,
        noise: float | Sequence[float] = 0.0,
        render_mode: str | None = None,
    ) -> None:
        self.n_forces = check_integer("n_forces", n_forces, 2)
        super().__init__(start, reward, failure_angle, track, noise, render_mode)
        self.action_space = spaces.Discrete(self.n_forces)
        #: Shares of the largest force, shape (n_forces,).
        self.forces: npt.NDArray[np.float64] = np.linspace(-1.0, 1.0, self.n_forces)

    def _push_of(self, action: int | np.integer[Any]) -> float:
        if not self.action_space.contains(action):
            raise ValueError(f"action must be an integer from 0 to {self.n_forces - 1}; got {action!r}")
        return float(self.forces[action])


class ContinuousCartPoleEnv(_CartPoleEnv["npt.NDArray[np.floating[Any]]"]):
    """
    ## Description

    `sb3_knntd/CartPole-v0` with a continuous force: the task of the paper's figures 6 and 7 for Ex⟨a⟩(λ). Dynamics,
    observations, rewards, initial states, episode ends and arguments are the same, except that there is no `n_forces`.

    ## Action Space

    `Box(-1, 1, (1,))`, float32: the force as a share of 10 N, positive to the right. Larger values are clipped.

    | Num | Action | Min | Max |
    |-----|--------|-----|-----|
    | 0   | force  | -1  | 1   |

    ## Arguments

    | Parameter       | Type                | Default    | Description                                             |
    |-----------------|---------------------|------------|---------------------------------------------------------|
    | `start`         | str or 4 numbers    | `"fixed"`  | initial state of the episodes                           |
    | `reward`        | str                 | `"shaped"` | reward function                                         |
    | `failure_angle` | number in (0, 90]   | `12.0`     | degrees from upright; 45 is also common                 |
    | `track`         | number > 0          | `4.5`      | metres from the centre to either end                    |
    | `noise`         | number or 4 numbers | `0.0`      | observation noise: standard deviation / usual width     |
    | `render_mode`   | str                 | `None`     | `"human"` or `"rgb_array"`                              |

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/ContinuousCartPole-v0", reward="step")

    ```

    ## Version History

    * v0: first version
    """

    def __init__(
        self,
        start: str | Sequence[float] = "fixed",
        reward: str = "shaped",
        failure_angle: float = 12.0,
        track: float = 4.5,
        noise: float | Sequence[float] = 0.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(start, reward, failure_angle, track, noise, render_mode)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)

    def _push_of(self, action: npt.NDArray[np.floating[Any]]) -> float:
        return checked_push(action)
