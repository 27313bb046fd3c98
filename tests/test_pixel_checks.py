# SPDX-License-Identifier: Apache-2.0
"""Verifying the pixels of a run: honest ones pass, and each forgery is caught.

What a forger can do is done here to a copy of an honest recording: every hash that
anybody could make fit is made to fit.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from forged_videos import drawn, forge, metadata, say, video
from parts import parametrize

import mjrec
from conftest import Corridor, run_episodes
from mjrec.evidence.verification import Check, Verdict
from mjrec.evidence.verifying.pixel_checks import check_pixels
from mjrec.evidence.verifying.task import Task
from mjrec.gl import probe

STEPS = 6
DECODES, PACED, DRAWN, ENCODED, ALIKE = range(5)
CLAIMS = (
    "the video decodes to the recorded number of frames and to their hash",
    "each frame of the video is shown for as long as was recorded",
    "the pictures drawn from the recorded snapshots have the shipped hashes",
    "encoding the drawn pictures again gives the shipped file",
    "the shipped frames show the pictures drawn",
)
PASS, FAIL, OPEN = Verdict.PASS, Verdict.FAIL, Verdict.NOT_CHECKABLE


def is_gpu() -> bool:
    return not probe("egl").software


needs_mesa = pytest.mark.skipif(
    "is_gpu()", reason="only Mesa has another rasteriser to choose"
)


def record(directory: Path, *, episodes: int = 1, **options: Any) -> Path:
    """Record episodes of a small HalfCheetah, and render their videos."""
    size: dict[str, Any] = {"height": 48, "width": 64}
    settings = {"episodes": "all", "uid": "u", **options}
    if options.get("render") == "live":
        made = gymnasium.make(
            "HalfCheetah-v5",
            max_episode_steps=STEPS,
            render_mode="rgb_array",
            **size,
        )
    else:
        made = gymnasium.make("HalfCheetah-v5", max_episode_steps=STEPS)
        settings = {**size, **settings}
    if settings.pop("episodes") == "all":
        settings["video_callable"] = lambda episode: True
    with mjrec.Monitor(made, directory, **settings) as env:
        for episode in range(episodes):
            env.reset(seed=episode)
            for _ in range(STEPS):
                env.step(np.full(6, 0.9 - episode, np.float32))
    return directory


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of two episodes, which nobody changes."""
    return record(tmp_path_factory.mktemp("honest") / "run", episodes=2)


@pytest.fixture
def run(honest: Path, tmp_path: Path) -> Path:
    """A copy of it, for forgers."""
    return Path(shutil.copytree(honest, tmp_path / "run"))


@pytest.fixture
def alone(run: Path) -> Path:
    """A copy with the first episode's video only, which takes less time."""
    for path in [*run.glob("*.video000001.*"), *run.glob("*.episode000001.*")]:
        path.unlink()
    return run


def checks_of(directory: Path, **options: Any) -> list[Check]:
    task = Task(recordings=directory, **options)
    return list(check_pixels(task, lambda done, total: None))


def found(directory: Path, **options: Any) -> dict[tuple[int, int], Check]:
    """Return the checks by the episode's number and the claim's."""
    return {
        (_episode(check), CLAIMS.index(check.claim)): check
        for check in checks_of(directory, **options)
    }


def _episode(check: Check) -> int:
    return int(re.findall(r"video(\d{6})", check.subject)[0])


def verdicts(directory: Path, episode: int = 0, **options: Any) -> list[Verdict]:
    """Return what became of each claim about an episode's video."""
    checks = found(directory, **options)
    return [check.verdict for (number, _), check in checks.items() if number == episode]


# Takes more than five seconds: its fixture records what all tests of the file read.
def test_an_honest_run_passes(honest: Path) -> None:
    """Bit for bit and byte for byte, on the machine that recorded it."""
    checks = found(honest)
    assert len(checks) == 10
    assert {check.verdict for check in checks.values()} == {PASS}
    assert checks[1, DRAWN].reason == "7 frames, bit for bit"
    assert checks[1, ENCODED].reason == "7 frames, byte for byte"
    assert checks[1, ALIKE].figures["psnr"] > 36


