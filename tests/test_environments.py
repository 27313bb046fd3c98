# SPDX-License-Identifier: Apache-2.0
"""Test environments made from names, including Gymnasium's own."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

import mjrec
from conftest import Corridor
from mjrec import InvalidArgument
from mjrec.environments.episode_seeds import EpisodeSeeds, episode_seeds
from mjrec.environments.from_name import environment_from_name
from mjrec.environments.gymnasium_environments import make_gymnasium
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.environments.policies import load_policy

BALL = """
<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1"/></body>
</worldbody><actuator><motor joint="j" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def make(env_id, **options):
    return make_gymnasium(env_id, EnvironmentOptions(**options))


def named(name, **options):
    return environment_from_name(name, EnvironmentOptions(**options))


def trajectory(made, seeds, *, steps=10):
    """Return the observations of the first steps with random actions."""
    policy = load_policy("random", made.environment)
    policy.reset(seeds)
    observations = [made.begin_episode(made.environment, seeds)]
    for _ in range(steps):
        observation, *_ = made.step(made.environment, policy(observations[-1]))
        observations.append(observation)
    parts = [o.values() if isinstance(o, dict) else [o] for o in observations]
    return b"".join(np.asarray(part).tobytes() for row in parts for part in row)


@pytest.mark.parametrize(
    "name", ["HalfCheetah-v5", "dm_control/cheetah-run", "A B.MJCF"]
)
def test_episode_depends_only_on_its_seeds(name, tmp_path, monkeypatch):
    """An episode does not depend on earlier episodes."""
    if name.startswith("dm_control/"):
        pytest.importorskip("dm_control")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "A B.MJCF").write_text(BALL)
    made = named(name, frames=False)
    first = trajectory(made, episode_seeds(5, 3))
    trajectory(made, episode_seeds(5, 4), steps=33)
    assert trajectory(made, episode_seeds(5, 3)) == first
    assert trajectory(made, episode_seeds(5, 4)) != first
    assert trajectory(made, episode_seeds(6, 3)) != first


def test_environment_and_actions_have_separate_seeds():
    made = named("HalfCheetah-v5", frames=False)
    seeds = EpisodeSeeds(environment=1, actions=2, policy=3)
    same_start = EpisodeSeeds(environment=1, actions=4, policy=3)
    begun, drawn = [], []
    for each in (seeds, seeds, same_start):
        begun.append(made.begin_episode(made.environment, each).tolist())
        # A user's policy may sample from the action space too.
        drawn.append(made.environment.action_space.sample().tolist())
    assert begun[0] == begun[1] == begun[2]
    assert drawn[0] == drawn[1] != drawn[2]


def test_begin_seeds_once_as_gymnasium_users_do():
    """Gymnasium users pass a seed only to the first `reset`."""
    made = named("InvertedPendulum-v5", frames=False)
    theirs = gymnasium.make("InvertedPendulum-v5")
    expected = [theirs.reset(seed=4)[0], theirs.reset()[0]]
    seeds = episode_seeds(4, 0)
    found = [made.begin(made.environment, seeds, seed) for seed in (4, None)]
    assert np.array_equal(found, expected)


def test_seeds_never_change_between_versions():
    assert episode_seeds(0, 1) == EpisodeSeeds(
        environment=1982462498, actions=679461430, policy=1947452081
    )


@pytest.mark.parametrize("bad", [-1, 2**32, True])
def test_invalid_seeds_are_rejected(bad):
    with pytest.raises(InvalidArgument, match=r"seed must be .*4294967295"):
        episode_seeds(bad, 0)
    with pytest.raises(InvalidArgument, match="episode must be"):
        episode_seeds(0, bad)


