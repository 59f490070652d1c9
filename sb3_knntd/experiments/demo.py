"""``sb3-knntd demo``: train, save, load, evaluate, plot."""

from __future__ import annotations

import argparse
import re
import shlex
import signal
import time
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd.common.command_line import INTERRUPTED, CommandError, make_env, positive_int, require, seed_int
from sb3_knntd.common.files import replacing
from sb3_knntd.experiments.baselines.random_agent import RandomPolicy
from sb3_knntd.plots import figure_of, plot_learning_curve, plot_value_function, telling_dims
from sb3_knntd.registry import for_actions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sb3_knntd.common.command_line import Subparsers

EVAL_EPISODES = 100
#: Predicting for several environments at once takes hardly longer than for one.
EVAL_ENVS = 20
#: Step limit for environments without one; otherwise the evaluation of a policy that moves in circles would not end.
EVAL_STEP_LIMIT = 1000
#: Evaluation uses other initial states than training.
EVAL_SEED_OFFSET = 1000


def add_demo(subparsers: Subparsers) -> None:
    """
    :param subparsers: where to add the command
    """
    parser = subparsers.add_parser(
        "demo",
        help="train on an environment and show what was learned",
        description="Train KNNTD, or ExA where actions are continuous, on an environment, save and reload the model, "
        "evaluate it beside a random policy, and draw its learning curve and value function.",
    )
    parser.add_argument("--env", default="MountainCar-v0", metavar="ID", help="gymnasium id (default: %(default)s)")
    parser.add_argument(
        "--steps", type=positive_int, default=50_000, metavar="N", help="environment steps (default: %(default)s)"
    )
    parser.add_argument("--seed", type=seed_int, default=0, metavar="N", help="random seed (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for all files (default: %(default)s)"
    )
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    require("tqdm", "rich", "tensorboard", "matplotlib")
    return 0 if demo(args.env, args.steps, args.seed, args.out) else INTERRUPTED


class StopOnInterrupt:
    """
    A callback for ``learn``, and its context manager: Ctrl-C stops training after the current step, so that the table
    is consistent and the progress bar is closed. A second Ctrl-C raises KeyboardInterrupt as usual.
    """

    def __init__(self) -> None:
        self.interrupted = False

    def __enter__(self) -> StopOnInterrupt:
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *exception: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _interrupt(self, signal_number: int, frame: FrameType | None) -> None:
        self.interrupted = True
        signal.signal(signal.SIGINT, self._previous)

    def __call__(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> bool:
        return not self.interrupted


def demo(env_id: str, steps: int, seed: int, out: Path) -> bool:
    """
    Train KNNTD, or ExA for continuous actions, save and load the model, compare it with a random policy, draw plots,
    and print the results.

    :param env_id: gymnasium id
    :param steps: number of environment steps to train for
    :param seed: seed of training; evaluation derives its own from it
    :param out: output folder
    :return: True if everything was done; False after Ctrl-C during training, when only the model is saved
    :raises CommandError: if there is no such environment, neither algorithm supports its spaces, or ``out`` cannot be
        written to
    """
    env = make_env(env_id)
    algorithm = for_actions(env.action_space).load()
    name = algorithm.__name__
    try:
        # Check the environment before any file of an earlier demo is overwritten.
        algorithm(env)
    except ValueError as error:
        raise CommandError(str(error)) from error
    # File names contain the environment, so that demos of several environments can share a folder.
    stem = f"{name.lower()}_{re.sub(r'[^A-Za-z0-9._-]', '_', env_id)}"
    files = {"model": out / f"{stem}.zip", "episodes": out / f"{stem}.monitor.csv"}
    try:
        out.mkdir(parents=True, exist_ok=True)
        monitored = Monitor(env, str(files["episodes"]))
    except OSError as error:
        raise CommandError(f"cannot write to {out}: {error}") from error
    model = algorithm(monitored, seed=seed, tensorboard_log=str(out / "tensorboard"))

    print(f"Training {name} on {env_id} for {steps:,} steps")
    start = time.perf_counter()
    with StopOnInterrupt() as stop:
        model.learn(steps, callback=stop, progress_bar=True)
    seconds = time.perf_counter() - start
    model.save(files["model"])
    monitored.close()
    files["TensorBoard log"] = Path(model.logger.get_dir() or out)
    if stop.interrupted:
        print(f"Interrupted after {model.num_timesteps:,} of {steps:,} steps. The model was saved.")
        _print_files(files)
        return False
    print(f"Trained in {seconds:.1f} s. Evaluating the saved model over {EVAL_EPISODES} episodes.")

    step_limit = None if env.spec is not None and env.spec.max_episode_steps else EVAL_STEP_LIMIT
    eval_env = make_vec_env(
        env_id,
        EVAL_ENVS,
        seed=seed + EVAL_SEED_OFFSET,
        env_kwargs={} if step_limit is None else {"max_episode_steps": step_limit},
    )
    loaded = algorithm.load(files["model"], env=eval_env)
    learned = _evaluate(loaded, eval_env)
    eval_env.action_space.seed(seed)
    random = _evaluate(RandomPolicy(eval_env.observation_space, eval_env.action_space), eval_env)
    eval_env.close()
    print()
    _print_returns(f"Return on {env_id}", {name: learned, "random policy": random})
    if step_limit is not None:
        print(f"The environment has no step limit: evaluation episodes were cut at {step_limit:,} steps.")
    for finding in loaded.diagnose():
        print(f"Check {finding}")

    files["learning curve"] = out / f"{stem}_learning_curve.png"
    axes = plot_learning_curve(
        np.cumsum(monitored.get_episode_lengths()), monitored.get_episode_rewards(), baseline=float(random.mean())
    )
    axes.set_xlim(right=steps)
    figure_of(axes).suptitle(f"{name} on {env_id}")
    _save_picture(figure_of(axes), files["learning curve"])
    if isinstance(loaded.observation_space, spaces.Box) and loaded.observation_space.shape[0] >= 2:
        files["value function"] = out / f"{stem}_value_function.png"
        _save_picture(figure_of(plot_value_function(loaded, telling_dims(loaded))[0]), files["value function"])
    print()
    _print_files(files)
    print(f"See the log with: tensorboard --logdir {shlex.quote(str(out / 'tensorboard'))}")
    return True


def _evaluate(policy: PolicyPredictor, env: VecEnv) -> np.ndarray:
    returns, _ = evaluate_policy(policy, env, EVAL_EPISODES, deterministic=True, return_episode_rewards=True)
    return np.asarray(returns)


def _save_picture(figure: Figure, path: Path) -> None:
    with replacing(path) as file:
        figure.savefig(file, format="png")


def _print_returns(title: str, returns: dict[str, np.ndarray]) -> None:
    width = max(map(len, (title, *returns)))
    print(f"{title:<{width}}  {'mean':>10}  {'std':>10}  {'median':>10}")
    for name, values in returns.items():
        print(f"{name:<{width}}  {values.mean():>10.2f}  {values.std():>10.2f}  {np.median(values):>10.2f}")


def _print_files(files: dict[str, Path]) -> None:
    width = max(map(len, files))
    for name, path in files.items():
        print(f"{name:<{width}}  {path}")
