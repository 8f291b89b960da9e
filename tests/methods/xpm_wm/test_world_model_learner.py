from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.small import MODEL, kitchen, random_windows
from torch import Tensor

from popgen.durable_files import load_state, save_state
from popgen.methods.xpm_wm.actor_critic import Actor, fit_actor
from popgen.methods.xpm_wm.config import AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.latent_filter import Latent, from_indices
from popgen.methods.xpm_wm.model_report import OPEN_LOOP, model_report
from popgen.methods.xpm_wm.replay import KIND_CODE, Windows
from popgen.methods.xpm_wm.world_model import (
    LatentFilter,
    ModelLearner,
    Observed,
    WindowBatch,
    fit_partners,
    predecessor_kl,
)
from popgen.nets import weights as w
from popgen.types import Kind

SPEC = kitchen().spec
LOSSLESS = MODEL.model_copy(update={"view": "lossless", "cnn_channels": 3, "cnn_kernels": (3, 3)})


def make_learner(config: WorldModelConfig = MODEL, seed: int = 0, **changes: Any) -> ModelLearner:
    return ModelLearner(config.model_copy(update=changes), SPEC, seed)


def crossed(windows: Windows, partners: list[int]) -> Windows:
    """The same windows, some of them as if recorded in cross-play with a partner (0: self-play)."""
    given = np.array(partners)
    kind = np.where(given > 0, KIND_CODE[Kind.XP], KIND_CODE[Kind.SP])
    return replace(windows, partner=given, kind=kind)


@pytest.mark.parametrize("config", [MODEL, LOSSLESS], ids=["features", "lossless"])
def test_updates_lower_every_part_of_the_loss(config: WorldModelConfig) -> None:
    learner, windows = make_learner(config, learning_rate=5e-3), random_windows(24, 5, view=config.view)
    assert windows.events[:, 1:].any()
    learner.set_biases(windows)
    figures = [learner.update(windows)[0] for _ in range(60)]
    assert learner.updates == 60 and np.isfinite([list(each.values()) for each in figures]).all()
    first, last = ({k: np.mean([each[k] for each in part]) for k in part[0]} for part in (figures[:3], figures[-3:]))
    for name, share in {"loss_observation": 0.8, "loss_events": 1.0, "loss_continue": 0.5}.items():
        assert last[name] < share * first[name], name


def test_without_a_bound_the_gradient_is_as_it_is() -> None:
    free, wide = make_learner(grad_clip=0.0), make_learner(grad_clip=1e9)
    before = w.weights_of(free.model)
    for learner in (free, wide):
        learner.update(random_windows(6, 5))
    after, same = w.weights_of(free.model), w.weights_of(wide.model)
    assert all((after[name] == same[name]).all() for name in after)
    assert any((after[name] != before[name]).any() for name in after)


def test_losses_and_weights_have_the_same_names() -> None:
    learner = make_learner(event_scale=7.0, continue_scale=0.3, kl_predecessors=0.2)
    terms, _, _ = learner.losses(WindowBatch.from_windows(random_windows(6, 5), learner.model))
    assert learner.loss_weights().keys() == terms.keys()
    weights = learner.loss_weights()
    assert (weights["events"], weights["continue"], weights["predecessors"]) == (7.0, 0.3, 0.2)


def test_nothing_is_predicted_into_a_beginning() -> None:
    """Events and KL of the first state of an episode count for nothing; its observation does."""
    learner, windows = make_learner(), random_windows(6, 5)
    learner.set_biases(windows)
    windows.is_first[2, 3] = True

    def terms(given: Windows) -> dict[str, float]:
        learner.generator.manual_seed(0)
        return {
            name: float(term.detach())
            for name, term in learner.losses(WindowBatch.from_windows(given, learner.model))[0].items()
        }

    before = terms(windows)
    events = windows.events.copy()
    events[:, 0], events[2, 3] = 1 - events[:, 0], 1 - events[2, 3]
    assert terms(replace(windows, events=events)) == before
    events[2, 2] = 1 - events[2, 2]
    assert terms(replace(windows, events=events))["events"] != before["events"]
    # By hand, over the steps that count.
    learner.generator.manual_seed(0)
    batch = WindowBatch.from_windows(windows, learner.model)
    terms, seen, extras = learner.losses(batch)
    kl = (seen.posterior * (seen.posterior.log() - seen.prior.log())).sum((-2, -1))[~batch.is_first].detach()
    weight = learner.config.kl_dyn + learner.config.kl_rep
    assert float(extras["kl"]) == pytest.approx(float(kl.mean()), rel=1e-5)
    assert float(terms["kl"].detach()) == pytest.approx(weight * float(kl.clamp(min=1.0).mean()), rel=1e-5)


