"""VecEnvs whose environments are stepped together: those of EnvPool and of gymnasium.vector."""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.vector import AutoresetMode, VectorEnv
from scipy.stats import mannwhitneyu
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize
from toy_envs import DriftEnv

from sb3_knntd import KNNTD
from sb3_knntd.vec_envs import EnvPoolVecEnv, GymnasiumVecEnv, LeanVecEnv

N_ENVS = 6
MODES = list(AutoresetMode)
# EnvPool has no wheels for Python 3.10.
needs_envpool = pytest.mark.skipif(find_spec("envpool") is None, reason="EnvPool is not installed")
KINDS = [pytest.param("envpool", marks=needs_envpool), "numpy", *(mode.name for mode in MODES)]


def drifting(n_envs: int = N_ENVS, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> VectorEnv[Any, Any, Any]:
    """The drifting points of the fixture ``make_venv``, in gymnasium's vector environment."""
    return gym.vector.SyncVectorEnv(
        [partial(DriftEnv, offset=0.23 * index) for index in range(n_envs)], autoreset_mode=mode
    )


def cart_poles(kind: str, n_envs: int = N_ENVS) -> VecEnv:
    """Gymnasium's or EnvPool's cart-poles."""
    if kind == "envpool":
        return EnvPoolVecEnv("CartPole-v1", n_envs)
    if kind == "numpy":
        return GymnasiumVecEnv(gym.make_vec("CartPole-v1", n_envs, vectorization_mode="vector_entry_point"))
    kwargs = {"autoreset_mode": AutoresetMode[kind]}
    return GymnasiumVecEnv(gym.make_vec("CartPole-v1", n_envs, vectorization_mode="sync", vector_kwargs=kwargs))


def after(observation: np.ndarray, action: int) -> np.ndarray:
    """Where a step of the cart-pole leads, by gymnasium's own environment."""
    env = CartPoleEnv()
    env.reset(seed=0)
    env.state = observation.astype(np.float64)  # type: ignore[assignment]
    reached: np.ndarray = env.step(action)[0]
    return reached


@pytest.mark.parametrize("kind", KINDS)
def test_no_transition_leads_across_a_reset(kind: str) -> None:
    venv = cart_poles(kind)
    venv.seed(3)
    observations = venv.reset()
    rng = np.random.default_rng(0)
    lengths, n_ended = np.zeros(N_ENVS, int), 0
    for _ in range(120):
        actions = rng.integers(0, 2, N_ENVS)
        next_observations, rewards, dones, infos = venv.step(actions)
        assert rewards.dtype == np.float32
        assert observations.flags.c_contiguous, "another order of memory would be compiled for anew"
        np.testing.assert_array_equal(rewards, 1.0)
        lengths += 1
        for env, info in enumerate(infos):
            reached = info["terminal_observation"] if dones[env] else next_observations[env]
            np.testing.assert_allclose(reached, after(observations[env], actions[env]), atol=1e-5)
            assert info["TimeLimit.truncated"] is False
            if dones[env]:
                # Episodes start within 0.05 of the centre and at rest; they end outside 2.4 m or 12 degrees.
                assert (np.abs(next_observations[env]) <= 0.05).all()
                assert abs(reached[0]) > 2.4 or abs(reached[2]) > np.radians(12)
                assert info["episode"]["l"] == info["episode"]["r"] == lengths[env]
                lengths[env] = 0
                n_ended += 1
            else:
                assert "episode" not in info
                assert "terminal_observation" not in info
        observations = next_observations
    assert n_ended > 2 * N_ENVS
    venv.close()


@pytest.mark.parametrize("kind", KINDS)
def test_all_episodes_may_be_cut_in_the_same_step(kind: str) -> None:
    if kind == "envpool":
        venv: VecEnv = EnvPoolVecEnv("CartPole-v1", N_ENVS, max_episode_steps=7)
    elif kind == "numpy":
        venv = GymnasiumVecEnv(gym.make_vec("CartPole-v1", N_ENVS, max_episode_steps=7))
    else:
        limited = partial(gym.make, "CartPole-v1", max_episode_steps=7)
        venv = GymnasiumVecEnv(gym.vector.SyncVectorEnv([limited] * N_ENVS, autoreset_mode=AutoresetMode[kind]))
    observations = venv.reset()
    for step in range(1, 36):
        actions = np.arange(N_ENVS) % 2
        next_observations, _, dones, infos = venv.step(actions)
        np.testing.assert_array_equal(dones, step % 7 == 0)
        for env, info in enumerate(infos):
            reached = info["terminal_observation"] if dones[env] else next_observations[env]
            np.testing.assert_allclose(reached, after(observations[env], actions[env]), atol=1e-5)
            assert info["TimeLimit.truncated"] == dones[env]
            if dones[env]:
                assert (np.abs(next_observations[env]) <= 0.05).all()
                assert info["episode"]["l"] == 7
        observations = next_observations
    venv.close()


def without_times(infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Infos without the time since the environments were made."""
    for info in infos:
        info.get("episode", {}).pop("t", None)
    return infos


@pytest.mark.parametrize("mode", MODES)
def test_gymnasium_vector_environments_return_what_dummy_vec_env_returns(mode: AutoresetMode) -> None:
    def make(index: int) -> gym.Env[Any, Any]:
        return Monitor(gym.make("MountainCar-v0", max_episode_steps=9 + index))

    fns = [partial(make, index) for index in range(N_ENVS)]
    alone, together = DummyVecEnv(fns), GymnasiumVecEnv(gym.vector.SyncVectorEnv(fns, autoreset_mode=mode))
    rng = np.random.default_rng(1)
    for venv in (alone, together):
        venv.seed(5)
    np.testing.assert_array_equal(alone.reset(), together.reset())
    for _ in range(40):
        actions = rng.integers(0, 3, N_ENVS)
        *ones, ones_infos = alone.step(actions)
        *others, others_infos = together.step(actions)
        for one, other in zip(ones, others, strict=True):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
        np.testing.assert_equal(without_times(others_infos), without_times(ones_infos))


@pytest.mark.parametrize("mode", MODES)
def test_a_model_learns_the_same_table_from_gymnasium_vector(
    mode: AutoresetMode, make_model: Callable[..., KNNTD], make_venv: Callable[..., VecEnv]
) -> None:
    alone = make_model(make_venv(N_ENVS)).learn(60 * N_ENVS)
    together = make_model(drifting(mode=mode)).learn(60 * N_ENVS)
    assert alone.policy.q_table.any()
    np.testing.assert_array_equal(together.policy.q_table, alone.policy.q_table)
    lengths = [[info["l"] for info in model.ep_info_buffer or ()] for model in (alone, together)]
    assert lengths[0] == lengths[1] != []


def test_models_take_environments_of_gymnasium_vector(tmp_path: pathlib.Path) -> None:
    model = KNNTD("KNNPolicy", gym.make_vec("CartPole-v1", 3), seed=0).learn(300)
    assert model.n_envs == 3
    model.set_env(gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec("CartPole-v1", 3, "sync")))
    model.learn(300)
    model.save(tmp_path / "model")
    loaded = KNNTD.load(tmp_path / "model", env=gym.make_vec("CartPole-v1", 3)).learn(30, reset_num_timesteps=False)
    assert loaded.num_timesteps == 330


class Forgetful(VectorEnv[Any, Any, Any]):
    """Two clocks that count to 3 and 4. Its reset does not know the option reset_mask."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, **metadata: Any) -> None:
        self.metadata = {**self.metadata, **metadata}
        self.num_envs = 2
        self.single_observation_space = gym.spaces.Box(0.0, 9.0, (1,))
        self.single_action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.count = np.zeros(2, np.float32)
        return self.count[:, None].copy(), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.count += 1
        ended = self.count >= [3, 4]
        return self.count[:, None].copy(), np.ones(2), ended, np.zeros(2, bool), {}


def test_environments_that_cannot_reset_some_are_refused_before_anything_wrong_is_learned() -> None:
    model = KNNTD(Forgetful(), points=4, n_neighbors=1, seed=0).learn(4)
    with pytest.raises(ValueError, match="reset_mask"):
        model.learn(4, reset_num_timesteps=False)


def test_an_environment_without_the_last_observations_is_refused() -> None:
    with pytest.raises(ValueError, match="final_obs"):
        KNNTD(Forgetful(autoreset_mode=AutoresetMode.SAME_STEP), points=4, n_neighbors=1).learn(8)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: GymnasiumVecEnv(gym.make("CartPole-v1")), "gymnasium.make_vec"),  # type: ignore[arg-type]
        (lambda: GymnasiumVecEnv(Forgetful(autoreset_mode="sometimes")), "NEXT_STEP.*'sometimes'"),
        pytest.param(
            lambda: EnvPoolVecEnv("CartPol-v1"), "no environment 'CartPol-v1'.*CartPole-v1", marks=needs_envpool
        ),
        pytest.param(lambda: EnvPoolVecEnv("CartPole-v1", n_envs=0), "n_envs", marks=needs_envpool),
        pytest.param(lambda: EnvPoolVecEnv("CartPole-v1", gravity=3.0), "gravity", marks=needs_envpool),
        pytest.param(lambda: EnvPoolVecEnv("CartPole-v1", batch_size=3), "batch_size.*n_envs", marks=needs_envpool),
        (lambda: KNNTD("envpool:CartPole-v1"), r"KNNTD\(EnvPoolVecEnv\('CartPole-v1', n_envs=64\)\)"),
    ],
)
def test_wrong_arguments_say_what_would_do(make: Callable[[], Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()


@needs_envpool
def test_environments_of_envpool_itself_are_refused_as_they_cannot_be_seeded() -> None:
    import envpool

    pool = envpool.make_gymnasium("CartPole-v1", num_envs=2)
    with pytest.raises(ValueError, match=r"EnvPoolVecEnv\(env_id, n_envs\)"):
        KNNTD(pool)


def test_without_envpool_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(ImportError, match=r"pip install 'sb3-knntd\[envpool\]'"):
        EnvPoolVecEnv("CartPole-v1")


@needs_envpool
def test_seeds_of_envpool() -> None:
    def run(seed: int | None) -> np.ndarray:
        venv = EnvPoolVecEnv("CartPole-v1", 3, seed=seed)
        return np.stack([venv.reset(), *(venv.step(np.ones(3, int))[0] for _ in range(40)), venv.reset()])

    np.testing.assert_array_equal(run(7), run(7))
    assert not np.array_equal(run(7), run(8))
    assert not np.array_equal(run(None), run(None))
    # The environment after the first has the next seed.
    np.testing.assert_array_equal(run(7)[0, 1], run(8)[0, 0])


@needs_envpool
def test_training_with_envpool_is_reproducible() -> None:
    def train() -> KNNTD:
        return KNNTD(EnvPoolVecEnv("MountainCar-v0", 8, num_threads=2), points=9, seed=1).learn(8 * 250)

    model = train()
    np.testing.assert_array_equal(train().policy.q_table, model.policy.q_table)
    # No episode is longer than gymnasium's limit.
    assert [info["l"] for info in model.ep_info_buffer or ()] == [200] * 8


@needs_envpool
def test_continuous_actions_and_discrete_observations_of_envpool() -> None:
    venv = EnvPoolVecEnv("Pendulum-v1", 2)
    venv.reset()
    assert venv.step(np.zeros((2, 1), np.float32))[0].shape == (2, 3)
    model = KNNTD(EnvPoolVecEnv("FrozenLake-v1", 4), seed=0).learn(4000)
    assert model.policy.q_table.shape == (16, 4)
    assert model.policy.q_table.any()


@pytest.mark.parametrize("kind", KINDS[:2])
def test_other_algorithms_and_wrappers_of_sb3(kind: str) -> None:
    venv = VecNormalize(cart_poles(kind, 2))
    model = PPO("MlpPolicy", venv, n_steps=32, batch_size=32, n_epochs=1, device="cpu").learn(128)
    assert len(model.ep_info_buffer or ()) > 0
    mean, _ = evaluate_policy(model, cart_poles(kind, 2), n_eval_episodes=4)
    assert mean > 1
    with pytest.warns(UserWarning, match="already wrapped"):
        VecMonitor(cart_poles(kind, 2))


class Lights(gym.Env[np.ndarray, int]):
    """An environment of two steps with infos of its own."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.count = 0
        return np.zeros(1, np.float32), {"begun": True}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.count += 1
        info: dict[str, Any] = {"count": self.count}
        if action:
            info["nested"] = {"light": self.count}
        return np.ones(1, np.float32), 0.0, self.count == 2, False, info


@pytest.mark.parametrize("mode", MODES)
def test_infos_of_the_environments(mode: AutoresetMode) -> None:
    alone, together = (
        DummyVecEnv([lambda: Monitor(Lights())] * 2),
        GymnasiumVecEnv(gym.vector.SyncVectorEnv([Lights] * 2, autoreset_mode=mode)),
    )
    for venv in (alone, together):
        venv.reset()
    assert together.reset_infos == alone.reset_infos
    for _ in range(3):
        infos = [without_times(venv.step(np.array([0, 1]))[3]) for venv in (alone, together)]
        assert infos[1] == infos[0]
        assert together.reset_infos == alone.reset_infos


class Remembers(gym.Env[np.ndarray, int]):
    """An environment that returns the same arrays and the same info in every step."""

    observation_space = gym.spaces.Box(-9.0, 9.0, (2,))
    action_space = gym.spaces.Discrete(3)

    def __init__(self) -> None:
        self.place = np.zeros(2, np.float32)
        self.info: dict[str, Any] = {"places": [], "last": {"place": self.place}}

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.place[:] = 0.0
        return self.place, {"begun": True}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place += action
        self.info["places"].append(float(self.place[0]))
        self.info["count"] = len(self.info["places"])
        return self.place, 0.1 * action, False, bool(self.place[0] > 4), self.info


def test_what_lean_vec_env_returned_does_not_change_later() -> None:
    def run(kind: type[DummyVecEnv]) -> list[Any]:
        venv = kind([Remembers, Remembers])
        return [venv.reset(), *(venv.step(np.array([1, 2])) for _ in range(7)), venv.reset_infos]

    np.testing.assert_equal(run(LeanVecEnv), run(DummyVecEnv))


def test_models_put_single_environments_into_lean_vec_env(capsys: pytest.CaptureFixture[str]) -> None:
    model = KNNTD("MountainCar-v0", seed=0, verbose=1)
    assert type(model.env) is LeanVecEnv
    assert isinstance(model.env, DummyVecEnv)
    assert model.env.env_is_wrapped(Monitor) == [True]
    assert capsys.readouterr().out.count("Wrapping the env") == 2
    alone = KNNTD(DummyVecEnv([lambda: Monitor(gym.make("MountainCar-v0"))]), seed=0)
    np.testing.assert_array_equal(model.learn(900).policy.q_table, alone.learn(900).policy.q_table)
    dictionary = gym.wrappers.TransformObservation(
        Remembers(), lambda seen: {"place": seen}, gym.spaces.Dict({"place": Remembers.observation_space})
    )
    assert LeanVecEnv([lambda: dictionary]).reset()["place"].shape == (1, 2)  # type: ignore[call-overload, index]


@needs_envpool
@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["CartPole-v1", "MountainCar-v0"])
def test_learning_with_envpool_is_as_good(env_id: str) -> None:
    from stable_baselines3.common.env_util import make_vec_env

    def returns(make: Callable[[int], VecEnv]) -> np.ndarray:
        models = [KNNTD(make(seed), seed=seed).learn(100_000) for seed in range(10)]
        return np.array([np.mean([info["r"] for info in model.ep_info_buffer or ()]) for model in models])

    ours = returns(lambda seed: EnvPoolVecEnv(env_id, 8, seed=seed))
    theirs = returns(lambda seed: make_vec_env(env_id, 8, seed=seed))
    # Seeds differ; a thousandth is the chance that equal distributions do so this much.
    assert mannwhitneyu(ours, theirs).pvalue > 0.001
