"""Actor on the player-specific latent and centralised critics on the joint one (paper, section 4.1): those of a member
that learns, with their optimisers, and the policy that it acts with, its own archived latent filter and its actor."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from pydantic import ValidationError
from torch import Tensor, nn

from popgen.config.run_config import as_user_error
from popgen.config.schema import Schema
from popgen.envs.contract import EnvSpec
from popgen.losses.policy_losses import ReturnScale
from popgen.methods.xpm_wm.config import ACTING, AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.latent_filter import Latent, LatentFilter, player_masks
from popgen.nets import weights as w
from popgen.nets.blocks import mlp
from popgen.policies.portable_program import Program, ProgramWriter
from popgen.types import check_reset


def draw_by_inversion(
    log_probs: Float[Tensor, "*batch A"], generator: torch.Generator | None = None
) -> Int[Tensor, "*batch"]:
    """By inverting the cumulative distribution: one uniform number an action, the fewest draws; for imagination."""
    cumulative = log_probs.exp().cumsum(-1)
    uniform = torch.rand(cumulative.shape[:-1], generator=generator, device=cumulative.device)
    actions = (cumulative < uniform.unsqueeze(-1) * cumulative[..., -1:]).sum(-1)
    return actions.clamp(max=cumulative.shape[-1] - 1)


class Actor(nn.Module):
    """pi(a^i | h, z^i, seat): one network for both seats; seats are told apart by a one-hot.

    `actor_input=latent` drops h, the paper's literal pi(a^i | z^i).
    """

    masks: Tensor
    seats: Tensor

    def __init__(self, config: AgentConfig, model: WorldModelConfig, num_actions: int) -> None:
        super().__init__()
        self.config = config
        self.use_h = config.actor_input == "model"
        size = model.classes * model.groups
        inputs = size + 2 + (model.deter if self.use_h else 0)
        self.net = mlp(
            inputs,
            num_actions,
            units=config.units,
            layers=config.layers,
            activation=config.activation,
            norm=config.norm,
            output_scale=0.01,
        )
        self.register_buffer("masks", player_masks(model.groups, model.joint_groups, model.classes), persistent=False)
        self.register_buffer("seats", torch.eye(2), persistent=False)

    def inputs(self, latent: Latent, seat: Tensor) -> Tensor:
        """Network inputs of the players in `seat` (...,) int64, one per model state (..., .)."""
        dtype = latent.z.dtype  # a mask of more precision would widen the latents, which layers then narrow again
        parts = [latent.z * self.masks.to(dtype)[seat], self.seats.to(dtype)[seat]]
        return torch.cat([latent.h, *parts] if self.use_h else parts, -1)

    def log_probs(self, latent: Latent, seat: Tensor) -> Tensor:
        """(..., A) log-probabilities, mixed with a uniform share so that no action dies."""
        probs = torch.softmax(self.net(self.inputs(latent, seat)).float(), -1)
        uniform = self.config.unimix
        return torch.log(probs * (1.0 - uniform) + uniform / probs.shape[-1])

    @torch.no_grad()
    def sample(self, latent: Latent, seat: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """(...,) int64 actions."""
        return draw_by_inversion(self.log_probs(latent, seat), generator)

    def write_program(self, writer: ProgramWriter, h: str, z: str) -> Program:
        """The end of a program, from the vectors of the latent."""
        own = writer.add_operation("times", (z, writer.add_linear("seat", self.masks.T)))
        inputs = writer.add_operation("join", ([h] if self.use_h else []) + [own, "seat"])
        return writer.finish(writer.add_layers(self.net, inputs), unimix=self.config.unimix)


FIT_ROWS = 512
"""States in a step of `fit_actor`."""


class Fit(NamedTuple):
    """What `fit_actor` did: KL in nats from the wanted policy to the actor's, before and after, over the states."""

    before: float
    after: float


