"""A VecEnv over EnvPool, whose environments are C++ (extra ``[envpool]``)."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any

import numpy as np

from sb3_knntd.common.checks import check_integer
from sb3_knntd.vec_envs.base import BatchedVecEnv, BatchStep, Turn, add_infos, new_infos

#: EnvPool's seeds are 32-bit integers with a sign.
N_SEEDS = 2**31
#: One spare environment for so many: the share of environments whose episodes may end in a step without waiting.
ENVS_PER_SPARE = 4
#: EnvPool's own numbers in its infos.
BOOKKEEPING = {"env_id", "players", "elapsed_step"}
#: Options of EnvPool that are fixed here.
SETTLED = {"num_envs", "batch_size", "env_seed", "max_num_players", "gym_reset_return_info", "env_type"}


class EnvPoolVecEnv(BatchedVecEnv):
    """
    The environments of EnvPool (https://envpool.readthedocs.io), for every SB3 algorithm. EnvPool makes a step of all
    environments in C++ threads, many times faster than Python environments.

    .. code-block:: python

        model = KNNTD(EnvPoolVecEnv("CartPole-v1", n_envs=64), seed=0).learn(1_000_000)

    EnvPool resets an environment one step after its episode ended. Here the next episode begins in the same step, as in
    SB3's DummyVecEnv: in a spare environment that has been reset, while the other one is reset in the next step. There
    is a spare one for every four environments. After ``seed``, the next :meth:`reset` makes the environments anew,
    since EnvPool takes seeds only then.

    :param env_id: EnvPool's name of the environment; ``envpool.list_all_envs()`` has all of them
    :param n_envs: number of environments, an integer >= 1
    :param seed: seed of the first environment; the others have the following ones. ``None`` for random seeds
    :param options: options of ``envpool.make``, such as ``num_threads``, ``max_episode_steps``, ``render_mode`` and
        those of the environment
    :raises ImportError: if EnvPool is not installed
    :raises ValueError: if there is no such environment or option
    """

    def __init__(self, env_id: str, n_envs: int = 1, seed: int | None = None, **options: Any) -> None:
        try:
            import envpool
        except ImportError as error:
            raise ImportError("EnvPoolVecEnv needs EnvPool: pip install 'sb3-knntd[envpool]'") from error
        n_envs = check_integer("n_envs", n_envs, 1)
        if SETTLED & options.keys():
            raise ValueError(
                f"EnvPoolVecEnv sets {', '.join(sorted(SETTLED & options.keys()))} itself; give the number of "
                "environments as n_envs, and their seed as seed"
            )
        known = envpool.list_all_envs()
        if env_id not in known:
            near = ", ".join(get_close_matches(str(env_id), known))
            raise ValueError(
                f"EnvPool has no environment {env_id!r}; "
                f"{f'near it are {near}' if near else 'envpool.list_all_envs() has all names'}"
            )
        self._n_pool = n_pool = n_envs + max(1, n_envs // ENVS_PER_SPARE)
        self._make = lambda seeds: envpool.make_gymnasium(env_id, num_envs=n_pool, env_seed=seeds, **options)
        entropy = np.random.SeedSequence().generate_state(n_pool)
        try:
            pool = self._make((entropy % N_SEEDS).tolist())
        except TypeError as error:
            raise ValueError(f"EnvPool's {env_id} does not take {options}: {error}") from error
        if pool.config["max_num_players"] != 1:
            raise ValueError(f"EnvPoolVecEnv takes environments of one player; {env_id} has more")
        super().__init__(pool, n_envs, pool.observation_space, pool.action_space)
        if seed is not None:
            self.seed(seed)

    def _reset_all(self) -> np.ndarray:
        if any(self._options):
            raise ValueError(f"EnvPool's environments take no options of reset; got {self._options}")
        if self._seeds[0] is not None:
            self._batch.close()
            self._batch = self._make([(self._seeds[0] + place) % N_SEEDS for place in range(self._n_pool)])
        observations, infos = self._batch.reset()
        n = self.num_envs
        rows = add_infos([{} for _ in range(self._n_pool)], _of_environments(infos))
        #: the environment of the pool in each place
        self._ids = np.arange(n, dtype=np.int32)
        # Environments at the start of an episode: their first observations and infos.
        self._spare = dict(zip(range(n, self._n_pool), zip(observations[n:], rows[n:], strict=True), strict=True))
        # Environments that are reset in the next step.
        self._to_reset: list[int] = []
        self.reset_infos = rows[:n]
        first: np.ndarray = observations[:n]
        return first

    def _step_all(self, actions: np.ndarray) -> BatchStep:
        n, resetting, ids = self.num_envs, self._to_reset, self._ids
        if resetting:
            ids = np.concatenate((ids, np.array(resetting, np.int32)))
            # EnvPool ignores the actions of the environments that it resets.
            actions = np.concatenate((actions, np.broadcast_to(actions[:1], (len(resetting), *actions.shape[1:]))))
        observations, rewards, terminated, truncated, infos = self._batch.step(actions, ids)
        rows = new_infos(len(ids))
        # Most environments have none of their own.
        if len(infos) > len(BOOKKEEPING):
            add_infos(rows, _of_environments(infos))
        for place, env in enumerate(resetting, start=n):
            del rows[place]["TimeLimit.truncated"]
            self._spare[env] = observations[place], rows[place]
        self._to_reset = []
        return BatchStep(observations[:n], rewards[:n], terminated[:n], truncated[:n], rows[:n])

    def _turn(self, ended: np.ndarray, step: BatchStep) -> Turn:
        last = step.observations[ended]
        if len(ended) > len(self._spare):
            self._reset_now(self._ids[ended[len(self._spare) :]])
        first = []
        for place in ended.tolist():
            env = int(self._ids[place])
            if env in self._spare:
                # It has just been reset.
                started = env
            else:
                started = next(iter(self._spare))
                self._to_reset.append(env)
                self._ids[place] = started
            observation, self.reset_infos[place] = self._spare.pop(started)
            first.append(observation)
        return Turn(last, first)

    def _reset_now(self, ids: np.ndarray) -> None:
        """Reset environments at once, which takes as long as a step."""
        observations, infos = self._batch.reset(ids)
        rows = add_infos([{} for _ in ids], _of_environments(infos))
        self._spare |= dict(zip(ids.tolist(), zip(observations, rows, strict=True), strict=True))

    def _images(self) -> list[np.ndarray | None]:
        return list(self._batch.render(self._ids))


def _of_environments(infos: dict[str, Any]) -> dict[str, Any]:
    """The infos without EnvPool's own numbers."""
    return {name: values for name, values in infos.items() if name not in BOOKKEEPING}
