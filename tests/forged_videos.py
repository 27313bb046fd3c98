# SPDX-License-Identifier: Apache-2.0
"""Finished videos, and what a forger makes of them: files that fit in themselves."""

import json

import mjrec
from mjrec.formats.video_writer import VideoWriter

_ENDINGS = (".mp4", ".framehash", ".meta.json")


def video(directory, episode=0):
    """Return the video of an episode."""
    [path] = directory.glob(f"*.video{episode:06d}.mp4")
    return path


def metadata(path):
    """Return what the metadata of a video says."""
    return json.loads(path.with_suffix(".meta.json").read_text())


def say(path, **changes):
    """Change what the metadata of a video says."""
    said = {**metadata(path), **changes}
    path.with_suffix(".meta.json").write_text(json.dumps(said))


def drawn(directory, episode=0):
    """Return the frames of an episode, drawn again."""
    [path] = directory.glob(f"*.episode{episode:06d}.h5")
    return list(mjrec.render(path))


def forge(path, frames, *, hashes=True, **kw):
    """Put other frames into a video, and make all fit that anybody can."""
    said, kept = metadata(path), path.with_suffix(".framehash").read_bytes()
    options = {"fps": int(said["fps"]), "frame_hashes": True, **kw}
    with VideoWriter(path, **options) as writer:
        for frame in frames:
            writer.write(frame)
    if not hashes:
        path.with_suffix(".framehash").write_bytes(kept)
    assert writer.result is not None
    last = len(frames) - 1
    say(
        path,
        file_sha256=writer.result.file_sha256,
        decoded_sha256=writer.result.decoded_sha256,
        frame_count=len(frames),
        frame_steps=[[0, last]],
        length=last,
    )


def swap(one, other):
    """Give each of two videos the other's name, with all that belongs to them."""
    for ending in _ENDINGS:
        first, second = (path.with_suffix(ending) for path in (one, other))
        content = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(content)
