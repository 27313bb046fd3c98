# SPDX-License-Identifier: Apache-2.0
"""Whether a packed run's `environment.json` says what its recordings say.

It is a copy, for people and programs that read nothing else: whoever writes another
graphics card there is told from what each video's metadata says.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...formats.json_fields import read_object
from ...formats.video_metadata import metadata_path
from ..verification import Check, Level
from .findings import Findings
from .recorded_monitors import RecordedMonitor

_OF_PICTURES = ("gl_vendor", "gl_renderer", "gl_version", "rendered_with")
_PACKED_WITH = ("mjrec", "bagit", "python", "zlib", "options")
_ABSENT = object()


def check_environment_file(
    path: Path, monitors: Iterable[RecordedMonitor]
) -> Iterator[Check]:
    """Yield what is found about the file that says what recordings were made with.

    Args:
        path: of the file.
        monitors: what is recorded.
    """
    found = Findings(Level.STATS, f"{path.name} says what the recordings say")
    try:
        said = read_object(path)
    except (OSError, ValueError) as error:
        found.look(path.name, f"it cannot be read: {error}")
        yield from found.checks()
        return
    expected = {monitor.infix: _expected(monitor) for monitor in monitors}
    recordings = said.get("recordings")
    if not isinstance(recordings, Mapping):
        recordings = {}
    for infix in sorted(expected.keys() | recordings.keys()):
        subject = f"recording {infix[:100]}"
        pair = recordings.get(infix, _ABSENT), expected.get(infix, _ABSENT)
        found.look(subject, *_differences("", *pair))
    found.look(path.name, *_objections_to_rest(said))
    yield from found.checks()


def _objections_to_rest(said: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with that of which the recordings know nothing."""
    for key in said.keys() - {"recordings", "packed_with"}:
        yield f"{key[:100]}: it says {said[key]!r:.60}, of which nothing is recorded"
    packed_with = said.get("packed_with")
    if not isinstance(packed_with, Mapping) or packed_with.keys() != set(_PACKED_WITH):
        yield f"packed_with: it is not the versions of {', '.join(_PACKED_WITH)}"


def _expected(monitor: RecordedMonitor) -> Mapping[str, Any]:
    """Return what the file is to say of a monitor."""
    pictures: list[Mapping[str, Any]] = []
    encoders: list[Mapping[str, Any]] = []
    said_of = {
        metadata_path(Path(video.name)).name: video.metadata for video in monitor.videos
    }
    manifest = monitor.manifest
    for _, metadata in () if manifest is None else manifest.videos:
        said = said_of.get(metadata, {})
        _note(pictures, {key: said.get(key) for key in _OF_PICTURES})
        _note(
            encoders,
            {
                "version": _mapping(said.get("encoder_version")).get("version"),
                "ffmpeg_sha256": said.get("ffmpeg_sha256"),
            },
        )
    versions = _mapping(monitor.details.get("versions"))
    env_info = {} if manifest is None else manifest.env_info
    return {
        "env_id": str(env_info.get("env_id", "(unknown)")),
        "versions": {k: v for k, v in versions.items() if isinstance(v, str)},
        "surroundings": _mapping(monitor.details.get("surroundings")) or None,
        "pictures": pictures,
        "encoders": encoders,
    }


def _note(known: list[Mapping[str, Any]], one: Mapping[str, Any]) -> None:
    if any(value is not None for value in one.values()) and one not in known:
        known.append(one)


def _differences(where: str, said: Any, recorded: Any) -> Iterator[str]:
    """Yield where two values differ, down to what is neither object nor list."""
    if isinstance(said, Mapping) and isinstance(recorded, Mapping):
        for key in [*recorded, *(key for key in said if key not in recorded)]:
            yield from _differences(
                f"{where}.{key[:100]}".removeprefix("."),
                said.get(key, _ABSENT),
                recorded.get(key, _ABSENT),
            )
    elif isinstance(said, list) and isinstance(recorded, list):
        for index in range(max(len(said), len(recorded))):
            pair = (
                values[index] if index < len(values) else _ABSENT
                for values in (said, recorded)
            )
            yield from _differences(f"{where}[{index}]", *pair)
    elif type(said) is not type(recorded) or said != recorded:
        place = f"{where}: " if where else ""
        yield f"{place}it says {_shown(said)}, the recordings {_shown(recorded)}"


def _shown(value: Any) -> str:
    return "nothing" if value is _ABSENT else f"{value!r:.60}"


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
