"""Every value of every argument either works or raises an error that names the argument."""

from __future__ import annotations

import datetime
import decimal
import fractions
import itertools
import math
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sb3_knntd.callbacks import (
    EpisodeVideoCallback,
    HParamCallback,
    PerceptionStatsCallback,
    TableCheckpointCallback,
    ValueMapCallback,
)
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_knntd import KNNTD, ExA, KNNDyna
from sb3_knntd.filters import DeltaFilter, VecDeltaFilter

pytestmark = pytest.mark.filterwarnings("ignore")

#: Timeout of a case, seconds; it may have to compile a kernel.
PATIENCE = 300
#: Additional address space for the cases, bytes; less than the smallest size that is refused.
ROOM = 2**31

NAN, INF = float("nan"), float("inf")

#: Values that are valid for some arguments and invalid for others.
VALUES: list[Any] = [
    None, True, False, np.True_, "", "auto", "no", "0.5", "adaptive", "gaussian", "brute", "hashed", "a/b", "a\0b", "é",
    b"", b"0.5", NAN, INF, -INF, 0.5, 1.5, 5.0, 1e-320, 5e-324, 1e-200, 1e30, 1e155, 1e308, -1e308, -0.0, -0.5, 3.0,
    0, 1, 2, 3, 7, -1, 10**9, -(10**9), 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 10**18, 10**400, -(10**400), 10**5000,
    0j, 1 + 0j, complex(NAN, INF), np.float32(0.5), np.float64(NAN), np.int8(3), np.uint64(2**63), np.longdouble(0.5),
    np.complex64(1), np.datetime64("2026-01-01"), np.str_("auto"), fractions.Fraction(1, 2), decimal.Decimal("0.5"),
    fractions.Fraction(10**400), datetime.date(2026, 1, 1), object(), object, float, int, len, math.sqrt, range(3), ...,
    lambda: 0.5, lambda x: x, lambda x: 0.5, lambda x: NAN, lambda x: None, lambda x: "0.5", lambda x: 1 + x * 1e308,
    [], (), {}, set(), {"a": 1}, {1: 2}, {"dtype": th.float32}, {"table": "hashed"}, {"compiled": False},
    {"compiled": 3},
    {"dtype": np.zeros(2)}, {"table": "dense"}, [1], [1, 2], (3, 4), [3.0, 4.0], [0, 3], [NAN, 1], [True,
    True], [10**9] * 2,
    [10**400, 1], [2**62, 2**62], ["a", "b"], ["3", "4"], [None, None], [[0, 1], [1, 0]], [[0.0, 0.0], [1.0]],
    [[NAN, 0.0]],
    [[INF, 0.0]], [[0j, 1j]], [["0", "1"]], [[True, False]], [[]], [[[0.0, 0.0]]], [[-1.0, 1.0]], [[1.0,
    -1.0]], [[1e308, 0]],
    [[-1e308, -1e308], [1e308, 1e308]], ([-1, -1], [1, 1]), ([-1, -1], [1, INF]), ([0, 0], [5e-324, 1]), ("01", "12"),
    ([1e9, 1e9], [1e9 + 1e-7, 1e10]), ([-1, -1], [1, 10**400]), (["0", "0"], ["1", "1"]), ([0j, 0j], [1j, 1j]),
    np.array(3), np.array([3]), np.array([4, 4]), np.zeros(0), np.zeros((0, 2)), np.zeros((3, 2)), np.zeros((2, 2, 2)),
    np.full((3, 2), NAN), np.ones((3, 2), bool), np.ones((3, 2), complex), np.full((3, 2), "x"), np.empty((3,
    2), object),
    np.ones((3, 2), np.float16), np.arange(6, dtype=np.uint8).reshape(3, 2), th.tensor(0.5), th.tensor([3, 4]),
    th.zeros((3, 2)), th.ones(2, requires_grad=True), th.float32, th.float16, th.device("cpu"), "cpu", "meta",
    "cuda:99",
    Path("somewhere"), Path(), iter([1, 2]), np.random.default_rng(0), "KNNPolicy",
]  # fmt: skip

values = st.one_of(
    st.sampled_from(VALUES),
    st.integers(-3, 20),
    st.floats(-10.0, 10.0),
    st.text("ab/.\0 ", max_size=4),
    st.lists(st.one_of(st.integers(-1, 4), st.floats(-2.0, 2.0), st.booleans(), st.none()), max_size=3),
)


