"""LeRobot v3.x and v2.1: rows and tables renumbered, videos copied as they are."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.curators.base import Curator, Plan, register
from torchrl_tsallis.data.curators.lerobot_stats import of_episodes, of_rows
from torchrl_tsallis.data.readers.arrow import array_of, is_binary, open_arrow
from torchrl_tsallis.data.readers.base import need

_RATING = {"dtype": "float32", "shape": [1], "names": None}
_STATS = ("min", "max", "mean", "std", "count")


@register
class LeRobotCurator(Curator):
    """Writes a data set that LeRobot loads: ``episode_index`` and ``index`` count from 0 without gaps.

    Videos are never encoded anew: in v3 an episode is found in its file by time stamps, which stay; in v2.1 it has a
    file of its own, which gets the new number. ``rating`` is a scalar feature of every frame.
    """

    name = "lerobot"
    sequence = "a frame left out of LeRobot's rows would no longer fit its video and its time stamps"

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._root = plan.source
        self._info: dict[str, Any] = json.loads((plan.source / "meta" / "info.json").read_text())
        self._version_2 = str(self._info.get("codebase_version", "")).startswith("v2")
        # The reader gives the episodes of a split alone, the copy holds all that are not dropped.
        whole = type(plan.reader)(plan.source, type(plan.reader.options)(observation=()))
        self._lengths = {int(name): length for name, length in whole.lengths().items()}
        self._kept = [number for number in self._lengths if str(number) not in plan.dropped]
        self._new = {number: k for k, number in enumerate(self._kept)}

    def write(self, target: Path) -> None:
        """Writes the folder."""
        skip = {self._root / "data", self._root / "meta" / "episodes"}
        if self._version_2:
            skip.add(self._root / "videos")
        shutil.copytree(
            self._root,
            target,
            ignore=lambda folder, names: [name for name in names if Path(folder) / name in skip],
        )
        columns = self._write_rows(target)
        episodes = self._write_episodes(target, columns)
        if self._version_2:
            self._write_videos(target)
        self._write_stats(target, columns, episodes)
        self._write_info(target)

    def _path_2(self, pattern: str, number: int, video: str = "") -> Path:
        """A file of v2.1, by the pattern in ``info.json``."""
        chunk = number // int(self._info.get("chunks_size") or 1000)
        return Path(pattern.format(episode_chunk=chunk, episode_index=number, video_key=video))

    def _write_rows(self, target: Path) -> dict[str, np.ndarray]:
        """Writes the rows that stay, file by file, and gives the numbers in them, and ``rating``."""
        parquet, pa = need("pyarrow.parquet", target), need("pyarrow", target)
        parts: dict[str, list[np.ndarray]] = {}
        self._place: dict[int, tuple[int, int, str]] = {}  # first row, the one after the last, file
        start = 0
        for file in sorted(self._root.glob("data/**/*.parquet")):
            table = open_arrow(file)
            old = array_of(table, "episode_index", file).reshape(-1)
            frame = array_of(table, "frame_index", file).reshape(-1) if "frame_index" in table.column_names else old
            order = np.lexsort((frame, old))
            order = order[np.isin(old[order], self._kept)]
            if not len(order):
                continue
            table, old = table.take(pa.array(order)), old[order]
            numbers, first, counts = np.unique(old, return_index=True, return_counts=True)
            for number, begin, count in zip(numbers.tolist(), first.tolist(), counts.tolist(), strict=True):
                if number in self._place or count != self._lengths[number]:
                    raise ValueError(
                        f"episode {number} of {str(self._root)!r} lies in several files, which LeRobot cannot load: "
                        "merge them by LeRobot's own tools first"
                    )
                self._place[number] = (start + begin, start + begin + count, str(file))
            rating = np.concatenate([self.plan.steps(str(n), self.plan.rating) for n in numbers.tolist()])
            new = {
                "episode_index": np.array([self._new[n] for n in old.tolist()]),
                "index": start + np.arange(len(old)),
                "rating": rating.astype(np.float32),
            }
            table = self._with_columns(pa, table, new)
            relative = file.relative_to(self._root)
            if self._version_2 and "data_path" in self._info:
                relative = self._path_2(self._info["data_path"], self._new[int(numbers[0])])
            elif self._version_2:
                relative = relative.with_name(re.sub(r"\d+", f"{self._new[int(numbers[0])]:06d}", file.name))
            (target / relative).parent.mkdir(parents=True, exist_ok=True)
            parquet.write_table(table, target / relative)
            start += len(table)
            for field in table.schema:
                if not is_binary(field.type) and "string" not in str(field.type):
                    parts.setdefault(field.name, []).append(array_of(table, field.name, file))
        return {key: np.concatenate(arrays) for key, arrays in parts.items()}

    @staticmethod
    def _with_columns(pa: Any, table: Any, new: dict[str, np.ndarray]) -> Any:
        """Sets the columns, and declares ``rating`` to the library that reads the file."""
        described = dict(table.schema.metadata or {})
        for name, values in new.items():
            there = table.column_names.index(name) if name in table.column_names else None
            if there is not None:
                field = table.schema.field(there)
                table = table.set_column(there, field, pa.array(values).cast(field.type))
            elif name == "rating":
                table = table.append_column("rating", pa.array(values, pa.float32()))
        if b"huggingface" in described:
            entry = json.loads(described[b"huggingface"])
            features = entry.setdefault("info", {}).setdefault("features", {})
            features["rating"] = {"dtype": "float32", "_type": "Value"}
            entry.pop("fingerprint", None)  # of the rows as they were
            described[b"huggingface"] = json.dumps(entry).encode()
        return table.replace_schema_metadata(described or None)

    def _write_episodes(self, target: Path, columns: dict[str, np.ndarray]) -> list[dict[str, Any]]:
        """Writes the table of episodes, and gives the statistics of each that stays."""
        if (self._root / "meta" / "episodes.jsonl").exists():
            return self._write_lines(target, columns)
        files = sorted(self._root.glob("meta/episodes/**/*.parquet"))
        if not files:
            return []
        pa, parquet = need("pyarrow", target), need("pyarrow.parquet", target)
        whole = pa.concat_tables([open_arrow(file) for file in files], promote_options="default")
        rows = {row["episode_index"]: row for row in whole.to_pylist()}
        kept = []
        for number in self._kept:
            row = rows[number]
            begin, end, file = self._place[number]
            chunk, part = (int(x) for x in re.findall(r"(\d+)", file)[-2:])
            fixed: dict[str, Any] = {
                "episode_index": self._new[number],
                "dataset_from_index": begin,
                "dataset_to_index": end,
                "data/chunk_index": chunk,
                "data/file_index": part,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for key, rows_ in (("episode_index", columns["episode_index"]), ("index", columns.get("index"))):
                said = [name for name in whole.column_names if name.startswith(f"stats/{key}/")]
                if said and rows_ is not None:
                    found = of_rows(rows_[begin:end], [name.rpartition("/")[2] for name in said])
                    fixed |= {f"stats/{key}/{name}": value for name, value in found.items()}
            kept.append(row | {key: value for key, value in fixed.items() if key in whole.column_names})
        table = target / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        table.parent.mkdir(parents=True)
        parquet.write_table(pa.Table.from_pylist(kept, schema=whole.schema), table)
        return [_nested(row) for row in kept]

    def _write_lines(self, target: Path, columns: dict[str, np.ndarray]) -> list[dict[str, Any]]:
        """The tables of v2.1: one line an episode."""
        stats: list[dict[str, Any]] = []
        for name in ("episodes.jsonl", "episodes_stats.jsonl"):
            file = self._root / "meta" / name
            if not file.exists():
                continue
            rows = {
                row["episode_index"]: row for row in map(json.loads, filter(str.strip, file.read_text().splitlines()))
            }
            lines = []
            for number in self._kept:
                row = dict(rows[number]) | {"episode_index": self._new[number]}
                begin, end, _ = self._place[number]
                if "stats" in row:
                    row["stats"] = dict(row["stats"])
                    for key in ("episode_index", "index", "rating"):
                        wanted = list(row["stats"].get(key, _STATS if key == "rating" else ()))
                        if wanted and key in columns:
                            row["stats"][key] = of_rows(columns[key][begin:end], wanted)
                    stats.append(row["stats"])
                lines.append(json.dumps(row) + "\n")
            (target / "meta" / name).write_text("".join(lines))
        return stats

    def _write_videos(self, target: Path) -> None:
        """Copies the files of v2.1 under their new numbers."""
        pattern = self._info.get("video_path")
        for key, described in (self._info.get("features") or {}).items():
            for number, new in self._new.items():
                source = self._root / self._path_2(pattern, number, key) if pattern else None
                if described.get("dtype") == "video" and source is not None and source.exists():
                    copy = target / self._path_2(str(pattern), new, key)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(source, copy)

    def _write_stats(self, target: Path, columns: dict[str, np.ndarray], episodes: list[dict[str, Any]]) -> None:
        file = target / "meta" / "stats.json"
        if not file.exists():
            return
        stats = json.loads(file.read_text())
        stats.setdefault("rating", dict.fromkeys(_STATS))
        for key, said in stats.items():
            if key in columns:
                stats[key] = said | of_rows(columns[key], list(said))
                continue
            joined = of_episodes([episode.get(key, {}) for episode in episodes], list(said))
            if joined is None:
                self.plan.notes.append(f"the statistics of {key!r} are still those of the whole data set")
            else:
                stats[key] = joined
        file.write_text(json.dumps(stats, indent=4))

    def _write_info(self, target: Path) -> None:
        info = dict(self._info)
        info |= {"total_episodes": len(self._kept), "total_frames": sum(self._lengths[n] for n in self._kept)}
        features = dict(info.get("features") or {}) | {"rating": _RATING}
        info["features"] = features
        if "total_videos" in info:
            videos = sum(1 for described in features.values() if described.get("dtype") == "video")
            info["total_videos"] = videos * len(self._kept)
        if "total_chunks" in info:
            info["total_chunks"] = -(-len(self._kept) // int(info.get("chunks_size") or 1000))
        info["splits"] = {name: self._split(name, str(said)) for name, said in (info.get("splits") or {}).items()}
        (target / "meta" / "info.json").write_text(json.dumps(info, indent=4))

    def _split(self, name: str, said: str) -> str:
        match = re.fullmatch(r"(\d*):(\d*)", said.strip())
        if match is None:
            self.plan.notes.append(f"the split {name!r} is {said!r} still: it is not of the form 'from:to'")
            return said
        bounds = int(match[1] or 0), int(match[2] or max(self._lengths) + 1)
        return ":".join(str(sum(number < bound for number in self._kept)) for bound in bounds)

    def commands(self, out: Path) -> list[str]:
        """LeRobot's own tool for the same choice; it encodes videos anew."""
        numbers = sorted(int(name) for name in self.plan.dropped)
        name = shlex.quote(self._root.name)
        return [
            f"lerobot-edit-dataset --repo_id {name} --root {shlex.quote(str(self._root))} "
            f"--new_repo_id {shlex.quote(self._root.name + '_curated')} --operation.type delete_episodes "
            f'--operation.episode_indices "{numbers}"'
        ]


def _nested(row: dict[str, Any]) -> dict[str, Any]:
    """Statistics of an episode by feature, from columns ``stats/<feature>/<name>``."""
    out: dict[str, Any] = {}
    for key, value in row.items():
        if key.startswith("stats/") and value is not None:
            feature, _, name = key.removeprefix("stats/").rpartition("/")
            out.setdefault(feature, {})[name] = value
    return out
