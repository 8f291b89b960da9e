"""Count bonus, trust in imagined events, ends after rare ones, the entropy bonus: by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.small import AGENT, MODEL, kitchen, random_latent, random_play, random_windows

from popgen.methods.xpm_wm.agent import clip_advantages, entropy_scale
from popgen.methods.xpm_wm.config import DiscoveryConfig
from popgen.methods.xpm_wm.imagination import (
    LEAST_TRUST,
    Discovery,
    Rates,
    expected_pay,
    find_highest_paying,
    trusted_shares,
)
from popgen.methods.xpm_wm.real_play import Tally, TallyKeeper
from popgen.methods.xpm_wm.world_model import ModelLearner, WorldModel, before_or_at

SPEC = kitchen().spec
SOUP, DELIVERY = 3, 4


def make(**options: Any) -> Discovery:
    return Discovery(DiscoveryConfig(**options), SPEC, "features", torch.device("cpu"))


def tally_of(events: list[int], own: list[int] | None = None, steps: int = 0) -> Tally:
    none = np.zeros(0, np.int64)
    return Tally(np.array(events), np.array(own or [0] * SPEC.num_events), steps, none, none, ())


def model_with_events(*probable: int) -> WorldModel:
    """It says of every state that player 0 caused these events, and nothing else."""
    torch.manual_seed(0)
    model = WorldModel(MODEL.model_copy(update={"imagination": "mode"}), SPEC).requires_grad_(False)
    last = model.event_head[-1]
    last.weight.zero_()
    last.bias.fill_(-50.0)
    last.bias[list(probable)] = 50.0
    return model


def test_an_imagined_event_counts_for_a_multiple_of_its_real_share() -> None:
    rates = Rates(np.array([0.1, 0.1, 0.1, 0.0]), np.array([0.04, 0.2, 0.0, 0.0]))
    assert trusted_shares(rates, 2.0).tolist() == pytest.approx([0.8, 1.0, LEAST_TRUST, LEAST_TRUST])


def test_rates_are_compared_over_what_was_played_since_and_averaged() -> None:
    discovery = make(trust=1.0)
    imagined = np.full(SPEC.num_events, 0.1)
    assert discovery.compare(imagined, tally_of([0] * 5)) == {}  # nothing of its own was played
    discovery.compare(imagined, tally_of([9] * 5, [2, 0, 0, 0, 0], 50))
    assert discovery.shares[:2].tolist() == pytest.approx([0.5, 0.1])  # (2 + 1/2) / 50 and (1/2) / 50 over 0.1
    figures = discovery.compare(imagined, tally_of([9] * 5, [2, 0, 0, 0, 0], 60))
    assert figures[f"real_rate_{SPEC.event_names[0]}"] == pytest.approx(0.05)
    assert discovery.shares[0] == pytest.approx(0.5) and discovery.shares[1] == pytest.approx(0.3)


def test_state_of_the_comparison_comes_back() -> None:
    discovery, again = make(trust=1.0), make(trust=1.0)
    discovery.compare(np.full(5, 0.1), tally_of([9] * 5, [2, 0, 1, 0, 0], 50))
    again.load_state(discovery.state())
    for one in (discovery, again):
        one.compare(np.full(5, 0.2), tally_of([9] * 5, [3, 1, 1, 0, 0], 70))
    assert np.array_equal(again.shares, discovery.shares)
    fresh = make(trust=1.0)
    fresh.load_state(make(trust=1.0).state())
    assert fresh.rates is None and fresh.shares.tolist() == [1.0] * 5


def test_events_pay_by_factor_and_trust() -> None:
    discovery = make(event_factors={SPEC.event_names[0]: 0.2})
    discovery.shares = np.array([1.0, 1.0, 1.0, 0.5, 1.0])
    paid = discovery.pay(model_with_events(0, SOUP), random_latent(3, 2))
    assert torch.allclose(paid.reward, torch.full((3, 2), 0.2 + 0.5 * 3.0), atol=1e-5)


def test_a_scaffold_pays_less_the_more_often_what_it_is_for_is_reached() -> None:
    """With real rates 0.002 and 0.006 of the two goals and an end at 0.004: a half is left, and nothing."""
    onion, dish, potted = SPEC.event_names[:3]
    soup = SPEC.event_names[SOUP]
    discovery = make(trust=1.0, scaffolds={onion: potted, dish: soup}, scaffold_until=0.004)
    latent = random_latent(3, 2)
    assert discovery.scaffold_shares().tolist() == [1.0] * 5  # no rates were taken yet
    discovery.rates = Rates(np.zeros(5), np.array([0.1, 0.1, 0.002, 0.006, 0.0]))
    assert discovery.scaffold_shares().tolist() == pytest.approx([0.5, 0.0, 1.0, 1.0, 1.0])
    paid = discovery.pay(model_with_events(0, 1, SOUP), latent)
    assert torch.allclose(paid.reward, torch.full((3, 2), 0.5 + 0.0 + 3.0), atol=1e-5)


def test_a_rare_event_pays_and_ends() -> None:
    discovery, model, latent = make(rare_events=5), model_with_events(SOUP), random_latent(3, 2)
    for seen, ends in ((4, True), (5, False)):
        discovery.tally = tally_of([99, 99, 99, seen, 0])
        paid, plain = discovery.pay(model, latent), expected_pay(model, latent)
        assert torch.allclose(paid.reward, torch.full((3, 2), 3.0)) and torch.allclose(paid.reward, plain.reward)
        assert torch.equal(paid.keep, torch.zeros(3, 2) if ends else plain.keep)


def test_the_bonus_is_that_of_the_states_that_the_model_shows() -> None:
    """The model shows both players as the first two states of real play; a blur of two orientations earns nothing."""
    env, keeper = kitchen(4), TallyKeeper(kitchen(), "features")
    keeper.add(random_play(env, 30)[0], 1)
    discovery = make(count_bonus=2.0)
    discovery.tally = tally = keeper.tally(1)
    obs = kitchen().observe()[0]
    key = sum((obs[0][list(part)] > 0).astype(np.int64) @ w for part, w in zip(*_make_parts(), strict=True))
    visits = int(tally.visits[np.searchsorted(tally.keys, key)])
    model = model_with_events()
    for decoder in model.decoders:
        decoder.trunk[-1].weight.zero_()
        decoder.output.copy_(torch.from_numpy(obs[0].astype(np.float32) - 0.5))
    bonus = discovery.bonus(model, random_latent(2, 3), 2.0)
    assert torch.allclose(bonus, torch.full((2, 3), 2 * 2.0 / np.sqrt(1.0 + visits)))
    unseen = replace(tally, keys=tally.keys + 1)
    discovery.tally = unseen
    assert torch.allclose(discovery.bonus(model, random_latent(2, 3), 2.0), torch.full((2, 3), 4.0))
    model.decoders[0].output[list(SPEC.views["features"].own[1])] = 1.0
    assert torch.allclose(discovery.bonus(model, random_latent(2, 3), 2.0), torch.full((2, 3), 2.0))


def _make_parts() -> tuple[Any, Any]:
    from popgen.methods.xpm_wm.real_play import part_weights

    view = SPEC.views["features"]
    return view.own, part_weights(view)


def test_the_bonus_is_halved_when_the_highest_paying_event_is_found_and_ends_when_play_begins() -> None:
    discovery = make(count_bonus=1.0, found_events=10)
    assert discovery.bonus_scale(False) == 0.0  # nothing is known of real play
    discovery.tally = tally_of([99, 99, 99, 99, 9])
    assert (discovery.found(), discovery.bonus_scale(False), discovery.bonus_scale(True)) == (False, 1.0, 0.0)
    discovery.tally = tally_of([0, 0, 0, 0, 10])
    assert (discovery.found(), discovery.bonus_scale(False)) == (True, 0.5)
    assert not make(count_bonus=1.0).found()


def test_highest_paying_are_events_that_pay_half_of_the_most() -> None:
    spec = replace(SPEC, event_weights=(1.0, 1.0, 3.0, 5.9, 12.0))
    assert np.flatnonzero(find_highest_paying(spec)).tolist() == [4]
    spec = replace(spec, event_weights=(1.0, 1.0, 3.0, 6.0, 12.0))
    assert np.flatnonzero(find_highest_paying(spec)).tolist() == [3, 4]


def test_entropy_falls_when_the_highest_paying_event_is_found_and_again_when_play_begins() -> None:
    agent = AGENT.model_copy(update={"entropy": 0.08, "entropy_end": 0.01, "entropy_ramp": 10})
    found = DiscoveryConfig(found_entropy=0.02)
    scales = [entropy_scale(agent, found, *done) for done in ((0, 0), (5, 0), (10, 0), (20, 5), (20, 10), (0, 10))]
    assert scales == pytest.approx([0.08, 0.04, 0.02, (0.02 * 0.01) ** 0.5, 0.01, 0.01])


def test_clipped_advantages_set_a_smaller_unit() -> None:
    """One of 100 among nine of magnitude 1 and signs in turn: mean magnitude 10.9, cut at 2 x that."""
    advantage = torch.tensor([[1.0, -1.0] * 4 + [1.0, 100.0]])
    running = torch.ones_like(advantage, dtype=torch.bool)
    cut, unit = clip_advantages(advantage, running, 2.0)
    assert cut[0, -1] == pytest.approx(21.8) and torch.equal(cut[0, :-1], advantage[0, :-1])
    assert float(unit) == pytest.approx(float(cut.std()))


def test_no_start_follows_a_rare_event_of_its_window() -> None:
    windows = replace(random_windows(40, 5), partner=np.arange(40))
    windows.events[:] = 0
    windows.events[:20, 2, 1, DELIVERY] = 1
    assert before_or_at(windows, (DELIVERY,))[0].tolist() == [False, False, True, True, True]
    assert not before_or_at(windows, (SOUP,)).any()
    learner = ModelLearner(MODEL, SPEC, seed=0)
    seen = learner.posteriors(windows)
    picked = learner.starts(seen, windows, 300, pool=0, rare=(DELIVERY,))
    early = picked.partner < 20
    assert early.any() and np.array_equal(picked.h[early], seen.latent.h[1, picked.partner[early]].detach().numpy())
    windows.events[:, 1:, 0, DELIVERY] = 1  # nothing else is left: then these are taken
    assert len(learner.starts(seen, windows, 7, pool=0, rare=(DELIVERY,))) == 7
