# SPDX-License-Identifier: Apache-2.0
"""What names a person or a machine: of whoever packs, and of whoever recorded."""

from __future__ import annotations

import getpass
import logging
import os
import pwd
import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

_USER_VARIABLES = ("USER", "LOGNAME", "USERNAME", "SUDO_USER")
_HOST_VARIABLES = ("HOSTNAME", "HOST")
_PERSON_VARIABLES = ("GIT_AUTHOR_NAME", "GIT_COMMITTER_NAME")
_ADDRESS_VARIABLES = ("EMAIL", "GIT_AUTHOR_EMAIL", "GIT_COMMITTER_EMAIL")
_DIRECTORY_VARIABLES = ("PWD", "OLDPWD")

# What is shorter (`../x`) is no address, and could stand anywhere.
_SHORTEST_ADDRESS = 6

_GIT_SETTINGS = r"^(user\.(name|email)|remote\..*\.(url|pushurl))$"
_GIT_SECONDS = 10.0

# "Ada Lovelace <ada@example.org>", "Ada Lovelace (0000-0001-2345-6789)".
_ADDRESS_OF_AUTHOR = re.compile(r"[<(\[]\s*([^<>()\[\]]+?)\s*[>)\]]")
_ADDRESS = re.compile(r"[\w.+-]+@[\w-]+(?:\.[\w-]+)+")
_ORCID = re.compile(r"\b(?:\d{4}-){3}\d{3}[\dXx]\b")
# Where homes are, on Linux, on clusters and on a Mac.
HOME_OF_ANYBODY = r"/(?:[\w.-]+/)*?(?:home|Users)/[^/\s\"':,;<>]+"
_HOME = re.compile(rf"(?<!\w){HOME_OF_ANYBODY}")
_ABSOLUTE = re.compile(r"(?<![\w./])(/[^\s\"':,;<>=]+)")
# `git@host:owner/name.git`, `https://token@host/owner/name`.
_REPOSITORY = re.compile(
    r"(?:[a-z+]+://)?(?:[^@/\s]+@)?[^:/\s]+(?::\d+)?[:/]+(?P<path>.+?)(?:\.git)?/*"
)


@dataclass(frozen=True, kw_only=True)
class Identity:
    """The texts that name a person or a machine, each sorted and there once.

    Attributes:
        users: login names.
        people: full names, as their owners write them.
        addresses: of mail, and ORCIDs.
        hosts: names of machines, whole and without their domain.
        homes: absolute paths of home directories.
        directories: absolute paths of where the work is: working directories, roots of
            repositories, directories of policies and programs.
        remotes: URLs of git repositories, and their `owner/name`.
    """

    users: tuple[str, ...] = ()
    people: tuple[str, ...] = ()
    addresses: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    homes: tuple[str, ...] = ()
    directories: tuple[str, ...] = ()
    remotes: tuple[str, ...] = ()


def identity_of_user(
    surroundings: Mapping[str, Any] | Iterable[Mapping[str, Any]] = (),
    authors: Iterable[str] = (),
) -> Identity:
    """Return what names the user of this process, its machine, and who recorded.

    Asks the system, the environment variables, and git's settings in the working
    directory and in the recorded repositories; no name server.

    Args:
        surroundings: what the manifests say of where their recordings were made, which
            may have been another machine and another user; one, or one for each.
        authors: as `pack` takes them: "Name", "Name <address or ORCID>".
    """
    recorded = [surroundings] if isinstance(surroundings, Mapping) else surroundings
    found = _Found()
    found.add_system()
    found.add_variables(os.environ)
    directories = [_working_directory()]
    for one in recorded:
        found.add_surroundings(one)
        directories += _roots(one)
    for directory in dict.fromkeys(filter(None, directories)):
        found.add_git(directory)
    for author in authors:
        found.add_author(author)
    return found.identity()


