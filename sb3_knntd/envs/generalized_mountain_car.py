"""The generalised Mountain-Car of the 2008 competition: displaced and noisy observations, and an engine that varies."""

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

#: Width of position and velocity, of which noise is a part.
RANGES = (MAX_POSITION - MIN_POSITION, 2.0 * MAX_SPEED)

MAX_OFFSET = 1.0
MIN_DIVIDER, MAX_DIVIDER = 5.0, 20.0
MIN_FORCE_FACTOR, MAX_FORCE_FACTOR = 0.8, 1.2
FORCE_DEVIATION = 0.05
NOISE_SHAPE = (5.0, 2.0)

START_POSITION = -0.5
#: A third of the valley's positions, moved to the start.
MIN_START, MAX_START = START_POSITION + MIN_POSITION / 3.0, START_POSITION + MAX_POSITION / 3.0

_MAX_NOISE = tuple(0.5 * width / MIN_DIVIDER for width in RANGES)
LOWEST_REPORT = (MIN_POSITION - MAX_OFFSET - _MAX_NOISE[0], -MAX_SPEED - MAX_OFFSET - _MAX_NOISE[1])
#: The competition counted the highest velocity from the lowest, -0.07: what is above was reported as this.
HIGHEST_REPORT = (MAX_POSITION + MAX_OFFSET + _MAX_NOISE[0], -MAX_SPEED + MAX_OFFSET + _MAX_NOISE[1])


class MountainCarProblem(NamedTuple):
    """
    What tells one problem of the generalised Mountain-Car from another.

    :param offset: what is added to the position and the velocity that are reported, each in [-1, 1]
    :param noise_divider: parts of the range of position and velocity that their noise spreads over, each in [5, 20]
    :param force_factor: mean of what the engine's force is multiplied by, in [0.8, 1.2]
    """

    offset: tuple[float, float]
    noise_divider: tuple[float, float]
    force_factor: float


def draw_problem(rng: np.random.Generator) -> MountainCarProblem:
    """
    :param rng: generator to draw with
    :return: a problem, each of its numbers uniform in its range
    """
    low = (-MAX_OFFSET, -MAX_OFFSET, MIN_DIVIDER, MIN_DIVIDER, MIN_FORCE_FACTOR)
    high = (MAX_OFFSET, MAX_OFFSET, MAX_DIVIDER, MAX_DIVIDER, MAX_FORCE_FACTOR)
    position, velocity, position_divider, velocity_divider, factor = rng.uniform(low, high).tolist()
    return MountainCarProblem((position, velocity), (position_divider, velocity_divider), factor)


def numbered_problem(number: int) -> MountainCarProblem:
    """
    :param number: of the problem, an integer of at least 0
    :return: the problem of that number, everywhere and always the same
    """
    # A key of its own, or the problem would be made of the numbers that an environment with this seed starts with.
    return draw_problem(np.random.default_rng(np.random.SeedSequence(number, spawn_key=(0,))))


