"""The family `line`, importable without the environment itself."""

from popgen.envs import EnvFamily

FAMILY = EnvFamily("line", ("short", "long"), "toy_popgen.line_env:LineEnv")
