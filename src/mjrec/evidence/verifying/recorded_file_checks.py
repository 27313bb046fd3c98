# SPDX-License-Identifier: Apache-2.0
"""Whether the files of a monitor directory are what they say of each other."""

from __future__ import annotations

import gzip
import hashlib
import re
import zlib
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from ...errors import UnreadableFile
from ...formats.frame_hashes import frame_hash_header, frame_hash_path
from ...formats.json_fields import field, integer, read_object
from ...formats.manifest import read_manifest
from ...formats.monitor_directory import (
    infix_of,
    is_manifest,
    is_second_name,
    iter_monitor_files,
    view_of,
    without_part,
)
from ...formats.regular_files import open_regular
from ...formats.trajectory_file import open_trajectory
from ...formats.video_metadata import metadata_path
from ..verification import Check, Level
from .digests import digest_of
from .findings import Findings
from .task import Count

_METADATA = ".meta.json"
_VIDEOS = (".mp4", ".avi")
_MODEL = re.compile(r"openaigym\.model\.(?P<digits>[0-9a-f]{16})\.mjb\.gz")
_FRAME = re.compile(rb"0, *(?P<number>\d+), *(?P=number), *1, *\d+, [0-9a-f]{64}\n")

_CHUNK = 1 << 20
_LARGEST_MODEL = 1 << 31
_ALWAYS_FINE = 1 << 28
_MOST_EXPANSION = 100
_LONGEST_LINE = 1000
_HEADER_LINES = frame_hash_header(height=1, width=1, fps=Fraction(1)).count("\n")


def check_recorded_files(
    directory: Path, count: Count, *, is_packed: bool
) -> Iterator[Check]:
    """Yield what is found about the files of a monitor directory.

    Args:
        directory: of the recordings.
        count: told how many of its parts are done.
        is_packed: nothing else may be there. Beside recordings that were not packed
            there may be anything of their owner's.
    """
    paths = list(iter_monitor_files(directory))
    parts = (
        _check_videos(paths),
        _check_frame_hashes(paths),
        _check_manifests(paths),
        _check_models(paths, is_packed=is_packed),
        _check_strays(directory, paths, is_packed=is_packed),
    )
    for done, part in enumerate(parts):
        count(done, len(parts))
        yield from part
    count(len(parts), len(parts))


def _check_videos(paths: list[Path]) -> Iterator[Check]:
    found = Findings(Level.FILES, "each video is the file that its metadata describes")
    known = {path.name for path in paths}
    for path in paths:
        if path.suffix in _VIDEOS and metadata_path(path).name not in known:
            found.look(path.name, "it has no metadata: nothing says what it shows")
        if path.name.endswith(_METADATA):
            _look_at_video(path, known, found)
    yield from found.checks(passed="by SHA-256")


def _look_at_video(metadata: Path, known: set[str], found: Findings) -> None:
    try:
        said = read_object(metadata)
    except (OSError, ValueError) as error:
        found.look(metadata.name, f"it cannot be read: {error}")
        return
    stem = metadata.name.removesuffix(_METADATA)
    video = next(
        (name for end in (*_VIDEOS, ".json") if (name := f"{stem}{end}") in known), None
    )
    if video is None:
        is_lost = not (said.get("broken") is True or said.get("empty") is True)
        found.look(metadata.name, "its video is missing" if is_lost else None)
        return
    digest = said.get("file_sha256")
    if digest is None:
        found.cannot_tell(
            "the metadata of a video has no SHA-256 of it: it is a text recording, or "
            "another program wrote it"
        )
        return
    try:
        is_it = digest_of(metadata.with_name(video)) == digest
    except (OSError, ValueError) as error:
        found.look(video, f"it cannot be read: {error}")
        return
    found.look(
        video, None if is_it else "it is not the file whose SHA-256 its metadata has"
    )


