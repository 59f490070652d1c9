"""The generalised Mountain-Car: its problems, the effect of each part, and compliance with gymnasium."""

from __future__ import annotations

import math
import pickle
import re
import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as check_for_gymnasium
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from stable_baselines3.common.env_checker import check_env as check_for_sb3
from stable_baselines3.common.env_util import make_vec_env

import sb3_knntd.envs
from sb3_knntd import KNNTD
from sb3_knntd.envs.generalized_mountain_car import (
    GeneralizedMountainCarEnv,
    draw_problem,
    numbered_problem,
)
from sb3_knntd.envs.mountain_car import mountain_car_step

NAME, CAR = "sb3_knntd/GeneralizedMountainCar-v0", "sb3_knntd/MountainCar-v0"
SWITCHES = ("noise", "offset", "random_force", "random_start")
ALL_OFF = dict.fromkeys(SWITCHES, False)
WIDTHS = np.array([1.8, 0.14])
problems = st.integers(0, 2**40)


def make(**kwargs: Any) -> Any:
    return gym.make(NAME, **kwargs).unwrapped


def roll(env: Any, seed: int, n_steps: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Observations and true states of an episode of fixed actions."""
    observation, info = env.reset(seed=seed)
    observations, states = [observation], [info["state"]]
    for number in range(n_steps):
        observation, _, _, _, info = env.step(number * number // 7 % 3)
        observations.append(observation)
        states.append(info["state"])
    return np.array(observations), np.array(states)


# --- problems ---------------------------------------------------------------------------------------------------------


@given(number=problems)
@settings(max_examples=200, deadline=None)
def test_a_problem_is_within_its_ranges(number: int) -> None:
    problem = numbered_problem(number)
    assert all(-1.0 <= offset <= 1.0 for offset in problem.offset)
    assert all(5.0 <= divider <= 20.0 for divider in problem.noise_divider)
    assert 0.8 <= problem.force_factor <= 1.2
    assert problem == numbered_problem(number)


def test_problems_fill_their_ranges() -> None:
    drawn = [numbered_problem(number) for number in range(400)]
    numbers = np.array([(*p.offset, *p.noise_divider, p.force_factor) for p in drawn])
    low, width = np.array([-1, -1, 5, 5, 0.8]), np.array([2, 2, 15, 15, 0.4])
    for column in ((numbers - low) / width).T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    correlations = np.corrcoef(numbers.T) - np.eye(5)
    assert np.abs(correlations).max() < 0.2


def test_numbered_problems_never_change() -> None:
    # Results are reported by problem number, so the problem of a number must never change.
    problem = numbered_problem(0)
    assert problem.offset == pytest.approx((0.8858751057657588, -0.3673256952290038))
    assert problem.noise_divider == pytest.approx((15.83513882974738, 6.884046281490399))
    assert problem.force_factor == pytest.approx(0.969190545005988)


def test_a_number_is_the_same_problem_everywhere() -> None:
    expected = numbered_problem(7)
    first, second = make(problem=7), make(problem=np.int64(7))
    first.reset(seed=1), second.reset(seed=2)
    assert first.parameters == second.parameters == expected
    code = f"import gymnasium as gym; print(gym.make('sb3_knntd.envs:{NAME}', problem=7).unwrapped.parameters)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == str(expected)
    assert make(problem=8).parameters != expected


def test_problems_and_starts_use_different_random_numbers() -> None:
    env = make(problem=3)
    env.reset(seed=3)
    drawn_from_the_seed = draw_problem(np.random.Generator(np.random.PCG64(np.random.SeedSequence(3))))
    assert env.parameters != drawn_from_the_seed


def test_without_a_number_the_seed_draws_the_problem() -> None:
    env = make(problem=None)
    env.reset(seed=5)
    drawn = env.parameters
    for _ in range(3):
        env.reset()
        env.step(0)
    assert env.parameters is drawn
    env.reset(seed=6)
    assert env.parameters != drawn
    env.reset(seed=5)
    assert env.parameters == drawn

    np.testing.assert_array_equal(roll(env, 5)[0], roll(make(problem=None), 5)[0])
    assert make(problem=None).parameters != make(problem=None).parameters


# --- observations -----------------------------------------------------------------------------------------------------


def test_the_observation_space_is_that_of_the_competition() -> None:
    for number in (0, 1, None):
        space = gym.make(NAME, problem=number).observation_space
        np.testing.assert_allclose(space.low, (-2.38, -1.084), rtol=1e-6)
        np.testing.assert_allclose(space.high, (1.78, 0.944), rtol=1e-6)


@given(number=problems, seed=st.integers(0, 2**31), left=st.booleans())
@settings(max_examples=40, deadline=None)
def test_observations_are_within_the_limits_of_the_problem(number: int, seed: int, left: bool) -> None:
    env = GeneralizedMountainCarEnv(problem=number)
    offset, divider, _ = env.parameters
    observation, info = env.reset(seed=seed)
    assert -0.9 <= info["state"][0] <= -0.3
    assert info["state"][1] == 0.0
    for step in range(100):
        assert observation in env.observation_space
        assert (np.abs(info["state"] - (-0.3, 0.0)) <= (0.9, 0.07)).all()
        expected = np.clip(info["state"] + offset, env.observation_space.low, env.observation_space.high)
        assert (np.abs(observation - expected) <= 0.5 * WIDTHS / divider + 1e-6).all()
        # Swinging, to reach both ends of the valley.
        push_left = left if step == 0 else info["state"][1] < 0
        observation, *_, info = env.step(0 if push_left else 2)


def test_noise_is_a_beta_distribution_of_the_problems_width() -> None:
    env = make(problem=2, offset=False)
    env.reset(seed=0)
    errors = []
    for _ in range(4000):
        observation, info = env.reset()
        errors.append(observation - info["state"])
    betas = np.array(errors) * env.parameters.noise_divider / WIDTHS + 0.5
    for column in betas.T:
        assert stats.kstest(column, stats.beta(5, 2).cdf).pvalue > 1e-3
    assert betas.mean() == pytest.approx(5 / 7, abs=0.01), "the noise has a mean"
    assert abs(np.corrcoef(betas.T)[0, 1]) < 0.1


def test_offsets_shift_the_observations() -> None:
    env = make(problem=2, noise=False)
    observations, states = roll(env, 0)
    np.testing.assert_allclose(observations, states + env.parameters.offset, rtol=1e-6, atol=1e-7)


def test_velocities_are_clipped_to_the_competitions_limit() -> None:
    number = next(number for number in range(1000) if numbered_problem(number).offset[1] > 0.98)
    observations, states = roll(make(problem=number, noise=False), 0)
    assert (states[:, 1] + numbered_problem(number).offset[1]).max() > 0.944
    assert observations[:, 1].max() == np.float32(0.944)


# --- dynamics ---------------------------------------------------------------------------------------------------------


@given(number=problems, seed=st.integers(0, 2**31), actions=st.lists(st.integers(0, 2), min_size=1, max_size=80))
@settings(max_examples=25, deadline=None)
def test_without_all_parts_it_is_the_mountain_car(number: int, seed: int, actions: list[int]) -> None:
    ours, plain = GeneralizedMountainCarEnv(problem=number, **ALL_OFF), sb3_knntd.envs.MountainCarEnv()
    np.testing.assert_array_equal(ours.reset(seed=seed)[0], plain.reset(seed=seed)[0])
    for action in actions:
        observation, _, terminated, truncated, info = ours.step(action)
        expected, _, expected_end, expected_cut, _ = plain.step(action)
        assert ours.state == plain.state
        np.testing.assert_array_equal(info["state"], plain.state)
        np.testing.assert_array_equal(observation, expected)
        assert (terminated, truncated) == (expected_end, expected_cut)


def test_the_engine_varies_around_the_problems_strength() -> None:
    env = make(problem=4, random_start=False)
    env.reset(seed=0)
    factors = []
    for action in [0, 2] * 1000:
        env.reset()
        env.step(action)
        idle = mountain_car_step((-0.5, 0.0), 1)[1]
        factors.append((env.state[1] - idle) / (0.001 * (action - 1)))
    assert stats.kstest(factors, stats.norm(env.parameters.force_factor, 0.05).cdf).pvalue > 1e-3

    env.reset()
    env.step(1)
    assert env.state == mountain_car_step((-0.5, 0.0), 1), "gravity does not vary"


def test_the_step_compiles_with_a_force() -> None:
    compiled = numba.njit(mountain_car_step)
    for force in (0.0008, 0.0012):
        assert compiled((-0.7, 0.01), 2, force) == mountain_car_step((-0.7, 0.01), 2, force)
    assert mountain_car_step((-0.7, 0.01), 2, 0.001) == mountain_car_step((-0.7, 0.01), 2)


def test_starts_fill_their_range() -> None:
    env = make()
    env.reset(seed=0)
    starts = np.array([env.reset()[1]["state"] for _ in range(500)])
    assert stats.kstest(starts[:, 0], stats.uniform(-0.9, 0.6).cdf).pvalue > 1e-3
    assert (starts[:, 1] == 0.0).all()
    assert (make(random_start=False).reset()[1]["state"] == (-0.5, 0.0)).all()


@pytest.mark.parametrize("switch", SWITCHES)
def test_disabling_a_part_does_not_change_the_others(switch: str) -> None:
    full, part = make(problem=1), make(problem=1, **{switch: False})
    (observations, states), (others, other_states) = roll(full, 3), roll(part, 3)
    assert (observations != others).any()
    assert part.parameters == full.parameters
    if switch in ("noise", "offset"):
        np.testing.assert_array_equal(states, other_states)
    else:
        assert (states != other_states).any()


def test_reward_and_end() -> None:
    env = make(**ALL_OFF)
    env.reset(options={"state": (0.4, 0.0)})
    assert env.step(1)[1:4] == (-1.0, False, False)
    env.reset(options={"state": (0.48, 0.05)})
    assert env.step(2)[1:4] == (0.0, True, False)


def test_only_the_true_position_ends_an_episode() -> None:
    number = next(number for number in range(100) if numbered_problem(number).offset[0] > 0.95)
    env = make(problem=number)
    observation, _ = env.reset(seed=0, options={"state": (-0.3, 0.05)})
    assert observation[0] > 0.5
    assert not env.step(2)[2]


# --- gymnasium API ----------------------------------------------------------------------------------------------------

VARIANTS: list[dict[str, Any]] = [
    {},
    {"problem": None},
    ALL_OFF,
    *({switch: False, "problem": 3} for switch in SWITCHES),
    {"problem": next(number for number in range(1000) if numbered_problem(number).offset[1] > 0.98)},
]


def test_registration() -> None:
    assert gym.spec(NAME).max_episode_steps == 1000
    assert sb3_knntd.envs.GeneralizedMountainCarEnv is type(make())
    assert gym.make(NAME).action_space == gym.spaces.Discrete(3)


@pytest.mark.parametrize("kwargs", VARIANTS, ids=str)
def test_the_checkers_find_nothing(kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_for_gymnasium(make(**kwargs))
        check_for_sb3(make(render_mode="rgb_array", **kwargs), skip_render_check=False)
        check_for_sb3(gym.make(NAME, **kwargs))


@pytest.mark.parametrize("kwargs", VARIANTS, ids=str)
def test_the_same_seed_makes_the_same_episode(kwargs: dict[str, Any]) -> None:
    env = make(**kwargs)
    first, again, other = roll(env, 8), roll(env, 8), roll(make(**kwargs), 8)
    for observations, states in (again, other):
        np.testing.assert_array_equal(observations, first[0])
        np.testing.assert_array_equal(states, first[1])
    if kwargs is not ALL_OFF:
        assert (roll(env, 9)[0] != first[0]).any()


def test_info_contains_the_true_state() -> None:
    env = make()
    _, info = env.reset(seed=0)
    for action in (0, 1, 2):
        np.testing.assert_array_equal(info["state"], env.state)
        assert info["state"].dtype == np.float64
        kept = info["state"].copy()
        before, info = info, env.step(action)[4]
        np.testing.assert_array_equal(before["state"], kept)


def test_it_can_be_pickled() -> None:
    env = make(problem=None)
    env.reset(seed=0)
    twin = pickle.loads(pickle.dumps(env))
    assert twin.parameters == env.parameters
    np.testing.assert_array_equal(env.step(2)[0], twin.step(2)[0])


def test_knntd_learns_from_it() -> None:
    model = KNNTD(env=make_vec_env(NAME, n_envs=2, seed=0), points=4, seed=0).learn(1000)
    assert np.isfinite(model.policy.q_table.numpy()).all()
    assert (model.policy.q_table != 0).any()


def test_options_of_reset() -> None:
    env = make()
    env.reset(options={"state": (-0.3, 0.01)})
    assert env.state == (-0.3, 0.01)
    for _ in range(10):
        env.reset(options={"low": -0.8, "high": -0.7})
        assert -0.8 <= env.state[0] <= -0.7
        assert env.state[1] == 0.0
    # The state is the true one, independent of the offset.
    with pytest.raises(ValueError, match=re.escape("2 numbers from (-1.2, -0.07) to (0.6, 0.07); got (1.5, 0.0)")):
        env.reset(options={"state": (1.5, 0.0)})


@pytest.mark.parametrize(
    ("argument", "value", "way_out"),
    [
        *(("problem", value, ">= 0") for value in (-1, 1.5, "3", True, math.nan, [1])),
        *((switch, value, "True or False") for switch in SWITCHES for value in (0.1, None, "no", 1)),
        ("render_mode", "ansi", "'rgb_array'"),
    ],
)
def test_bad_arguments(argument: str, value: Any, way_out: str) -> None:
    with pytest.raises(ValueError, match=f"^{argument} must be .*{way_out}.*; got {re.escape(repr(value))}"):
        GeneralizedMountainCarEnv(**{argument: value})


@pytest.mark.parametrize("action", [3, -1, 0.5, None, "left"])
def test_bad_actions(action: Any) -> None:
    env = make(random_start=False)
    env.reset()
    with pytest.raises(ValueError, match=f"^action must be 0, 1 or 2; got {re.escape(repr(action))}"):
        env.step(action)
    assert env.state == (-0.5, 0.0)


def test_step_needs_a_reset_first() -> None:
    with pytest.raises(ResetNeeded, match=r"reset\(\) before step"):
        make().step(0)


def test_pictures_show_the_true_state() -> None:
    pytest.importorskip("pygame")
    ours, plain = make(render_mode="rgb_array"), gym.make(CAR, render_mode="rgb_array").unwrapped
    ours.reset(options={"state": (-0.9, 0.0)}), plain.reset(options={"state": (-0.9, 0.0)})
    np.testing.assert_array_equal(ours.render(), plain.render())
    still = ours.render()
    ours.step(0)
    assert (ours.render() != still).any()


def test_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    env = make(render_mode="human")
    env.reset()
    assert env.render() is None
    assert pygame.display.get_caption()[0] == "Generalised Mountain-Car"
    env.close()
    assert pygame.display.get_surface() is None
