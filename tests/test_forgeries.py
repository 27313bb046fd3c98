# SPDX-License-Identifier: Apache-2.0
"""Forged runs fail verification, or are believed, with a line that names the lie.

The forger recomputes everything else: returns, statistics, hashes of files and
frames, metadata, the table, the crate and the bag.
"""

import dataclasses
import gzip
import json
import re
import shutil
import struct
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from operator import methodcaller

import gymnasium
import h5py
import numpy as np
import pytest
from packed_runs import edit_json, make_bag_fit, rewrite_descriptions, the, unpacked
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
from mjrec.trackers import MonitorCsvTracker

FAIL, PARTLY, PASS = Verdict.FAIL, Verdict.PARTLY, Verdict.PASS
PENDULUM = "InvertedPendulum-v5"
TURNED = "display_orientation=insert:rotate=180"
DEVICE = {"index": 0, "note": "all succeeded"}
X264 = "dc45e9bde6d948b7962cd820d923eeef"
# This path of boxes leads to the parameters of a stream.
BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1", b"avcC")
SINE = ("-f", "lavfi", "-i", "sine=duration=0.1")
TITLE = ("-metadata", "title=Success rate 100 %")


@dataclasses.dataclass(frozen=True)
class Forgery:
    """Describe one forgery and its expected verdict."""

    what: str
    # This regular expression must match the report.
    line: str
    # This function edits a monitor directory before packing.
    lie: Callable | None = None
    # This function records the run to edit.
    of: Callable = honest.pendulum
    # This function edits the packed run, whose manifests are then updated.
    bag: Callable | None = None
    verdict: Verdict = FAIL
    packing: dict = dataclasses.field(default_factory=dict)


def both(*lies):
    def all_of_them(run):
        for lie in lies:
            lie(run)

    return all_of_them


def each(count, lie):
    """Apply a lie to each of the first `count` episodes."""
    return both(*(partial(lie, episode=episode) for episode in range(count)))


# These functions lie about numbers.


def double_rewards_of(run, episode):
    run.say_rewards(episode, lambda rewards: 2 * rewards)


double_rewards = each(4, double_rewards_of)
name_another_seed = methodcaller("say", 1, seed=77)
leave_actions_out = each(4, lambda run, episode: run.edit_rows(episode, action=None))
call_it_successful = each(4, lambda run, episode: run.say(episode, success=True))


def leave_states_out(run, episode):
    """Remove states as `pack --episodes` does, but leave the manifest as it is."""
    facts = {"states_left_out": True, "video": None, "model": None}
    left_out = {"state": None, "snapshot": None, "snapshots": np.empty(0)}
    run.edit_rows(episode, frame_steps=np.empty(0, np.int64), facts=facts, **left_out)


def call_actions_irregular(run, episode):
    lines = [
        {"action": {"episode_id": episode, "step": n, "dtype": "float32", "value": a}}
        for n, a in enumerate(run.content(episode).actions.tolist())
    ]
    run.edit_rows(episode, action=None)
    run.edit_journal(lambda all_: all_.__setitem__(slice(1, 1), lines))


def repeat_last_states(run):
    """Mark the last states as unknown."""
    run.edit_rows(1, states=lambda states: states[-2:].fill(np.nan))


def cut(run, **facts):
    """Remove the end of an episode and of its video."""
    steps, whole = 2, run.content(1)
    is_truncated = facts.get("truncated", False)
    run.edit_rows(
        1,
        states=whole.states[: steps + 1],
        actions=whole.actions[:steps],
        rewards=whole.rewards[:steps],
        terminated=np.zeros(steps, np.bool_),
        truncated=np.array([False, is_truncated]),
        snapshots=whole.snapshots[: steps + 1],
        frame_steps=whole.frame_steps[: steps + 1],
    )
    total = float(whole.rewards[:steps].sum())
    said = {"length": steps, "reward": total, "terminated": False, "truncated": False}
    run.say(1, **{**said, **facts})
    run.film(1)


cut_as_by_a_limit = partial(cut, truncated=True)


def edit_a_state(run):
    """Change one state by one unit in the last place."""

    def edit(states):
        states[2, 2] = np.nextafter(states[2, 2], np.inf)

    run.edit_rows(1, states=edit)


def edit_an_action(run):
    run.edit_rows(1, actions=lambda actions: actions.__setitem__(1, -actions[1]))


def forget_the_seed(run):
    """Drop the seed of an episode whose initial state was chosen by hand."""
    run.say(1, seed=None)
    run.edit_rows(1, facts={"random_state": None})
    edit_a_state(run)


def swap_episodes(run):
    """Report two episodes in reverse order, each with its own seed and video."""
    for old, new in ((0, 9), (1, 0), (9, 1)):
        run.renumber(old, new)

    def sort(lines):
        places = [n for n, line in enumerate(lines) if "length" in line]
        ordered = sorted((lines[n] for n in places), key=lambda e: e["episode_id"])
        for place, line in zip(places, ordered, strict=True):
            lines[place] = line

    run.edit_journal(sort)


def show_one_as_two(run, **facts):
    """Report the rows and numbers of the best episode twice."""
    others = run.content(3).facts
    own = ("episode_id", "start_time", "end_time", "possible_video")
    shutil.copy(run.trajectory(2), run.trajectory(3))
    run.edit_rows(3, facts={name: others[name] for name in own if name in others})
    [told] = [line for line in run.lines() if line.get("episode_id") == 2]
    same = ("length", "reward", "terminated", "truncated", "seed")
    run.say(3, **{**{key: told[key] for key in same}, **facts})


def leave_the_worst_out(run):
    """Remove the worst episode and renumber the others."""
    run.remove_episode(0)
    for old in (1, 2, 3):
        run.renumber(old, old - 1)
    run.say_numbers(3)


def leave_the_first_out(run):
    """Remove the first episode as if another monitor had recorded it."""
    run.remove_episode(0)
    run.edit_details(first_episode_id=1)
    run.edit_journal(lambda lines: lines[0]["run"].update(first_episode_id=1))


def copy_the_recording(run):
    """Show one recording as two with different names."""
    for path in list(run.directory.iterdir()):
        if ".0.u." in path.name:
            shutil.copy(path, path.with_name(path.name.replace(".0.u.", ".0.v.")))
    replace_in_second(run, "0.u", "0.v")


