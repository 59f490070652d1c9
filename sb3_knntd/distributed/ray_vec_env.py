"""A VecEnv whose environments run on the machines of a Ray cluster (extra ``[ray]``)."""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs

from sb3_knntd.common.checks import check_integer, check_number, shown

try:
    import ray
    from ray import cloudpickle
    from ray.actor import ActorHandle
    from ray.exceptions import (
        LocalRayletDiedError,
        NodeDiedError,
        ObjectLostError,
        OutOfMemoryError,
        RayActorError,
        RayTaskError,
        WorkerCrashedError,
    )
except ImportError as error:
    raise ImportError("RayVecEnv needs Ray: pip install 'sb3-knntd[ray]'") from error

from sb3_knntd.distributed.env_actor import EnvActor, pack_request
from sb3_knntd.distributed.ray_jobs import connect

#: Seconds to wait for resources of the cluster before warning about what is missing.
PATIENCE = 30.0
#: Raised by Ray if a process or its machine has died, or its answer was lost.
DEATHS = (
    RayActorError,
    NodeDiedError,
    WorkerCrashedError,
    LocalRayletDiedError,
    OutOfMemoryError,
    ObjectLostError,
)
#: Options of a Ray actor that are fixed here or are parameters of :class:`RayVecEnv`.
SETTLED = {"num_cpus", "max_restarts", "max_task_retries", "max_concurrency", "name", "lifetime", "get_if_exists"}


