# SPDX-License-Identifier: Apache-2.0
"""Directories that real gyms wrote are read, and real gym 0.21 agrees with us.

`data/gym/<version>/<case>/` was recorded by `legacy/record_gym.py` with that version.
Gym itself runs in an environment of its own, made once and kept in the user's cache.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mjrec
from mjrec.formats.manifest import Manifest, write_manifest
from mjrec.formats.stats_file import StatsFile, write_stats_file

TESTS = Path(__file__).parent
DATA = TESTS / "data" / "gym"
VERSIONS = ["0.7.4", "0.9.6", "0.12.1", "0.17.3", "0.19.0", "0.21.0", "0.22.0"]
CASES = sorted(path.name for path in (DATA / VERSIONS[0]).iterdir())
NAN, INF = math.nan, math.inf

# What was played in each case: lengths, rewards, types.
PLAYED: dict[str, tuple[list[int], list[float], str | None]] = {
    "plain": ([3, 1, 2], [4.5, -2.0, 0.5], "ttt"),
    "text": ([3, 1, 2], [4.5, -2.0, 0.5], "ttt"),
    "not_finite": ([3, 1, 2], [NAN, INF, -INF], "ttt"),
    "no_spec": ([3], [4.5], "t"),
    "unfinished": ([3, 1], [4.5, -2.0], "ee"),
    "empty": ([], [], None),
    "two_monitors": ([3, 3, 1, 1], [4.5, 4.5, -2.0, -2.0], "tete"),
    # Played as "tee": gym's file has "tteee" and does not say which were surplus.
    "resets_in_a_row": ([3, 1, 2], [4.5, -2.0, 0.5], "tte"),
}


def load(directory: Path) -> dict[str, Any]:
    results = mjrec.load_results(directory)
    assert results is not None
    return results


def test_every_version_and_case_is_recorded() -> None:
    """No directory went missing."""
    assert {path.name for path in DATA.iterdir()} == set(VERSIONS)
    for version in VERSIONS:
        assert {path.name for path in (DATA / version).iterdir()} == set(PLAYED)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("case", CASES)
def test_what_a_gym_wrote_is_read(version: str, case: str) -> None:
    """Lengths, rewards and types are those that were played."""
    directory = DATA / version / case
    lengths, rewards, types = PLAYED[case]
    results = load(directory)
    assert results["episode_lengths"] == lengths
    assert results["episode_rewards"] == pytest.approx(rewards, nan_ok=True)
    assert results["episode_types"] == (None if types is None else list(types))
    assert results["env_info"] == {
        "gym_version": version,
        **({} if case == "no_spec" else {"env_id": "Tiny-v0"}),
    }
    assert sorted(results["timestamps"]) == results["timestamps"]
    episodes = list(mjrec.iter_episodes(directory))
    assert sorted(episode.length for episode in episodes) == sorted(lengths)


@pytest.mark.parametrize("version", VERSIONS)
def test_monitors_of_one_directory_are_told_apart(version: str) -> None:
    """Also past the one that only began."""
    results = load(DATA / version / "two_monitors")
    assert results["data_sources"] == [0, 2, 0, 2]
    starts = results["initial_reset_timestamps"]
    assert len(starts) == len(results["manifests"]) == 3
    for source, end in zip(results["data_sources"], results["timestamps"], strict=True):
        assert starts[source] < end
    assert results["initial_reset_timestamp"] == starts[0] == min(starts)


@pytest.mark.parametrize("version", VERSIONS)
def test_text_recordings_of_a_gym_are_found(version: str) -> None:
    """As pairs of paths, and with their episodes."""
    directory = DATA / version / "text"
    videos = load(directory)["videos"]
    assert [Path(video).name[-16:] for video, _ in videos] == [
        "video000000.json",
        "video000002.json",
    ]
    first, second, third = mjrec.iter_episodes(directory)
    assert [(str(e.video), str(e.metadata)) for e in (first, third)] == videos
    assert second.video is None


@pytest.fixture(scope="session")
def gym_python() -> Path:
    """Return the Python of an environment that holds gym 0.21.0."""
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    home = cache / "mjrec-tests" / f"gym-0.21.0-{tag}"
    home.parent.mkdir(parents=True, exist_ok=True)
    with home.with_suffix(".lock").open("w") as lock:
        # Several test processes make it once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (home / "complete").exists():
            shutil.rmtree(home, ignore_errors=True)
            make_gym_environment(home)
            (home / "complete").touch()
    return home / "bin" / "python"


def make_gym_environment(home: Path) -> None:
    """Install gym 0.21.0, which only tools of its own time can build."""
    run(sys.executable, "-m", "venv", home)
    python = home / "bin" / "python"
    pip = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    run(*pip, "pip==24.0", "setuptools==65.5.1", "wheel==0.38.4")
    # That setuptools wants a class which Python 3.12 took away, and never uses it.
    (packages,) = home.glob("lib/python*/site-packages")
    (packages / "old_setuptools.pth").write_text(
        "import pkgutil; pkgutil.ImpImporter = "
        "getattr(pkgutil, 'ImpImporter', type('ImpImporter', (), {}))\n"
    )
    numpy = "numpy<2" if sys.version_info < (3, 13) else "numpy<3"
    run(*pip, "--only-binary=numpy", "--no-build-isolation", "gym==0.21.0", numpy)


def run(*command: str | Path) -> str:
    """Run a program; show what it said where it fails."""
    # Warnings are errors in these tests, not in gym.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"}
    done = subprocess.run(
        [str(part) for part in command],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
        timeout=240,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def gym_load_results(python: Path, *directories: Path) -> list[Any]:
    """Return what gym's own `load_results` returns for each directory."""
    script = TESTS / "legacy" / "gym_load_results.py"
    results: list[Any] = json.loads(run(python, script, *directories))
    for result in results:
        if result is not None and "videos" in result:
            result["videos"] = [tuple(pair) for pair in result["videos"]]
    return results