def replace_in_second(run, old, new):
    """Replace a text in every file of the second recording."""
    for path in run.directory.glob("*.0.v.*"):
        if path.suffix in (".json", ".jsonl"):
            path.write_text(path.read_text().replace(old, new))
        elif path.suffix == ".h5":
            with open_trajectory(path) as reader:
                text = json.dumps(dict(reader.facts)).replace(old, new)
                reader.facts = json.loads(text)
                write_hdf5(reader, path)


def of_the_second(*lies):
    """Apply lies to only the second of two recordings."""

    def lie(run):
        (second := run.directory.with_name("second")).mkdir()
        for path in list(run.directory.iterdir()):
            if ".0.v." in path.name:
                path.rename(second / path.name)
            elif ".model." in path.name:
                shutil.copy(path, second)
        both(*lies)(ForgedRun(second))
        for path in list(second.iterdir()):
            path.replace(run.directory / path.name)

    return lie


def double_rewards_cut_off(run):
    """Double the rewards of an incomplete episode that has a video."""
    twice = 2 * float(run.content(0).rewards.sum())
    run.edit_rows(0, rewards=lambda r: r.__imul__(2), facts={"reward": twice})
    run.edit_json("*.video000000.meta.json", reward=twice)


def double_the_return(run):
    """Double the return and keep the rewards of the steps."""
    run.say(1, reward=2 * added_up(run.content(1).rewards))


# No reset is given an option that is not plain, so nothing can be recreated.
NO_PLAIN_OPTION = {"note": "version 1.0"}
give_no_plain_option = methodcaller("say", 3, options=NO_PLAIN_OPTION)


def say_an_option(run, **options):
    run.edit_journal(lambda lines: lines[0]["run"]["options"].update(options))


def say_a_random_state(run):
    run.edit_rows(1, facts={"random_state": {"bit_generator": "of luck"}})


def name_an_argument(run):
    """Add an argument that no version of the environment accepts."""

    def edit(facts):
        if isinstance(facts.get("environment"), dict):
            facts["environment"]["kwargs"]["no_such"] = 1

    run.say_everywhere(edit)


def swap_the_ending(run):
    """Present a fall as a time limit."""
    content = run.content(1)
    run.edit_rows(1, terminated=content.truncated, truncated=content.terminated)
    run.say(1, terminated=False, truncated=True)


# These functions lie about videos.


def paint(run, episode=1, *, at=slice(None), side=3):
    """Blacken a square in some frames."""
    frames = [one.copy() for one in run.frames(episode)]
    for one in frames[at]:
        one[12 : 12 + side, 12 : 12 + side] = 0
    run.film(episode, frames)


one_spot = partial(paint, at=slice(2, 3))
black_squares = each(2, partial(paint, side=8))


def negative(run, episode=1, **said):
    run.film(episode, [255 - frame for frame in run.frames(episode)], **said)


def refilm(change):
    """Replace the second episode's frames with the result of `change`."""
    return lambda run: run.film(1, change(run.frames(1)))


hide_the_fall = refilm(lambda frames: frames[:-2])
double_a_frame = refilm(lambda f: [*f[:2], f[1], *f[2:]])


def swap_videos(run):
    frames = [run.frames(0), run.frames(1)]
    run.film(0, frames[1])
    run.film(1, frames[0])


def negative_as_clip(run):
    """Present other frames as a clip, whose states nobody keeps."""
    negative(run)
    old, new = ".video000001.", ".video000001.step000003."
    for path in list(run.directory.glob(f"*{old}*")):
        path.rename(path.with_name(path.name.replace(old, new)))
    run.edit_json("*.step000003.meta.json", first_step=3, last_episode_id=1)

    def rename(said):
        said["videos"] = [
            [n.replace(old, new) for n in pair] for pair in said["videos"]
        ]

    run.edit_json("*.manifest.json", rename)
    clip = {"episode_id": 1, "video": run.the("*.step000003.mp4").name}
    run.edit_journal(lambda lines: lines.insert(-1, {"clip": clip}))
    run.edit_rows(1, facts={"video": None})


def live_and_doctored(run):
    """Present other frames as rendered live by the environment."""
    negative(run, recording="live", recording_reason="render='live'")
    run.say(1, recording="live")
    run.edit_rows(1, facts={"video": {"recording": "live"}})


mux = partial(methodcaller, "mux", 1)


def bitstream(filters):
    return mux("-c", "copy", "-bsf:v", filters)


def swift_in_real_time(run):
    run.film(1)
    bitstream("setts=ts=TS/2:duration=DURATION/2")(run)


def second_track(run):
    """Add a second track that players show instead of the first."""
    other = run.directory.parent / "other.mp4"
    with VideoWriter(other, fps=25) as writer:
        for frame in run.frames(1):
            writer.write(255 - frame)
    maps = ("-map", "0:v", "-map", "1:v", "-c", "copy")
    disposition = ("-disposition:v:0", "0", "-disposition:v:1", "default")
    run.mux(1, *maps, *disposition, inputs=(other,))


def rotation(run):
    """Rotate the video so that a fallen robot seems to stand."""
    content = bytearray(run.video(1).read_bytes())
    matrix = content.index(b"tkhd") + 4 + 4 * 10
    assert content[matrix : matrix + 4] == b"\0\1\0\0"
    turned = b"\0\0\0\0\0\1\0\0\0\0\0\0\xff\xff\0\0\0\0\0\0\0\0\0\0\0\x20\0\0"
    content[matrix : matrix + 28] = turned
    run.video(1).write_bytes(content)
    run.rehash(1)


def hidden_bytes(run):
    path = run.video(1)
    path.write_bytes(path.read_bytes() + b"\0\0\0\x10free12345678")
    run.rehash(1)


def encoded_with(arguments):
    """Encode the same frames with metadata that only affects players."""
    given = {"encoder_arguments": ("-bsf:v", arguments)}
    return each(2, lambda run, episode: run.film(episode, **given))


