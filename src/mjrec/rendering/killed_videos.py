# SPDX-License-Identifier: Apache-2.0
"""Videos that were recorded live when their process was killed.

The encoder goes on to the end of what it was given, and finishes its hidden file. A
note beside it says what it is.

Text recordings are on the disk frame by frame, and have no note: their frames tell the
rate, and the trajectory, where there is one, the episode.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from ..errors import EncoderError, Error, UnreadableFile
from ..formats.asciicast import AsciicastWriter, unfinished_recording
from ..formats.journal import KILLED
from ..formats.locks import is_locked
from ..formats.monitor_directory import episode_of, video_prefix
from ..formats.unfinished_video import UnfinishedVideo, read_note
from ..formats.video_metadata import (
    StepRuns,
    further_live_videos,
    metadata_path,
    timing_facts,
    write_metadata,
)
from .killed_episodes import KnownEpisodes
from .recovery_report import RecoveredFile

_MOMENT = 0.05


def finish_video(
    note_file: Path, known: KnownEpisodes, *, is_over: Callable[[], bool]
) -> RecoveredFile | None:
    """Give a live video its name and its metadata, as far as it goes.

    A file that cannot be decoded keeps its hidden name, and the metadata says that the
    video broke, and why.

    Args:
        note_file: the note beside it. That of an episode's first video comes after
            those of its further cameras, which its metadata names.
        known: what is known of the monitor's episodes.
        is_over: tells whether not to wait any longer for its encoder.

    Returns:
        What became of it; None where only the note was left.

    Raises:
        Error: its encoder is still at it, or the files cannot be written.
    """
    try:
        video = read_note(note_file)
    except UnreadableFile:
        # Whoever writes a note writes it before there is a video.
        note_file.unlink(missing_ok=True)
        return None
    _wait_for_encoder(video, is_over)
    if metadata_path(video.path).exists() or not _is_begun(video):
        _forget(note_file, video)
        return None
    if not _holds_pictures(video):
        # It was killed before its encoder had been given a frame.
        write_metadata(video.path, _metadata_without_video(video, known))
        _forget(note_file, video)
        return RecoveredFile(metadata_path(video.path).name, "there was no frame yet")
    try:
        facts = video.finish()
    except EncoderError as error:
        return _give_up(note_file, video, known, error)
    metadata = _metadata(video, facts, known)
    write_metadata(video.path, metadata)
    _forget(note_file, video)
    count = facts["frame_count"]
    frames = f"{count} {'frame' if count == 1 else 'frames'}"
    ending = "" if metadata["complete"] else f", incomplete: {metadata['reason']}"
    return RecoveredFile(video.path.name, frames + ending)


def _wait_for_encoder(video: UnfinishedVideo, is_over: Callable[[], bool]) -> None:
    while is_locked(video.temporary):
        if is_over():
            raise Error(
                f"The encoder of {video.path.name} is still finishing its file. To "
                f"wait longer: mjrec recover --timeout 60 {video.path.parent}"
            )
        time.sleep(_MOMENT)


def _is_begun(video: UnfinishedVideo) -> bool:
    """Tell whether there is a file that anything was written into."""
    for path in (video.temporary, video.path):
        # A link may lead anywhere.
        if path.is_file() and not path.is_symlink():
            return path.stat().st_size > 0
    return False


def _holds_pictures(video: UnfinishedVideo) -> bool:
    """Tell whether the file holds anything besides what every mp4 begins with."""
    path = video.temporary if video.temporary.exists() else video.path
    end = path.stat().st_size
    with path.open("rb") as file:
        position = 0
        while position + 8 <= end:
            file.seek(position)
            size, kind = struct.unpack(">I4s", file.read(8))
            if kind not in (b"ftyp", b"moov", b"free", b"mdat"):
                return True
            # 0 is to the end, as in one that is not finished, and 1 very large.
            held = end - position if size == 0 else size
            if kind == b"mdat" and held != 8:
                return True
            position += max(size, 8)
    return False


def _forget(note_file: Path, video: UnfinishedVideo) -> None:
    """Remove what is not needed any more; the note last, which says what it was."""
    video.temporary.unlink(missing_ok=True)
    if video.hashes is not None:
        video.hashes.unlink(missing_ok=True)
    note_file.unlink(missing_ok=True)


def _give_up(
    note_file: Path, video: UnfinishedVideo, known: KnownEpisodes, error: EncoderError
) -> RecoveredFile:
    said = error.stderr.strip().splitlines()
    why = said[-1] if said else str(error)
    reason = (
        "the recording process was killed, and its encoder before it had finished the "
        f"file: {why}"
    )
    failure = {"broken": True, "broken_reason": reason}
    write_metadata(video.path, {**_metadata_without_video(video, known), **failure})
    if video.hashes is not None:
        video.hashes.unlink(missing_ok=True)
    return RecoveredFile(
        video.path.name, f"broken ({why}); its data is in {video.temporary.name}"
    )


def _metadata_without_video(
    video: UnfinishedVideo, known: KnownEpisodes
) -> Mapping[str, Any]:
    number = episode_of(video.path.name)
    ending = known.ending(number) or {"complete": False, "reason": KILLED}
    return {
        **video.metadata,
        **ending,
        **known.sums(number),
        "empty": True,
        "recovered": True,
    }


def _metadata(
    video: UnfinishedVideo, facts: dict[str, Any], known: KnownEpisodes
) -> Mapping[str, Any]:
    number = episode_of(video.path.name)
    frame_count, stride = facts["frame_count"], facts["stride"]
    frames_per_step = facts.pop("frames_per_step")
    sums = known.sums(number)
    ending = known.ending(number)
    length: Any = sums.get("length")
    steps: Iterable[int] = range(0, frame_count * stride, stride)
    # The last step is always among them.
    whole = [*range(0, length, stride), length] if isinstance(length, int) else []
    if ending is not None and frames_per_step == 1 and len(whole) == frame_count:
        steps = whole
    else:
        # The last frames were on their way to the encoder.
        ending = {"complete": False, "reason": KILLED}
    runs = StepRuns(steps, stride=stride)
    # How many frames each step gave is known only where it is one.
    frame_steps = runs.ranges if frames_per_step == 1 else None
    return {
        **video.metadata,
        **facts,
        **ending,
        **sums,
        "frame_steps": frame_steps,
        **_further_videos(video.path),
        "recovered": True,
    }


def _further_videos(video: Path) -> dict[str, Any]:
    """Return what the first video of an episode says of those of further cameras."""
    names = further_live_videos(video)
    return {"further_videos": names} if names else {}


_TOLD_BY_TRAJECTORY = ("type", "env_id", "seed", "options", "versions")


def finish_text(part: Path, known: KnownEpisodes) -> RecoveredFile | None:
    """Make a text recording, and its metadata, of the frames that are there.

    Args:
        part: the hidden file that the frames were written into.
        known: what is known of the monitor's episodes.

    Returns:
        What was made; None where it was there already.

    Raises:
        UnreadableFile: there is no whole frame in it.
        Error: the files cannot be written.
    """
    number = episode_of(part.name)
    assert number is not None
    path = part.with_name(f"{video_prefix(known.infix, number)}.json")
    if metadata_path(path).exists():
        part.unlink(missing_ok=True)
        return None
    rate, frames = unfinished_recording(part)
    ending = known.ending(number)
    sums = known.sums(number)
    if ending is None or sums.get("length") != len(frames) - 1:
        ending = {"complete": False, "reason": KILLED}
    writer = AsciicastWriter(path, rate=rate)
    for frame in frames:
        writer.write(frame)
    writer.close()
    facts: dict[str, Any] = dict(known.facts(number))
    write_metadata(
        path,
        {
            "episode_id": number,
            "content_type": "video/vnd.openai.ansivid",
            "encoder_version": {"backend": "TextEncoder", "version": 1},
            "recording": "live",
            **{key: facts[key] for key in _TOLD_BY_TRAJECTORY if key in facts},
            **ending,
            **sums,
            **timing_facts(StepRuns(range(len(frames))), fps=rate, timestep=None),
            "recovered": True,
        },
    )
    part.unlink(missing_ok=True)
    cut = "" if ending["complete"] else f", incomplete: {ending['reason']}"
    count = f"{len(frames)} {'frame' if len(frames) == 1 else 'frames'}"
    return RecoveredFile(path.name, count + cut)
