"""A mixture of policies over whole episodes: its formulas by hand, its samples, and what it finds."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal

from torchrl_tsallis import AdaTerm, PeakRating, ScoreTuner, TsallisBCLoss
from torchrl_tsallis.data.episodes import Episodes
from torchrl_tsallis.modes import (
    Annealing,
    EpisodeMixture,
    EpisodeSampler,
    episode_means,
    make_episode_buffer,
    random_responsibilities,
    responsibilities,
    robust_log_prob,
)
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings.normal import DiagonalNormal
from torchrl_tsallis.trainers import make_offline_trainer, resume


def demonstrations(episodes_of=(4, 4), length=32, sign=(1.0, -1.0), noise=0.05, seed=0):
    """Demonstrators who act by opposite signs, in turns; the true one of each episode."""
    generator = torch.Generator().manual_seed(seed)
    true = torch.arange(sum(episodes_of)) % len(sign)
    observation = torch.randn(len(true) * length, 2, generator=generator)
    action = torch.tensor(sign)[true].repeat_interleave(length)[:, None] * observation
    action = action + noise * torch.randn(action.shape, generator=generator)
    data = TensorDict({"observation": observation, "action": action}, [len(action)])
    return data.set("episode", torch.arange(len(true)).repeat_interleave(length)), true


def mixture_of(data, sizes, *, seed=0, every=8, known=None, rating=None, **options):
    torch.manual_seed(seed)
    loss = TsallisBCLoss([make_policy(2, 2, hidden=(16,)) for _ in range(sum(sizes))], rating=rating or PeakRating())
    buffer = make_episode_buffer(data, seeds=list(range(sum(sizes))), batch_size=32)
    mixture = EpisodeMixture(loss, buffer, sizes, every=every, seed=seed, known=known, **options)
    return loss, buffer, mixture


def train(loss, buffer, mixture, steps, **options):
    trainer = make_offline_trainer(
        loss, buffer, AdaTerm(loss.parameters(), lr=5e-3, batch_dims=1), steps=steps, progress=False, **options
    )
    mixture.register(trainer)
    return trainer


# ---- the likelihood


def test_log_prob_is_the_normal_ones_up_to_a_constant_where_nothing_is_cut():
    value, loc, scale = torch.tensor([[1.0, 2.0]]), torch.tensor([[0.5, 1.0]]), torch.tensor([[2.0, 0.5]])
    wanted = Independent(Normal(loc, scale), 1).log_prob(value) + math.log(2 * math.pi)
    torch.testing.assert_close(robust_log_prob(DiagonalNormal(value, loc, scale)), wanted)


@pytest.mark.parametrize("far", [6.0, 1e6, 3e38, math.inf])
def test_a_step_that_was_not_expected_costs_three_nats_a_dimension_and_no_more(far):
    one = torch.ones(1, 2)
    assert robust_log_prob(DiagonalNormal(far * one, 0 * one, one)).item() == pytest.approx(-6.0)


def test_means_are_those_of_each_episodes_own_rows():
    value = torch.tensor([[1.0, 2.0, 3.0, 10.0], [0.0, 0.0, 3.0, -1.0]])
    found = episode_means(value, torch.tensor([0, 0, 0, 1]), 2)
    assert found.tolist() == [[2.0, 10.0], [1.0, -1.0]]


# ---- the responsibilities


def test_responsibilities_by_hand():
    # (e^(2 * 1) * .25^.1) / (e^(2 * 1) * .25^.1 + e^0 * .75^.1)
    given = torch.tensor([[1.0], [0.0]], dtype=torch.float64)
    found = responsibilities(given, torch.tensor([0.25, 0.75]).double(), 2.0)[0].item()
    a, b = math.exp(2) * 0.25**0.1, 0.75**0.1
    assert found == pytest.approx(a / (a + b), rel=1e-9)


def test_a_component_without_episodes_can_still_get_one_back():
    found = responsibilities(torch.tensor([[50.0], [0.0]]).double(), torch.tensor([0.0, 1.0]).double(), 20.0)
    assert found.isfinite().all() and found[0, 0] > 0.99


def test_temperature_is_zero_before_the_start_then_geometric_then_constant():
    plan = Annealing(start=2, length=4, first=1.0, last=16.0)
    assert [plan.temperature(k) for k in (0, 1, 2, 3, 4, 6, 99)] == pytest.approx([0, 0, 1, 2, 4, 16, 16])


@pytest.mark.parametrize(("name", "value"), [("start", -1), ("length", 0), ("first", 0.0), ("last", math.nan)])
def test_an_annealing_that_cannot_be_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        Annealing(**{name: value})


def test_soft_starts_differ_by_seed_and_sum_to_one():
    a, b = (random_responsibilities(3, 5, torch.Generator().manual_seed(seed)) for seed in (0, 1))
    assert a.sum(0).allclose(torch.ones(5).double()) and not a.allclose(b)


# ---- the samples


def sampler_of(lengths, members):
    lengths = torch.tensor(lengths)
    return EpisodeSampler(Episodes(lengths.cumsum(0) - lengths, lengths), seeds=list(range(members)))


def test_rows_are_drawn_in_proportion_to_the_weight_of_their_episode():
    sampler = sampler_of([10, 30], 2)
    sampler.weights = torch.tensor([[1.0, 1.0], [3.0, 1.0]])
    index, _ = sampler.sample(None, 40_000)
    # 1/4 of the rows, and 3 * 10 / (3 * 10 + 30) = 1/2; three standard errors are 0.0075
    assert (index < 10).double().mean(1).tolist() == pytest.approx([0.25, 0.5], abs=0.0075)
    assert index.min() == 0 and index.max() == 39
    counts = torch.bincount(index[0], minlength=40)
    assert counts.min() > 800 and counts.max() < 1200  # 1000 each; five standard errors are 160


@pytest.mark.parametrize("drawn", [0.0, 1.0 - 2**-53])
def test_the_ends_of_the_unit_interval_give_rows_that_exist_and_have_weight(monkeypatch, drawn):
    sampler = sampler_of([3, 2, 4], 1)
    sampler.weights = torch.tensor([[0.0, 1.0, 0.0]])
    monkeypatch.setattr(torch, "rand", lambda *size, **options: torch.full(size, drawn, dtype=torch.float64))
    assert sampler.sample(None, 1)[0].item() in (3, 4)


@pytest.mark.parametrize(
    "weights",
    [torch.ones(1, 3), torch.tensor([[1.0, -1.0], [1.0, 1.0]]), torch.tensor([[0.0, 0.0], [1.0, 1.0]]),
     torch.tensor([[torch.nan, 1.0], [1.0, 1.0]]), torch.tensor([[torch.inf, 1.0], [1.0, 1.0]])],
)  # fmt: skip
def test_weights_that_cannot_be_are_refused(weights):
    with pytest.raises(ValueError, match="weights"):
        sampler_of([2, 2], 2).weights = weights


def test_a_sampler_goes_on_where_its_state_was_taken(tmp_path):
    sampler = sampler_of([5, 7], 2)
    sampler.weights = torch.tensor([[1.0, 0.5], [0.0, 1.0]])
    sampler.sample(None, 3)
    sampler.dumps(tmp_path / "sampler")
    wanted = sampler.sample(None, 6)[0]
    other = sampler_of([5, 7], 2)
    other.loads(tmp_path / "sampler")
    assert other.sample(None, 6)[0].equal(wanted)
    with pytest.raises(ValueError, match="2 members, there are 3"):
        sampler_of([5, 7], 3).loads(tmp_path / "sampler")


def test_pairs_without_episodes_are_refused_with_the_reason():
    data, _ = demonstrations()
    with pytest.raises(ValueError, match="pairs without episodes, which a mixture of whole episodes needs"):
        make_episode_buffer(data.exclude("episode"), seeds=[0])


# ---- the mixture


def test_two_demonstrators_are_told_apart_without_labels():
    data, true = demonstrations()
    loss, buffer, mixture = mixture_of(data, [2], annealing=Annealing(start=2, length=20))
    train(loss, buffer, mixture, 400, tuner=ScoreTuner(loss), log_every=100).train()
    found = mixture.responsibilities.argmax(0)
    assert found.equal(true) or found.equal(1 - true)
    assert mixture.responsibilities.amax(0).min() > 0.99
    own = int(found[0])  # the policy of the first demonstrator acts as they do: a = o
    state = TensorDict({"observation": torch.tensor([[1.0, -0.5]])}, [1])
    actor = make_policy(2, 2, hidden=(16,))
    actor.load_state_dict(loss.member_state_dict(own))
    assert actor(state)["loc"].detach()[0].tolist() == pytest.approx([1.0, -0.5], abs=0.2)


def test_mixtures_beside_one_another_are_what_each_is_alone():
    data, _ = demonstrations()
    torch.manual_seed(0)
    actors = [make_policy(2, 2, hidden=(16,)) for _ in range(5)]
    found = {}
    for name, members, sizes, first in (("both", range(5), [2, 3], 0), ("second", range(2, 5), [3], 1)):
        loss = TsallisBCLoss([actors[k] for k in members], rating=PeakRating())
        buffer = make_episode_buffer(data, seeds=list(members), batch_size=16)
        mixture = EpisodeMixture(loss, buffer, sizes, every=4, seed=first, annealing=Annealing(start=1, length=4))
        train(loss, buffer, mixture, 40, log_every=20).train()
        found[name] = mixture.responsibilities
    torch.testing.assert_close(found["both"][2:], found["second"], atol=1e-4, rtol=1e-4)


def test_episodes_that_are_not_known_are_never_drawn_and_are_rated_all_the_same():
    data, _ = demonstrations()
    known = torch.ones(1, 8, dtype=torch.bool)
    known[0, 5:] = False
    loss, buffer, mixture = mixture_of(data, [2], known=known, annealing=Annealing(start=0, length=1))
    trainer = train(loss, buffer, mixture, 40, log_every=20)
    drawn = []
    trainer.register_op("process_optim_batch", lambda batch: drawn.append(batch["observation"].flatten(0, 1)))
    trainer.train()
    seen = {tuple(row) for batch in drawn for row in batch.tolist()}
    assert seen and not seen & {tuple(row) for row in data["observation"][5 * 32 :].tolist()}
    assert mixture.share.sum().item() == pytest.approx(1.0)
    assert mixture.responsibilities[:, 5:].sum(0).allclose(torch.ones(3).double())


def test_a_killed_mixture_is_resumed_bit_for_bit(tmp_path):
    data, _ = demonstrations()

    def run(folder, steps):
        loss, buffer, mixture = mixture_of(
            data, [2], every=5, rating=PeakRating(beta=0.5), annealing=Annealing(start=1, length=10)
        )
        options = {"checkpoint_dir": folder, "checkpoint_every": 20, "log_every": 20}
        trainer = train(loss, buffer, mixture, steps, tuner=ScoreTuner(loss), **options)
        resume(trainer)
        trainer.train()
        return loss, mixture

    run(tmp_path / "broken", 40)
    (loss, mixture), (whole_loss, whole) = run(tmp_path / "broken", 80), run(tmp_path / "whole", 80)
    assert mixture.responsibilities.equal(whole.responsibilities) and mixture.updates == whole.updates == 16
    assert mixture.sampler.weights.equal(whole.sampler.weights)
    for name, value in whole_loss.state_dict().items():
        assert loss.state_dict()[name].equal(value), name


def test_a_tsallis_rating_does_as_well():
    data, true = demonstrations()
    torch.manual_seed(0)
    loss = TsallisBCLoss([make_policy(2, 2, hidden=(16,)) for _ in range(2)], gamma_mix=0.0, q=0.95)
    buffer = make_episode_buffer(data, seeds=[0, 1], batch_size=32)
    mixture = EpisodeMixture(loss, buffer, [2], every=8, annealing=Annealing(start=2, length=20))
    train(loss, buffer, mixture, 400, log_every=100).train()
    found = mixture.responsibilities.argmax(0)
    assert found.equal(true) or found.equal(1 - true)


def test_what_does_not_fit_is_refused():
    data, _ = demonstrations()
    loss, buffer, _ = mixture_of(data, [2])
    with pytest.raises(ValueError, match=r"sizes=\[3\], 2 stacked members and 2 seeds"):
        EpisodeMixture(loss, buffer, [3], every=1)
    with pytest.raises(ValueError, match="known has shape"):
        EpisodeMixture(loss, buffer, [2], every=1, known=torch.ones(8, dtype=torch.bool))
    with pytest.raises(ValueError, match="every"):
        EpisodeMixture(loss, buffer, [2], every=0)
    from torchrl_tsallis.data import make_stacked_replay_buffer

    other = make_stacked_replay_buffer(data, seeds=[0, 1], batch_size=8)
    with pytest.raises(ValueError, match="make it with make_episode_buffer"):
        EpisodeMixture(loss, other, [2], every=1)
    mixture = EpisodeMixture(loss, buffer, [2], every=1)
    with pytest.raises(ValueError, match="resume with the same components"):
        mixture.load_state_dict({"responsibilities": torch.ones(3, 8), "updates": 0, "steps": 0})
