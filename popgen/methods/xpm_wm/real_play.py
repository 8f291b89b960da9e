"""Real play: who plays in the real environments, policies as they travel to samplers, and what play has shown: of a
policy, of the world, and of the imagination beside it. No torch here: the replay actors load this."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec, ViewSpec
from popgen.methods.training import Pending, PolicySnapshot, Sampled, State
from popgen.methods.xpm_wm.config import DiscoveryConfig, WatchConfig, WorldModelRun
from popgen.play.episodes import Episode
from popgen.play.rollout import Match
from popgen.policies.simple_policies import RandomPolicy
from popgen.types import RANDOM_MEMBER, Kind, Segment, Weights

Pair = tuple[int, int]


Put = Callable[[Any], Pending[Any]]
"""Into the workers' store."""


@dataclass(frozen=True)
class MemberWeights:
    """Handles of what a member's learner published: filter and actor (`acting`), critics, and the world model, of the
    same filter, that it learned in."""

    acting: Pending[Weights]
    critics: Pending[Weights]
    model: Pending[Weights]

    def to_state(self) -> State:
        """For a checkpoint."""
        return {"acting": self.acting, "critics": self.critics, "model": self.model}

    @staticmethod
    def from_state(state: State, put: Put) -> MemberWeights:
        """From `to_state()`, as it was read."""
        return MemberWeights(put(state["acting"]), put(state["critics"]), put(state["model"]))


def policy_snapshot(config: WorldModelRun, acting: Pending[Weights]) -> PolicySnapshot:
    """A member's policy as it travels to a sampler."""
    sizes = {"world_model": config.world_model.model_dump(mode="json"), "agent": config.agent.model_dump(mode="json")}
    return PolicySnapshot("world_model", sizes, acting)


def policy_snapshots(config: WorldModelRun, acting: Mapping[int, Pending[Weights]]) -> dict[int, PolicySnapshot]:
    """Policies of members by their acting weights."""
    return {member: policy_snapshot(config, weights) for member, weights in acting.items()}


def random_snapshot(spec: EnvSpec, interact: float, put: Put) -> PolicySnapshot:
    """The random player; where there is such an action, it interacts with probability `interact` (0: as any other)."""
    names, probabilities = spec.action_names, None
    if interact and "interact" in names:
        rest = (1.0 - interact) / (len(names) - 1)
        probabilities = [interact if name == "interact" else rest for name in names]
    random = RandomPolicy(spec.num_actions, probabilities)
    return PolicySnapshot(random.kind, random.config(), put({}))


def random_match(envs: int) -> Match:
    """Random play in all environments."""
    return Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), envs)


def self_play_match(member: int, envs: int) -> Match:
    """Self-play in all environments."""
    return Match(Kind.SP, (member, member), envs)


def seatings(member: int, partners: Sequence[int]) -> list[Pair]:
    """Every partner, in both seats."""
    return [pair for partner in partners for pair in ((member, partner), (partner, member))]


def seed_of_round(member_seed: int, number: int) -> int:
    """Of a later member's round, from 1 on; members' seeds follow one another, so from round 100 on it lies far off."""
    hundreds, place = divmod(number, 100)
    return member_seed * 100 + place + hundreds * 10**15


def later_matches(member: int, pairs: Sequence[Pair], episodes_sp: int, episodes_xp: int, seed: int) -> list[Match]:
    """Self-play, and cross-play of every pair, in an order drawn by `seed`: an episode in each environment."""
    if not pairs:
        return [self_play_match(member, episodes_sp)]
    order = np.random.default_rng(seed).permutation(len(pairs))
    counts = np.bincount(np.arange(episodes_xp) % len(pairs), minlength=len(pairs))
    cross = [Match(Kind.XP, pairs[i], int(n)) for i, n in zip(order, counts, strict=True)]
    return [self_play_match(member, episodes_sp), *cross]


def episodes_of(sampled: Sequence[Sampled]) -> list[Episode]:
    """The episodes that ended, in the samplers' order."""
    return [episode for one in sampled for episode in one.collected.episodes]


def steps_of(sampled: Sequence[Sampled]) -> int:
    """Environment steps of all of them."""
    return sum(one.collected.steps for one in sampled)


