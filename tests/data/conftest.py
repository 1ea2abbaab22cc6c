"""Small files of each format, written as the format's own library writes them."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

FIXTURES = Path(__file__).parent / "fixtures"


@pytest.fixture
def fixtures() -> Path:
    """The folder of committed files."""
    return FIXTURES


@pytest.fixture
def write_robomimic():
    """Writes the layout of robomimic: names with gaps that sort wrongly, masks, a reward, two vectors and an image."""

    def write(path: Path, lengths: dict[str, int] | None = None, *, obs: bool = True, following: bool = True) -> Path:
        lengths = {"demo_10": 4, "demo_2": 3, "demo_7": 5} if lengths is None else lengths
        with h5py.File(path, "w") as file:
            data = file.create_group("data")
            data.attrs["total"] = sum(lengths.values())
            data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1})
            for name, size in lengths.items():
                number, demo = float(name.rpartition("_")[2]), data.create_group(name)
                demo.attrs["num_samples"] = size
                steps = np.arange(size, dtype=np.float64)
                demo["actions"] = np.stack([steps, np.full(size, number)], 1)
                demo["rewards"] = steps
                demo["dones"] = np.zeros(size, dtype=np.int64)  # done_mode 0: only where the task succeeds
                demo["states"] = np.zeros((size, 6))
                if obs:
                    for group in ("obs", "next_obs") if following else ("obs",):
                        shift = float(group == "next_obs")
                        demo[f"{group}/eef_pos"] = np.stack([steps + shift, np.full(size, number), 0 * steps], 1)
                        demo[f"{group}/grip"] = np.full((size, 1), number + shift)
                        demo[f"{group}/image"] = np.zeros((size, 8, 8, 3), dtype=np.uint8)
            file["mask/train"] = np.array([name.encode() for name in sorted(lengths)][:2])
            file["mask/better"] = np.array([b"demo_7"])
        return path

    return write


@pytest.fixture
def write_minari(tmp_path, monkeypatch):
    """Writes data sets by minari itself: 12 episodes of 3 to 6 steps that end in turn by either flag and by none."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari = pytest.importorskip("minari")
        import gymnasium as gym
        from minari.data_collector import EpisodeBuffer
    box = gym.spaces.Box
    vector = box(-99, 99, (3,), np.float32)
    spaces = {
        "box": vector,
        "dict": gym.spaces.Dict(
            {"state": vector, "goal": box(-9, 9, (2,), np.float64), "pixels": box(0, 255, (32, 32, 3), np.uint8)}
        ),
        "tuple": gym.spaces.Tuple((vector, box(-9, 9, (2,), np.float32))),
        "discrete": gym.spaces.Discrete(7),
    }

    def rows(space, episode: int, size: int):
        steps = np.arange(size)
        if isinstance(space, gym.spaces.Dict):
            return {key: rows(part, episode, size) for key, part in space.spaces.items()}
        if isinstance(space, gym.spaces.Tuple):
            return tuple(rows(part, episode, size) for part in space.spaces)
        if isinstance(space, gym.spaces.Discrete):
            return list(steps % 7)
        if space.dtype == np.uint8:
            return [np.full(space.shape, 20 * episode, np.uint8) for _ in steps]
        return [np.array([step, episode, 0.5][: space.shape[0]], dtype=space.dtype) for step in steps]

    def write(kind: str = "box", data_format: str = "hdf5", infos: bool = True) -> Path:
        buffers = []
        for k in range(12):
            size, end = 3 + k % 4, k % 3
            last = np.arange(size) == size - 1
            buffers.append(
                EpisodeBuffer(
                    id=k,
                    observations=rows(spaces[kind], k, size + 1),
                    actions=[np.array([step, k], dtype=np.float32) for step in range(size)],
                    rewards=[float(step) for step in range(size)],
                    terminations=list(last & (end == 0)),
                    truncations=list(last & (end == 1)),
                    infos={"speed": np.arange(size + 1.0)} if infos else None,
                )
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            minari.create_dataset_from_buffers(
                f"toy/{kind}{data_format}-v0",
                buffer=buffers,
                observation_space=spaces[kind],
                action_space=box(-99, 99, (2,), np.float32),
                data_format=data_format,
                algorithm_name="none",
                author="none",
                author_email="none",
                code_permalink="none",
            )
        return tmp_path / "minari" / "toy" / f"{kind}{data_format}-v0"

    return write


@pytest.fixture
def write_v21():
    """Writes the layout of LeRobot v2.1: one Parquet file an episode, metadata in lines."""

    def write(path: Path, lengths: tuple[int, ...] = (3, 5, 4), version: str = "v2.1", lists: str = "fixed") -> Path:
        (path / "meta").mkdir(parents=True)
        (path / "data" / "chunk-000").mkdir(parents=True)
        features = {
            "observation.state": {"dtype": "float32", "shape": [2], "names": [["x", "y"]]},
            "action": {"dtype": "float32", "shape": [2], "names": None},
            "observation.images.cam": {"dtype": "video", "shape": [48, 64, 3], "names": None},
        }
        info = {"codebase_version": version, "fps": 30, "total_episodes": len(lengths), "features": features}
        info |= {"total_frames": sum(lengths), "splits": {"train": "0:2", "test": "2:3"}}
        (path / "meta" / "info.json").write_text(json.dumps(info))
        rows = [{"episode_index": k, "tasks": ["t"], "length": n} for k, n in enumerate(lengths)]
        (path / "meta" / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        start = 0
        kind = pa.list_(pa.float32(), 2) if lists == "fixed" else pa.list_(pa.float32())
        for k, size in enumerate(lengths):
            steps = list(range(size))
            table = {
                "observation.state": pa.array([[float(step), float(k)] for step in steps], kind),
                "action": pa.array([[float(step), 10.0 * k] for step in steps], kind),
                "timestamp": pa.array([step / 30 for step in steps], pa.float32()),
                "frame_index": pa.array(steps, pa.int64()),
                "episode_index": pa.array([k] * size, pa.int64()),
                "index": pa.array([start + step for step in steps], pa.int64()),
            }
            start += size
            pq.write_table(pa.table(table), path / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
        return path

    return write
