# SPDX-License-Identifier: Apache-2.0
"""Test loading policies by name and checking their actions."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

import mjrec
from mjrec.environments.actions import checked
from mjrec.environments.episode_seeds import EpisodeSeeds, episode_seeds
from mjrec.environments.policies import load_policy, policy_from

SEEDS = EpisodeSeeds(environment=1, actions=2, policy=3)

MIXED = spaces.Dict(
    {
        "arm": spaces.Box(np.array([-1, 1], np.float32), np.array([1, 2], np.float32)),
        "grip": spaces.Discrete(3),
        "both": spaces.Tuple([spaces.MultiDiscrete([2, 5]), spaces.MultiBinary(3)]),
    }
)


def environment_with(space):
    return SimpleNamespace(action_space=space)


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Return a function that writes modules, and unload the modules afterwards."""
    monkeypatch.chdir(tmp_path)
    written = []

    def write_module(text, name="mjrec_test_policy"):
        (tmp_path / f"{name}.py").write_text(text)
        written.append(name)

    yield write_module
    for name in written:
        sys.modules.pop(name, None)


BOX = environment_with(spaces.Box(-1, 1, (2,), np.float32))


def load(name, environment=BOX, **kwargs):
    return load_policy(f"mjrec_test_policy:{name}", environment, kwargs)


BOUNDS = np.array([[-1, 0.3, -7], [1, 0.30001, 1e6]], np.float32)


@pytest.mark.parametrize(
    "space", [spaces.Box(-np.inf, np.inf, (2,), np.float64), MIXED, spaces.Box(*BOUNDS)]
)
def test_random_actions_depend_on_the_episode_seed_alone(space):
    """Actions equal those of `space.sample()`, but do not advance its generator."""

    def draw(policy, episode):
        policy.reset(episode_seeds(0, episode))
        return [policy(None) for _ in range(20)]

    space.seed(9)
    next_sample = repr(space.sample())
    space.seed(9)
    policy = load_policy("random", environment_with(space))
    first = draw(policy, 3)
    assert all(space.contains(action) for action in first)
    assert repr(draw(policy, 4)) != repr(first)
    assert repr(draw(load_policy("random", environment_with(space)), 3)) == repr(first)
    assert repr(space.sample()) == next_sample
    space.seed(episode_seeds(0, 3).actions)
    assert repr([space.sample() for _ in range(20)]) == repr(first)


@pytest.mark.parametrize(
    ("space", "zero"),
    [
        (spaces.Box(np.array([0.5, -3]), np.array([2, -1.0]), dtype=float), [0.5, -1]),
        (spaces.Discrete(3, start=4), 4),
        (spaces.MultiDiscrete([2, 2], start=[1, -1]), [1, 0]),
        (spaces.MultiBinary(2), [0, 0]),
    ],
)
def test_zero_is_the_action_nearest_to_zero(space, zero):
    """Writing to an earlier action must not change later ones."""
    policy = load_policy("zero", environment_with(spaces.Tuple([space])))
    for _ in range(2):
        policy.reset(SEEDS)
        [action] = policy(None)
        assert space.contains(action)
        assert np.array_equal(action, zero)
        if isinstance(action, np.ndarray):
            action[:] = 7


def test_dm_env_actions_are_drawn_within_their_bounds():
    """Actions without bounds are drawn from a normal distribution around zero."""
    specs = pytest.importorskip("dm_env").specs
    spec = {
        "bounded": specs.BoundedArray((2,), np.float32, [-1, 2.1], [0, 3]),
        "endless": specs.BoundedArray((2,), float, -1e10, 1e10),
        "half": specs.BoundedArray((), float, 5, np.inf),
        "parts": [specs.DiscreteArray(4), specs.Array((3,), np.float64)],
    }
    environment = SimpleNamespace(action_spec=lambda: spec)
    policy = load_policy("random", environment)
    policy.reset(SEEDS)
    actions = [policy(None) for _ in range(300)]
    for action in actions:
        spec["bounded"].validate(action["bounded"])
        assert action["parts"][0] in range(4)
        assert action["half"] >= 5
    bounded = np.array([action["bounded"] for action in actions])
    assert bounded.mean(axis=0) == pytest.approx([-0.5, 2.55], abs=0.1)
    free = np.array([action["endless"] for action in actions])
    assert [free.mean(), free.std()] == pytest.approx([0, 1], abs=0.2)
    policy.reset(SEEDS)
    assert repr([policy(None) for _ in range(300)]) == repr(actions)
    zero = load_policy("zero", environment)(None)
    assert zero["bounded"].tolist() == [0, np.float32(2.1)]
    assert (zero["half"], zero["parts"][0]) == (5, 0)
    strings = SimpleNamespace(action_spec=lambda: specs.StringArray(()))
    with pytest.raises(mjrec.PolicyError, match="numeric actions"):
        load_policy("random", strings)


@pytest.mark.parametrize(
    ("space", "action", "taken"),
    [
        (BOX.action_space, np.array([3.0, 0]), [3, 0]),
        (BOX.action_space, [0, 1], [0, 1]),
        (spaces.Discrete(3), np.array([1]), 1),
        (spaces.Dict(a=BOX.action_space), {"a": [0, 9]}, {"a": [0, 9]}),
    ],
)
def test_actions_of_other_types_are_converted(space, action, taken):
    """Policies may return float64, lists, and arrays with a single number."""
    found = checked(space, action)
    assert taken == (found.tolist() if isinstance(found, np.ndarray) else found)
    assert type(taken) is not int or type(found) is int


