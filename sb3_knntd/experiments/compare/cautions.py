"""Warnings about results that do not compare well."""

from __future__ import annotations

import json
from statistics import median

from sb3_knntd.experiments.compare.configurations import label
from sb3_knntd.experiments.compare.results import Comparison
from sb3_knntd.experiments.compare.statistics import FEWEST_SEEDS

#: Below this share of a core, times depend more on the machine than on the algorithm.
BUSY_SHARE = 0.8


def cautions(comparison: Comparison) -> list[str]:
    """
    :param comparison: what is reported on
    :return: warnings for the reader, a sentence or two each
    """
    every = [run for task in comparison.tasks for runs in task.runs.values() for run in runs]
    words = []
    fewest = min(len(runs) for task in comparison.tasks for runs in task.runs.values())
    if fewest < FEWEST_SEEDS:
        words.append(
            f"Fewer than {FEWEST_SEEDS} seeds: the intervals mean little. They are drawn from so few values that they "
            "are too narrow more often than not."
        )
    if len({json.dumps(run.result["versions"]) for run in every}) > 1:
        words.append("These results were made by different versions of the software.")
    if len({json.dumps(run.result["machine"]) for run in every}) > 1:
        words.append("These results were made on different machines: times do not compare.")
    short = [
        f"{label(algo)} on {env} for {found.tuned_steps:,}"
        for (env, algo), found in comparison.configurations.items()
        if (found.tuned_steps or 0) > comparison.steps
    ]
    if short:
        words.append(f"Some configurations were made for more than {comparison.steps:,} steps: {', '.join(short)}.")
    busy = [
        share
        for task in comparison.tasks
        for runs in task.runs.values()
        if (share := median(run.cpu_share for run in runs)) < BUSY_SHARE
    ]
    if busy:
        words.append(
            f"The machine was busy with other work: some runs had no more than {min(busy):.2f} of a core. Seconds and "
            "steps/s tell of that as well."
        )
    return words
