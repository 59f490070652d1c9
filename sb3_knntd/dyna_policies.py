"""The policies of KNNDyna: tables whose weights are as wide as their points are apart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy

from sb3_knntd.actions.peak import PeakSelector
from sb3_knntd.actions.selection import ActionSelector
from sb3_knntd.perception import GrowingPoints
from sb3_knntd.perception.weights import KernelWeights
from sb3_knntd.policies import ExAPolicy, KNNPolicy

#: Bandwidth of the weights, in spacings of the points.
BANDWIDTH = 0.7


class SpacedPolicy(KNNPolicy):
    """
    A policy whose bandwidth follows the spacing of points that grow, and whose values are planned: they cannot be set.
    """

    @property
    def bandwidth(self) -> float:
        """Bandwidth of the weights, scaled units."""
        assert isinstance(self.perceiver.weights, KernelWeights)
        return self.perceiver.weights.bandwidth

    def match_spacing(self) -> None:
        """Set the bandwidth by the spacing of the points. To be called when that has changed."""
        points, weights = self.perceiver.points, self.perceiver.weights
        if isinstance(points, GrowingPoints) and isinstance(weights, KernelWeights):
            weights.bandwidth = BANDWIDTH * float(points.spacing)
            self.perceiver.fit()

    def set_q(self, observation: np.ndarray, action: Any, value: Any) -> None:
        """
        Raises an error: the values are planned.

        :param observation: has no effect
        :param action: has no effect
        :param value: has no effect
        :raises ValueError: always
        """
        raise self._planned("set_q")

    def fill(self, function: Callable[[np.ndarray], Any]) -> None:
        """
        Raises an error: the values are planned.

        :param function: has no effect
        :raises ValueError: always
        """
        raise self._planned("fill")

    def imitate(self, controller: Any, margin: float | None = None) -> None:
        """
        Raises an error: the values are planned. ``model.imitate`` learns the model from a controller's steps.

        :param controller: has no effect
        :param margin: has no effect
        :raises ValueError: always
        """
        raise self._planned("imitate")

    @staticmethod
    def _planned(method: str) -> ValueError:
        return ValueError(
            f"{method} has no place in KNNDyna: the next plan would overwrite what it sets. Teach the model by "
            "model.learn_from(data) or model.imitate(controller), give a reward_function, or forbid actions by "
            "policy.forbid"
        )

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        answer = super().load_state_dict(state_dict, strict, assign)
        self.match_spacing()
        return answer


class DynaPolicy(SpacedPolicy):
    """
    A table of action values at points that grow. The parameters are those of :class:`~sb3_knntd.KNNPolicy`.
    """


class DynaBoxPolicy(SpacedPolicy, ExAPolicy):
    """
    A table of the values of action points. The values of the neighbours are averaged, and the action is the peak of a
    parabola through the best action point and those next to it, see :class:`~sb3_knntd.actions.peak.PeakSelector`.
    The parameters are those of :class:`~sb3_knntd.ExAPolicy`.
    """

    def _greedy_selector(self) -> ActionSelector:
        return PeakSelector(self.columns, random_ties=False, rules=self.rules)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The greedy action.

        :param observation: one observation, or a batch, observation units
        :param state: has no effect and is returned
        :param episode_start: has no effect
        :param deterministic: has no effect, the policy is deterministic
        :return: action, or a batch of actions, and ``state``
        """
        actions, state = BasePolicy.predict(self, observation, state, episode_start, deterministic)
        return actions.astype(self.action_space.dtype), state


def policy_for(action_space: spaces.Space[Any]) -> type[KNNPolicy]:
    """
    :param action_space: Discrete or Box
    :return: the policy for it
    """
    return DynaBoxPolicy if isinstance(action_space, spaces.Box) else DynaPolicy
