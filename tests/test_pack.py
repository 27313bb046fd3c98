# SPDX-License-Identifier: Apache-2.0
"""A packed run holds what was recorded, conforms, and is the same every time."""

import csv
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from packed_runs import record_pendulum, the, unpacked
from recordings import frames_of, manifest_of, metadata_of, videos_in

import honest_runs
import mjrec
from mjrec.commands import main
from mjrec.evidence.layout import STATISTICS_COLUMNS
from mjrec.formats.journal import is_of_spans

STATED = {
    "title": "Pendulums: «five» of them",
    "authors": ["Ada Lovelace <0000-0002-1825-0097>", "van Rossum, Guido <g@x.org>"],
    "license": "cc-by-4.0",
}


@pytest.fixture(scope="module")
def recorded(pendulums):
    """Return a directory with three episodes, two of them with a video."""
    return pendulums(3)


@pytest.fixture(scope="module")
def archive(recorded, tmp_path_factory):
    """Return the packed archive of the recorded directory."""
    return mjrec.pack(recorded, tmp_path_factory.mktemp("packed") / "run.zip", **STATED)


@pytest.fixture(scope="module")
def bag(archive, tmp_path_factory):
    """Return the unpacked folder of the archive."""
    return unpacked(archive, tmp_path_factory.mktemp("unpacked"))


@pytest.fixture(scope="module")
def infix(recorded):
    """Return the infix of the recorded files."""
    name = the(recorded, "*.jsonl").name
    return name.removeprefix("openaigym.episodes.").removesuffix(".jsonl")


def packed_bytes(path):
    """Return the packed content of a file, which omits a journal's lines about logs."""
    lines = path.read_bytes().splitlines(keepends=True)
    is_journal = path.suffix == ".jsonl"
    return b"".join(x for x in lines if not (is_journal and is_of_spans(x)))


def packed_and_unpacked(directory, place, **options):
    return unpacked(mjrec.pack(directory, place / "a.zip", **options), place / "x")


def readme_of(bag):
    return (bag / "data/README.md").read_text()


def entities_of(bag):
    crate = json.loads((bag / "data/ro-crate-metadata.json").read_text())
    assert crate["@context"] == "https://w3id.org/ro/crate/1.1/context"
    entities = {entity["@id"]: entity for entity in crate["@graph"]}
    assert len(entities) == len(crate["@graph"])
    return entities


def actions_of(entities):
    return [e for e in entities.values() if e["@type"] == "CreateAction"]


def test_it_holds_the_recordings_unchanged(recorded, bag, tmp_path):
    """Every file is equal byte for byte, even under a limit that is not reached."""
    assert bag.name == "run"
    limited = packed_and_unpacked(recorded, tmp_path, max_size="5M")
    for folder in (bag, limited):
        packed = {path.name: path for path in (folder / "data/recordings").iterdir()}
        assert sorted(packed) == sorted(path.name for path in recorded.iterdir())
        for name, path in packed.items():
            assert path.read_bytes() == packed_bytes(recorded / name)


def test_other_programs_take_the_bag(bag):
    """The bag is valid for the `bagit` package and for sha512sum."""
    assert (bag / "bagit.txt").read_text().startswith("BagIt-Version: 1.0\n")
    for command in (
        [sys.executable, "-m", "bagit", "--validate", "."],
        ["sha512sum", "--check", "--strict", "--quiet", "manifest-sha512.txt"],
    ):
        subprocess.run(command, cwd=bag, check=True, capture_output=True)


def test_names_in_the_zip_are_plain(archive):
    """Entries are sorted in one folder and have no times or owners."""
    with zipfile.ZipFile(archive) as packed:
        infos = packed.infolist()
    names = [info.filename for info in infos]
    assert names == sorted(names)
    assert all(name.startswith("run/") for name in names)
    assert {info.date_time for info in infos} == {(1980, 1, 1, 0, 0, 0)}
    assert {info.external_attr >> 16 for info in infos} == {stat.S_IFREG | 0o644}
    stored = {i.filename for i in infos if i.compress_type == zipfile.ZIP_STORED}
    assert stored == {n for n in names if n.endswith((".mp4", ".h5", ".gz", ".zip"))}


