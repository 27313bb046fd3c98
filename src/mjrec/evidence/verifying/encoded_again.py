# SPDX-License-Identifier: Apache-2.0
"""Encoding the pictures of a video once more, to see whether it is the same file.

The same pictures, settings and ffmpeg give the same bytes: so a video in which anything
was changed is found, whatever else was made to fit. What the archive says about the
encoder's command line is compared with ours, and never run.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from ...errors import UnreadableFile
from ...formats.ffmpeg import ffmpeg_sha256
from ...formats.regular_files import open_regular
from ...formats.video_writer import VideoWriter
from ...frames import Frame
from .shipped_video import ShippedVideo

OLD_RATE: Final = "-framerate"

_READ_SIZE: Final = 1 << 20


class EncodedAgain:
    """A second encoding of a video, in a temporary directory; used in a `with` block.

    Args:
        video: the shipped one.

    Attributes:
        refusal: why it cannot be; None where it can.
        is_same_ffmpeg: whether the shipped one was encoded by this very ffmpeg, as its
            metadata says.
    """

    def __init__(self, video: ShippedVideo) -> None:
        self._video = video
        self.is_same_ffmpeg = video.ffmpeg_sha256 == ffmpeg_sha256()
        self._directory = tempfile.TemporaryDirectory(prefix="mjrec-verify-")
        try:
            path = Path(self._directory.name) / "again.mp4"
            self._writer = VideoWriter(path, fps=video.fps)
        except BaseException:
            self._directory.cleanup()
            raise
        self.refusal = self._refusal()

    def write(self, frame: Frame) -> None:
        """Encode a picture.

        Raises:
            Error: as `VideoWriter.write`.
        """
        self._writer.write(frame)

    def is_equal(self) -> bool:
        """Finish the file, and tell whether it is the shipped one, byte for byte.

        Raises:
            UnreadableFile: the shipped one cannot be read.
            Error: as `VideoWriter.close`.
        """
        self._writer.close()
        try:
            with (
                open_regular(self._video.path) as shipped,
                self._writer.path.open("rb") as again,
            ):
                while True:
                    one, other = shipped.read(_READ_SIZE), again.read(_READ_SIZE)
                    if one != other:
                        return False
                    if not one:
                        return True
        except (OSError, ValueError) as error:
            raise UnreadableFile(self._video.path, error) from error

    def close(self) -> None:
        """Leave nothing behind. Idempotent."""
        self._writer.abort()
        self._directory.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _refusal(self) -> str | None:
        video = self._video
        # But for the name of the file.
        file = self._writer.file_of(video.height, video.width)
        ours = file.encoder["arguments"][:-1]
        theirs = list(video.encoder_arguments)[:-1]
        # An older mjrec said `-framerate`, which gives the same file wherever its
        # frames then last as long as recorded; else that is told already.
        if ours in (theirs, ["-r" if each == OLD_RATE else each for each in theirs]):
            return None
        odd = [argument for argument in theirs if argument not in ours]
        missing = [argument for argument in ours if argument not in theirs]
        return (
            "it was encoded with other arguments than this version of mjrec uses "
            f"(theirs alone: {' '.join(odd)[:200] or 'none'}; ours alone: "
            f"{' '.join(missing)[:200] or 'none'}), and a command line out of an "
            "archive is not run; verify it with the version of mjrec that recorded it"
        )
