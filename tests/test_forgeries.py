# SPDX-License-Identifier: Apache-2.0
"""Forged runs: what a liar did, the verdict, and what is said of it.

Each is made by an author who computes everything else again: returns, statistics,
hashes of files and frames, metadata, the table, the crate and the bag.
"""

import json
import re
import shutil
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from packed_runs import describe_again, edit_json, make_bag_fit, the, unpacked
from parts import parametrize

import honest_runs as honest
import lying_environments as lying
import mjrec
from forged_runs import ForgedRun
from mjrec.evaluation.episode_results import recorded_results
from mjrec.evidence.findings import Outcome, Verdict
from mjrec.formats.trajectory import added_up
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.trajectory_hdf5 import write_hdf5
from mjrec.formats.video_writer import VideoWriter
from mjrec.rendering.chosen_videos import write_choice
from mjrec.rendering.jobs import RecordingKey

FAIL, PARTLY, PASS = Verdict.FAIL, Verdict.PARTLY, Verdict.PASS

Lie = Callable[[ForgedRun], object]

FLIP = "display_orientation=insert:rotate=180"

SMALL = {"render_mode": "rgb_array", "width": 32, "height": 32}
EVALUATION = {"mode": "evaluation", "workers": 1}


@dataclass(frozen=True)
class Forgery:
    """A row of the table.

    Attributes:
        what: the liar did.
        lie: edits a monitor directory before it is packed.
        line: what is said of it, a regular expression.
        of: records the run that is edited.
        bag: edits the packed run, whose lists are made to fit afterwards.
        verdict: of all that.
        packing: options of `pack`.
        quick: whether it is tried by default.
    """

    what: str
    lie: Lie = lambda run: None
    line: str = ""
    of: Callable[[Path], object] = honest.pendulum
    bag: Callable[[Path], object] | None = None
    verdict: Verdict = FAIL
    packing: dict[str, Any] = field(default_factory=dict)
    quick: bool = False


# Lies about numbers.


def double_rewards(run):
    for episode in range(4):
        run.say_rewards(episode, lambda rewards: 2 * rewards)


def leave_states_out(run):
    """As `pack --episodes` does, but for what that would say in the manifest."""
    for episode in range(4):
        facts = {"states_left_out": True, "video": None, "model": None}
        run.edit_rows(
            episode,
            state=None,
            snapshot=None,
            snapshots=np.empty(0),
            frame_steps=np.empty(0, np.int64),
            facts=facts,
        )


def leave_actions_out(run):
    for episode in range(4):
        run.edit_rows(episode, action=None)


def call_actions_irregular(run):
    for episode in range(4):
        actions = run.content(episode).actions
        run.edit_rows(episode, action=None)
        lines = [
            {
                "action": {
                    "episode_id": episode,
                    "step": n,
                    "dtype": "float32",
                    "value": a.tolist(),
                }
            }
            for n, a in enumerate(actions)
        ]
        run.edit_journal(lambda all_, lines=lines: all_.__setitem__(slice(1, 1), lines))


def repeat_last_states(run):
    """And call those that were there unknown."""

    def edit(states):
        states[-2:] = np.nan

    run.edit_rows(1, states=edit)


def cut(run, episode, steps, **facts):
    """Leave out the end of an episode, and of its video if it has one."""
    whole = run.content(episode)
    run.edit_rows(
        episode,
        states=whole.states[: steps + 1],
        actions=whole.actions[:steps],
        rewards=whole.rewards[:steps],
        terminated=np.zeros(steps, np.bool_),
        truncated=np.arange(steps) == (steps - 1 if facts.get("truncated") else -1),
        snapshots=whole.snapshots[: steps + 1],
        frame_steps=whole.frame_steps[: steps + 1],
    )
    total = float(whole.rewards[:steps].sum())
    said = {"length": steps, "reward": total, "terminated": False, "truncated": False}
    run.say(episode, **{**said, **facts})
    if episode < 2:
        run.film(episode)


def hide_the_fall(run):
    run.film(1, run.frames(1)[:-2])


def edit_a_state(run):
    """By one unit in the last place."""

    def edit(states):
        states[2, 2] = np.nextafter(states[2, 2], np.inf)

    run.edit_rows(1, states=edit)


def edit_an_action(run):
    run.edit_rows(1, actions=lambda actions: actions.__setitem__(1, -actions[1]))


def name_another_seed(run):
    run.say(1, seed=77)


def forget_the_seed(run):
    """Of an episode whose beginning was chosen by hand."""
    run.say(1, seed=None)
    run.edit_rows(1, facts={"random_state": None})
    edit_a_state(run)


def swap_episodes(run):
    """Tell two episodes in the other order, each with its own seed and video."""
    for old, new in ((0, 9), (1, 0), (9, 1)):
        run.renumber(old, new)

    def sort(lines):
        places = [n for n, line in enumerate(lines) if "length" in line]
        ordered = sorted((lines[n] for n in places), key=lambda e: e["episode_id"])
        for place, line in zip(places, ordered, strict=True):
            lines[place] = line

    run.edit_journal(sort)


