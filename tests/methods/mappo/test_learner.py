"""The learner on its own: where gradients go, which way they point, and going on from a snapshot."""

from __future__ import annotations

import inspect
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

from popgen.config.sections import ClusterConfig, EnvConfig
from popgen.envs import make_env
from popgen.methods.mappo.algorithm import MappoConfig
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.mappo.play_record import PlayRecord
from popgen.methods.mappo.pooled_learner import PooledLearner
from popgen.methods.mappo.pooling import Plan
from popgen.methods.mappo.rl_module import MemberModule, module_spec
from popgen.methods.mappo.slots import Rollout, SlotPool
from popgen.methods.mappo.training_job import Job

ENV = EnvConfig(params={"horizon": 20})
PPO = PpoConfig(units=16, layers=1, envs=4, steps=20, epochs=2, minibatches=2, learning_rate=1e-2)
CROSS = DiversityConfig(order="sequential", xp_envs=4, mp_envs=4, lambda_xp=0.5)
SPEC = make_env(ENV.name, 1, **ENV.params).spec


@pytest.fixture(autouse=True)
def short_stacks(monkeypatch: pytest.MonkeyPatch) -> None:
    """RLlib asks who makes each part of a learner, and would read the source of pytest's whole stack each time."""
    monkeypatch.setattr(inspect, "stack", partial(inspect.stack, 0))


def learner(job: Job) -> PooledLearner:
    config = MappoConfig.of(job, SPEC, ClusterConfig())
    made = PooledLearner(config=config, module_spec=module_spec(job, SPEC, inference_only=False))
    made.build()
    return made


def actors(made: PooledLearner) -> dict[int, Any]:
    return {member: made._module_of(member).actor for member in made.config.job.learning}


def sampled(job: Job, nets: dict[int, Any], seed: int = 0) -> Rollout:
    groups = job.matches()
    pool = SlotPool(lambda n, s: make_env(ENV.name, n, seed=s, **ENV.params), groups, "features", seed=seed)
    return pool.play(range(len(groups)), 20, nets)


def later(**changes: Any) -> Job:
    """Member 3 after two frozen ones."""
    diversity = CROSS.model_copy(update=changes)
    return Job(ENV, PPO, diversity, (3,), seed=7, frozen={1: {}, 2: {}}, mixed=True, fresh=True)


def with_partners(made: PooledLearner) -> dict[int, Any]:
    nets = actors(made)
    spec = module_spec(Job(ENV, PPO, None, (1,), seed=50), SPEC, inference_only=True)
    frozen = spec.build()["member_1"].actor
    return {**nets, 1: frozen, 2: frozen}


def update(made: PooledLearner, rollouts: list[Rollout], plans: dict[int, Plan]) -> None:
    made.update(episodes=rollouts, timesteps={}, plans=plans, progress=0.0, num_epochs=1, shuffle_batch_per_epoch=False)


def copies(module: torch.nn.Module) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy().copy() for name, value in module.state_dict().items()}


def moved(module: torch.nn.Module, before: dict[str, np.ndarray]) -> set[str]:
    """Networks of a member in which something changed."""
    now = copies(module)
    changed = [name.split(".") for name in now if (now[name] != before[name]).any()]
    return {".".join(parts[:2]) if parts[0] == "critics" else parts[0] for parts in changed}


def test_a_copy_for_acting_has_no_critics() -> None:
    job = later()
    acting = module_spec(job, SPEC, inference_only=True).build()["member_3"]
    assert isinstance(acting, MemberModule) and {name.split(".")[0] for name in acting.state_dict()} == {"actor"}
    made = learner(job)
    assert set(made._module_of(3).critics) == {"SP", "XP_1", "XP_2", "MP_1", "MP_2"}
    for name, value in acting.actor.state_dict().items():
        assert torch.equal(value, made._module_of(3).actor.state_dict()[name])  # the same seed


def test_the_chosen_partners_critics_and_nothing_else_moves() -> None:
    made = learner(job := later())
    nets = with_partners(made)
    frozen, module = copies(nets[1]), copies(made._module_of(3))
    update(made, [sampled(job, nets)], {3: Plan(2, 0.5, 0.25)})
    assert moved(made._module_of(3), module) == {"actor", "critics.SP", "critics.XP_2", "critics.MP_2"}
    assert not moved(nets[1], frozen)


def test_members_learn_together_each_from_its_own_seats() -> None:
    job = Job(ENV, PPO, CROSS, (1, 2), seed=3)
    made = learner(job)
    rollout, before = sampled(job, actors(made)), {m: copies(made._module_of(m)) for m in (1, 2)}
    update(made, [rollout], {1: Plan(2, 0.5), 2: Plan()})
    assert moved(made._module_of(1), before[1]) == {"actor", "critics.SP", "critics.XP_2"}
    assert moved(made._module_of(2), before[2]) == {"actor", "critics.SP"}


