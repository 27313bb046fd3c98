# SPDX-License-Identifier: Apache-2.0
"""ffmpeg's encoding settings: codec, quality, colors and container.

The same frames produce the same file on any CPU with any number of cores: the number of
threads is fixed, x264 uses only algorithms that give the same result on every CPU
(`cpu-independent=1`), and colors are converted with exact rounding.
"""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from ..errors import InvalidArgument, UnknownName
from .ffmpeg import (
    every_frame_arguments,
    ffmpeg_executable,
    ffmpeg_version,
    remembered,
    run_ffmpeg,
    video_encoders,
)

_DEFAULT_CODEC = "libx264"
_WORST_CRF = 51.0
# x264's output depends on its number of threads, so this is a constant that does not
# depend on the machine.
_ENCODER_THREADS = 4

# Container formats, keyed by file suffix.
MUXERS = {
    ".mp4": "mp4",
    ".mov": "mov",
    ".mkv": "matroska",
    ".webm": "webm",
    ".avi": "avi",
}
_STANDARD_OUTPUT = "pipe:1"
_TRIAL_SIDE = 64

# Pixel formats that store rgb24 losslessly.
_RGB_FORMATS = ("rgb24", "bgr24", "gbrp", "bgr0", "rgb0")
_LOSSLESS_CODECS = frozenset(
    {"ffv1", "libx264rgb", "utvideo", "png", "apng", "qtrle", "ffvhuff", "huffyuv"}
)
# Arguments for codecs whose default quality in ffmpeg is poor or unexpected.
_QUALITY = {
    _DEFAULT_CODEC: ("-crf", "18"),
    "libx264rgb": ("-crf", "0"),
    "mpeg4": ("-q:v", "2"),
}

# Exact rounding and chroma averaging: without `bitexact` and `accurate_rnd`, swscale's
# result depends on the CPU.
_SCALE_FLAGS = "area+accurate_rnd+full_chroma_int+full_chroma_inp+bitexact"
# The filter also tags the frames: ffmpeg 8 and later prefer the frames' tags to the
# encoder's `-color_primaries` and `-color_trc`, and would write "unknown".
_TO_BT709 = (
    f"scale=out_color_matrix=bt709:out_range=limited:flags={_SCALE_FLAGS},"
    "format=yuv420p,setparams=range=limited:color_primaries=bt709:color_trc=bt709:"
    "colorspace=bt709"
)
_BT709_TAGS = (
    *("-color_primaries", "bt709"),
    *("-color_trc", "bt709"),
    *("-colorspace", "bt709"),
    *("-color_range", "tv"),
)


@dataclass(frozen=True)
class EncoderSettings:
    """Encoder settings that apply to any frame size and rate.

    Attributes:
        codec: ffmpeg's name for the encoder.
        pixel_format: pixel format of the encoded video: yuv420p, or a format that
            stores rgb24 losslessly.
        muxer: ffmpeg's name for the container.
        encoding: the arguments between the input and the container.
    """

    codec: str
    pixel_format: str
    muxer: str
    encoding: tuple[str, ...]

    def arguments(
        self, *, height: int, width: int, fps: Fraction, output: str
    ) -> list[str]:
        """Return ffmpeg's arguments for encoding rgb24 frames from standard input."""
        index = "+faststart"
        if output == _STANDARD_OUTPUT:
            # The beginning of a file cannot be rewritten through a pipe.
            index = "+frag_keyframe+empty_moov"
        return [
            *("-hide_banner", "-loglevel", "error", "-nostdin", "-y"),
            *("-f", "rawvideo", "-pixel_format", "rgb24"),
            *("-video_size", f"{width}x{height}"),
            # With `-framerate`, ffmpeg would write a nearby common rate to the file:
            # for some rates always, and for 125 if there are 3 to 9 frames.
            *("-r", f"{fps.numerator}/{fps.denominator}"),
            *("-i", "pipe:0"),
            *self.encoding,
            *(("-movflags", index) if self.muxer in ("mp4", "mov") else ()),
            *("-f", self.muxer, output),
        ]