def test_module_may_be_in_the_working_directory(tmp_path, monkeypatch, registered):
    """`module:Id` imports the module first, and a failing import is a single error."""
    (tmp_path / "mjrec_test_envs.py").write_text(
        "import gymnasium, conftest\n"
        "gymnasium.register('Local-v0', lambda **k: conftest.Corridor(**k))\n"
    )
    (tmp_path / "mjrec_test_broken.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    assert make("mjrec_test_envs:Local-v0").render_mode == "rgb_array"
    with pytest.raises(mjrec.EnvironmentNotMade, match="ZeroDivisionError"):
        make("mjrec_test_broken:Local-v0")
    assert sys.path == path


class OnlyText(Corridor):
    metadata = {"render_modes": ["human", "ansi"], "render_fps": 10}  # noqa: RUF012


class OnlyWindow(Corridor):
    metadata = {"render_modes": ["human"], "render_fps": 10}  # noqa: RUF012


class NoCamera(HalfCheetahEnv):
    def __init__(self, render_mode=None, width=48, height=48):
        super().__init__(render_mode=render_mode, width=width, height=height)


def missing(**kwargs):
    try:
        import no_such_engine
    except ImportError as error:
        raise gymnasium.error.DependencyNotInstalled(
            "No engine, run `pip install swig` and then `pip install engine`"
        ) from error
    return no_such_engine


@pytest.fixture
def registered(monkeypatch):
    """Register environments for the duration of a test."""
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {**gymnasium.registry})
    for env_id, entry_point in {
        "Corridor-v0": Corridor,
        "OnlyText-v0": OnlyText,
        "OnlyWindow-v0": OnlyWindow,
        "NoCamera-v0": NoCamera,
        # The render modes of a function are unknown until it is called.
        "Made-v0": lambda render_mode=None: Corridor(render_mode=render_mode),
        "Blind-v0": lambda render_mode=None: Corridor(render_mode=None),
        "Missing-v0": missing,
    }.items():
        gymnasium.register(env_id, entry_point)
    gymnasium.register("Short-v0", Corridor, max_episode_steps=4)


@pytest.mark.parametrize(
    ("env_id", "asked", "kwargs", "expected"),
    [
        ("Corridor-v0", None, {}, 1000),
        ("Corridor-v0", 3, {}, 3),
        ("Short-v0", 9, {}, 4),
        # Gymnasium's own name for the limit also works, with -1 for no limit.
        ("HalfCheetah-v5", None, {"max_episode_steps": 6}, 6),
        ("Short-v0", None, {"max_episode_steps": -1}, 1000),
    ],
)
def test_step_limit_is_smallest_or_1000(registered, env_id, asked, kwargs, expected):
    env = make(env_id, max_steps=asked, kwargs=kwargs)
    assert env.spec.max_episode_steps == expected


@pytest.mark.parametrize(
    ("env_id", "kwargs", "mode", "text"),
    [
        *(("OnlyText-v0", {}, "ansi", "o\n"), ("Made-v0", {}, "rgb_array", "")),
        # A name without a version means the latest version.
        ("FrozenLake", {"render_mode": "ansi"}, "ansi", "FHFH"),
    ],
)
def test_render_mode_is_requested_or_available(registered, env_id, kwargs, mode, text):
    env = make(env_id, kwargs=kwargs)
    env.reset(seed=0)
    assert env.render_mode == mode
    assert text in str(env.render())


@pytest.mark.parametrize(
    ("env_id", "options", "camera"),
    [
        ("HalfCheetah-v5", {}, "track"),
        ("HalfCheetah-v5", {"camera": -1}, -1),
        ("HalfCheetah-v5", {"kwargs": {"camera_id": -1}}, -1),
        # This environment takes no camera, like those of Gymnasium-Robotics.
        ("NoCamera-v0", {}, "track"),
    ],
)
def test_default_camera_follows_the_robot(registered, env_id, options, camera):
    """The default camera of Gymnasium 1.4, -1, does not follow the robot."""
    base = make(env_id, **options).unwrapped
    shown = base.mujoco_renderer.camera_id
    assert camera == (-1 if shown == -1 else base.model.camera(shown).name)