def _check_frame_hashes(paths: list[Path]) -> Iterator[Check]:
    found = Findings(
        Level.FILES, "there is a recorded hash for each frame of each video"
    )
    known = {path.name for path in paths}
    for path in paths:
        if path.suffix == ".framehash" and path.with_suffix(".mp4").name not in known:
            found.look(path.name, "it belongs to no video")
        if path.suffix == ".mp4" and frame_hash_path(path).name in known:
            found.look(path.name, _objection_to_hashes(path))
        elif path.suffix == ".mp4" and _had_hashes(path):
            found.look(path.name, "the file of the hashes of its frames is missing")
        elif path.suffix == ".mp4":
            found.cannot_tell("a video has no file of the hashes of its frames")
    yield from found.checks()


def _had_hashes(video: Path) -> bool:
    """Tell whether mjrec made a video whole, which never leaves out the hashes.

    Of one that a killed process left they may have been lost.
    """
    try:
        said = read_object(metadata_path(video))
    except (OSError, ValueError):
        return False
    return said.get("decoded_sha256") is not None and said.get("complete") is not False


def _objection_to_hashes(video: Path) -> str | None:
    try:
        said = read_object(metadata_path(video))
        frames = field(said, "frame_count", integer)
        height, width = (field(said, side, integer) for side in ("height", "width"))
        with open_regular(frame_hash_path(video)) as file:
            lines = [file.readline(_LONGEST_LINE) for _ in range(_HEADER_LINES)]
            if lines[-3] != f"#dimensions 0: {width}x{height}\n".encode():
                return "the hashes are of frames of another size than its metadata says"
            count = 0
            while line := file.readline(_LONGEST_LINE):
                match = _FRAME.fullmatch(line)
                if match is None or int(match["number"]) != count:
                    return f"there is no hash of frame {count} where it should be"
                count += 1
    except (OSError, ValueError) as error:
        return f"its hashes cannot be compared: {error}"
    if count == frames:
        return None
    return f"its metadata says {frames} frames, and there are hashes of {count}"


def _check_manifests(paths: list[Path]) -> Iterator[Check]:
    found = Findings(
        Level.FILES, "the manifests list every video, and every listed video is there"
    )
    known = {path.name for path in paths}
    listed: set[str] = set()
    manifests: set[str] = set()
    for path in paths:
        if is_manifest(path.name):
            manifests.add(infix_of(path.name) or "")
            listed |= _listed_in(path, known, found)
    for infix in sorted({infix_of(path.name) or "" for path in paths} - {""}):
        if infix not in manifests:
            found.look(
                infix,
                "it has no manifest, which says what belongs together: mjrec recover "
                "writes one of what a killed recording left",
            )
    for path in paths:
        if infix_of(path.name) in manifests and path.suffix in _VIDEOS:
            found.look(path.name, _objection_to_place(path, known, listed))
    yield from found.checks()


def _listed_in(manifest: Path, known: set[str], found: Findings) -> set[str]:
    try:
        said = read_manifest(manifest)
    except UnreadableFile as error:
        found.look(manifest.name, f"it cannot be read: {error.reason}")
        return set()
    infix = infix_of(manifest.name)
    names = {name for pair in said.videos for name in pair} | {said.stats}
    for name in sorted(names):
        if infix_of(name) != infix:
            found.look(name, f"{manifest.name} lists it, and it is another recording's")
        elif name not in known:
            found.look(name, f"{manifest.name} lists it, and it is not there")
    return names


def _objection_to_place(video: Path, known: set[str], listed: set[str]) -> str | None:
    if video.name in listed:
        return None
    # Rendered again another way, beside the original; or given up half-way.
    if view_of(video.name) and _episode_is_known(video, known):
        return None
    if _says_broken(video):
        return None
    return "no manifest lists it"


def _episode_is_known(video: Path, known: set[str]) -> bool:
    name = video.name
    while view_of(name):
        name = without_part(name)
        trajectory = name.replace(".video.", ".trajectory.", 1)
        head, _, number = trajectory.removesuffix(".mp4").rpartition(".video")
        if name in known or f"{head}.episode{number}.h5" in known:
            return True
    return False


