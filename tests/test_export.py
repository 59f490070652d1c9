"""Exported policies do what ``predict`` does."""

from __future__ import annotations

import base64
import json
import pathlib
import pickle
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from toy_envs import DriftEnv, GridEnv, PushEnv

from sb3_knntd import KNNTD, ExA, ExAPolicy, KNNDyna, KNNPolicy, load_policy
from sb3_knntd.actions.exploration import EpsilonGreedy
from sb3_knntd.actions.selection import MeanValueSelector
from sb3_knntd.cli import main
from sb3_knntd.export import FORMATS
from sb3_knntd.kernels import jit
from sb3_knntd.kernels.perceive import Weighting
from sb3_knntd.kernels.selection import Target

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")

Model = KNNTD | ExA | KNNDyna

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


class CountedPush(GridEnv):
    """A torus of cells on which an action from 0 to 3 is rounded to a move; half of a move costs nothing."""

    def __init__(self) -> None:
        super().__init__("multi_discrete")
        self.action_space = spaces.Box(0.0, 3.0, (1,), np.float32)  # type: ignore[assignment]

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(np.rint(action[0]))
        return observation, reward - 0.3 * float(action[0] - 1.4) ** 2, *rest


def ruled(model: Model) -> Model:
    """The model, with actions forbidden in two regions that overlap."""
    low, high = DriftEnv.LOW, DriftEnv.HIGH
    space = model.action_space
    first: Any = space.start if isinstance(space, spaces.Discrete) else {0: (0.5, 1.0)}
    second: Any = space.start + 1 if isinstance(space, spaces.Discrete) else {0: (-1.0, -0.5)}
    model.policy.forbid(first, {0: (low[0], 0.3 * high[0])})
    model.policy.forbid(second, {1: (0.0, np.inf)})
    return model


def dyna(env: Any, n_steps: int = 200, **arguments: Any) -> KNNDyna:
    """A model of KNNDyna that learned for a few steps."""
    return KNNDyna(env, seed=0, **{"simulated_steps": 10, **arguments}).learn(n_steps)


def grown() -> KNNTD:
    """A model whose points were added to after it had learned, and that learned on."""
    model = KNNTD(DriftEnv(), points=SCATTERED, **GIVEN).learn(500)
    model.policy.add_points(SCATTERED[:40] + 0.013)
    return model.learn(500)


#: Models by name; each is made once.
MAKERS: dict[str, Callable[[], Model]] = {
    "lattice": lambda: KNNTD(DriftEnv(), points=(20, 17), **GIVEN).learn(2_000),
    "gaussian": lambda: KNNTD(DriftEnv(), weights="gaussian", bandwidth=0.2, **GIVEN).learn(1_000),
    "forbidden": lambda: ruled(KNNTD(DriftEnv(), points=(9, 7), **GIVEN).learn(1_000)),
    "forbidden, continuous": lambda: ruled(ExA(PushEnv(), points=(9, 7), **GIVEN).learn(1_000)),
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
    "growing": lambda: KNNTD(DriftEnv(), points="grow", spacing=0.1, weights="gaussian", seed=0).learn(1_000),
    "fewer points than neighbours": lambda: KNNTD(DriftEnv(), points="grow", spacing=1.2, n_neighbors=9, seed=0).learn(
        300
    ),
    "planned": lambda: dyna(DriftEnv()),
    "planned, counted states": lambda: dyna(GridEnv("multi_discrete")),
    "planned, forbidden": lambda: ruled(dyna(FromFive(), policy_kwargs={"dtype": th.float32})),
    "peak": lambda: dyna(PushEnv(dtype=np.float32), action_points=5),
    "peak, two points": lambda: dyna(PushEnv(), action_points=[[-1.0, 0.5]], spacing=0.5),
    "peak, forbidden": lambda: ruled(dyna(PushEnv(shape=(2,)), action_points=(9, 3))),
    "peak, two dimensions": lambda: dyna(
        PushEnv(shape=(2, 1), dtype=np.float32), action_points=[[-1.0, -0.2, 0.7, 1.0], [-1.0, 0.1, 1.0]]
    ),
    "peak, whole actions": lambda: dyna(PushEnv(low=-3, high=4, dtype=np.int32)),
    "peak, counted states": lambda: dyna(CountedPush(), action_points=5),
}
if jit.AVAILABLE:
    MAKERS |= {
        "hashed": lambda: KNNTD(DriftEnv(), points=(20, 17), **GIVEN, **HASHED).learn(1_000),
        "more points than memory": lambda: KNNTD(DriftEnv(), points=10**6, **GIVEN).learn(1_000),
        "continuous, hashed": lambda: ExA(PushEnv(dtype=np.float32), points=5_000, **GIVEN, **HASHED).learn(1_000),
    }
