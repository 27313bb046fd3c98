# SPDX-License-Identifier: Apache-2.0
"""Read files of offline runs of Weights & Biases.

wandb has had no reader of its own since 0.31. After a header of seven bytes, the format
is LevelDB's log: 32 KiB blocks of pieces, each with a checksum and a length. A record
is one whole piece (1), or a first piece (2), middle pieces (3) and a last one (4).
"""

import json
import struct

from wandb.proto import wandb_internal_pb2

_HEADER = struct.Struct("<4sHB")
_PIECE = struct.Struct("<IHB")
_BLOCK = 1 << 15
_WHOLE, _FIRST, _LAST = 1, 2, 4


def records(path):
    for data in _pieces(path.read_bytes()):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        yield record


def history(path):
    """Return the logged rows without W&B's own keys."""
    return [
        _row(record.history.item)
        for record in records(path)
        if record.WhichOneof("record_type") == "history"
    ]


def axes(path):
    """Return the axis of each metric or pattern by name."""
    metrics = [r.metric for r in records(path) if r.HasField("metric")]
    return {m.name or m.glob_name: m.step_metric for m in metrics if m.step_metric}


def _row(items):
    row = {}
    for item in items:
        # A video is stored as several nested items.
        *outer, last = list(item.nested_key) or [item.key]
        inner = row
        for key in outer:
            inner = inner.setdefault(key, {})
        inner[last] = json.loads(item.value_json)
    return {key: value for key, value in row.items() if not key.startswith("_")}


def _pieces(data):
    magic, _, _ = _HEADER.unpack_from(data)
    assert magic == b":W&B"
    begun = b""
    place = _HEADER.size
    while place < len(data):
        if _BLOCK - place % _BLOCK < _PIECE.size:
            place += _BLOCK - place % _BLOCK
            continue
        _, length, kind = _PIECE.unpack_from(data, place)
        place += _PIECE.size
        piece = data[place : place + length]
        begun = piece if kind in (_WHOLE, _FIRST) else begun + piece
        place += length
        if kind in (_WHOLE, _LAST):
            yield begun
