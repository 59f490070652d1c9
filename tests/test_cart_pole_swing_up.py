"""The cart-pole swing-up: its equations, reward, ends and starts."""

from __future__ import annotations

import math
import re
from typing import Any

import gymnasium as gym
import numba
import numpy as np
import pytest

import sb3_knntd.envs
from sb3_knntd.envs.cart_pole import cart_pole_step
from sb3_knntd.envs.cart_pole_swing_up import PILCO, swing_up_reward, swing_up_step

SWING_UP = "sb3_knntd/CartPoleSwingUp-v0"


def make(**kwargs: Any) -> Any:
    return gym.make(SWING_UP, **kwargs).unwrapped


# Computed with 40 digits from the equations of motion in their textbook form, the accelerations as the solution of
# [mass matrix] x [accelerations] = [forces]: number of Euler steps, start, forces, {number of steps: state}.
RECORDS: list[tuple[int, tuple[float, ...], list[float], dict[int, tuple[float, ...]]]] = [
    (
        5,
        (0.0, 0.0, 3.14, 0.0),
        [((7 * t) % 11 - 5) / 5 for t in range(40)],
        {
            10: (-0.023606933888047688, 0.2910236748122977, 3.3526277738400743, 1.2834267728727662),
            20: (-0.10915662389442764, -0.2934392698761178, 3.0915272766592263, -0.6962950676076061),
            40: (-0.2320050964604244, 0.3300592642655287, 2.980144953820459, 0.722742030031499),
        },
    ),
    (
        1,
        (0.5, -1.0, 0.2, 2.0),
        [((3 * t) % 11 - 5) / 5 for t in range(20)],
        {
            5: (0.4429635948246547, -1.2274463349096831, 0.32268226864037663, 2.8535806698413837),
            10: (0.3833225924102568, -1.1866703343927274, 0.46981102135182257, 3.212350895548295),
            20: (0.2588720709300669, -1.2161105787368232, 0.8626716990631377, 4.741463169955579),
        },
    ),
]


@pytest.mark.parametrize(("frame_skip", "start", "forces", "records"), RECORDS)
def test_the_environment_follows_recorded_trajectories(
    frame_skip: int, start: tuple[float, ...], forces: list[float], records: dict[int, tuple[float, ...]]
) -> None:
    env = make(frame_skip=frame_skip, start=start)
    env.reset()
    for number, force in enumerate(forces, start=1):
        observation = env.step(np.array([force]))[0]
        if number in records:
            position, velocity, angle, rotation = records[number]
            assert env.state == pytest.approx(records[number], rel=1e-9, abs=1e-12)
            seen = (position, velocity, math.cos(angle), math.sin(angle), rotation)
            np.testing.assert_allclose(observation, seen, rtol=1e-6, atol=1e-7)
    assert number in records


def test_the_dynamics_can_be_compiled_and_leave_the_state_as_it_was() -> None:
    state = (0.5, -1.0, 0.2, 2.0)
    once = cart_pole_step(state, 0.3, PILCO)
    assert numba.njit(cart_pole_step)(state, 0.3, PILCO) == pytest.approx(once, rel=1e-14)
    assert swing_up_step(state, 0.3, 2) == cart_pole_step(once, 0.3, PILCO)
    assert state == (0.5, -1.0, 0.2, 2.0)


