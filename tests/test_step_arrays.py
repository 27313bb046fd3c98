# SPDX-License-Identifier: Apache-2.0
"""Actions and observations become arrays of one kind, with every value kept."""

import numpy as np
import pytest

from mjrec.recorder.step_arrays import action_array, step_array


@pytest.mark.parametrize(
    ("example", "kind"),
    [
        (np.zeros(3, np.float32), ("<f8", (3,))),
        (np.zeros((2, 2)), ("<f8", (2, 2))),
        (np.int32(2), ("<i8", ())),
        (True, ("<i8", ())),
        ([0.5, 1], ("<f8", (2,))),
        (np.zeros((4, 4, 3), np.uint8), ("|u1", (4, 4, 3))),
        # Its arrays lie one behind the other, in its own order.
        ({"b": [1, 2], "a": np.float32(3)}, ("<f8", (3,))),
    ],
)
def test_a_kind_keeps_every_value(example, kind):
    """Floats are float64 and integers int64; frames stay as they are."""
    array = step_array(example)
    assert array.kind == np.dtype(kind)
    parts = example.values() if isinstance(example, dict) else [example]
    assert array.set(example)
    expected = np.concatenate([np.ravel(part) for part in parts])
    assert np.array_equal(array.values.ravel(), expected)


def test_actions_may_begin_with_whole_numbers():
    """One is a choice; several are float64; of what fits nowhere nothing is made."""
    kinds = [action_array(example) for example in (3, [0, 0], np.zeros(2, np.int64))]
    assert [each.kind.base for each in kinds] == ["<i8", "<f8", "<f8"]
    for example in (None, "left", [[1], [1, 2]], {}, {"a": "b"}, 1j):
        assert step_array(example) is None


@pytest.mark.parametrize(
    ("example", "like", "odd"),
    [
        (np.ones(2), np.ones(2, np.float32), np.ones(3)),
        (np.ones(2), [3, 4], "left"),
        (np.ones(2), [True, False], None),
        # It would lose what is behind its point.
        (1, 2, 0.5),
        ({"a": [1.0], "b": 2.0}, {"b": 2.0, "a": [1.0]}, {"a": [1.0]}),
        ({"a": [1.0], "b": 2.0}, {"b": 2.0, "a": [1.0]}, [1.0, 2.0]),
    ],
)
def test_an_odd_one_is_held_as_zeros(example, like, odd):
    """In the same memory, from which rows are gathered; and then goes on."""
    array = step_array(example)
    memory = array.values
    for value, fits in ((like, True), (odd, False), (like, True)):
        assert array.set(value) is fits
        assert memory.any() == fits
    assert array.values is memory
