# SPDX-License-Identifier: Apache-2.0
"""What is said of a video that is there: its metadata, and the hashes of its frames.

Both may be anybody's. What is relied on is checked here, once.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from ...errors import InvalidArgument
from ...formats.frame_hashes import frame_hash_header, frame_hash_path
from ...formats.json_fields import (
    field,
    integer,
    list_of,
    mapping,
    one_of,
    optional,
    positive,
    rate,
    read_object,
    text,
    unreadable,
)
from ...formats.regular_files import read_regular
from ...formats.video_metadata import metadata_path
from ...frames import QUALITIES, check_size
from ...rendering.views import PlainCamera, plain_camera

GL_STRINGS: Final = ("gl_vendor", "gl_renderer", "gl_version")

_MOST_FRAMES: Final = 10**8
# Of a header, and of one frame of any size.
_LONGEST_LINE: Final = 200
_HEADER_LINES: Final = 16
_SHA256: Final = re.compile(r"[0-9a-f]{64}", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class ShippedVideo:
    """A video, as its metadata describes it.

    Attributes:
        path: the mp4.
        height: of a frame as it was drawn, in pixels.
        width: likewise.
        fps: frames per second.
        frame_count: how many frames there are.
        frame_steps: the step of every frame, as runs.
        stride: the usual number of steps from one frame to the next.
        decoded_sha256: of all decoded planes.
        pixel_format: ffmpeg's name.
        is_live: whether it was drawn while the episode ran.
        live_reason: why; None where nobody says.
        cut_short: why it ended before its episode; None where nobody says that it did.
        camera: which one is said to have seen it, or None.
        first_camera: the same, or the first where several are in one picture.
        is_clip: whether it is one of those that are counted in steps.
        quality: how well it was drawn.
        pillow: the version that wrote on the frames; None where nothing is on them.
        ffmpeg_sha256: of the binary that encoded it; None where nobody knows.
        encoder_arguments: what that was told, after the program's name.
        gl: who drew it: vendor, renderer and version; None for what nobody says.
        machine: the fingerprint of the machine that drew it; None where nobody says.
        is_smaller: whether it was made smaller when it was packed.
    """

    path: Path
    height: int
    width: int
    fps: Fraction
    frame_count: int
    frame_steps: Sequence[Sequence[int]]
    stride: int
    decoded_sha256: str
    pixel_format: str
    is_live: bool
    live_reason: str | None
    cut_short: str | None
    camera: PlainCamera | None
    first_camera: PlainCamera | None
    is_clip: bool
    quality: str
    pillow: str | None
    ffmpeg_sha256: str | None
    encoder_arguments: Sequence[str]
    gl: tuple[str | None, ...]
    machine: Mapping[str, Any] | None
    is_smaller: bool

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    @property
    def padded(self) -> tuple[int, int]:
        """Height and width of the file's frames."""
        return self.height + self.height % 2, self.width + self.width % 2


def read_shipped_video(path: Path) -> ShippedVideo:
    """Read what a video's metadata says.

    Raises:
        UnreadableFile: it is missing or damaged, or says what cannot be.
    """
    metadata = metadata_path(path)
    with unreadable(metadata):
        said = read_object(metadata)
        height, width = (field(said, key, integer) for key in ("height", "width"))
        try:
            check_size(height, width)
        except InvalidArgument as error:
            raise ValueError(str(error)) from error
        encoder = field(said, "encoder_version", mapping)
        return ShippedVideo(
            path=path,
            height=height,
            width=width,
            fps=field(said, "fps", rate),
            frame_count=field(said, "frame_count", _frame_count),
            frame_steps=field(said, "frame_steps", list_of(list_of(integer))),
            stride=field(said, "stride", positive, default=1),
            decoded_sha256=field(said, "decoded_sha256", _sha256),
            pixel_format=field(said, "pixel_format", text),
            is_live=field(said, "recording", text, default="live") != "deferred",
            live_reason=field(said, "recording_reason", optional(text), default=None),
            cut_short=_cut_short(said),
            camera=_camera(said.get("camera")),
            first_camera=_camera(_first(said.get("camera"))),
            is_clip="first_step" in said,
            quality=field(said, "quality", one_of(*QUALITIES), default="full"),
            pillow=_pillow(field(said, "annotated", optional(mapping), default=None)),
            ffmpeg_sha256=field(said, "ffmpeg_sha256", optional(_sha256), default=None),
            encoder_arguments=field(encoder, "cmdline", list_of(text))[1:],
            gl=tuple(field(said, k, optional(text), default=None) for k in GL_STRINGS),
            machine=field(said, "machine", optional(mapping), default=None),
            is_smaller="packed_smaller" in said,
        )


def read_frame_hashes(video: ShippedVideo) -> list[str]:
    """Return the sha256 of each frame of a video, as its `.framehash` file has them.

    The file is held to the last character: what ffmpeg's tools would read in it is what
    is read here.

    Raises:
        UnreadableFile: it is missing or damaged, or of frames of another size or rate.
    """
    path = frame_hash_path(video.path)
    header = frame_hash_header(height=video.height, width=video.width, fps=video.fps)
    with unreadable(path):
        limit = _LONGEST_LINE * (_HEADER_LINES + video.frame_count)
        content = read_regular(path, limit=limit).decode("ascii")
        if not content.startswith(header):
            raise ValueError(
                f"its head is not that of {video.width}x{video.height} frames at "
                f"{video.fps} a second"
            )
        lines = content.removeprefix(header).splitlines(keepends=True)
        size = 3 * video.height * video.width
        return [_hash(line, number, size) for number, line in enumerate(lines)]


def _hash(line: str, number: int, size: int) -> str:
    begin = f"0, {number:10d}, {number:10d}, {1:8d}, {size:8d}, "
    digest = line.removeprefix(begin).removesuffix("\n")
    if not _SHA256.fullmatch(digest) or line != f"{begin}{digest}\n":
        raise ValueError(f"the line of frame {number} is {line!r:.120}")
    return digest


def _frame_count(value: Any) -> int:
    count = integer(value)
    if not 1 <= count <= _MOST_FRAMES:
        raise ValueError(f"{count!r:.80} is no number of frames")
    return count


def _sha256(value: Any) -> str:
    if not _SHA256.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is no sha256")
    return str(value)


def _cut_short(said: Mapping[str, Any]) -> str | None:
    broken = field(said, "broken_reason", optional(text), default=None)
    if said.get("complete") is False:
        return broken or field(said, "reason", optional(text), default=None)
    return broken


def _camera(value: Any) -> PlainCamera | None:
    """Return a camera, or None for what is none: nothing, or several."""
    try:
        return None if value is None else plain_camera(value)
    except InvalidArgument:
        return None


def _first(cameras: Any) -> Any:
    return cameras[0] if isinstance(cameras, list) and cameras else cameras


def _pillow(annotated: Mapping[str, Any] | None) -> str | None:
    return None if annotated is None else field(annotated, "pillow", text, default="")
