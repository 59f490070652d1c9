"""Videos of episodes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, sync_envs_normalization

from sb3_knntd.common.checks import check_integer, check_path, shown
from sb3_knntd.common.files import replace_file

from .throttled import ThrottledCallback, picture_formats

#: Maximum frame rate, frames per second; frames of faster environments are skipped.
FRAMES_PER_SECOND = 25
#: Maximum width and height, pixels.
LARGEST = 320


class EpisodeVideoCallback(ThrottledCallback):
    """
    Records an episode of the greedy policy every ``video_freq`` calls and at the end of training, as an animated GIF.
    It is written to TensorBoard's images under ``video/episode`` if the model logs there, and to ``folder`` if given.
    (SB3's own ``Video`` needs moviepy below 2.)

    .. code-block:: python

        video = EpisodeVideoCallback(gym.make("MountainCar-v0", render_mode="rgb_array"))
        KNNTD("MountainCar-v0", tensorboard_log="logs").learn(50_000, callback=video)

    :param eval_env: environment of the episodes, with ``render_mode="rgb_array"``: not the training environment, but
        with the same wrappers. Its VecNormalize gets the statistics of the training environment, as in EvalCallback
    :param video_freq: record every ``video_freq`` calls (of n_envs steps each); ``None``: as often as takes 0.1 % of
        the time, about once in half an hour
    :param folder: folder for ``episode_{steps}.gif``; ``None`` for no files
    :param max_steps: maximum number of recorded steps
    :param verbose: 1 to print a line for each written file
    :raises ValueError: if an argument is invalid; when training begins, if there is neither TensorBoard nor a folder
    :raises ImportError: when training begins, if Pillow is not installed
    """

    FIRST_SECONDS: ClassVar[float] = 1.0

    def __init__(
        self,
        eval_env: gym.Env[Any, Any] | VecEnv,
        video_freq: int | None = None,
        folder: str | Path | None = None,
        max_steps: int = 1000,
        verbose: int = 0,
    ) -> None:
        super().__init__("video_freq", video_freq, verbose)
        if not isinstance(eval_env, (gym.Env, VecEnv)):
            raise ValueError(
                "eval_env must be an environment, e.g. gymnasium.make(id, render_mode='rgb_array'); got "
                f"{shown(eval_env)}"
            )
        self.eval_env = eval_env if isinstance(eval_env, VecEnv) else DummyVecEnv([lambda: eval_env])
        if self.eval_env.num_envs != 1:
            raise ValueError(f"eval_env must be one environment; got {self.eval_env.num_envs} of them")
        if self.eval_env.render_mode != "rgb_array":
            raise ValueError(
                f"eval_env must have render_mode='rgb_array'; got {self.eval_env.render_mode!r}. Make it with "
                "gymnasium.make(id, render_mode='rgb_array')"
            )
        self.folder = None if folder is None else check_path("folder", folder)
        self.max_steps = check_integer("max_steps", max_steps, 1)

    def _init_callback(self) -> None:
        # Raise before training, not after hours of it.
        try:
            import PIL.Image  # noqa: F401
        except ImportError as error:
            raise ImportError('videos need Pillow: pip install "sb3-knntd[extra]"') from error
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)

    def _on_training_start(self) -> None:
        if self.folder is None and not self._writers():
            raise ValueError(
                "EpisodeVideoCallback: the video has nowhere to go. Give the model tensorboard_log, or the callback "
                "folder='videos'"
            )
        super()._on_training_start()

    def _writers(self) -> list[Any]:
        """TensorBoard's writers: SB3's logger does not support animated images."""
        outputs = picture_formats(self.logger)
        return [output.writer for output in outputs if isinstance(output, TensorBoardOutputFormat)]

    def _act(self) -> None:
        gif, (height, width) = self.record()
        for writer in self._writers():
            from tensorboard.compat.proto.summary_pb2 import Summary

            image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
            summary = Summary(value=[Summary.Value(tag="video/episode", image=image)])
            writer.file_writer.add_summary(summary, self.num_timesteps)
            writer.flush()
        if self.folder is not None:
            path = self.folder / f"episode_{self.num_timesteps}.gif"
            replace_file(path, gif)
            if self.verbose >= 1:
                print(f"Video written to {path}")

    def record(self) -> tuple[bytes, tuple[int, int]]:
        """
        :return: an episode of the current greedy policy as a GIF, and its height and width in pixels
        """
        from PIL import Image

        env, model = self.eval_env, self.model
        if model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, env)
        per_second = float(env.get_attr("metadata")[0].get("render_fps", FRAMES_PER_SECOND))
        every = int(np.ceil(per_second / FRAMES_PER_SECOND))
        frames = []
        observations, done = env.reset(), False
        for step in range(self.max_steps):
            if step % every == 0:
                frame = Image.fromarray(np.asarray(env.render()))
                frame.thumbnail((LARGEST, LARGEST))
                frames.append(frame)
            if done:
                break
            assert isinstance(observations, np.ndarray)
            actions, _ = model.predict(observations, deterministic=True)
            observations, _, dones, _ = env.step(actions)
            done = bool(dones[0])
        file = io.BytesIO()
        frames[0].save(
            file, "GIF", save_all=True, append_images=frames[1:], duration=round(1000 * every / per_second), loop=0
        )
        return file.getvalue(), (frames[0].height, frames[0].width)
