"""Checkpoints that survive a crash, and training that continues from them."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import tempfile
import zipfile
from inspect import signature
from pathlib import Path
from typing import Any, ClassVar

from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.common.checks import check_flag, check_integer, check_name, check_path
from sb3_knntd.common.files import read_description, replacing, sweep
from sb3_knntd.common.plain import class_name, loaded_class

from .throttled import ThrottledCallback

#: Member of a checkpoint that holds the names of the classes and the mean return.
NOTES = "checkpoint.json"
#: The same in checkpoints of earlier versions.
OLD_NOTES = "checkpoint.pkl"
#: Maximum size of this member, bytes; a few hundred are usual.
LARGEST_NOTES = 2**20
WRAPPER = "vec_env_wrapper_{}.pkl"


class TableCheckpointCallback(ThrottledCallback):
    """
    Saves the model every ``save_freq`` calls and at the end of training, together with the statistics of VecNormalize
    and of any other VecEnvWrapper with the same methods ``save`` and ``load``. The last checkpoints and the best one
    are kept: ``{name_prefix}_{steps}_steps.zip`` and ``{name_prefix}_best.zip``. The best checkpoint is the one with
    the highest mean return of the last training episodes (``rollout/ep_rew_mean``, over ``stats_window_size``
    episodes) when it was saved; for the best model in evaluations use SB3's EvalCallback.

    Each checkpoint is one file that is written atomically: even if the process or the machine stops, the newest
    checkpoint is complete. ``KNNTD.load`` can load it as well.

    .. code-block:: python

        model.learn(1_000_000, callback=TableCheckpointCallback("checkpoints"))

        # after a crash
        model = TableCheckpointCallback.resume("checkpoints", env)
        callback = TableCheckpointCallback("checkpoints")
        model.learn(1_000_000 - model.num_timesteps, callback=callback, reset_num_timesteps=False)

    :param save_path: folder
    :param save_freq: save every ``save_freq`` calls (of n_envs steps each); ``None``: as often as takes 0.1 % of the
        time, about once in half a minute with a small table
    :param n_last: number of last checkpoints to keep, >= 1
    :param save_best: whether to keep the best checkpoint
    :param name_prefix: prefix of the file names
    :param verbose: 1 to print a line for each written file
    :raises ValueError: if an argument is invalid; when training begins, if the folder holds checkpoints of later steps,
        which belong to another run
    """

    FIRST_SECONDS: ClassVar[float] = 0.05

    def __init__(
        self,
        save_path: str | Path,
        save_freq: int | None = None,
        n_last: int = 3,
        save_best: bool = True,
        name_prefix: str = "checkpoint",
        verbose: int = 0,
    ) -> None:
        super().__init__("save_freq", save_freq, verbose)
        self.save_path = check_path("save_path", save_path)
        self.n_last = check_integer("n_last", n_last, 1)
        self.save_best = check_flag("save_best", save_best)
        self.name_prefix = check_name("name_prefix", name_prefix)
        #: mean return of the best checkpoint so far, ``None`` if there is none
        self.best_mean_reward: float | None = None

    @property
    def best_path(self) -> Path:
        """Path of the best checkpoint."""
        return self.save_path / f"{self.name_prefix}_best.zip"

    def _init_callback(self) -> None:
        self.save_path.mkdir(parents=True, exist_ok=True)
        # Remove temporary files now: the next best checkpoint may be written much later.
        sweep(self.best_path)

    def _on_training_start(self) -> None:
        steps = _steps_of(self.save_path, self.name_prefix)
        if steps and max(steps) > self.num_timesteps:
            raise ValueError(
                f"save_path: {self.save_path} holds a checkpoint of step {max(steps)}, and this run is at step "
                f"{self.num_timesteps}. To go on from it call TableCheckpointCallback.resume({str(self.save_path)!r}, "
                "env) and learn(..., reset_num_timesteps=False); for a new run give another folder or name_prefix"
            )
        if self.save_best and self.best_path.exists():
            self.best_mean_reward = _read_notes(self.best_path)["mean_reward"]
        super()._on_training_start()

    def _act(self) -> None:
        path = _path_of(self.save_path, self.name_prefix, self.num_timesteps)
        episodes = self.model.ep_info_buffer
        mean_reward = float(safe_mean([episode["r"] for episode in episodes])) if episodes else None
        with replacing(path) as file:
            _save(file, self.model, mean_reward)
        best = self.best_mean_reward
        if self.save_best and mean_reward is not None and (best is None or mean_reward > best):
            with open(path, "rb") as saved, replacing(self.best_path) as file:
                shutil.copyfileobj(saved, file)
            self.best_mean_reward = mean_reward
        for step in _steps_of(self.save_path, self.name_prefix)[: -self.n_last]:
            _path_of(self.save_path, self.name_prefix, step).unlink()
        if self.verbose >= 1:
            print(f"Checkpoint written to {path}")

    @staticmethod
    def resume(
        path: str | Path,
        env: GymEnv | str,
        name_prefix: str = "checkpoint",
        force_reset: bool = True,
        trusted: bool = True,
        **kwargs: Any,
    ) -> KNNAlgorithm:
        """
        Load the model of the newest checkpoint, with the saved wrappers around its environment. Continue training with
        ``model.learn(remaining_steps, reset_num_timesteps=False)``.

        A saved wrapper replaces the wrapper of the same class around ``env``; if there is none, it is put around
        ``env``. So ``env`` may be wrapped as in the first run, or not wrapped.

        :param path: folder, or a single checkpoint, such as the best one
        :param env: the environment to continue in
        :param name_prefix: prefix of the file names
        :param force_reset: whether to start new episodes. Use ``False`` for an environment that is still in the saved
            state: learning then continues exactly as if it had not been interrupted
        :param trusted: whether to unpickle objects, see :meth:`~sb3_knntd.KNNTD.load`. With ``False``, a VecNormalize,
            which is saved by pickle, cannot be restored; a VecDeltaFilter can
        :param kwargs: other arguments of :meth:`~sb3_knntd.KNNTD.load`
        :return: the model; its environment is ``model.get_env()``
        :raises FileNotFoundError: if there is no checkpoint
        :raises ValueError: if the file is damaged or no checkpoint, the spaces of ``env`` differ, a class of the model
            or of a wrapper has not been imported, or, with ``trusted=False``, an object would have to be unpickled
        """
        file = Path(path)
        if not file.is_file():
            steps = _steps_of(file, name_prefix)
            if not steps:
                raise FileNotFoundError(f"no checkpoint {name_prefix}_*_steps.zip in {file}")
            file = _path_of(file, name_prefix, steps[-1])
        notes = _read_notes(file)
        read_description(file)
        algorithm: type[KNNAlgorithm] = loaded_class(notes["algorithm"], KNNAlgorithm)
        venv = KNNAlgorithm._wrap_env(maybe_make_env(env, verbose=0), verbose=0)
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(file) as archive:
            # From the inside out, since each wrapper is put around the previous ones.
            for index, name in reversed(list(enumerate(notes["wrappers"]))):
                wrapper = loaded_class(name, VecEnvWrapper)
                venv = _rewrap(venv, wrapper, archive.extract(WRAPPER.format(index), folder), trusted)
        return algorithm.load(file, env=venv, force_reset=force_reset, trusted=trusted, **kwargs)


def _path_of(folder: Path, name_prefix: str, step: int) -> Path:
    return folder / f"{name_prefix}_{step}_steps.zip"


def _steps_of(folder: Path, name_prefix: str) -> list[int]:
    """The steps of all checkpoints, ascending."""
    prefix, suffix = f"{name_prefix}_", "_steps.zip"
    names = (path.name for path in folder.glob("*.zip"))
    numbers = (name[len(prefix) : -len(suffix)] for name in names if name.startswith(prefix) and name.endswith(suffix))
    return sorted(int(number) for number in numbers if number.isdecimal())


def _save(file: io.BufferedRandom, model: KNNAlgorithm, mean_reward: float | None) -> None:
    model.save(file)
    wrappers = _saveable_wrappers(model.get_env())
    names = [class_name(type(wrapper)) for wrapper in wrappers]
    notes = {"algorithm": class_name(type(model)), "wrappers": names, "mean_reward": mean_reward}
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(file, "a") as archive:
        archive.writestr(NOTES, json.dumps(notes))
        for index, wrapper in enumerate(wrappers):
            saved = os.path.join(folder, WRAPPER.format(index))
            wrapper.save(saved)
            archive.write(saved, WRAPPER.format(index))


def _saveable_wrappers(venv: VecEnv | None) -> list[Any]:
    """The wrappers that can be saved and loaded like VecNormalize, the outermost first."""
    wrappers = []
    while isinstance(venv, VecEnvWrapper):
        # Check the class: an instance looks up missing attributes in the environment that it wraps.
        if all(callable(getattr(type(venv), name, None)) for name in ("save", "load")):
            wrappers.append(venv)
        venv = venv.venv
    return wrappers


def _rewrap(venv: VecEnv, wrapper: type[Any], saved: str, trusted: bool) -> VecEnv:
    """Load a wrapper in place of the wrapper of the same class, or around all wrappers if there is none."""
    takes_trust = "trusted" in signature(wrapper.load).parameters
    if not (trusted or takes_trust):
        raise ValueError(
            f"a {wrapper.__name__} is saved by pickle, and unpickling executes code from the file. If you trust its "
            "source, pass trusted=True"
        )
    how = {"trusted": trusted} if takes_trust else {}
    around: list[VecEnvWrapper] = []
    inner = venv
    while isinstance(inner, VecEnvWrapper) and type(inner) is not wrapper:
        around.append(inner)
        inner = inner.venv
    if not isinstance(inner, VecEnvWrapper):
        loaded: VecEnv = wrapper.load(saved, venv, **how)
        return loaded
    loaded = wrapper.load(saved, inner.venv, **how)
    if not around:
        return loaded
    around[-1].venv = loaded
    return venv


class _Names(pickle.Unpickler):
    """Unpickles only names and numbers; nothing is imported or called."""

    def find_class(self, module: str, name: str) -> Any:
        """
        :param module: module of a class
        :param name: name of the class
        :return: its full name, in place of the class
        """
        return f"{module}.{name}"


def _read_notes(path: Path) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(path) as archive:
            is_json = NOTES in archive.namelist()
            with archive.open(NOTES if is_json else OLD_NOTES) as file:
                content = file.read(LARGEST_NOTES)
        notes: dict[str, Any] = json.loads(content) if is_json else _Names(io.BytesIO(content)).load()
        mean_reward = notes["mean_reward"]
        if not (mean_reward is None or isinstance(mean_reward, int | float)) or not isinstance(notes["wrappers"], list):
            raise ValueError(f"its notes are {notes!r}")
    # A damaged pickle can raise anything.
    except Exception as error:
        raise ValueError(f"{path} is no checkpoint, or was cut off: {error}") from error
    return notes
