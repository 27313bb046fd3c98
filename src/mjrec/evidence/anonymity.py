# SPDX-License-Identifier: Apache-2.0
"""Recordings without the names of the people and machines that made them.

Of a staged monitor directory, whose files are copies or links:

- the texts in JSON (manifests, metadata, statistics, journals, text recordings), in
  trajectories' facts and in Stable-Baselines3's CSV have placeholders: `<home>`,
  `<path>`, `<user>`, `<host>`;
- of the provenance of a recording, the command line keeps only names of files, the
  code neither its commit nor where it is, and variables no directories;
- of the device that drew a video its number is left, and where UUIDs of GPUs stood is
  `<gpu>`: each names a single card;
- names of files, where a uid, a camera or a prefix has the identity in it, have `user`
  or `host` instead, and what refers to them says the same;
- sources of models have no comments, and their images no texts (`anonymous_models`);
- a compiled model that has the identity in it, which only its author could have
  loaded, is removed.

What is matched how, `identity_matching` says. Times stay, and so do all numbers, the
process id in a default uid among them. What else has the identity in it (a body of a
model, say) stays, and `identity_traces` finds it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..atomic_files import replacing
from ..errors import FileNotWritten, InvalidArgument
from ..formats.json_fields import unreadable
from ..formats.monitor_directory import FILE_PREFIX, Infix, infix_of, is_second_name
from ..formats.trajectory_file import amend_trajectories
from ..json_text import dumps, loads
from .anonymous_models import anonymous_sources, compiled_model
from .identity import Identity
from .identity_matching import IdentityMatcher

logger = logging.getLogger(__name__)

_JSON = re.compile(r".*\.json~*")
_MODEL = f"{FILE_PREFIX}.model."

# Where programs are is the same for everybody.
_SHARED = r"(?!(?:usr|bin|sbin|lib|lib64|opt|etc|proc|sys|dev)(?:/|$))"
_DIRECTORY = re.compile(rf"(?<![\w./])/{_SHARED}[^\s\"':,;<>=]+")
# What is a path for sure: `dm_control/cheetah-run` is none.
_PATH_OF_FILE = re.compile(
    r"(?<![\w.-])(?:[/~]|\.\.?/)[^\s\"':,;<>=]*|[^\s\"':,;<>=]*/[^\s\"':,;<>=/]*\.\w+"
)
# Of a card, or of a part of one; `CUDA_VISIBLE_DEVICES` takes a beginning too.
_GPU = re.compile(r"(?<![\w-])(?:GPU|MIG)-[0-9a-fA-F][0-9a-fA-F/-]*")
# Search engines find a commit.
_CODE = {"remote": None, "root": "<path>", "commit": "<commit>"}


def make_anonymous(recordings: Path, *, identity: Identity) -> None:
    """Take an identity out of a monitor directory that is made of copies or links.

    Nothing is written in place: a file that is a hard link to an original is replaced
    by another one. After an error the directory is of no use.

    Args:
        recordings: the directory.
        identity: what must not be named.

    Raises:
        UnreadableFile: a file is damaged, so that nothing says what is in it.
        InvalidArgument: two files would have the same name.
        FileNotWritten: the disk is full.
    """
    matcher = IdentityMatcher(identity)
    paths = sorted(path for path in recordings.iterdir() if path.is_file())
    texts = _Texts(matcher, [path.name for path in paths])
    names = {path: texts.name(path.name) for path in paths}
    name, count = Counter(names.values()).most_common(1)[0]
    if count > 1:
        raise InvalidArgument(
            f"Without the names of persons and machines in them, two files would be "
            f"called {name!r}. Record with other uids, or name the cameras otherwise."
        )
    for path, new in names.items():
        _make_file_anonymous(path, texts, matcher)
        if new != path.name and path.exists():
            path.rename(path.with_name(new))


class _Texts:
    """Replaces texts, and the names of files in them as those files are renamed.

    Args:
        matcher: finds what is to be replaced.
        names: of all files.
    """

    def __init__(self, matcher: IdentityMatcher, names: list[str]) -> None:
        self._matcher = matcher
        self._infixes = _renamed_infixes(matcher, names)
        olds = sorted(self._infixes, key=len, reverse=True)
        any_old = "|".join(map(re.escape, olds)) if olds else r"(?!)"
        self._infix = re.compile(rf"(?<!\w)(?:{any_old})(?![\w-])")

    def name(self, name: str) -> str:
        """Return the new name of a file."""
        return self._matcher.replaced_in_name(self._with_new_infixes(name))

    def text(self, text: str) -> str:
        """Return a text without the identity."""
        is_of_monitor = text.startswith(f"{FILE_PREFIX}.")
        if is_second_name(text) or (is_of_monitor and not re.search(r"[/\s]", text)):
            return self.name(text)
        return self._matcher.replaced(self._with_new_infixes(text))

    def value(self, value: Any) -> Any:
        """Return a value of JSON without the identity."""
        match value:
            case str():
                return self.text(value)
            case list():
                return [self.value(item) for item in value]
            case dict():
                return {
                    self.text(key): self.value(_general(key, item))
                    for key, item in value.items()
                }
            case _:
                return value

    def json(self, data: bytes) -> bytes:
        """Return JSON without the identity; the same bytes where it has none."""
        value = loads(data)
        new = self.value(value)
        return data if new == value else dumps(new).encode()

    def _with_new_infixes(self, text: str) -> str:
        return self._infix.sub(lambda match: self._infixes[match[0]], text)


def _make_file_anonymous(path: Path, texts: _Texts, matcher: IdentityMatcher) -> None:
    name = path.name
    if _JSON.fullmatch(name):
        _rewrite(path, texts.json)
    elif name.endswith(".jsonl"):
        _rewrite(path, lambda data: b"".join(_json_lines(data, texts)))
    elif name.endswith(".csv"):
        _rewrite(path, lambda data: b"".join(_csv_lines(data, texts)))
    elif name.endswith(".h5"):
        with _writing(path):
            amend_trajectories({path: texts.value})
    elif name.startswith(_MODEL) and name.endswith(".zip"):
        _rewrite(path, lambda data: anonymous_sources(data, matcher))
    elif name.startswith(_MODEL) and matcher.found_in_bytes(compiled_model(path)):
        logger.info("%s is left out: it names who compiled it.", name)
        path.unlink()


def _rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    with unreadable(path):
        old = path.read_bytes()
        new = change(old)
    if new != old:
        with _writing(path), replacing(path) as temporary:
            temporary.write_bytes(new)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error) from error


def _json_lines(data: bytes, texts: _Texts) -> Iterator[bytes]:
    for line in data.splitlines(keepends=True):
        text = line.rstrip(b"\n")
        try:
            yield texts.json(text) + line[len(text) :]
        except ValueError:
            # A torn one, which readers leave out, says nothing of the run.
            logger.info("A line of a journal that is no JSON is left out.")


def _csv_lines(data: bytes, texts: _Texts) -> Iterator[bytes]:
    for line in data.splitlines(keepends=True):
        if line.startswith(b"#"):
            yield b"#" + texts.json(line[1:].rstrip(b"\n")) + b"\n"
        else:
            yield texts.text(line.decode()).encode()


def _general(key: str, value: Any) -> Any:
    """Return what may be said under a key of JSON in any recording."""
    if key == "provenance" and isinstance(value, dict):
        return {k: _general_provenance(k, item) for k, item in value.items()}
    if key == "gl_device" and isinstance(value, dict):
        return {k: v for k, v in value.items() if k not in ("uuid", "file")}
    return value


def _general_provenance(key: str, value: Any) -> Any:
    match key, value:
        case "working_directory", _:
            return "<path>"
        case "command", list():
            return [_without_directories(each) for each in value]
        case "variables", dict():
            return {name: _general_variable(each) for name, each in value.items()}
        case "code", dict():
            return {**value, **{k: v for k, v in _CODE.items() if k in value}}
        case "policy", {"file": str(file)}:
            return {**value, "file": os.path.basename(file)}  # noqa: PTH119  text
        case _:
            return value


def _general_variable(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    return _GPU.sub("<gpu>", _DIRECTORY.sub("<path>", value))


def _without_directories(argument: Any) -> Any:
    if not isinstance(argument, str):
        return argument
    return _PATH_OF_FILE.sub(
        lambda match: match[0].rstrip("/").rpartition("/")[2] or "<path>", argument
    )


def _renamed_infixes(matcher: IdentityMatcher, names: list[str]) -> Mapping[str, str]:
    """Return the new infixes of monitors that must not have their old ones."""
    old = sorted({infix for name in names if (infix := infix_of(name)) is not None})
    taken = {infix for infix in old if matcher.replaced_in_name(infix) == infix}
    new: dict[str, str] = {}
    for infix in old:
        parsed = Infix.parse(infix)
        if infix in taken or parsed is None:
            continue
        uid, number = matcher.replaced_in_name(parsed.uid), 1
        candidate = Infix(parsed.monitor_id, uid)
        while str(candidate) in taken:
            number += 1
            candidate = Infix(parsed.monitor_id, f"{uid}-{number}")
        new[infix] = str(candidate)
        taken.add(new[infix])
    return new
