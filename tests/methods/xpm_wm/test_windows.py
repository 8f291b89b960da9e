from __future__ import annotations

import numpy as np
import pytest

from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.xpm_wm.imagination import NEW_SP, NEW_XP, OLD, draw_cross_play, draw_self_play
from popgen.methods.xpm_wm.replay import Draws, Windows, exchange_players, major_events, model_batch, start_batch
from popgen.methods.xpm_wm.world_model import Starts
from popgen.types import Kind

SPEC = make_env("overcooked/cramped_room").spec


def count(draws: Draws, wanted: object = lambda request: True) -> int:
    return sum(request.count for request in (*draws.sp, *draws.xp) if wanted(request))  # type: ignore[operator]


@pytest.mark.parametrize("member", [1, 2, 3, 7])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.5, 1.0])
def test_a_model_batch_is_full_and_mixed_as_asked(member: int, fraction: float) -> None:
    config = RunConfig.parse({"phase1": {"recent_fraction": fraction}, "phase2": {"new_fraction": fraction}})
    draws, batch = model_batch(config, member), config.world_model.batch
    assert count(draws) == batch and all(request.count >= 0 for request in (*draws.sp, *draws.xp))
    if member == 1:
        assert not draws.xp and count(draws, lambda r: r.query.last is not None) == round(batch * fraction)
        return
    new = count(draws, lambda r: r.query.owner_is == "equal")
    assert new == round(batch * fraction)
    own_xp = sum(r.count for r in draws.xp if r.query.owner_is == "equal")
    assert own_xp == new // 2
    assert all(r.query.owner == member for r in (*draws.sp, *draws.xp))
    if member == 2:  # nobody has played cross-play before
        assert sum(r.count for r in draws.xp if r.query.owner_is == "below") == 0


