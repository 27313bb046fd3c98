# SPDX-License-Identifier: Apache-2.0
"""Videos that were being recorded live when their process was killed.

The encoder encodes all frames that it received, and finishes its hidden file. Text is
written to a hidden file frame by frame. A note next to the file describes the video.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..errors import DirectoryNotWritable, EncoderError, Error, UnreadableFile
from ..formats.asciicast import AsciicastWriter, unfinished_frames
from ..formats.ffmpeg import ffmpeg_sha256, ffmpeg_version
from ..formats.frame_hashes import cut_frame_hashes, frame_hash_path
from ..formats.json_fields import (
    field,
    mapping,
    optional,
    positive,
    rate,
    read_object,
    text,
    unreadable,
)
from ..formats.killed_episodes import CUT_BY_KILL
from ..formats.locks import is_locked
from ..formats.monitor_directory import unfinished_files
from ..formats.video_file import content_facts
from ..formats.video_metadata import (
    StepRuns,
    further_live_videos,
    metadata_path,
    write_metadata,
)
from ..formats.video_sink import note_path
from ..plain_text import counted

# Only the metadata of clips has this key.
_FIRST_STEP = "first_step"
_BROKEN = (
    "the recording process was killed, and so was its encoder, before the file was "
    "finished"
)


def finish_video(path: Path, known: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Give a live video its final name, and metadata for the frames that it has.

    A file that cannot be decoded keeps its hidden name. The metadata then states that
    the video is broken, and why.

    Args:
        path: the video. Call this for an episode's first camera last, because its
            metadata lists the other cameras' videos.
        known: known facts about the episode: its `length`, its `reward`, and, if it has
            ended, the facts about its end, including `complete`.

    Yields:
        The file's name and what was done with it. Nothing if only the note was left.

    Raises:
        Error: the encoder is still running, or the files cannot be written.
    """
    try:
        about, facts = _read_note(path)
    except UnreadableFile:
        # A note is written before its video exists.
        note_path(path).unlink(missing_ok=True)
        return
    # A process that was killed here has left the beginning of a second text file.
    part = max(unfinished_files(path), key=lambda p: p.stat().st_size, default=path)
    if is_locked(part):
        raise Error(
            f"The encoder for {path.name} is still finishing its file. To wait longer: "
            f"mjrec recover --timeout 60 {path.parent}"
        )
    if not metadata_path(path).exists():
        if _FIRST_STEP in about:
            # A clip spans episodes. Facts about one do not describe its end.
            known = {}
        try:
            finish = _finish_text if path.suffix == ".json" else _finish_images
            found = finish(part, path, facts)
            metadata = _metadata(path, about, {**facts, **found}, known)
            done = path.name, _counted(metadata["frame_count"], metadata)
        except (EncoderError, UnreadableFile) as error:
            ending = known if "complete" in known else {**known, **CUT_BY_KILL}
            metadata = {**about, **ending, "empty": True, "recovered": True}
            done = metadata_path(path).name, "there were no frames yet"
            # Frames are hashed before they are encoded, so the encoder may not have
            # received the last one.
            if _hashed_frames(path) > 1:
                words = getattr(error, "stderr", "").strip().splitlines()
                why = [str(error), *words][-1]
                metadata |= {"broken": True, "broken_reason": f"{_BROKEN}: {why}"}
                write_metadata(path, metadata)
                yield path.name, f"broken ({why}); its data is in {part.name}"
                return
        write_metadata(path, metadata)
        yield done
    # The note is needed as long as one of the other files exists.
    for left in (*unfinished_files(path), *_hashes(path), note_path(path)):
        left.unlink(missing_ok=True)


def _read_note(video: Path) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the metadata about a recording, and the facts about its file and timing.

    Raises:
        UnreadableFile: the note is missing or damaged.
    """
    path = note_path(video)
    with unreadable(path):
        values = read_object(path)
        facts = field(values, "facts", mapping)
        for key in ("stride", "frames_per_step"):
            field(facts, key, positive)
        field(facts, "fps", rate)
        field(facts, "timestep", optional(rate))
        if video.suffix == ".mp4":
            for key in ("padded_height", "padded_width"):
                field(facts, key, positive)
            field(facts, "pixel_format", text)
        field(facts, "encoder_version", mapping)
        return field(values, "metadata", mapping), facts


def _hashes(video: Path) -> list[Path]:
    return unfinished_files(frame_hash_path(video))


def _hashed_frames(video: Path) -> int:
    """Return the number of frames that were, or were about to be, encoded."""
    texts = [path.read_text("ascii", "replace") for path in _hashes(video)]
    return sum(not line.startswith("#") for t in texts for line in t.splitlines())


def _finish_images(part: Path, video: Path, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Rename a video and its frame hashes, and return facts about their content.

    Raises:
        EncoderError: the video cannot be decoded to its end.
        DirectoryNotWritable: the files cannot be renamed.
    """
    found = content_facts(
        part,
        height=facts["padded_height"],
        width=facts["padded_width"],
        pixel_format=facts["pixel_format"],
    )
    is_same_ffmpeg = facts["encoder_version"].get("version") == ffmpeg_version()
    try:
        for hashes in _hashes(video):
            try:
                # Some frames that have hashes may not have reached the file.
                cut_frame_hashes(hashes, found["frame_count"])
            except ValueError:
                # Incomplete hashes are worse than none.
                hashes.unlink()
            else:
                hashes.replace(frame_hash_path(video))
        part.replace(video)
    except OSError as error:
        raise DirectoryNotWritable(video.parent, error) from error
    return {**found, "ffmpeg_sha256": ffmpeg_sha256() if is_same_ffmpeg else None}


def _finish_text(part: Path, video: Path, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Write a text recording anew, and return facts about its content.

    Raises:
        UnreadableFile: there is no complete frame.
        FileNotWritten: the disk is full.
    """
    frames = unfinished_frames(part)
    writer = AsciicastWriter(video, rate=Fraction(facts["fps"]))
    for frame in frames:
        writer.write(frame)
    writer.close()
    return {"frame_count": len(frames)}


def _counted(count: int, metadata: Mapping[str, Any]) -> str:
    ending = "" if metadata["complete"] else f", incomplete: {metadata['reason']}"
    return f"{counted(count, 'frame')}{ending}"


def _metadata(
    video: Path,
    about: Mapping[str, Any],
    facts: dict[str, Any],
    known: Mapping[str, Any],
) -> dict[str, Any]:
    frame_count, stride = facts["frame_count"], facts["stride"]
    frames_per_step = facts.pop("frames_per_step")
    length = known.get("length", 0)
    # The last step always has a frame.
    steps = [*range(0, length, stride), length]
    is_whole = len(steps) == frame_count and frames_per_step == 1
    if not is_whole or "complete" not in known:
        # The encoder had not received the last frames.
        steps = [*range(0, frame_count * stride, stride)]
        sums = {key: known[key] for key in ("length", "reward") if key in known}
        known = {**sums, **CUT_BY_KILL}
    # The step of each frame is known only if there is one frame per step.
    is_known = frames_per_step == 1
    further = further_live_videos(video)
    return {
        **about,
        **facts,
        **known,
        "frame_steps": StepRuns(steps, stride=stride).ranges if is_known else None,
        **({"further_videos": further} if further else {}),
        "recovered": True,
    }
