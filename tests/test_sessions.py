# SPDX-License-Identifier: Apache-2.0
"""Sessions whose frames are drawn later, by others, or not at all."""

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest
from recordings import manifest_of, videos_in

import mjrec
from mjrec import sessions
from mjrec.commands import main
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.errors import GLError
from mjrec.recorder.options import RecorderOptions
from mjrec.sessions import Session, record_session


def session(directory, *, name="InvertedPendulum-v5", **options):
    """Return a session of two steps an episode; options of the session or monitor."""
    own = {k: options.pop(k) for k in ("episodes", "schedule") if k in options}
    return Session(
        environment=name,
        directory=directory,
        seed=0,
        made=EnvironmentOptions(max_steps=2, height=32, width=32),
        monitor=RecorderOptions(**options),
        **own,
    )


@pytest.fixture
def no_probing(monkeypatch):
    """Fail where an OpenGL backend is looked for."""

    def fail():
        raise AssertionError("looked for OpenGL")

    monkeypatch.setattr(sessions, "use_gl", fail)


@pytest.fixture
def no_gl(monkeypatch):
    """Let no OpenGL backend be found."""

    def fail():
        raise GLError("Nothing renders here.")

    monkeypatch.setattr(sessions, "use_gl", fail)


@pytest.mark.usefixtures("no_probing")
@pytest.mark.parametrize("options", [{"workers": 0}, {"render": "off"}])
def test_what_is_not_drawn_here_looks_for_no_gl(options, tmp_path):
    """The states are recorded, and the videos are promised, or not wanted."""
    [episode] = record_session(session(tmp_path, **options))
    pending = manifest_of(tmp_path)["mjrec"]["pending"]
    if options.get("render") == "off":
        assert (episode.video, pending) == (None, [])
    else:
        assert episode.video is not None
        assert [entry["video"] for entry in pending] == [episode.video.name]
    assert videos_in(tmp_path) == []
    assert len(list(tmp_path.glob("*.trajectory.*"))) == 1


@pytest.mark.parametrize("render", [None, "live"])
@pytest.mark.usefixtures("no_gl")
def test_without_gl_the_way_out_is_named(tmp_path, render):
    """Where the frames could be drawn elsewhere; nothing is written."""
    options = {"render": render} if render else {}
    with pytest.raises(GLError, match="Nothing renders here") as raised:
        list(record_session(session(tmp_path / "out", **options)))
    assert ("--workers 0" in str(raised.value)) == (render is None)
    assert (f"mjrec render {tmp_path / 'out'}" in str(raised.value)) == (not render)
    assert not (tmp_path / "out").exists()


def test_an_iterator_that_is_left_waits_for_nothing(tmp_path):
    """What is not rendered by then stays pending."""
    with contextlib.closing(
        record_session(session(tmp_path, episodes=3, schedule="all", workers=1))
    ) as run:
        next(run)
    pending = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [entry["episode_id"] for entry in pending] == [0]


RECORD = ("record", "InvertedPendulum-v5", "--size", "32x32", "--max-steps", "9")


def test_record_says_which_videos_are_pending(tmp_path, capsys):
    """And what makes them; also for programs."""
    command = [*RECORD, "--seed", "0", "--workers", "0", "--out"]
    assert main([*command, str(tmp_path / "a")]) == 0
    assert f"000000.mp4  (pending: mjrec render {tmp_path / 'a'})" in (
        capsys.readouterr().out
    )
    assert main([*command, str(tmp_path / "b"), "--json"]) == 0
    [episode] = json.loads(capsys.readouterr().out)["episodes"]
    assert episode["pending"] is True


@pytest.mark.skipif(
    importlib.util.find_spec("pygame") is not None, reason="pygame is installed"
)
@pytest.mark.parametrize("options", [{}, {"keep": "best:1"}])
def test_what_cannot_be_drawn_is_recorded_without_videos(options, tmp_path, caplog):
    """CartPole needs pygame: one line says so, unless frames were asked for."""
    asked = replace(
        session(tmp_path, name="CartPole", episodes=2, **options),
        made=EnvironmentOptions(max_steps=2),
    )
    assert [each.video for each in record_session(asked)] == [None, None]
    assert mjrec.load_results(tmp_path)["episode_lengths"] == [2, 2]
    [line] = caplog.messages
    assert "No videos, only statistics. Drawing CartPole-v1 needs pygame" in line
    live = replace(asked, monitor=RecorderOptions(render="live", force=True))
    with pytest.raises(mjrec.MissingDependency, match="pygame"):
        list(record_session(live))


def test_record_chooses_a_backend_before_mujoco_is_loaded(tmp_path):
    """Where `MUJOCO_GL` says nothing, MuJoCo would take one that needs a screen."""
    environ = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY")}
    subprocess.run(
        [sys.executable, "-m", "mjrec", *RECORD, "--out", str(tmp_path)],
        env=environ,
        check=True,
    )
    assert videos_in(tmp_path)


@pytest.mark.thorough
def test_record_without_any_gl(tmp_path):
    """On a machine, or in a process, that has none."""
    command = [*RECORD, "--seed", "0", "--workers", "0"]
    run = subprocess.run(
        [sys.executable, "-m", "mjrec", *command, "--out", str(tmp_path)],
        env={**os.environ, "MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "pending: mjrec render" in run.stdout
