"""A policy that is loaded after its target network was made is noticed, and is not pulled to what was there before."""

from __future__ import annotations

import copy
import gc
import itertools
import logging
import pickle

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl._utils import logger
from torchrl.objectives.common import LossModule

from torchrl_tsallis import AdaTerm, CATSoftUpdate, TsallisBCLoss
from torchrl_tsallis.modules import make_policy


@pytest.fixture
def messages():
    """What TorchRL's logger says."""
    found: list[str] = []

    class Handler(logging.Handler):
        def emit(self, record):
            found.append(record.getMessage())

    handler, level = Handler(), logger.level
    logger.addHandler(handler)
    logger.setLevel("WARNING")
    yield found
    logger.removeHandler(handler)
    logger.setLevel(level)


def make_actor(seed):
    torch.manual_seed(seed)
    return make_policy(3, 2, hidden=(8, 8))


def data_of(seed, *members):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(*members, 16, 3, generator=generator)
    return TensorDict({"observation": observation, "action": observation[..., :2].sin()}, observation.shape[:-1])


def train(loss, updater, steps, first=0, optimizer=None):
    members = [] if loss.num_members is None else [loss.num_members]
    optimizer = optimizer or AdaTerm(loss.parameters(), lr=1e-2, batch_dims=len(members))
    for step in range(first, first + steps):
        loss(data_of(step, *members))["loss_tsallis_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
    return optimizer


def tensors(loss):
    return {name: x.clone() for name, x in loss.state_dict().items() if isinstance(x, torch.Tensor)}


def same(first, second):
    assert first.keys() == second.keys()
    for name in first:
        assert torch.equal(first[name], second[name]), name


def by_actor(loss, actor, other):
    actor.load_state_dict(other.state_dict())


def by_parts(loss, actor, other):
    for part, theirs in zip(actor.module[0].module, other.module[0].module, strict=True):
        part.load_state_dict(theirs.state_dict())


def by_loss(loss, actor, other):
    state = TsallisBCLoss(other, gamma_mix=0.0).state_dict()
    loss.load_state_dict({n: x for n, x in state.items() if n.startswith("actor_network_params.")}, strict=False)


def by_a_module_around(loss, actor, other):
    nn.ModuleDict({"policy": actor}).load_state_dict(nn.ModuleDict({"policy": other}).state_dict())


def by_copies(loss, actor, other):
    with torch.no_grad():
        for p, q in zip(actor.parameters(), other.parameters(), strict=True):
            p.copy_(q)


def by_data(loss, actor, other):
    for p, q in zip(actor.parameters(), other.parameters(), strict=True):
        p.data.copy_(q.data)


def by_vector(loss, actor, other):
    nn.utils.vector_to_parameters(nn.utils.parameters_to_vector(other.parameters()), actor.parameters())


def by_stateful_net(loss, actor, other):
    loss.from_stateful_net("actor_network", other)


WAYS = [by_actor, by_parts, by_loss, by_a_module_around, by_copies, by_data, by_vector, by_stateful_net]


@pytest.mark.parametrize("load", WAYS)
@pytest.mark.parametrize("steps", [0, 5])
def test_a_policy_loaded_late_is_not_pulled_to_the_one_before(load, steps, messages):
    actor, other = make_actor(0), make_actor(1)
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    train(loss, updater, steps)
    assert not messages
    load(loss, actor, other)
    for _ in range(20):
        updater.step()
    same(actor.state_dict(), other.state_dict())
    state = tensors(loss)
    for name in actor.state_dict():
        assert torch.equal(state[f"target_actor_network_params.{name}"], state[f"actor_network_params.{name}"])
    assert [message for message in messages if "starts anew" in message] == messages
    assert len(messages) == 1


@pytest.mark.parametrize("load", [by_actor, by_parts, by_loss, by_a_module_around])
def test_loaded_late_trains_bit_for_bit_as_loaded_before(load):
    results = []
    for late in (False, True):
        actor = make_actor(0)
        if not late:
            by_actor(None, actor, make_actor(1))
        loss = TsallisBCLoss(actor)
        updater = CATSoftUpdate(loss)
        if late:
            load(loss, actor, make_actor(1))
        train(loss, updater, 10)
        results.append({**tensors(loss), **updater.state_dict()["cat"]["target_actor_network_params"]["scale"]})
    same(*results)


def test_parameters_that_resemble_the_old_ones_are_noticed_where_load_state_dict_brings_them(messages):
    actor, other = make_actor(0), make_actor(0)
    with torch.no_grad():
        for p in other.parameters():
            p.mul_(1.1)
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    by_actor(loss, actor, other)
    updater.step()
    same(actor.state_dict(), other.state_dict())
    assert len(messages) == 1


@pytest.mark.parametrize("lr", [1e-3, 0.03, 0.3])
@pytest.mark.parametrize("kind", [AdaTerm, torch.optim.Adam, torch.optim.SGD])
def test_steps_of_an_optimizer_are_not_taken_for_a_load(kind, lr, messages):
    loss = TsallisBCLoss(make_actor(0))
    updater = CATSoftUpdate(loss)
    optimizer = kind(loss.parameters(), lr=min(lr, 0.03) if kind is torch.optim.SGD else lr)
    train(loss, updater, 20, optimizer=optimizer)
    assert not messages


def test_a_policy_that_diverged_is_not_taken_for_a_load(messages):
    loss = TsallisBCLoss(make_actor(0))
    updater = CATSoftUpdate(loss)
    with torch.no_grad():
        for p in loss.parameters():
            p.fill_(torch.nan)
    updater.step()
    assert not messages


def test_parameters_that_are_swapped_out_and_back_leave_no_trace(messages):
    results = []
    for swap in (False, True):
        actor = make_actor(0)
        loss = TsallisBCLoss(actor)
        updater = CATSoftUpdate(loss)
        optimizer = train(loss, updater, 5)
        if swap:
            kept = copy.deepcopy(actor.state_dict())
            by_actor(loss, actor, make_actor(1))
            actor.load_state_dict(kept)
        train(loss, updater, 5, 5, optimizer)
        results.append({**tensors(loss), **updater.state_dict()["cat"]["target_actor_network_params"]["scale"]})
    same(*results)
    assert not messages


@pytest.mark.parametrize("order", list(itertools.permutations(["actor", "loss", "updater"])), ids="-".join)
def test_a_checkpoint_continues_bit_for_bit_in_whatever_order_it_is_loaded(order, messages):
    actor = make_actor(0)
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    optimizer = train(loss, updater, 8)
    parts = {"actor": actor, "loss": loss, "updater": updater}
    saved = {name: copy.deepcopy(part.state_dict()) for name, part in parts.items()}
    saved_optimizer = copy.deepcopy(optimizer.state_dict())
    resumed_actor = make_actor(1)
    resumed = TsallisBCLoss(resumed_actor)
    follower = CATSoftUpdate(resumed)
    for name in order:
        {"actor": resumed_actor, "loss": resumed, "updater": follower}[name].load_state_dict(saved[name])
    other = AdaTerm(resumed.parameters(), lr=1e-2)
    other.load_state_dict(saved_optimizer)
    train(loss, updater, 8, 8, optimizer)
    train(resumed, follower, 8, 8, other)
    same(tensors(loss), tensors(resumed))
    for name, views in updater.state_dict()["cat"]["target_actor_network_params"].items():
        same(views, follower.state_dict()["cat"]["target_actor_network_params"][name])
    assert not messages


def test_of_stacked_members_the_loaded_one_starts_anew(messages):
    results = []
    for load in (False, True):
        loss = TsallisBCLoss([make_actor(seed) for seed in range(3)])
        updater = CATSoftUpdate(loss)
        optimizer = train(loss, updater, 5)
        if load:
            new = TensorDict.from_module(make_actor(9)).data
            loss.actor_network_params.data[1].update_(new)
            updater.step()
            assert torch.equal(loss.actor_network_params.data[1].get(("module", "0", "module", "0", "weight")),
                               new.get(("module", "0", "module", "0", "weight")))  # fmt: skip
        else:
            updater.step()
        train(loss, updater, 5, 5, optimizer)
        results.append(tensors(loss))
    assert ["of members [1]" in message for message in messages] == [True]
    for name, x in results[0].items():
        if name != "q" and x.ndim:
            assert torch.equal(x[::2], results[1][name][::2]), name


def test_what_is_not_trained_reaches_the_target_too():
    actor = make_actor(0)
    network = actor.module[0].module
    network[0].weight.requires_grad_(False)
    network.register_buffer("mean", torch.zeros(3))
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    train(loss, updater, 3, optimizer=AdaTerm([p for p in loss.parameters() if p.requires_grad]))
    state = copy.deepcopy(make_actor(1).state_dict())
    actor.load_state_dict({**state, "module.0.module.mean": torch.ones(3)})
    target = tensors(loss)
    assert torch.equal(
        target["target_actor_network_params.module.0.module.0.weight"], state["module.0.module.0.weight"]
    )
    assert torch.equal(target["target_actor_network_params.module.0.module.mean"], torch.ones(3))


def test_a_load_after_a_change_of_the_data_type_is_followed(messages):
    actor = make_actor(0)
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    updater.step()
    loss.double()
    state = {name: x.double() for name, x in make_actor(1).state_dict().items()}
    actor.load_state_dict(state)
    updater.step()
    target = tensors(loss)
    for name, x in state.items():
        assert torch.equal(target[f"target_actor_network_params.{name}"], x), name
    assert len(messages) == 1


def test_parameters_that_are_exchanged_for_others_are_named(messages):
    actor = make_actor(0)
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    actor.load_state_dict(make_actor(1).state_dict(), assign=True)
    updater.step()
    assert ["assign=True" in message for message in messages] == [True]


def test_a_loss_of_several_networks_watches_each_of_them(messages):
    class Two(LossModule):
        actor: TensorDictModule
        actor_params: TensorDictParams
        target_actor_params: TensorDictParams
        critic: TensorDictModule
        critic_params: TensorDictParams
        target_critic_params: TensorDictParams

        def __init__(self):
            super().__init__()
            torch.manual_seed(0)
            for name, members in (("actor", None), ("critic", 2)):
                nets = [TensorDictModule(nn.Linear(3, 4), ["x"], [name]) for _ in range(members or 1)]
                nets = nets if members else nets[0]
                self.convert_to_functional(nets, name, expand_dim=members, create_target_params=True)

        def _forward_value_estimator_keys(self, **kwargs):
            pass

        def forward(self, tensordict):
            return tensordict

    loss = Two()
    updater = CATSoftUpdate(loss)
    critics = tensors(loss.target_critic_params)
    loss.critic.load_state_dict(loss.critic.state_dict())
    state = TensorDictModule(nn.Linear(3, 4), ["x"], ["actor"]).state_dict()
    loss.actor.load_state_dict(state)
    for _ in range(3):
        updater.step()
    same(loss.actor.state_dict(), state)
    same(tensors(loss.target_critic_params), critics)
    assert ["into actor_params" in message for message in messages] == [True]


def test_copies_of_the_actor_and_files_of_it_take_no_loss_along(messages):
    actor = make_actor(0)
    size = len(pickle.dumps(actor))
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    assert len(pickle.dumps(actor)) < 2 * size
    other = copy.deepcopy(actor)
    other.load_state_dict(make_actor(1).state_dict())
    updater.step()
    assert not messages
    same(actor.state_dict(), make_actor(0).state_dict())


def test_a_pickled_updater_still_notices(messages):
    loss = TsallisBCLoss(make_actor(0))
    copied, follower = pickle.loads(pickle.dumps((loss, CATSoftUpdate(loss))))
    by_actor(copied, copied.actor_network, make_actor(1))
    for _ in range(5):
        follower.step()
    same(copied.actor_network.state_dict(), make_actor(1).state_dict())
    assert len(messages) == 1


def test_an_updater_that_is_gone_leaves_the_actor_alone():
    actor = make_actor(0)
    hooks = len(actor._load_state_dict_post_hooks)
    loss = TsallisBCLoss(actor)
    updater = CATSoftUpdate(loss)
    assert len(actor._load_state_dict_post_hooks) == hooks + 1
    del updater

    gc.collect()
    assert len(actor._load_state_dict_post_hooks) == hooks
    by_actor(loss, actor, make_actor(1))
