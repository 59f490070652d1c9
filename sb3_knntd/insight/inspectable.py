"""Models that can be asked what they have learned."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from sb3_knntd.insight.diagnosis import TABLE_CHECKLIST, Checklist, Diagnosis, diagnose
from sb3_knntd.insight.explanation import Explanation, explain
from sb3_knntd.online_algorithm import OnlineAlgorithm
from sb3_knntd.plots import Names
from sb3_knntd.policies import KNNPolicy


class Inspectable(OnlineAlgorithm):
    """
    An online algorithm whose policy is a table.

    The parameters are those of SB3's BaseAlgorithm.
    """

    #: what :meth:`diagnose` looks for
    checklist: ClassVar[Checklist] = TABLE_CHECKLIST
    policy: KNNPolicy
    gamma: Any
    #: ε or the temperature at the last step
    exploration_rate: float

    def explain(self, observation: np.ndarray, names: Names | None = None) -> Explanation:
        """
        Explain the action at an observation: ``print`` shows the neighbours, their weights and values, and ``plot``
        draws them.

        :param observation: one observation, as :meth:`predict` takes it
        :param names: names of the dimensions and actions; by default those of the environment, or numbers
        :return: the explanation
        :raises ValueError: if it is not one finite observation, or ``names`` do not fit
        """
        return explain(self, observation, names)

    def diagnose(self, names: Names | None = None) -> Diagnosis:
        """
        Look for what hinders learning in the table and in the statistics of the steps learned from.

        :param names: names of the dimensions and actions; by default those of the environment, or numbers
        :return: the findings, each with the parameter to change; empty if nothing was found
        :raises ValueError: if ``names`` do not fit
        """
        return diagnose(self, names)

    def _conclude(self) -> None:
        super()._conclude()
        if self.verbose >= 1:
            for finding in self.diagnose():
                print(f"Check {finding}")
