# SPDX-License-Identifier: Apache-2.0
"""`mjrec strip` writes a film strip."""

import json

import numpy as np
import pytest
from PIL import Image

import mjrec
from mjrec.commands.strip import strip
from mjrec.errors import InvalidArgument


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "video.mp4"
    with mjrec.VideoWriter(path, fps=10) as writer:
        for i in range(12):
            writer.write(np.full((32, 48, 3), 20 * i, np.uint8))
    return path


def test_it_writes_a_picture_and_says_its_size(video, tmp_path, capsys):
    """In as many columns as asked for."""
    out = tmp_path / "strip.png"
    assert strip(video, frames=6, columns=2, out=out) == 0
    with Image.open(out) as image:
        assert image.width == 2 + 2 * (48 + 2)
        assert f"{image.width}x{image.height} pixels" in capsys.readouterr().out


def test_json(video, tmp_path, capsys):
    """For scripts."""
    out = tmp_path / "strip.png"
    assert strip(video, frames=1, out=out, as_json=True) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"strip": str(out), "width": 52, "height": said["height"]}


def test_what_a_video_cannot_show(video, tmp_path):
    """Another size needs the trajectory; nothing is written."""
    with pytest.raises(InvalidArgument, match="trajectory"):
        strip(video, size="640x480", out=tmp_path / "strip.png")
    with pytest.raises(InvalidArgument, match="12 pictures"):
        strip(video, frames=13, out=tmp_path / "strip.png")
    assert not (tmp_path / "strip.png").exists()