# The frames are unchanged; only the file or its timing differs.
OF_FILES = {
    "twice the speed, as the metadata says": (
        methodcaller("film", 1, fps="50", playback_speed=2.0),
        "playback_speed: the archive has 2.0",
    ),
    "twice the speed, called real time": (swift_in_real_time, "times: the archive has"),
    "a frame that stands": (
        bitstream("setts=ts=if(eq(N\\,0)\\,TS\\,TS+1/TB)"),
        "times: .* not all shown for the same duration",
    ),
    "a second track on top": (second_track, "2 boxes 'stts'"),
    "a commentary": (
        mux(*SINE, "-map", "0:v", "-map", "1:a", "-c:v", "copy"),
        "2 boxes 'stts'",
    ),
    "a title in the file": (mux("-c", "copy", *TITLE, metadata="0"), "udta: .* title"),
    "a video turned": (rotation, "tkhd: .* turned"),
    "wide pixels": (
        bitstream("h264_metadata=sample_aspect_ratio=4/1"),
        "avc1: .* shape of its pixels",
    ),
    # This crop hides what happens at the right edge.
    "a video cropped": (
        bitstream("h264_metadata=crop_right=16"),
        "size.*: the archive has .* W16 H32",
    ),
    "bytes at the end of a video": (hidden_bytes, "boxes: the archive has free"),
}


def say_it_in_the_stream(run, episode):
    """Hide text in an encoder message that uses the encoder's own id."""
    text = f"h264_metadata=sei_user_data={X264}+All_goals_were_reached"
    filters = f"filter_units=remove_types=6,{text}"
    run.film(episode, encoder_arguments=("-x264-params", "me=dia", "-bsf:v", filters))


def hide_in_box(run, episode, *path):
    """Hide text at the end of a box in an mp4 file, where no program looks."""
    run.film(episode, encoder_arguments=("-x264-params", "me=dia"))
    content, text = bytearray(run.video(episode).read_bytes()), b"All were reached."
    numbers, at = [], 0
    for name in path:
        at = content.index(name, at)
        numbers.append(at - 4)
    end = numbers[-1] + struct.unpack_from(">L", content, numbers[-1])[0]
    if end < len(content):
        # The frames move, so their offsets must change.
        chunks = content.index(b"stco") + 8
        [count] = struct.unpack_from(">L", content, chunks)
        numbers += range(chunks + 4, chunks + 4 + 4 * count, 4)
    for at in numbers:
        [number] = struct.unpack_from(">L", content, at)
        struct.pack_into(">L", content, at, number + len(text))
    run.video(episode).write_bytes(content[:end] + text + content[end:])
    run.rehash(episode)


def in_box(*path):
    return lambda run, episode: hide_in_box(run, episode, *path)


def write_with_spaces(run):
    """Add spaces that no JSON reader sees."""
    text = run.metadata(1).read_text()
    run.metadata(1).write_text(text.replace(": ", ":  ", 1))


def edit_the_csv(run):
    path = run.the("*.monitor.csv")
    path.write_text(path.read_text().replace("\n2.0,", "\n9.0,"))


def add_a_close_up(run):
    """Add an unrequested further video from a flattering camera."""
    path = run.video(1)
    for ending in (".mp4", ".meta.json", ".framehash"):
        name = path.name.replace(".mp4", f".close{ending}")
        shutil.copy(path.with_suffix(ending), path.with_name(name))
    first, close = path.name, path.name.replace(".mp4", ".close.mp4")
    meta = close.replace(".mp4", ".meta.json")
    run.edit_json(meta, first_video=first, camera="close")
    run.edit_json(first.replace(".mp4", ".meta.json"), further_videos=[close])
    run.edit_json("*.manifest.json", lambda said: said["videos"].append([close, meta]))


def call_it_broken(run):
    """Report a video as broken to hide it."""
    name = run.metadata(1).name
    run.video(1).unlink()
    run.the("*000001.framehash").unlink()
    run.edit_json(name, broken=True, broken_reason="full disk")
    run.list_no_video(".video000001.mp4")
    run.edit_details(broken=[name])


def blame_the_schedule(run):
    """Remove a video and a trajectory, and report a fault of the schedule."""
    run.trajectory(1).unlink()
    blame_a_fault(run, "video")


def blame_a_fault(run, what="trajectory"):
    """Remove a video and report a fault as the reason."""
    run.remove_video(1)
    fault = {"episode_id": 1, "what": what, "reason": "no idea"}

    def edit(lines):
        [at] = [n for n, line in enumerate(lines) if line.get("episode_id") == 1]
        if what == "video":
            del lines[at]["recording"]
        else:
            run.edit_rows(1, facts={"video": None})
        lines.insert(at, {"fault": fault})

    run.edit_journal(edit)
    run.edit_details(faults=[fault])


def blame_another_episode(run):
    """Attribute the fault that cut a trajectory short to another episode."""

    def edit(facts):
        if facts.get("what") == "trajectory":
            facts["episode_id"] = 2

    run.say_everywhere(edit)


def leave_faults_out(run):
    def edit(lines):
        lines[:] = [line for line in lines if "fault" not in line]

    run.edit_journal(edit)
    run.edit_details(faults=[])


def pending_worst(bag):
    """Report the worst episode's video as pending."""
    run = ForgedRun(bag / "data/recordings")
    name, trajectory = run.video(0).name, run.trajectory(0).name
    run.remove_video(0)
    run.edit_details(
        pending=[{"episode_id": 0, "video": name, "trajectory": trajectory}]
    )
    rewrite_descriptions(bag)


def say_it_was_made_smaller(bag):
    """Claim that packing reduced the video, which would excuse blurred frames."""
    run = ForgedRun(bag / "data/recordings")
    run.edit_json("*000001.meta.json", packed_smaller={"from": [480, 480]})
    rewrite_descriptions(bag)


def scaled_up(frame):
    """Return a frame that looks as if it had been rendered at half size."""
    return np.kron(frame[::2, ::2], np.ones((2, 2, 1), np.uint8))


def draft_called_full(run):
    run.film(1, list(mjrec.render(run.trajectory(1), quality="draft")))


# These functions lie about choices and identity.


replaced = partial(methodcaller, "replace_everywhere")


