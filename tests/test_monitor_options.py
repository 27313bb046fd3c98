# SPDX-License-Identifier: Apache-2.0
"""Test that `mjrec.Monitor` rejects invalid options before it creates any file."""

import gc

import gymnasium
import pytest

import mjrec
from conftest import Corridor
from mjrec.recorder.tracking import Tracker


def cheetah():
    return gymnasium.make("HalfCheetah-v5", render_mode="rgb_array")


class Overlay(gymnasium.Wrapper):
    def render(self):
        return self.env.render() // 2


ENVIRONMENTS = {
    "corridor": Corridor,
    "windows": lambda: Corridor(render_mode="human"),
    "cheetah": cheetah,
    "overlay": lambda: Overlay(cheetah()),
}
INVALID = {
    "corridor": [
        ({"video_callable": True}, "InvalidArgument", "video_callable"),
        ({"mode": "testing"}, "InvalidArgument", "training"),
        ({"fps": True}, "InvalidArgument", "fps"),
        ({"trajectory_callable": 5}, "InvalidArgument", "trajectory_callable"),
        ({"policy_file": "none.zip"}, "InvalidArgument", "policy_file"),
        *(
            ({"uid": uid}, "InvalidArgument", "uid")
            for uid in ("", "a/b", ".hidden", "a b", "é", "x" * 101)
        ),
        *(
            ({"resume": value}, "InvalidArgument", 'True, False, or "join"')
            for value in ("yes", 1, None)
        ),
        ({"camera": "side"}, "InvalidArgument", "camera"),
        ({"width": 100}, "InvalidArgument", "width"),
        *(
            ({"on_error": value}, "InvalidArgument", '"raise", or "warn"')
            for value in ("ignore", True)
        ),
        ({"render": "deferred"}, "PicturesDiffer", "no accessible MuJoCo model"),
        ({"step_trigger": 5}, "InvalidArgument", "step_trigger must be a function"),
        ({"step_trigger": lambda: True}, "InvalidArgument", "called with one argument"),
        ({"step_trigger": bool, "video_callable": bool}, "InvalidArgument", "one of"),
        ({"step_trigger": bool, "render": "deferred"}, "PicturesDiffer", '"live"'),
        ({"video_length": 0}, "InvalidArgument", "positive whole number"),
        ({"video_length": True}, "InvalidArgument", "positive whole number"),
        ({"video_length": 3, "render": "off"}, "InvalidArgument", 'render="off"'),
        ({"keep": lambda a, b: [0]}, "InvalidArgument", "called with one argument"),
        ({"trackers": 5}, "InvalidArgument", "trackers must be"),
        ({"trackers": [Tracker(), print]}, "InvalidArgument", "trackers must be"),
        ({"trackers": Tracker}, "InvalidArgument", "trackers must be"),
        ({"trackers": [Tracker()] * 2}, "InvalidArgument", "twice"),
    ],
    "windows": [
        ({}, "NoPictures", r'(?s)="rgb_array".*video_callable=False'),
        ({"keep": "worst:1"}, "NoPictures", "rgb_array"),
    ],
    "cheetah": [
        *(({"render": v}, "InvalidArgument", "deferred") for v in ("later", 3, "")),
        *(({"workers": v}, "InvalidArgument", "workers") for v in (-1, 1.5, True, "2")),
        ({"keep": "wurst:3"}, "UnknownName", "'wurst:3'. Available: best"),
        ({"keep": "median:2"}, "UnknownName", "Available: best"),
        ({"keep": "worst,worst:2"}, "InvalidArgument", "names the same rule twice"),
        *(
            ({"keep": rule}, "InvalidArgument", "1 or more")
            for rule in ("worst:0", "best:x", "failures:1.5")
        ),
        ({"keep": 3}, "InvalidArgument", "must be one of"),
        ({"keep": "worst:3", "video_callable": False}, "InvalidArgument", "before"),
        ({"keep": "worst:3", "video_callable": bool}, "InvalidArgument", "one of them"),
        ({"keep": "worst:3", "render": "off"}, "InvalidArgument", "disables videos"),
        ({"keep": "worst:3", "video_length": 3}, "InvalidArgument", "in steps"),
        ({"keep": "worst:3", "step_trigger": bool}, "InvalidArgument", "in steps"),
        ({"camera": []}, "InvalidArgument", "no camera"),
        ({"camera": ["track", "track"]}, "InvalidArgument", "twice"),
        ({"camera": ["track", None]}, "InvalidArgument", "only the first"),
        ({"camera": ["track", "trick"]}, "InvalidArgument", "trick"),
        ({"camera": "track", "tiled": True}, "InvalidArgument", "one of each"),
        *(
            ({"camera": camera, "render": "live"}, "NoPictures", r"camera_name=.*out")
            for camera in ("track", [None, "track"])
        ),
        ({"name_prefix": "openaigym.video"}, "InvalidArgument", "name_prefix"),
        ({"name_prefix": "../x"}, "InvalidArgument", "name_prefix"),
        ({"annotate": 1}, "InvalidArgument", "annotate"),
    ],
    "overlay": [({"render": "deferred"}, "PicturesDiffer", "Overlay")],
}


@pytest.mark.parametrize(
    ("name", "options", "error", "words"),
    [(name, *case) for name, cases in INVALID.items() for case in cases],
)
def test_invalid_options_leave_no_files(name, options, error, words, tmp_path):
    env = ENVIRONMENTS[name]()
    with pytest.raises(getattr(mjrec, error), match=words):
        mjrec.Monitor(env, tmp_path / "new", **options)
    gc.collect()
    assert not (tmp_path / "new").exists()
    assert not getattr(env.unwrapped, "closed", 0)
    env.reset()
    env.close()


def test_object_that_is_no_environment_is_refused(tmp_path):
    with pytest.raises(mjrec.InvalidArgument, match=r"builtins\.dict"):
        mjrec.Monitor({}, tmp_path)
