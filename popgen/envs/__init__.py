"""Environments behind one registry: `make_env(name, num_envs, seed=..., **params)`."""

from popgen.envs.contract import BatchedEnv, EnvSpec, ViewSpec
from popgen.envs.env_registry import env_names, make_env

__all__ = ["BatchedEnv", "EnvSpec", "ViewSpec", "env_names", "make_env"]
