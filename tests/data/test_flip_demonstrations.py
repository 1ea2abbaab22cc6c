from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_tsallis.data.flip_demonstrations import FAULTS, label_faults, record_flips, replay_forces
from torchrl_tsallis.data.teleoperation import FlipOperator, Stroke, Style, draw_style, plan_stroke
from torchrl_tsallis.envs.flips import FlipCount

EDGES = np.stack([np.full(10, 0.104), np.linspace(0.0035, 0.0125, 10)], 1)
START = np.array([0.125, 0.0, 0.04])


def test_a_stroke_goes_under_the_top_page_and_over_to_the_left():
    style = Style(misses=0.0, releases=0.0, hesitates=0.0, height_noise=0.0)
    stroke = plan_stroke(np.random.default_rng(0), style, START, EDGES)
    inserted = stroke.path[stroke.lift - 1]
    assert inserted[0] < EDGES[-1, 0]
    np.testing.assert_allclose(inserted[2], EDGES[-1, 1] - 0.0005 + 0.003, atol=1e-9)  # half a gap of 1 mm below
    assert stroke.path[stroke.release - 1, 0] < 0
    assert np.linalg.norm(stroke.path[-1]) > 0.1 and stroke.path[-1, 0] > 0
    assert np.linalg.norm(np.diff(stroke.path, axis=0), axis=1).max() * 50 < 1.0  # m/s
    assert not stroke.pause.any() and not stroke.off_target


def test_faults_of_a_stroke():
    rng = np.random.default_rng(0)
    off = [plan_stroke(rng, Style(misses=1.0), START, EDGES) for _ in range(20)]
    assert all(stroke.off_target for stroke in off)
    early = plan_stroke(rng, Style(releases=1.0, misses=0.0), START, EDGES)
    assert early.path[early.release - 1, 0] > 0
    pausing = [plan_stroke(rng, Style(hesitates=1.0), START, EDGES) for _ in range(20)]
    assert all(10 <= stroke.pause.sum() <= 35 for stroke in pausing)
    for stroke in pausing:
        assert np.ptp(stroke.path[stroke.pause], axis=0).max() == 0


def test_the_last_page_and_no_page():
    rng = np.random.default_rng(0)
    assert np.isfinite(plan_stroke(rng, Style(), START, EDGES[:1]).path).all()
    operator = FlipOperator(0)
    observation = np.concatenate([START, np.zeros(3), START, np.zeros(3)])
    left = np.array([[-0.1, 0.01]] * 10)
    for _ in range(5):
        force = operator.act(observation, left)
    assert not operator.strokes and np.abs(force).max() < 1.0


def test_the_operator_is_seeded_and_limited():
    def forces(seed):
        operator = FlipOperator(seed)
        observation = np.concatenate([START, np.zeros(3), START, np.zeros(3)])
        return np.stack([operator.act(observation, EDGES) for _ in range(200)])

    first = forces(1)
    np.testing.assert_array_equal(first, forces(1))
    assert not np.array_equal(first, forces(2))
    assert first.dtype == np.float32
    norm = np.linalg.norm(first, axis=1)  # the follower is stuck at the start: the coupling saturates
    assert norm.max() == pytest.approx(3.3, rel=1e-6)
    assert draw_style(np.random.default_rng(0)) != draw_style(np.random.default_rng(1))


def test_labels_by_hand():
    def stroke(off_target=False, pause=()):
        paused = np.zeros(10, dtype=bool)
        paused[list(pause)] = True
        return Stroke(np.zeros((10, 3)), paused, 3, 7, off_target)

    strokes = [stroke(), stroke(pause=(1, 2)), stroke(off_target=True), stroke()]
    # Stroke 0 turns one page late, after stroke 1 has begun; stroke 1 turns two, 2 none, and 3 is cut off at its lift.
    flips = FlipCount(np.array([9, 8, 7]), np.array([12, 15, 16]), np.array([0, 1, 1]), np.array([1, 2]))
    labels = label_faults(strokes, [0, 10, 20, 30], flips, 35)
    assert set(labels) == set(FAULTS)
    assert np.flatnonzero(labels["missed"]).tolist() == list(range(20, 30))
    assert np.flatnonzero(labels["multiple"]).tolist() == list(range(10, 20))
    assert np.flatnonzero(labels["hesitation"]).tolist() == [11, 12]
    assert np.flatnonzero(labels["off_target"]).tolist() == list(range(20, 30))


@pytest.fixture(scope="module")
def recording():
    pytest.importorskip("gymnasium")
    pytest.importorskip("pybullet")
    from torchrl_tsallis.envs import make_page_flip

    return make_page_flip, *record_flips(make_page_flip, seed=1, steps=220)


def test_recording(recording):
    _, data, facts = recording
    assert data.shape == (220,)
    assert data["observation"].shape == data["next", "observation"].shape == (220, 12)
    assert data["observation"].dtype == data["action"].dtype == torch.float32
    torch.testing.assert_close(data["next", "observation"][:-1], data["observation"][1:], rtol=0, atol=0)
    torch.testing.assert_close(data["next", "observation"][:, 3:6], data["action"], rtol=0, atol=0)
    torch.testing.assert_close(data["observation"][1:, 6:], data["observation"][:-1, :6], rtol=0, atol=0)
    assert data["is_init"].nonzero().tolist() == [[0, 0]]
    assert data["next", "done"].nonzero().tolist() == data["next", "truncated"].nonzero().tolist() == [[219, 0]]
    union = torch.stack([data["info", name] for name in FAULTS]).any(0)
    assert torch.equal(union, data["info", "is_noise"])
    assert facts["flips"] == sum(facts["sizes"]) > 0


def test_replayed_forces_turn_the_same_pages(recording):
    make_env, data, facts = recording
    observations, flips = replay_forces(make_env, data["action"], seed=facts["seed"])
    np.testing.assert_array_equal(observations, data["next", "observation"].numpy())
    assert flips.total == facts["flips"]


def test_slices_for_a_recurrent_imitator(recording):
    from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

    data = torch.cat([recording[1], recording[1]])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(data)),
        sampler=SliceSampler(slice_len=20, end_key=("next", "done"), cache_values=True),
        batch_size=100,
    )
    buffer.extend(data.exclude("info"))
    batch = buffer.sample().reshape(-1, 20)
    torch.testing.assert_close(batch["next", "observation"][:, :-1], batch["observation"][:, 1:], rtol=0, atol=0)
    assert batch["is_init"][:, 0].all() and not batch["is_init"][:, 1:].any()
