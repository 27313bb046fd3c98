# SPDX-License-Identifier: Apache-2.0
"""The pixels: whether each video shows what its trajectory recorded.

What proves most comes first, and what is left is said:

- the shipped file decodes to the recorded number of frames and to their recorded hash,
  and shows each for the recorded time;
- the pictures drawn from the recorded snapshots are those whose hashes were shipped,
  bit for bit where the same driver draws;
- encoding them again gives the shipped file, byte for byte, where the same ffmpeg does;
- the shipped frames show the pictures drawn, to within what another driver or encoder
  may differ.

Which driver and which encoder were used is only known from the archive itself. Whoever
forges it may name others; then the last of these is what is left, with its limits.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from imageio.v3 import imwrite

from ...annotation import annotated, pillow_version
from ...errors import Error, GLError, MissingDependency, UnreadableFile
from ...formats.json_fields import read_object
from ...formats.monitor_directory import iter_monitor_files
from ...frames import Frame
from ...machine import machine_fingerprint, usable_cpus
from ...provenance import versions
from ...rendering.pool import WorkerPool
from ...simulation.model_trust import trusting_models
from ..verification import Check, Level, Verdict
from .decoded_video import DecodedVideo
from .difference_picture import difference_picture
from .drawing_plan import DoesNotFit, DrawingPlan, NotDrawable, plan_drawing
from .encoded_again import OLD_RATE, EncodedAgain
from .frame_times import UnevenTimes, rate_of_frames
from .likeness import MOST_SHADOW, OTHER_ENCODER, OTHER_RENDERER, Likeness
from .picture_similarity import Planes, but_for_shadows, planes_of, similarity
from .shipped_video import (
    GL_STRINGS,
    ShippedVideo,
    read_frame_hashes,
    read_shipped_video,
)
from .task import Count, Task

_DECODES: Final = "the video decodes to the recorded number of frames and to their hash"
_PACED: Final = "each frame of the video is shown for as long as was recorded"
_DRAWN: Final = "the pictures drawn from the recorded snapshots have the shipped hashes"
_ENCODED: Final = "encoding the drawn pictures again gives the shipped file"
_ALIKE: Final = "the shipped frames show the pictures drawn"
_OF_DRAWING: Final = (_DRAWN, _ENCODED, _ALIKE)

_VIDEO: Final = ".mp4"
_METADATA: Final = ".meta.json"
_TEXT: Final = "video/vnd.openai.ansivid"
_SOFTWARE: Final = ("llvmpipe", "softpipe", "swrast")
_MOST_NAMED: Final = 5
_FRAMES_OF_A_WORKER: Final = 32
# As far from a usual rate as ffmpeg has been seen to round one: 125 to 120.
_NEAR: Final = Fraction(1, 20)


def check_pixels(
    task: Task, count: Count, *, made_again: Collection[str] = ()
) -> Iterator[Check]:
    """Check every video of a monitor directory, one after the other.

    With a sample, so many frames of each video are drawn, all equally likely to be
    among them; the whole video is decoded in any case.

    Args:
        task: what is asked for.
        count: told how many frames are done, and of how many.
        made_again: the sha256 of compiled models that may be loaded, because they were
            made again here.
    """
    paths = sorted(iter_monitor_files(task.recordings))
    metadata = [path for path in paths if path.name.endswith(_METADATA)]
    videos = [path for path in paths if path.suffix == _VIDEO]
    yield from _without_video(metadata, {path.name for path in videos})
    read = [_read(path) for path in videos]
    totals = [_frames_to_draw(video, task) for video in read]
    ends = itertools.accumulate(totals)
    # To start one takes as long as drawing some pictures.
    most = max(1, sum(totals) // _FRAMES_OF_A_WORKER)
    with (
        trusting_models(sorted(made_again)),
        WorkerPool(min(most, usable_cpus())) as workers,
    ):
        studio = _Studio(task=task, workers=workers)
        for video, total, end in zip(read, totals, ends, strict=True):
            done = itertools.count(end - total + 1)
            if isinstance(video, Check):
                yield video
                continue
            whole = _check_decodes(video)
            paced = _check_paced(video)
            yield from (whole, paced)
            yield from studio.check(
                video,
                is_whole=whole.verdict is Verdict.PASS,
                is_paced=paced.verdict is not Verdict.NOT_CHECKABLE,
                on_frame=lambda done=done: count(next(done), sum(totals)),
            )
            count(end, sum(totals))


def _read(path: Path) -> ShippedVideo | Check:
    try:
        return read_shipped_video(path)
    except UnreadableFile as error:
        reason = f"what is said of it cannot be read: {error.reason}"
        return _check(_DECODES, path.name, Verdict.FAIL, reason)


def _frames_to_draw(video: ShippedVideo | Check, task: Task) -> int:
    if isinstance(video, Check):
        return 0
    return video.frame_count if task.sample is None else _sampled(video, task)


def _sampled(video: ShippedVideo, task: Task) -> int:
    assert task.sample is not None
    return min(max(1, task.sample), video.frame_count)


def _without_video(metadata: Iterable[Path], videos: set[str]) -> Iterator[Check]:
    """Yield a check for each metadata file that has no mp4."""
    for path in metadata:
        name = path.name.removesuffix(_METADATA) + _VIDEO
        if name in videos:
            continue
        try:
            said = read_object(path)
        except (OSError, ValueError) as error:
            reason = f"what is said of it cannot be read: {error}"
            yield _check(_DECODES, name, Verdict.FAIL, reason)
            continue
        if said.get("content_type") == _TEXT:
            reason = "it is a recording of text, of which there are no pictures"
        elif said.get("broken") or said.get("empty"):
            why = said.get("broken_reason") or "its metadata says that it is empty"
            reason = f"there is no video: {str(why)[:500]}"
        else:
            reason = "its metadata is there, and the video is not"
            yield _check(_DECODES, name, Verdict.FAIL, reason)
            continue
        yield _check(_DECODES, name, Verdict.NOT_CHECKABLE, reason)


def _check_decodes(video: ShippedVideo) -> Check:
    """Check the file itself, which needs nothing else than ffmpeg."""
    if video.pixel_format != "yuv420p":
        reason = f"it is encoded as {video.pixel_format:.80}, and only yuv420p is read"
        return _check(_DECODES, video.name, Verdict.NOT_CHECKABLE, reason)
    try:
        found = _what_is_wrong_inside(video)
    except MissingDependency as error:
        reason = str(error).removesuffix(".")
        return _check(_DECODES, video.name, Verdict.NOT_CHECKABLE, reason)
    except Error as error:
        found = " ".join(str(error).split())
    if found is not None:
        return _check(_DECODES, video.name, Verdict.FAIL, found)
    return _check(
        _DECODES,
        video.name,
        Verdict.PASS,
        f"{_frames(video.frame_count)} of {video.width}x{video.height} pixels",
        frames=video.frame_count,
    )


def _what_is_wrong_inside(video: ShippedVideo) -> str | None:
    digest, number = hashlib.sha256(), 0
    with DecodedVideo(video.path) as decoded:
        if (decoded.height, decoded.width) != video.padded:
            height, width = video.padded
            return (
                f"it is {decoded.width}x{decoded.height} pixels large, and its "
                f"metadata says {width}x{height}"
            )
        for number, planes in enumerate(decoded, 1):
            # Nobody need decode for ever what is too long already.
            if number > video.frame_count:
                return f"it has more frames than the {video.frame_count} recorded"
            for plane in planes:
                digest.update(plane.data)
    if number != video.frame_count:
        return f"it has {_frames(number)}, and its metadata says {video.frame_count}"
    if digest.hexdigest() != video.decoded_sha256:
        return (
            f"its frames have the sha256 {digest.hexdigest()}, and its metadata says "
            f"{video.decoded_sha256}"
        )
    return None


def _check_paced(video: ShippedVideo) -> Check:
    """Check how long the file shows its frames, which no hash of them says."""
    try:
        rate = rate_of_frames(video.path, most=video.frame_count)
    except MissingDependency as error:
        return _check(_PACED, video.name, Verdict.NOT_CHECKABLE, _one_line(error))
    except (UnevenTimes, Error) as error:
        return _check(_PACED, video.name, Verdict.FAIL, _one_line(error))
    if rate == video.fps:
        reason = f"{rate} frames a second"
        return _check(_PACED, video.name, Verdict.PASS, reason)
    reason = f"it has {rate} frames a second, and its metadata says {video.fps}"
    if OLD_RATE in video.encoder_arguments and abs(rate / video.fps - 1) < _NEAR:
        reason += (
            ", which the ffmpeg of an older mjrec took for the usual rate next to it"
        )
        return _check(_PACED, video.name, Verdict.NOT_CHECKABLE, reason)
    return _check(_PACED, video.name, Verdict.FAIL, reason)


@dataclass
class _Found:
    """What drawing a video's pictures again has shown.

    Attributes:
        positions: the numbers of the frames that were drawn.
        wrong: those among them whose hash is another.
        likenesses: of what was shipped, within what another encoder may differ, and
            another renderer.
        unshadowed: the latter, without what is in shadow in one picture only.
        pictures: the drawn and the shipped picture that are most unlike.
        gl: who drew.
        bytes_equal: whether the file encoded again is the shipped one; None where none
            was made.
        refusal: why none was made.
        is_same_ffmpeg: whether it is the ffmpeg that encoded the shipped one.
    """

    positions: Sequence[int]
    wrong: list[int] = field(default_factory=list)
    likenesses: tuple[Likeness, ...] = ()
    unshadowed: Likeness = field(default_factory=lambda: Likeness(OTHER_RENDERER))
    pictures: tuple[Planes, Planes] | None = None
    gl: tuple[str | None, ...] = ()
    bytes_equal: bool | None = None
    refusal: str | None = None
    is_same_ffmpeg: bool = False


class _Studio:
    """Draws videos again.

    Args:
        task: what is asked for.
        workers: who draw.
    """

    def __init__(self, *, task: Task, workers: WorkerPool) -> None:
        self._task = task
        self._workers = workers
        self._pictures = itertools.count()
        # Where nothing can be drawn at all, each video would take as long to find out.
        self._gl_failure: str | None = None

    def check(
        self,
        video: ShippedVideo,
        *,
        is_whole: bool,
        is_paced: bool,
        on_frame: Any,
    ) -> Iterator[Check]:
        """Yield what is found of a video by drawing its pictures again.

        Args:
            video: the shipped one.
            is_whole: whether it decodes as recorded.
            is_paced: False where it plays at another rate for a known reason.
            on_frame: called for each picture that was drawn.
        """
        try:
            plan = plan_drawing(video)
        except NotDrawable as error:
            yield from _all_not_checkable(video, str(error))
            return
        except DoesNotFit as error:
            yield _check(_DRAWN, video.name, Verdict.FAIL, str(error))
            yield from _all_not_checkable(
                video, "its metadata and its trajectory do not fit", of=_OF_DRAWING[1:]
            )
            return
        if self._gl_failure is not None:
            yield from _all_not_checkable(video, self._gl_failure)
            return
        try:
            hashes = read_frame_hashes(video)
        except UnreadableFile as error:
            reason = f"the hashes of its frames cannot be read: {error.reason}"
            yield _check(_DRAWN, video.name, Verdict.FAIL, reason)
            hashes = None
        if hashes is not None and len(hashes) != video.frame_count:
            reason = f"there are hashes of {_frames(len(hashes))}, and the video has "
            reason += str(video.frame_count)
            yield _check(_DRAWN, video.name, Verdict.FAIL, reason)
            hashes = None
        try:
            found = self._draw(
                video,
                plan,
                hashes,
                is_whole=is_whole,
                is_paced=is_paced,
                tell=on_frame,
            )
        except GLError as error:
            self._gl_failure = f"nothing can be drawn here: {_one_line(error)}"
            yield from _all_not_checkable(video, self._gl_failure)
            return
        except Error as error:
            yield from _not_drawn(video, plan, error)
            return
        for check in self._judge(video, plan, found, hashes):
            yield check if plan.excuse is None else _excused(check, plan.excuse)

    def _draw(
        self,
        video: ShippedVideo,
        plan: DrawingPlan,
        hashes: Sequence[str] | None,
        *,
        is_whole: bool,
        is_paced: bool,
        tell: Any,
    ) -> _Found:
        """Draw the pictures, compare them with what was shipped, and encode them."""
        found = _Found(self._positions(video))
        found.likenesses = Likeness(OTHER_ENCODER), Likeness(OTHER_RENDERER)
        with contextlib.ExitStack() as stack:
            shipped = stack.enter_context(_Shipped(video)) if is_whole else None
            again = stack.enter_context(EncodedAgain(video))
            found.refusal, found.is_same_ffmpeg = again.refusal, again.is_same_ffmpeg
            if len(found.positions) < video.frame_count:
                found.refusal = (
                    f"only {len(found.positions)} of {_frames(video.frame_count)} were "
                    "drawn: leave --sample out"
                )
            if not is_paced:
                found.refusal = "it plays at another rate than was recorded"
            for position, frame in self._frames(video, plan, found.positions):
                digest = hashlib.sha256(np.ascontiguousarray(frame).data).hexdigest()
                if hashes is not None and digest != hashes[position]:
                    found.wrong.append(position)
                if shipped is not None:
                    _compare(found, position, frame, shipped.frame(position))
                if found.refusal is None:
                    again.write(frame)
                tell()
            if found.refusal is None:
                found.bytes_equal = again.is_equal()
        strings = self._workers.gl_facts
        found.gl = tuple(strings.get(key) for key in GL_STRINGS)
        return found

    def _positions(self, video: ShippedVideo) -> list[int]:
        """Return the numbers of the frames that are drawn."""
        task, total = self._task, video.frame_count
        if task.sample is None or _sampled(video, task) == total:
            return list(range(total))
        # Another choice for each video, and the same on every machine.
        seed = [task.seed, zlib.crc32(video.name.encode())]
        chosen = np.random.default_rng(seed).choice(
            total, _sampled(video, task), replace=False
        )
        return sorted(int(position) for position in chosen)

    def _frames(
        self, video: ShippedVideo, plan: DrawingPlan, positions: Sequence[int]
    ) -> Iterator[tuple[int, Frame]]:
        indices = [plan.indices[position] for position in positions]
        drawn = self._workers.frames(
            plan.trajectory,
            indices,
            plan.view,
            **({} if plan.cameras is None else {"cameras": plan.cameras}),
        )
        for position, frame in zip(positions, drawn, strict=True):
            if plan.captions is not None:
                frame = annotated(frame, plan.captions[position])
            yield position, frame

    def _judge(
        self,
        video: ShippedVideo,
        plan: DrawingPlan,
        found: _Found,
        hashes: Sequence[str] | None,
    ) -> Iterator[Check]:
        is_exact = hashes is not None and not found.wrong
        other = _other_renderer(video, plan, found)
        if hashes is not None:
            yield _judged_hashes(video, found, other)
        yield _judged_bytes(video, found, is_exact=is_exact, other=other)
        if found.pictures is not None:
            yield self._judged_likeness(video, found, is_exact=is_exact, other=other)

    def _judged_likeness(
        self, video: ShippedVideo, found: _Found, *, is_exact: bool, other: str | None
    ) -> Check:
        strict, loose = found.likenesses
        is_near = is_exact or other is None or _draws_nearly_the_same(video, found)
        likeness = strict if is_near else loose
        is_proved = bool(found.bytes_equal)
        passes = likeness.passes or is_proved
        is_shadow = likeness is loose and not passes and found.unshadowed.passes
        reason = likeness.told()
        if is_proved:
            reason = f"they are the same file; {reason}"
        elif is_shadow:
            reason = (
                f"{reason}; but what differs more is in shadow in one of the two, and "
                "renderers differ in where a large floor casts shadows on itself: "
                "nobody can tell"
            )
        else:
            reason = f"{reason}; {likeness.told_unnoticed()}"
        figures = {**likeness.figures(), **self._keep_picture(found)}
        if is_proved:
            # What was encoded again, byte for byte, leaves room for nothing.
            figures = {k: v for k, v in figures.items() if "unnoticed" not in k}
        otherwise = Verdict.NOT_CHECKABLE if is_shadow else Verdict.FAIL
        verdict = Verdict.PASS if passes else otherwise
        return _check(_ALIKE, video.name, verdict, reason, **figures)

    def _keep_picture(self, found: _Found) -> dict[str, str]:
        """Write the frame that is most unlike; return where, for the report."""
        if self._task.pictures is None or found.pictures is None:
            return {}
        drawn, shipped = found.pictures
        name = f"worst-{next(self._pictures):06d}.png"
        imwrite(self._task.pictures / name, difference_picture(drawn, shipped))
        return {"picture": name}


class _Shipped:
    """The frames of a video that decodes, for who wants some of them, in order."""

    def __init__(self, video: ShippedVideo) -> None:
        self._decoded = DecodedVideo(video.path)
        self._frames = enumerate(self._decoded)

    def frame(self, position: int) -> Planes:
        """Return a frame behind the one that was asked for before."""
        return next(planes for number, planes in self._frames if number == position)

    def __enter__(self) -> _Shipped:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._decoded.close()


def _compare(found: _Found, position: int, drawn: Frame, shipped: Planes) -> None:
    planes = planes_of(drawn)
    alike = similarity(planes, shipped)
    is_worst = [likeness.add(position, alike) for likeness in found.likenesses]
    if is_worst[0]:
        found.pictures = planes, shipped
    if OTHER_RENDERER.strain(alike) > 1:
        unshadowed, share = but_for_shadows(planes, shipped)
        if share <= MOST_SHADOW:
            alike = similarity(planes, unshadowed)
    found.unshadowed.add(position, alike)


def _other_renderer(
    video: ShippedVideo, plan: DrawingPlan, found: _Found
) -> str | None:
    """Return who drew a video and who draws here, where they are not the same."""
    if video.gl != found.gl:
        return f"it was drawn by {_names(video.gl)}, and here draws {_names(found.gl)}"
    if _is_software(found.gl) and not _is_this_cpu(video.machine or plan.machine):
        return (
            f"{_names(found.gl)} draws here too, which draws otherwise on another CPU, "
            "and it was drawn on another one, or nobody says on which"
        )
    if video.pillow is not None and video.pillow != pillow_version():
        return (
            f"Pillow {video.pillow:.40} has written on it, and here writes "
            f"{pillow_version()}"
        )
    return None


def _is_software(gl: Sequence[str | None]) -> bool:
    """Tell whether a CPU draws: Mesa's reciprocals differ between their makers."""
    return any(name in (gl[1] or "") for name in _SOFTWARE)


