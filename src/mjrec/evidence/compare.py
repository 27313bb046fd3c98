# SPDX-License-Identifier: Apache-2.0
"""Item-by-item comparison of a packed run with the same run recreated.

Files with equal bytes need no further check. Otherwise a comparator for each kind of
file finds the differences, and an excuse may allow them. A file that only one run has
is a difference. Memory is independent of the number of episodes; time is proportional.
"""

from __future__ import annotations

import contextlib
import filecmp
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from ..atomic_files import file_sha256
from ..errors import Error, UnreadableFile
from ..formats.frame_hashes import frame_hash_path
from ..formats.json_fields import read_object
from ..formats.monitor_directory import episode_of, infix_of
from ..formats.trajectory_hdf5 import open_hdf5
from .archive import BAG_DECLARATION
from .claims import claimed_excuses
from .compare_descriptions import compare_descriptions
from .compare_json import (
    KEYS,
    Rule,
    Rules,
    compare_journals,
    compare_objects,
    is_gl_device,
    same_journal,
)
from .compare_models import (
    compare_models,
    compare_sources,
    model_name,
    recompiled,
    renamed_models,
)
from .compare_rows import compare_rewards, compare_trajectories, same_trajectory
from .compare_video import compare_frame_hashes, compare_sampled, compare_videos
from .differences import Aspect, Difference, Same, short
from .excuses import NUMERIC, Trial, applicable, believed, merged, with_allowed
from .findings import Excuse, Finding, Level, Outcome, Topic
from .honesty import read_metadata, remarks_on_video
from .layout import PAYLOAD, RECORDINGS, SAMPLED
from .notes import REWARDS_FILE, read_notes
from .sums import Sums

# Kinds of files, by the ends of their names.
_KINDS: Final[Mapping[str, str]] = {
    ".mjb.gz": "model",
    ".zip": "sources",
    ".jsonl": "journal",
    ".stats.json": "statistics",
    ".manifest.json": "manifest",
    ".h5": "trajectory",
    ".framehash": "hashes",
    ".meta.json": "metadata",
    ".mp4": "video",
    ".monitor.csv": "results",
    ".json": "text",
}
# Kinds of files in a run that was recreated without rendering.
_UNDRAWN: Final = ("journal", "statistics", "manifest", "trajectory")
# Keys of a manifest that rendering changes.
_DRAWN_KEYS: Final = frozenset(("videos", "pending", "broken"))
# Compared first. Metadata comes after videos: it has the hash of the decoded frames.
_ORDER: Final = ("sources", "model", "journal", "video")
_TOPICS: Final = {
    "model": Topic.IDENTITY,
    "sources": Topic.IDENTITY,
    "journal": Topic.REWARDS,
    "statistics": Topic.REWARDS,
    "manifest": Topic.SELECTION,
    "trajectory": Topic.PHYSICS,
    "video": Topic.VIDEOS,
    "metadata": Topic.VIDEOS,
    "hashes": Topic.PICTURES,
    "text": Topic.PICTURES,
}
_OF_MANIFEST: Final = (Topic.SELECTION, Topic.IDENTITY)
_NOT_MADE: Final = "nothing recreated this file"
# How numbers differ that other code has computed.
_COMPUTED: Final = (Aspect.STATE, Aspect.VELOCITY, Aspect.DERIVED, Aspect.SUMMED)
_NO_DIFFERENCES: Final = (Aspect.CLAIM, Aspect.STATEMENT)
# Excuses for recordings that were not replayed.
_UNPLAYED: Final = ("environment", "wrappers", "actions not kept")
_Found: TypeAlias = Iterator[Same | Difference]