def show_one_as_two(run, seed=99):
    """The best episode's rows and numbers again, with a new seed or its own."""
    facts = run.content(3).facts
    own = ("episode_id", "start_time", "end_time", "possible_video")
    shutil.copy(run.trajectory(2), str(run.trajectory(3)))
    run.edit_rows(3, facts={name: facts[name] for name in own if name in facts})
    [told] = [line for line in _lines(run) if line.get("episode_id") == 2]
    same = {k: told[k] for k in ("length", "reward", "terminated", "truncated")}
    run.say(3, **same, seed=told["seed"] if seed is None else seed)


def leave_the_worst_out(run):
    """And number the others on."""
    run.remove_episode(0)
    for old in (1, 2, 3):
        run.renumber(old, old - 1)
    run.say_numbers(3)
    run.edit_journal(lambda lines: None)


def leave_the_first_out(run):
    """And keep the numbers, as if another monitor had recorded before."""
    run.remove_episode(0)
    run.edit_json("*.manifest.json", lambda m: m["mjrec"].update(first_episode_id=1))
    run.edit_journal(lambda lines: lines[0]["run"].update(first_episode_id=1))


def copy_the_recording(run):
    """One recording shown as two, by two names."""
    for path in list(run.directory.iterdir()):
        if ".0.u." in path.name:
            shutil.copy(path, path.with_name(path.name.replace(".0.u.", ".0.v.")))
    replace_in_second(run, "0.u", "0.v")


def replace_in_second(run, old, new):
    """Replace a text in all that the second recording says."""
    for path in run.directory.glob("*.0.v.*"):
        if path.suffix in (".json", ".jsonl"):
            path.write_text(path.read_text().replace(old, new))
        elif path.suffix == ".h5":
            with open_trajectory(path) as reader:
                text = json.dumps(dict(reader.facts)).replace(old, new)
                reader.facts = json.loads(text)
                write_hdf5(reader, path)


def double_rewards_cut_off(run):
    """Of an episode that is in no statistics, and has a video."""
    [cut_off] = {float(run.content(0).rewards.sum())}
    run.edit_rows(0, rewards=lambda r: r.__imul__(2), facts={"reward": 2 * cut_off})
    run.edit_json("*.video000000.meta.json", lambda m: m.update(reward=2 * cut_off))


def double_the_return(run):
    """And leave the rewards of the steps as they are."""
    run.say(1, reward=2 * added_up(run.content(1).rewards))


def give_no_plain_option(run):
    """What is no plain value is given to no reset, so that nothing is recreated."""
    run.say(3, options={"note": "version 1.0"})


# Lies about videos.


def one_pixel(run):
    frames = [frame.copy() for frame in run.frames(1)]
    frames[2][20, 10] ^= 64
    run.film(1, frames)


def one_pixel_each(run):
    for episode in (0, 1):
        frames = [frame.copy() for frame in run.frames(episode)]
        frames[-1][20, 10] ^= 64
        run.film(episode, frames)


def negative(episode):
    return lambda run: run.film(episode, [255 - f for f in run.frames(episode)])


def double_a_frame(run):
    frames = run.frames(1)
    run.film(1, [*frames[:2], frames[1], *frames[2:]])


def replace_a_frame(run):
    frames = run.frames(1)
    run.film(1, [*frames[:2], frames[1], *frames[3:]])


def swap_videos(run):
    frames = [run.frames(0), run.frames(1)]
    run.film(0, frames[1])
    run.film(1, frames[0])


def negative_as_clip(run):
    """A video of something else, called a clip, whose states nobody keeps."""
    run.film(1, [255 - frame for frame in run.frames(1)])
    old, new = ".video000001.", ".video000001.step000003."
    for path in list(run.directory.glob(f"*{old}*")):
        path.rename(path.with_name(path.name.replace(old, new)))
    name = run.the("*.step000003.mp4").name
    facts = {"first_step": 3, "last_episode_id": 1}
    run.edit_json("*.step000003.meta.json", lambda said: said.update(facts))
    run.edit_json(
        "*.manifest.json",
        lambda said: said.update(
            videos=[[n.replace(old, new) for n in pair] for pair in said["videos"]]
        ),
    )
    run.edit_journal(
        lambda lines: lines.insert(-1, {"clip": {"episode_id": 1, "video": name}})
    )
    run.edit_rows(1, facts={"video": None})


def live_and_doctored(run):
    """Frames of something else, called drawn by the environment itself."""
    said = {"recording": "live", "recording_reason": "render='live'"}
    run.film(1, [255 - frame for frame in run.frames(1)], **said)
    run.say(1, recording="live")
    run.edit_rows(1, facts={"video": {"recording": "live"}})


def swift(run):
    """Twice the speed, and metadata that says so."""
    run.film(1, fps="50", playback_speed=2.0)


