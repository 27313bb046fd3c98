# SPDX-License-Identifier: Apache-2.0
"""The level `files`: every file is there, unchanged, and there are no others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ..verification import Check
from .bag_checks import check_bag, no_bag
from .packed_file_checks import check_packed_files
from .recorded_file_checks import check_recorded_files
from .task import Count, Task


def check_files(task: Task, count: Count, *, bag: Path | None) -> Iterator[Check]:
    """Yield what is found about the files.

    Args:
        task: what is asked for.
        count: told how much is done.
        bag: the folder that is a bag; None where nothing was packed.
    """
    if bag is None:
        yield no_bag()
    else:
        yield from check_bag(bag, count)
        yield from check_packed_files(bag)
    yield from check_recorded_files(task.recordings, count, is_packed=bag is not None)
