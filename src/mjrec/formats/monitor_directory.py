# SPDX-License-Identifier: Apache-2.0
"""The names of the files in a monitor directory.

::

    directory/
    ├── openaigym.manifest.<infix>.manifest.json        the index, written last
    ├── openaigym.episode_batch.<infix>.stats.json      gym's statistics
    ├── openaigym.episodes.<infix>.jsonl                journal, one line per episode
    ├── openaigym.video.<infix>.video000027.mp4         a video ...
    ├── openaigym.video.<infix>.video000027.meta.json   ... its metadata
    ├── openaigym.video.<infix>.video000027.framehash   ... the hashes of its frames
    ├── openaigym.video.<infix>.video000027.failed.json ... why it is still pending
    ├── openaigym.clip.<infix>.step000000137.failed.json    why a clip is still pending
    ├── openaigym.video.<infix>.video000027.json        a text recording (asciicast)
    ├── openaigym.video.<infix>.video000027.side.mp4    video of an additional camera
    ├── openaigym.video.<infix>.video000027.camera2.mp4 ... of a camera without a name
    ├── openaigym.video.<infix>.video000027.tiled.mp4   all sub-environments in one
    ├── openaigym.video.<infix>.video000027.side.640x480.mp4 a rerendered video
    ├── openaigym.video.<infix>.video000027.step000137.mp4 video of a clip
    ├── rl-video-episode-27.mp4                         second name of the first ...
    ├── rl-video-episode-27.side.mp4                    ... and of another one
    ├── openaigym.states.<infix>.000000.log             rows of recordings in flight
    ├── openaigym.states.<infix>.000000.tail            ... the last of these rows
    ├── openaigym.states.<infix>.000000.looks           ... changes to the model
    ├── openaigym.trajectory.<infix>.episode000027.h5   a recorded episode, finished
    ├── openaigym.trajectories.<infix>.h5               ... or many in one file
    ├── openaigym.model.<16 hex digits>.mjb.gz          a compiled model ...
    ├── openaigym.model.<16 hex digits>.zip             ... and its sources
    ├── openaigym.results.<infix>.monitor.csv           table for Stable-Baselines3
    ├── .openaigym.<infix>.lock                         held while its monitor is open
    ├── .openaigym.video.<infix>.video000027.lock       held while a video is rendered
    ├── .openaigym.clip.<infix>.step000000137.lock      held while a clip is rendered
    ├── .openaigym.manifest.<infix>.lock                held to rewrite a manifest
    └── .openaigym.render.<number>.lock                 held while that CPU is in use

The names of an episode's videos differ in the part before the suffix. A camera can have
any name, so the name is encoded. The result cannot be mistaken for another part and
never leads out of the directory.

A recording in flight is a span of rows, which the journal lists (see `spans`). An
episode's span is named after its future trajectory. A clip has a part for each episode,
`openaigym.clip.<infix>.step000000137.part000000`, named after the number of steps that
the monitor had recorded when the clip began. A clip's video is named after its first
episode, with a step (`video000027.step000137.mp4`) if a step triggered the clip.

`<infix>` is `<monitor id>.<uid or process id>`. It identifies one monitor: no two
monitors in a directory ever have the same infix. Files whose names start with a dot and
end in `.part` are still being written.
"""

from __future__ import annotations

import glob
import hashlib
import os
import re
import shlex
import urllib.parse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InvalidArgument
from ..plain_text import listed

FILE_PREFIX = "openaigym"
MANIFEST_PREFIX = f"{FILE_PREFIX}.manifest"

_SHOWN = 5

_UID = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}", re.ASCII)

# The names that this package and all versions of gym have used. No other file in a
# directory is ours. A name that ends in `~` is one of gym's temporary names.
#
# Names are also read from files, which may be untrusted: a name with a slash would lead
# out of the directory, and a number with a million digits would take minutes to parse.
#
# Gym accepted any string as a uid.
_INFIX_PART = r"(?P<infix>[0-9]{1,18}\.[^/\n\0]+)"
_INFIX = re.compile(_INFIX_PART)
_VIDEO = rf"openaigym\.video\.{_INFIX_PART}\.video(?P<episode>[0-9]{{6,18}})"
_TRAJECTORY = (
    rf"openaigym\.trajectory\.{_INFIX_PART}\.episode(?P<episode>[0-9]{{6,18}})"
)
# The group is not called `episode`, so that no part of a clip is mistaken for an
# episode's file.
_CLIP = rf"openaigym\.clip\.{_INFIX_PART}\.step(?P<step>[0-9]{{9,18}})"
_CLIP_PART = re.compile(rf"{_CLIP}\.part(?P<part>[0-9]{{6,18}})")
_VIDEO_FILE = re.compile(
    rf"{_VIDEO}(\.step(?P<step>[0-9]{{6,18}}))?(\.(?P<view>[^/\n\0]+?))??"
    r"\.(?P<ending>mp4|avi|json|framehash|meta\.json|failed\.json)"
)
_STATES = rf"openaigym\.states\.{_INFIX_PART}\.(?P<log>[0-9]{{6,9}})"

