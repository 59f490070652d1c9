"""Warnings about results that are not directly comparable."""

from __future__ import annotations

import json
from statistics import median

from sb3_knntd.experiments.compare.configurations import label
from sb3_knntd.experiments.compare.results import Comparison
from sb3_knntd.experiments.compare.statistics import FEWEST_SEEDS

#: Below this share of a core, times depend more on the load of the machine than on the algorithm.
BUSY_SHARE = 0.8


def cautions(comparison: Comparison) -> list[str]:
    """
    :param comparison: the comparison to report
    :return: warnings for the reader, one or two sentences each
    """
    every = [run for task in comparison.tasks for runs in task.runs.values() for run in runs]
    words = []
    fewest = min(len(runs) for task in comparison.tasks for runs in task.runs.values())
    if fewest < FEWEST_SEEDS:
        words.append(
            f"Fewer than {FEWEST_SEEDS} seeds: the intervals are not reliable. Bootstrap intervals from so few values "
            "are usually too narrow."
        )
    if len({json.dumps(run.result["versions"]) for run in every}) > 1:
        words.append("The runs used different versions of the software.")
    if len({json.dumps(run.result["machine"]) for run in every}) > 1:
        words.append("The runs used different machines: times are not comparable.")
    short = [
        f"{label(algo)} on {env} for {found.tuned_steps:,}"
        for (env, algo), found in comparison.configurations.items()
        if (found.tuned_steps or 0) > comparison.steps
    ]
    if short:
        words.append(f"Some configurations were tuned for more than {comparison.steps:,} steps: {', '.join(short)}.")
    busy = [
        share
        for task in comparison.tasks
        for runs in task.runs.values()
        if (share := median(run.cpu_share for run in runs)) < BUSY_SHARE
    ]
    if busy:
        words.append(
            f"The machine was busy with other work: some runs got only {min(busy):.2f} of a core, which affects "
            "seconds and steps/s."
        )
    return words
