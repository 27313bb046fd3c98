# SPDX-License-Identifier: Apache-2.0
"""Episodes are finished beside a simulation, by a process of its own."""

from __future__ import annotations

import functools
import logging
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from parts import parametrize
from processes import children
from recordings import frames_of, in_flight
from trajectories_by_hand import write_log
from waiting import wait_until

from mjrec import Error, InvalidArgument, Monitor
from mjrec.formats.in_flight import find_recording, is_in_flight, recordings_in_flight
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering.render_service import Progress, RenderService

# A program around a service, with the directory at argv[1].
PROGRAM = """
import pathlib, sys
from mjrec.formats.in_flight import recordings_in_flight
from mjrec.rendering.render_service import RenderService
directory = pathlib.Path(sys.argv[1])
service = RenderService(directory, workers=1)
for recording in recordings_in_flight(directory):
    service.submit(recording.path)
"""


@pytest.fixture(scope="module")
def _recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short episodes of a simulation, as yet without videos."""
    directory = tmp_path_factory.mktemp("recorded")
    env = gymnasium.make(
        "InvertedPendulum-v5", width=40, height=32, max_episode_steps=3
    )
    monitor = Monitor(env, directory, lambda _: True, workers=0, quality="draft")
    for seed in (0, 1):
        monitor.reset(seed=seed)
        for _ in range(3):
            monitor.step(env.action_space.sample())
    monitor.close(wait=False)
    return directory


@pytest.fixture
def recorded(_recorded: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(_recorded, tmp_path / "recorded"))


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., RenderService]]:
    """Make services that are stopped at the end."""
    services = []

    def make(directory: Path = tmp_path, workers: int | None = 1) -> RenderService:
        services.append(RenderService(directory, workers=workers))
        return services[-1]

    yield make
    for service in services:
        service.stop()


@pytest.fixture
def others() -> set[int]:
    """The processes that were there before."""
    return children()


def logs_in(directory: Path) -> list[Path]:
    """Return what its recordings in flight will become."""
    return [recording.path for recording in recordings_in_flight(directory)]


def finished(logs: list[Path]) -> list[bool]:
    """Tell of each whether it is there, and its rows are not."""
    return [log.exists() and find_recording(log) is None for log in logs]


def test_trajectories_get_their_final_form(
    tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """Those that come later too, and after a wait, from one process."""
    before = children()
    service = start()
    for round_ in range(2):
        logs = [write_log(tmp_path, 10 * round_ + k, video=None) for k in range(3)]
        for log in logs:
            service.submit(log)
        service.wait()
        assert finished(logs) == [True] * 3
        assert service.waiting == []
        assert service.failures == {}
        assert len(children() - before) == 1
    service.stop()
    assert children() == before


def test_videos_are_rendered(
    recorded: Path, start: Callable[..., RenderService]
) -> None:
    """By workers of their own, and every frame is shown to be drawn."""
    logs = logs_in(recorded)
    service = start(recorded, workers=None)
    seen: list[Progress] = []
    for log in logs:
        service.submit(log)
    service.wait(seen.append)
    assert service.failures == {}
    videos = sorted(recorded.glob("*.mp4"))
    assert [len(frames_of(video)) for video in videos] == [4, 4]
    assert finished(logs) == [True] * 2
    assert seen[-1] == Progress(videos_done=2, videos=2, frames_done=8, frames=8)
    service.stop()
    assert not list(recorded.glob(".*"))


def test_nothing_is_started_before_there_is_something_to_do(
    tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """And waiting for nothing is over at once."""
    before = children()
    service = start()
    service.wait()
    service.stop()
    assert children() == before


def test_a_video_that_is_expected_finds_its_workers(
    recorded: Path, start: Callable[..., RenderService]
) -> None:
    """They start while its episode runs, and stay from video to video."""
    others = children()
    service = start(recorded, workers=2)
    service.expect()
    [server] = children() - others
    wait_until(lambda: len(children(server)) == 2)
    workers = children(server)
    for log in in_flight(recorded):
        service.expect()
        service.submit(log)
        service.wait()
        assert children(server) == workers
    assert service.failures == {}
    assert len(list(recorded.glob("*.mp4"))) == 2


def test_submitting_never_waits(
    others: set[int], tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """Not even while the server does not read, with more names than a pipe holds."""
    log = write_log(tmp_path, video=None)
    service = start()
    service.submit(log)
    [server] = children() - others
    os.kill(server, signal.SIGSTOP)
    missing = [tmp_path / f"{log.stem[:-6]}{k:06d}.h5" for k in range(1, 3000)]
    for path in missing:
        service.submit(path)
    os.kill(server, signal.SIGCONT)
    service.wait()
    assert service.waiting == []
    assert finished([log]) == [True]


def test_what_fails_is_told_and_stops_nothing_else(
    tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """By the name of the video; the trajectory stays."""
    service = start()
    bad, good = write_log(tmp_path, 0), write_log(tmp_path, 1, video=None)
    min(tmp_path.glob("*.log")).unlink()
    for log in (bad, good):
        service.submit(log)
    service.wait()
    assert list(service.failures) == ["openaigym.video.0.7.video000000.mp4"]
    assert "Cannot read" in next(iter(service.failures.values()))
    assert logs_in(tmp_path) == [bad]
    assert finished([good]) == [True]


def test_a_model_that_is_still_being_written_is_waited_for(
    recorded: Path, start: Callable[..., RenderService]
) -> None:
    """It is compressed beside the simulation, and a short episode ends before."""
    [model] = recorded.glob("*.mjb.gz")
    hidden = model.rename(model.with_name("hidden"))
    first, second = logs_in(recorded)
    later = write_log(recorded, video=None)
    service = start(recorded)
    service.submit(first)
    service.submit(later)
    wait_until(lambda: finished([later]) == [True])
    assert not list(recorded.glob("*.mp4"))
    hidden.rename(model)
    service.submit(second)
    service.wait()
    assert service.failures == {}
    assert len(list(recorded.glob("*.mp4"))) == 2


def test_a_model_that_never_comes_is_an_error(
    recorded: Path, start: Callable[..., RenderService]
) -> None:
    """Once the service is waited for, nobody writes it any more."""
    for model in recorded.glob("*.model.*"):
        model.unlink()
    service = start(recorded)
    service.submit(logs_in(recorded)[0])
    service.wait()
    [reason] = service.failures.values()
    assert "model" in reason


def test_stopping_leaves_what_is_not_done(
    recorded: Path, start: Callable[..., RenderService], stuck_encoder: Path
) -> None:
    """At once, in the midst of a video; no process and no temporary file stays."""
    before = children()
    service = start(recorded)
    logs = logs_in(recorded)
    for log in logs:
        service.submit(log)
    wait_until(stuck_encoder.exists)
    began = time.monotonic()
    service.stop()
    assert time.monotonic() - began < 3
    service.stop()
    assert children() == before
    assert not list(recorded.glob("*.meta.json"))
    assert not list(recorded.glob(".*"))
    assert [log.exists() or is_in_flight(log) for log in logs] == [True] * 2


def test_one_worker_beside_a_simulation_uses_one_cpu(
    recorded: Path,
    start: Callable[..., RenderService],
    stuck_encoder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Mesa's rasteriser starts no threads that would get in the way of the steps."""
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    others = children()
    service = start(recorded, workers=1)
    for log in in_flight(recorded):
        service.submit(log)
    wait_until(stuck_encoder.exists)
    [server] = children() - others
    commands = {pid: Path(f"/proc/{pid}/cmdline") for pid in children(server)}
    [worker] = [pid for pid, cmd in commands.items() if b"worker" in cmd.read_bytes()]
    environment = Path(f"/proc/{worker}/environ").read_bytes().split(b"\0")
    assert b"LP_NUM_THREADS=1" in environment


