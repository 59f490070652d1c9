"""Plots show the given data or the values of the policy."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from matplotlib.axes import Axes
from sb3_knntd.callbacks import EpisodeVideoCallback, ValueMapCallback
from toy_envs import DriftEnv, GridEnv, PushEnv

from sb3_knntd import KNNTD, KNNDyna
from sb3_knntd.plots import (
    NAMES,
    Names,
    figure_of,
    new_figure,
    plot_learning_curve,
    plot_model_points,
    plot_rollout,
    plot_value_function,
    roll_out,
    running_median,
    telling_dims,
    value_grid,
)


class StillEnv(gym.Env[np.ndarray, int]):
    """An environment with spaces that is never stepped."""

    def __init__(self, low: list[float], high: list[float], actions: spaces.Discrete) -> None:
        self.observation_space = spaces.Box(np.float32(low), np.float32(high), dtype=np.float32)
        self.action_space = actions

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        return self.observation_space.low, {}


def make_model(low: list[float], high: list[float], n_actions: int = 3, start: int = 0, **arguments: Any) -> KNNTD:
    env = StillEnv(low, high, spaces.Discrete(n_actions, start=start))
    return KNNTD(env, **{"points": 9, "n_neighbors": 4, **arguments})


def fill(model: KNNTD, values: Any) -> None:
    """Give the table values, a function of the points, (n_points, obs_dim) -> (n_points, n_actions)."""
    model.policy.q_table.copy_(th.as_tensor(values(model.policy.points.numpy())))


def images(axes: tuple[Axes, Axes]) -> tuple[np.ma.MaskedArray[Any, Any], np.ma.MaskedArray[Any, Any]]:
    return tuple(np.ma.asarray(ax.images[0].get_array()) for ax in axes)  # type: ignore[return-value]


def lines_of(axes: Axes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {str(line.get_label()): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in axes.lines}


# ------------------------------------------------------------- learning curve


def test_running_median() -> None:
    np.testing.assert_array_equal(running_median([5.0, 1.0, 3.0, 9.0, 2.0], 3), [5, 3, 3, 3, 3])
    np.testing.assert_array_equal(running_median([5.0, 1.0], 1), [5, 1])
    assert len(running_median([], 3)) == 0
    with pytest.raises(ValueError, match="window must be an integer >= 1; got 0"):
        running_median([1.0], 0)


def test_the_learning_curve_shows_episodes_median_and_baseline() -> None:
    returns = np.random.default_rng(0).normal(size=80).cumsum()
    steps = np.arange(1, 81) * 50
    axes = plot_learning_curve(steps, returns, baseline=-3.5)
    lines = lines_of(axes)
    np.testing.assert_array_equal(lines["each episode"], (steps, returns))
    np.testing.assert_array_equal(lines["running median of 8 episodes"], (steps, running_median(returns, 8)))
    assert set(lines["random policy, mean"][1]) == {-3.5}
    faint, bold, dashed = axes.lines
    assert faint.get_alpha() < 0.5
    assert bold.get_linewidth() >= 2
    assert dashed.get_linestyle() == "--"
    assert axes.get_xlabel() == "environment steps"
    assert axes.get_ylabel() == "episode return"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(lines)


@pytest.mark.parametrize(("n_episodes", "window"), [(1, 5), (120, 12), (3000, 100)])
def test_the_median_is_over_a_tenth_of_the_episodes(n_episodes: int, window: int) -> None:
    axes = plot_learning_curve(np.arange(n_episodes), np.zeros(n_episodes))
    assert f"running median of {window} episodes" in lines_of(axes)


def test_a_learning_curve_without_episodes_is_an_error() -> None:
    axes = plot_learning_curve([], [], baseline=1.0)
    assert [text.get_text() for text in axes.texts] == ["no episode has ended"]
    assert plot_learning_curve([], []).get_legend() is None


def test_a_learning_curve_needs_a_step_for_each_return() -> None:
    with pytest.raises(ValueError, match="got 2 and 3"):
        plot_learning_curve([1, 2], [1, 2, 3])


def test_curves_are_drawn_on_given_axes() -> None:
    axes = new_figure(4, 3).add_subplot()
    assert plot_learning_curve([1], [1.0], axes=axes) is axes
    pair = tuple(new_figure(8, 3).subplots(1, 2))
    model = make_model([0, 0], [1, 1])
    assert plot_value_function(model, axes=pair, resolution=5) == pair


# -------------------------------------------------------------- value function


def test_the_grid_has_the_values_of_the_policy() -> None:
    model = make_model([0, -5], [2, 5])
    fill(model, lambda points: np.stack([points[:, 0], -points[:, 1], points.sum(axis=1)], axis=1))
    grid = value_grid(model, resolution=8)
    assert grid.extent == (0, 2, -5, 5)
    assert grid.fixed == {}
    assert grid.q_values.shape == (8, 8, 3)
    # Row 6 from the bottom is at -5 + 6.5/8 of the height, column 1 at 1.5/8 of the width.
    here = model.policy.q_values(np.array([2 * 1.5 / 8, -5 + 10 * 6.5 / 8]))[0]
    np.testing.assert_array_equal(grid.q_values[6, 1], here)


def test_dimensions_may_be_exchanged() -> None:
    model = make_model([0, -5], [2, 5])
    fill(model, lambda points: np.stack([points[:, 0], -points[:, 1], points.sum(axis=1)], axis=1))
    straight, turned = value_grid(model, resolution=6), value_grid(model, dims=(1, 0), resolution=6)
    assert turned.extent == (-5, 5, 0, 2)
    np.testing.assert_array_equal(turned.q_values, straight.q_values.transpose(1, 0, 2))


def test_other_dimensions_are_fixed_in_the_middle_or_at_given_values() -> None:
    model = make_model([0, -5, 10, 2], [2, 5, 20, 3], points=4)
    fill(model, lambda points: np.stack([points.sum(axis=1)] * 3, axis=1))
    grid = value_grid(model, dims=(3, 1), fixed={2: 18}, resolution=4)
    assert grid.fixed == {0: 1.0, 2: 18.0}
    here = model.policy.q_values(np.array([1.0, -5 + 10 * 0.5 / 4, 18.0, 2 + 2.5 / 4]))[0]
    np.testing.assert_array_equal(grid.q_values[0, 2], here)


def test_the_picture_is_the_greatest_value_and_its_action() -> None:
    model = make_model([0, -5], [2, 5])
    fill(model, lambda points: 1 + np.stack([points[:, 0], -points[:, 1], points.sum(axis=1)], axis=1))
    grid = value_grid(model, resolution=20)
    axes = plot_value_function(model, resolution=20)
    values, actions = images(axes)
    np.testing.assert_array_equal(values, grid.q_values.max(axis=2))
    np.testing.assert_array_equal(actions, grid.q_values.argmax(axis=2))
    assert len(np.unique(actions)) == 3
    for ax in axes:
        assert ax.images[0].get_extent() == [0, 2, -5, 5]
        assert ax.images[0].origin == "lower"
    assert not axes[0].texts


def test_unvisited_cells_are_masked() -> None:
    model = make_model([0, 0], [1, 1], initial_value=2.0)
    fill(model, lambda points: np.where(points[:, :1] < 0.5, -1.0, 2.0) * np.ones(3))
    axes = plot_value_function(model, resolution=40)
    values, actions = images(axes)
    np.testing.assert_array_equal(values.mask, actions.mask)
    assert not values.mask[:, :15].any()
    assert values.mask[:, 25:].all()
    assert [text.get_text() for text in axes[0].texts] == ["grey: nothing learned"]


def test_points_that_grow_are_drawn(tmp_path: Path) -> None:
    """Also those beyond the range that was visited when all was scaled, and none before learning."""
    model = make_model([-1.0, -np.inf], [1.0, np.inf], points="grow", n_neighbors=2)
    for observation in ([0.2, 3.0], [0.4, 3.0], [0.4, 5.0], [0.9, 4.0]):
        axes = plot_value_function(model)
        figure_of(axes[0]).savefig(tmp_path / "map.png")
        for ax in axes:
            drawn = np.stack(lines_of(ax)["points"], axis=1)
            np.testing.assert_array_equal(drawn, model.policy.points.numpy())
        model.policy.lay_anew(np.array([observation]))
        model.policy.grow(np.array([observation]))
    assert axes[0].get_ylim() == (3.0, 5.0)
    assert not lines_of(plot_value_function(make_model([-1.0, -1.0], [1.0, 1.0]))[0])


def test_an_untrained_model_can_be_drawn(tmp_path: Path) -> None:
    axes = plot_value_function(make_model([0, 0], [1, 1]), resolution=10)
    assert images(axes)[0].mask.all()
    figure_of(axes[0]).savefig(tmp_path / "picture.png")


def test_known_environments_are_drawn_with_their_names() -> None:
    model = KNNTD("CartPole-v1", points=3)
    axes = plot_value_function(model, dims=(2, 3), fixed={0: 1.5}, resolution=5)
    assert axes[0].get_xlabel() == axes[1].get_xlabel() == "pole angle (rad)"
    assert axes[0].get_ylabel() == "pole angular velocity (rad/s)"
    figure = figure_of(axes[0])
    assert figure.get_suptitle() == "where cart position (m) = 1.5, cart velocity (m/s) = 0"
    assert [label.get_text() for label in figure.axes[3].get_yticklabels()] == ["push left", "push right"]


@pytest.mark.parametrize("env_id", sorted(NAMES))
def test_names_fit_their_environment(env_id: str) -> None:
    env = gym.make(env_id)
    assert env.observation_space.shape == (len(NAMES[env_id].observations),)
    n_actions = env.action_space.n if isinstance(env.action_space, spaces.Discrete) else env.action_space.shape[0]  # type: ignore[index]
    assert len(NAMES[env_id].actions) == n_actions


def test_unknown_environments_are_drawn_with_numbers() -> None:
    axes = plot_value_function(make_model([0, 0], [1, 1], n_actions=2, start=5), resolution=5)
    assert axes[0].get_xlabel() == "observation[0]"
    assert axes[0].get_ylabel() == "observation[1]"
    labels = figure_of(axes[0]).axes[3].get_yticklabels()
    assert [label.get_text() for label in labels] == ["action 5", "action 6"]


def test_names_can_be_given() -> None:
    names = Names(("level (m)", "inflow (l/s)"), ("shut", "open"))
    model = make_model([0, 0], [1, 1], n_actions=2)
    axes = plot_value_function(model, resolution=5, names=names)
    assert axes[0].get_xlabel() == "level (m)"
    with pytest.raises(ValueError, match="names must hold one for each"):
        plot_value_function(model, names=Names(("level (m)",), ("shut", "open")))


def test_many_actions_are_named_in_part() -> None:
    axes = plot_value_function(make_model([0, 0], [1, 1], n_actions=25), resolution=5)
    labels = [label.get_text() for label in figure_of(axes[0]).axes[3].get_yticklabels()]
    assert labels == [f"action {number}" for number in range(0, 25, 3)]


def test_action_colors_differ_in_lightness() -> None:
    axes = plot_value_function(make_model([0, 0], [1, 1], n_actions=5), resolution=5)
    colors = axes[1].images[0].get_cmap()(np.arange(5))
    lightness = colors[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert np.diff(lightness).min() > 0.08


def test_selected_dimensions_are_those_the_value_depends_on() -> None:
    model = make_model([0] * 4, [1] * 4, points=4, n_actions=2)
    assert telling_dims(model) == (0, 1)
    fill(model, lambda points: np.stack([points @ [0.1, 3.0, 0.0, 2.0]] * 2, axis=1))
    assert telling_dims(model) == (1, 3)
    assert telling_dims(make_model([0, 0], [1, 1])) == (0, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dims": (0, 3)}, r"dims must be two different dimensions of 0 to 2; got \(0, 3\)"),
        ({"dims": (1, 1)}, "dims must be two different"),
        ({"dims": (0, -1)}, "dims must be two different"),
        ({"dims": (0, 1, 2)}, "dims must be two different"),
        ({"fixed": {1: 0.5}}, r"fixed must name dimensions .* other than those drawn, \(0, 1\); got {1: 0.5}"),
        ({"fixed": {7: 0.5}}, "fixed must name dimensions"),
        ({"resolution": 0}, "resolution must be an integer from 1 to 4096; got 0"),
    ],
)
def test_invalid_plots_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plot_value_function(make_model([0, 0, 0], [1, 1, 1], points=3), **arguments)


@pytest.mark.parametrize("env", ["FrozenLake-v1", StillEnv([0], [1], spaces.Discrete(2))], ids=["states", "line"])
def test_a_value_function_needs_two_dimensions(env: Any) -> None:
    with pytest.raises(ValueError, match="two dimensions of a Box"):
        plot_value_function(KNNTD(env))


# ---------------------------------------------------------------- global state


def test_no_window_and_no_global_state_is_touched() -> None:
    program = (
        "import sys, sb3_knntd.plots\n"
        "assert 'matplotlib' not in sys.modules, 'imported before it is needed'\n"
        "sb3_knntd.plots.plot_learning_curve([1, 2], [1, 2])\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr


def test_the_example_draws_a_value_function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "images" / "picture.png"
    learn = KNNTD.learn
    monkeypatch.setattr(KNNTD, "learn", lambda self, total_timesteps: learn(self, min(total_timesteps, 500)))
    monkeypatch.setattr(sys, "argv", ["value_function.py", str(path)])
    runpy.run_path(str(Path(__file__).parents[1] / "examples" / "value_function.py"), run_name="__main__")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_settings_of_the_user_are_not_changed() -> None:
    before = dict(matplotlib.rcParams)
    plot_learning_curve([1, 2], [1.0, 2.0])
    plot_value_function(make_model([0, 0], [1, 1]), resolution=5)
    assert dict(matplotlib.rcParams) == before


# ------------------------------------------------------------ missing packages


def hide(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    """Simulate that a package is not installed."""
    for name in [package, *(name for name in sys.modules if name.startswith(f"{package}."))]:
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.parametrize(
    "draw",
    [
        lambda model: plot_value_function(model, resolution=3),
        lambda model: plot_learning_curve([1, 2], [0.0, 1.0]),
        lambda model: model.learn(10, callback=ValueMapCallback(folder="maps")),
    ],
    ids=["value function", "learning curve", "map callback"],
)
def test_without_matplotlib_plots_say_what_to_install(
    draw: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model = make_model([0.0, 0.0], [1.0, 1.0])
    hide(monkeypatch, "matplotlib")
    with pytest.raises(ImportError, match=r'matplotlib: pip install "sb3-knntd\[extra\]"'):
        draw(model)
    assert model.num_timesteps == 0


def test_without_pillow_a_video_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, watched = make_model([0.0, 0.0], [1.0, 1.0]), StillEnv([0.0, 0.0], [1.0, 1.0], spaces.Discrete(3))
    watched.render_mode = "rgb_array"
    hide(monkeypatch, "PIL")
    with pytest.raises(ImportError, match=r'Pillow: pip install "sb3-knntd\[extra\]"'):
        model.learn(10, callback=EpisodeVideoCallback(watched, folder=tmp_path))
    assert model.num_timesteps == 0


# ------------------------------------------------------------- points and rollouts


class Corridor(gym.Env[np.ndarray, int]):
    """From 0 to the right by 0.1 a step, or to the left; the episode ends at 1."""

    observation_space = spaces.Box(-1.0, 1.2, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.n_steps = 0.0, 0
        return np.float32([self.x]), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.x = max(self.x + (0.1 if action else -0.1), -1.0)
        self.n_steps += 1
        return np.float32([self.x]), -1.0, self.x >= 1.0, self.n_steps == 30, {}


@pytest.fixture(scope="module")
def corridor_model() -> KNNDyna:
    return KNNDyna(Corridor(), spacing=0.05, simulated_steps=5, seed=0).learn(400)


def test_points_are_drawn_with_the_number_of_actions_that_are_known() -> None:
    model = KNNDyna(DriftEnv(), spacing=0.1, simulated_steps=5, seed=0).learn(150)
    axes = plot_model_points(model, dims=(1, 0))
    (drawn,) = axes.collections
    np.testing.assert_array_equal(np.asarray(drawn.get_offsets()), model.policy.points.numpy()[:, ::-1])
    known = model.learner.planner.known
    assert 0 < known.sum() < known.size
    np.testing.assert_array_equal(np.asarray(drawn.get_array()), known.sum(axis=1))
    (dots,) = axes.lines
    assert len(np.asarray(dots.get_xdata())) == 150
    assert axes.get_title() == f"{len(known)} points, 150 transitions"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("observation[1]", "observation[0]")
    # Another algorithm knows the entries that it has updated.
    grown = KNNTD(DriftEnv(), points="grow", spacing=0.1, seed=0).learn(150)
    (drawn,) = plot_model_points(grown, names=Names(("x", "v"), ("l", "n", "r"))).collections
    np.testing.assert_array_equal(np.asarray(drawn.get_array()), (grown.policy.q_table != 0).sum(dim=1).numpy())


@pytest.mark.parametrize("dims", [(0, 0), (0, 2), (-1, 0), "xy"])
def test_points_are_drawn_over_two_dimensions(dims: Any) -> None:
    with pytest.raises(ValueError, match="dims must be two different dimensions"):
        plot_model_points(KNNDyna(DriftEnv()), dims)


def test_points_of_states_and_of_one_dimension_are_not_drawn(corridor_model: KNNDyna) -> None:
    for model in (corridor_model, KNNDyna(GridEnv())):
        with pytest.raises(ValueError, match="observations must be a Box of 2 or more dimensions; got"):
            plot_model_points(model)


def test_a_rollout_follows_the_model(corridor_model: KNNDyna) -> None:
    right = roll_out(corridor_model, np.float32([0.0]), np.ones(5, np.int64))
    np.testing.assert_allclose(right.observations[:, 0], np.arange(6) / 10, atol=0.01)
    np.testing.assert_allclose(right.rewards, -1.0, atol=1e-6)
    assert right.known.all()
    left = roll_out(corridor_model, np.float32([0.0]), np.zeros(5, np.int64))
    np.testing.assert_allclose(left.observations[:, 0], -np.arange(6) / 10, atol=0.01)
    # It ends where the episode does.
    long = roll_out(corridor_model, np.float32([0.0]), np.ones(50, np.int64))
    assert 8 <= len(long.rewards) <= 11
    assert len(long.observations) == len(long.rewards) + 1


def test_a_rollout_is_drawn_beside_the_real_episode() -> None:
    model = KNNDyna(PushEnv(), spacing=0.1, simulated_steps=5, seed=0).learn(150)
    env = PushEnv(lengths=[100])
    observations, actions, rewards = [env.reset()[0]], [], []
    for number in range(20):
        actions.append(np.array([np.sin(number)]))
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    expected = roll_out(model, observations[0], np.array(actions))
    places = plot_rollout(model, np.array(observations), np.array(actions), rewards)
    assert [ax.get_ylabel() for ax in places] == ["observation[0]", "observation[1]", "reward"]
    for dim, ax in enumerate(places[:2]):
        lines = lines_of(ax)
        np.testing.assert_array_equal(lines["environment"], (np.arange(21), np.array(observations)[:, dim]))
        n_steps = len(expected.rewards)
        np.testing.assert_array_equal(lines["model"], (np.arange(n_steps + 1), expected.observations[:, dim]))
    lines = lines_of(places[2])
    np.testing.assert_array_equal(lines["environment"], (np.arange(1, 21), rewards))
    np.testing.assert_array_equal(lines["model"], (np.arange(1, n_steps + 1), expected.rewards))
    # Far away nothing is known.
    places = plot_rollout(model, np.array(observations) + 2.0, np.array(actions))
    assert len(places) == 2
    assert lines_of(places[0])["model, not known"][0][0] == 1


def test_a_rollout_that_does_not_fit(corridor_model: KNNDyna) -> None:
    line, ones = np.zeros((6, 1)), np.ones(5, np.int64)
    for arguments, says in (
        ((line[1:], ones), r"observations must have shape \(n_steps \+ 1, 1\), here \(6, 1\)"),
        ((line, ones, [0.0]), r"rewards must have shape \(5,\)"),
        ((line, ones, None, []), "axes must be 1, one for each of observation"),
    ):
        with pytest.raises(ValueError, match=says):
            plot_rollout(corridor_model, *arguments)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="model must be a KNNDyna, which has a model of its environment; got a KNNTD"):
        plot_rollout(make_model([0], [1]), line, ones)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="learned nothing"):
        plot_rollout(KNNDyna(Corridor()), line, ones)


def test_the_greedy_action_between_action_points_is_drawn() -> None:
    model = KNNDyna(PushEnv(), spacing=0.1, simulated_steps=5, seed=0).learn(150)
    grid = value_grid(model, resolution=5)
    across, up = np.meshgrid(*(np.linspace(a, b, 11)[1::2] for a, b in (grid.extent[:2], grid.extent[2:])))
    places = np.stack([across, up], axis=2).reshape(-1, 2)
    np.testing.assert_allclose(grid.actions.reshape(-1, 1), model.predict(places)[0], rtol=1e-6)
    assert not np.isin(grid.actions, [-1.0, 0.0, 1.0]).all()
