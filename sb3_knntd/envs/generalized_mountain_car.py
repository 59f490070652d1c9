"""The generalised Mountain-Car of the 2008 competition: offset and noisy observations, and a variable engine force."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_knntd.common.checks import check_integer
from sb3_knntd.envs.base import PaperEnv, State
from sb3_knntd.envs.mountain_car import (
    FORCE,
    GOAL_POSITION,
    MAX_POSITION,
    MAX_SPEED,
    MIN_POSITION,
    draw_mountain_car,
    mountain_car_canvas,
    mountain_car_step,
)
from sb3_knntd.envs.rendering import Canvas

#: Ranges of position and velocity; the noise is a share of them.
RANGES = (MAX_POSITION - MIN_POSITION, 2.0 * MAX_SPEED)

MAX_OFFSET = 1.0
MIN_DIVIDER, MAX_DIVIDER = 5.0, 20.0
MIN_FORCE_FACTOR, MAX_FORCE_FACTOR = 0.8, 1.2
FORCE_DEVIATION = 0.05
NOISE_SHAPE = (5.0, 2.0)

START_POSITION = -0.5
#: Initial positions: a third of the position range, around the fixed start.
MIN_START, MAX_START = START_POSITION + MIN_POSITION / 3.0, START_POSITION + MAX_POSITION / 3.0

_MAX_NOISE = tuple(0.5 * width / MIN_DIVIDER for width in RANGES)
LOWEST_REPORT = (MIN_POSITION - MAX_OFFSET - _MAX_NOISE[0], -MAX_SPEED - MAX_OFFSET - _MAX_NOISE[1])
#: The competition computed the largest velocity from the smallest, -0.07; larger velocities are clipped to it.
HIGHEST_REPORT = (MAX_POSITION + MAX_OFFSET + _MAX_NOISE[0], -MAX_SPEED + MAX_OFFSET + _MAX_NOISE[1])


class MountainCarProblem(NamedTuple):
    """
    The parameters of one problem of the generalised Mountain-Car.

    :param offset: offsets added to the observed position and velocity, each in [-1, 1]
    :param noise_divider: range of position and velocity divided by the width of their noise, each in [5, 20]
    :param force_factor: mean factor of the engine force, in [0.8, 1.2]
    """

    offset: tuple[float, float]
    noise_divider: tuple[float, float]
    force_factor: float


def draw_problem(rng: np.random.Generator) -> MountainCarProblem:
    """
    :param rng: random generator
    :return: a problem, each parameter drawn uniformly from its range
    """
    low = (-MAX_OFFSET, -MAX_OFFSET, MIN_DIVIDER, MIN_DIVIDER, MIN_FORCE_FACTOR)
    high = (MAX_OFFSET, MAX_OFFSET, MAX_DIVIDER, MAX_DIVIDER, MAX_FORCE_FACTOR)
    position, velocity, position_divider, velocity_divider, factor = rng.uniform(low, high).tolist()
    return MountainCarProblem((position, velocity), (position_divider, velocity_divider), factor)


def numbered_problem(number: int) -> MountainCarProblem:
    """
    :param number: number of the problem, an integer >= 0
    :return: the problem with that number, always the same
    """
    # The spawn key makes the problem independent of the random numbers of an environment with the same seed.
    return draw_problem(np.random.default_rng(np.random.SeedSequence(number, spawn_key=(0,))))


class GeneralizedMountainCarEnv(PaperEnv["int | np.integer[Any]"]):
    """
    ## Description

    The harder version of `sb3_knntd/MountainCar-v0` of the Second Annual Reinforcement Learning Competition of 2008, in
    which kNN-TD(λ) came second. Observed position and velocity have an unknown offset and noise with a nonzero mean.
    The engine is stronger or weaker than usual, and its force varies from step to step. A *problem* is one draw of the
    offsets, the widths of the noise and the mean engine force; it stays the same in all episodes. This is also the task
    of the paper's figure 4 for the δs filter, so `info["state"]` is the true state at every step.

    In the competition an agent had 100,000 steps per problem, and its score was the number of finished episodes.

    ## Action Space

    `Discrete(3)`

    | Num | Action               |
    |-----|----------------------|
    | 0   | engine pushes left   |
    | 1   | engine idles         |
    | 2   | engine pushes right  |

    ## Observation Space

    `Box` of shape `(2,)`, float32, the same for all problems

    | Num | Observation                  | Min    | Max   | Unit             |
    |-----|------------------------------|--------|-------|------------------|
    | 0   | position + offset + noise    | -2.38  | 1.78  | length           |
    | 1   | velocity + offset + noise    | -1.084 | 0.944 | length per step  |

    The velocities of one problem fill 1/14 of that range: a learner that spreads points over it wastes most of them.
    Velocities can reach 1.084, but are clipped to 0.944, the limit of the competition, where 1.084 was intended. This
    affects about one problem in fifteen, those with a velocity offset above 0.86. If the offset is close to 1, it hides
    almost all of the velocity.

    ## Problems

    | Parameter                                  | Drawn uniformly from | If disabled    |
    |--------------------------------------------|----------------------|----------------|
    | offset of the position                     | [-1, 1]              | 0              |
    | offset of the velocity                     | [-1, 1]              | 0              |
    | noise divider *d* of the position          | [5, 20]              | no noise       |
    | noise divider *d* of the velocity          | [5, 20]              | no noise       |
    | mean factor *m* of the engine force        | [0.8, 1.2]           | factor 1       |

    The noise is *(β - 0.5) range / d*, with *β* drawn from Beta(5, 2) independently for every observation and
    dimension, and ranges of 1.8 and 0.14. Its mean is 0.214 *range / d*, its standard deviation 0.160 *range / d*.

    ## Dynamics

    Those of `sb3_knntd/MountainCar-v0`, except that the engine force of each step is multiplied by a sample of
    *N(m, 0.05)*, where 0.05 is the standard deviation. Gravity does not vary.

    ## Rewards

    -1 per step, and 0 for the step that reaches the goal (-1 in `sb3_knntd/MountainCar-v0`).
    The `reward_threshold` is a mean return of -150.

    ## Starting State

    | `random_start`   | position                                     | velocity |
    |------------------|----------------------------------------------|----------|
    | `True` (default) | -0.5 + *U*(-1.2, 0.6) / 3, in [-0.9, -0.3]   | 0        |
    | `False`          | -0.5                                         | 0        |

    ## Episode End

    1. Termination: true position ≥ 0.5.
    2. Truncation, as registered: 1000 steps, as in `sb3_knntd/MountainCar-v0`. The competition limited only the total
       number of steps; `gym.make(..., max_episode_steps=100_000)` is equivalent.

    ## Arguments

    | Parameter      | Type                  | Default | Description                                                   |
    |----------------|-----------------------|---------|---------------------------------------------------------------|
    | `problem`      | integer ≥ 0 or `None` | `0`     | number of the problem                                         |
    | `noise`        | bool                  | `True`  | whether observations are noisy                                |
    | `offset`       | bool                  | `True`  | whether observations have an offset                           |
    | `random_force` | bool                  | `True`  | whether the engine force has the problem's mean, and varies   |
    | `random_start` | bool                  | `True`  | whether initial positions are random                          |
    | `render_mode`  | str                   | `None`  | `"human"` or `"rgb_array"`, both of the true state            |

    A number stands for the same problem in every process and for every seed: several environments, for example for
    training and evaluation, are the same problem if they have the same number. With `None` a problem is drawn when the
    environment is made, and a new one by each `reset` with a seed, from that seed. `env.unwrapped.parameters` holds the
    parameters of the problem.

    Disabling one part does not change the random numbers of the others: the same seed and actions give the same states
    with and without `noise` and `offset`.

    `reset` takes `options={"state": (position, velocity)}` with the true values, or `{"low": ..., "high": ...}` for
    limits of the position.

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/GeneralizedMountainCar-v0", problem=3, random_force=False)

    ```

    ## Differences from the competition

    The competition had 35 training problems and other test problems, with parameters drawn from these ranges; they are
    not among the problems drawn here. Its published source, `MountainCar.java` of the competition's software, uses the
    opposite sign of the noise, and 5 and 2 as the degrees of freedom of two χ² variables. *β* then has the distribution
    Beta(2.5, 1): the mean has the same size, and the standard deviation is 0.213 *range / d*.

    ## Version History

    * v0: first version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    drawn_dimensions: ClassVar[slice] = slice(0, 1)

    def __init__(
        self,
        problem: int | None = 0,
        noise: bool = True,
        offset: bool = True,
        random_force: bool = True,
        random_start: bool = True,
        render_mode: str | None = None,
    ) -> None:
        self.problem = None if problem is None else check_integer("problem", problem, 0)
        for name, value in (
            ("noise", noise),
            ("offset", offset),
            ("random_force", random_force),
            ("random_start", random_start),
        ):
            if not isinstance(value, (bool, np.bool_)):
                raise ValueError(f"{name} must be True or False; got {value!r}")
        fixed: State = (START_POSITION, 0.0)
        super().__init__(
            observation_space=spaces.Box(
                np.array(LOWEST_REPORT, dtype=np.float32), np.array(HIGHEST_REPORT, dtype=np.float32)
            ),
            ranges=RANGES,
            starts={"fixed": (fixed, fixed), "uniform": ((MIN_START, 0.0), (MAX_START, 0.0))},
            start="uniform" if random_start else "fixed",
            noise=0.0,
            render_mode=render_mode,
            state_space=spaces.Box(
                np.array([MIN_POSITION, -MAX_SPEED], dtype=np.float32),
                np.array([MAX_POSITION, MAX_SPEED], dtype=np.float32),
            ),
        )
        self.action_space = spaces.Discrete(3)
        self.noise = noise  # type: ignore[assignment]  # A flag here: the noise of this task is not Gaussian.
        self.offset = offset
        self.random_force = random_force
        #: The parameters of the problem, including those of disabled parts.
        self.parameters = draw_problem(self.np_random) if self.problem is None else numbered_problem(self.problem)
        self._redraw = False
        self._push = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """
        Start an episode.

        :param seed: seed of the environment's generator, from which with ``problem=None`` a problem is drawn; None
            leaves both unchanged
        :param options: ``{"state": state}`` sets the initial state; ``{"low": number, "high": number}`` the limits of
            the initial position; both only for this episode
        :return: observation and info
        :raises ValueError: if an option does not give a state of the environment
        """
        self._redraw = self.problem is None and seed is not None
        return super().reset(seed=seed, options=options)

    def _on_reset(self) -> None:
        self._push = 0
        if self._redraw:
            self.parameters = draw_problem(self.np_random)

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
        # Drawn even if it is not used, so that the other random numbers do not depend on which parts are enabled.
        factor = self.np_random.normal(self.parameters.force_factor, FORCE_DEVIATION)
        force = FORCE * factor if self.random_force else FORCE
        self.state = position, _ = mountain_car_step((state[0], state[1]), int(action), force)
        arrived = position >= GOAL_POSITION
        if self.render_mode == "human":
            self.render()
        return self._observe(), float(arrived) - 1.0, arrived, False, self._info()

    def _observe(self) -> npt.NDArray[np.float32]:
        noise = (self.np_random.beta(*NOISE_SHAPE, size=2) - 0.5) * RANGES / self.parameters.noise_divider
        observed = np.array(self.state, dtype=np.float64)
        if self.offset:
            observed += self.parameters.offset
        if self.noise:
            observed += noise
        return np.minimum(np.maximum(observed, self._low), self._high).astype(np.float32)

    def _info(self) -> dict[str, Any]:
        return {"state": np.array(self.state, dtype=np.float64)}

    def _make_canvas(self, human: bool) -> Canvas:
        return mountain_car_canvas(human, self.metadata["render_fps"], "Generalised Mountain-Car")

    def _draw(self, canvas: Canvas, state: State) -> None:
        draw_mountain_car(canvas, state[0], self._push)