CHEETAH = "HalfCheetah-v5"
WRONG = [
    (" ", {}, InvalidArgument, "name must be"),
    ("dm_control/cheetah", {}, InvalidArgument, "dm_control/<domain>-<task>"),
    ("./robot.txt", {}, InvalidArgument, r"\.xml or \.mjcf"),
    ("robto.xml", {}, mjrec.UnknownName, r"MJCF file .*Available: .*robot.xml"),
    # Suggestions ignore versions; if there are none, the error explains valid names.
    ("halfcheeta-v9", {}, mjrec.UnknownName, CHEETAH),
    ("zz/zzz-v0", {}, mjrec.UnknownName, r"colon.*dm_control/<domain>"),
    ("no_such_module:X-v0", {}, mjrec.EnvironmentNotMade, "no_such_module"),
    # An error in a constructor is reported as a single error.
    (CHEETAH, {"kwargs": {"foo": 1}}, mjrec.EnvironmentNotMade, f"{CHEETAH}.*'foo'"),
    # Gymnasium's own message has the commands in backticks.
    (
        *("Missing-v0", {}, mjrec.MissingDependency),
        r"Missing-v0 needs no_such_engine.*install swig && pip install engine",
    ),
    (CHEETAH, {"kwargs": {"max_episode_steps": 1.5}}, InvalidArgument, "max_ep"),
    (CHEETAH, {"camera": 0, "kwargs": {"camera_id": 0}}, InvalidArgument, "twice"),
    (CHEETAH, {"width": 9, "kwargs": {"width": 8}}, InvalidArgument, "twice"),
    (CHEETAH, {"camera": "nose"}, mjrec.UnknownName, "'nose'.*track"),
    (CHEETAH, {"camera": 3}, InvalidArgument, "Camera number 3"),
    ("Corridor-v0", {"camera": "track"}, InvalidArgument, "has no cameras"),
    ("Corridor-v0", {"height": 9, "width": 9}, InvalidArgument, "takes no size"),
    # The error names the environment's modes, the usable modes and a way out.
    ("OnlyWindow-v0", {}, mjrec.NoPictures, r"\['human'\].*rgb_array.*none"),
    ("Blind-v0", {}, mjrec.NoPictures, "ignored render_mode"),
    (CHEETAH, {"kwargs": {"render_mode": None}}, mjrec.NoPictures, "was requested"),
    (CHEETAH, {"kwargs": {"render_mode": "rgb"}}, mjrec.UnknownName, "'rgb'.*rgb_arr"),
    (CHEETAH, {"max_steps": 0}, InvalidArgument, "max_steps"),
    (CHEETAH, {"max_steps": 1.5}, InvalidArgument, "max_steps"),
    (CHEETAH, {"height": True}, InvalidArgument, "height"),
]


@pytest.mark.parametrize(("name", "options", "kind", "words"), WRONG)
def test_invalid_requests_name_the_valid_ones(
    tmp_path, monkeypatch, registered, name, options, kind, words
):
    """Invalid requests fail before an episode starts."""
    monkeypatch.chdir(tmp_path)
    for file_name in ("robot.txt", "robot.xml"):
        (tmp_path / file_name).write_text("<mujoco/>")

    def begin():
        # Some invalid requests still make an environment, though without frames.
        if (refusal := named(name, **options).not_drawn) is not None:
            raise refusal

    with pytest.raises(kind, match=words) as caught:
        begin()
    assert "foo" not in words or isinstance(caught.value.__cause__, TypeError)


def test_missing_pygame_is_reported_before_the_first_episode(monkeypatch):
    """The error has the command to run, and suggests text where that is available."""
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(mjrec.MissingDependency, match=r"gymnasium\[classic-control\]"):
        make("CartPole-v1")
    with pytest.raises(mjrec.MissingDependency, match=r"gymnasium\[toy-text\].*ansi"):
        make("FrozenLake-v1")