def assert_same(ours: Any, gyms: Any, *, but: tuple[str, ...] = ()) -> None:
    """Compare key by key; keys of `but` are compared elsewhere."""
    assert list(ours) == list(gyms)
    for key in [key for key in ours if key not in but]:
        # NaN is equal to nothing; its text is.
        assert repr(ours[key]) == repr(gyms[key]), key


@pytest.mark.legacy
def test_gym_agrees_on_what_gyms_wrote(gym_python: Path) -> None:
    """Key by key, except where gym is known to be wrong."""
    cases = [
        path for version in VERSIONS for path in sorted((DATA / version).iterdir())
    ]
    for directory, gyms in zip(
        cases, gym_load_results(gym_python, *cases), strict=True
    ):
        ours = load(directory)
        match directory.name:
            case "no_spec":
                assert "missing expected key env_id" in gyms["error"]
            case "two_monitors":
                # It lists no start for the idle monitor and shifts the types.
                but = ("initial_reset_timestamps", "episode_types")
                assert_same(ours, gyms, but=but)
                starts = ours["initial_reset_timestamps"]
                assert gyms["initial_reset_timestamps"] == [starts[0], starts[2]]
                assert gyms["episode_types"] == ["t", "t", "t", "e"]
            case "empty":
                assert_same(ours, gyms, but=("initial_reset_timestamps",))
                assert gyms["initial_reset_timestamps"] == []
            case _:
                assert_same(ours, gyms)


@pytest.mark.legacy
def test_gym_agrees_on_what_we_write(gym_python: Path, tmp_path: Path) -> None:
    """Two monitors of a directory with videos, a key of our own, and infinity."""
    for monitor, (name, shift) in enumerate([("0.7", 0.0), ("1.7", 0.5)]):
        stats = StatsFile(
            initial_reset_timestamp=1790000000.0 + shift,
            timestamps=(1790000001.0 + shift, 1790000002.0 + shift),
            episode_lengths=(10, 20),
            episode_rewards=(math.inf, 0.1 + monitor),
            episode_types=("t", "e"),
        )
        stats_name = f"openaigym.episode_batch.{name}.stats.json"
        video = f"openaigym.video.{name}.video000000"
        write_stats_file(tmp_path / stats_name, stats)
        for suffix in (".mp4", ".meta.json"):
            (tmp_path / (video + suffix)).touch()
        manifest = Manifest(
            stats=stats_name,
            videos=((f"{video}.mp4", f"{video}.meta.json"),),
            env_info={"gym_version": "mjrec-1", "env_id": "Hopper-v5"},
            mjrec={"format": 1, "schedule": ["cubic", [True, True]]},
        )
        write_manifest(tmp_path / f"openaigym.manifest.{name}.manifest.json", manifest)
    (gyms,) = gym_load_results(gym_python, tmp_path)
    assert gyms["episode_types"] == ["t", "t", "e", "e"]
    assert_same(load(tmp_path), gyms)


@pytest.mark.legacy
def test_gym_agrees_on_what_a_monitor_writes(
    gym_python: Path, tmp_path: Path, corridor: Any, make_corridor: Any, play: Any
) -> None:
    """Two runs, the second resumed, with videos, a mode, and an unfinished episode."""
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 2)
        env.reset()
        env.step(0)
    with mjrec.Monitor(
        make_corridor(length=2), tmp_path, resume=True, mode="evaluation"
    ) as env:
        play(env, 2)
    (gyms,) = gym_load_results(gym_python, tmp_path)
    assert gyms["episode_lengths"] == [3, 3, 2, 2]
    assert gyms["episode_types"] == ["t", "t", "e", "e"]
    assert_same(load(tmp_path), gyms)


@pytest.mark.legacy
def test_gym_reads_null_where_we_wrote_nan(gym_python: Path, tmp_path: Path) -> None:
    """The file is JSON; the other episodes' rewards are unharmed."""
    name = "openaigym.episode_batch.0.7.stats.json"
    stats = StatsFile(1.0, (2.0, 3.0), (1, 1), (math.nan, 2.5), ("t", "t"))
    write_stats_file(tmp_path / name, stats)
    env_info = {"gym_version": "mjrec-1", "env_id": "Hopper-v5"}
    path = tmp_path / "openaigym.manifest.0.7.manifest.json"
    write_manifest(path, Manifest(name, (), env_info, None))
    (gyms,) = gym_load_results(gym_python, tmp_path)
    assert gyms["episode_rewards"] == [None, 2.5]
    assert_same(load(tmp_path), gyms, but=("episode_rewards",))


@pytest.mark.legacy
def test_gym_agrees_that_there_is_nothing(gym_python: Path, tmp_path: Path) -> None:
    """None for a missing directory and for one without manifests."""
    directories = [tmp_path / "missing", tmp_path]
    assert gym_load_results(gym_python, *directories) == [None, None]
    assert [mjrec.load_results(directory) for directory in directories] == [None, None]
