"""The benchmarks run and write what they say they do. Their figures are the machine's own, and none is asserted."""

from __future__ import annotations

import importlib
import json
import math
import pathlib
import subprocess
import sys
from typing import Any

import pytest

ROOT = pathlib.Path(__file__).parent.parent


@pytest.fixture
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of the benchmarks, which are run from the root of the repository and not installed."""
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
    # One for accelerators too, which is left out with a word where there is none.
    assert "cuda" in names


def test_without_an_accelerator_its_benchmark_is_left_out(
    benchmarks: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert benchmarks("speed").cuda(1) == []
    assert "no such device" in capsys.readouterr().err


def test_ratios_are_medians_of_pairs(benchmarks: Any) -> None:
    speed = benchmarks("speed")
    # The first of each is the warm-up, which does not count.
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
        """Plays in this process: what is tested is the table, not the pool."""

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