class Comparison:
    """The comparison of two packed runs. Iterate over it once.

    Args:
        given: the archive's folder, which contains `data/`.
        made: the recreated run's folder, which contains `data/` and `maker.json`, the
            list of items that could not be recreated.
        level: the depth of the comparison. Below PIXELS, `made` was not rendered.
        sampled: whether `made` contains a sample of rendered frames.
        allow: excuses that the reader accepts, as "NAME=VALUE".
        on_progress: called with the number of bytes compared so far and in total.

    Attributes:
        excuses: the excuses that were used or refuted, once the last finding has been
            yielded.
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
        self._is_bag = (given / BAG_DECLARATION).exists()
        self._level = Level.PHYSICS if sampled else level
        self._sampled = made / SAMPLED if sampled else None
        self._allow = tuple(allow)
        self._on_progress = on_progress
        self._notes = read_notes(made)
        self._decoded: dict[str, str] = {}
        self._renamed: dict[str, str] = {}
        self.excuses: tuple[Excuse, ...] = ()

    def __iter__(self) -> Iterator[Finding]:
        """Yield differences as they are found, then the totals of equal items."""
        noted = [believed(note) for note in self._notes]
        claims = claimed_excuses(self._given, self._made)
        excuses = applicable(merged([*claims, *(excuse for excuse, _ in noted)]))
        trial = Trial(with_allowed(excuses, self._allow))
        sums, is_other_code = Sums(), False
        for _, finding in noted:
            if finding is not None:
                trial.use(str(finding.excuse))
                sums.add(finding)
        for found in self._compare():
            if isinstance(found, Finding):
                sums.add(found)
            elif isinstance(found, Difference):
                finding = trial.judge(found)
                if finding is None:
                    continue
                if finding.outcome is not Outcome.DIFFERENT:
                    sums.add(finding)
                    continue
                is_other_code |= found.aspect in _COMPUTED
                if sums.fail(finding):
                    yield finding
            elif not trial.same(found):
                sums.same(found)
        yield from trial.refutations()
        yield from sums
        self.excuses = trial.excuses
        if is_other_code and not any(e.name in NUMERIC for e in self.excuses):
            yield _other_code()

    def _compare(self) -> Iterator[Same | Difference | Finding]:
        self._renamed = renamed_models(self._given, self._made)
        if self._is_bag:
            yield from compare_descriptions(self._given.parent)
        names = [self._names(folder) for folder in (self._given, self._made)]
        files = sorted(names[0].keys() | names[1].keys(), key=_order)
        total, done = sum(names[0].values()), 0
        for file in files:
            yield from self._compare_names(file, *(file in each for each in names))
            if file in names[0] and file in names[1]:
                yield from self._compare_file(file)
            done += names[0].get(file, 0)
            self._on_progress(done, total)
        if self._level is Level.STATS:
            yield from self._compare_rewards()
        if self._level is not Level.PIXELS:
            yield from self._not_compared()

    def _names(self, folder: Path) -> dict[str, int]:
        """Return the sizes of the files to compare, by name."""
        found = {
            path.relative_to(folder).as_posix(): path.lstat().st_size
            for path in (folder / RECORDINGS).rglob("*")
            if path.is_symlink() or not path.is_dir()
        }
        kinds: tuple[str, ...] = tuple(_KINDS.values())
        if self._level is not Level.PIXELS:
            kinds = _UNDRAWN if self._level is Level.PHYSICS else _UNDRAWN[:-1]
        elif self._is_bag:
            kinds = (*kinds, "")
        return {f: size for f, size in found.items() if _kind(f) in kinds}

    def _compare_names(
        self, file: str, is_given: bool, is_made: bool
    ) -> Iterator[Same | Difference | Finding]:
        kind, model = _kind(file), model_name(file)
        if is_given and is_made:
            return
        if model in self._renamed or model in self._renamed.values():
            # The sources are the same; the name has the hash of the compiled model.
            if is_given and kind == "model":
                yield recompiled(file)
            return
        if is_made and self._level is not Level.PIXELS and kind == "trajectory":
            with open_hdf5(self._made / file) as reader:
                if reader.facts.get("kept") is False:
                    # It would be removed once its video is rendered.
                    return
        if is_given and kind in ("model", "sources") and self._is_unplayed(model):
            yield _believed(
                Topic.IDENTITY,
                "the recordings of this model could not be recreated",
                1,
                "model",
                excuse="environment",
            )
            return
        yield Difference(
            topic=_TOPICS.get(kind, Topic.FILES),
            file=file,
            # A missing compiled model is not excused as compiled elsewhere.
            aspect=Aspect.MODEL if kind == "model" and is_given else Aspect.EXACT,
            how=_NOT_MADE if is_given else "no such file, but one was recreated",
        )

    def _is_unplayed(self, model: str) -> bool:
        """Return whether a model belongs only to recordings that were not recreated."""
        return bool(self._unplayed) and model not in self._played_models

    @functools.cached_property
    def _unplayed(self) -> set[str]:
        return {n.item for n in self._notes if n.excuse == "environment"}

    @functools.cached_property
    def _played_models(self) -> set[str]:
        """The models of recreated recordings; all trajectories are opened for them."""
        played: set[str] = set()
        for path in (self._given / RECORDINGS).glob("*.h5"):
            if f"recording {infix_of(path.name)}" not in self._unplayed:
                with contextlib.suppress(Error), open_hdf5(path) as reader:
                    names = reader.facts.get("model") or {}
                    played |= {model_name(str(names.get(k))) for k in ("mjb", "xml")}
        return played

    def _compare_file(self, file: str) -> Iterator[Same | Difference | Finding]:
        given, made, kind = self._given / file, self._made / file, _kind(file)
        try:
            if filecmp.cmp(given, made, shallow=False):
                yield from self._same(file, kind)
            else:
                yield from self._compare_kind(given, made, file, kind)
        except Error as error:
            yield _damaged(file, error)
        if kind == "metadata" and self._level is Level.PIXELS:
            yield from remarks_on_video(given, file)

    def _same(self, file: str, kind: str) -> _Found:
        match kind:
            case "journal":
                yield from same_journal(self._given / file, file)
            case "trajectory":
                yield from same_trajectory(self._given / file, file)
            case "model":
                yield Same(topic=Topic.IDENTITY, file=file, unit="compiled model")
            case "video":
                yield Same(topic=Topic.VIDEOS, file=file, unit="video")
                yield Same(topic=Topic.FILES, file=file, unit="encoding")
            case "hashes":
                yield from compare_frame_hashes(
                    self._given / file, self._made / file, file
                )
            case "manifest":
                for topic in _OF_MANIFEST:
                    yield Same(topic=topic, file=file, unit="recording")
        yield Same(topic=Topic.FILES, file=file)

    def _compare_kind(self, given: Path, made: Path, file: str, kind: str) -> _Found:
        rules = self._rules(kind)
        match kind:
            case "journal":
                yield from compare_journals(given, made, file, rules)
            case "trajectory":
                yield from compare_trajectories(given, made, file, rules)
            case "video":
                yield from compare_videos(
                    given,
                    made,
                    file,
                    lambda digest: self._decoded.update({file: digest}),
                )
            case "hashes":
                yield from compare_frame_hashes(given, made, file)
            case "model":
                yield from compare_models(given, made, file)
            case "sources":
                yield from compare_sources(given, made, file)
            case "manifest":
                yield from self._compare_manifests(given, made, file, rules)
            case "statistics" | "metadata" | "text":
                yield from compare_objects(given, made, file, rules)
            case _:
                yield Difference(topic=Topic.FILES, file=file, how="its bytes differ")

    def _compare_manifests(
        self, given: Path, made: Path, file: str, rules: Rules
    ) -> _Found:
        compared = compare_objects(given, made, file, rules)
        found = [each for each in compared if isinstance(each, Difference)]
        if self._level is not Level.PIXELS:
            # Without rendering, only the lists of videos differ.
            found = [each for each in found if each.aspect is not Aspect.STORED]
            numbers = [_with_video(read_object(path)) for path in (given, made)]
            if numbers[0] != numbers[1]:
                found.append(_other_choice(numbers[0], numbers[1], file))
        yield from found
        for topic in _OF_MANIFEST:
            exact = (each for each in found if each.aspect not in _NO_DIFFERENCES)
            if not any(each.topic is topic for each in exact):
                yield Same(topic=topic, file=file, unit="recording")

    def _rules(self, kind: str = "") -> Rules:
        left_out = _DRAWN_KEYS if self._level is not Level.PIXELS else frozenset()
        return Rules(
            keys=KEYS,
            usual=Rule(_TOPICS.get(kind, Topic.FILES)),
            own={
                "file_sha256": lambda file, value: self._own_sha256(
                    _video_of(file), value
                ),
                "decoded_sha256": lambda file, value: (
                    self._decoded.get(_video_of(file)) == value
                ),
                "gl_device": lambda _, value: is_gl_device(value),
            },
            left_out=left_out if kind == "manifest" else frozenset(),
            renamed=self._renamed,
            is_packed=self._is_bag,
        )

    def _compare_rewards(self) -> _Found:
        """Compare the rewards that were recreated instead of trajectories."""
        path = self._made.parent / REWARDS_FILE
        if not path.exists():
            return
        with np.load(path, allow_pickle=False) as rewards:
            known = frozenset(rewards.files)
            unplayed = {n.item for n in self._notes if n.excuse in _UNPLAYED}
            for given in sorted((self._given / RECORDINGS).glob("*.h5")):
                infix, number = infix_of(given.name), episode_of(given.name)
                file, name = f"{RECORDINGS}/{given.name}", f"{infix}.{number}"
                items = {f"recording {infix}", f"episode {number} of {infix}"}
                if name not in known:
                    if items.isdisjoint(unplayed):
                        yield Difference(topic=Topic.PHYSICS, file=file, how=_NOT_MADE)
                    continue
                try:
                    yield from compare_rewards(given, rewards[name], file)
                except Error as error:
                    yield _damaged(file, error)

    def _not_compared(self) -> Iterator[Same | Difference | Finding]:
        """Yield what this level skips, and compare the sampled frames."""
        videos = sorted((self._given / RECORDINGS).glob("*.mp4"))
        frames = drawn = 0
        for path in videos:
            frames += _frame_count(path)
            folder = self._sampled / path.name if self._sampled else None
            if folder is not None and folder.is_dir():
                drawn += sum(1 for _ in folder.iterdir())
                file = f"{RECORDINGS}/{path.name}"
                try:
                    hashes = frame_hash_path(path)
                    yield from compare_sampled(path, hashes, folder, file)
                except Error as error:
                    yield _damaged(file, error)
        if videos:
            undone = "videos were not recreated"
            yield _believed(Topic.VIDEOS, undone, len(videos), "video")
        if frames > drawn:
            reason = "frames were not rerendered"
            if drawn:
                missed = f"{1 - drawn / frames:.0%}"
                reason += f"; the chance of missing a single changed one is {missed}"
            yield _believed(Topic.PICTURES, reason, frames - drawn, "frame")
        if self._level is Level.STATS:
            undone = "states were not compared (--level stats)"
            yield _believed(Topic.PHYSICS, undone, 1, "recording")

    def _own_sha256(self, file: str, value: Any) -> bool:
        path = self._given / file
        return path.is_file() and file_sha256(path) == value


def _order(file: str) -> tuple[int, str]:
    kind = _kind(file)
    return (_ORDER.index(kind) if kind in _ORDER else len(_ORDER)), file


def _kind(file: str) -> str:
    """Return the kind of a file; "" if it is not a recording."""
    if not file.startswith(f"{RECORDINGS}/openaigym."):
        return ""
    return next((kind for end, kind in _KINDS.items() if file.endswith(end)), "")


def _damaged(file: str, error: Error) -> Difference:
    # Without the path, which is in a temporary folder.
    reason = error.reason if isinstance(error, UnreadableFile) else str(error)
    topic = _TOPICS.get(_kind(file), Topic.FILES)
    return Difference(topic=topic, file=file, how=f"it cannot be read: {reason}")


def _other_code() -> Finding:
    return Finding(
        topic=Topic.PHYSICS,
        item="",
        outcome=Outcome.NOTED,
        reason="it claims the same versions and machine as here, so the code or the "
        "numbers must have been different",
        unit="verification",
        is_headline=True,
    )


def _video_of(file: str) -> str:
    return f"{file.removesuffix('.meta.json')}.mp4"


def _with_video(manifest: Mapping[str, Any]) -> set[int]:
    """Return the episodes that have a video or a pending one."""
    details = manifest.get("mjrec") or {}
    names = [video for video, _ in manifest.get("videos", ())]
    names += details.get("broken", ())
    numbers = {episode_of(name) for name in names}
    numbers |= {entry.get("episode_id") for entry in details.get("pending", ())}
    return {number for number in numbers if number is not None}


def _other_choice(given: set[int], made: set[int], file: str) -> Difference:
    return Difference(
        topic=Topic.SELECTION,
        file=file,
        where="episodes with a video",
        how=f"only the archive has {_listed(given - made)}, only the recreated run "
        f"has {_listed(made - given)}",
    )


def _listed(numbers: set[int]) -> str:
    return short(", ".join(map(str, sorted(numbers))) or "none")


def _frame_count(video: Path) -> int:
    count = read_metadata(video).get("frame_count")
    return count if isinstance(count, int) else 0


def _believed(
    topic: Topic, reason: str, count: int, unit: str, *, excuse: str | None = None
) -> Finding:
    return Finding(
        topic=topic,
        item="",
        outcome=Outcome.BELIEVED,
        reason=reason,
        excuse=excuse,
        count=count,
        unit=unit,
    )