def swift_in_real_time(run):
    """Twice the speed, called real time."""
    path, fps = run.video(1), json.loads(_metadata(run, 1).read_text())["fps"]
    run.film(1)
    run.mux(1, "-c", "copy", "-bsf:v", "setts=ts=TS/2:duration=DURATION/2")
    assert fps == "25"
    assert path.exists()


def slow_start(run):
    """One frame stands for a second; the same frames, the same average."""
    run.mux(1, "-c", "copy", "-bsf:v", "setts=ts=if(eq(N\\,0)\\,TS\\,TS+1/TB)")


def second_track(run):
    """A track on top of it, that players show."""
    other = run.directory.parent / "other.mp4"
    with VideoWriter(other, fps=25) as writer:
        for frame in run.frames(1):
            writer.write(255 - frame)
    maps = ("-map", "0:v", "-map", "1:v", "-c", "copy")
    disposition = ("-disposition:v:0", "0", "-disposition:v:1", "default")
    run.mux(1, *maps, *disposition, inputs=(other,))


def sound(run):
    """A commentary."""
    run.mux(
        1,
        *("-f", "lavfi", "-i", "sine=duration=0.1"),
        *("-map", "0:v", "-map", "1:a", "-c:v", "copy"),
    )


def title(run):
    said = ("-metadata", "title=Success rate 100 %")
    run.mux(1, "-c", "copy", *said, metadata="0")


def rotation(run):
    """Players show a robot that lies as one that stands."""
    path = run.video(1)
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 4 * 10
    unity = content[matrix : matrix + 36]
    assert unity[:4] == b"\0\1\0\0"
    turned = b"\0\0\0\0\0\1\0\0\0\0\0\0\xff\xff\0\0\0\0\0\0\0\0\0\0\0\x20\0\0"
    content[matrix : matrix + 28] = turned
    path.write_bytes(content)
    run.rehash(1)


def wide_pixels(run):
    run.mux(1, "-c", "copy", "-bsf:v", "h264_metadata=sample_aspect_ratio=4/1")


def cropped(run):
    """What happens at the right is not shown."""
    run.mux(1, "-c", "copy", "-bsf:v", "h264_metadata=crop_right=16")


def refilm(arguments):
    """Encode the same frames again, with what only players go by."""

    def lie(run):
        for episode in (0, 1):
            run.film(episode, encoder_arguments=("-bsf:v", arguments))

    return lie


def hidden_bytes(run):
    path = run.video(1)
    path.write_bytes(path.read_bytes() + b"\0\0\0\x10free12345678")
    run.rehash(1)


def small_called_large(run):
    """Drawn at a quarter of the size, and scaled up."""
    frames = [np.kron(f[::2, ::2], np.ones((2, 2, 1), np.uint8)) for f in run.frames(1)]
    run.film(1, frames)


def add_a_close_up(run):
    """A further video that nothing asked for, from where it looks best."""
    path = run.video(1)
    for ending in (".mp4", ".meta.json", ".framehash"):
        name = path.name.replace(".mp4", f".close{ending}")
        shutil.copy(path.with_suffix(ending), path.with_name(name))
    first, close = path.name, path.name.replace(".mp4", ".close.mp4")
    meta = close.replace(".mp4", ".meta.json")
    run.edit_json(meta, lambda said: said.update(first_video=first, camera="close"))
    run.edit_json(
        first.replace(".mp4", ".meta.json"), lambda s: s.update(further_videos=[close])
    )
    run.edit_json("*.manifest.json", lambda said: said["videos"].append([close, meta]))


def draft_called_full(run):
    frames = list(mjrec.render(run.trajectory(1), quality="draft"))
    run.film(1, frames)


def call_it_broken(run):
    """The video of an episode that should not be seen."""
    name = _metadata(run, 1).name
    run.video(1).unlink()
    run.the("*000001.framehash").unlink()
    run.edit_json(
        name, lambda said: said.update(broken=True, broken_reason="full disk")
    )
    run.edit_json("*.manifest.json", lambda said: _list_broken(said, name))


def blame_the_schedule(run):
    """For the video and the trajectory of an episode that should not be seen."""
    run.remove_video(1)
    run.trajectory(1).unlink()
    fault = {"episode_id": 1, "what": "video", "reason": "no idea"}

    def edit(lines):
        [at] = [n for n, line in enumerate(lines) if line.get("episode_id") == 1]
        del lines[at]["recording"]
        lines.insert(at, {"fault": fault})

    run.edit_journal(edit)
    run.edit_json("*.manifest.json", lambda said: said["mjrec"].update(faults=[fault]))


def _list_broken(manifest, name):
    manifest["videos"] = [pair for pair in manifest["videos"] if pair[1] != name]
    manifest["mjrec"]["broken"] = [name]


# Lies about what was chosen.


def call_the_best_worst(run):
    """The rule said best:1."""

    def edit(facts):
        for key, value in facts.items():
            if value == "best:1":
                facts[key] = "worst:1"

    run.say_everywhere(edit)


