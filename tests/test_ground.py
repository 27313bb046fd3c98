# SPDX-License-Identifier: Apache-2.0
"""The small modules at the bottom: JSON, files that appear whole, frames, errors."""

from __future__ import annotations

import json
import math
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjrec
from mjrec import ExistingRecordings, InvalidArgument, InvalidFrame, UnknownName
from mjrec.atomic_files import replacing, write_text
from mjrec.formats.monitor_directory import infix_of
from mjrec.frames import check_frame, check_size, pad_to_even
from mjrec.json_text import dumps, float_from_json, loads


def test_infinity_is_valid_json_that_reads_as_infinity() -> None:
    """A strict parser accepts it, and strings that say so stay strings."""
    text = dumps([math.inf, -math.inf, "Infinity", {"-Infinity": 1}])
    assert json.loads(text, parse_constant=pytest.fail) == [
        math.inf,
        -math.inf,
        "Infinity",
        {"-Infinity": 1},
    ]


def test_nan_is_null() -> None:
    """And null is NaN again."""
    assert dumps([math.nan, np.float32("nan")]) == "[null, null]"
    assert math.isnan(float_from_json(None))
    assert loads("[NaN]") != [1.0]  # gym's own token, accepted


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.float32(0.5), "0.5"),
        (np.int8(3), "3"),
        (np.uint64(2**63), str(2**63)),
        (np.bool_(True), "true"),
        (np.arange(3), "[0, 1, 2]"),
        ((1, 2), "[1, 2]"),
        ({1: 2}, '{"1": 2}'),
        (0.1, "0.1"),
    ],
)
def test_numpy_is_written_as_numbers(value: Any, text: str) -> None:
    """Scalars of every kind, arrays and tuples."""
    assert dumps(value) == text


def test_unknown_objects_are_written_as_what_they_look_like() -> None:
    """What is noted for people never stops a run."""
    assert loads(dumps({"a": Path("x")})) == {"a": {"repr": repr(Path("x"))}}


def test_file_appears_whole(tmp_path: Path) -> None:
    """The name is there only when the block has ended."""
    path = tmp_path / "a.txt"
    with replacing(path) as temporary:
        temporary.write_text("half")
        assert not path.exists()
        assert re.fullmatch(r"\.a\.txt\.[0-9a-f]{8}\.part", temporary.name)
        assert temporary.parent == tmp_path
    assert path.read_text() == "half"
    assert list(tmp_path.iterdir()) == [path]


def test_unfinished_file_of_a_hidden_one_is_known_as_a_monitors(tmp_path: Path) -> None:
    """Or nobody would remove what a killed process has left of it."""
    note = tmp_path / ".openaigym.video.0.7.video000015.mp4.note.part"
    with replacing(note) as temporary:
        assert infix_of(temporary.name) == "0.7"
        temporary.touch()
    assert note.exists()


def test_failure_leaves_the_old_file(tmp_path: Path) -> None:
    """And no temporary one."""
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_odd_sides_are_padded_by_their_edge() -> None:
    """Nothing is rescaled: every pixel stays where it was."""
    frame = np.random.default_rng(0).integers(0, 255, (3, 5, 3)).astype(np.uint8)
    padded = pad_to_even(frame)
    assert padded.shape == (4, 6, 3)
    assert (padded[:3, :5] == frame).all()
    assert (padded[3, :5] == frame[2]).all()
    assert (padded[:3, 5] == frame[:, 4]).all()
    assert pad_to_even(padded) is padded


@pytest.mark.parametrize(
    "bad",
    [
        None,
        [[[0, 0, 0]]],
        np.zeros((2, 2, 3)),
        np.zeros((2, 2), np.uint8),
        np.zeros((2, 2, 4), np.uint8),
        np.zeros((0, 2, 3), np.uint8),
    ],
)
def test_what_is_no_frame_is_said(bad: Any) -> None:
    """The error says what it is and what it should be."""
    with pytest.raises(InvalidFrame, match="must"):
        check_frame(bad)


@pytest.mark.parametrize("size", [(0, 1), (1, -1), (1.5, 2), (True, 2), (99999, 1)])
def test_impossible_sizes_are_an_error(size: tuple[Any, Any]) -> None:
    """It names the side."""
    with pytest.raises(InvalidArgument, match=r"height|width"):
        check_size(*size)


def test_unknown_name_lists_what_there_is() -> None:
    """A few names are all listed; of many, those that look alike."""
    assert "There are: side, top." in str(UnknownName("camera", "sid", ["side", "top"]))
    many = [f"Env-v{n}" for n in range(50)]
    assert "Names like it: Env-v3" in str(UnknownName("environment", "env-v3", many))
    assert "none with a like name" in str(UnknownName("environment", "zzz", many))
    assert "There are none." in str(UnknownName("camera", "a", []))


ERRORS = [
    mjrec.UnknownName("camera", "a", ["b"]),
    mjrec.ExistingRecordings(Path("d"), ["a"]),
    mjrec.DirectoryNotWritable(Path("d"), "why"),
    mjrec.DifferentEnvironment(Path("d"), "a", "b"),
    mjrec.EncoderError("what", command=["ffmpeg"], returncode=1, stderr="said"),
    mjrec.UnreadableFile(Path("f"), "why"),
    mjrec.MissingDependency("p", purpose="x", install="pip install p"),
    mjrec.EnvironmentNotMade("e", "why"),
    mjrec.ResetNeeded("text"),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_errors_come_home_from_other_processes(error: mjrec.Error) -> None:
    """They survive pickling, message and facts."""
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)


def test_value_that_holds_itself_is_written() -> None:
    """As what Python shows of it."""
    loop: list[Any] = []
    loop.append(loop)
    assert loads(dumps(loop)) == [{"repr": "[[...]]"}]


def test_existing_recordings_lists_five_at_most() -> None:
    """And says how many more there are."""
    error = ExistingRecordings(Path("d"), [f"file{n}" for n in range(8)])
    assert "file4 and 3 more" in str(error)
    assert "file5" not in str(error)