def fit_actor(
    actor: Actor,
    latent: Latent,
    wanted: Float[Tensor, "R P A"],
    steps: int,
    rng: np.random.Generator,
    *,
    rows: int = FIT_ROWS,
    rate: float = 1e-3,
) -> Fit:
    """Train `actor` until it acts in the states (R, .) as `wanted`, log-probabilities by seat, says.

    Args:
        steps: of Adam, each on `rows` random states in both seats.
        rate: Adam's step size.
    """
    both = torch.arange(wanted.shape[1], device=wanted.device)

    def divergence(part: Latent, target: Tensor) -> Tensor:
        log_probs = actor.log_probs(part.expand_players(), both.expand(target.shape[:2]))
        return F.kl_div(log_probs, target, reduction="none", log_target=True).sum(-1).mean()

    with torch.no_grad():
        before = float(divergence(latent, wanted))
    optimiser = torch.optim.Adam(actor.parameters(), lr=rate, fused=True)
    for _ in range(steps):
        picked = torch.from_numpy(rng.integers(0, len(wanted), size=rows)).to(wanted.device)
        optimiser.zero_grad(set_to_none=True)
        divergence(latent[picked], wanted[picked]).backward()
        optimiser.step()
    with torch.no_grad():
        return Fit(before, float(divergence(latent, wanted)))


