# SPDX-License-Identifier: Apache-2.0
"""Recordings without whoever made them.

Of a staged monitor directory, which is nobody's original:

- the texts in JSON (manifests, metadata, statistics, journals, text recordings) and in
  Stable-Baselines3's CSV have placeholders: `<home>`, `<path>`, `<user>`, `<host>`;
- of the surroundings of a recording, the command line keeps only names of files, the
  code neither its commit nor where it is, and variables no directories;
- of the device that drew a video its number is left, and where UUIDs of GPUs stood is
  `<gpu>`: each names a single card;
- names of files, where a uid, a camera or a prefix has the identity in it, have `user`
  or `host` instead, and whatever refers to them says the same;
- trajectories have other facts, and the same arrays (`amend_trajectory`);
- models have no comments, and compile to the same (`anonymous_models`);
- a compiled model that has the identity in it, which only its author could have
  loaded, is removed.

What is matched how, `identity_matching` says. Times stay, and so do all numbers, the
process id in a default uid among them.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...atomic_files import replacing
from ...errors import FileNotWritten, InvalidArgument
from ...formats.json_fields import unreadable
from ...formats.monitor_directory import FILE_PREFIX, Infix, infix_of, is_second_name
from ...formats.trajectory_file import amend_trajectory
from ...json_text import dumps, loads
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
    r"(?:[/~]|\.\.?/)[^\s\"':,;<>=]*|[^\s\"':,;<>=]*/[^\s\"':,;<>=/]*\.\w+"
)
_COMMIT = "<commit>"
# Of a card, or of a part of one; `CUDA_VISIBLE_DEVICES` takes a beginning too.
_GPU = re.compile(r"(?<![\w-])(?:GPU|MIG)-[0-9a-fA-F][0-9a-fA-F/-]*")


def make_anonymous(recordings: Path, *, identity: Identity) -> None:
    """Take an identity out of a monitor directory that is made of copies or links.

    Nothing is written in place: a file that is a hard link to an original is replaced
    by another one. After an error the directory is of no use.

    Args:
        recordings: the directory.
        identity: who and what must not be named.

    Raises:
        UnreadableFile: a file is damaged, so that nobody knows what is in it.
        InvalidArgument: two files would have the same name.
        FileNotWritten: the disk is full.
    """
    matcher = IdentityMatcher(identity)
    paths = sorted(path for path in recordings.iterdir() if path.is_file())
    texts = _Texts(matcher, [path.name for path in paths])
    for path in paths:
        _make_file_anonymous(path, texts, matcher)
    _rename(recordings, {path.name: texts.name(path.name) for path in paths})


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
        self._infix = re.compile(
            rf"(?<!\w)(?:{'|'.join(map(re.escape, olds))})(?![\w-])"
            if olds
            else r"(?!)"
        )

    def text(self, text: str) -> str:
        """Return a text without the identity."""
        if is_second_name(text) or _is_monitor_file(text):
            return self.name(text)
        return self._matcher.replaced(self._with_new_infixes(text))

    def name(self, name: str) -> str:
        """Return the new name of a file."""
        return self._matcher.replaced_in_name(self._with_new_infixes(name))

    def value(self, value: Any) -> Any:
        """Return a value of JSON without the identity."""
        match value:
            case str():
                return self.text(value)
            case list():
                return [self.value(item) for item in value]
            case dict():
                return {
                    self.text(key): self._member(key, item)
                    for key, item in value.items()
                }
            case _:
                return value

    def _member(self, key: str, value: Any) -> Any:
        if key == "surroundings" and isinstance(value, dict):
            return self.value(_general_surroundings(value))
        if key == "gl_device" and isinstance(value, dict):
            value = {k: v for k, v in value.items() if k not in ("uuid", "file")}
        return self.value(value)

    def _with_new_infixes(self, text: str) -> str:
        return self._infix.sub(lambda match: self._infixes[match[0]], text)


def _make_file_anonymous(path: Path, texts: _Texts, matcher: IdentityMatcher) -> None:
    name = path.name
    if _JSON.fullmatch(name):
        _rewrite(path, lambda data: _json(data, texts))
    elif name.endswith(".jsonl"):
        _rewrite(path, lambda data: b"".join(_json_lines(data, texts)))
    elif name.endswith(".csv"):
        _rewrite(path, lambda data: b"".join(_csv_lines(data, texts)))
    elif name.endswith(".h5"):
        with _writing(path):
            amend_trajectory(path, texts.value)
    elif name.startswith(_MODEL) and name.endswith(".zip"):
        _rewrite(path, lambda data: anonymous_sources(data, matcher))
    elif name.startswith(_MODEL) and matcher.found_in_bytes(compiled_model(path)):
        logger.info("%s is left out: it names whoever compiled it.", name)
        path.unlink()


def _rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    with unreadable(path):
        old = path.read_bytes()
        new = change(old)
    if new == old:
        return
    with _writing(path), replacing(path) as temporary:
        temporary.write_bytes(new)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error) from error


def _json(data: bytes, texts: _Texts) -> bytes:
    value = loads(data)
    new = texts.value(value)
    return data if new == value else dumps(new).encode()


def _json_lines(data: bytes, texts: _Texts) -> Iterator[bytes]:
    for line in data.splitlines(keepends=True):
        try:
            yield _json(line.rstrip(b"\n"), texts) + line[len(line.rstrip(b"\n")) :]
        except ValueError:
            # A torn one, which readers leave out, says nothing of the run.
            logger.info("A line of a journal that is no JSON is left out.")


def _csv_lines(data: bytes, texts: _Texts) -> Iterator[bytes]:
    for line in data.splitlines(keepends=True):
        if line.startswith(b"#"):
            yield b"#" + _json(line[1:].rstrip(b"\n"), texts) + b"\n"
        else:
            yield texts.text(line.decode()).encode()


def _general_surroundings(surroundings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what may be said of where a recording was made, whoever made it."""
    general = dict(surroundings)
    command = general.get("command")
    if isinstance(command, list):
        general["command"] = [_without_directories(item) for item in command]
    variables = general.get("variables")
    if isinstance(variables, Mapping):
        general["variables"] = {
            name: _general_variable(value) if isinstance(value, str) else value
            for name, value in variables.items()
        }
    code = general.get("code")
    if isinstance(code, Mapping):
        # Search engines find a commit.
        hidden = {"remote": None, "root": "<path>", "commit": _COMMIT}
        general["code"] = {**code, **{k: v for k, v in hidden.items() if k in code}}
    policy = general.get("policy")
    if isinstance(policy, Mapping) and isinstance(policy.get("file"), str):
        general["policy"] = {**policy, "file": os.path.basename(policy["file"])}  # noqa: PTH119  text
    if "working_directory" in general:
        general["working_directory"] = "<path>"
    return general