class RayVecEnv(VecEnv):
    """
    SB3's SubprocVecEnv on a Ray cluster: each environment runs in its own process, on any machine of the cluster. It is
    for simulators that take milliseconds per step or more. With the same seeds it returns what SubprocVecEnv returns.

    It uses the cluster that this process is connected to, or connects to one; the connection then stays open until the
    program ends or calls ``ray.shutdown()``. The environments' dependencies must be installed on all machines.

    .. code-block:: python

        kwargs = {"address": "auto", "num_cpus": 2}
        venv = make_vec_env("Ant-v5", 32, vec_env_cls=RayVecEnv, vec_env_kwargs=kwargs)

    An environment whose process or machine dies is restarted wherever resources are free. The current step truncates
    its episode: the reward is 0, ``terminal_observation`` in its info is the last observation received,
    ``TimeLimit.truncated`` and ``env_restarted`` are true, and the info of a Monitor has no ``episode``. The new
    environment

    - has the attributes set by :meth:`set_attr`; changes made by its methods are lost;
    - is reset with a seed derived from its last seed and the number of restarts, or without a seed if it had none;
    - keeps the rows of a Monitor file that it finds on its machine in a second file beside it.

    If an environment dies during :meth:`reset` or another call, the call is repeated in the new environment. An
    exception raised by an environment is raised here, with its traceback, and does not restart it.

    :param env_fns: functions that create the environments, one for each
    :param num_cpus: CPUs that Ray reserves for each environment, any number >= 0; below 1, environments share a CPU
    :param actor_options: other options of a Ray actor, such as ``num_gpus``, ``memory`` (bytes), ``resources``,
        ``runtime_env`` and ``scheduling_strategy`` (by default ``"SPREAD"``: spread over the machines)
    :param address: ``"auto"`` for the cluster of this machine, ``"ray://host:port"`` for a remote cluster, ``None`` for
        the one of the environment variable ``RAY_ADDRESS`` or, if unset, a new local cluster; ignored if already
        connected
    :param max_restarts: maximum number of consecutive restarts of an environment without a finished episode, an
        integer >= 0
    :param timeout: seconds to wait for an answer of an environment, above 0; a slower one is considered dead. ``None``
        to wait forever
    :param placement_timeout: seconds to wait for resources of the cluster, above 0
    :raises ImportError: on import of the module, if Ray is not installed
    :raises ValueError: if an argument is invalid; the message names it and says what is valid
    :raises ConnectionError: if there is no cluster at ``address``
    :raises TimeoutError: if the cluster has too few resources for the environments
    :raises RuntimeError: if an environment dies more often than ``max_restarts``, here or later
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any]]],
        num_cpus: float = 1.0,
        actor_options: Mapping[str, Any] | None = None,
        address: str | None = None,
        max_restarts: int = 3,
        timeout: float | None = None,
        placement_timeout: float = 300.0,
    ) -> None:
        if not isinstance(env_fns, Sequence) or not env_fns or not all(map(callable, env_fns)):
            raise ValueError(f"env_fns must be functions that make environments, at least one; got {shown(env_fns)}")
        n_envs = len(env_fns)
        if address is not None and not isinstance(address, str):
            raise ValueError(f"address must be 'auto', 'ray://host:port' or None; got {shown(address)}")
        if not (actor_options is None or isinstance(actor_options, Mapping)):
            raise ValueError(f"actor_options must be a dict of options of a Ray actor; got {shown(actor_options)}")
        options = dict(actor_options or {})
        if SETTLED & options.keys():
            raise ValueError(
                f"actor_options cannot have {', '.join(sorted(SETTLED & options.keys()))}: num_cpus and max_restarts "
                "are parameters of RayVecEnv, and it sets the others itself"
            )
        self.max_restarts = check_integer("max_restarts", max_restarts, 0)
        self.timeout = None if timeout is None else check_number("timeout", timeout, 0.0, above=True)
        self.placement_timeout = check_number("placement_timeout", placement_timeout, 0.0, above=True)
        options = {
            "scheduling_strategy": "SPREAD",
            **options,
            "num_cpus": check_number("num_cpus", num_cpus, 0.0),
            # A restart by Ray would replace an environment within an episode by one that has not been reset.
            "max_restarts": 0,
            "max_task_retries": 0,
        }
        try:
            self._actor_class = ray.remote(EnvActor).options(**options)
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"num_cpus={num_cpus!r}, actor_options={shown(actor_options)}: {error}") from error
        asked_for = {"num_cpus": num_cpus, **(actor_options or {})}
        self._asked_for = {key: value for key, value in asked_for.items() if key != "runtime_env"}

        #: number of restarts of each environment, shape (n_envs,)
        self.restarts = [0] * n_envs
        self.waiting = False
        self.closed = False
        self._deaths_in_row = [0] * n_envs
        self._env_fns = [cloudpickle.dumps(env_fn) for env_fn in env_fns]
        self._attributes: list[dict[str, bytes]] = [{} for _ in env_fns]
        self._logs: list[str | None] = [None] * n_envs
        self._last_seeds: list[int | None] = [None] * n_envs
        # Last observation of each environment that is within an episode.
        self._observations: dict[int, Any] = {}
        # First observation and info of the environments restarted within an episode, until the next step.
        self._begun_anew: dict[int, tuple[Any, dict[str, Any]]] = {}
        self._steps: list[tuple[int, ray.ObjectRef[bytes]]] = []
        self._actors: dict[int, ActorHandle[Any]] = {}

        connect(address, log_to_driver=True)
        try:
            self._restart(self._start(range(n_envs)))
            observation_space, action_space = self._call([0], "spaces")[0]
            super().__init__(n_envs, observation_space, action_space)
        except BaseException:
            self._kill()
            raise

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: shape (n_envs, *action_shape)
        """
        self._steps = [
            (index, self._send(index, pack_request("step", action)))
            for index, action in zip(range(self.num_envs), actions, strict=True)
            if index not in self._begun_anew
        ]
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, shape (n_envs,), whether the episodes have ended, shape (n_envs,), and infos
        """
        steps = [(index, step) for index, step in self._steps if index not in self._begun_anew]
        try:
            answers, deaths = self._receive(steps)
            self._restart(deaths)
        finally:
            self._steps, self.waiting = [], False
        made = {index: answer for (index, _), answer in zip(steps, answers, strict=True) if index not in deaths}
        for index, (_, _, done, _, _) in made.items():
            if done:
                self._deaths_in_row[index] = 0
        results = [made[index] if index in made else self._cut_off(index) for index in range(self.num_envs)]
        observations, rewards, dones, infos, reset_infos = zip(*results, strict=True)
        self._observations = dict(enumerate(observations))
        self.reset_infos = list(reset_infos)
        return _stack_obs(observations, self.observation_space), np.stack(rewards), np.stack(dones), list(infos)

    def reset(self) -> VecEnvObs:
        """
        :return: the first observations
        """
        # Drop steps in progress.
        self._steps, self.waiting = [], False
        self._observations, self._begun_anew = {}, {}
        for index, seed in enumerate(self._seeds):
            if seed is not None:
                self._last_seeds[index] = seed
        results = self._call_each(
            range(self.num_envs),
            [pack_request("reset", *given) for given in zip(self._seeds, self._options, strict=True)],
        )
        observations, reset_infos = zip(*results, strict=True)
        self._observations = dict(enumerate(observations))
        self.reset_infos = list(reset_infos)
        self._reset_seeds()
        self._reset_options()
        return _stack_obs(observations, self.observation_space)

    def close(self) -> None:
        """Close the environments and stop their processes."""
        if self.closed:
            return
        self.closed = True
        # After a shutdown of Ray there is nothing left to close.
        if ray.is_initialized():
            try:
                self._receive([(index, self._send(index, pack_request("close"))) for index in self._actors])
            finally:
                self._kill()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        :return: an image of each environment, ``None`` where they do not render to arrays
        """
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"the environments' render_mode is {self.render_mode!r}; images need 'rgb_array'", stacklevel=2
            )
            return [None] * self.num_envs
        return self._call(range(self.num_envs), "render")

    def has_attr(self, attr_name: str) -> bool:
        """
        :param attr_name: name of an attribute of the environments or their wrappers
        :return: whether all environments have it
        """
        return all(self._call(range(self.num_envs), "has_attr", attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: name of an attribute of the environments or their wrappers
        :param indices: indices of environments, ``None`` for all
        :return: a copy of its value in each of them
        :raises AttributeError: if one has no such attribute
        """
        return self._call(self._targets(indices), "get_attr", attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: name of an attribute of the outermost wrappers
        :param value: its new value; each environment gets a copy, also after a restart
        :param indices: indices of environments, ``None`` for all
        """
        targets = self._targets(indices)
        self._call(targets, "set_attr", attr_name, value)
        pickled = cloudpickle.dumps(value)
        for index in targets:
            self._attributes[index][attr_name] = pickled

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :param method_name: name of a method of the environments or their wrappers
        :param method_args: its arguments
        :param indices: indices of environments, ``None`` for all
        :param method_kwargs: its keyword arguments
        :return: the return value of each
        :raises AttributeError: if one has no such method
        """
        return self._call(self._targets(indices), "env_method", method_name, *method_args, **method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        :param wrapper_class: class of a wrapper
        :param indices: indices of environments, ``None`` for all
        :return: whether each is wrapped in it
        """
        return self._call(self._targets(indices), "is_wrapped", wrapper_class)

    # ----------------------------------------------------- requests and answers

    def _targets(self, indices: VecEnvIndices) -> list[int]:
        # Negative indices count from the end.
        return [range(self.num_envs)[index] for index in self._get_indices(indices)]

    def _call(self, targets: Sequence[int], name: str, /, *args: Any, **kwargs: Any) -> list[Any]:
        return self._call_each(targets, [pack_request(name, *args, **kwargs)] * len(targets))

    def _call_each(self, targets: Sequence[int], requests: Sequence[bytes]) -> list[Any]:
        """Send a request to each target and wait for all answers. If an environment dies, send its request again."""
        answers: list[Any] = [None] * len(targets)
        left = list(range(len(targets)))
        while left:
            heard, deaths = self._receive([(targets[at], self._send(targets[at], requests[at])) for at in left])
            for at, answer in zip(left, heard, strict=True):
                answers[at] = answer
            self._restart(deaths)
            left = [at for at in left if targets[at] in deaths]
        return answers

    def _send(self, index: int, request: bytes) -> ray.ObjectRef[bytes]:
        return self._actors[index].answer.remote(request)

    def _receive(self, asked: Sequence[tuple[int, ray.ObjectRef[bytes]]]) -> tuple[list[Any], dict[int, Exception]]:
        """The answers, ``None`` for an environment that died, and the error of each of these by environment."""
        references = [reference for _, reference in asked]
        # Wait for all first, so that no environment is busy when another one raises.
        late = set(ray.wait(references, num_returns=len(references), timeout=self.timeout)[1]) if references else set()
        answers: list[Any] = []
        deaths: dict[int, Exception] = {}
        for index, reference in asked:
            answer = None
            if reference in late:
                deaths[index] = TimeoutError(f"no answer within {self.timeout:g} s")
            else:
                try:
                    answer = cloudpickle.loads(ray.get(reference))
                except RayTaskError:  # raised by the environment, even if its type is also one of DEATHS
                    raise
                except DEATHS as error:
                    deaths[index] = error
            answers.append(answer)
        return answers, deaths

    # ------------------------------------------------------------------ restarts

    def _restart(self, deaths: Mapping[int, Exception]) -> None:
        """Restart the environments that died, until all are alive."""
        while deaths:
            for index, error in deaths.items():
                self._tell_of_death(index, error)
            deaths = self._start(list(deaths))

    def _tell_of_death(self, index: int, error: Exception) -> None:
        # The last line of Ray's messages says what happened.
        reason = textwrap.shorten((str(error).strip() or type(error).__name__).splitlines()[-1], 300)
        if self._deaths_in_row[index] >= self.max_restarts:
            raise RuntimeError(
                f"environment {index} has died {self._deaths_in_row[index] + 1} times in a row without finishing an "
                f"episode, and max_restarts is {self.max_restarts}. Its last death: {reason}. If it always dies, run "
                "it in this process to see why: use DummyVecEnv instead of RayVecEnv"
            ) from error
        self._deaths_in_row[index] += 1
        self.restarts[index] += 1
        warnings.warn(
            f"environment {index} died and is restarted (restart {self.restarts[index]}): {reason}", stacklevel=2
        )

    def _start(self, indices: Sequence[int]) -> dict[int, Exception]:
        """Create environments, and reset those that were within an episode; the error of each that died, by index."""
        deaths = self._place(indices)
        living = [index for index in indices if index not in deaths]
        logs, died = self._receive([(index, self._send(index, self._beginning(index))) for index in living])
        deaths |= died
        for index, log in zip(living, logs, strict=True):
            if index not in died:
                self._logs[index] = log

        in_episodes = [index for index in living if index not in died and (self.waiting or index in self._observations)]
        requests = [
            (index, self._send(index, pack_request("reset", self._next_seed(index), {}))) for index in in_episodes
        ]
        firsts, died = self._receive(requests)
        deaths |= died
        for index, first in zip(in_episodes, firsts, strict=True):
            if index not in died:
                self._begun_anew[index] = first
        return deaths

    def _place(self, indices: Iterable[int]) -> dict[int, Exception]:
        """Start a process for each environment; the error of each that died, by index."""
        for index in indices:
            if index in self._actors:
                # The old process may be alive, but unreachable or busy for too long.
                ray.kill(self._actors[index])
            self._actors[index] = self._actor_class.remote()  # type: ignore[assignment]
        ready: dict[ray.ObjectRef[Any], int] = {self._actors[index].__ray_ready__.remote(): index for index in indices}
        _, without = ray.wait(list(ready), num_returns=len(ready), timeout=min(PATIENCE, self.placement_timeout))
        if without and self.placement_timeout > PATIENCE:
            warnings.warn(f"still waiting for {self._need(len(without))}", stacklevel=2)
            _, without = ray.wait(without, num_returns=len(without), timeout=self.placement_timeout - PATIENCE)
        if without:
            raise TimeoutError(
                f"in {self.placement_timeout:g} s (placement_timeout) Ray did not start {self._need(len(without))}"
            )
        deaths: dict[int, Exception] = {}
        for reference, index in ready.items():
            try:
                ray.get(reference)
            except DEATHS as error:
                if isinstance(error, RayActorError) and error.actor_init_failed:
                    raise
                deaths[index] = error
        return deaths

    def _need(self, n_without: int) -> str:
        there, free = (
            {key: value for key, value in amounts.items() if ":" not in key and "memory" not in key}
            for amounts in (ray.cluster_resources(), ray.available_resources())
        )
        return (
            f"the processes of {n_without} of {len(self.restarts)} environments. Each needs {self._asked_for}; the "
            f"cluster has {there}, of which {free} is free. If that is too little, use fewer environments or a smaller "
            "num_cpus"
        )

    def _beginning(self, index: int) -> bytes:
        return pack_request(
            "begin", self._env_fns[index], self._attributes[index], self._logs[index], self.restarts[index]
        )

    def _next_seed(self, index: int) -> int | None:
        seed = self._last_seeds[index]
        if seed is None:
            return None
        # The last seed itself would repeat the same episodes.
        return int(np.random.SeedSequence((seed, self.restarts[index])).generate_state(1)[0])

    def _cut_off(self, index: int) -> tuple[Any, float, bool, dict[str, Any], dict[str, Any]]:
        """The step of a restarted environment, which truncates the episode."""
        observation, reset_info = self._begun_anew.pop(index)
        info = {
            "TimeLimit.truncated": True,
            "env_restarted": True,
            # There is no last observation if the environment was stepped without a reset.
            "terminal_observation": self._observations.get(index, observation),
        }
        return observation, 0.0, True, info, reset_info

    def _kill(self) -> None:
        for actor in self._actors.values():
            ray.kill(actor)
        self._actors = {}