MODELS: dict[str, Model] = {}
#: Torch takes seconds to export a policy: the others are exported by the slow tests.
FEW = {"lattice", "scattered", "four dimensions", "counted states", "whole actions", "continuous, hashed"}
FEW |= {"planned", "peak, two dimensions", "peak, forbidden", "fewer points than neighbours"}


def model_of(name: str) -> Model:
    """One of the models."""
    if name not in MODELS:
        MODELS[name] = MAKERS[name]()
    return MODELS[name]


@pytest.fixture(params=MAKERS)
def model(request: pytest.FixtureRequest) -> Model:
    """Each of the models."""
    return model_of(request.param)


def observations_of(model: Model, n: int = N_OBSERVATIONS) -> np.ndarray:
    """Random observations inside and outside the range of the points; a tenth on points and halfway between them."""
    frozen = model.policy.frozen()
    drawn = frozen.sample_observations(n, seed=7)
    if isinstance(model.observation_space, spaces.Box):
        shape = (20,) * frozen.obs_dim if frozen.lattice is None else frozen.lattice.shape
        halves = 2 * np.maximum(np.array(shape) - 1, 1)
        places = np.random.default_rng(8).integers(0, halves + 1, (n // 10, frozen.obs_dim)) / halves
        drawn[: n // 10] = frozen.low + places * (frozen.high - frozen.low)
    return drawn


def assert_same_actions(
    model: Model, actions: np.ndarray, expected: np.ndarray, rtol: float = 1e-7, atol: float = 1e-12
) -> None:
    """Check actions against those of ``predict``."""
    if isinstance(model.action_space, spaces.Discrete):
        np.testing.assert_array_equal(actions, expected)
    elif isinstance(model, KNNDyna):
        # Of action points whose values differ by little more than rounding does, the peak is as uncertain.
        difference = np.abs(actions.astype(np.float64) - expected)
        assert (difference < 1e-6).mean() > 0.998
        assert difference.max() < 1e-2
    else:
        np.testing.assert_allclose(actions, expected, rtol=rtol, atol=atol)


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


def actions_as_rows(model: Model, observations: np.ndarray) -> np.ndarray:
    return model.predict(observations, deterministic=True)[0].reshape(len(observations), -1)


@needs_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
def test_c_acts_like_predict(model: Model, compiler: str, tmp_path: Path) -> None:
    observations = observations_of(model)
    source, _ = model.policy.export(tmp_path / "policy.c", "c")
    actions, values = run_c(source, observations, compiler, "-O2")
    # A double that is rounded to the dtype of the action space.
    assert_same_actions(model, actions, actions_as_rows(model, observations), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(values, model.policy.q_values(observations).numpy(), rtol=1e-6, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize("rows", ["changed", "all"])
@pytest.mark.parametrize("name", ["lattice", "scattered", "float32", "continuous", "untrained"])
def test_c_stores_all_rows_or_those_that_changed(name: str, rows: str, tmp_path: Path) -> None:
    model = model_of(name)
    observations = observations_of(model, 2_000)
    source, _ = model.policy.export(tmp_path / "policy", "c", rows=rows)
    actions, values = run_c(source, observations, COMPILERS[0], "-Os")
    np.testing.assert_allclose(actions, actions_as_rows(model, observations), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(values, model.policy.q_values(observations).numpy(), rtol=1e-6, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize(
    "name", ["lattice", "gaussian", "scattered", "continuous", "whole actions", "planned", "peak, two dimensions"]
)
def test_c_computes_in_single_precision(name: str, tmp_path: Path) -> None:
    model = model_of(name)
    observations = observations_of(model, 2_000)
    source, header = model.policy.export(tmp_path / "policy.h", "c", precision="float")
    assert "typedef float policy_real;" in header.read_text()
    assert "double" not in source.read_text()
    actions, values = run_c(source, observations, COMPILERS[0], "-O3", real=np.float32)
    expected = model.policy.q_values(observations).numpy()
    # Which points are the nearest is a matter of the last digit on points and halfway between them.
    usual = slice(len(observations) // 10, None)
    np.testing.assert_allclose(values[usual], expected[usual], rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    agree = (np.abs(actions - actions_as_rows(model, observations)) < 1e-3)[usual].all(axis=1)
    # Between values that are equal to the last digit either action can be taken.
    differ = np.ptp(expected[usual], axis=1) > 1e-4 * np.abs(expected).max()
    assert differ.mean() > 0.3
    assert agree[differ].mean() > 0.99
    assert agree.mean() > 0.95


@needs_compiler
@pytest.mark.parametrize("name", ["lattice", "scattered", "continuous", "counted states", "peak", "peak, forbidden"])
def test_c_is_safe_with_any_number(name: str, tmp_path: Path) -> None:
    """A sensor may fail: what is returned is an action, and no memory is touched that is not its own."""
    model = model_of(name)
    odd = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-310, 0.0, -0.0])
    observations = np.stack([each.ravel() for each in np.meshgrid(odd, odd)], axis=1)
    source, _ = model.policy.export(tmp_path / "policy", "c")
    checks = ["-g", "-fsanitize=undefined", "-fsanitize-undefined-trap-on-error", "-fstack-protector-all"]
    actions, values = run_c(source, observations, COMPILERS[0], *checks)
    assert np.isfinite(actions).all()
    assert np.isfinite(values).all()
    space = model.action_space
    low, high = (space.low, space.high) if isinstance(space, spaces.Box) else (0, 2**31)
    assert ((actions >= low) & (actions <= high)).all()


@needs_compiler
def test_many_dimensions_are_for_c(tmp_path: Path) -> None:
    """Tensor operations compare all points that could be near; C goes through them as far as it must."""
    if not jit.AVAILABLE:
        pytest.skip("hashed tables need numba")
    space = spaces.Box(-1.0, 1.0, (12,), np.float32)
    policy = KNNPolicy(space, spaces.Discrete(3), points=10)
    observations = policy.frozen().sample_observations(300)
    observations[:50] = 0.0  # the middle of a cell, as far from each of its 2^12 corners
    rows = policy.perceive(observations).indices[:, ::3].unique()
    values = th.from_numpy(np.random.default_rng(0).normal(size=(len(rows), 3)))
    state = {"table.row_points": rows, "table.row_visits": th.ones(len(rows), dtype=th.int32), "table.values": values}
    policy.load_state_dict({**policy.state_dict(), **state})
    expected, _ = policy.predict(observations)
    assert len(np.unique(expected)) == 3
    source, _ = policy.export(tmp_path / "policy", "c")
    np.testing.assert_array_equal(run_c(source, observations, COMPILERS[0], "-O2")[0][:, 0], expected)
    with pytest.raises(ValueError, match=r"lattice of 12 dimensions .* Export the policy as 'c'"):
        policy.export(tmp_path / "policy", "torchscript")


@needs_compiler
def test_the_program_in_the_docs_runs(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "export.md").read_text(encoding="utf-8")
    model = KNNTD("MountainCar-v0", points=20, seed=0).learn(500)
    source, _ = model.policy.export(tmp_path / "mountain_car", "c")
    main = tmp_path / "main.c"
    main.write_text(page.partition("```c\n")[2].partition("```")[0])
    subprocess.run(
        [COMPILERS[0], *STRICT, str(main), str(source), "-lm", "-o", str(tmp_path / "controller")], check=True
    )
    told = subprocess.run([tmp_path / "controller"], capture_output=True, check=True, text=True).stdout
    action, _ = model.predict(np.array([-0.5, 0.02], np.float32), deterministic=True)
    assert told.startswith(f"action {action} of values ")


@needs_compiler
def test_names_in_c_follow_that_of_the_file(tmp_path: Path) -> None:
    source, header = model_of("lattice").policy.export(tmp_path / "2-joint arm.c", "c")
    assert header == tmp_path / "2-joint arm.h"
    subprocess.run([COMPILERS[0], *STRICT, "-c", str(source), "-o", str(tmp_path / "arm.o")], check=True)
    assert "int _2_joint_arm_action(" in header.read_text()


def test_values_too_large_for_a_float_are_refused(tmp_path: Path) -> None:
    model = KNNTD(DriftEnv(), points=(3, 3), bandwidth=1e-30, **GIVEN)
    model.policy.export(tmp_path / "policy", "c")
    model.policy.table.values[:] = 1e39
    with pytest.raises(ValueError, match=r"precision='float': 1e\+39 is too large for it, use 'double'"):
        model.policy.export(tmp_path / "policy", "c", precision="float")


# ------------------------------------------------------------------- ONNX


def test_onnx_acts_like_predict(model: Model, tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    observations = observations_of(model)
    (path,) = model.policy.export(tmp_path / "policy", "onnx")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    actions, values = session.run(None, {"observation": observations})
    expected = model.predict(observations, deterministic=True)[0]
    assert actions.dtype == expected.dtype
    assert actions.shape == expected.shape
    assert_same_actions(model, actions, expected)
    np.testing.assert_allclose(values, model.policy.q_values(observations).numpy(), rtol=1e-6, atol=1e-6)
    singles = [session.run(["action"], {"observation": observations[i : i + 1]})[0] for i in range(100)]
    np.testing.assert_array_equal(np.concatenate(singles), actions[:100])


# ------------------------------------------------------------------ torch


def few_by_default(few: set[str]) -> list[Any]:
    """All models, most of them in the slow tests."""
    return [pytest.param(name, marks=() if name in few else pytest.mark.slow) for name in MAKERS]


def acts(program: Callable[[th.Tensor], th.Tensor], model: Model, n: int = 2_000) -> None:
    """Check that a program acts like a model on a batch, and on single observations."""
    observations = observations_of(model, n)
    expected = model.predict(observations, deterministic=True)[0]
    actions = program(th.from_numpy(observations)).numpy()
    assert actions.dtype == expected.dtype
    assert actions.shape == expected.shape
    assert_same_actions(model, actions, expected)
    for i in range(20):
        np.testing.assert_array_equal(program(th.from_numpy(observations[i : i + 1])).numpy(), actions[i : i + 1])


@pytest.mark.parametrize("name", few_by_default(FEW))
def test_torchscript_acts_like_predict(name: str, tmp_path: Path) -> None:
    (path,) = model_of(name).policy.export(tmp_path / "policy", "torchscript")
    acts(th.jit.load(path), model_of(name))


@pytest.mark.parametrize("name", few_by_default({"whole actions", "continuous, hashed", "peak, forbidden"}))
def test_torch_export_acts_like_predict(name: str, tmp_path: Path) -> None:
    (path,) = model_of(name).policy.export(tmp_path / "policy", "torch_export")
    acts(th.export.load(path).module(), model_of(name))


# -------------------------------------------------- safetensors, CSV, NPZ


def test_a_shared_policy_is_the_same(model: Model, tmp_path: Path) -> None:
    pytest.importorskip("safetensors")
    (path,) = model.policy.export(tmp_path / "policy", "safetensors")
    policy = load_policy(path)
    assert type(policy) is type(model.policy)
    observations = observations_of(model, 1_000)
    np.testing.assert_array_equal(policy.predict(observations)[0], model.policy.predict(observations)[0])
    assert policy.q_values(observations).equal(model.policy.q_values(observations))
    assert policy.points.equal(model.policy.points)
    saved = model.policy.state_dict()
    assert {name: tensor.dtype for name, tensor in policy.state_dict().items()} == {
        name: tensor.dtype for name, tensor in saved.items()
    }
    assert all(tensor.equal(saved[name]) for name, tensor in policy.state_dict().items())


def test_learning_goes_on_from_a_shared_policy(tmp_path: Path) -> None:
    pytest.importorskip("safetensors")
    model = model_of("lattice")
    (path,) = model.policy.export(tmp_path / "policy", "safetensors")
    other = KNNTD(DriftEnv(), points=(20, 17), **GIVEN)
    other.policy.load_state_dict(load_policy(path).state_dict())
    assert other.policy.q_table.equal(model.policy.q_table)
    other.learn(100)
    assert not other.policy.q_table.equal(model.policy.q_table)


class Bomb:
    """Unpickling it executes code."""

    def __reduce__(self) -> Any:
        return pathlib.Path.touch, (pathlib.Path("executed"),)


DESCRIPTIONS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no dict": lambda told: [told],
    "of another version": lambda told: {**told, "version": 99},
    "of no policy": lambda told: {**told, "policy": "os.system"},
    "of another class": lambda told: {**told, "policy": "stable_baselines3.common.policies.BasePolicy"},
    "without arguments": lambda told: {**told, "arguments": None},
    "of other spaces": lambda told: {**told, "arguments": {**told["arguments"], "observation_space": 3}},
    "with another argument": lambda told: {**told, "arguments": {**told["arguments"], "eval": "1"}},
    "with other points": lambda told: {**told, "arguments": {**told["arguments"], "points": [3, 3]}},
    "with too many points": lambda told: {**told, "arguments": {**told["arguments"], "points": 10**12}},
    "with a class": lambda told: {
        **told,
        "arguments": {**told["arguments"], "weights": {":plain:": "class", "of": ["sb3_knntd.policies.KNNPolicy"]}},
    },
    "with a pickle": lambda told: {
        **told,
        "arguments": {
            **told["arguments"],
            "weights": {":serialized:": base64.b64encode(pickle.dumps(Bomb())).decode()},
        },
    },
}


@pytest.mark.parametrize("fault", DESCRIPTIONS)
def test_a_forged_policy_is_refused(fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    safetensors = pytest.importorskip("safetensors.torch")
    monkeypatch.chdir(tmp_path)
    model_of("lattice").policy.export("policy", "safetensors")
    content = pathlib.Path("policy.safetensors").read_bytes()
    size = int.from_bytes(content[:8], "little")
    told = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["sb3_knntd"])
    tensors = safetensors.load(content)
    safetensors.save_file(tensors, "forged.safetensors", {"sb3_knntd": json.dumps(DESCRIPTIONS[fault](told))})
    with pytest.raises(ValueError, match=r"."):
        load_policy("forged.safetensors")
    assert not pathlib.Path("executed").exists()


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    safetensors = pytest.importorskip("safetensors.torch")
    path = tmp_path / "other.safetensors"
    with pytest.raises(FileNotFoundError, match="other"):
        load_policy(path)
    path.write_bytes(b"something")
    with pytest.raises(ValueError, match="no safetensors file"):
        load_policy(path)
    safetensors.save_file({"weight": th.zeros(3)}, path)
    with pytest.raises(ValueError, match="no policy of sb3-knntd"):
        load_policy(path)
    model_of("lattice").policy.export(path, "safetensors")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="cut off"):
        load_policy(path)


def test_tables_hold_points_values_and_visits(model: Model, tmp_path: Path) -> None:
    policy = model.policy
    (npz,) = policy.export(tmp_path / "table", "npz")
    (csv,) = policy.export(tmp_path / "table", "csv")
    with np.load(npz) as arrays:
        order = policy.table.points()
        order = slice(None) if order is None else order.argsort()
        np.testing.assert_allclose(arrays["points"], policy.points[order], rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(arrays["values"], policy.q_table[order])
        assert (arrays["visits"] > 0).sum() == policy.table.n_visited
        assert len(arrays["actions"]) == arrays["values"].shape[1]
        header = csv.read_text().partition("\n")[0].split(",")
        rows = np.loadtxt(csv, delimiter=",", skiprows=1, ndmin=2)
        assert len(header) == rows.shape[1] == len(set(header))
        parts = (arrays["points"], arrays["values"], arrays["visits"][:, None])
        np.testing.assert_array_equal(rows, np.concatenate(parts, axis=1))


def test_columns_of_tables_are_named_by_their_actions(tmp_path: Path) -> None:
    names = {}
    for name in ("first action 5", "joint", "factored"):
        (path,) = model_of(name).policy.export(tmp_path / name, "csv")
        names[name] = path.read_text().partition("\n")[0].split(",")[2:-1]
    assert names == {
        "first action 5": ["q_5", "q_6", "q_7"],
        "joint": ["q_-1_-1", "q_-1_0", "q_-1_1", "q_1_-1", "q_1_0", "q_1_1"],
        "factored": ["q_action0_-1", "q_action0_1", "q_action1_-1", "q_action1_0", "q_action1_1"],
    }


# ------------------------------------------------------------- all formats


class BestOfMean(ExAPolicy):
    """Takes the one action point whose mean value is the best."""

    def _greedy_selector(self) -> MeanValueSelector:
        return MeanValueSelector(self.columns, Target.SARSA, EpsilonGreedy(), random_ties=False)

    def _recommended(self, action_indices: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
        return self.fit_actions(self.columns.points[action_indices[:, 0, 0]])


def test_a_continuous_action_can_be_chosen_from_the_mean(tmp_path: Path) -> None:
    env = PushEnv(shape=(2,))
    policy = BestOfMean(env.observation_space, env.action_space, action_points=(2, 3), points=(9, 7))
    random = np.random.default_rng(0)
    policy.load_from_vector(random.normal(size=policy.q_table.numel()))
    observations = policy.frozen().sample_observations(1_000)
    expected, _ = policy.predict(observations)
    assert len(np.unique(expected, axis=0)) == 6
    if COMPILERS:
        source, _ = policy.export(tmp_path / "policy", "c")
        np.testing.assert_allclose(run_c(source, observations, COMPILERS[0], "-O2")[0], expected, rtol=1e-6)
    onnxruntime = pytest.importorskip("onnxruntime")
    (path,) = policy.export(tmp_path / "policy", "onnx")
    actions = onnxruntime.InferenceSession(path).run(["action"], {"observation": observations})[0]
    np.testing.assert_array_equal(actions, expected)


PEAKS = [name for name in MAKERS if name.startswith("peak")]


@pytest.mark.parametrize("name", PEAKS)
def test_models_with_peaks_take_actions_between_their_action_points(name: str) -> None:
    """Otherwise, the tests of formats with them would not test peaks."""
    model = model_of(name)
    observations = observations_of(model)
    taken = model.predict(observations)[0].reshape(len(observations), -1).astype(np.float64)
    between = [
        ~np.isclose(taken[:, [dimension]], points.numpy(), rtol=1e-6).any(axis=1)
        for dimension, points in enumerate(model.policy.action_points)
    ]
    shares = [each.mean() for each in between]
    expected = [name != "peak, two points"] * len(shares)
    assert [share > 0.03 for share in shares] == expected, shares


@pytest.mark.parametrize("name", FORMATS)
def test_a_policy_without_points_is_not_exported(name: str, tmp_path: Path) -> None:
    if FORMATS[name].needs:
        pytest.importorskip(FORMATS[name].needs)
    for model in (KNNDyna(PushEnv()), KNNTD(DriftEnv(), points="grow")):
        with pytest.raises(ValueError, match=r"no points yet.*call learn"):
            model.policy.export(tmp_path / "policy", name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("weighting", Weighting)
def test_every_kernel_of_weights_can_be_exported(weighting: Weighting, tmp_path: Path) -> None:
    """Whoever adds one adds its formula to the formats that write formulas."""
    model = KNNTD(DriftEnv(), points=(9, 7), weights=weighting.name.lower(), bandwidth=0.7, **GIVEN).learn(500)
    model.policy.export(tmp_path / "policy", "c")
    pytest.importorskip("onnx")
    model.policy.export(tmp_path / "policy", "onnx")


def test_functions_as_weights_are_for_torch_only(tmp_path: Path) -> None:
    model = KNNTD(DriftEnv(), points=(9, 7), weights=lambda squares: 1.0 / (0.1 + squares), **GIVEN).learn(500)
    for name in ("c", "onnx", "safetensors"):
        with pytest.raises(ValueError, match=f"weights: a function .* '{name}'.*'torchscript'"):
            model.policy.export(tmp_path / "policy", name)
    for name in ("torchscript", "csv", "npz"):
        model.policy.export(tmp_path / "policy", name)
    acts(th.jit.load(tmp_path / "policy.pt"), model)


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "torch_export"])
def test_what_is_exported_in_training_is_up_to_date(name: str, tmp_path: Path) -> None:
    """Values of points with a trace are not in the table yet."""
    exported: list[list[bytes]] = []

    class Export(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 40:
                policy = self.model.policy
                for _ in range(2):
                    files = policy.export(tmp_path / "policy", name)
                    exported.append([file.read_bytes() for file in files])
                    policy.table.drop_traces()
            return True

    if FORMATS[name].needs:
        pytest.importorskip(FORMATS[name].needs)
    KNNTD(DriftEnv(), points=(9, 7), **GIVEN).learn(40, callback=Export())
    if not name.startswith("torch"):  # torch's files differ each time
        assert exported[0] == exported[1]


def test_torch_export_of_a_table_that_is_behind_is_refused() -> None:
    """It would silently be the policy of some steps ago."""

    class Export(BaseCallback):
        def _on_step(self) -> bool:
            policy, example = self.model.policy, th.zeros(2, 2)
            with pytest.raises(ValueError, match=r"call model\.policy\.eval\(\) first"):
                th.export.export(policy, (example,))
            program = th.export.export(policy.eval(), (example,)).module()
            places = th.from_numpy(observations_of(self.model, 2))
            np.testing.assert_array_equal(program(places).numpy(), policy.predict(places.numpy())[0])
            return False

    KNNTD(DriftEnv(), points=(9, 7), **GIVEN).learn(40, callback=Export())


def test_unknown_formats_and_options(tmp_path: Path) -> None:
    policy = model_of("lattice").policy
    with pytest.raises(ValueError, match=r"format must be one of 'c', 'onnx'.*got 'matlab'"):
        policy.export(tmp_path / "policy", "matlab")
    with pytest.raises(ValueError, match="format='csv' has no option 'rows'; its options: none"):
        policy.export(tmp_path / "policy", "csv", rows="all")
    with pytest.raises(ValueError, match="format='c' has no option 'dtype'; its options: 'precision' and 'rows'"):
        policy.export(tmp_path / "policy", "c", dtype="float")
    with pytest.raises(ValueError, match="precision must be one of 'double', 'float'; got 'half'"):
        policy.export(tmp_path / "policy", "c", precision="half")
    with pytest.raises(ValueError, match=r"rows must be one of .*; got 'some'"):
        policy.export(tmp_path / "policy", "c", rows="some")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["lattice", "factored", "counted states", "peak, two dimensions"])
def test_test_vectors_are_what_predict_returns(name: str, tmp_path: Path) -> None:
    model = model_of(name)
    *_, vectors = model.policy.export(tmp_path / "policy", "npz", test_vectors=tmp_path / "sub" / "vectors.csv")
    rows = np.loadtxt(vectors, delimiter=",", skiprows=1)
    header = vectors.read_text().partition("\n")[0].split(",")
    kinds = np.array([name.partition("_")[0] for name in header])
    observations = rows[:, kinds == "observation"].reshape(-1, *(model.observation_space.shape or ()))
    observations = observations.astype(model.observation_space.dtype)
    assert len(observations) == 1_000
    expected = model.predict(observations, deterministic=True)[0].reshape(1_000, -1)
    np.testing.assert_array_equal(rows[:, kinds == "action"], expected)
    np.testing.assert_array_equal(rows[:, kinds == "value"], model.policy.q_values(observations))


# ---------------------------------------------------------- command line


@pytest.mark.parametrize("name", ["lattice", "planned", "peak"])
def test_the_command_exports_a_saved_model(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = model_of(name)
    model.save(tmp_path / "model")
    out, vectors = tmp_path / "controller", tmp_path / "vectors.csv"
    arguments = ["--format", "c", "--precision", "float", "--out", str(out), "--test-vectors", str(vectors)]
    assert main(["export", str(tmp_path / "model"), *arguments]) == 0
    written = [line.partition(" ")[0] for line in capsys.readouterr().out.splitlines()]
    assert written == [f"{out}.c", f"{out}.h", str(vectors)]
    model.policy.export(tmp_path / "same" / "controller", "c", precision="float")
    assert (tmp_path / "same" / "controller.c").read_text() == (tmp_path / "controller.c").read_text()


def test_the_command_executes_nothing_unless_it_is_told_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    KNNTD(DriftEnv(), points=(5, 5), weights=lambda squares: 1.0 / (1.0 + squares), **GIVEN).save(tmp_path / "model")
    arguments = ["export", str(tmp_path / "model.zip"), "--format", "csv", "--out", str(tmp_path / "table")]
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert "unpickling executes code" in (error := capsys.readouterr().err)
    assert error.strip().endswith("pass --trusted")
    assert main([*arguments, "--trusted"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.zip", "--format", "c", "--out", "x"], "no such file: missing.zip"),
        (["model.zip", "--format", "c", "--out", "x"], "no saved model"),
        (["model.zip", "--format", "excel", "--out", "x"], "'excel'"),
        (["dqn.zip", "--format", "c", "--out", "x"], "dqn.zip must hold a model of KNNTD, ExA"),
    ],
)
def test_the_command_says_what_is_wrong(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    pathlib.Path("model.zip").write_bytes(b"nothing")
    DQN("MlpPolicy", "CartPole-v1").save("dqn.zip")
    with pytest.raises(SystemExit, match="2"):
        main(["export", *arguments])
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