@pytest.mark.parametrize(
    ("space", "action"),
    [
        (BOX.action_space, None),
        (BOX.action_space, np.zeros((1, 2))),
        (BOX.action_space, np.array([0, np.nan])),
        (BOX.action_space, ["a", "b"]),
        (BOX.action_space, [[1], [1, 2]]),
        (spaces.Discrete(3), 3),
        (spaces.Discrete(3), 1.0),
        (spaces.Discrete(3), np.array([1, 2])),
        (MIXED, {"arm": 1}),
        (spaces.Tuple([spaces.Discrete(2)]), (1, 1)),
    ],
)
def test_invalid_action_is_refused(space, action):
    """The error message contains the space and the action."""
    policy = policy_from(lambda _: action, "mine", environment_with(space))
    with pytest.raises(mjrec.PolicyError, match="must return an action in ") as caught:
        policy(None)
    assert str(space) in str(caught.value)
    assert repr(action) in str(caught.value)


def test_functions_classes_and_calls_are_policies(write):
    """A class receives the environment, the arguments and the seeds."""
    write(
        "import mjrec_test_neighbour\n"
        "def double(observation): return observation * 2\n"
        "def make(environment, scale):\n"
        "    return lambda _: [environment.action_space.shape[0] * scale] * 2\n"
        "class Policy:\n"
        "    def __init__(self, environment, last=2): self.last = last\n"
        "    def reset(self, seed): self.seed = seed\n"
        "    def __call__(self, observation): return [self.seed, self.last]\n"
        "    @staticmethod\n"
        "    def still(observation): return mjrec_test_neighbour.value\n"
    )
    write("value = [0.5, 0.5]\n", name="mjrec_test_neighbour")
    path = list(sys.path)
    assert load("double")(np.array([0.1, 0.2])).tolist() == [0.2, 0.4]
    assert load("make()", scale=3)(None) == [6, 6]
    assert load("Policy.still")(None) == [0.5, 0.5]
    policy = load("Policy", last=7)
    policy.reset(SEEDS)
    assert policy(None) == [3, 7]
    assert sys.path == path  # The working directory was added only for loading.
    with pytest.raises(mjrec.PolicyError, match="unexpected keyword argument 'scale'"):
        load("Policy", scale=3)
    for name in ("random", "mjrec_test_policy:double"):
        with pytest.raises(mjrec.InvalidArgument, match="takes no arguments"):
            load_policy(name, BOX, {"scale": 3})


def test_predict_is_called_as_stable_baselines3_does():
    """The call is deterministic and passes the state and the episode start."""

    class Model:
        calls = []  # noqa: RUF012  one list for all instances

        def predict(self, observation, state=None, episode_start=None, deterministic=0):
            self.calls.append((observation, state, *episode_start, deterministic))
            return np.zeros(2), (0 if state is None else state) + 1

        def __call__(self, observation):
            raise AssertionError("not this one")

    class Short:
        def predict(self, state):
            return [state, 0]

    policy = policy_from(Model(), "model", BOX)
    for _ in range(2):
        policy.reset(SEEDS)
        policy("a")
        policy("b")
    assert Model.calls == [("a", None, True, True), ("b", 1, False, True)] * 2
    # `predict` may have fewer arguments and may return only the action.
    assert policy_from(Short(), "short", BOX)(1) == [1, 0]


INVALID = [
    # Errors suggest similar built-in names, modules, names in modules, and files.
    ("", "rnd", mjrec.UnknownName, "'rnd'.*random, zero.*module:name"),
    ("", ":act", mjrec.UnknownName, "module:name"),
    ("", "mjrec_test_plicy:act", mjrec.UnknownName, "'mjrec_test_plicy'.*test_policy"),
    ("", "bst.zip", mjrec.UnknownName, r"'bst.zip'.*best.zip"),
    (
        *("import math\ndef act(o): pass\nclass Other: pass\n_x = 1\n", "atc"),
        *(mjrec.UnknownName, "'atc'.*Available: Other, act"),
    ),
    # The message includes the line of the error.
    (
        *("def f(o): pass\n1 / 0\n", "f", mjrec.PolicyError),
        r"ZeroDivisionError.*mjrec_test_policy.py, line 2",
    ),
    ("def f(o:\n", "f", mjrec.PolicyError, r"SyntaxError.*line 1\)\.$"),
    ("number = 3\n", "number", mjrec.PolicyError, "is 3, which is not callable"),
    ("def f(env): return 3\n", "f()", mjrec.PolicyError, "is 3, which is not callable"),
]


@pytest.mark.parametrize(("text", "name", "kind", "words"), INVALID)
def test_invalid_policy_names_alternatives_or_the_error(write, text, name, kind, words):
    write(text)
    Path("best.zip").touch()
    with pytest.raises(kind, match=words):
        load_policy(f"mjrec_test_policy:{name}" if text else name, BOX)


def test_policy_errors_name_call_and_line(write):
    write(
        "class Late:\n"
        "    def __init__(self, environment): pass\n"
        "    def reset(self, seed): raise KeyError('in reset')\n"
        "    def __call__(self, o): raise KeyError('in call')\n"
        "class Early(Late):\n"
        "    def __init__(self, environment): raise TypeError('in init')\n"
        "class Alone(Late):\n"
        "    def __init__(self): pass\n"
    )
    policy = load("Late")
    with pytest.raises(mjrec.PolicyError, match=r"reset\(3\).*in reset.*line 3") as e:
        policy.reset(SEEDS)
    assert isinstance(e.value.__cause__, KeyError)
    with pytest.raises(mjrec.PolicyError, match=r"in call.*line 4"):
        policy(None)
    with pytest.raises(mjrec.PolicyError, match=r"Creating .*Early.*in init"):
        load("Early")
    with pytest.raises(mjrec.PolicyError, match=r"Alone.* Give it a parameter"):
        load("Alone")
