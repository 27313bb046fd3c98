# SPDX-License-Identifier: Apache-2.0
"""Results are found, merged and cleared as in gym, without its mistakes."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

import pytest

import mjrec
from mjrec.errors import DirectoryInUse, UnreadableFile
from mjrec.formats.locks import Lock
from mjrec.formats.manifest import Manifest, write_manifest
from mjrec.formats.stats_file import StatsFile, write_stats_file

ENV_INFO = {"gym_version": "mjrec-1", "env_id": "Hopper-v5"}


def stats(
    *timestamps: float, start: float | None = 0.0, types: str | None = None
) -> StatsFile:
    """Return statistics whose lengths and rewards tell the episodes apart."""
    return StatsFile(
        initial_reset_timestamp=start,
        timestamps=timestamps,
        episode_lengths=tuple(int(t * 10) for t in timestamps),
        episode_rewards=tuple(-t for t in timestamps),
        episode_types=None if types is None else tuple(types),
    )


def write(
    directory: Path,
    infix: str,
    content: StatsFile,
    *,
    env_info: dict[str, Any] = ENV_INFO,
    videos: tuple[tuple[str, str], ...] = (),
) -> str:
    """Write what a closed monitor leaves; return the manifest's path."""
    name = f"openaigym.episode_batch.{infix}.stats.json"
    write_stats_file(directory / name, content)
    path = directory / f"openaigym.manifest.{infix}.manifest.json"
    write_manifest(path, Manifest(name, videos, env_info, None))
    return str(path)


def load(directory: Path) -> dict[str, Any]:
    results = mjrec.load_results(directory)
    assert results is not None
    return results


def touch(directory: Path, *names: str) -> list[Path]:
    paths = [directory / name for name in names]
    for path in paths:
        path.touch()
    return paths


MONITOR_FILES = [
    "openaigym.episode_batch.0.1.stats.json",
    "openaigym.episodes.0.1.jsonl",
    "openaigym.manifest.0.1.manifest.json",
    "openaigym.video.0.1.video000000.json",
    "openaigym.video.0.1.video000000.meta.json",
    "openaigym.video.0.1.video000000.mp4",
]
HIDDEN_FILES = [
    ".openaigym.0.1.lock",
    ".openaigym.video.0.1.video000008.mp4.01234567.part",
]
OTHER_FILES = ["openaigym.notes.txt", "openaigymfoo", "policy.pt", ".hidden"]


def test_detecting_manifests_takes_exact_names_in_order(tmp_path: Path) -> None:
    """Left-overs of an interrupted gym and names like a manifest's are none."""
    touch(
        tmp_path,
        "openaigym.manifest.1.7.manifest.json",
        "openaigym.manifest.0.7.manifest.json",
        "openaigym.manifest.0.8.manifest.json~",
        "openaigym.manifest.",
        "openaigym.manifest.0.9.manifest.jsonl",
    )
    expected = [
        str(tmp_path / "openaigym.manifest.0.7.manifest.json"),
        str(tmp_path / "openaigym.manifest.1.7.manifest.json"),
    ]
    assert mjrec.detect_training_manifests(tmp_path) == expected
    assert mjrec.detect_training_manifests(str(tmp_path)) == expected


def test_detecting_manifests_among_given_names(tmp_path: Path) -> None:
    """`files` stands for the listing of the directory."""
    late, early = (f"openaigym.manifest.{i}.7.manifest.json" for i in (1, 0))
    assert mjrec.detect_training_manifests(tmp_path, files=[late, "x", early]) == [
        str(tmp_path / early),
        str(tmp_path / late),
    ]


def test_detecting_monitor_files(tmp_path: Path) -> None:
    """What monitors finished, and nothing of other people."""
    touch(tmp_path, *MONITOR_FILES, *HIDDEN_FILES, *OTHER_FILES)
    assert mjrec.detect_monitor_files(tmp_path) == [
        str(tmp_path / name) for name in MONITOR_FILES
    ]
    assert mjrec.detect_monitor_files(str(tmp_path / "missing")) == []


