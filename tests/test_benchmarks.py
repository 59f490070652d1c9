"""The benchmarks run and write their results. No measured value is asserted."""

from __future__ import annotations

import importlib
import json
import math
import pathlib
import subprocess
import sys
from typing import Any

import optuna
import pytest
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd import KNNTD, cli
from sb3_knntd.distributed.jobs import Job, Outcome
from sb3_knntd.registry import ALGORITHMS
from sb3_knntd.zoo.schedules import with_schedules
from sb3_knntd.zoo.search_space import attributes

ROOT = pathlib.Path(__file__).parent.parent


@pytest.fixture
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that imports a benchmark module; benchmarks run from the repository root and are not installed."""
    monkeypatch.syspath_prepend(str(ROOT))
    return lambda name: importlib.import_module(f"benchmarks.{name}")


def test_speed_prints_and_stores_its_table(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "speed.json"
    command = [sys.executable, "-m", "benchmarks.speed", "--repeats", "1", "--only", "predict", "--json", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    header, rule, row, empty, machine = done.stdout.splitlines()
    assert [cell.strip() for cell in header.strip("|").split("|")][:4] == ["what", "ratio", "range", "must reach"]
    assert set(rule) <= set("|-")
    assert empty == ""
    stored = json.loads(file.read_text())
    assert set(stored) == {"machine", "rows"}
    (line,) = stored["rows"]
    assert line["what"] in row
    assert line["target"] in row
    assert f"{line['ratio']:.3g}" in row
    assert line["low"] <= line["ratio"] <= line["high"]
    assert 0.0 < line["ratio"] < math.inf
    for what in ("processor", "cores", "torch", "numba"):
        assert f"{what} {stored['machine'][what]}" in machine


@pytest.mark.slow
def test_ray_vec_env_prints_and_stores_its_table(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "steps.json"
    command = [sys.executable, "-m", "benchmarks.ray_vec_env", "--repeats", "1", "--json", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    rows = json.loads(file.read_text())["rows"]
    assert [row["seconds"] for row in rows] == [0.0, 0.01]
    for row, printed in zip(rows, done.stdout.splitlines()[2:4], strict=True):
        assert min(row["subproc"], row["ray"]) > 1e3 * row["seconds"]
        assert printed == f"| {1e3 * row['seconds']:g} | {row['subproc']:.2f} | {row['ray']:.2f} |"


def test_speed_refuses_what_it_does_not_know(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["speed", "--only", "nonsense"])
    with pytest.raises(SystemExit, match="2"):
        benchmarks("speed").main()
    error = capsys.readouterr().err
    assert "nonsense" in error
    assert "predict" in error


def test_speed_has_a_row_for_each_figure(benchmarks: Any) -> None:
    names = set(benchmarks("speed").BENCHMARKS)
    assert names >= {"bare1", "bare64", "dqn", "points", "huge", "neighbors", "episode", "kd_tree", "hnsw"}
    assert names >= {"predict", "startup", "memory64", "memory32"}
    assert names >= {"envpool_cart_pole", "envpool_mountain_car", "envpool_ppo", "gymnasium_vector", "lean", "compiled"}
    assert names >= {"compiled1", "side_by_side", "first_use"}
    # Also one for GPUs, which is skipped with a message if there is none.
    assert "cuda" in names


def test_without_a_gpu_its_benchmark_is_skipped(
    benchmarks: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert benchmarks("speed").cuda(1) == []
    assert "no such device" in capsys.readouterr().err


def test_ratios_are_medians_of_pairs(benchmarks: Any) -> None:
    speed = benchmarks("speed")
    # The first value of each is the warm-up, which does not count.
    ones, others = iter([1e9, 6.0, 2.0, 30.0]), iter([1e-9, 2.0, 2.0, 3.0])
    row = speed.compare("a over b", "<= 2.5", lambda: next(ones), lambda: next(others), 3, "µs")
    assert (row.ratio, row.low, row.high) == (3.0, 1.0, 10.0)
    assert not row.reached
    assert row._replace(target=">= 3").reached
    assert row._replace(target="<= 3").reached
    assert not row._replace(target=">= 3.1").reached


def test_learning_plays_a_case(benchmarks: Any) -> None:
    learning = benchmarks("learning")
    case = learning.Case("tiny", "MountainCar-v0", 300, n_envs=2)
    figure = learning.play(case, seed=3)
    assert -200.0 <= figure <= 0.0
    assert learning.play(case, seed=3) == figure


def test_learning_takes_the_tuned_settings(benchmarks: Any) -> None:
    settings = benchmarks("learning").tuned_settings("knntd", "MountainCar-v0")
    assert settings
    assert not {"n_timesteps", "policy"} & set(settings)


def test_learning_prints_and_stores_its_table(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: pathlib.Path
) -> None:
    learning = benchmarks("learning")

    class Here:
        """A pool that runs in this process, because this tests only the table."""

        def __enter__(self) -> Here:
            return self

        def __exit__(self, *_: object) -> None: ...

        map = staticmethod(map)

    played = []
    monkeypatch.setattr(learning, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(learning, "play", lambda case, seed: played.append((case.what, seed)) or -100.0 - seed)
    file = tmp_path / "learning.json"
    monkeypatch.setattr(
        sys, "argv", ["learning", "--seeds", "3", "--first-seed", "5", "--only", "tuned", "--json", str(file)]
    )
    learning.main()
    assert played == [("tuned", 5), ("tuned", 6), ("tuned", 7)]
    printed = capsys.readouterr().out
    assert "| -106.0 |" in printed
    assert "Seeds 5 to 7" in printed
    stored = json.loads(file.read_text())
    (case,) = stored["cases"]
    assert case["returns"] == [-105.0, -106.0, -107.0]
    assert case["seeds"] == [5, 6, 7]
    assert stored["machine"]["torch"]


def test_learning_has_the_tables_of_the_issue(benchmarks: Any) -> None:
    tables = benchmarks("learning").TABLES
    # 64 environments are compared with one over the same number of steps.
    assert {case.n_envs for case in tables["envs"]} >= {1, 64}
    assert len({(case.env_id, case.steps) for case in tables["envs"]}) == 1


def test_the_zoo_benchmark_trains_as_the_command_does(
    benchmarks: Any, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {
        "n_timesteps": 1000.0,
        "policy": "KNNPolicy",
        "bounds": [[-2.4, -3.0, -0.21, -3.0], [2.4, 3.0, 0.21, 3.0]],
        "learning_rate": "lin_0.5_0.1",
        "n_envs": 2,
    }
    played = benchmarks("zoo").play("knntd", "CartPole-v1", settings, seed=3, episodes=5)

    config = tmp_path / "config.yml"
    config.write_text(yaml.safe_dump({"CartPole-v1": settings}))
    arguments = ["--seed", "3", "--eval-freq", "-1", "--conf-file", str(config), "-f", str(tmp_path)]
    assert cli.main(["train", "--algo", "knntd", "--env", "CartPole-v1", *arguments]) == 0
    model = KNNTD.load(tmp_path / "knntd" / "CartPole-v1_1" / "CartPole-v1.zip")
    returns, _ = evaluate_policy(model, make_vec_env("CartPole-v1", 10, seed=10_003), 5, return_episode_rewards=True)
    assert (model.policy.q_table != 0).any()
    assert played["returns"] == returns
    assert played["seconds"] > 0.0


def test_the_zoo_benchmark_evaluates_through_the_filter_that_was_learned(benchmarks: Any) -> None:
    zoo = benchmarks("zoo")
    settings = {
        "n_timesteps": 100.0,
        "policy": "KNNPolicy",
        "vec_env_wrapper": {"sb3_knntd.VecDeltaFilter": {"bounds": "adaptive"}},
    }
    seen = []

    def evaluate(model: Any, envs: VecEnv, *_: Any, **__: Any) -> tuple[list[float], list[int]]:
        seen.append((model.env, envs))
        return [0.0], [1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(zoo, "evaluate_policy", evaluate)
        zoo.play("knntd", "MountainCar-v0", settings, seed=0, episodes=1)
    ((training, evaluation),) = seen
    assert evaluation.table is training.table
    assert not evaluation.training


def test_the_zoo_benchmark_ends_endless_episodes(benchmarks: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo = benchmarks("zoo")
    monkeypatch.setattr(zoo, "MOST_STEPS", 20)
    # Without learning the policy would walk into the wall forever.
    settings = {"n_timesteps": 1.0, "policy": "KNNPolicy", "learning_rate": 0.0}
    assert zoo.play("knntd", "CliffWalking-v1", settings, seed=0, episodes=3)["returns"] == [-20.0] * 3


def test_the_zoo_benchmark_lists_published_results(benchmarks: Any) -> None:
    zoo = benchmarks("zoo")
    row = zoo.Row("knntd", "LunarLander-v3", 500_000, [7, 8], [[100.0, 300.0], [0.0, 0.0]], [2.0, 4.0])
    _, _, ours, *theirs = zoo.table([row]).splitlines()
    assert [cell.strip() for cell in ours.strip("|").split("|")] == [
        *("**knntd**", "LunarLander-v3", "100.00", "122.47", "100.00 [20.00, 180.00]", "500k", "2", "4", "3 s")
    ]
    assert len(theirs) == 3
    assert "| ppo | LunarLander-v2 | 242.12 | 31.82 |  | 1M | 1 |" in theirs[2]
    # The paper's Mountain-Car is a different environment from gymnasium's.
    assert len(zoo.table([row._replace(env_id="sb3_knntd/MountainCar-v0")]).splitlines()) == 3


def test_the_zoo_benchmark_writes_what_was_learned_and_tells_what_failed(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path
) -> None:
    zoo = benchmarks("zoo")

    def outcomes(jobs: list[Job], *_: Any) -> dict[str, Outcome]:
        learned = {job.key: Outcome({"returns": [-100.0, -110.0], "seconds": 1.0}) for job in jobs}
        return learned | {"knntd-MountainCar-v0-6": Outcome(error="Traceback\nImportError: no simulator\n")}

    monkeypatch.setattr(zoo, "run_jobs", outcomes)
    page, stored = tmp_path / "benchmark.md", tmp_path / "benchmark.json"
    command = ["--env", "MountainCar-v0", "--seeds", "10", "MountainCar-v0=3", "--first-seed", "5"]
    monkeypatch.setattr(sys, "argv", ["zoo", *command, "--markdown", str(page), "--json", str(stored)])
    with pytest.raises(SystemExit, match="knntd-MountainCar-v0-6: ImportError: no simulator"):
        zoo.main()
    (row,) = json.loads(stored.read_text())["rows"]
    assert row["seeds"] == [5, 7]
    assert (row["mean_reward"], row["std_reward"]) == ([-105.0, -105.0], [5.0, 5.0])
    assert f"python -m benchmarks.zoo {' '.join(command)}" in page.read_text()
    assert "| **knntd** | MountainCar-v0 | -105.00 | 5.00 | -105.00 [-105.00, -105.00] |" in page.read_text()


@pytest.mark.parametrize("words", ["0", "ten", "MountainCar-v0=", "=3", "MountainCar-v0=0", "Elsewhere-v0=3"])
def test_the_zoo_benchmark_refuses_seeds(benchmarks: Any, monkeypatch: pytest.MonkeyPatch, words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["zoo", "--seeds", words])
    with pytest.raises(SystemExit, match="2"):
        benchmarks("zoo").main()


def test_competition_counts_the_steps_of_each_episode(benchmarks: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    competition = benchmarks("competition")
    monkeypatch.setattr(competition, "EPISODES", 3)
    monkeypatch.setattr(competition, "MOST_STEPS", 50)
    # The goal cannot be reached in so few steps.
    for variant in competition.VARIANTS:
        assert competition.learn(variant, 7) == [50, 50, 50]


def test_competition_is_learned_with_the_stored_configuration(benchmarks: Any) -> None:
    competition = benchmarks("competition")
    settings = competition.settings()
    assert settings["bounds"] == "adaptive"
    assert not {"policy", "n_timesteps", "vec_env_wrapper"} & set(settings)
    KNNTD(competition.ENV_ID, **settings)


def test_tuning_compares_the_best_trials_with_the_configuration(benchmarks: Any) -> None:
    present = benchmarks("zoo").configurations()["knntd", "CartPole-v1"]
    study = optuna.create_study(direction="maximize")

    def objective(trial: optuna.Trial) -> float:
        for name, value in attributes(4, present).items():
            trial.set_user_attr(name, value)
        ALGORITHMS["knntd"].load_search_space().sample(trial, 2, 1, {})
        return [1.0, 3.0, 2.0][trial.number]

    study.optimize(objective, n_trials=3)
    tried = benchmarks("tuning").candidates("knntd", present, study, best=2)
    assert list(tried) == ["present", "1", "2"]
    assert tried["present"] == present
    for name in ("1", "2"):
        assert tried[name]["points"] == present["points"]
        assert tried[name]["gamma"] == pytest.approx(1 - study.trials[int(name)].params["one_minus_gamma"], abs=1e-3)
        arguments = {key: value for key, value in tried[name].items() if key not in ("n_timesteps", "policy")}
        KNNTD("CartPole-v1", **with_schedules(arguments))
