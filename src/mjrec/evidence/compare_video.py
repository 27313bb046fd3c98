# SPDX-License-Identifier: Apache-2.0
"""Comparison of two videos: the mp4 boxes, the times, the shape, and each frame.

The same frames, settings and ffmpeg produce the same bytes. If the bytes differ,
everything that affects players must still be equal, and each frame is decoded and
compared.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import imageio.v3
import numpy as np

from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular, read_regular
from .compare_json import Rules, lines_of
from .differences import Aspect, Difference, Same, differs
from .findings import Topic
from .frame_similarity import (
    OTHER_CPU,
    OTHER_ENCODER,
    Planes,
    Similarity,
    but_for_shadows,
    planes_of,
    similarity,
)
from .mp4_videos import Box, decoded_video, odd_contents, read_boxes, shown_times

# Boxes that a different encoder, or different frames, may change.
_ENCODED: Final = frozenset(
    ("mdat", "avcC", "btrt", "stsz", "stsc", "stco", "co64", "stss", "ctts", "elst")
)
_MEANINGS: Final = {
    "mvhd": "how long it is and how fast it plays",
    "mdhd": "how long it is",
    "tkhd": "how long it is shown, how large, and how it is turned",
    "avc1": "the size and the shape of its pixels",
    "stts": "when its frames are shown",
    "udta": "its title and other texts",
}
# Present only if frames are stored out of order or are not all key frames.
_OPTIONAL: Final = frozenset(("ctts", "stss"))
_LONGEST_HASHES: Final = 1 << 28
_HASH_BEGINS: Final = re.compile(rb"0, +\d+, +\d+, +1, +\d+, ")
_EQUAL: Final = Similarity(100.0, 1.0, 0.0)
_differs = functools.partial(differs, Topic.VIDEOS, unit="video")


def compare_videos(
    given: Path,
    made: Path,
    rules: Rules,
) -> Iterator[Same | Difference]:
    """Compare two videos whose bytes differ.

    Args:
        given: the archive's video.
        made: the recreated video.
        rules: receives the SHA-256 of all planes of the archive's video.

    Raises:
        UnreadableFile, EncoderError: a video is damaged.
    """
    boxes, again = read_boxes(given), read_boxes(made)
    found = list(_compare_boxes(boxes, again))
    with unreadable(given):
        times = [shown_times(each) for each in (boxes, again)]
    if times[0] != times[1]:
        shown = [
            each if isinstance(each, str) else f"{each[0]} frames of {each[1]} s"
            for each in times
        ]
        found.append(_differs("times", *shown))
    yield from found
    yield Difference(
        Topic.FILES,
        unit="encoding",
        aspect=Aspect.ENCODED,
        how="it was encoded differently",
    )
    frames = [*_compare_frames(given, made, rules)]
    frames += [_differs(*each) for each in odd_contents(given, made)]
    yield from frames
    if not found and not any(each.topic is Topic.VIDEOS for each in frames):
        yield Same(Topic.VIDEOS, unit="video")


def _compare_boxes(given: Sequence[Box], made: Sequence[Box]) -> Iterator[Difference]:
    kept = [[b for b in boxes if b.name not in _OPTIONAL] for boxes in (given, made)]
    paths = [[box.path for box in boxes] for boxes in kept]
    if paths[0] != paths[1]:
        counts = [Counter(each) for each in paths]
        more = [one - other for one, other in (counts, counts[::-1])]
        yield _differs("boxes", *(", ".join(each) or "no other" for each in more))
        return
    for one, other in zip(*kept, strict=True):
        if one.name not in _ENCODED and one.content != other.content:
            means = _MEANINGS.get(one.name, "more")
            how = f"the bytes that say {means} differ"
            yield Difference(Topic.VIDEOS, unit="video", where=one.path, how=how)


def _compare_frames(
    given: Path, made: Path, rules: Rules
) -> Iterator[Same | Difference]:
    worst, digest = Worst(), hashlib.sha256()
    with decoded_video(given) as (header, one), decoded_video(made) as (again, other):
        if header != again:
            yield _differs("size, rate and shape of pixels", header, again)
            return
        for number, (a, b) in enumerate(itertools.zip_longest(one, other)):
            if a is None or b is None:
                which = ["no frame" if each is None else "a frame" for each in (a, b)]
                yield _differs(f"frame {number}", *which)
                return
            for plane in a:
                digest.update(np.ascontiguousarray(plane).data)
            worst.add(number, a, b)
    rules.decoded[given] = digest.hexdigest()
    yield from worst.differences()


def compare_sampled(
    video: Path, hashes: Path, drawn: Path
) -> Iterator[Same | Difference]:
    """Compare some rerendered frames with a video and the hashes of its frames.

    Args:
        video: the archive's video.
        hashes: its `.framehash` file.
        drawn: the folder with the rendered frames, `<number>.png`.

    Raises:
        UnreadableFile, EncoderError: the video or the file of hashes is damaged.
    """
    with unreadable(hashes):
        lines = read_regular(hashes, limit=_LONGEST_HASHES).splitlines()
    recorded = [line.rpartition(b", ")[2] for line in lines if line[:1].isdigit()]
    wanted = {int(path.stem): path for path in drawn.glob("*.png")}
    # The encoder is lossy. Its limits apply on any machine.
    worst, shipped, equal = Worst(), Worst(), 0
    with decoded_video(video) as (_, decoded):
        for number, planes in enumerate(decoded):
            path = wanted.pop(number, None)
            if path is None:
                continue
            frame = np.ascontiguousarray(imageio.v3.imread(path)[..., :3])
            expected = planes_of(frame)
            if expected.luma.shape != planes.luma.shape:
                sizes = [f"{p.luma.shape[::-1]} pixels" for p in (planes, expected)]
                yield _differs(f"frame {number}", *sizes)
                return
            is_equal = number < len(recorded) and (
                recorded[number] == hashlib.sha256(frame.data).hexdigest().encode()
            )
            equal += is_equal
            (shipped if is_equal else worst).add(number, planes, expected)
    if wanted:
        yield _differs(f"frame {min(wanted)}", "no such frame", "a frame")
    if shipped.strain > 1:
        for difference in shipped.differences():
            yield replace(difference, topic=Topic.VIDEOS, aspect=Aspect.EXACT)
    yield from worst.differences()
    if equal:
        yield Same(Topic.PICTURES, count=equal, unit="frame")


def compare_frame_hashes(
    given: Path, made: Path, _: object
) -> Iterator[Same | Difference]:
    """Compare two videos' frame hashes; yield differences and equal frames."""
    differing, equal, first = 0, 0, ""
    with unreadable(given), open_regular(given) as one, open_regular(made) as other:
        pairs = itertools.zip_longest(lines_of(one), lines_of(other))
        for number, (a, b) in enumerate(pairs, start=1):
            begins = [_HASH_BEGINS.match(line or b"") for line in (a, b)]
            if a == b:
                equal += begins[0] is not None
            elif not begins[0] or not begins[1] or begins[0][0] != begins[1][0]:
                yield _differs(f"line {number}", *map(_text, (a, b)))
            else:
                differing += 1
                first = first or _text(a).split(",")[1].strip()
    if differing:
        yield Difference(
            Topic.PICTURES,
            count=differing,
            unit="frame hash",
            aspect=Aspect.HASH,
            where=f"frame {first}",
            how="its hash differs",
        )
    if equal:
        yield Same(Topic.PICTURES, count=equal, unit="frame")


