# SPDX-License-Identifier: Apache-2.0
"""Comparison of JSON files, value by value: journal, statistics, manifest, metadata.

A table lists the keys whose values may differ from the recreated ones, with a topic and
the allowed kind of difference. All other keys must exist and have equal values.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from .. import json_text
from ..atomic_files import file_sha256
from ..formats.journal import is_of_spans
from ..formats.json_fields import json_object, unreadable
from ..formats.regular_files import open_regular, read_regular
from .differences import (
    STORED_DIFFERENTLY,
    Aspect,
    Difference,
    Same,
    only_in,
    unlike,
)
from .findings import Topic

_LONGEST_LINE: Final = 1 << 24
_LONGEST_FILE: Final = 1 << 28
_EPISODE: Final = re.compile(rb'\{"episode_id": (\d{1,15}),')
ABSENT: Final = object()


class Rule(NamedTuple):
    """A key's topic, how its value may differ, and the excuse's name for a CLAIM."""

    topic: Topic
    aspect: Aspect = Aspect.EXACT
    claim: str = ""


_OF_FILES: Final = Rule(Topic.FILES)


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The rules for comparing the values in a file.

    Attributes:
        given: the archive's file.
        usual: the topic of all keys that the table does not list.
        left_out: keys to ignore.
        renamed: names in the archive, mapped to the names of the recreated files (the
            name of a compiled model contains its hash).
        is_packed: whether packing removed the lines about rows from journals.
        is_drawn: whether the recreated run was rendered.
        decoded: the SHA-256 of all decoded frames of the archive's videos, keyed by
            path. The comparison of videos adds them.
    """

    given: Path
    usual: Topic = Topic.FILES
    left_out: frozenset[str] = frozenset()
    renamed: Mapping[str, str] = field(default_factory=dict)
    is_packed: bool = False
    is_drawn: bool = True
    decoded: dict[Path, str] = field(default_factory=dict)

    def translated(self, text: bytes) -> bytes:
        """Return bytes from the archive, with its names replaced by recreated ones."""
        for name, again in self.renamed.items():
            text = text.replace(name.encode(), again.encode())
        return text


_RETURN: Final = Rule(Topic.REWARDS, Aspect.SUMMED)
_END: Final = Rule(Topic.REWARDS)
_BEGINNING: Final = Rule(Topic.BEGINNING)
_SELECTION: Final = Rule(Topic.SELECTION)
_IDENTITY: Final = Rule(Topic.IDENTITY)
_VIDEO: Final = Rule(Topic.VIDEOS)
_STATEMENT: Final = Rule(Topic.FILES, Aspect.STATEMENT)
_GL: Final = Rule(Topic.PICTURES, Aspect.CLAIM, "gl")
_FFMPEG: Final = Rule(Topic.VIDEOS, Aspect.CLAIM, "ffmpeg")
_MODEL: Final = Rule(Topic.IDENTITY, Aspect.MODEL)

# For all files, because a key and the keys below it mean the same thing everywhere.
_KEYS: Final[Mapping[str, Rule]] = {
    **dict.fromkeys(("reward", "episode_rewards", "reward_before"), _RETURN),
    **dict.fromkeys(("length", "episode_lengths", "terminated", "truncated"), _END),
    **dict.fromkeys(("type", "episode_types", "warnings"), _END),
    "success": Rule(Topic.REWARDS, Aspect.OBSERVED),
    **dict.fromkeys(("seed", "options", "random_state"), _BEGINNING),
    **dict.fromkeys(("schedule", "keep", "chosen", "selection", "dropped"), _SELECTION),
    **dict.fromkeys(("pending", "broken", "packed_episodes", "cut"), _SELECTION),
    **dict.fromkeys(("first_episode_id", "next_episode_id"), _SELECTION),
    **dict.fromkeys(("env_info", "env_id", "environment", "infix"), _IDENTITY),
    **dict.fromkeys(("camera", "scene", "height", "width", "fps", "quality"), _VIDEO),
    **dict.fromkeys(("timestep", "playback_speed", "stride", "rate"), _VIDEO),
    **dict.fromkeys(("frame_count", "frame_steps", "recording", "video"), _VIDEO),
    **dict.fromkeys(("gl_vendor", "gl_renderer", "gl_version"), _GL),
    **dict.fromkeys(("ffmpeg_sha256",), _FFMPEG),
    **dict.fromkeys(("start_time", "end_time", "timestamps"), _OF_FILES),
    **dict.fromkeys(("initial_reset_timestamp", "provenance"), _OF_FILES),
    "machine": Rule(Topic.PHYSICS, Aspect.CLAIM, "machine"),
    "model": _MODEL,
}
# The keys whose values contain versions, keyed by package name.
_VERSIONS: Final = frozenset(("versions", "rendered_with"))
# The program's name and version. Its other arguments are not claims.
_ENCODER: Final = ("encoder_version.version", "encoder_version.cmdline[0]")
# Which of several similar devices rendered. Only EGL numbers them.
_DEVICE: Final = {
    "file": re.compile(r"/dev/[\w/-]{1,80}", re.ASCII),
    "uuid": re.compile(r"GPU-[0-9a-f-]{36}", re.ASCII),
}