def name_another_schedule(run):
    """Episodes 0 and 1 were chosen by hand."""

    def edit(facts):
        for key, value in facts.items():
            if value == "capped_cubic_video_schedule":
                facts[key] = "every:2"

    run.say_everywhere(edit)


def choose_by_hand(run):
    """Another episode than the schedule names has the video."""
    run.remove_video(1)
    run.say(1, chosen=False, recording=None)
    run.edit_rows(1, facts={"video": None})
    run.edit_json(
        "*.manifest.json", lambda m: m["mjrec"]["schedule"].update(recorded=[0])
    )


# Lies about identity.


def hide_arguments(run):
    """The environment was made with noise of its reset's own."""

    def edit(facts):
        facts.pop("reset_noise_scale", None)

    run.say_everywhere(edit)


def call_it_another_environment(run):
    run.say_everywhere(
        lambda facts: _replace(facts, "InvertedPendulum-v5", "Hopper-v5")
    )


def call_it_by_another_name(run):
    """In what people read; it is made by its own id."""

    def edit(facts):
        _replace(facts, "InvertedPendulum-v5", "Humanoid-v5", key="env_id")

    run.say_everywhere(edit)


def call_it_ones_own(run):
    run.say_everywhere(
        lambda facts: _replace(facts, "InvertedPendulum-v5", "MyPendulum-v0")
    )


def pretend_to_be_gym(run):
    """Of gym's own directories hardly anything can be checked."""
    run.edit_json("*.manifest.json", lambda said: said.pop("mjrec"))
    run.edit_json(
        "*.manifest.json", lambda said: said["env_info"].update(gym_version="0.21.0")
    )
    for pattern in ("*.jsonl", "*.h5", "*.model.*"):
        for path in run.directory.glob(pattern):
            path.unlink()


