# SPDX-License-Identifier: Apache-2.0
"""The facts about a recording, checked for rendering, and its frames and captions.

A recording may come from a stranger. Its facts are checked here once, so that later
code can rely on valid rates, and on paths that stay inside the directory.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..annotation import Caption
from ..errors import InvalidArgument, NoPictures, UnreadableFile
from ..formats.json_fields import (
    base_name,
    boolean,
    field,
    integer,
    list_of,
    mapping,
    number,
    one_of,
    optional,
    rate,
    text,
    unreadable,
)
from ..formats.monitor_directory import (
    clip_step,
    clip_video_prefix,
    episode_of,
    further_parts,
    infix_of,
    is_second_name,
    video_prefix,
    with_part,
)
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_file import open_trajectory
from ..frames import QUALITIES
from ..rates import stride_for, to_rate
from ..simulation.foreign_files import open_vetted_trajectory
from .jobs import PlainCamera, plain_camera

logger = logging.getLogger(__name__)

_BLOCK_BYTES = 1 << 20

# A rate that the user requested is stored as given, such as 29.97, or as the exact
# fraction of a float. `Fraction` accepts more, but 1e20000000 would take ages to parse.
_ASKED_RATE = re.compile(r"\d{1,40}(\.\d{1,40}|/0*[1-9]\d{0,39})?", re.ASCII)


def open_for_rendering(path: Path, *, is_vetted: bool = False) -> TrajectoryReader:
    """Open a trajectory, which may come from a stranger, and check its facts.

    Afterwards, `rate`, `timestep`, `scene`, `model`, `video` and `clip` are valid,
    None, or missing; `stride`, `kept` and `candidate` are valid or missing.

    Args:
        path: the trajectory.
        is_vetted: whether another mjrec process has already opened it successfully.

    Raises:
        UnreadableFile: a fact is invalid, or see `open_vetted_trajectory`.
    """
    reader = open_trajectory(path) if is_vetted else open_vetted_trajectory(path)
    try:
        with unreadable(path):
            _check_all(reader.facts, _FACTS)
    except BaseException:
        reader.close()
        raise
    return reader


def model_file(directory: Path, facts: Mapping[str, Any]) -> Path | None:
    """Return the model file that rendering a recording needs; None if unknown."""
    model = facts.get("model") or {}
    # The compiled model is written first. Its sources may never be written.
    name = model.get("mjb") or model.get("xml")
    return None if name is None else directory / name


def video_facts(facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a recording's facts about its video; empty if there is no video."""
    return facts.get("video") or {}


def video_path(recording: Path, facts: Mapping[str, Any]) -> Path:
    """Return the path of the video of a trajectory or of a clip's part.

    Raises:
        UnreadableFile: the recording names no video, or a video that is not its own.
    """
    name = str(video_facts(facts).get("name"))
    infix, step = infix_of(recording.name), clip_step(recording.name)
    # Only the name of a clip's video shows in which episode the clip began.
    episode = episode_of(recording.name if step is None else name)
    own: set[str] = set()
    if infix is not None and episode is not None:
        own.add(f"{video_prefix(infix, episode)}.mp4")
        if step is not None:
            own.add(f"{clip_video_prefix(infix, episode, step)}.mp4")
    if name not in own:
        raise UnreadableFile(
            recording,
            f"the video in its facts, {name!r:.200}, does not belong to its episode",
        )
    return recording.with_name(name)


