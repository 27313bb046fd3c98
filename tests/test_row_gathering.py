# SPDX-License-Identifier: Apache-2.0
"""A row is gathered from memory that lies in several places."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.simulation.gathering import WORDS, can_be_gathered, words_of

MODEL = """
<mujoco>
  <worldbody>
    <body><freejoint/><geom size=".1"/></body>
    <body pos="1 0 0"><joint name="x"/><geom size=".1"/></body>
  </worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""


def take(words: Any, out: Any) -> None:
    """Gather a row as recorders do."""
    WORDS.take(words, None, out, "clip")


def gathered(words: Any) -> bytes:
    out = np.full(len(words), 77, np.uint64)
    take(words, out)
    return out.tobytes()


def whole(size: int) -> int:
    return -(-size // 8) * 8


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_arrays_lie_one_behind_the_other(order: tuple[int, ...]) -> None:
    """In the order in which they are given, wherever they are; bit for bit."""
    chance = np.random.default_rng(1)
    arrays: list[Any] = [
        np.frombuffer(bytearray(chance.bytes(size)), dtype)
        for size, dtype in [(24, np.float64), (400_000, np.uint8), (16, np.int32)]
    ]
    arrays = [arrays[k] for k in order]
    assert gathered(words_of(arrays)) == b"".join(array.tobytes() for array in arrays)


def test_a_row_is_that_of_the_moment() -> None:
    """What is written into the arrays later is in the next one."""
    first, second = np.zeros(3), np.zeros(2)
    words = words_of([first, second])
    out = np.zeros(5, np.uint64)
    for step in range(5):
        first[:], second[:] = step, np.nan
        take(words, out)
        assert out.view(np.float64)[:3].tolist() == [step] * 3
        assert np.isnan(out.view(np.float64)[3:]).all()


def test_nothing_but_the_row_is_written() -> None:
    """A row of a log stands among others."""
    array = np.arange(3.0)
    slots = np.full((4, 3), 77, np.uint64)
    take(words_of([array]), slots[2])
    assert (slots[[0, 1, 3]] == 77).all()
    assert slots[2].tobytes() == array.tobytes()


def test_an_array_that_ends_within_a_word_takes_the_whole_word() -> None:
    """The next one begins with a word; what lies between is nobody's."""
    memory = np.frombuffer(bytearray(range(1, 49)), np.uint8)
    head, tail = memory[:13], memory[24:32]
    found = gathered(words_of([head, tail]))
    assert len(found) == whole(13) + 8
    assert found[:13] == head.tobytes()
    assert found[16:] == tail.tobytes()


@pytest.mark.parametrize("empty", [np.empty(0), np.empty((0, 3)), np.empty(0, np.int8)])
def test_an_array_without_elements_is_nothing(empty: Any) -> None:
    """Wherever it is said to lie; also where there is no other one."""
    array = np.arange(4.0)
    assert gathered(words_of([empty, array, empty])) == array.tobytes()
    assert gathered(words_of([empty])) == b""
    assert gathered(words_of([])) == b""


def test_it_gathers_from_a_simulation() -> None:
    """Step after step, together with memory of our own."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    action = np.zeros(1)
    arrays: list[Any] = [data.qpos, data.qvel, data.geom_xpos, data.ctrl, action]
    assert can_be_gathered(arrays)
    words = words_of(arrays)
    for step in range(20):
        action[:] = data.ctrl[:] = step
        mujoco.mj_step(model, data)
        assert gathered(words) == b"".join(array.tobytes() for array in arrays)
    mujoco.mj_resetData(model, data)
    assert gathered(words) == b"".join(array.tobytes() for array in arrays)


@pytest.mark.parametrize(
    ("array", "can_be"),
    [
        (np.zeros((3, 2)), True),
        (np.zeros((3, 2)).T, False),
        (np.zeros(6)[::2], False),
        (np.zeros(16, np.uint8)[8:], True),
        (np.zeros(16, np.uint8)[4:], False),
        (np.zeros(16, np.uint8)[4:4], True),
        (np.zeros(3, np.uint8), True),
    ],
)
def test_what_does_not_begin_with_a_word_cannot_be_gathered(
    array: Any, can_be: bool
) -> None:
    """Nor what has gaps; an array without elements is no obstacle."""
    assert can_be_gathered([np.zeros(1), array]) == can_be
