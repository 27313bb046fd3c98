# SPDX-License-Identifier: Apache-2.0
"""The digest by which a resumed evaluation recognises its policy."""

import functools
import os
import subprocess
import sys

import cloudpickle
import numpy as np
import pytest

from mjrec.evaluation.policy_digest import pickle_digest

SCRIPT = """
import sys
import numpy as np
import mjrec

NAMES = {"left", "right", "up", "down"}

class Policy:
    kinds = frozenset(["alpha", "beta", "gamma"])

    def __init__(self, gain):
        self.gain = gain
        self.seen = {"x", "y", "z"}

    def __call__(self, observation):
        noise = np.random.default_rng(0).normal() if self.seen & NAMES else 0.0
        return np.full(1, self.gain + noise) if "a" in {"a", "b", "c"} else None

[directory, number, gain] = sys.argv[1:]
if number == "2":
    import numpy.random
    import scipy.stats
mjrec.evaluate(
    "InvertedPendulum-v5", policy=Policy(float(gain)), directory=directory, workers=1,
    num_seeds=int(number), episodes=1, keep="none", max_steps=2, resume=True,
)
"""


def test_policy_of_a_script_has_the_same_digest_in_its_next_process(tmp_path):
    """There, sets have another order, and more modules are imported."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)

    def run(number, gain):
        command = [sys.executable, script, tmp_path / "e", str(number), str(gain)]
        environment = {**os.environ, "PYTHONHASHSEED": str(number)}
        return subprocess.run(command, env=environment, capture_output=True, text=True)

    for number in (1, 2):
        done = run(number, 0.5)
        assert done.returncode == 0, done.stderr
    other = run(3, 0.6)
    assert "policy (its content) was" in other.stderr


def digest(policy):
    return pickle_digest(cloudpickle.dumps(policy))


def shared(first, second):
    return [first, second]


def rings():
    ring = {"set": set(), "list": []}
    ring["list"].append(ring)
    inner = functools.partial(max, ring["list"])
    inner.__dict__["back"] = {inner}
    return ring, inner


class Lazy:
    """Pickled with a state, or without."""

    def __init__(self, *state):
        self.state = state

    def __reduce__(self):
        return Lazy, (), *self.state


SAME = {
    "an empty __dict__, or none": (Lazy(), Lazy({})),
    "one string object, or two": (["ab", "ab"], ["ab", "".join("ab")]),
    "sets filled in another order": ({8, 0}, {0, 8}),
    "reference cycles": (rings(), rings()),
}
DIFFERENT = {
    "weights": (np.zeros(3), np.array([0.0, 0.0, 1e-300])),
    "types of weights": (np.zeros(3), np.zeros(3, np.float32)),
    "code": (lambda: 1 + len("x"), lambda: 2 + len("x")),
    "a set's elements": ({"a", "b"}, {"a", "c"}),
    "elements of nested sets": ({frozenset("ab")}, {frozenset("ac")}),
    "bounds of strings": (["ab", "c"], ["a", "bc"]),
    "numbers and their texts": ([1], ["1"]),
    "the order of lists": ([1, 2], [2, 1]),
    "one list object, or two": (shared(*[[]] * 2), shared([], [])),
    "arguments": (functools.partial(max, 1), functools.partial(max, 2)),
}


@pytest.mark.parametrize("kind", SAME)
def test_equal_policies_have_equal_digests(kind):
    """Their pickles may differ."""
    one, other = SAME[kind]
    assert digest(one) == digest(other)


@pytest.mark.parametrize("kind", DIFFERENT)
def test_different_policies_have_different_digests(kind):
    one, other = DIFFERENT[kind]
    assert digest(one) != digest(other)


def test_deeply_nested_policies_have_a_digest():
    chain = None
    for _ in range(300):
        chain = [chain]
    assert digest(chain) != digest([chain])