# ---- what play has shown ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Candidate:
    """A policy as it played some real episodes, and what it scored in self-play and strongest cross-play."""

    weights: MemberWeights
    sp: float
    xp: float

    def merit(self, xp_limit: float | None = None) -> float:
        """Self-play less the strongest cross-play: what a member is chosen by. Cross-play below its limit is worth no
        more than at it."""
        return self.sp - (self.xp if xp_limit is None else max(self.xp, xp_limit))

    def to_state(self) -> State:
        """For a checkpoint."""
        return {"published": self.weights.to_state(), "sp": self.sp, "xp": self.xp}

    @staticmethod
    def from_state(state: State, put: Put) -> Candidate:
        """From `to_state()`, as it was read."""
        return Candidate(MemberWeights.from_state(state["published"], put), float(state["sp"]), float(state["xp"]))


LEAST_PAY = 0.05
"""Imagined reward a step below which nothing is farmed: a pick-up every twenty steps."""


@dataclass
class Watch:
    """What a member's training has shown so far.

    Attributes:
        gap: rounds in a row in which imagination paid too much.
        best_precision: of events at one step, the highest so far.
        imprecise: reports in a row that were far below it.
        warned_of_pay: a line has said that imagination pays too much; a round in which it does not resets this.
        warned_of_precision: the same of precision.
    """

    gap: int = 0
    best_precision: float = 0.0
    imprecise: int = 0
    warned_of_pay: bool = False
    warned_of_precision: bool = False

    def look(self, figures: Mapping[str, float], report: Mapping[str, float], config: WatchConfig, rounds: int) -> str:
        """What is to be said after a round, "" if nothing.

        Args:
            figures: of the round.
            report: of the world model, where one has come in with the round.
            config: of the watch.
            rounds: how many in a row it takes to speak of a gap.
        """
        lines = [self._look_at_pay(figures, config, rounds), self._look_at_events(report, config)]
        return "; ".join(line for line in lines if line)

    def _look_at_pay(self, figures: Mapping[str, float], config: WatchConfig, rounds: int) -> str:
        imagined, real = figures.get("agent/imagined_shaped_sp"), figures.get("real_shaped_sp")
        if imagined is None or real is None or not config.imagined_factor:
            return ""
        if imagined <= max(LEAST_PAY, config.imagined_factor * real):
            self.gap, self.warned_of_pay = 0, False
            return ""
        self.gap += 1
        if self.gap < rounds or self.warned_of_pay:
            return ""
        self.warned_of_pay = True
        return (
            f"imagination has paid {imagined:.2f} a step and real self-play {real:.2f} for {self.gap} rounds, the "
            "actor may be farming the world model's errors: give the model more updates (phase1.model_updates, "
            "phase2.model_updates) or trust its events less (discovery.trust=2)"
        )

    def _look_at_events(self, report: Mapping[str, float], config: WatchConfig) -> str:
        precision = report.get("report/event_precision_step1")
        if precision is None or not config.precision_share:
            return ""
        self.best_precision = max(self.best_precision, precision)
        if precision >= config.precision_share * self.best_precision:
            self.imprecise, self.warned_of_precision = 0, False
            return ""
        self.imprecise += 1
        if self.imprecise < config.precision_reports or self.warned_of_precision:
            return ""
        self.warned_of_precision = True
        return (
            f"{precision:.0%} of the events that the world model predicts a step ahead are real, "
            f"{self.best_precision:.0%} were: give it more updates or a lower learning rate "
            "(world_model.learning_rate, phase2.model_lr)"
        )

    def to_state(self) -> State:
        """For a checkpoint, whose keys are older than the attributes' names."""
        counts = {"gap": self.gap, "best_precision": self.best_precision, "imprecise": self.imprecise}
        return counts | {"told": self.warned_of_pay, "told_precision": self.warned_of_precision}

    @staticmethod
    def from_state(state: State) -> Watch:
        """From `to_state()`, as it was read."""
        return Watch(
            gap=int(state["gap"]),
            best_precision=float(state["best_precision"]),
            imprecise=int(state["imprecise"]),
            warned_of_pay=bool(state["told"]),
            warned_of_precision=bool(state["told_precision"]),
        )


@dataclass(frozen=True)
class Tally:
    """Of all real self-play and random play.

    Attributes:
        events: (E,) int64, how often each happened to either player.
        own_events: (E,) int64, the same in the present member's self-play alone.
        own_steps: environment steps of that.
        keys: (K,) int64, ascending: players' own states that were seen.
        visits: (K,) int64, how often each.
        known: for each part of `ViewSpec.own`, (N,) int64, ascending: the values of that part that were seen.
    """

    events: np.ndarray
    own_events: np.ndarray
    own_steps: int
    keys: np.ndarray
    visits: np.ndarray
    known: tuple[np.ndarray, ...]


_LARGEST = 2**62


