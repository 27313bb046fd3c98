# SPDX-License-Identifier: Apache-2.0
"""Forged runs, as a whole: unpacked, changed, made to fit, and verified by a stranger.

After each forgery every hash that anybody can compute is computed again: those of the
bag, of the metadata and of the trajectories. What is caught is caught by what follows
from what; `docs/evidence.md` has the table.
"""

from __future__ import annotations

import csv
import hashlib
import io
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forged_episodes import forge as forge_episode
from forged_episodes import swap_model
from forged_videos import drawn, forge, metadata, say, swap, video
from packed_runs import edit_json, make_bag_fit, record_pendulum, the, unpacked
from parts import parametrize
from recordings import edit_journal
from trajectory_contents import TrajectoryContent, content_of

import mjrec
from mjrec.evidence.verification import Level, Verdict
from mjrec.formats.trajectory_file import open_trajectory

EPISODES = 4


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A packed run of four evaluated episodes, two with a video, unpacked."""
    place = tmp_path_factory.mktemp("honest")
    record_pendulum(place / "run", EPISODES, longest=5, mode="evaluation", uid="u")
    archive = mjrec.pack(place / "run", place / "run.zip")
    return unpacked(archive, place / "unpacked")


@pytest.fixture
def bag(honest: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(honest, tmp_path / "run"))


def recordings(bag: Path) -> Path:
    return bag / "data" / "recordings"


def trajectory(path: Path) -> TrajectoryContent:
    with open_trajectory(path) as reader:
        return content_of(reader)


def episode(bag: Path, number: int) -> Path:
    return the(bag, f"*.episode{number:06d}.h5")


# The forgeries. Each changes a bag; its manifests are made to fit afterwards.


def change_one_pixel(bag: Path) -> None:
    frames = [frame.copy() for frame in drawn(recordings(bag), 1)]
    frames[3][20, 10] ^= 64
    forge_video(bag, 1, frames)


def drop_a_frame(bag: Path) -> None:
    frames = drawn(recordings(bag), 1)
    forge_video(bag, 1, frames[:2] + frames[3:])


def double_a_frame(bag: Path) -> None:
    frames = drawn(recordings(bag), 1)
    forge_video(bag, 1, [*frames[:2], frames[2], *frames[2:]])


def drop_one_and_double_another(bag: Path) -> None:
    frames = drawn(recordings(bag), 1)
    forge_video(bag, 1, [*frames[:2], frames[1], *frames[3:]])


def edit_a_reward_everywhere(bag: Path) -> None:
    """In trajectory, journal, statistics, metadata and table."""
    path = episode(bag, 1)
    rewards = mjrec.load_trajectory(path).rewards.copy()
    rewards[2] += 1.0
    total = 0.0
    for reward in rewards.tolist():
        total += reward
    forge_episode(path, rewards=rewards, facts={"reward": total})
    say(video(recordings(bag), 1), reward=total)
    edit_journal(recordings(bag), 1, reward=total)
    edit_json(
        the(bag, "*.stats.json"),
        lambda stats: stats["episode_rewards"].__setitem__(1, total),
    )
    rows = read_table(bag)
    rows[1]["reward"] = repr(total)
    write_table(bag, rows)


def edit_a_reward_and_delete_the_seed(bag: Path) -> None:
    """So that nobody could begin the episode again."""
    edit_a_reward_everywhere(bag)
    forge_episode(episode(bag, 1), facts={"seed": None, "random_state": None})
    say(video(recordings(bag), 1), seed=None)
    edit_journal(recordings(bag), 1, seed=None)
    rows = read_table(bag)
    rows[1]["seed"] = ""
    write_table(bag, rows)


def call_it_another_environment(bag: Path) -> None:
    """In all files, but for what it was made as."""
    name = "Humanoid-v5"
    for number in range(EPISODES):
        forge_episode(episode(bag, number), facts={"env_id": name})
    for path in recordings(bag).glob("*.mp4"):
        say(path, env_id=name)
    manifest, journal = the(bag, "*.manifest.json"), the(bag, "*.jsonl")
    edit_json(manifest, lambda said: said["env_info"].update(env_id=name))
    described = the(bag, "environment.json")
    for path in (journal, described):
        path.write_text(path.read_text().replace("InvertedPendulum-v5", name))


def edit_a_state(bag: Path) -> None:
    """By one unit in the last place."""

    def edit(states: Any) -> None:
        states[2, 2] = np.nextafter(states[2, 2], np.inf)

    forge_episode(episode(bag, 1), states=edit)


def edit_an_action(bag: Path) -> None:
    """The controls in the states, which say it too, are left."""
    forge_episode(episode(bag, 1), actions=lambda a: a.__setitem__(2, -a[2]))


def edit_an_action_and_its_control(bag: Path) -> None:
    path = episode(bag, 1)
    control = mjrec.load_trajectory(path).component("ctrl")
    states = mjrec.load_trajectory(path).states
    [column] = [
        i for i in range(states.shape[1]) if np.array_equal(states[:, i], control[:, 0])
    ]
    forge_episode(
        path,
        actions=lambda a: a.__setitem__(2, -a[2]),
        states=lambda s: s.__setitem__((3, column), -s[3, column]),
    )


def swap_videos(bag: Path) -> None:
    """With metadata that say what each is to be of."""
    videos = [video(recordings(bag), number) for number in (0, 1)]
    before = [metadata(path) for path in videos]
    swap(*videos)
    for path, said in zip(videos, before, strict=True):
        kept = ("episode_id", "seed", "length", "reward", "terminated", "truncated")
        say(path, **{name: said[name] for name in kept})


def relabel_the_best(bag: Path) -> None:
    """The second episode's video is shown as that of the first."""
    first, second = (video(recordings(bag), number) for number in (0, 1))
    said = metadata(first)
    for ending in (".mp4", ".framehash", ".meta.json"):
        shutil.copy(second.with_suffix(ending), first.with_suffix(ending))
    kept = ("episode_id", "seed", "length", "reward", "terminated", "truncated")
    say(first, **{name: said[name] for name in kept})


