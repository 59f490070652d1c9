"""Exported policies do what ``predict`` does."""

from __future__ import annotations

import csv
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from toy_envs import DriftEnv, GridEnv, PushEnv

from sb3_knntd import KNNTD, ExA
from sb3_knntd.kernels import jit

N_OBSERVATIONS = 10_000
SCATTERED = np.random.default_rng(5).uniform(DriftEnv.LOW, DriftEnv.HIGH, size=(150, 2))
GIVEN: dict[str, Any] = {"bounds": (DriftEnv.LOW, DriftEnv.HIGH), "seed": 0}
HASHED = {"policy_kwargs": {"table": "hashed"}}


class FromFive(DriftEnv):
    """Actions 5 to 7."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Discrete(3, start=5)

    def step(self, action: Any) -> Any:
        return super().step(action - 5)


def grown() -> KNNTD:
    """A model whose points were added to after it had learned, and that learned on."""
    model = KNNTD(DriftEnv(), points=SCATTERED, **GIVEN).learn(500)
    model.policy.add_points(SCATTERED[:40] + 0.013)
    return model.learn(500)


#: Models by name; each is made once.
MAKERS: dict[str, Callable[[], KNNTD | ExA]] = {
    "lattice": lambda: KNNTD(DriftEnv(), points=(20, 17), **GIVEN).learn(2_000),
    "gaussian": lambda: KNNTD(DriftEnv(), weights="gaussian", bandwidth=0.2, **GIVEN).learn(1_000),
    "untrained": lambda: KNNTD(DriftEnv(), points=(4, 3), initial_value=1.5, **GIVEN),
    "scattered": lambda: KNNTD(DriftEnv(), points=SCATTERED, n_neighbors=6, **GIVEN).learn(1_000),
    "ties": lambda: KNNTD(DriftEnv(), points=np.round(SCATTERED, 1), n_neighbors=7, **GIVEN).learn(1_000),
    "grown": grown,
    "float32": lambda: KNNTD(DriftEnv(), policy_kwargs={"dtype": th.float32}, **GIVEN).learn(1_000),
    "four dimensions": lambda: KNNTD("CartPole-v1", seed=0).learn(2_000),
    "one dimension": lambda: KNNTD("FrozenLake-v1", seed=0).learn(3_000),
    "counted states": lambda: KNNTD(GridEnv("multi_discrete"), seed=0).learn(2_000),
    "binary states": lambda: KNNTD(GridEnv("multi_binary"), seed=0).learn(2_000),
    "first action 5": lambda: KNNTD(FromFive(), points=(9, 7), **GIVEN).learn(1_000),
    "continuous": lambda: ExA(PushEnv(dtype=np.float32), points=(12, 9), **GIVEN).learn(1_000),
    "continuous, scattered": lambda: ExA(PushEnv(), points=SCATTERED, weights="gaussian", **GIVEN).learn(1_000),
    "joint": lambda: ExA(PushEnv(shape=(2,)), action_points=(2, 3), points=(9, 7), **GIVEN).learn(1_000),
    "factored": lambda: ExA(
        PushEnv(shape=(2, 1)), action_points=(2, 3), action_table="factored", points=(9, 7), **GIVEN
    ).learn(1_000),
    "whole actions": lambda: ExA(PushEnv(low=-3, high=4, dtype=np.int32), points=(9, 7), **GIVEN).learn(1_000),
}
if jit.AVAILABLE:
    MAKERS |= {
        "hashed": lambda: KNNTD(DriftEnv(), points=(20, 17), **GIVEN, **HASHED).learn(1_000),
        "more points than memory": lambda: KNNTD(DriftEnv(), points=10**6, **GIVEN).learn(1_000),
        "continuous, hashed": lambda: ExA(PushEnv(dtype=np.float32), points=5_000, **GIVEN, **HASHED).learn(1_000),
    }
MODELS: dict[str, KNNTD | ExA] = {}


@pytest.fixture(params=MAKERS)
def model(request: pytest.FixtureRequest) -> KNNTD | ExA:
    """Each of the models."""
    if request.param not in MODELS:
        MODELS[request.param] = MAKERS[request.param]()
    return MODELS[request.param]


def observations_of(model: KNNTD | ExA, n: int = N_OBSERVATIONS) -> np.ndarray:
    """Random observations inside and outside the range of the points; a tenth on points and halfway between them."""
    frozen = model.policy.frozen()
    drawn = frozen.sample_observations(n, seed=7)
    if isinstance(model.observation_space, spaces.Box):
        shape = (20,) * frozen.obs_dim if frozen.lattice is None else frozen.lattice.shape
        halves = 2 * np.maximum(np.array(shape) - 1, 1)
        places = np.random.default_rng(8).integers(0, halves + 1, (n // 10, frozen.obs_dim)) / halves
        drawn[: n // 10] = frozen.low + places * (frozen.high - frozen.low)
    return drawn


# ---------------------------------------------------------------------- C

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow", "-Wdouble-promotion"]
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="needs gcc or clang")


def run_c(
    source: Path, observations: np.ndarray, compiler: str, *flags: str, real: type = np.float64
) -> tuple[np.ndarray, np.ndarray]:
    """Compile an exported policy with a program that reads observations, and return its actions and values."""
    name = source.stem
    header = source.with_suffix(".h").read_text()
    size = "ACTION_SIZE" in header and int(header.partition("_ACTION_SIZE ")[2].split()[0])
    call = {
        False: f"actions[0] = {name}_action(observation);",
        1: f"actions[0] = {name}_action(observation);",
    }.get(size, f"{name}_action(observation, actions);")
    upper, n_actions = name.upper(), size or 1
    program = f"""
