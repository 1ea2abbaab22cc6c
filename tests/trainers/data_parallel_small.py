"""Some steps of data-parallel training, in one process of two; also run as a script, by its rank and the store."""

from __future__ import annotations

import sys
from datetime import timedelta

import torch
from tensordict import TensorDict
from torch import distributed
from torch.nn.parallel import DistributedDataParallel

from torchrl_tsallis import AdaTerm, CATSoftUpdate, PeakRating, PredictiveBCLoss, QTuner, ScoreTuner, TsallisBCLoss
from torchrl_tsallis.modules import make_policy, make_recurrent_policy

#: Name -> members (0 is a single policy), whether there is a mask, the rating
CASES = {
    "single": (0, False, "tsallis"),
    "masked": (0, True, "tsallis"),
    "members": (3, False, "tsallis"),
    "masked members": (3, True, "tsallis"),
    "peak": (0, False, "peak"),
    "masked peak": (0, True, "peak"),
    "masked members of peak": (3, True, "peak"),
    "masked prediction": (0, True, "prediction"),
}
ROWS, STEPS = 24, 4


def batch_of(members: int, masked: bool, step: int) -> TensorDict:
    """A batch ``[*S, ROWS]`` of demonstrations; the halves differ much, and in their numbers of valid samples."""
    generator = torch.Generator().manual_seed(step)
    shape = [members, ROWS] if members else [ROWS]
    observation = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    action = observation[..., :2].tanh() + 0.2 * torch.randn(*shape, 2, generator=generator, dtype=torch.float64)
    action[..., : ROWS // 3, :] += 5.0
    batch = TensorDict({"observation": observation, "action": action}, shape)
    if masked:
        mask = torch.rand(shape, generator=generator) < torch.linspace(0.2, 1.0, ROWS)
        batch["collector", "mask"] = mask
        batch["observation"][~mask] = torch.nan
    return batch


def as_sequences(batch: TensorDict) -> TensorDict:
    """Each row as a sequence of one step, whose next observation is to be predicted."""
    batch = batch.unsqueeze(-1)
    batch["is_init"] = torch.ones(*batch.shape, 1, dtype=torch.bool)
    batch["next", "observation"] = 2.0 * batch["observation"]
    return batch


def train(case: str, rank: int | None = None) -> dict[str, torch.Tensor]:
    """Trains by a share of each batch, or by all of it, and returns the outputs, the weights and phi."""
    members, masked, kind = CASES[case]
    torch.manual_seed(0)
    actors = [make_policy(3, 2, hidden=(6,)) for _ in range(members or 1)]
    policies = actors if members else actors[0]
    if kind == "peak":
        loss = TsallisBCLoss(policies, rating=PeakRating()).double()
        updater, tuner, logged = None, ScoreTuner(loss, lr=1e-2), ["u", "distance"]
    elif kind == "prediction":
        loss = PredictiveBCLoss(make_recurrent_policy(3, 2, hidden_size=4, state_noise=0.0)).double()
        updater, tuner, logged = CATSoftUpdate(loss), QTuner(loss, lr=1e-2), ["q"]
    else:
        gamma = ["adaptive", 0.0, "adaptive"] if members else "adaptive"
        loss = TsallisBCLoss(policies, gamma_mix=gamma).double()
        updater, tuner, logged = CATSoftUpdate(loss), QTuner(loss, lr=1e-2), ["q", "gamma_mix", "bound"]
    optimizer = AdaTerm(loss.parameters(), lr=1e-2, batch_dims=bool(members))
    forward = loss if rank is None else DistributedDataParallel(loss)
    seen: dict[str, torch.Tensor] = {}
    for step in range(STEPS):
        batch = batch_of(members, masked, step)
        if rank is not None:
            batch = batch[..., rank * ROWS // 2 : (rank + 1) * ROWS // 2]
        out = forward(as_sequences(batch) if kind == "prediction" else batch)
        sum(value for name, value in out.items() if name.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        if updater is not None:
            updater.step()
        out["objective"] = tuner.step()
        names = [*logged, "rating_mean", "rating_var", "ess", "log_prob", "objective"]
        seen |= {f"{name} of step {step}": out[name] for name in names}
    return seen | {"phi": tuner.phi.detach()} | {name: x.clone() for name, x in loss.state_dict().items()}


def train_in_parallel(rank: int, store: str) -> dict[str, dict[str, torch.Tensor]]:
    """Trains all cases as one of two processes."""
    distributed.init_process_group(
        "gloo", f"file://{store}", rank=rank, world_size=2, timeout=timedelta(seconds=900)
    )  # fmt: skip
    try:
        return {case: train(case, rank) for case in CASES}
    finally:
        distributed.destroy_process_group()


if __name__ == "__main__":
    train_in_parallel(int(sys.argv[1]), sys.argv[2])
