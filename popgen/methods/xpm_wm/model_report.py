"""Looking inside the world model: does it know the events, and for how long does it see clearly?"""

from __future__ import annotations

import torch

from popgen.methods.xpm_wm.config import OPEN_LOOP
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.methods.xpm_wm.replay import Windows
from popgen.methods.xpm_wm.world_model import ModelLearner, WindowBatch, WorldModel, event_counts


@torch.no_grad()
def model_report(learner: ModelLearner, windows: Windows, context: int) -> dict[str, float]:
    """Figures on real windows of at least `context + OPEN_LOOP` states.

    After `context` observed steps the model continues from its prior with the real actions, one and OPEN_LOOP steps:
    event precision and recall (all events, and each by name), and the share of exact joint observations.
    Windows in which an episode begins after the context are left out.
    """
    model = learner.model
    batch = WindowBatch.from_windows(windows, model)
    end = context + OPEN_LOOP
    keep = ~batch.is_first[context:end].any(0)
    obs, actions = batch.obs[:, keep], batch.actions[:, keep]
    seen = model.observe(obs[:context], actions[:context], batch.is_first[:context, keep], learner.generator)
    figures = {"exact_posterior": float(model.exact(model.decode(seen.latent), obs[:context]).float().mean())}
    latent = seen.latent[-1]
    for step in range(1, OPEN_LOOP + 1):
        t = context + step - 1
        latent = model.step(latent, actions[t], learner.generator)
        if step in (1, OPEN_LOOP):
            figures |= _compare_step(model, latent, obs[t], batch.events[t, keep], f"step{step}")
    return figures


def _compare_step(
    model: WorldModel, latent: Latent, obs: torch.Tensor, events: torch.Tensor, label: str
) -> dict[str, float]:
    spec = model.spec
    figures = {f"exact_{label}": float(model.exact(model.decode(latent), obs).float().mean())}
    if model.scalar:  # it tells no events
        return figures
    logits = model.event_logits(latent).unflatten(-1, (spec.num_players, spec.num_events))
    counts = event_counts(logits.unsqueeze(0), events.unsqueeze(0), torch.ones(1, len(events), device=events.device))
    figures[f"event_precision_{label}"] = _share_of(counts["hits"].sum(), counts["predicted"].sum())
    figures[f"event_recall_{label}"] = _share_of(counts["hits"].sum(), counts["actual"].sum())
    for index, name in enumerate(spec.event_names):
        if counts["actual"][index] > 0:
            figures[f"recall_{name}_{label}"] = _share_of(counts["hits"][index], counts["actual"][index])
        if counts["predicted"][index] > 0:
            figures[f"precision_{name}_{label}"] = _share_of(counts["hits"][index], counts["predicted"][index])
    return figures


def _share_of(hits: torch.Tensor, of: torch.Tensor) -> float:
    return float(hits / of) if of > 0 else 0.0
