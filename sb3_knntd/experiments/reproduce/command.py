"""``sb3-knntd reproduce``: compute a figure over seeds and write its tables, plot and verdict."""

from __future__ import annotations

import io
import sys
import textwrap
from collections.abc import Iterable
from pathlib import Path

from sb3_knntd.common.command_line import CommandError
from sb3_knntd.common.csv_tables import csv_table
from sb3_knntd.common.files import replace_file
from sb3_knntd.distributed.jobs import Job, run_jobs
from sb3_knntd.experiments.reproduce import FIGURES
from sb3_knntd.experiments.reproduce.settings import load_settings
from sb3_knntd.experiments.reproduce.statistics import seeds_range

WIDTH = 100


def reproduce(name: str, best: bool, seeds: range, episodes: int | None, out: Path, workers: int | None) -> int:
    """
    Compute a figure of the paper over seeds, write its files, and print the verdict.

    :param name: name of the figure
    :param best: whether to use this project's best settings instead of the paper's
    :param seeds: seeds of the runs
    :param episodes: number of training episodes, ``None`` for that of the settings
    :param out: output folder; files go to its subfolder ``name/best`` or ``name/paper``
    :param workers: number of processes, ``None`` for one per core
    :return: exit code: 0, or 1 if a seed failed
    :raises CommandError: if the figure has no best settings, ``episodes`` is too small, or ``out`` cannot be written to
    """
    figure, variant = FIGURES[name], "best" if best else "paper"
    variants = load_settings(name)
    if variant not in variants:
        raise CommandError(f"{name} has the paper's settings only: leave out --best")
    settings = variants[variant]
    if episodes is not None:
        if episodes < figure.min_episodes:
            raise CommandError(f"--episodes must be at least {figure.min_episodes} for {name}; got {episodes}")
        settings = {algorithm: {**setting, "episodes": episodes} for algorithm, setting in settings.items()}
    folder = out / name / variant
    jobs = {
        (algorithm, seed): Job(
            f"{algorithm}-{seed}", figure.compute, {"algorithm": algorithm, "setting": setting, "seed": seed}
        )
        for algorithm, setting in settings.items()
        for seed in seeds
    }
    try:
        outcomes = run_jobs(list(jobs.values()), folder / "seeds", workers, f"{name} {variant}")
    except OSError as error:
        raise CommandError(f"cannot write to {folder}: {error}") from error

    failed = {key: outcome.error for key, outcome in outcomes.items() if outcome.error}
    if failed:
        print(next(iter(failed.values())), file=sys.stderr)
        print(
            f"{len(failed)} of {len(jobs)} runs failed: {', '.join(failed)}. The error of the first is above. The "
            "table, plot and verdict need all runs. Run the same command to try them again.",
            file=sys.stderr,
        )
        return 1

    results = {
        algorithm: {seed: outcomes[jobs[algorithm, seed].key].result for seed in seeds} for algorithm in settings
    }
    of_whom = "this project's best settings" if best else "the paper's settings"
    text = "\n".join(textwrap.wrap(figure.verdict(results), WIDTH)) + "\n"
    picture = io.BytesIO()
    title = f"Figure {name.removeprefix('fig')} with {of_whom}, {seeds_range(seeds)}"
    figure.draw(results, title).savefig(picture, format="png")
    contents = {
        **{file: csv_table(*table) for file, table in figure.tables(results).items()},
        "figure.png": picture.getvalue(),
        "verdict.txt": text.encode(),
    }
    for file, content in contents.items():
        replace_file(folder / file, content)
    print(text)
    _print_paths(folder / file for file in contents)
    return 0


def _print_paths(paths: Iterable[Path]) -> None:
    for path in paths:
        print(path)
