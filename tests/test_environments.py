# SPDX-License-Identifier: Apache-2.0
"""From names to environments; Gymnasium's."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import mjrec
from mjrec.environments.episode_seeds import EpisodeSeeds, episode_seeds
from mjrec.environments.from_name import environment_from_name
from mjrec.environments.gymnasium_environments import make_gymnasium
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.environments.names import (
    DmControlName,
    GymnasiumName,
    MjcfName,
    parse_environment_name,
)
from mjrec.environments.policies import load_policy

BALL = """
<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1"/></body>
</worldbody><actuator><motor joint="j" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.fixture(params=["HalfCheetah-v5", "dm_control/cheetah-run", "ball.xml"])
def named(request, tmp_path):
    """An environment of each kind."""
    name = request.param
    if name.endswith(".xml"):
        path = tmp_path / name
        path.write_text(BALL)
        name = str(path)
    elif name.startswith("dm_control/"):
        pytest.importorskip("dm_control")
    return environment_from_name(name, EnvironmentOptions(pictures=False))


def trajectory(named, seeds, *, steps=10):
    """Return the observations of an episode's first steps under random actions."""
    policy = load_policy("random", named.environment)
    policy.reset(seeds)
    observations = [named.begin_episode(named.environment, seeds)]
    for _ in range(steps):
        observation, *_ = named.step(named.environment, policy(observations[-1]))
        observations.append(observation)
    parts = [o.values() if isinstance(o, dict) else [o] for o in observations]
    return b"".join(np.asarray(part).tobytes() for row in parts for part in row)


def test_an_episode_depends_on_its_seeds_alone(named):
    """Neither on the episodes before it nor on how these ended."""
    first = trajectory(named, episode_seeds(5, 3))
    trajectory(named, episode_seeds(5, 4), steps=33)
    assert trajectory(named, episode_seeds(5, 3)) == first
    assert trajectory(named, episode_seeds(5, 4)) != first
    assert trajectory(named, episode_seeds(6, 3)) != first
    named.environment.close()


def test_the_environments_seed_and_the_actions_seed_differ():
    """Each stream changes what it is for, and nothing else."""
    named = environment_from_name("HalfCheetah-v5", EnvironmentOptions(pictures=False))
    seeds = EpisodeSeeds(environment=1, actions=2, policy=3)
    same_start = EpisodeSeeds(environment=1, actions=4, policy=3)
    begun = [named.begin_episode(named.environment, s) for s in (seeds, same_start)]
    assert np.array_equal(*begun)
    # A policy of the user's may draw from the action space, too.
    drawn = []
    for each in (seeds, seeds, same_start):
        named.begin_episode(named.environment, each)
        drawn.append(named.environment.action_space.sample().tolist())
    assert drawn[0] == drawn[1] != drawn[2]


def test_importing_the_package_loads_no_framework():
    """Neither do names, seeds, options, and the way from a name."""
    code = (
        "import sys\n"
        "import mjrec.environments.from_name, mjrec.environments.policies\n"
        "loaded = {'gymnasium', 'dm_control', 'dm_env', 'mujoco'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("HalfCheetah-v5", GymnasiumName("HalfCheetah-v5")),
        ("my_envs:Robot-v0", GymnasiumName("my_envs:Robot-v0")),
        ("phys2d/CartPole-v1", GymnasiumName("phys2d/CartPole-v1")),
        ("dm_control/ball_in_cup-catch", DmControlName("ball_in_cup", "catch")),
        ("dm_control/humanoid_CMU-run", DmControlName("humanoid_CMU", "run")),
    ],
)
def test_names_mean_what_they_say(text, name):
    """And are written as they were read."""
    assert parse_environment_name(text) == name
    assert str(name) == text


def test_a_file_is_named_by_its_path(tmp_path):
    """Its end says that it is an MJCF file; where there is none, those there are."""
    for file_name in ("a robot.mjcf", "ROBOT.XML", "robot.xml"):
        path = tmp_path / file_name
        path.write_text("<mujoco/>")
        assert parse_environment_name(str(path)) == MjcfName(path)
    with pytest.raises(mjrec.UnknownName, match=r"MJCF file .*There are: .*robot.xml"):
        parse_environment_name(str(tmp_path / "robto.xml"))
    with pytest.raises(mjrec.UnknownName, match="There are none"):
        parse_environment_name(str(tmp_path / "nowhere" / "robot.xml"))


