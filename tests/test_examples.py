"""The examples run as they are, and show what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[1] / "examples"
PNG = b"\x89PNG\r\n\x1a\n"


def run(name: str, folder: Path, *arguments: str) -> str:
    """
    :param name: a script in ``examples/``
    :param folder: where to run it
    :param arguments: of its command line
    :return: what it prints
    """
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_tested() -> None:
    tests = Path(__file__).read_text()
    assert all(f'"{path.name}"' in tests for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb"))


def test_value_function(tmp_path: Path) -> None:
    run("value_function.py", tmp_path, "here.png")
    assert (tmp_path / "here.png").read_bytes().startswith(PNG)


def test_tank_level(tmp_path: Path) -> None:
    distances = dict(re.findall(r"(\w+): mean distance from the set point (\S+) cm", run("tank_level.py", tmp_path)))
    assert set(distances) == {"PI", "ExA"}
    # At the set points' average, the valve as it is, it would be three centimetres.
    assert float(distances["ExA"]) < 2.0
    assert (tmp_path / "tank_level.png").read_bytes().startswith(PNG)


def test_cliff_walking(tmp_path: Path) -> None:
    pattern = r"(\w+): greedy route of (\d+) steps, return while training (\S+)"
    lines = re.findall(pattern, run("cliff_walking.py", tmp_path))
    (sarsa, sarsa_steps, sarsa_return), (q_learning, q_steps, q_return) = lines
    assert (sarsa, q_learning) == ("sarsa", "q_learning")
    # The shortest way, along the edge, has 13 steps.
    assert int(q_steps) == 13 < int(sarsa_steps) < 20
    assert float(sarsa_return) > float(q_return)


def test_noisy_sensors(tmp_path: Path) -> None:
    printed = run("noisy_sensors.py", tmp_path)
    without, filtered = (int(steps) for steps in re.findall(r"filter: (\d+) steps to the goal", printed))
    assert filtered < without
    position, velocity = re.search(r"(\S+) of position, (\S+) of velocity", printed).groups()
    assert max(float(position), float(velocity)) < 0.75
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
