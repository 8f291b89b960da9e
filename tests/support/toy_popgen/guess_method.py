"""The method `guess` as popgen knows it."""

from __future__ import annotations

from toy_popgen.guess_config import RECIPES, GuessRun

from popgen.envs import EnvSpec
from popgen.methods.method import ActorDemand, Method, Needs, ask_for


def list_actors(config: GuessRun) -> list[ActorDemand]:
    """Samplers alone."""
    return [ask_for(config, "sampler_cpus", config.cluster.samplers)]


def estimate_needs(config: GuessRun, spec: EnvSpec) -> Needs:
    """A member is a few numbers; nothing is kept of the episodes."""
    return Needs(member=8 * spec.num_actions, batch=0, batch_field="guess.episodes")


METHOD = Method(
    name="guess",
    title="Guess",
    summary="Members that are the best of some random habits.",
    colour="#666666",
    marker="x",
    config=GuessRun,
    recipes=RECIPES,
    training="toy_popgen.guess_training:open_training",
    actors=list_actors,
    needs=estimate_needs,
    policies={"habit": "toy_popgen.habit_policy:HabitPolicy"},
)