def test_the_same_input_gives_the_same_bytes(recorded, archive, tmp_path, monkeypatch):
    """Times, order, location, umask and lack of hard links do not matter."""
    (tmp_path / "copy").mkdir()
    for path in sorted(recorded.iterdir(), reverse=True):
        shutil.copyfile(path, tmp_path / "copy" / path.name)
        os.utime(tmp_path / "copy" / path.name, (1, 1))

    def refuse(*_, **__):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    monkeypatch.chdir(tmp_path)
    before = os.umask(0o077)
    try:
        again = mjrec.pack("copy", "run.zip", **STATED)
    finally:
        os.umask(before)
    assert again.read_bytes() == archive.read_bytes()


def test_packing_changes_nothing_else(recorded, tmp_path):
    """The recordings and the working directory stay the same, even from a thread."""

    def status():
        found = {path: path.stat() for path in recorded.iterdir()}
        return {p: (s.st_mtime_ns, s.st_nlink, s.st_mode) for p, s in found.items()}

    before, place = status(), Path.cwd()
    seen = set()
    packing = threading.Thread(target=mjrec.pack, args=(recorded, tmp_path / "a.zip"))
    packing.start()
    while packing.is_alive():
        seen.add(Path.cwd())
        packing.join(0.001)
    assert seen | {Path.cwd()} == {place}
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]
    # Temporary links to the recordings are gone.
    assert {links for _, links, _ in before.values()} == {1}
    assert status() == before


def test_the_table_says_what_the_journal_says(recorded, infix, bag):
    """There is one row per episode, in order, with bit-identical numbers."""
    with (bag / "data/statistics.csv").open(newline="") as file:
        table = csv.DictReader(file)
        rows = list(table)
    assert tuple(table.fieldnames) == STATISTICS_COLUMNS
    episodes = list(mjrec.iter_episodes(recorded))
    assert len(rows) == len(episodes) == 3
    for row, episode in zip(rows, episodes, strict=True):
        assert (row["monitor"], int(row["episode_id"])) == (infix, episode.episode_id)
        assert float(row["reward"]) == episode.reward
        assert float(row["end_time"]) == episode.end_time
        assert json.loads(row["seed"]) == episode.seed
        assert row["truncated"] == str(episode.truncated).lower()
        assert row["video"] == (episode.video.name if episode.video else "")
        assert bool(row["video_sha256"]) == bool(episode.video)
    assert rows[0]["video_sha256"] == metadata_of(recorded, 0)["file_sha256"]


def test_the_crate_has_what_its_specification_wants(bag):
    """The crate meets every MUST of RO-Crate 1.1 and Process Run Crate 0.5."""
    entities = entities_of(bag)
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
    assert action["startTime"] < action["endTime"]
    tools = [entities[tool["@id"]] for tool in action["instrument"]]
    assert {tool["@type"] for tool in tools} == {"SoftwareApplication"}
    versions = {tool["name"]: tool["softwareVersion"] for tool in tools}
    assert next(iter(versions)) == "mjrec"
    assert versions["mjrec"] == mjrec.__version__
    assert versions.keys() >= {"mujoco", "gymnasium", "python"}


def references_in(value):
    if isinstance(value, dict):
        return [value["@id"]] if set(value) == {"@id"} else []
    items = value if isinstance(value, list) else []
    return [reference for item in items for reference in references_in(item)]


def test_the_crate_describes_every_file_and_nothing_else(bag):
    """Every reference leads to an entity, and every file entity to a file."""
    entities = entities_of(bag)
    sizes = {
        path.relative_to(bag / "data").as_posix(): str(path.stat().st_size)
        for path in (bag / "data").rglob("*")
        if path.is_file() and path.name != "ro-crate-metadata.json"
    }
    files = {i: e["contentSize"] for i, e in entities.items() if e["@type"] == "File"}
    assert files == sizes
    known = ("http://schema.org/", "https://w3id.org/ro/crate/")
    for entity in entities.values():
        for reference in references_in(list(entity.values())):
            assert reference in entities or reference.startswith(known)
    [action] = actions_of(entities)
    results = {result["@id"] for result in action["result"]}
    objects = {one["@id"] for one in action["object"]}
    recordings = {name for name in files if name.startswith("recordings/")}
    models = {name for name in recordings if ".model." in name}
    assert results | (objects & recordings) == recordings
    assert {one for one in objects if "model" in one} == models


def test_the_citation_is_valid(bag):
    """The file is YAML with the required fields."""
    cited = yaml.safe_load((bag / "data/CITATION.cff").read_text())
    ada = {"family-names": "Lovelace", "given-names": "Ada"}
    guido = {"family-names": "van Rossum", "given-names": "Guido", "email": "g@x.org"}
    assert cited["cff-version"] == "1.2.0"
    assert cited["title"] == STATED["title"]
    assert cited["license"] == "CC-BY-4.0"
    assert cited["authors"] == [
        {**ada, "orcid": "https://orcid.org/0000-0002-1825-0097"},
        guido,
    ]


