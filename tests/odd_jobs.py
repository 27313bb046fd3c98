# SPDX-License-Identifier: Apache-2.0
"""Handlers of jobs that do what policies and environments do on a bad day."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mjrec


class OddJobs:
    """Does what a job's `do` names, and notes in a file that it was closed."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._settings = settings

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        job: Mapping[str, Any] = getattr(self, arguments["do"])(arguments)
        return job

    def close(self) -> None:
        if "closed" in self._settings:
            with Path(self._settings["closed"]).open("a") as file:
                file.write(f"{os.getpid()}\n")
        if self._settings.get("closes") == "badly":
            raise OSError("the disk is gone")

    def echo(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"arguments": dict(arguments), "settings": self._settings}

    def where(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        main = sys.modules["__main__"]
        return {
            "pid": os.getpid(),
            "directory": str(Path.cwd()),
            "main": Path(str(main.__file__)).name,
            "session": os.getsid(0),
            "threads": os.environ.get("OMP_NUM_THREADS"),
        }

    def die(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """End the process; where `once` names a file, only if there is none yet."""
        if "once" in arguments:
            try:
                Path(arguments["once"]).touch(exist_ok=False)
            except FileExistsError:
                return {"alive": True}
        print(f"{arguments['how']} is near")
        if arguments["how"] == "exit":
            os._exit(7)
        os.kill(os.getpid(), signal.Signals[arguments["how"]])
        raise AssertionError("dead")

    def fail(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        raise ValueError("not\n  today")

    def leave(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        sys.exit("enough")

    def no_json(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"path": Path()}

    def talk(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        print('{"key": "a", "value": {"forged": true}}')
        print("to the error output", file=sys.stderr)
        subprocess.run(["echo", "of a child"], check=True)
        logging.getLogger("odd").warning("a warning of %d", 7)
        print("50 %\r100 %", end="")
        return {"read": sys.stdin.read()}

    def shout(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        print("x" * 1_000_000)
        return {}

    def meet(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Wait until another job has opened the other end of a pipe."""
        with Path(arguments["pipe"]).open(arguments["mode"]):
            gpus = os.environ.get("CUDA_VISIBLE_DEVICES")
            return {"pid": os.getpid(), "gpus": gpus}

    def hold(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Keep at it until a signal comes; a file says when it has begun."""
        with self._begun(arguments):
            signal.pause()
        raise AssertionError("the signal was to raise something")

    def hold_on(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Take no notice of signals."""
        with self._begun(arguments):
            while True:
                with contextlib.suppress(SystemExit):
                    signal.pause()

    def fork(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Die, and leave a child that goes on."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            child = os.fork()
        if not child:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            while True:
                signal.pause()
        with Path(arguments["children"]).open("a") as file:
            file.write(f"{child}\n")
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("dead")

    @contextlib.contextmanager
    def _begun(self, arguments: Mapping[str, Any]) -> Any:
        # A new file, so that nothing is ever replaced.
        with Path(arguments["begun"]).open("x") as file:
            file.write(str(os.getpid()))
        try:
            yield
        finally:
            print("let go")


def make(settings: Mapping[str, Any]) -> OddJobs:
    return OddJobs(settings)


def make_nothing(settings: Mapping[str, Any]) -> OddJobs:
    print("about to raise")
    raise ValueError("there is no handler")


def make_no_name(settings: Mapping[str, Any]) -> OddJobs:
    raise mjrec.UnknownName("camera", "egocentric", ["back", "side"])


def make_and_die(settings: Mapping[str, Any]) -> OddJobs:
    with Path(settings["begun"]).open("a") as file:
        file.write("begun\n")
    print("a library is missing", flush=True)
    os._exit(3)


def make_and_be_told_to_end(settings: Mapping[str, Any]) -> OddJobs:
    """As a SIGTERM may come while modules are imported: in a class's body."""

    class Ends:
        def __set_name__(self, owner: type, name: str) -> None:
            signal.raise_signal(signal.SIGTERM)

    type("Imported", (), {"part": Ends()})
    return OddJobs(settings)


def make_and_die_at_first(settings: Mapping[str, Any]) -> OddJobs:
    """Two die as they begin, each with a file of its own; others do their jobs."""
    for number in range(2):
        with contextlib.suppress(FileExistsError):
            Path(settings["deaths"], str(number)).touch(exist_ok=False)
            os._exit(3)
    return OddJobs(settings)
