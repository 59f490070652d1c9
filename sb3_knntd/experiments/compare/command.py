"""``sb3-knntd compare``: run algorithms on environments with several seeds and write a report."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import rl_zoo3

from sb3_knntd.common.command_line import CommandError, make_env, reason_of
from sb3_knntd.common.files import replace_file
from sb3_knntd.distributed.jobs import Backend, Job, Outcome, run_jobs, run_locally, usable_cores
from sb3_knntd.experiments.compare.configurations import FLOOR, Configuration, configuration, fits, label
from sb3_knntd.experiments.compare.experiment import experiment, prepare
from sb3_knntd.experiments.compare.report import make_report
from sb3_knntd.experiments.compare.results import Comparison, Run, Task, make_groups
from sb3_knntd.experiments.compare.run import is_result, run

#: Modules that local workers preload.
PRELOADED = ("sb3_knntd.experiments.compare.run",)


class Plan(NamedTuple):
    """
    The arguments of the command.

    :param envs: ids of the environments
    :param algos: names of the algorithms; random actions are always added
    :param seeds: seeds of the runs
    :param steps: environment steps per run
    :param defaults: whether to use the algorithms' default parameters instead of the tuned configurations
    :param conf: configuration files by algorithm
    :param thresholds: by environment, the mean return that counts as solved
    :param eval_points: evaluations per run
    :param eval_episodes: episodes per evaluation
    :param packages: modules that register environments
    :param out: output folder
    """

    envs: Sequence[str]
    algos: Sequence[str]
    seeds: range
    steps: int
    defaults: bool
    conf: Mapping[str, Path]
    thresholds: Mapping[str, float]
    eval_points: int
    eval_episodes: int
    packages: Sequence[str]
    out: Path

    @property
    def command(self) -> str:
        """The command line that reproduces the results, without the options of the backend."""
        words: list[Any] = ["sb3-knntd", "compare", "--env", *self.envs, "--algos", *self.algos]
        words += ["--seeds", len(self.seeds), "--first-seed", self.seeds[0], "--steps", self.steps]
        words += ["--defaults"] if self.defaults else []
        words += ["--conf", *(f"{algo}={path}" for algo, path in self.conf.items())] if self.conf else []
        given = [f"{env}={threshold:g}" for env, threshold in self.thresholds.items()]
        words += ["--threshold", *given] if given else []
        words += ["--eval-points", self.eval_points, "--eval-episodes", self.eval_episodes]
        words += ["--gym-packages", *self.packages] if self.packages else []
        return shlex.join(str(word) for word in [*words, "--out", self.out])


class Key(NamedTuple):
    """
    Identifies a run.

    :param env: id of the environment
    :param algo: name of the algorithm
    :param seed: seed of the run
    """

    env: str
    algo: str
    seed: int


def compare(
    plan: Plan,
    backend: str,
    workers: int | None = None,
    address: str | None = None,
    cpus: float = 1.0,
    memory: float | None = None,
) -> int:
    """
    Compute the missing runs, write the report, and print its path.

    :param plan: arguments of the command
    :param backend: ``"local"`` or ``"ray"``
    :param workers: number of local processes, ``None`` for one per core
    :param address: address of the Ray cluster
    :param cpus: CPUs that Ray reserves per run
    :param memory: memory that Ray reserves per run, GiB, ``None`` for no reservation
    :return: exit code: 0, or 1 if runs failed
    :raises CommandError: if an argument is invalid; raised before anything is computed
    """
    try:
        prepare(plan.packages)
    except Exception as error:
        raise CommandError(f"--gym-packages: {reason_of(error)}") from error
    check_plan(plan)
    algos = [*(algo for algo in dict.fromkeys(plan.algos) if algo != FLOOR), FLOOR]
    chosen = choose_configurations(plan, algos)
    jobs = {
        Key(env, algo, seed): make_job(plan, env, algo, seed, found.hyperparams)
        for (env, algo), found in chosen.items()
        for seed in plan.seeds
    }
    with ExitStack() as stack:
        compute = _ray(stack, address, cpus, memory) if backend == "ray" else _local(workers)
        try:
            outcomes = run_jobs(list(jobs.values()), plan.out / "runs", title="compare", backend=compute)
        except OSError as error:
            raise CommandError(f"cannot write to {plan.out}: {error}") from error

    by_key = {key: outcomes[job.key] for key, job in jobs.items()}
    failures = {f"{key.env}, {label(key.algo)}, seed {key.seed}": o.error for key, o in by_key.items() if o.error}
    for name, reason in failures.items():
        print(f"Failed: {name}\n{reason}", file=sys.stderr)
    comparison = gather(plan, chosen, by_key, failures)
    if not comparison.tasks:
        print("No environment has complete results: no report. Run the same command to try again.", file=sys.stderr)
        return 1
    for name, content in make_report(comparison).items():
        path = plan.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content)
    print(plan.out / "report.html")
    if failures:
        print(f"{len(failures)} of {len(jobs)} runs failed. Run the same command to try them again.", file=sys.stderr)
    return 1 if failures else 0


def check_plan(plan: Plan) -> None:
    """
    :param plan: arguments of the command
    :raises CommandError: if a name is unknown, or arguments are inconsistent
    """
    known = [algo for algo in rl_zoo3.ALGOS if algo != FLOOR]
    for option, names in (("--algos", plan.algos), ("--conf", plan.conf)):
        for name in names:
            if name not in rl_zoo3.ALGOS:
                raise CommandError(f"{option}: unknown algorithm {name!r}; known are {', '.join(sorted(known))}")
    for env in plan.envs:
        make_env(env).close()
    for env in plan.thresholds:
        if env not in plan.envs:
            raise CommandError(f"--threshold: {env!r} is not among {', '.join(plan.envs)}")
    if plan.steps < plan.eval_points:
        raise CommandError(f"--steps must be at least --eval-points, {plan.eval_points}; got {plan.steps}")


def choose_configurations(plan: Plan, algos: Sequence[str]) -> dict[tuple[str, str], Configuration]:
    """
    :param plan: arguments of the command
    :param algos: names of algorithms
    :return: configurations by environment and algorithm, for algorithms that support the action space; a model was
        built from each to check it
    :raises CommandError: if a configuration cannot be read or built, or an algorithm supports none of the environments
    """
    chosen = {}
    for env in plan.envs:
        for algo in algos:
            if not fits(algo, env):
                continue
            try:
                chosen[env, algo] = configuration(algo, env, plan.defaults, plan.conf)
                with experiment(algo, env, chosen[env, algo].hyperparams, plan.steps, seed=0):
                    pass
            except Exception as error:
                raise CommandError(f"{algo} on {env}: {type(error).__name__}: {error}") from error
    for algo in algos:
        if not any(algo == other for _, other in chosen):
            raise CommandError(f"--algos: {algo} supports the action space of none of {', '.join(plan.envs)}")
    return chosen


def make_job(plan: Plan, env: str, algo: str, seed: int, hyperparams: Mapping[str, Any]) -> Job:
    """
    :param plan: arguments of the command
    :param env: id of the environment
    :param algo: name of the algorithm
    :param seed: seed of the run
    :param hyperparams: configuration of the algorithm
    :return: the job; its name contains a hash of everything that the result depends on, so that results of several
        plans can share a folder
    """
    arguments = {
        "env": env,
        "algo": algo,
        "seed": seed,
        "steps": plan.steps,
        "hyperparams": hyperparams,
        "eval_points": plan.eval_points,
        "eval_episodes": plan.eval_episodes,
        "packages": list(plan.packages),
    }
    digest = hashlib.sha256(json.dumps(arguments, sort_keys=True).encode()).hexdigest()[:10]
    name = "".join(character if character.isalnum() or character in "_-" else "-" for character in env)
    return Job(f"{name}-{algo}-{seed}-{digest}", run, arguments, is_result)


def gather(
    plan: Plan,
    chosen: Mapping[tuple[str, str], Configuration],
    outcomes: Mapping[Key, Outcome],
    failures: Mapping[str, str],
) -> Comparison:
    """
    :param plan: arguments of the command
    :param chosen: the configurations
    :param outcomes: outcomes of the runs
    :param failures: error messages by name of the failed run
    :return: the comparison to report; without environments that have no finished runs of random actions
    """
    tasks = []
    for env in plan.envs:
        runs: dict[str, list[Run]] = {}
        for key, outcome in outcomes.items():
            if key.env == env and not outcome.error:
                runs.setdefault(key.algo, []).append(Run(*key, outcome.result))
        spec = gym.spec(env)
        if FLOOR in runs:
            tasks.append(Task(env, runs, plan.thresholds.get(env, spec.reward_threshold)))
    left_out = [
        f"{label(algo)} does not support the action space of {env}."
        for env in plan.envs
        for algo in dict.fromkeys(plan.algos)
        if (env, algo) not in chosen and algo != FLOOR
    ]
    return Comparison(
        tasks,
        make_groups(tasks),
        chosen,
        plan.command,
        plan.seeds,
        plan.steps,
        plan.eval_points,
        plan.eval_episodes,
        failures,
        left_out,
    )


def _local(workers: int | None) -> Backend:
    return partial(run_locally, workers=workers or usable_cores(), fresh=True, preload=PRELOADED)


def _ray(stack: ExitStack, address: str | None, cpus: float, memory: float | None) -> Backend:
    from sb3_knntd.distributed.ray_jobs import connected, run_on_ray

    try:
        stack.enter_context(connected(address))
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise CommandError(f"--address: {error}") from error
    return partial(run_on_ray, cpus=cpus, memory=memory)
