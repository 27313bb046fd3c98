# SPDX-License-Identifier: Apache-2.0
"""Compare two packed runs: equal, with one edit, or with a claim that allows it."""

import json
import shutil
import struct
import time

import gymnasium
import h5py
import numpy as np
import pytest
from imageio.v3 import imwrite
from packed_runs import edit_json, rewrite_descriptions, the, unpacked

import honest_runs
import mjrec
from forged_runs import ForgedRun
from mjrec.evidence.compare import Comparison
from mjrec.evidence.excuses import note, write_notes
from mjrec.evidence.findings import Level, Outcome, Topic, Verdict, Verification
from mjrec.formats.trajectory import added_up

H100 = "NVIDIA H100 80GB HBM3"


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """Return the unpacked archive of a run of three episodes, two with a video."""
    directory = tmp_path_factory.mktemp("packed")
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=6, width=48, height=48)
    monitor = mjrec.Monitor(env, directory / "recorded", uid="u", workers=1)
    honest_runs.play(monitor, 3)
    mjrec.pack(directory / "recorded", directory / "run.zip", license="MIT")
    return unpacked(directory / "run.zip", directory / "unpacked")


@pytest.fixture
def given(packed, tmp_path):
    """Return a copy of the archive to edit."""
    return shutil.copytree(packed, tmp_path / "run")


@pytest.fixture
def made(packed, tmp_path):
    """Return a copy to edit that stands for the recreated run."""
    return shutil.copytree(packed, tmp_path / "made")


def compared(given, made, *, is_described=False, **options):
    """Update descriptions unless `is_described`, then compare two runs."""
    if not is_described:
        rewrite_descriptions(given)
    comparison = Comparison(given, made, **options)
    level, findings = options.get("level", Level.PIXELS), tuple(comparison)
    return Verification(
        path=given, level=level, findings=findings, excuses=comparison.excuses
    )


def counts_of(verification, outcome, topic):
    return sum(
        each.count
        for each in verification.findings
        if (each.outcome, each.topic) == (outcome, topic)
    )


# These functions edit an unpacked run.


def in_json(pattern, edit=lambda content: None, **facts):
    def change(content):
        edit(content)
        content.update(facts)

    return lambda bag: edit_json(the(bag, pattern), change)


def in_details(edit):
    return in_json("*.manifest.json", lambda manifest: edit(manifest["mjrec"]))


def in_hdf5(edit):
    def change(bag):
        with h5py.File(the(bag, "*episode000000.h5"), "r+") as file:
            edit(file)

    return change


def in_states(row, member, add):
    def edit(file):
        rows = file["states"][:]
        rows[member][row] += add
        file["states"][...] = rows

    return in_hdf5(edit)


def in_rows(**changes):
    return lambda bag: ForgedRun(bag / "data/recordings").edit_rows(0, **changes)


def another_reward(bag):
    run = ForgedRun(bag / "data/recordings")
    rewards = run.content(0).rewards.copy()
    rewards[2] = 9.0
    run.edit_rows(0, rewards=rewards, facts={"reward": added_up(rewards)})


def in_text(pattern, old, new):
    def edit(bag):
        text = the(bag, pattern).read_text()
        assert old in text
        the(bag, pattern).write_text(text.replace(old, new, 1))

    return edit


def in_mp4(edit):
    def change(bag):
        path = the(bag, "*video000000.mp4")
        content = bytearray(path.read_bytes())
        edit(content)
        path.write_bytes(content)

    return change