def put_another_model_before(run):
    """Two files of one name, of which a reader sees the first or the last."""
    path = run.the("*.model.*.zip")
    with zipfile.ZipFile(path) as archive:
        members = {info: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for info, content in members.items():
            if info.filename.endswith(".xml"):
                archive.writestr(info.filename, content.replace(b"0.1", b"0.9"))
            archive.writestr(info, content)


def swap_the_model(run):
    """Sources of a lighter robot."""
    run.rewrite_zip(
        run.the("*.model.*.zip"),
        lambda content: content.replace(b'size=".05"', b'size=".04"'),
    )


def call_it_trained(run):
    """Training episodes of an evaluation, whose actions nobody keeps."""
    run.say_everywhere(lambda facts: _replace(facts, "e", "t", key="type"))
    run.edit_journal(lambda lines: lines[0]["run"]["options"].pop("mode", None))


def call_it_successful(run):
    for episode in range(4):
        run.say(episode, success=True)


def swap_the_ending(run):
    """A fall is called a limit of time."""
    content = run.content(1)
    run.edit_rows(1, terminated=content.truncated, truncated=content.terminated)
    run.say(1, terminated=False, truncated=True)


def call_it_double(run):
    """The actions' own dtype is another."""
    for episode in range(3):
        run.edit_rows(episode, facts={"action_dtypes": [[0, "float64"]]})


# Additions.


def add_to_hdf5(run):
    with h5py.File(run.trajectory(1), "r+") as file:
        file["success"] = np.ones(3)


def add_an_attribute(run):
    with h5py.File(run.trajectory(1), "r+") as file:
        file["rewards"].attrs["note"] = "doubled"


def add_a_fact(run):
    run.edit_rows(1, facts={"policy": "PPO"})


def add_to(pattern):
    return lambda run: run.edit_json(pattern, lambda said: said.update(success_rate=1))


def add_to_manifest(run):
    run.edit_json("*.manifest.json", lambda said: said["mjrec"].update(award="best"))


def add_to_facts(key):
    """Add to all objects that stand under a key."""

    def edit(facts):
        if isinstance(facts.get(key), dict):
            facts[key]["success_rate"] = 1

    return lambda run: run.say_everywhere(edit)


def add_a_video(bag):
    """Of a recording of which nothing else is there."""
    path = the(bag, "*.video000001.mp4")
    shutil.copy(path, path.with_name(path.name.replace(".0.u.", ".0.w.")))
    describe_again(bag)


def add_a_line(run):
    run.edit_journal(lambda lines: lines.insert(-1, {"remark": {"success": True}}))


def add_to_a_line(run):
    run.say(1)

    def edit(lines):
        next(line for line in lines if "length" in line)["judged"] = "perfect"

    run.edit_journal(edit)


def add_a_file(name):
    return lambda bag: (bag / name).write_text("All goals were reached.")


def replace_in(name, old, new):
    def edit(bag):
        path = the(bag, name)
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return edit


def pending_worst(bag):
    """The worst episode's video is to be rendered some day."""
    run = ForgedRun(bag / "data/recordings")
    name, trajectory = run.video(0).name, run.trajectory(0).name
    run.remove_video(0)
    promise = {"episode_id": 0, "video": name, "trajectory": trajectory}
    run.edit_json("*.manifest.json", lambda s: s["mjrec"].update(pending=[promise]))
    describe_again(bag)


def say_it_was_made_smaller(bag):
    """Which would excuse blurred frames."""
    run = ForgedRun(bag / "data/recordings")
    run.edit_json(
        "*000001.meta.json", lambda s: s.update(packed_smaller={"from": [480, 480]})
    )
    describe_again(bag)


def add_a_line_about_rows(bag):
    """Which packing takes out."""
    path = the(bag, "*.jsonl")
    lines = path.read_text().splitlines()
    rows = json.dumps({"note": {"name": "all goals reached"}})
    path.write_text("\n".join([*lines[:2], rows, *lines[2:]]) + "\n")
    describe_again(bag)


def edit_environment(**facts):
    def edit(bag):
        def change(said):
            [recording] = said["recordings"].values()
            recording.update(facts)

        edit_json(the(bag, "environment.json"), change)

    return edit


def tell_in_options(bag):
    def edit(said):
        said["packed_with"]["options"]["anonymous"] = {"award": "best paper"}

    edit_json(the(bag, "environment.json"), edit)


def edit_the_table(bag):
    path = the(bag, "statistics.csv")
    lines = path.read_text().splitlines()
    lines[2] = lines[2].replace(",2.0,", ",4.0,")
    path.write_text("\n".join(lines) + "\n")


# What may be claimed beside a lie, where nothing of the kind is true.


def claim_version(package, version):
    def edit(facts):
        if isinstance(facts.get("versions"), dict):
            facts["versions"][package] = version
        if "mujoco" in facts and package == "mujoco":
            facts["mujoco"] = version
        if isinstance(facts.get("rendered_with"), dict):
            facts["rendered_with"][package] = version

    return lambda run: run.say_everywhere(edit)


def claim_machine(run):
    def edit(facts):
        if "cpu_flags" in facts:
            facts["cpu_flags"] = "0" * 64

    run.say_everywhere(edit)


def claim_gpu(run):
    said = {"gl_vendor": "NVIDIA Corporation", "gl_version": "4.6.0 NVIDIA 580.95"}
    gpu = {**said, "gl_renderer": "NVIDIA H100 80GB HBM3/PCIe/SSE2"}
    run.edit_json("*.meta.json", lambda m: m.update(gpu))


def claim_ffmpeg(run):
    run.edit_json("*.meta.json", lambda m: m.update(ffmpeg_sha256="0" * 64))
    run.edit_json(
        "*.meta.json",
        lambda m: m["encoder_version"].update(version="ffmpeg version 7.1"),
    )


def claim_wrapper(run):
    def edit(facts):
        if facts.get("wrappers") == []:
            facts["wrappers"] = ["mylab.wrappers.Shaping"]
            facts["wrapper_arguments"] = [None]

    run.say_everywhere(edit)


CLAIMS = {
    "another Gymnasium": claim_version("gymnasium", "1.1.1"),
    "another MuJoCo": claim_version("mujoco", "3.5.0"),
    "another machine": claim_machine,
    "another GPU": claim_gpu,
    "another ffmpeg": claim_ffmpeg,
    "a wrapper": claim_wrapper,
}


def both(*lies):
    def all_of_them(run):
        for lie in lies:
            lie(run)

    return all_of_them


def doctored(change, of=honest.pendulum):
    """Return what records an environment that is not what its name says."""

    def record(directory):
        with lying.doctored(change):
            of(directory)

    return record


def noiseless(directory):
    honest.pendulum(directory, make={"reset_noise_scale": 0.0})


def best(directory):
    honest.kept(directory, rule="best:1")


def close_and_go_on(directory):
    """Close each time when an episode goes wrong."""
    for first in (0, 2):
        env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3, **SMALL)
        monitor = mjrec.Monitor(env, directory, uid="u", resume=True, **EVALUATION)
        for episode, steps in ((first, 3), (first + 1, 2)):
            monitor.reset(seed=episode)
            for _ in range(steps):
                monitor.step(np.full(1, 0.1, np.float32))
        monitor.close()


def by_hand(directory):
    honest.pendulum(directory, video_callable=lambda episode: episode in (0, 1))


def evaluated_and_swapped(directory):
    """Call the worst episode of an evaluation its best, as `evaluate` writes it."""
    honest.evaluated(directory, keep="none")
    ended = [*recorded_results(directory)]
    folder, worst = min(ended, key=lambda each: each[1].total_reward or 0.0)
    infix = worst.monitor
    assert infix is not None
    assert worst.episode_id is not None
    chosen = {RecordingKey(infix, worst.episode_id): ["best"]}
    write_choice(folder, chosen, rule="best", finished=len(ended))
    mjrec.render_videos(folder)


# The table.

