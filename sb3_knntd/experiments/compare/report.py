"""The report of a comparison: tables, plots and data files. The text is in the template ``report.html``."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import matplotlib
import yaml
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from sb3_knntd.common.csv_tables import csv_table
from sb3_knntd.experiments.compare.cautions import cautions
from sb3_knntd.experiments.compare.configurations import FLOOR, is_own, label
from sb3_knntd.experiments.compare.pictures import (
    colors,
    draw_aggregates,
    draw_curves,
    draw_efficiency,
    draw_improvements,
    draw_profiles,
)
from sb3_knntd.experiments.compare.results import Comparison, Group, Task
from sb3_knntd.experiments.compare.statistics import (
    AGGREGATES,
    REPETITIONS,
    Estimate,
    GroupStatistics,
    curves,
    group_statistics,
    task_rows,
)
from sb3_knntd.plots import DPI


class Column(NamedTuple):
    """
    A column of the table of an environment.

    :param name: heading
    :param key: key of the value in a row
    :param form: format of the numbers
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


def make_report(comparison: Comparison) -> dict[str, bytes]:
    """
    :param comparison: the comparison to report
    :return: contents of the files by name: the page, its data as CSV and JSON, and the plots
    """
    contents: dict[str, bytes] = {}
    rows = {task.env: task_rows(task) for task in comparison.tasks}
    statistics = [group_statistics(group) for group in comparison.groups]
    contents["report.html"] = _page(comparison, rows, statistics, contents).encode()
    contents["summary.csv"] = _summary_csv(rows)
    contents["curves.csv"] = _curves_csv(comparison.tasks)
    contents["report.json"] = json.dumps(_json(comparison, rows, statistics), indent=1, ensure_ascii=False).encode()
    return contents


def _page(
    comparison: Comparison,
    rows: Mapping[str, Sequence[dict[str, Any]]],
    statistics: Sequence[GroupStatistics],
    contents: dict[str, bytes],
) -> str:
    """Render the page from ``report.html``, and add its plots to the contents."""
    algos = list(dict.fromkeys(algo for task in comparison.tasks for algo in task.runs))
    palette = colors(algos)
    results = [run.result for task in comparison.tasks for runs in task.runs.values() for run in runs]
    jinja = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    jinja.filters |= {"label": label, "thousands": "{:,}".format, "number": _number, "yaml": _yaml}
    return jinja.from_string(
        files("sb3_knntd.experiments.compare").joinpath("report.html").read_text(encoding="utf-8")
    ).render(
        comparison=comparison,
        algos=algos,
        floor=FLOOR,
        repetitions=REPETITIONS,
        cautions=cautions(comparison),
        tasks=[_task_view(task, rows[task.env], palette, contents) for task in comparison.tasks],
        groups=[
            _group_view(number, group, statistic, palette, contents)
            for number, (group, statistic) in enumerate(zip(comparison.groups, statistics, strict=True), 1)
        ],
        machines=_distinct("{processor}, {cores} cores, {system}".format(**result["machine"]) for result in results),
        versions=_distinct(
            ", ".join(f"{package} {version}" for package, version in result["versions"].items()) for result in results
        ),
    )


def _task_view(
    task: Task, rows: Sequence[dict[str, Any]], palette: Mapping[str, str], contents: dict[str, bytes]
) -> dict[str, Any]:
    lines = curves({algo: task.returns(algo)[:, None, :] for algo in task.runs})
    columns = [column for column in TASK_COLUMNS if task.threshold is not None or column.key not in THRESHOLD_KEYS]
    figures = {
        "steps": draw_curves(task, lines, palette, against_time=False),
        "seconds": draw_curves(task, lines, palette, against_time=True),
    }
    return {
        "task": task,
        "pictures": _store_pictures(task.env.replace("/", "-"), figures, contents),
        "table": {
            "header": [column.name for column in columns],
            "rows": [
                _row(row["algo"], [_cell(row, column) for column in columns])
                for row in sorted(rows, key=lambda row: row["final_iqm"], reverse=True)
            ],
        },
    }


