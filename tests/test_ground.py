# SPDX-License-Identifier: Apache-2.0
"""Test the modules that all others use: JSON, atomic files, frames and errors."""

import json
import math
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import mjrec
from mjrec import ExistingRecordings, InvalidArgument, InvalidFrame, UnknownName
from mjrec.atomic_files import replacing, write_text
from mjrec.formats.monitor_directory import infix_of
from mjrec.frames import check_frame, check_size, grid_frame, grid_shape
from mjrec.json_text import dumps, float_from_json, loads

LOOP = []
LOOP.append(LOOP)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([np.float32(0.5), np.uint64(2**63), np.bool_(True)], f"[0.5, {2**63}, true]"),
        ((np.arange(3), 0.1), "[[0, 1, 2], 0.1]"),
        ({1: 2, None: np.int64(3)}, '{"1": 2, "null": 3}'),
        ([math.nan, np.float32("nan")], "[null, null]"),
        # JSON parsers read 1e999 as infinity; strings are not converted.
        ([math.inf, -math.inf, "Infinity"], '[1e999, -1e999, "Infinity"]'),
        # Facts that only people read must never stop a run.
        ({"a": Path("x")}, '{"a": {"repr": "PosixPath(\'x\')"}}'),
        (LOOP, '[{"repr": "[[...]]"}]'),
    ],
)
def test_json_is_valid_for_numpy_nan_and_unknown_values(value, text):
    assert dumps(value) == text
    json.loads(text, parse_constant=pytest.fail)


def test_nan_and_infinity_are_read_back():
    assert math.isnan(float_from_json(None))
    assert repr(loads("[NaN, -Infinity, 1e999]")) == "[nan, -inf, inf]"


def test_file_appears_whole_or_not_at_all(tmp_path):
    """A failure leaves the old file unchanged and no temporary file."""
    path = tmp_path / "openaigym.video.0.7.video000015.mp4"
    with replacing(path) as temporary:
        temporary.write_text("half")
        assert not path.exists()
        hidden = rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.part"
        assert re.fullmatch(hidden, temporary.name)
        # The infix lets cleanup find files that a killed process left behind.
        assert infix_of(temporary.name) == "0.7"
    write_text(path, "old")
    # The last character cannot be encoded, so writing fails.
    with pytest.raises(UnicodeEncodeError), replacing(path) as temporary:
        temporary.write_text("new\udc80")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "bad",
    [
        *(None, [[[0, 0, 0]]], np.zeros((2, 2, 3)), np.zeros((2, 2), np.uint8)),
        *(np.zeros((2, 2, 4), np.uint8), np.zeros((0, 2, 3), np.uint8)),
    ],
)
def test_invalid_frames_are_errors(bad):
    with pytest.raises(InvalidFrame, match="must"):
        check_frame(bad)


@pytest.mark.parametrize("size", [(0, 1), (1.5, 2), (True, 2), (1, 99999)])
def test_impossible_sizes_are_errors(size):
    with pytest.raises(InvalidArgument, match=r"height|width"):
        check_size(*size)


def test_grid_is_nearly_square_and_scales_nothing():
    for count in range(1, 40):
        rows, columns = grid_shape(count)
        assert rows * columns >= count > (rows - 1) * columns
        assert rows <= columns <= rows + 1
    frames = [np.full((2, 3, 3), value, np.uint8) for value in (10, 20, 30)]
    grid = grid_frame(frames)
    assert grid[::2, ::3, 0].tolist() == [[10, 20], [30, 0]]
    assert (grid == grid[::2, ::3].repeat(2, axis=0).repeat(3, axis=1)).all()
    with pytest.raises(InvalidArgument, match="3x2, 4x5"):
        grid_frame([frames[0], np.zeros((5, 4, 3), np.uint8)])


def test_long_lists_in_errors_are_shortened_to_similar_names():
    assert "Available: side, top." in str(UnknownName("camera", "sid", ["side", "top"]))
    many = [f"Env-v{n}" for n in range(50)]
    assert "Similar names: Env-v3" in str(UnknownName("environment", "env-v3", many))
    assert "of the 50 known names is" in str(UnknownName("environment", "zzz", many))
    assert "There are none." in str(UnknownName("camera", "a", []))
    existing = str(ExistingRecordings(Path("d"), [f"file{n}" for n in range(8)]))
    assert "file4 and 3 more" in existing
    assert "file5" not in existing


ERRORS = [
    mjrec.UnknownName("camera", "a", ["b"]),
    mjrec.ExistingRecordings(Path("d"), ["a"]),
    mjrec.DirectoryNotWritable(Path("d"), "why"),
    mjrec.DifferentEnvironment(Path("d"), "a", "b"),
    mjrec.EncoderError("what", command=["ffmpeg"], returncode=1, stderr="why"),
    mjrec.UnreadableFile(Path("f"), "why"),
    mjrec.MissingDependency("p", purpose="x", install="pip install p"),
    mjrec.EnvironmentNotMade("e", "why"),
    mjrec.ResetNeeded("text"),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_errors_survive_pickling_with_all_facts(error):
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy)) == (type(error), str(error))
    assert vars(copy) == vars(error)