FORGERIES = (
    # Numbers.
    Forgery("rewards doubled", double_rewards, "reward", quick=True),
    *(
        Forgery(f"rewards doubled, with {name} claimed", both(double_rewards, claim))
        for name, claim in CLAIMS.items()
        if name != "a wrapper"
    ),
    # It could have been there: this is what a wrapper may do.
    Forgery(
        "rewards doubled, with a wrapper claimed",
        both(double_rewards, claim_wrapper),
        r"rewards .* \[wrappers\]",
        verdict=PARTLY,
    ),
    *(
        Forgery(f"{lie.__name__}, with a wrapper claimed", both(lie, claim_wrapper))
        for lie in (edit_a_state, name_another_seed, hide_the_fall)
    ),
    Forgery(
        "an action edited, with a wrapper claimed",
        both(edit_an_action, claim_wrapper),
        r"not its controls.* \[wrappers\]",
        verdict=PARTLY,
        quick=True,
    ),
    Forgery(
        "last states called unknown, with a wrapper claimed",
        both(repeat_last_states, claim_wrapper),
    ),
    Forgery(
        "cut before the fall, with a wrapper claimed",
        both(lambda run: cut(run, 1, 2, truncated=True), claim_wrapper),
        verdict=PARTLY,
    ),
    Forgery(
        "rewards doubled, states left out",
        both(double_rewards, leave_states_out),
        "reward",
    ),
    Forgery(
        "rewards doubled, actions left out of an evaluation",
        both(double_rewards, leave_actions_out),
    ),
    Forgery(
        "rewards doubled, actions called irregular",
        both(double_rewards, call_actions_irregular),
        "reward",
    ),
    # No package is called so, but an excuse is.
    Forgery(
        "rewards doubled, with a version of the environment claimed",
        both(double_rewards, claim_version("environment", "1.0")),
        "reward",
        quick=True,
    ),
    Forgery(
        "rewards doubled, with an option that no reset can be given",
        both(double_rewards, give_no_plain_option),
    ),
    Forgery(
        "rewards doubled of an episode that was cut off",
        double_rewards_cut_off,
        "reward",
        of=honest.early,
    ),
    Forgery(
        "a return doubled, with a wrapper claimed",
        both(double_the_return, edit_an_action, claim_wrapper),
        "reward",
    ),
    Forgery(
        "rewards doubled by a wrapper that is not named",
        line="reward",
        of=doctored(lying.double_reward),
        quick=True,
    ),
    Forgery("falls that do not end an episode", of=doctored(lying.never_fall)),
    Forgery("a pole that is held", of=doctored(lying.push)),
    Forgery("a heavier robot", of=doctored(lying.make_heavy)),
    Forgery("played on the moon", of=doctored(lying.raise_gravity)),
    Forgery("every episode a success", of=doctored(lying.always_succeed)),
    Forgery("success added to the journal", call_it_successful, "success"),
    Forgery("last states called unknown", repeat_last_states, "state", quick=True),
    Forgery("cut before the fall", lambda run: cut(run, 1, 2)),
    Forgery(
        "cut before the fall, called a limit",
        lambda run: cut(run, 1, 2, truncated=True),
    ),
    Forgery("a state of an ulp", edit_a_state, r"qpos|qvel|states"),
    Forgery("an action edited", edit_an_action, "", quick=True),
    Forgery("another seed", name_another_seed, ""),
    Forgery("a beginning of one's own, its seed forgotten", forget_the_seed),
    Forgery("two episodes in the other order", swap_episodes),
    Forgery("one episode shown as two", show_one_as_two),
    Forgery(
        "one episode shown as two, with its seed",
        lambda run: show_one_as_two(run, seed=None),
        "same episode",
        verdict=PARTLY,
    ),
    Forgery(
        "rewards doubled, of episodes that were not chosen for packing",
        double_rewards,
        "reward",
        packing={"episodes": [0]},
    ),
    Forgery(
        "rewards doubled, anonymously",
        double_rewards,
        "reward",
        packing={"anonymous": True},
    ),
    Forgery("the worst left out, the others renumbered", leave_the_worst_out),
    Forgery("the first left out", leave_the_first_out, "begins with episode 1"),
    Forgery("one recording shown as two", copy_the_recording, "same", verdict=PARTLY),
    Forgery("fall called a limit of time", swap_the_ending, "terminated|truncated"),
    Forgery(
        "closed whenever an episode goes wrong, and resumed",
        of=close_and_go_on,
        line="continues after them",
        verdict=PARTLY,
    ),
    Forgery("actions called float64", call_it_double, of=honest.cheetah),
    # Videos.
    Forgery("one pixel changed", one_pixel, "frame 2", quick=True),
    *(
        Forgery(f"one pixel changed, with {name} claimed", both(one_pixel, claim))
        for name, claim in CLAIMS.items()
    ),
    Forgery(
        "a pixel of each video changed, with another ffmpeg claimed",
        both(one_pixel_each, claim_ffmpeg),
        "hash",
    ),
    Forgery("the fall not shown", hide_the_fall, "frames"),
    Forgery("a frame doubled", double_a_frame, "frames"),
    Forgery("a frame replaced", replace_a_frame, "frame 2"),
    Forgery("videos swapped", swap_videos),
    Forgery("a negative called a clip", negative_as_clip),
    Forgery("a negative called live", live_and_doctored),
    Forgery("a body made invisible", of=doctored(lying.hide_the_pole), quick=True),
    Forgery("twice the speed, as the metadata says", swift),
    Forgery("twice the speed, called real time", swift_in_real_time),
    Forgery("a frame that stands", slow_start),
    Forgery("a second track on top", second_track, "track|tables", quick=True),
    Forgery("a commentary", sound, "track|tables"),
    Forgery("a title in the file", title),
    Forgery("a video turned", rotation),
    Forgery("wide pixels", wide_pixels),
    Forgery("a video cropped", cropped),
    Forgery("bytes at the end of a video", hidden_bytes),
    *(
        Forgery(f"{lie.__name__}, with another ffmpeg claimed", both(lie, claim_ffmpeg))
        for lie in (
            *(swift, swift_in_real_time, slow_start, second_track, sound, title),
            *(rotation, wide_pixels, cropped, hidden_bytes, double_a_frame),
        )
    ),
    *(
        Forgery(what, both(refilm(f"h264_metadata={metadata}"), claim_ffmpeg), line)
        for what, metadata, line in (
            ("false colours", "matrix_coefficients=0", "colour tags"),
            ("a message", f"sei_user_data={'ab' * 16}+Success", "frames and messages"),
            ("videos turned in the stream", FLIP, "frame"),
        )
    ),
    Forgery(
        "negatives of all videos, with another GPU claimed",
        both(*(negative(episode) for episode in (0, 1)), claim_gpu),
        "",
    ),
    Forgery("videos swapped, with another GPU claimed", both(swap_videos, claim_gpu)),
    Forgery("small frames called large", small_called_large),
    Forgery("draft called full", draft_called_full),
    Forgery("a close-up added", add_a_close_up),
    Forgery("a video called broken", call_it_broken, "no such file"),
    Forgery("a video left out, the schedule blamed", blame_the_schedule, "no such"),
    # The returns of such an episode count, and the first lines name it.
    Forgery(
        "the encoder killed before the fall",
        of=honest.encoder_killed,
        line=r"faults while recording.* video of episode 1(.|\n)*\[broken video\]",
        verdict=PARTLY,
    ),
    Forgery(
        "rewards doubled of an episode whose encoder was killed",
        lambda run: run.say_rewards(1, lambda rewards: 2 * rewards),
        "reward",
        of=honest.encoder_killed,
    ),
    Forgery("the worst's video called pending", bag=pending_worst),
    Forgery("a video called made smaller", bag=say_it_was_made_smaller),
    # What was chosen.
    Forgery("the best called the worst", call_the_best_worst, of=best, quick=True),
    Forgery("the worst of an evaluation called its best", of=evaluated_and_swapped),
    Forgery("another schedule named", name_another_schedule),
    Forgery("a scheduled video left out", choose_by_hand),
    # Identity.
    Forgery("arguments hidden", hide_arguments, of=noiseless, quick=True),
    Forgery("another environment named", call_it_another_environment),
    Forgery("another name", call_it_by_another_name, "its name is", quick=True),
    Forgery("called one's own environment", call_it_ones_own),
    Forgery("called gym's", pretend_to_be_gym),
    Forgery("another model's sources", swap_the_model, of=honest.mjcf),
    Forgery("a second file in a model's sources", put_another_model_before, "zip"),
    Forgery("evaluation called training", call_it_trained),
    # Claims without a lie. Where nothing need differ, nothing was excused.
    *(
        Forgery(f"{name} claimed", CLAIMS[name], verdict=PASS)
        for name in ("another Gymnasium", "another machine", "another ffmpeg")
    ),
    *(
        Forgery(f"{name} claimed", CLAIMS[name], "is claimed to be")
        for name in ("another MuJoCo", "another GPU")
    ),
    Forgery(
        "another MuJoCo claimed, the compiled model left out",
        both(CLAIMS["another MuJoCo"], lambda run: run.the("*.mjb.gz").unlink()),
        "mjb.gz",
    ),
    # Additions.
    Forgery("a dataset added", add_to_hdf5, "success", quick=True),
    Forgery("an attribute added", add_an_attribute, "note"),
    Forgery("a fact added", add_a_fact, "policy"),
    Forgery("a key in the statistics", add_to("*.stats.json"), "success_rate"),
    Forgery("a key in metadata", add_to("*000001.meta.json"), "success_rate"),
    Forgery("a key in the manifest", add_to_manifest, "award"),
    Forgery(
        "a key in the manifest, with a schedule of one's own",
        add_to_manifest,
        "award",
        of=by_hand,
    ),
    Forgery(
        "a key about the device",
        lambda run: run.edit_json(
            "*.meta.json",
            lambda said: said.update(gl_device={"index": 0, "note": "all succeeded"}),
        ),
        "gl_device",
    ),
    *(
        Forgery(f"a key of the {key}", add_to_facts(key), "success_rate")
        for key in ("provenance", "machine")
    ),
    Forgery("a line in the journal", add_a_line, "remark"),
    Forgery("a line about rows", bag=add_a_line_about_rows, line="goals"),
    Forgery("a key in a line of the journal", add_to_a_line, "judged"),
    Forgery(
        "a note beside the data",
        bag=add_a_file("notes.txt"),
        line="notes.txt",
        quick=True,
    ),
    Forgery("a note in the data", bag=add_a_file("data/notes.txt"), line="notes.txt"),
    Forgery(
        "a video of no recording",
        bag=add_a_video,
        line="does not belong to a recording",
    ),
    Forgery(
        "a note in the recordings",
        bag=add_a_file("data/recordings/notes.txt"),
        line="notes.txt",
        quick=True,
    ),
    # Descriptions.
    Forgery(
        "README claims more",
        bag=replace_in("README.md", "## Videos", "All reached the goal.\n\n## Videos"),
        line="README",
        quick=True,
    ),
    Forgery(
        "a line at the end of the README that begins as one of the bag's own",
        bag=lambda bag: the(bag, "README.md").write_text(
            the(bag, "README.md").read_text() + "Payload-Oxum: all goals reached\n"
        ),
        line="README",
    ),
    Forgery(
        "a claim in the README beside versions, with another MuJoCo claimed",
        CLAIMS["another MuJoCo"],
        bag=replace_in("README.md", "| versions | ", "| versions | best policy, "),
        line="README",
    ),
    Forgery(
        "citation claims more",
        bag=replace_in("CITATION.cff", "type: dataset", "type: dataset\nversion: best"),
        line="CITATION",
    ),
    Forgery(
        "crate claims more",
        bag=replace_in(
            "ro-crate-metadata.json", "Complete episodes: 4", "Successes: 4"
        ),
        line="crate",
    ),
    Forgery("a return in the table", bag=edit_the_table, line="statistics.csv"),
    Forgery(
        "a return in the table, beside an environment of one's own",
        lambda run: replace_in_second(run, '"id": "InvertedP', '"id": "MyP'),
        of=honest.several,
        bag=edit_the_table,
        line="statistics.csv",
    ),
    Forgery(
        "an option of packing that tells more",
        packing={"anonymous": True},
        bag=tell_in_options,
        line="packing options",
    ),
    Forgery(
        "another graphics card in environment.json",
        bag=edit_environment(frames=[{"gl_renderer": "RTX 4090"}]),
        line="environment.json",
    ),
    Forgery(
        "another command in environment.json",
        bag=edit_environment(provenance={"command": ["honest.py"]}),
        line="environment.json",
    ),
    Forgery(
        "a line in bag-info",
        bag=replace_in("bag-info.txt", "Bagging-Date", "Award: best\nBagging-Date"),
        line="bag-info",
    ),
)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """Return what records once in a session, for tests that change copies."""
    made = {}

    def directory(record):
        if record not in made:
            made[record] = tmp_path_factory.mktemp("honest") / "run"
            record(made[record])
        return made[record]

    return directory