_MANIFEST = re.compile(rf"openaigym\.manifest\.{_INFIX_PART}\.manifest\.json")
# The key is the word after `openaigym.`. A directory may contain a million names, so
# each name is matched against only one pattern.
_VISIBLE = {
    "manifest": re.compile(rf"openaigym\.manifest\.{_INFIX_PART}\.manifest\.json~*"),
    "episode_batch": re.compile(
        rf"openaigym\.episode_batch\.{_INFIX_PART}\.stats\.json~*"
    ),
    "episodes": re.compile(rf"openaigym\.episodes\.{_INFIX_PART}\.jsonl"),
    "video": re.compile(rf"{_VIDEO}\.[^/\n\0]*(mp4|avi|json|framehash)"),
    "clip": re.compile(rf"{_CLIP}\.failed\.json"),
    "trajectory": re.compile(rf"{_TRAJECTORY}\.h5"),
    "trajectories": re.compile(rf"openaigym\.trajectories\.{_INFIX_PART}\.h5"),
    "states": re.compile(rf"{_STATES}\.(log|tail|looks)"),
    "model": re.compile(r"openaigym\.model\.[0-9a-f]{16}\.(zip|mjb\.gz)"),
    "results": re.compile(rf"openaigym\.results\.{_INFIX_PART}\.monitor\.csv"),
}
_HIDDEN = (
    re.compile(rf"\.{_VIDEO}\.lock"),
    re.compile(rf"\.{_CLIP}\.lock"),
    re.compile(r"\.openaigym\.(recover|render\.[0-9]+)\.lock"),
    re.compile(rf"\.openaigym\.manifest\.{_INFIX_PART}\.lock"),
    re.compile(rf"\.openaigym\.{_INFIX_PART}\.lock"),
    re.compile(r"\.openaigym\.[^/\n\0]+\.part"),
)
# A note is rewritten like any other file, so an unfinished note has both suffixes.
_PART = re.compile(
    r"\.(?P<final>openaigym\..+?)(?P<note>\.note(\.part)?)?(?P<hex>\.[0-9a-f]{8})?\.part"
)

_MP4 = ".mp4"
_TILED = "tiled"

# Camera names that are empty or would be mistaken for another part of a file's name.
_AMBIGUOUS = re.compile(
    r"|full|draft|annotated|plain|tiled|meta|\d*x\d*|.*fps|(video|step)\d+"
    r"|camera(-.*|\d+)"
)
# A file name has at most 255 bytes, which all of its parts share.
_LONGEST_PART = 80
_DIGEST = 8

# The file names of Gymnasium's RecordVideo, for any portable `name_prefix`.
_SECOND_STEM = (
    r"(?!openaigym)[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}-(episode|step)-[0-9]{1,18}"
)
_SECOND_NAME = re.compile(rf"{_SECOND_STEM}\.mp4", re.ASCII)
_OF_SECOND_NAME = re.compile(rf"{_SECOND_STEM}(\.[^.]*)?\.(mp4|meta\.json)", re.ASCII)


@dataclass(frozen=True)
class VideoName:
    """The parsed name of a video, or of a file that belongs to a video.

    Attributes:
        name: the file's name.
        infix: the monitor's infix.
        episode_id: the episode that the video shows, or in which a clip began.
        first_step: number of steps recorded when a clip began; None if no step
            triggered the clip.
        view: the part of the name that distinguishes an episode's videos; empty for the
            first camera's original video.
        ending: the kind of file, such as `mp4` or `meta.json`.
    """

    name: str
    infix: str
    episode_id: int
    first_step: int | None
    view: str
    ending: str

    @classmethod
    def parse(cls, name: str) -> VideoName | None:
        """Parse a name, or return None if the file does not belong to a video."""
        match = _VIDEO_FILE.fullmatch(name)
        if match is None:
            return None
        step = None if match["step"] is None else int(match["step"])
        return cls(
            *(name, match["infix"], int(match["episode"]), step),
            *(match["view"] or "", match["ending"]),
        )

    @property
    def video(self) -> str:
        """The name of the mp4 file."""
        return f"{self.name.removesuffix(self.ending)}mp4"

    @property
    def is_episodes(self) -> bool:
        """Whether the file belongs to an episode's first video.

        This is False for a step-triggered clip, but True for a clip that began with an
        episode.
        """
        return not self.view and self.first_step is None


