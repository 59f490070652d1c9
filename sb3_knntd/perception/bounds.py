"""The range of observations that is mapped to [-1, 1]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_knntd.common.checks import check_integer, check_numbers, shown
from sb3_knntd.common.state_checks import checked_tensor

#: A larger bound counts as no bound: no sensor spans such a range, and no lattice resolves it.
LARGEST_SENSIBLE_BOUND = 1e10
#: A measured range is widened by this fraction on each side, since a better policy reaches states that a random one
#: does not.
MARGIN = 0.25
#: A visited range may be exceeded by this fraction of it before all is scaled anew.
SLACK = 0.1
#: A range below this fraction of the values in it is rounding.
RESOLUTION = 1e-6
#: Scaled values are clipped to this size. It is far outside all points, and small enough that a squared distance still
#: resolves the differences in the other dimensions.
FARTHEST = 1e4
#: Number of observations that the range of an open dimension is measured over, in total and per environment.
MEASURING_STEPS = 1000
MEASURING_STEPS_PER_ENV = 100


def steps_to_measure(n_envs: int) -> int:
    """
    :param n_envs: number of environments
    :return: number of observations that the range of an open dimension is measured over
    """
    return max(MEASURING_STEPS, MEASURING_STEPS_PER_ENV * n_envs)


class Bounds(nn.Module):
    """
    Affine map of each observation dimension onto [-1, 1] (eq. 4 of the paper). Observations outside the bounds are
    mapped to values outside [-1, 1], clipped to ±10,000.

    A dimension is *open* if one of its bounds is infinite, NaN or larger than 1e10, or if it is empty (low >= high).
    Its range is [-1, 1] until :meth:`measure` is called, and then that of the observations, widened by a quarter on
    each side; a finite bound stays where it is. *Adaptive* bounds are open in all dimensions, and :meth:`widen` moves
    them when an observation lies outside, up to the bounds given.

    :param low: lower bounds, shape (obs_dim,), observation units
    :param high: upper bounds, shape (obs_dim,), observation units
    :param adaptive: whether the bounds follow the observations
    """

    low: th.Tensor
    high: th.Tensor
    open: th.Tensor
    seen_low: th.Tensor
    seen_high: th.Tensor
    lowest: th.Tensor
    highest: th.Tensor

    def __init__(self, low: np.ndarray, high: np.ndarray, adaptive: bool = False) -> None:
        super().__init__()
        self.adaptive = adaptive
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        #: number of observation dimensions
        self.obs_dim = len(low)
        empty = low >= high
        low_is_known = (np.abs(low) <= LARGEST_SENSIBLE_BOUND) & ~empty
        high_is_known = (np.abs(high) <= LARGEST_SENSIBLE_BOUND) & ~empty
        is_open = ~(low_is_known & high_is_known) | adaptive
        self.register_buffer("low", th.from_numpy(np.where(is_open, -1.0, low)))
        self.register_buffer("high", th.from_numpy(np.where(is_open, 1.0, high)))
        self.register_buffer("open", th.from_numpy(is_open))
        self.register_buffer("lowest", th.from_numpy(np.where(low_is_known, low, -np.inf)), persistent=False)
        self.register_buffer("highest", th.from_numpy(np.where(high_is_known, high, np.inf)), persistent=False)
        self.register_buffer("seen_low", th.full_like(self.low, th.inf))
        self.register_buffer("seen_high", th.full_like(self.low, -th.inf))

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        # torch reports missing entries.
        if all(prefix + name in state_dict for name in self.state_dict()):
            shape = (self.obs_dim,)
            low, high = (checked_tensor(state_dict, prefix + name, shape) for name in ("low", "high"))
            for name in ("seen_low", "seen_high"):
                checked_tensor(state_dict, prefix + name, shape, finite=False)
            if not (low < high).all() or not th.isfinite(high - low).all():
                raise ValueError(f"{prefix}low must be below {prefix}high; got {low.tolist()} and {high.tolist()}")
        super()._load_from_state_dict(state_dict, prefix, *args)

    @property
    def is_open(self) -> bool:
        """Whether the range of some dimension has to be measured."""
        return bool(self.open.any())

    def measure(self, observations: th.Tensor) -> None:
        """
        Widen the range of the open dimensions to include these observations.

        :param observations: shape (batch, obs_dim), finite
        """
        self.seen_low.copy_(th.minimum(self.seen_low, observations.amin(dim=0)))
        self.seen_high.copy_(th.maximum(self.seen_high, observations.amax(dim=0)))
        width = self.seen_high - self.seen_low
        # A dimension that was constant so far gets one unit on each side.
        margin = th.where(width > 0, MARGIN * width, 1.0)
        low = th.where(self.open, self.seen_low - margin, self.low)
        high = th.where(self.open, self.seen_high + margin, self.high)
        if not self.adaptive:
            low = th.where(self.lowest.isfinite(), self.lowest, low)
            high = th.where(self.highest.isfinite(), self.highest, high)
            # All observations lie beyond the bound that is known.
            low, high = (
                th.where((low >= high) & self.lowest.isinf(), high - 1.0, low),
                th.where((low >= high) & self.highest.isinf(), low + 1.0, high),
            )
        self._set(low, high)

    def widen(self, observations: th.Tensor) -> None:
        """
        Move the bounds that these observations exceed to include them, and by a quarter of the range more.

        :param observations: shape (batch, obs_dim), finite
        """
        lowest = th.minimum(self.low, observations.amin(dim=0))
        highest = th.maximum(self.high, observations.amax(dim=0))
        margin = MARGIN * (highest - lowest)
        self._set(
            th.where(lowest < self.low, lowest - margin, self.low),
            th.where(highest > self.high, highest + margin, self.high),
        )

    def take_over(self, before: Bounds) -> None:
        """
        Take the range of the open dimensions from other bounds.

        :param before: bounds of the same dimensions
        """
        self.seen_low.copy_(before.seen_low)
        self.seen_high.copy_(before.seen_high)
        ends_stay = not self.adaptive
        low = th.where(self.lowest.isfinite() & ends_stay, self.lowest, before.low)
        high = th.where(self.highest.isfinite() & ends_stay, self.highest, before.high)
        self._set(th.where(self.open, low, self.low), th.where(self.open, high, self.high))

    def reach(self) -> tuple[th.Tensor, th.Tensor]:
        """
        :return: the values (low, high) beyond which :meth:`widen` moves a bound, each of shape (obs_dim,), observation
            units; infinite where a bound has reached its limit
        """
        low = th.where(self.low > self.lowest, self.low, -th.inf)
        return low, th.where(self.high < self.highest, self.high, th.inf)

    def _set(self, low: th.Tensor, high: th.Tensor) -> None:
        self.low.copy_(th.maximum(low, self.lowest))
        self.high.copy_(th.minimum(high, self.highest))

    def scale(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: shape (..., obs_dim), observation units
        :return: the observations in scaled units, in [-1, 1] within the bounds (eq. 4)
        """
        return (2.0 * ((observations - self.low) / (self.high - self.low)) - 1.0).clamp(-FARTHEST, FARTHEST)

    def unscale(self, scaled: th.Tensor) -> th.Tensor:
        """
        :param scaled: shape (..., obs_dim), scaled units
        :return: the values in observation units
        """
        return self.low + 0.5 * (scaled + 1.0) * (self.high - self.low)