def _group_view(
    number: int,
    group: Group,
    statistic: GroupStatistics,
    palette: Mapping[str, str],
    contents: dict[str, bytes],
) -> dict[str, Any]:
    figures = {
        "aggregates": draw_aggregates(statistic.aggregates, palette),
        "profiles": draw_profiles(statistic.thresholds, statistic.profiles, palette),
        "efficiency": draw_efficiency(statistic.shares, statistic.curves, palette),
    }
    if statistic.improvements:
        figures["improvement"] = draw_improvements(statistic.improvements, palette)
    return {
        "tasks": group.tasks,
        "seeds": {algo: len(group.scores(algo)) for algo in statistic.aggregates},
        "pictures": _store_pictures(f"group-{number}", figures, contents),
        "table": {
            "header": [f"{name}{end}" for name in AGGREGATES for end in ("", ", 95 % low", ", 95 % high")],
            "rows": [
                _row(
                    algo,
                    [
                        {"text": _number(part, ".3f"), "key": repr(float(part))}
                        for parts in zip(*estimate, strict=True)
                        for part in parts
                    ],
                )
                for algo, estimate in statistic.aggregates.items()
            ],
        },
    }


def _store_pictures(
    prefix: str, figures: Mapping[str, Figure], contents: dict[str, bytes]
) -> dict[str, dict[str, Any]]:
    """Add plots to the contents as PNG, and return each as an SVG data URI."""
    stored = {}
    for name, figure in figures.items():
        png, svg = io.BytesIO(), io.BytesIO()
        figure.savefig(png, format="png")
        # The output is reproducible byte for byte.
        with matplotlib.rc_context({"svg.hashsalt": f"{prefix}-{name}", "path.simplify": True}):
            figure.savefig(svg, format="svg", metadata={"Date": None})
        contents[f"images/{prefix}-{name}.png"] = png.getvalue()
        width, height = figure.get_size_inches() * DPI
        stored[name] = {
            "uri": f"data:image/svg+xml;base64,{base64.b64encode(svg.getvalue()).decode()}",
            "width": round(width),
            "height": round(height),
        }
    return stored


def _row(algo: str, cells: Sequence[dict[str, str]]) -> dict[str, Any]:
    return {"own": is_own(algo), "cells": [{"text": label(algo), "key": label(algo)}, *cells]}


def _cell(row: Mapping[str, Any], column: Column) -> dict[str, str]:
    value = row[column.key]
    if math.isinf(value):
        return {"text": "never", "key": "1e999"}
    text = f"{value} of {row['runs']}" if column.key == "reached" else _number(value, column.form)
    return {"text": text, "key": repr(value)}


def _number(value: float, form: str = ".1f") -> str:
    return format(value, form).replace("-", "−")


def _yaml(values: Mapping[str, Any]) -> str:
    return str(yaml.safe_dump(values, sort_keys=True, allow_unicode=True))


def _distinct(values: Iterator[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _summary_csv(rows: Mapping[str, Sequence[dict[str, Any]]]) -> bytes:
    summary = [row for of_env in rows.values() for row in of_env]
    return csv_table(list(summary[0]), (row.values() for row in summary))


def _curves_csv(tasks: Sequence[Task]) -> bytes:
    return csv_table(
        ("env", "algo", "seed", "steps", "seconds", "return_mean", "return_std"),
        (
            (task.env, algo, run.seed, steps, round(seconds, 4), mean, std)
            for task in tasks
            for algo, runs in task.runs.items()
            for run in runs
            for steps, seconds, mean, std in zip(
                *(run.result[name] for name in ("steps", "seconds", "returns", "stds")), strict=True
            )
        ),
    )


def _json(
    comparison: Comparison, rows: Mapping[str, Sequence[dict[str, Any]]], statistics: Sequence[GroupStatistics]
) -> dict[str, Any]:
    """The data as JSON; infinite and missing values (thresholds that are unknown or were not reached) become null."""

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
