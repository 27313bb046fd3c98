# SPDX-License-Identifier: Apache-2.0
"""The live view: a read-only server of pages about a run that goes on."""

from __future__ import annotations

import base64
import json
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.parse
import urllib.request
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import gymnasium
import numpy as np
import pytest

import mjrec

pytest.importorskip("viser")
from mjrec.viewing.live import LiveView

_STEPS = 6


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Any]:
    """Yield a monitor that has ended an episode and is in its second."""
    env = gymnasium.make("Hopper-v5", max_episode_steps=_STEPS)
    with mjrec.Monitor(env, tmp_path, workers=0, video_callable=lambda _: True) as env:
        env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(_STEPS):
            env.step(env.action_space.sample())
        env.reset(seed=1)
        env.step(env.action_space.sample())
        yield env


@pytest.fixture
def view(run: Any, tmp_path: Path) -> Iterator[LiveView]:
    """Yield a view of the run, answered by a thread."""
    del run
    with LiveView(tmp_path) as opened:
        thread = threading.Thread(target=opened.serve)
        thread.start()
        yield opened
        opened.close()
        thread.join()


def ask(view: LiveView, page: str, **options: Any) -> Any:
    """Return what the view says, in JSON."""
    address = urlsplit(view.url)
    token = parse_qs(address.query)["token"][0]
    query = "&".join(f"{k}={v}" for k, v in {"token": token, **options}.items())
    with urllib.request.urlopen(f"http://{address.netloc}{page}?{query}") as answer:
        return json.loads(answer.read())


def test_new_states_of_a_running_episode_are_served(run: Any, view: LiveView) -> None:
    """A page gets the states that came since it last asked, and their rewards."""
    episodes = ask(view, "/episodes")
    assert [each["label"] for each in episodes["episodes"]] == ["0", "1"]
    assert episodes["episodes"][0]["length"] == _STEPS
    assert "length" not in episodes["episodes"][1]
    assert len(episodes["returns"]) == episodes["count"] == 1
    name = episodes["episodes"][1]["name"]
    first = ask(view, "/motion", episode=name)
    assert (first["steps"], first["chunk"]["count"], first["ending"]) == (1, 2, "")
    _, reward, *_ = run.step(run.action_space.sample())
    then = ask(view, "/motion", **{"episode": name, "from": 2})
    assert (then["steps"], then["chunk"]["count"]) == (2, 1)
    data = zlib.decompress(base64.b64decode(then["chunk"]["data"]))
    assert np.frombuffer(data, "<f4")[2] == pytest.approx(reward, rel=1e-6)


def test_an_evaluation_is_shown_as_one(tmp_path: Path) -> None:
    """Its episodes are named by their recordings, and the newest comes last."""
    for number, name in enumerate(("Hopper-v5/seed-000", "Hopper-v5/seed-001")):
        env = gymnasium.make("Hopper-v5", max_episode_steps=2)
        place, uid = tmp_path / name, f"s{number}"
        place.mkdir(parents=True)
        with mjrec.Monitor(env, place, uid=uid, workers=0, mode="evaluation") as env:
            env.reset(seed=number)
            for _ in range(2):
                env.step(env.action_space.sample() * 0)
    with LiveView(tmp_path) as opened:
        thread = threading.Thread(target=opened.serve)
        thread.start()
        listed = ask(opened, "/episodes")
        newest = listed["episodes"][-1]["name"]
        motion = ask(opened, "/motion", episode=urllib.parse.quote(newest))
        opened.close()
        thread.join()
    assert [each["label"] for each in listed["episodes"]] == ["0.s0 0", "0.s1 0"]
    assert newest.startswith("Hopper-v5/seed-001/")
    assert (listed["count"], motion["steps"]) == (2, 2)


def test_a_view_that_never_served_can_be_closed(tmp_path: Path) -> None:
    """Nothing waits for it, however often."""
    with LiveView(tmp_path) as opened:
        opened.close()
    opened.close()


def test_nothing_is_served_without_the_token(view: LiveView) -> None:
    """A page without the token, or of another name, is refused; nothing can be sent."""
    address = f"http://{urlsplit(view.url).netloc}"
    assert address.startswith("http://127.0.0.1:")
    for page in ("/", "/episodes", "/motion?token=guess"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address + page)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        ask(view, "/motion", episode="../secret.h5")
    with pytest.raises(urllib.error.HTTPError, match="501"):
        urllib.request.urlopen(view.url, data=b"{}")


@pytest.mark.usefixtures("run", "default_signals")
def test_ctrl_c_ends_the_command(tmp_path: Path) -> None:
    """It prints its address, answers, and leaves with status 0 and without an error."""
    command = [sys.executable, "-m", "mjrec", "view", str(tmp_path)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert urllib.request.urlopen(url.replace("/?", "/episodes?")).status == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