def test_names_that_cannot_be_say_what_can(tmp_path):
    """Nothing, half a name, a file of another kind."""
    with pytest.raises(mjrec.InvalidArgument, match="needs a name"):
        parse_environment_name(" ")
    for text in ("dm_control/cheetah", "dm_control/-run", "dm_control/"):
        with pytest.raises(mjrec.InvalidArgument, match="dm_control/<domain>-<task>"):
            parse_environment_name(text)
    path = tmp_path / "robot.txt"
    path.write_text("<mujoco/>")
    with pytest.raises(mjrec.InvalidArgument, match=r"\.xml or \.mjcf"):
        parse_environment_name(str(path))


@pytest.mark.parametrize("name", ["max_steps", "height", "width"])
@pytest.mark.parametrize("bad", [0, 1.5, True])
def test_options_are_checked_at_once(name, bad):
    """Before anything is made; also where only one side is given."""
    with pytest.raises(mjrec.InvalidArgument, match=name):
        EnvironmentOptions(**{name: bad})


def steps_of(env):
    env.reset(seed=0)
    steps = 0
    while True:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        steps += 1
        if terminated or truncated:
            assert truncated
            return steps


@pytest.fixture
def register():
    """Register environments for one test."""
    before = set(gymnasium.registry)

    def register_environment(env_id, entry_point, **kwargs):
        gymnasium.register(env_id, entry_point, **kwargs)

    yield register_environment
    for env_id in set(gymnasium.registry) - before:
        del gymnasium.registry[env_id]


@pytest.mark.parametrize(
    ("own", "asked", "expected"), [(None, None, 1000), (None, 3, 3), (4, 9, 4)]
)
def test_limits_of_other_environments(register, make_corridor, own, asked, expected):
    """1000 where an environment has none; its own where that is smaller."""
    register("Endless-v0", make_corridor, max_episode_steps=own)
    options = EnvironmentOptions(max_steps=asked, kwargs={"length": 10**6})
    assert steps_of(make_gymnasium("Endless-v0", options)) == expected


@pytest.mark.parametrize(("own", "expected"), [(6, 6), (-1, 1000)])
def test_gymnasiums_own_word_for_the_limit(own, expected):
    """`max_episode_steps` replaces the registered limit, and -1 is none."""
    options = EnvironmentOptions(pictures=False, kwargs={"max_episode_steps": own})
    env = make_gymnasium("HalfCheetah-v5", options)
    assert env.spec is not None
    assert env.spec.max_episode_steps == expected
    with pytest.raises(mjrec.InvalidArgument, match="max_episode_steps"):
        make_gymnasium(
            "HalfCheetah-v5", EnvironmentOptions(kwargs={"max_episode_steps": 1.5})
        )


def camera_of(env):
    return int(env.unwrapped.mujoco_renderer.camera_id)


def robot_pixels(camera):
    """Return how much of the robot is seen thirty metres from where it began."""
    options = EnvironmentOptions(camera=camera, height=48, width=64)
    env = make_gymnasium("HalfCheetah-v5", options)
    env.reset(seed=0)
    # Where Gymnasium's free camera looks is settled at the first picture.
    env.render()
    simulated = env.unwrapped
    simulated.data.qpos[0] = 30
    simulated.set_state(simulated.data.qpos, simulated.data.qvel)
    picture = np.asarray(env.render()).astype(int)
    env.close()
    assert picture.shape == (48, 64, 3)
    # Its colour; the ground is green and the sky is grey.
    red, green, blue = (picture[..., channel] for channel in range(3))
    return int(((red - blue > 60) & (red > green)).sum())


def test_pictures_follow_the_robot_unless_asked_otherwise():
    """Gymnasium 1.4's default camera stays where it is; -1 asks for that one."""
    assert robot_pixels(None) > 15
    assert robot_pixels(-1) == 0


def test_an_environments_own_camera_argument_stays():
    """What --env-kwargs says about the view is what the person wants."""
    view = {"default_camera_config": {"distance": 9.0}}
    env = make_gymnasium("HalfCheetah-v5", EnvironmentOptions(kwargs=view))
    assert "camera_name" not in (env.spec.kwargs if env.spec else {})
    with pytest.raises(mjrec.InvalidArgument, match="given twice"):
        make_gymnasium("HalfCheetah-v5", EnvironmentOptions(camera=0, kwargs=view))
    with pytest.raises(mjrec.InvalidArgument, match=r"width .* given twice"):
        make_gymnasium(
            "HalfCheetah-v5", EnvironmentOptions(width=9, kwargs={"width": 8})
        )