class _Found:
    """What was found so far."""

    def __init__(self) -> None:
        self._texts: dict[str, set[str]] = {field.name: set() for field in _FIELDS}

    def identity(self) -> Identity:
        return Identity(
            **{name: tuple(sorted(texts)) for name, texts in self._texts.items()}
        )

    def add_system(self) -> None:
        self._add("users", _login())
        try:
            entry = pwd.getpwuid(os.geteuid())
        except KeyError:  # a container's user may have none
            entry = None
        if entry is not None:
            self._add("users", entry.pw_name)
            # Room, telephones and so on follow.
            self._add_person(entry.pw_gecos.split(",")[0])
            self._add("homes", entry.pw_dir)
        for name in _host_names():
            self._add_host(name)
        self._add("directories", _working_directory())

    def add_variables(self, variables: Mapping[str, Any]) -> None:
        for kind, names in (
            ("users", _USER_VARIABLES),
            ("directories", _DIRECTORY_VARIABLES),
            ("homes", ("HOME",)),
        ):
            for name in names:
                self._add(kind, variables.get(name))
        for name in _PERSON_VARIABLES:
            self._add_person(variables.get(name))
        for name in _ADDRESS_VARIABLES:
            self._add_address(variables.get(name))
        for name in _HOST_VARIABLES:
            self._add_host(variables.get(name))

    def add_surroundings(self, surroundings: Mapping[str, Any]) -> None:
        variables = surroundings.get("variables")
        if isinstance(variables, Mapping):
            self.add_variables(variables)
            for value in variables.values():
                self._add_homes_in(value)
        self._add_path(surroundings.get("working_directory"))
        code = surroundings.get("code")
        if isinstance(code, Mapping):
            self._add_path(code.get("root"))
            self._add_remote(code.get("remote"))
        policy = surroundings.get("policy")
        if isinstance(policy, Mapping):
            self._add_path_of_file(policy.get("file"))
        command = surroundings.get("command")
        for argument in command if isinstance(command, list) else ():
            self._add_homes_in(argument)
            if isinstance(argument, str):
                for path in _ABSOLUTE.findall(argument):
                    self._add_path_of_file(path)

    def add_git(self, directory: str) -> None:
        for key, value in _git_settings(directory):
            if key == "user.name":
                self._add_person(value)
            elif key == "user.email":
                self._add_address(value)
            else:
                self._add_remote(value)

    def add_author(self, author: str) -> None:
        for inside in _ADDRESS_OF_AUTHOR.findall(author):
            # An affiliation is a name too.
            is_address = "@" in inside or "://" in inside or _ORCID.search(inside)
            (self._add_address if is_address else self._add_person)(inside)
        for found in (*_ADDRESS.findall(author), *_ORCID.findall(author)):
            self._add_address(found)
        name = _ADDRESS_OF_AUTHOR.sub(" ", author)
        self._add_person(" ".join(_ADDRESS.sub(" ", name).split()))

    def _add(self, kind: str, text: object) -> None:
        if not isinstance(text, str) or not text.strip() or "\0" in text:
            return
        text = text.strip()
        if kind in ("homes", "directories"):
            text = os.path.normpath(text)
            # The root of everything, or /tmp, names nobody.
            if not text.startswith("/") or text in _EVERYBODYS:
                return
            self._add_homes_in(text)
            # Also what it is a link to: both are met in messages.
            self._texts[kind].add(os.path.realpath(text))
        self._texts[kind].add(text)

    def _add_host(self, name: object) -> None:
        if isinstance(name, str):
            self._add("hosts", name)
            self._add("hosts", name.split(".")[0])

    def _add_person(self, name: object) -> None:
        if isinstance(name, str):
            self._add("people" if " " in name.strip() else "users", name)

    def _add_address(self, address: object) -> None:
        if not isinstance(address, str):
            return
        if len(address) < _SHORTEST_ADDRESS:
            self._add_person(address)
            return
        self._add("addresses", address)
        for orcid in _ORCID.findall(address):
            self._add("addresses", orcid)
        if _ADDRESS.fullmatch(address):
            self._add("users", address.split("@")[0])

    def _add_remote(self, remote: object) -> None:
        if not isinstance(remote, str) or len(remote.strip()) < _SHORTEST_ADDRESS:
            return
        self._add("remotes", remote)
        self._add_homes_in(remote)
        match = _REPOSITORY.fullmatch(remote.strip())
        if match is None or remote.startswith("/"):
            return
        path = match["path"].strip("/")
        if "/" in path:
            self._add("remotes", path)
            self._add("users", path.split("/")[0])

    def _add_path(self, path: object) -> None:
        self._add("directories", path)

    def _add_path_of_file(self, path: object) -> None:
        if isinstance(path, str) and path.startswith("/"):
            directory = os.path.dirname(os.path.normpath(path))  # noqa: PTH120  text, of another machine perhaps
            # Where programs are is the same for everybody.
            if not directory.startswith(_SHARED):
                self._add_path(directory)
            self._add_homes_in(path)

    def _add_homes_in(self, text: object) -> None:
        if isinstance(text, str):
            for match in _HOME.finditer(text):
                self._texts["homes"].add(match[0])
                self._texts["users"].add(match[0].rpartition("/")[2])


_FIELDS = fields(Identity)
_EVERYBODYS = frozenset(
    ("/", "/tmp", "/var/tmp", "/home", "/Users", "/usr", "/opt", "/var", "/dev/shm")
)
_SHARED = ("/usr", "/bin", "/sbin", "/lib", "/opt", "/etc", "/proc", "/sys", "/dev")


def _login() -> str | None:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # nobody says it; which of them, depends on Python
        return None


def _host_names() -> Iterator[str]:
    name = os.uname().nodename
    yield name
    # The whole name of the machine, where it has one that needs no name server.
    try:
        lines = Path("/etc/hosts").read_text(errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        _, *names = line.partition("#")[0].split() or [""]
        if name in names:
            yield from names


def _working_directory() -> str | None:
    try:
        return str(Path.cwd())
    except OSError:  # it was removed
        return None


def _roots(surroundings: Mapping[str, Any]) -> list[str]:
    """Return the recorded repository and working directory, where they are here."""
    code = surroundings.get("code")
    root = code.get("root") if isinstance(code, Mapping) else None
    candidates = (root, surroundings.get("working_directory"))
    return [str(path) for path in candidates if _is_directory(path)]


def _is_directory(path: object) -> bool:
    # A null character, which a file may name, is a ValueError.
    try:
        return isinstance(path, str) and path.startswith("/") and Path(path).is_dir()
    except (OSError, ValueError):
        return False


def _git_settings(directory: str) -> list[tuple[str, str]]:
    command = ["git", "-C", directory, "config", "--null", "--get-regexp"]
    try:
        done = subprocess.run(
            [*command, _GIT_SETTINGS],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_GIT_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        logger.debug("git says nothing of %s: %s", directory, error)
        return []
    settings = done.stdout.decode(errors="replace").split("\0")
    pairs = (setting.partition("\n") for setting in settings)
    return [(key.lower(), value) for key, newline, value in pairs if newline]
