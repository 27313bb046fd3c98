# SPDX-License-Identifier: Apache-2.0
"""All errors of mjrec, as a tree.

::

    Error (Exception)
    ├── InvalidArgument (also ValueError)   a wrong value
    │   ├── UnknownName                     no such environment, camera, policy ...
    │   └── InvalidFrame                    not a (height, width, 3) uint8 array
    ├── ExistingRecordings                  neither force nor resume was asked for
    ├── DirectoryInUse                      another live monitor writes there
    ├── DirectoryNotWritable (also OSError) cannot be created or written to
    ├── FileNotWritten (also OSError)       such as a full disk
    ├── DifferentEnvironment                resume over another environment
    ├── DifferentEvaluation                 resume with other options
    ├── EnvironmentNotMade                  making a known environment failed
    ├── NotPicklable (also TypeError)       a monitor belongs to its process
    ├── NoPictures                          the environment cannot be drawn
    ├── PicturesDiffer                      frames do not follow from the state
    ├── ResetNeeded                         step before reset or after the end
    ├── ResetNotAllowed                     reset in the middle of an episode
    ├── ClosedError                         used after close()
    ├── EncoderError                        ffmpeg failed or died
    │   └── FrameCountError                 the finished file lacks or doubles frames
    ├── RenderError                         videos could not be rendered
    ├── BlankVideo                          strict=True: the video shows nothing
    ├── GLError                             no backend renders, or the wrong one
    ├── PolicyError                         a policy raised or gave a bad action
    ├── ArchiveError                        write_archive's checks
    ├── PackError                           a run cannot be packed as asked
    │   ├── UnfinishedRecordings            render or recover first
    │   ├── ArchiveTooLarge                 exceeds max_size
    │   └── IdentityLeft                    anonymous=True: a name is left
    ├── UnreadableFile                      a damaged or foreign file
    │   ├── UnreadableArchive               given to `mjrec verify`
    │   └── UntrustedModel                  a stranger's, without its sources
    └── MissingDependency (also ImportError)  an extra is not installed

Every message says what was asked, what is there, and what to do.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


class Error(Exception):
    """Base of every error that mjrec raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        # The subclasses take facts and make the message of them; pickle (an error
        # that comes home from a worker process) would call them with the message.
        return rebuilt, (type(self), str(self), vars(self))


def rebuilt(kind: type[Error], message: str, facts: Mapping[str, Any]) -> Error:
    """Return an error that was carried from another process."""
    error = kind.__new__(kind)
    error.args = (message,)
    vars(error).update(facts)
    return error


_MOST_NAMES = 20


def _first_of(names: Sequence[str], count: int, *, between: str = ", ") -> str:
    """Return some names, and how many there are besides."""
    more = len(names) - count
    shown = between.join(names[:count])
    return f"{shown} and {more} more" if more > 0 else shown


class InvalidArgument(Error, ValueError):
    """An argument has a value that cannot be."""


class UnknownName(InvalidArgument):
    """A name that stands for nothing.

    Attributes:
        kind: what was looked for, for example `"camera"`.
        name: the name asked for.
        available: the names there are.
    """

    def __init__(
        self, kind: str, name: object, available: Iterable[str], *, hint: str = ""
    ) -> None:
        self.kind = kind
        self.name = name
        self.available = list(available)
        shown, label = self.available, "There are"
        if len(shown) > _MOST_NAMES:
            shown = difflib.get_close_matches(str(name), self.available, _MOST_NAMES)
            label = "Names like it"
        listed = f"{label}: {', '.join(shown)}."
        if not self.available:
            listed = "There are none."
        elif not shown:
            listed = f"There are {len(self.available)}, none with a like name."
        super().__init__(f"There is no {kind} {name!r}. {listed} {hint}".rstrip())


class InvalidFrame(InvalidArgument):
    """A frame that is not a `(height, width, 3) uint8` array."""


