"""Planning: from transitions to the values of a table."""

from sb3_knntd.planning.base import Planner, PlanSettings
from sb3_knntd.planning.learner import DynaLearner
from sb3_knntd.planning.local import LocalPlanner
from sb3_knntd.planning.states import StatePlanner

__all__ = ["DynaLearner", "LocalPlanner", "PlanSettings", "Planner", "StatePlanner"]
