"""RL Zoo's commands with this package's algorithms, as a user runs them."""

from __future__ import annotations

import json
import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
import optuna
import pytest
import yaml
from gymnasium import spaces
from gymnasium.envs.classic_control import MountainCarEnv
from matplotlib import pyplot as plt
from optuna.samplers import BaseSampler, RandomSampler
from sqlalchemy.exc import IntegrityError, OperationalError
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.utils import LinearSchedule
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_knntd import KNNTD, ExA, KNNDyna, registry
from sb3_knntd.cli import main
from sb3_knntd.common import command_line
from sb3_knntd.common.command_line import CommandError
from sb3_knntd.common.schedules import parse_schedule
from sb3_knntd.zoo import experiment, register
from sb3_knntd.zoo.configuration_first import ConfigurationFirst
from sb3_knntd.zoo.schedules import with_schedules
from sb3_knntd.zoo.search_space import OBS_DIM, SearchSpace, attributes, study_values

# SB3 silences the first warning at import, which pytest undoes; the second is RL Zoo's about an unnamed study.
pytestmark = [
    pytest.mark.filterwarnings("ignore:rich is experimental"),
    pytest.mark.filterwarnings("ignore:You passed a remote storage"),
]

ALGORITHMS = {"knntd": KNNTD, "exa": ExA, "knndyna": KNNDyna}


def search_space(algo: str) -> SearchSpace:
    """What a study searches for an algorithm."""
    space = registry.ALGORITHMS[algo].load_search_space()
    assert isinstance(space, SearchSpace)
    return space


ENVS = {"knntd": "MountainCar-v0", "exa": "Pendulum-v1", "knndyna": "Pendulum-v1"}
#: A table that differs from those of the configurations.
TABLES: dict[str, dict[str, Any]] = {
    "knntd": {"points": [8, 7], "n_neighbors": 3},
    "exa": {"points": [5, 4, 3], "n_neighbors": 3},
    "knndyna": {"spacing": 0.3},
}
COMMAND = [sys.executable, "-m", "sb3_knntd.zoo"]
OPTIMIZE = ["--optimize", "-n", "300", "--n-evaluations", "2", "--eval-episodes", "1", "--no-optim-plots"]


