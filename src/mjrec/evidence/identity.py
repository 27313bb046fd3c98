# SPDX-License-Identifier: Apache-2.0
"""Names of people and machines: those who recorded, and the user who packs."""

from __future__ import annotations

import getpass
import logging
import os
import pwd
import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..formats.json_fields import facts_in
from .statements import Author

logger = logging.getLogger(__name__)

_VARIABLES = {
    "users": ("USER", "LOGNAME", "USERNAME", "SUDO_USER"),
    "people": ("GIT_AUTHOR_NAME", "GIT_COMMITTER_NAME"),
    "addresses": ("EMAIL", "GIT_AUTHOR_EMAIL", "GIT_COMMITTER_EMAIL"),
    "hosts": ("HOSTNAME", "HOST"),
    "homes": ("HOME",),
    "directories": ("PWD", "OLDPWD"),
}
_GIT_SETTINGS = r"^(user\.(name|email)|remote\..*\.(url|pushurl))$"
_GIT_SECONDS = 10.0

# Shorter remotes (`../x`) could match anywhere.
_SHORTEST_REMOTE = 6
# Home directories on Linux, on clusters and on macOS.
HOME_OF_ANYBODY = r"/(?:[\w.-]+/)*?(?:home|Users)/[^/\s\"':,;<>]+"
_HOME = re.compile(rf"(?<!\w){HOME_OF_ANYBODY}")
_ABSOLUTE = re.compile(r"(?<![\w./])(/[^\s\"':,;<>=]+)")
# `git@host:owner/name.git`, `https://token@host/owner/name`.
_REPOSITORY = re.compile(
    r"(?:[a-z+]+://)?(?:[^@/\s]+@)?[^:/\s]+(?::\d+)?[:/]+"
    r"(?P<path>(?P<owner>[^/]+)/.+?)(?:\.git)?/*"
)
_AFFILIATION = re.compile(r"\s*[(\[].*?[)\]]")
# Directories that do not identify a person. Below _SHARED are programs, the same for
# all users.
_EVERYBODYS = frozenset(
    ("/", "/tmp", "/var/tmp", "/home", "/Users", "/usr", "/opt", "/var", "/dev/shm")
)
_SHARED = ("/usr", "/bin", "/sbin", "/lib", "/opt", "/etc", "/proc", "/sys", "/dev")


@dataclass(frozen=True, kw_only=True)
class Identity:
    """The strings that name a person or a machine.

    Attributes:
        users: login names.
        people: full names, as their owners write them.
        addresses: email addresses and ORCIDs.
        hosts: host names, with and without their domain.
        homes: absolute paths of home directories.
        directories: absolute paths of the user's work: working directories, roots of
            repositories, directories of policies and programs.
        remotes: URLs of git repositories, and the `owner/name` in them.
    """

    users: set[str] = field(default_factory=set)
    people: set[str] = field(default_factory=set)
    addresses: set[str] = field(default_factory=set)
    hosts: set[str] = field(default_factory=set)
    homes: set[str] = field(default_factory=set)
    directories: set[str] = field(default_factory=set)
    remotes: set[str] = field(default_factory=set)

    def add(self, kind: str, value: object) -> None:
        """Add a string and the names derived from it; ignore any other value."""
        text = value.strip() if isinstance(value, str) else ""
        if not text or "\0" in text:
            return
        for home in _HOME.findall(text):
            self.homes.add(home)
            self.users.add(home.rpartition("/")[2])
        match kind:
            case "homes" | "directories":
                path = os.path.normpath(text)
                if path.startswith("/") and path not in _EVERYBODYS:
                    # Messages may contain the path itself or the target of a link.
                    getattr(self, kind).update((path, os.path.realpath(path)))
            case "people" if " " not in text:
                self.users.add(text)
            case "addresses":
                self.addresses.add(text)
                if "@" in text:
                    self.users.add(text.split("@")[0])
            case "hosts":
                self.hosts.update((text, text.split(".")[0]))
            case "remotes":
                self._add_remote(text)
            case _:
                getattr(self, kind).add(text)

    def _add_remote(self, remote: str) -> None:
        if len(remote) < _SHORTEST_REMOTE:
            return
        self.remotes.add(remote)
        match = _REPOSITORY.fullmatch(remote)
        if match is not None and not remote.startswith("/"):
            self.remotes.add(match["path"].strip("/"))
            self.users.add(match["owner"])