@pytest.mark.thorough
def test_progress_is_told(honest: Path) -> None:
    """Frame by frame, to the end."""
    told: list[tuple[int, int]] = []
    list(check_pixels(Task(recordings=honest), lambda *done: told.append(done)))
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert {total for _, total in told} == {14}
    assert told[-1] == (14, 14)


@pytest.mark.thorough
def test_nothing_is_written_into_the_recordings(honest: Path, tmp_path: Path) -> None:
    """Whatever is made again is made elsewhere."""

    def state() -> list[tuple[str, int, bytes]]:
        paths = sorted(honest.iterdir())
        return [(p.name, p.stat().st_mtime_ns, p.read_bytes()) for p in paths]

    before = state()
    (tmp_path / "pictures").mkdir()
    checks_of(honest, pictures=tmp_path / "pictures")
    assert state() == before


def one_pixel(frames: list[Any]) -> list[Any]:
    """Return frames with one pixel of one of them a little brighter."""
    changed = [frame.copy() for frame in frames]
    changed[3][20, 30] ^= 64
    return changed


# Takes more than five seconds: all videos are drawn again.
def test_one_pixel_changed_with_every_hash_made_to_fit(run: Path) -> None:
    """The drawn picture has another hash, and is encoded to another file."""
    forge(video(run), one_pixel(drawn(run)))
    checks = found(run)
    assert [checks[0, claim].verdict for claim in range(4)] == [PASS, PASS, FAIL, FAIL]
    assert "1 of 7 drawn have other hashes: 3" in checks[0, DRAWN].reason
    assert verdicts(run, 1) == [PASS] * 5


@pytest.mark.thorough
def test_one_pixel_changed_in_the_video_alone(alone: Path) -> None:
    """The frames' hashes are true, and the file is not what they are encoded to."""
    forge(video(alone), one_pixel(drawn(alone)), hashes=False)
    assert verdicts(alone)[:4] == [PASS, PASS, PASS, FAIL]


@parametrize(
    "change",
    [lambda f: f[:2] + f[3:], lambda f: [*f[:2], f[2], *f[2:]], lambda f: f[:-1]],
    ids=["dropped", "doubled", "last dropped"],
)
def test_a_frame_dropped_or_doubled(alone: Path, change: Callable[..., Any]) -> None:
    """The trajectory has another number of pictures."""
    forge(video(alone), change(drawn(alone)))
    checks = found(alone)
    assert checks[0, DECODES].verdict is PASS
    assert checks[0, DRAWN].verdict is FAIL
    assert "its trajectory has 7 pictures" in checks[0, DRAWN].reason


@pytest.mark.thorough
def test_a_frame_in_the_place_of_another(alone: Path) -> None:
    """One is dropped and another doubled, so that their number stays."""
    frames = drawn(alone)
    forge(video(alone), [*frames[:2], frames[1], *frames[3:]])
    checks = found(alone)
    assert "other hashes: 2;" in checks[0, DRAWN].reason
    assert checks[0, ENCODED].verdict is FAIL


@pytest.mark.thorough
def test_videos_swapped_between_episodes(run: Path) -> None:
    """Both show another episode than their names say."""
    for ending in (".mp4", ".framehash", ".meta.json"):
        one, other = (video(run, n).with_suffix(ending) for n in (0, 1))
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)
    for episode in (0, 1):
        assert verdicts(run, episode) == [PASS, PASS, FAIL, FAIL, FAIL]


@pytest.mark.thorough
def test_a_video_relabelled_as_another_episodes(run: Path) -> None:
    """The best episode's video as that of the first, its own metadata kept."""
    for ending in (".mp4", ".framehash"):
        content = video(run, 1).with_suffix(ending).read_bytes()
        video(run, 0).with_suffix(ending).write_bytes(content)
    said = metadata(video(run, 1))
    say(video(run, 0), decoded_sha256=said["decoded_sha256"])
    assert verdicts(run, 0) == [PASS, PASS, FAIL, FAIL, FAIL]
    assert verdicts(run, 1) == [PASS] * 5