@pytest.mark.parametrize("member", [2, 5])
def test_where_members_meet_nobody_a_batch_is_full_of_self_play(member: int) -> None:
    config = RunConfig.parse({"agent": {"lambda_xp": 0.0}, "phase2": {"episodes_xp": 0, "new_fraction": 0.25}})
    draws, batch = model_batch(config, member), config.world_model.batch
    own = [request.count for request in draws.sp if request.query.owner_is == "equal"]
    assert sum(request.count for request in draws.sp) == batch and own == [batch // 4]
    starts = start_batch(config, SPEC, member, 1000)
    assert sum(request.count for request in starts.sp if request.pool == OLD) == 1000
    assert not any(request.count for request in (*draws.xp, *starts.xp))


def test_soups_are_the_major_events() -> None:
    assert [SPEC.event_names[i] for i in major_events(SPEC)] == ["takes_soup", "delivers_soup"]
    assert major_events(make_env("rendezvous/mppmr").spec) == ()


@pytest.mark.parametrize("member", [2, 3])
def test_start_windows_of_a_later_member(member: int) -> None:
    config = RunConfig.parse({"phase2": {"starts_random": 0.34, "starts_event": 0.3, "event_reach": 10}})
    draws = start_batch(config, SPEC, member, 1000)
    old = [r for r in (*draws.sp, *draws.xp) if r.pool == OLD]
    assert sum(r.count for r in old) == 1000
    assert all((r.query.owner, r.query.owner_is) == (member, "below") for r in old)
    assert sum(r.count for r in old if r.query.kind is Kind.RANDOM) == 340
    (event,) = [r for r in old if r.events]
    assert (event.count, event.events, event.reach) == (300, major_events(SPEC), 10)
    late_xp = [r.count for r in draws.xp if r.pool == OLD]
    assert late_xp == ([0] if member == 2 else [180])
    new = {r.pool: r for r in (*draws.sp, *draws.xp) if r.pool != OLD}
    assert new.keys() == {NEW_SP, NEW_XP} and all(r.query.owner == member for r in new.values())
    assert new[NEW_XP].query.kind is Kind.XP and new[NEW_XP] in draws.xp and new[NEW_SP] in draws.sp


def make_starts(old: int, new_sp: int, new_xp: dict[int, int]) -> Starts:
    pool = np.array([OLD] * old + [NEW_SP] * new_sp + [NEW_XP] * sum(new_xp.values()), np.uint8)
    partner = np.array([0] * (old + new_sp) + [k for k, n in new_xp.items() for _ in range(n)], np.int16)
    return Starts(np.zeros((len(pool), 2), np.float32), np.zeros((len(pool), 3), np.uint8), pool, partner)


def test_self_play_starts_are_mixed_by_pool_not_by_size() -> None:
    starts = make_starts(500, 3, {1: 20, 2: 20})
    rows = draw_self_play(starts, 20_000, 0.4, 0.25, np.random.default_rng(0))
    shares = np.bincount(starts.pool[rows], minlength=3) / len(rows)
    assert shares == pytest.approx([0.6, 0.3, 0.1], abs=0.015) and len(rows) == 20_000


def test_missing_pools_give_their_share_to_the_others() -> None:
    rng = np.random.default_rng(0)
    assert set(draw_self_play(make_starts(5, 0, {}), 50, 0.9, 0.5, rng)) <= set(range(5))
    only_new = make_starts(0, 0, {1: 4})
    assert set(draw_self_play(only_new, 200, 0.0, 0.0, rng)) == {0, 1, 2, 3}
    with pytest.raises(LookupError, match="no states"):
        draw_self_play(make_starts(0, 0, {}), 5, 0.5, 0.5, rng)


def test_cross_play_starts_are_of_the_partner_or_old() -> None:
    starts, rng = make_starts(30, 30, {1: 10, 2: 10}), np.random.default_rng(1)
    rows = draw_cross_play(starts, 8000, 0.25, 2, rng)
    own = starts.pool[rows] == NEW_XP
    assert own.mean() == pytest.approx(0.25, abs=0.02) and set(starts.partner[rows][own]) == {2}
    assert set(starts.pool[rows]) == {OLD, NEW_XP}
    anyone = draw_cross_play(starts, 2000, 1.0, None, rng)
    assert set(starts.partner[anyone]) == {1, 2}
    stand_in = draw_cross_play(make_starts(7, 5, {1: 5}), 100, 1.0, 3, rng)
    assert set(stand_in) <= set(range(7))


def test_starts_are_joined_in_order() -> None:
    parts = [make_starts(2, 1, {}), make_starts(0, 0, {4: 2})]
    joined = Starts.concat(parts)
    assert joined.pool.tolist() == [OLD, OLD, NEW_SP, NEW_XP, NEW_XP] and joined.partner.tolist() == [0, 0, 0, 4, 4]
    assert len(joined) == 5 and joined.h.shape == (5, 2)


GRID = "XXXPXXX/O {}   D/X  X  X/O   {} S/XXXXXXX"


def test_a_window_with_exchanged_players_is_the_play_of_exchanged_players() -> None:
    """The oracle: the same kitchen with both players' places exchanged, in which each takes the other's actions."""
    steps, rng = 60, np.random.default_rng(0)
    first, second = (make_env("overcooked/alcove", 4, grid=GRID.format(*order)) for order in ("12", "21"))
    seen: dict[str, list[np.ndarray]] = {"as": [], "exchanged": [], "events": [], "exchanged events": []}
    actions = rng.integers(first.spec.num_actions, size=(steps, 4, 2), dtype=np.uint8)
    for joint in actions:
        results = first.step(joint), second.step(joint[:, ::-1])
        for name, env, result in zip(("as", "exchanged"), (first, second), results, strict=True):
            seen[name].append(env.encode(env.get_state(), "features"))
            seen[f"{'' if name == 'as' else 'exchanged '}events"].append(result.events)
    stacked = {name: np.stack(values, 1) for name, values in seen.items()}
    none, zeros = np.zeros((4, steps), bool), np.zeros(4, np.int64)
    taken = actions.transpose(1, 0, 2).astype(np.int64)
    windows = Windows(stacked["as"], taken, stacked["events"], none, none, zeros, zeros, zeros.astype(bool))
    exchanged = exchange_players(windows)
    assert np.array_equal(exchanged.obs, stacked["exchanged"])
    assert np.array_equal(exchanged.events, stacked["exchanged events"]) and windows.events.any()
    assert np.array_equal(exchanged.actions, taken[:, :, ::-1])
    assert np.array_equal(windows.obs, stacked["as"])  # what was given is unchanged
