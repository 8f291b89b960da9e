"""Environments behind one registry: `make_env(name, num_envs, seed=..., **params)`."""

from popgen.envs.contract import BatchedEnv, EnvSpec, ViewSpec
from popgen.envs.env_registry import EnvFamily, env_names, make_env

__all__ = ["BatchedEnv", "EnvFamily", "EnvSpec", "ViewSpec", "env_names", "make_env"]