def slower(content):
    at = content.index(b"mdhd") + 16
    [scale] = struct.unpack_from(">I", content, at)
    struct.pack_into(">I", content, at, scale // 2)


def redrawn(bag, episode, change):
    """Change the frames of a video, and update its metadata to match."""
    run = ForgedRun(bag / "data/recordings")
    frames = [change(frame.astype(int)) for frame in run.frames(episode)]
    run.film(episode, [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames])


def noisy(frame):
    return frame + np.random.default_rng(0).integers(-3, 4, frame.shape)


def brighter(bag):
    redrawn(bag, 0, lambda frame: frame + 60)


def removed(pattern):
    return lambda bag: the(bag, pattern).unlink()


PENDING = {"episode_id": 1}
THING = {"@id": "#x", "@type": "Thing"}
NOTED = "Mjrec-Evidence-Version: 1\nNote: x"
EDITS = [
    (
        in_json("*.stats.json", lambda s: s["episode_rewards"].reverse()),
        *(Topic.REWARDS, "episode_rewards[0]"),
    ),
    (in_text("*.jsonl", '"length": 6', '"length": 5'), Topic.REWARDS, "0.length"),
    (in_text("*.jsonl", '"seed": 1', '"seed": 2'), Topic.BEGINNING, "1.seed"),
    (in_text("*.jsonl", 'ule": "', 'ule": "my_'), Topic.SELECTION, "run.schedule"),
    (
        in_details(lambda said: said["pending"].append(PENDING)),
        *(Topic.SELECTION, "mjrec.pending"),
    ),
    (in_json("*000000.meta.json", playback_speed=2.0), Topic.VIDEOS, "playback_speed"),
    (
        in_json("*000000.meta.json", remark="best"),
        *(Topic.VIDEOS, "only the archive has it"),
    ),
    (
        in_json("*000000.meta.json", lambda m: m.pop("stride")),
        *(Topic.VIDEOS, "only the recreated run has it"),
    ),
    (
        in_json("*000000.meta.json", lambda m: m["encoder_version"].update(cmdline=[])),
        *(Topic.VIDEOS, "cmdline"),
    ),
    (in_json("environment.json", note="x"), Topic.FILES, "note"),
    (
        in_json("ro-crate-metadata.json", lambda c: c["@graph"].append(THING)),
        *(Topic.FILES, "#x"),
    ),
    (in_text("README.md", "| 18 |", "| 19 |"), Topic.FILES, "line"),
    (in_text("statistics.csv", ",t,6,", ",t,7,"), Topic.FILES, "line"),
    (in_text("CITATION.cff", "dataset", "software"), Topic.FILES, "line"),
    (in_text("bag-info.txt", NOTED.split("\n")[0], NOTED), Topic.FILES, "line"),
    (
        lambda bag: (bag / "data" / "notes.txt").write_text("best"),
        *(Topic.FILES, "only the archive has it: notes.txt"),
    ),
    (
        removed("*video000001.framehash"),
        Topic.PICTURES,
        "only the recreated run has it",
    ),
    (removed("*episode000001.h5"), Topic.PHYSICS, "only the recreated run has it"),
    (in_states(3, "qpos", 1e-12), Topic.PHYSICS, "states[3].qpos"),
    (in_states(0, "qvel", 1e-12), Topic.BEGINNING, "states[0].qvel"),
    (another_reward, Topic.REWARDS, "rewards[2]"),
    (
        in_hdf5(lambda file: file["terminated"].write_direct(np.ones(6, bool))),
        *(Topic.REWARDS, "terminated[0]"),
    ),
    (
        in_hdf5(lambda file: file.create_dataset("notes", data=[1.0])),
        Topic.FILES,
        "notes",
    ),
    (
        in_hdf5(lambda file: file["rewards"].attrs.create("unit", 1)),
        *(Topic.FILES, "attribute unit"),
    ),
    (in_rows(facts={"note": 1}), Topic.PHYSICS, "note"),
    (in_mp4(slower), Topic.VIDEOS, "times"),
    (in_mp4(lambda c: c.extend(b"\0\0\0\x10uuid12345678")), Topic.VIDEOS, "uuid"),
    (brighter, Topic.PICTURES, "levels in the worst block"),
    (
        lambda bag: the(bag, "*video000000.mp4").write_bytes(b"x" * 99),
        *(Topic.VIDEOS, "the wrong size"),
    ),
    (
        in_text("*video000000.framehash", "0,          3,", "0,          4,"),
        *(Topic.VIDEOS, "line"),
    ),
]


def test_equal_runs_have_no_differences(packed):
    """Every topic is reported with its count."""
    verification = compared(packed, packed)
    assert verification.verdict is Verdict.PASS
    counts = {(f.topic, f.unit): f.count for f in verification.findings}
    assert {f.outcome for f in verification.findings} == {Outcome.RECREATED}
    assert counts[Topic.REWARDS, "episode"] == 3
    assert counts[Topic.PHYSICS, "step"] == 12
    assert counts[Topic.PICTURES, "frame"] == 14
    assert {topic for topic, _ in counts} == set(Topic)


@pytest.mark.parametrize(("edit", "topic", "words"), EDITS)
def test_a_single_edit_is_found(packed, given, edit, topic, words):
    """The failure appears under the right topic and says where the edit is."""
    edit(given)
    verification = compared(given, packed, is_described=True)
    assert verification.verdict is Verdict.FAIL
    found = [f for f in verification.failures if words in f.reason]
    assert topic in {f.topic for f in found}, verification.failures


def test_less_deep_levels_compare_less(packed, given):
    """A lower level believes what it skips, and always compares rewards."""
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
    another_reward(given)
    found = compared(given, packed, level=Level.STATS).failures
    assert {(f.topic, f.item) for f in found} == {(Topic.REWARDS, "episode 0 of 0.u")}
    assert any("rewards[2]" in f.reason for f in found)


def test_some_frames_are_drawn_and_compared(packed, given, made):
    """Sampled frames are compared with both the hash file and the video."""
    folder = made / "sampled" / the(given, "*video000000.mp4").name
    folder.mkdir(parents=True)
    for number, frame in enumerate(mjrec.render(the(given, "*episode000000.h5"))):
        if number in (1, 4):
            imwrite(folder / f"{number}.png", frame)
    verification = compared(given, made, sampled=True)
    assert verification.verdict is Verdict.PARTLY
    assert counts_of(verification, Outcome.RECREATED, Topic.PICTURES) == 2
    assert counts_of(verification, Outcome.BELIEVED, Topic.PICTURES) == 5 + 7
    brighter(given)
    failed = compared(given, made, sampled=True).failures
    assert {f.topic for f in failed} == {Topic.PICTURES}
    # The hashes match the rerendered frames, but the video file does not.
    hashes = the(given, "*video000000.framehash")
    hashes.write_bytes(the(packed, "*video000000.framehash").read_bytes())
    failed = compared(given, made, sampled=True).failures
    assert {f.topic for f in failed} == {Topic.VIDEOS}


def test_an_undrawn_run_has_the_same_videos_to_draw(packed, made):
    """Without rendering, a pending video in the run matches a video in the archive."""
    pending = [{"episode_id": 0}, {"episode_id": 1}]
    in_json("*.manifest.json", videos=[])(made)
    in_details(lambda said: said.update(pending=pending))(made)
    assert compared(packed, made, level=Level.PHYSICS).verdict is Verdict.PARTLY
    in_details(lambda said: said["pending"].pop())(made)
    [found] = compared(packed, made, level=Level.PHYSICS).failures
    assert found.topic is Topic.SELECTION
    assert "only the archive has 1" in found.reason


def test_what_was_fed_to_the_maker_is_believed(packed, made):
    """Recorded values that were fed to the run do not count as recreated."""
    fed = note("episode 2 of 0.u", "actions not kept", "its return is believed")
    write_notes(made, [fed])
    verification = compared(packed, made)
    assert verification.verdict is Verdict.PARTLY
    counts = {
        f.outcome: f.count
        for f in verification.findings
        if (f.topic, f.unit) == (Topic.REWARDS, "episode")
    }
    assert counts == {Outcome.RECREATED: 2, Outcome.BELIEVED: 1}
    assert [excuse.name for excuse in verification.excuses] == ["actions not kept"]


def test_an_excuse_reaches_its_own_item_only(given, made):
    """A wrapper claimed for one episode excuses only that episode's success."""

    def succeed(episode):
        path = the(given, "*.jsonl")
        lines = path.read_text().splitlines(keepends=True)
        begin = f'{{"episode_id": {episode}, '
        [number] = [n for n, line in enumerate(lines) if line.startswith(begin)]
        lines[number] = lines[number].replace('"success": null', '"success": true')
        path.write_text("".join(lines))

    succeed(0)
    reason = "mine.Success is not here"
    write_notes(made, [note("episode 0 of 0.u", "wrappers", reason)])
    verification = compared(given, made)
    assert verification.verdict is Verdict.PARTLY
    [excuse] = verification.excuses
    assert (excuse.name, excuse.items) == ("wrappers", ("episode 0 of 0.u",))
    succeed(1)
    assert compared(given, made).verdict is Verdict.FAIL


def test_a_claim_of_another_renderer_is_tried(packed, given):
    """Similar frames pass with the claim, unless some are equal bit for bit."""
    redrawn(given, 1, noisy)
    ForgedRun(given / "data/recordings").edit_json("*.meta.json", gl_renderer=H100)
    verification = compared(given, packed)
    assert verification.verdict is Verdict.FAIL
    assert any("equal bit for bit" in f.reason for f in verification.failures)
    assert [e.refuted for e in verification.excuses if e.name == "gl"] == [True]
    redrawn(given, 0, noisy)
    verification = compared(given, packed)
    assert verification.verdict is Verdict.PARTLY, verification.failures
    [excuse] = verification.excuses
    assert excuse.name == "gl"
    assert H100 in excuse.claimed
    assert compared(given, packed, allow=["gl=nvidia h100"]).verdict is Verdict.PASS


def test_a_false_claim_of_another_version_is_refuted(packed, given):
    """The compiled model reveals the version that wrote it."""
    manifest = json.loads(the(given, "*.manifest.json").read_text())
    version = manifest["mjrec"]["versions"]["mujoco"]
    in_text("*.jsonl", f'"mujoco": "{version}"', '"mujoco": "9.0.0"')(given)
    failures = compared(given, packed).failures
    assert any("the same version" in f.reason for f in failures)


def test_remarks_say_what_a_video_does_not_show(given, made):
    """A note about playback speed does not lower the verdict."""
    for bag in (given, made):
        in_json("*000000.meta.json", playback_speed=2.0)(bag)
    verification = compared(given, made)
    assert verification.verdict is Verdict.PASS
    notes = [f.reason for f in verification.findings if f.outcome is Outcome.NOTED]
    assert notes == ["plays at 2 times real time"]


def test_time_is_linear_in_episodes(tmp_path):
    """Four times as many episodes take about four times as long."""
    seconds = []
    for count in (500, 2000):
        bags = [tmp_path / f"{name}-{count}" for name in ("given", "made")]
        fed = [f"episode {number} of 0.u" for number in range(0, count, 2)]
        for bag, reward in zip(bags, (1.0, 1.5), strict=True):
            (bag / "data/recordings").mkdir(parents=True)
            lines = (
                f'{{"episode_id": {n}, "reward": {reward}}}\n' for n in range(count)
            )
            journal = bag / "data/recordings/openaigym.episodes.0.u.jsonl"
            journal.write_text("".join(lines))
            write_notes(bag, [note(item, "actions not kept", "") for item in fed])
        start = time.process_time()
        found = list(Comparison(*bags))
        seconds.append(time.process_time() - start)
        # Values that were fed to the run have no excuse.
        assert sum(f.count for f in found if f.outcome is Outcome.DIFFERENT) == count
    assert seconds[1] < 8 * seconds[0] + 0.1
