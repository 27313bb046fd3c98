# SPDX-License-Identifier: Apache-2.0
"""MJCF files, simulated and as an environment."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mjrec
from mjrec.environments.mjcf_environments import MjcfEnvironment, make_mjcf
from mjrec.environments.options import EnvironmentOptions
from mjrec.simulation.mjcf import MjcfSimulation, load_mjcf

# A red ball on a rail with a motor, a free one, and a green one far from both.
MODEL = """
<mujoco>
  <option timestep="{timestep}"/>
  <visual><headlight ambient="1 1 1"/></visual>
  <worldbody>
    {cameras}
    <geom name="far" size="1" pos="0 50 0" rgba="0 1 0 1"/>
    <body name="ball">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom size=".3" rgba="1 0 0 1" mass="1"/>
      {follower}
    </body>
  </worldbody>
  <actuator>
    <motor joint="rail" gear="5" ctrllimited="true" ctrlrange="-2 3"/>
    <position joint="rail" kp="0.1"/>
  </actuator>
</mujoco>
"""
FIXED = '<camera name="fixed" pos="0 53 0" xyaxes="-1 0 0 0 0 1"/>'
FOLLOWER = '<camera name="follow" mode="trackcom" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>'


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write_model(
        *, timestep: float = 0.002, cameras: str = "", follower: str = ""
    ) -> Path:
        path = tmp_path / "rail.xml"
        path.write_text(
            MODEL.format(timestep=timestep, cameras=cameras, follower=follower)
        )
        return path

    return write_model


@pytest.mark.parametrize("timestep", [0.002, 0.0033, 0.01, 0.0166667, 0.0041667])
def test_there_are_sixty_frames_to_the_second(
    write: Callable[..., Path], timestep: float
) -> None:
    """No frame is more than half a timestep off, and nothing adds up."""
    simulation = MjcfSimulation(load_mjcf(write(timestep=timestep)))
    assert simulation.frame_rate == 60
    for frame in range(1, 301):
        simulation.advance(np.zeros(2))
        # A hundred-thousandth is the rounding of 1/60 and 1/240 to these digits.
        off = abs(simulation.data.time - frame / 60)
        assert off <= timestep / 2 + 1e-5 * frame / 60


def test_a_long_timestep_makes_one_frame_a_step(write: Callable[..., Path]) -> None:
    """A simulation slower than 60 steps a second plays at its own rate."""
    env = MjcfEnvironment(write(timestep=0.025))
    assert env.simulation.frame_rate == Fraction(40)
    assert env.metadata["render_fps"] == 40
    assert env.control_timestep() == 0.025
    env.reset()
    env.step(np.zeros(2))
    assert env.simulation.data.time == 0.025


def test_the_environment_declares_sixty_frames(write: Callable[..., Path]) -> None:
    """The rate is the same whole number whatever the first step happens to last."""
    env = MjcfEnvironment(write(timestep=0.01))
    assert env.metadata["render_fps"] == 60
    assert env.control_timestep() == pytest.approx(1 / 60)
    assert MjcfEnvironment.metadata["render_fps"] == 60


# States have no bounds, and the actuators' ranges are the author's.
@pytest.mark.filterwarnings("ignore:.*Box (action|observation) space:UserWarning")
def test_the_environment_keeps_gymnasiums_contract(write: Callable[..., Path]) -> None:
    """Gymnasium's own checker finds nothing to say."""
    check_env(MjcfEnvironment(write()), skip_render_check=True)


def test_actions_are_the_controls_within_their_ranges(
    write: Callable[..., Path],
) -> None:
    """An actuator without limits has none in the action space either."""
    space = MjcfEnvironment(write()).action_space
    assert isinstance(space, gymnasium.spaces.Box)
    assert space.low.tolist() == [-2, -np.inf]
    assert space.high.tolist() == [3, np.inf]


def test_observations_are_positions_and_velocities(write: Callable[..., Path]) -> None:
    """The motor moves the ball."""
    env = MjcfEnvironment(write())
    first, _ = env.reset(seed=3)
    assert first.tolist() == [0, 0]
    for _ in range(10):
        observation, reward, terminated, truncated, info = env.step(np.array([1, 0]))
    data = env.simulation.data
    assert observation.tolist() == [data.qpos[0], data.qvel[0]]
    assert observation[0] > 0.01
    assert (reward, terminated, truncated, info) == (0.0, False, False, {})


def test_a_reset_is_the_initial_state_again(write: Callable[..., Path]) -> None:
    """The frames of a second episode lie where those of the first lay."""
    env = MjcfEnvironment(write(timestep=0.01))

    def times() -> list[float]:
        env.reset()
        return [
            env.step(np.ones(2)) and float(env.simulation.data.time) for _ in range(7)
        ]

    assert times() == times()


def test_a_model_without_actuators_is_simulated(tmp_path: Path) -> None:
    """A passive model takes empty actions."""
    path = tmp_path / "falling.mjcf"
    path.write_text(
        '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody>'
        "</mujoco>"
    )
    env = MjcfEnvironment(path)
    env.reset()
    assert env.action_space.shape == (0,)
    observation, *_ = env.step(env.action_space.sample())
    assert observation[2] < 0