def _general_variable(value: str) -> str:
    return _GPU.sub("<gpu>", _DIRECTORY.sub("<path>", value))


def _without_directories(argument: Any) -> Any:
    if not isinstance(argument, str):
        return argument
    return _PATH_OF_FILE.sub(_base_name, argument)


def _base_name(match: re.Match[str]) -> str:
    return match[0].rstrip("/").rpartition("/")[2] or "<path>"


def _renamed_infixes(matcher: IdentityMatcher, names: list[str]) -> dict[str, str]:
    """Return the new infixes of monitors that must not have their old ones."""
    old = sorted({infix for name in names if (infix := infix_of(name)) is not None})
    new: dict[str, str] = {}
    taken = {infix for infix in old if matcher.replaced_in_name(infix) == infix}
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


def _is_monitor_file(text: str) -> bool:
    return text.startswith(f"{FILE_PREFIX}.") and not re.search(r"[/\s]", text)


def _rename(recordings: Path, names: Mapping[str, str]) -> None:
    if len(set(names.values())) < len(names):
        twice = [
            name for name in names.values() if list(names.values()).count(name) > 1
        ]
        raise InvalidArgument(
            f"Without the names of persons and machines in them, two files would be "
            f"called {twice[0]!r}. Record with other uids, or name the cameras "
            "otherwise."
        )
    for old, new in names.items():
        if old != new and (recordings / old).exists():
            (recordings / old).rename(recordings / new)
