"""Which partner is the strongest."""

from __future__ import annotations

import numpy as np
import pytest

from popgen.methods.mappo.partner_episodes import PartnerEpisodes


def known() -> PartnerEpisodes:
    returns = PartnerEpisodes([1, 2, 4], window=2)
    for partner, reward in ((1, 5.0), (2, 9.0), (4, 1.0)):
        returns.add(partner, reward, score=reward / 10)
    return returns


def test_the_highest_mean_return_of_the_window_wins() -> None:
    returns = known()
    assert returns.strongest() == 2
    for reward in (7.0, 12.0):  # the 5.0 has left the window of two
        returns.add(1, reward, 0.0)
    assert returns.strongest() == 1 and returns.mean_scores() == {1: 0.0, 2: 0.9, 4: 0.1}


def test_one_without_episodes_comes_first() -> None:
    returns = known()
    returns.forget(4)
    assert returns.strongest() == 4 and 4 not in returns.mean_scores()


def test_without_a_window_every_episode_since_the_last_choice_counts() -> None:
    returns = PartnerEpisodes([1, 2], window=None)
    for reward in range(100):
        returns.add(1, float(reward), 0.0)
    returns.add(2, 60.0, 0.0)
    assert returns.strongest() == 2  # 49.5 of all hundred; the latest alone would be more
    returns.forget(2)
    returns.add(2, 49.0, 0.0)
    assert returns.strongest() == 1


def test_a_share_of_choices_is_any_partner() -> None:
    rng, returns = np.random.default_rng(0), known()
    chosen = [returns.choose(0.3, rng) for _ in range(3000)]
    shares = np.bincount(chosen, minlength=5)[[1, 2, 4]] / 3000
    np.testing.assert_allclose(shares, [0.1, 0.8, 0.1], atol=0.02)
    assert {returns.choose(0.0, rng) for _ in range(50)} == {2}


def test_going_on_from_a_state() -> None:
    returns, other = known(), PartnerEpisodes([1, 2, 4], window=2)
    other.add(1, 100.0, 0.0)
    other.load_state(returns.state())
    assert other.state() == returns.state() and other.strongest() == 2
    assert other.returns[1].maxlen == 2


def test_nobody_to_choose_from() -> None:
    with pytest.raises(ValueError):
        PartnerEpisodes([], 1).strongest()
