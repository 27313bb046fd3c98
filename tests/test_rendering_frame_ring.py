# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from mjrec.errors import Error
from mjrec.rendering.frame_ring import SLOTS, FrameRing


def test_what_one_process_draws_the_other_reads() -> None:
    """In the same memory, given on by its number alone."""
    ring = FrameRing()
    ring.shape(4, 6)
    ring.slot(3)[:] = 7
    script = (
        "from mjrec.rendering.frame_ring import FrameRing\n"
        f"ring = FrameRing({ring.descriptor})\n"
        "ring.shape(4, 6)\n"
        "assert (ring.slot(3) == 7).all()\n"
        "ring.slot(1)[2, 3] = (1, 2, 3)\n"
    )
    subprocess.run(
        [sys.executable, "-c", script], pass_fds=[ring.descriptor], check=True
    )

    assert ring.slot(1)[2, 3].tolist() == [1, 2, 3]
    assert ring.slot(1).sum() == 6
    ring.close()


def test_slots_are_apart() -> None:
    """One picture each."""
    ring = FrameRing()
    ring.shape(3, 5)
    for number in range(SLOTS):
        ring.slot(number)[:] = number + 1

    for number in range(SLOTS):
        assert ring.slot(number).shape == (3, 5, 3)
        assert (ring.slot(number) == number + 1).all()
    ring.close()


def test_the_memory_only_grows() -> None:
    """A reader of the larger pictures is not killed."""
    ring = FrameRing()
    ring.shape(8, 8)
    large = ring.slot(SLOTS - 1)
    ring.shape(2, 2)
    assert os.fstat(ring.descriptor).st_size == SLOTS * 8 * 8 * 3
    assert large.sum() == 0
    ring.shape(16, 8)
    assert os.fstat(ring.descriptor).st_size == SLOTS * 16 * 8 * 3
    ring.close()


def test_a_kept_picture_outlives_the_ring() -> None:
    """Closing takes no memory away from under anybody."""
    ring = FrameRing()
    ring.shape(2, 2)
    kept = ring.slot(0)
    ring.close()
    ring.close()

    kept[:] = 9
    assert np.array_equal(kept, np.full((2, 2, 3), 9))


def test_more_memory_than_there_can_be() -> None:
    """One error that says what was asked for."""
    ring = FrameRing()
    with pytest.raises(Error, match="4 pictures of 100000000x100000000 pixels"):
        ring.shape(10**8, 10**8)
    ring.close()
