# SPDX-License-Identifier: Apache-2.0
"""Memory that one process draws pictures into and another one reads them from."""

from __future__ import annotations

import mmap
import os

import numpy as np

from ..errors import Error
from ..frames import Frame

# As many as keep a worker drawing while its reader is busy with the pictures before.
SLOTS = 4


class FrameRing:
    """A few pictures in memory that two processes share.

    The memory is a file without a name: nothing has to be removed, however the
    processes die. Which slot is whose at what time is for the two to settle; a ring
    belongs to one worker alone, because of two that write into one ring the later
    picture may take the slot before the earlier one.

    Args:
        descriptor: of the memory, as the other process got it from `descriptor`; a new
            one is made if None.

    Raises:
        Error: the system grants no more memory or files.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._slots: list[Frame] = []
        try:
            self.descriptor = (
                os.memfd_create("mjrec-frames") if descriptor is None else descriptor
            )
        except OSError as error:
            raise Error(f"No memory to share pictures in: {error}.") from error

    def shape(self, height: int, width: int) -> None:
        """Lay out the slots for pictures of this size; earlier ones are void.

        Both processes call it, one after the other, before they use a slot.

        Raises:
            Error: the system grants no such memory.
        """
        size = height * width * 3
        try:
            # It only grows: memory that is taken away under a reader kills it.
            if os.fstat(self.descriptor).st_size < SLOTS * size:
                os.ftruncate(self.descriptor, SLOTS * size)
            memory = mmap.mmap(self.descriptor, SLOTS * size)
        except (OSError, ValueError) as error:
            raise Error(
                f"No memory to share {SLOTS} pictures of {width}x{height} pixels in: "
                f"{error}. Ask for smaller pictures, or for fewer workers."
            ) from error
        pictures = np.frombuffer(memory, np.uint8).reshape(SLOTS, height, width, 3)
        self._slots = list(pictures)

    def slot(self, number: int) -> Frame:
        """Return the memory of a slot, `(height, width, 3) uint8`."""
        return self._slots[number]

    def close(self) -> None:
        """Let go of the memory. Idempotent."""
        self._slots = []
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
