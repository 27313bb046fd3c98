# SPDX-License-Identifier: Apache-2.0
"""Two packed runs compared: equal, with one edit, and with a claim that allows it."""

from __future__ import annotations

import json
import shutil
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from forged_videos import forge, say
from imageio.v3 import imwrite
from packed_runs import (
    describe_again,
    edit_json,
    edit_trajectory,
    set_reward,
    the,
    unpacked,
)

import mjrec
from mjrec.evidence.compare import Comparison
from mjrec.evidence.excuses import note, write_notes
from mjrec.evidence.findings import (
    Finding,
    Level,
    Outcome,
    Topic,
    Verdict,
    Verification,
)
from mjrec.formats.json_fields import from_json, to_json

Edit = Callable[[Path], object]


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A packed run of two episodes, one with a video, unpacked."""
    directory = tmp_path_factory.mktemp("packed")
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=6, width=48, height=48)
    with mjrec.Monitor(env, directory / "recorded", uid="u", workers=1) as env:
        env.action_space.seed(5)
        for episode in range(3):
            env.reset(seed=episode)
            done = False
            while not done:
                *_, terminated, truncated, _ = env.step(env.action_space.sample())
                done = terminated or truncated
    mjrec.pack(directory / "recorded", directory / "run.zip", license="MIT")
    return unpacked(directory / "run.zip", directory / "unpacked")


@pytest.fixture
def given(packed: Path, tmp_path: Path) -> Path:
    """A copy to edit."""
    return shutil.copytree(packed, tmp_path / "run")


def compared(
    given: Path, made: Path, *, is_described: bool = False, **options: Any
) -> Verification:
    """Compare; the descriptions of what was edited fit, unless they fit before."""
    if not is_described:
        describe_again(given)
    comparison = Comparison(given, made, **options)
    findings = tuple(comparison)
    return Verification(
        path=given,
        level=options.get("level", Level.PIXELS),
        findings=findings,
        excuses=comparison.excuses,
    )


def recorded(pattern: str, edit: Callable[[Path], object]) -> Edit:
    return lambda bag: edit(the(bag, pattern))


def in_json(pattern: str, edit: Callable[[Any], object]) -> Edit:
    return recorded(pattern, lambda path: edit_json(path, edit))


def in_hdf5(edit: Callable[[h5py.File], object]) -> Edit:
    return recorded("*episode000000.h5", lambda path: edit_trajectory(path, edit))


def in_states(row: int, member: str, add: float) -> Edit:
    def edit(file: h5py.File) -> None:
        rows = file["states"][:]
        rows[member][row] += add
        file["states"][...] = rows

    return in_hdf5(edit)


def in_text(pattern: str, old: str, new: str) -> Edit:
    def edit(path: Path) -> None:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return recorded(pattern, edit)


def in_mp4(edit: Callable[[bytearray], object]) -> Edit:
    def change(path: Path) -> None:
        content = bytearray(path.read_bytes())
        edit(content)
        path.write_bytes(content)

    return recorded("*video000000.mp4", change)


def slower(content: bytearray) -> None:
    at = content.index(b"mdhd") + 16
    [scale] = struct.unpack_from(">I", content, at)
    struct.pack_into(">I", content, at, scale // 2)


def brighter(path: Path) -> None:
    drawn = list(mjrec.render(the(path.parent, "*episode000000.h5")))
    forge(
        path,
        [np.clip(frame.astype(int) + 60, 0, 255).astype(np.uint8) for frame in drawn],
        fps=20,
    )


def test_equal_runs_are_made_again(packed: Path) -> None:
    """Each topic has its count."""
    verification = compared(packed, packed)
    assert verification.verdict is Verdict.PASS
    counts = {(f.topic, f.unit): f.count for f in verification.findings}
    assert {f.outcome for f in verification.findings} == {Outcome.RECREATED}
    assert counts[Topic.REWARDS, "episode"] == 3
    assert counts[Topic.PHYSICS, "step"] == 12
    assert counts[Topic.PICTURES, "frame"] == 14
    assert {topic for topic, _ in counts} == set(Topic)


@pytest.mark.parametrize(
    ("edit", "topic", "words"),
    [
        (
            in_json("*.stats.json", lambda s: s["episode_rewards"].reverse()),
            Topic.REWARDS,
            "episode_rewards[0]",
        ),
        (
            in_text("*.jsonl", '"length": 6', '"length": 5'),
            Topic.REWARDS,
            "episode 0.length",
        ),
        (
            in_text("*.jsonl", '"seed": 1', '"seed": 2'),
            Topic.BEGINNING,
            "episode 1.seed",
        ),
        (
            in_text("*.jsonl", '"schedule": "', '"schedule": "my_'),
            Topic.SELECTION,
            "run.schedule",
        ),
        (
            in_json(
                "*.manifest.json",
                lambda m: m["mjrec"]["pending"].append({"episode_id": 1}),
            ),
            Topic.SELECTION,
            "mjrec.pending",
        ),
        (
            in_json("*000000.meta.json", lambda m: m.update(playback_speed=2.0)),
            Topic.VIDEOS,
            "playback_speed",
        ),
        (
            in_json("*000000.meta.json", lambda m: m.update(remark="best")),
            Topic.VIDEOS,
            "only the archive has it",
        ),
        (
            in_json("*000000.meta.json", lambda m: m.pop("stride")),
            Topic.VIDEOS,
            "only the recreated run has it",
        ),
        (
            in_json(
                "*000000.meta.json",
                lambda m: m["encoder_version"]["cmdline"].append("-an"),
            ),
            Topic.VIDEOS,
            "cmdline",
        ),
        (
            in_json("environment.json", lambda m: m.update(note="x")),
            Topic.FILES,
            "note",
        ),
        (
            in_json(
                "ro-crate-metadata.json",
                lambda c: c["@graph"].append({"@id": "#x", "@type": "Thing"}),
            ),
            Topic.FILES,
            "#x",
        ),
        (
            in_text("README.md", "| 18 |", "| 19 |"),
            Topic.FILES,
            "line",
        ),
        (in_text("statistics.csv", ",t,6,", ",t,7,"), Topic.FILES, "line"),
        (in_text("CITATION.cff", "dataset", "software"), Topic.FILES, "line"),
        (
            in_text(
                "bag-info.txt",
                "Mjrec-Evidence-Version: 1",
                "Mjrec-Evidence-Version: 1\nNote: x",
            ),
            Topic.FILES,
            "line",
        ),
        (
            lambda bag: (bag / "data" / "notes.txt").write_text("best"),
            Topic.FILES,
            "this file was not recreated",
        ),
        (
            lambda bag: the(bag, "*video000001.framehash").unlink(),
            Topic.PICTURES,
            "no such file",
        ),
        (
            lambda bag: the(bag, "*episode000001.h5").unlink(),
            Topic.PHYSICS,
            "no such file",
        ),
        (in_states(3, "qpos", 1e-12), Topic.PHYSICS, "states[3].qpos"),
        (in_states(0, "qvel", 1e-12), Topic.BEGINNING, "states[0].qvel"),
        (
            recorded("*episode000000.h5", lambda path: set_reward(path, 2, 9.0)),
            Topic.REWARDS,
            "rewards[2]",
        ),
        (
            in_hdf5(lambda file: file["terminated"].write_direct(np.ones(6, bool))),
            Topic.REWARDS,
            "terminated[0]",
        ),
        (
            in_hdf5(lambda file: file.create_dataset("notes", data=[1.0])),
            Topic.FILES,
            "notes",
        ),
        (
            in_hdf5(lambda file: file["rewards"].attrs.__setitem__("unit", 1)),
            Topic.FILES,
            "attribute unit",
        ),
        (
            recorded("*episode000000.h5", lambda path: edit_trajectory(path, note=1)),
            Topic.PHYSICS,
            "note",
        ),
        (in_mp4(slower), Topic.VIDEOS, "times"),
        (
            in_mp4(lambda content: content.extend(b"\0\0\0\x10uuid12345678")),
            Topic.VIDEOS,
            "uuid",
        ),
        (
            recorded("*video000000.mp4", brighter),
            Topic.PICTURES,
            "levels in the worst block",
        ),
        (
            recorded("*video000000.mp4", lambda path: path.write_bytes(b"x" * 99)),
            Topic.VIDEOS,
            "the wrong size",
        ),
        (
            in_text("*video000000.framehash", "0,          3,", "0,          4,"),
            Topic.VIDEOS,
            "line",
        ),
    ],
)
def test_a_single_edit_is_found(
    packed: Path, given: Path, edit: Edit, topic: Topic, words: str
) -> None:
    """It fails, on the line of its topic, and says where."""
    edit(given)
    verification = compared(given, packed, is_described=True)
    assert verification.verdict is Verdict.FAIL
    found = [f for f in verification.failures if words in f.reason]
    assert topic in {f.topic for f in found}, verification.failures


def test_less_deep_levels_compare_less(packed: Path, given: Path) -> None:
    """What they leave out is believed, with counts."""
    in_states(3, "qpos", 1e-3)(given)
    shallow = compared(given, packed, level=Level.STATS)
    assert shallow.verdict is Verdict.PARTLY
    believed = {
        (f.topic, f.count, f.unit)
        for f in shallow.findings
        if f.outcome is Outcome.BELIEVED
    }
    assert believed == {
        (Topic.PHYSICS, 1, "recording"),
        (Topic.VIDEOS, 2, "video"),
        (Topic.PICTURES, 14, "frame"),
    }
    assert compared(given, packed, level=Level.PHYSICS).verdict is Verdict.FAIL


def test_the_level_of_statistics_compares_rewards(packed: Path, given: Path) -> None:
    """Step by step, though not the states."""
    set_reward(the(given, "*episode000000.h5"), 2, 9.0)
    found = compared(given, packed, level=Level.STATS).failures
    assert {(f.topic, f.item) for f in found} == {(Topic.REWARDS, "episode 0 of 0.u")}
    assert any("rewards[2]" in f.reason for f in found)


def test_some_frames_are_drawn_and_compared(packed: Path, given: Path) -> None:
    """Each with its hash and with what the file shows."""
    made = shutil.copytree(packed, given.with_name("made"))
    name = the(given, "*video000000.mp4").name
    folder = made / "sampled" / name
    folder.mkdir(parents=True)
    for number, frame in enumerate(mjrec.render(the(given, "*episode000000.h5"))):
        if number in (1, 4):
            imwrite(folder / f"{number}.png", frame)
    verification = compared(given, made, sampled=True)
    assert verification.verdict is Verdict.PARTLY
    counts = {
        f.outcome: f.count for f in verification.findings if f.topic is Topic.PICTURES
    }
    assert counts == {Outcome.RECREATED: 2, Outcome.BELIEVED: 5 + 7}
    brighter(the(given, "*video000000.mp4"))
    failed = compared(given, made, sampled=True).failures
    assert {f.topic for f in failed} == {Topic.PICTURES}
    # The hashes say what is drawn, the file shows something else.
    hashes = the(given, "*video000000.framehash")
    hashes.write_bytes(the(packed, "*video000000.framehash").read_bytes())
    failed = compared(given, made, sampled=True).failures
    assert {f.topic for f in failed} == {Topic.VIDEOS}


def test_an_undrawn_run_has_the_same_videos_to_draw(packed: Path, given: Path) -> None:
    """Below the level of frames a pending video stands for one that is there."""
    made = given

    def undraw(manifest: Any) -> None:
        manifest["videos"] = []
        manifest["mjrec"]["pending"] = [{"episode_id": number} for number in (0, 1)]

    edit_json(the(made, "*.manifest.json"), undraw)
    assert compared(packed, made, level=Level.PHYSICS).verdict is Verdict.PARTLY
    edit_json(the(made, "*.manifest.json"), lambda m: m["mjrec"]["pending"].pop())
    found = compared(packed, made, level=Level.PHYSICS).failures
    assert [f.topic for f in found] == [Topic.SELECTION]
    assert "only the archive has 1" in found[0].reason


def test_what_was_fed_to_the_maker_is_believed(packed: Path, given: Path) -> None:
    """Its episode is not counted as recreated, though it is equal."""
    fed = note("episode 2 of 0.u", "actions not kept", "its return is believed")
    write_notes(given, [fed])
    verification = compared(packed, given)
    assert verification.verdict is Verdict.PARTLY
    counts = {
        f.outcome: f.count
        for f in verification.findings
        if (f.topic, f.unit) == (Topic.REWARDS, "episode")
    }
    assert counts == {Outcome.RECREATED: 2, Outcome.BELIEVED: 1}
    assert [excuse.name for excuse in verification.excuses] == ["actions not kept"]


def test_an_excuse_reaches_its_own_item_only(packed: Path, given: Path) -> None:
    """A wrapper of one recording excuses successes there, and no files."""

    def succeed(episode: int) -> None:
        path = the(given, "*.jsonl")
        lines = path.read_text().splitlines(keepends=True)
        begin = f'{{"episode_id": {episode}, '
        [number] = [n for n, line in enumerate(lines) if line.startswith(begin)]
        lines[number] = lines[number].replace('"success": null', '"success": true')
        path.write_text("".join(lines))

    succeed(0)
    made = shutil.copytree(packed, given.with_name("made"))
    write_notes(
        made, [note("episode 0 of 0.u", "wrappers", "mine.Success is not here")]
    )
    verification = compared(given, made)
    assert verification.verdict is Verdict.PARTLY
    [excuse] = verification.excuses
    assert (excuse.name, excuse.items) == ("wrappers", ("episode 0 of 0.u",))
    succeed(1)
    assert compared(given, made).verdict is Verdict.FAIL


def claim(bag: Path, **facts: Any) -> None:
    for path in bag.rglob("*.meta.json"):
        say(path.with_name(path.name.replace(".meta.json", ".mp4")), **facts)


def redrawn(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Draw a video's frames otherwise, and let it say so."""
    drawn = list(mjrec.render(the(path.parent, f"*{path.stem[-6:]}.h5")))
    known = json.loads(path.with_suffix(".meta.json").read_text())
    forge(path, [change(frame) for frame in drawn], fps=20)
    said = json.loads(path.with_suffix(".meta.json").read_text())
    for name in ("file_sha256", "decoded_sha256"):
        known[name] = said[name]
    path.with_suffix(".meta.json").write_text(json.dumps(known))


