"""A member of an XPM-WM population: its own archived latent filter and its actor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from pydantic import ValidationError
from torch import nn

from popgen.config.run_config import as_user_error
from popgen.config.schema import Schema
from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.config import ACTING, AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.latents import Latent
from popgen.methods.xpm_wm.world_model import LatentFilter
from popgen.nets import weights as w

_S = TypeVar("_S", bound=Schema)


class WorldModelSeat(nn.Module):
    """A member's step in one seat (`popgen.play.stacked_partners.Stackable`); its memory is h and z side by side."""

    def __init__(self, latent_filter: LatentFilter, actor: Actor) -> None:
        super().__init__()
        self.filter, self.actor = latent_filter, actor

    def forward(
        self,
        memory: torch.Tensor,
        obs: torch.Tensor,
        previous_actions: torch.Tensor,
        is_first: torch.Tensor,
        seat: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Memory (R, D + C * G), obs (R, P, *shape), actions (R, P), is_first and seats (R,) -> log-probabilities
        (R, A) and the next memory."""
        sizes = (self.filter.config.deter, self.filter.latent_size)
        latent = self.filter.filter(Latent(*memory.split(sizes, -1)), obs, previous_actions, is_first)
        return self.actor.log_probs(latent, seat), latent.flat()


class WorldModelPolicy:
    """Filters the joint observation into (h, z) and acts on each seat's player-specific latent.

    Actions are sampled from the actor, as in training.
    """

    kind: ClassVar[str] = "world_model"

    def __init__(self, model: WorldModelConfig, agent: AgentConfig, spec: EnvSpec) -> None:
        self._model, self._agent, self._spec = model, agent, spec
        self.view = model.view
        self.filter, self.actor = LatentFilter(model, spec), Actor(agent, model, spec.num_actions)
        self._parts = nn.ModuleDict({"filter": self.filter, "actor": self.actor}).eval().requires_grad_(False)
        self._generator = torch.Generator()
        self._latent: Latent | None = None

    def __repr__(self) -> str:
        return f"<WorldModelPolicy on {self.view!r}, {sum(p.numel() for p in self._parts.parameters()):,} weights>"

    def reset(self, batch: int, seed: int) -> None:
        """B fresh episodes; see `Policy`."""
        self._generator.manual_seed(seed)
        self._latent = self.filter.initial(batch)

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """(B, P) uint8 actions; see `Policy`."""
        if self._latent is None or len(is_first) != len(self._latent.h):
            before = "nothing yet" if self._latent is None else f"{len(self._latent.h)} rows"
            problem = f"act on {len(is_first)} rows, but reset for {before}"
            raise RuntimeError(f"{problem}: call reset(batch={len(is_first)}, seed=...) first")
        with torch.no_grad():
            self._latent = self.filter.filter(
                self._latent,
                torch.from_numpy(np.ascontiguousarray(obs)),
                torch.from_numpy(previous_actions.astype(np.int64)),
                torch.from_numpy(np.ascontiguousarray(is_first)),
                self._generator,
            )
            seats = torch.tensor([0, 1]).expand(len(is_first), 2)
            return self.actor.sample(self._latent.expand_players(), seats, self._generator).numpy().astype(np.uint8)

    @property
    def memory_size(self) -> int:
        """Numbers of a row's h and z; see `popgen.play.stacked_partners.Stackable`."""
        return self._model.deter + self.filter.latent_size

    def seat_network(self) -> nn.Module | None:
        """See `popgen.play.stacked_partners.Stackable`; a filter that samples draws from a generator of its own."""
        return WorldModelSeat(self.filter, self.actor) if self._model.imagination == "mode" else None

    def memory(self) -> dict[str, Any]:
        """The running episodes' latents and the generator; see `popgen.play.policy.Remembering`."""
        if self._latent is None:
            raise RuntimeError("there is no memory before reset")
        latent = {"h": self._latent.h.numpy(), "z": self._latent.z.numpy()}
        return latent | {"generator": self._generator.get_state().numpy()}

    def load_memory(self, memory: dict[str, Any]) -> None:
        """Continue from `memory()`."""
        self._latent = Latent(*(torch.from_numpy(np.array(memory[name])) for name in ("h", "z")))
        self._generator.set_state(torch.from_numpy(np.array(memory["generator"])))

    def config(self) -> dict[str, Any]:
        """The fields of the two schemas that the networks are built from."""
        return {
            "world_model": self._model.model_dump(mode="json", include=set(ACTING["world_model"])),
            "agent": self._agent.model_dump(mode="json", include=set(ACTING["agent"])),
        }

    def weights(self) -> w.Weights:
        """`filter.*` and `actor.*`."""
        return w.weights_of(self._parts)

    def load(self, weights: Mapping[str, np.ndarray]) -> None:
        """Load `weights()` of a policy of the same sizes (else ValueError); the running episodes' latents stay."""
        w.load_weights(self._parts, weights)

    @classmethod
    def from_parts(
        cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec
    ) -> WorldModelPolicy:
        """Build from `config()` and `weights()`.

        Fields of `config` that do not decide how a policy acts are ignored: they may be another version's.

        Raises:
            ValueError: a field that decides it is missing or wrong, or the weights do not fit.
        """
        model = _read_section(config, "world_model", WorldModelConfig)
        policy = cls(model, _read_section(config, "agent", AgentConfig), spec)
        policy.load(weights)
        return policy


def _read_section(config: Mapping[str, Any], section: str, schema: type[_S]) -> _S:
    """The schema from the acting fields of one section; the rest is at its defaults."""
    given = config.get(section)
    if not isinstance(given, Mapping):
        raise ValueError(f"the config has no {section!r}")
    missing = [name for name in ACTING[section] if name not in given]
    if missing:
        raise ValueError(f"{section}.{missing[0]} is missing")
    try:
        return schema.model_validate({name: given[name] for name in ACTING[section]})
    except ValidationError as error:
        raise as_user_error(error, section) from None