def loss(made: PooledLearner, log_ratio: list[float], advantage: list[float], cross: list[bool]) -> torch.Tensor:
    """Of rows whose policy gives the action `log_ratio` more log-probability than when it was played."""
    logits = torch.zeros(len(advantage), SPEC.num_actions, requires_grad=True)
    log_prob = torch.log_softmax(logits, -1)[:, 0].detach()
    batch = {
        "action": torch.zeros(len(advantage), dtype=torch.long),
        "log_prob": log_prob - torch.tensor(log_ratio),
        "advantage": torch.tensor(advantage),
        "weight": torch.full((len(advantage),), 1.0),
        "cross": torch.tensor(cross),
        "critics": {},
    }
    made._sums = {"member_3": {name: [] for name in ("policy_loss", "value_loss", "entropy", "kl", "clipped")}}
    made._entropy = 0.0
    fwd = {"action_dist_inputs": logits, "vf_preds": {}}
    value = made.compute_loss_for_module(module_id="member_3", config=None, batch=batch, fwd_out=fwd)
    (grad,) = torch.autograd.grad(value, logits)
    return grad[:, 0]


def test_gradients_point_where_the_signed_advantage_says() -> None:
    """Descending makes an action of positive signed advantage likelier, of negative less likely."""
    grad = loss(learner(later()), [0.0, 0.0], [1.0, -1.0], [False, True])
    assert grad[0] < 0 < grad[1]


def test_the_signed_loss_stops_at_the_clip_and_the_published_one_does_not() -> None:
    """Cross-play rows (signed advantage -1) whose action is already half as likely: a ratio below 1 - clip."""
    gone = [float(np.log(0.5))]
    assert loss(learner(later()), gone, [-1.0], [True]).item() == 0.0
    assert loss(learner(later(xp_loss="negated")), gone, [-1.0], [True]).item() > 0.0
    # Self-play rows are as always.
    assert loss(learner(later(xp_loss="negated")), gone, [-1.0], [False]).item() == 0.0


@pytest.mark.parametrize(("progress", "share"), [(0.0, 1.0), (0.5, 0.6), (1.0, 0.2), (1.7, 0.2)])
def test_rates_go_in_a_straight_line(progress: float, share: float) -> None:
    ppo = PPO.model_copy(update={"learning_rate_end": 0.2, "entropy_end": 0.2})
    made = learner(Job(ENV, ppo, None, (1,), seed=0))
    made._anneal_rates(progress)
    assert made._entropy == pytest.approx(0.01 * share)
    for optimiser in made._named_optimizers.values():
        assert optimiser.param_groups[0]["lr"] == pytest.approx(1e-2 * share)


def test_a_snapshot_goes_on_exactly() -> None:
    job = later()
    one, other = learner(job), learner(Job(ENV, PPO, CROSS, (3,), seed=8, frozen=job.frozen, mixed=True, fresh=True))
    nets = with_partners(one)
    plans = {3: Plan(1, 0.5, 0.25)}
    first, second = sampled(job, nets, seed=1), sampled(job, nets, seed=2)
    update(one, [first], plans)
    other.restore(one.snapshot())
    for made in (one, other):
        update(made, [second], plans)
    ours, theirs = copies(one._module_of(3)), copies(other._module_of(3))
    assert all((ours[name] == theirs[name]).all() for name in ours)


def test_rollouts_of_several_runners_are_one_batch() -> None:
    job = later()
    made = learner(job)
    nets = with_partners(made)
    rollouts = [sampled(job, nets, seed=1), sampled(job, nets, seed=2)]
    update(made, rollouts, {3: Plan(1, 0.5, 0.25)})
    figures = made.figures()[3]
    own = np.concatenate([r.reward[:, r.columns(0)] for r in rollouts])
    assert figures["sp_reward"] == pytest.approx(float(own.mean()), abs=1e-6)
    assert {"xp_reward", "policy_loss", "value_loss", "entropy", "kl", "clipped"} <= figures.keys()


def test_fewer_rows_than_minibatches_are_learned_from() -> None:
    """A lost runner may have had most of them: a minibatch without rows would have no mean entropy."""
    ppo = PPO.model_copy(update={"minibatches": 80})
    job = Job(ENV, ppo, None, (1,), seed=3)
    made = learner(job)
    pool = SlotPool(lambda n, s: make_env(ENV.name, n, seed=s, **ENV.params), job.matches(), "features", seed=0)
    short = pool.play([0], 2, actors(made))
    before = copies(made._module_of(1))
    update(made, [short], {1: Plan()})
    assert np.isfinite(list(made.figures()[1].values())).all()
    assert moved(made._module_of(1), before) == {"actor", "critics.SP"}