def test_the_environment_says_what_drew_encoded_and_packed(recorded, infix, bag):
    """The file also has the provenance of the recording."""
    content = json.loads((bag / "data/environment.json").read_text())
    said, metadata = content["recordings"][infix], metadata_of(recorded, 0)
    details = manifest_of(recorded)["mjrec"]
    assert said["env_id"] == "InvertedPendulum-v5"
    assert said["versions"] == details["versions"]
    assert said["provenance"] == details.get("provenance")
    [frames], [encoder] = said["pictures"], said["encoders"]
    assert frames["gl_renderer"] == metadata["gl_renderer"]
    assert encoder["ffmpeg_sha256"] == metadata["ffmpeg_sha256"]
    packed_with = content["packed_with"]
    assert packed_with["mjrec"] == mjrec.__version__
    usual = dict.fromkeys(("episodes", "max_size", "planned"))
    assert packed_with["options"] == {
        **usual,
        **STATED,
        "name": "run",
        "anonymous": False,
    }


def test_the_readme_leads_a_stranger(infix, recorded, bag):
    """The README says what the run is, how to verify it, and why videos were chosen."""
    returns = mjrec.load_results(recorded)["episode_rewards"]
    text = readme_of(bag)
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


def test_the_readme_leads_to_a_replay(bag, tmp_path, monkeypatch):
    """The README's commands copy the recordings and make a page for an episode."""
    monkeypatch.chdir(shutil.copytree(bag, tmp_path / "bag"))
    copy, replay = re.findall(r"(?:    (cp .*)|`mjrec (replay .*?)`)", readme_of(bag))
    subprocess.run(copy[0].split(), check=True)
    assert main(replay[1].replace(" N", " 1").split()) == 0
    assert "episode 1" in Path("replay.html").read_text()


def test_the_readme_says_what_environments_were_made_with(tmp_path):
    """Arguments and wrappers can make a well-known environment a different one."""
    env = gymnasium.make("HalfCheetah-v5", forward_reward_weight=100.0)
    env = gymnasium.wrappers.ClipReward(env, 1.0)
    kept = {"video_callable": False, "trajectory_callable": True}
    honest_runs.play(mjrec.Monitor(env, tmp_path / "run", **kept), 1, most=2)
    text = readme_of(packed_and_unpacked(tmp_path / "run", tmp_path))
    assert (
        "| environment | HalfCheetah-v5, made with forward_reward_weight=100.0, in the"
    ) in text
    assert "ClipReward(min_reward=1.0" in text


def test_nothing_need_be_stated(recorded, tmp_path):
    """Where a statement is required, the archive says that none was given."""
    folder = packed_and_unpacked(recorded, tmp_path)
    root = entities_of(folder)["./"]
    assert root["name"] == "Recordings of InvertedPendulum-v5"
    assert root["license"].startswith("No license was stated")
    assert "author" not in root
    cited = yaml.safe_load((folder / "data/CITATION.cff").read_text())
    assert cited["authors"] == [{"name": "Not stated"}]
    assert "license" not in cited


@pytest.fixture(scope="module")
def one_chosen(recorded, tmp_path_factory):
    """Return the unpacked archive of episode 1, chosen by a NumPy integer."""
    place = tmp_path_factory.mktemp("chosen")
    return packed_and_unpacked(recorded, place, episodes=np.array([1]))


def test_some_episodes_can_be_chosen(recorded, infix, one_chosen, names):
    """Statistics stay whole, nothing is pending, and the archive names the choice."""
    packed = one_chosen / "data/recordings"
    assert videos_in(packed) == [1]
    left_out = set(names(recorded)) - set(names(packed))
    assert left_out == {n for n in names(recorded) if ".video000000." in n}
    manifest = manifest_of(packed)
    [[video, _]] = manifest["videos"]
    assert video == f"openaigym.video.{infix}.video000001.mp4"
    assert manifest["mjrec"].pop("packed_episodes") == [1]
    assert manifest["mjrec"] == manifest_of(recorded)["mjrec"]
    assert len((one_chosen / "data/statistics.csv").read_text().splitlines()) == 4
    assert not [each for each in mjrec.iter_episodes(packed) if each.pending]
    said = json.loads((one_chosen / "data/environment.json").read_text())
    assert said["packed_with"]["options"]["episodes"] == [1]
    # The original directory is unchanged.
    assert videos_in(recorded) == [0, 1]


