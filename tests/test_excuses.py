# SPDX-License-Identifier: Apache-2.0
"""Check what each excuse allows, where it applies, and up to which size."""

from dataclasses import replace

import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.evidence.compare_video import Worst
from mjrec.evidence.differences import Aspect, Difference
from mjrec.evidence.excuses import applicable, excuse_of, merged, with_allowed
from mjrec.evidence.findings import Outcome, Topic
from mjrec.evidence.frame_similarity import planes_of
from mjrec.evidence.trial import Trial

RECORDING = "recording 0.u"
EPISODE = "episode 3 of 0.u"
TRAJECTORY = "recordings/openaigym.trajectory.0.u.episode000003.h5"
VIDEO = "recordings/openaigym.video.0.u.video000003.mp4"
EXCUSES = {
    "mujoco": ("mujoco", "3.16.0", "3.17.0", RECORDING),
    "major": ("mujoco", "3.17.0", "4.0.0", RECORDING),
    "rk4": ("rk4", "quaternions", "", RECORDING),
    "machine": ("machine", "x86_64 a", "x86_64 b", RECORDING),
    "numpy": ("numpy", "2.3.0", "2.4.0", RECORDING),
    "gymnasium": ("gymnasium", "1.3.0", "1.4.0", RECORDING),
    "python": ("python", "3.12.1", "3.11.7", RECORDING),
    "hdf5": ("hdf5", "1.14.6", "2.0.0"),
    "h100": ("gl", "NVIDIA H100", "llvmpipe", RECORDING),
    "llvmpipe": ("gl", "llvmpipe (LLVM 17)", "llvmpipe (LLVM 15)", RECORDING),
    "ffmpeg": ("ffmpeg", "7.0", "9.0", RECORDING),
    "wrappers": ("wrappers", "mine.Wrapper", "", RECORDING),
    "beginning": ("unseeded beginning", "", "", EPISODE),
    "environment": ("environment", "mine.Environment", "", RECORDING),
    "of another": ("mujoco", "3.16.0", "3.17.0", "recording 1.u"),
}


def difference(aspect, size=None, **changes):
    usual = {"topic": Topic.PHYSICS, "file": TRAJECTORY, "how": ""}
    return Difference(**{**usual, **changes}, aspect=aspect, size=size)


def frame(psnr, block, **shadow):
    figures = {"psnr": psnr, "ssim": 0.99, "block": block, "shadow": 0.0, "patch": 0.0}
    figures |= shadow
    lit = {"psnr_lit": 40.0, "ssim_lit": 0.99, "block_lit": 9.0}
    return difference(
        Aspect.PICTURE, topic=Topic.PICTURES, file=VIDEO, figures={**figures, **lit}
    )


WITHIN, BELIEVED = Outcome.WITHIN_TOLERANCE, Outcome.BELIEVED
NOTED, DIFFERENT = Outcome.NOTED, Outcome.DIFFERENT


def reward(aspect, size=None):
    return difference(aspect, size, topic=Topic.REWARDS)