class VisitedBounds(Bounds):
    """
    Bounds whose open dimensions have the range that was visited. A dimension that was constant so far has one unit on
    each side of its value.

    :param low: lower bounds, shape (obs_dim,), observation units
    :param high: upper bounds, shape (obs_dim,), observation units
    :param adaptive: whether all dimensions are open
    """

    @property
    def is_open(self) -> bool:
        """False: no range has to be measured before learning."""
        return False

    def widen(self, observations: th.Tensor) -> None:
        """
        Set the range of the open dimensions to that of all observations so far.

        :param observations: shape (batch, obs_dim), finite
        """
        self.seen_low.copy_(th.minimum(self.seen_low, observations.amin(dim=0)))
        self.seen_high.copy_(th.maximum(self.seen_high, observations.amax(dim=0)))
        margin = th.where(self._varied(), 0.0, 1.0)
        self._set(
            th.where(self.open, self.seen_low - margin, self.low),
            th.where(self.open, self.seen_high + margin, self.high),
        )

    def reach(self) -> tuple[th.Tensor, th.Tensor]:
        """
        :return: the values (low, high) beyond which an observation widens the range by more than a tenth, each of
            shape (obs_dim,), observation units; infinite where the range is not open or has reached its limit
        """
        slack = th.where(self._varied(), SLACK * (self.seen_high - self.seen_low), 0.0)
        low = th.where(self.open & (self.seen_low > self.lowest), self.seen_low - slack, -th.inf)
        return low, th.where(self.open & (self.seen_high < self.highest), self.seen_high + slack, th.inf)

    def _varied(self) -> th.Tensor:
        """Whether a range was visited in each dimension, shape (obs_dim,), bool."""
        largest = th.maximum(self.seen_low.abs(), self.seen_high.abs())
        return self.seen_high - self.seen_low > RESOLUTION * largest


def count_states(observation_space: spaces.Space[Any]) -> tuple[np.ndarray, np.ndarray]:
    """
    :param observation_space: Discrete, or MultiDiscrete or MultiBinary of one axis
    :return: the first state and the number of states of each component, each of shape (obs_dim,)
    :raises TypeError: if the space is not one of these
    """
    if isinstance(observation_space, spaces.Discrete):
        return np.array([observation_space.start]), np.array([observation_space.n])
    if isinstance(observation_space, spaces.MultiDiscrete):
        return observation_space.start, observation_space.nvec
    if isinstance(observation_space, spaces.MultiBinary):
        return np.zeros(observation_space.shape, np.int64), np.full(observation_space.shape, 2)
    raise TypeError(f"no states can be counted in {observation_space}")