def encoder_settings(
    *,
    codec: str | None,
    crf: float | None,
    muxer: str,
    encoder_arguments: Sequence[str] = (),
) -> EncoderSettings:
    """Return the settings for `VideoWriter`'s arguments.

    Raises:
        InvalidArgument: an argument is invalid.
        UnknownName: ffmpeg has no such encoder.
    """
    codec = _DEFAULT_CODEC if codec is None else codec
    if not isinstance(codec, str):
        raise InvalidArgument(
            f"codec must be ffmpeg's name for an encoder, not {codec!r}."
        )
    if isinstance(encoder_arguments, str) or not all(
        isinstance(each, str) for each in encoder_arguments
    ):
        raise InvalidArgument(
            "encoder_arguments must be a sequence of strings, not "
            f"{encoder_arguments!r}."
        )
    help_text = _encoder_help(codec)
    quality = _quality_arguments(codec, crf, help_text)
    pixel_format = _pixel_format(codec, help_text)
    yuv = pixel_format == "yuv420p"
    encoding = (
        *("-an", "-map_metadata", "-1"),
        *(("-vf", _TO_BT709) if yuv else ("-pix_fmt", pixel_format)),
        *every_frame_arguments(),
        *("-c:v", codec),
        *_x264_arguments(codec, crf),
        *quality,
        *("-threads", str(_ENCODER_THREADS)),
        *("-fflags", "+bitexact", "-flags:v", "+bitexact"),
        *(_BT709_TAGS if yuv else ()),
        *encoder_arguments,
    )
    return EncoderSettings(codec, pixel_format, muxer, encoding)


def check_encoding(settings: EncoderSettings, fps: Fraction) -> None:
    """Try an encoding, so that invalid settings fail before any work is done.

    Each encoding is tried only once per ffmpeg binary.

    Raises:
        EncoderError: ffmpeg cannot encode with these settings.
    """
    question = " ".join(_trial_arguments(settings, fps))
    remembered(question, lambda: try_encoding(settings, fps))


def try_encoding(settings: EncoderSettings, fps: Fraction) -> str:
    """Encode one small gray frame, and return a note that this worked.

    Raises:
        EncoderError: ffmpeg cannot encode with these settings.
    """
    run_ffmpeg(
        _trial_arguments(settings, fps),
        standard_input=bytes([128]) * (_TRIAL_SIDE * _TRIAL_SIDE * 3),
        what=f"ffmpeg cannot encode {fps} frames per second with {settings.codec} "
        f"into a {settings.muxer} file: choose another codec, rate or file type.",
    )
    return "it works"


def _trial_arguments(settings: EncoderSettings, fps: Fraction) -> list[str]:
    return settings.arguments(
        height=_TRIAL_SIDE, width=_TRIAL_SIDE, fps=fps, output=_STANDARD_OUTPUT
    )


def _x264_arguments(codec: str, crf: float | None) -> tuple[str, ...]:
    if codec not in ("libx264", "libx264rgb"):
        return ()
    # x264 treats any crf that truncates to 0 as lossless, which profile High does not
    # support.
    high = codec == "libx264" and (crf is None or crf >= 1)
    return (
        *("-preset", "veryfast"),
        *(("-profile:v", "high") if high else ()),
        *("-x264-params", "cpu-independent=1"),
    )


def _quality_arguments(
    codec: str, crf: float | None, help_text: str
) -> tuple[str, ...]:
    if crf is None:
        return _QUALITY.get(codec, ())
    is_number = isinstance(crf, numbers.Real) and not isinstance(crf, bool)
    if not is_number or not 0 <= crf <= _WORST_CRF:
        raise InvalidArgument(
            f"crf must be a number from 0 (largest file) to {_WORST_CRF:g} (worst "
            f"quality), not {crf!r}."
        )
    if " -crf " not in help_text:
        raise InvalidArgument(
            f"The encoder {codec} does not support crf={crf:g} or any other crf: leave "
            "it out, or use codec='libx264'."
        )
    return ("-crf", f"{crf:g}")


def _pixel_format(codec: str, help_text: str) -> str:
    _, _, rest = help_text.partition("Supported pixel formats:")
    supported = rest.partition("\n")[0].split()
    wanted = _RGB_FORMATS if codec in _LOSSLESS_CODECS else ("yuv420p",)
    for pixel_format in wanted:
        if pixel_format in supported:
            return pixel_format
    raise InvalidArgument(
        f"The encoder {codec} must support {' or '.join(wanted)}, but supports only "
        f"{', '.join(supported) or 'unknown formats'}: use codec='libx264', or "
        "codec='ffv1' for a lossless video."
    )


def _encoder_help(codec: str) -> str:
    """Return ffmpeg's help text for an encoder."""
    arguments = ["-hide_banner", "-h", f"encoder={codec}"]
    text = remembered(
        " ".join(arguments),
        lambda: run_ffmpeg(arguments).decode("utf-8", errors="replace"),
    )
    # Given the name of a codec, ffmpeg describes all encoders for that codec.
    if f"Encoder {codec} [" not in text:
        raise UnknownName(
            "video encoder",
            codec,
            video_encoders(),
            hint=f"These are the encoders in {ffmpeg_executable()}, "
            f"{ffmpeg_version()}.",
        )
    return text