def _is_own_sha256(rules: Rules, value: Any) -> bool:
    path = video_of(rules.given)
    return path.is_file() and file_sha256(path) == value


def _is_gl_device(_: Rules, value: Any) -> bool:
    """Return whether a value is ABSENT or a valid `gl_device` with no other text."""
    if value is ABSENT:
        return True
    if not isinstance(value, dict) or type(value.get("index")) is not int:
        return False
    details = {key: text for key, text in value.items() if key != "index"}
    return details.keys() <= _DEVICE.keys() and all(
        isinstance(text, str) and _DEVICE[key].fullmatch(text)
        for key, text in details.items()
    )


# Tests of whether a value that differs from the recreated one is correct for the
# archive's own file, or cannot be recreated. Called with the value, or ABSENT.
_OWN: Final[Mapping[str, Callable[[Rules, Any], bool]]] = {
    "file_sha256": _is_own_sha256,
    "decoded_sha256": lambda rules, value: (
        rules.decoded.get(video_of(rules.given)) == value
    ),
    "gl_device": _is_gl_device,
}


def compare_objects(
    given: Path, made: Path, rules: Rules
) -> Iterator[Same | Difference]:
    """Yield the differences between two files that each contain a JSON object.

    Raises:
        UnreadableFile: a file is damaged.
    """
    with unreadable(given):
        one, other = (read_regular(path, limit=_LONGEST_FILE) for path in (given, made))
        found = list(text_differences(one, other, rules))
    yield from found or [STORED_DIFFERENTLY]


def compare_journals(
    given: Path, made: Path, rules: Rules
) -> Iterator[Same | Difference]:
    """Compare two journals line by line; yield differences and equal episodes.

    Raises:
        UnreadableFile: a journal is damaged.
    """
    with unreadable(given), open_regular(given) as one, open_regular(made) as other:
        given_lines = lines_of(one) if rules.is_packed else _without_rows(one)
        pairs = itertools.zip_longest(given_lines, _without_rows(other))
        for number, (a, b) in enumerate(pairs, start=1):
            if a is None or b is None:
                how = only_in(b is None, (a or b or b"").decode(errors="replace"))
                yield Difference(Topic.REWARDS, where=f"line {number}", how=how)
                return
            yield from _compare_lines(number, a, b, rules)


def _compare_lines(
    number: int, one: bytes, other: bytes, rules: Rules
) -> Iterator[Same | Difference]:
    begin, found = _EPISODE.match(one), []
    episode = int(begin[1]) if begin else None
    if rules.translated(one) != other:
        given, made = json_object(one), json_object(other)
        named = given.get("episode_id")
        episode = named if type(named) is int else None
        where = f"line {number}" if episode is None else f"episode {episode}"
        if next(iter(given), "") != next(iter(made), ""):
            # They report different kinds of events.
            texts = (line.decode(errors="replace").strip() for line in (one, other))
            yield Difference(
                Topic.REWARDS, where=where, how=unlike(*texts), episode=episode
            )
            return
        found = list(text_differences(one, other, rules, where=where, episode=episode))
        yield from found or [STORED_DIFFERENTLY]
    if not found and episode is not None:
        yield Same(Topic.REWARDS, unit="episode", episode=episode)


