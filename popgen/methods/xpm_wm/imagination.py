"""Imagination: states to start from, the prior rolled forward under joint actors, what it pays, what is learned from
it, and what is believed.

The rollout is Algorithm 1's lines 8 and 10. `Discovery` is for tasks where a reward lies behind a long chain of events
that play does not show yet (docs/notes/learning.md, The counter circuit): a bonus for states of a player that real play
has hardly seen, events that count only as far as they happen in reality as often as in imagination, and trajectories
that end where the model has seen too little to go on. `PayLimits` holds later members to what real play has earned (A
delivery in every step, in the same notes).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.config import AgentConfig, DiscoveryConfig
from popgen.methods.xpm_wm.latent_filter import Latent, from_indices
from popgen.methods.xpm_wm.real_play import Tally, event_pay, part_weights
from popgen.methods.xpm_wm.replay import NEW_SP, NEW_XP, OLD
from popgen.methods.xpm_wm.world_model import PlayerDecoder, Starts, WorldModel

# ---- states to start from --------------------------------------------------------------------------------------------


def draw_self_play(
    starts: Starts, count: int, new_share: float, from_xp: float, rng: np.random.Generator
) -> np.ndarray:
    """Rows for imagined self-play: SP *and* XP states (paper, eq. XPM-Sim), which makes mixed play unnecessary.

    `new_share` of them come from this member's own data if there is any, of which `from_xp` from cross-play.
    """
    pools = [np.flatnonzero(starts.pool == pool) for pool in (OLD, NEW_SP, NEW_XP)]
    shares = np.array([1.0 - new_share, new_share * (1.0 - from_xp), new_share * from_xp])
    return _draw_mixture(pools, shares, count, rng)


def draw_cross_play(
    starts: Starts, count: int, new_share: float, partner: int | None, rng: np.random.Generator
) -> np.ndarray:
    """Rows for imagined cross-play with `partner`: XP states recorded with that partner (None: any partner).

    Until such states exist, and for the share of old data, the kept buffer stands in (Algorithm 1 fills
    B_XP with random episodes before anything else).
    """
    own = starts.pool == NEW_XP
    if partner is not None:
        own = own & (starts.partner == partner)
    pools = [np.flatnonzero(starts.pool == OLD), np.flatnonzero(own)]
    return _draw_mixture(pools, np.array([1.0 - new_share, new_share]), count, rng)


def _draw_mixture(pools: list[np.ndarray], shares: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    shares = np.where([len(pool) > 0 for pool in pools], np.maximum(shares, 1e-9), 0.0)
    if not shares.any():
        raise LookupError("there are no states to start imagination from")
    sizes = rng.multinomial(count, shares / shares.sum())
    return np.concatenate([rng.choice(pool, size) for pool, size in zip(pools, sizes, strict=True) if size])


# ---- the rollout -----------------------------------------------------------------------------------------------------


JointActor = Callable[[Latent], Int[Tensor, "B P"]]
"""Joint actions for a batch of model states."""


@dataclass(frozen=True)
class Imagined:
    """Trajectories of H steps in B columns, on one device.

    Attributes:
        latent: model states, h (H + 1, B, D) and z (H + 1, B, C * G); the first are those to start from.
        actions: of both players.
        reward: what each step earned.
        keep: probability that the episode goes on after the step.
        running: probability that it still ran before the step.
    """

    latent: Latent
    actions: Int[Tensor, "H B P"]
    reward: Float[Tensor, "H B"]
    keep: Float[Tensor, "H B"]
    running: Float[Tensor, "H B"]

    def of_columns(self, columns: slice) -> Imagined:
        """Part of the batch."""
        return Imagined(
            Latent(self.latent.h[:, columns], self.latent.z[:, columns]),
            self.actions[:, columns],
            self.reward[:, columns],
            self.keep[:, columns],
            self.running[:, columns],
        )


class Paid(NamedTuple):
    """What arriving in states earned, and the probability that the episode goes on from them."""

    reward: Float[Tensor, "*batch"]
    keep: Float[Tensor, "*batch"]


Pay = Callable[[WorldModel, Latent], Paid]


def expected_pay(model: WorldModel, arrived: Latent) -> Paid:
    """As the world model predicts it."""
    return Paid(model.reward(arrived).float(), model.continuation(arrived).float())


@torch.no_grad()
def imagine(
    model: WorldModel,
    act: JointActor,
    start: Latent,
    horizon: int,
    generator: torch.Generator | None = None,
    pay: Pay = expected_pay,
) -> Imagined:
    """Roll the prior forward for `horizon` steps from start (B, .) with the joint policy `act`."""
    states, actions = [start], []
    for _ in range(horizon):
        joint = act(states[-1])
        actions.append(joint)
        states.append(model.step(states[-1], joint, generator))
    latent = Latent(torch.stack([s.h for s in states]), torch.stack([s.z for s in states]))
    reward, keep = pay(model, latent[1:])
    return Imagined(latent, torch.stack(actions), reward, keep, find_running(keep))


def find_running(keep: Float[Tensor, "H B"]) -> Float[Tensor, "H B"]:
    """Probability that an episode still runs before each step, from those that it goes on after each."""
    return torch.cat([torch.ones_like(keep[:1]), keep[:-1]]).cumprod(0)


def find_excessive_pay(reward: Float[Tensor, "H B"], limits: np.ndarray) -> Bool[Tensor, "H B"]:
    """Steps with which the last 1, 2, ... steps together have earned more than `limits` (H,) says of so many."""
    earned = torch.cat([torch.zeros_like(reward[:1]), reward.cumsum(0)])
    excessive = torch.zeros_like(reward, dtype=torch.bool)
    for steps, limit in enumerate(limits[: len(reward)].tolist(), 1):
        excessive[steps - 1 :] |= earned[steps:] - earned[:-steps] > limit
    return excessive


class PayLimits:
    """Holds imagination to what real play has earned.

    Attributes:
        most: (H,) what the last 1, 2, ... steps of a trajectory may earn; None: anything.
        exceeded: share of the latest trajectories that would have earned more.
    """

    def __init__(self) -> None:
        self.most: np.ndarray | None = None
        self.exceeded = 0.0

    def hold(self, imagined: Imagined) -> Imagined:
        """Trajectories end with their first excessive step, which earns nothing."""
        if self.most is None:
            return imagined
        excessive = find_excessive_pay(imagined.reward, self.most)
        self.exceeded = float(excessive.any(0).float().mean())
        reward, keep = (values.masked_fill(excessive, 0.0) for values in (imagined.reward, imagined.keep))
        return replace(imagined, reward=reward, keep=keep, running=find_running(keep))

    def figures(self) -> dict[str, float]:
        """For the logs."""
        return {} if self.most is None else {"excessive_pay": self.exceeded}


# ---- a batch of self-play and cross-play -----------------------------------------------------------------------------


class ImaginedPlay(NamedTuple):
    """B columns of self-play and, after them, N of cross-play; in the latter, the agent's seat."""

    imagined: Imagined
    seats: Int[Tensor, " N"]