@pytest.mark.thorough
def test_who_names_another_driver_is_left_with_little_room(alone: Path) -> None:
    """What the driver is said to have been changes no verdict about a sprite."""
    frames = [frame.copy() for frame in drawn(alone)]
    frames[4][8:11, 8:11] = (255, 0, 0)
    forge(video(alone), frames)
    say(video(alone), gl_renderer="NVIDIA H200/PCIe/SSE2")
    checks = found(alone)
    assert checks[0, DRAWN].verdict is OPEN
    assert "NVIDIA H200" in checks[0, DRAWN].reason
    assert checks[0, ENCODED].verdict is OPEN
    assert checks[0, ALIKE].verdict is FAIL
    assert checks[0, ALIKE].figures["worst_frame"] == 4


@pytest.mark.thorough
@needs_mesa
def test_the_same_software_on_another_cpu_may_differ_by_roundings(alone: Path) -> None:
    """What a CPU of another maker draws has other bits, and is no forgery."""
    changed = [frame ^ np.uint8(1) for frame in drawn(alone)]
    forge(video(alone), changed)
    say(video(alone), machine={"architecture": "x86_64", "cpu_flags": "0" * 64})
    assert verdicts(alone) == [PASS, PASS, OPEN, OPEN, PASS]
    painted = [frame.copy() for frame in changed]
    # Fainter than what another driver might differ.
    painted[4][8:16, 8:16] = np.minimum(painted[4][8:16, 8:16], 219) + np.uint8(36)
    forge(video(alone), painted)
    assert verdicts(alone) == [PASS, PASS, OPEN, OPEN, FAIL]


