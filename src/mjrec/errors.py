# SPDX-License-Identifier: Apache-2.0
"""mjrec's exceptions, as a tree.

::

    Error (Exception)
    ├── InvalidArgument (also ValueError)   an invalid value
    │   ├── UnknownName                     no such environment, camera, policy ...
    │   └── InvalidFrame                    not a (height, width, 3) uint8 array
    ├── ExistingRecordings                  neither force nor resume was given
    ├── DirectoryInUse                      another open monitor writes there
    ├── DirectoryNotWritable (also OSError) cannot be created or written to
    ├── FileNotWritten (also OSError)       for example, the disk is full
    ├── DifferentEnvironment                resume with a different environment
    ├── DifferentEvaluation                 resume with different options
    ├── EnvironmentNotMade                  creating a known environment failed
    ├── NotPicklable (also TypeError)       a monitor belongs to its process
    ├── NoPictures                          the environment provides no frames
    ├── PicturesDiffer                      the state does not determine the frames
    ├── ResetNeeded                         step before reset or after the end
    ├── ResetNotAllowed                     reset in the middle of an episode
    ├── ClosedError                         used after close()
    ├── EncoderError                        ffmpeg failed or died
    │   └── FrameCountError                 the finished file lacks or repeats frames
    ├── RenderError                         videos could not be rendered
    ├── BlankVideo                          strict=True: the video shows nothing
    ├── GLError                             no backend works, or the wrong one is loaded
    ├── PolicyError                         a policy failed or gave an invalid action
    ├── ArchiveError                        a check of write_archive failed
    ├── PackError                           a run cannot be packed as requested
    │   ├── UnfinishedRecordings            render or recover first
    │   ├── ArchiveTooLarge                 exceeds max_size
    │   └── IdentityLeft                    anonymous=True: a name remains
    ├── UnreadableFile                      a damaged file, or the wrong kind of file
    │   ├── UnreadableArchive               `mjrec verify` cannot read the archive
    │   └── UntrustedModel                  an untrusted model without its sources
    └── MissingDependency (also ImportError)  an extra is not installed

Every message says what was requested, what was found, and what to do.
"""

from __future__ import annotations

import difflib
import importlib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .plain_text import listed


class Error(Exception):
    """Base class of all errors that mjrec raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Subclasses build the message from their arguments, but pickle (used for errors
        # from worker processes) would call them with the finished message.
        return rebuilt, (type(self), str(self), vars(self))


def rebuilt(kind: type[Error], message: str, facts: Mapping[str, Any]) -> Error:
    """Rebuild an error that came from another process."""
    error = kind.__new__(kind)
    error.args = (message,)
    vars(error).update(facts)
    return error


_MOST_NAMES = 20


class InvalidArgument(Error, ValueError):
    """An argument has an invalid value."""


class UnknownName(InvalidArgument):
    """A name that does not exist.

    Attributes:
        kind: what was looked up, for example `"camera"`.
        name: the requested name.
        available: the names that exist.
    """

    def __init__(
        self, kind: str, name: object, available: Iterable[str], *, hint: str = ""
    ) -> None:
        self.kind = kind
        self.name = name
        self.available = list(available)
        shown, label = self.available, "Available"
        if len(shown) > _MOST_NAMES:
            shown = difflib.get_close_matches(str(name), self.available, _MOST_NAMES)
            label = "Similar names"
        listed = f"{label}: {', '.join(shown)}."
        if not self.available:
            listed = "There are none."
        elif not shown:
            listed = f"None of the {len(self.available)} known names is similar."
        super().__init__(f"There is no {kind} {name!r}. {listed} {hint}".rstrip())


class InvalidFrame(InvalidArgument):
    """A frame that is not a `(height, width, 3) uint8` array."""


class ExistingRecordings(Error):
    """The directory contains recordings and neither `force` nor `resume` was given.

    Attributes:
        directory: the requested directory.
        names: the base names of the monitor files in the directory.
    """

    def __init__(self, directory: Path, names: Sequence[str]) -> None:
        self.directory = directory
        self.names = list(names)
        super().__init__(
            f"{directory} already contains recordings: {listed(names, 5)}. Use a "
            "separate directory for each run, resume=True (--resume) to add to these "
            "recordings, or force=True (--force) to delete them."
        )


class DirectoryInUse(Error):
    """Another monitor is still open and writing to the directory."""


class DirectoryNotWritable(Error, OSError):
    """The directory cannot be created or written to."""

    def __init__(self, directory: Path, reason: object) -> None:
        self.directory = directory
        super().__init__(
            f"Cannot write to {directory}: {reason}. Choose a directory that you have "
            "permission to write to."
        )


class FileNotWritten(Error, OSError):
    """A file could not be written: the disk is full, or the directory is missing.

    Attributes:
        path: the file.
    """

    def __init__(
        self,
        path: Path,
        reason: object,
        *,
        then: str = "the next close() or `mjrec render` will retry",
    ) -> None:
        self.path = path
        super().__init__(
            f"Cannot write {path}: {reason}. Existing files are unchanged. If the disk "
            f"is full, free some space; {then}."
        )


class DifferentEnvironment(Error):
    """`resume=True` was given for recordings of a different environment."""

    def __init__(self, directory: Path, recorded: str, asked: str) -> None:
        self.recorded = recorded
        self.asked = asked
        super().__init__(
            f"{directory} contains recordings of {recorded}, but this monitor records "
            f"{asked}. Use another directory, because one directory cannot hold the "
            "results of two environments."
        )


class DifferentEvaluation(Error):
    """`resume=True` was given for an evaluation started with different options.

    Attributes:
        directory: the evaluation's directory.
        differences: pairs of old and new values, keyed by option.
    """

    def __init__(
        self, directory: Path, differences: Mapping[str, tuple[object, object]]
    ) -> None:
        self.directory = directory
        self.differences = dict(differences)
        listed = "; ".join(
            f"{name} was {begun!r} and is now {asked!r}"
            for name, (begun, asked) in self.differences.items()
        )
        super().__init__(
            f"The evaluation in {directory} was started with different options: "
            f"{listed}. Use the same options, or another directory."
        )


class EnvironmentNotMade(Error):
    """A known environment could not be created; the cause is chained.

    Attributes:
        name: the environment's name.
    """

    def __init__(self, name: str, reason: object, *, hint: str = "") -> None:
        self.name = name
        text = f"Could not create {name}: {reason}"
        super().__init__(f"{text.rstrip('. ')}. {hint}".rstrip())


class NotPicklable(Error, TypeError):
    """A monitor cannot be sent to another process or copied."""


class NoPictures(Error):
    """Videos were requested, but the environment provides no frames."""


class PicturesDiffer(Error):
    """An environment's frames cannot be reproduced from its recorded state."""


