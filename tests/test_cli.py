"""The command line, as a user runs it."""

from __future__ import annotations

import gc
import os
import re
import signal
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import load_results

import sb3_knntd.experiments.demo
from sb3_knntd import KNNTD, ExA
from sb3_knntd.cli import main
from sb3_knntd.common import command_line
from sb3_knntd.common.command_line import CommandError

# SB3 silences this warning at import, which pytest undoes.
pytestmark = pytest.mark.filterwarnings("ignore:rich is experimental")

PNG = b"\x89PNG\r\n\x1a\n"
TABLE_ROW = re.compile(r"(-?\d+\.\d\d) +(\d+\.\d\d) +(-?\d+\.\d\d)$")


class CorridorEnv(gym.Env[np.ndarray, int]):
    """Walk right along [0, 1] to the end. The user presses Ctrl-C at some steps of training.

    :param interrupts: which steps, and how often in each
    """

    observation_space = spaces.Box(np.float32([0.0, -1.0]), np.float32([1.0, 1.0]), dtype=np.float32)
    action_space = spaces.Discrete(2)
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(self, interrupts: dict[int, int] | None = None, render_mode: str | None = None) -> None:
        self.interrupts = interrupts or {}
        self.render_mode = render_mode
        self.total_steps = 0
        self.x = 0.0

    def _observation(self) -> np.ndarray:
        return np.array([self.x, 0.0], dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = 0.0
        return self._observation(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.total_steps += 1
        for _ in range(self.interrupts.get(self.total_steps, 0)):
            signal.raise_signal(signal.SIGINT)
        self.x = float(np.clip(self.x + (0.25 if action == 1 else -0.25), 0.0, 1.0))
        return self._observation(), -1.0, self.x == 1.0, False, {}


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    gym.register("Corridor-v0", CorridorEnv, max_episode_steps=20)
    gym.register("Endless-v0", CorridorEnv)
    gym.register("Broken-v0", lambda: 1 / 0)
    gym.register("Interrupted-v0", CorridorEnv, kwargs={"interrupts": {57: 1}}, max_episode_steps=20)
    gym.register("InterruptedTwice-v0", CorridorEnv, kwargs={"interrupts": {57: 2}}, max_episode_steps=20)
    yield
    for name in ("Corridor-v0", "Endless-v0", "Broken-v0", "Interrupted-v0", "InterruptedTwice-v0"):
        del gym.registry[name]


def error_of(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must be refused; return its error message."""
    with pytest.raises(SystemExit) as refused:
        main(argv)
    output = capsys.readouterr()
    assert refused.value.code == 2
    assert output.out == ""
    assert output.err.count("\n") == 1
    return output.err


def test_a_user_runs_the_demo(tmp_path: Path) -> None:
    command = next(iter(entry_points(group="console_scripts", name="sb3-knntd")))
    program = f"import sys; from {command.module} import {command.attr}; sys.exit({command.attr}())"
    run = subprocess.run(
        [sys.executable, "-c", program, "demo", "--steps", "1000", "--seed", "3", "--out", "my demo"],
        cwd=tmp_path,
        env={**os.environ, "COLUMNS": "100"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    out = tmp_path / "my demo"

    assert "Training KNNTD on MountainCar-v0 for 1,000 steps" in run.stdout
    assert "1,000/1,000" in run.stdout + run.stderr, "no progress bar"
    lines = run.stdout.splitlines()
    header = next(line for line in lines if line.startswith("Return on MountainCar-v0"))
    assert header.split()[-3:] == ["mean", "std", "median"]
    learned, random = lines[lines.index(header) + 1 :][:2]
    assert learned.startswith("KNNTD ")
    assert random.startswith("random policy ")
    assert len(header) == len(learned) == len(random)
    for line in (learned, random):
        mean, std, median = map(float, TABLE_ROW.search(line).groups())
        assert -200 <= mean <= 0
        assert -200 <= median <= 0
        assert std >= 0

    assert "tensorboard --logdir 'my demo/tensorboard'" in run.stdout
    for ending in (".zip", ".monitor.csv", "_learning_curve.png", "_value_function.png"):
        assert (out / f"knntd_MountainCar-v0{ending}").is_file()
        assert str(Path("my demo") / f"knntd_MountainCar-v0{ending}") in run.stdout
    for picture in out.glob("*.png"):
        assert picture.read_bytes().startswith(PNG)
        assert picture.stat().st_size > 10_000
    assert list((out / "tensorboard" / "KNNTD_1").glob("events.out.tfevents.*"))
    assert zipfile.is_zipfile(out / "knntd_MountainCar-v0.zip")
    assert load_results(str(out))["l"].sum() == 1000

    model = KNNTD.load(out / "knntd_MountainCar-v0.zip")
    assert model.num_timesteps == 1000
    assert model.seed == 3


def test_the_table_is_that_of_the_saved_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[str, np.ndarray] = {}
    monkeypatch.setattr(sb3_knntd.experiments.demo, "_print_returns", lambda title, returns: shown.update(returns))
    assert main(["demo", "--env", "Corridor-v0", "--steps", "400", "--out", str(tmp_path)]) == 0
    assert len(shown["KNNTD"]) == len(shown["random policy"]) == 100
    # Four steps are the minimum; a trained policy takes four in every episode.
    np.testing.assert_array_equal(shown["KNNTD"], -4)
    assert shown["random policy"].mean() < -8
    assert shown["random policy"].std() > 0


def test_the_same_seed_gives_the_same_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = []
    for run in "ab":
        assert (
            main(["demo", "--env", "Corridor-v0", "--steps", "100", "--seed", "5", "--out", str(tmp_path / run)]) == 0
        )
        tables.append([line for line in capsys.readouterr().out.splitlines() if TABLE_ROW.search(line)])
    assert len(tables[0]) == 2
    assert tables[0] == tables[1]
    first, second = (KNNTD.load(tmp_path / run / "knntd_Corridor-v0.zip") for run in "ab")
    np.testing.assert_array_equal(first.policy.q_table.numpy(), second.policy.q_table.numpy())


def test_a_second_demo_replaces_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for steps in (100, 60):
        assert main(["demo", "--env", "Corridor-v0", "--steps", str(steps), "--out", str(tmp_path)]) == 0
    assert KNNTD.load(tmp_path / "knntd_Corridor-v0.zip").num_timesteps == 60
    assert sorted(path.name for path in (tmp_path / "tensorboard").iterdir()) == ["KNNTD_1", "KNNTD_2"]


def test_a_demo_of_a_single_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--env", "Corridor-v0", "--steps", "1", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "knntd_Corridor-v0_learning_curve.png").read_bytes().startswith(PNG)


def test_finite_states_have_no_value_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--env", "FrozenLake-v1", "--steps", "200", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "knntd_FrozenLake-v1_learning_curve.png").is_file()
    assert not (tmp_path / "knntd_FrozenLake-v1_value_function.png").exists()
    assert "value function" not in capsys.readouterr().out


def test_an_environment_without_end_is_evaluated_in_finite_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sb3_knntd.experiments.demo, "EVAL_STEP_LIMIT", 30)
    monkeypatch.setattr(KNNTD, "predict", lambda self, observation, **_: (np.zeros(len(observation), int), None))
    assert main(["demo", "--env", "Endless-v0", "--steps", "50", "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert re.search(r"^KNNTD +-30.00 +0.00 +-30.00$", output, re.MULTILINE)
    assert "cut at 30 steps" in output


def test_ctrl_c_keeps_what_was_learned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    handler = signal.getsignal(signal.SIGINT)
    assert main(["demo", "--env", "Interrupted-v0", "--steps", "5000", "--out", str(tmp_path)]) == 130
    assert signal.getsignal(signal.SIGINT) is handler
    output = capsys.readouterr().out
    path = tmp_path / "knntd_Interrupted-v0.zip"
    assert "Interrupted after 57 of 5,000 steps" in output
    assert "saved" in output
    assert str(path) in output
    model = KNNTD.load(path)
    assert model.num_timesteps == 57
    assert model.policy.q_table.any()


def test_a_second_ctrl_c_ends_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    handler = signal.getsignal(signal.SIGINT)
    assert main(["demo", "--env", "InterruptedTwice-v0", "--steps", "5000", "--out", str(tmp_path)]) == 130
    assert signal.getsignal(signal.SIGINT) is handler
    assert "Interrupted." in capsys.readouterr().err
    # The interrupted progress bar prints once more when it is collected: do this here, not in another test.
    gc.collect()
    assert not (tmp_path / "knntd_InterruptedTwice-v0.zip").exists()


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("MountainCra-v0", "MountainCar"),
        ("MountainCar-v99", "version"),
        ("no id at all", "Malformed"),
        ("no_such_package:Env-v0", "no_such_package"),
        ("Broken-v0", "ZeroDivisionError"),
    ],
)
def test_an_unknown_environment_is_refused(
    env_id: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    error = error_of(["demo", "--env", env_id, "--out", str(out)], capsys)
    assert error.startswith("sb3-knntd demo: error: ")
    assert env_id in error
    assert message in error
    assert not out.exists()


def test_continuous_actions_are_shown_with_exa(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--env", "Pendulum-v1", "--steps", "400", "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "Training ExA on Pendulum-v1 for 400 steps" in output
    assert re.search(r"^ExA +-\d+\.\d\d ", output, re.MULTILINE)
    assert re.search(r"^random policy +-\d+\.\d\d ", output, re.MULTILINE)
    assert ExA.load(tmp_path / "exa_Pendulum-v1.zip").num_timesteps == 400
    for picture in ("learning_curve", "value_function"):
        assert (tmp_path / f"exa_Pendulum-v1_{picture}.png").read_bytes().startswith(PNG)
    assert (tmp_path / "tensorboard" / "ExA_1").is_dir()


def test_unsupported_spaces_give_the_message_of_the_algorithm(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="Tuple") as refusal:
        KNNTD("Blackjack-v1")
    error = error_of(["demo", "--env", "Blackjack-v1", "--out", str(out)], capsys)
    assert " ".join(str(refusal.value).split()) in error
    assert not out.exists()


def test_traceback_is_shown_on_demand(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="Broken-v0") as error:
        main(["--traceback", "demo", "--env", "Broken-v0", "--out", str(tmp_path)])
    assert isinstance(error.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize("steps", ["0", "-5", "1.5", "many"])
def test_steps_must_be_a_positive_whole_number(steps: str, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(["demo", f"--steps={steps}"], capsys)
    assert "--steps" in error
    assert repr(steps) in error


@pytest.mark.parametrize("seed", ["-1", "4294967296", "x"])
def test_invalid_seeds_are_refused(seed: str, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(["demo", f"--seed={seed}"], capsys)
    assert "--seed" in error
    assert repr(seed) in error


def test_missing_extra_packages_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find_spec = command_line.find_spec
    absent = {"tqdm", "matplotlib"}
    monkeypatch.setattr(
        sb3_knntd.common.command_line, "find_spec", lambda name: None if name in absent else find_spec(name)
    )
    error = error_of(["demo", "--out", str(tmp_path / "out")], capsys)
    assert "tqdm and matplotlib" in error
    assert 'pip install "sb3-knntd[extra]"' in error
    assert not (tmp_path / "out").exists()


def test_out_must_be_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "taken"
    file.write_text("precious")
    error = error_of(["demo", "--env", "Corridor-v0", "--out", str(file)], capsys)
    assert str(file) in error
    assert file.read_text() == "precious"


@pytest.mark.parametrize("argv", [[], ["dance"], ["demo", "--episodes", "3"], ["demo", "extra"]])
def test_unknown_commands_are_refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert ": error: " in error_of(argv, capsys)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["--version"])
    assert done.value.code == 0
    assert capsys.readouterr().out == f"sb3-knntd {version('sb3-knntd')}\n"


@pytest.mark.parametrize(
    ("argv", "expected"),
    [(["--help"], ["demo", "--version"]), (["demo", "--help"], ["--env", "--steps", "--seed", "--out", "50000"])],
)
def test_help(argv: list[str], expected: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(argv)
    assert done.value.code == 0
    output = capsys.readouterr().out
    for word in expected:
        assert word in output