def noisy(frame: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).integers(-3, 4, frame.shape)
    return np.clip(frame.astype(int) + noise, 0, 255).astype(np.uint8)


def test_another_renderer_is_tried(packed: Path, given: Path) -> None:
    """Frames that are alike pass with it; the claim and its costs are named."""
    for number in (0, 1):
        redrawn(the(given, f"*video00000{number}.mp4"), noisy)
    claim(given, gl_renderer="NVIDIA H100 80GB HBM3")
    verification = compared(given, packed)
    assert verification.verdict is Verdict.PARTLY, verification.failures
    [excuse] = verification.excuses
    assert excuse.name == "gl"
    assert "H100" in excuse.claimed
    assert compared(given, packed, allow=["gl=nvidia h100"]).verdict is Verdict.PASS


def test_a_false_claim_of_another_renderer_is_refuted(
    packed: Path, given: Path
) -> None:
    """Half of the frames are equal bit for bit, so it was the same one."""
    redrawn(the(given, "*video000001.mp4"), noisy)
    claim(given, gl_renderer="NVIDIA H100 80GB HBM3")
    verification = compared(given, packed)
    assert verification.verdict is Verdict.FAIL
    assert any("equal bit for bit" in f.reason for f in verification.failures)
    assert [e.refuted for e in verification.excuses if e.name == "gl"] == [True]


