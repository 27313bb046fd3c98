# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging
import re
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import gymnasium
import numpy as np
import pytest
from recordings import frames_of

from mjrec import InvalidArgument, VideoRecorder


def metadata_of(recorder: VideoRecorder) -> dict[str, Any]:
    assert recorder.metadata_path is not None
    content: dict[str, Any] = json.loads(Path(recorder.metadata_path).read_text())
    return content


def record(recorder: VideoRecorder, env: Any, steps: int) -> dict[str, Any]:
    env.reset()
    recorder.capture_frame()
    for _ in range(steps):
        env.step(env.action_space.sample())
        recorder.capture_frame()
    recorder.close()
    return metadata_of(recorder)


class Pictures:
    """Gives a list of things as pictures."""

    render_mode = "rgb_array"
    metadata = {"render_fps": 5}  # noqa: RUF012  as environments have it

    def __init__(self, *pictures: Any) -> None:
        self.pictures = list(pictures)

    def render(self) -> Any:
        return self.pictures.pop(0)


def picture(height: int = 8, width: int = 10) -> Any:
    return np.full((height, width, 3), 90, np.uint8)


def picture_of(number: int) -> Any:
    return np.full((16, 16, 3), 25 * number, np.uint8)


def number_of(frame: Any) -> int:
    return round(float(frame.mean()) / 25)


def test_every_capture_is_a_frame(corridor: Any, tmp_path: Path) -> None:
    """The reset's frame and the last one are in the file, in order."""
    recorder = VideoRecorder(corridor, tmp_path / "v.mp4")
    metadata = record(recorder, corridor, 3)
    shown = [int((frame[0, :, 0] > 128).sum()) for frame in frames_of(recorder.path)]
    assert shown == [4, 8, 12, 16]
    assert metadata["frame_count"] == 4
    assert metadata["frame_steps"] == [[0, 3]]
    assert metadata["content_type"] == "video/mp4"
    assert recorder.functional
    assert not recorder.empty


def test_metadata_has_gyms_encoder_keys(corridor: Any, tmp_path: Path) -> None:
    """Backend, version and command line; no absolute path that a move makes stale."""
    metadata = record(VideoRecorder(corridor, tmp_path / "v.mp4"), corridor, 1)
    encoder = metadata["encoder_version"]
    assert encoder["backend"] == "ffmpeg"
    assert encoder["version"].startswith("ffmpeg version")
    assert encoder["cmdline"][-1] == "v.mp4"


def test_rate_is_the_simulated_time_of_a_step(halfcheetah: Any, tmp_path: Path) -> None:
    """HalfCheetah steps 0.05 s, so its video has 20 frames a second."""
    metadata = record(VideoRecorder(halfcheetah, tmp_path / "v.mp4"), halfcheetah, 2)
    assert metadata["fps"] == "20"
    assert metadata["timestep"] == "1/20"
    assert metadata["playback_speed"] == 1.0