@pytest.mark.thorough
@needs_mesa
def test_an_honest_video_that_another_driver_drew(
    alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mesa's other rasteriser draws otherwise, and near enough; the room is stated."""
    monkeypatch.setenv("GALLIUM_DRIVER", "softpipe")
    checks = found(alone)
    assert [checks[0, claim].verdict for claim in (DRAWN, ENCODED, ALIKE)] == [
        OPEN,
        OPEN,
        PASS,
    ]
    assert "softpipe" in checks[0, DRAWN].reason
    assert "not noticed would be" in checks[0, ALIKE].reason
    assert checks[0, ALIKE].figures["unnoticed_square"] < 4


@pytest.mark.thorough
def test_a_shadow_of_another_driver_is_no_forgery(alone: Path) -> None:
    """Where only the light differs nobody can tell, in a small part of a picture."""
    for side, verdict in ((10, OPEN), (16, FAIL)):
        # As another driver draws: no picture is the same to the last bit.
        frames = [frame ^ np.uint8(1) for frame in drawn(alone)]
        frames[4][4 : 4 + side, 8 : 8 + side] //= 8
        forge(video(alone), frames)
        say(video(alone), gl_renderer="a card that is not here")
        checks = found(alone)
        assert checks[0, ALIKE].verdict is verdict
        assert ("in shadow" in checks[0, ALIKE].reason) is (verdict is OPEN)


@pytest.mark.thorough
def test_a_shadow_of_the_same_driver_is_a_forgery(alone: Path) -> None:
    """What drew the pictures draws the same shadows again."""
    frames = [frame.copy() for frame in drawn(alone)]
    frames[4][4:14, 8:18] //= 8
    forge(video(alone), frames)
    assert verdicts(alone)[ALIKE] is FAIL


@pytest.mark.thorough
@needs_mesa
def test_another_pose_is_noticed_with_another_driver(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other episode's pictures are beyond what a driver may differ."""
    forge(video(run), drawn(run, 1))
    monkeypatch.setenv("GALLIUM_DRIVER", "softpipe")
    assert verdicts(run) == [PASS, PASS, OPEN, OPEN, FAIL]


@pytest.mark.thorough
def test_an_honest_video_of_another_encoder(run: Path) -> None:
    """Other bytes of the same pictures pass by their likeness, with the reason."""
    arguments = metadata(video(run))["encoder_version"]
    forge(video(run), drawn(run), crf=17)
    say(video(run), ffmpeg_sha256="0" * 64, encoder_version=arguments)
    checks = found(run)
    assert [checks[0, claim].verdict for claim in (DRAWN, ENCODED, ALIKE)] == [
        PASS,
        OPEN,
        PASS,
    ]
    assert "another ffmpeg encoded it" in checks[0, ENCODED].reason
    # Who was that very ffmpeg has to make the very bytes.
    say(video(run), ffmpeg_sha256=metadata(video(run, 1))["ffmpeg_sha256"])
    assert verdicts(run) == [PASS, PASS, PASS, FAIL, PASS]


def test_a_command_line_of_the_archive_is_not_run(alone: Path, tmp_path: Path) -> None:
    """It is compared, and where it is another one, that is said."""
    marker = tmp_path / "ran"
    said = metadata(video(alone))["encoder_version"]
    said["cmdline"] = [*said["cmdline"][:-1], "-y", f"file:{marker}"]
    say(video(alone), encoder_version=said)
    checks = found(alone)
    assert checks[0, ENCODED].verdict is OPEN
    assert "is not run" in checks[0, ENCODED].reason
    assert not marker.exists()


@pytest.mark.thorough
def test_a_sample_is_drawn_from_its_seed(alone: Path) -> None:
    """So many frames of each video, the same each time; the rest is said."""
    checks = found(alone, sample=2, seed=5)
    assert [checks[0, claim].verdict for claim in (DRAWN, ENCODED, ALIKE)] == [
        PASS,
        OPEN,
        PASS,
    ]
    assert checks[0, DRAWN].reason == "2 of 7 frames, bit for bit"
    assert "leave --sample out" in checks[0, ENCODED].reason
    assert found(alone, sample=2, seed=5) == checks
    assert found(alone, sample=2, seed=6) != checks


@pytest.mark.thorough
def test_a_sample_of_all_frames_is_no_sample(alone: Path) -> None:
    """Also where more are asked for than there are."""
    assert verdicts(alone, sample=100) == [PASS] * 5


@pytest.mark.thorough
def test_the_frame_that_differs_most_is_shown(alone: Path, tmp_path: Path) -> None:
    """As drawn, as shipped, and how they differ."""
    frames = [frame.copy() for frame in drawn(alone)]
    frames[4][8:24, 8:24] = (255, 0, 0)
    forge(video(alone), frames)
    checks = found(alone, pictures=tmp_path)
    shown = tmp_path / checks[0, ALIKE].figures["picture"]
    assert shown.read_bytes().startswith(b"\x89PNG")
    assert checks[0, ALIKE].figures["worst_frame"] == 4


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "videos"),
    [
        ({"camera": ["track", -1]}, 2),
        ({"camera": ["track", -1], "tiled": True}, 1),
        ({"annotate": True}, 1),
        ({"quality": "draft", "height": 33, "width": 47}, 1),
        ({"max_fps": 7}, 1),
    ],
    ids=["two cameras", "tiled", "annotated", "draft and odd", "strided"],
)
def test_every_kind_of_video_is_drawn_again(
    tmp_path: Path, options: dict[str, Any], videos: int
) -> None:
    """With its cameras, captions, quality, size and rate."""
    checks = checks_of(record(tmp_path / "run", **options))
    assert len(checks) == 5 * videos
    assert {check.verdict for check in checks} == {PASS}


