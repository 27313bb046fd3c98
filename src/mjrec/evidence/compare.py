# SPDX-License-Identifier: Apache-2.0
"""Two packed runs, item by item: an archive's, and the same run made again.

Equal bytes need no second look; else one comparator for each kind of file says where
the two differ, and an excuse may allow it. A file that only one of the two has is a
difference. Memory does not grow with the number of episodes, time does in proportion.
"""

from __future__ import annotations

import dataclasses
import filecmp
import gzip
import hashlib
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from .. import json_text
from ..atomic_files import file_sha256
from ..errors import Error, UnreadableFile
from ..formats.frame_hashes import frame_hash_path
from ..formats.json_fields import json_object, read_object
from ..formats.monitor_directory import episode_of, infix_of
from ..formats.trajectory_hdf5 import open_hdf5
from .claims import claimed_excuses
from .compare_json import (
    KEYS,
    Rule,
    Rules,
    compare_crates,
    compare_journals,
    compare_objects,
    same_journal,
)
from .compare_rows import compare_rewards, compare_trajectories, same_trajectory
from .compare_text import compare_frame_hashes, compare_tables, compare_texts
from .compare_video import compare_sampled, compare_videos
from .differences import Aspect, Difference, Same, short
from .excuses import NUMERIC, Trial, applicable, believed, merged, with_allowed
from .findings import Excuse, Finding, Level, Outcome, Topic
from .honesty import read_metadata, remarks_on_video
from .layout import CRATE, ENVIRONMENT, PAYLOAD, RECORDINGS, SAMPLED, STATISTICS
from .notes import REWARDS_FILE, read_notes

_TAGS: Final = ("bagit.txt", "bag-info.txt")
# What stands in the middle or at the end of a file's name, and what kind it is then.
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
# What a run has that was made without drawing.
_UNDRAWN: Final = ("journal", "statistics", "manifest", "trajectory")
# In a manifest, what drawing changes.
_DRAWN_KEYS: Final = frozenset(("videos", "pending", "broken"))
# Before the metadata, which has the hash of what was decoded.
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
_NOT_MADE: Final = "nothing made this file again"
_NO_DIFFERENCES: Final = (Aspect.CLAIM, Aspect.STATEMENT)
# Excuses of what was not played.
_UNPLAYED: Final = ("environment", "wrappers", "actions not kept")
_MOST_FAILURES: Final = 100
_MODEL: Final = re.compile(r"openaigym\.model\.[0-9a-f]{16}")
# Four numbers; the last is the version. A model of 1 GiB is beyond any.
_MODEL_HEAD: Final = 16
_LARGEST_MODEL: Final = 1 << 30
# In the zip file of its sources.
_CONTENTS: Final = "contents.json"

_Found: TypeAlias = Iterator[Same | Difference]


