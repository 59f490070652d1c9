"""The examples run without changes and give the results that they describe."""

from __future__ import annotations

import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[1] / "examples"
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """A function ``run(script, *arguments)`` that runs an example in an empty folder and returns its output."""

    def run(name: str, *arguments: str) -> str:
        # In this process: importing torch in a new one takes longer than most examples.
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_every_example_is_tested() -> None:
    tests = Path(__file__).read_text()
    assert all(f'"{path.name}"' in tests for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb"))


def test_value_function(run: Callable[..., str], tmp_path: Path) -> None:
    run("value_function.py", "here.png")
    assert (tmp_path / "here.png").read_bytes().startswith(PNG)


def test_tank_level(run: Callable[..., str], tmp_path: Path) -> None:
    distances = dict(re.findall(r"(\w+): mean distance from the set point (\S+) cm", run("tank_level.py")))
    assert set(distances) == {"PI", "ExA"}
    # A constant level at the mean of the set points has a mean distance of three centimetres.
    assert float(distances["ExA"]) < 2.0
    assert (tmp_path / "tank_level.png").read_bytes().startswith(PNG)


def test_dc_motor(run: Callable[..., str], tmp_path: Path) -> None:
    errors = [float(error) for error in re.findall(r"mean squared angle (\S+) rad", run("dc_motor.py"))]
    controller, imitated, learned = errors
    assert imitated < 1.3 * controller
    assert learned < 0.95 * controller
    assert (tmp_path / "dc_motor.png").read_bytes().startswith(PNG)


def test_correct_table(run: Callable[..., str], tmp_path: Path) -> None:
    steps, leftmost = zip(*re.findall(r": (\d+) steps, leftmost position (\S+)", run("correct_table.py")), strict=True)
    assert all(int(n) < 130 for n in steps)
    assert float(leftmost[1]) > float(leftmost[0])
    assert (tmp_path / "correct_table.png").read_bytes().startswith(PNG)


def test_knn_td_from_scratch(run: Callable[..., str]) -> None:
    printed = run("knn_td_from_scratch.py")
    first, *_, last = re.findall(r"episodes .* mean return (\S+)\n", printed)
    (greedy,) = re.findall(r"greedy policy: mean return (\S+)", printed)
    # Episodes that do not reach the goal have 200 steps. The environment's reward threshold is -110.
    assert float(first) < -190.0
    assert float(last) >= -110.0
    assert float(greedy) >= -110.0


def test_exa_from_scratch(run: Callable[..., str]) -> None:
    (greedy,) = re.findall(r"greedy policy: mean return (\S+)", run("exa_from_scratch.py"))
    # The environment's reward threshold is 90.
    assert float(greedy) >= 90.0


def test_delta_filter_from_scratch(run: Callable[..., str]) -> None:
    pairs = re.findall(r"error (\S+) of the sensor, (\S+) of the filter", run("delta_filter_from_scratch.py"))
    assert len(pairs) == 2
    assert all(float(filtered) < 0.85 * float(sensed) for sensed, filtered in pairs)


def test_cliff_walking(run: Callable[..., str]) -> None:
    pattern = r"(\w+): greedy path of (\d+) steps, mean training return (\S+)"
    lines = re.findall(pattern, run("cliff_walking.py"))
    (sarsa, sarsa_steps, sarsa_return), (q_learning, q_steps, q_return) = lines
    assert (sarsa, q_learning) == ("sarsa", "q_learning")
    # The shortest path, along the edge, has 13 steps.
    assert int(q_steps) == 13 < int(sarsa_steps) < 20
    assert float(sarsa_return) > float(q_return)


def test_noisy_sensors(run: Callable[..., str], tmp_path: Path) -> None:
    printed = run("noisy_sensors.py")
    without, filtered = (int(steps) for steps in re.findall(r"filter: (\d+) steps to the goal", printed))
    assert filtered < without
    shares = re.findall(r"(\S+) of (?:position|velocity)", printed)
    assert len(shares) == 2
    assert max(map(float, shares)) < 0.75
    assert (tmp_path / "noisy_sensors.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("name", ["look_inside.ipynb"])
def test_notebooks_run(name: str, tmp_path: Path) -> None:
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": tmp_path}}).execute()


@pytest.mark.parametrize("name", ["look_inside.ipynb"])
def test_notebooks_are_kept_without_outputs(name: str) -> None:
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    nbformat.validate(notebook)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
