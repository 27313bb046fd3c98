# SPDX-License-Identifier: Apache-2.0
"""Complete episodes survive any end of the recording process at any moment.

Each case ends a child process in one way at a random moment (seeded), then loads,
recovers and renders its directory. The default run tries one moment of a few ways.
"""

import itertools
import json
import random
import signal
import subprocess
import sys
import time

import pytest
from parts import parametrize
from recordings import frames_in, metadata_of
from waiting import wait_until

import mjrec
from mjrec.rendering.finish import finish

MOMENTS = 20
# The seconds start when the child begins to record.
LONGEST = 0.8

# Records short episodes and prints each that is over. Its own exception or exit comes
# between any two instructions.
PROGRAM = """
import json, os, signal, sys, threading
import gymnasium, numpy, mjrec

directory, render, way, delay = sys.argv[1:4] + [float(sys.argv[4])]
if way == "SIGTERM":
    mjrec.exit_on_signals()
env = gymnasium.make(
    "InvertedPendulum-v5", render_mode="rgb_array", width=32, height=32
)
env = mjrec.Monitor(env, directory, lambda episode: episode % 5 == 0, render=render,
                    workers=1, trajectory_callable=True, quality="full")

class Crash(Exception):
    # Python's threading.Condition would swallow a RuntimeError.
    pass

def crash(*_):
    raise Crash("crashed")

env.reset(seed=0)
print("begun", flush=True)
if way == "exception":
    signal.signal(signal.SIGALRM, crash)
    signal.setitimer(signal.ITIMER_REAL, delay)
if way == "_exit":
    threading.Timer(delay, os._exit, (3,)).start()
generator = numpy.random.default_rng(0)
while True:
    episode, rewards, done = env.episode_id - 1, [], False
    while not done:
        _, reward, terminated, truncated, _ = env.step(generator.uniform(-0.2, 0.2, 1))
        rewards.append(float(reward))
        done = terminated or truncated
    # This write is unbuffered, so that a kill loses no printed line.
    os.write(1, (json.dumps([episode, rewards]) + "\\n").encode())
    env.reset()
"""

DEFAULT = [("SIGKILL", "live"), ("SIGKILL", "deferred"), ("exception", "live")]
WAYS = {
    "SIGKILL": ("killed", -signal.SIGKILL),
    "SIGTERM": ("interrupt", 143),
    "SIGINT": ("interrupt", -signal.SIGINT),
    "exception": ("exception", 1),
    "_exit": ("killed", 3),
}


def crash(directory, render, way, delay):
    """Record until the process ends in that way; return the rewards it printed."""
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(directory), render, way, str(delay)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # With a buffer, `readline` could take more than the first line.
        bufsize=0,
        start_new_session=True,
    ) as process:
        assert process.stdout.readline() == b"begun\n"
        if way.startswith("SIG"):
            time.sleep(delay)
            process.send_signal(signal.Signals[way])
        output, errors = process.communicate(timeout=60)
    assert process.returncode == WAYS[way][1], errors.decode()
    return dict(map(json.loads, output.splitlines()))


def check_statistics(directory, over):
    """Check that each printed episode is counted, and at most one more."""
    results = mjrec.load_results(directory)
    lengths = [] if results is None else results["episode_lengths"]
    assert len(over) <= len(lengths) <= len(over) + 1
    for episode, rewards in over.items():
        assert lengths[episode] == len(rewards)
        assert results["episode_rewards"][episode] == pytest.approx(sum(rewards))


def check_episodes(directory, over):
    """Check that trajectories are exact, and scheduled videos have every frame."""
    for episode, rewards in over.items():
        [path] = directory.glob(f"*.episode{episode:06d}.h5")
        trajectory = mjrec.load_trajectory(path)
        assert trajectory.rewards.tolist() == rewards
        assert trajectory.facts["complete"] is True
        assert any(directory.glob(f"*.video{episode:06d}.mp4")) is (episode % 5 == 0)
        if episode % 5 == 0:
            assert len(frames_in(directory, episode)) == len(rewards) + 1
            assert metadata_of(directory, episode)["complete"] is True


def check_last_episode(directory, number, reason):
    """Check that the running episode has its length and the reason of its end."""
    trajectories = map(mjrec.load_trajectory, directory.glob(f"*{number:06d}.h5"))
    facts = [{**each.facts, "rows": len(each.rewards)} for each in trajectories]
    metadata = directory.glob(f"*{number:06d}.meta.json")
    facts += [json.loads(path.read_text()) for path in metadata]
    # If a signal handler runs while an episode ends, it leaves what a kill leaves.
    by_handler = reason in ("interrupt", "exception")
    for each in facts:
        assert each["complete"] or each["reason"] in (reason, *["killed"] * by_handler)
        assert each.get("rows", each["length"]) == each["length"]


def render_all(directory):
    """Render pending videos; return False while the dead process's renderer has some.

    The renderer ends when it notices that its parent is gone.
    """
    found = list(finish(directory, workers=1))
    assert not any(each.failures for each in found)
    return not any(each.elsewhere for each in found)


# Takes more than five seconds: all videos of the dead process are rendered.
@pytest.mark.usefixtures("default_signals")
@parametrize(
    ("way", "render", "moment"),
    itertools.product(WAYS, ("live", "deferred"), range(MOMENTS)),
    default=[(*case, 0) for case in DEFAULT],
    part=pytest.mark.crashes,
)
def test_complete_episodes_survive_and_no_temporary_file_is_left(
    way, render, moment, tmp_path
):
    delay = random.Random(f"{way} {render} {moment}").uniform(0, LONGEST)
    over = crash(tmp_path, render, way, delay)
    check_statistics(tmp_path, over)
    # A child between fork and exec may still hold its parent's lock.
    wait_until(lambda: not mjrec.recover(tmp_path).open_monitors, seconds=60)
    assert not mjrec.recover(tmp_path), "something was left to recover"
    wait_until(lambda: render_all(tmp_path), seconds=60)
    check_statistics(tmp_path, over)
    check_episodes(tmp_path, over)
    check_last_episode(tmp_path, len(over), WAYS[way][0])
    left = [*tmp_path.glob(".*"), *tmp_path.glob("openaigym.states.*")]
    assert [path.name for path in left if path.suffix != ".lock"] == []
    for path in tmp_path.glob("*.json"):
        json.loads(path.read_text())