class Comparison:
    """The comparison of two packed runs; iterate over it, once.

    Args:
        given: the archive's: the folder that holds `data/`.
        made: the run that was made again, likewise; `maker.json` there says what could
            not be.
        level: how deep. Below PIXELS, `made` was not drawn.
        sampled: some frames were drawn, and lie in `made`.
        allow: excuses that the reader takes, "NAME=VALUE" each.
        on_progress: called with the bytes that are compared, and all that there are.

    Attributes:
        excuses: after the last finding, those that were used or are refuted.
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
        self._decoded: dict[str, str] = {}
        self._renamed: dict[str, str] = {}
        self.excuses: tuple[Excuse, ...] = ()

    def __iter__(self) -> Iterator[Finding]:
        """Yield what differs as it is found; then what is equal, in sums."""
        noted = [believed(note) for note in self._notes]
        claims = claimed_excuses(self._given, self._made)
        excuses = applicable(merged([*claims, *(excuse for excuse, _ in noted)]))
        trial = Trial(with_allowed(excuses, self._allow))
        sums, is_other_code = _Sums(), False
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
                is_other_code |= found.aspect in (Aspect.STATE, Aspect.DERIVED)
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
        self._renamed = _renamed_models(self._given, self._made)
        for tag in _TAGS:
            yield from self._compare_tags(tag)
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
        """Return the files that are compared, and their sizes."""
        found = {
            path.relative_to(folder).as_posix(): path.lstat().st_size
            for path in folder.rglob("*")
            if path.is_symlink() or not path.is_dir()
        }
        kinds: tuple[str, ...] = tuple(_KINDS.values())
        if self._level is not Level.PIXELS:
            kinds = _UNDRAWN if self._level is Level.PHYSICS else _UNDRAWN[:-1]
        elif (self._given.parent / _TAGS[0]).exists():
            kinds = (*kinds, "")
        return {f: size for f, size in found.items() if _kind(f) in kinds}

    def _compare_tags(self, tag: str) -> _Found:
        given, made = (folder.parent / tag for folder in (self._given, self._made))
        if given.is_file() and made.is_file() and not _is_equal(given, made):
            yield from compare_texts(given, made, tag, self._rules())

    def _compare_names(self, file: str, is_given: bool, is_made: bool) -> _Found:
        kind, model = _kind(file), _model(file)
        if is_given and is_made:
            return
        if model in self._renamed or model in self._renamed.values():
            # The sources are the same; they are in the name of what is made of them.
            if is_given and kind == "model":
                yield _recompiled(file)
            return
        if is_made and self._level is not Level.PIXELS and kind == "trajectory":
            with open_hdf5(self._made / file) as reader:
                if reader.facts.get("kept") is False:
                    # It is removed once its video is drawn.
                    return
        yield Difference(
            topic=_TOPICS.get(kind, Topic.FILES),
            file=file,
            # A compiled model that is not there is none that was compiled elsewhere.
            aspect=Aspect.MODEL if kind == "model" and is_given else Aspect.EXACT,
            how=_NOT_MADE if is_given else "no such file, but one was made again",
        )

    def _compare_file(self, file: str) -> Iterator[Same | Difference | Finding]:
        given, made, kind = self._given / file, self._made / file, _kind(file)
        try:
            if _is_equal(given, made):
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
                yield from _compare_models(given, made, file)
            case "sources":
                yield from _compare_sources(given, made, file)
            case "manifest":
                yield from self._compare_manifests(given, made, file, rules)
            case "statistics" | "metadata" | "text":
                yield from compare_objects(given, made, file, rules)
            case _ if file == CRATE:
                yield from compare_crates(given, made, file, rules)
            case _ if file == ENVIRONMENT:
                yield from compare_objects(given, made, file, rules)
            case _ if file == STATISTICS:
                own = self._own_sha256
                yield from compare_tables(
                    given, made, file, lambda name, v: own(f"{RECORDINGS}/{name}", v)
                )
            case _ if Path(file).suffix in (".md", ".cff"):
                yield from compare_texts(given, made, file, rules)
            case _:
                yield Difference(topic=Topic.FILES, file=file, how="its bytes differ")

    def _compare_manifests(
        self, given: Path, made: Path, file: str, rules: Rules
    ) -> _Found:
        compared = compare_objects(given, made, file, rules)
        found = [each for each in compared if isinstance(each, Difference)]
        if self._level is not Level.PIXELS:
            # What was not drawn has other lists of videos, and no more.
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
                "contentSize": self._own_size,
            },
            left_out=left_out if kind == "manifest" else frozenset(),
            renamed=self._renamed,
        )

    def _compare_rewards(self) -> _Found:
        """Compare what was made again instead of trajectories."""
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
                        yield _not_made(file)
                    continue
                try:
                    yield from compare_rewards(given, rewards[name], file)
                except Error as error:
                    yield _damaged(file, error)

    def _not_compared(self) -> Iterator[Same | Difference | Finding]:
        """Yield what this level leaves out; of sampled videos, what was drawn."""
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
            undone = "videos were not made again"
            yield _believed(Topic.VIDEOS, undone, len(videos), "video")
        if frames > drawn:
            reason = "frames were not drawn again"
            if drawn:
                missed = f"{1 - drawn / frames:.0%}"
                reason += f"; a single changed one is missed with a chance of {missed}"
            yield _believed(Topic.PICTURES, reason, frames - drawn, "frame")
        if self._level is Level.STATS:
            undone = "states were not compared (--level stats)"
            yield _believed(Topic.PHYSICS, undone, 1, "recording")

    def _own_sha256(self, file: str, value: Any) -> bool:
        path = self._given / file
        return path.is_file() and file_sha256(path) == value

    def _own_size(self, file: str, value: Any) -> bool:
        for name, again in self._renamed.items():
            file = file.replace(again, name)
        path = self._given / file
        return path.is_file() and str(path.stat().st_size) == value


class _Sums:
    """Counts findings that say the same of several items."""

    def __init__(self) -> None:
        self._sums: dict[tuple[Any, ...], Finding] = {}
        self._counts: Counter[tuple[Any, ...]] = Counter()
        self._failures: Counter[Topic] = Counter()

    def same(self, found: Same) -> None:
        """Count what is equal."""
        self._add(
            Finding(
                topic=found.topic,
                item=found.item,
                outcome=Outcome.MADE_AGAIN,
                count=found.count,
                unit=found.unit,
            ),
            reason="",
        )

    def add(self, finding: Finding) -> None:
        """Count a finding with those for the same excuse; the worst speaks for all."""
        alike = (
            finding.reason if finding.outcome is not Outcome.WITHIN_TOLERANCE else ""
        )
        self._add(finding, reason=alike)

    def fail(self, finding: Finding) -> bool:
        """Count what differs; return whether to list it by itself."""
        self._failures[finding.topic] += 1
        return self._failures[finding.topic] <= _MOST_FAILURES

    def __iter__(self) -> Iterator[Finding]:
        for key, finding in self._sums.items():
            yield dataclasses.replace(finding, count=self._counts[key])
        for topic, count in self._failures.items():
            if count > _MOST_FAILURES:
                yield Finding(
                    topic=topic,
                    item="",
                    outcome=Outcome.DIFFERENT,
                    reason="more places differ",
                    count=count - _MOST_FAILURES,
                    unit="place",
                )

    def _add(self, finding: Finding, *, reason: str) -> None:
        key = (finding.topic, finding.outcome, finding.excuse, finding.unit, reason)
        self._counts[key] += finding.count
        known = self._sums.get(key)
        if known is None:
            self._sums[key] = finding
            return
        worst = max(known, finding, key=_size)
        is_one = known.item == finding.item
        self._sums[key] = worst if is_one else dataclasses.replace(worst, item="")


def _size(finding: Finding) -> float:
    return float(finding.figures.get("maximum", 0.0))


def _order(file: str) -> tuple[int, str]:
    kind = _kind(file)
    return (_ORDER.index(kind) if kind in _ORDER else len(_ORDER)), file


def _kind(file: str) -> str:
    """Return what kind of file it is; "" of those that are no recordings."""
    if not file.startswith(f"{RECORDINGS}/openaigym."):
        return ""
    return next((kind for end, kind in _KINDS.items() if file.endswith(end)), "")


def _is_equal(one: Path, other: Path) -> bool:
    return filecmp.cmp(one, other, shallow=False)


def _model(file: str) -> str:
    """Return the name of a model without what it is followed by; "" of other files."""
    found = _MODEL.match(file.rpartition("/")[2])
    return found[0] if found else ""


def _renamed_models(given: Path, made: Path) -> dict[str, str]:
    """Return the models that have another name made again, of the same sources."""
    sources = [
        {_sources(path): _model(path.name) for path in folder.rglob("*.model.*.zip")}
        for folder in (given, made)
    ]
    return {
        name: sources[1][digest]
        for digest, name in sources[0].items()
        if sources[1].get(digest, name) != name
    }


def _sources(path: Path) -> str:
    """Return the hash of a model's sources, whatever their main file is called.

    Some environments write it under a name that is random.
    """
    digest = hashlib.sha256()
    try:
        with zipfile.ZipFile(path) as sources:
            if sum(each.file_size for each in sources.infolist()) > _LARGEST_MODEL:
                raise ValueError("its sources are larger than any")
            contents = json_object(sources.read(_CONTENTS))
            main = f"source/{contents.get('main')}"
            digest.update(json_text.dumps({**contents, "main": ""}).encode())
            names = [name for name in sources.namelist() if name != _CONTENTS]
            for name in [main, *sorted(set(names) - {main})]:
                content = sources.read(name)
                said = "" if name == main else name
                digest.update(f"{said!r}: {len(content)}\n".encode())
                digest.update(content)
    except (KeyError, OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UnreadableFile(path, error) from error
    return digest.hexdigest()


def _compare_sources(given: Path, made: Path, file: str) -> _Found:
    is_equal = _sources(given) == _sources(made)
    yield Difference(
        topic=Topic.IDENTITY,
        file=file,
        # The name of the main file is a statement.
        aspect=Aspect.STATEMENT if is_equal else Aspect.EXACT,
        how="its sources are not those of the model that was made again",
    )


def _compare_models(given: Path, made: Path, file: str) -> _Found:
    contents = []
    for path in (given, made):
        try:
            with gzip.open(path) as model:
                contents.append(model.read(_LARGEST_MODEL))
        except (OSError, EOFError, zlib.error) as error:
            raise UnreadableFile(path, error) from error
    if contents[0][:_MODEL_HEAD] == contents[1][:_MODEL_HEAD]:
        # The head has the version of MuJoCo that wrote it.
        yield Same(topic=Topic.IDENTITY, file=file, unit="compiled model")
    if contents[0] != contents[1]:
        yield _recompiled(file)
    else:
        yield Difference(
            topic=Topic.FILES,
            file=file,
            aspect=Aspect.STORED,
            how="the same model, compressed otherwise",
        )


def _damaged(file: str, error: Error) -> Difference:
    # Without the path, which is that of a temporary folder.
    reason = error.reason if isinstance(error, UnreadableFile) else str(error)
    topic = _TOPICS.get(_kind(file), Topic.FILES)
    return Difference(topic=topic, file=file, how=f"it cannot be read: {reason}")


def _not_made(file: str) -> Difference:
    topic = _TOPICS.get(_kind(file), Topic.FILES)
    return Difference(topic=topic, file=file, how=_NOT_MADE)


def _other_code() -> Finding:
    return Finding(
        topic=Topic.PHYSICS,
        item="",
        outcome=Outcome.NOTED,
        reason="it claims the versions and the machine that are here, so other code or "
        "other numbers were at work",
        unit="verification",
        is_headline=True,
    )


def _recompiled(file: str) -> Difference:
    return Difference(
        topic=Topic.IDENTITY,
        file=file,
        aspect=Aspect.MODEL,
        unit="compiled model",
        how="it was compiled otherwise",
    )


def _video_of(file: str) -> str:
    return f"{file.removesuffix('.meta.json')}.mp4"


def _with_video(manifest: Mapping[str, Any]) -> set[int]:
    """Return the episodes that have a video, or wait for one."""
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
        how=f"only the archive has {_listed(given - made)}, only what was made again "
        f"has {_listed(made - given)}",
    )


def _listed(numbers: set[int]) -> str:
    return short(", ".join(map(str, sorted(numbers))) or "none")


def _frame_count(video: Path) -> int:
    count = read_metadata(video).get("frame_count")
    return count if isinstance(count, int) else 0


def _believed(topic: Topic, reason: str, count: int, unit: str) -> Finding:
    return Finding(
        topic=topic,
        item="",
        outcome=Outcome.BELIEVED,
        reason=reason,
        count=count,
        unit=unit,
    )
