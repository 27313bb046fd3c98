# SPDX-License-Identifier: Apache-2.0
"""TensorBoard event files, written with TensorBoard's own package.

The package's `EventFileWriter` is not used: it has a thread that a forked process would
lack, writes only from time to time, and loads TensorFlow if that is installed. Import
this module only if tensorboard is known to be installed.
"""

from __future__ import annotations

import io
import os
import socket
import struct
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboard.compat.proto import event_pb2, summary_pb2, tensor_pb2, types_pb2
from tensorboard.plugins.text.metadata import create_summary_metadata
from tensorboard.summary.writer.record_writer import RecordWriter

from ..atomic_files import AppendOnlyFile, make_directory
from ..errors import DirectoryNotWritable

# Format and offset of the width and height in a GIF.
_GIF_SIZE = struct.Struct("<HH")
_GIF_SIZE_AT = 6


class EventFile:
    """An event file in a new directory, to which events are written immediately.

    Several threads may write at the same time.

    Args:
        directory: the directory to create. If it exists, a number is added to its name,
            because TensorBoard stops reading the first of two files in a directory.

    Raises:
        DirectoryNotWritable: the directory cannot be created.
        FileNotWritten: the disk is full.
    """

    def __init__(self, directory: Path) -> None:
        make_directory(directory.parent)
        self.directory, number = directory, 1
        while not _made(self.directory):
            number += 1
            self.directory = directory.with_name(f"{directory.name}-{number}")
        now = time.time()
        name = f"events.out.tfevents.{now:010.0f}.{socket.gethostname()}.{os.getpid()}"
        self._file = AppendOnlyFile([self.directory / name])
        self._lock = threading.Lock()
        self._write(event_pb2.Event(wall_time=now, file_version="brain.Event:2"))

    def write_scalars(
        self, values: Mapping[str, float], *, step: int, wall_time: float
    ) -> None:
        """Write scalars, keyed by tag."""
        pairs = values.items()
        summaries = [summary_pb2.Summary.Value(tag=k, simple_value=v) for k, v in pairs]
        self._write_summary(*summaries, step=step, wall_time=wall_time)

    def write_gif(self, tag: str, gif: bytes, *, step: int, wall_time: float) -> None:
        """Write an animated GIF."""
        width, height = _GIF_SIZE.unpack_from(gif, _GIF_SIZE_AT)
        image = summary_pb2.Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=gif
        )
        value = summary_pb2.Summary.Value(tag=tag, image=image)
        self._write_summary(value, step=step, wall_time=wall_time)

    def write_text(self, tag: str, text: str, *, step: int, wall_time: float) -> None:
        """Write text, which TensorBoard shows as Markdown."""
        tensor = tensor_pb2.TensorProto(
            dtype=types_pb2.DT_STRING, string_val=[text.encode()]
        )
        metadata = create_summary_metadata(display_name=tag, description="")
        value = summary_pb2.Summary.Value(tag=tag, metadata=metadata, tensor=tensor)
        self._write_summary(value, step=step, wall_time=wall_time)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write_summary(
        self, *values: summary_pb2.Summary.Value, step: int, wall_time: float
    ) -> None:
        summary = summary_pb2.Summary(value=values)
        self._write(event_pb2.Event(wall_time=wall_time, step=step, summary=summary))

    def _write(self, event: event_pb2.Event) -> None:
        # Prepared outside the lock, because the checksum of a large record takes a
        # while.
        record = io.BytesIO()
        RecordWriter(record).write(event.SerializeToString())
        with self._lock:
            self._file.append(record.getvalue())


def _made(directory: Path) -> bool:
    try:
        directory.mkdir()
    except FileExistsError:
        return False
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error
    return True