def zoo(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


def train(folder: Path, algo: str, env: str, *arguments: object) -> Path:
    """Train and return the folder of the run."""
    before = set(folder.glob(f"{algo}/*"))
    zoo("train", "--algo", algo, "--env", env, "-f", folder, "--seed", 1, "--eval-episodes", 1, *arguments)
    (run,) = set(folder.glob(f"{algo}/*")) - before
    return run


def saved_model(algo: str, run: Path) -> Any:
    (path,) = (path for path in run.glob("*.zip") if not path.name.startswith(("rl_model", "best_model")))
    return ALGORITHMS[algo].load(path)


def tuned(algo: str, env: str) -> dict[str, Any]:
    """The configuration of this package."""
    path = registry.ALGORITHMS[algo].config_path
    assert path is not None
    settings: dict[str, Any] = yaml.safe_load(path.read_text())[env]
    return settings


@pytest.fixture(scope="module", params=ALGORITHMS)
def trained(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The algorithm, and the folder of a run of 600 steps with other points than the configuration's."""
    algo = request.param
    folder = tmp_path_factory.mktemp("logs")
    options = ["-n", 600, "--eval-freq", 300, "--save-freq", 300, "--tensorboard-log", folder / "tb"]
    table = [f"{name}:{value}" for name, value in TABLES[algo].items()]
    return algo, train(folder, algo, ENVS[algo], *options, "--log-interval", 1, "-params", *table)


def test_train_stores_model_checkpoints_evaluations_and_settings(trained: tuple[str, Path]) -> None:
    algo, run = trained
    env = ENVS[algo]
    assert run.name == f"{env}_1"
    files = {"0.monitor.csv", "best_model.zip", "evaluations.npz", "rl_model_300_steps.zip", "rl_model_600_steps.zip"}
    assert files | {f"{env}.zip"} <= {path.name for path in run.iterdir()}
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [300, 600]
    assert load_results(str(run))["l"].sum() == 600
    assert ALGORITHMS[algo].load(run / "rl_model_300_steps.zip").num_timesteps == 300
    model = saved_model(algo, run)
    assert model.num_timesteps == 600
    assert model.device.type == "cpu"
    # The configuration is found by default, and the command line overrides it.
    configured = tuned(algo, env)
    assert len(configured["policy"]) > 0
    for name in configured.keys() & {"gamma", "bandwidth", "trace_decay"}:
        assert getattr(model, name) == configured[name]
    for name, value in TABLES[algo].items():
        assert getattr(model, name) == value


def test_tensorboard_log(trained: tuple[str, Path]) -> None:
    algo, run = trained
    (folder,) = run.parent.parent.glob(f"tb/{ENVS[algo]}/*")
    assert folder.name == f"{ALGORITHMS[algo].__name__}_1"
    log = EventAccumulator(str(folder)).Reload()
    error = "train/model_error" if algo == "knndyna" else "train/td_error"
    for key in ("rollout/ep_rew_mean", "eval/mean_reward", error):
        assert np.isfinite([scalar.value for scalar in log.Scalars(key)]).all()
    assert [scalar.step for scalar in log.Scalars("eval/mean_reward")] == [300, 600]


def test_enjoy_plays_the_saved_model(trained: tuple[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    algo, run = trained
    env = ENVS[algo]
    zoo("enjoy", "--algo", algo, "--env", env, "-f", run.parent.parent, "--no-render", "-n", 200, "--seed", 7)
    model, venv = saved_model(algo, run), make_vec_env(env, seed=7)
    observation, episode_return, done = venv.reset(), 0.0, [False]
    while not done[0]:
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, done, _ = venv.step(action)
        episode_return += reward[0]
    assert f"Episode Reward: {episode_return:.2f}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "file"),
    [
        (["--load-best"], "best_model.zip"),
        (["--load-checkpoint", 300], "rl_model_300_steps.zip"),
        (["--load-last-checkpoint", "--stochastic", "--n-envs", 1, "-P"], "rl_model_600_steps.zip"),
    ],
)
def test_enjoy_loads_what_is_asked_for(
    trained: tuple[str, Path], options: list[object], file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    algo, run = trained
    zoo("enjoy", "--algo", algo, "--env", ENVS[algo], "-f", run.parent.parent, "--no-render", "-n", 5, *options)
    assert f"Loading {run / file}" in capsys.readouterr().out


def test_a_seed_given_to_load_determines_exploration(trained: tuple[str, Path]) -> None:
    algo, run = trained
    if algo == "knndyna":
        pytest.skip("KNNDyna predicts greedily")
    observation = make_vec_env(ENVS[algo], seed=0).reset()

    def explored(seed: int | None) -> list[list[float]]:
        model = ALGORITHMS[algo].load(run / "rl_model_300_steps.zip", seed=seed)
        model.exploration_rate = 1.0
        return [model.predict(observation)[0].tolist() for _ in range(30)]

    assert explored(1) == explored(1)
    assert explored(1) != explored(2)
    assert explored(None) == explored(None)


def test_training_continues_from_a_saved_model(trained: tuple[str, Path], tmp_path: Path) -> None:
    algo, run = trained
    env = ENVS[algo]
    agent = run / f"{env}.zip"
    before = saved_model(algo, run)
    if algo == "knndyna":
        # It goes on from the transitions that it knows.
        again = saved_model(algo, train(tmp_path, algo, env, "-n", 100, "--eval-freq", -1, "-i", agent))
        assert (again.num_timesteps, again.learner.planner.n_transitions) == (100, 700)
        assert again.spacing == TABLES[algo]["spacing"]
        return
    frozen = train(tmp_path, algo, env, "-n", 300, "--eval-freq", -1, "-i", agent, "-params", "learning_rate:0.0")
    after = saved_model(algo, frozen)
    assert after.num_timesteps == 300
    # The points of the saved model, not those of the configuration.
    assert after.policy.points.shape == before.policy.points.shape
    np.testing.assert_array_equal(after.policy.q_table, before.policy.q_table)
    learned = train(tmp_path, algo, env, "-n", 300, "--eval-freq", -1, "-i", agent)
    assert not np.array_equal(saved_model(algo, learned).policy.q_table, before.policy.q_table)


@pytest.mark.parametrize(("name", "value"), [("points", 4), ("n_neighbors", 2), ("spacing", 0.5)])
def test_training_cannot_continue_with_another_table(
    trained: tuple[str, Path], name: str, value: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    algo, run = trained
    with pytest.raises(SystemExit, match="2"):
        train(tmp_path, algo, ENVS[algo], "-n", 300, "-i", run / f"{ENVS[algo]}.zip", "-params", f"{name}:{value}")
    assert f"{name} cannot be given with -i" in capsys.readouterr().err


def test_record_video(trained: tuple[str, Path], tmp_path: Path) -> None:
    algo, run = trained
    zoo("record_video", "--algo", algo, "--env", ENVS[algo], "-f", run.parent.parent, "-o", tmp_path, "-n", 3)
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 0


def test_progress_bar(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    train(tmp_path, "knntd", "MountainCar-v0", "-n", 300, "--eval-freq", -1, "-P")
    assert "300/300" in capfd.readouterr().out


def test_an_environment_without_configuration_gets_the_defaults(tmp_path: Path) -> None:
    model = saved_model("knntd", train(tmp_path, "knntd", "FrozenLake8x8-v1", "-n", 100, "--eval-freq", -1))
    fresh = KNNTD("FrozenLake8x8-v1")
    for name in ("points", "n_neighbors", "gamma", "trace_decay", "exploration_initial_eps"):
        assert getattr(model, name) == getattr(fresh, name)
    assert model.lr_schedule(0.5) == fresh.lr_schedule(0.5)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_conf_file(algo: str, tmp_path: Path) -> None:
    table = "spacing" if algo == "knndyna" else "points"
    settings = {
        "n_timesteps": 400,
        "policy": "KNNPolicy",
        "n_envs": 2,
        "normalize": True,
        "env_wrapper": [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 20}}],
        "callback": {"stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes": {"max_episodes": 4}},
        "policy_kwargs": "dict(dtype=th.float32)",
        "learning_rate": "lin_0.8",
        "trace_decay": "lin_0.5_0.9",
        table: 1,
    }
    conf = tmp_path / "mine.yml"
    conf.write_text(yaml.dump({ENVS[algo]: settings}))
    run = train(tmp_path / "logs", algo, ENVS[algo], "-conf", conf, "--eval-freq", -1, "-params", "gamma:0.5")
    model = saved_model(algo, run)
    assert (model.num_timesteps, model.n_envs, model.gamma) == (4 * 20 * 2, 2, 0.5)
    assert str(model.policy.q_table.dtype) == "torch.float32"
    assert [model.lr_schedule(progress) for progress in (1.0, 0.5, 0.0)] == pytest.approx([0.8, 0.4, 0.0])
    assert [model.trace_schedule(progress) for progress in (1.0, 0.5, 0.0)] == pytest.approx([0.5, 0.7, 0.9])
    assert (run / ENVS[algo] / "vecnormalize.pkl").is_file()
    zoo("enjoy", "--algo", algo, "--env", ENVS[algo], "-f", tmp_path / "logs", "--no-render", "-n", 5)

    python = tmp_path / "mine.py"
    python.write_text(f"hyperparams = {{{ENVS[algo]!r}: dict(n_timesteps=40, policy='KNNPolicy', {table}=3)}}")
    run = train(tmp_path / "logs", algo, ENVS[algo], "--conf-file", python, "--eval-freq", -1)
    assert getattr(saved_model(algo, run), table) == 3


def test_environments_in_processes(tmp_path: Path) -> None:
    options = ["-n", "400", "--vec-env", "subproc", "-params", "n_envs:2", "--eval-freq", "-1", "--seed", "1"]
    env = "sb3_knntd/ContinuousCartPole-v0"
    subprocess.run([*COMMAND, "train", "--algo", "exa", "--env", env, *options], cwd=tmp_path, check=True)
    model = saved_model("exa", tmp_path / "logs" / "exa" / "sb3_knntd-ContinuousCartPole-v0_1")
    assert (model.num_timesteps, model.n_envs) == (400, 2)


def test_environments_of_this_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env, name = "sb3_knntd/MountainCar-v0", "sb3_knntd-MountainCar-v0"
    run = train(tmp_path, "knntd", env, "-n", 3000, "--eval-freq", 1500, "--eval-episodes", 2)
    assert run.name == f"{name}_1"
    zoo("enjoy", "--algo", "knntd", "--env", env, "-f", tmp_path, "--no-render", "-n", 5)

    # RL Zoo's plots find runs by folder names, and set a style at import.
    shown: list[Any] = []
    monkeypatch.setattr(plt, "show", lambda: shown.extend(plt.gca().get_lines()))
    with matplotlib.rc_context():
        zoo("plot_train", "-a", "knntd", "-e", env, "-f", tmp_path, "-w", 1)
        results = tmp_path / "results"
        zoo("all_plots", "-a", "knntd", "-e", env, "-f", tmp_path, "-o", results, "--no-display")
        plt.close("all")
    (line,) = shown
    assert len(line.get_xdata()) == len(load_results(str(run))) > 0
    with open(f"{results}.pkl", "rb") as file:
        ((label, result),) = pickle.load(file)[name].items()
    assert label.startswith("KNNTD")
    assert result["timesteps"].tolist() == [1500, 3000]


def test_algorithms_of_rl_zoo_still_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = train(tmp_path, "dqn", "CartPole-v1", "-n", 100, "--eval-freq", -1)
    assert re.search(r"rl_zoo3.hyperparams.dqn\.yml", capsys.readouterr().out)
    assert DQN.load(run / "CartPole-v1.zip").num_timesteps >= 100


# ------------------------------------------------------------------ schedules


def test_schedules_as_strings() -> None:
    falling = parse_schedule("learning_rate", "lin_0.5")
    assert [falling(progress) for progress in (1.0, 0.5, 0.0)] == pytest.approx([0.5, 0.25, 0.0])
    rising = parse_schedule("trace_decay", "lin_0.8_0.9")
    assert [rising(progress) for progress in (1.0, 0.5, 0.0)] == pytest.approx([0.8, 0.85, 0.9])
    given = {"learning_rate": 0.3, "temperature": "lin_1e-01", "points": "auto"}
    read = with_schedules(given)
    assert (read["learning_rate"], read["points"]) == (0.3, "auto")
    assert isinstance(read["temperature"], LinearSchedule)
    assert given["temperature"] == "lin_1e-01"


@pytest.mark.parametrize("word", ["cos_0.5", "lin", "lin_", "lin_x", "lin_0.5_0.1_3", "0.5", ""])
def test_a_string_that_is_not_a_schedule(word: str) -> None:
    with pytest.raises(ValueError, match=f"trace_decay must be a number, 'lin_START'.*got {word!r}"):
        with_schedules({"trace_decay": word})


# --------------------------------------------------------------- optimisation


def make_env(algo: str, obs_dim: int) -> gym.Env[Any, Any]:
    """An environment for building a model, never stepped."""
    env = gym.Env[Any, Any]()
    box = spaces.Box(-1.0, 1.0, (obs_dim,), np.float32)
    env.observation_space = box if obs_dim else spaces.Discrete(5)
    env.action_space = spaces.Discrete(3) if algo == "knntd" else spaces.Box(-1.0, 1.0, (2,), np.float32)
    return env


def with_attributes(trial: Any, obs_dim: int, configuration: dict[str, Any]) -> Any:
    for name, value in attributes(obs_dim, configuration).items():
        trial.set_user_attr(name, value)
    return trial


def asked(obs_dim: int, configuration: dict[str, Any], sampler: BaseSampler | None = None) -> Any:
    """The first trial of a study."""
    study = optuna.create_study(sampler=sampler or RandomSampler(seed=0))
    return with_attributes(study.ask(), obs_dim, configuration)


def ends(distribution: Any) -> tuple[Any, Any]:
    choices = getattr(distribution, "choices", None)
    return (choices[0], choices[-1]) if choices else (distribution.low, distribution.high)


@pytest.mark.parametrize("algo", ["knntd", "exa"])
@pytest.mark.parametrize("obs_dim", [0, 1, 2, 4, 6, 17])
def test_search_space(algo: str, obs_dim: int) -> None:
    trial = asked(obs_dim, {})
    search_space(algo).sample(trial, 0, 1, {})
    assert ("points_per_dimension" in trial.params) == (obs_dim > 0)
    # The corners of the search space, and random samples.
    distributions = trial.distributions.items()
    for params in (trial.params, *({name: ends(d)[end] for name, d in distributions} for end in (0, 1))):
        arguments = search_space(algo).sample(with_attributes(optuna.trial.FixedTrial(params), obs_dim, {}), 0, 1, {})
        converted = search_space(algo).convert(json.loads(json.dumps(params)))
        assert json.loads(json.dumps(converted)) == converted
        assert arguments.keys() == converted.keys()
        assert all(callable(value) or converted[name] == value for name, value in arguments.items())
        model = ALGORITHMS[algo](env=make_env(algo, obs_dim), **arguments)
        for name, value in arguments.items():
            assert getattr(model, name) == value
        assert model.lr_schedule(1.0) == params["initial_learning_rate"]
        final = params["initial_learning_rate"] * params["final_learning_rate_share"]
        assert model.lr_schedule(0.0) == pytest.approx(final, rel=0.01)
        if obs_dim:
            spacing = 2 / (params["points_per_dimension"] - 1)
            assert model.bandwidth == pytest.approx(params["bandwidth_in_spacings"] * spacing)
            assert model.policy.perceiver.points.n_points <= max(30_000, 3**obs_dim)


@pytest.mark.parametrize("n_actions", [0, 2])
@pytest.mark.parametrize("obs_dim", [0, 4])
def test_search_space_of_dyna(obs_dim: int, n_actions: int) -> None:
    space, env = search_space("knndyna"), make_env("exa" if n_actions else "knntd", obs_dim)
    trial = asked(obs_dim, {})
    space.sample(trial, n_actions, 1, {})
    assert ("spacing" in trial.params, "action_points" in trial.params) == (obs_dim > 0, n_actions > 0)
    distributions = trial.distributions.items()
    for params in (trial.params, *({name: ends(d)[end] for name, d in distributions} for end in (0, 1))):
        fixed = with_attributes(optuna.trial.FixedTrial(params), obs_dim, {})
        arguments = space.sample(fixed, n_actions, 1, {})
        assert arguments == json.loads(json.dumps(space.convert(params)))
        model = KNNDyna(env=env, **arguments)
        for name, value in arguments.items():
            assert getattr(model, name) == value
    # What a configuration gives in detail is kept.
    given = {"spacing": 0.1, "action_points": [[-1.0, 1.0]] * 2}
    assert not given.keys() & space.sample(asked(obs_dim, given), n_actions, 1, {}).keys()


@pytest.mark.parametrize("algo", ["knntd", "exa"])
@pytest.mark.parametrize(("points", "most_neighbors"), [([4, 6], 16), ([2, 3], 6), ([[0.0, 0.0], [1.0, 1.0]], 2)])
def test_a_study_keeps_the_points_of_each_dimension(algo: str, points: list[Any], most_neighbors: int) -> None:
    configuration = {"points": points, "action_points": [[-1.0, 1.0], [-1.0, 0.0, 1.0]]}
    trial = asked(2, configuration)
    arguments = search_space(algo).sample(trial, 0, 1, {})
    assert not {"points", "action_points"} & arguments.keys()
    assert trial.distributions["n_neighbors"].high == most_neighbors
    assert arguments["bandwidth"] == trial.params["bandwidth"]
    # One number for all dimensions is no such knowledge.
    assert {"points"} < search_space(algo).sample(asked(2, {"points": 5, "action_points": 3}), 0, 1, {}).keys()


@pytest.mark.parametrize(
    ("algo", "given"),
    [
        ("knntd", {}),
        ("knntd", {"points": [5, 6]}),
        ("exa", {}),
        ("exa", {"points": [5, 6]}),
        ("knndyna", {}),
        ("knndyna", {"spacing": 0.11}),
    ],
)
def test_the_first_trial_is_the_configurations(algo: str, given: dict[str, Any]) -> None:
    configuration = given | search_space(algo).sample(asked(2, given), 0, 1, {})
    first = ConfigurationFirst(RandomSampler(seed=1), study_values(ALGORITHMS[algo], configuration))
    arguments = given | search_space(algo).sample(asked(2, given, first), 0, 1, {})
    assert arguments.keys() == configuration.keys()
    for name, value in arguments.items():
        if isinstance(value, LinearSchedule):
            given_schedule = configuration[name]
            assert (value.start, value.end) == pytest.approx((given_schedule.start, given_schedule.end), rel=0.01)
        else:
            number = isinstance(value, float)
            assert value == (pytest.approx(configuration[name]) if number else configuration[name]), name


def test_the_first_trial_where_the_configuration_is_not_in_the_search_space() -> None:
    settings = {"learning_rate": 0.4, "gamma": 1.0, "exploration_initial_eps": 0.0, "exploration": "unheard-of"}
    study = optuna.create_study(sampler=ConfigurationFirst(RandomSampler(seed=0), study_values(KNNTD, settings)))
    first, second = (with_attributes(study.ask(), 2, settings) for _ in range(2))
    for trial in (first, second):
        search_space("knntd").sample(trial, 0, 1, {})
    assert (first.params["initial_learning_rate"], first.params["final_learning_rate_share"]) == (0.4, 1.0)
    assert (first.params["one_minus_gamma"], first.params["exploration_initial_eps"]) == (0.0001, 0.001)
    assert (first.params["target"], first.params["exploration_fraction"]) == ("sarsa", 0.5)
    assert first.params.keys() == second.params.keys()
    assert second.params["initial_learning_rate"] != 0.4


def test_optimize_exa_and_train_with_a_trial(tmp_path: Path) -> None:
    storage = tmp_path / "studies" / "exa.log"
    study_options = ["--storage", storage, "--study-name", "pendulum"]
    zoo("train", "--algo", "exa", "--env", "Pendulum-v1", "-f", tmp_path, *OPTIMIZE, "--n-trials", 2, *study_options)
    backend = optuna.storages.journal.JournalFileBackend(str(storage))
    study = optuna.load_study(study_name="pendulum", storage=optuna.storages.JournalStorage(backend))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "COMPLETE"]
    assert all(trial.value is not None and -2000 < trial.value < 0 for trial in study.trials)
    trial = study.trials[1]
    assert trial.user_attrs[OBS_DIM] == 3
    settings = tuned("exa", "Pendulum-v1")
    assert study.trials[0].params["initial_value_size"] == abs(settings["initial_value"])
    assert study.trials[0].params["bandwidth"] == settings["bandwidth"]
    options = ["-n", 100, "--eval-freq", -1, *study_options, "--trial-id", 1]
    (report,) = (tmp_path / "exa").glob("report_*.csv")
    assert report.is_file()
    model = saved_model("exa", train(tmp_path / "best", "exa", "Pendulum-v1", *options))
    assert model.points == settings["points"]
    assert model.bandwidth == trial.params["bandwidth"]
    assert model.gamma == 1 - trial.params["one_minus_gamma"] == trial.user_attrs["gamma"]
    assert model.lr_schedule(1.0) == trial.params["initial_learning_rate"]


def test_optimize_dyna(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    zoo("train", "--algo", "knndyna", "--env", "Pendulum-v1", "-f", tmp_path, *OPTIMIZE, "--n-trials", 2)
    assert "Number of finished trials:  2" in capsys.readouterr().out


def test_optimize_finite_states_with_other_sampler_and_pruner(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--sampler", "random", "--pruner", "halving", "--n-trials", 2, "--n-jobs", 2]
    zoo("train", "--algo", "knntd", "--env", "FrozenLake-v1", "-f", tmp_path, *OPTIMIZE, *options)
    assert "Number of finished trials:  2" in capsys.readouterr().out


def test_a_trial_that_diverges_does_not_end_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learn, calls = KNNTD.learn, iter(range(2))

    def diverging_at_first(model: KNNTD, *arguments: Any, **options: Any) -> KNNTD:
        if next(calls) == 0:
            raise FloatingPointError("the action values have diverged")
        return learn(model, *arguments, **options)

    monkeypatch.setattr(KNNTD, "learn", diverging_at_first)
    storage = tmp_path / "study.log"
    options = ["--n-trials", 2, "--storage", storage, "--study-name", "diverging"]
    zoo("train", "--algo", "knntd", "--env", "MountainCar-v0", "-f", tmp_path, *OPTIMIZE, *options)
    backend = optuna.storages.journal.JournalFileBackend(str(storage))
    study = optuna.load_study(study_name="diverging", storage=optuna.storages.JournalStorage(backend))
    assert [trial.state.name for trial in study.trials] == ["PRUNED", "COMPLETE"]


def test_two_processes_on_one_study(tmp_path: Path) -> None:
    options = ["--storage", "study.log", "--study-name", "two", "--n-trials", "2", "--n-startup-trials", "1"]
    command = [*COMMAND, "train", "--algo", "knntd", "--env", "MountainCar-v0", *OPTIMIZE, *options]
    workers = [
        subprocess.Popen(
            [*command, "--seed", str(seed)], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        for seed in (1, 2)
    ]
    said = [worker.communicate(timeout=300)[0] for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0], said
    tried = [set(re.findall(r"Trial (\d+) (?:finished|pruned)", text)) for text in said]
    assert [len(trials) for trials in tried] == [2, 2]
    assert tried[0] | tried[1] == {"0", "1", "2", "3"}
    backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / "study.log"))
    study = optuna.load_study(study_name="two", storage=optuna.storages.JournalStorage(backend))
    assert [trial.number for trial in study.trials] == [0, 1, 2, 3]
    assert all(trial.state.is_finished() for trial in study.trials)


def test_a_database_whose_tables_another_worker_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment, "DATABASE_PAUSE", 0.0)
    made = optuna.storages.RDBStorage
    failures = iter([IntegrityError("CREATE TYPE", None, Exception("exists already"))])

    def make(url: str) -> Any:
        for failure in failures:
            raise failure
        return made(url)

    monkeypatch.setattr(optuna.storages, "RDBStorage", make)
    url = f"sqlite:///{tmp_path}/study.db"
    experiment.make_tables(url)
    assert optuna.get_all_study_names(url) == []
    with pytest.raises(OperationalError):
        experiment.make_tables(f"sqlite:///{tmp_path}/missing/study.db")


# ------------------------------------------------------------- the command line


def test_help_is_rl_zoos(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["train", "--help"])
    assert stopped.value.code == 0
    assert "--eval-freq" in capsys.readouterr().out


def test_unknown_algorithm(capsys: pytest.CaptureFixture[str]) -> None:
    argv = list(sys.argv)
    with pytest.raises(SystemExit) as stopped:
        main(["train", "--algo", "qlearning"])
    assert stopped.value.code == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("sb3-knntd train: error: argument --algo: invalid choice: 'qlearning'")
    assert "knntd" in error
    assert "exa" in error
    assert sys.argv == argv


#: Invalid arguments of ``train``, and the part of the message that names the error.
MISTAKES: dict[str, tuple[list[str], str]] = {
    "environment": (["--env", "sb3_knntd/MountainCar-v"], "you maybe meant sb3_knntd/MountainCar-v0?"),
    "spaces": (["--env", "Pendulum-v1"], "KNNTD takes actions in a Discrete space"),
    "algorithm": (["--algo", "qlearning"], "argument --algo: invalid choice: 'qlearning'"),
    "unknown argument": (["--episodes", "5"], "unrecognized arguments: --episodes 5"),
    "a word for a number": (["-n", "many"], "argument -n/--n-timesteps: invalid int value: 'many'"),
    "unknown parameter": (["-params", "nosuch:1"], "unexpected keyword argument 'nosuch'"),
    "value of a parameter": (["-params", "gamma:2"], "gamma must be a finite number in [0, 1]; got 2"),
    "parameter without a value": (["-params", "gamma"], "argument -params/--hyperparams: must be NAME:VALUE"),
    "parameter that is no Python": (["-params", "weights:gaussian"], "got weights:gaussian: name 'gaussian' is not"),
    "schedule": (["-params", "learning_rate:'cos_0.5'"], "learning_rate must be a number, 'lin_START'"),
    "size": (["-params", "points:[10**9,10**9]"], "29.8 GiB"),
    "environment's arguments": (["--env-kwargs", "nosuch:1"], "unexpected keyword argument 'nosuch'"),
    "missing file": (["--conf-file", "missing.yml"], "No such file or directory: 'missing.yml'"),
    "file that is no YAML": (["--conf-file", "broken.yml"], "ParserError"),
    "file without the entry": (["--conf-file", "other.yml"], "Hyperparameters not found for knntd-MountainCar-v0"),
    "file of something else": (["--conf-file", "list.yml"], "'list' object has no attribute"),
    "missing model": (["-i", "missing.zip"], "trained_agent must be a valid path"),
    "model that is none": (["-i", "broken.zip"], "broken.zip is no saved model"),
    "module": (["--gym-packages", "no_such_module"], "No module named 'no_such_module'"),
    "device": (["--device", "abacus"], "device must be 'cpu'"),
    "seed": (["--seed", str(2**40)], "Seed must be between"),
    "folder": (["-f", "broken.yml"], "Not a directory"),
    "log": (["-tb", "broken.yml"], "Not a directory"),
    "trials": (["--optimize", "--n-trials", "0", "--no-optim-plots"], "No trials are completed yet"),
    "storage": (["--optimize", "--storage", "nosuch://x", "--study-name", "s"], "nosuch"),
    "parameter of a study": (["--optimize", "--n-trials", "1", "-params", "nosuch:1"], "keyword argument 'nosuch'"),
}


@pytest.fixture
def mistaken_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, content in {
        "broken.yml": "a: [1, 2\nb: }",
        "other.yml": "CartPole-v1: {gamma: 0.9}",
        "list.yml": "[1]",
    }.items():
        (tmp_path / name).write_text(content)
    (tmp_path / "broken.zip").write_text("hello")


def line_of(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must be refused; return the single line on standard error."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(argv)
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert error.startswith(f"sb3-knntd {argv[0]}: error: ")
    return error


@pytest.mark.usefixtures("mistaken_files")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_argument_is_one_line(mistake: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, says = MISTAKES[mistake]
    argv = ["train", "--algo", "knntd", "--env", "MountainCar-v0", "-n", "30", "-f", "logs", "--eval-freq", "-1"]
    assert says in line_of([*argv, *arguments], capsys)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["enjoy", "--env", "MountainCar-v0", "-f", "nowhere"], "The nowhere/knntd folder was not found"),
        (["enjoy", "--env", "MountainCar-v0", "--gym-packages", "no_such_module"], "No module named 'no_such_module'"),
        (["enjoy", "--env-kwargs", "goal"], "argument --env-kwargs: must be NAME:VALUE"),
        (["record_video", "--env", "MountainCar-v0", "-f", "nowhere"], "The nowhere/knntd folder was not found"),
    ],
)
def test_a_wrong_argument_of_enjoy_is_one_line(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert says in line_of([arguments[0], "--algo", "knntd", *arguments[1:]], capsys)


def test_traceback_is_shown_on_demand(tmp_path: Path) -> None:
    arguments = ["--algo", "knntd", "--env", "MountainCar-v0", "-f", str(tmp_path), "-params", "gamma:2"]
    with pytest.raises(CommandError, match="gamma") as error:
        main(["--traceback", "train", *arguments])
    assert isinstance(error.value.__cause__, ValueError)


def test_errors_during_training_are_not_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of environments or of this package keep their traceback."""

    def step(env: MountainCarEnv, action: int) -> Any:
        raise ValueError("a fault of the environment")

    monkeypatch.setattr(MountainCarEnv, "step", step)
    with pytest.raises(ValueError, match="a fault of the environment"):
        train(tmp_path, "knntd", "MountainCar-v0", "-n", 30, "--eval-freq", -1)


def test_diverging_values_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def learn(model: KNNTD, *arguments: Any, **options: Any) -> KNNTD:
        raise FloatingPointError("the action values have diverged: give a smaller learning_rate")

    monkeypatch.setattr(KNNTD, "learn", learn)
    argv = ["train", "--algo", "knntd", "--env", "MountainCar-v0", "-f", str(tmp_path)]
    assert "the action values have diverged" in line_of(argv, capsys)


def test_module_lists_its_commands() -> None:
    help_text = subprocess.run([*COMMAND, "--help"], capture_output=True, text=True, check=True).stdout
    for command in ("train", "enjoy", "record_video", "plot_train", "plot_from_file", "all_plots"):
        assert re.search(rf"^    {command}\b", help_text, re.MULTILINE)


def test_without_rl_zoo(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    found = command_line.find_spec
    monkeypatch.setattr(command_line, "find_spec", lambda name: None if name == "rl_zoo3" else found(name))
    with pytest.raises(SystemExit) as stopped:
        main(["train", "--algo", "knntd"])
    assert stopped.value.code == 2
    error = 'sb3-knntd train: error: rl_zoo3 not installed: pip install "sb3-knntd[zoo]"\n'
    assert capsys.readouterr().err == error


def test_other_commands_do_not_wait_for_rl_zoo() -> None:
    program = "import sys, sb3_knntd.zoo, sb3_knntd.cli; print('rl_zoo3' in sys.modules, 'optuna' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_register_adds_them_to_rl_zoo() -> None:
    import rl_zoo3.train

    register()
    register()
    assert rl_zoo3.train.ALGOS["knntd"] is rl_zoo3.ALGOS["knntd"] is KNNTD
    assert rl_zoo3.ALGOS["exa"] is ExA
