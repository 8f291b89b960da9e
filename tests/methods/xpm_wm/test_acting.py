from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.small import AGENT, MODEL, kitchen, random_play

from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.methods.xpm_wm.config import ACTING
from popgen.nets import weights as w
from popgen.policies.policy_registry import build_policy
from popgen.population import PopulationWriter, load_population

SPEC = kitchen().spec


def make_policy(seed: int = 0) -> WorldModelPolicy:
    torch.manual_seed(seed)
    policy = WorldModelPolicy(MODEL, AGENT, SPEC)
    with torch.no_grad():  # far from uniform, so that what it sees decides
        policy.actor.net[-1].weight.mul_(300.0)
    return policy


def play(policy: WorldModelPolicy, seed: int = 3, batch: int = 6) -> np.ndarray:
    """(T, B, P) actions on a fixed stream of observations with resets."""
    env = kitchen(batch, horizon=7)
    (segment,) = random_play(env, 20, seed=1)
    policy.reset(batch, seed)
    actions, previous = [], np.zeros((batch, 2), np.uint8)
    for t in range(20):
        first = env.time(segment.states[t]) == 0
        previous = policy.act(env.encode(segment.states[t]), previous, first)
        actions.append(previous)
    return np.array(actions)


def test_actions_are_a_function_of_seed_and_observations() -> None:
    policy = make_policy()
    first = play(policy)
    assert first.shape == (20, 6, 2) and first.dtype == np.uint8 and len(np.unique(first)) == SPEC.num_actions
    assert np.array_equal(play(policy), first) and not np.array_equal(play(policy, seed=4), first)


def test_a_saved_and_loaded_policy_acts_identically(tmp_path: Path) -> None:
    policy = make_policy()
    PopulationWriter(tmp_path, SPEC, method="xpm_wm", config_digest="0" * 64, seed=0).add_member(
        policy, seed=0, steps={}
    )
    loaded = load_population(tmp_path)[1]
    assert isinstance(loaded, WorldModelPolicy) and loaded.config() == policy.config()
    assert np.array_equal(play(loaded), play(policy)) and not np.array_equal(play(make_policy(1)), play(policy))


def test_parts_rebuild_it() -> None:
    policy = make_policy()
    config = json.loads(json.dumps(policy.config()))
    assert {name.partition(".")[0] for name in policy.weights()} == {"filter", "actor"}
    assert np.array_equal(play(build_policy("world_model", config, policy.weights(), SPEC)), play(policy))


def test_fields_of_training_do_not_matter_to_a_saved_policy() -> None:
    """A config of a version that trained otherwise: fields we do not know, and fields that we know gone or changed."""
    policy = make_policy()
    whole = {"world_model": MODEL.model_dump(mode="json"), "agent": AGENT.model_dump(mode="json")}
    assert set(policy.config()["world_model"]) < set(whole["world_model"])
    assert set(policy.config()["agent"]) < set(whole["agent"])
    other = json.loads(json.dumps(whole))
    other["agent"] |= {"lambda_warmup": 200, "lambda_xp": "strong", "actor_lr": -1}
    other["world_model"] |= {"decoder_heads": 3, "batch": None}
    other["curriculum"] = {}
    del other["agent"]["horizon"], other["world_model"]["length"]
    for config in (whole, other):
        rebuilt = build_policy("world_model", config, policy.weights(), SPEC)
        assert rebuilt.config() == policy.config() and np.array_equal(play(rebuilt), play(policy))


FIELDS = [(section, name) for section, names in ACTING.items() for name in names]


@pytest.mark.parametrize(("section", "name"), FIELDS)
def test_a_field_that_decides_how_it_acts_must_be_there_and_right(section: str, name: str) -> None:
    policy = make_policy()
    config = policy.config()
    config[section][name] = "wrong"
    with pytest.raises(ValueError, match=rf"^{section}\.{name}: [^\n]*$"):
        build_policy("world_model", config, policy.weights(), SPEC)
    del config[section][name]
    with pytest.raises(ValueError, match=rf"^{section}\.{name} is missing$"):
        build_policy("world_model", config, policy.weights(), SPEC)


def test_parts_without_a_section_are_refused() -> None:
    policy = make_policy()
    for config in ({"world_model": policy.config()["world_model"]}, {**policy.config(), "agent": [1]}):
        with pytest.raises(ValueError, match="no 'agent'"):
            build_policy("world_model", config, policy.weights(), SPEC)
    groups = policy.config()
    groups["world_model"]["joint_groups"] = groups["world_model"]["groups"]
    with pytest.raises(ValueError, match=r"^world_model\.joint_groups: must leave"):
        build_policy("world_model", groups, policy.weights(), SPEC)