def identity_of_user(
    provenance: Iterable[Mapping[str, Any]] = (), authors: Iterable[Author] = ()
) -> Identity:
    """Return the names of this user, of this machine, and of the people who recorded.

    They come from the system, the environment variables, and git's settings in the
    working directory and in the recorded repositories. No name server is queried.

    Args:
        provenance: the provenance in the recordings' manifests, which may be from a
            different machine and a different user.
        authors: the stated authors.
    """
    identity = Identity()
    _add_system(identity)
    _add_variables(identity, os.environ)
    directories = [_working_directory()]
    for said in provenance:
        _add_provenance(identity, said)
        root = facts_in(said.get("code")).get("root")
        directories += [root, said.get("working_directory")]
    for directory in dict.fromkeys(filter(_is_directory, directories)):
        for key, value in _git_settings(directory):
            kind = {"user.name": "people", "user.email": "addresses"}
            identity.add(kind.get(key, "remotes"), value)
    for author in authors:
        identity.add("people", _AFFILIATION.sub("", author.name))
        for inside in _AFFILIATION.findall(author.name):
            identity.add("people", inside.strip(" ()[]"))
        identity.add("addresses", author.email)
        if author.orcid:
            identity.add("addresses", author.orcid.rpartition("/")[2])
    return identity


def _add_system(identity: Identity) -> None:
    try:
        identity.add("users", getpass.getuser())
    except (KeyError, OSError):  # which of the two depends on Python's version
        logger.debug("This process has no login name.")
    try:
        entry = pwd.getpwuid(os.geteuid())
    except KeyError:  # a container's user may have none
        pass
    else:
        identity.add("users", entry.pw_name)
        # Office, telephone numbers and so on follow the name.
        identity.add("people", entry.pw_gecos.split(",")[0])
        identity.add("homes", entry.pw_dir)
    for name in _host_names():
        identity.add("hosts", name)
    identity.add("directories", _working_directory())


def _add_variables(identity: Identity, variables: Mapping[str, Any]) -> None:
    for kind, names in _VARIABLES.items():
        for name in names:
            identity.add(kind, variables.get(name))


def _add_provenance(identity: Identity, said: Mapping[str, Any]) -> None:
    variables, code = facts_in(said.get("variables")), facts_in(said.get("code"))
    _add_variables(identity, variables)
    identity.add("directories", said.get("working_directory"))
    identity.add("directories", code.get("root"))
    identity.add("remotes", code.get("remote"))
    command = said.get("command")
    texts = [*variables.values(), *(command if isinstance(command, list) else ())]
    files = [facts_in(said.get("policy")).get("file")]
    for text in texts:
        if isinstance(text, str):
            # Only homes: a variable may be a list of directories that all users share.
            for home in _HOME.findall(text):
                identity.add("homes", home)
    for argument in texts[len(variables) :]:
        files += _ABSOLUTE.findall(argument) if isinstance(argument, str) else []
    for file in files:
        if isinstance(file, str) and file.startswith("/"):
            directory = os.path.dirname(os.path.normpath(file))  # noqa: PTH120  a string, maybe from another machine
            if not directory.startswith(_SHARED):
                identity.add("directories", directory)


def _host_names() -> Iterator[str]:
    name = os.uname().nodename
    yield name
    # The machine's full name, if /etc/hosts contains it.
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


def _is_directory(path: Any) -> bool:
    # A recorded path may contain a null character, which raises ValueError.
    try:
        return isinstance(path, str) and path.startswith("/") and Path(path).is_dir()
    except (OSError, ValueError):
        return False


def _git_settings(directory: Any) -> list[tuple[str, str]]:
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
        logger.debug("Git's settings in %s cannot be read: %s", directory, error)
        return []
    settings = done.stdout.decode(errors="replace").split("\0")
    pairs = (setting.partition("\n") for setting in settings)
    return [(key.lower(), value) for key, newline, value in pairs if newline]
