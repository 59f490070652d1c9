"""Other threads that read, interrupts, faulty environments and divergence spoil nothing."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from toy_envs import DriftEnv, PushEnv

from sb3_knntd import KNNTD, ExA
from sb3_knntd.actions.exploration import EXPLORATIONS, EpsilonGreedy
from sb3_knntd.kernels.perceive import weigh
from sb3_knntd.perception.weights import Gaussian
from sb3_knntd.q_table import table as table_module

BOUNDS = DriftEnv.LOW, DriftEnv.HIGH
TABLES = ["dense", "hashed"]


def make_venv(n_envs: int = 1, env_cls: type[DriftEnv] = DriftEnv) -> VecEnv:
    return DummyVecEnv([lambda index=index: env_cls(offset=0.23 * index) for index in range(n_envs)])  # type: ignore[misc]


def make(venv: VecEnv | None = None, table: str = "dense", algorithm: Any = KNNTD, **arguments: Any) -> Any:
    kwargs = {"table": table, **arguments.pop("policy_kwargs", {})}
    settings = {"points": 60, "bounds": BOUNDS, "n_neighbors": 4, "seed": 0, "learning_rate": 0.3, **arguments}
    return algorithm(make_venv() if venv is None else venv, policy_kwargs=kwargs, **settings)


# ------------------------------------------------------------- other threads


def read_in_threads(model: Any, n_steps: int, least_reads: int) -> int:
    """Train while four threads read; how often they did."""
    counts, faults, done = [0] * 4, [], threading.Event()
    observation = np.array([[0.1, 0.01], [-0.5, 0.0]], dtype=np.float32)

    def read(number: int) -> None:
        try:
            while not done.is_set() or sum(counts) < least_reads:
                model.predict(observation, deterministic=number % 2 == 0)
                values = model.policy.q_values(observation) if hasattr(model, "target") else model.policy.q_table[:9]
                assert th.isfinite(values).all()
                assert (values.abs() < 1e4).all()
                assert th.isfinite(model.policy.q_table).all()
                counts[number] += 3
        except BaseException as fault:
            faults.append(fault)

    threads = [threading.Thread(target=read, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    try:
        model.learn(n_steps)
    finally:
        done.set()
        for thread in threads:
            thread.join()
    assert not faults, faults[0]
    return sum(counts)


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize(
    ("algorithm", "n_steps", "n_reads"),
    [
        (KNNTD, 3_000, 500),
        (ExA, 3_000, 500),
        pytest.param(KNNTD, 100_000, 200_000, marks=pytest.mark.slow),
        pytest.param(ExA, 100_000, 200_000, marks=pytest.mark.slow),
    ],
)
def test_reading_in_other_threads_changes_nothing(algorithm: Any, table: str, n_steps: int, n_reads: int) -> None:
    env_cls = PushEnv if algorithm is ExA else DriftEnv
    alone, read = (make(make_venv(2, env_cls), table, algorithm) for _ in range(2))
    alone.learn(n_steps)
    assert read_in_threads(read, n_steps, n_reads) >= n_reads
    assert th.equal(alone.policy.q_table, read.policy.q_table)


# ---------------------------------------------------------------- interrupts


@pytest.mark.parametrize("n_envs", [1, 3])
def test_interrupt_while_a_hashed_table_grows(monkeypatch: pytest.MonkeyPatch, n_envs: int) -> None:
    model = make(make_venv(n_envs), "hashed", points=300)
    real = table_module.make_slots
    interrupted = False

    def make_slots(capacity: int) -> np.ndarray:
        nonlocal interrupted
        if not interrupted and capacity > 1024:
            interrupted = True
            raise KeyboardInterrupt
        return real(capacity)

    monkeypatch.setattr(table_module, "make_slots", make_slots)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20_000)
    assert th.isfinite(model.policy.q_table).all()
    n_rows = len(model.policy.q_table)
    model.learn(20_000)
    assert len(model.policy.q_table) > n_rows


@pytest.mark.parametrize("name", ["_made_of", "_reserve_rows", "reserve", "make_room", "bind", "_prepare", "_fill"])
def test_interrupt_at_every_line_of_what_grows(name: str) -> None:
    for line in range(1, 60):
        model = make(None, "hashed", points=300, trace_decay=1.0, gamma=1.0)
        seen = 0

        def trace(frame: FrameType, event: str, _: Any, line: int = line) -> Any:
            nonlocal seen
            if frame.f_code.co_name != name or "sb3_knntd" not in frame.f_code.co_filename:
                return None
            if event == "line":
                seen += 1
                if seen == line:
                    raise KeyboardInterrupt
            return trace

        sys.settrace(trace)
        try:
            model.learn(1_500)
        except KeyboardInterrupt:
            pass
        else:
            return
        finally:
            sys.settrace(None)
        assert th.isfinite(model.policy.q_table).all()
        model.learn(1_500, reset_num_timesteps=False)
        assert th.isfinite(model.policy.q_table).all()


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there is no such timer")
@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("n_interrupts", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_interrupts_at_random_moments(table: str, n_interrupts: int) -> None:
    model = make(make_venv(2), table, points=300)
    told: list[int] = []

    def callback(locals_: dict[str, Any], _: Any) -> bool:
        told.append(len(locals_["rewards"]))
        return True

    def interrupt(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    model.learn(100, callback=callback)
    random = np.random.default_rng(0)
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for _ in range(n_interrupts):
            with pytest.raises(KeyboardInterrupt):  # noqa: PT012  where it comes is the point
                # Again a while later: Python drops an interrupt that comes where nothing can be raised, as in __del__.
                signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-4, 3e-2), 1.0)
                model.learn(10**9, callback=callback, reset_num_timesteps=False)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            assert th.isfinite(model.policy.q_table).all()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    n_told = len(told)
    model.learn(100, callback=callback)
    assert len(told) > n_told


def test_bounds_that_were_half_widened_are_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make(None, bounds="adaptive", points=8)
    model.learn(1_500)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(type(model.policy.table), "carry_over", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.policy.widen(th.tensor([[9.0, 9.0]]))
    monkeypatch.undo()
    assert all(th.equal(before[name], value) for name, value in model.policy.state_dict().items())
    model.policy.widen(th.tensor([[9.0, 9.0]]))
    assert not th.equal(before["perceiver.bounds.high"], model.policy.perceiver.bounds.high)
    model.learn(10)


# ------------------------------------------------------- faulty environments


class Tampered(VecEnvWrapper):
    """From the step numbered ``at`` on, counted from 1, what is returned goes through ``change``."""

    def __init__(self, venv: VecEnv, change: Callable[[list[Any]], None], at: int = 20) -> None:
        super().__init__(venv)
        self.change, self.left = change, at

    def reset(self) -> Any:
        observations = [self.venv.reset(), None, None, None]
        if self.left == 0:
            self.change(observations)
        return observations[0]

    def step_wait(self) -> Any:
        self.left -= 1
        returned = list(self.venv.step_wait())
        if self.left == 0:
            self.change(returned)
        return tuple(returned)


def replace(index: int, make_array: Callable[[], Any]) -> Callable[[list[Any]], None]:
    def change(returned: list[Any]) -> None:
        returned[index] = make_array()

    return change


def end_with(last_observation: Any) -> Callable[[list[Any]], None]:
    def change(returned: list[Any]) -> None:
        returned[2] = np.array([True, True])
        returned[3] = [{"terminal_observation": last_observation, "TimeLimit.truncated": True}] * 2

    return change


def explode(_: list[Any]) -> None:
    raise ValueError("the simulator is gone")


NUMBERS = np.float32
FAULTS: dict[str, tuple[Callable[[list[Any]], None], str]] = {
    "more observations": (replace(0, lambda: np.zeros((40, 2), NUMBERS)), r"observations.*\(40, 2\).*\(2, 2\)"),
    "fewer observations": (replace(0, lambda: np.zeros((1, 2), NUMBERS)), r"observations.*\(1, 2\).*\(2, 2\)"),
    "wider observations": (replace(0, lambda: np.zeros((2, 5), NUMBERS)), r"observations.*\(2, 5\).*\(2, 2\)"),
    "flat observations": (replace(0, lambda: np.zeros(2, NUMBERS)), r"observations.*\(2,\).*\(2, 2\)"),
    "words": (replace(0, lambda: np.full((2, 2), "a")), r"observations.*<U1.*numbers"),
    "no array": (replace(0, lambda: [[0.0, 0.0], [0.0, 0.0]]), r"observations.*list"),
    "fewer rewards": (replace(1, lambda: np.zeros(1, NUMBERS)), r"rewards.*\(1,\).*\(2,\)"),
    "columns of rewards": (replace(1, lambda: np.zeros((2, 1), NUMBERS)), r"rewards.*\(2, 1\).*\(2,\)"),
    "objects": (replace(1, lambda: np.array([None, None])), r"rewards.*object"),
    "fewer dones": (replace(2, lambda: np.zeros(1, bool)), r"dones.*\(1,\).*\(2,\)"),
    "dones that are floats": (replace(2, lambda: np.zeros(2)), r"dones.*float64"),
    "a wide last observation": (end_with(np.zeros(3, NUMBERS)), r"environment 0.*\(3,\).*\(2,\)"),
    "a last observation of NaN": (end_with(np.full(2, np.nan, NUMBERS)), r"environment 0.*terminal observation"),
    "NaN": (replace(0, lambda: np.full((2, 2), np.nan, NUMBERS)), "environment 0.*observation"),
    "a reward of NaN": (replace(1, lambda: np.full(2, np.nan, NUMBERS)), "environment 0.*reward"),
    "an exception": (explode, "the simulator is gone"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kwargs", [{}, {"table": "hashed"}, {"compiled": False}], ids=str)
def test_the_table_is_as_it_was(fault: str, kwargs: dict[str, Any]) -> None:
    change, message = FAULTS[fault]
    model = make(Tampered(make_venv(2), change), points=12, policy_kwargs=kwargs)
    model.learn(38)
    before = model.policy.state_dict()
    before = {name: value.clone() for name, value in before.items()}
    visited = model.policy.table.n_visited
    with pytest.raises(ValueError, match=message):
        model.learn(2, reset_num_timesteps=False)
    after = model.policy.state_dict()
    assert before.keys() == after.keys()
    assert all(th.equal(before[name], after[name]) for name in before)
    assert model.policy.table.n_visited == visited
    # What follows is what follows in a model that has just this table, and no episode.
    other = make(make_venv(2), points=12, policy_kwargs=kwargs)
    other.policy.load_state_dict(before)
    for each in (model, other):
        each.set_env(make_venv(2))
        each.set_random_seed(5)
        each.learn(60)
    assert th.equal(model.policy.q_table, other.policy.q_table)


def test_first_observations_are_checked() -> None:
    change = replace(0, lambda: np.zeros((3, 2), NUMBERS))
    for arguments in ({}, {"bounds": "adaptive"}):
        with pytest.raises(ValueError, match=r"observations.*\(3, 2\).*\(2, 2\)"):
            make(Tampered(make_venv(2), change, at=0), **arguments).learn(10)


# ---------------------------------------------------------------- divergence


@pytest.mark.parametrize("kwargs", [{}, {"table": "hashed"}, {"compiled": False}], ids=str)
@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
def test_divergence_leaves_the_table_finite(kwargs: dict[str, Any], dtype: th.dtype, n_envs: int, traces: str) -> None:
    kwargs = {"dtype": dtype, **kwargs}
    model = make(
        make_venv(n_envs), points=6, learning_rate=50.0, gamma=1.0, traces=traces, trace_decay=1.0, policy_kwargs=kwargs
    )
    tables = []

    def watch(*_: Any) -> bool:
        tables.append(model.policy.q_table.clone())
        return True

    with pytest.raises(FloatingPointError, match="diverge"):
        model.learn(20_000, callback=watch)
    assert th.isfinite(model.policy.q_table).all()
    assert th.equal(model.policy.q_table, tables[-1])


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(
    ("argument", "low", "settings"),
    [
        ("learning_rate", -1.0, {}),
        ("learning_rate", np.nan, {}),
        ("trace_decay", np.nan, {}),
        ("trace_decay", 1.5, {}),
        ("temperature", 0.0, {"exploration": "softmax"}),
        ("temperature", np.nan, {"exploration": "softmax"}),
    ],
)
def test_rates_are_checked_at_every_step(compiled: bool, argument: str, low: float, settings: dict[str, Any]) -> None:
    schedule = {argument: lambda progress: low if 0.6 < progress < 0.7 else 0.5}
    model = make(policy_kwargs={"compiled": compiled}, **schedule, **settings)
    with pytest.raises(ValueError, match=rf"(?s){argument} at this step.*{low}"):
        model.learn(200)
    assert model.num_timesteps == 60
    assert th.isfinite(model.policy.q_table).all()


# --------------------------------------------------------- changed parameters


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(
    ("name", "value"),
    [("gamma", 0.0), ("trace_decay", 0.2), ("step_size", "paper"), ("traces", "accumulating"),
     ("reset_other_actions", True), ("learning_rate", 0.01), ("exploration_initial_eps", 1.0)],
)  # fmt: skip
def test_a_changed_parameter_holds_as_it_does_after_loading(
    tmp_path: Any, compiled: bool, name: str, value: Any
) -> None:
    model = make(points=12, policy_kwargs={"compiled": compiled}).learn(100)
    model.save(tmp_path / "before")
    unchanged = KNNTD.load(tmp_path / "before", make_venv()).learn(100)
    loaded = KNNTD.load(tmp_path / "before", make_venv(), **{name: value}).learn(100)
    setattr(model, name, value)
    model.set_env(make_venv())
    model.learn(100)
    assert th.equal(model.policy.q_table, loaded.policy.q_table)
    assert not th.equal(model.policy.q_table, unchanged.policy.q_table)


def test_schedules_that_are_set_hold() -> None:
    model = make().learn(100)
    before = model.policy.q_table.clone()
    model.learning_rate = 0.0
    model._setup_lr_schedule()
    assert th.equal(model.learn(100).policy.q_table, before)
    model.lr_schedule = lambda _: 0.5
    assert not th.equal(model.learn(100).policy.q_table, before)
    model.trace_schedule = lambda _: 2.0
    with pytest.raises(ValueError, match="trace_decay"):
        model.learn(100)


@pytest.mark.parametrize(
    ("name", "value"), [("gamma", 2.0), ("learning_rate", -1.0), ("traces", "dutch"), ("exploration_final_eps", np.nan)]
)
def test_a_change_that_does_not_fit_is_refused(name: str, value: Any) -> None:
    model = make()
    before = getattr(model, name)
    with pytest.raises(ValueError, match=name):
        setattr(model, name, value)
    assert getattr(model, name) == before


@pytest.mark.parametrize("name", ["points", "n_neighbors", "weights", "initial_value"])
def test_what_the_table_was_built_with_cannot_be_changed(name: str) -> None:
    with pytest.raises(AttributeError, match=rf"{name} cannot be changed.*KNNTD\(env, {name}="):
        setattr(make(), name, None)


def test_a_target_that_is_set_holds() -> None:
    model = make().learn(100)
    model.target = "q_learning"
    assert model.learner.selector.target.name == "Q_LEARNING"
    with pytest.raises(ValueError, match="random numbers"):
        model.exploration = "softmax"
    assert model.exploration == "epsilon_greedy"
    model.learn(100)


# ---------------------------------------------------------- unknown to kernels


def test_exploration_unknown_to_the_compiled_step(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(EpsilonGreedy):
        """Not the one that is compiled."""

    monkeypatch.setitem(EXPLORATIONS, "epsilon_greedy", Other)
    with pytest.raises(ValueError, match="Other"):
        make()
    make(policy_kwargs={"compiled": False}).learn(10)


def test_weights_unknown_to_the_compiled_step() -> None:
    with pytest.raises(TypeError, match=r"Other\.WEIGHTING"):

        class Other(Gaussian):
            """Not the one that is compiled."""


def test_codes_that_no_kernel_knows_raise() -> None:
    with pytest.raises(ValueError, match="weighting"):
        weigh(99, 1.0, np.array([0.1, 0.2]))
