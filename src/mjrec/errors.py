# SPDX-License-Identifier: Apache-2.0
"""What can go wrong, as one tree.

::

    Error (Exception)
    ├── InvalidArgument (also ValueError)   a value that cannot be
    │   ├── UnknownName                     no such environment, camera, policy ...
    │   └── InvalidFrame                    not a (height, width, 3) uint8 picture
    ├── ExistingRecordings                  neither force nor resume was asked for
    ├── DirectoryInUse                      another live monitor writes there
    ├── DirectoryNotWritable (also OSError) it cannot be made or written to
    ├── FileNotWritten (also OSError)       a full disk, say
    ├── DifferentEnvironment                resume over another environment
    ├── DifferentEvaluation                 resume of an evaluation that is another
    ├── EnvironmentNotMade                  it is known, and making it failed
    ├── NotPicklable (also TypeError)       a monitor, which belongs to a process
    ├── NoPictures                          the environment cannot be drawn
    ├── PicturesDiffer                      from its state it would look otherwise
    ├── ResetNeeded                         step before reset or after the end
    ├── ResetNotAllowed                     reset in mid-episode
    ├── ClosedError                         used after close()
    ├── EncoderError                        ffmpeg failed or died
    │   └── FrameCountError                 the finished file lacks or doubles frames
    ├── RenderError                         videos could not be made of their states
    ├── BlankVideo                          strict=True, and nothing is to be seen
    ├── GLError                             no backend renders, or the wrong one
    ├── PolicyError                         a policy raised or gave a bad action
    ├── ArchiveError                        write_archive's checks
    ├── PackError                           a run cannot be packed as asked
    │   ├── UnfinishedRecordings            something is to be rendered or recovered
    │   ├── ArchiveTooLarge                 max_size, also with smaller videos
    │   └── IdentityLeft                    anonymous=True, and somebody is named
    ├── UnreadableFile                      a damaged or foreign file
    │   ├── UnreadableArchive               which `mjrec verify` was given
    │   └── UntrustedModel                  a stranger's, and without its sources
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
    """A picture that is not a `(height, width, 3) uint8` array."""


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
            f"{directory} holds recordings of {recorded}, and this monitor is around "
            f"{asked}. Results of two environments in one directory cannot be told "
            "apart: use another directory."
        )


class DifferentEvaluation(Error):
    """`resume=True` of an evaluation that was begun in another way.

    Attributes:
        directory: of the evaluation.
        differences: what was begun and what is asked now, by what it is of.
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
            f"The evaluation in {directory} was begun in another way: {listed}. Its "
            "results and new ones do not belong together: ask for the same, or use "
            "another directory."
        )


class EnvironmentNotMade(Error):
    """An environment that is known could not be made; the cause is kept.

    Attributes:
        name: the environment asked for.
    """

    def __init__(self, name: str, reason: object, *, hint: str = "") -> None:
        self.name = name
        text = f"Making {name} failed: {reason}"
        super().__init__(f"{text.rstrip('. ')}. {hint}".rstrip())


class NotPicklable(Error, TypeError):
    """A monitor was to be sent to another process, or copied."""


class NoPictures(Error):
    """Videos were asked for of an environment that gives no pictures."""


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
            f"{reasons} Their states are kept; to try again: mjrec render {directory}"
        )


class BlankVideo(Error):
    """With `strict=True`: a video is whole, and shows nothing.

    Attributes:
        path: the video; it is kept, and so is its metadata, which says the same.
        frame_count: how many frames it has.
        suspicion: what is wrong with it.
    """

    def __init__(self, path: Path, *, frame_count: int, suspicion: str) -> None:
        self.path = path
        self.frame_count = frame_count
        self.suspicion = suspicion
        super().__init__(
            f"{path} shows nothing: {suspicion}. The file is kept. Look at the lights "
            "and the camera of the model, and at what `mjrec doctor` says of OpenGL; "
            "without strict (--strict) this is a warning."
        )


