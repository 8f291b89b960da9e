"""Play of an ego beside partners, or with itself, as its learner wants it.

A row is a seat that the ego holds: one in each environment beside partners, all seats in self-play. Row t holds the
state s_t that was seen, the action taken in it and what that gave; episodes follow each other in a column.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from popgen.envs.contract import BatchedEnv
from popgen.envs.reward import training_reward
from popgen.methods.ego.augmented_starts import AugmentedStarts
from popgen.methods.ego.config import HiptConfig
from popgen.methods.ego.ego_networks import EgoNet
from popgen.methods.ego.partner_seats import PartnerSeats
from popgen.methods.ego.two_levels import draw_durations, influence_of_skill
from popgen.nets.blocks import draw_by_gumbel
from popgen.nets.feed_forward import joint_copies
from popgen.play.stacked_partners import PartnerPool


class EndedEpisode(NamedTuple):
    """A whole episode: the partner's number (-1 in self-play) and seat, score, undiscounted training reward."""

    partner: int
    seat: int
    score: float
    shaped: float


@dataclass(frozen=True)
class Choices:
    """What the high level did, (T, R) each; log_prob counts where it decides.

    Attributes:
        skill: the z of each step. decides: it was drawn at this step. log_prob: of the draw.
        influence: u of each step.
    """

    skill: Tensor
    decides: Tensor
    log_prob: Tensor
    influence: Tensor


@dataclass(frozen=True)
class Rollout:
    """T steps of R rows.

    Attributes:
        seen: (T, R, *view.shape), what the row's seat saw. extras: (T, R, X), see `EgoNet.make_extras`.
        judged: (T + 1, R, C), the joint features for critics. who: (T + 1, R, W), seat and partner as one-hot numbers.
        is_first: (T, R) bool. state: (T / L, R, S), the memory before each sequence of L steps.
        actions, log_prob, reward: (T, R). done: (T, R) bool, terminated or cut.
        cut_at: (K, 2), step and row of each end that was cut, which bootstraps from cut_judged (K, C), cut_who (K, W).
        choices: of the high level, None for one level.
        episodes: whole ones that ended.
        steps: environment steps, which self-play's rows share. simulated: those that moved augmented starts on.
    """

    seen: Tensor
    extras: Tensor
    judged: Tensor
    who: Tensor
    is_first: Tensor
    state: Tensor
    actions: Tensor
    log_prob: Tensor
    reward: Tensor
    done: Tensor
    cut_at: Tensor
    cut_judged: Tensor
    cut_who: Tensor
    choices: Choices | None
    episodes: list[EndedEpisode]
    steps: int
    simulated: int


@dataclass(frozen=True)
class Company:
    """Whom the ego plays with; without a pool and seats, itself.

    Attributes:
        pool: how the partners act. seats: who sits where.
        starts: other start states than the environment's, None for none.
    """

    pool: PartnerPool | None = None
    seats: PartnerSeats | None = None
    starts: AugmentedStarts | None = None

    @property
    def parts(self) -> dict[str, PartnerPool | PartnerSeats | AugmentedStarts]:
        """Those that there are, each with a state of its own."""
        parts = {"pool": self.pool, "seats": self.seats, "starts": self.starts}
        return {name: part for name, part in parts.items() if part is not None}