def _says_broken(video: Path) -> bool:
    try:
        return read_object(metadata_path(video)).get("broken") is True
    except (OSError, ValueError):
        return False


def _check_models(paths: list[Path], *, is_packed: bool) -> Iterator[Check]:
    found = Findings(
        Level.FILES, "each recorded model is the one that its name and the states name"
    )
    named: dict[str, str] = {}
    for path in paths:
        if path.suffix == ".h5" and ".trajectory." in path.name:
            named.update(_models_of(path, found))
    known = {path.name for path in paths}
    for path in paths:
        match = _MODEL.fullmatch(path.name)
        if match is not None:
            found.look(path.name, _objection_to_model(path, match["digits"]))
        # Packing leaves out what nothing refers to; anything may be called so.
        if is_packed and _is_model(path) and path.name not in named:
            found.look(path.name, "no recorded states are of this model")
    for name, owner in sorted(named.items()):
        # What it was made from need not be known.
        if name not in known and name.endswith(".mjb.gz"):
            found.cannot_tell(
                f"a compiled model is missing that states were recorded of: {name} "
                f"(of {owner})"
            )
    yield from found.checks(passed="by SHA-256")


def _is_model(path: Path) -> bool:
    return path.name.startswith("openaigym.model.")


def _models_of(trajectory: Path, found: Findings) -> Mapping[str, str]:
    """Return the names of the files of a trajectory's model, each with its owner."""
    try:
        with open_trajectory(trajectory) as reader:
            model = reader.facts.get("model")
    except UnreadableFile as error:
        found.look(trajectory.name, f"it cannot be read: {error.reason}")
        return {}
    if not isinstance(model, Mapping):
        return {}
    names: dict[str, Any] = {key: model.get(key) for key in ("mjb", "xml")}
    digits = str(model.get("sha256"))[:16]
    for name in names.values():
        if name is not None and (
            not isinstance(name, str)
            or not name.startswith(f"openaigym.model.{digits}.")
        ):
            found.look(
                trajectory.name, "it names a model file of another SHA-256 than it says"
            )
            return {}
    found.look(trajectory.name)
    return {name: trajectory.name for name in names.values() if name is not None}


def _objection_to_model(path: Path, digits: str) -> str | None:
    try:
        digest = _sha256_inside(path)
    except (OSError, ValueError, EOFError, zlib.error) as error:
        return f"it cannot be read: {error}"
    if digest.startswith(digits):
        return None
    return f"the model inside has the SHA-256 {digest[:16]}..., not that of its name"


def _sha256_inside(path: Path) -> str:
    digest = hashlib.sha256()
    size = 0
    with open_regular(path) as packed, gzip.open(packed) as file:
        limit = min(
            _LARGEST_MODEL,
            max(_ALWAYS_FINE, _MOST_EXPANSION * path.stat().st_size),
        )
        while chunk := file.read(_CHUNK):
            size += len(chunk)
            if size > limit:
                raise ValueError("it unpacks to far more than any model")
            digest.update(chunk)
    return digest.hexdigest()


def _check_strays(
    directory: Path, paths: list[Path], *, is_packed: bool
) -> Iterator[Check]:
    found = Findings(
        Level.FILES, "there is nothing but recordings among the recordings"
    )
    known = {path.name for path in paths}
    contents = {_identity(path) for path in paths} if is_packed else set()
    for path in sorted(directory.iterdir()):
        if path.name in known:
            found.look(path.name)
        elif is_packed and not _is_second(path, contents):
            found.look(path.name, "it belongs to no recording")
        elif path.name.startswith("openaigym."):
            found.look(path.name, "it is called like a recording, and is none")
    yield from found.checks()


def _is_second(path: Path, contents: set[str | None]) -> bool:
    """Tell whether a file is a recorded one by its second name."""
    # Metadata and hashes are called like their video.
    stem = path.name.split(".")[0]
    if not is_second_name(f"{stem}.mp4"):
        return False
    return _identity(path) in contents - {None}


def _identity(path: Path) -> str | None:
    try:
        return digest_of(path)
    except (OSError, ValueError):
        return None