@pytest.mark.thorough
def test_a_video_rendered_again_beside_the_original(alone: Path) -> None:
    """It shows what its metadata says, of the recorded pictures."""
    view: dict[str, Any] = {"camera": -1, "height": 24, "width": 32}
    rendered = mjrec.render_videos(min(alone.glob("*.h5")), **view, max_fps=10)
    [name] = rendered.videos
    checks = [check for check in checks_of(alone) if check.subject == name]
    assert [check.verdict for check in checks] == [PASS] * 5


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options",
    [{}, {"annotate": True}],
    ids=["alone", "annotated"],
)
def test_a_live_video_of_a_known_environment_shows_its_snapshots(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    """It is drawn from them, whatever was said of when it was drawn."""
    run = record(tmp_path / "run", render="live", **options)
    assert verdicts(run) == [PASS] * 5
    forge(video(run), [255 - frame for frame in drawn(run)])
    assert FAIL in verdicts(run)


class Bar(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Draws on the pictures."""

    def render(self) -> Any:
        frame = np.array(self.env.render())
        frame[:4] = 255
        return frame


@pytest.mark.thorough
@pytest.mark.parametrize("render", [None, "live"])
def test_a_live_video_may_show_what_wrappers_draw(
    tmp_path: Path, render: str | None
) -> None:
    """No failure: the reason names the wrapper."""
    made = gymnasium.make(
        "HalfCheetah-v5",
        max_episode_steps=2,
        render_mode="rgb_array",
        height=48,
        width=64,
    )
    with mjrec.Monitor(
        Bar(made), tmp_path / "run", mode="evaluation", render=render
    ) as env:
        run_episodes(env, 1)
    checks = found(tmp_path / "run")
    assert [checks[0, claim].verdict for claim in range(5)] == [PASS] * 2 + [OPEN] * 3
    assert "Bar" in checks[0, DRAWN].reason


@pytest.mark.thorough
def test_a_video_that_plays_at_another_speed(alone: Path) -> None:
    """The frames are the same, and the time of each is another."""
    forge(video(alone), drawn(alone), fps=30)
    checks = found(alone)
    assert checks[0, DECODES].verdict is PASS
    assert checks[0, PACED].verdict is FAIL
    assert "30 frames a second" in checks[0, PACED].reason


@pytest.mark.thorough
def test_a_video_whose_rate_an_older_version_rounded(alone: Path) -> None:
    """It plays at the usual rate next to the recorded one, and nobody is to blame."""
    forge(video(alone), drawn(alone), fps=Fraction(201, 10), hashes=False)
    encoder = metadata(video(alone))["encoder_version"]
    old = ["-framerate" if each == "-r" else each for each in encoder["cmdline"]]
    say(video(alone), encoder_version={**encoder, "cmdline": old})
    assert verdicts(alone) == [PASS, OPEN, PASS, OPEN, PASS]


@pytest.mark.thorough
def test_a_video_of_an_older_version_is_encoded_again(alone: Path) -> None:
    """What it told ffmpeg of the rate has given the same file."""
    encoder = metadata(video(alone))["encoder_version"]
    old = ["-framerate" if each == "-r" else each for each in encoder["cmdline"]]
    say(video(alone), encoder_version={**encoder, "cmdline": old})
    assert verdicts(alone) == [PASS] * 5


def test_a_live_video_that_is_counted_in_steps(tmp_path: Path) -> None:
    """It is of no episode, so it fits none."""
    run = record(tmp_path / "run", mode="evaluation", render="live", video_length=3)
    checks = found(run)
    assert checks[0, DRAWN].verdict is OPEN
    assert "counted in steps" in checks[0, DRAWN].reason


def test_a_video_without_a_simulation(tmp_path: Path) -> None:
    """There is no trajectory to draw from."""
    with mjrec.Monitor(Corridor(), tmp_path / "run") as env:
        run_episodes(env, 1)
    assert verdicts(tmp_path / "run") == [PASS, PASS, OPEN, OPEN, OPEN]


def test_a_text_recording_has_no_pixels(tmp_path: Path) -> None:
    """It is said, and nothing fails."""
    with mjrec.Monitor(Corridor(render_mode="ansi"), tmp_path / "run") as env:
        run_episodes(env, 1)
    [check] = checks_of(tmp_path / "run")
    assert (check.verdict, "recording of text" in check.reason) == (OPEN, True)


@pytest.mark.parametrize("said", [{"broken": True, "empty": True}, {}])
def test_metadata_without_a_video(alone: Path, said: dict[str, Any]) -> None:
    """A video that broke is said to have; one that is gone is missed."""
    say(video(alone), **said)
    video(alone).unlink()
    [check] = [check for (number, _), check in found(alone).items() if number == 0]
    assert check.verdict is (OPEN if said else FAIL)


@pytest.mark.thorough
def test_a_model_that_is_missing_or_a_strangers(
    alone: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without its sources nothing is drawn, and that is said."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "stranger"))
    assert verdicts(alone) == [PASS] * 5
    for path in alone.glob("*.zip"):
        path.unlink()
    checks = found(alone)
    assert [checks[0, claim].verdict for claim in range(5)] == [PASS] * 2 + [OPEN] * 3
    assert "is not loaded" in checks[0, DRAWN].reason


@pytest.mark.parametrize("damage", ["snapshots", "cut"])
def test_a_damaged_trajectory_is_no_excuse(alone: Path, damage: str) -> None:
    """Who damages what the pictures follow from has not made the checks vanish."""
    [path] = alone.glob("*.episode000000.h5")
    content = path.read_bytes()
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    else:
        import h5py

        with h5py.File(path, "r+") as file:
            values = file["snapshots"][...]
            del file["snapshots"]
            file["snapshots"] = values[:-1]
    assert found(alone)[0, DRAWN].verdict is FAIL


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-700])


def _garbage(path: Path) -> None:
    path.write_bytes(b"\x00\x01" * 4000)


def _list_of_files(path: Path) -> None:
    path.write_text("ffconcat version 1.0\nfile /etc/passwd\n")


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _link(path: Path) -> None:
    outside = path.parent.parent / "outside.mp4"
    path.rename(outside)
    path.symlink_to(outside)


@pytest.mark.thorough
@pytest.mark.parametrize("damage", [_cut, _garbage, _list_of_files, _empty, _link])
def test_what_is_no_video_is_a_failure(
    run: Path, damage: Callable[[Path], None]
) -> None:
    """Told, not raised; and the other video is checked."""
    damage(video(run))
    assert verdicts(run)[0] is FAIL
    assert verdicts(run, 1) == [PASS] * 5


@pytest.mark.parametrize(
    "said",
    [
        {"width": 48, "height": 64},
        {"width": 10**9},
        {"width": "64"},
        {"frame_count": 8},
        {"frame_count": 10**15},
        {"fps": "1e20000000"},
        {"fps": "19"},
        {"decoded_sha256": "0" * 64},
        {"decoded_sha256": None},
        {"frame_steps": [[0, 5], [7, 7]]},
        {"quality": "draft"},
        {"encoder_version": []},
        {"stride": 0},
        {"camera": {"type": []}, "gl_vendor": [1]},
    ],
    ids=lambda said: "-".join(f"{k}={str(v)[:9]}" for k, v in said.items()),
)
def test_metadata_that_says_something_else_is_a_failure(
    alone: Path, said: dict[str, Any]
) -> None:
    """Whatever it says, it is a check that fails and no error."""
    say(video(alone), **said)
    assert FAIL in verdicts(alone)


@parametrize("change", ["missing", "short", "foreign", "long"])
def test_frame_hashes_that_are_none(alone: Path, change: str) -> None:
    """A file that lacks lines, has more, or is something else."""
    path = video(alone).with_suffix(".framehash")
    lines = path.read_text().splitlines(keepends=True)
    if change == "missing":
        path.unlink()
    else:
        changed = {"short": lines[:-1], "foreign": ["x\n"], "long": [*lines, lines[-1]]}
        path.write_text("".join(changed[change]))
    assert found(alone)[0, DRAWN].verdict is FAIL


def test_where_nothing_can_be_drawn(
    honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What needs no drawing is checked, and the rest says why not."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere.json")
    for episode in (0, 1):
        assert verdicts(honest, episode) == [PASS, PASS, OPEN, OPEN, OPEN]
