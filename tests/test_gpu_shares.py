# SPDX-License-Identifier: Apache-2.0

import pytest

from mjrec.engines.gpu_shares import GpuShare
from mjrec.errors import InvalidArgument


@pytest.mark.parametrize(
    ("each", "gpus", "given"),
    [
        (0.25, ["0", "1"], ["0", "0", "0", "0", "1", "1", "1", "1"]),
        (0.5, ["3", "5"], ["3", "3", "5", "5", "3", "3", "5", "5"]),
        (1, ["0", "1"], ["0", "1", "0", "1", "0", "1", "0", "1"]),
        (2, ["0", "1", "2", "3"], ["0,1", "2,3"] * 4),
        (0.3, ["a", "b"], ["a", "a", "a", "b", "b", "b", "a", "a"]),
        (1 / 3, ["a", "b"], ["a", "a", "a", "b", "b", "b", "a", "a"]),
        (2, ["0"], ["0"] * 8),
        (0.25, [], [None] * 8),
        (0, ["0"], [None] * 8),
    ],
)
def test_gpus_are_filled_one_after_the_other(each, gpus, given):
    """As many workers as share one get the same; further ones go round again."""
    share = GpuShare(each=each)
    assert [share.of(seat, gpus) for seat in range(8)] == given


@pytest.mark.parametrize("each", [-0.5, float("nan"), float("inf"), "1", None, True])
def test_what_is_no_share_is_refused(each):
    """The message says what would be one."""
    with pytest.raises(InvalidArgument, match=r"such as 1, or 0\.25"):
        GpuShare(each=each)


def test_more_than_one_is_whole():
    """Half of two GPUs each is not what anybody means."""
    with pytest.raises(InvalidArgument, match=r"cannot be 1\.5"):
        GpuShare(each=1.5)


def test_who_requires_a_gpu_asks_for_one():
    """Else nobody could say which."""
    with pytest.raises(InvalidArgument, match="none is asked for"):
        GpuShare(required=True)