class ExistingRecordings(Error):
    """The directory holds recordings and neither `force` nor `resume` was given.

    Attributes:
        directory: the directory asked for.
        names: the base names of the monitor files in it.
    """

    def __init__(self, directory: Path, names: Sequence[str]) -> None:
        self.directory = directory
        self.names = list(names)
        super().__init__(
            f"{directory} holds recordings already: {_first_of(names, 5)}. Use a "
            "directory of its own for each run, resume=True (--resume) to add to these "
            "recordings, or force=True (--force) to delete them."
        )


class DirectoryInUse(Error):
    """Another monitor, which is still open, writes into the directory."""


class DirectoryNotWritable(Error, OSError):
    """The directory cannot be made or written to."""

    def __init__(self, directory: Path, reason: object) -> None:
        self.directory = directory
        super().__init__(
            f"Cannot write into {directory}: {reason}. Choose a directory that this "
            "user may write to."
        )


class FileNotWritten(Error, OSError):
    """A file could not be written: the disk is full, or the directory is gone.

    Attributes:
        path: the file.
    """

    def __init__(
        self,
        path: Path,
        reason: object,
        *,
        then: str = "the next close() or `mjrec render` tries again",
    ) -> None:
        self.path = path
        super().__init__(
            f"Cannot write {path}: {reason}. What is there stays as it is; where space "
            f"was lacking, free some: {then}."
        )


class DifferentEnvironment(Error):
    """`resume=True` over recordings of another environment."""

    def __init__(self, directory: Path, recorded: str, asked: str) -> None:
        self.recorded = recorded
        self.asked = asked
        super().__init__(
            f"{directory} holds recordings of {recorded}, but this monitor records "
            f"{asked}. Use another directory: results of two environments cannot share "
            "one."
        )


class DifferentEvaluation(Error):
    """`resume=True` of an evaluation that was started with other options.

    Attributes:
        directory: of the evaluation.
        differences: pairs of old and new value, by option.
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
            f"The evaluation in {directory} was started with other options: {listed}. "
            "Use the same options, or another directory."
        )


class EnvironmentNotMade(Error):
    """A known environment could not be made; the cause is kept.

    Attributes:
        name: the environment's name.
    """

    def __init__(self, name: str, reason: object, *, hint: str = "") -> None:
        self.name = name
        text = f"Making {name} failed: {reason}"
        super().__init__(f"{text.rstrip('. ')}. {hint}".rstrip())


class NotPicklable(Error, TypeError):
    """A monitor cannot be sent to another process or copied."""


class NoPictures(Error):
    """Videos are wanted, but the environment gives no frames."""


class PicturesDiffer(Error):
    """What an environment shows cannot be drawn from its recorded state."""


class RenderError(Error):
    """Videos could not be rendered from their recorded states.

    Attributes:
        directory: where the recordings are.
        failures: the reasons, by the names of the videos.
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
            f"{reasons} Their states are kept. To try again: mjrec render {directory}"
        )


class BlankVideo(Error):
    """With `strict=True`: a complete video shows nothing.

    Attributes:
        path: the video; it is kept, with its metadata.
        frame_count: number of frames.
        suspicion: what is wrong.
    """

    def __init__(self, path: Path, *, frame_count: int, suspicion: str) -> None:
        self.path = path
        self.frame_count = frame_count
        self.suspicion = suspicion
        super().__init__(
            f"{path} shows nothing: {suspicion}. The file is kept. Check the model's "
            "lights and camera, and OpenGL with `mjrec doctor`. Without strict "
            "(--strict) this is a warning."
        )


class ResetNeeded(Error):
    """`step` before the first `reset`, or after the end of an episode."""


class ResetNotAllowed(Error):
    """`reset` in the middle of an episode, without `allow_early_reset=True`."""


class ClosedError(Error):
    """A writer or recorder was used after it was closed."""


class EncoderError(Error):
    """ffmpeg failed or died.

    Attributes:
        command: its arguments.
        returncode: its exit status; negative is the signal that killed it.
        stderr: the end of its output.
    """

    def __init__(
        self, what: str, *, command: Sequence[str], returncode: int | None, stderr: str
    ) -> None:
        self.command = list(command)
        self.returncode = returncode
        self.stderr = stderr
        output = stderr.strip() or "(nothing)"
        super().__init__(
            f"{what} ffmpeg's exit status: {returncode}. It was started as: "
            f"{' '.join(self.command)}. Its last output: {output}"
        )


