# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mjrec.formats.trajectory import Array
from mjrec.recorder.step_arrays import action_array, step_array


@pytest.mark.parametrize(
    ("example", "kind"),
    [
        (np.zeros(3, np.float32), Array("<f8", (3,))),
        (np.zeros((2, 2), ">f8"), Array("<f8", (2, 2))),
        (2, Array("<i8", ())),
        (np.int8(1), Array("<i8", ())),
        (True, Array("<i8", ())),
        ([0.5, 1.0], Array("<f8", (2,))),
        (np.zeros((4, 4, 3), np.uint8), Array("|u1", (4, 4, 3))),
        (np.zeros(0), Array("<f8", (0,))),
    ],
)
def test_kind_keeps_every_value(example: Any, kind: Array) -> None:
    """Floats are float64 and integers int64; pictures stay as they are."""
    array = step_array(example)
    assert array is not None
    assert array.kind == kind
    assert array.set(example)
    assert array.size == kind.size
    np.testing.assert_array_equal(array.values, example)


def test_float32_and_float64_are_the_same_kind() -> None:
    """Whichever comes first."""
    array = step_array(np.zeros(2, np.float32))
    assert array is not None
    assert array.set(np.array([0.1, 0.2]))
    assert array.values.tolist() == [0.1, 0.2]


def test_dictionary_becomes_one_vector() -> None:
    """Its arrays lie one behind the other, in its own order."""
    array = step_array({"b": np.ones((2, 2), np.float32), "a": 3})
    assert array is not None
    assert array.parts == {"b": (2, 2), "a": ()}
    assert array.set({"b": np.full((2, 2), 2.0), "a": 5})
    assert array.values.tolist() == [2, 2, 2, 2, 5]


@pytest.mark.parametrize(
    "example", [None, "text", object(), {}, {"a": "b"}, ([1], [1, 2]), 1j]
)
def test_nothing_like_an_array(example: Any) -> None:
    """What no array holds is not recorded."""
    assert step_array(example) is None


def test_dictionary_in_another_order_is_the_same() -> None:
    """Arrays go by their names."""
    array = step_array({"b": np.ones(2), "a": 3})
    assert array is not None
    assert array.set({"a": 5, "b": np.full(2, 2.0)})
    assert array.values.tolist() == [2, 2, 5]


def test_actions_may_begin_with_whole_numbers() -> None:
    """A single one is a choice and stays an integer; several are float64."""
    array = action_array([0, 0])
    assert array is not None
    assert array.set([0.5, -0.9])
    assert array.values.tolist() == [0.5, -0.9]
    choice = action_array(1)
    assert choice is not None
    assert choice.kind == Array("<i8", ())
    assert not choice.set(0.5)


@pytest.mark.parametrize("odd", [np.zeros(3), None, "x", [[1, 2]], {"a": 1}])
def test_odd_one_is_held_as_zeros(odd: Any) -> None:
    """An environment may take it all the same."""
    array = step_array(np.ones(2))
    assert array is not None
    assert array.set(np.ones(2))
    assert not array.set(odd)
    assert array.values.tolist() == [0, 0]


def test_float_where_integers_are_is_odd() -> None:
    """It would lose what is behind its point."""
    array = step_array(np.array([1, 2]))
    assert array is not None
    assert not array.set(np.array([0.5, 1.0]))
    assert not array.set([0.5, 1.0])
    assert array.set(np.array([3, 4], np.int8))


def test_odd_dictionary_is_held_as_zeros() -> None:
    """Also where it is no dictionary any more."""
    array = step_array({"a": np.ones(2)})
    assert array is not None
    assert not array.set(np.ones(2))
    assert not array.set({"a": "text"})


def test_values_are_always_the_same_memory() -> None:
    """Whoever copies them need not ask again, whatever they were set to."""
    array = step_array(np.zeros(2))
    assert array is not None
    before = array.values
    for value in (np.ones(2), [2.0, 3.0], None, np.array([4, 5], np.int8)):
        array.set(value)
        assert array.values is before
    assert before.tolist() == [4, 5]
