# SPDX-License-Identifier: Apache-2.0
"""The live view: a local, read-only server of pages about a running recording."""

import base64
import json
import logging
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
import zlib
from urllib.parse import parse_qs, urlencode, urlsplit

import gymnasium
import numpy as np
import pytest
from browsers import data_of, served

import mjrec
from mjrec.commands import main
from mjrec.errors import InvalidArgument

pytest.importorskip("viser")
from mjrec.viewing.episodes import trajectory_in
from mjrec.viewing.live import LiveView
from mjrec.viewing.motion import OWN_LIGHTS

STEPS = 3
# A falling weight wraps its tendon around a pulley.
WRAPPING = """
<mujoco>
  <worldbody>
    <site name="above" pos="0 0 1"/>
    <geom name="pulley" type="cylinder" size=".1 .1" pos=".15 0 .7" euler="90 0 0"/>
    <body pos=".3 0 1.2">
      <freejoint/> <geom size=".05"/> <site name="below"/>
    </body>
  </worldbody>
  <tendon>
    <spatial> <site site="above"/> <geom geom="pulley"/> <site site="below"/> </spatial>
  </tendon>
</mujoco>
"""


def begin(directory, **options):
    """Return a monitor that has recorded an episode."""
    directory.mkdir(parents=True, exist_ok=True)
    env = gymnasium.make("Hopper-v5", max_episode_steps=STEPS)
    env = mjrec.Monitor(env, directory, lambda _: True, workers=0, **options)
    env.reset(seed=0)
    for _ in range(STEPS):
        env.step(np.zeros(3))
    return env


def ask(view, page, **options):
    """Return the view's answer, which is JSON."""
    address = urlsplit(view.url)
    token = parse_qs(address.query)["token"][0]
    query = urlencode({"token": token, **options})
    with urllib.request.urlopen(f"http://{address.netloc}{page}?{query}") as answer:
        return json.loads(answer.read())


def test_new_states_of_a_running_episode_are_served(tmp_path):
    """A page gets only the states since its last request, with their rewards."""
    with begin(tmp_path) as run, served(tmp_path) as view:
        run.reset(seed=1)
        run.step(np.zeros(3))
        listed = ask(view, "/episodes")
        first, second = listed["episodes"]
        assert (first["label"], first["length"]) == ("0", STEPS)
        assert (second["label"], second["running"]) == ("1", True)
        assert len(listed["returns"]) == listed["count"] == 1
        motion = ask(view, "/motion", episode=second["name"])
        assert (motion["steps"], motion["chunk"]["count"]) == (1, 2)
        assert motion["ending"] == ""
        _, reward, *_ = run.step(np.ones(3))
        later = ask(view, "/motion", **{"episode": second["name"], "from": 2})
        assert (later["steps"], later["chunk"]["count"]) == (2, 1)
        data = zlib.decompress(base64.b64decode(later["chunk"]["data"]))
        assert np.frombuffer(data, "<f4")[2] == pytest.approx(reward, rel=1e-6)


def test_the_episodes_of_an_evaluation_are_listed_together(tmp_path):
    """Labels tell their recordings apart, and the newest comes last.

    `mjrec replay` requests one of the files if several have the number.
    """
    for seed in (0, 1):
        place = tmp_path / f"Hopper-v5/seed-00{seed}"
        begin(place, uid=f"s{seed}", mode="evaluation").close()
    with served(tmp_path) as view:
        listed = ask(view, "/episodes")
        newest = listed["episodes"][-1]["name"]
        motion = ask(view, "/motion", episode=newest)
    assert [each["label"] for each in listed["episodes"]] == ["0.s0 0", "0.s1 0"]
    assert newest.startswith("Hopper-v5/seed-001/")
    assert (listed["count"], motion["steps"]) == (2, STEPS)
    paths = [tmp_path / each["name"] for each in listed["episodes"]]
    with pytest.raises(InvalidArgument, match="Several monitors") as error:
        trajectory_in(tmp_path, 0)
    advice = (
        f"Instead of the directory, give one of these files: {paths[0]}, {paths[1]}."
    )
    assert advice in str(error.value)