class FrameCountError(EncoderError):
    """The finished video does not hold the frames that were written."""


class GLError(Error):
    """No OpenGL backend renders here, or another one is already in use."""


class PolicyError(Error):
    """A policy cannot be built, raised, or gave an invalid action."""


class ArchiveError(Error):
    """A check of `write_archive` failed; nothing was written."""


class PackError(Error):
    """A run cannot be packed as asked; nothing was written."""


class UnfinishedRecordings(PackError):
    """Recordings are not finished.

    Attributes:
        directory: where the recordings are.
        names: base names of unfinished files.
    """

    def __init__(self, directory: Path, names: Sequence[str], *, advice: str) -> None:
        self.directory = directory
        self.names = list(names)
        listed = _first_of(names, 5)
        super().__init__(
            f"The recordings in {directory} are not finished: {listed}. {advice}"
        )


class ArchiveTooLarge(PackError):
    """A packed run would exceed the limit, even with smaller videos.

    Attributes:
        size: least size of the smallest archive that was tried, in bytes.
        limit: the limit in bytes.
        largest: names and sizes of its largest files.
    """

    def __init__(
        self, size: int, limit: int, largest: Sequence[tuple[str, int]], *, reason: str
    ) -> None:
        self.size = size
        self.limit = limit
        self.largest = list(largest)
        listed = "".join(f"\n  {size:>12}  {name}" for name, size in self.largest)
        super().__init__(
            f"The packed run would have {size} bytes at least, and max_size allows "
            f"{limit}. "
            f"{reason} Choose episodes (episodes=[0, 8], --episodes 0,8), or allow "
            f"more. The largest files, in bytes:{listed}"
        )


class IdentityLeft(PackError):
    """With `anonymous=True`: the archive would still name a person or machine.

    Attributes:
        found: files, each with what was found in it.
    """

    def __init__(self, found: Sequence[tuple[str, str]]) -> None:
        self.found = list(found)
        listed = _first_of(
            [f"{name}: {what}" for name, what in found], 10, between="; "
        )
        super().__init__(
            f"The packed run would not be anonymous, so it was not written: {listed}. "
            "Record again without these names (uid, camera, body, title), or leave out "
            "the episodes that have them."
        )


class UnreadableFile(Error):
    """A file is damaged, or not what its name says.

    Attributes:
        path: the file.
        reason: what is wrong with it.
    """

    _message = "Cannot read {path}: {reason}."
    _advice = " To read the other files of its directory, move this one away."

    def __init__(self, path: Path, reason: object) -> None:
        self.path = path
        self.reason = str(reason)
        # Nothing can be moved away that is not there.
        advice = self._advice if os.path.lexists(path) else ""
        super().__init__(self._message.format(path=path, reason=reason) + advice)


class UnreadableArchive(UnreadableFile):
    """The file to verify is no packed run, or is damaged."""

    _message = "Cannot verify {path}: {reason}."
    _advice = (
        " It may be incomplete, or was packed again by another program: ask for the "
        "file that `mjrec pack` wrote."
    )


class UntrustedModel(UnreadableFile):
    """A compiled model that a stranger may have written is not loaded.

    Attributes:
        path: of the model.
        reason: why its sources cannot be used, and how to trust it.
    """

    _message = "The model {path} is not loaded: {reason}."
    _advice = ""


class MissingDependency(Error, ImportError):
    """An optional package is needed and not installed."""

    def __init__(self, package: str, *, purpose: str, install: str) -> None:
        self.package = package
        super().__init__(
            f"{purpose} needs {package}, which is not installed. Run: {install}"
        )


KINDS: Mapping[str, type[Error]] = {
    name: kind
    for name, kind in list(globals().items())
    if isinstance(kind, type) and issubclass(kind, Error)
}
# For the package, whose public names all of these are.
__all__ = [*KINDS]