def text_differences(
    given: bytes, made: bytes, rules: Rules, **place: Any
) -> Iterator[Difference]:
    """Yield the differences between two texts that each contain a JSON object.

    Args:
        given: the archive's text.
        made: the recreated text.
        rules: the rules of the comparison.
        **place: `where` and `episode` of `json_differences`.
    """
    text = rules.translated(given)
    one, other = json_object(text), json_object(made)
    if not _is_plain(text, one) and _is_plain(made, other):
        # Spaces and needless digits could say anything.
        how = "it is not written as mjrec writes it"
        yield Difference(rules.usual, how=how, where=place.get("where", ""))
    yield from json_differences(one, other, rules, **place)


def _is_plain(text: bytes, value: Any) -> bool:
    return text.decode().removesuffix("\n") == json_text.dumps(value)


def json_differences(
    given: Any,
    made: Any,
    rules: Rules,
    *,
    where: str = "",
    episode: int | None = None,
) -> Iterator[Difference]:
    """Yield the differences between two JSON values.

    Args:
        given: the archive's value.
        made: the recreated value.
        rules: the rules of the comparison.
        where: the values' path in the file.
        episode: the number of the episode that the values belong to.
    """

    def walk(
        given: Any, made: Any, where: str, rule: Rule | None
    ) -> Iterator[Difference]:
        if given is made or (type(given) is type(made) and given == made):
            return
        if isinstance(given, dict) and isinstance(made, dict):
            for key in dict.fromkeys((*given, *made)):
                one, other = given.get(key, ABSENT), made.get(key, ABSENT)
                inner = f"{where}.{key}" if where else key
                own = _OWN.get(key)
                if key in rules.left_out:
                    continue
                if own is None or not own(rules, one):
                    yield from walk(one, other, inner, _rule(key, inner, rule))
                elif one != other:
                    yield _leaf(one, other, inner, _STATEMENT, episode)
        elif (
            isinstance(given, list)
            and isinstance(made, list)
            and len(given) == len(made)
        ):
            for index, pair in enumerate(zip(given, made, strict=True)):
                inner = f"{where}[{index}]"
                deeper = _FFMPEG if inner.endswith(_ENCODER) else rule
                yield from walk(*pair, inner, deeper)
        else:
            usual = rule or Rule(rules.usual)
            yield _leaf(given, made, where, usual, episode)

    return walk(given, made, where, None)


def _rule(key: str, where: str, outer: Rule | None) -> Rule | None:
    """Return the rule for a key that is below one with the rule `outer`."""
    if where.endswith(_ENCODER):
        return _FFMPEG
    if outer is not None and not outer.claim.endswith("*"):
        return outer
    if outer is not None:
        return Rule(outer.topic, Aspect.CLAIM, key)
    if key in _VERSIONS:
        # The keys below it are the packages' names.
        return Rule(Topic.IDENTITY, Aspect.CLAIM, "*")
    return _KEYS.get(key)


def _leaf(
    given: Any, made: Any, where: str, rule: Rule, episode: int | None
) -> Difference:
    size, aspect, how = None, rule.aspect, unlike(given, made)
    if isinstance(given, int | float) and isinstance(made, int | float):
        error = abs(given - made) / (1 + abs(given))
        size = error if math.isfinite(error) else None
    is_gone = given is ABSENT or made is ABSENT
    if is_gone:
        how = only_in(made is ABSENT, given if made is ABSENT else made)
    may_be_gone = aspect is Aspect.STATEMENT or (
        aspect is Aspect.CLAIM and rule.claim != "machine"
    )
    if (is_gone and not may_be_gone) or (aspect is Aspect.SUMMED and size is None):
        # A different version never turns a non-number into a number, or omits a key.
        # But a package, or OpenGL's names, may be missing on this machine.
        aspect = Aspect.EXACT
    return Difference(
        rule.topic,
        unit="value" if episode is None else "episode",
        episode=episode,
        aspect=aspect,
        where=where,
        how=how,
        size=size,
        claim=rule.claim,
    )


def lines_of(file: BinaryIO) -> Iterator[bytes]:
    """Yield the lines of a file, and raise an error if one is too long."""
    while line := file.readline(_LONGEST_LINE):
        if len(line) >= _LONGEST_LINE:
            raise ValueError("a line is too long")
        yield line


def _without_rows(file: BinaryIO) -> Iterator[bytes]:
    return (line for line in lines_of(file) if not is_of_spans(line))


def video_of(metadata: Path) -> Path:
    """Return the path of the video that a metadata file describes."""
    return metadata.with_name(f"{metadata.name.removesuffix('.meta.json')}.mp4")