def forged(forgery, run, into):
    """Return a forged archive, or an unpacked one."""
    directory = Path(shutil.copytree(run, into / "recorded"))
    forgery.lie(ForgedRun(directory))
    archive = mjrec.pack(directory, into / "run.zip", **forgery.packing)
    if forgery.bag is None:
        return archive
    bag = unpacked(archive, into / "unpacked")
    forgery.bag(bag)
    make_bag_fit(bag)
    return bag


def told(found):
    """Return all that speaks against an archive, or is believed."""
    lines = [
        f"{each.outcome} {each.topic} {each.item}: {each.reason} [{each.excuse}]"
        for each in found.findings
        if each.outcome is not Outcome.RECREATED
    ]
    lines += [
        f"{'refuted' if each.refuted else 'excuse'} {each.name}: {each.claimed}"
        for each in found.excuses
    ]
    return "\n".join(lines)


@parametrize(
    "forgery",
    FORGERIES,
    default=[each for each in FORGERIES if each.quick],
    ids=lambda each: each.what,
)
def test_forgery_is_seen(forgery, recorded, tmp_path):
    """With the verdict of the table, and a line that says where."""
    archive = forged(forgery, recorded(forgery.of), tmp_path)
    found = mjrec.verify(archive)
    assert found.verdict is forgery.verdict, told(found)
    assert re.search(forgery.line, told(found)), told(found)


def _lines(run):
    return [json.loads(line) for line in run.the("*.jsonl").read_text().splitlines()]


def _metadata(run, episode):
    return run.the(f"*.video{episode:06d}.meta.json")


def _replace(facts, old, new, key=None):
    for name, value in facts.items():
        if value == old and key in (None, name):
            facts[name] = new
