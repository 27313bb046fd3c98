# SPDX-License-Identifier: Apache-2.0
"""A packed run holds what was recorded, conforms, and is the same every time."""

from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import stat
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from packed_runs import record_pendulum, the, unpacked
from recordings import frames_of, manifest_of, metadata_of, videos_in

import honest_runs
import mjrec
from mjrec.evidence.layout import STATISTICS_COLUMNS
from mjrec.evidence.pack import pack_folder
from mjrec.evidence.packed_run import PackingOptions
from mjrec.formats.journal import is_of_spans

STATED: dict[str, Any] = {
    "title": "Pendulums: «five» of them",
    "authors": ["Ada Lovelace <0000-0002-1825-0097>", "van Rossum, Guido <g@x.org>"],
    "license": "cc-by-4.0",
}


@pytest.fixture(scope="module")
def recorded(pendulums: Callable[..., Path]) -> Path:
    """Return a directory with three episodes, of which two have a video."""
    return pendulums(3)


@pytest.fixture(scope="module")
def archive(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return it packed."""
    path = tmp_path_factory.mktemp("packed") / "run.zip"
    return mjrec.pack(recorded, path, **STATED)


@pytest.fixture(scope="module")
def bag(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return that unpacked."""
    return unpacked(archive, tmp_path_factory.mktemp("unpacked"))


@pytest.fixture(scope="module")
def infix(recorded: Path) -> str:
    """Return what the names of its files have in common."""
    name = the(recorded, "*.jsonl").name
    return name.removeprefix("openaigym.episodes.").removesuffix(".jsonl")


def packed_bytes(path: Path) -> bytes:
    """Return what is packed of a file: of a journal all but the lines about logs."""
    lines = path.read_bytes().splitlines(keepends=True)
    is_journal = path.suffix == ".jsonl"
    return b"".join(x for x in lines if not (is_journal and is_of_spans(x)))


def test_it_holds_the_recordings_unchanged(recorded: Path, bag: Path) -> None:
    """Every file of the directory, and not one byte of it is another."""
    assert bag.name == "run"
    packed = {path.name: path for path in (bag / "data/recordings").iterdir()}
    assert sorted(packed) == sorted(path.name for path in recorded.iterdir())
    for name, path in packed.items():
        assert path.read_bytes() == packed_bytes(recorded / name)


def test_other_programs_take_the_bag(bag: Path) -> None:
    """The `bagit` package, and sha512sum, as the README says."""
    assert (bag / "bagit.txt").read_text().startswith("BagIt-Version: 1.0\n")
    for command in (
        [sys.executable, "-m", "bagit", "--validate", "."],
        ["sha512sum", "--check", "--strict", "--quiet", "manifest-sha512.txt"],
    ):
        subprocess.run(command, cwd=bag, check=True, capture_output=True)


def test_names_in_the_zip_are_plain(archive: Path) -> None:
    """One folder, sorted, no times, no owners, what is compressed already stored."""
    with zipfile.ZipFile(archive) as packed:
        infos = packed.infolist()
    names = [info.filename for info in infos]
    assert names == sorted(names)
    assert all(name.startswith("run/") for name in names)
    assert {info.date_time for info in infos} == {(1980, 1, 1, 0, 0, 0)}
    assert {info.external_attr >> 16 for info in infos} == {stat.S_IFREG | 0o644}
    stored = {i.filename for i in infos if i.compress_type == zipfile.ZIP_STORED}
    assert stored == {n for n in names if n.endswith((".mp4", ".h5", ".gz", ".zip"))}


def test_the_same_input_gives_the_same_bytes(
    recorded: Path,
    archive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From a copy with other times, in another order, elsewhere, with another umask."""
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in sorted(recorded.iterdir(), reverse=True):
        shutil.copyfile(path, copy / path.name)
        os.utime(copy / path.name, (1, 1))
    monkeypatch.chdir(tmp_path)
    before = os.umask(0o077)
    try:
        again = mjrec.pack("copy", "run.zip", **STATED)
    finally:
        os.umask(before)
    assert again.read_bytes() == archive.read_bytes()


def test_packing_changes_nothing_else(recorded: Path, tmp_path: Path) -> None:
    """Neither the recordings, nor the working directory, also from a thread."""
    before = {path: path.stat() for path in recorded.iterdir()}
    place = Path.cwd()
    seen: set[Path] = set()
    packing = threading.Thread(target=mjrec.pack, args=(recorded, tmp_path / "a.zip"))
    packing.start()
    while packing.is_alive():
        seen.add(Path.cwd())
        packing.join(0.001)
    assert seen | {Path.cwd()} == {place}
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]
    after = {path: path.stat() for path in recorded.iterdir()}
    assert after.keys() == before.keys()
    for path, status in after.items():
        # The links that were made of it are gone.
        assert (status.st_mtime_ns, status.st_nlink, status.st_mode) == (
            before[path].st_mtime_ns,
            1,
            before[path].st_mode,
        )


def test_files_are_copied_where_there_are_no_links(
    recorded: Path, archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another file system, say; the archive is the same."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    again = mjrec.pack(recorded, tmp_path / "run.zip", **STATED)
    assert again.read_bytes() == archive.read_bytes()


def test_the_table_says_what_the_journal_says(
    recorded: Path, infix: str, bag: Path
) -> None:
    """A row an episode, in order, with the same bits in every number."""
    with (bag / "data/statistics.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert tuple(head) == STATISTICS_COLUMNS
    episodes = list(mjrec.iter_episodes(recorded))
    assert len(rows) == len(episodes) == 3
    for cells, episode in zip(rows, episodes, strict=True):
        row = dict(zip(head, cells, strict=True))
        assert (row["monitor"], int(row["episode_id"])) == (infix, episode.episode_id)
        assert float(row["reward"]) == episode.reward
        assert float(row["end_time"]) == episode.end_time
        assert json.loads(row["seed"]) == episode.seed
        assert row["truncated"] == str(episode.truncated).lower()
        assert row["video"] == (episode.video.name if episode.video else "")
        assert bool(row["video_sha256"]) == bool(episode.video)
    digest = metadata_of(recorded, 0)["file_sha256"]
    assert dict(zip(head, rows[0], strict=True))["video_sha256"] == digest


def _entities(bag: Path) -> dict[str, Any]:
    crate = json.loads((bag / "data/ro-crate-metadata.json").read_text())
    assert crate["@context"] == "https://w3id.org/ro/crate/1.1/context"
    entities = {entity["@id"]: entity for entity in crate["@graph"]}
    assert len(entities) == len(crate["@graph"])
    return entities


def test_the_crate_has_what_its_specification_wants(bag: Path) -> None:
    """What RO-Crate 1.1 and Process Run Crate 0.5 call MUST."""
    entities = _entities(bag)
    descriptor = entities["ro-crate-metadata.json"]
    assert descriptor["about"] == {"@id": "./"}
    assert descriptor["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    root = entities["./"]
    assert root["@type"] == "Dataset"
    assert all(root[key] for key in ("name", "description", "datePublished"))
    assert entities[root["license"]["@id"]]["name"] == "CC-BY-4.0"
    profile = root["conformsTo"]["@id"]
    assert profile == "https://w3id.org/ro/wfrun/process/0.5"
    assert entities[profile]["@type"] == "CreativeWork"
    people = [entities[author["@id"]]["name"] for author in root["author"]]
    assert people == ["Ada Lovelace", "Guido van Rossum"]
    assert "https://orcid.org/0000-0002-1825-0097" in entities
    action = entities[root["mentions"]["@id"]]
    assert action["@type"] == "CreateAction"
    tools = [entities[tool["@id"]] for tool in action["instrument"]]
    assert {tool["@type"] for tool in tools} == {"SoftwareApplication"}
    assert tools[0]["name"] == "mjrec"
    versions = {tool["name"]: tool["softwareVersion"] for tool in tools}
    assert versions["mjrec"] == mjrec.__version__
    assert versions.keys() >= {"mujoco", "gymnasium", "python"}
    assert action["startTime"] < action["endTime"]


def test_the_crate_describes_every_file_and_nothing_else(bag: Path) -> None:
    """Every reference leads to an entity, and every entity of a file to a file."""
    entities = _entities(bag)
    files = {
        path.relative_to(bag / "data").as_posix()
        for path in (bag / "data").rglob("*")
        if path.is_file() and path.name != "ro-crate-metadata.json"
    }
    described = {i for i, entity in entities.items() if entity["@type"] == "File"}
    assert described == files
    for name in described:
        size = (bag / "data" / name).stat().st_size
        assert entities[name]["contentSize"] == str(size)

    def references(value: Any) -> Any:
        if isinstance(value, dict):
            return [value["@id"]] if set(value) == {"@id"} else []
        return (
            [i for item in value for i in references(item)]
            if (isinstance(value, list))
            else []
        )

    known = {i for entity in entities.values() for i in map(str, [entity["@id"]])}
    for entity in entities.values():
        for value in entity.values():
            for reference in references(value):
                assert reference in known or reference.startswith(
                    ("http://schema.org/", "https://w3id.org/ro/crate/")
                )
    [action] = [e for e in entities.values() if e["@type"] == "CreateAction"]
    results = {result["@id"] for result in action["result"]}
    objects = {one["@id"] for one in action["object"]}
    recordings = {name for name in files if name.startswith("recordings/")}
    assert results | (objects & recordings) == recordings
    assert {one for one in objects if "model" in one} == {
        name for name in recordings if ".model." in name
    }


def test_the_citation_is_valid(bag: Path) -> None:
    """YAML, with what the format demands."""
    cited = yaml.safe_load((bag / "data/CITATION.cff").read_text())
    assert cited["cff-version"] == "1.2.0"
    assert cited["title"] == STATED["title"]
    assert cited["license"] == "CC-BY-4.0"
    assert cited["authors"] == [
        {
            "family-names": "Lovelace",
            "given-names": "Ada",
            "orcid": "https://orcid.org/0000-0002-1825-0097",
        },
        {"family-names": "van Rossum", "given-names": "Guido", "email": "g@x.org"},
    ]


def test_the_environment_says_what_drew_and_encoded(
    recorded: Path, infix: str, bag: Path
) -> None:
    """Beside what the recording says of its own provenance."""
    content = json.loads((bag / "data/environment.json").read_text())
    said, metadata = content["recordings"][infix], metadata_of(recorded, 0)
    details = manifest_of(recorded)["mjrec"]
    assert said["env_id"] == "InvertedPendulum-v5"
    assert said["versions"] == details["versions"]
    assert said["provenance"] == details.get("provenance")
    [frames], [encoder] = said["pictures"], said["encoders"]
    assert frames["gl_renderer"] == metadata["gl_renderer"]
    assert encoder["ffmpeg_sha256"] == metadata["ffmpeg_sha256"]
    assert content["packed_with"]["mjrec"] == mjrec.__version__


def test_the_readme_leads_a_stranger(infix: str, recorded: Path, bag: Path) -> None:
    """What it is, how to verify it, what was shown, by which rule."""
    returns = mjrec.load_results(recorded)["episode_rewards"]
    text = (bag / "data/README.md").read_text()
    for part in (
        f"# {STATED['title']}",
        "mjrec verify run.zip",
        "Ada Lovelace",
        "CC-BY-4.0",
        "capped_cubic_video_schedule",
        f"openaigym.video.{infix}.video000001.mp4",
        "| OpenGL | ",
        "a view of the recorded states, not separate evidence",
        f"| {infix} | InvertedPendulum-v5 | 3 | {sum(returns) / 3:.6g} | ",
    ):
        assert part in text
    assert "The author chose" not in text


def test_the_readme_says_what_environments_were_made_with(tmp_path: Path) -> None:
    """Which makes another environment of one with a name that everybody knows."""
    env = gymnasium.make("HalfCheetah-v5", forward_reward_weight=100.0)
    env = gymnasium.wrappers.ClipReward(env, 1.0)
    directory = tmp_path / "run"
    kept: dict[str, Any] = {"video_callable": False, "trajectory_callable": True}
    honest_runs.play(mjrec.Monitor(env, directory, **kept), 1, most=2)
    folder = unpacked(mjrec.pack(directory, tmp_path / "a.zip"), tmp_path / "x")
    text = (folder / "data/README.md").read_text()
    said = (
        "| environment | HalfCheetah-v5, made with forward_reward_weight=100.0, in the"
    )
    assert said in text
    assert "ClipReward(min_reward=1.0" in text


def test_nothing_need_be_stated(recorded: Path, tmp_path: Path) -> None:
    """Then that is said, where something has to be."""
    folder = unpacked(mjrec.pack(recorded, tmp_path / "a.zip"), tmp_path / "x")
    root = _entities(folder)["./"]
    assert root["name"] == "Recordings of InvertedPendulum-v5"
    assert root["license"].startswith("No licence was stated")
    assert "author" not in root
    cited = yaml.safe_load((folder / "data/CITATION.cff").read_text())
    assert cited["authors"] == [{"name": "Not stated"}]
    assert "license" not in cited


@pytest.fixture(scope="module")
def one_chosen(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an archive of episode 1 alone, chosen by a NumPy integer."""
    path = tmp_path_factory.mktemp("chosen") / "one.zip"
    mjrec.pack(recorded, path, episodes=np.array([1]))
    return unpacked(path, path.parent / "x")


def test_some_episodes_can_be_chosen(
    recorded: Path, infix: str, one_chosen: Path, names: Callable[[Path], list[str]]
) -> None:
    """Statistics stay whole, and everything says that a choice was made."""
    packed = one_chosen / "data/recordings"
    assert videos_in(packed) == [1]
    left_out = set(names(recorded)) - set(names(packed))
    assert left_out == {n for n in names(recorded) if ".video000000." in n}
    manifest = manifest_of(packed)
    assert [video for video, _ in manifest["videos"]] == [
        f"openaigym.video.{infix}.video000001.mp4"
    ]
    assert manifest["mjrec"].pop("packed_episodes") == [1]
    assert manifest["mjrec"] == manifest_of(recorded)["mjrec"]
    assert len((one_chosen / "data/statistics.csv").read_text().splitlines()) == 4
    # In the original it is as it was.
    assert videos_in(recorded) == [0, 1]


def test_actions_of_all_episodes_stay(
    recorded: Path, infix: str, one_chosen: Path
) -> None:
    """Anyone can make the others again, from their seeds; only states are left out."""
    name = f"openaigym.trajectory.{infix}.episode000000.h5"
    before, after = (
        mjrec.load_trajectory(folder / name)
        for folder in (recorded, one_chosen / "data/recordings")
    )
    np.testing.assert_array_equal(after.actions, before.actions)
    np.testing.assert_array_equal(after.rewards, before.rewards)
    assert after.facts["seed"] == before.facts["seed"]
    assert after.states.size == 0 < before.states.size
    assert not after.frame_steps.size


def test_descriptions_claim_what_is_in_the_archive(one_chosen: Path) -> None:
    """Of episodes that were not chosen there are neither videos nor states."""
    held = (
        "statistics of 3 episodes of InvertedPendulum-v5, 1 video, actions of 2 "
        "episodes and physics states of 1 episode"
    )
    text = (one_chosen / "data/README.md").read_text()
    entities = _entities(one_chosen)
    assert held in text
    assert held in entities["./"]["description"]
    assert held in entities["recordings/"]["description"]
    assert "The author chose some" in text
    assert "as it was recorded" not in text


def test_what_was_left_out_is_not_pending(one_chosen: Path) -> None:
    """Nothing promises a video of an episode that was not chosen."""
    episodes = mjrec.iter_episodes(one_chosen / "data/recordings")
    assert not [episode for episode in episodes if episode.pending]


def test_commands_in_the_readme_can_be_pasted(recorded: Path, tmp_path: Path) -> None:
    """A shell takes the archive's name as one argument, whatever is in it."""
    name = "it's $(here); a `run` & more.zip"
    folder = unpacked(mjrec.pack(recorded, tmp_path / name), tmp_path / "x")
    lines = (folder / "data/README.md").read_text().splitlines()
    [command] = [line for line in lines if line.startswith("    mjrec verify ")]
    assert shlex.split(command) == ["mjrec", "verify", name]


def test_more_files_than_verify_takes_are_refused(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before any work, and with the way out."""
    monkeypatch.setattr("mjrec.evidence.pack.MOST_ENTRIES", 20)
    with pytest.raises(mjrec.PackError, match=r"at most 20 files.*--episodes"):
        mjrec.pack(recorded, tmp_path / "run.zip")
    assert not list(tmp_path.iterdir())


def test_the_options_of_packing_are_said(bag: Path, one_chosen: Path) -> None:
    """Who makes the archive again packs in the same way."""
    said = [
        json.loads((folder / "data/environment.json").read_text())["packed_with"]
        for folder in (bag, one_chosen)
    ]
    assert said[0]["options"] == {
        **STATED,
        "name": "run",
        "episodes": None,
        "anonymous": False,
        "max_size": None,
        "planned": None,
    }
    assert said[1]["options"]["episodes"] == [1]


def test_the_same_folder_comes_of_the_same_options(
    recorded: Path, bag: Path, tmp_path: Path
) -> None:
    """Without a zip file, for who compares with it."""
    authors = tuple(STATED["authors"])
    options = PackingOptions(name="run", **{**STATED, "authors": authors})
    pack_folder(recorded, tmp_path / "again", options)
    files = {p.relative_to(bag) for p in bag.rglob("*") if p.is_file()}
    assert len(files) > 20
    for file in files:
        assert (tmp_path / "again" / file).read_bytes() == (bag / file).read_bytes()


@pytest.mark.thorough
def test_models_of_other_episodes_are_left_out(tmp_path: Path) -> None:
    """What nothing in the archive refers to would be called an extra file."""
    directory = tmp_path / "runs"
    record_pendulum(directory, 1)
    stray = directory / "openaigym.model.0123456789abcdef.mjb.gz"
    stray.write_bytes(b"of an episode that is gone")
    again = the(directory, "*.mp4").with_suffix(".side.mp4")
    again.write_bytes(b"rendered again")
    (directory / "notes.txt").write_text("mine")
    packed = unpacked(mjrec.pack(directory, tmp_path / "a.zip"), tmp_path / "x")
    held = {path.name for path in (packed / "data/recordings").iterdir()}
    assert held == {path.name for path in directory.iterdir()} - {
        *(stray.name, again.name, "notes.txt")
    }


def test_two_monitors_are_two_actions(recorded: Path, tmp_path: Path) -> None:
    """Each with its own files; a choice of episodes is of both."""
    directory = tmp_path / "runs"
    shutil.copytree(recorded, directory)
    record_pendulum(directory, 1, uid="other", resume=True)
    folder = unpacked(
        mjrec.pack(directory, tmp_path / "a.zip", episodes=[0]), tmp_path / "x"
    )
    actions = [e for e in _entities(folder).values() if e["@type"] == "CreateAction"]
    assert len(actions) == 2
    results = [{one["@id"] for one in action["result"]} for action in actions]
    assert not results[0] & results[1]
    assert len(_entities(folder)["./"]["mentions"]) == 2


def _record(directory: Path, episodes: int, size: tuple[int, int], **rest: Any) -> None:
    """Record episodes of four steps with frames of that height and width."""
    env = gymnasium.make(
        "HalfCheetah-v5",
        render_mode="rgb_array",
        height=size[0],
        width=size[1],
        max_episode_steps=4,
    )
    with mjrec.Monitor(env, directory, workers=1, **rest) as env:
        for _ in range(episodes):
            env.reset(seed=3)
            done = False
            while not done:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                done = terminated or truncated


def _largest_video(archive: Path) -> int:
    with zipfile.ZipFile(archive) as packed:
        return max(i.file_size for i in packed.infolist() if i.filename[-4:] == ".mp4")


@pytest.mark.thorough
def test_videos_are_drawn_smaller_for_a_limit(tmp_path: Path) -> None:
    """All frames of them, with hashes of their own; the recording stays as it was."""
    directory = tmp_path / "runs"
    _record(directory, 2, size=(240, 320))
    whole = mjrec.pack(directory, tmp_path / "whole.zip")
    told: list[Any] = []
    limit = whole.stat().st_size - _largest_video(whole) // 4
    small = mjrec.pack(
        directory, tmp_path / "small.zip", max_size=limit, on_progress=told.append
    )
    assert small.stat().st_size <= limit
    assert _largest_video(small) < _largest_video(whole)
    folder = unpacked(small, tmp_path / "x")
    packed = folder / "data/recordings"
    for episode in videos_in(packed):
        before, after = metadata_of(directory, episode), metadata_of(packed, episode)
        assert after["packed_smaller"] == {"from": [240, 320]}
        assert (after["height"], after["width"]) == (180, 240)
        frames = frames_of(the(packed, f"*video{episode:06d}.mp4"))
        assert [frame.shape for frame in frames] == [(180, 240, 3)] * len(frames)
        assert len(frames) == after["frame_count"] == before["frame_count"]
        hashes = the(packed, f"*video{episode:06d}.framehash").read_text()
        assert "#dimensions 0: 240x180\n" in hashes
        for key in ("file_sha256", "decoded_sha256"):
            assert after[key] != before[key]
        for key in ("camera", "reward", "seed", "fps", "frame_steps"):
            assert after[key] == before[key]
    assert "smaller than 320x240" in (folder / "data/README.md").read_text()
    assert told[-1].frames_done == told[-1].frames > 0
    assert told[-1].videos_done == 2
    assert "packed_smaller" not in metadata_of(directory, 0)


def test_a_limit_that_is_kept_anyway_changes_no_recording(
    recorded: Path, tmp_path: Path
) -> None:
    """No video is drawn again."""
    packed = mjrec.pack(recorded, tmp_path / "run.zip", max_size="5M")
    for path in (unpacked(packed, tmp_path / "x") / "data/recordings").iterdir():
        assert path.read_bytes() == packed_bytes(recorded / path.name)
