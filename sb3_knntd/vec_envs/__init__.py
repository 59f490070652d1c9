"""VecEnvs whose environments are stepped together: those of EnvPool, of gymnasium.vector, and the paper's, compiled."""

from __future__ import annotations

from sb3_knntd.vec_envs.compiled import CompiledVecEnv
from sb3_knntd.vec_envs.envpool import EnvPoolVecEnv
from sb3_knntd.vec_envs.gymnasium import GymnasiumVecEnv, as_vec_env, reset_some
from sb3_knntd.vec_envs.lean import LeanVecEnv

__all__ = ["CompiledVecEnv", "EnvPoolVecEnv", "GymnasiumVecEnv", "LeanVecEnv", "as_vec_env", "reset_some"]
