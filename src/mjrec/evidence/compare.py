# SPDX-License-Identifier: Apache-2.0
"""Item-by-item comparison of a packed run with its recreation.

Files with equal bytes need no further check. For all others, a comparator for their
kind finds the differences, and an excuse may allow them. A file that exists in only one
run is a difference. Memory use does not depend on the number of episodes; time is
proportional to it.
"""

from __future__ import annotations

import filecmp
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from ..errors import Error, FileNotWritten, UnreadableFile
from ..formats.frame_hashes import frame_hash_path
from ..formats.json_fields import read_object
from ..formats.monitor_directory import episode_of
from ..formats.trajectory_hdf5 import open_hdf5
from ..formats.video_metadata import metadata_of
from .archive import BAG_DECLARATION
from .claims import claimed_excuses
from .compare_descriptions import compare_descriptions
from .compare_json import Rules, compare_journals, compare_objects, video_of
from .compare_models import (
    compare_models,
    compare_sources,
    model_name,
    models_of,
    renamed_models,
)
from .compare_rows import compare_trajectories, same_trajectory
from .compare_video import compare_frame_hashes, compare_sampled, compare_videos
from .differences import Aspect, Difference, Same, only_in, short
from .excuses import applicable, is_fed, merged, noted_excuse, read_notes, with_allowed
from .findings import Excuse, Finding, Level, Outcome, Topic
from .honesty import remarks_on_video
from .layout import PAYLOAD, RECORDINGS, SAMPLED
from .trial import Trial

_Found: TypeAlias = Iterator[Same | Difference]

# Keys of a manifest that rendering changes.
_DRAWN_KEYS: Final = frozenset(("videos", "pending", "broken"))
_NO_DIFFERENCES: Final = (Aspect.CLAIM, Aspect.STATEMENT)


def _compare_manifests(given: Path, made: Path, rules: Rules) -> _Found:
    if not rules.is_drawn:
        rules = replace(rules, left_out=_DRAWN_KEYS)
    compared = compare_objects(given, made, rules)
    found = [each for each in compared if isinstance(each, Difference)]
    if not rules.is_drawn:
        # Without rendering, only the lists of videos differ.
        found = [each for each in found if each.aspect is not Aspect.STORED]
        numbers = [_with_video(read_object(path)) for path in (given, made)]
        if numbers[0] != numbers[1]:
            found.append(_other_choice(*numbers))
    yield from found
    other = {each.topic for each in found if each.aspect not in _NO_DIFFERENCES}
    for topic, unit in _KINDS[".manifest.json"].proved:
        if topic not in other:
            yield Same(topic, unit=unit)


def _other_bytes(given: Path, made: Path, rules: Rules) -> _Found:
    yield Difference(Topic.FILES, how="its bytes differ")


class _Kind(NamedTuple):
    """A kind of file: its topic, its comparator, and what equal bytes prove."""

    topic: Topic
    compare: Callable[[Path, Path, Rules], _Found]
    proved: tuple[tuple[Topic, str], ...] = ()


# Kinds of files, keyed by the ending of their names, in the order of the comparison.
# Metadata comes after videos, because it contains the hash of the decoded frames.
_KINDS: Final[Mapping[str, _Kind]] = {
    ".zip": _Kind(Topic.IDENTITY, compare_sources),
    ".mjb.gz": _Kind(
        Topic.IDENTITY, compare_models, ((Topic.IDENTITY, "compiled model"),)
    ),
    ".jsonl": _Kind(Topic.REWARDS, compare_journals),
    ".mp4": _Kind(
        Topic.VIDEOS,
        compare_videos,
        ((Topic.VIDEOS, "video"), (Topic.FILES, "encoding")),
    ),
    ".stats.json": _Kind(Topic.REWARDS, compare_objects),
    ".manifest.json": _Kind(
        Topic.SELECTION,
        _compare_manifests,
        ((Topic.SELECTION, "recording"), (Topic.IDENTITY, "recording")),
    ),
    ".h5": _Kind(Topic.PHYSICS, compare_trajectories),
    ".framehash": _Kind(Topic.PICTURES, compare_frame_hashes),
    ".meta.json": _Kind(Topic.VIDEOS, compare_objects),
    ".monitor.csv": _Kind(Topic.FILES, _other_bytes),
    ".json": _Kind(Topic.PICTURES, compare_objects),
    "": _Kind(Topic.FILES, _other_bytes),
}
# The kinds of files in a run that was recreated without rendering.
_UNDRAWN: Final = (".jsonl", ".stats.json", ".manifest.json", ".h5")
_MODELS: Final = (".mjb.gz", ".zip")
# Kinds whose equal items are counted by their comparators.
_COUNTED: Final = (".jsonl", ".framehash")