def test_actions_of_all_episodes_stay(recorded, infix, one_chosen):
    """Others can recreate the episodes, because only their states are left out."""
    name = f"openaigym.trajectory.{infix}.episode000000.h5"
    folders = (recorded, one_chosen / "data/recordings")
    before, after = (mjrec.load_trajectory(folder / name) for folder in folders)
    np.testing.assert_array_equal(after.actions, before.actions)
    np.testing.assert_array_equal(after.rewards, before.rewards)
    assert after.facts["seed"] == before.facts["seed"]
    assert after.states.size == 0 < before.states.size
    assert not after.frame_steps.size
    held = (
        "statistics of 3 episodes of InvertedPendulum-v5, 1 video, actions of 2 "
        "episodes and physics states of 1 episode"
    )
    text, entities = readme_of(one_chosen), entities_of(one_chosen)
    assert held in text
    assert held in entities["./"]["description"]
    assert held in entities["recordings/"]["description"]
    assert "The author chose some" in text
    assert "as it was recorded" not in text


def test_commands_in_the_readme_can_be_pasted(recorded, tmp_path):
    """A shell reads the name as one argument, whatever characters it has."""
    name = "it's $(here); a `run` & more.zip"
    folder = unpacked(mjrec.pack(recorded, tmp_path / name), tmp_path / "x")
    lines = readme_of(folder).splitlines()
    [command] = [line for line in lines if line.startswith("    mjrec verify ")]
    assert shlex.split(command) == ["mjrec", "verify", name]


def test_more_files_than_verify_takes_are_refused(recorded, tmp_path, monkeypatch):
    """Nothing is written, and the error names the remedy."""
    monkeypatch.setattr("mjrec.evidence.pack.MOST_ENTRIES", 20)
    with pytest.raises(mjrec.PackError, match=r"at most 20 files.*--episodes"):
        mjrec.pack(recorded, tmp_path / "run.zip")
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_models_of_other_episodes_are_left_out(tmp_path):
    """Unreferenced files would count as extra files."""
    directory = tmp_path / "runs"
    record_pendulum(directory, 1)
    stray = directory / "openaigym.model.0123456789abcdef.mjb.gz"
    stray.write_bytes(b"of an episode that is gone")
    again = the(directory, "*.mp4").with_suffix(".side.mp4")
    again.write_bytes(b"rendered again")
    (directory / "notes.txt").write_text("mine")
    packed = packed_and_unpacked(directory, tmp_path) / "data/recordings"
    left_out = {stray.name, again.name, "notes.txt"}
    assert {p.name for p in directory.iterdir()} - left_out == {
        p.name for p in packed.iterdir()
    }


def test_two_monitors_are_two_actions(recorded, tmp_path):
    """Each action has its own files, and a choice of episodes applies to both."""
    directory = shutil.copytree(recorded, tmp_path / "runs")
    record_pendulum(directory, 1, uid="other", resume=True)
    entities = entities_of(packed_and_unpacked(directory, tmp_path, episodes=[0]))
    first, second = actions_of(entities)
    results = [{one["@id"] for one in each["result"]} for each in (first, second)]
    assert not results[0] & results[1]
    assert len(entities["./"]["mentions"]) == 2


def largest_video(archive):
    with zipfile.ZipFile(archive) as packed:
        return max(i.file_size for i in packed.infolist() if i.filename[-4:] == ".mp4")


@pytest.mark.thorough
def test_videos_are_drawn_smaller_for_a_limit(tmp_path):
    """All frames are kept with new hashes, and the recording does not change."""
    directory = tmp_path / "runs"
    small = {"render_mode": "rgb_array", "height": 240, "width": 320}
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=4, **small)
    honest_runs.play(mjrec.Monitor(env, directory, workers=1), 2)
    whole = mjrec.pack(directory, tmp_path / "whole.zip")
    told = []
    limit = whole.stat().st_size - largest_video(whole) // 4
    options = {"max_size": limit, "on_progress": told.append}
    smaller = mjrec.pack(directory, tmp_path / "small.zip", **options)
    assert smaller.stat().st_size <= limit
    assert largest_video(smaller) < largest_video(whole)
    folder = unpacked(smaller, tmp_path / "x")
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
    assert "smaller than 320x240" in readme_of(folder)
    assert told[-1].frames_done == told[-1].frames > 0
    assert told[-1].videos_done == 2
    assert "packed_smaller" not in metadata_of(directory, 0)