def test_an_unknown_camera_names_those_there_are():
    """Before any episode begins."""
    with pytest.raises(mjrec.UnknownName, match=r"'nose'.*track"):
        make_gymnasium("HalfCheetah-v5", EnvironmentOptions(camera="nose"))
    with pytest.raises(mjrec.InvalidArgument, match="camera number 3"):
        make_gymnasium("HalfCheetah-v5", EnvironmentOptions(camera=3))


def test_a_mujoco_environment_that_takes_no_camera_is_given_one(register):
    """Gymnasium-Robotics' take none; their renderer has one all the same."""
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    class NoCamera(HalfCheetahEnv):
        def __init__(self, render_mode=None, width=48, height=48):
            super().__init__(render_mode=render_mode, width=width, height=height)

    register("NoCamera-v0", NoCamera)
    env = make_gymnasium("NoCamera-v0", EnvironmentOptions())
    assert camera_of(env) == 0
    env.close()


def test_text_environments_give_text(register, make_corridor):
    """Where the environment has nothing else, or where text is asked for."""

    class OnlyText(make_corridor):
        metadata = {"render_modes": ["human", "ansi"], "render_fps": 10}  # noqa: RUF012  Gymnasium's own way

    register("OnlyText-v0", OnlyText)
    assert make_gymnasium("OnlyText-v0", EnvironmentOptions()).render_mode == "ansi"
    asked = EnvironmentOptions(kwargs={"render_mode": "ansi"})
    env = make_gymnasium("FrozenLake-v1", asked)
    env.reset(seed=0)
    assert "FHFH" in str(env.render())


def test_an_environment_without_pictures_says_what_it_has(register, make_corridor):
    """The modes there are, the modes it takes, and the way out."""

    class OnlyWindow(make_corridor):
        metadata = {"render_modes": ["human"], "render_fps": 10}  # noqa: RUF012  Gymnasium's own way

    register("OnlyWindow-v0", OnlyWindow)
    with pytest.raises(mjrec.NoPictures, match=r"\['human'\].*rgb_array.*none"):
        make_gymnasium("OnlyWindow-v0", EnvironmentOptions())
    for mode in ("human", None):
        with pytest.raises(mjrec.NoPictures, match="asked for"):
            make_gymnasium(
                "HalfCheetah-v5", EnvironmentOptions(kwargs={"render_mode": mode})
            )
    with pytest.raises(mjrec.UnknownName, match=r"render mode .*'rgb'.*rgb_array"):
        make_gymnasium(
            "HalfCheetah-v5", EnvironmentOptions(kwargs={"render_mode": "rgb"})
        )


def test_a_function_may_make_the_environment(register, make_corridor):
    """Its render modes are known only when it has been called."""
    register("Made-v0", lambda render_mode=None: make_corridor(render_mode=render_mode))
    env = make_gymnasium("Made-v0", EnvironmentOptions())
    assert env.render_mode == "rgb_array"
    register("Blind-v0", lambda render_mode=None: make_corridor(render_mode=None))
    with pytest.raises(mjrec.NoPictures, match="took no render mode"):
        make_gymnasium("Blind-v0", EnvironmentOptions())


def test_cameras_and_sizes_are_for_mujoco(register, make_corridor):
    """Another environment draws what it draws."""
    register("Corridor-v0", make_corridor)
    with pytest.raises(mjrec.InvalidArgument, match="Corridor-v0 has no cameras"):
        make_gymnasium("Corridor-v0", EnvironmentOptions(camera="track"))
    with pytest.raises(mjrec.InvalidArgument, match="Corridor-v0 takes no size"):
        make_gymnasium("Corridor-v0", EnvironmentOptions(height=10, width=10))


def test_an_unknown_environment_names_its_like():
    """Nobody remembers every version; unlike any, how names are made."""
    for env_id in ("HalfCheeta-v5", "HalfCheetah-v9", "halfcheetah"):
        with pytest.raises(mjrec.UnknownName, match="HalfCheetah-v5"):
            make_gymnasium(env_id, EnvironmentOptions())
    for env_id in ("no such thing!", "zz/zzz-v0"):
        with pytest.raises(mjrec.UnknownName, match=r"colon.*dm_control/<domain>"):
            make_gymnasium(env_id, EnvironmentOptions())


