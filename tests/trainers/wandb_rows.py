"""Rows of W&B's offline runs, from the files that ``wandb sync`` uploads: LevelDB's log format, of protobuf records."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def _records(content: bytes) -> Iterator[bytes]:
    """The records of a file; one that is cut off is left out."""
    at, record = 7, b""  # after the header
    while at + 7 <= len(content):
        left = 32768 - at % 32768
        if left < 7:  # the rest of a block
            at += left
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + 7])
        record += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield record
            record = b""


def wandb_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of all offline runs below a folder, in their order."""
    from wandb.proto import wandb_internal_pb2

    rows = []
    for path in sorted(folder.rglob("offline-run-*/*.wandb")):
        for content in _records(path.read_bytes()):
            record = wandb_internal_pb2.Record.FromString(content)
            if record.WhichOneof("record_type") == "history":
                items = record.history.item
                rows.append({item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items})
    return rows
