"""A member of a stacked run equals the run that it would be by itself."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.modules import make_policy

METHODS = {
    "bc": (1.0, 0.0, False),
    "q_bc": (0.8, 0.0, False),
    "q_kl": (0.8, 1.0, False),
    "adaptive_gamma": (0.7, "adaptive", False),
    "proposal": (0.8, "adaptive", True),
    "adaptive_q": (0.8, 0.0, True),
}


def make_actor(seed: int):
    torch.manual_seed(seed)
    return make_policy(3, 2, hidden=(8, 8))


def data_of(seed: int, rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(100 + seed)
    observation = torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    action = observation[:, :2].tanh() + 0.2 * noise
    action[::7] += 5.0
    return TensorDict({"observation": observation, "action": action}, [rows])


def solo_step(method: str, actor):
    q, gamma, tune = METHODS[method]
    loss = TsallisBCLoss(actor, q=q, gamma_mix=gamma).double()
    optimizer = AdaTerm(loss.parameters(), lr=1e-2)
    updater = CATSoftUpdate(loss) if loss.needs_target else None
    tuner = QTuner(loss, lr=1e-2) if tune else None
    return loss, stepper(loss, optimizer, updater, tuner)


def stacked_step(methods: list[str], actors: list):
    q, gamma, tuned = (list(column) for column in zip(*(METHODS[method] for method in methods), strict=True))
    loss = TsallisBCLoss(actors, q=q, gamma_mix=gamma).double()
    optimizer = AdaTerm(loss.parameters(), lr=1e-2, batch_dims=1)
    return loss, stepper(loss, optimizer, CATSoftUpdate(loss), QTuner(loss, tuned=tuned, lr=1e-2))


def stepper(loss, optimizer, updater, tuner):
    def step(batch):
        out = loss(batch)
        out["loss_tsallis_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()
        if updater is not None:
            updater.step()
        if tuner is not None:
            tuner.step()
        return out.detach()

    return step


def test_members_of_all_methods_equal_their_solo_runs():
    methods = list(METHODS)
    actors = [make_actor(seed).double() for seed in range(len(methods))]
    initial = [{k: v.clone() for k, v in actor.state_dict().items()} for actor in actors]
    data = [data_of(seed) for seed in range(len(methods))]
    generator = torch.Generator().manual_seed(0)
    rows = torch.stack([torch.randperm(64, generator=generator)[:16] for _ in range(100)])
    loss, step = stacked_step(methods, actors)
    outs = [step(torch.stack([member[index] for member in data])) for index in rows]
    for k, method in enumerate(methods):
        actor = make_actor(k).double()
        solo, solo_stepper = solo_step(method, actor)
        solo_outs = [solo_stepper(data[k][index]) for index in rows]
        for name, value in loss.member_state_dict(k).items():
            torch.testing.assert_close(value, actor.state_dict()[name], rtol=1e-4, atol=1e-8)
        for out, solo_out in zip(outs, solo_outs, strict=True):
            for name in set(loss.out_keys) - {"loss_tsallis_bc"}:
                torch.testing.assert_close(out[name][k], solo_out[name], rtol=1e-4, atol=1e-8)
    for out in outs:
        assert out["loss_tsallis_bc"].ndim == 0
    assert all(torch.equal(a.state_dict()[n], v) for a, i in zip(actors, initial, strict=True) for n, v in i.items())
