# SPDX-License-Identifier: Apache-2.0
"""The videos that are counted in steps: the pictures of all parts in one file."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..annotation import Caption, check_annotation
from ..formats.unfinished_video import VideoFile
from .captions import Captions
from .pool import WorkerPool
from .recorded_clips import RecordedClip, read_clip
from .recorded_facts import open_for_rendering
from .videos import (
    Footage,
    ending_facts,
    is_annotated,
    known_facts,
    render_footage,
    usual_fps,
    video_path,
    what_broke,
    write_that_it_broke,
)
from .views import View

_NO_FRAME = "the process was killed before its first frame"


def render_clip(
    parts: Sequence[Path],
    *,
    workers: WorkerPool,
    strict: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> VideoFile | None:
    """Render the video of a clip, with its frame hashes and its metadata.

    As `render_video` does, of all parts one behind the other.

    Args:
        parts: its logs, in their order.
        workers: who draw.
        strict: whether a video that shows nothing is an error.
        on_frame: called after every frame, once for each of every video.

    Returns:
        What was written, of the first camera; None where no frame was recorded, which
        the metadata now says.

    Raises:
        UnreadableFile: a part is missing or damaged.
        Error: as `render_video`.
    """
    clip = read_clip(parts)
    first = clip.facts[0]
    if not clip.frame_count:
        metadata = {**_told(clip), "broken_reason": _NO_FRAME}
        write_that_it_broke(video_path(parts[0], first), metadata)
        return None
    chosen = clip.chosen()
    # All frames are recorded: `max_fps` has no part in the rate that was asked for.
    asked = (first.get("video") or {}).get("fps")
    runs = _runs(clip, chosen.indices)
    footage = Footage(
        runs=runs,
        facts=first,
        metadata=_told(clip),
        # Pictures are counted, because resets have one and are no steps.
        steps=chosen.indices,
        stride=chosen.every,
        timestep=clip.timing.get("timestep"),
        fps=usual_fps(clip.timing, chosen) if asked is None else Fraction(asked),
        captions=_captions(runs) if is_annotated(first) else None,
    )
    return render_footage(
        footage, workers=workers, view=View(), strict=strict, on_frame=on_frame
    )


def _runs(clip: RecordedClip, indices: Sequence[int]) -> list[tuple[Path, list[int]]]:
    """Return the parts, each with the numbers of those of its pictures."""
    ends = list(itertools.accumulate(clip.frame_counts))
    runs = []
    for path, end, count in zip(clip.parts, ends, clip.frame_counts, strict=True):
        begin = end - count
        own = [index - begin for index in indices if begin <= index < end]
        if own:
            runs.append((path, own))
    return runs


def _captions(runs: Sequence[tuple[Path, Sequence[int]]]) -> list[Caption]:
    check_annotation()
    captions: list[Caption] = []
    for path, indices in runs:
        with open_for_rendering(path) as reader:
            captions += Captions(reader, indices)
    return captions


def _told(clip: RecordedClip) -> dict[str, Any]:
    """Return what the metadata says of what was recorded."""
    first, last = clip.facts[0], clip.facts[-1]
    so_far = {"length": clip.step_count, "reward": clip.reward}
    missing = any("final_frame" in facts for facts in clip.facts)
    return {
        **known_facts(first),
        "first_step": (first.get("clip") or {}).get("first_step"),
        "last_episode_id": last.get("last_episode_id", last.get("episode_id")),
        **({"final_frame": "missing"} if missing else {}),
        **ending_facts(last, so_far),
        **what_broke(last),
    }