@pytest.mark.parametrize(
    ("name", "found", "outcome"),
    [
        ("mujoco", difference(Aspect.STATE, 1e-7), WITHIN),
        ("mujoco", difference(Aspect.STATE, 1e-5), DIFFERENT),
        ("mujoco", difference(Aspect.SOLVER, 1.0), BELIEVED),
        ("mujoco", difference(Aspect.EXACT), DIFFERENT),
        ("major", difference(Aspect.STATE, 5e-3), WITHIN),
        ("major", reward(Aspect.SUMMED, 5e-3), WITHIN),
        ("rk4", difference(Aspect.STATE, 0.2), DIFFERENT),
        ("rk4", difference(Aspect.VELOCITY, 0.5), WITHIN),
        # Contacts may change a step's reward, and a return adds rewards up.
        ("rk4", reward(Aspect.DERIVED, 0.06), WITHIN),
        ("rk4", reward(Aspect.DERIVED, 0.2), DIFFERENT),
        ("rk4", reward(Aspect.SUMMED, 0.06), DIFFERENT),
        # This reward of one was doubled.
        ("major", reward(Aspect.DERIVED, 0.5), DIFFERENT),
        ("machine", reward(Aspect.DERIVED, 0.5), DIFFERENT),
        ("gymnasium", reward(Aspect.DERIVED, 0.5), DIFFERENT),
        ("gymnasium", reward(Aspect.DERIVED, 1e-9), WITHIN),
        ("numpy", difference(Aspect.STATE, 1e-7), DIFFERENT),
        ("python", difference(Aspect.STATE, 1e-12), DIFFERENT),
        ("python", difference(Aspect.CLAIM, claim="python"), NOTED),
        ("python", difference(Aspect.CLAIM, claim="numpy"), DIFFERENT),
        ("hdf5", difference(Aspect.STORED), NOTED),
        ("hdf5", difference(Aspect.STATE, 1e-12), DIFFERENT),
        ("h100", frame(30.0, 30.0), WITHIN),
        ("h100", frame(27.0, 30.0), DIFFERENT),
        ("h100", frame(27.0, 100.0, shadow=0.02), WITHIN),
        ("h100", frame(27.0, 100.0, shadow=0.2), DIFFERENT),
        ("h100", difference(Aspect.STATE, 1e-12), DIFFERENT),
        ("llvmpipe", frame(30.0, 30.0), DIFFERENT),
        ("llvmpipe", frame(36.0, 12.0), WITHIN),
        ("llvmpipe", frame(48.0, 26.5, shadow=0.001), WITHIN),
        ("llvmpipe", frame(48.0, 26.5, shadow=0.02), DIFFERENT),
        # A patch of 0.017 or 0.125 is 8 pixels wide in a frame of 480 or 64 pixels.
        ("llvmpipe", frame(48.0, 70.0, shadow=0.001, patch=0.017), DIFFERENT),
        ("machine", frame(48.0, 70.0, shadow=0.001, patch=0.017), DIFFERENT),
        ("h100", frame(48.0, 70.0, shadow=0.001, patch=0.017), WITHIN),
        ("h100", frame(40.0, 70.0, shadow=0.016, patch=0.125), DIFFERENT),
        ("ffmpeg", frame(36.0, 12.0), WITHIN),
        # Frames are hashed before they are encoded.
        ("ffmpeg", difference(Aspect.HASH, topic=Topic.PICTURES), DIFFERENT),
        # The rewards were fed to the recreated run, so nothing can make them differ.
        ("wrappers", reward(Aspect.EXACT), DIFFERENT),
        ("wrappers", reward(Aspect.OBSERVED), BELIEVED),
        ("machine", reward(Aspect.OBSERVED, 1e-6), WITHIN),
        ("machine", reward(Aspect.OBSERVED, 0.5), DIFFERENT),
        ("wrappers", frame(36.0, 12.0), DIFFERENT),
        ("beginning", difference(Aspect.STATE, 1.0, topic=Topic.BEGINNING), DIFFERENT),
        ("environment", difference(Aspect.EXACT), BELIEVED),
        # Descriptions follow from the recordings, whatever the environment is.
        ("environment", difference(Aspect.EXACT, file="README.md"), DIFFERENT),
        ("beginning", difference(Aspect.STATE, 1e-12), DIFFERENT),
        ("of another", difference(Aspect.STATE, 1e-12), DIFFERENT),
    ],
)
def test_an_excuse_allows_what_it_states(name, found, outcome):
    """Nothing outside its own items or beyond its tolerance is allowed."""
    assert Trial([excuse_of(*EXCUSES[name])]).judge(found).outcome is outcome


@pytest.mark.parametrize(
    ("name", "side"), [("llvmpipe", 8), ("machine", 8), ("h100", 28)]
)
def test_a_black_square_is_no_shadow(name, side):
    """A black square on a body is not excused, even if it is tiny in the frame."""
    lit = np.full((480, 480, 3), 150, np.uint8)
    painted = lit.copy()
    painted[200 : 200 + side, 200 : 200 + side] = 0
    worst = Worst()
    worst.add(0, planes_of(painted), planes_of(lit))
    [found] = worst.differences()
    trial = Trial([excuse_of(*EXCUSES[name])])
    assert trial.judge(replace(found, file=VIDEO)).outcome is DIFFERENT


def test_the_widest_excuse_decides():
    """Order does not matter, and excuses that were not needed are marked."""
    trial = Trial([excuse_of(*EXCUSES[n]) for n in ("numpy", "python", "mujoco")])
    trial.judge(difference(Aspect.CLAIM, claim="python"))
    assert [each.is_needed for each in trial.excuses] == [False] * 3
    finding = trial.judge(difference(Aspect.STATE, 1e-7))
    assert (finding.outcome, finding.excuse) == (WITHIN, "mujoco")


def test_turns_by_rk4_differ_between_major_versions_only():
    """If both versions are MuJoCo 3, a model that uses RK4 excuses nothing."""
    note = excuse_of("rk4", "quaternions", "", RECORDING)
    for name, kept in (("major", True), ("mujoco", False), ("numpy", False)):
        assert (note in applicable([note, excuse_of(*EXCUSES[name])])) is kept


def test_the_same_claim_of_two_recordings_is_one_excuse():
    """An excuse for the whole archive absorbs those for single recordings."""
    excuses = [excuse_of("numpy", "1", "2", item) for item in ("a", "b", "a")]
    assert [each.items for each in merged(excuses)] == [("a", "b")]
    assert [e.items for e in merged([*excuses, excuse_of("numpy", "1", "2")])] == [()]


@pytest.mark.parametrize(
    ("allow", "allowed"),
    [
        ("gl=nvidia h100", True),
        ("gl=any", True),
        ("gl=A100", False),
        ("cpu=any", False),
    ],
)
def test_a_reader_takes_an_excuse_with_its_value(allow, allowed):
    """A reader who knows where an archive comes from may allow an excuse."""
    [taken] = with_allowed([excuse_of(*EXCUSES["h100"])], [allow])
    assert taken.allowed is allowed


@pytest.mark.parametrize("allow", ["gl", "gl=", "=H100", ""])
def test_no_excuse_is_taken_without_a_value(allow):
    """Without a value, an allowed excuse would accept any claim."""
    with pytest.raises(InvalidArgument, match="gl=NVIDIA H100"):
        with_allowed([], [allow])