def test_episodes_with_other_geom_sizes_have_other_scenes(tmp_path, caplog):
    """A page has the shapes of one scene, so it must reload for another.

    All of them together log a note once.
    """
    caplog.set_level(logging.INFO)
    with begin(tmp_path) as run:
        for radius in (0.05, 0.2):
            run.unwrapped.model.geom_size[2, 0] = radius
            run.reset(seed=1)
            for _ in range(STEPS):
                run.step(np.zeros(3))
    with served(tmp_path) as view:
        names = [each["name"] for each in ask(view, "/episodes")["episodes"]]
        first, same, other = (
            ask(view, "/motion", episode=name)["scene"] for name in names
        )
    assert first == same != other
    assert caplog.text.count(OWN_LIGHTS) == 1


def test_a_page_reloads_once_when_a_tendon_begins_to_wrap(tmp_path):
    """Then it has the segments of the tendon."""
    (tmp_path / "model.xml").write_text(WRAPPING)
    options = ["--out", str(tmp_path / "run"), "--max-steps", "60", "--workers", "0"]
    assert main(["record", str(tmp_path / "model.xml"), *options]) == 0

    def page():
        data = data_of(urllib.request.urlopen(view.url).read().decode())
        segments = [name for name in data["nodes"] if name.startswith("/tendon/")]
        return data["scene"], len(segments)

    with served(tmp_path / "run") as view:
        [episode] = ask(view, "/episodes")["episodes"]
        first, one = page()
        motions = [ask(view, "/motion", episode=episode["name"]) for _ in range(2)]
        second, several = page()
    assert one == 1 < several
    assert first != second == motions[0]["scene"] == motions[1]["scene"]


def test_an_episode_cut_by_a_kill_is_not_running(tmp_path):
    # A copy of an open run is what a kill leaves: no process holds its lock.
    with begin(tmp_path / "open") as run:
        run.reset(seed=1)
        run.step(np.zeros(3))
        shutil.copytree(tmp_path / "open", tmp_path / "killed")
    with served(tmp_path / "killed") as view:
        _, cut = ask(view, "/episodes")["episodes"]
        assert cut["running"] is False
        motion = ask(view, "/motion", episode=cut["name"])
    assert motion["ending"] == "End of the recording"


def test_states_that_are_not_finite_are_skipped(tmp_path, monkeypatch):
    """The answer names the state to request next."""

    def load(path, **options):
        trajectory = mjrec.load_trajectory(path, **options)
        trajectory.states[STEPS] = np.nan
        return trajectory

    monkeypatch.setattr("mjrec.viewing.live.load_trajectory", load)
    begin(tmp_path).close()
    with served(tmp_path) as view:
        [episode] = ask(view, "/episodes")["episodes"]
        motion = ask(view, "/motion", episode=episode["name"])
        assert (motion["chunk"]["count"], motion["next"]) == (STEPS, STEPS + 1)
        rest = {"episode": episode["name"], "from": STEPS}
        assert "chunk" not in ask(view, "/motion", **rest)


@pytest.mark.parametrize("port", [-1, 65536])
def test_an_impossible_port_is_an_error(port, tmp_path):
    with pytest.raises(InvalidArgument, match="must be 0-65535"):
        LiveView(tmp_path, port=port)


def test_a_view_that_never_served_can_be_closed_repeatedly(tmp_path):
    with LiveView(tmp_path) as opened:
        opened.close()
    opened.close()


def test_requests_without_the_token_foreign_files_and_posts_are_refused(tmp_path):
    with served(tmp_path) as view:
        address = f"http://{urlsplit(view.url).netloc}"
        assert address.startswith("http://127.0.0.1:")
        for page in ("/", "/episodes", "/motion?token=guess"):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(address + page)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            ask(view, "/motion", episode="../secret.h5")
        with pytest.raises(urllib.error.HTTPError, match="501"):
            urllib.request.urlopen(view.url, data=b"{}")


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_ends_the_command_with_status_0(tmp_path):
    """Before, it prints its URL and answers."""
    command = [sys.executable, "-m", "mjrec", "view", str(tmp_path)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert urllib.request.urlopen(url.replace("/?", "/episodes?")).status == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
