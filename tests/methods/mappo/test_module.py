"""A member's networks: what the actor and the critics see, and the paper's sizes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.mappo.rl_module import MemberModule, module_spec
from popgen.methods.mappo.training_job import Job
from popgen.nets.feed_forward import joint

VIEWS = {"features": ["scale=laptop"], "lossless": ["scale=paper", "ppo.units=32", "ppo.cnn_channels=8"]}


def member(*overrides: str) -> tuple[MemberModule, Job]:
    """Member 2 beside a frozen one."""
    config = RunConfig.parse(compose(["method=comedi", *overrides]))
    job = Job(config.env, config.ppo, config.diversity, (2,), seed=0, frozen={1: {}}, mixed=True, fresh=True)
    spec = make_env(config.env.name, 1, **config.env.params).spec
    return module_spec(job, spec, inference_only=False).build()["member_2"], job


def observed(job: Job) -> Tensor:
    """Joint observations (6, P, ...) after some random steps."""
    env, draw = make_env(job.env.name, 6, seed=1, **job.env.params), torch.Generator().manual_seed(0)
    for _ in range(15):
        env.step(torch.randint(0, 5, (6, 2), generator=draw, dtype=torch.uint8).numpy())
    return torch.from_numpy(env.observe(job.ppo.view))


@pytest.mark.parametrize("view", VIEWS)
def test_the_actor_sees_its_own_view_and_a_critic_both(view: str) -> None:
    module, job = member(*VIEWS[view])
    spec = make_env(job.env.name, 1, **job.env.params).spec.views[view]
    obs, seat = observed(job), torch.eye(2)[[0] * 6]
    assert module.actor.shape == spec.shape
    shape = joint(obs, spec).shape[1:]
    assert all(critic.shape == shape for critic in module.critics.values())
    # In `features` the other player is a part of one's own view; lossless ones are put side by side.
    assert shape == (spec.shape if view == "features" else (*spec.shape[:2], 2 * spec.shape[2]))
    other = obs.clone()
    other[:, 1] = obs[:, 1].flip(0)
    assert torch.equal(module.actor(obs[:, 0], seat), module.actor(other[:, 0], seat))
    if view == "lossless":
        critic = module.critics["XP_1"]
        assert (critic(joint(obs, spec), seat) != critic(joint(other, spec), seat)).any()


@pytest.mark.parametrize("env", ["overcooked/cramped_room", "rendezvous/mppmr"])
def test_the_papers_networks(env: str) -> None:
    module, _ = member("scale=paper", f"env={env}")
    flat = env.startswith("rendezvous")
    assert set(module.critics) == {"SP", "XP_1", "MP_1"}
    for net, outputs in [(module.actor, 5 if flat else 6), *((critic, 1) for critic in module.critics.values())]:
        parts = list(net)
        linear = [part.out_features for part in parts if isinstance(part, nn.Linear)]
        kernels = [part.kernel_size for part in parts if isinstance(part, nn.Conv2d)]
        # Two shared layers and the actor's or the critic's own one; on rendezvous five.
        assert linear == [*[512] * (5 if flat else 3), outputs]
        assert kernels == ([] if flat else [(5, 5), (3, 3), (3, 3)])
        assert sum(isinstance(part, nn.LeakyReLU) for part in parts) == len(linear) - 1 + len(kernels)
        assert not any(isinstance(part, nn.Tanh | nn.ReLU) for part in parts)
