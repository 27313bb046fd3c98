# SPDX-License-Identifier: Apache-2.0
"""Trajectories with other facts and the same arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...formats.trajectory_file import open_trajectory
from ...formats.trajectory_hdf5 import write_hdf5


def write_anonymous_trajectory(path: Path, anonymous: Callable[[Any], Any]) -> None:
    """Replace a trajectory by one whose facts are anonymous.

    It is written anew, so that nothing is in it which this package does not write, and
    nothing of what was there before. Its arrays stay, bit for bit.

    Args:
        path: of the HDF5 file.
        anonymous: returns a value of JSON without the identity.

    Raises:
        UnreadableFile: it is damaged.
        FileNotWritten: the disk is full.
    """
    with open_trajectory(path) as reader:
        facts = anonymous(dict(reader.header.facts))
        reader.header = dataclasses.replace(reader.header, facts=facts)
        write_hdf5(reader, path)