class Comparison:
    """The comparison of two packed runs. Iterate over it once.

    Args:
        given: the archive's folder, which contains `data/`.
        made: the recreated run's folder, which contains `data/` and the notes on items
            that could not be recreated.
        level: the depth of the comparison. Below PIXELS, `made` was not rendered.
        sampled: whether `made` contains a sample of rendered frames.
        allow: excuses that the reader accepts, as "NAME=VALUE".
        on_progress: called with the number of bytes compared so far and in total.

    Attributes:
        excuses: the excuses that were used or refuted; complete once the last finding
            has been yielded.
    """

    def __init__(
        self,
        given: Path,
        made: Path,
        *,
        level: Level = Level.PIXELS,
        sampled: bool = False,
        allow: Iterable[str] = (),
        on_progress: Callable[[int, int], object] = lambda *_: None,
    ) -> None:
        self._given, self._made = given / PAYLOAD, made / PAYLOAD
        self._level = Level.PHYSICS if sampled else level
        self._sampled = made / SAMPLED if sampled else None
        self._allow = tuple(allow)
        self._on_progress = on_progress
        self._notes = read_notes(made)
        self._unplayed = {n.item for n in self._notes if n.excuse == "environment"}
        self._rules = Rules(
            given=self._given,
            renamed=renamed_models(self._given, self._made),
            is_packed=(given / BAG_DECLARATION).exists(),
            is_drawn=self._level is Level.PIXELS,
        )
        self.excuses: tuple[Excuse, ...] = ()

    def __iter__(self) -> Iterator[Finding]:
        """Yield differences as they are found, then the totals of equal items."""
        claims = claimed_excuses(self._given, self._made)
        excuses = applicable(merged([*claims, *map(noted_excuse, self._notes)]))
        trial = Trial(with_allowed(excuses, self._allow))
        for note in self._notes:
            # Other notes matter only for differences.
            if is_fed(str(note.excuse)):
                trial.believe(note)
        for found in self._compare():
            if (finding := trial.take(found)) is not None:
                yield finding
        self.excuses = trial.excuses
        yield from trial.totals()

    def _compare(self) -> Iterator[Same | Difference | Finding]:
        if self._rules.is_packed:
            yield from compare_descriptions(self._given.parent)
        given, made = (self._names(folder) for folder in (self._given, self._made))
        total, done = sum(given.values()), 0
        for file in sorted(given.keys() | made.keys(), key=_order):
            if file in given and file in made:
                yield from self._compare_file(file, self._made / file)
            else:
                yield from self._only_in_one(file, file in given)
            done += given.get(file, 0)
            self._on_progress(done, total)
        if self._level is not Level.PIXELS:
            yield from self._not_compared()

    def _names(self, folder: Path) -> dict[str, int]:
        """Return the sizes of the files to compare, keyed by name."""
        found = {
            path.relative_to(folder).as_posix(): path.lstat().st_size
            for path in (folder / RECORDINGS).rglob("*")
            if path.is_symlink() or not path.is_dir()
        }
        kinds: tuple[str, ...] = _UNDRAWN
        if self._level is Level.PIXELS:
            kinds = tuple(end for end in _KINDS if end or self._rules.is_packed)
        return {f: size for f, size in found.items() if _ending(f) in kinds}

    def _only_in_one(
        self, file: str, is_given: bool
    ) -> Iterator[Same | Difference | Finding]:
        ending, model = _ending(file), model_name(file)
        renamed = self._rules.renamed
        if model in renamed or model in renamed.values():
            # The sources are equal, but the name contains the compiled model's hash.
            again = self._made / RECORDINGS / f"{renamed.get(model)}{ending}"
            if is_given and again.is_file():
                yield from self._compare_file(file, again)
                return
            if not is_given:
                return
        if not is_given and self._level is not Level.PIXELS and ending == ".h5":
            with open_hdf5(self._made / file) as reader:
                if reader.facts.get("kept") is False:
                    # The recorder removes it once its video is rendered.
                    return
        if is_given and ending in _MODELS and self._is_unplayed(model):
            reason = "the recordings of this model could not be recreated"
            yield _believed(Topic.IDENTITY, reason, 1, "model", excuse="environment")
            return
        yield Difference(
            _kind(file).topic,
            file=file,
            # A compiled model missing from the archive is not excused.
            aspect=Aspect.MODEL if ending == ".mjb.gz" and is_given else Aspect.EXACT,
            how=only_in(is_given, Path(file).name),
        )

    def _is_unplayed(self, model: str) -> bool:
        """Return whether a model belongs only to recordings that were not recreated."""
        return bool(self._unplayed) and model not in self._played_models

    @functools.cached_property
    def _played_models(self) -> set[str]:
        """The models of recreated recordings. Finding them opens all trajectories."""
        models = models_of(self._given / RECORDINGS).items()
        played = (m for i, m in models if f"recording {i}" not in self._unplayed)
        return {model_name(file) for files in played for file in files}

    def _compare_file(
        self, file: str, made: Path
    ) -> Iterator[Same | Difference | Finding]:
        given, kind = self._given / file, _kind(file)
        rules = replace(self._rules, given=given, usual=kind.topic)
        try:
            if filecmp.cmp(given, made, shallow=False):
                found = self._same(given, made, rules)
            else:
                found = kind.compare(given, made, rules)
            if self._level is Level.STATS and _ending(file) == ".h5":
                found = (each for each in found if each.topic is Topic.REWARDS)
            for each in found:
                yield replace(each, file=file)
        except FileNotWritten:
            raise
        except Error as error:
            yield _damaged(file, error)
        if _ending(file) == ".meta.json" and self._level is Level.PIXELS:
            metadata = metadata_of(video_of(given))
            yield from remarks_on_video(metadata, file)

    def _same(self, given: Path, made: Path, rules: Rules) -> _Found:
        file = f"{RECORDINGS}/{given.name}"
        kind = _kind(file)
        if _ending(file) in _COUNTED:
            yield from kind.compare(given, made, rules)
        elif _ending(file) == ".h5":
            yield from same_trajectory(given)
        for topic, unit in kind.proved:
            yield Same(topic, unit=unit)
        yield Same(Topic.FILES)

    def _not_compared(self) -> Iterator[Same | Difference | Finding]:
        """Yield the items that this level skips, and compare the sampled frames."""
        videos = sorted((self._given / RECORDINGS).glob("*.mp4"))
        frames = drawn = 0
        for path in videos:
            count = metadata_of(path).get("frame_count")
            frames += count if isinstance(count, int) else 0
            folder = self._sampled / path.name if self._sampled else None
            if folder is not None and folder.is_dir():
                drawn += sum(1 for _ in folder.iterdir())
                file = f"{RECORDINGS}/{path.name}"
                try:
                    hashes = frame_hash_path(path)
                    for each in compare_sampled(path, hashes, folder):
                        yield replace(each, file=file)
                except Error as error:
                    yield _damaged(file, error)
        if videos:
            undone = "videos were not recreated"
            yield _believed(Topic.VIDEOS, undone, len(videos), "video")
        if frames > drawn:
            reason = "frames were not rerendered"
            if drawn:
                missed = f"{1 - drawn / frames:.0%}"
                reason += f"; the chance of missing a single changed frame is {missed}"
            yield _believed(Topic.PICTURES, reason, frames - drawn, "frame")
        if self._level is Level.STATS:
            undone = "states were not compared (--level stats)"
            yield _believed(Topic.PHYSICS, undone, 1, "recording")