def test_clearing_removes_monitor_files_and_nothing_else(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Locks and unfinished files of the dead too; no directory, whatever its name."""
    caplog.set_level(logging.INFO, "mjrec")
    touch(tmp_path, *MONITOR_FILES, *HIDDEN_FILES, *OTHER_FILES)
    folder = tmp_path / "openaigym.video.9.9.video000000.mp4"
    folder.mkdir()
    mjrec.clear_monitor_files(str(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {*OTHER_FILES, folder.name}
    assert "Removed 8 monitor files" in caplog.text
    mjrec.clear_monitor_files(tmp_path / "missing")


def test_clearing_removes_a_link_and_not_what_it_points_to(tmp_path: Path) -> None:
    """Somebody's original stays."""
    (original,) = touch(tmp_path, "original.mp4")
    link = tmp_path / MONITOR_FILES[-1]
    link.symlink_to(original)
    mjrec.clear_monitor_files(tmp_path)
    assert list(tmp_path.iterdir()) == [original]


def test_a_directory_in_use_is_not_cleared(tmp_path: Path) -> None:
    """Nothing is removed while an open monitor holds its lock."""
    touch(tmp_path, *MONITOR_FILES)
    lock = Lock(tmp_path / HIDDEN_FILES[0], "")
    with pytest.raises(DirectoryInUse, match=r"\.openaigym\.0\.1\.lock"):
        mjrec.clear_monitor_files(tmp_path)
    assert len(list(tmp_path.iterdir())) == len(MONITOR_FILES) + 1
    lock.release()
    mjrec.clear_monitor_files(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_merging_sorts_by_time_and_keeps_rows_together(tmp_path: Path) -> None:
    """Lengths, rewards, types and sources follow their timestamps."""
    write(tmp_path, "0.7", stats(1.0, 4.0, start=0.5, types="te"))
    write(tmp_path, "1.7", stats(2.0, 3.0, start=0.25, types="et"))
    paths = [tmp_path / f"openaigym.episode_batch.{i}.7.stats.json" for i in (0, 1)]
    assert mjrec.merge_stats_files(paths) == (
        [0, 1, 1, 0],
        [0.5, 0.25],
        [1.0, 2.0, 3.0, 4.0],
        [10, 20, 30, 40],
        [-1.0, -2.0, -3.0, -4.0],
        ["t", "e", "t", "e"],
        0.25,
    )


def test_merging_is_stable(tmp_path: Path) -> None:
    """Many episodes of the same time stay in the order of files and episodes."""
    for infix in ("0.7", "1.7"):
        content = StatsFile(0.0, (1.0,) * 100, tuple(range(100)), (0.0,) * 100, None)
        write(tmp_path, infix, content)
    results = load(tmp_path)
    assert results["data_sources"] == [0] * 100 + [1] * 100
    assert results["episode_lengths"] == [*range(100), *range(100)]


def test_nothing_merged_gives_what_gym_gave() -> None:
    """Empty lists, no types, and a start of 0."""
    assert mjrec.merge_stats_files([]) == ([], [], [], [], [], None, 0)


def test_surplus_types_do_not_shift_those_of_later_files(tmp_path: Path) -> None:
    """Gym noted a type at each reset; each file's surplus is dropped."""
    write(tmp_path, "0.7", stats(1.0, types="ttt"))
    write(tmp_path, "1.7", stats(2.0, 3.0, types="eee"))
    assert load(tmp_path)["episode_types"] == ["t", "e", "e"]


def test_a_file_without_types_holds_training_episodes(tmp_path: Path) -> None:
    """Beside one that has types; alone it has none."""
    write(tmp_path, "0.7", stats(1.0, 2.0))
    assert load(tmp_path)["episode_types"] is None
    write(tmp_path, "1.7", stats(1.5, types="e"))
    assert load(tmp_path)["episode_types"] == ["t", "e", "t"]


def test_sources_index_manifests_and_starts_past_empty_files(tmp_path: Path) -> None:
    """A monitor that completed nothing keeps its place in every list."""
    write(tmp_path, "0.7", stats(start=None, types=""))
    write(tmp_path, "1.7", stats(start=0.1, types="e"))
    last = write(tmp_path, "2.7", stats(1.0, start=0.5, types="t"))
    results = load(tmp_path)
    assert results["initial_reset_timestamps"] == [None, 0.1, 0.5]
    (source,) = results["data_sources"]
    assert results["manifests"][source] == last
    assert results["initial_reset_timestamps"][source] == 0.5
    assert results["initial_reset_timestamp"] == 0.5


def test_rewards_that_are_no_numbers_come_back(tmp_path: Path) -> None:
    """NaN and infinity as they were."""
    rewards = (math.nan, math.inf, -math.inf, 1.0)
    write(
        tmp_path, "0.7", StatsFile(0.0, (1.0, 2.0, 3.0, 4.0), (1,) * 4, rewards, None)
    )
    loaded = load(tmp_path)["episode_rewards"]
    assert loaded == pytest.approx(list(rewards), nan_ok=True)
    assert all(type(reward) is float for reward in loaded)


def test_no_directory_is_none_and_an_error_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As in gym; the same for a directory without manifests."""
    assert mjrec.load_results(tmp_path / "missing") is None
    assert mjrec.load_results(str(tmp_path)) is None
    assert [record.levelname for record in caplog.records] == ["ERROR", "ERROR"]
    assert f"There is no directory {tmp_path / 'missing'}" in caplog.text
    assert f"There are no manifests in {tmp_path}" in caplog.text


def test_unequal_env_infos_are_merged_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The warning shows what differs and where; the newest results' info counts."""
    newest = {"gym_version": "mjrec-1", "env_id": "Hopper-v5", "extra": [1]}
    write(tmp_path, "0.7", stats(9.0, start=8.0), env_info=newest)
    older = {"gym_version": "0.21.0", "env_id": "Hopper-v5"}
    write(tmp_path, "1.7", stats(1.0), env_info=older)
    results = load(tmp_path)
    assert results["env_info"] == newest
    assert results["timestamps"] == [1.0, 9.0]
    (record,) = caplog.records
    assert "'0.21.0' in openaigym.manifest.1.7.manifest.json" in record.getMessage()
    assert "extra is [1] in" in record.getMessage()
    assert "env_id is" not in record.getMessage()


def test_missing_keys_of_env_info_are_fine(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A monitor around an environment without a spec can be loaded."""
    write(tmp_path, "0.7", stats(1.0), env_info={"gym_version": "0.21.0"})
    assert load(tmp_path)["env_info"] == {"gym_version": "0.21.0"}
    write(tmp_path, "0.7", stats(1.0), env_info={})
    assert load(tmp_path)["env_info"] == {}
    assert not caplog.records


def test_videos_are_pairs_of_paths_in_order(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Those that are gone are left out, with one warning for all."""
    pairs = tuple((f"v{i}.mp4", f"v{i}.meta.json") for i in range(4))
    write(tmp_path, "1.7", stats(), videos=pairs[:1])
    write(tmp_path, "0.7", stats(), videos=pairs[1:])
    touch(tmp_path, "v0.mp4", "v0.meta.json", "v2.mp4", "v2.meta.json")
    assert load(tmp_path)["videos"] == [
        (str(tmp_path / "v2.mp4"), str(tmp_path / "v2.meta.json")),
        (str(tmp_path / "v0.mp4"), str(tmp_path / "v0.meta.json")),
    ]
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "2 of 4 videos" in record.getMessage()
    assert "v1.mp4, v3.mp4" in record.getMessage()


def test_missing_and_damaged_files_are_named(tmp_path: Path) -> None:
    """First the statistics, then the manifest."""
    path = Path(write(tmp_path, "0.7", stats(1.0)))
    stats_path = tmp_path / "openaigym.episode_batch.0.7.stats.json"
    stats_path.write_text(stats_path.read_text()[:-5])
    with pytest.raises(UnreadableFile, match=stats_path.name):
        mjrec.load_results(tmp_path)
    stats_path.unlink()
    with pytest.raises(UnreadableFile, match=f"{stats_path.name}: No such file"):
        mjrec.load_results(tmp_path)
    path.write_text(json.dumps({"stats": "../secret"}))
    with pytest.raises(UnreadableFile, match=path.name):
        mjrec.load_results(tmp_path)


def test_a_moved_directory_is_read(tmp_path: Path) -> None:
    """Paths in the results are those of the directory as it is asked for."""
    (tmp_path / "old").mkdir()
    write(tmp_path / "old", "0.7", stats(1.0))
    (tmp_path / "old").rename(tmp_path / "new")
    assert load(tmp_path / "new")["manifests"] == [
        str(tmp_path / "new" / "openaigym.manifest.0.7.manifest.json")
    ]