class GeneralizedMountainCarEnv(PaperEnv["int | np.integer[Any]"]):
    """
    ## Description

    `sb3_knntd/MountainCar-v0` as it was made harder for the Second Annual Reinforcement Learning Competition of 2008,
    where kNN-TD(λ) came second: the agent is told position and velocity with an unknown offset and with noise that has
    a mean, and an engine that is stronger or weaker than usual varies from step to step. A *problem* is one draw of the
    offsets, the noise's widths and the engine's mean strength; it stays what it is from episode to episode. It is also
    the task of the paper's figure 4 for the δs filter, so `info["state"]` tells the true state at every step.

    The competition gave an agent 100,000 steps on a problem, and its score was how many episodes it finished.

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
    | 0   | position + offset + noise    | -2.38  | 1.78  | of length        |
    | 1   | velocity + offset + noise    | -1.084 | 0.944 | of length a step |

    A problem's velocities fill a fourteenth of that range: learners that spread points over it waste most of them.
    Velocities up to 1.084 come up, and are reported as 0.944: the competition's limit, though it was meant to be 1.084.
    That touches about one problem in fifteen, those whose velocity offset is above 0.86, and where the offset is close
    to 1 it hides nearly all of the velocity.

    ## Problems

    | Number of a problem                        | Drawn uniformly from | Without it     |
    |--------------------------------------------|----------------------|----------------|
    | offset of the position                     | [-1, 1]              | 0              |
    | offset of the velocity                     | [-1, 1]              | 0              |
    | noise divider *d* of the position          | [5, 20]              | no noise       |
    | noise divider *d* of the velocity          | [5, 20]              | no noise       |
    | mean *m* of the engine's strength          | [0.8, 1.2]           | strength 1     |

    Noise is *(β - 0.5) range / d*, with *β* from Beta(5, 2) for every observation and dimension anew, and ranges of 1.8
    and 0.14; so its mean is 0.214 *range / d*, its standard deviation 0.160 *range / d*.

    ## Dynamics

    Those of `sb3_knntd/MountainCar-v0`, except that each step's engine force is multiplied by a draw from *N(m, 0.05)*,
    0.05 being the standard deviation. Gravity is exact.

    ## Rewards

    -1 a step, and 0 for the step that reaches the goal, which `sb3_knntd/MountainCar-v0` rewards with -1 as well.
    The `reward_threshold` is a mean return of -150.

    ## Starting State

    | `random_start`   | position                                     | velocity |
    |------------------|----------------------------------------------|----------|
    | `True` (default) | -0.5 + *U*(-1.2, 0.6) / 3, in [-0.9, -0.3]   | 0        |
    | `False`          | -0.5                                         | 0        |

    ## Episode End

    1. Termination: true position ≥ 0.5.
    2. Truncation, as registered: 1000 steps, as in `sb3_knntd/MountainCar-v0`. The competition had no limit but that of
       all steps together; `gym.make(..., max_episode_steps=100_000)` comes to the same.

    ## Arguments

    | Parameter      | Type                  | Default | Description                                                   |
    |----------------|-----------------------|---------|---------------------------------------------------------------|
    | `problem`      | integer ≥ 0 or `None` | `0`     | which problem                                                 |
    | `noise`        | bool                  | `True`  | whether observations are noisy                                |
    | `offset`       | bool                  | `True`  | whether observations are displaced                            |
    | `random_force` | bool                  | `True`  | whether the engine has the problem's strength, and varies     |
    | `random_start` | bool                  | `True`  | whether starts are drawn                                      |
    | `render_mode`  | str                   | `None`  | `"human"` or `"rgb_array"`, both of the true state            |

    A number stands for one problem, in every process and whatever the environment's seed: several environments, or one
    to train in and one to evaluate in, are the same problem if they have the same number. With `None` the problem is
    drawn when the environment is made, and drawn again, from that seed, by each `reset` that is given one; in between
    it stays. `env.unwrapped.parameters` holds its numbers.

    With a part switched off, the draws of the others stay as they are: the same seed and the same actions make the same
    states with and without `noise` and `offset`.

    `reset` takes `options={"state": (position, velocity)}`, the true ones, or `{"low": ..., "high": ...}` for limits of
    the position.

    ```python
    >>> import gymnasium as gym
    >>> import sb3_knntd.envs
    >>> env = gym.make("sb3_knntd/GeneralizedMountainCar-v0", problem=3, random_force=False)

    ```

    ## Differences from the competition

    The competition had 35 problems to practise on and others for the test, with numbers drawn from these ranges; they
    are not among those drawn here. Its published source, `MountainCar.java` of the competition's software, gives the
    noise the other sign and takes 5 and 2 for the degrees of freedom of two χ² variables, which makes *β* one of
    Beta(2.5, 1): the same size of mean, and a standard deviation of 0.213 *range / d*.

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
        self.noise = noise  # type: ignore[assignment]  # A switch here, for noise of its own kind.
        self.offset = offset
        self.random_force = random_force
        #: The problem's numbers, whichever parts are switched on.
        self.parameters = draw_problem(self.np_random) if self.problem is None else numbered_problem(self.problem)
        self._redraw = False
        self._push = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """
        Start an episode.

        :param seed: of the environment's generator, from which with ``problem=None`` a problem is drawn; None leaves
            both as they are
        :param options: ``{"state": state}`` starts there; ``{"low": number, "high": number}`` starts between these
            positions; both only for this episode
        :return: observation and info
        :raises ValueError: if an option is no state of the environment
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
        :raises ValueError: if the action is another
        """
        state = self._known_state()
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0, 1 or 2; got {action!r}")
        self._push = int(action) - 1
        # Drawn even if it is not used, so that the rest of the episode does not depend on what is switched on.
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