def _order(file: str) -> tuple[int, str]:
    return [*_KINDS].index(_ending(file)), file


def _ending(file: str) -> str:
    """Return the ending of a file name that identifies its kind; "" if unknown."""
    if not file.startswith(f"{RECORDINGS}/openaigym."):
        return ""
    return next(end for end in _KINDS if file.endswith(end))


def _kind(file: str) -> _Kind:
    return _KINDS[_ending(file)]


def _damaged(file: str, error: Error) -> Difference:
    # Without the path, which is in a temporary folder.
    reason = error.reason if isinstance(error, UnreadableFile) else str(error)
    return Difference(_kind(file).topic, file=file, how=f"it cannot be read: {reason}")


def _with_video(manifest: Mapping[str, Any]) -> set[int]:
    """Return the episodes that have a video or a pending one."""
    details = manifest.get("mjrec") or {}
    names = [video for video, _ in manifest.get("videos", ())]
    names += details.get("broken", ())
    numbers = {episode_of(name) for name in names}
    numbers |= {entry.get("episode_id") for entry in details.get("pending", ())}
    return {number for number in numbers if number is not None}


def _other_choice(given: set[int], made: set[int]) -> Difference:
    one, other = (
        short(", ".join(map(str, sorted(numbers))) or "none")
        for numbers in (given - made, made - given)
    )
    return Difference(
        Topic.SELECTION,
        where="episodes with a video",
        how=f"only the archive has {one}; only the recreated run has {other}",
    )


def _believed(
    topic: Topic, reason: str, count: int, unit: str, *, excuse: str | None = None
) -> Finding:
    outcome = Outcome.BELIEVED
    return Finding(topic, "", outcome, reason, excuse=excuse, count=count, unit=unit)
