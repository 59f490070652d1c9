"""The benchmarks run and write their results. No measured value is asserted."""

from __future__ import annotations

import importlib
import json
import math
import pathlib
import shutil
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from gymnasium.error import DependencyNotInstalled
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


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_export_prints_and_stores_its_table(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "export.json"
    command = [sys.executable, "-m", "benchmarks.export", "--repeats", "1", "--json", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    rows = json.loads(file.read_text())["rows"]
    # The page has the lines of this table.
    page = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    for row, printed in zip(rows, done.stdout.splitlines()[2:], strict=False):
        assert printed.startswith(f"| {row['policy']} | {row['options']} | {row['nanoseconds']:,.0f} | ")
        assert f"| {row['policy']} | {row['options']} | " in page
        assert row["size"] > 0
        assert 0.0 < row["nanoseconds"] < row["predict"]


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


def steady(*action: float) -> Any:
    """A model that always takes the same action."""
    return SimpleNamespace(predict=lambda observations, **_: (np.array([action] * len(observations)), None))


def test_an_evaluation_ends_when_the_threshold_is_out_of_reach(benchmarks: Any) -> None:
    efficiency = benchmarks("sample_efficiency")
    # Each step costs 1, and an episode of MountainCar-v0 that only idles has 200 of them.
    envs = make_vec_env("MountainCar-v0", 4, seed=0)
    idle = SimpleNamespace(predict=lambda observations, **_: (np.ones(len(observations), np.int64), None))
    goal = efficiency.Goal("MountainCar-v0", threshold=-110.0, most=0.0)
    assert efficiency.evaluate(idle, envs, goal) == -111.0
    assert efficiency.evaluate(idle, envs, goal, to_the_end=True) == -200.0
    assert efficiency.evaluate(idle, envs, goal._replace(threshold=-200.0)) == -200.0


@pytest.mark.parametrize(("angle", "share"), [(0.0, 1.0), (math.pi, 0.0)])
def test_the_swing_up_is_measured_by_how_long_the_pole_is_up(benchmarks: Any, angle: float, share: float) -> None:
    efficiency = benchmarks("sample_efficiency")
    goal = efficiency.TASKS["sb3_knntd/CartPoleSwingUp-v0"].goal
    # Without a push the pole stays where it is.
    start = {"start": (0.0, 0.0, angle, 0.0)}
    envs = make_vec_env(goal.env_id, 2, seed=0, env_kwargs=start)
    assert efficiency.evaluate(steady(0.0), envs, goal) == pytest.approx(share)


def test_an_episode_that_ends_early_has_the_pole_up_for_a_small_share(benchmarks: Any) -> None:
    efficiency = benchmarks("sample_efficiency")
    goal = efficiency.TASKS["sb3_knntd/CartPoleSwingUp-v0"].goal
    envs = make_vec_env(goal.env_id, 1, seed=0, env_kwargs={"start": (2.3, 2.0, 0.0, 0.0)})
    assert efficiency.evaluate(steady(0.0), envs, goal) <= 2 / 200


@pytest.mark.parametrize(("threshold", "steps"), [(-1000.0, 250), (0.0, None)])
def test_training_ends_at_the_threshold_or_at_the_limit(benchmarks: Any, threshold: float, steps: int | None) -> None:
    efficiency = benchmarks("sample_efficiency")
    goal = efficiency.Goal("MountainCar-v0", threshold, 0.0)._asdict()
    result = efficiency.train(goal, "knntd", {"policy": "KNNPolicy"}, limit=600, seed=3, warm=False)
    assert result["steps"] == steps
    assert (result["at_end"] is None) == (steps is not None)
    assert result["at_end"] is None or -200.0 <= result["at_end"] < 0.0
    assert result["cpu_seconds"] > 0.0
    assert result["seconds"] > 0.0


@pytest.mark.parametrize(
    ("steps", "is_met"),
    [
        ([750, 1000, 1000, 2000], True),
        ([250, 250, 250, 2250], False),
        ([250, 1250, 1250, 2000], False),
        ([250, 250, 250, math.inf], False),
    ],
)
def test_a_task_is_met_by_median_and_by_most_seeds(benchmarks: Any, steps: list[float], is_met: bool) -> None:
    efficiency = benchmarks("sample_efficiency")
    line = efficiency.TASKS["Pendulum-v1"]
    assert efficiency.is_met(line, steps) is is_met
    assert efficiency.is_met(line._replace(n_of_ten=7, median=1250), steps) is True
    assert efficiency.is_met(line.times(2), [2 * number for number in steps]) is is_met


def test_no_threshold_is_above_what_an_episode_can_have(benchmarks: Any) -> None:
    for line in benchmarks("sample_efficiency").TASKS.values():
        assert line.goal.most >= max(line.goal.threshold, 0.0)


def test_learning_tells_steps_to_thresholds(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: pathlib.Path
) -> None:
    learning, efficiency = benchmarks("learning"), benchmarks("sample_efficiency")
    computed: list[str] = []

    def outcomes(jobs: list[Job], folder: pathlib.Path, *_: Any) -> dict[str, Outcome]:
        assert folder == tmp_path
        computed.extend(job.key for job in jobs)
        steps = {5: 500, 6: 1500, 7: None}
        return {
            job.key: Outcome(
                {"steps": steps[job.arguments["seed"]], "cpu_seconds": 1.5, "seconds": 2.0, "at_end": -300.0}
            )
            for job in jobs
        }

    def make(env_id: str) -> Any:
        if env_id == "InvertedPendulum-v5":
            raise DependencyNotInstalled("no simulator")
        return gym.make(env_id)

    monkeypatch.setattr(efficiency, "run_jobs", outcomes)
    monkeypatch.setattr(efficiency, "gym", SimpleNamespace(make=make, spec=gym.spec))
    file = tmp_path / "steps.json"
    command = ["--seeds", "3", "--first-seed", "5", "--runs", str(tmp_path), "--json", str(file)]
    envs = ["--env", "Pendulum-v1", "InvertedPendulum-v5"]
    monkeypatch.setattr(sys, "argv", ["learning", "--only", "dyna", "rivals", *command, *envs])
    learning.main()
    printed, told = capsys.readouterr()
    assert "InvertedPendulum-v5 is left out: no simulator" in told
    assert (
        "| Pendulum-v1, -200 | 1,500 | 2 of 3 within 2,000 | 1.5 | <= 1,000; 10 of 10 within 2,000 | no "
        "| 500 1,500 > 4,000 |"
    ) in printed
    assert "| 1,500 | 2 of 3 within 4,000 | 1.5 | <= 2,000; 10 of 10 within 4,000 | no |" in printed
    assert "| Pendulum-v1, -200 | SAC | 1,500 | 2 of 3 within 4,000 | 1.5 | 500 1,500 > 4,000 |" in printed
    assert "| Pendulum-v1, -200 | CrossQ |" in printed
    stored = json.loads(file.read_text())
    assert [(row["table"], row["goal"]["env_id"]) for row in stored["dyna"]] == [
        ("tuned", "Pendulum-v1"),
        ("defaults", "Pendulum-v1"),
    ]
    assert [run["steps"] for run in stored["rivals"][0]["runs"]] == [500, 1500, None]
    # No run is computed twice.
    assert len(computed) == len(set(computed))


def test_learning_knows_a_task_for_every_rival(benchmarks: Any) -> None:
    efficiency = benchmarks("sample_efficiency")
    assert {rival.env_id for rival in efficiency.RIVALS} == set(efficiency.TASKS)
    assert len({rival[:2] for rival in efficiency.RIVALS}) == len(efficiency.RIVALS)


def test_planning_cost_measures_every_size(benchmarks: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    cost = benchmarks("planning_cost")
    monkeypatch.setattr(cost, "WARM_UP", 200)
    costs = cost.measure("CartPole-v1", [150, 300], window=100)
    assert [each.size for each in costs] == [150, 300]
    for each in costs:
        assert each.planning > 0.0
        assert each.longest >= each.step > 0.0
        assert each.longest_wall > 0.0


def test_planning_cost_refuses_sizes_that_overlap(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["planning_cost", "--sizes", "10000", "11000"])
    with pytest.raises(SystemExit, match="2"):
        benchmarks("planning_cost").main()
    assert "[10000, 11000]" in capsys.readouterr().err


def test_the_tank_is_held_by_the_pi_controller(
    benchmarks: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tank = benchmarks("tank")
    monkeypatch.setattr(tank, "EPISODES", 2)
    monkeypatch.setattr(sys, "argv", ["tank", "--seeds", "1", "--steps", "60"])
    tank.main()
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert [row[1].strip() for row in rows] == ["controller", "PI", "KNNDyna, seed 100", "KNNDyna, median"]
    assert float(rows[1][3]) < 0.5 < float(rows[2][3])


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
    row, _ = json.loads(stored.read_text())["rows"]
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