class Point(gym.Env[np.ndarray, Any]):
    """A point in the plane, pushed by actions, with episodes of six steps."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"
    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, action_space: spaces.Space[Any]) -> None:
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.n_steps = self.np_random.uniform(-1, 1, 2).astype(np.float32), 0
        return self.place, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        push = np.float32(np.mean(action)) / 2 - np.float32(0.25)
        self.place = np.clip(self.place + push, -1, 1).astype(np.float32)
        return self.place, float(self.place[0]), self.n_steps == 6, False, {}

    def render(self) -> Any:
        return np.zeros((8, 8, 3), np.uint8)


TWO, BOX = spaces.Discrete(2), spaces.Box(-1.0, 1.0, (1,), np.float32)


def learn(algorithm: type[KNNTD | ExA | KNNDyna], arguments: dict[str, Any]) -> None:
    # KNNDyna first plans after 25 steps.
    n_steps = 30 if algorithm is KNNDyna else 10
    model = algorithm(Point(TWO if algorithm is KNNTD else BOX), **arguments).learn(n_steps)
    assert model.num_timesteps == n_steps
    assert th.isfinite(model.policy.q_table).all()
    assert model.action_space.contains(model.predict(np.zeros(2, np.float32), deterministic=True)[0])


def walk(env: DeltaFilter) -> None:
    env.reset(seed=0)
    for _ in range(5):
        assert np.isfinite(env.step(env.action_space.sample())[0]).all()


def walk_all(venv: VecDeltaFilter) -> None:
    venv.reset()
    for _ in range(10):
        assert np.isfinite(venv.step(np.array([0, 1]))[0]).all()


def watch(callback: type[Any], arguments: dict[str, Any], **needed: Any) -> None:
    model = KNNTD(Point(TWO), points=4, tensorboard_log="logs" if callback is HParamCallback else None)
    assert model.learn(10, callback=callback(**{**needed, **arguments})).num_timesteps == 10


numbers = itertools.count()

#: The tested classes, and the names of their arguments.
MAKERS: dict[type[Any], Callable[[dict[str, Any]], None]] = {
    KNNTD: lambda arguments: learn(KNNTD, arguments),
    ExA: lambda arguments: learn(ExA, arguments),
    KNNDyna: lambda arguments: learn(KNNDyna, arguments),
    DeltaFilter: lambda arguments: walk(DeltaFilter(Point(TWO), **arguments)),
    VecDeltaFilter: lambda arguments: walk_all(VecDeltaFilter(DummyVecEnv([lambda: Point(TWO)] * 2), **arguments)),
    ValueMapCallback: lambda arguments: watch(ValueMapCallback, arguments, folder="maps", resolution=3),
    PerceptionStatsCallback: lambda arguments: watch(PerceptionStatsCallback, arguments),
    TableCheckpointCallback: lambda arguments: watch(
        TableCheckpointCallback, arguments, save_path=f"checkpoints/{next(numbers)}"
    ),
    EpisodeVideoCallback: lambda arguments: watch(
        EpisodeVideoCallback, arguments, eval_env=Point(TWO), folder="videos"
    ),
    HParamCallback: lambda arguments: watch(HParamCallback, arguments),
}
#: Classes with more arguments are drawn more often.
KINDS = [KNNTD] * 6 + [ExA] * 6 + [KNNDyna] * 4 + [DeltaFilter] * 3 + [VecDeltaFilter] * 2 + list(MAKERS)[5:]
#: Arguments that are not varied: environments, which other tests cover, and internal arguments.
LEFT_OUT = {"self", "policy", "env", "venv", "_init_setup_model"}


def names_of(kind: type[Any]) -> list[str]:
    code = kind.__init__.__code__
    return [name for name in code.co_varnames[: code.co_argcount] if name not in LEFT_OUT]


@st.composite
def cases(draw: st.DrawFn) -> tuple[type[Any], dict[str, Any]]:
    kind = draw(st.sampled_from(KINDS))
    names = draw(st.lists(st.sampled_from(names_of(kind)), min_size=1, max_size=2, unique=True))
    return kind, {name: draw(values) for name in names}


def check(kind: type[Any], arguments: dict[str, Any]) -> None:
    """
    Check that the object can be made and used, or that the error is a user error that names a given argument.
    Divergence is attributed to the learning rate, which its message names.
    """
    try:
        MAKERS[kind](arguments)
    except (ValueError, TypeError, FloatingPointError) as error:
        if not any(name in str(error) for name in arguments):
            raise AssertionError(f"names none of {', '.join(arguments)}: {type(error).__name__}: {error}") from error


@pytest.fixture
def confined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run in an empty folder, with a memory limit and a timeout."""
    monkeypatch.chdir(tmp_path)
    # Compile once before the memory is limited.
    for kind in (KNNTD, ExA, KNNDyna, DeltaFilter):
        MAKERS[kind]({})
    resource = limits = None
    if sys.platform == "linux":
        import resource

        limits = resource.getrlimit(resource.RLIMIT_AS)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, limits[1]))
    yield
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def hang(signal_number: int, frame: FrameType | None) -> None:
    raise AssertionError(f"hung for {PATIENCE} s")


def run(case: tuple[type[Any], dict[str, Any]]) -> None:
    handler = signal.signal(signal.SIGALRM, hang)
    signal.alarm(PATIENCE)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check(*case)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)


unhurried = settings(
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    database=None,
    print_blob=True,
)


@pytest.mark.usefixtures("confined")
@settings(unhurried, max_examples=100, derandomize=True)
@given(cases())
def test_an_argument_works_or_is_named(case: tuple[type[Any], dict[str, Any]]) -> None:
    run(case)


@pytest.mark.slow
@pytest.mark.usefixtures("confined")
@settings(unhurried, max_examples=5000)
@given(cases())
def test_thousands_of_arguments_work_or_are_named(case: tuple[type[Any], dict[str, Any]]) -> None:
    run(case)