#include <stdio.h>
#include "{name}.h"
int main(void)
{{
    {name}_real observation[{upper}_OBSERVATION_SIZE], actions[{n_actions}], values[{upper}_N_VALUES];
    while (fread(observation, sizeof observation, 1, stdin) == 1) {{
        {call}
        {name}_q_values(observation, values);
        fwrite(actions, sizeof actions, 1, stdout);
        fwrite(values, sizeof values, 1, stdout);
    }}
    return 0;
}}
"""
    main = source.with_name("main.c")
    main.write_text(program)
    binary = source.with_name("a.out")
    # Only the exported file is held to the strict rules.
    subprocess.run([compiler, *STRICT, *flags, "-c", str(source), "-o", str(source.with_suffix(".o"))], check=True)
    subprocess.run([compiler, "-O1", str(main), str(source.with_suffix(".o")), "-lm", "-o", str(binary)], check=True)
    given = observations.reshape(len(observations), -1).astype(real)
    answer = subprocess.run([str(binary)], input=given.tobytes(), capture_output=True, check=True).stdout
    rows = np.frombuffer(answer, real).reshape(len(observations), -1)
    return rows[:, :n_actions], rows[:, n_actions:]


def actions_as_rows(model: KNNTD | ExA, observations: np.ndarray) -> np.ndarray:
    return model.predict(observations, deterministic=True)[0].reshape(len(observations), -1)


@needs_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
def test_c_acts_like_predict(model: KNNTD | ExA, compiler: str, tmp_path: Path) -> None:
    observations = observations_of(model)
    source, _ = model.policy.export(tmp_path / "policy.c", "c")
    actions, values = run_c(source, observations, compiler, "-O2")
    expected = actions_as_rows(model, observations)
    if isinstance(model, KNNTD):
        np.testing.assert_array_equal(actions, expected)
    else:
        # A double that is rounded to the dtype of the action space.
        np.testing.assert_allclose(actions, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(values, model.policy.q_values(observations).numpy(), rtol=1e-6, atol=1e-6)


# ------------------------------------------------------------------- ONNX


def test_onnx_acts_like_predict(model: KNNTD | ExA, tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    observations = observations_of(model)
    (path,) = model.policy.export(tmp_path / "policy", "onnx")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    actions, values = session.run(None, {"observation": observations})
    expected = model.predict(observations, deterministic=True)[0]
    assert actions.dtype == expected.dtype
    assert actions.shape == expected.shape
    if isinstance(model, KNNTD):
        np.testing.assert_array_equal(actions, expected)
    else:
        np.testing.assert_allclose(actions, expected, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(values, model.policy.q_values(observations).numpy(), rtol=1e-6, atol=1e-6)
    singles = [session.run(["action"], {"observation": observations[i : i + 1]})[0] for i in range(100)]
    np.testing.assert_array_equal(np.concatenate(singles), actions[:100])


# ------------------------------------------------------------------ torch


def acts(program: Callable[[th.Tensor], th.Tensor], model: KNNTD | ExA, n: int = 2_000) -> None:
    """Check that a program acts like a model on a batch, and on single observations."""
    observations = observations_of(model, n)
    expected = model.predict(observations, deterministic=True)[0]
    actions = program(th.from_numpy(observations)).numpy()
    assert actions.dtype == expected.dtype
    assert actions.shape == expected.shape
    if isinstance(model, KNNTD):
        np.testing.assert_array_equal(actions, expected)
    else:
        np.testing.assert_allclose(actions, expected, rtol=1e-7, atol=1e-12)
    for i in range(20):
        np.testing.assert_array_equal(program(th.from_numpy(observations[i : i + 1])).numpy(), actions[i : i + 1])


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
def test_torchscript_acts_like_predict(model: KNNTD | ExA, tmp_path: Path) -> None:
    (path,) = model.policy.export(tmp_path / "policy", "torchscript")
    acts(th.jit.load(path), model)


def test_torch_export_acts_like_predict(model: KNNTD | ExA, tmp_path: Path) -> None:
    (path,) = model.policy.export(tmp_path / "policy", "torch_export")
    acts(th.export.load(path).module(), model)