def test_rewards() -> None:
    assert swing_up_reward((0.0, 3.0, 0.0, -5.0)) == 1.0
    assert swing_up_reward((0.0, 3.0, math.pi, -5.0)) == 0.0
    assert swing_up_reward((0.0, 0.0, math.pi / 2, 0.0)) == pytest.approx(0.5)
    assert swing_up_reward((2.4, 0.0, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-12)
    env = make(start=(1.0, 0.5, 1.0, -0.3))
    env.reset()
    reward = env.step(np.array([0.5]))[1]
    assert reward == pytest.approx((1 + math.cos(env.state[2])) / 2 * math.cos(math.pi * env.state[0] / 4.8))


def test_it_tells_whether_the_pole_is_up() -> None:
    # Beside the limit, cos(angle) = 0.9, on either side and after whole turns.
    edge = math.acos(0.9)
    for turns in (-1, 0, 1):
        for side in (-1, 1):
            for angle, up in ((0.99 * edge, True), (1.01 * edge, False)):
                _, info = make(start=(0.0, 0.0, side * angle + 2 * math.pi * turns, 0.0)).reset()
                assert info == {"upright": up}
    env = make(noise=0.1)
    env.reset(seed=0)
    info = env.step(np.array([1.0]))[4]
    assert info["upright"] is False
    np.testing.assert_array_equal(info["state"], env.state)


@pytest.mark.parametrize("side", [-1, 1])
def test_an_episode_ends_off_the_track(side: int) -> None:
    for position, expected in ((2.3, False), (2.39, True)):
        env = make(start=(side * position, side * 1.0, math.pi, 0.0))
        env.reset()
        observation, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        assert (terminated, truncated) == (expected, False)
        if expected:
            assert abs(env.state[0]) > 2.4
            assert observation[0] == np.float32(side * 2.4)


def test_an_episode_lasts_ten_seconds() -> None:
    env = gym.make(SWING_UP)
    env.reset(seed=0)
    assert [env.step(np.zeros(1, np.float32))[3] for _ in range(200)].index(True) == 199
    assert env.spec is not None
    assert env.spec.reward_threshold == 140.0
    assert sb3_knntd.envs.CartPoleSwingUpEnv is type(env.unwrapped)


def test_starts() -> None:
    hanging = (0.0, 0.0, math.pi, 0.0)
    env = make(start="fixed")
    observation, _ = env.reset()
    assert env.state == hanging
    np.testing.assert_allclose(observation, (0.0, 0.0, -1.0, 0.0, 0.0), atol=1e-7)
    env = make()
    env.reset(seed=3)
    states = np.array([(env.reset(), env.state)[1] for _ in range(300)])
    np.testing.assert_allclose(states.min(axis=0), np.array(hanging) - 0.1, atol=0.005)
    np.testing.assert_allclose(states.max(axis=0), np.array(hanging) + 0.1, atol=0.005)
    env.reset(options={"state": (0.1, 0.2, -4.0, 3.0)})
    assert env.state == (0.1, 0.2, -4.0, 3.0)
    env.reset(options={"low": 1.0, "high": 1.5})
    assert all(1.0 <= number <= 1.5 for number in env.state)


def test_the_force_is_clipped() -> None:
    states = []
    for force in (1.0, 5.0):
        env = make(start="fixed")
        env.reset()
        env.step(np.array([force], dtype=np.float32))
        states.append(env.state)
    assert states[0] == states[1]


def test_noise_is_a_share_of_each_usual_range() -> None:
    start = (0.5, 1.0, math.pi / 4, 2.0)
    env = make(noise=0.01, start=start)
    env.reset(seed=0)
    seen = np.array([env.reset()[0] for _ in range(2000)])
    np.testing.assert_allclose(seen.std(axis=0), 0.01 * np.array((4.8, 8.0, 2.0, 2.0, 20.0)), rtol=0.1)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(seen.mean(axis=0), (0.5, 1.0, half, half, 2.0), atol=0.02)


def test_a_controller_that_knows_the_equations_swings_it_up() -> None:
    env = gym.make(SWING_UP, start="fixed")
    observation, _ = env.reset()
    upright = 0
    for _ in range(200):
        position, velocity, cos, sin, rotation = observation.tolist()
        if cos > 0.8:
            angle = math.atan2(sin, cos)
            push = 0.5 * position + 0.7 * velocity + 4.5 * angle + 0.9 * rotation
        else:
            # Pump energy into the pole, J below that of the pole upright at rest.
            energy = 0.03 * rotation**2 + 1.473 * (cos - 1.0)
            push = min(max(2.0 * (energy - 0.15) * rotation * cos, -0.8), 0.8) - 0.5 * position - 0.1 * velocity
        observation, _, terminated, _, info = env.step(np.array([push], dtype=np.float32))
        assert not terminated
        upright += info["upright"]
    assert upright >= 150


@pytest.mark.parametrize(
    ("argument", "value", "way_out"),
    [
        *(("frame_skip", value, ">= 1") for value in (0, -1, 1.5, "5", None, True)),
        *(
            ("start", value, "'uniform', 'fixed', or a state, 4 numbers")
            for value in ("up", None, (3.0, 0, 0, 0), (0,) * 5)
        ),
        *(("noise", value, "5 such numbers") for value in (-0.1, [0.1] * 4, "much")),
    ],
)
def test_bad_arguments(argument: str, value: Any, way_out: str) -> None:
    with pytest.raises(ValueError, match=f"^{argument} .*{re.escape(way_out)}.*{re.escape(repr(value))}"):
        sb3_knntd.envs.CartPoleSwingUpEnv(**{argument: value})


@pytest.mark.parametrize("action", [[math.nan], [math.inf], [0.1, 0.2], None, "left", []])
def test_bad_actions(action: Any) -> None:
    env = make(start="fixed")
    env.reset()
    with pytest.raises(ValueError, match="^action must be one finite number.*" + re.escape(repr(action))):
        env.step(action)
    assert env.state == (0.0, 0.0, math.pi, 0.0)