def part_weights(view: ViewSpec) -> tuple[np.ndarray, ...]:
    """For each part of a player's own entries, (N,) int64: their sum over the entries that are set is its value, and
    the sum of the parts' values the key of the state. The same for everyone who asks."""
    rng = np.random.default_rng(0)
    return tuple(rng.integers(1, _LARGEST, len(part), dtype=np.int64) for part in view.own)


class TallyKeeper:
    """Counts segments as they arrive.

    Args:
        env: encodes states.
        view: whose own states are counted; "" counts events alone.
    """

    def __init__(self, env: BatchedEnv, view: str) -> None:
        self.env, self.view = env, view
        self.parts = env.spec.views[view].own if view else ()
        self.weights = part_weights(env.spec.views[view]) if view else ()
        self.events: dict[tuple[int, str], np.ndarray] = {}
        self.steps: dict[tuple[int, str], int] = {}
        self.visits: dict[int, int] = {}
        self.known: list[set[int]] = [set() for _ in self.parts]

    def add(self, segment: Segment, owner: int) -> None:
        """Count a segment that was played for `owner`."""
        key = (owner, str(segment.kind))
        seen = segment.events.sum((0, 1, 2), dtype=np.int64)
        self.events[key] = self.events.get(key, np.zeros_like(seen)) + seen
        self.steps[key] = self.steps.get(key, 0) + segment.steps
        if self.parts:
            self._count_states(segment.states)

    def _count_states(self, states: np.ndarray) -> None:
        obs = self.env.encode(states.reshape(-1, states.shape[-1]), self.view).reshape(-1, *self._parts_shape())
        parts = zip(self.parts, self.weights, strict=True)
        values = [(obs[:, list(part)] > 0).astype(np.int64) @ weights for part, weights in parts]
        for known, value in zip(self.known, values, strict=True):
            known.update(np.unique(value).tolist())
        for key, count in zip(*np.unique(np.sum(values, 0), return_counts=True), strict=True):
            self.visits[int(key)] = self.visits.get(int(key), 0) + int(count)

    def _parts_shape(self) -> tuple[int, ...]:
        return self.env.spec.views[self.view].shape

    def tally(self, owner: int) -> Tally:
        """So far, with `owner` as the present member."""
        none = np.zeros(self.env.spec.num_events, np.int64)
        own = (owner, str(Kind.SP))
        keys = np.array(sorted(self.visits), np.int64)
        visits = np.array([self.visits[int(key)] for key in keys], np.int64)
        known = tuple(np.array(sorted(part), np.int64) for part in self.known)
        total = sum(self.events.values(), none)
        return Tally(total, self.events.get(own, none), self.steps.get(own, 0), keys, visits, known)

    def state(self) -> dict[str, Any]:
        """Everything counted."""
        return {
            "events": [[owner, kind, counts.tolist()] for (owner, kind), counts in self.events.items()],
            "steps": [[owner, kind, steps] for (owner, kind), steps in self.steps.items()],
            "visits": np.array(list(self.visits.items()), np.int64).reshape(-1, 2),
            "known": [sorted(part) for part in self.known],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Replace the contents with `state()`."""
        self.events = {(int(o), str(kind)): np.array(counts, np.int64) for o, kind, counts in state["events"]}
        self.steps = {(int(o), str(kind)): int(steps) for o, kind, steps in state["steps"]}
        self.visits = {int(key): int(count) for key, count in np.asarray(state["visits"]).tolist()}
        self.known = [set(map(int, part)) for part in state["known"]]


def event_pay(config: DiscoveryConfig, spec: EnvSpec) -> np.ndarray:
    """(E,) float64: what each event pays in imagination."""
    return np.asarray(spec.event_weights, np.float64) * [config.event_factors.get(n, 1.0) for n in spec.event_names]


def goes_by_tally(config: DiscoveryConfig) -> bool:
    """Whether anything depends on what real play has shown."""
    return bool(config.count_bonus or config.found_events or config.rare_events or config.trust)


class HasTally(Protocol):
    """Workers, or what answers for them."""

    def tally(self, member: int) -> Pending[Tally]: ...


def read_tally(work: HasTally, member: int, config: DiscoveryConfig) -> Tally | None:
    """What real play has shown so far, with `member` as the present one; None where nothing goes by it."""
    return work.tally(member).result() if goes_by_tally(config) else None


def rare_events(tally: Tally | None, config: DiscoveryConfig) -> tuple[int, ...]:
    """Events that real play has shown too seldom to imagine what follows them."""
    return () if tally is None else tuple(np.flatnonzero(tally.events < config.rare_events).tolist())