class ResetNeeded(Error):
    """`step` before the first `reset`, or after the end of an episode."""


class ResetNotAllowed(Error):
    """`reset` in mid-episode, without `allow_early_reset=True`."""


class ClosedError(Error):
    """A writer or recorder was used after it was closed."""


class EncoderError(Error):
    """ffmpeg failed or died.

    Attributes:
        command: the argument list it was started with.
        returncode: its exit status; negative is the signal that killed it.
        stderr: the end of what it said.
    """

    def __init__(
        self, what: str, *, command: Sequence[str], returncode: int | None, stderr: str
    ) -> None:
        self.command = list(command)
        self.returncode = returncode
        self.stderr = stderr
        said = stderr.strip() or "(nothing)"
        super().__init__(
            f"{what} ffmpeg's exit status: {returncode}. It was started as: "
            f"{' '.join(self.command)}. The end of what it said: {said}"
        )


class FrameCountError(EncoderError):
    """The finished video does not hold exactly the frames that were written."""


class GLError(Error):
    """No OpenGL backend renders here, or another one is in use already."""


class PolicyError(Error):
    """A policy cannot be built, raised, or gave something that is no action."""


class ArchiveError(Error):
    """A check of `write_archive` failed; nothing was written."""


class PackError(Error):
    """A run cannot be packed as asked; nothing was written."""


class UnfinishedRecordings(PackError):
    """Something of the recordings is still to be done.

    Attributes:
        directory: where the recordings are.
        names: the base names of what is not finished.
    """

    def __init__(self, directory: Path, names: Sequence[str], *, advice: str) -> None:
        self.directory = directory
        self.names = list(names)
        listed = _first_of(names, 5)
        super().__init__(
            f"The recordings in {directory} are not finished: {listed}. {advice}"
        )


class ArchiveTooLarge(PackError):
    """A packed run would be larger than allowed, also with smaller videos.

    Attributes:
        size: what the smallest archive that was tried has at least, in bytes.
        limit: the most that was allowed.
        largest: the names and sizes of the largest files in it.
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
    """With `anonymous=True`: something that names somebody is still in the archive.

    Attributes:
        found: the files, each with what was found in it.
    """

    def __init__(self, found: Sequence[tuple[str, str]]) -> None:
        self.found = list(found)
        listed = _first_of(
            [f"{name}: {what}" for name, what in found], 10, between="; "
        )
        super().__init__(
            f"The packed run would not be anonymous, so it was not written: {listed}. "
            "Record again without these (a uid, a camera's or a body's name, "
            "a title), or leave out the episodes that have them."
        )


class UnreadableFile(Error):
    """A file that is damaged, or not what its name says.

    Attributes:
        path: the file.
        reason: what is wrong with it.
    """

    _message = "Cannot read {path}: {reason}."
    _advice = (
        " The other files of its directory are as good as before; to read them, move "
        "this one away."
    )

    def __init__(self, path: Path, reason: object) -> None:
        self.path = path
        self.reason = str(reason)
        # Nothing can be moved away that is not there.
        advice = self._advice if os.path.lexists(path) else ""
        super().__init__(self._message.format(path=path, reason=reason) + advice)


class UnreadableArchive(UnreadableFile):
    """What was given to be verified is no packed run, or is damaged."""

    _message = "Cannot verify {path}: {reason}."
    _advice = (
        " It may not have come whole, or was packed anew by another program: ask for "
        "the file that `mjrec pack` made again."
    )


class UntrustedModel(UnreadableFile):
    """A compiled model that a stranger may have written, which is not loaded.

    Attributes:
        path: of the model.
        reason: why nothing else can be used instead, and how to say that it is trusted.
    """

    _message = "The model {path} is not loaded: {reason}."
    _advice = ""


class MissingDependency(Error, ImportError):
    """Something optional is needed and not installed."""

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