def test_an_unstable_simulation_ends_where_it_was_sound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo starts over by itself; the episode must not go on from there."""
    # MuJoCo writes MUJOCO_LOG.TXT where it is.
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "unstable.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1"/>'
        '</body></worldbody><actuator><motor joint="j" gear="1e12"/></actuator>'
        "</mujoco>"
    )
    env = MjcfEnvironment(path)
    env.reset()
    sound, *_ = env.step([0.0])
    time = env.simulation.data.time
    observation, _, terminated, truncated, info = env.step([1.0])
    assert (terminated, truncated) == (True, False)
    assert "unstable" in info["unstable"]
    assert observation.tolist() == sound.tolist()
    assert env.simulation.data.time == time > 0
    env.reset()
    assert env.step([0.0])[2] is False


@pytest.mark.parametrize("action", [[0.0], [0, np.nan], [0, np.inf], np.zeros((2, 1))])
def test_what_is_no_control_is_refused(write: Callable[..., Path], action: Any) -> None:
    """MuJoCo would go on with other controls, or raise something obscure."""
    env = MjcfEnvironment(write())
    env.reset()
    with pytest.raises(mjrec.InvalidArgument, match=r"\(2,\) finite numbers"):
        env.step(action)


def test_episodes_end_after_max_steps(write: Callable[..., Path]) -> None:
    """A model has no end of its own: 1000 steps, or as many as were asked for."""
    for asked, expected in ((None, 1000), (7, 7)):
        env = make_mjcf(write(), EnvironmentOptions(max_steps=asked, pictures=False))
        env.reset()
        steps, truncated = 0, False
        while not truncated:
            _, _, terminated, truncated, _ = env.step(np.zeros(2))
            steps += 1
            assert not terminated
        assert steps == expected


def test_pictures_show_the_camera_that_follows(write: Callable[..., Path]) -> None:
    """The ball stays in the middle of the picture however far it goes."""
    env = MjcfEnvironment(
        write(cameras=FIXED, follower=FOLLOWER),
        render_mode="rgb_array",
        height=32,
        width=48,
    )
    assert env.camera == "follow"
    env.reset()
    for _ in range(60):
        env.step([3, 0])
    assert env.simulation.data.qpos[0] > 1
    picture = env.render()
    assert picture.shape == (32, 48, 3)
    assert picture.dtype == np.uint8
    red, green, _ = picture[16, 24]
    assert red > 100 > green
    env.close()
    env.close()


def test_where_nothing_follows_the_first_camera_shows(
    write: Callable[..., Path],
) -> None:
    """The author's camera is better than MuJoCo's free one; a named one is best."""
    path = write(cameras=FIXED)
    env = MjcfEnvironment(path, render_mode="rgb_array", height=32, width=32)
    assert env.camera == "fixed"
    env.reset()
    red, green, _ = env.render()[16, 16]
    assert green > 100 > red
    env.close()
    assert MjcfEnvironment(path, camera=-1).camera == -1
    assert MjcfEnvironment(write()).camera == -1


def test_the_default_size_is_480_by_480(write: Callable[..., Path]) -> None:
    """As large as Gymnasium's own pictures."""
    env = MjcfEnvironment(write(), render_mode="rgb_array")
    env.reset()
    assert env.render().shape == (480, 480, 3)
    env.close()


def test_without_pictures_nothing_is_rendered(write: Callable[..., Path]) -> None:
    """Rendering is an error that says how to make the environment."""
    env = MjcfEnvironment(write())
    env.reset()
    with pytest.raises(mjrec.NoPictures, match='render_mode="rgb_array"'):
        env.render()
    with pytest.raises(mjrec.InvalidArgument, match="render_mode"):
        MjcfEnvironment(write(), render_mode="human")


def test_an_unknown_camera_names_those_there_are(write: Callable[..., Path]) -> None:
    """Known at once, and not at the first picture."""
    with pytest.raises(mjrec.UnknownName, match=r"'nose'.*fixed, follow"):
        MjcfEnvironment(write(cameras=FIXED, follower=FOLLOWER), camera="nose")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<mujoco><wrld/></mujoco>", "unrecognized element.*wrld"),
        ("<mujoco><worldbody>", "XML"),
        ("", "XML"),
        (
            '<mujoco><asset><mesh name="m" file="nowhere.stl"/></asset></mujoco>',
            "nowhere.stl",
        ),
    ],
)
def test_a_bad_file_gives_mujocos_reason_and_its_own_name(
    tmp_path: Path, text: str, reason: str
) -> None:
    """One sentence: which file, and what MuJoCo says is wrong in it."""
    path = tmp_path / "bad.xml"
    path.write_text(text)
    with pytest.raises(mjrec.UnreadableFile, match=f"bad.xml: .*{reason}") as caught:
        load_mjcf(path)
    assert "\n" not in str(caught.value)


def test_recordings_name_the_file(tmp_path: Path) -> None:
    """The spec's id keeps recordings of two files apart, whatever they are called."""
    path = tmp_path / "my robot (2).xml"
    path.write_text("<mujoco/>")
    env = make_mjcf(path, EnvironmentOptions(pictures=False))
    assert env.spec is not None
    assert env.spec.id == "mjcf/my_robot__2_"


def test_a_file_takes_no_more_arguments(write: Callable[..., Path]) -> None:
    """All there is to say stands in the file."""
    with pytest.raises(mjrec.InvalidArgument, match=r"no more arguments.*frame_skip"):
        make_mjcf(write(), EnvironmentOptions(kwargs={"frame_skip": 2}))