def make_bounds(
    bounds: Any, observation_space: spaces.Space[Any], *, from_space: bool = True, visited: bool = False
) -> Bounds:
    """
    :param bounds: ``None`` for the bounds of the space, ``"adaptive"`` to follow the observations within the bounds of
        the space, a pair (low, high) of arrays of shape (obs_dim,) in observation units, or a dict of some dimensions
        and their (low, high), the others as with ``None``. A bound that is infinite or NaN has to be measured
    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :param from_space: whether the bounds of the space hold. They do not for an environment wrapped in VecNormalize;
        then all dimensions are open unless ``bounds`` are given
    :param visited: whether the open dimensions have the range that was visited, see :class:`VisitedBounds`
    :return: the bounds
    :raises ValueError: if ``bounds`` has another form, is larger than 1e10, or low >= high somewhere
    """
    kind = VisitedBounds if visited else Bounds
    low, high = _bounds_of(observation_space)
    # A space with one bound says little about the range: both are measured.
    sensible = (np.abs(low) <= LARGEST_SENSIBLE_BOUND) & (np.abs(high) <= LARGEST_SENSIBLE_BOUND) & from_space
    low, high = np.where(sensible, low, -np.inf), np.where(sensible, high, np.inf)
    if bounds is None:
        return kind(low, high)
    if not isinstance(observation_space, spaces.Box):
        raise ValueError(
            f"bounds must be None for a {type(observation_space).__name__} observation space, whose states are "
            f"the points; got {shown(bounds)}"
        )
    if isinstance(bounds, str) and bounds == "adaptive":
        return kind(low, high, adaptive=True)
    return kind(*check_box("bounds", bounds, low, high, "None, 'adaptive', or "))


def check_box(
    name: str, value: Any, low: np.ndarray, high: np.ndarray, also: str = "", thin: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """
    :param name: name of the argument
    :param value: a pair (low, high) of arrays of shape (n_dims,), or a dict of some dimensions and their (low, high).
        A bound may be infinite or NaN
    :param low: lower bounds of the dimensions that a dict does not name, shape (n_dims,)
    :param high: upper bounds of them, shape (n_dims,)
    :param also: what else the argument may be, for the message
    :param thin: whether low may equal high
    :return: the lower and the upper bounds, shape (n_dims,) each
    :raises ValueError: if ``value`` has another form, a bound is finite and larger than 1e10, or low is not below high
    """
    n_dims = len(low)
    forms = f"a pair (low, high) of {n_dims} numbers each, or a dict such as {{{n_dims - 1}: (-3.0, 3.0)}}"
    try:
        if isinstance(value, Mapping):
            given_low, given_high = low.copy(), high.copy()
            for key, pair in value.items():
                # JSON turns the keys of a saved dict into text.
                dimension = check_integer(
                    f"{name}: a dimension", int(key) if isinstance(key, str) else key, 0, n_dims - 1
                )
                given_low[dimension], given_high[dimension] = check_numbers(name, pair)
        else:
            given_low, given_high = (check_numbers(name, bound) for bound in value)
    except (TypeError, ValueError) as error:
        reason = f" ({error})" if isinstance(value, Mapping) else ""
        raise ValueError(f"{name} must be {also}{forms}; got {shown(value)}{reason}") from error
    for end, given in (("low", given_low), ("high", given_high)):
        if given.shape != (n_dims,):
            raise ValueError(
                f"{name}: {end} must have shape {(n_dims,)}, one number for each dimension; got shape {given.shape}"
            )
        if np.any(np.isfinite(given) & (np.abs(given) > LARGEST_SENSIBLE_BOUND)):
            raise ValueError(
                f"{name}: {end} must be at most {LARGEST_SENSIBLE_BOUND:g} in size, or infinite or NaN; got {given}"
            )
    wrong = given_low > given_high if thin else given_low >= given_high
    if wrong.any():
        dimension = int(np.argmax(wrong))
        raise ValueError(
            f"{name}: low must be {'at most' if thin else 'below'} high in every dimension; in dimension {dimension} "
            f"low is {given_low[dimension]:g} and high is {given_high[dimension]:g}"
        )
    return given_low, given_high


def _bounds_of(observation_space: spaces.Space[Any]) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(observation_space, spaces.Box):
        return observation_space.low.astype(np.float64), observation_space.high.astype(np.float64)
    first, counts = count_states(observation_space)
    # The only point of a dimension is in the middle of its range: for a single state, that state.
    single = (counts == 1).astype(np.float64)
    return first - single, first + np.maximum(counts - 1, 1)