def draw_start_rows(
    config: AgentConfig, starts: Starts, new_share: float, partner: int | None, rng: np.random.Generator
) -> np.ndarray:
    """Rows of `starts` for a batch: `starts_sp` of self-play and, with a partner, `starts_xp` of cross-play."""
    rows = draw_self_play(starts, config.starts_sp, new_share, config.sp_from_xp, rng)
    if partner is None or not config.starts_xp:
        return rows
    only = partner if config.xp_starts == "partner" else None
    return np.concatenate([rows, draw_cross_play(starts, config.starts_xp, new_share, only, rng)])


def start_latents(starts: Starts, rows: np.ndarray, classes: int, device: torch.device, dtype: torch.dtype) -> Latent:
    """The stored model states of `rows`."""
    z = from_indices(torch.from_numpy(starts.z[rows]).to(device), classes).flatten(-2)
    return Latent(torch.from_numpy(starts.h[rows]).to(device, dtype), z.to(dtype))


def cross_play_seats(count: int, device: torch.device) -> Int[Tensor, " {count}"]:
    """The agent's seat: 0 in the first half, 1 in the second."""
    return (torch.arange(count, device=device) >= count // 2).long()


def joint_actor(
    own: Actor, partner: Actor | None, first: int, seats: Int[Tensor, " N"], generator: torch.Generator
) -> JointActor:
    """Both seats by `own`, but for the other seat than `seats` in the columns from `first` on, which is `partner`'s."""
    both = torch.tensor([0, 1], device=seats.device)
    columns = first + torch.arange(len(seats), device=seats.device)

    def act(latent: Latent) -> Int[Tensor, "B P"]:
        pair = latent.expand_players()
        actions = own.sample(pair, both.expand(pair.h.shape[:-1]), generator)
        if partner is not None:
            actions[columns, 1 - seats] = partner.sample(latent[first:], 1 - seats, generator)
        return actions

    return act


# ---- what is learned from it -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """R imagined states of one pair of policies; no gradient flows into them.

    Attributes:
        key: of the critic that learns from them.
        latent: h (R, D) and z (R, C * G), what that critic sees.
        seat: what it sees beside them.
        returns: its targets.
        seats: where the member sat: K is 2 in self-play, 1 in cross-play.
        actions: what it did there.
        advantage: with the objective's sign, weight and unit.
        running: probability that the imagined episode still runs.
        entropy_scale: of the bonus in these states.
        log_prob: of the actions under the policy that took them; None where one step is taken on the whole batch.
    """

    key: int
    latent: Latent
    seat: Int[Tensor, " R"]
    returns: Float[Tensor, " R"]
    seats: Int[Tensor, "R K"]
    actions: Int[Tensor, "R K"]
    advantage: Float[Tensor, " R"]
    running: Float[Tensor, " R"]
    entropy_scale: float
    log_prob: Float[Tensor, "R K"] | None = None

    @staticmethod
    def from_imagined(
        imagined: Imagined,
        key: int,
        seats: Int[Tensor, "B K"],
        returns: Float[Tensor, "H B"],
        advantage: Float[Tensor, "H B"],
        entropy_scale: float,
    ) -> Samples:
        """A row for each of the R = H * B states of trajectories: `seats` are the member's, the critic sees the first
        of them."""
        steps, batch = imagined.reward.shape
        seats = seats.expand(steps, batch, -1)
        latent, actions = imagined.latent[:-1], imagined.actions.gather(-1, seats)
        return Samples(
            key=key,
            latent=Latent(latent.h.flatten(0, 1), latent.z.flatten(0, 1)),
            seat=seats[..., 0].flatten(0, 1),
            returns=returns.flatten(0, 1),
            seats=seats.flatten(0, 1),
            actions=actions.flatten(0, 1),
            advantage=advantage.flatten(0, 1),
            running=imagined.running.flatten(0, 1),
            entropy_scale=entropy_scale,
        )

    def __len__(self) -> int:
        return len(self.returns)

    def __getitem__(self, rows: Int[Tensor, " N"]) -> Samples:
        return replace(
            self,
            latent=self.latent[rows],
            seat=self.seat[rows],
            returns=self.returns[rows],
            seats=self.seats[rows],
            actions=self.actions[rows],
            advantage=self.advantage[rows],
            running=self.running[rows],
            log_prob=None if self.log_prob is None else self.log_prob[rows],
        )

    def minibatches(self, parts: int, generator: torch.Generator) -> list[Samples]:
        """All rows in random order in so many parts; as they are if that is one."""
        if parts == 1:
            return [self]
        order = torch.randperm(len(self), generator=generator, device=self.returns.device)
        return [self[rows] for rows in torch.tensor_split(order, parts)]


# ---- what is believed, and what real play has hardly seen ------------------------------------------------------------


LEAST_TRUST = 0.01
"""Share of its weight that an imagined event keeps in any case."""
NEWEST = 0.5
"""Weight of the latest rates in their moving averages."""


class Rates(NamedTuple):
    """Events of each type in a step of the task, (E,) float64: in imagination and in real play."""

    imagined: np.ndarray
    real: np.ndarray


def trusted_shares(rates: Rates, factor: float) -> np.ndarray:
    """(E,) float64 within [LEAST_TRUST, 1]: what an imagined event counts for, `factor` times its real rate over its
    imagined one."""
    return np.clip(factor * rates.real / np.maximum(rates.imagined, 1e-12), LEAST_TRUST, 1.0)


def find_highest_paying(spec: EnvSpec) -> np.ndarray:
    """(E,) bool: events that pay at least half of what the highest-paying one pays."""
    weights = np.asarray(spec.event_weights)
    return weights >= max(0.5 * weights.max(), 1e-9)


class Discovery:
    """What an agent's learner knows of real play beside the world model.

    Give it a tally before updates; nothing changes in imagination where all options are off.

    Attributes:
        tally: of real play; None before there is one.
        shares: (E,) what an imagined event counts for.
        rates: moving averages, from the first comparison on.
        seen: events and steps of the member's own play at the last comparison.
    """

    def __init__(self, config: DiscoveryConfig, spec: EnvSpec, view: str, device: torch.device) -> None:
        self.config, self.spec, self.view, self.device = config, spec, spec.views[view], device
        self.weights = event_pay(config, spec)
        self.highest_paying = find_highest_paying(spec)
        self.tally: Tally | None = None
        self.shares = np.ones(spec.num_events)
        self.rates: Rates | None = None
        self.seen = (np.zeros(spec.num_events, np.int64), 0)

    @property
    def changes_pay(self) -> bool:
        """Whether what imagined events pay differs from the environment's weights."""
        return bool(self.config.event_factors or self.config.trust or self.config.rare_events)

    def found(self) -> bool:
        """Whether the highest-paying events have been seen often enough to count as found."""
        if self.tally is None or not self.config.found_events:
            return False
        return int(self.tally.events[self.highest_paying].sum()) >= self.config.found_events

    def bonus_scale(self, self_play_has_begun: bool) -> float:
        """Scale of the count bonus: halved once the highest-paying event is found, 0 once real self-play has begun."""
        if self_play_has_begun or self.tally is None:
            return 0.0
        return self.config.count_bonus * (0.5 if self.found() else 1.0)

    # ---- pay ---------------------------------------------------------------------------------------------------------

    def pay(self, model: WorldModel, arrived: Latent) -> Paid:
        """Reward and continuation of imagined states; an event that has been seen too rarely pays and ends them."""
        events = model.event_probs(arrived).float()
        players = self.spec.num_players
        worth = self.weights * self.shares * self.scaffold_shares()
        weights = torch.as_tensor(np.tile(worth, players), dtype=torch.float32)
        keep = model.continuation(arrived).float()
        if self.config.rare_events and self.tally is not None:
            rare = np.tile(self.tally.events < self.config.rare_events, players)
            happened = (events > 0.5) & torch.as_tensor(rare, device=self.device)
            keep = torch.where(happened.any(-1), torch.zeros_like(keep), keep)
        return Paid((events * weights.to(self.device)).sum(-1), keep)

    def scaffold_shares(self) -> np.ndarray:
        """(E,) float64 within [0, 1]: what is left of the pay of events that only lead to others."""
        shares, names, rates = np.ones(self.spec.num_events), self.spec.event_names, self.rates
        if rates is None:
            return shares
        for name, goal in self.config.scaffolds.items():
            reached = rates.real[names.index(goal)] / max(self.config.scaffold_until, 1e-12)
            shares[names.index(name)] = max(0.0, 1.0 - reached)
        return shares

    def bonus(self, model: WorldModel, arrived: Latent, scale: float) -> Float[Tensor, "*batch"]:
        """For each player `scale` / sqrt(1 + n), n the real visits of the state of its own that the model shows. A
        state with a part that was never seen is no new combination, but a blur: it earns nothing."""
        assert self.tally is not None
        total = torch.zeros(arrived.h.shape[:-1], device=self.device)
        weights = part_weights(self.view)
        columns = torch.tensor([entry for part in self.view.own for entry in part], device=self.device)
        for player, decoder in enumerate(model.decoders):
            assert isinstance(decoder, PlayerDecoder)
            shown = decoder.entries(model.player_latent(arrived, player), columns) > 0.0
            parts = shown.split([len(part) for part in self.view.own], -1)
            values = [
                (part * torch.as_tensor(one, device=self.device)).sum(-1)
                for part, one in zip(parts, weights, strict=True)
            ]
            total += self._bonus_of(values)
        return scale * total

    def _bonus_of(self, values: list[Int[Tensor, "*batch"]]) -> Float[Tensor, "*batch"]:
        """1 / sqrt(1 + n) of states with these values of their parts."""
        assert self.tally is not None
        valid = torch.ones_like(values[0], dtype=torch.bool)
        for value, known in zip(values, self.tally.known, strict=True):
            valid &= torch.isin(value, torch.as_tensor(known, device=self.device))
        key = torch.stack(values).sum(0)
        keys = torch.as_tensor(self.tally.keys, device=self.device)
        at = torch.searchsorted(keys, key).clamp(max=len(keys) - 1)
        visits = torch.as_tensor(self.tally.visits, device=self.device)[at] * (keys[at] == key)
        return valid / torch.sqrt(1.0 + visits)

    # ---- trust -------------------------------------------------------------------------------------------------------

    def compare(self, imagined: np.ndarray, tally: Tally) -> dict[str, float]:
        """Take in imagined events a step (E,), and the real ones since the last comparison; figures of both."""
        events, steps = self.seen
        new_steps = tally.own_steps - steps
        if new_steps < 1:
            return {}
        new = Rates(imagined, (tally.own_events - events + 0.5) / new_steps)
        self.seen = (tally.own_events, tally.own_steps)
        old = self.rates or new
        mixed = [(1.0 - NEWEST) * before + NEWEST * now for before, now in zip(old, new, strict=True)]
        self.rates = Rates(*mixed)
        self.shares = trusted_shares(self.rates, self.config.trust)
        figures: dict[str, float] = {}
        for index, name in enumerate(self.spec.event_names):
            figures[f"trust_{name}"] = float(self.shares[index])
            figures[f"imagined_rate_{name}"] = float(new.imagined[index])
            figures[f"real_rate_{name}"] = float(new.real[index])
        return figures

    # ---- what is kept ------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything but the tally, which comes with every task."""
        rates = {} if self.rates is None else {"imagined": self.rates.imagined, "real": self.rates.real}
        return {"shares": self.shares, "rates": rates, "events": self.seen[0], "steps": self.seen[1]}

    def load_state(self, state: dict[str, Any]) -> None:
        """Replace the contents with `state()`."""
        rates = {name: np.array(values, np.float64) for name, values in state["rates"].items()}
        self.shares = np.array(state["shares"], np.float64)
        self.rates = Rates(**rates) if rates else None
        self.seen = (np.array(state["events"], np.int64), int(state["steps"]))