def test_terminal_states_are_where_the_episode_stops() -> None:
    learner, windows = make_learner(learning_rate=1e-2), random_windows(16, 5)
    terminal = windows.obs[:, :, 0, 0] > 0  # anything that can be seen
    assert 0.05 < terminal.mean() < 0.95
    windows = replace(windows, terminal=terminal)
    learner.set_biases(windows)
    for _ in range(150):
        learner.update(windows)
    seen = learner.posteriors(windows)
    going_on = learner.model.continuation(seen.latent).T.detach().numpy()
    assert going_on[~terminal].mean() - going_on[terminal].mean() > 0.5


class Archived:
    """A predecessor's filter that believes something fixed, and remembers what it was shown."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.shown: list[Tensor] = []

    def observe_posterior(self, obs: Tensor, actions: Tensor, is_first: Tensor, generator: Any) -> tuple[None, Tensor]:
        assert obs.shape[:2] == actions.shape[:2] == is_first.shape
        self.shown.append(obs)
        return None, self.belief(obs.shape[0], obs.shape[1])

    def belief(self, steps: int, rows: int) -> Tensor:
        logits = torch.randn(MODEL.classes, MODEL.groups, generator=torch.Generator().manual_seed(self.seed))
        return torch.softmax(logits, -2).expand(steps, rows, -1, -1)


PARTNERS = [0, 1, 2, 0, 2, 3]
ROUTES = {
    "partner": {1: [1], 2: [2, 4], 3: [5]},
    "latest": {3: [1, 2, 4, 5]},
    "all": {1: [1, 2, 4, 5], 2: [1, 2, 4, 5], 3: [1, 2, 4, 5]},
}


@pytest.mark.parametrize("reading", ROUTES)
def test_the_predecessor_term_is_of_cross_play_rows_and_of_the_right_member(reading: str) -> None:
    learner = make_learner(kl_predecessors=1.0, predecessors=reading)
    archive = {member: Archived(member) for member in (1, 2, 3)}
    learner.predecessors = archive  # type: ignore[assignment]
    batch = WindowBatch.from_windows(crossed(random_windows(6, 5), PARTNERS), learner.model)
    terms, seen, _ = learner.losses(batch)
    routes = ROUTES[reading]
    for member, archived in archive.items():
        assert [obs.shape[1] for obs in archived.shown] == ([len(routes[member])] if member in routes else [])
        if member in routes:
            assert torch.equal(archived.shown[0], batch.obs[:, routes[member]])
    expected = sum(
        predecessor_kl(seen.posterior[:, rows], archive[member].belief(5, len(rows))).sum() / (5 * 6)
        for member, rows in routes.items()
    )
    torch.testing.assert_close(terms["predecessors"], expected)
    terms["predecessors"].backward()
    trained = {
        name.split(".")[0] for name, p in learner.model.named_parameters() if p.grad is not None and p.grad.any()
    }
    assert trained == {"filter"}


def test_no_predecessor_term_without_cross_play_or_weight() -> None:
    learner = make_learner(kl_predecessors=1.0)
    learner.predecessors = {1: Archived(1)}  # type: ignore[dict-item]
    batch = WindowBatch.from_windows(crossed(random_windows(3, 5), [0, 0, 2]), learner.model)
    assert float(learner.losses(batch)[0]["predecessors"]) == 0.0
    learner = make_learner(kl_predecessors=0.0)
    learner.predecessors = {2: Archived(2)}  # type: ignore[dict-item]
    assert float(learner.losses(batch)[0]["predecessors"]) == 0.0 and not learner.predecessors[2].shown  # type: ignore[attr-defined]


def test_an_archived_filter_pulls_the_posterior_towards_it_and_stays() -> None:
    learner = make_learner(kl_predecessors=50.0, learning_rate=3e-3)
    torch.manual_seed(7)
    theirs = w.weights_of(LatentFilter(MODEL, SPEC))
    learner.add_predecessor(1, theirs)
    windows = crossed(random_windows(6, 5), [1] * 6)
    first = learner.update(windows)[0]["loss_predecessors"]
    for _ in range(30):
        last = learner.update(windows)[0]["loss_predecessors"]
    assert last < 0.7 * first
    after = w.weights_of(learner.predecessors[1])
    assert all(np.array_equal(after[name], value) for name, value in theirs.items())


def test_a_restored_learner_goes_on_identically(tmp_path: Path) -> None:
    learner, windows = make_learner(), random_windows(6, 5)
    learner.set_biases(windows)
    for _ in range(3):
        learner.update(windows)
    save_state(tmp_path / "model", learner.state())
    other = make_learner(seed=5)
    other.update(windows)
    other.load_state(load_state(tmp_path / "model"))
    for seed in range(2):
        given = random_windows(6, 5, seed=seed)
        (figures, seen), (again, same) = learner.update(given), other.update(given)
        assert figures == again
        one, two = (each.starts(part, given, 9, pool=0) for each, part in ((learner, seen), (other, same)))
        assert np.array_equal(one.h, two.h) and np.array_equal(one.z, two.z)
    theirs = w.weights_of(other.model)
    assert all(np.array_equal(theirs[name], value) for name, value in w.weights_of(learner.model).items())


def test_the_learning_rate_of_later_members() -> None:
    learner, windows = make_learner(learning_rate=1e-2), random_windows(4, 5)
    learner.update(windows)
    learner.set_learning_rate(1e-9)
    before = w.weights_of(learner.model)
    learner.update(windows)
    assert max(np.abs(value - before[name]).max() for name, value in w.weights_of(learner.model).items()) < 1e-6


@pytest.mark.parametrize("broken", ["events", "gradient"])
def test_an_update_that_is_not_finite_is_told_at_once_and_changes_nothing(broken: str) -> None:
    learner, windows = make_learner(), random_windows(6, 5)
    learner.update(windows)
    bias = learner.model.event_head[-1].bias
    if broken == "events":
        bias.data[0] = float("nan")
    else:
        bias.register_hook(lambda gradient: gradient * float("inf"))
    before = w.weights_of(learner.model)
    message = rf"^{broken} not finite in update 2 of the world model, at a learning rate of 0\.002$"
    with pytest.raises(FloatingPointError, match=message):
        learner.update(windows)
    after = w.weights_of(learner.model)
    assert learner.updates == 1 and all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)


def test_starts_are_posterior_states_that_are_neither_terminal_nor_first() -> None:
    learner, windows = make_learner(), crossed(random_windows(6, 5), PARTNERS)
    windows.terminal[1, 2] = windows.terminal[4, 4] = True
    seen = learner.posteriors(windows)
    starts = learner.starts(seen, windows, 500, pool=2, skip=2)
    assert len(starts) == 500 and (starts.pool == 2).all()
    assert (starts.h.dtype, starts.z.dtype, starts.partner.dtype) == (np.float32, np.uint8, np.int16)
    places = set()
    for h, z, partner in zip(starts.h, starts.z, starts.partner, strict=True):
        (match,) = np.argwhere((seen.latent.h.numpy() == h).all(-1)).tolist()
        t, b = match
        assert partner == PARTNERS[b]
        torch.testing.assert_close(from_indices(torch.from_numpy(z), MODEL.classes).flatten(-2), seen.latent.z[t, b])
        places.add((t, b))
    assert places == {(t, b) for t in (2, 3, 4) for b in range(6)} - {(2, 1), (4, 4)}


def test_starts_can_leave_out_the_windows_that_were_chosen_for_an_event() -> None:
    learner, windows = make_learner(), crossed(random_windows(6, 5), PARTNERS)
    windows.chosen[[0, 3, 5]] = True
    seen = learner.posteriors(windows)
    for chosen, wanted in ((True, {0, 1, 2, 3, 4, 5}), (False, {1, 2, 4})):
        starts = learner.starts(seen, windows, 300, pool=0, chosen=chosen)
        assert {int(np.argwhere((seen.latent.h.numpy() == h).all(-1))[0, 1]) for h in starts.h} == wanted


def rigged(learner: ModelLearner) -> None:
    """A model that predicts event 0 of player 0 and event 2 of player 1, always."""
    with torch.no_grad():
        learner.model.event_head[-1].weight.zero_()
        learner.model.event_head[-1].bias.fill_(-5.0)
        learner.model.event_head[-1].bias[[0, SPEC.num_events + 2]] = 5.0


def test_report_counts_events_after_the_context() -> None:
    learner, context = make_learner(), 3
    rigged(learner)
    windows = random_windows(40, context + OPEN_LOOP, seed=1)
    windows.is_first[:, 1:] = False
    windows.is_first[5, context], windows.is_first[6, context + OPEN_LOOP - 1] = True, True
    windows.is_first[7, context - 1] = True  # within the context: no reason to leave it out
    rng = np.random.default_rng(0)
    windows.events[:] = rng.random(windows.events.shape) < 0.3
    figures = model_report(learner, windows, context)
    rows = [n for n in range(40) if n not in (5, 6)]
    for label, t in (("step1", context), (f"step{OPEN_LOOP}", context + OPEN_LOOP - 1)):
        events = windows.events[rows, t]
        hits = int(events[:, 0, 0].sum() + events[:, 1, 2].sum())
        assert figures[f"event_precision_{label}"] == pytest.approx(hits / (2 * len(rows)))
        assert figures[f"event_recall_{label}"] == pytest.approx(hits / events.sum())
        name = SPEC.event_names[2]
        assert figures[f"recall_{name}_{label}"] == pytest.approx(events[:, 1, 2].sum() / events[:, :, 2].sum())
        assert figures[f"precision_{name}_{label}"] == pytest.approx(events[:, 1, 2].sum() / len(rows))
        assert figures[f"recall_{SPEC.event_names[1]}_{label}"] == 0.0
        assert f"precision_{SPEC.event_names[1]}_{label}" not in figures


def test_report_goes_on_open_loop_with_the_real_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, context = make_learner(), 3
    windows = random_windows(10, context + OPEN_LOOP, seed=2)
    windows.is_first[:, 1:] = False
    model, played, observed = learner.model, [], []
    step, observe = model.step, model.observe

    def spied_observe(obs: Tensor, actions: Tensor, is_first: Tensor, generator: Any) -> Observed:
        observed.append((len(obs), len(actions)))
        return observe(obs, actions, is_first, generator)

    monkeypatch.setattr(model, "observe", spied_observe)
    monkeypatch.setattr(
        model, "step", lambda latent, actions, generator: (played.append(actions), step(latent, actions))[1]
    )
    model_report(learner, windows, context)
    assert observed == [(context, context)]
    # actions[t] led to state t.
    for number, actions in enumerate(played):
        assert np.array_equal(actions.numpy(), windows.actions[:, context + number])
    assert len(played) == OPEN_LOOP


def random_states(rows: int, seed: int) -> Latent:
    g = torch.Generator().manual_seed(seed)
    sizes = (MODEL.deter, MODEL.classes * MODEL.groups)
    return Latent(*(torch.randn(rows, size, generator=g) for size in sizes))


def make_actor(seed: int) -> Actor:
    torch.manual_seed(seed)
    return Actor(AgentConfig(units=16), MODEL, SPEC.num_actions)


def test_an_actor_is_fitted_to_the_policy_that_is_wanted() -> None:
    """KL of (3/4, 1/4, 0, ...) from the uniform policy, worked out; then it falls to nearly nothing, and an actor that
    acts so already is left where it is."""
    actor, states = make_actor(0), random_states(64, 1)
    torch.nn.init.zeros_(actor.net[-1].weight)  # type: ignore[union-attr, arg-type]
    wanted = torch.full((64, 2, SPEC.num_actions), 1e-9)
    wanted[..., 0], wanted[..., 1] = 0.75, 0.25
    expected = 0.75 * np.log(0.75 * SPEC.num_actions) + 0.25 * np.log(0.25 * SPEC.num_actions)
    fit = fit_actor(actor, states, wanted.log(), 200, np.random.default_rng(0), rows=32, rate=5e-3)
    assert fit.before == pytest.approx(expected, abs=0.01) and 0.0 < fit.after < 0.05
    both = torch.tensor([0, 1]).expand(64, 2)
    with torch.no_grad():
        own = actor.log_probs(states.expand_players(), both)
    assert fit_actor(actor, states, own, 0, np.random.default_rng(0)) == (0.0, 0.0)


def test_partners_act_on_the_changed_models_latents_as_they_did_on_their_own() -> None:
    """Most of what a model that has moved on made of a partner is put right; the archived filter stays as it is."""
    learner, windows = make_learner(), random_windows(24, 8)
    archived = make_learner(seed=5)
    learner.add_predecessor(1, w.weights_of(archived.model.filter))
    before = w.weights_of(learner.predecessors[1])
    actor = make_actor(2)
    with torch.no_grad():
        actor.net[-1].weight.mul_(30.0)  # type: ignore[union-attr, operator]
    (fit,) = fit_partners(learner, {1: actor}, windows, 200)
    assert fit.before > 0.1 and fit.after < fit.before / 2
    for name, values in w.weights_of(learner.predecessors[1]).items():
        np.testing.assert_array_equal(values, before[name])