class RenderError(Error):
    """Videos could not be rendered from their recorded states.

    Attributes:
        directory: the directory of the recordings.
        failures: the reasons, keyed by video name.
    """

    def __init__(self, directory: Path, failures: Mapping[str, str]) -> None:
        self.directory = directory
        self.failures = dict(failures)
        names = dict.fromkeys(self.failures.values(), "")
        for name, why in self.failures.items():
            names[why] += f", {name}" if names[why] else name
        reasons = "; ".join(f"{listed}: {why}" for why, listed in names.items())
        super().__init__(
            f"{len(self.failures)} of the videos in {directory} could not be rendered: "
            f"{reasons} Their states are kept. To retry, run: mjrec render {directory}"
        )


class BlankVideo(Error):
    """A complete video shows nothing, and `strict=True` was given.

    Attributes:
        path: the video, which is kept together with its metadata.
        frame_count: number of frames.
        suspicion: a description of the problem.
    """

    def __init__(self, path: Path, *, frame_count: int, suspicion: str) -> None:
        self.path = path
        self.frame_count = frame_count
        self.suspicion = suspicion
        super().__init__(
            f"{path} shows nothing: {suspicion}. The file is kept. Check the model's "
            "lights and camera, and run `mjrec doctor` to check OpenGL. Without strict "
            "(--strict) this is only a warning."
        )


class ResetNeeded(Error):
    """`step` was called before the first `reset` or after the end of an episode."""


class ResetNotAllowed(Error):
    """`reset` was called during an episode, without `allow_early_reset=True`."""


class ClosedError(Error):
    """A writer or recorder was used after it was closed."""


class EncoderError(Error):
    """ffmpeg failed or died.

    Attributes:
        command: ffmpeg's command line.
        returncode: ffmpeg's exit status, or -N if signal N killed it.
        stderr: the end of ffmpeg's output.
    """

    def __init__(
        self, what: str, *, command: Sequence[str], returncode: int | None, stderr: str
    ) -> None:
        self.command = list(command)
        self.returncode = returncode
        self.stderr = stderr
        output = stderr.strip() or "(nothing)"
        super().__init__(
            f"{what} ffmpeg's exit status: {returncode}. Command: "
            f"{' '.join(self.command)}. Its last output: {output}"
        )


class FrameCountError(EncoderError):
    """The finished video does not contain exactly the frames that were written."""


