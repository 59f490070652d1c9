"""A sampler whose first trial is the configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from optuna import Study
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.samplers import BaseSampler
from optuna.trial import FrozenTrial, TrialState


class ConfigurationFirst(BaseSampler):
    """
    Wraps a sampler: the first trial of a study uses given values, so that the other trials can be compared with them
    and the best trial is never worse.

    :param sampler: sampler of the other trials, and of values that are not given
    :param values: values of the first trial by name; numbers outside the search range are clipped to it, and categories
        that are not searched are left to the sampler
    """

    def __init__(self, sampler: BaseSampler, values: Mapping[str, Any]) -> None:
        self.sampler = sampler
        self.values = values

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return {} if trial.number == 0 else self.sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        return self.sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        value = self.values.get(param_name) if trial.number == 0 else None
        if isinstance(param_distribution, CategoricalDistribution):
            if value in param_distribution.choices:
                return value
        elif isinstance(value, float | int):
            return min(max(value, param_distribution.low), param_distribution.high)  # type: ignore[attr-defined]
        return self.sampler.sample_independent(study, trial, param_name, param_distribution)

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        self.sampler.before_trial(study, trial)

    def after_trial(self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None) -> None:
        self.sampler.after_trial(study, trial, state, values)

    def reseed_rng(self) -> None:
        self.sampler.reseed_rng()
