"""Finding rewards that chance hardly ever meets in imagination, and not believing those that the model makes up.

What helps where a reward lies behind a long chain of events that play does not show yet (docs/notes/learning.md, The
counter circuit): a bonus for states of a player that real play has hardly seen, events that count only as far as they
happen in reality as often as in imagination, and trajectories that end where the model has seen too little to go on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.config import DiscoveryConfig
from popgen.methods.xpm_wm.imagination import Paid
from popgen.methods.xpm_wm.latents import Latent
from popgen.methods.xpm_wm.play_tally import Tally, part_weights
from popgen.methods.xpm_wm.world_model import PlayerDecoder, WorldModel

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


def dearest_events(spec: EnvSpec) -> np.ndarray:
    """(E,) bool: events that pay at least half of what the dearest pays."""
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
        factors = [config.event_factors.get(name, 1.0) for name in spec.event_names]
        self.weights = np.asarray(spec.event_weights, np.float64) * factors
        self.dearest = dearest_events(spec)
        self.tally: Tally | None = None
        self.shares = np.ones(spec.num_events)
        self.rates: Rates | None = None
        self.seen = (np.zeros(spec.num_events, np.int64), 0)

    @property
    def changes_pay(self) -> bool:
        """Whether what imagined events pay differs from the environment's weights."""
        return bool(self.config.event_factors or self.config.trust or self.config.rare_events)

    def found(self) -> bool:
        """Whether the dearest event has been seen often enough to count as found."""
        if self.tally is None or not self.config.found_events:
            return False
        return int(self.tally.events[self.dearest].sum()) >= self.config.found_events

    def bonus_scale(self, plays: bool) -> float:
        """Of the count bonus: halved once the dearest event has been found, none once real self-play has begun."""
        if plays or self.tally is None:
            return 0.0
        return self.config.count_bonus * (0.5 if self.found() else 1.0)

    # ---- pay ---------------------------------------------------------------------------------------------------------

    def pay(self, model: WorldModel, arrived: Latent) -> Paid:
        """Reward and continuation of imagined states; an event that has been seen too rarely pays and ends them."""
        events = model.event_probs(arrived).float()
        players = self.spec.num_players
        weights = torch.as_tensor(np.tile(self.weights * self.shares, players), dtype=torch.float32)
        keep = model.continuation(arrived).float()
        if self.config.rare_events and self.tally is not None:
            rare = np.tile(self.tally.events < self.config.rare_events, players)
            happened = (events > 0.5) & torch.as_tensor(rare, device=self.device)
            keep = torch.where(happened.any(-1), torch.zeros_like(keep), keep)
        return Paid((events * weights.to(self.device)).sum(-1), keep)

    def bonus(self, model: WorldModel, arrived: Latent, scale: float) -> Tensor:
        """(...,) float32: for each player `scale` / sqrt(1 + n), n the real visits of the state of its own that the
        model shows. A state with a part that was never seen is no new combination, but a blur: it earns nothing."""
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

    def _bonus_of(self, values: list[Tensor]) -> Tensor:
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
        played = tally.own_steps - steps
        if played < 1:
            return {}
        new = Rates(imagined, (tally.own_events - events + 0.5) / played)
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
