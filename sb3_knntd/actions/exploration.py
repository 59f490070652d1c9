"""Exploration policies for discrete actions."""

from __future__ import annotations

from typing import ClassVar, Protocol

import torch as th

from sb3_knntd.kernels.selection import Exploration


def greedy(values: th.Tensor, ranks: th.Tensor | None = None) -> th.Tensor:
    """
    The best action of each row.

    :param values: shape (..., n_actions)
    :param ranks: uniform random numbers in [0, 1) that break ties between best actions, shape (...); if not given, the
        first is taken
    :return: shape (...), int64
    """
    best = values == values.amax(dim=-1, keepdim=True)
    if ranks is None:
        return best.int().argmax(dim=-1)
    count = best.cumsum(dim=-1)
    return (count == 1 + pick(ranks, count[..., -1])[..., None]).int().argmax(dim=-1)


def pick(uniforms: th.Tensor, n: th.Tensor | int) -> th.Tensor:
    """
    :param uniforms: random numbers in [0, 1)
    :param n: number of choices, at least 1
    :return: uniformly distributed integers in [0, n), of the shape of ``uniforms``
    """
    # The product may be rounded up to n.
    return (uniforms * n).long().clamp(max=n - 1) if isinstance(n, int) else th.minimum((uniforms * n).long(), n - 1)


class ExplorationPolicy(Protocol):
    """A stochastic policy over action values. ``rate`` is ε or the temperature."""

    #: the corresponding exploration of the kernels
    CODE: ClassVar[Exploration]
    #: number of uniform random numbers used for one action
    N_UNIFORMS: ClassVar[int]

    def choose(self, values: th.Tensor, uniforms: th.Tensor, rate: float, random_ties: bool) -> th.Tensor:
        """
        :param values: action values, shape (batch, n_actions)
        :param uniforms: random numbers in [0, 1), shape (batch, N_UNIFORMS)
        :param rate: ε or the temperature
        :param random_ties: whether ties between best actions are broken at random, otherwise the first is taken
        :return: actions, shape (batch,), int64
        """
        ...

    def expectation(self, values: th.Tensor, rate: float) -> th.Tensor:
        """
        :param values: action values, shape (batch, n_actions)
        :param rate: ε or the temperature
        :return: the mean value under this policy, shape (batch,)
        """
        ...


class EpsilonGreedy:
    """A uniformly random action with probability ε, otherwise the best one."""

    CODE: ClassVar[Exploration] = Exploration.EPSILON_GREEDY
    N_UNIFORMS: ClassVar[int] = 2

    def choose(self, values: th.Tensor, uniforms: th.Tensor, rate: float, random_ties: bool) -> th.Tensor:
        best = greedy(values, uniforms[:, 1] if random_ties else None)
        # A random one of the best of equal values: of all actions that are not forbidden.
        drawn = greedy(values > -th.inf, uniforms[:, 1])
        return th.where(uniforms[:, 0] < rate, drawn, best)

    def expectation(self, values: th.Tensor, rate: float) -> th.Tensor:
        allowed = values > -th.inf
        mean = values.where(allowed, 0.0).sum(dim=-1) / allowed.sum(dim=-1)
        return (1.0 - rate) * values.amax(dim=-1) + rate * mean


class Softmax:
    """An action with probability proportional to exp(Q / temperature)."""

    CODE: ClassVar[Exploration] = Exploration.SOFTMAX
    N_UNIFORMS: ClassVar[int] = 1

    def choose(self, values: th.Tensor, uniforms: th.Tensor, rate: float, random_ties: bool) -> th.Tensor:
        shares = th.softmax(values / rate, dim=-1).cumsum(dim=-1)
        # Scale by the last sum, which may be less than 1 due to rounding.
        return (uniforms[:, :1] * shares[:, -1:] >= shares).sum(dim=-1).clamp(max=values.shape[-1] - 1)

    def expectation(self, values: th.Tensor, rate: float) -> th.Tensor:
        # 0 * -inf is NaN.
        return (th.softmax(values / rate, dim=-1) * values).nansum(dim=-1)


#: The exploration policies by the name that users pass.
EXPLORATIONS: dict[str, type[ExplorationPolicy]] = {
    policy.CODE.name.lower(): policy for policy in (EpsilonGreedy, Softmax)
}