@pytest.mark.parametrize("change", ["missing", "unknown", "shape"])
def test_weights_that_do_not_fit_are_refused(change: str) -> None:
    policy = make_policy()
    weights = policy.weights()
    name = "filter.gru.gates.bias"
    if change == "missing":
        del weights[name]
    elif change == "unknown":
        name = "critics.0.bias"
        weights[name] = np.zeros(1, np.float32)
    else:
        weights[name] = weights[name][:-1]
    with pytest.raises(ValueError, match=name):
        build_policy("world_model", policy.config(), weights, SPEC)


def test_new_weights_do_not_end_the_running_episodes() -> None:
    policy, other = make_policy(), make_policy(1)
    obs = kitchen(3).observe()
    policy.reset(3, 0)
    policy.act(obs, np.zeros((3, 2), np.uint8), np.ones(3, bool))
    latent = policy._latent
    policy.load(other.weights())
    assert policy._latent is latent
    assert all(np.array_equal(value, other.weights()[name]) for name, value in policy.weights().items())


def test_each_seat_acts_on_its_own_part_of_the_latent() -> None:
    policy = make_policy()
    obs = kitchen(200).observe()
    policy.reset(200, 0)
    actions = policy.act(obs, np.zeros((200, 2), np.uint8), np.ones(200, bool))
    assert policy._latent is not None
    for seat in (0, 1):
        wanted = policy.actor.log_probs(policy._latent, torch.full((200,), seat)).exp().mean(0).numpy()
        seen = np.bincount(actions[:, seat], minlength=SPEC.num_actions) / 200
        assert np.abs(seen - wanted).max() < 4 * np.sqrt(0.25 / 200)


def test_a_row_that_begins_anew_forgets_its_past_and_no_other() -> None:
    policy, env = make_policy(), kitchen(2, horizon=7)
    (segment,) = random_play(env, 6, seed=2)
    hidden = []
    for first in ([False, False], [True, False]):
        policy.reset(2, 0)
        for t in range(5):
            policy.act(env.encode(segment.states[t]), segment.actions[max(t - 1, 0)], np.full(2, t == 0))
        policy.act(env.encode(segment.states[5]), segment.actions[4], np.array(first))
        assert policy._latent is not None
        hidden.append(policy._latent.h.clone())
    assert not torch.equal(hidden[0][0], hidden[1][0]) and torch.equal(hidden[0][1], hidden[1][1])
    fresh = make_policy()
    fresh.reset(2, 5)
    fresh.act(env.encode(segment.states[5]), segment.actions[0], np.ones(2, bool))
    assert fresh._latent is not None and torch.equal(fresh._latent.h[0], hidden[1][0])


def test_reset_must_fit_the_batch() -> None:
    policy = make_policy()
    first = np.ones(2, bool)
    with pytest.raises(RuntimeError, match=r"reset\(batch=2"):
        policy.act(kitchen(2).observe(), np.zeros((2, 2), np.uint8), first)
    policy.reset(3, 0)
    with pytest.raises(RuntimeError, match=r"reset\(batch=2"):
        policy.act(kitchen(2).observe(), np.zeros((2, 2), np.uint8), first)


def test_the_policy_that_samplers_get_is_filter_and_actor() -> None:
    """What an agent learner publishes (`AgentActor.acting_weights`) is what `load` takes."""
    policy, other = make_policy(), make_policy(1)
    merged = w.prefixed("filter", w.weights_of(other.filter)) | w.prefixed("actor", w.weights_of(other.actor))
    policy.load(merged)
    assert np.array_equal(play(policy), play(other))


def test_memory_goes_on_in_the_middle_of_an_episode() -> None:
    from popgen.play.policy import Remembering

    env, policy, other = kitchen(3), make_policy(), make_policy()
    assert isinstance(policy, Remembering)
    with pytest.raises(RuntimeError, match="before reset"):
        policy.memory()
    obs, actions, first = env.observe(), np.zeros((3, 2), np.uint8), np.ones(3, bool)
    policy.reset(3, seed=5)
    for _ in range(4):
        actions, first = policy.act(obs, actions, first), np.zeros(3, bool)
    other.load_memory(policy.memory())
    for _ in range(6):
        ours, theirs = policy.act(obs, actions, first), other.act(obs, actions, first)
        np.testing.assert_array_equal(ours, theirs)
        actions = ours