def clip_step(name: str) -> int | None:
    """Return the step at which a clip began, given the name of one of its parts.

    This is the number of steps that the monitor had recorded by then. For any other
    name, the result is None.
    """
    match = _CLIP_PART.fullmatch(name)
    return None if match is None else int(match["step"])


def is_infix(text: str) -> bool:
    """Return whether `text` is a valid infix."""
    return _INFIX.fullmatch(text) is not None


def infix_order(infix: str) -> tuple[int, int, str]:
    """Return a sort key that orders infixes by monitor id and process id."""
    number, _, uid = infix.partition(".")
    # Process ids are compared as numbers: 9 comes before 10.
    return int(number), int(uid) if uid.isdecimal() else 0, uid


def check_uid(uid: object) -> str:
    """Return `uid` as a string for use in file names.

    Raises:
        InvalidArgument: `uid` is not allowed in portable file names.
    """
    text = str(uid)
    if not _UID.fullmatch(text):
        raise InvalidArgument(
            "uid becomes part of file names. It must consist of 1 to 100 letters, "
            f"digits, '_', '-' and '.', and not start with '.', but it is {uid!r}."
        )
    return text


def manifest_name(infix: str) -> str:
    """Return the manifest's name."""
    return f"{MANIFEST_PREFIX}.{infix}.manifest.json"


def stats_prefix(infix: str) -> str:
    """Return the statistics file's name without `.stats.json`."""
    return f"{FILE_PREFIX}.episode_batch.{infix}"


def journal_name(infix: str) -> str:
    """Return the journal's name."""
    return f"{FILE_PREFIX}.episodes.{infix}.jsonl"


def video_prefix(infix: str, episode_id: int) -> str:
    """Return the name of an episode's video without its extensions."""
    return f"{FILE_PREFIX}.video.{infix}.video{episode_id:06d}"


def trajectory_prefix(infix: str, episode_id: int) -> str:
    """Return the name of an episode's trajectory without `.h5`."""
    return f"{FILE_PREFIX}.trajectory.{infix}.episode{episode_id:06d}"


def bundle_name(infix: str) -> str:
    """Return the name of a monitor's bundle, the file that holds many trajectories."""
    return f"{FILE_PREFIX}.trajectories.{infix}.h5"


def is_bundle(name: str) -> bool:
    """Return whether `name` is the name of a bundle."""
    return _VISIBLE["trajectories"].fullmatch(name) is not None


def clip_prefix(infix: str, first_step: int) -> str:
    """Return the start of the names of a clip's parts.

    Args:
        infix: the monitor's infix.
        first_step: number of steps that the monitor had recorded when the clip began.
    """
    return f"{FILE_PREFIX}.clip.{infix}.step{first_step:09d}"


def clip_part_name(infix: str, first_step: int, number: int) -> str:
    """Return the name of a clip's part. Parts are numbered from 0, one per episode."""
    return f"{clip_prefix(infix, first_step)}.part{number:06d}"


def log_name(infix: str, number: int) -> str:
    """Return the name of a row log. Its companion files have other suffixes."""
    return f"{FILE_PREFIX}.states.{infix}.{number:06d}.log"


def clip_video_prefix(infix: str, episode_id: int, step: int | None) -> str:
    """Return the name of a clip's video without its extensions.

    Args:
        infix: the monitor's infix.
        episode_id: the episode in which the clip began.
        step: number of steps recorded when a step triggered the clip; None if it began
            with the episode.
    """
    prefix = video_prefix(infix, episode_id)
    return prefix if step is None else f"{prefix}.step{step:06d}"


def render_lock_name(number: int) -> str:
    """Return the name of the lock file that represents one of the machine's CPUs."""
    return f".{FILE_PREFIX}.render.{number}.lock"


def lock_name(infix: str) -> str:
    """Return the name of the lock file that an open monitor holds."""
    return f".{FILE_PREFIX}.{infix}.lock"


