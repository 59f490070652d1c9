"""What hinders learning, found in the table and in the statistics of the steps that were learned from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, overload

import numpy as np
from gymnasium import spaces

from sb3_knntd.perception import Lattice
from sb3_knntd.plots import Names, names_for
from sb3_knntd.policies import TableModel

#: After fewer steps nothing is said of a table that is learned from each step.
LEAST_STEPS = 5_000
#: Share of the observations beyond the bounds of a dimension.
MOST_BEYOND = 0.05
#: Share of the bounds of a dimension that the observations span. With fewer steps, a beginner may not have got far.
LEAST_SPAN, STEPS_FOR_SPAN = 0.1, 10_000
#: Median number of updates of a visited point.
LEAST_VISITS = 2
#: Share of the visits to points whose greedy action was never tried, or whose values never changed.
MOST_UNTRIED = 0.3
#: How much of the way from the attainable returns to the initial value the values still are.
MOST_OPTIMISM = 0.2
#: Steps that a state takes to move from one point to the next along the fastest dimension.
MOST_STEPS_PER_POINT = 50
#: ε at the end of training.
MOST_EPSILON = 0.1
#: How far values may be beyond the returns that the rewards allow, as a multiple of their range.
MOST_EXCESS = 10.0
#: A value is saturated at this share of the worst possible one; share of the visits to points with such values.
SATURATED, MOST_SATURATED = 0.95, 0.5
#: How much values change if a dimension is shuffled, as a share of their standard deviation. It is not told from fewer
#: steps, fewer pairs of points that differ in the dimension, or a smaller share of its bounds.
LEAST_EFFECT, STEPS_FOR_EFFECT, PAIRS_FOR_EFFECT, SPAN_FOR_EFFECT = 0.12, 10_000, 100, 0.5
#: Number of points that the effect of a dimension is computed from.
SAMPLE = 1_000


class TrainedModel(TableModel, Protocol):
    """A model whose policy is a table that it has learned."""

    gamma: Any
    #: ε or the temperature at the last step
    exploration_rate: float

    checklist: ClassVar[Checklist]


@dataclass(frozen=True)
class Finding:
    """
    Something that hinders learning.

    :param name: which kind of finding it is, see :func:`diagnose`
    :param parameter: the parameter to change
    :param value: the measured number that led to it
    :param message: what was found and what to do
    :param dims: the observation dimensions that it is about
    """

    name: str
    parameter: str
    value: float
    message: str
    dims: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.parameter}: {self.message}"


@dataclass(frozen=True)
class Diagnosis(Sequence[Finding]):
    """
    The findings, most important first: a sequence, empty if nothing was found.

    :param findings: the findings
    :param n_steps: number of steps that were learned from
    :param n_points: number of points
    :param n_visited: number of points that were visited
    :param visits: median number of updates of a visited point
    :param least_steps: number of steps that a diagnosis takes
    """

    findings: tuple[Finding, ...]
    n_steps: int
    n_points: int
    n_visited: int
    visits: float
    least_steps: int = LEAST_STEPS

    @overload
    def __getitem__(self, index: int) -> Finding: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Finding]: ...

    def __getitem__(self, index: int | slice) -> Finding | Sequence[Finding]:
        return self.findings[index]

    def __len__(self) -> int:
        return len(self.findings)

    def __str__(self) -> str:
        facts = (
            f"{self.n_steps:,} steps, {self.n_visited:,} of {self.n_points:,} points visited "
            f"({self.n_visited / self.n_points:.1%}), each {self.visits:,.0f} times (median)"
        )
        if self:
            return "\n".join([facts, *(f"- {finding}" for finding in self)])
        few = f"Too few steps for a diagnosis: it takes {self.least_steps:,}."
        return f"{facts}\n{few if self.n_steps < self.least_steps else 'Nothing was found.'}"


class Case:
    """
    What the checks look at.

    :param model: the model
    :param names: names of the dimensions and actions
    """

    def __init__(self, model: TrainedModel, names: Names) -> None:
        policy = model.policy
        self.model, self.policy, self.names = model, policy, names
        self.experience = policy.experience
        bounds = policy.perceiver.bounds
        self.low, self.high = bounds.low.cpu().numpy(), bounds.high.cpu().numpy()
        self.seen_low, self.seen_high = self.experience.low.cpu().numpy(), self.experience.high.cpu().numpy()
        with policy.table.lock:
            counts, rows = policy.visits.cpu().numpy(), policy.q_table.double().cpu().numpy()
        visited = counts > 0
        #: of the visited points: number of updates, share of all updates, and values
        self.visits, self.rows = counts[visited], rows[visited]
        self.weights = self.visits / max(1, self.visits.sum())
        self.visited = np.flatnonzero(visited)

    @property
    def is_box(self) -> bool:
        return isinstance(self.model.observation_space, spaces.Box)

    @property
    def has_range(self) -> bool:
        """Whether the bounds are fixed, and could be other ones."""
        return self.is_box and not self.policy.perceiver.bounds.adaptive

    @cached_property
    def span(self) -> np.ndarray:
        """The range seen in each dimension, as a share of the bounds, shape (obs_dim,)."""
        span: np.ndarray = (self.seen_high - self.seen_low) / (self.high - self.low)
        return span

    @cached_property
    def spacing(self) -> np.ndarray:
        """Distance of neighbouring points of a lattice, shape (obs_dim,), observation units; infinite without any."""
        points = self.policy.perceiver.points
        if not isinstance(points, Lattice):
            return np.full(len(self.low), np.inf)
        gaps = np.array(points.shape) - 1
        spacing: np.ndarray = np.where(gaps > 0, (self.high - self.low) / np.maximum(gaps, 1), np.inf)
        return spacing

    @property
    def attainable(self) -> tuple[float, float]:
        """The lowest and the highest return of endless episodes with the rewards that were seen."""
        gamma, n_steps = float(self.model.gamma), self.experience.n_steps
        horizon = n_steps if gamma == 1.0 else min(n_steps, 1.0 / (1.0 - gamma))
        lowest, highest = self.experience.rewards
        return lowest * horizon, highest * horizon

    @cached_property
    def factors(self) -> list[np.ndarray]:
        """The values of the visited points for each action factor, shape (n, n_columns)."""
        return [self.rows[:, first:end] for first, end in self.policy.selector.factor_ranges]

    @cached_property
    def values(self) -> np.ndarray:
        """The value of the greedy action at each visited point, shape (n,)."""
        values: np.ndarray = np.mean([rows.max(axis=1) for rows in self.factors], axis=0)
        return values

    def range_of(self, dim: int) -> str:
        """The range seen in a dimension."""
        return f"{self.seen_low[dim]:.3g} to {self.seen_high[dim]:.3g}"


class Checklist(NamedTuple):
    """
    What an algorithm is checked for.

    :param least_steps: number of steps that the checks take
    :param checks: the checks, the most important first
    :param at_once: those that are made after fewer steps
    """

    least_steps: int
    checks: tuple[Callable[[Case], Iterator[Finding]], ...]
    at_once: tuple[Callable[[Case], Iterator[Finding]], ...] = ()


def diagnose(model: TrainedModel, names: Names | None = None) -> Diagnosis:
    """
    Look for what hinders learning. The names of the findings, and what each says:

    ======================== =========================================================================================
    ``diverging``            values are far beyond the returns that the rewards allow
    ``beyond_bounds``        more than 5 % of the observations are beyond the bounds of a dimension
    ``unused_range``         the observations span less than a tenth of a dimension's bounds: few points are visited
    ``constant_dimension``   all observations are the same in a dimension
    ``useless_dimension``    the values hardly depend on a dimension
    ``initial_values``       the values of most visits are still the initial ones
    ``optimism``             for more than 30 % of the visits the greedy action was never tried, or the values are still
                             above all returns that the rewards allow: the initial value is not used up
    ``too_coarse``           a state takes more than 50 steps to move from one point of the lattice to the next
    ``too_fine``             most visited points were updated only once
    ``saturated``            most values are the worst ones that γ allows
    ``exploring``            ε is still above 0.1
    ======================== =========================================================================================

    KNNDyna is checked for what hinders a model and planning instead.

    :param model: the model
    :param names: names of the dimensions and actions; by default those of the environment, or numbers
    :return: the findings; after fewer than 5,000 steps ``diverging`` only; KNNDyna: none after fewer than 1,000
    :raises ValueError: if ``names`` do not fit
    """
    case = Case(model, names_for(model, names))
    n_steps, checklist = case.experience.n_steps, model.checklist
    checks = checklist.checks if n_steps >= checklist.least_steps else checklist.at_once
    findings = [finding for check in checks for finding in check(case)] if n_steps and len(case.visits) else []
    median = float(np.median(case.visits)) if len(case.visits) else 0.0
    n_points = model.policy.perceiver.points.n_points
    return Diagnosis(tuple(findings), n_steps, n_points, len(case.visits), median, checklist.least_steps)


def _diverging(case: Case) -> Iterator[Finding]:
    initial, (lowest, highest) = case.policy.table.initial_value, case.attainable
    least, most = min(0.0, initial, lowest), max(0.0, initial, highest)
    excess = max(float(case.values.max()) - most, least - float(case.values.min()), 0.0)
    if excess > MOST_EXCESS * max(most - least, 1e-300):
        yield Finding(
            "diverging",
            "learning_rate",
            excess,
            f"values reach {max(case.values, key=abs):.3g}, far beyond the returns of {least:.3g} to {most:.3g} that "
            "the rewards allow: they diverge. Lower learning_rate or trace_decay, or use step_size='normalized' and "
            "traces='replacing'",
        )


def beyond_bounds(case: Case) -> Iterator[Finding]:
    """
    :param case: what to look at
    :return: dimensions in which many observations are beyond the bounds
    """
    shares = case.experience.share_beyond.cpu().numpy()
    for dim in np.flatnonzero(case.has_range & (shares > MOST_BEYOND)).tolist():
        yield Finding(
            "beyond_bounds",
            "bounds",
            float(shares[dim]),
            f"{shares[dim]:.0%} of the observations are beyond [{case.low[dim]:.3g}, {case.high[dim]:.3g}] in "
            f"{case.names.observations[dim]}, which was {case.range_of(dim)}. Give wider bounds, or bounds='adaptive'",
            (dim,),
        )


def _unused_range(case: Case) -> Iterator[Finding]:
    if not case.has_range or case.experience.n_steps < STEPS_FOR_SPAN:
        return
    # With two points or fewer every observation uses all of them.
    several = case.spacing < (case.high - case.low) / 1.5
    share = len(case.visits) / case.policy.perceiver.points.n_points
    for dim in np.flatnonzero(several & (case.span < LEAST_SPAN) & (case.span > 0)).tolist():
        yield Finding(
            "unused_range",
            "bounds",
            float(case.span[dim]),
            f"{case.names.observations[dim]} was {case.range_of(dim)}, {case.span[dim]:.0%} of the bounds "
            f"[{case.low[dim]:.3g}, {case.high[dim]:.3g}], and only {share:.1%} of the points were visited. Give "
            "narrower bounds, or bounds='adaptive'",
            (dim,),
        )


def _constant_dimension(case: Case) -> Iterator[Finding]:
    for dim in np.flatnonzero(case.is_box & (case.span == 0) & np.isfinite(case.spacing)).tolist():
        yield Finding(
            "constant_dimension",
            "points",
            0.0,
            f"{case.names.observations[dim]} was always {case.seen_low[dim]:.3g}. Leave it out of the observations, or "
            "give it a single point",
            (dim,),
        )


def _useless_dimension(case: Case) -> Iterator[Finding]:
    if not case.is_box or case.experience.n_steps < STEPS_FOR_EFFECT:
        return
    generator = np.random.default_rng(0)
    rows = generator.choice(len(case.visited), SAMPLE, p=case.weights)
    places = case.policy.points.cpu().numpy()[case.visited[rows]]
    values = case.policy.q_values(places).cpu().numpy()
    spread = float(values.std(axis=0).mean())
    if not spread > 0.0:
        return
    for dim in np.flatnonzero(np.isfinite(case.spacing) & (case.span > SPAN_FOR_EFFECT)).tolist():
        moved = places.copy()
        moved[:, dim] = generator.permutation(places[:, dim])
        differ = np.abs(moved[:, dim] - places[:, dim]) > case.spacing[dim] / 2
        if differ.sum() < PAIRS_FOR_EFFECT:
            continue
        changes = np.abs(case.policy.q_values(moved[differ]).cpu().numpy() - values[differ])
        effect = float(changes.mean()) / spread
        if effect < LEAST_EFFECT:
            yield Finding(
                "useless_dimension",
                "points",
                effect,
                f"the values hardly depend on {case.names.observations[dim]}: they change by {effect:.0%} of their "
                "standard deviation with it. Leave it out of the observations, or give it a single point",
                (dim,),
            )


def _initial_values(case: Case) -> Iterator[Finding]:
    initial = case.policy.table.initial_value
    share = float(case.weights[(case.rows == initial).all(axis=1)].sum())
    if share > 1.0 - MOST_UNTRIED:
        lowest, highest = case.experience.rewards
        rewards = f"every reward was {lowest:g}" if lowest == highest else f"rewards were {lowest:g} to {highest:g}"
        yield Finding(
            "initial_values",
            "initial_value",
            share,
            f"the values of {share:.0%} of the visits are still {initial:g}, and {rewards}. If there are others to be "
            "found, give an initial_value above the returns that can be attained: the model then tries every action",
        )


def _optimism(case: Case) -> Iterator[Finding]:
    initial = case.policy.table.initial_value
    untried = np.zeros(len(case.rows), bool)
    for rows in case.factors:
        untried |= (rows.max(axis=1) == initial) & (rows != initial).any(axis=1)
    share = float(case.weights[untried].sum())
    if share > MOST_UNTRIED:
        yield Finding(
            "optimism",
            "initial_value",
            share,
            f"for {share:.0%} of the visits the greedy action was never tried, as initial_value={initial:g} is above "
            "the values of the others. Give a lower one, or train longer",
        )
    most, mean = max(0.0, case.attainable[1]), float(case.weights @ case.values)
    if initial > most and mean > most + MOST_OPTIMISM * (initial - most):
        yield Finding(
            "optimism",
            "initial_value",
            mean,
            f"the values are {mean:.3g} on average, and the rewards allow at most {most:.3g}: what is left of "
            f"initial_value={initial:g} decides what the model does. Give one nearer to {most:.3g}, or train longer",
        )


def _too_coarse(case: Case) -> Iterator[Finding]:
    if not case.is_box:
        return
    moves = case.experience.mean_change.cpu().numpy() / case.spacing
    dim = int(moves.argmax())
    if 0.0 < moves[dim] * MOST_STEPS_PER_POINT < 1.0:
        yield Finding(
            "too_coarse",
            "points",
            float(moves[dim]),
            f"from one point to the next takes {1 / moves[dim]:,.0f} steps even along {case.names.observations[dim]}, "
            "the fastest dimension, so that the points hardly tell the steps apart. Give more points, or hold each "
            "action for several steps",
            (dim,),
        )


def _too_fine(case: Case) -> Iterator[Finding]:
    median = float(np.median(case.visits))
    if case.is_box and median < LEAST_VISITS:
        yield Finding(
            "too_fine",
            "points",
            median,
            f"most of the {len(case.visits):,} visited points were updated only once. Give fewer points, more "
            "n_neighbors, or train longer",
        )


def saturated(case: Case) -> Iterator[Finding]:
    """
    :param case: what to look at
    :return: a finding if most values are the worst ones that γ allows
    """
    gamma, (lowest, _) = float(case.model.gamma), case.experience.rewards
    if gamma == 1.0 or lowest >= 0.0:
        return
    worst = lowest / (1.0 - gamma)
    share = float(case.weights[case.values <= SATURATED * worst].sum())
    if share > MOST_SATURATED:
        yield Finding(
            "saturated",
            "gamma",
            share,
            f"the values of {share:.0%} of the visits are {worst:.3g}, the worst that rewards of {lowest:g} and "
            f"gamma={gamma:g} can give: what comes after {1 / (1 - gamma):,.0f} steps does not count. Give a larger "
            "gamma",
        )


def _exploring(case: Case) -> Iterator[Finding]:
    epsilon = float(case.model.exploration_rate)
    if epsilon > MOST_EPSILON and not case.policy.selector.rate_is_temperature:
        yield Finding(
            "exploring",
            "exploration_final_eps",
            epsilon,
            f"ε is still {epsilon:.2g}: the values are those of a policy that acts at random that often. Give a lower "
            "exploration_final_eps, or a smaller exploration_fraction",
        )


#: Of a table that is learned from each step. Values that diverge need no more steps to be certain of.
TABLE_CHECKLIST = Checklist(
    least_steps=LEAST_STEPS,
    checks=(
        _diverging,
        beyond_bounds,
        _unused_range,
        _constant_dimension,
        _useless_dimension,
        _initial_values,
        _optimism,
        _too_coarse,
        _too_fine,
        saturated,
        _exploring,
    ),
    at_once=(_diverging,),
)
