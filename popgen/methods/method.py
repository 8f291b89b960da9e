"""What the rest of the house must know of a method: one record, which the method's package gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.recipe import Recipe, Settings

if TYPE_CHECKING:
    from popgen.methods.training import OpenTraining


@dataclass(frozen=True)
class ActorDemand:
    """`count` actors that take `amounts` of one node's resources each; `field` is the setting to blame."""

    field: str
    count: int
    amounts: dict[str, float]


@dataclass(frozen=True)
class Needs:
    """Bytes that a run of the method needs, as bounds of what grows with its configuration.

    Attributes:
        member: weights of the last member: what it acts with, and its critics, of which it has the most.
        batch: observations or latents of the largest batch that an update learns from, once.
        batch_field: the setting that this batch grows with.
        buffers: both replay buffers when they are full; 0 without buffers.
        buffers_field: the setting that bounds them, "" without buffers.
        in_flight: segments on their way from the samplers at a time.
        left: what a finished member leaves behind for those after it.
        buffer_copies: whole copies of the buffers among the checkpoints of the running member.
        together: members that are trained, and checkpointed, together.
        in_driver: learning takes place in the driver's process, so that its machine needs the memory in a cluster too.
    """

    member: int
    batch: int
    batch_field: str
    buffers: int = 0
    buffers_field: str = ""
    in_flight: int = 0
    left: int = 0
    buffer_copies: int = 0
    together: int = 1
    in_driver: bool = False


@dataclass(frozen=True)
class Continuation:
    """What a population to continue (`population.init_from`) must have in common with the run.

    Attributes:
        kind: policy kind of its members.
        shapes: section -> fields that decide the shapes of weights which the run takes over.
        capacity: section and field of the buffers' capacity, which must not shrink.
    """

    kind: str
    shapes: Mapping[str, tuple[str, ...]]
    capacity: tuple[str, str]


def _accept(config: RunConfig, spec: EnvSpec) -> None:
    """No checks beyond those that every run undergoes."""


@dataclass(frozen=True)
class Method:
    """A way to generate a population.

    Attributes:
        name: value of the setting `method`.
        title: on tables and charts, as the paper writes it.
        summary: one sentence.
        colour, marker: on charts (matplotlib's names).
        config: the schema of its runs: the shared sections and its own.
        recipes: complete settings by name; `laptop` must be among them.
        training: `module:function`, an `OpenTraining`, imported when a run starts.
        actors: what its workers ask Ray for.
        needs: memory and disk.
        check: refuses a configuration that cannot work in an environment, by a `UserError`.
        policies: policy kind -> `module:class` of the members that it saves, beside those of `popgen.policies`.
        continuation: what a population to continue must have in common; None where the method cannot continue one.
        objectives: its rows in a table of self-sabotage: name -> settings on top of a recipe. A name means the same in
            every method: `self-play` (no partner), `paper` (the paper's objective) and `ours` (with our options).
        multiple: its members come in so many at a time,
        alone: after so many that come one by one.
        trains_ego: its population of one is an ego agent, which plays with others.
    """

    name: str
    title: str
    summary: str
    colour: str
    marker: str
    config: type[RunConfig]
    recipes: Mapping[str, Recipe]
    training: str
    actors: Callable[[Any], list[ActorDemand]]
    needs: Callable[[Any, EnvSpec], Needs]
    check: Callable[[Any, EnvSpec], None] = _accept
    policies: Mapping[str, str] = field(default_factory=dict)
    continuation: Continuation | None = None
    objectives: Mapping[str, Settings] = field(default_factory=dict)
    multiple: int = 1
    alone: int = 0
    trains_ego: bool = False

    @property
    def family(self) -> str:
        """Package of the schema that its own is built on: methods of one family share a learner, and start from the
        same weights at the same seed."""
        schemas = [one for one in self.config.__mro__ if issubclass(one, RunConfig) and one is not RunConfig]
        root = schemas[-1] if schemas else self.config
        return root.__module__.rpartition(".")[0] or root.__module__

    def fit_size(self, least: int) -> int:
        """Members of the smallest population of whole groups that has at least so many."""
        groups = -(-max(0, least - self.alone) // self.multiple)
        return self.alone + groups * self.multiple

    def load_training(self) -> OpenTraining:
        """The start of its workers."""
        module, _, name = self.training.partition(":")
        return getattr(import_module(module), name)


def ask_for(config: RunConfig, setting: str, count: int, gpus: float = 0.0) -> ActorDemand:
    """`count` actors with the cores of `cluster.<setting>`, cards, and the cluster's further resources."""
    cluster = config.cluster
    amounts = {"CPU": getattr(cluster, setting), "GPU": gpus, **cluster.resources}
    return ActorDemand(f"cluster.{setting}", count, {name: amount for name, amount in amounts.items() if amount})
