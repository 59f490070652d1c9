"""``sb3-knntd compare``: its runs, its statistics and its report."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import compare_envs  # noqa: F401
import job_functions
import numpy as np
import pytest
import yaml
from playwright.sync_api import sync_playwright
from rliable import metrics
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_knntd import KNNTD
from sb3_knntd.cli import main
from sb3_knntd.common import command_line
from sb3_knntd.distributed.jobs import Event, Job, Outcome, run_jobs, run_locally
from sb3_knntd.experiments.compare import statistics
from sb3_knntd.experiments.compare.cautions import cautions
from sb3_knntd.experiments.compare.command import Plan, make_job
from sb3_knntd.experiments.compare.configurations import Configuration, configuration, fits, label
from sb3_knntd.experiments.compare.experiment import experiment, prepare
from sb3_knntd.experiments.compare.report import make_report
from sb3_knntd.experiments.compare.results import Comparison, Group, Run, Task, make_groups
from sb3_knntd.experiments.compare.run import Recorder, run
from sb3_knntd.experiments.compare.statistics import aggregates, curves, improvements, profiles, task_rows

CHROMIUM = Path("/usr/bin/chromium")
TINY = ["--steps", "300", "--eval-points", "3", "--eval-episodes", "2", "--gym-packages", "compare_envs"]


def result(returns: list[float], seconds: list[float] | None = None, **more: Any) -> dict[str, Any]:
    n = len(returns)
    return {
        "steps": [100 * (i + 1) for i in range(n)],
        "returns": returns,
        "stds": [0.0] * n,
        "seconds": seconds or [0.5 * (i + 1) for i in range(n)],
        "cpu_seconds": (seconds or [0.5 * n])[-1],
        "start_seconds": 1.0,
        "base_memory": 300_000_000,
        "peak_memory": 310_000_000,
        "model_size": 2_000,
        "versions": {"python": "3.12"},
        "machine": {"processor": "abacus", "cores": "1", "system": "wood"},
        **more,
    }


def task(
    runs: dict[str, list[list[float]]], env: str = "CartPole-v1", threshold: float | None = 100.0, **more: Any
) -> Task:
    made = {
        algo: [Run(env, algo, seed, result(returns, **more)) for seed, returns in enumerate(curves_)]
        for algo, curves_ in runs.items()
    }
    return Task(env, made, threshold)


def comparison(*tasks: Task, **more: Any) -> Comparison:
    n_seeds = len(next(iter(tasks[0].runs.values())))
    chosen = {(t.env, algo): Configuration({"policy": "x"}, "somewhere", 299) for t in tasks for algo in t.runs}
    fields = {"failures": {}, "notes": [], **more}
    return Comparison(list(tasks), make_groups(tasks), chosen, "the command", range(n_seeds), 300, 3, 2, **fields)


@pytest.fixture(scope="module", autouse=True)
def _few_repetitions() -> Iterator[None]:
    """Use fewer resamples: two thousand take seconds per report."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "REPETITIONS", 50)
        yield


# ------------------------------------------------------------------ the runs


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path]:
    """The arguments of a finished small comparison, and its folder."""
    out = tmp_path_factory.mktemp("compare") / "results"
    arguments = ["compare", "--env", "compare/Corridor-v0", "--algos", "knntd", "sarsa", "--seeds", "2"]
    arguments += [*TINY, "--workers", "2", "--out", str(out)]
    assert main(arguments) == 0
    return arguments, out