def test_nothing_is_begun_after_a_stop(
    tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """A trajectory that ends then stays as it is."""
    service = start()
    service.stop()
    log = write_log(tmp_path, video=None)
    service.submit(log)
    service.wait()
    assert is_in_flight(log)
    assert service.failures == {}


def test_a_wait_can_be_interrupted(
    recorded: Path, start: Callable[..., RenderService]
) -> None:
    """Ctrl-C while it waits; another wait goes on, with what came in between."""
    service = start(recorded)
    service.submit(logs_in(recorded)[0])

    def interrupt(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        service.wait(interrupt)
    late = write_log(recorded, video=None)
    service.submit(late)
    service.wait()
    assert service.failures == {}
    assert len(list(recorded.glob("*.mp4"))) == 1
    assert finished([late]) == [True]


def test_ctrl_c_in_the_terminal_does_not_reach_the_server(
    others: set[int], tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """It has a session of its own, and gives way to others."""
    service = start()
    service.submit(write_log(tmp_path, video=None))
    [server] = children() - others
    assert os.getsid(server) == server
    wait_until(lambda: os.getpriority(os.PRIO_PROCESS, server) == 10)


@parametrize("signum", [signal.SIGKILL, signal.SIGSEGV])
def test_a_second_server_goes_on_for_a_dead_one(
    others: set[int],
    signum: signal.Signals,
    recorded: Path,
    start: Callable[..., RenderService],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Nothing is missing, nothing is left of the first one, and it is told how it died.

    It dies once in the midst of a video, and once before anything has begun.
    """
    service = start(recorded)
    for log in logs_in(recorded):
        service.submit(log)
    [server] = children() - others
    if signum == signal.SIGKILL:
        wait_until(lambda: list(recorded.glob(".*.mp4.*.part")))
    os.kill(server, signum)
    service.wait()
    assert service.failures == {}
    assert [len(frames_of(video)) for video in recorded.glob("*.mp4")] == [4, 4]
    assert signum.name in caplog.text
    service.stop()
    assert not list(recorded.glob(".*"))
    assert children() == others


def test_servers_that_die_are_one_clear_failure(
    others: set[int],
    tmp_path: Path,
    start: Callable[..., RenderService],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It is told how they died; nothing waits for ever, and all stays pending."""
    service = start()
    logs = [write_log(tmp_path, k, model={"mjb": "none"}) for k in range(2)]
    for log in logs:
        service.submit(log)
    for _ in range(2):
        [server] = children() - others
        os.kill(server, signal.SIGKILL)
        wait_until(functools.partial(_has_ended, server))
        later = write_log(tmp_path, 2)
        service.submit(later)
    service.wait()
    assert list(service.failures) == [log.name for log in [*logs, later]]
    assert "killed by SIGKILL" in service.failures[later.name]
    assert len(set(service.failures.values())) == 1
    assert caplog.text.count("SIGKILL") == 2
    service.submit(write_log(tmp_path, 3))
    service.wait()
    assert len(service.failures) == 4
    assert children() == others


@pytest.mark.thorough
def test_a_server_that_hangs_is_ended(
    others: set[int],
    tmp_path: Path,
    start: Callable[..., RenderService],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With its children; the log has its threads' stacks, and another one tries."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "if sys.argv[0] == '-m':\n"
        "    import os, subprocess, threading\n"
        "    def wait_for_a_disk_that_does_not_answer(*a, **k):\n"
        "        child = subprocess.Popen(['sleep', '60'], start_new_session=True)\n"
        f"        open({str(tmp_path / 'pids')!r}, 'a').write(f'{{child.pid}}\\n')\n"
        "        threading.Lock().acquire() and threading.Event().wait()\n"
        "    import mjrec.rendering.finishing as f\n"
        "    f.finish_trajectory = wait_for_a_disk_that_does_not_answer\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MJREC_PATIENCE", "0.7")
    service = start()
    log = write_log(tmp_path, video=None)
    service.submit(log)
    service.wait()
    assert "hung for 2.1 seconds" in service.failures[log.name]
    assert "in wait_for_a_disk_that_does_not_answer" in caplog.text
    assert caplog.text.count("What its threads were at") == 2
    assert is_in_flight(log)
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 2
    wait_until(lambda: all(map(_has_ended, pids)))
    assert children() == others


@pytest.mark.thorough
def test_a_server_at_work_does_not_hang(
    tmp_path: Path, start: Callable[..., RenderService], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long it takes for one thing; here, for a log."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "if sys.argv[0] == '-m':\n"
        "    import time\n"
        "    import mjrec.rendering.finishing as f\n"
        "    finish = f.finish_trajectory\n"
        "    def slowly(log):\n"
        "        for _ in range(40):\n"
        "            time.sleep(0.1)\n"
        "        return finish(log)\n"
        "    f.finish_trajectory = slowly\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MJREC_PATIENCE", "0.7")
    service = start()
    log = write_log(tmp_path, video=None)
    service.submit(log)
    service.wait()
    assert service.failures == {}
    assert finished([log]) == [True]


def test_what_failed_is_known_after_a_stop(
    tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """The manifest is to say it, though nobody waits."""
    service = start()
    bad = write_log(tmp_path)
    next(tmp_path.glob("*.log")).unlink()
    service.submit(bad)
    good = write_log(tmp_path, 1, video=None)
    service.submit(good)
    wait_until(lambda: finished([good]) == [True])
    service.stop()
    assert "Cannot read" in service.failures["openaigym.video.0.7.video000000.mp4"]


def test_a_server_that_cannot_start_says_why(
    tmp_path: Path,
    start: Callable[..., RenderService],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its last words are part of the failure."""
    monkeypatch.setattr(sys, "executable", "/bin/false")
    service = start()
    log = write_log(tmp_path)
    service.submit(log)
    service.wait()
    assert "ended with status 1" in service.failures[log.name]
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    service = start()
    service.submit(log)
    service.wait()
    assert "could not be started" in service.failures[log.name]


def test_what_libraries_print_disturbs_nobody(
    tmp_path: Path,
    start: Callable[..., RenderService],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Be it before the server has begun or in the midst of its work."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "if sys.argv[0] == '-m':\n"
        "    os.write(1, b'early words\\n[1]\\n')\n"
        "    import mjrec.rendering.finishing as f\n"
        "    add = f.EpisodeFinisher.add\n"
        "    def tell(*a, **k):\n"
        "        print('late words', flush=True)\n"
        "        os.write(1, b'half a line')\n"
        "        return add(*a, **k)\n"
        "    f.EpisodeFinisher.add = tell\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    service = start()
    log = write_log(tmp_path, video=None)
    service.submit(log)
    with caplog.at_level(logging.WARNING):
        service.wait()
    assert service.failures == {}
    assert finished([log]) == [True]
    assert "early words" in caplog.text
    assert "late words" not in caplog.text


def test_the_servers_warnings_are_logged_here(
    tmp_path: Path,
    start: Callable[..., RenderService],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They would be seen nowhere else."""
    (tmp_path / "sitecustomize.py").write_text(
        "import atexit, logging, sys\n"
        "if sys.argv[0] == '-m':\n"
        "    def tell(*a, **k):\n"
        "        logging.getLogger('mjrec').warning('100% slow')\n"
        "        return False\n"
        "    import mjrec.rendering.finishing as f\n"
        "    f.EpisodeFinisher.add = tell\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    service = start()
    service.submit(write_log(tmp_path, video=None))
    with caplog.at_level(logging.WARNING):
        service.wait()
    assert "100% slow" in caplog.text


@pytest.mark.parametrize("workers", [0, -1, True, 1.5, "2"])
def test_workers_are_a_number_of_processes(workers: Any, tmp_path: Path) -> None:
    """At least one."""
    with pytest.raises(InvalidArgument, match="workers"):
        RenderService(tmp_path, workers=workers)


def test_a_forked_child_leaves_the_server_alone(
    tmp_path: Path, start: Callable[..., RenderService]
) -> None:
    """It cannot use it, and its end is not that of the server."""
    service = start()
    log = write_log(tmp_path, video=None)
    service.submit(log)

    child = os.fork()
    if child == 0:
        status = 1
        try:
            service.submit(log)
        except Error:
            service.wait()
            service.stop()
            status = 0
        os._exit(status)
    assert os.waitpid(child, 0)[1] == 0
    service.wait()
    assert service.failures == {}
    assert finished([log]) == [True]


def test_the_server_ends_with_its_parent(tmp_path: Path) -> None:
    """However that ends, and though it has forked a child that lives on."""
    log = write_log(tmp_path, model={"mjb": "none"})
    code = (
        "import os, time\nif os.fork() == 0:\n    time.sleep(60)\n    os._exit(0)\n"
        "print(service._server.child.pid, flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM + code, str(tmp_path)],
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as program:
        assert program.stdout is not None
        server = int(program.stdout.readline())
        program.kill()
        program.wait()
        wait_until(lambda: _has_ended(server))
        # The child, which has nothing to do with it.
        os.killpg(program.pid, signal.SIGKILL)
    with open_trajectory(log) as reader:
        assert reader.step_count == 4


@parametrize("way", ["script", "stdin", "daemonic"])
def test_any_program_can_have_a_service(way: str, tmp_path: Path) -> None:
    """A script without a guard, `python -`, a daemonic process; once each."""
    log = write_log(tmp_path, video=None)
    code = PROGRAM + "service.wait()\nprint('waited', service.failures)\n"
    if way == "daemonic":
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=_serve, args=(tmp_path,), daemon=True)
        process.start()
        process.join()
        assert process.exitcode == 0
    else:
        script = tmp_path / "script.py"
        script.write_text(code)
        answer = subprocess.run(
            [sys.executable, "-" if way == "stdin" else str(script), str(tmp_path)],
            input=code if way == "stdin" else None,
            capture_output=True,
            text=True,
            check=True,
        )
        assert answer.stdout == "waited {}\n"
    assert finished([log]) == [True]


def _serve(directory: Path) -> None:
    service = RenderService(directory, workers=1)
    for log in logs_in(directory):
        service.submit(log)
    service.wait()


def test_the_simulation_gets_no_thread_and_no_library(tmp_path: Path) -> None:
    """Neither of what draws, nor of what writes HDF5."""
    write_log(tmp_path, video=None)
    code = (
        "import threading\n"
        "heavy = {'mujoco', 'OpenGL', 'h5py', 'multiprocessing'} & set(sys.modules)\n"
        "print(threading.active_count(), sorted(heavy))\nservice.wait()\n"
    )
    answer = subprocess.run(
        [sys.executable, "-c", PROGRAM + code, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert answer.stdout == "1 []\n"


def _has_ended(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
    return stat.rpartition(")")[2].split()[0] == "Z"
