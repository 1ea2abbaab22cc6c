"""npz archives and CSV files."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_tsallis.data import find_episodes
from torchrl_tsallis.data.readers import describe, read_demonstrations

T, F = True, False


def d4rl(**other) -> dict[str, np.ndarray]:
    entries = {
        "observations": np.arange(18, dtype=np.float32).reshape(6, 3),
        "actions": np.arange(12, dtype=np.float32).reshape(6, 2),
        "rewards": np.arange(6.0),
        "terminals": np.array([F, T, F, F, F, F]),
        "timeouts": np.array([F, F, F, T, F, F]),
    }
    return {key: value for key, value in {**entries, **other}.items() if value is not None}


def test_d4rl_ends_by_either_flag_and_at_the_last_row(tmp_path):
    np.savez(tmp_path / "data.npz", **d4rl(next_observations=np.ones((6, 3))))
    data, source = read_demonstrations(tmp_path / "data.npz", next_observation=True)
    assert find_episodes(data).lengths.tolist() == [2, 2, 2] and source.episodes == ("0", "1", "2")
    assert data["next", "terminated"][:, 0].tolist() == [F, T, F, F, F, F]
    assert data["next", "truncated"][:, 0].tolist() == [F, F, F, T, F, T]
    assert data["next", "reward"][:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert (data["next", "observation"] == 1).all()


def test_episode_numbers_and_contradictions(tmp_path):
    file = tmp_path / "data.npz"
    np.savez(file, **d4rl(terminals=None, timeouts=None, episode=np.array([3, 3, 3, 8, 8, 9])))
    assert describe(file).episodes == {"3": 3, "8": 2, "9": 1}
    np.savez(file, **d4rl(episode=np.array([3, 3, 3, 8, 8, 9])))
    with pytest.raises(ValueError, match=r"data.npz'.*contradict.*first \[1, 3\]"):
        read_demonstrations(file)
    np.savez(file, **d4rl(terminals=None, timeouts=None, run=np.array([0, 0, 1, 1, 1, 1])))
    assert describe(file).pairs and describe(file, episode="run").episodes == {"0": 2, "1": 4}
    with pytest.raises(KeyError, match="no 'trial' for the episode"):
        read_demonstrations(file, episode="trial")


def test_pairs(tmp_path):
    np.savez(tmp_path / "data.npz", obs=np.zeros((5, 3)), act=np.arange(5))
    data, _ = read_demonstrations(tmp_path / "data.npz")
    assert sorted(data.keys()) == ["action", "info", "observation"]
    assert data["action"].tolist() == [0, 1, 2, 3, 4] and data["observation"].dtype == torch.float32


def test_imitation_has_one_observation_more_an_episode(tmp_path):
    file, lengths = tmp_path / "data.npz", [2, 3, 1]
    obs = np.concatenate([np.stack([np.arange(n + 1.0), np.full(n + 1, k)], 1) for k, n in enumerate(lengths)])
    acts = np.concatenate([np.stack([np.arange(float(n)), np.full(n, k)], 1) for k, n in enumerate(lengths)])
    infos = np.array([{"a": 1}] * 6, dtype=object)
    np.savez(file, obs=obs, acts=acts, infos=infos, terminal=np.array([T, F, T]), indices=np.array([2, 5]))
    data, source = read_demonstrations(file, next_observation=True)
    assert torch.equal(data["observation"], data["action"])
    assert torch.equal(data["next", "observation"] - data["observation"], torch.tensor([[1.0, 0.0]] * 6))
    assert find_episodes(data).lengths.tolist() == lengths
    assert data["next", "terminated"].sum() == 2 and "infos" in source.left_out
    assert describe(file).columns["infos"].dtype == "pickled"
    with pytest.raises(TypeError, match="'infos' of .* is pickled, not numbers, and is never unpickled"):
        read_demonstrations(file, observation="infos")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"actions": None}, KeyError, "has no entries called action: name one by action="),
        ({"observations": None}, KeyError, "nothing in .* is called an observation: name its keys"),
        ({"observations": np.zeros((5, 3))}, ValueError, "'observations' of .* has 5 rows, the action has 6"),
        ({"terminals": np.zeros(5, bool)}, ValueError, "'terminated' of .* has 5 rows, actions 6"),
        ({"actions": np.zeros((0, 2))}, ValueError, "holds no row"),
        ({"actions": np.array([{}] * 6)}, KeyError, "has no entries called action: name one by action="),
        ({"actions": np.array([["a", "b"]] * 6)}, KeyError, "has no entries called action: name one by action="),
        ({"actions": np.full((6, 2), np.nan)}, ValueError, r"data.npz'.*'action' is NaN or infinite in 6 of 6 rows"),
        ({"observations": np.zeros((6, 3), complex)}, KeyError, "nothing in .* is called an observation"),
    ],
)
def test_broken_archives(tmp_path, change, error, message):
    np.savez(tmp_path / "data.npz", **d4rl(**change))
    with pytest.raises(error, match=message):
        read_demonstrations(tmp_path / "data.npz")


def test_truncated_archives(tmp_path):
    file = tmp_path / "data.npz"
    np.savez(file, **d4rl())
    whole = file.read_bytes()
    broken = bytearray(whole)
    broken[200] ^= 0xFF
    for content in (whole[:-50], whole[:100], b"", bytes(broken)):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"data.npz' is (truncated or )?broken"):
            read_demonstrations(file)


CSV = "run,obs_x,obs_y,act,force,done\n" + "".join(
    f"{run},{step}.5,{run},{step},{10 * step},{done}\n"
    for run, step, done in [(0, 0, "false"), (0, 1, "True"), (4, 0, 0), (4, 1, 0), (4, 2, 1)]
)


def test_csv_by_usual_names_and_by_options(tmp_path):
    file = tmp_path / "data.csv"
    file.write_text("\ufeff" + CSV)
    data, source = read_demonstrations(file)
    assert data["observation"].tolist() == [[0.5, 0], [1.5, 0], [0.5, 4], [1.5, 4], [2.5, 4]]
    assert data["action"].tolist() == [[0], [1], [0], [1], [2]]
    assert find_episodes(data).lengths.tolist() == [2, 3] and source.layout[1] == ("obs_y", 1, 2)
    data, source = read_demonstrations(file, observation="obs_*", action=["force", "act"], episode="run")
    assert data["action"][-1].tolist() == [20, 2] and source.episodes == ("0", "4")
    file.write_text(CSV.replace(",", ";"))
    assert read_demonstrations(file).data["action"].tolist() == [[0], [1], [0], [1], [2]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "name each column once|holds no row|nothing in"),
        ("obs,act\n", "holds no row"),
        ("obs,obs\n1,2\n", "must name each column once"),
        ("obs,act\n1,2\n3\n", "line 3 of .* has 1 cells, the header 2"),
        ("obs,act\n1,2\n3,left\n", "column 'act' of .* holds 'left' at row 1, not a number"),
        ("obs,act\n1,2\n3,\n", "column 'act' of .* holds '' at row 1"),
        ("obs,act\n1,2\nnan,3\n", r"'observation' is NaN or infinite in 1 of 2 rows, first \[1\]"),
        ("obs,act,done\n1,2,7\n3,4,1\n", "'done'.* is 7.0 at row 0"),
    ],
)
def test_broken_tables(tmp_path, content, message):
    (tmp_path / "data.csv").write_text(content)
    with pytest.raises((ValueError, KeyError), match=message):
        read_demonstrations(tmp_path / "data.csv")


def test_a_table_that_is_no_text(tmp_path):
    (tmp_path / "data.csv").write_bytes(b"\xff\xfe\x00\x01" * 20)
    with pytest.raises(ValueError, match=r"data.csv' is truncated or broken"):
        read_demonstrations(tmp_path / "data.csv")