CARD = torch.device("cuda", 0)


class Card(TorchFunctionMode):
    """Stands in for a GPU, which this machine need not have: refuses what CUDA would.

    Tensors that are moved to it, and what is computed from them, are marked. One of them meets another tensor only if
    that is a scalar or an index, and becomes an array only after `cpu()`.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        given = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
        on_card = [t for t in given if marked(t)]
        if func == Tensor.device.__get__:
            return CARD if on_card else func(*args, **kwargs)
        if func is Tensor.to and CARD in (*args[1:], kwargs.get("device")):
            return mark(args[0].to(kwargs.get("dtype", args[0].dtype)).clone())
        if func is Tensor.cpu:
            return args[0].clone()
        assert not (on_card and func is Tensor.numpy), "an array of a tensor on the card"
        loose = [t for t in given if not marked(t) and t.dim()]
        allowed = func is Tensor.copy_ or func is Tensor.__getitem__ and marked(args[0])
        assert not (on_card and loose and not allowed), f"{func.__name__} of tensors on two devices"
        result = func(*args, **kwargs)
        return tree_map_only(Tensor, mark, result) if on_card else result


def mark(tensor: Tensor) -> Tensor:
    tensor.on_card = True  # type: ignore[attr-defined]
    return tensor


def marked(tensor: Tensor) -> bool:
    return getattr(tensor, "on_card", False)


def on_card(made: PooledLearner) -> PooledLearner:
    made._device = CARD
    for member in made.config.job.learning:
        tensors = [*made._module_of(member).parameters(), *made._module_of(member).buffers()]
        for tensor in tensors:
            mark(tensor)
    return made


@pytest.mark.parametrize("changes", [{}, {"xp_loss": "negated"}])
def test_a_learner_on_a_card_learns_the_same(changes: dict[str, Any]) -> None:
    job = later(**changes)
    here, there = learner(job), on_card(learner(job))
    nets, plans = with_partners(here), {3: Plan(1, 0.5, 0.25)}
    rollouts = [sampled(job, nets, seed=1), sampled(job, nets, seed=2)]
    update(here, rollouts, plans)
    with Card():
        update(there, rollouts, plans)
        actor, critics, snapshot = there.actors()[3], there.critics(3), there.snapshot()
        there.restore(snapshot)
        figures = there.figures()[3]
    assert all((actor[name] == array).all() for name, array in here.actors()[3].items())
    assert all((critics[name] == array).all() for name, array in here.critics(3).items())
    assert figures == here.figures()[3]


def test_the_card_refuses_what_is_elsewhere() -> None:
    with Card():
        there, here = torch.ones(3).to(CARD), torch.ones(3)
        assert (there * 2.0)[torch.tensor([0, 1])].device == CARD and here.device.type == "cpu"
        with pytest.raises(AssertionError, match="two devices"):
            there + here
        with pytest.raises(AssertionError, match="an array"):
            (there + 1.0).numpy()
        assert (there.cpu() + here).tolist() == [2.0] * 3


def test_a_learner_that_asks_for_a_card_gets_one() -> None:
    job = Job(ENV, PPO, None, (1,), seed=0)
    assert MappoConfig.of(job, SPEC, ClusterConfig()).num_gpus_per_learner == 0
    config = MappoConfig.of(job, SPEC, ClusterConfig(agent_gpus=1.0))
    config.validate()
    assert config.num_gpus_per_learner == 1 and config.num_learners == 0


def test_of_pairs_that_meet_everyone_learns_from_its_own_play_and_from_all_others() -> None:
    """Two pairs: best responses 1 and 2, confederates 3 and 4; steps by their owners."""
    ppo = PPO.model_copy(update={"envs": 4})
    job = Job(ENV, ppo, CROSS, (1, 2, 3, 4), seed=3, pairs={1: 3, 2: 4}, all_partners=True)
    made = learner(job)
    before, record = {m: copies(made._module_of(m)) for m in job.learning}, PlayRecord(job)
    rollout = sampled(job, actors(made))
    update(made, [rollout], {member: record.plan(member, 100) for member in job.learning})
    for member, other in ((1, 4), (2, 3), (3, 2), (4, 1)):
        assert moved(made._module_of(member), before[member]) == {"actor", "critics.SP", f"critics.XP_{other}"}
    counted = {(one.owner, str(one.kind)): one.steps for one in record.add(0, rollout, judge_partners=True)}
    assert counted == {(1, "SP"): 80, (2, "SP"): 80, (3, "XP"): 80, (4, "XP"): 80}
    assert set(made.actors()) == {1, 2, 3, 4} and set(made.figures()[1]) >= {"xp_reward", "sp_reward", "entropy"}
