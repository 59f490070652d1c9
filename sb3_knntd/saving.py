"""Saving and loading of algorithms."""

from __future__ import annotations

import io
import pathlib
import pickle
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.save_util import is_json_serializable
from stable_baselines3.common.type_aliases import GymEnv

from sb3_knntd.common.environments import check_environment
from sb3_knntd.common.files import read_description, replacing
from sb3_knntd.common.plain import encodable, objects_for
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.learners import Learner
from sb3_knntd.online_algorithm import OnlineAlgorithm

SelfSavedAlgorithm = TypeVar("SelfSavedAlgorithm", bound="SavedAlgorithm")


class SavedAlgorithm(OnlineAlgorithm):
    """
    An online algorithm that is saved atomically, and whose training can be resumed exactly from a saved file.

    The parameters are those of SB3's BaseAlgorithm.
    """

    learner: Learner
    #: name of the algorithm in saved files, the same for all subclasses, which can load each other's files
    _algorithm: ClassVar[str]
    #: arguments of the constructor that :meth:`refine` can change after loading
    _refinable: ClassVar[tuple[str, ...]] = ()
    _stream: RandomStream
    _prediction_stream: RandomStream

    @abstractmethod
    def _check_normalization(self, env: GymEnv | None) -> None:
        """Check that an environment normalises observations if and only if the model was made for such environments."""

    def _excluded_save_params(self) -> list[str]:
        ours = ["_stream", "_prediction_stream", "_is_set_up", "_constant_trace"]
        return [*super()._excluded_save_params(), *ours]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "learner"], []

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save the complete state to a zip file: table, traces, random state and counters. The file is written atomically:
        an interruption leaves the old file.

        :param path: file, with ``.zip`` added if it has no suffix, or file-like object
        :param exclude: attributes to exclude in addition to SB3's
        :param include: attributes to save although SB3 excludes them
        """
        self._stream_states = [self._stream.state(), self._prediction_stream.state()]
        shown, in_episodes = self._last_obs, self.learner.in_episodes
        if self._acted_on is not None:
            # Called by a callback: the saved model must continue with the next step.
            self._move_on()
        try:
            if not isinstance(path, (str, pathlib.Path)):
                self._save(path, exclude, include)
                return
            target = pathlib.Path(path)
            if not target.suffix:
                target = target.with_name(f"{target.name}.zip")
            target.parent.mkdir(parents=True, exist_ok=True)
            with replacing(target) as file:
                self._save(file, exclude, include)
        finally:
            self._last_obs, self.learner.in_episodes = shown, in_episodes

    def _save(self, file: Any, exclude: Iterable[str] | None, include: Iterable[str] | None) -> None:
        """Save to an open file, and add the pickled objects as data, for :meth:`load` with ``trusted=False``."""
        left_out = {*self._excluded_save_params(), *(exclude or ())} - set(include or ())
        values = {name: value for name, value in vars(self).items() if name not in left_out}
        self.plain = encodable({name: value for name, value in values.items() if not is_json_serializable(value)})
        try:
            super().save(file, exclude, include)
        finally:
            del self.plain

    @classmethod
    def load(
        cls: type[SelfSavedAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "cpu",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trusted: bool = True,
        **kwargs: Any,
    ) -> SelfSavedAlgorithm:
        """
        Load a model from a zip file.

        SB3's format contains pickled objects, and unpickling executes code from the file, so load only files from
        sources that you trust. With ``trusted=False`` nothing is unpickled: spaces, SB3's schedules, arrays and numbers
        are read from the data that :meth:`save` adds to the file. To share what was learned,
        ``model.policy.export(path, "safetensors")`` writes a file without pickled objects.

        :param path: file, or file-like object
        :param env: environment to continue with, ``None`` to predict only. The number of environments may differ from
            the saved one
        :param device: device of the perception and the table
        :param custom_objects: objects that replace those in the file
        :param print_system_info: whether to print information on the system that the model was saved on
        :param force_reset: whether ``learn`` starts new episodes; with ``False`` it continues the saved episodes, for
            an environment that is still in the saved state
        :param trusted: whether to unpickle objects; use ``False`` for files from others
        :param kwargs: attributes to change; with ``seed``, new sequences of random numbers are started; with ``points``
            or ``bounds``, the values are carried over to the new points, see ``refine``
        :return: the model
        :raises ValueError: if the file is damaged, the algorithm or the spaces of ``env`` differ, or, with
            ``trusted=False``, the file holds functions or other objects only as pickles
        """
        check_environment(cls.__name__, env)
        saved = read_description(path)
        if saved.get("algorithm") != cls._algorithm:
            raise ValueError(
                f"{path} holds a model of {saved.get('algorithm', 'another algorithm')}, not of {cls._algorithm}: "
                "load it with its own class"
            )
        refined = {name: kwargs.pop(name) for name in cls._refinable if name in kwargs}
        if not trusted:
            custom_objects = objects_for(path, saved, custom_objects or {}) | (custom_objects or {})
        try:
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except (RuntimeError, pickle.UnpicklingError, KeyError) as error:  # the state does not fit
            # SB3 handles a ValueError as if from an old file of DQN, and then raises KeyError for a missing optimizer.
            cause = error.__context__ if isinstance(error, KeyError) and error.__context__ else error
            raise ValueError(f"{path}: {cause}") from cause
        vars(model).pop("plain", None)
        # Files of the first version store the next actions here, or None if new episodes were to start.
        if vars(model).pop("_last_actions", ...) is None:
            model.learner.abandon_episodes()
        if env is not None:
            model._check_normalization(model.env)
        if model.n_envs != saved["n_envs"]:
            model._last_obs = None
        elif model._last_obs is not None:
            shape = (model.n_envs, *(model.observation_space.shape or ()))
            if getattr(model._last_obs, "shape", None) != shape:
                raise ValueError(f"{path}: the last observations must have shape {shape}; got {model._last_obs!r:.200}")
        # A given seed starts new sequences; otherwise the saved ones continue.
        if kwargs.get("seed") is None:
            for stream, state in zip((model._stream, model._prediction_stream), model._stream_states, strict=True):
                stream.set_state(state)
        if refined:
            model.refine(**refined)
        return model

    def refine(self: SelfSavedAlgorithm, points: Any = None, bounds: Any = None) -> SelfSavedAlgorithm:
        """
        Lay the points anew, and carry the values over.

        :param points: as in the constructor; ``None`` leaves them
        :param bounds: as in the constructor; ``None`` leaves them
        :return: the model
        :raises NotImplementedError: if the algorithm has no such points
        """
        raise NotImplementedError(f"{type(self).__name__} cannot be refined")