def manifest_lock_name(infix: str) -> str:
    """Return the name of the lock file held while a manifest is rewritten.

    The monitor's own lock is not used, because the monitor itself stays closed.
    """
    return f".{MANIFEST_PREFIX}.{infix}.lock"


def is_manifest(name: str) -> bool:
    """Return whether `name` is the name of a finished manifest."""
    return _MANIFEST.fullmatch(name) is not None


def infix_of(name: str) -> str | None:
    """Return the infix in the name of a file or recording, or None if it has none."""
    match = _match(name) or _CLIP_PART.fullmatch(name)
    return None if match is None else match.groupdict().get("infix")


def episode_of(name: str) -> int | None:
    """Return the episode number in a file's name, or None if it has none."""
    return _number(name, "episode")


def log_number(name: str) -> int | None:
    """Return the number of the row log that a file belongs to, or None."""
    return _number(name, "log")


def _number(name: str, part: str) -> int | None:
    match = _match(name)
    number = None if match is None else match.groupdict().get(part)
    return None if number is None else int(number)


def final_name(name: str) -> str | None:
    """Return the final name of an unfinished file or note, or None for other names."""
    part = _PART.fullmatch(name)
    return None if part is None else part["final"]


def is_note(name: str) -> bool:
    """Return whether `name` is the name of a note about an unfinished video."""
    part = _PART.fullmatch(name)
    return part is not None and bool(part["note"]) and not part["hex"]


def unfinished_files(path: Path) -> list[Path]:
    """Return the existing temporary files that were created to write `path`."""
    pattern = f".{glob.escape(path.name)}.{8 * '[0-9a-f]'}.part"
    found = sorted(path.parent.glob(pattern))
    # A link may point anywhere.
    return [part for part in found if part.is_file() and not part.is_symlink()]


def iter_monitor_files(directory: Path, *, hidden: bool = False) -> Iterator[Path]:
    """Yield the monitor files of `directory`, sorted by name.

    Only regular files (and links to them) that have a monitor file's name are included.
    Directories, and other files whose names start with `openaigym.`, are ignored.

    Args:
        directory: the directory; its subdirectories are not searched. A missing
            directory counts as empty.
        hidden: whether to include locks and unfinished files.
    """
    if not directory.is_dir():
        return
    for name in sorted(_names(directory, hidden=hidden)):
        yield directory / name


def monitor_directories_in(directory: Path) -> list[Path]:
    """Return the subdirectories that hold monitor files, sorted by name.

    Two levels are searched, because an evaluation has a folder for each task, which has
    folders of its own.
    """
    found: list[Path] = []
    for path in sorted(directory.iterdir()):
        if not path.is_dir() or path.is_symlink() or path.name.startswith("."):
            continue
        inner = [path, *sorted(each for each in path.iterdir() if each.is_dir())]
        found += [each for each in inner if any(iter_monitor_files(each))]
    return found


def recording_directories(directory: Path) -> list[Path]:
    """Return a directory if it has recordings, or else its subdirectories that do.

    If there are no such subdirectories, the directory itself is returned.
    """
    if not directory.is_dir() or any(iter_monitor_files(directory)):
        return [directory]
    return monitor_directories_in(directory) or [directory]


def where_recordings_are(directory: Path) -> str:
    """Return advice for the error about a directory without recordings.

    Its subdirectories are searched, because an evaluation has its recordings there.
    """
    below = monitor_directories_in(directory)
    folders = [str(path.relative_to(directory)) for path in below]
    if not folders:
        return f"To record, run `mjrec record ENV --out {shlex.quote(str(directory))}`."
    return f"Its subfolders do ({listed(folders, _SHOWN)}): choose one of them."


def names_in(directory: Path) -> Iterator[str]:
    """Yield the names of all entries in a directory, in no particular order.

    Use this to find a few names among a million, because creating a `Path` for each
    would be too slow.
    """
    with os.scandir(directory) as entries:
        for entry in entries:
            yield entry.name


def _names(directory: Path, *, hidden: bool) -> Iterator[str]:
    # scandir returns the file type with the name, so a network file system gets one
    # query for many entries instead of one for each.
    with os.scandir(directory) as entries:
        for entry in entries:
            is_wanted = hidden or not entry.name.startswith(".")
            if is_wanted and _match(entry.name) is not None and _is_file(entry):
                yield entry.name


