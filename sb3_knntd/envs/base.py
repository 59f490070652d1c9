"""The common base class of the environments: initial states, observations, noise and rendering."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Generic, TypeVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import logger, spaces
from gymnasium.error import ResetNeeded

from sb3_knntd.common.checks import check_word
from sb3_knntd.envs.rendering import Canvas

ActionT = TypeVar("ActionT")
State = tuple[float, ...]


class PaperEnv(gym.Env[npt.NDArray[np.float32], ActionT], Generic[ActionT], ABC):
    """
    An environment whose state is a tuple of floats and whose observation is that state, or what ``_exact`` makes
    of it, optionally with noise.

    The noise is Gaussian and drawn independently for each observation from the environment's own generator. It affects
    only the observations: the state, the reward and the end of an episode are exact. With noise, ``info["state"]`` is
    the true state as a float64 array. Observations are clipped to the observation space.

    :param observation_space: a Box of shape (obs_dim,)
    :param ranges: width of each observation dimension's usual range, shape (obs_dim,); the unit of ``noise``
    :param starts: the named distributions of initial states, including "uniform": for each name the limits (low, high)
        of a uniform distribution, two states
    :param start: one of these names, or a state
    :param noise: standard deviation of the noise as a share of ``ranges``, a number or one number per dimension
    :param render_mode: None, "human" or "rgb_array"
    :param state_space: a Box of the states, shape (state_dim,); None if it is the observation space
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    #: The dimensions that ``options={"low": ..., "high": ...}`` of :meth:`reset` apply to.
    drawn_dimensions: ClassVar[slice] = slice(None)

    def __init__(
        self,
        observation_space: spaces.Box,
        ranges: Sequence[float],
        starts: dict[str, tuple[State, State]],
        start: str | Sequence[float],
        noise: float | Sequence[float],
        render_mode: str | None,
        state_space: spaces.Box | None = None,
    ) -> None:
        if render_mode is not None:
            check_word("render_mode", render_mode, self.metadata["render_modes"])
        self.observation_space: spaces.Box = observation_space  # type: ignore[assignment]
        self._state_space = observation_space if state_space is None else state_space
        self._low = observation_space.low.astype(np.float64)
        self._high = observation_space.high.astype(np.float64)
        self.render_mode = render_mode
        self.noise = _check_noise(noise, len(ranges))
        self._deviation = self.noise * np.asarray(ranges, dtype=np.float64)
        self._noisy = bool(self.noise.any())
        low_start: Any
        high_start: Any
        low_start, high_start = starts[start] if isinstance(start, str) and start in starts else (start, start)
        wanted = f"must be one of {', '.join(map(repr, starts))}, or"
        self._start = (
            self._check_state("start", low_start, start, wanted),
            self._check_state("start", high_start, start, wanted),
        )
        self._uniform = starts["uniform"]
        self.state: State | None = None
        self._canvas: Canvas | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """
        Start an episode.

        :param seed: seed of the environment's generator; None leaves it unchanged
        :param options: ``{"state": state}`` sets the initial state; ``{"low": number, "high": number}`` sets the limits
            of the "uniform" distribution; both only for this episode
        :return: observation and info
        :raises ValueError: if an option does not give a state of the environment
        """
        super().reset(seed=seed)
        self.state = self._draw_start(options or {})
        self._on_reset()
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._info()

    def _draw_start(self, options: dict[str, Any]) -> State:
        given = {key: options[key] for key in ("low", "high", "state") if options.get(key) is not None}
        if "state" in given:
            return self._check_state('options["state"]', given["state"], given["state"], "must be")
        low, high = (np.array(limit) for limit in (self._uniform if given else self._start))
        for key, limits in (("low", low), ("high", high)):
            if key in given:
                try:
                    limits[self.drawn_dimensions] = given[key]
                except (TypeError, ValueError):
                    limits[:] = np.nan
                self._check_state(f'options["{key}"]', limits, given[key], "must make")
        if (low > high).any():
            raise ValueError(
                f'options["low"] must not be above options["high"]; the start would be drawn from {low} to {high}'
            )
        if (low == high).all():
            return tuple(low.tolist())
        return tuple(self.np_random.uniform(low, high).tolist())

    def _check_state(self, name: str, value: Any, given: Any, wanted: str) -> State:
        try:
            state = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            state = np.empty(0)
        low, high = self._state_space.low, self._state_space.high
        # Compare in the precision of the space, so that its limits are valid states.
        with np.errstate(over="ignore"):
            rounded = state.astype(np.float32)
        if state.shape != low.shape or not ((rounded >= low) & (rounded <= high)).all():
            raise ValueError(
                f"{name} {wanted} a state, {len(low)} numbers from ({', '.join(f'{bound:g}' for bound in low)}) "
                f"to ({', '.join(f'{bound:g}' for bound in high)}); got {given!r}"
            )
        return tuple(state.tolist())

    def _known_state(self) -> State:
        if self.state is None:
            raise ResetNeeded("call reset() before step()")
        return self.state

    def _on_reset(self) -> None:
        """Reset attributes that belong to the previous episode."""

    def _observe(self) -> npt.NDArray[np.float32]:
        observed = np.array(self._exact(), dtype=np.float64)
        if self._noisy:
            observed = self._fold(observed + self._deviation * self.np_random.standard_normal(len(observed)))
        return np.minimum(np.maximum(observed, self._low), self._high).astype(np.float32)

    def _exact(self) -> Sequence[float]:
        """
        :return: the observation of the state before noise and clipping, shape (obs_dim,)
        """
        return self._known_state()

    def _fold(self, observed: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """
        :param observed: observation plus noise
        :return: the same with angles wrapped to [-π, π]
        """
        return observed

    def _info(self) -> dict[str, Any]:
        return {"state": np.array(self.state, dtype=np.float64)} if self._noisy else {}

    @abstractmethod
    def _make_canvas(self, human: bool) -> Canvas: ...

    @abstractmethod
    def _draw(self, canvas: Canvas, state: State) -> None: ...

    def render(self) -> npt.NDArray[np.uint8] | None:
        """
        Render the state.

        :return: with "rgb_array" the image, shape (height, width, 3); else None
        """
        if self.render_mode is None:
            name = self.spec.id if self.spec is not None else type(self).__name__
            logger.warn(f'{name} was made without a render_mode and cannot render; pass "human" or "rgb_array"')
            return None
        if self.state is None:
            raise ResetNeeded("call reset() before render()")
        if self._canvas is None:
            self._canvas = self._make_canvas(self.render_mode == "human")
        self._draw(self._canvas, self.state)
        return self._canvas.show()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None


def _check_noise(noise: Any, n_dimensions: int) -> npt.NDArray[np.float64]:
    try:
        shares = np.array(noise, dtype=np.float64)
    except (TypeError, ValueError):
        shares = np.array(np.nan)
    fits = shares.shape in ((), (n_dimensions,)) and bool((np.isfinite(shares) & (shares >= 0.0)).all())
    if isinstance(noise, (bool, str)) or not fits:
        raise ValueError(
            f"noise must be a finite number >= 0, a share of each dimension's range, or {n_dimensions} such numbers, "
            f"one per dimension; got {noise!r}"
        )
    return np.broadcast_to(shares, (n_dimensions,)).copy()
