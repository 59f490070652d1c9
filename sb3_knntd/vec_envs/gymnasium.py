"""A VecEnv over the environments of ``gymnasium.vector``."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.vector import AutoresetMode, VectorEnv

from sb3_knntd.vec_envs.base import BatchedVecEnv, BatchStep, Turn, add_infos, new_infos

#: What an environment says in its infos of the episodes that it ended in a step of mode SAME_STEP.
FINAL = {"final_obs", "final_info"}


@singledispatch
def reset_some(env: Any, mask: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """
    Reset some environments of a vector environment, by gymnasium's option ``reset_mask``. Classes that do not know that
    option can be registered here with their own way: ``@reset_some.register``.

    :param env: the vector environment
    :param mask: whether to reset each environment, shape (n_envs,), bool
    :return: observations of all environments, of which only those that were reset are read, and infos
    """
    observations, infos = env.reset(options={"reset_mask": mask})
    return observations, infos


@reset_some.register
def _reset_cart_poles(env: CartPoleVectorEnv, mask: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    # As in its step: gymnasium's class knows no reset_mask.
    state: Any = env.state
    state[:, mask] = env.np_random.uniform(low=env.low, high=env.high, size=(4, mask.sum()))
    env.steps[mask] = 0
    env.prev_done[mask] = False
    return state.T.astype(np.float32), {}


def as_vec_env(env: Any) -> Any:
    """
    :param env: an environment of any kind
    :return: a VecEnv of it if it is one of ``gymnasium.vector``, otherwise itself
    """
    return GymnasiumVecEnv(env) if isinstance(env, VectorEnv) else env


class GymnasiumVecEnv(BatchedVecEnv):
    """
    An environment of ``gymnasium.vector``, for every SB3 algorithm, in each autoreset mode. ``KNNTD`` and ``ExA``
    wrap such environments by themselves.

    .. code-block:: python

        model = PPO("MlpPolicy", GymnasiumVecEnv(gym.make_vec("CartPole-v1", num_envs=64)))

    With ``AutoresetMode.NEXT_STEP`` and ``DISABLED`` environments are reset in the step that ends their episode, by
    gymnasium's option ``reset_mask``, see :func:`reset_some`.

    :param env: the vector environment
    :raises ValueError: if it is none, or has no known autoreset mode
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(env, VectorEnv):
            raise ValueError(f"env must be an environment of gymnasium.vector, as from gymnasium.make_vec; got {env!r}")
        if type(env).__module__.startswith("envpool") or hasattr(env, "all_env_ids"):
            raise ValueError(
                f"GymnasiumVecEnv takes no environments of EnvPool, whose seeds are fixed when they are made; got "
                f"{type(env).__name__}. Use EnvPoolVecEnv(env_id, n_envs)"
            )
        # As in gymnasium, environments that do not say it have the first mode.
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        try:
            self._mode = AutoresetMode(mode)
        except ValueError:
            raise ValueError(
                f"env.metadata['autoreset_mode'] must be one of {', '.join(map(str, AutoresetMode))}; got {mode!r}"
            ) from None
        self._final_infos: dict[str, Any] = {}
        super().__init__(env, env.num_envs, env.single_observation_space, env.single_action_space)

    def _reset_all(self) -> np.ndarray:
        if any(options != self._options[0] for options in self._options):
            raise ValueError("environments of gymnasium.vector take the same options of reset; got different ones")
        # SB3's seeds are consecutive, as gymnasium makes them from the first.
        observations, infos = self._batch.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = add_infos([{} for _ in self.reset_infos], infos)
        first: np.ndarray = observations
        return first

    def _step_all(self, actions: np.ndarray) -> BatchStep:
        observations, rewards, terminated, truncated, infos = self._batch.step(actions)
        rows = new_infos(self.num_envs)
        if infos:
            add_infos(rows, {name: values for name, values in infos.items() if name.lstrip("_") not in FINAL})
        if self._mode == AutoresetMode.SAME_STEP:
            self._final_infos = infos
        return BatchStep(observations, rewards, terminated, truncated, rows)

    def _turn(self, ended: np.ndarray, step: BatchStep) -> Turn:
        if self._mode == AutoresetMode.SAME_STEP:
            return self._turn_made(ended, step)
        mask = np.zeros(self.num_envs, np.bool_)
        mask[ended] = True
        last = step.observations[ended]
        others = step.observations[~mask]
        observations, infos = reset_some(self._batch, mask)
        if not np.array_equal(observations[~mask], others):
            raise ValueError(
                f"{self._batch} has reset environments whose episodes go on: it must know gymnasium's option "
                "reset_mask of reset. Make it with the autoreset mode SAME_STEP, or as "
                "gymnasium.make_vec(id, n_envs, vectorization_mode='sync')"
            )
        resets = add_infos([{} for _ in range(self.num_envs)], infos)
        for env in ended.tolist():
            self.reset_infos[env] = resets[env]
        return Turn(last, observations[ended])

    def _turn_made(self, ended: np.ndarray, step: BatchStep) -> Turn:
        """The environment has begun the next episodes itself."""
        if "final_obs" not in self._final_infos:
            raise ValueError(f"{self._batch} has the autoreset mode SAME_STEP, but its infos lack 'final_obs'")
        finals = add_infos(new_infos(self.num_envs), self._final_infos.get("final_info", {}))
        for env in ended.tolist():
            # The infos are those of the reset, and the final ones those of the step.
            step.infos[env].pop("TimeLimit.truncated")
            self.reset_infos[env], step.infos[env] = step.infos[env], finals[env]
        last = self._final_infos["final_obs"]
        return Turn([last[env] for env in ended.tolist()], step.observations[ended])