def swap_the_model(bag: Path) -> None:
    """A heavier pole, under the name and with the hash of its own."""
    for number in range(EPISODES):
        swap_model(recordings(bag), number, 'size="0.049 0.3"', 'size="0.059 0.3"')
    for old in recordings(bag).glob("*.mjb.gz"):
        old.unlink()
        old.with_name(old.name.replace(".mjb.gz", ".zip")).unlink()


def lift_what_is_drawn(bag: Path) -> None:
    """The pole is drawn higher than it is, and the video made from that."""
    path = episode(bag, 1)

    def lift(rows: Any) -> None:
        # Of the last geom, the pole.
        rows["geom_xpos"][:, -1, -1] += 0.2

    forge_episode(path, snapshots=lift)
    forge_video(bag, 1, drawn(recordings(bag), 1))


def draw_another_episode(bag: Path) -> None:
    """What is drawn of the first episode is shown as the second."""
    other = trajectory(episode(bag, 0)).snapshots

    def put(rows: Any) -> None:
        shared = min(len(rows), len(other))
        rows[:shared] = other[:shared]

    forge_episode(episode(bag, 1), snapshots=put)
    forge_video(bag, 1, drawn(recordings(bag), 1))


def add_a_file(bag: Path) -> None:
    first = video(recordings(bag), 0)
    shutil.copy(
        first, first.with_name(first.name.replace("video000000", "video000002"))
    )


def rename_a_file(bag: Path) -> None:
    path = episode(bag, 1)
    path.rename(path.with_name(path.name.replace("episode000001", "episode000009")))


def add_a_scheduled_episode(bag: Path) -> None:
    """The manifest says that a video was wanted that the schedule does not name."""
    edit_json(
        the(bag, "*.manifest.json"),
        lambda manifest: manifest["mjrec"]["schedule"]["recorded"].append(3),
    )


def name_another_schedule(bag: Path) -> None:
    edit_json(
        the(bag, "*.manifest.json"),
        lambda manifest: manifest["mjrec"]["schedule"].update(name="at:0,3"),
    )


def add_a_note(bag: Path) -> None:
    """Beside the recordings; the bag's manifest lists it, as it lists all."""
    (bag / "data" / "notes.txt").write_text("Reviewed, and found to be in order.")


def name_another_gpu(bag: Path) -> None:
    """In the summary, for readers who look at nothing else."""
    edit_json(
        bag / "data" / "environment.json",
        lambda said: next(iter(said["recordings"].values()))["pictures"][0].update(
            gl_renderer="NVIDIA GeForce RTX 4090/PCIe/SSE2"
        ),
    )


def call_it_live(bag: Path) -> None:
    """Another video, which is said to be none that is drawn from states."""
    path = episode(bag, 1)
    forge_video(bag, 1, [255 - frame for frame in drawn(recordings(bag), 1)])
    say(video(recordings(bag), 1), recording="live")
    with open_trajectory(path) as reader:
        promised = reader.facts["video"]
    forge_episode(path, facts={"video": {**promised, "recording": "live"}})


def take_the_hashes_out(bag: Path) -> None:
    video(recordings(bag), 1).with_suffix(".framehash").unlink()