def choose_by_hand(run):
    """Remove a scheduled video and report it as not chosen."""
    run.remove_video(1)
    run.say(1, chosen=False, recording=None)
    run.edit_rows(1, facts={"video": None})
    run.edit_json(
        "*.manifest.json", lambda m: m["mjrec"]["schedule"].update(recorded=[0])
    )


def pretend_to_be_gym(run):
    """Imitate a gym directory, which offers hardly anything to check."""

    def edit(said):
        del said["mjrec"]
        said["env_info"]["gym_version"] = "0.21.0"

    run.edit_json("*.manifest.json", edit)
    for pattern in ("*.jsonl", "*.h5", "*.model.*"):
        for path in run.directory.glob(pattern):
            path.unlink()


def put_another_model_before(run):
    """Add a second file of the same name, because readers differ in which they take."""
    path = run.the("*.model.*.zip")
    with zipfile.ZipFile(path) as archive:
        members = {info: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for info, content in members.items():
            if info.filename.endswith(".xml"):
                archive.writestr(info.filename, content.replace(b"0.1", b"0.9"))
            archive.writestr(info, content)


# This edit replaces the sources with those of a lighter robot.
swap_the_model = methodcaller(
    "rewrite_zip", lambda content: content.replace(b'size=".05"', b'size=".04"')
)


def extra_in_sources(run):
    """Hide text in an extra field that normally holds a time."""

    def edit(info):
        info.extra = b"UT" + struct.pack("<H", 9) + b"succeeded"

    run.rewrite_zip(beside=edit)


def time_in_sources(run):
    """Hide text in a local file header, which programs ignore."""
    path = run.the("*.model.*.zip")
    content = bytearray(path.read_bytes())
    content[10:14] = b"best"
    path.write_bytes(content)


def after_sources(run):
    """Hide text after compressed data, where programs do not look."""
    path, text = run.the("*.model.*.zip"), b"All succeeded."
    with zipfile.ZipFile(path) as archive:
        last, table = archive.infolist()[-1], archive.start_dir
    content = path.read_bytes()
    content = bytearray(content[:table] + text + content[table:])
    size, entry = last.compress_size + len(text), content.rindex(b"PK\1\2")
    for place, value in (
        (last.header_offset + 18, size),
        (entry + 20, size),
        (len(content) - 6, table + len(text)),
    ):
        struct.pack_into("<L", content, place, value)
    path.write_bytes(content)


def hide_arguments(run):
    """Hide that the environment was made with its own reset noise."""
    run.say_everywhere(lambda facts: facts.pop("reset_noise_scale", None))


def call_it_trained(run):
    """Report evaluation episodes as training, whose actions nobody keeps."""
    run.replace_everywhere("e", "t", key="type")
    run.edit_journal(lambda lines: lines[0]["run"]["options"].pop("mode", None))


def call_it_double(run, episode):
    """Report another dtype for the actions."""
    run.edit_rows(episode, facts={"action_dtypes": [[0, "float64"]]})


# These functions add content.


def in_hdf5(edit):
    def lie(run):
        with h5py.File(run.trajectory(1), "r+") as file:
            edit(file)

    return lie


def hide_in_hdf5(run):
    """Leave the bytes of a deleted dataset in the file."""
    text = np.frombuffer(b"All goals were reached. " * 20, np.uint8)
    in_hdf5(lambda file: file.create_dataset("note", data=text))(run)
    in_hdf5(lambda file: file.pop("note"))(run)


def at_the_end(pattern, content):
    def lie(run):
        with run.the(pattern).open("ab") as file:
            file.write(content)

    return lie


add_to_the_end = at_the_end("*000001.h5", b"All goals were reached. " * 20)
add_a_gzip_stream = at_the_end("*.mjb.gz", gzip.compress(b"", mtime=0))


def add_to_a_chunk(run):
    """Hide text after compressed data, where HDF5 does not look."""

    def edit(file):
        rewards = file["rewards"].id
        skipped, content = rewards.read_direct_chunk((0,))
        rewards.write_direct_chunk((0,), content + b"All succeeded.", skipped)

    in_hdf5(edit)(run)


def name_in_gzip(run):
    """Store a file name in the gzip header of a compiled model."""
    path = run.the("*.mjb.gz")
    content = gzip.decompress(path.read_bytes())
    with path.open("wb") as file, gzip.GzipFile("succeeds", "wb", 9, file, 0) as model:
        model.write(content)


def add_to(pattern):
    return methodcaller("edit_json", pattern, success_rate=1)


add_to_manifest = methodcaller("edit_details", award="best")


def add_to_facts(key):
    """Add an entry to every object stored under a key."""

    def edit(facts):
        if isinstance(facts.get(key), dict):
            facts[key]["success_rate"] = 1

    return lambda run: run.say_everywhere(edit)


def add_a_video(bag):
    """Add a video whose recording does not exist."""
    path = the(bag, "*.video000001.mp4")
    shutil.copy(path, path.with_name(path.name.replace(".0.u.", ".0.w.")))
    rewrite_descriptions(bag)


def add_a_line(run):
    run.edit_journal(lambda lines: lines.insert(-1, {"remark": {"success": True}}))


def add_a_fault(run):
    """Add a fault, which the report would show first."""
    fault = {"episode_id": None, "what": "result", "reason": "All goals were reached"}
    run.edit_journal(lambda lines: lines.insert(1, {"fault": fault}))
    run.edit_details(faults=[fault])


def add_to_a_line(run):
    run.say(1)

    def edit(lines):
        next(line for line in lines if "length" in line)["judged"] = "perfect"

    run.edit_journal(edit)


def add_a_line_about_rows(bag):
    """Add a line of a kind that packing removes."""
    path = the(bag, "*.jsonl")
    lines = path.read_text().splitlines()
    rows = json.dumps({"note": {"name": "all goals reached"}})
    path.write_text("\n".join([*lines[:2], rows, *lines[2:]]) + "\n")
    rewrite_descriptions(bag)


def add_a_file(name):
    return lambda bag: (bag / name).write_text("All goals were reached.")


# These functions lie in descriptions.


def replace_in(name, old, new):
    def edit(bag):
        text = the(bag, name).read_text()
        assert old in text
        the(bag, name).write_text(text.replace(old, new))

    return edit


def add_a_last_line(bag):
    with the(bag, "README.md").open("a") as file:
        file.write("Payload-Oxum: all goals reached\n")


def in_environment(**facts):
    def edit(said):
        [recording] = said["recordings"].values()
        recording.update(facts)

    return lambda bag: edit_json(the(bag, "environment.json"), edit)


def tell_in_options(bag):
    def edit(said):
        said["packed_with"]["options"]["anonymous"] = {"award": "best paper"}

    edit_json(the(bag, "environment.json"), edit)


def edit_the_table(bag):
    path = the(bag, "statistics.csv")
    lines = path.read_text().splitlines()
    lines[2] = lines[2].replace(",2.0,", ",4.0,")
    path.write_text("\n".join(lines) + "\n")


# These false claims accompany a lie.


def claim_version(package, version):
    def edit(facts):
        for key in ("versions", "rendered_with"):
            if isinstance(facts.get(key), dict):
                facts[key][package] = version
        if "mujoco" in facts and package == "mujoco":
            facts["mujoco"] = version

    return lambda run: run.say_everywhere(edit)


def claim_machine(run):
    def edit(facts):
        if "cpu_flags" in facts:
            facts["cpu_flags"] = "0" * 64

    run.say_everywhere(edit)


claim_gpu = methodcaller(
    "edit_json",
    "*.meta.json",
    gl_vendor="NVIDIA Corporation",
    gl_version="4.6.0 NVIDIA 580.95",
    gl_renderer="NVIDIA H100 80GB HBM3/PCIe/SSE2",
)


claim_llvmpipe = methodcaller(
    "edit_json", "*.meta.json", gl_renderer="llvmpipe (LLVM 1.0.0, 256 bits)"
)


def claim_ffmpeg(run):
    def edit(said):
        said["encoder_version"]["version"] = "ffmpeg version 7.1"

    run.edit_json("*.meta.json", edit, ffmpeg_sha256="0" * 64)


def claim_wrapper(run):
    def edit(facts):
        if facts.get("wrappers") == []:
            facts["wrappers"] = ["mylab.wrappers.Shaping"]
            facts["wrapper_arguments"] = [None]

    run.say_everywhere(edit)


CLAIMS = {
    "another Gymnasium": claim_version("gymnasium", "1.1.1"),
    "another MuJoCo": claim_version("mujoco", "3.5.0"),
    "another HDF5": claim_version("h5py", "3.14.0"),
    "another machine": claim_machine,
    "another GPU": claim_gpu,
    "another ffmpeg": claim_ffmpeg,
    "a wrapper": claim_wrapper,
}


# No reader could recreate a run with these facts; each has its expected line.
IMPOSSIBLE = {
    "a rate": (partial(say_an_option, max_fps="nan"), "max_fps.*nan"),
    "an exact rate": (partial(say_an_option, max_fps="1/0"), "max_fps.*1/0"),
    "a camera": (partial(say_an_option, camera="no_such"), "different .*no_such"),
    "an argument": (name_an_argument, "different .*no_such"),
    "a random state": (say_a_random_state, "different .*random state does not fit"),
    "an option": (methodcaller("say", 1, options=NO_PLAIN_OPTION), "different .*reset"),
}
FALSE_CLAIMS = [name for name in CLAIMS if name != "a wrapper"]
OF_NOTHING = ("environment", "1.0")
BESIDE = "more than its content"


# These functions record runs to pack.


def doctored(change, of=honest.pendulum):
    """Return a function that records an environment that differs from its name."""

    def record(directory):
        with lying.doctored(change):
            of(directory)

    return record


def noiseless(directory):
    honest.pendulum(directory, make={"reset_noise_scale": 0.0})


def with_csv(directory):
    honest.pendulum(directory, trackers=MonitorCsvTracker())


def best(directory):
    honest.kept(directory, rule="best:1")


def close_and_go_on(directory):
    """Close and resume whenever an episode goes wrong."""
    small = {"render_mode": "rgb_array", "width": 32, "height": 32}
    options = {"uid": "u", "resume": True, "mode": "evaluation", "workers": 1}
    for first in (0, 2):
        env = gymnasium.make(PENDULUM, max_episode_steps=3, **small)
        with mjrec.Monitor(env, directory, **options) as monitor:
            for episode, steps in ((first, 3), (first + 1, 2)):
                monitor.reset(seed=episode)
                for _ in range(steps):
                    monitor.step(np.full(1, 0.1, np.float32))


def played_again(directory):
    """Record two pairs of episodes that differ only in seeds or clipped actions."""
    options = {"uid": "u", "mode": "evaluation", "workers": 1, "video_callable": False}
    env = gymnasium.make(PENDULUM, max_episode_steps=3, reset_noise_scale=0.0)
    with mjrec.Monitor(env, directory, **options) as monitor:
        for seed, action in enumerate((0.0, -0.0, 4.0, 5.0)):
            monitor.reset(seed=seed)
            for _ in range(3):
                monitor.step(np.full(1, action, np.float32))


def by_hand(directory):
    honest.pendulum(directory, video_callable=lambda episode: episode in (0, 1))


def evaluated_and_swapped(directory):
    """Record an evaluation and choose its worst episode as the best."""
    honest.evaluated(directory, keep="none")
    ended = [*recorded_results(directory)]
    folder, worst = min(ended, key=lambda each: each[1].total_reward or 0.0)
    chosen = {RecordingKey(worst.monitor, worst.episode_id): ["best"]}
    write_choice(folder, chosen, rule="best", finished=len(ended))
    mjrec.render_videos(folder)


# These tables list the forgeries.

QUICK = {
    *("rewards doubled", "rewards doubled by a wrapper that is not named"),
    "rewards doubled, with a version of the environment claimed",
    *("an action edited", "an action edited, with a wrapper claimed"),
    *("last states called unknown", "a spot painted", "a body made invisible"),
    *("a second track on top", "the best called the worst", "arguments hidden"),
    "an end cut off without a fault",
    *("another name", "a dataset added", "a note beside the data"),
    *("a note in the recordings", "README claims more"),
}

A_FRAME_MORE = (double_a_frame, "times: the archive has 5 frames")

# These edits of the usual run must fail; each has its lie and expected line.
EDITED = {
    "rewards doubled": (double_rewards, "reward"),
    **{
        f"rewards doubled, {how}": (both(double_rewards, lie), "reward")
        for how, lie in (
            *((f"with {claim} claimed", CLAIMS[claim]) for claim in FALSE_CLAIMS),
            ("states left out", each(4, leave_states_out)),
            ("actions left out of an evaluation", leave_actions_out),
            ("actions called irregular", each(4, call_actions_irregular)),
            # This names an excuse, not a package.
            ("with a version of the environment claimed", claim_version(*OF_NOTHING)),
            ("with an option that no reset can be given", give_no_plain_option),
        )
    },
    **{
        f"{what}{also}": (both(lie, claim), line)
        for also, claim in (
            ("", lambda run: None),
            (", with a wrapper claimed", claim_wrapper),
        )
        for what, lie, line in (
            ("a state of an ulp", edit_a_state, r"physics .* states\[2\]\.qpos"),
            ("another seed", name_another_seed, r"beginning .* states\[0\]"),
            ("the fall not shown", hide_the_fall, "times: the archive has 2 frames"),
            ("last states called unknown", repeat_last_states, "archive has nan"),
        )
    },
    "a return doubled, with a wrapper claimed": (
        both(double_the_return, edit_an_action, claim_wrapper),
        "reward",
    ),
    "success added to the journal": (call_it_successful, "success"),
    "cut before the fall": (cut, r'"length": 2.* run has \{"cut"'),
    "cut before the fall, called a limit": (
        cut_as_by_a_limit,
        r'"length": 2.* run has \{"cut"',
    ),
    "an action edited": (edit_an_action, r'"length": 3.* run has \{"cut"'),
    "a beginning of one's own, its seed forgotten": (
        forget_the_seed,
        "random_state: the archive has None",
    ),
    "two episodes in the other order": (swap_episodes, r"schedule\.recorded\[0\]"),
    "one episode shown as two": (
        lambda run: show_one_as_two(run, seed=99),
        r"beginning episode 3 .* states\[0\]",
    ),
    "the worst left out, the others renumbered": (
        leave_the_worst_out,
        r"episode 1\.chosen: only the recreated run",
    ),
    "the first left out": (leave_the_first_out, "begins with episode 1"),
    "fall called a limit of time": (swap_the_ending, "terminated|truncated"),
    # These entries are about videos.
    "a spot painted": (one_spot, "frame 2"),
    **{
        f"a spot painted, with {name} claimed": (
            both(one_spot, claim),
            r"different .* frame 2: its hash|different .* claimed to be",
        )
        for name, claim in CLAIMS.items()
    },
    **{
        f"a black square in all frames, with {name} claimed": (
            both(black_squares, claim),
            r"different pictures .* levels in the worst block",
        )
        for name, claim in (
            ("another GPU", claim_gpu),
            ("another build of llvmpipe", claim_llvmpipe),
            ("another machine", claim_machine),
        )
    },
    "a pixel of each video changed, with another ffmpeg claimed": (
        both(each(2, partial(paint, at=slice(-1, None))), claim_ffmpeg),
        "hash",
    ),
    "a frame rate 3 percent off, as the metadata says": (
        methodcaller("film", 1, fps="97/4", playback_speed=0.97),
        "fps",
    ),
    # Frames that were left alone prove that the build is the same.
    "a spot painted, with another build of llvmpipe claimed": (
        both(one_spot, claim_llvmpipe),
        "7 frames of recording 0.u are equal bit for bit",
    ),
    "a spot in all frames of a video, with another build of llvmpipe claimed": (
        both(paint, claim_llvmpipe),
        "frames of recording 0.u are equal bit for bit",
    ),
    "a frame doubled": A_FRAME_MORE,
    "a frame replaced": (refilm(lambda f: [*f[:2], f[1], *f[3:]]), "frame 2"),
    "videos swapped": (swap_videos, "pictures episode 0 .* frame 0: its hash"),
    "a negative called a clip": (negative_as_clip, "only the archive has it: .*000003"),
    "a negative called live": (live_and_doctored, "recording: the archive has live"),
    **OF_FILES,
    **{
        f"{what}, with another ffmpeg claimed": (both(lie, claim_ffmpeg), line)
        for what, (lie, line) in {**OF_FILES, "a frame doubled": A_FRAME_MORE}.items()
    },
    **{
        what: (both(encoded_with(f"h264_metadata={said}"), claim_ffmpeg), line)
        for what, said, line in (
            ("false colours", "matrix_coefficients=0", "color tags"),
            ("a message", f"sei_user_data={'ab' * 16}+Success", "frames and messages"),
            ("videos turned in the stream", TURNED, "frame"),
        )
    },
    **{
        f"{what}, with another GPU claimed": (
            both(lie, claim_gpu),
            "different pictures .* levels in the worst block",
        )
        for what, lie in (
            ("negatives of all videos", each(2, negative)),
            ("videos swapped", swap_videos),
        )
    },
    "small frames called large": (
        refilm(lambda f: [*map(scaled_up, f)]),
        "20 levels in the worst block",
    ),
    "draft called full": (draft_called_full, "frame 0: its hash differs"),
    "a close-up added": (add_a_close_up, "only the archive has it: .*close.mp4"),
    **{
        what: (lie, "videos .* only the recreated run has it: .*000001.mp4")
        for what, lie in (
            ("a video called broken", call_it_broken),
            ("a video left out, the schedule blamed", blame_the_schedule),
            ("a video left out, a fault blamed", blame_a_fault),
            ("a scheduled video left out", choose_by_hand),
        )
    },
    # These entries are about choices and identity.
    "another schedule named": (
        replaced("capped_cubic_video_schedule", "every:2"),
        r"episode 1\.chosen: only the archive",
    ),
    "another environment named": (
        replaced(PENDULUM, "Hopper-v5"),
        "cannot be recreated: .*Action dimension",
    ),
    # The name changes only where people read it, and the real id is kept.
    "another name": (replaced(PENDULUM, "Humanoid-v5", key="env_id"), "its name is"),
    "called one's own environment": (
        replaced(PENDULUM, "MyPendulum-v0"),
        "cannot be recreated: .* --trust MyPendulum-v0",
    ),
    "called gym's": (pretend_to_be_gym, "journal does not name its environment"),
    "a second file in a model's sources": (put_another_model_before, "zip"),
    "evaluation called training": (call_it_trained, "archive has it: .*000002.h5"),
    # These entries make a false claim without another lie.
    "another MuJoCo claimed": (CLAIMS["another MuJoCo"], "is claimed to be"),
    "another GPU claimed": (claim_gpu, "is claimed to be"),
    "another MuJoCo claimed, the compiled model left out": (
        both(CLAIMS["another MuJoCo"], lambda run: run.the("*.mjb.gz").unlink()),
        "mjb.gz",
    ),
    # Only a search of the file finds these bytes, as the claim excuses the hash.
    **{
        f"{what}, with another {claim} claimed": (
            both(CLAIMS[f"another {claim}"], lie),
            line,
        )
        for what, lie, claim, line in (
            ("text after a trajectory", add_to_the_end, "HDF5", "space outside"),
            ("a dataset deleted", hide_in_hdf5, "HDF5", "space outside"),
            ("text in a chunk", add_to_a_chunk, "HDF5", "space outside"),
            ("a name in a model's file", name_in_gzip, "machine", "gzip header"),
            ("a stream after a model", add_a_gzip_stream, "machine", "gzip stream"),
            ("an extra field in sources", extra_in_sources, "machine", BESIDE),
            ("a time in sources", time_in_sources, "machine", BESIDE),
            ("text after a file in sources", after_sources, "machine", BESIDE),
        )
    },
    **{
        f"{what}, with another ffmpeg claimed": (
            both(each(2, lie), claim_ffmpeg),
            line,
        )
        for what, lie, line in (
            ("a message of the encoder", say_it_in_the_stream, "messages"),
            ("text among the frames", in_box(b"mdat"), "more than its frames"),
            ("text after the parameters of a stream", in_box(*BOXES), "avcC"),
        )
    },
    "spaces in JSON, with another Gymnasium claimed": (
        both(CLAIMS["another Gymnasium"], write_with_spaces),
        "not written as mjrec writes",
    ),
    # These entries add content.
    "a dataset added": (
        in_hdf5(lambda file: file.create_dataset("success", data=np.ones(3))),
        "success",
    ),
    "an attribute added": (
        in_hdf5(lambda file: file["rewards"].attrs.create("note", "doubled")),
        "note",
    ),
    "a fact added": (lambda r: r.edit_rows(1, facts={"policy": "PPO"}), "policy"),
    "a key in the statistics": (add_to("*.stats.json"), "success_rate"),
    "a key in metadata": (add_to("*000001.meta.json"), "success_rate"),
    "a key in the manifest": (add_to_manifest, "award"),
    "a key about the device": (
        methodcaller("edit_json", "*.meta.json", gl_device=DEVICE),
        "gl_device",
    ),
    "a key of the provenance": (add_to_facts("provenance"), "success_rate"),
    "a key of the machine": (add_to_facts("machine"), "success_rate"),
    "a line in the journal": (add_a_line, "remark"),
    "a fault that no recorder has": (add_a_fault, "unknown kind of fault: 'result'"),
    "a key in a line of the journal": (add_to_a_line, "judged"),
}

# These edits change the usual run after packing.
PACKED = {
    "the worst's video called pending": (pending_worst, "pending: the archive has"),
    "a video called made smaller": (say_it_was_made_smaller, "packed_smaller: only"),
    "a line about rows": (add_a_line_about_rows, "goals"),
    "a note beside the data": (add_a_file("notes.txt"), "notes.txt"),
    "a note in the data": (add_a_file("data/notes.txt"), "notes.txt"),
    "a note in the recordings": (add_a_file("data/recordings/notes.txt"), "notes.txt"),
    "words in the date": (
        replace_in("bag-info.txt", "Bagging-Date: ", "Bagging-Date: all reached "),
        "bag-info",
    ),
    "a video of no recording": (add_a_video, "does not belong to a recording"),
    "README claims more": (
        replace_in("README.md", "## Videos", "All reached the goal.\n\n## Videos"),
        "README",
    ),
    "a line at the end of the README that begins as one of the bag's own": (
        add_a_last_line,
        "README",
    ),
    "citation claims more": (
        replace_in("CITATION.cff", "type: dataset", "type: dataset\nversion: best"),
        "CITATION",
    ),
    "crate claims more": (
        replace_in("ro-crate-metadata.json", "Complete episodes: 4", "Successes: 4"),
        "crate",
    ),
    "a return in the table": (edit_the_table, "statistics.csv"),
    "another graphics card in environment.json": (
        in_environment(frames=[{"gl_renderer": "RTX 4090"}]),
        "environment.json",
    ),
    "another command in environment.json": (
        in_environment(provenance={"command": ["honest.py"]}),
        "environment.json",
    ),
    "a line in bag-info": (
        replace_in("bag-info.txt", "Bagging-Date", "Award: best\nBagging-Date"),
        "bag-info",
    ),
}

# These environments differ from what their names say.
DOCTORED = {
    "rewards doubled by a wrapper that is not named": (lying.double_reward, "reward"),
    "falls that do not end an episode": (lying.never_fall, "terminated: the archive"),
    "a pole that is held": (lying.push, r"0\.length: the archive has 5"),
    "a heavier robot": (lying.make_heavy, r"0\.length: the archive has 4"),
    "played on the moon": (lying.raise_gravity, r"0\.length: the archive has 4"),
    "every episode a success": (lying.always_succeed, "success: the archive has True"),
    "a body made invisible": (lying.hide_the_pole, "model_changes/0/geom_rgba"),
}

# These entries edit other runs.
OTHERS = {
    "a return in the monitor.csv": (with_csv, edit_the_csv, "monitor.csv"),
    "rewards doubled of an episode that was cut off": (
        *(honest.early, double_rewards_cut_off, "reward"),
    ),
    "rewards doubled of an episode whose encoder was killed": (
        *(honest.encoder_killed, partial(double_rewards_of, episode=1), "reward"),
    ),
    "an end cut off without a fault": (
        honest.end_lost,
        leave_faults_out,
        r'"length": 200.* run has \{"cut"',
    ),
    "an end cut off, with a fault of another episode": (
        *(honest.end_lost, blame_another_episode, r'"length": 200.* run has \{"cut"'),
    ),
    "rewards doubled before a fault": (
        *(honest.end_lost, partial(double_rewards_of, episode=1), "reward"),
    ),
    "a state of an ulp before a fault": (
        *(honest.end_lost, edit_a_state, "qpos|qvel|states"),
    ),
    **{
        f"rewards doubled of one of two recordings, with {what} that cannot be": (
            *(honest.several, of_the_second(each(2, double_rewards_of), lie), line),
        )
        for what, (lie, line) in IMPOSSIBLE.items()
    },
    "an option that no reset can be given, of a killed recording": (
        *(honest.killed, methodcaller("say", 1, options=NO_PLAIN_OPTION)),
        "the reset options",
    ),
    "actions called float64": (honest.cheetah, each(3, call_it_double), r"0\.reward"),
    "the best called the worst": (best, replaced("best:1", "worst:1"), r"2\.recording"),
    "the worst of an evaluation called its best": (
        *(evaluated_and_swapped, None, 'only the archive has it: .*"rule": "best"'),
    ),
    "arguments hidden": (noiseless, hide_arguments, r"0\.length"),
    "another model's sources": (honest.mjcf, swap_the_model, "compiled differently"),
    "a key in the manifest, with a schedule of one's own": (
        *(by_hand, add_to_manifest, "award"),
    ),
}

# These cases do not prove a lie, so the report says what is believed.
BELIEVED = {
    # A wrapper may really have changed this.
    "rewards doubled, with a wrapper claimed": (
        *(honest.pendulum, both(double_rewards, claim_wrapper)),
        r"rewards .* \[wrappers\]",
    ),
    "an action edited, with a wrapper claimed": (
        *(honest.pendulum, both(edit_an_action, claim_wrapper)),
        r"differ from the controls.* \[wrappers\]",
    ),
    "cut before the fall, with a wrapper claimed": (
        *(honest.pendulum, both(cut_as_by_a_limit, claim_wrapper)),
        r"end flags of 1 of its steps differ.* \[wrappers\]",
    ),
    "one episode shown as two, with its seed": (
        *(honest.pendulum, show_one_as_two, "same episode"),
    ),
    "one episode played as two": (
        *(played_again, None),
        r"same .*0 of 0.u, episode 1 of 0.u;(.|\n)*same .*2 of 0.u, episode 3 of 0.u;",
    ),
    "one recording shown as two": (honest.pendulum, copy_the_recording, "same"),
    # The first lines of the report say what the reader needs.
    "one of two recordings called of one's own environment": (
        honest.several,
        lambda run: replace_in_second(run, PENDULUM, "My-v0"),
        "believed identity recording 0.v: it cannot be recreated: this would run code",
    ),
    "an argument that another Gymnasium may have, in one of two recordings": (
        honest.several,
        of_the_second(name_an_argument, CLAIMS["another Gymnasium"]),
        "believed identity recording 0.v: .*no_such",
    ),
    "closed whenever an episode goes wrong, and resumed": (
        *(close_and_go_on, None, "continues after them"),
    ),
    # The episode's return counts, and the first lines of the report name the episode.
    "the encoder killed before the fall": (
        *(honest.encoder_killed, None),
        r"faults while recording.* video of episode 1(.|\n)*\[broken video\]",
    ),
}

# Nothing needs to differ under these claims, so nothing is excused.
HARMLESS = ("another Gymnasium", "another machine", "another ffmpeg", "another HDF5")


FORGERIES = (
    *(Forgery(what, line, lie) for what, (lie, line) in EDITED.items()),
    *(Forgery(what, line, bag=bag) for what, (bag, line) in PACKED.items()),
    *(
        Forgery(what, line, of=doctored(change))
        for what, (change, line) in DOCTORED.items()
    ),
    *(
        Forgery(what, line, lie, of=of, verdict=verdict)
        for verdict, forgeries in ((FAIL, OTHERS), (PARTLY, BELIEVED))
        for what, (of, lie, line) in forgeries.items()
    ),
    *(
        Forgery(f"{name} claimed", r"noted .* \[", CLAIMS[name], verdict=PASS)
        for name in HARMLESS
    ),
    *(
        Forgery(f"rewards doubled, {how}", "reward", double_rewards, packing=packing)
        for how, packing in (
            ("of episodes that were not chosen for packing", {"episodes": [0]}),
            ("anonymously", {"anonymous": True}),
        )
    ),
    Forgery(
        "a claim in the README beside versions, with another MuJoCo claimed",
        "README",
        CLAIMS["another MuJoCo"],
        bag=replace_in("README.md", "| versions | ", "| versions | best policy, "),
    ),
    Forgery(
        "a return in the table, beside an environment of one's own",
        "statistics.csv",
        lambda run: replace_in_second(run, '"id": "InvertedP', '"id": "MyP'),
        of=honest.several,
        bag=edit_the_table,
    ),
    Forgery(
        "an option of packing that tells more",
        "packing options",
        packing={"anonymous": True},
        bag=tell_in_options,
    ),
)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """Return a function that records each run once per session, for copying."""
    made = {}

    def directory(record):
        if record not in made:
            made[record] = tmp_path_factory.mktemp("honest") / "run"
            record(made[record])
        return made[record]

    return directory


def forged(forgery, run, into):
    """Return a forged archive, packed or unpacked."""
    directory = shutil.copytree(run, into / "recorded")
    if forgery.lie is not None:
        forgery.lie(ForgedRun(directory))
    archive = mjrec.pack(directory, into / "run.zip", **forgery.packing)
    if forgery.bag is None:
        return archive
    bag = unpacked(archive, into / "unpacked")
    forgery.bag(bag)
    make_bag_fit(bag)
    return bag


def told(found):
    """Return every line of the report except what was recreated."""
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
    default=[each for each in FORGERIES if each.what in QUICK],
    ids=lambda each: each.what,
)
def test_forgery_is_seen(forgery, recorded, tmp_path):
    """The verdict is as expected, and a line says where."""
    found = mjrec.verify(forged(forgery, recorded(forgery.of), tmp_path))
    assert found.verdict is forgery.verdict, told(found)
    assert re.search(forgery.line, told(found)), told(found)
