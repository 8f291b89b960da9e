"""The paper's ablation of the reward: a head that predicts the joint reward in the place of the events."""

from __future__ import annotations

import pytest
import torch
from support.small import MODEL, kitchen, random_latent, random_windows

from popgen.errors import UserError
from popgen.methods.xpm_wm.config import OPEN_LOOP, XpmWmRun
from popgen.methods.xpm_wm.model_report import model_report
from popgen.methods.xpm_wm.world_model import ModelLearner, WorldModel, event_loss

SPEC = kitchen().spec
SCALAR = MODEL.model_copy(update={"reward_head": "scalar"})


def make_scalar(output: float) -> WorldModel:
    """A model whose head says the same of every state."""
    model = WorldModel(SCALAR, SPEC)
    with torch.no_grad():
        model.event_head[-1].weight.zero_()
        model.event_head[-1].bias.fill_(output)
    return model


def test_its_loss_is_a_gaussians() -> None:
    """The head says 2; nothing is worth 0 and a soup that player 1 delivers its weight w: 2 and (w - 2)^2 / 2."""
    model, latent = make_scalar(2.0), random_latent(1, 2)
    events = torch.zeros(1, 2, 2 * SPEC.num_events)
    events[0, 1, -1] = 1.0
    weight = SPEC.event_weights[-1]
    wanted = [[2.0, 0.5 * (weight - 2.0) ** 2]]
    assert model.reward_loss(latent, events).tolist() == [pytest.approx(wanted[0])]
    assert model.reward(latent).tolist() == [[2.0, 2.0]]
    assert model.event_head[-1].out_features == 1


def test_it_starts_at_the_mean_reward() -> None:
    model = make_scalar(0.0)
    means = torch.linspace(0.0, 0.2, 2 * SPEC.num_events)
    size = SPEC.views["features"].shape[0]
    model.set_outputs(torch.zeros(1, 1, 2, size), means[None, None])
    wanted = float((means * torch.tensor(SPEC.event_weights).repeat(2)).sum())
    assert model.reward(random_latent(3)).tolist() == pytest.approx([wanted] * 3)


def test_the_event_vector_learns_as_without_the_choice() -> None:
    model, latent = WorldModel(MODEL, SPEC), random_latent(2, 3)
    events = (torch.rand(2, 3, 2 * SPEC.num_events, generator=torch.Generator().manual_seed(0)) < 0.2).float()
    assert torch.equal(model.reward_loss(latent, events), event_loss(model.event_logits(latent), events))
    assert MODEL.reward_head == "events" and model.event_head[-1].out_features == 2 * SPEC.num_events


def test_it_learns_and_its_report_tells_no_events() -> None:
    learner = ModelLearner(SCALAR, SPEC, seed=0)
    learner.set_biases(random_windows(8, 5))
    losses = [learner.update(random_windows(8, 5, seed=0))[0]["loss_events"] for _ in range(5)]
    assert losses[-1] < losses[0]
    figures = model_report(learner, random_windows(8, 3 + OPEN_LOOP), 3)
    assert "exact_step1" in figures and not any("event" in name for name in figures)


def test_discovery_of_events_is_refused() -> None:
    values = {"env": {"name": "overcooked/cramped_room"}, "world_model": {"reward_head": "scalar"}}
    XpmWmRun.parse({"method": "xpm_wm", **values})
    with pytest.raises(UserError, match="reward_head"):
        XpmWmRun.parse({"method": "xpm_wm", **values, "discovery": {"trust": 2.0}})