def test_without_a_version_the_latest_is_meant():
    """As for gymnasium.make, without its warning."""
    env = make_gymnasium("HalfCheetah", EnvironmentOptions(pictures=False))
    assert env.spec is not None
    assert env.spec.id == "HalfCheetah-v5"


def test_what_a_constructor_raises_is_one_error_with_its_cause(register):
    """Whatever third-party code raises; of a bare assertion, where it stands."""

    def asserting(**kwargs):
        raise AssertionError

    register("Asserting-v0", asserting)
    bad = EnvironmentOptions(kwargs={"foo": 1})
    with pytest.raises(mjrec.EnvironmentNotMade, match=r"HalfCheetah-v5.*'foo'") as e:
        make_gymnasium("HalfCheetah-v5", bad)
    assert isinstance(e.value.__cause__, TypeError)
    with pytest.raises(
        mjrec.EnvironmentNotMade, match=r"AssertionError in .*test_environments.py, "
    ):
        make_gymnasium("Asserting-v0", EnvironmentOptions())


def test_what_is_not_installed_is_named_with_its_command(register):
    """Gymnasium's own message has the command between backticks."""

    def missing(**kwargs):
        try:
            import no_such_engine
        except ImportError as error:
            raise gymnasium.error.DependencyNotInstalled(
                "No engine, run `pip install swig` and then `pip install engine`"
            ) from error
        return no_such_engine

    register("Missing-v0", missing)
    with pytest.raises(
        mjrec.MissingDependency,
        match=r"Missing-v0 needs no_such_engine.*install swig && pip install engine",
    ):
        make_gymnasium("Missing-v0", EnvironmentOptions())


@pytest.mark.parametrize(
    ("env_id", "extra"),
    [("CartPole-v1", "classic-control"), ("FrozenLake-v1", "toy-text")],
)
def test_without_pygame_drawing_is_refused_before_the_first_episode(
    env_id, extra, monkeypatch
):
    """The line to run; and text, where the environment has it."""
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(mjrec.MissingDependency, match=rf"gymnasium\[{extra}\]") as e:
        make_gymnasium(env_id, EnvironmentOptions())
    assert ("ansi" in str(e.value)) == (env_id == "FrozenLake-v1")


def test_a_module_that_registers_lies_in_the_working_directory(
    tmp_path, monkeypatch, register
):
    """`module:Id` imports it first; that it fails is one error."""
    (tmp_path / "mjrec_test_envs.py").write_text(
        "import gymnasium\n"
        "class Env(gymnasium.Env):\n"
        "    metadata = {'render_modes': ['ansi']}\n"
        "    action_space = observation_space = gymnasium.spaces.Discrete(1)\n"
        "    def __init__(self, render_mode=None):\n"
        "        self.render_mode = render_mode\n"
        "gymnasium.register('Local-v0', 'mjrec_test_envs:Env')\n"
    )
    (tmp_path / "mjrec_test_broken.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    env = make_gymnasium("mjrec_test_envs:Local-v0", EnvironmentOptions())
    assert env.render_mode == "ansi"
    with pytest.raises(mjrec.EnvironmentNotMade, match="ZeroDivisionError"):
        make_gymnasium("mjrec_test_broken:Local-v0", EnvironmentOptions())
    with pytest.raises(mjrec.EnvironmentNotMade, match="no_such_module"):
        make_gymnasium("no_such_module:Local-v0", EnvironmentOptions())
    assert sys.path == path


def test_a_stream_is_seeded_once():
    """As Gymnasium's users do: `reset(seed=...)`, then `reset()` and `reset()`."""
    options = EnvironmentOptions(pictures=False)
    named = environment_from_name("InvertedPendulum-v5", options)
    theirs = gymnasium.make("InvertedPendulum-v5")
    expected = [theirs.reset(seed=4)[0], theirs.reset()[0]]
    env, seeds = named.environment, episode_seeds(4, 0)
    found = [named.begin(env, seeds, seed) for seed in (4, None)]
    assert np.array_equal(found, expected)
    theirs.close()
    env.close()