def _is_this_cpu(machine: Mapping[str, Any] | None) -> bool:
    here = machine_fingerprint()
    return machine is not None and all(
        machine.get(key) == here[key] for key in ("architecture", "cpu_flags")
    )


def _draws_nearly_the_same(video: ShippedVideo, found: _Found) -> bool:
    """Tell whether two renderers differ by no more than roundings.

    So it is where any picture is equal to the last bit, and where the same program
    draws on another CPU.
    """
    are_some_equal = 0 < len(found.wrong) < len(found.positions)
    both = [(gl[1] or "").partition(" ")[0] for gl in (video.gl, found.gl)]
    return are_some_equal or (both[0] == both[1] and both[0] in _SOFTWARE)


def _judged_hashes(video: ShippedVideo, found: _Found, other: str | None) -> Check:
    total, drawn = video.frame_count, len(found.positions)
    extent = _frames(total) if drawn == total else f"{drawn} of {_frames(total)}"
    figures = {"drawn": drawn, "frames": total, "other": len(found.wrong)}
    if not found.wrong:
        reason = f"{extent}, bit for bit"
        return _check(_DRAWN, video.name, Verdict.PASS, reason, **figures)
    named = ", ".join(map(str, found.wrong[:_MOST_NAMED]))
    more = " ..." if len(found.wrong) > _MOST_NAMED else ""
    differ = f"{len(found.wrong)} of {drawn} drawn have other hashes: {named}{more}"
    if other is None:
        reason = f"{differ}; the same driver drew them ({_names(found.gl)})"
        return _check(_DRAWN, video.name, Verdict.FAIL, reason, **figures)
    reason = f"{other}; {differ}; how alike they are is checked instead"
    return _check(_DRAWN, video.name, Verdict.NOT_CHECKABLE, reason, **figures)


