# SPDX-License-Identifier: Apache-2.0
"""Test recording sessions whose frames are rendered later, elsewhere or never."""

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


def session(directory, *, name="InvertedPendulum-v5", episodes=1, **options):
    return Session(
        environment=name,
        directory=directory,
        seed=0,
        episodes=episodes,
        made=EnvironmentOptions(max_steps=2, height=32, width=32),
        monitor=RecorderOptions(**options),
    )


@pytest.fixture
def no_gl(monkeypatch):
    def fail():
        raise GLError("Nothing renders here.")

    monkeypatch.setattr(sessions, "use_gl", fail)


@pytest.mark.usefixtures("no_gl")
@pytest.mark.parametrize("options", [{"workers": 0}, {"render": "off"}])
def test_deferred_drawing_needs_no_gl(options, tmp_path):
    [episode] = record_session(session(tmp_path, **options))
    pending = [entry["video"] for entry in manifest_of(tmp_path)["mjrec"]["pending"]]
    assert pending == ([] if episode.video is None else [episode.video.name])
    assert len(pending) == ("workers" in options)
    assert videos_in(tmp_path) == []
    assert len(list(tmp_path.glob("*.trajectory.*"))) == 1


@pytest.mark.parametrize("render", [None, "live"])
@pytest.mark.usefixtures("no_gl")
def test_missing_gl_error_suggests_deferred_drawing(tmp_path, render):
    """If live frames were requested, the error must not suggest deferring them."""
    out = tmp_path / "out"
    with pytest.raises(GLError, match="Nothing renders here") as raised:
        list(record_session(session(out, render=render)))
    for way in ("--workers 0", f"mjrec render {out}"):
        assert (way in str(raised.value)) == (render is None)
    assert not out.exists()


RECORD = ("record", "InvertedPendulum-v5", "--size", "32x32", "--max-steps", "9")


def test_record_lists_pending_videos_and_their_command(tmp_path, capsys):
    command = [*RECORD, "--seed", "0", "--workers", "0", "--force", "--out"]
    assert main([*command, str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert f"000000.mp4  (pending: mjrec render {tmp_path})" in printed
    assert main([*command, str(tmp_path), "--json"]) == 0
    [episode] = json.loads(capsys.readouterr().out)["episodes"]
    assert episode["pending"] is True


@pytest.mark.skipif(
    importlib.util.find_spec("pygame") is not None, reason="pygame is installed"
)
@pytest.mark.parametrize("options", [{}, {"keep": "best:1"}])
def test_environment_that_cannot_be_drawn_gives_statistics(options, tmp_path, caplog):
    """A warning says that CartPole needs pygame; requesting frames is an error."""
    cart_pole = replace(
        session(tmp_path, name="CartPole", episodes=2, **options),
        made=EnvironmentOptions(max_steps=2),
    )
    assert [each.video for each in record_session(cart_pole)] == [None, None]
    assert mjrec.load_results(tmp_path)["episode_lengths"] == [2, 2]
    [line] = caplog.messages
    assert "only statistics, no videos. Drawing CartPole-v1 needs pygame" in line
    live = replace(cart_pole, monitor=RecorderOptions(render="live", force=True))
    with pytest.raises(mjrec.MissingDependency, match="pygame"):
        list(record_session(live))


def test_record_chooses_a_backend_before_importing_mujoco(tmp_path):
    """By itself, MuJoCo would choose a backend that needs a display."""
    environ = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY")}
    command = [sys.executable, "-m", "mjrec", *RECORD, "--out", str(tmp_path)]
    subprocess.run(command, env=environ, check=True)
    assert videos_in(tmp_path)