class Worst:
    """Compares pairs of frames and keeps the largest differences."""

    def __init__(self) -> None:
        self._plain, self._lit = _EQUAL, _EQUAL
        self._shadow = self._patch = 0.0
        self._differing, self._worst = 0, 0
        self.strain = 0.0

    def add(self, number: int, one: Planes, other: Planes) -> None:
        """Compare two frames."""
        pairs = zip(one, other, strict=True)
        if all(np.array_equal(a, b) for a, b in pairs):
            return
        self._differing += 1
        found = similarity(one, other)
        lit = found
        if OTHER_CPU.strain(found) > 1:
            but, share, patch = but_for_shadows(one, other)
            self._shadow = max(self._shadow, share)
            self._patch = max(self._patch, patch)
            lit = similarity(one, but)
        self._plain, self._lit = _lower(self._plain, found), _lower(self._lit, lit)
        if (strain := OTHER_ENCODER.strain(found)) > self.strain:
            self.strain, self._worst = strain, number

    def differences(self) -> Iterator[Difference]:
        """Yield one difference for all frames; nothing if all are equal."""
        if not self._differing:
            return
        plain, lit = self._plain, self._lit
        yield Difference(
            Topic.PICTURES,
            count=self._differing,
            unit="frame",
            aspect=Aspect.PICTURE,
            where=f"frame {self._worst}",
            how=f"{plain.psnr:.1f} dB from the recreated one, "
            f"{plain.block:.0f} levels in the worst block",
            figures={
                **plain._asdict(),
                **{f"{name}_lit": value for name, value in lit._asdict().items()},
                "shadow": self._shadow,
                "patch": self._patch,
                "worst_frame": self._worst,
            },
        )


def _lower(one: Similarity, other: Similarity) -> Similarity:
    return Similarity(
        min(one.psnr, other.psnr),
        min(one.ssim, other.ssim),
        max(one.block, other.block),
    )


def _text(line: bytes | None) -> str:
    return "nothing" if line is None else line.decode(errors="replace").rstrip("\n")