def play_it_faster(bag: Path) -> None:
    """The same frames and the same hashes of them."""
    path = video(recordings(bag), 1)
    said = metadata(path)
    forge(path, drawn(recordings(bag), 1), fps=50, hashes=False)
    say(path, length=said["length"], frame_steps=said["frame_steps"])


def forge_video(bag: Path, number: int, frames: list[Any]) -> None:
    """Put other frames into a video; length and metadata stay the episode's."""
    path = video(recordings(bag), number)
    length = metadata(path)["length"]
    forge(path, frames)
    say(path, length=length)


def make_table_fit(bag: Path) -> None:
    """Let the table say the hashes of the videos that are there."""
    rows = read_table(bag)
    for row in rows:
        if row["video"]:
            content = (recordings(bag) / row["video"]).read_bytes()
            row["video_sha256"] = hashlib.sha256(content).hexdigest()
    write_table(bag, rows)


def read_table(bag: Path) -> list[dict[str, str]]:
    text = (bag / "data" / "statistics.csv").read_text()
    return list(csv.DictReader(io.StringIO(text)))


def write_table(bag: Path, rows: list[dict[str, str]]) -> None:
    with (bag / "data" / "statistics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@dataclass(frozen=True)
class Case:
    """A forgery, at which level it is caught, and a word of what is said of it."""

    forgery: Callable[[Path], object]
    level: Level
    says: str


FILES, STATS, PHYSICS, PIXELS = Level
CASES = (
    Case(change_one_pixel, PIXELS, "have other hashes: 3"),
    Case(drop_a_frame, PIXELS, "its trajectory has 4 pictures"),
    Case(double_a_frame, PIXELS, "its trajectory has 4 pictures"),
    Case(drop_one_and_double_another, PIXELS, "have other hashes: 2"),
    Case(edit_a_reward_everywhere, PHYSICS, "step 3"),
    Case(edit_a_reward_and_delete_the_seed, PHYSICS, "step 3"),
    Case(call_it_another_environment, PHYSICS, "made as InvertedPendulum-v5"),
    Case(edit_a_state, PHYSICS, "qpos[1]"),
    Case(edit_an_action, PHYSICS, "step 3"),
    Case(edit_an_action_and_its_control, PHYSICS, "step 3"),
    Case(swap_videos, PIXELS, "other hashes"),
    Case(relabel_the_best, PIXELS, "other hashes"),
    Case(swap_the_model, PHYSICS, "body_mass"),
    Case(lift_what_is_drawn, PHYSICS, "frame 0: after step 0 geom_xpos["),
    Case(draw_another_episode, PHYSICS, "pictures differ"),
    Case(add_a_file, FILES, "video000002"),
    Case(rename_a_file, STATS, "what is inside says 1, its name 9"),
    Case(add_a_scheduled_episode, STATS, "3"),
    Case(name_another_schedule, STATS, "at:0,3"),
    Case(call_it_live, PIXELS, "have other hashes: 0, 1, 2, 3"),
    Case(take_the_hashes_out, FILES, "hashes of its frames is missing"),
    Case(play_it_faster, PIXELS, "50 frames a second"),
    Case(add_a_note, FILES, "notes.txt"),
    Case(name_another_gpu, STATS, "RTX 4090"),
)


# One of each kind: pictures, rewards, states, actions, names, models, files.
BY_DEFAULT = {
    *(drop_a_frame, edit_a_reward_everywhere, edit_a_state, edit_an_action),
    *(swap_videos, swap_the_model, add_a_file),
}


# Takes more than five seconds: the videos of a run are drawn, forged and drawn again.
@parametrize(
    "case",
    CASES,
    default=[case for case in CASES if case.forgery in BY_DEFAULT],
    ids=lambda case: case.forgery.__name__,
)
def test_forgery_is_caught(case: Case, bag: Path) -> None:
    """At the level that the documentation says, and with what was found where."""
    case.forgery(bag)
    make_table_fit(bag)
    make_bag_fit(bag)
    found = mjrec.verify(bag, level=case.level)
    assert {check.level for check in found.failures} == {case.level}
    assert any(case.says in f"{c.subject} {c.reason}" for c in found.failures), found


def test_what_was_not_forged_passes(bag: Path) -> None:
    """Also after its manifests were written again."""
    make_bag_fit(bag)
    found = mjrec.verify(bag)
    assert found.failures == ()
    assert found.count(Verdict.NOT_CHECKABLE) == 0


@parametrize(
    "forgery", [change_one_pixel, edit_a_state, add_a_file], ids=lambda f: f.__name__
)
def test_forgery_without_new_manifests_is_caught_at_once(
    forgery: Callable[[Path], object], bag: Path
) -> None:
    """Nothing but checksums is needed for it."""
    forgery(bag)
    assert not mjrec.verify(bag, level="files").passed