class TwoHot(nn.Module):
    """Bins at symexp of an even grid over [-limit, limit]; exactly antisymmetric, so flat logits mean 0.

    An odd number of bins keeps one at 0. `limit` is in symlog units: 7 covers returns of about +-1,100.
    """

    bins: Tensor

    def __init__(self, bins: int, limit: float = 7.0) -> None:
        super().__init__()
        half = torch.expm1(torch.linspace(0.0, limit, bins // 2 + 1))[1:]
        middle = torch.zeros(bins % 2)
        self.register_buffer("bins", torch.cat([-half.flip(0), middle, half]), persistent=False)

    def mean(self, logits: Float[Tensor, "*batch K"]) -> Float[Tensor, "*batch"]:
        """The expected value."""
        return (torch.softmax(logits.float(), -1) * self.bins).sum(-1)

    def loss(self, logits: Float[Tensor, "*batch K"], target: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Cross-entropy (...) of the two-hot encoding of `target` (...) under logits (..., K)."""
        bins = self.bins
        target = target.detach().clamp(float(bins[0]), float(bins[-1])).contiguous()
        above = torch.searchsorted(bins, target).clamp(1, len(bins) - 1)
        low, high = bins[above - 1], bins[above]
        weight = (target - low) / (high - low)
        log_probs = torch.log_softmax(logits, -1)
        below_log = log_probs.gather(-1, (above - 1).unsqueeze(-1)).squeeze(-1)
        above_log = log_probs.gather(-1, above.unsqueeze(-1)).squeeze(-1)
        return -((1.0 - weight) * below_log + weight * above_log)


class Critic(nn.Module):
    """v(h, z, seat) of one pair of policies as a two-hot distribution over returns.

    The seat of agent j tells the two seatings of a cross-play pair apart; in self-play it is 0.
    """

    seats: Tensor

    def __init__(self, config: AgentConfig, model: WorldModelConfig) -> None:
        super().__init__()
        inputs = model.deter + model.classes * model.groups + 2
        self.net = mlp(
            inputs,
            config.bins,
            units=config.units,
            layers=config.layers,
            activation=config.activation,
            norm=config.norm,
            output_scale=0.0,
        )
        self.two_hot = TwoHot(config.bins)
        self.register_buffer("seats", torch.eye(2), persistent=False)

    def logits(self, latent: Latent, seat: Tensor) -> Tensor:
        """(..., bins)."""
        return self.net(torch.cat([latent.h, latent.z, self.seats.to(latent.z.dtype)[seat]], -1))

    def value(self, latent: Latent, seat: Tensor) -> Tensor:
        """(...) expected return."""
        return self.two_hot.mean(self.logits(latent, seat))

    def loss(self, latent: Latent, seat: Tensor, target: Tensor) -> Tensor:
        """Cross-entropy (...) against the returns `target` (...)."""
        return self.two_hot.loss(self.logits(latent, seat).float(), target)


# ---- networks that learn ---------------------------------------------------------------------------------------------

SELF = 0
"""Key of the self-play critic among the critics; cross-play critics are keyed by partner."""


class AgentNetworks:
    """Fresh networks on `device`; `rollout_actor` is the actor's copy in `dtype`, with which it acts in imagination.

    Args:
        partners: predecessors, each with a critic of its own.
        seed: of the initial weights.
    """

    def __init__(
        self,
        config: AgentConfig,
        model_config: WorldModelConfig,
        num_actions: int,
        partners: Iterable[int],
        seed: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.config, self.model_config, self.device, self.dtype = config, model_config, device, dtype
        torch.manual_seed(seed)
        self.actor = Actor(config, model_config, num_actions).to(device)
        self.return_range = ReturnScale(config.return_percentiles).to(device)
        self.critics = nn.ModuleDict({str(key): self._fresh_critic() for key in (SELF, *partners)})
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = self._make_optimiser(self.actor, config.actor_lr)
        self.critic_optimiser = self._make_optimiser(self.critics, config.critic_lr)
        self.rollout_actor = copy.deepcopy(self.actor).to(dtype).requires_grad_(False)

    def _fresh_critic(self) -> Critic:
        return Critic(self.config, self.model_config).to(self.device)

    def _make_optimiser(self, module: nn.Module, rate: float) -> torch.optim.Adam:
        return torch.optim.Adam(module.parameters(), lr=rate, eps=self.config.adam_eps, fused=True)

    def add_critic(self, partner: int) -> None:
        """A critic of cross-play with one more partner; the optimisers begin anew."""
        self.critics[str(partner)] = self._fresh_critic()
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = self._make_optimiser(self.actor, self.config.actor_lr)
        self.critic_optimiser = self._make_optimiser(self.critics, self.config.critic_lr)
        self.rollout_actor = copy.deepcopy(self.actor).to(self.dtype).requires_grad_(False)

    def critic(self, key: int, *, slow: bool = False) -> Critic:
        """The critic of a key, or its slow copy."""
        critic = (self.slow if slow else self.critics)[str(key)]
        assert isinstance(critic, Critic)
        return critic

    def step_actor(self, loss: Tensor) -> None:
        """One step of the actor down the gradient of `loss`."""
        self._step_down(self.actor_optimiser, loss, self.actor.parameters())

    def step_critics(self, loss: Tensor) -> None:
        """The same for the critics."""
        self._step_down(self.critic_optimiser, loss, self.critics.parameters())

    def _step_down(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Iterable[nn.Parameter]) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        w.clip_gradients(parameters, self.config.grad_clip)
        optimiser.step()

    @torch.no_grad()
    def update_copies(self) -> None:
        """Slow critics move towards the fast ones; the rollout copy of the actor is refreshed."""
        for slow, fast in zip(self.slow.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast, 1.0 - self.config.slow_critic)
        for rollout, trained in zip(self.rollout_actor.parameters(), self.actor.parameters(), strict=True):
            rollout.copy_(trained)

    def state(self) -> dict[str, Any]:
        """Weights and optimisers."""
        return {
            "actor": w.weights_of(self.actor),
            "critics": w.weights_of(self.critics),
            "slow": w.weights_of(self.slow),
            "scale": w.weights_of(self.return_range),
            "actor_optimiser": w.optimiser_state(self.actor_optimiser),
            "critic_optimiser": w.optimiser_state(self.critic_optimiser),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the contents with `state()`; the partners' critics must have been added before."""
        w.load_weights(self.actor, state["actor"])
        w.load_weights(self.critics, state["critics"])
        w.load_weights(self.slow, state["slow"])
        w.load_weights(self.return_range, state["scale"])
        w.load_weights(self.rollout_actor, state["actor"], cast=True)
        w.load_optimiser_state(self.actor_optimiser, state["actor_optimiser"])
        w.load_optimiser_state(self.critic_optimiser, state["critic_optimiser"])


# ---- the policy ------------------------------------------------------------------------------------------------------

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
        check_reset(None if self._latent is None else len(self._latent.h), len(is_first))
        assert self._latent is not None
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

    def to_program(self) -> Program:
        """See `popgen.policies.portable_program.Portable`."""
        if self.view != "features":
            raise ValueError(f"it reads the view {self.view!r}, programs read 'features'")
        if self._model.imagination != "mode":
            raise ValueError("its latents are drawn (imagination=sample), programs take the likeliest")
        writer = ProgramWriter()
        latent = self.filter.write_program(writer)
        return self.actor.write_program(writer, *latent)

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