def further_video_paths(recording: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Return the paths of the videos from a recording's other cameras.

    Raises:
        UnreadableFile: see `video_path`.
    """
    video = video_facts(facts)
    cameras = video.get("cameras") or ()
    if video.get("tiled") or len(cameras) < 2:
        return []
    first = video_path(recording, facts)
    return [
        first.with_name(with_part(first.name, part)) for part in further_parts(cameras)
    ]


class ChosenFrames(NamedTuple):
    """A selection of a recording's frames.

    Attributes:
        indices: the numbers of the frames.
        every: the stride between frames; the last stride may be smaller.
    """

    indices: list[int]
    every: int


def check_has_frames(reader: TrajectoryReader) -> None:
    """Raise NoPictures, with the reason, if a trajectory has no frames to draw."""
    facts = reader.facts
    if facts.get("scene") is not None and reader.frame_count:
        return
    reason = facts.get("refusal") or (
        "it ended before the first" if facts.get("scene") else "none were recorded"
    )
    raise NoPictures(
        f"{reader.path} contains no snapshots to draw frames from: {reason}. If it "
        "has states, mjrec.render_states can draw them."
    )


def warn_of_other_frames(name: str, facts: Mapping[str, Any]) -> None:
    """Warn if a recording's environment showed more than its scene."""
    reason = video_facts(facts).get("reason")
    if reason:
        logger.warning(
            "%s was recorded live, because %s. Only the scene is drawn here.",
            name,
            reason,
        )


def chosen_frames(
    count: int, facts: Mapping[str, Any], max_fps: float | Fraction | None
) -> ChosenFrames:
    """Select recorded frames so that their rate does not exceed `max_fps`.

    The selection consists of frames 0, n, 2n ... with the smallest n that fits, and the
    last frame.

    Args:
        count: number of recorded frames.
        facts: the recording's checked facts.
        max_fps: maximum frames per second of simulated time. None selects all.

    Raises:
        InvalidArgument: `max_fps` is not a valid rate, or the recording's own rate is
            unknown.
    """
    every = 1
    if max_fps is not None:
        wanted, recorded = to_rate(max_fps), recorded_rate(facts)
        if recorded is not None:
            every = stride_for(recorded, wanted)
        # A single frame, from an episode that ended before its second step, needs no
        # rate.
        elif count > 1:
            raise InvalidArgument(
                "max_fps requires the number of control steps per second, but this "
                "recording ended before it was known. Omit max_fps."
            )
    last = [count - 1] if count else []
    return ChosenFrames([*range(0, count - 1, every), *last], every)


def recorded_rate(facts: Mapping[str, Any]) -> Fraction | None:
    """Return the recorded frames per second of simulated time; None if unknown."""
    if facts.get("rate") is None:
        return None
    return Fraction(facts["rate"]) / int(facts.get("stride", 1))


def captions(reader: TrajectoryReader, indices: Sequence[int]) -> Iterator[Caption]:
    """Return the captions of some frames of a trajectory, in the order of `indices`.

    The return is the sum of the rewards up to the frame's step. The time is the
    simulated time since the reset. Without recorded states, the time is computed from
    the steps; if their duration is unknown, it is None. A clip's part may begin in
    mid-episode; its facts contain the earlier time and rewards.

    Raises:
        UnreadableFile: the file is damaged. The call raises this, not the iterator.
    """
    facts = reader.facts
    episode_id, before = int(facts.get("episode_id") or 0), facts.get("clip") or {}
    steps = reader.frame_steps[list(indices)]
    # Add the rewards one by one, as the monitor does, so that rounding is the same.
    first = float(before.get("reward_before", 0.0))
    sums = np.cumsum(np.concatenate([[first], reader.rewards]))
    rewards = sums[np.minimum(steps, len(sums) - 1)]
    times = _times(reader, steps, before.get("reset_time"))
    steps = steps + before.get("steps_before", 0)

    def caption(number: int) -> Caption:
        return Caption(
            episode_id=episode_id,
            step=int(steps[number]),
            time=None if times is None else float(times[number]),
            reward=float(rewards[number]),
        )

    return map(caption, range(len(steps)))


def _times(
    reader: TrajectoryReader, steps: NDArray[np.int64], reset_time: float | None
) -> Sequence[float] | None:
    clock = _clock(reader)
    if clock is not None and len(clock) > max(steps, default=0):
        began = clock[0] if reset_time is None else reset_time
        elapsed: list[float] = (clock[steps] - began).tolist()
        return elapsed
    timestep = reader.facts.get("timestep")
    if timestep is None:
        return None
    return [float(step * Fraction(timestep)) for step in steps.tolist()]


def _clock(reader: TrajectoryReader) -> NDArray[np.float64] | None:
    """Return the simulated time of each state; None if there are no states."""
    clock = reader.columns.get("time")
    if clock is None or not reader.row_count:
        return None
    rows = max(1, _BLOCK_BYTES // reader.dtype["state"].itemsize)
    blocks = [
        # Copy the times, so that the states themselves can be freed.
        reader.states(start, min(start + rows, reader.row_count))[:, clock.start].copy()
        for start in range(0, reader.row_count, rows)
    ]
    return np.concatenate(blocks)


def asked_rate(value: Any) -> Fraction:
    """Return a rate that a user requested, from its text in a recording.

    Raises:
        ValueError: the text is not a valid rate.
    """
    if not _ASKED_RATE.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is not a valid rate")
    try:
        return to_rate(Fraction(value))
    except InvalidArgument as error:
        raise ValueError(str(error)) from error


def _count(value: Any) -> int:
    if isinstance(value, float) or integer(value) < 0:
        raise ValueError(f"{value!r:.80} is not a number of steps")
    return int(value)


def _stride(value: Any) -> int:
    if _count(value) < 1:
        raise ValueError("it must be at least 1")
    return int(value)


def _cameras(value: Any) -> tuple[PlainCamera | None, ...]:
    cameras = list_of(optional(plain_camera))(value)
    if not cameras or None in cameras[1:]:
        raise ValueError("only the first camera can be the environment's own view")
    return cameras


def _second_name(value: Any) -> str:
    if not is_second_name(text(value)):
        raise ValueError(f"{value!r:.80} is not a valid second name of a video")
    return str(value)


def _object_of(**checks: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def check(value: Any) -> Mapping[str, Any]:
        _check_all(mapping(value), checks)
        return mapping(value)

    return optional(check)


def _check_all(
    facts: Mapping[str, Any], checks: Mapping[str, Callable[[Any], Any]]
) -> None:
    for key, check in checks.items():
        field(facts, key, check, default=None)


_FACTS: Mapping[str, Callable[[Any], Any]] = {
    "rate": optional(rate),
    "timestep": optional(rate),
    "stride": _stride,
    "kept": boolean,
    "candidate": boolean,
    "refusal": optional(text),
    "broken_reason": optional(text),
    "reason": optional(text),
    "scene": optional(mapping),
    "exception": optional(mapping),
    "model": _object_of(mjb=optional(base_name), xml=optional(base_name)),
    "video": _object_of(
        # `video_path` checks that the video belongs to the recording's episode.
        name=text,
        quality=one_of(*QUALITIES),
        recording=one_of("deferred", "live"),
        reason=optional(text),
        selection=optional(mapping),
        fps=optional(asked_rate),
        max_fps=optional(asked_rate),
        cameras=optional(_cameras),
        tiled=boolean,
        annotate=boolean,
        also_named=optional(_second_name),
    ),
    "clip": _object_of(
        first_step=_count,
        part=_count,
        steps_before=_count,
        reward_before=number,
        reset_time=optional(number),
    ),
}
