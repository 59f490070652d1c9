"""SB3's conventions for models: construction, policy, files and environments."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS, ON_BOX, TD_ONLY, fitting
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from toy_envs import DriftEnv, PushEnv

from sb3_knntd import KNNTD, ExA, KNNDyna
from sb3_knntd.dyna_policies import DynaBoxPolicy
from sb3_knntd.policies import ExAPolicy, KNNPolicy

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


def message_of(make: Callable[[], Any]) -> str:
    with pytest.raises(ValueError, match=r"\w") as error:
        make()
    return str(error.value)


# --------------------------------------------------------------- construction


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ExA(KNNPolicy, PushEnv()), ["ExAPolicy", "got KNNPolicy", "ExA(env)", 'ExA("KNNPolicy", env)']),
        (lambda: KNNTD(ExAPolicy, DriftEnv()), ["KNNPolicy", "Discrete", "got ExAPolicy", "KNNTD(env)"]),
        (lambda: ExA("ExAPolicy", PushEnv()), ["'ExAPolicy'", "named 'KNNPolicy'", "ExA(env)"]),
        (lambda: KNNDyna(KNNPolicy), ["env must be given", "KNNDyna(env)"]),
        (lambda: KNNDyna(ExAPolicy, PushEnv()), ["DynaBoxPolicy", "got ExAPolicy", 'KNNDyna("KNNPolicy", env)']),
        (lambda: KNNDyna(DynaBoxPolicy, DriftEnv()), ["DynaPolicy", "Discrete", "got DynaBoxPolicy"]),
        (lambda: KNNDyna("DynaPolicy", DriftEnv()), ["'DynaPolicy'", "named 'KNNPolicy'", "KNNDyna(env)"]),
        (lambda: KNNTD(DriftEnv), ["class DriftEnv", "KNNTD(DriftEnv(...))"]),
        (lambda: KNNTD("KNNPolicy", DriftEnv), ["class DriftEnv", "KNNTD(DriftEnv(...))"]),
        (lambda: ExA(env=PushEnv), ["class PushEnv", "ExA(PushEnv(...))"]),
        (lambda: KNNTD(DummyVecEnv), ["class DummyVecEnv"]),
    ],
)
def test_a_wrong_call_names_the_right_one(make: Callable[[], Any], says: list[str]) -> None:
    message = message_of(make)
    for words in says:
        assert words in message


def test_user_defined_policies_are_accepted() -> None:
    class Ours(KNNPolicy):
        pass

    class OursToo(ExAPolicy):
        pass

    class Planned(DynaBoxPolicy):
        pass

    assert type(KNNTD(Ours, DriftEnv()).policy) is Ours
    assert type(KNNDyna(Planned, PushEnv()).policy) is Planned
    assert type(ExA(OursToo, PushEnv()).policy) is OursToo


# --------------------------------------------------------- MultiBinary observations


class Switches(gym.Env[Any, Any]):
    """Switch all lights on; an action toggles one. Observed as bits, or as components with two states."""

    def __init__(self, n: int = 4, binary: bool = True) -> None:
        self.observation_space: Any = spaces.MultiBinary(n) if binary else spaces.MultiDiscrete([2] * n)
        self.action_space = spaces.Discrete(n)
        self.n = n

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.bits = self.np_random.integers(0, 2, self.n)
        self.elapsed = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.bits[action] ^= 1
        self.elapsed += 1
        return self._seen(), -1.0, bool(self.bits.all()), self.elapsed == 50, {}

    def _seen(self) -> Any:
        return self.bits.astype(self.observation_space.dtype)


def as_box(env: gym.Env[Any, Any], algorithm: Algorithm) -> gym.Env[Any, Any]:
    if algorithm not in ON_BOX:
        return env
    n = env.unwrapped.n  # type: ignore[attr-defined]
    box = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
    return gym.wrappers.TransformAction(env, lambda action: min(int((action[0] + 1) / 2 * n), n - 1), box)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_bits_are_a_table(algorithm: Algorithm, n_envs: int) -> None:
    def learned(binary: bool) -> KNNTD | ExA | KNNDyna:
        venv = DummyVecEnv([lambda: as_box(Switches(binary=binary), algorithm)] * n_envs)
        return algorithm(venv, seed=0).learn(1_500)

    bits, components = learned(True), learned(False)
    assert bits.policy.q_table.shape[0] == 16
    assert bits.policy.points.tolist()[5] == [0.0, 1.0, 0.0, 1.0]
    assert bits.policy.q_table.any()
    assert th.equal(bits.policy.q_table, components.policy.q_table)
    every = bits.policy.points.numpy().astype(np.int8)
    np.testing.assert_array_equal(bits.predict(every, deterministic=True)[0], components.predict(every)[0])
    assert bits.predict(every[3], deterministic=True)[0] == bits.predict(every, deterministic=True)[0][3]


def test_switches_are_learned() -> None:
    model = KNNTD(Switches(), seed=0).learn(5_000)
    every = model.policy.points.numpy().astype(np.int8)[:-1]
    actions, _ = model.predict(every, deterministic=True)
    # The best action switches on a light that is off.
    assert not every[np.arange(len(every)), actions].any()


def test_many_bits_have_a_row_for_each_state_that_was_visited() -> None:
    model = KNNTD(Switches(n=40), seed=0).learn(300)
    assert 10 < model.policy.q_table.shape[0] < 1_000


def test_bits_of_several_axes_and_given_points_are_refused() -> None:
    class Board(Switches):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = spaces.MultiBinary([2, 2])

    assert "MultiBinary of one axis" in message_of(lambda: KNNTD(Board()))
    assert "MultiBinary" in message_of(lambda: KNNTD(Switches(), points=3))


# ------------------------------------------------------------------ files


class Mine(KNNTD):
    """A user-defined subclass."""


class MineToo(ExA):
    """Another user-defined subclass."""


class MineAsWell(KNNDyna):
    """A third user-defined subclass."""


@pytest.mark.parametrize(
    ("base", "sub", "other"), [(KNNTD, Mine, ExA), (ExA, MineToo, KNNTD), (KNNDyna, MineAsWell, KNNTD)]
)
def test_subclasses_and_their_base_read_each_others_files(
    base: Algorithm, sub: Algorithm, other: Algorithm, tmp_path: pathlib.Path
) -> None:
    env = PushEnv() if base is ExA else DriftEnv()
    for writer, reader in ((sub, base), (base, sub), (sub, sub)):
        model = writer(env, **fitting(base, {"points": (5, 5), "seed": 0})).learn(200)
        model.save(tmp_path / "model")
        loaded = reader.load(tmp_path / "model")
        assert type(loaded) is reader
        assert th.equal(loaded.policy.q_table, model.policy.q_table)
        with pytest.raises(ValueError, match=f"holds a model of {base.__name__}, not of {other.__name__}"):
            other.load(tmp_path / "model")


@TD_ONLY
def test_a_policy_with_a_function_is_saved_and_read(
    make_model: MakeModel, observations: np.ndarray, tmp_path: pathlib.Path
) -> None:
    height = 0.3
    policy = make_model(weights=lambda d2: th.exp(-d2 / height)).learn(300).policy
    policy.save(tmp_path / "policy")  # type: ignore[arg-type]
    loaded = type(policy).load(tmp_path / "policy")  # type: ignore[arg-type]
    assert th.equal(loaded.q_table, policy.q_table)
    np.testing.assert_array_equal(loaded.predict(observations)[0], policy.predict(observations)[0])
    np.testing.assert_array_equal(loaded.perceive(observations).probabilities, policy.perceive(observations)[1])


# ------------------------------------------------------------- the policy's values


@TD_ONLY
@pytest.mark.parametrize("table", ["dense", "hashed"])
@pytest.mark.parametrize("dtype", [th.float64, th.float32])
def test_the_table_as_a_vector_and_back(make_model: MakeModel, table: str, dtype: th.dtype) -> None:
    model = make_model(policy_kwargs={"table": table, "dtype": dtype}).learn(203)
    vector = model.policy.parameters_to_vector()
    assert vector.dtype == np.dtype(str(dtype).removeprefix("torch."))
    np.testing.assert_array_equal(vector, model.policy.q_table.numpy().ravel())
    assert vector.any()

    wanted = np.random.default_rng(0).normal(size=len(vector)).astype(vector.dtype)
    model.policy.load_from_vector(wanted)
    # The vector is a copy in both directions.
    wanted_then, vector_then = wanted.copy(), vector.copy()
    wanted[:] = np.nan
    np.testing.assert_array_equal(model.policy.parameters_to_vector(), wanted_then)
    np.testing.assert_array_equal(vector, vector_then)
    # The episode continues, and learns from the loaded values.
    model.learn(1, reset_num_timesteps=False)
    after = model.policy.parameters_to_vector()[: len(wanted_then)]
    changed = after != wanted_then
    assert 0 < changed.sum() <= 4


def test_a_vector_that_does_not_fit(make_model: MakeModel) -> None:
    model = make_model().learn(100)
    before = model.policy.parameters_to_vector()
    for wrong in (before[:-1], before[None], np.full_like(before, np.nan)):
        with pytest.raises(ValueError, match="vector must"):
            model.policy.load_from_vector(wrong)
    np.testing.assert_array_equal(model.policy.parameters_to_vector(), before)


def test_a_replaced_policy_is_refused_with_advice(
    make_model: MakeModel, observations: np.ndarray, tmp_path: pathlib.Path
) -> None:
    teacher = make_model(seed=5).learn(400)
    teacher.policy.save(tmp_path / "policy")  # type: ignore[arg-type]
    other = type(teacher.policy).load(tmp_path / "policy")  # type: ignore[arg-type]
    model = make_model()
    made_with, model.policy = model.policy, other  # type: ignore[assignment]
    # A replaced policy may be used for prediction.
    expected, _ = teacher.predict(observations, deterministic=True)
    np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], expected)
    with pytest.raises(ValueError, match=r"model\.policy\.load_state_dict\(other\.state_dict\(\)\)"):
        model.learn(100)
    # What the message says works.
    model.policy = made_with  # type: ignore[assignment]
    model.policy.load_state_dict(other.state_dict())
    assert th.equal(model.policy.q_table, teacher.policy.q_table)
    model.learn(100)
    assert not th.equal(model.policy.q_table, teacher.policy.q_table)


# ------------------------------------------------------------- normalised observations


def test_a_normalising_environment_needs_a_model_made_for_it(
    make_model: MakeModel, make_venv: MakeVenv, algorithm: Algorithm, tmp_path: pathlib.Path
) -> None:
    model = make_model(make_venv()).learn(50)
    before = model.get_env()
    message = message_of(lambda: model.set_env(VecNormalize(make_venv())))
    assert f"{algorithm.__name__}(VecNormalize(env))" in message
    assert "norm_obs=False" in message
    assert model.get_env() is before
    model.learn(50, reset_num_timesteps=False)
    # What the message says works.
    model.set_env(VecNormalize(make_venv(), norm_obs=False))
    assert model.get_vec_normalize_env() is model.get_env()
    model.learn(50)
    model.save(tmp_path / "model")
    assert "VecNormalize" in message_of(lambda: algorithm.load(tmp_path / "model", env=VecNormalize(make_venv())))
    algorithm.load(tmp_path / "model", env=make_venv()).learn(10)


def test_a_model_of_normalised_observations_needs_them(
    make_model: MakeModel, make_venv: MakeVenv, algorithm: Algorithm, tmp_path: pathlib.Path
) -> None:
    venv = VecNormalize(make_venv())
    model = make_model(venv, bounds=None).learn(1_200)
    model.save(tmp_path / "model")
    venv.save(str(tmp_path / "normalize"))
    loaded = algorithm.load(tmp_path / "model")
    for call in (
        lambda: model.set_env(make_venv()),
        lambda: loaded.set_env(VecNormalize(make_venv(), norm_obs=False)),
        lambda: algorithm.load(tmp_path / "model", env=make_venv()),
    ):
        assert "VecNormalize.load(path, env)" in message_of(call)
    again = VecNormalize.load(str(tmp_path / "normalize"), make_venv())
    loaded.set_env(again)
    assert loaded.get_vec_normalize_env() is again
    loaded.learn(50)
    assert algorithm.load(tmp_path / "model", env=again).learn(50).num_timesteps == 50
    # A separately saved policy is equal to that of the model.
    loaded.policy.save(tmp_path / "policy")  # type: ignore[arg-type]
    policy = type(loaded.policy).load(tmp_path / "policy")  # type: ignore[arg-type]
    assert th.equal(policy.points, loaded.policy.points)