class EgoSampler:
    """Steps N environments with one ego in each; episodes continue from one rollout to the next.

    Args:
        env: N environments. net: the ego's, called as it is at the time.
        company: its partners.
        levels: durations of z, None for one level.
        unroll, sequence: T and L.
        seed: of environments and draws.
    """

    def __init__(
        self,
        env: BatchedEnv,
        net: EgoNet,
        company: Company,
        levels: HiptConfig | None,
        *,
        unroll: int,
        sequence: int,
        seed: int,
    ) -> None:
        self.env, self.net, self.company, self.levels = env, net, company, levels
        self.unroll, self.sequence = unroll, sequence
        count, spec = env.num_envs, env.spec
        self.self_play = company.pool is None
        self.env_of_row = np.repeat(np.arange(count), spec.num_players if self.self_play else 1)
        self._copies = joint_copies(spec.views["features"])
        self._views = {self.net.sizes.view, "features", *(company.pool.views if company.pool else ())}
        self._generator = torch.Generator().manual_seed(seed)
        rows = len(self.env_of_row)
        env.reset(seed=seed)
        env.set_time(_stagger_ends(env, unroll, 1 if company.seats is None else company.seats.cells))
        self._whole = env.time(env.get_state()) == 0
        self._previous = np.zeros((count, spec.num_players), np.uint8)
        self._first = np.ones(count, bool)
        self._score, self._shaped = np.zeros(count), np.zeros(count)
        self._state = torch.zeros(rows, net.state_size)
        self._skill, self._left = torch.zeros(rows, dtype=torch.int64), torch.zeros(rows, dtype=torch.int64)

    # ---- one rollout ---------------------------------------------------------------------------------------------

    @torch.no_grad()
    def play(self) -> Rollout:
        """T steps of all environments."""
        columns: defaultdict[str, list[Any]] = defaultdict(list)
        episodes: list[EndedEpisode] = []
        for t in range(self.unroll):
            seen = self._observe()
            if t % self.sequence == 0:
                columns["state"].append(self._state)
            own = self._choose_actions(columns, seen, fresh=t == 0)
            actions = self._join_actions(own, seen)
            if self.company.starts is not None:
                self.company.starts.see(self.env.get_state())
            result = self.env.step(actions)
            reward, done = training_reward(self.env.spec, result), result.done
            columns["reward"].append(torch.from_numpy(reward[self.env_of_row]))
            columns["done"].append(torch.from_numpy(done[self.env_of_row]))
            self._score += result.score
            self._shaped += reward
            self._note_cuts(columns, t, np.flatnonzero(result.truncated & ~result.terminated))
            self._previous, self._first = actions, done.copy()
            if done.any():
                episodes += self._end_episodes(np.flatnonzero(done))
        self._judge(columns, self._observe())
        simulated = 0 if self.company.starts is None else self.company.starts.take_simulated()
        return _stack_columns(columns, episodes, self.unroll * self.env.num_envs, simulated)

    def _observe(self) -> dict[str, np.ndarray]:
        states = self.env.get_state()
        return {view: self.env.encode(states, view) for view in self._views}

    @property
    def _row_seats(self) -> np.ndarray:
        """(R,) the ego's seat in each row."""
        if self.company.seats is None:
            return np.tile(np.arange(self.env.spec.num_players), self.env.num_envs)
        return 1 - self.company.seats.seat

    def _judge(self, columns: dict[str, list[Any]], seen: dict[str, np.ndarray]) -> None:
        """What critics look at: the joint features from the row's seat, and who plays."""
        seats, rows, features = self._row_seats, self.env_of_row, seen["features"]
        judged = [_pick_rows(features, rows, seats)]
        if self._copies == 2:
            judged.append(_pick_rows(features, rows, 1 - seats))
        columns["judged"].append(torch.cat(judged, -1))
        who = [F.one_hot(torch.from_numpy(seats), self.env.spec.num_players)]
        if self.company.seats is not None and self.company.pool is not None:
            who.append(F.one_hot(torch.from_numpy(self.company.seats.partner), len(self.company.pool.policies)))
        columns["who"].append(torch.cat(who, -1).float())

    def _choose_actions(self, columns: dict[str, list[Any]], seen: dict[str, np.ndarray], *, fresh: bool) -> np.ndarray:
        """The ego's actions (R,), and all that is kept of this choice."""
        self._judge(columns, seen)
        net, seats, rows = self.net, self._row_seats, self.env_of_row
        obs = _pick_rows(seen[net.sizes.view], rows, seats)
        own, other = (_pick_rows(self._previous, rows, s).long() for s in (seats, 1 - seats))
        first = torch.from_numpy(self._first[self.env_of_row])
        extras = net.make_extras(torch.from_numpy(seats), own, other, first)
        remembered = net.remember(net.encode(obs, extras).unsqueeze(0), self._state, first.unsqueeze(0))
        self._state, memory = remembered.state, remembered.outputs[0]
        logits = net.action_logits(memory) if self.levels is None else self._decide(columns, memory, first, fresh)
        drawn = draw_by_gumbel(logits, self._generator)
        kept = {"seen": obs, "extras": extras, "is_first": first, "actions": drawn.action, "log_prob": drawn.log_prob}
        for name, value in kept.items():
            columns[name].append(value)
        return drawn.action.numpy().astype(np.uint8)

    def _decide(self, columns: dict[str, list[Any]], memory: Tensor, first: Tensor, fresh: bool) -> Tensor:
        """Choose z where one is due, at the beginning of a rollout everywhere; the action logits under it."""
        assert self.levels is not None
        decides = first | (self._left == 0) | torch.full_like(first, fresh)
        skill_logits, by_skill = self.net.skill_logits(memory), self.net.logits_by_skill(memory)
        drawn = draw_by_gumbel(skill_logits, self._generator)
        levels = self.levels
        durations = draw_durations(len(memory), levels.duration_least, levels.duration_most, self._generator)
        self._skill = torch.where(decides, drawn.action, self._skill)
        self._left = torch.where(decides, durations, self._left) - 1
        columns["skill"].append(self._skill)
        columns["decides"].append(decides)
        columns["skill_log_prob"].append(drawn.log_prob)
        columns["influence"].append(influence_of_skill(skill_logits, by_skill, self._skill))
        index = self._skill.view(-1, 1, 1).expand(-1, 1, by_skill.shape[-1])
        return by_skill.gather(1, index).squeeze(1)

    def _join_actions(self, own: np.ndarray, seen: dict[str, np.ndarray]) -> np.ndarray:
        """Joint actions (N, P) of the ego's rows and the partners."""
        if self.company.pool is None or self.company.seats is None:
            return own.reshape(self.env.num_envs, -1)
        seats = self.company.seats
        partner, seat = seats.partner, seats.seat
        actions = np.empty((self.env.num_envs, 2), np.uint8)
        rows = np.arange(self.env.num_envs)
        actions[rows, 1 - seat] = own
        actions[rows, seat] = self.company.pool.act(seen, self._previous, self._first, partner, seat)
        return actions

    def _note_cuts(self, columns: dict[str, list[Any]], step: int, envs: np.ndarray) -> None:
        """Ends of episodes that bootstrap, with what they led to."""
        if not len(envs):
            return
        ended: dict[str, list[Any]] = {"judged": [], "who": []}
        self._judge(ended, self._observe())
        rows = torch.from_numpy(np.flatnonzero(np.isin(self.env_of_row, envs)))
        columns["cut_at"].append(torch.stack([torch.full_like(rows, step), rows], -1))
        columns["cut_judged"].append(ended["judged"][0][rows])
        columns["cut_who"].append(ended["who"][0][rows])

    def _end_episodes(self, envs: np.ndarray) -> list[EndedEpisode]:
        """Whole episodes among those that ended; all of them begin anew, perhaps with another partner."""
        company, whole = self.company, envs[self._whole[envs]]
        episodes = []
        for n in whole.tolist():
            where = (-1, 0) if company.seats is None else (int(company.seats.partner[n]), int(company.seats.seat[n]))
            episodes.append(EndedEpisode(*where, float(self._score[n]), float(self._shaped[n])))
        if company.seats is not None:
            company.seats.note_returns(whole, self._shaped[whole])
            company.seats.move_on(envs)
        self.env.reset(indices=envs)
        self._whole[envs], self._score[envs], self._shaped[envs] = True, 0.0, 0.0
        if company.starts is not None:
            self._whole[envs[company.starts.begin(envs)]] = False
        return episodes

    # ---- checkpoints ---------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here, except the networks."""
        return {
            "env": self.env.get_state(),
            "env_generator": self.env.generator_state(),
            "generator": self._generator.get_state().numpy(),
            "previous": self._previous.copy(),
            "first": self._first.copy(),
            "whole": self._whole.copy(),
            "score": self._score.copy(),
            "shaped": self._shaped.copy(),
            "memory": self._state.numpy().copy(),
            "skill": self._skill.numpy().copy(),
            "left": self._left.numpy().copy(),
            "company": {name: part.state() for name, part in self.company.parts.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()` of a sampler of the same environments and partners."""
        self.env.set_state(np.array(state["env"]))
        self.env.load_generator_state(state["env_generator"])
        self._generator.set_state(torch.from_numpy(np.array(state["generator"])))
        self._previous = np.array(state["previous"], np.uint8).reshape(self._previous.shape)
        self._first = np.array(state["first"], bool).reshape(self._first.shape)
        self._whole = np.array(state["whole"], bool).reshape(self._whole.shape)
        self._score = np.array(state["score"], np.float64).reshape(self._score.shape)
        self._shaped = np.array(state["shaped"], np.float64).reshape(self._shaped.shape)
        self._state = torch.from_numpy(np.array(state["memory"], np.float32)).view(self._state.shape)
        self._skill = torch.from_numpy(np.array(state["skill"], np.int64)).view(self._skill.shape)
        self._left = torch.from_numpy(np.array(state["left"], np.int64)).view(self._left.shape)
        for name, part in self.company.parts.items():
            part.load_state(state["company"][name])


def _stagger_ends(env: BatchedEnv, unroll: int, cells: int) -> np.ndarray:
    """(N,) first time steps: the first ends of episodes are spread over the horizon, so that each rollout shows all
    ages; the environments of one cell are spread alike."""
    horizon = env.spec.horizon
    phases = horizon // unroll if horizon % unroll == 0 else 1
    return (np.arange(env.num_envs) // cells % phases) * unroll


def _pick_rows(values: np.ndarray, envs: np.ndarray, seats: np.ndarray) -> Tensor:
    """(N, P, ...) -> (R, ...), the given seat of each row's environment."""
    return torch.from_numpy(values[envs, seats])


def _stack_columns(columns: dict[str, list[Any]], episodes: list[EndedEpisode], steps: int, simulated: int) -> Rollout:
    choices = None
    if "skill" in columns:
        names = ("skill", "decides", "skill_log_prob", "influence")
        choices = Choices(*(torch.stack(columns.pop(name)) for name in names))
    judged, who = columns["judged"][0], columns["who"][0]
    nowhere = {"cut_at": torch.zeros(0, 2, dtype=torch.int64), "cut_judged": judged[:0], "cut_who": who[:0]}
    cuts = {name: torch.cat([empty, *columns.pop(name, [])]) for name, empty in nowhere.items()}
    stacked = {name: torch.stack(column) for name, column in columns.items()}
    return Rollout(**stacked, **cuts, choices=choices, episodes=episodes, steps=steps, simulated=simulated)