def _is_file(entry: os.DirEntry[str]) -> bool:
    # Follow links with `Path.is_file`, which does not raise for a link to itself.
    return Path(entry).is_file() if entry.is_symlink() else entry.is_file()


def _match(name: str) -> re.Match[str] | None:
    """Match the name of a monitor file. Return None for other files."""
    if name.startswith("."):
        final = final_name(name)
        if final is not None and (match := _match(final)) is not None:
            return match
        matches = (pattern.fullmatch(name) for pattern in _HIDDEN)
        return next((match for match in matches if match is not None), None)
    _, _, rest = name.partition(".")
    kind, _, _ = rest.partition(".")
    visible = _VISIBLE.get(kind)
    return None if visible is None else visible.fullmatch(name)


def name_part(text: str) -> str:
    """Encode a string as a part of a file name.

    Every character except ASCII letters, digits, `_` and `-` is percent-encoded as
    UTF-8. A result that is too long for a name is truncated and ends in a digest.
    """
    quoted = urllib.parse.quote(text, safe="", errors="surrogatepass")
    # Besides letters, digits, `_` and `-`, these are the only characters that `quote`
    # does not encode.
    part = quoted.replace(".", "%2E").replace("~", "%7E")
    if len(part) <= _LONGEST_PART:
        return part
    digest = hashlib.sha256(part.encode()).hexdigest()[:_DIGEST]
    # Do not cut an encoded character in half.
    begin = re.sub("%.?$", "", part[: _LONGEST_PART - _DIGEST - 1])
    return f"{begin}-{digest}"


def camera_part(camera: Any) -> str:
    """Return the part of a file name that represents one camera.

    A name that could be mistaken for another part is prefixed, as in `camera-draft`.

    Args:
        camera: a name, a number, or the fields of an `MjvCamera`.
    """
    if isinstance(camera, int):
        return str(camera)
    part = name_part(str(camera))
    return f"camera-{part}" if _AMBIGUOUS.fullmatch(part) else part


def further_parts(cameras: Sequence[Any]) -> list[str]:
    """Return the name parts for all cameras of an episode except the first.

    A camera without a name is named after its position, such as `camera2` for the
    second camera. If two parts would be the same, as for camera 1 and the camera "1",
    the later part gets `-2`, `-3` and so on.

    Args:
        cameras: all cameras, in order.
    """
    parts: list[str] = []
    for place, camera in enumerate(cameras[1:], 2):
        has_name = isinstance(camera, str | int)
        part = camera_part(camera) if has_name else f"camera{place}"
        unlike, number = part, 1
        while unlike in parts:
            number += 1
            unlike = f"{part}-{number}"
        parts.append(unlike)
    return parts


def with_part(video: str, part: str) -> str:
    """Return a video's name with a part inserted before the extension.

    >>> with_part("rl-video-episode-27.mp4", "side")
    'rl-video-episode-27.side.mp4'
    """
    stem, dot, ending = video.rpartition(".")
    return f"{stem}.{part}{dot}{ending}"


def tiled_name(video: str) -> str:
    """Return the name of the video that shows all sub-environments together.

    Args:
        video: the name that the video would have otherwise.
    """
    return with_part(video, _TILED)


def view_of(video: str) -> str:
    """Return the name part of a video's camera, or "" for the first camera's video.

    >>> view_of("openaigym.video.0.7.video000027.step000137.side.mp4")
    'side'
    """
    name = VideoName.parse(video)
    # The view of a rerendered video contains more than a camera's part.
    return "" if name is None or "." in name.view else name.view


def is_second_name(name: str) -> bool:
    """Return whether `name` could be the second name of one of our videos."""
    return _SECOND_NAME.fullmatch(name) is not None


def is_called_like_second(name: str) -> bool:
    """Return whether `name` could be the second name of any of a video's files."""
    return _OF_SECOND_NAME.fullmatch(name) is not None


def second_name_of(name: str, second: str, *, first: str) -> str | None:
    """Return the second name of a file that belongs to an episode.

    >>> second_name_of("v.side.meta.json", "rl-video-episode-2.mp4", first="v.mp4")
    'rl-video-episode-2.side.meta.json'

    Args:
        name: the file's name.
        second: the second name of the episode's first video.
        first: the name of the episode's first video.

    Returns:
        The second name, or None if the file does not belong to this episode.
    """
    stem = first.removesuffix(_MP4)
    if not name.startswith(f"{stem}."):
        return None
    return second.removesuffix(_MP4) + name.removeprefix(stem)