def test_a_false_claim_of_another_version_is_refuted(packed: Path, given: Path) -> None:
    """The compiled model says which version wrote it."""
    version = json.loads(the(given, "*.manifest.json").read_text())["mjrec"][
        "versions"
    ]["mujoco"]
    in_text("*.jsonl", f'"mujoco": "{version}"', '"mujoco": "9.0.0"')(given)
    verification = compared(given, packed)
    assert any("the same version" in f.reason for f in verification.failures)


def test_remarks_say_what_a_video_does_not_show(packed: Path, given: Path) -> None:
    """They lower no verdict: it was asked for so."""
    for bag in (given, made := shutil.copytree(packed, given.with_name("made"))):
        edit_json(the(bag, "*000000.meta.json"), lambda m: m.update(playback_speed=2.0))
    verification = compared(given, made)
    assert verification.verdict is Verdict.PASS
    notes = [f.reason for f in verification.findings if f.outcome is Outcome.NOTED]
    assert notes == ["plays at 2 times real time"]


def test_time_is_linear_in_episodes(tmp_path: Path) -> None:
    """Four times the episodes take about four times as long."""
    seconds = []
    for count in (500, 2000):
        bags = [tmp_path / f"{name}-{count}" for name in ("given", "made")]
        for bag, reward in zip(bags, (1.0, 1.5), strict=True):
            folder = bag / "data" / "recordings"
            folder.mkdir(parents=True)
            lines = (
                json.dumps({"episode_id": n, "reward": reward}) for n in range(count)
            )
            (folder / "openaigym.episodes.0.u.jsonl").write_text(
                "\n".join(lines) + "\n"
            )
            notes = [
                note(f"episode {number} of 0.u", "actions not kept", "believed")
                for number in range(0, count, 2)
            ]
            write_notes(bag, notes)
        start = time.process_time()
        found = list(Comparison(*bags))
        seconds.append(time.process_time() - start)
        # What was fed to the run has no excuse.
        assert sum(f.count for f in found if f.outcome is Outcome.DIFFERENT) == count
    assert seconds[1] < 8 * seconds[0] + 0.1


def test_findings_travel_between_processes() -> None:
    """What a finding says survives JSON."""
    finding = Finding(
        topic=Topic.PICTURES, item="a", outcome=Outcome.NOTED, figures={"psnr": 30.0}
    )
    assert from_json(Finding, json.loads(json.dumps(to_json(finding)))) == finding
