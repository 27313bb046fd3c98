# SPDX-License-Identifier: Apache-2.0
"""What becomes known of a recorded episode after its log was closed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import FileNotWritten
from .json_fields import unreadable
from .regular_files import open_regular
from .trajectory_log import facts_record, write_all
from .trajectory_log_reader import end_of_records


def append_facts(log: Path, facts: Mapping[str, Any]) -> None:
    """Add to the facts of a log that is closed; of a key, the newest counts.

    Only the process that wrote the log may do this, as long as nobody else takes it
    for theirs; or who holds the episode's lock, once that process is done with it.
    Where the log ends in half a record, that is cut off first: readers would look no
    further. Like all that is written to a log it is with the operating system when
    this returns, whole or not at all.

    Args:
        log: the file.
        facts: what to add.

    Raises:
        UnreadableFile: there is no such file, or it is no log.
        FileNotWritten: the disk is full; the log is as before.
    """
    record = facts_record(facts)
    with unreadable(log), open_regular(log) as file:
        end = end_of_records(file.fileno())
    try:
        descriptor = os.open(log, os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            os.ftruncate(descriptor, end)
            try:
                write_all(descriptor, record, end)
            except OSError:
                os.ftruncate(descriptor, end)
                raise
        finally:
            os.close(descriptor)
    except OSError as error:
        raise FileNotWritten(log, error.strerror or error) from error
