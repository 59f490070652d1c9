"""What hinders learning with a model and planning."""

from __future__ import annotations

from collections.abc import Iterator

from sb3_knntd.insight.diagnosis import Case, Checklist, Finding, beyond_bounds, saturated
from sb3_knntd.perception import GrowingPoints
from sb3_knntd.planning.learner import DynaLearner

#: After fewer steps nothing is said.
LEAST_STEPS = 1_000
#: Error of the model, as a share of the changes that it predicts.
MOST_ERROR = 0.3
#: How far the spacing may have grown, since ``max_points`` was reached.
MOST_GROWTH = 1.5


def _model_error(case: Case) -> Iterator[Finding]:
    share = _learner(case).planner.error_share
    if share > MOST_ERROR:
        yield Finding(
            "model_error",
            "env",
            share,
            f"the model's predictions are off by {share:.0%} of the change in a step. If the state is not observed, "
            "such as a velocity, observe it or give the last observations too (FrameStackObservation, flattened); if "
            "observations are noisy, filter them (DeltaFilter); if the state jumps, take KNNTD or ExA",
        )


def _same_rewards(case: Case) -> Iterator[Finding]:
    if not _learner(case).planner.rewards.differs:
        yield Finding(
            "same_rewards",
            "optimism",
            case.experience.rewards[0],
            f"every reward was {case.experience.rewards[0]:g} and no episode has ended by itself, so that there is "
            "nothing to plan for. If there are others to be found, train longer, give a larger optimism, or, if it is "
            "known, a reward_function that leads to them",
        )


def _max_points(case: Case) -> Iterator[Finding]:
    points = case.policy.perceiver.points
    if not isinstance(points, GrowingPoints):
        return
    growth = float(points.spacing) / points.initial_spacing
    if growth > MOST_GROWTH:
        yield Finding(
            "max_points",
            "max_points",
            growth,
            f"max_points={points.max_points:,} was reached, and the spacing of the points has grown from "
            f"{points.initial_spacing:.3g} to {float(points.spacing):.3g}: the policy is coarse. Give more max_points, "
            "or leave dimensions out of the observations",
        )


def _learner(case: Case) -> DynaLearner:
    learner = getattr(case.model, "learner", None)
    assert isinstance(learner, DynaLearner)
    return learner


CHECKLIST = Checklist(LEAST_STEPS, (_model_error, _same_rewards, beyond_bounds, _max_points, saturated))
