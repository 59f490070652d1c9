"""Environments: the equations and options of the paper's, and compliance of all of them with gymnasium."""

from __future__ import annotations

import math
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.envs.classic_control.acrobot import AcrobotEnv as GymnasiumAcrobotEnv
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import check_env as check_for_gymnasium
from stable_baselines3.common.env_checker import check_env as check_for_sb3
from stable_baselines3.common.env_util import make_vec_env

import sb3_knntd.envs
from sb3_knntd import KNNTD
from sb3_knntd.envs.acrobot import acrobot_height, acrobot_step
from sb3_knntd.envs.cart_pole import cart_pole_failed, cart_pole_shaped_reward, cart_pole_step
from sb3_knntd.envs.mountain_car import mountain_car_step

CAR, POLE = "sb3_knntd/MountainCar-v0", "sb3_knntd/CartPole-v0"
CONTINUOUS, ACROBOT = "sb3_knntd/ContinuousCartPole-v0", "sb3_knntd/Acrobot-v0"
SWING_UP = "sb3_knntd/CartPoleSwingUp-v0"
ALL = (CAR, POLE, CONTINUOUS, ACROBOT)

# Every environment with its defaults, and with each argument changed at least once.
VARIANTS: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in ALL),
    (CAR, {"start": "uniform", "reward": "goal", "noise": 0.05}),
    (CAR, {"start": "anywhere", "noise": [0.0, 1.0]}),
    (CAR, {"start": (-1.2, 0.07)}),
    (POLE, {"n_forces": 3, "start": "uniform", "reward": "step", "failure_angle": 45, "noise": 0.3}),
    (POLE, {"n_forces": 2, "track": 2.4, "reward": "failure", "start": [2.4, 1.0, 0.1, 0.0]}),
    (CONTINUOUS, {"start": "uniform", "reward": "step", "failure_angle": 45.0, "track": 1, "noise": 0.01}),
    (ACROBOT, {"dynamics": "nips", "start": "uniform", "reward": "goal", "noise": 0.2}),
    (ACROBOT, {"start": (math.pi, -math.pi, 4 * math.pi, -9 * math.pi)}),
    (SWING_UP, {}),
    (SWING_UP, {"start": "fixed", "frame_skip": 2, "noise": [0.0, 0.1, 0.1, 0.1, 0.0]}),
    (SWING_UP, {"start": (2.4, -1.0, 9.0, 5.0)}),
]


def make(name: str, **kwargs: Any) -> Any:
    return gym.make(name, **kwargs).unwrapped


@pytest.fixture
def headless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow windows on machines without a screen."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")


# --- the equations ----------------------------------------------------------------------------------------------------