class GLError(Error):
    """No OpenGL backend works here, or the wrong backend is already in use."""


class PolicyError(Error):
    """A policy could not be built, failed, or returned an invalid action."""


class ArchiveError(Error):
    """A check of `write_archive` failed; nothing was written."""


class PackError(Error):
    """A run cannot be packed as requested; nothing was written."""


class UnfinishedRecordings(PackError):
    """The recordings are not finished.

    Attributes:
        directory: the directory of the recordings.
        names: base names of the unfinished files.
    """

    def __init__(self, directory: Path, names: Sequence[str], *, advice: str) -> None:
        self.directory = directory
        self.names = list(names)
        shown = listed(names, 5)
        super().__init__(
            f"The recordings in {directory} are not finished: {shown}. {advice}"
        )


class ArchiveTooLarge(PackError):
    """A packed run would exceed the limit, even with smaller videos.

    Attributes:
        size: lower bound on the size of the smallest archive tried, in bytes.
        limit: the limit in bytes.
        largest: names and sizes of that archive's largest files.
    """

    def __init__(
        self, size: int, limit: int, largest: Sequence[tuple[str, int]], *, reason: str
    ) -> None:
        self.size = size
        self.limit = limit
        self.largest = list(largest)
        listed = "".join(f"\n  {size:>12}  {name}" for name, size in self.largest)
        super().__init__(
            f"The packed run would take at least {size} bytes, but max_size allows "
            f"only {limit}. "
            f"{reason} Pack fewer episodes (episodes=[0, 8], --episodes 0,8), or raise "
            f"max_size. The largest files, in bytes:{listed}"
        )


class IdentityLeft(PackError):
    """The archive would still name a person or machine despite `anonymous=True`.

    Attributes:
        found: pairs of a file and the name found in it.
    """

    def __init__(self, found: Sequence[tuple[str, str]]) -> None:
        self.found = list(found)
        shown = listed([f"{name}: {what}" for name, what in found], 10, between="; ")
        super().__init__(
            f"The packed run would not be anonymous, so it was not written: {shown}. "
            "Change the title, record again without these names (uid, camera, body), "
            "or leave out the episodes that contain them."
        )


class UnreadableFile(Error):
    """A file is damaged, or not what its name suggests.

    Attributes:
        path: the file.
        reason: what is wrong with the file.
    """

    _message = "Cannot read {path}: {reason}."
    _advice = " To read the other files in its directory, move this one away."

    def __init__(self, path: Path, reason: object) -> None:
        self.path = path
        self.reason = str(reason)
        # A file that does not exist cannot be moved away.
        advice = self._advice if os.path.lexists(path) else ""
        super().__init__(self._message.format(path=path, reason=reason) + advice)


class UnreadableArchive(UnreadableFile):
    """The file to verify is not a packed run, or is damaged."""

    _message = "Cannot verify {path}: {reason}."
    _advice = (
        " It may be incomplete, or may have been repacked by another program: ask for "
        "the original file from `mjrec pack`."
    )


class UntrustedModel(UnreadableFile):
    """A compiled model from an untrusted source was not loaded.

    Attributes:
        path: the model's path.
        reason: why its sources cannot be used, and how to trust the model.
    """

    _message = "The model {path} was not loaded: {reason}."
    _advice = ""


class MissingDependency(Error, ImportError):
    """An optional package or program is needed, but missing or unusable.

    Args:
        package: the dependency's name.
        purpose: the feature that needs it.
        install: the command that installs it.
        reason: why it is unusable; None if it is not installed.
    """

    def __init__(
        self, package: str, *, purpose: str, install: str, reason: str | None = None
    ) -> None:
        self.package = package
        what = "which is not installed" if reason is None else f"but {reason}"
        super().__init__(f"{purpose} needs {package}, {what}. Run: {install}")


def optional_module(name: str, *, purpose: str, install: str) -> Any:
    """Import a module of a package that is optional.

    Args:
        name: the module's name.
        purpose: see `MissingDependency`.
        install: what pip installs.

    Raises:
        MissingDependency: the package is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        # The package may be there, and lack one that it needs itself.
        if not f"{name}.".startswith(f"{error.name}."):
            raise
        package = name.partition(".")[0]
        raise MissingDependency(
            package, purpose=purpose, install=f'pip install "{install}"'
        ) from error


KINDS: Mapping[str, type[Error]] = {
    name: kind
    for name, kind in list(globals().items())
    if isinstance(kind, type) and issubclass(kind, Error)
}
# The package exports all of these.
__all__ = [*KINDS]
