"""Planning: from transitions to the values of a table."""

from sb3_knntd.planning.base import Planner, PlanSettings
from sb3_knntd.planning.local import LocalPlanner
from sb3_knntd.planning.states import StatePlanner

__all__ = ["LocalPlanner", "PlanSettings", "Planner", "StatePlanner"]