def test_rate_is_right_above_action_repeat(halfcheetah: Any, tmp_path: Path) -> None:
    """A wrapper that repeats actions makes the step longer, whatever is declared."""

    class Repeat(gymnasium.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            self.env.step(action)
            return self.env.step(action)

    env = Repeat(halfcheetah)
    assert record(VideoRecorder(env, tmp_path / "v.mp4"), env, 2)["fps"] == "10"


def test_rate_that_is_no_whole_number_is_exact(tmp_path: Path) -> None:
    """Humanoid's 0.015 s are 200/3 frames a second, also in the file."""
    env = gymnasium.make("Humanoid-v5", render_mode="rgb_array", width=32, height=32)
    recorder = VideoRecorder(env, tmp_path / "v.mp4")
    assert record(recorder, env, 2)["fps"] == "200/3"
    with av.open(str(recorder.path)) as container:
        assert container.streams.video[0].average_rate == Fraction(200, 3)
    env.close()


def test_rate_without_simulation_is_the_declared_one(
    corridor: Any, tmp_path: Path
) -> None:
    """`render_fps` counts where no simulated time is to be seen."""
    assert (
        record(VideoRecorder(corridor, tmp_path / "v.mp4"), corridor, 2)["fps"] == "10"
    )


def test_nothing_declared_is_30_and_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The warning names the argument that chooses."""
    source = Pictures(picture(), picture())
    source.metadata = {}
    recorder = VideoRecorder(source, tmp_path / "v.mp4")
    recorder.capture_frame()
    recorder.capture_frame()
    recorder.close()
    assert metadata_of(recorder)["fps"] == "30"
    assert "fps=" in caplog.text


def test_fps_is_written_and_selects_nothing(halfcheetah: Any, tmp_path: Path) -> None:
    """Every frame is there, played at half the speed."""
    recorder = VideoRecorder(halfcheetah, tmp_path / "v.mp4", fps=10)
    metadata = record(recorder, halfcheetah, 3)
    assert metadata["frame_count"] == 4
    assert metadata["playback_speed"] == 0.5


@pytest.mark.parametrize("fps", [0, -1, float("nan"), True, "30"])
def test_impossible_fps_is_an_error(corridor: Any, tmp_path: Path, fps: Any) -> None:
    """At construction, before anything is written."""
    with pytest.raises(InvalidArgument, match="fps must be"):
        VideoRecorder(corridor, tmp_path / "v.mp4", fps=fps)


def test_single_frame_is_a_video(corridor: Any, tmp_path: Path) -> None:
    """One capture is enough; the rate is then the declared one."""
    recorder = VideoRecorder(corridor, tmp_path / "v.mp4")
    assert record(recorder, corridor, 0)["fps"] == "10"
    assert len(frames_of(recorder.path)) == 1


def test_frame_list_is_drained_in_order(make_corridor: Any, tmp_path: Path) -> None:
    """All the frames of a step are recorded, and the rate fits them."""
    env = make_corridor(render_mode="rgb_array_list")
    # Three pictures for each tenth of a second.
    times = iter([0.0, 0.1, 0.2])
    shown = iter([[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    env.render = lambda: [picture_of(number) for number in next(shown)]
    recorder = VideoRecorder(env, tmp_path / "v.mp4", clock=lambda: next(times))
    metadata = record(recorder, env, 2)
    recorded = [number_of(frame) for frame in frames_of(recorder.path)]
    assert recorded == list(range(1, 10))
    assert metadata["frame_count"] == 9
    assert metadata["fps"] == "30"
    assert metadata["playback_speed"] == 1.0
    with av.open(str(recorder.path)) as container:
        assert container.streams.video[0].average_rate == 30


def test_text_environment_becomes_an_asciicast(
    make_corridor: Any, tmp_path: Path
) -> None:
    """Frames of the mode ansi are text, shown at the declared rate."""
    env = make_corridor(render_mode="ansi")
    recorder = VideoRecorder(env, base_path=tmp_path / "v")
    metadata = record(recorder, env, 2)
    assert recorder.path == str(tmp_path / "v.json")
    assert metadata["content_type"] == "video/vnd.openai.ansivid"
    assert metadata["encoder_version"] == {"backend": "TextEncoder", "version": 1}
    cast = json.loads((tmp_path / "v.json").read_text())
    assert cast["stdout"][2][1].endswith("..o\r\n")
    assert cast["stdout"][0][0] == 0.1


@pytest.mark.parametrize("mode", [None, "human", "depth_array"])
def test_without_pictures_it_is_not_enabled(
    make_corridor: Any, tmp_path: Path, mode: str | None
) -> None:
    """It then does nothing and leaves nothing, as in gym."""
    recorder = VideoRecorder(make_corridor(render_mode=mode), tmp_path / "v.mp4")
    recorder.capture_frame()
    recorder.close()
    assert not recorder.enabled
    assert not recorder.functional
    assert recorder.path is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (None, "NoneType"),
        (np.zeros((8, 10), np.uint8), r"shape \(8, 10\)"),
        (np.zeros((8, 10, 4), np.uint8), r"shape \(8, 10, 4\)"),
        (np.zeros((8, 10, 3)), "float64"),
        (np.zeros((8, 12, 3), np.uint8), "one size"),
        ("text", "str"),
    ],
)
def test_bad_frame_keeps_the_good_ones(
    tmp_path: Path, bad: Any, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The video ends there, playable; one warning and the metadata say why."""
    recorder = VideoRecorder(
        Pictures(picture(), picture(), bad, picture(), bad), tmp_path / "v.mp4"
    )
    for _ in range(5):
        recorder.capture_frame()
    recorder.close()
    assert recorder.broken
    assert not recorder.functional
    assert len(frames_of(recorder.path)) == 2
    assert metadata_of(recorder)["broken"] is True
    # That nothing moves in the two is another matter.
    told = [r for r in caplog.records if r.name == "mjrec.recorder.video_recorder"]
    [warning] = [r for r in told if r.levelno == logging.WARNING]
    assert re.search(reason, warning.getMessage())


def test_bad_first_frame_leaves_no_video(tmp_path: Path) -> None:
    """The metadata says that it is broken and empty."""
    recorder = VideoRecorder(Pictures(None), tmp_path / "v.mp4")
    recorder.capture_frame()
    recorder.close()
    assert recorder.empty
    metadata = metadata_of(recorder)
    assert metadata["broken"]
    assert metadata["empty"]
    assert [p.name for p in tmp_path.iterdir()] == ["v.meta.json"]


def test_no_frame_leaves_only_metadata(corridor: Any, tmp_path: Path) -> None:
    """It says `empty`; a second close changes nothing."""
    recorder = VideoRecorder(corridor, tmp_path / "v.mp4", {"episode_id": 3})
    recorder.close()
    recorder.close()
    assert recorder.empty
    assert metadata_of(recorder) == {
        "episode_id": 3,
        "content_type": "video/mp4",
        "empty": True,
    }


def test_capture_after_close_does_nothing(corridor: Any, tmp_path: Path) -> None:
    """The finished file stays as it is."""
    recorder = VideoRecorder(corridor, tmp_path / "v.mp4")
    record(recorder, corridor, 1)
    recorder.capture_frame()
    recorder.close()
    assert len(frames_of(recorder.path)) == 2


def test_reused_picture_array_is_copied(tmp_path: Path) -> None:
    """An environment may draw every picture into the same array."""
    shared = picture()

    class Reusing:
        render_mode = "rgb_array"
        metadata = {"render_fps": 5}  # noqa: RUF012  as environments have it

        def render(self) -> Any:
            shared[:] = np.clip(shared + 60, 0, 255)
            return shared

    recorder = VideoRecorder(Reusing(), tmp_path / "v.mp4")
    for _ in range(2):
        recorder.capture_frame()
    recorder.close()
    first, second = frames_of(recorder.path)
    assert abs(int(first.mean()) - 150) < 4
    assert abs(int(second.mean()) - 210) < 4


def test_error_of_render_is_raised_unchanged(tmp_path: Path) -> None:
    """It is the environment's own and breaks nothing."""

    def fail() -> None:
        raise RuntimeError("no GL")

    recorder = VideoRecorder(
        SimpleNamespace(render_mode="rgb_array", render=fail), tmp_path / "v.mp4"
    )
    with pytest.raises(RuntimeError, match="no GL"):
        recorder.capture_frame()
    assert not recorder.broken
    recorder.close()
    assert metadata_of(recorder)["empty"]


def test_path_and_base_path_are_either_or(corridor: Any, tmp_path: Path) -> None:
    """Both at once is an error."""
    with pytest.raises(InvalidArgument, match="not both"):
        VideoRecorder(corridor, tmp_path / "v.mp4", base_path=tmp_path / "v")


def test_wrong_extension_is_an_error(make_corridor: Any, tmp_path: Path) -> None:
    """The error says which it must be."""
    with pytest.raises(InvalidArgument, match=r"end in \.json"):
        VideoRecorder(make_corridor(render_mode="ansi"), tmp_path / "v.mp4")
    with pytest.raises(InvalidArgument, match=r"end in \.mp4"):
        VideoRecorder(make_corridor(), tmp_path / "v.avi")


def test_without_a_path_it_makes_one(corridor: Any) -> None:
    """A new temporary directory holds the video."""
    recorder = VideoRecorder(corridor)
    record(recorder, corridor, 1)
    assert len(frames_of(recorder.path)) == 2


def test_later_chdir_parts_nothing(
    corridor: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Video and metadata go where the relative path pointed at first."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    recorder = VideoRecorder(corridor, "v.mp4")
    monkeypatch.chdir(tmp_path / "elsewhere")
    record(recorder, corridor, 1)
    assert {p.name for p in tmp_path.glob("v.*")} == {"v.mp4", "v.meta.json"}


def test_with_closes(corridor: Any, tmp_path: Path) -> None:
    """Leaving the block finishes the file."""
    with VideoRecorder(corridor, tmp_path / "v.mp4") as recorder:
        recorder.capture_frame()
    assert recorder.finished
    assert len(frames_of(recorder.path)) == 1


def test_users_metadata_is_left_alone(corridor: Any, tmp_path: Path) -> None:
    """The dictionary given is copied, not changed."""
    given = {"episode_id": 1}
    record(VideoRecorder(corridor, tmp_path / "v.mp4", given), corridor, 1)
    assert given == {"episode_id": 1}


def test_disabled_recorder_does_nothing(corridor: Any, tmp_path: Path) -> None:
    """Not even a picture is drawn."""
    recorder = VideoRecorder(corridor, tmp_path / "v.mp4", enabled=False)
    recorder.capture_frame()
    recorder.close()
    assert corridor.rendered == 0
    assert not list(tmp_path.iterdir())
