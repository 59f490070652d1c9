"""Weights of the neighbours by distance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import torch as th

from sb3_knntd.common.checks import LEAST, check_member, check_number, shown
from sb3_knntd.common.tracing import is_traced
from sb3_knntd.kernels.perceive import Weighting


class Weights(Protocol):
    """Maps squared distances (batch, k), in scaled units and ascending along k, to weights (batch, k)."""

    def __call__(self, squared_distances: th.Tensor, /) -> th.Tensor: ...


class KernelWeights(ABC):
    """
    Weights that the kernels know. Each subclass names its own ``WEIGHTING``, whose formula in
    :func:`sb3_knntd.kernels.perceive.weigh` is the same.

    :param bandwidth: h, scaled units
    """

    WEIGHTING: ClassVar[Weighting]

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        # Inherited, it would have the kernels compute the formula of the parent class.
        weighting = vars(cls).get("WEIGHTING")
        if not isinstance(weighting, Weighting):
            members = ", ".join(f"Weighting.{member.name}" for member in Weighting)
            raise TypeError(
                f"{cls.__name__}.WEIGHTING must be set in the class itself, to one of {members}; got "
                f"{shown(weighting)}. Weights that the kernels do not know can be passed as a function"
            )

    def __init__(self, bandwidth: float = 1.0) -> None:
        self.bandwidth = float(bandwidth)

    @abstractmethod
    def __call__(self, squared_distances: th.Tensor) -> th.Tensor: ...


class InverseQuadratic(KernelWeights):
    """
    w = 1 / (1 + d²/h²); with h = 1 eq. 5 of the paper.

    :param bandwidth: h, scaled units
    """

    WEIGHTING = Weighting.INVERSE_QUADRATIC

    def __call__(self, squared_distances: th.Tensor) -> th.Tensor:
        return 1.0 / (1.0 + squared_distances / (self.bandwidth * self.bandwidth))


class Gaussian(KernelWeights):
    """
    w = exp(-d² / 2h²), scaled in each row to give the nearest neighbour weight 1: far outside the points all weights
    would be 0 otherwise. The normalisation cancels the scale.

    :param bandwidth: h, scaled units
    """

    WEIGHTING = Weighting.GAUSSIAN

    def __call__(self, squared_distances: th.Tensor) -> th.Tensor:
        excess = squared_distances - squared_distances[:, :1]
        return th.exp(-excess / (2.0 * (self.bandwidth * self.bandwidth)))


class Custom:
    """
    A user's function. Each return value is checked.

    :param function: from squared distances (batch, k) to weights (batch, k)
    """

    def __init__(self, function: Callable[[th.Tensor], Any]) -> None:
        self.function = function

    def __call__(self, squared_distances: th.Tensor) -> th.Tensor:
        try:
            answer = self.function(squared_distances)
        except Exception as error:
            raise ValueError(
                f"weights: the function must take squared distances, an array (batch, k); {shown(self.function)} "
                f"raised {type(error).__name__}: {error}"
            ) from error
        if is_traced():
            return self._recorded(answer)
        try:
            weights = th.as_tensor(answer, dtype=th.float64, device=squared_distances.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"weights: the function must return an array of numbers; got {shown(answer)}") from error
        if weights.shape != squared_distances.shape:
            raise ValueError(
                f"weights: the function must return an array of the shape it is given, "
                f"{tuple(squared_distances.shape)}; got {tuple(weights.shape)}"
            )
        fault = _fault(weights)
        if fault:
            raise ValueError(
                f"weights: the function must return finite numbers >= 0, not all zero in a row; it returned {fault} "
                f"for the squared distances {squared_distances[~_is_proper(weights)][0].tolist()}"
            )
        return weights

    @staticmethod
    def _recorded(answer: Any) -> th.Tensor:
        """While torch traces there are no values to check."""
        if not isinstance(answer, th.Tensor):
            raise ValueError(
                "a policy can be traced or exported if its weights are named ('inverse_quadratic', 'gaussian') or a "
                f"function of torch operations; this one returned {type(answer).__name__}. predict works with any"
            )
        return answer.double()


_BUILT_IN: dict[Weighting, type[KernelWeights]] = {kind.WEIGHTING: kind for kind in (InverseQuadratic, Gaussian)}


def make_weights(weights: Any, bandwidth: float, n_neighbors: int) -> Weights:
    """
    :param weights: ``"inverse_quadratic"``, ``"gaussian"`` or a function from squared distances (batch, k)
        in scaled units to weights (batch, k)
    :param bandwidth: h, scaled units; not used by a function
    :param n_neighbors: k, to try the function with
    :return: the weights
    :raises ValueError: if the word is unknown, h is less than 1e-100, or the function raises, or returns NaN, infinity,
        negative or all-zero weights for typical distances
    """
    bandwidth = check_number("bandwidth", bandwidth, LEAST)
    if not callable(weights):
        return _BUILT_IN[check_member("weights", weights, _BUILT_IN)](bandwidth)
    custom = Custom(weights)
    # From an observation on a point to one at the far corner of a four-dimensional box. There are more rows than
    # neighbours, so that a function that confuses the axes returns a wrong shape.
    reach = th.linspace(0.0, 1.0, n_neighbors, dtype=th.float64)
    scales, offsets = th.linspace(0.0, 4.0, n_neighbors + 2), th.linspace(0.0, 12.0, n_neighbors + 2)
    custom(scales[:, None].double() * reach + offsets[:, None].double())
    return custom


def _is_proper(weights: th.Tensor) -> th.Tensor:
    return (th.isfinite(weights) & (weights >= 0)).all(dim=1) & (weights.sum(dim=1) > 0)


def _fault(weights: th.Tensor) -> str:
    if _is_proper(weights).all():
        return ""
    if not th.isfinite(weights).all():
        return "NaN or infinity"
    return "negative weights" if (weights < 0).any() else "only zeros"
