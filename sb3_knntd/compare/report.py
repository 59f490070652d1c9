"""The report of a comparison: tables, pictures and words, one page of HTML and the files behind it."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import yaml
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from sb3_knntd.compare.configurations import FLOOR, OURS, Configuration, label
from sb3_knntd.compare.pictures import (
    colors,
    draw_aggregates,
    draw_curves,
    draw_efficiency,
    draw_improvements,
    draw_profiles,
)
from sb3_knntd.compare.results import Group, Task
from sb3_knntd.compare.statistics import (
    AGGREGATES,
    FEWEST_SEEDS,
    REPETITIONS,
    Estimate,
    aggregates,
    curves,
    improvements,
    profiles,
)
from sb3_knntd.plots import DPI

#: Below this share of a core, times tell more of the machine than of the algorithm.
BUSY_SHARE = 0.8
#: Bytes in a megabyte and in a kilobyte.
MB, KB = 1e6, 1e3


class Comparison(NamedTuple):
    """
    Everything that a report is about.

    :param tasks: environments with their runs
    :param groups: those with the same algorithms together
    :param configurations: by environment and algorithm
    :param command: what computed it
    :param seeds: of the runs
    :param steps: of each run
    :param eval_points: evaluations of each run
    :param eval_episodes: episodes of each evaluation
    :param failures: by name of a run that failed, why
    :param notes: what else the reader must know
    """

    tasks: Sequence[Task]
    groups: Sequence[Group]
    configurations: Mapping[tuple[str, str], Configuration]
    command: str
    seeds: Sequence[int]
    steps: int
    eval_points: int
    eval_episodes: int
    failures: Mapping[str, str]
    notes: Sequence[str]


class Column(NamedTuple):
    """
    :param name: heading
    :param key: of the row's value
    :param form: how a number is written
    """

    name: str
    key: str
    form: str


TASK_COLUMNS = (
    Column("runs", "runs", "d"),
    Column("final return, IQM", "final_iqm", ".1f"),
    Column("95 % low", "final_low", ".1f"),
    Column("95 % high", "final_high", ".1f"),
    Column("median", "final_median", ".1f"),
    Column("mean over training, IQM", "mean_iqm", ".1f"),
    Column("reached threshold", "reached", "d"),
    Column("steps to threshold", "steps_to_threshold", ",.0f"),
    Column("seconds to threshold", "seconds_to_threshold", ",.1f"),
    Column("steps/s", "steps_per_second", ",.0f"),
    Column("share of a core", "cpu_share", ".2f"),
    Column("start-up (s)", "start_seconds", ".1f"),
    Column("peak memory (MB)", "peak_memory_mb", ",.0f"),
    Column("above imports (MB)", "learning_memory_mb", ",.0f"),
    Column("model (kB)", "model_kb", ",.0f"),
)
THRESHOLD_KEYS = ("reached", "steps_to_threshold", "seconds_to_threshold")


def task_rows(task: Task) -> list[dict[str, Any]]:
    """
    :param task: an environment with its runs
    :return: for each algorithm what was measured, medians over seeds unless the name says otherwise
    """
    final = curves({algo: task.returns(algo)[:, None, -1:] for algo in task.runs})
    mean = curves({algo: task.returns(algo).mean(axis=1)[:, None, None] for algo in task.runs})
    rows = []
    for algo, runs in task.runs.items():
        costs = [run.cost_to(task.threshold) if task.threshold is not None else (math.nan,) * 2 for run in runs]
        rows.append(
            {
                "env": task.env,
                "algo": algo,
                "runs": len(runs),
                "final_iqm": final[algo].value.item(),
                "final_low": final[algo].low.item(),
                "final_high": final[algo].high.item(),
                "final_median": float(np.median([run.final_return for run in runs])),
                "mean_iqm": mean[algo].value.item(),
                "threshold": task.threshold,
                "reached": sum(math.isfinite(steps) for steps, _ in costs),
                "steps_to_threshold": median(steps for steps, _ in costs),
                "seconds_to_threshold": median(seconds for _, seconds in costs),
                "steps_per_second": median(run.steps_per_second for run in runs),
                "cpu_share": median(run.cpu_share for run in runs),
                "start_seconds": median(run.result["start_seconds"] for run in runs),
                "peak_memory_mb": median(run.result["peak_memory"] / MB for run in runs),
                "learning_memory_mb": median(
                    (run.result["peak_memory"] - run.result["base_memory"]) / MB for run in runs
                ),
                "model_kb": median(run.result["model_size"] / KB for run in runs),
            }
        )
    return rows


def median(values: Iterator[float]) -> float:
    """
    :param values: numbers, which may be infinite
    :return: the middle one; of an even number the mean of the two in the middle
    """
    ordered = sorted(values)
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else (ordered[half - 1] + ordered[half]) / 2


class GroupStatistics(NamedTuple):
    """
    What is told over several environments, of final scores unless the name says otherwise.

    :param aggregates: by algorithm
    :param thresholds: scores at which the profiles stand, shape (n,)
    :param profiles: by algorithm
    :param improvements: by pair
    :param shares: points of the curves, as shares of the training, shape (n_points,)
    :param curves: by algorithm, of scores during training
    """

    aggregates: Mapping[str, Estimate]
    thresholds: np.ndarray
    profiles: Mapping[str, Estimate]
    improvements: Mapping[tuple[str, str], Estimate]
    shares: np.ndarray
    curves: Mapping[str, Estimate]


def group_statistics(group: Group) -> GroupStatistics:
    """
    :param group: environments with the same algorithms
    :return: what is told of them together
    """
    scores = {algo: drawn for algo in group.algos if len(drawn := group.scores(algo))}
    final = {algo: drawn[..., -1] for algo, drawn in scores.items()}
    lowest = min(0.0, min(float(drawn.min()) for drawn in final.values()))
    highest = max(1.0, max(float(drawn.max()) for drawn in final.values()))
    thresholds = np.linspace(max(lowest, -1.0), highest * 1.02, 121)
    firsts = [algo for algo in final if algo in OURS] or list(final)[:1]
    n_points = next(iter(scores.values())).shape[-1]
    return GroupStatistics(
        aggregates(final),
        thresholds,
        profiles(final, thresholds),
        improvements(final, firsts),
        np.arange(1, n_points + 1) / n_points,
        curves(scores),
    )


def make_report(comparison: Comparison) -> dict[str, bytes]:
    """
    :param comparison: what to report on
    :return: by name, the files: the page, the tables behind it as CSV and JSON, and the pictures
    """
    contents: dict[str, bytes] = {}
    every = list(dict.fromkeys(algo for task in comparison.tasks for algo in task.runs))
    palette = colors(every)
    rows = {task.env: task_rows(task) for task in comparison.tasks}
    statistics = [group_statistics(group) for group in comparison.groups]
    pictures = _Pictures(contents)

    task_views = []
    for task in comparison.tasks:
        lines = curves({algo: task.returns(algo)[:, None, :] for algo in task.runs})
        name = task.env.replace("/", "-")
        columns = [column for column in TASK_COLUMNS if task.threshold is not None or column.key not in THRESHOLD_KEYS]
        task_views.append(
            {
                "env": task.env,
                "text": _task_text(task),
                "pictures": [
                    pictures.add(
                        f"{name}-steps",
                        draw_curves(task, lines, palette, against_time=False),
                        f"Learning curves on {task.env} against environment steps",
                        "Against environment steps. IQM over seeds, bands: 95 %.",
                    ),
                    pictures.add(
                        f"{name}-seconds",
                        draw_curves(task, lines, palette, against_time=True),
                        f"Learning curves on {task.env} against seconds of learning",
                        "The same against seconds of learning (median over seeds), on a logarithmic scale.",
                    ),
                ],
                "table": _task_table(rows[task.env], columns),
            }
        )
    group_views = [
        _group_view(number, group, statistic, palette, pictures)
        for number, (group, statistic) in enumerate(zip(comparison.groups, statistics, strict=True), 1)
    ]
    results = [run.result for task in comparison.tasks for runs in task.runs.values() for run in runs]
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True).from_string(
        files("sb3_knntd.compare").joinpath("report.html").read_text(encoding="utf-8")
    )
    contents["report.html"] = page.render(
        title=f"Comparison on {', '.join(task.env for task in comparison.tasks)}",
        summary=_summary(comparison, every),
        command=comparison.command,
        notes=[*cautions(comparison), *comparison.notes],
        failures=[{"name": name, "error": error} for name, error in comparison.failures.items()],
        tasks=task_views,
        groups=group_views,
        configurations=[
            {
                "title": f"{env}: {label(algo)}",
                "source": _source(configuration, comparison.steps),
                "text": yaml.safe_dump(configuration.hyperparams, sort_keys=True, allow_unicode=True),
            }
            for (env, algo), configuration in comparison.configurations.items()
        ],
        method=_method(comparison),
        machines=_distinct("{processor}, {cores} cores, {system}".format(**result["machine"]) for result in results),
        versions=_distinct(
            ", ".join(f"{package} {version}" for package, version in result["versions"].items()) for result in results
        ),
    ).encode()
    contents["summary.csv"] = _csv([row for task in comparison.tasks for row in rows[task.env]])
    contents["curves.csv"] = _csv(list(_curve_rows(comparison.tasks)))
    contents["report.json"] = json.dumps(_json(comparison, rows, statistics), indent=1, ensure_ascii=False).encode()
    return contents


class _Pictures:
    """Stores pictures as PNG, and gives the page each as SVG in an address that needs no network."""

    def __init__(self, contents: dict[str, bytes]) -> None:
        self._contents = contents

    def add(self, name: str, figure: Figure, alt: str, caption: str) -> dict[str, Any]:
        png, svg = io.BytesIO(), io.BytesIO()
        figure.savefig(png, format="png")
        # The same results give the same bytes.
        with matplotlib.rc_context({"svg.hashsalt": name, "path.simplify": True}):
            figure.savefig(svg, format="svg", metadata={"Date": None})
        self._contents[f"images/{name}.png"] = png.getvalue()
        width, height = figure.get_size_inches() * DPI
        return {
            "uri": f"data:image/svg+xml;base64,{base64.b64encode(svg.getvalue()).decode()}",
            "alt": alt,
            "caption": caption,
            "width": round(width),
            "height": round(height),
        }


def _task_text(task: Task) -> str:
    if task.threshold is None:
        return f"No threshold is known. Acting at random returns {_number(task.floor)} on average."
    return (
        f"Threshold: a return of {_number(task.threshold)} (dashed). Acting at random returns {_number(task.floor)} on "
        "average. "
        "Costs up to the threshold are medians over all seeds; never, if fewer than half of them reached it."
    )


def _task_table(rows: Sequence[dict[str, Any]], columns: Sequence[Column]) -> dict[str, Any]:
    ordered = sorted(rows, key=lambda row: row["final_iqm"], reverse=True)
    return {
        "header": ["algorithm", *(column.name for column in columns)],
        "rows": [
            {
                "own": row["algo"] in OURS,
                "cells": [
                    {"text": label(row["algo"]), "key": label(row["algo"])},
                    *(_cell(row, column) for column in columns),
                ],
            }
            for row in ordered
        ],
    }


def _cell(row: Mapping[str, Any], column: Column) -> dict[str, str]:
    value = row[column.key]
    if math.isinf(value):
        return {"text": "never", "key": "1e999"}
    text = f"{value} of {row['runs']}" if column.key == "reached" else format(value, column.form).replace("-", "−")
    return {"text": text, "key": repr(value)}


def _group_view(
    number: int, group: Group, statistic: GroupStatistics, palette: Mapping[str, str], pictures: _Pictures
) -> dict[str, Any]:
    envs = ", ".join(task.env for task in group.tasks)
    tops = "; ".join(
        f"{task.env}: {_number(task.floor)} and {_number(task.top)}"
        + ("" if task.top == task.threshold else " (the best mean at the end, for want of a threshold)")
        for task in group.tasks
    )
    alone = " Over a single environment the median is the mean over seeds." if len(group.tasks) == 1 else ""
    added = [
        ("aggregates", draw_aggregates(statistic.aggregates, palette), "IQM, median and optimality gap of final scores",
         "Final scores. Of the optimality gap, what is missing to a score of 1, less is better. Bars: 95 %."),
        ("profiles", draw_profiles(statistic.thresholds, statistic.profiles, palette), "Performance profiles",
         "Performance profiles: share of runs with a final score above τ. Bands: 95 %."),
        ("efficiency", draw_efficiency(statistic.shares, statistic.curves, palette), "Sample efficiency",
         "Sample efficiency: IQM of scores during training. Bands: 95 %."),
    ]  # fmt: skip
    if statistic.improvements:
        added.insert(
            2,
            (
                "improvement",
                draw_improvements(statistic.improvements, palette),
                "Probability of improvement",
                "Probability that a run of the one has a higher final score than a run of the other. Bars: 95 %.",
            ),
        )
    names = [f"{name}{end}" for name in AGGREGATES for end in ("", ", 95 % low", ", 95 % high")]
    return {
        "title": "All environments together" if len(group.tasks) > 1 else f"Scores on {envs}",
        "text": (
            f"Scores: 0 is acting at random, 1 the threshold ({tops}).{alone} Statistics by rliable, over "
            f"{', '.join(f'{label(algo)}: {len(group.scores(algo))}' for algo in statistic.aggregates)} seeds."
        ),
        "pictures": [
            pictures.add(f"group-{number}-{name}", figure, f"{alt} on {envs}", caption)
            for name, figure, alt, caption in added
        ],
        "table": {
            "header": ["algorithm", *names],
            "rows": [
                {
                    "own": algo in OURS,
                    "cells": [
                        {"text": label(algo), "key": label(algo)},
                        *(
                            {"text": f"{part:.3f}".replace("-", "−"), "key": repr(float(part))}
                            for column in range(len(AGGREGATES))
                            for part in (estimate.value[column], estimate.low[column], estimate.high[column])
                        ),
                    ],
                }
                for algo, estimate in statistic.aggregates.items()
            ],
        },
    }


def _greedy_episodes(comparison: Comparison) -> str:
    return f"{comparison.eval_episodes} greedy episode" + "s" * (comparison.eval_episodes > 1)


def _summary(comparison: Comparison, algos: Sequence[str]) -> str:
    seeds = comparison.seeds
    which = f"seeds {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"seed {seeds[0]}"
    return (
        f"{', '.join(label(algo) for algo in algos)}: {comparison.steps:,} environment steps each, {which}, "
        f"{comparison.eval_points} evaluations of {_greedy_episodes(comparison)} along the way. "
        "This command computes it again:"
    )


def cautions(comparison: Comparison) -> list[str]:
    """
    :param comparison: what is reported on
    :return: what of it is to be read with care, a sentence or two each
    """
    every = [run for task in comparison.tasks for runs in task.runs.values() for run in runs]
    words = []
    fewest = min(len(runs) for task in comparison.tasks for runs in task.runs.values())
    if fewest < FEWEST_SEEDS:
        words.append(
            f"Fewer than {FEWEST_SEEDS} seeds: the intervals mean little. They are drawn from so few values that they "
            "are too narrow more often than not."
        )
    if len(_distinct(json.dumps(run.result["versions"]) for run in every)) > 1:
        words.append("These results were made by different versions of the software.")
    if len(_distinct(json.dumps(run.result["machine"]) for run in every)) > 1:
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


def _source(configuration: Configuration, steps: int) -> str:
    if configuration.tuned_steps in (None, steps):
        return configuration.source
    return f"{configuration.source}, made for {configuration.tuned_steps:,} steps"


def _method(comparison: Comparison) -> list[str]:
    return [
        f"Each run has {comparison.steps:,} environment steps, over all environments of its configuration together, "
        f"and is evaluated {comparison.eval_points} times at equal distances, the last time at the end: "
        f"{_greedy_episodes(comparison)} in environments of their own, whose starts are the same at every "
        "point and, for a seed, for every algorithm. Observations are normalised as in training; returns are the "
        "environment's own.",
        "A run is a process of its own, on the CPU with one thread, and everything in it is seeded by its seed. Where "
        "it was computed does not matter to its returns, as far as processors compute alike.",
        "Seconds are wall-clock time of learning: evaluation is not counted, nor is start-up, from building a model to "
        "having compiled and loaded what its first steps need. Share of a core is processor time over wall-clock time.",
        "Peak memory is the largest resident size of the process; above imports, that less what it had before the "
        "first model was built. Model is the size of the saved file.",
        "The threshold is the environment's own reward_threshold or the one given. It is reached at the first "
        "evaluation whose mean return is no lower; a run that never gets there counts as infinitely long.",
        f"Statistics by rliable: IQM is the mean of the middle half of the runs; intervals are 95 % of {REPETITIONS:,} "
        "bootstrap resamples, stratified by environment. Of learning curves they hold point by point.",
        f"Without a tuned configuration an algorithm has its defaults. {label(FLOOR)} draws its actions from the "
        "action space.",
    ]


def _number(value: float) -> str:
    return f"{value:.1f}".replace("-", "−")


def _distinct(values: Iterator[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _curve_rows(tasks: Sequence[Task]) -> Iterator[dict[str, Any]]:
    for task in tasks:
        for algo, runs in task.runs.items():
            for run in runs:
                columns = (run.result[name] for name in ("steps", "seconds", "returns", "stds"))
                for steps, seconds, mean, std in zip(*columns, strict=True):
                    yield {
                        "env": task.env,
                        "algo": algo,
                        "seed": run.seed,
                        "steps": steps,
                        "seconds": round(seconds, 4),
                        "return_mean": mean,
                        "return_std": std,
                    }


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _json(
    comparison: Comparison, rows: Mapping[str, Sequence[dict[str, Any]]], statistics: Sequence[GroupStatistics]
) -> dict[str, Any]:
    """Numbers that JSON does not have are null: a threshold that is unknown or was never reached."""

    def plain(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    def ends(estimate: Estimate) -> dict[str, list[float]]:
        return {name: part.tolist() for name, part in zip(Estimate._fields, estimate, strict=True)}

    return {
        "command": comparison.command,
        "steps": comparison.steps,
        "seeds": list(comparison.seeds),
        "eval_points": comparison.eval_points,
        "eval_episodes": comparison.eval_episodes,
        "environments": {
            env: [{key: plain(value) for key, value in row.items()} for row in of_env] for env, of_env in rows.items()
        },
        "groups": [
            {
                "environments": [task.env for task in group.tasks],
                "floors": {task.env: task.floor for task in group.tasks},
                "tops": {task.env: task.top for task in group.tasks},
                "aggregate_names": list(AGGREGATES),
                "aggregates": {algo: ends(found) for algo, found in statistic.aggregates.items()},
                "profile_thresholds": statistic.thresholds.tolist(),
                "profiles": {algo: ends(found) for algo, found in statistic.profiles.items()},
                "improvements": {" > ".join(pair): ends(found) for pair, found in statistic.improvements.items()},
                "efficiency": {algo: ends(found) for algo, found in statistic.curves.items()},
            }
            for group, statistic in zip(comparison.groups, statistics, strict=True)
        ],
        "configurations": {
            f"{env}, {algo}": found._asdict() for (env, algo), found in comparison.configurations.items()
        },
        "failures": dict(comparison.failures),
    }