def _judged_bytes(
    video: ShippedVideo, found: _Found, *, is_exact: bool, other: str | None
) -> Check:
    if found.bytes_equal:
        reason = f"{_frames(video.frame_count)}, byte for byte"
        return _check(_ENCODED, video.name, Verdict.PASS, reason)
    if found.refusal is not None:
        return _check(_ENCODED, video.name, Verdict.NOT_CHECKABLE, found.refusal)
    if not found.is_same_ffmpeg:
        reason = (
            f"another ffmpeg encoded it (sha256 {video.ffmpeg_sha256}), and this one "
            "makes other bytes; how alike the frames are is checked instead"
        )
        return _check(_ENCODED, video.name, Verdict.NOT_CHECKABLE, reason)
    if not is_exact and other is not None:
        reason = f"{other}, so what is encoded here is something else"
        return _check(_ENCODED, video.name, Verdict.NOT_CHECKABLE, reason)
    reason = (
        "the same ffmpeg makes another file of the drawn pictures: it does not hold "
        "these, or was changed afterwards"
    )
    return _check(_ENCODED, video.name, Verdict.FAIL, reason)


def _excused(check: Check, excuse: str) -> Check:
    """Return what a check says of a live video that may show something else."""
    if check.verdict is not Verdict.FAIL:
        return check
    reason = f"it was drawn live, and {excuse}: {check.reason}"
    return dataclasses.replace(check, verdict=Verdict.NOT_CHECKABLE, reason=reason)


