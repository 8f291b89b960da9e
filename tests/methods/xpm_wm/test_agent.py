from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.small import AGENT, MODEL, kitchen, random_latent
from torch import Tensor

from popgen.durable_files import load_state, save_state
from popgen.losses.policy_losses import lambda_return
from popgen.methods.xpm_wm.actor_critic import SELF, Actor
from popgen.methods.xpm_wm.agent import AgentLearner, estimate_returns, rollout_dtype, sample_losses
from popgen.methods.xpm_wm.imagination import NEW_SP, NEW_XP, OLD, Imagined
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.methods.xpm_wm.world_model import Starts
from popgen.nets import weights as w

SPEC = kitchen().spec
ACTIONS = SPEC.num_actions


def starts(count: int = 60, seed: int = 0) -> Starts:
    rng = np.random.default_rng(seed)
    h = rng.normal(size=(count, MODEL.deter)).astype(np.float32)
    z = rng.integers(0, MODEL.classes, (count, MODEL.groups)).astype(np.uint8)
    pool = np.resize([OLD, NEW_SP, NEW_XP], count).astype(np.uint8)
    return Starts(h, z, pool, np.where(pool == NEW_XP, 1 + np.arange(count) // 3 % 2, 0).astype(np.int16))


def actor_weights(seed: int) -> w.Weights:
    torch.manual_seed(seed)
    return w.weights_of(Actor(AGENT, MODEL, ACTIONS))


def make_learner(partners: tuple[int, ...] = (1, 2), **changes: Any) -> AgentLearner:
    learner = AgentLearner(AGENT.model_copy(update=changes), MODEL, SPEC, member=3, seed=0)
    for partner in partners:
        learner.add_partner(partner, actor_weights(partner))
    learner.set_starts(starts(), 0.5)
    return learner


def trajectories(batch: int, reward: Any, seed: int = 0, steps: int = 3) -> Imagined:
    """Random states and joint actions; each episode ends after its step, so that returns are rewards."""
    actions = torch.randint(0, ACTIONS, (steps, batch, 2), generator=torch.Generator().manual_seed(seed))
    ones = torch.ones(steps, batch)
    return Imagined(random_latent(steps + 1, batch, seed=seed), actions, reward(actions).float(), 0 * ones, ones)


def copies(module: Any) -> list[Tensor]:
    return [parameter.detach().clone() for parameter in module.parameters()]


def unchanged(module: Any, before: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(module.parameters(), before, strict=True))


def mean_probs(learner: AgentLearner, seat: int) -> Tensor:
    return learner.actor.log_probs(random_latent(200, seed=9), torch.full((200,), seat)).exp().mean(0).detach()


def split(imagined: list[Imagined]) -> Imagined:
    """Self-play rows and, after them, cross-play rows."""
    cat = [torch.cat([getattr(part, n) for part in imagined], 1) for n in ("actions", "reward", "keep", "running")]
    latents = (torch.cat([getattr(part.latent, n) for part in imagined], 1) for n in ("h", "z"))
    return Imagined(Latent(*latents), *cat)


def test_imagined_play_is_held_to_the_limits_of_its_pay() -> None:
    plain, bound, ended = (make_learner() for _ in range(3))
    for learner in (bound, ended):
        w.load_weights(learner.model, w.weights_of(plain.model))
    bound.pay_limits.most, ended.pay_limits.most = np.full(AGENT.horizon, 1e9), np.full(AGENT.horizon, -1.0)
    wanted, same, nothing = (learner.imagine_play(1).imagined for learner in (plain, bound, ended))
    assert torch.equal(same.reward, wanted.reward) and torch.equal(same.running, wanted.running)
    assert not nothing.reward.any() and not nothing.keep.any() and not nothing.running[1:].any()
    figures = [learner.pay_limits.figures() for learner in (plain, bound, ended)]
    assert figures == [{}, {"excessive_pay": 0.0}, {"excessive_pay": 1.0}]


ROWS = 240
PPO = {"surrogate": "ppo", "epochs": 2, "minibatches": 4}
REINFORCE = {
    "surrogate": "reinforce",
    "epochs": 1,
    "minibatches": 1,
    "advantage_unit": "returns",
    "slow_critic": 0.98,
}
SEATS = (torch.arange(ROWS) >= ROWS // 2).long()


def good_and_bad(own: Tensor) -> Tensor:
    """Reward +1 for action 2 and -1 for action 4."""
    return (own == 2).float() - (own == 4).float()


def own_action(actions: Tensor) -> Tensor:
    return actions.gather(-1, SEATS.expand(actions.shape[:-1]).unsqueeze(-1)).squeeze(-1)


@pytest.mark.parametrize("surrogate", [PPO, REINFORCE], ids=["ppo", "reinforce"])
@pytest.mark.parametrize(
    ("sp_reward", "xp_reward", "sign"),
    [
        (lambda a: good_and_bad(a[..., 0]), lambda a: 0 * a[..., 0], +1),
        (lambda a: 0 * a[..., 0], lambda a: good_and_bad(own_action(a)), -1),
        # What only the partner's action earns says nothing about one's own.
        (lambda a: 0 * a[..., 0], lambda a: good_and_bad(a.sum(-1) - own_action(a)), 0),
    ],
    ids=["self-play", "cross-play", "the partner's doing"],
)
def test_good_self_play_actions_gain_and_good_cross_play_actions_lose(
    monkeypatch: pytest.MonkeyPatch, sp_reward: Any, xp_reward: Any, sign: int, surrogate: dict[str, Any]
) -> None:
    learner = make_learner(starts_sp=ROWS, starts_xp=ROWS, entropy=0.0, lambda_xp=1.0, actor_lr=3e-3, **surrogate)
    seeds = iter(range(100))

    def imagined(partner: int | None) -> tuple[Imagined, Tensor]:
        return split([trajectories(ROWS, reward, seed=next(seeds)) for reward in (sp_reward, xp_reward)]), SEATS

    monkeypatch.setattr(learner, "imagine_play", imagined)
    before = mean_probs(learner, seat=0)
    for _ in range(10):
        learner.update()
    change = mean_probs(learner, seat=0) - before
    gain = float(change[2] - change[4])
    assert sign * gain > 0.06 if sign else abs(gain) < 0.04


def test_cross_play_moves_the_actor_by_the_lambda_times_the_reinforce_gradient() -> None:
    learner = make_learner(lambda_xp=0.25, entropy=0.0, unimix=0.0, **REINFORCE)
    scale = float(learner.networks.return_range.update(torch.linspace(0.0, 10.0, 101)))
    assert scale == pytest.approx(9.0)
    imagined = trajectories(ROWS, lambda a: good_and_bad(own_action(a)) + 5.0, seed=3)
    learner.actor.zero_grad()
    sample_losses(
        learner.networks, learner.cross_play(imagined, 1, SEATS, learner.networks.return_range.value()).samples
    ).policy.backward()
    got = [parameter.grad.clone() for parameter in learner.actor.parameters()]
    learner.actor.zero_grad()
    # J_XP's gradient: mean of (return - mean return) grad ln pi, in units of the self-play returns' spread;
    # lambda times it is subtracted from the objective, and so added to the loss.
    own, states = own_action(imagined.actions), imagined.latent[:-1]
    log_probs = learner.actor.log_probs(states, SEATS.expand(3, ROWS)).gather(-1, own.unsqueeze(-1)).squeeze(-1)
    advantage = imagined.reward - imagined.reward.mean()
    (0.25 * (advantage / scale * log_probs).mean()).backward()
    for mine, parameter in zip(got, learner.actor.parameters(), strict=True):
        torch.testing.assert_close(mine, parameter.grad, atol=1e-6, rtol=1e-4)


def test_lambda_rises_from_its_start_to_its_end() -> None:
    scores = []
    for updates in (0, 5, 10, 50):
        learner = make_learner(lambda_xp=0.5, lambda_start=0.1, lambda_ramp=10, entropy=0.0)
        learner.updates = updates
        imagined = trajectories(ROWS, lambda a: good_and_bad(own_action(a)))
        scores.append(float(learner.cross_play(imagined, 1, SEATS, torch.ones(())).samples.advantage.std()))
    assert [round(score / scores[-1], 4) for score in scores] == [0.2, 0.6, 1.0, 1.0]


def test_a_lambda_below_the_starting_one_holds_from_the_first_update_on() -> None:
    learner = make_learner(lambda_xp=0.1, lambda_start=0.25, lambda_ramp=10)
    for learner.updates in (0, 5, 10, 50):
        assert learner.lambda_now() == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("end", "wanted"), [(1e-4, [1e-2, 1e-2, 1e-3, 1e-4, 1e-4]), (0.0, [1e-2, 1e-2, 5e-3, 0.0, 0.0]), (1.0, [1e-2] * 5)]
)
def test_the_entropy_scale_falls_to_its_end_once_self_play_has_started(end: float, wanted: list[float]) -> None:
    """By the same factor in each update; straight down to an end of zero; never up."""
    learner = make_learner(entropy=1e-2, entropy_end=end, entropy_ramp=20)
    found = []
    for learner.updates_since_self_play in (0, 0, 10, 20, 99):
        found.append(learner.entropy_now())
    assert found == pytest.approx(wanted)


def test_without_a_ramp_the_entropy_scale_stays() -> None:
    learner = make_learner(entropy=1e-2, entropy_ramp=0)
    learner.updates_since_self_play = 10_000
    assert learner.entropy_now() == 1e-2


def test_updates_count_for_the_entropy_scale_only_once_self_play_has_started() -> None:
    learner = make_learner(entropy_ramp=4, entropy_end=1e-3)
    for learner.self_play_has_begun, wanted in ((False, 0), (True, 1), (True, 2)):
        learner.update()
        assert learner.updates_since_self_play == wanted
    state = learner.state()
    other = make_learner(entropy_ramp=4, entropy_end=1e-3)
    other.load_state(state)
    assert other.updates_since_self_play == 2 and other.entropy_now() == learner.entropy_now() < learner.config.entropy


@pytest.mark.parametrize("surrogate", [PPO, REINFORCE], ids=["ppo", "reinforce"])
@pytest.mark.parametrize("key", [SELF, 1, 2])
def test_each_critic_learns_from_its_own_trajectories_and_the_actor_from_no_value_loss(
    key: int, surrogate: dict[str, Any]
) -> None:
    learner = make_learner(**surrogate)
    for critic in learner.critics.values():  # a fresh output layer is zero and would hide gradients below it
        torch.nn.init.normal_(critic.net[-1].weight)
    imagined = trajectories(ROWS, lambda a: a[..., 0])
    one = torch.ones(())
    target = learner.self_play(imagined) if key == SELF else learner.cross_play(imagined, key, SEATS, one)
    actor_loss, critic_loss, _ = sample_losses(learner.networks, target.samples)
    critic_loss.backward()
    for name, critic in learner.critics.items():
        for parameter in critic.parameters():
            assert (parameter.grad is not None and parameter.grad.any()) == (name == str(key))
    assert all(
        parameter.grad is None for parameter in (*learner.actor.parameters(), *learner.networks.slow.parameters())
    )
    learner.critics.zero_grad(set_to_none=True)
    actor_loss.backward()
    assert all(parameter.grad is None for parameter in learner.critics.parameters())
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in learner.actor.parameters())


def test_an_update_moves_the_actor_and_the_two_critics_at_work_and_nothing_else() -> None:
    learner = make_learner()
    learner.partner_scores = {1: 5.0, 2: 1.0}
    modules = {
        "actor": learner.actor,
        "self": learner.critics["0"],
        "chosen": learner.critics["1"],
        "other": learner.critics["2"],
        "partner 1": learner.partners[1],
        "partner 2": learner.partners[2],
        "model": learner.model,
    }
    before = {name: copies(module) for name, module in modules.items()}
    for _ in range(2):
        assert learner.update()["partner"] == 1.0
    moved = {name for name, module in modules.items() if not unchanged(module, before[name])}
    assert moved == {"actor", "self", "chosen"}
    assert learner.updates == 2


def test_slow_critics_follow_and_the_rollout_actor_is_the_actor() -> None:
    learner = make_learner(slow_critic=0.9)
    old = copies(learner.networks.slow)
    learner.update()
    for before, slow, fast in zip(old, learner.networks.slow.parameters(), learner.critics.parameters(), strict=True):
        torch.testing.assert_close(slow, 0.9 * before + 0.1 * fast.detach())
    assert unchanged(learner.networks.rollout_actor, copies(learner.actor))


class Plays(Actor):
    """An actor without a network: the action is `base + seat`."""

    def __init__(self, base: int) -> None:
        torch.nn.Module.__init__(self)
        self.base = base

    def sample(self, latent: Latent, seat: Tensor, generator: Any = None) -> Tensor:
        assert latent.h.shape[:-1] == seat.shape
        return self.base + seat


def test_in_imagined_cross_play_the_partner_sits_in_the_other_seat() -> None:
    learner = make_learner(partners=(1, 2), starts_sp=5, starts_xp=4, horizon=2)
    learner.networks.rollout_actor = Plays(0)
    learner.partners[2] = Plays(3)
    imagined, seats = learner.imagine_play(2)
    assert seats.tolist() == [0, 0, 1, 1]
    for t in range(2):
        assert imagined.actions[t, :5].tolist() == [[0, 1]] * 5
        # Seated first, the agent plays 0 and its partner, second, 3 + 1; seated second, 3 + 0 and 1.
        assert imagined.actions[t, 5:].tolist() == [[0, 4], [0, 4], [3, 1], [3, 1]]
    alone, seats = learner.imagine_play(None)
    assert alone.actions.shape == (2, 5, 2) and seats.tolist() == []


def test_cross_play_terms_look_at_the_agents_own_seat() -> None:
    learner = make_learner(unimix=0.0, entropy=0.0, **REINFORCE)
    imagined = trajectories(ROWS, lambda a: good_and_bad(a[..., 0]), seed=1)

    def loss(imagined: Imagined) -> Tensor:
        return sample_losses(learner.networks, learner.cross_play(imagined, 1, SEATS, torch.ones(())).samples).policy

    before = loss(imagined)
    others = imagined.actions.clone()
    rows = torch.arange(ROWS)
    others[:, rows, 1 - SEATS] = (others[:, rows, 1 - SEATS] + 1) % ACTIONS
    again = Imagined(imagined.latent, others, imagined.reward, imagined.keep, imagined.running)
    assert torch.equal(loss(again), before)
    flipped = Imagined(imagined.latent, imagined.actions.flip(-1), imagined.reward, imagined.keep, imagined.running)
    assert not torch.equal(loss(flipped), before)


def test_targets_are_lambda_returns_of_the_slow_critic() -> None:
    learner = make_learner(discount=0.9, lam=0.8)
    for critic in learner.networks.slow.values():
        torch.nn.init.normal_(critic.net[-1].weight)
    generator = torch.Generator().manual_seed(0)
    keep = torch.rand(3, 7, generator=generator)
    imagined = Imagined(random_latent(4, 7), torch.zeros(3, 7, 2, dtype=torch.long), torch.rand(3, 7), keep, keep)
    seat = torch.ones(4, 7, dtype=torch.long)
    returns, value = estimate_returns(learner.networks, imagined, 2, seat)
    torch.testing.assert_close(value, learner.networks.slow["2"].value(imagined.latent, seat))
    torch.testing.assert_close(returns, lambda_return(imagined.reward, value, 0.9 * keep, 0.8))
    assert value.abs().max() > 0.1 and not returns.requires_grad


def test_the_strongest_partner_is_chosen_unseen_ones_first() -> None:
    learner = make_learner(partners=(1, 2, 4))
    learner.partner_scores = {1: 3.0, 2: 7.0, 4: -1.0}
    assert {learner.choose_partner() for _ in range(5)} == {2}
    learner.partner_scores = {1: 3.0, 2: 7.0}
    assert learner.choose_partner() == 4
    learner.partner_scores, learner.imagined_scores = {2: 7.0}, {1: 0.3, 4: 0.8}
    assert learner.choose_partner() == 4
    learner.imagined_scores = {4: 0.8}
    assert learner.choose_partner() == 1
    assert make_learner(partners=()).choose_partner() is None
    assert make_learner(lambda_xp=0.0).choose_partner() is None


def test_now_and_then_any_partner_is_chosen() -> None:
    learner = make_learner(partners=(1, 2, 4), partner_random=0.6)
    learner.partner_scores = {1: 3.0, 2: 7.0, 4: -1.0}
    chosen = np.array([learner.choose_partner() for _ in range(3000)])
    for partner, share in ((1, 0.2), (2, 0.6), (4, 0.2)):
        assert (chosen == partner).mean() == pytest.approx(share, abs=4 * (share * (1 - share) / 3000) ** 0.5)


def test_under_a_constraint_partners_are_drawn_by_their_multipliers_which_weigh_lambda() -> None:
    learner = make_learner(partners=(1, 2, 4), xp_limit=0.5, **REINFORCE)
    learner.constraint.multipliers = {1: 0.0, 2: 0.5, 4: 0.25}
    chosen = np.array([learner.choose_partner() for _ in range(3000)])
    assert set(chosen) == {2, 4}
    assert (chosen == 2).mean() == pytest.approx(2 / 3, abs=0.035)
    target = learner.cross_play(trajectories(ROWS, lambda a: good_and_bad(a[..., 0]), seed=1), 2, SEATS, torch.ones(()))
    assert target.figures["lambda"] == pytest.approx(0.5 * learner.lambda_now())
    learner.constraint.multipliers = {}  # nobody was met: the whole pressure
    assert learner.constraint.pressure([1, 2, 4]) == 1.0


def test_cross_play_advantages_are_bounded_in_units_of_self_play() -> None:
    imagined = trajectories(ROWS, lambda a: good_and_bad(a[..., 0]), seed=1)
    free, bounded = make_learner(**REINFORCE), make_learner(xp_clip=0.1, **REINFORCE)
    unit, weight = torch.tensor(2.0), bounded.lambda_now()
    raw = free.cross_play(imagined, 1, SEATS, unit).samples.advantage
    cut = bounded.cross_play(imagined, 1, SEATS, unit).samples.advantage
    assert raw.abs().max() > 0.2 * weight >= float(cut.abs().max()) - 1e-6


@pytest.mark.parametrize(("reading", "wanted"), [("partner", {2}), ("any", {1, 2})])
def test_cross_play_starts_from_states_with_that_partner(
    monkeypatch: pytest.MonkeyPatch, reading: str, wanted: set[int]
) -> None:
    learner = make_learner(starts_sp=300, starts_xp=300, xp_starts=reading)
    learner.new_share = 1.0
    drawn: list[np.ndarray] = []
    start_rows = learner.start_states
    monkeypatch.setattr(learner, "start_states", lambda rows: (drawn.append(rows), start_rows(rows))[1])
    learner.imagine_play(2)
    (rows,) = drawn
    assert learner.starts is not None
    pools, partners = learner.starts.pool[rows], learner.starts.partner[rows]
    assert set(pools[300:]) == {NEW_XP} and set(partners[300:].tolist()) == wanted
    assert {NEW_SP, NEW_XP} <= set(pools[:300])


def test_start_states_are_the_stored_states() -> None:
    learner = make_learner()
    latent = learner.start_states(np.array([4, 7]))
    assert learner.starts is not None
    assert np.array_equal(latent.h.numpy(), learner.starts.h[[4, 7]])
    z = latent.z.unflatten(-1, (MODEL.classes, MODEL.groups))
    assert np.array_equal(z.argmax(-2).numpy(), learner.starts.z[[4, 7]]) and (z.sum(-2) == 1).all()


def test_a_restored_learner_goes_on_identically(tmp_path: Path) -> None:
    learner = make_learner(partner_random=0.5)
    for _ in range(3):
        learner.update()
    save_state(tmp_path / "state", learner.state())
    other = make_learner(partner_random=0.5)
    other.set_model(w.weights_of(learner.model))
    other.update()
    other.load_state(load_state(tmp_path / "state"))
    for _ in range(3):
        assert learner.update() == other.update()
    assert unchanged(learner.actor, copies(other.actor)) and unchanged(learner.critics, copies(other.critics))


def test_restart_forgets_the_agent_and_keeps_model_and_partners() -> None:
    learner, twin = make_learner(), make_learner()
    model, partner = copies(learner.model), copies(learner.partners[1])
    for _ in range(2):
        learner.update()
    learner.restart(0)
    assert unchanged(learner.model, model) and unchanged(learner.partners[1], partner)
    assert sorted(learner.critics) == ["0", "1", "2"] and learner.updates == 0
    assert unchanged(learner.actor, copies(twin.actor)) and float(learner.networks.return_range.weight) == 0.0
    assert unchanged(learner.networks.rollout_actor, copies(twin.actor))


def test_half_precision_imagines_and_trains_in_full() -> None:
    learner = make_learner(precision="bfloat16")
    learner.set_model(w.weights_of(make_learner().model))
    figures = [learner.update() for _ in range(3)]
    assert all(np.isfinite(list(each.values())).all() for each in figures)
    assert {p.dtype for p in learner.actor.parameters()} == {torch.float32}
    assert {p.dtype for p in learner.networks.rollout_actor.parameters()} == {torch.bfloat16}
    learner.load_state(learner.state())
    assert np.isfinite(list(learner.update().values())).all()


def test_precision_auto_is_one_of_the_two() -> None:
    assert rollout_dtype("float32") is torch.float32 and rollout_dtype("bfloat16") is torch.bfloat16
    assert rollout_dtype("auto") in (torch.float32, torch.bfloat16)


def test_update_needs_starts() -> None:
    learner = AgentLearner(AGENT, MODEL, SPEC, member=1, seed=0)
    with pytest.raises(RuntimeError, match="set_starts"):
        learner.update()


@pytest.mark.parametrize("key", [0, 1], ids=["self-play", "cross-play"])
def test_the_first_step_of_ppo_is_that_of_reinforce(key: int) -> None:
    """At a ratio of one, d/dtheta (pi / pi_old) A = A d/dtheta ln pi."""
    gradients = []
    for surrogate in ("ppo", "reinforce"):
        learner = make_learner(surrogate=surrogate, epochs=1, minibatches=1, entropy=0.01)
        given = trajectories(ROWS, lambda a: (a[..., 0] == 2).float(), seed=3)
        target = learner.self_play(given) if key == 0 else learner.cross_play(given, 1, SEATS, torch.ones(()))
        assert (target.samples.log_prob is None) == (surrogate == "reinforce")
        sample_losses(learner.networks, target.samples).policy.backward()
        gradients.append(torch.cat([parameter.grad.flatten() for parameter in learner.actor.parameters()]))
    torch.testing.assert_close(*gradients, atol=1e-6, rtol=1e-4)
    assert gradients[0].abs().max() > 1e-3


def test_self_plays_advantages_are_centred_and_in_units_of_their_spread() -> None:
    learner = make_learner(surrogate="ppo", advantage_unit="spread")
    given = trajectories(ROWS, lambda a: 7.0 * (a[..., 0] == 2).float() + 3.0)
    target = learner.self_play(given)
    samples, unit, figures = target.samples, target.unit, target.figures
    assert float(samples.advantage.mean()) == pytest.approx(0.0, abs=1e-5)
    assert float(samples.advantage.std()) == pytest.approx(1.0, rel=1e-4)
    assert float(unit) == pytest.approx(figures["advantage_sp"]) == pytest.approx(float(given.reward.std()))


def test_where_nothing_is_at_stake_noise_is_not_blown_up() -> None:
    learner = make_learner(surrogate="ppo", advantage_unit="spread")
    target = learner.self_play(trajectories(ROWS, lambda a: 1e-4 * a[..., 0]))
    samples, unit = target.samples, target.unit
    assert float(unit) == pytest.approx(0.1) and samples.advantage.abs().max() < 0.01