# Computed with 40 digits from the equations of motion in their textbook form, the accelerations as the solution of
# [mass matrix] x [accelerations] = [forces]: (dynamics, start, actions, {number of steps: state}).
Record = tuple[Callable[..., tuple[float, ...]], tuple[float, ...], list[Any], dict[int, tuple[float, ...]]]
RECORDS: dict[str, Record] = {
    "mountain car": (
        mountain_car_step,
        (-0.5, 0.0),
        [(t * t // 7) % 3 for t in range(150)],
        {
            50: (-0.5363844397574532, 0.0006173530563816057),
            100: (-0.5496573839656318, 0.001512316156132781),
            150: (-0.5092066999083087, -0.003751755482107802),
        },
    ),
    "mountain car, against the wall": (
        mountain_car_step,
        (-1.1, -0.05),
        [0] * 40,
        {
            1: (-1.148531300575228, -0.04853130057522784),
            2: (-1.195677235162574, -0.047145934587346),
            3: (-1.2, 0.0),
            40: (-0.380056288903796, 0.02576169656386655),
        },
    ),
    "cart-pole": (
        cart_pole_step,
        (0.0, 0.0, 0.0, 0.01),
        [((7 * t) % 11 - 5) / 5 for t in range(60)],
        {
            20: (-0.01714903190447448, -0.08426792280321281, 0.04530636741717796, 0.2642814010961937),
            40: (-0.0443410217887549, 0.04031604690117331, 0.2334643739494605, 0.7428646619629871),
            60: (-0.08895868485237959, -0.05625424261762295, 1.032399836125572, 3.770582690738478),
        },
    ),
    "cart-pole, falling": (
        cart_pole_step,
        (1.0, -2.0, 0.6, -3.0),
        [((3 * t) % 11 - 5) / 5 for t in range(30)],
        {
            10: (0.5662825662548455, -2.140833285862914, 0.1585122712138885, -1.750365573258229),
            20: (0.1288207468214281, -2.142270621214337, -0.1591302178091571, -1.7088435883457),
            30: (-0.3081945539189991, -1.999311701999148, -0.555188158096093, -2.821496689322205),
        },
    ),
    "acrobot": (
        acrobot_step,
        (0.1, -0.2, 0.3, -0.4),
        [(t // 3) % 3 for t in range(60)],
        {
            20: (-0.5065992329145253, 0.8569641503364175, 0.1938919503322315, -0.2719317210258588),
            40: (-0.0695750696727758, 0.1613470843339474, -0.5248447112744741, 0.8731679560227743),
            60: (0.4873995654902831, -0.8225806398642201, 0.222086477189031, -0.5746505769287389),
        },
    ),
    "acrobot, turning over": (
        acrobot_step,
        (2.0, -1.0, 5.0, -7.0),
        [(t // 2) % 3 for t in range(20)],
        {
            5: (1.043855283972656, -2.145810254113635, 6.007123126486859, -6.576142968749226),
            10: (0.04847759492458022, -1.268941161324853, 6.477159832639502, -5.906453937810462),
            20: (0.2705349906273442, 2.205552543384795, -4.519613460040987, 8.438445344911516),
        },
    ),
}


@pytest.mark.parametrize("name", RECORDS)
@pytest.mark.parametrize("compiled", [False, True], ids=["python", "numba"])
def test_the_dynamics_follow_recorded_trajectories(name: str, compiled: bool) -> None:
    step, state, actions, records = RECORDS[name]
    if compiled:
        step = numba.njit(step)
    for number, action in enumerate(actions, start=1):
        before = state
        state = step(state, action)
        assert step(before, action) == state
        if number in records:
            assert state == pytest.approx(records[number], rel=1e-9, abs=1e-12)
    assert number in records


def test_the_dynamics_take_arrays() -> None:
    assert mountain_car_step(np.array([-0.7, 0.01]), 2) == mountain_car_step((-0.7, 0.01), 2)  # type: ignore[arg-type]
    state = (0.1, -0.2, 0.3, -0.4)
    assert cart_pole_step(np.array(state), 0.3) == cart_pole_step(state, 0.3)  # type: ignore[arg-type]
    assert acrobot_step(np.array(state), 0) == acrobot_step(state, 0)  # type: ignore[arg-type]


def test_mountain_car_moves_as_gymnasiums() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = make(CAR), gym.make("MountainCar-v0").unwrapped
    ours.reset(), theirs.reset()
    for _ in range(300):
        # Include the ends of both ranges. No episode continues beyond the goal.
        state = np.clip(rng.uniform((-1.3, -0.08), (0.55, 0.08)), (-1.2, -0.07), (0.499, 0.07))
        ours.state, theirs.state = tuple(state.tolist()), state
        action = int(rng.integers(3))
        observation, reward, terminated, truncated, _ = ours.step(action)
        expected, expected_reward, expected_end, expected_cut, _ = theirs.step(action)
        np.testing.assert_allclose(observation, expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(ours.state, theirs.state, rtol=1e-12, atol=1e-15)
        assert (reward, terminated, truncated) == (expected_reward, expected_end, expected_cut)


def test_the_cart_pole_moves_as_gymnasiums() -> None:
    rng = np.random.default_rng(1)
    ours, theirs = make(POLE, n_forces=2, track=2.4, reward="step"), gym.make("CartPole-v1").unwrapped
    ours.reset()
    ends = 0
    for _ in range(300):
        theirs.reset()
        state = rng.uniform(-1, 1, 4) * (2.4, 4.0, 0.209, 4.0)
        ours.state, theirs.state = tuple(state.tolist()), state
        action = int(rng.integers(2))
        observation, reward, terminated, _, _ = ours.step(action)
        expected, expected_reward, expected_end, _, _ = theirs.step(action)
        np.testing.assert_allclose(ours.state, theirs.state, rtol=1e-12, atol=1e-15)
        assert (reward, terminated) == (expected_reward, expected_end)
        if not terminated:
            np.testing.assert_allclose(observation, expected, rtol=1e-6)
        ends += terminated
    assert 0 < ends < 300


@pytest.mark.parametrize("dynamics", ["book", "nips"])
def test_the_acrobot_moves_as_gymnasiums(dynamics: str) -> None:
    rng = np.random.default_rng(2)
    ours, theirs = make(ACROBOT, dynamics=dynamics), GymnasiumAcrobotEnv()
    theirs.book_or_nips = dynamics
    ours.reset(), theirs.reset()
    ends = 0
    for _ in range(200):
        state = rng.uniform(-1, 1, 4) * (np.pi, np.pi, 4 * np.pi, 9 * np.pi)
        ours.state, theirs.state = tuple(state.tolist()), state
        action = int(rng.integers(3))
        _, reward, terminated, _, _ = ours.step(action)
        _, expected_reward, expected_end, _, _ = theirs.step(action)
        np.testing.assert_allclose(ours.state, theirs.state, rtol=1e-9, atol=1e-9)
        assert (reward, terminated) == (expected_reward, expected_end)
        ends += terminated
    assert 0 < ends < 200


def test_the_two_acrobots_differ() -> None:
    state = (0.5, 1.0, 2.0, -1.0)
    assert acrobot_step(state, 1) != pytest.approx(acrobot_step(state, 1, True), rel=1e-3)


def test_the_shortest_path_up_the_mountain() -> None:
    # Found by breadth-first search from (-0.5, 0).
    env = make(CAR)
    env.reset()
    actions = [2] * 16 + [0] * 38 + [2] * 48
    ends = [env.step(action)[2] for action in actions]
    assert ends.index(True) == 101


# --- rewards, ends and starts -----------------------------------------------------------------------------------------


def test_rewards_of_the_mountain_car() -> None:
    for reward, expected in (("step", (-1.0, -1.0)), ("goal", (0.0, 1.0))):
        env = make(CAR, reward=reward)
        env.reset()
        first = env.step(2)
        env.reset(options={"state": (0.48, 0.05)})
        last = env.step(2)
        assert (first[1], last[1]) == expected
        assert (first[2], last[2]) == (False, True)


def test_rewards_of_the_acrobot() -> None:
    for reward, expected in (("step", (-1.0, 0.0)), ("goal", (0.0, 1.0))):
        env = make(ACROBOT, reward=reward)
        env.reset()
        first = env.step(1)
        env.reset(options={"state": (math.pi, 0.0, 0.0, 0.0)})
        last = env.step(1)
        assert (first[1], last[1]) == expected
        assert (first[2], last[2]) == (False, True)
    assert acrobot_height((0.0, 0.0, 0.0, 0.0)) == -2.0


@pytest.mark.parametrize("name", [POLE, CONTINUOUS])
def test_rewards_of_the_cart_pole(name: str) -> None:
    idle = {POLE: 5, CONTINUOUS: np.zeros(1, np.float32)}[name]
    start, leaning = (1.0, 0.5, 0.1, -0.3), (-2.0, 0.0, -0.2, -2.0)
    for reward in ("shaped", "step", "failure"):
        env = make(name, reward=reward, start=start)
        env.reset()
        _, first, terminated, _, _ = env.step(idle)
        position, _, angle, rotation = env.state
        assert not terminated
        upright = 10 - 10 * (10 * angle) ** 2 - 5 * abs(position) - 10 * abs(rotation)
        assert first == pytest.approx({"shaped": upright, "step": 1.0, "failure": 0.0}[reward])
        env.reset(options={"state": leaning})
        observation, last, terminated, _, _ = env.step(idle)
        position, _, angle, _ = env.state
        assert terminated
        fallen = -10000 - 50 * abs(position) - 100 * abs(angle)
        assert last == pytest.approx({"shaped": fallen, "step": 1.0, "failure": -1.0}[reward])
        # The observation is clipped to the space; the state is exact.
        assert observation[2] == np.float32(-math.radians(12.0))
        assert angle < -math.radians(12.0)


def test_the_best_of_the_shaped_reward_is_10() -> None:
    assert cart_pole_shaped_reward((0.0, 5.0, 0.0, 0.0), False) == 10.0


@pytest.mark.parametrize(("degrees", "track"), [(12.0, 4.5), (45.0, 4.5), (12.0, 2.4)])
def test_where_the_cart_pole_fails(degrees: float, track: float) -> None:
    env = make(POLE, failure_angle=degrees, track=track)
    limit = math.radians(degrees)
    np.testing.assert_allclose(env.observation_space.high[[0, 2]], (track, limit), rtol=1e-6)
    for share, expected in ((0.98, False), (1.0, True)):
        for side in (-1, 1):
            for state in ((0.0, 0.0, side * share * limit, side * 0.1), (side * share * track, side * 0.1, 0.0, 0.0)):
                env.reset(options={"state": state})
                assert env.step(5)[2] == expected
    assert not cart_pole_failed((track, 9.0, limit, 9.0), track, limit)


def test_forces_of_the_discrete_cart_pole() -> None:
    assert gym.make(POLE).action_space == gym.spaces.Discrete(11)
    assert gym.make(CONTINUOUS).action_space == gym.spaces.Box(-1, 1, (1,))
    for n_forces in (2, 3, 11):
        discrete, continuous = make(POLE, n_forces=n_forces), make(CONTINUOUS)
        for action, force in enumerate(np.linspace(-1, 1, n_forces)):
            discrete.reset(), continuous.reset()
            discrete.step(np.int64(action)), continuous.step(np.array([force]))
            assert discrete.state == pytest.approx(continuous.state)


def test_the_continuous_force_is_clipped() -> None:
    states = []
    for force in (1.0, 5.0):
        env = make(CONTINUOUS)
        env.reset()
        env.step(np.array([force], dtype=np.float32))
        states.append(env.state)
    assert states[0] == states[1]


FIXED = {CAR: (-0.5, 0.0), POLE: (0.0, 0.0, 0.0, 0.01), CONTINUOUS: (0.0, 0.0, 0.0, 0.01), ACROBOT: (0.0,) * 4}
DRAWN: list[tuple[str, str, Sequence[float], Sequence[float]]] = [
    (CAR, "uniform", (-0.6, 0.0), (-0.4, 0.0)),
    (CAR, "anywhere", (-1.2, -0.07), (0.5, 0.07)),
    (POLE, "uniform", (-0.05,) * 4, (0.05,) * 4),
    (CONTINUOUS, "uniform", (-0.05,) * 4, (0.05,) * 4),
    (ACROBOT, "uniform", (-0.1,) * 4, (0.1,) * 4),
]


@pytest.mark.parametrize("name", ALL)
def test_the_fixed_start(name: str) -> None:
    env = make(name)
    for _ in range(2):
        observation, info = env.reset()
        np.testing.assert_array_equal(observation, np.array(FIXED[name], dtype=np.float32))
        assert env.state == FIXED[name]
        assert info == {}


@pytest.mark.parametrize(("name", "start", "low", "high"), DRAWN)
def test_drawn_starts_fill_their_range(name: str, start: str, low: Sequence[float], high: Sequence[float]) -> None:
    env = make(name, start=start)
    env.reset(seed=3)
    states = np.array([(env.reset(), env.state)[1] for _ in range(300)])
    width = np.subtract(high, low)
    assert (states >= low).all()
    assert (states <= high).all()
    np.testing.assert_allclose(states.min(axis=0), low, atol=0.03 * width.max())
    np.testing.assert_allclose(states.max(axis=0), high, atol=0.03 * width.max())


@pytest.mark.parametrize("name", ALL)
def test_options_of_reset(name: str) -> None:
    env = make(name)
    given = (-0.3, 0.01) if name == CAR else (0.1, 0.2, 0.1, -0.2)
    env.reset(options={"state": given})
    assert env.state == given
    env.reset(options={"state": None, "something else": 3})
    assert env.state == FIXED[name]

    low, high = (-0.9, -0.8) if name == CAR else (0.01, 0.02)
    drawn = np.array([(env.reset(options={"low": low, "high": high}), env.state)[1] for _ in range(20)])
    moving = drawn[:, :1] if name == CAR else drawn
    assert ((moving >= low) & (moving <= high)).all()
    assert (moving.std(axis=0) > 0).all()
    if name == CAR:
        assert (drawn[:, 1] == 0).all()
    env.reset(options={"high": high if name != CAR else -0.5})
    assert env.state != FIXED[name]


# --- noise ------------------------------------------------------------------------------------------------------------

# Widths of the usual ranges; the noise is a share of them.
WIDTHS = {
    CAR: (1.8, 0.14),
    POLE: (9.0, 6.0, 2 * math.radians(12), 2 * math.radians(60)),
    CONTINUOUS: (9.0, 6.0, 2 * math.radians(12), 2 * math.radians(60)),
    ACROBOT: (2 * math.pi, 2 * math.pi, 8 * math.pi, 18 * math.pi),
}


@pytest.mark.parametrize("name", ALL)
def test_noise_is_a_share_of_each_range(name: str) -> None:
    env = make(name, noise=0.02)
    env.reset(seed=0)
    seen = np.array([env.reset()[0] for _ in range(2000)])
    np.testing.assert_allclose(seen.std(axis=0), 0.02 * np.array(WIDTHS[name]), rtol=0.1)
    np.testing.assert_allclose(seen.mean(axis=0), FIXED[name], atol=0.002 * max(WIDTHS[name]))

    shares = np.zeros(len(WIDTHS[name]))
    shares[1] = 0.05
    env = make(name, noise=shares)
    env.reset(seed=0)
    seen = np.array([env.reset()[0] for _ in range(500)])
    np.testing.assert_array_equal(np.delete(seen, 1, axis=1), np.delete([FIXED[name]] * 500, 1, axis=1).astype("f4"))
    assert seen[:, 1].std() == pytest.approx(0.05 * WIDTHS[name][1], rel=0.2)


@pytest.mark.parametrize("name", ALL)
def test_noise_affects_only_the_observation(name: str) -> None:
    noisy, quiet = make(name, noise=0.1), make(name)
    quiet.action_space.seed(0)
    noisy.reset(seed=1), quiet.reset(seed=1)
    for _ in range(30):
        action = quiet.action_space.sample()
        observation, reward, terminated, _, info = noisy.step(action)
        exact, expected_reward, expected_end, _, quiet_info = quiet.step(action)
        assert (observation != exact).any()
        assert (reward, terminated) == (expected_reward, expected_end)
        np.testing.assert_array_equal(info["state"], quiet.state)
        assert quiet_info == {}
        assert observation in noisy.observation_space


def test_noise_comes_from_the_environments_generator() -> None:
    def roll(seed: int) -> np.ndarray:
        env = make(CAR, noise=0.1, start="uniform")
        return np.array([env.reset(seed=seed)[0], *(env.step(0)[0] for _ in range(5))])

    np.testing.assert_array_equal(roll(1), roll(1))
    assert (roll(1) != roll(2)).all()


def test_noise_on_angles_wraps_around() -> None:
    env = make(ACROBOT, noise=[0.01, 0.01, 0, 0], start=(math.pi, -math.pi, 0, 0))
    env.reset(seed=0)
    angles = np.array([env.reset()[0][:2] for _ in range(400)])
    # Half of them on either side, and none clipped to the limit.
    assert 0.4 < (angles > 0).mean() < 0.6
    assert (np.abs(angles) > math.pi - 1e-4).mean() < 0.01


# --- gymnasium API ----------------------------------------------------------------------------------------------------


def test_registration() -> None:
    for name, steps, solved in (
        (CAR, 1000, -110),
        (POLE, 1000, 8000),
        (CONTINUOUS, 1000, 8000),
        (ACROBOT, 500, -100),
    ):
        spec = gym.spec(name)
        assert (spec.max_episode_steps, spec.reward_threshold) == (steps, solved)
    assert sb3_knntd.envs.MountainCarEnv is type(make(CAR))
    env = gym.make(ACROBOT)
    env.reset()
    assert [env.step(1)[3] for _ in range(500)].index(True) == 499


def test_registered_by_name_alone() -> None:
    code = "import gymnasium as gym; print(gym.make('sb3_knntd.envs:sb3_knntd/Acrobot-v0').unwrapped)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "AcrobotEnv" in answer.stdout


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
@pytest.mark.usefixtures("headless")
def test_the_checkers_find_nothing(name: str, kwargs: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_for_gymnasium(make(name, **kwargs))
        check_for_sb3(make(name, render_mode="rgb_array", **kwargs), skip_render_check=False)
        check_for_sb3(gym.make(name, **kwargs))


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_observations_stay_in_the_space_and_repeat_with_the_seed(name: str, kwargs: dict[str, Any]) -> None:
    rolls = []
    for _ in range(2):
        env = gym.make(name, **kwargs)
        env.action_space.seed(5)
        seen, rewards = [env.reset(seed=4)[0]], [0.0]
        for _ in range(300):
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert observation in env.observation_space
            assert isinstance(reward, float)
            assert isinstance(terminated, bool)
            seen.append(observation)
            rewards.append(reward)
            if terminated or truncated:
                seen.append(env.reset()[0])
        rolls.append((np.array(seen), rewards))
    np.testing.assert_array_equal(rolls[0][0], rolls[1][0])
    assert rolls[0][1] == rolls[1][1]


@pytest.mark.parametrize("name", [*ALL, SWING_UP])
def test_environments_can_be_pickled(name: str) -> None:
    env = make(name, noise=0.1)
    env.reset(seed=0)
    twin = pickle.loads(pickle.dumps(env))
    action = env.action_space.sample()
    np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])


@pytest.mark.parametrize("name", [CAR, POLE, ACROBOT])
def test_knntd_learns_from_them(name: str) -> None:
    model = KNNTD(env=make_vec_env(name, n_envs=2, seed=0), points=4, seed=0).learn(2000)
    assert np.isfinite(model.policy.q_table.numpy()).all()
    assert (model.policy.q_table != 0).any()


# --- bad input --------------------------------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")
REFUSED: list[tuple[str, str, list[Any], str]] = [
    (
        CAR,
        "start",
        ["top", None, 3, (0.0,), (0.0, 1.0), (NAN, 0.0), (1e300, 0.0), ("a", "b"), [[-0.5, 0.0]]],
        "'fixed'",
    ),
    (CAR, "reward", ["shaped", None, 1], "'goal'"),
    (CAR, "noise", [-0.1, NAN, INF, "much", None, True, [0.1], [0.1, -0.1], [0.1, NAN], [0.1] * 3, {}], "2 such"),
    (POLE, "n_forces", [1, 0, -3, 2.5, "many", None, True], ">= 2"),
    (POLE, "start", ["anywhere", (0.0, 0.0, 1.0, 0.0), (5.0, 0.0, 0.0, 0.0), (0.0, 0.0)], "'uniform'"),
    (POLE, "reward", ["goal", None], "'failure'"),
    (POLE, "failure_angle", [0, -12, 91, NAN, INF, "12", None, True], "(0, 90]"),
    (POLE, "track", [0, -1, NAN, INF, "long", None], "(0, inf)"),
    (CONTINUOUS, "noise", [-1, [0.1] * 3], "4 such"),
    (CONTINUOUS, "failure_angle", [180], "(0, 90]"),
    (ACROBOT, "dynamics", ["rlpy", None, 1], "'nips'"),
    (ACROBOT, "start", ["anywhere", (4.0, 0.0, 0.0, 0.0)], "'uniform'"),
    (ACROBOT, "reward", ["shaped"], "'goal'"),
    (ACROBOT, "noise", ["0.1", [0.1] * 6], "4 such"),
]


@pytest.mark.parametrize(
    ("name", "argument", "value", "way_out"),
    [(name, argument, value, way_out) for name, argument, values, way_out in REFUSED for value in values],
)
def test_bad_arguments(name: str, argument: str, value: Any, way_out: str) -> None:
    kind = type(make(name))
    with pytest.raises(ValueError, match=re.escape(repr(value))) as caught:
        kind(**{argument: value})
    assert str(caught.value).startswith(argument)
    assert way_out in str(caught.value)


def test_a_start_beyond_the_limits_asked_for() -> None:
    with pytest.raises(ValueError, match=r"^start must be .* from .* to .* got 'uniform'"):
        make(POLE, start="uniform", failure_angle=2)


def test_bad_render_mode() -> None:
    with pytest.raises(ValueError, match=r"^render_mode must be one of 'human', 'rgb_array'; got 'ansi'"):
        sb3_knntd.envs.AcrobotEnv(render_mode="ansi")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"state": (0.0,)},
            'options["state"] must be a state, 2 numbers from (-1.2, -0.07) to (0.6, 0.07); got (0.0,)',
        ),
        ({"state": "top"}, "got 'top'"),
        (
            {"low": "left"},
            "options[\"low\"] must make a state, 2 numbers from (-1.2, -0.07) to (0.6, 0.07); got 'left'",
        ),
        ({"low": -2.0}, 'options["low"] must make a state'),
        ({"high": [1, 2, 3]}, 'options["high"] must make a state'),
        ({"high": NAN}, 'options["high"] must make a state'),
        ({"low": -0.2, "high": -0.3}, 'options["low"] must not be above options["high"]'),
    ],
)
def test_bad_options_of_reset(options: dict[str, Any], message: str) -> None:
    env = make(CAR)
    with pytest.raises(ValueError, match=re.escape(message)):
        env.reset(options=options)


@pytest.mark.parametrize(
    ("name", "actions", "way_out"),
    [
        (CAR, [3, -1, 0.5, None, "left", NAN, [1]], "0, 1 or 2"),
        (POLE, [11, -1, 1.5, None], "from 0 to 10"),
        (ACROBOT, [3, None], "0, 1 or 2"),
        (CONTINUOUS, [[NAN], [INF], [0.1, 0.2], None, "left", []], "one finite number"),
    ],
)
def test_bad_actions(name: str, actions: list[Any], way_out: str) -> None:
    env = make(name)
    env.reset()
    for action in actions:
        with pytest.raises(ValueError, match=f"^action must be .*{way_out}.*" + re.escape(repr(action))):
            env.step(action)
        assert env.state == FIXED[name]


@pytest.mark.parametrize("name", [*ALL, SWING_UP])
def test_step_and_render_need_a_reset_first(name: str) -> None:
    env = make(name, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match=r"reset\(\) before step"):
        env.step(env.action_space.sample())
    with pytest.raises(ResetNeeded, match=r"reset\(\) before render"):
        env.render()


# --- pictures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        *((name, {}) for name in ALL),
        (POLE, {"track": 0.2}),
        (POLE, {"failure_angle": 45}),
        (SWING_UP, {"start": "fixed"}),
    ],
)
def test_pictures_show_the_state_and_the_action(name: str, kwargs: dict[str, Any]) -> None:
    pytest.importorskip("pygame")
    env = make(name, render_mode="rgb_array", **kwargs)
    size = {CAR: (400, 600, 3), ACROBOT: (500, 500, 3), SWING_UP: (320, 800, 3)}.get(name, (220, 800, 3))
    env.reset()
    first = env.render()
    assert first.shape == size
    assert first.dtype == np.uint8
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10
    np.testing.assert_array_equal(first, env.render())
    env.step(np.array([-1.0]) if name in (CONTINUOUS, SWING_UP) else 0)
    pushed = env.render()
    assert (pushed != first).any()
    env.reset()
    np.testing.assert_array_equal(env.render(), first)
    assert (pushed != first).any(), "a picture once given must not change"
    env.close()
    env.close()
    np.testing.assert_array_equal(env.render(), first)


def test_pictures_need_no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setattr(pygame.display, "init", lambda: pytest.fail("no display is needed"))
    env = make(POLE, render_mode="rgb_array")
    env.reset()
    env.render()


@pytest.mark.parametrize("name", [*ALL, SWING_UP])
@pytest.mark.usefixtures("headless")
def test_windows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    shown: list[int] = []
    monkeypatch.setattr(pygame.display, "flip", lambda: shown.append(1))
    env = make(name, render_mode="human")
    env.reset()
    env.step(env.action_space.sample())
    assert env.render() is None
    assert len(shown) == 3
    assert pygame.display.get_surface() is not None
    env.close()
    assert pygame.display.get_surface() is None


def test_rendering_without_a_mode_warns() -> None:
    env = make(CAR)
    env.reset()
    with pytest.warns(UserWarning, match='MountainCar-v0 was made without a render_mode .* "human" or "rgb_array"'):
        assert env.render() is None


def test_rendering_without_pygame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = make(CAR, render_mode="rgb_array")
    env.reset()
    env.step(0)
    with pytest.raises(DependencyNotInstalled, match=re.escape('pip install "gymnasium[classic-control]"')):
        env.render()