def test_compare_runs_everything_and_writes_all_files(compared: tuple[list[str], Path]) -> None:
    _, out = compared
    assert {path.name for path in out.iterdir()} == {
        "runs", "images", "report.html", "report.json", "summary.csv", "curves.csv"
    }  # fmt: skip
    stored = json.loads((out / "report.json").read_text())
    rows = {row["algo"]: row for row in stored["environments"]["compare/Corridor-v0"]}
    assert list(rows) == ["knntd", "sarsa", "random"]
    for row in rows.values():
        assert (row["runs"], row["threshold"]) == (2, -11.0)
        assert row["final_low"] <= row["final_iqm"] <= row["final_high"]
        assert 100 < row["steps_per_second"] < 1e6
        assert 100 < row["peak_memory_mb"] < 2000
        assert 0 <= row["learning_memory_mb"] < 300
        assert 0.5 < row["model_kb"] < 500
        assert row["start_seconds"] > 0
        assert 0 < row["cpu_share"] < 1.2
    assert rows["knntd"]["final_iqm"] > rows["random"]["final_iqm"], "it has learned nothing"
    with open(out / "curves.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 3 * 2 * 3
    assert [int(line["steps"]) for line in lines[:3]] == [100, 200, 300]
    with open(out / "summary.csv", newline="") as file:
        assert [row["algo"] for row in csv.DictReader(file)] == list(rows)
    assert all((out / "images" / name).stat().st_size > 5000 for name in os.listdir(out / "images"))
    assert len(os.listdir(out / "images")) == 6
    configurations = stored["configurations"]
    assert configurations["compare/Corridor-v0, knntd"]["hyperparams"] == {"policy": "KNNPolicy"}
    assert "--seeds 2 --first-seed 1000 --steps 300" in stored["command"]


def test_an_interrupted_comparison_continues_with_the_same_results(
    compared: tuple[list[str], Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments, out = compared
    before = {path.name: path.stat().st_mtime_ns for path in (out / "runs").glob("*.json")}
    (lost,) = (out / "runs").glob("*-knntd-1001-*")
    content = json.loads(lost.read_bytes())
    lost.unlink()
    # One more seed; the report is written again.
    (out / "report.html").unlink()
    grown = [*arguments[: arguments.index("--seeds")], "--seeds", "3", *arguments[arguments.index("--seeds") + 2 :]]
    assert main(grown) == 0
    err = capfd.readouterr().err
    assert "compare: 6 of 9" in err
    assert "compare: 9 of 9" in err
    assert "compare: 5 of 9" not in err
    assert (out / "report.html").exists()
    after = {path.name: path.stat().st_mtime_ns for path in (out / "runs").glob("*.json")}
    assert len(after) == 9
    assert [name for name in before if after[name] != before[name]] == [lost.name]
    again = json.loads(lost.read_bytes())
    for name in ("steps", "returns", "stds"):
        assert again["result"][name] == content["result"][name]
    assert again["result"]["seconds"] != content["result"]["seconds"]

    # Other settings do not overwrite existing results.
    assert main([*grown[:-2], "--steps", "150", "--seeds", "1", "--out", str(out)]) == 0
    assert len(list((out / "runs").glob("*.json"))) == 12


def test_a_failing_run_is_reported_and_the_others_finish(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "results"
    arguments = ["compare", "--env", "compare/Corridor-v0", "compare/Broken-v0", "--algos", "random", "--seeds", "1"]
    assert main([*arguments, *TINY, "--out", str(out)]) == 1
    err = capfd.readouterr().err
    assert "Failed: compare/Broken-v0, random, seed 1000\nTraceback" in err
    assert "1 of 2 runs failed" in err
    assert "2 of 2, 1 failed" in err
    page = (out / "report.html").read_text()
    assert "RuntimeError: the corridor &lt;has&gt; fallen in" in page
    assert "compare_envs.py" in page
    assert list(json.loads((out / "report.json").read_text())["environments"]) == ["compare/Corridor-v0"]
    assert main(["compare", "--env", "compare/Broken-v0", *arguments[4:], *TINY, "--out", str(out)]) == 1
    assert "no report" in capfd.readouterr().err


def test_evaluation_does_not_change_what_is_learned() -> None:
    prepare()
    hyperparams = {"policy": "KNNPolicy", "points": 8}
    with experiment("knntd", "MountainCar-v0", hyperparams, 700, seed=5) as (manager, model, _):
        recorder = Recorder(manager.create_envs(3, eval_env=True), 700, 7, 3, seed=5)
        model.learn(700, callback=recorder)
    assert recorder.steps == [100 * n for n in range(1, 8)]
    assert sorted(recorder.seconds) == recorder.seconds
    alone = KNNTD(make_vec_env("MountainCar-v0", seed=5), points=8, seed=5).learn(700)
    assert alone.policy.q_table.equal(model.policy.q_table)  # type: ignore[operator, attr-defined, union-attr]


def test_evaluation_starts_are_equal_for_all_algorithms_and_differ_from_training() -> None:
    prepare()
    starts: dict[str, list[np.ndarray]] = {}
    for algo, policy in (("random", "RandomPolicy"), ("sarsa", "TilePolicy")):
        with experiment(algo, "CartPole-v1", {"policy": policy}, 100, seed=7) as (manager, model, _):
            env = manager.create_envs(3, eval_env=True)
            reset = env.reset

            def recorded(algo: str = algo, reset: Any = reset) -> np.ndarray:
                starts.setdefault(algo, []).append(reset())
                return starts[algo][-1]

            env.reset = recorded  # type: ignore[method-assign]
            model.learn(100, callback=Recorder(env, 100, 2, 3, seed=7))
            assert model._last_obs is not None
    first, second = starts["random"]
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, starts["sarsa"][0])
    assert len(np.unique(first, axis=0)) == 3
    trained_from = make_vec_env("CartPole-v1", seed=7).reset()
    assert not (first == trained_from).all(axis=1).any()


def test_evaluation_normalises_observations_as_training_does() -> None:
    prepare()
    hyperparams = {"policy": "MlpPolicy", "normalize": True, "n_envs": 4, "n_steps": 16, "batch_size": 64}
    with experiment("ppo", "CartPole-v1", hyperparams, 256, seed=0) as (manager, model, _):
        env = manager.create_envs(2, eval_env=True)
        recorder = Recorder(env, 250, 2, 2, seed=0)
        model.learn(250, callback=recorder)
        training = model.get_vec_normalize_env()
        assert isinstance(model, PPO)
        assert isinstance(env, VecNormalize)
        assert training is not None
        np.testing.assert_array_equal(env.obs_rms.mean, training.obs_rms.mean)  # type: ignore[union-attr]
        assert not env.training
        assert min(recorder.returns) >= 5, "returns are normalised, not the environment's own"
    # Steps of four environments can pass a point without stopping at it.
    assert recorder.steps == [128, 252]


def test_points_closer_than_a_step_of_all_environments() -> None:
    outcome = run("compare/Corridor-v0", "ppo", 0, 24, {"policy": "MlpPolicy", "n_envs": 8, "n_steps": 8}, 6, 2)
    assert outcome["steps"] == [8, 8, 16, 16, 24, 24]
    assert len(outcome["returns"]) == len(outcome["seconds"]) == 6
    assert set(outcome["versions"]) >= {"python", "torch", "sb3-knntd"}


# ------------------------------------------------------------- configurations


RUNS = sorted((Path(__file__).parents[1] / "docs" / "comparison").glob("*/runs/*-1000-*.json"))


def test_stored_runs_count_as_computed(tmp_path: Path) -> None:
    """The runs behind docs/results.md were stored when the modules had other names."""
    assert RUNS
    jobs = []
    for path in RUNS:
        arguments = json.loads(path.read_text())["arguments"]
        plan = Plan(
            [arguments["env"]],
            [arguments["algo"]],
            range(1000, 1001),
            arguments["steps"],
            False,
            {},
            {},
            arguments["eval_points"],
            arguments["eval_episodes"],
            arguments["packages"],
            tmp_path,
        )
        job = make_job(plan, arguments["env"], arguments["algo"], 1000, arguments["hyperparams"])
        assert job.key == path.stem
        shutil.copyfile(path, tmp_path / path.name)
        jobs.append(job)

    def nothing(jobs: Sequence[Job]) -> Generator[Event, None, None]:
        assert not jobs
        yield from ()

    outcomes = run_jobs(jobs, tmp_path, backend=nothing)
    assert [outcomes[job.key].result for job in jobs] == [json.loads(path.read_text())["result"] for path in RUNS]


def test_configurations_are_the_tuned_ones_or_the_defaults(tmp_path: Path) -> None:
    tuned = configuration("dqn", "MountainCar-v0", False, {})
    assert tuned.hyperparams["learning_rate"] == 4e-3
    assert "n_timesteps" not in tuned.hyperparams
    assert (tuned.source, tuned.tuned_steps) == ("dqn.yml of RL Zoo, MountainCar-v0", 120_000)
    ours = configuration("knntd", "MountainCar-v0", False, {})
    assert ours.hyperparams["points"] == [22, 22]
    assert "this package" in ours.source
    assert configuration("sarsa", "MountainCar-v0", False, {}).hyperparams["gamma"] == 1.0

    for algo, policy in (("dqn", "MlpPolicy"), ("knntd", "KNNPolicy"), ("sarsa", "TilePolicy")):
        plain = Configuration({"policy": policy}, "the algorithm's defaults")
        assert configuration(algo, "MountainCar-v0", True, {}) == plain
        assert configuration(algo, "compare/Corridor-v0", False, {}) == plain
    related = configuration("dqn", "sb3_knntd/Acrobot-v0", False, {})
    assert related == configuration("dqn", "Acrobot-v1", False, {})
    assert configuration("knntd", "sb3_knntd/Acrobot-v0", False, {}).source.endswith("sb3_knntd/Acrobot-v0")

    path = tmp_path / "mine.yml"
    path.write_text(yaml.safe_dump({"default": {"policy": "KNNPolicy", "points": 5}, "CartPole-v1": {"points": 6}}))
    mine = configuration("knntd", "MountainCar-v0", True, {"knntd": path})
    assert mine == Configuration({"policy": "KNNPolicy", "points": 5}, "mine.yml, default")
    assert configuration("knntd", "CartPole-v1", False, {"knntd": path}).hyperparams == {"points": 6}
    assert configuration("dqn", "CartPole-v1", False, {"knntd": path}).tuned_steps == 50_000
    path.write_text(yaml.safe_dump({"CartPole-v1": {"points": 6}}))
    with pytest.raises(ValueError, match="neither an entry 'MountainCar-v0' nor 'default'"):
        configuration("knntd", "MountainCar-v0", False, {"knntd": path})


def test_algorithms_fit_by_their_actions() -> None:
    for algo, fit in (("knntd", True), ("dqn", True), ("ppo", True), ("sarsa", True), ("exa", False), ("sac", False)):
        assert fits(algo, "MountainCar-v0") is fit
        assert fits(algo, "Pendulum-v1") is (not fit or algo == "ppo")
    assert [label(algo) for algo in ("ppo", "knntd", "qrdqn")] == ["PPO", "kNN-TD(λ)", "QR-DQN"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algos", "dqnn"], "--algos: unknown algorithm 'dqnn'; known are a2c"),
        (["--algos", "sac"], "--algos: sac supports the action space of none of MountainCar-v0"),
        (["--env", "MountainCar-v9"], "--env: 'MountainCar-v9' cannot be made"),
        (["--steps", "39"], "--steps must be at least --eval-points, 40; got 39"),
        (["--steps", "0"], "must be a whole number of at least 1; got '0'"),
        (["--conf", "knntd"], "--conf must be NAME=FILE; got 'knntd'"),
        (["--conf", "knntd=/no/such.yml"], "No such file or directory: '/no/such.yml'"),
        (["--conf", "nobody=/no/such.yml"], "--conf: unknown algorithm 'nobody'"),
        (["--threshold", "high"], "--threshold: could not convert string to float: 'high'"),
        (["--threshold", "inf"], "--threshold must be finite; got MountainCar-v0=inf"),
        (["--threshold", "CartPole-v1=3"], "--threshold: 'CartPole-v1' is not among MountainCar-v0"),
        (["--env", "no_such_module:Env-v0"], "--env: 'no_such_module:Env-v0' cannot be made: No module named"),
        (["--gym-packages", "no_such_module"], "--gym-packages: No module named 'no_such_module'"),
        (["--gym-packages", "raising_module"], "--gym-packages: RuntimeError: no licence for this"),
        (["--backend", "ray", "--cpus-per-run", "-1"], "must be a number above 0; got '-1'"),
        (["--first-seed", "2147483640"], "seeds go to 2147483647; got 10 from 2147483640 on"),
    ],
)
def test_wrong_arguments_are_reported_before_anything_is_computed(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "raising_module.py").write_text("raise RuntimeError('no licence for this')")
    monkeypatch.syspath_prepend(tmp_path)
    command = ["compare", "--env", "MountainCar-v0", "--algos", "knntd", "--out", str(tmp_path / "out"), *arguments]
    with pytest.raises(SystemExit, match="2"):
        main(command)
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_invalid_configuration_is_reported_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yml"
    path.write_text(yaml.safe_dump({"default": {"policy": "KNNPolicy", "n_neighbors": 0}}))
    with pytest.raises(SystemExit, match="2"):
        main(["compare", "--env", "MountainCar-v0", "--algos", "knntd", "--conf", f"knntd={path}"])
    assert "knntd on MountainCar-v0: ValueError: n_neighbors must be" in capsys.readouterr().err


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    found = command_line.find_spec
    monkeypatch.setattr(command_line, "find_spec", lambda name: None if name in ("rliable", "ray") else found(name))
    with pytest.raises(SystemExit, match="2"):
        main(["compare", "--env", "CartPole-v1", "--algos", "knntd"])
    assert 'rliable not installed: pip install "sb3-knntd[compare]"' in capsys.readouterr().err


# ----------------------------------------------------------------- statistics


def test_costs_to_a_threshold() -> None:
    one = Run("e", "a", 0, result([0.0, 99.0, 100.0, 50.0], seconds=[1.0, 2.0, 4.0, 8.0]))
    assert one.cost_to(100.0) == (300.0, 4.0)
    assert one.cost_to(100.1) == (math.inf, math.inf)
    assert (one.steps_per_second, one.cpu_share) == (50.0, 1.0)

    rows = {row["algo"]: row for row in task_rows(task({"knntd": [[0, 100], [0, 0], [100, 0]], "random": [[0, 0]]}))}
    assert (rows["knntd"]["reached"], rows["knntd"]["steps_to_threshold"]) == (2, 200.0)
    assert (rows["random"]["reached"], rows["random"]["steps_to_threshold"]) == (0, math.inf)
    # Exactly half of the seeds is not a majority.
    (half, _) = task_rows(task({"knntd": [[100, 0], [100, 0], [0, 0], [0, 0]], "random": [[0, 0]]}))
    assert half["steps_to_threshold"] == math.inf
    (all_, _) = task_rows(task({"knntd": [[100, 0], [0, 100]], "random": [[0, 0]]}))
    assert all_["steps_to_threshold"] == 150.0
    (unknown, _) = task_rows(task({"knntd": [[0, 100]], "random": [[0, 0]]}, threshold=None))
    assert math.isnan(unknown["steps_to_threshold"])


def test_scores_are_normalised_by_random_actions_and_the_threshold() -> None:
    known = task({"knntd": [[10, 60], [35, 110]], "random": [[8, 12], [10, 10]]}, threshold=60.0)
    assert (known.floor, known.top) == (10.0, 60.0)
    np.testing.assert_allclose(known.scores("knntd"), [[0, 1], [0.5, 2]])
    # Without a threshold, or with one that random actions reach, the best final mean has a score of 1.
    for threshold in (None, 9.0):
        unknown = known._replace(threshold=threshold)
        assert unknown.top == 85.0
        np.testing.assert_allclose(unknown.scores("knntd")[:, -1].mean(), 1)
    hopeless = task({"knntd": [[10, 10]], "random": [[10, 10]]}, threshold=None)
    assert not hopeless.scores("knntd").any()


def test_environments_with_the_same_algorithms_are_grouped() -> None:
    same = {"knntd": [[1.0], [2.0]], "random": [[0.0], [0.0]]}
    a, b, c = task(same, "A"), task({"exa": [[1.0]], "random": [[0.0]]}, "B"), task(same, "C")
    groups = make_groups([a, b, c])
    assert [[t.env for t in group.tasks] for group in groups] == [["A", "C"], ["B"]]
    assert groups[0].scores("knntd").shape == (2, 2, 1)
    # A seed that failed on one environment does not count.
    short = c._replace(runs={"knntd": c.runs["knntd"][1:], "random": c.runs["random"]})
    np.testing.assert_allclose(Group([a, short], ["knntd"]).scores("knntd"), [[[0.02], [0.02]]])


def test_statistics_are_those_of_rliable() -> None:
    rng = np.random.default_rng(0)
    scores = {"a": rng.normal(0.8, 0.3, (10, 3)), "b": rng.normal(0.5, 0.3, (7, 3)).round(1)}
    before = np.random.get_state()[1][:5].tolist()  # type: ignore[index]
    found = aggregates(scores)
    assert np.random.get_state()[1][:5].tolist() == before  # type: ignore[index]
    assert all((found[a].low == aggregates(scores)[a].low).all() for a in scores)
    functions = (metrics.aggregate_iqm, metrics.aggregate_median, metrics.aggregate_optimality_gap)
    for algo, drawn in scores.items():
        np.testing.assert_allclose(found[algo].value, [function(drawn) for function in functions])
        assert (found[algo].low < found[algo].value).all()
        assert (found[algo].value < found[algo].high).all()
    better = improvements(scores, ["a"])
    assert list(better) == [("a", "b")]
    np.testing.assert_allclose(better["a", "b"].value, metrics.probability_of_improvement(scores["a"], scores["b"]))
    assert 0 <= better["a", "b"].low[0] < better["a", "b"].value[0] < better["a", "b"].high[0] <= 1
    points = curves({"a": scores["a"][:, :, None] * [1.0, 2.0]})["a"]
    iqm = metrics.aggregate_iqm(scores["a"])
    np.testing.assert_allclose(points.value, [iqm, 2 * iqm])
    profile = profiles(scores, np.array([-9.0, 0.5, 9.0]))["a"]
    np.testing.assert_allclose(profile.value, [1, (scores["a"] > 0.5).mean(), 0])


# --------------------------------------------------------------------- report


def test_the_report_warns_about_results_that_are_not_comparable() -> None:
    runs = {"knntd": [[0.0, 90.0, 120.0]] * 5, "random": [[0.0, 0.0, 0.0]] * 5}
    assert cautions(comparison(task(runs))) == []
    one = comparison(task(runs))
    long = {key: found._replace(tuned_steps=301) for key, found in one.configurations.items() if key[1] == "knntd"}
    (short,) = cautions(one._replace(configurations={**one.configurations, **long}))
    assert short == "Some configurations were tuned for more than 300 steps: kNN-TD(λ) on CartPole-v1 for 301."
    (few,) = cautions(comparison(task({**runs, "knntd": runs["knntd"][:4]})))
    assert few.startswith("Fewer than 5 seeds: the intervals are not reliable")
    (busy,) = cautions(comparison(task(runs, cpu_seconds=0.6)))
    assert "only 0.40 of a core" in busy
    for name, value, word in (("versions", {"python": "3.13"}, "versions"), ("machine", {"system": "x"}, "machines")):
        mixed = task(runs)
        mixed.runs["random"][0] = mixed.runs["random"][0]._replace(  # type: ignore[index]
            result=result([0.0, 0.0, 0.0], **{name: value})
        )
        (caution,) = cautions(comparison(mixed))
        assert f"different {word}" in caution


def test_the_report_shows_costs_failures_and_configurations() -> None:
    runs = {"knntd": [[0.0, 90.0, 120.0]] * 5, "random": [[0.0, 0.0, 0.0]] * 5}
    told = comparison(task(runs), failures={"<run>": "why & how"}, notes=["DQN cannot."])
    page = make_report(told)["report.html"].decode()
    for words in ("never", "5 of 5", "tuned for 299 steps", "Failed: &lt;run&gt;", "why &amp; how", "DQN cannot."):
        assert words in page


def test_the_report_is_reproducible_and_valid_json() -> None:
    a = task({"knntd": [[0, 90, 50]] * 5, "random": [[0, 0, 0]] * 5}, "A/x-v0", threshold=None)
    b = task({"exa": [[0, 90, 60]] * 5, "random": [[0, 0, 0]] * 5}, "B-v0")
    first, second = (make_report(comparison(a, b)) for _ in range(2))
    assert first == second

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    stored = json.loads(first["report.json"], parse_constant=refuse)
    rows = {row["algo"]: row for row in stored["environments"]["B-v0"]}
    assert rows["exa"]["steps_to_threshold"] is None
    assert "steps to threshold" in first["report.html"].decode()
    assert "images/A-x-v0-steps.png" in first
    page = make_report(comparison(a))["report.html"].decode()
    assert "steps to threshold" not in page
    assert "No threshold is known" in page


def test_an_algorithm_without_a_run_on_every_environment_has_no_score() -> None:
    runs = {"knntd": [[0.0, 90.0]] * 3, "random": [[0.0, 0.0]] * 3}
    a, b = task(runs, "A-v0"), task(runs, "B-v0")
    apart = b._replace(runs=b.runs | {"knntd": [run._replace(seed=run.seed + 7) for run in b.runs["knntd"]]})
    contents = make_report(comparison(a, apart))
    assert list(json.loads(contents["report.json"])["groups"][0]["aggregates"]) == ["random"]


@pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium")
def test_the_page_in_a_browser(compared: tuple[list[str], Path]) -> None:
    _, out = compared
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        for width in (400, 1600):
            page = browser.new_page(viewport={"width": width, "height": 900})
            said, asked = [], []
            page.on("console", lambda message, said=said: said.append(message.text))
            page.on("pageerror", lambda error, said=said: said.append(str(error)))
            page.on("request", lambda request, asked=asked: asked.append(request.url))
            page.goto((out / "report.html").as_uri())
            page.wait_for_load_state("networkidle")
            assert said == []
            assert [url for url in asked if not url.startswith(("data:", "file:"))] == []
            assert len([url for url in asked if url.startswith("file:")]) == 1
            images = page.eval_on_selector_all("img", "all => all.map(i => [i.naturalWidth, i.clientWidth, i.alt])")
            assert len(images) == 6
            for natural, shown, alternative in images:
                assert natural > 200
                assert shown > 0.8 * min(width, 500)
                assert alternative
            # Only tables, which scroll separately, are wider than the window.
            assert page.evaluate("document.documentElement.scrollWidth") == width
            smallest = page.eval_on_selector_all(
                "p, td, li", "all => all.map(e => parseFloat(getComputedStyle(e).fontSize))"
            )
            assert min(smallest) >= 14

            table = page.locator("table.sortable").first
            column = "final return, IQM"

            def values(table: Any = table) -> list[float]:
                return [float(text.replace("−", "-")) for text in table.locator("td:nth-child(3)").all_inner_texts()]

            unsorted = values()
            table.get_by_role("button", name=column).click()
            assert values() == sorted(unsorted)
            head = table.locator("th", has_text=column)
            assert head.get_attribute("aria-sort") == "ascending"
            table.get_by_role("button", name=column).click()
            assert values() == sorted(unsorted, reverse=True)
            table.get_by_role("button", name="algorithm").click()
            assert table.locator("td:first-child").all_inner_texts() == ["kNN-TD(λ)", "random", "SARSA(λ), tiles"]
            page.locator("details").first.click()
            assert "policy: KNNPolicy" in page.locator("details pre").first.inner_text()
        browser.close()


# ----------------------------------------------------------------------- jobs


def test_fresh_processes(tmp_path: Path) -> None:
    """Each job runs in a new process that inherits imports; dying and failing jobs are handled as usual."""
    (tmp_path / "pids").mkdir()
    jobs = [
        *(Job(f"slow-{n}", job_functions.slow, {"seconds": 0, "folder": str(tmp_path / "pids")}) for n in range(4)),
        Job("once", job_functions.die, {"marker": str(tmp_path / "once"), "times": 1}),
        Job("always", job_functions.die, {"marker": str(tmp_path / "always"), "times": 99}),
        Job("raises", job_functions.fail, {"what": "such thing"}),
        Job("threads", job_functions.threads, {}),
    ]
    events: list[tuple[str, Outcome | None]] = []
    for job, outcome in run_locally(jobs, 2, fresh=True, preload=["sb3_knntd.distributed.jobs", "job_functions"]):
        events.append((job.key, outcome))
        running = {key for key, _ in events} - {key for key, found in events if found}
        assert len(running) <= 2
    outcomes = {key: outcome for key, outcome in events if outcome}
    assert len({outcomes[f"slow-{n}"].result for n in range(4)}) == 4
    assert outcomes["once"] == Outcome("alive after 1")
    assert "died 2 times" in outcomes["always"].error
    assert "there is no such thing" in outcomes["raises"].error
    assert (outcomes["threads"].result["torch"], outcomes["threads"].result["openmp"]) == (1, "1")


INTERRUPTIBLE = """
import sys
from functools import partial
from pathlib import Path
import job_functions
from sb3_knntd.distributed.jobs import Job, run_jobs, run_locally
if __name__ == "__main__":
    folder, pids = Path(sys.argv[1]), sys.argv[2]
    jobs = [Job(f"{n}", job_functions.slow, {"seconds": 60 * n, "folder": pids}) for n in range(2)]
    backend = partial(run_locally, workers=1, fresh=True, preload=["sb3_knntd.distributed.jobs", "job_functions"])
    run_jobs(jobs, folder, backend=backend)
"""


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_fresh_processes_end_with_the_program(tmp_path: Path, blow: signal.Signals) -> None:
    folder, pids, script = tmp_path / "jobs", tmp_path / "pids", tmp_path / "script.py"
    pids.mkdir()
    script.write_text(INTERRUPTIBLE)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    program = subprocess.Popen([sys.executable, script, folder, pids], env=environment, start_new_session=True)
    end = time.monotonic() + 60
    while len(list(pids.iterdir())) < 2:
        assert time.monotonic() < end, "the second job never began"
        time.sleep(0.05)
    if blow == signal.SIGINT:
        os.killpg(program.pid, blow)  # like a terminal
    else:
        os.kill(program.pid, blow)
    program.wait(60)
    end = time.monotonic() + 30
    while any((Path("/proc") / path.name.split("-")[1]).exists() for path in pids.iterdir()):
        assert time.monotonic() < end, "a process outlived the program"
        time.sleep(0.05)
    assert [path.name for path in folder.glob("*.json")] == ["0.json"]


def test_progress_shows_running_and_remaining_jobs(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    jobs = [Job(name, job_functions.unstorable, {}) for name in "abc"]

    def backend(missing: Any) -> Any:
        yield from ((job, None) for job in missing)
        for job in missing:
            yield job, Outcome(1) if job.key != "b" else Outcome(error="no")

    run_jobs(jobs, tmp_path, title="t", backend=backend)
    lines = [line.split(", ") for line in capfd.readouterr().err.splitlines()]
    assert [line[:-1] for line in lines] == [
        ["t: 1 of 3", "2 running"],
        ["t: 2 of 3", "1 running", "1 failed"],
        ["t: 3 of 3", "1 failed"],
    ]
    assert all(line[-1].endswith("left") for line in lines)