def _not_drawn(video: ShippedVideo, plan: DrawingPlan, error: Error) -> Iterator[Check]:
    """Yield what an error in the midst of drawing means."""
    # What this very version has recorded it also reads, unless it is damaged. That a
    # model is missing, a stranger's or another version's is nobody's fault.
    is_damage = isinstance(error, UnreadableFile) and error.path == plan.trajectory
    if is_damage and plan.mujoco == _mujoco_version():
        yield _check(_DRAWN, video.name, Verdict.FAIL, _one_line(error))
        yield from _all_not_checkable(
            video, "its trajectory is damaged", of=_OF_DRAWING[1:]
        )
        return
    yield from _all_not_checkable(video, _one_line(error))


def _mujoco_version() -> str | None:
    return versions().get("mujoco")


def _all_not_checkable(
    video: ShippedVideo, reason: str, *, of: Sequence[str] = _OF_DRAWING
) -> Iterator[Check]:
    for claim in of:
        yield _check(claim, video.name, Verdict.NOT_CHECKABLE, reason)


def _check(
    claim: str, subject: str, verdict: Verdict, reason: str, **figures: Any
) -> Check:
    return Check(
        level=Level.PIXELS,
        claim=claim,
        subject=subject,
        verdict=verdict,
        reason=reason,
        figures=figures,
    )


def _names(gl: Sequence[str | None]) -> str:
    # The vendor's and the version's names alone say little to anybody.
    named = [name[:80] for name in gl[1:] if name]
    return ", ".join(named) or "nobody knows what"


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()).removesuffix(".")
