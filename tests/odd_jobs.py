# SPDX-License-Identifier: Apache-2.0
"""Handlers of jobs that crash, hang, print and misbehave like users' code."""

import contextlib
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import mjrec
from mjrec.engines.worker import time_limit


class OddJobs:
    """Calls the method that a job's `do` names."""

    def __init__(self, settings):
        self._settings = settings

    def __call__(self, arguments):
        return getattr(self, arguments["do"])(arguments)

    def leave(self):
        if "left" in self._settings:
            with Path(self._settings["left"]).open("a") as file:
                file.write(f"{os.getpid()}\n")

    def echo(self, arguments):
        return {"arguments": dict(arguments), "settings": self._settings}

    def where(self, arguments):
        return {
            "pid": os.getpid(),
            "directory": str(Path.cwd()),
            "session": os.getsid(0),
            "gpus": os.environ.get("CUDA_VISIBLE_DEVICES"),
        }

    def die(self, arguments):
        """Kill this process, unless the file `once` exists already."""
        if "once" in arguments:
            try:
                Path(arguments["once"]).touch(exist_ok=False)
            except FileExistsError:
                return {"alive": True}
        print(f"{arguments['how']} is near")
        os.kill(os.getpid(), signal.Signals[arguments["how"]])
        raise AssertionError("dead")

    def fail(self, arguments):
        raise ValueError("not\n  today")

    def leave_python(self, arguments):
        sys.exit("enough")

    def no_json(self, arguments):
        return {"path": Path()}

    def talk(self, arguments):
        print('{"key": "a", "value": {"forged": true}}')
        print("to the error output", file=sys.stderr)
        subprocess.run(["echo", "of a child"], check=True)
        logging.getLogger("odd").warning("a warning of %d", 7)
        print("50 %\r100 %")
        print("x" * arguments.get("more", 0))
        return {"read": sys.stdin.read()}

    def meet(self, arguments):
        """Wait until another job opens the other end of a pipe."""
        with Path(arguments["pipe"]).open(arguments["mode"]):
            gpus = os.environ.get("CUDA_VISIBLE_DEVICES")
            return {"pid": os.getpid(), "gpus": gpus}

    def hold(self, arguments):
        """Write the process id to the file `begun`; wait for the file `go`."""
        with Path(arguments["begun"]).open("a") as file:
            file.write(f"{os.getpid()}\n")
        go = Path(arguments.get("go", "/no/such/file"))
        while not go.exists():
            with contextlib.suppress(SystemExit):
                time.sleep(0.02)
        return {"pid": os.getpid()}

    def hang(self, arguments):
        """Hold the interpreter for minutes, unless the file `mark` exists."""
        import re

        mark = Path(arguments["mark"])
        if not mark.exists():
            with time_limit(0.3, mark, "too slow"):
                re.match(r"(a+)+b", "a" * 40)
        return {"mark": mark.read_text()}

    def fork(self, arguments):
        """Kill this process, but leave a running child in a session of its own."""
        child = subprocess.Popen(["sleep", "600"], start_new_session=True)
        with Path(arguments["children"]).open("a") as file:
            file.write(f"{child.pid}\n")
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("dead")


def make(settings):
    return OddJobs(settings)


def make_nothing(settings):
    raise ValueError("there is no handler")


def make_no_name(settings):
    raise mjrec.UnknownName("camera", "egocentric", ["back", "side"])


def make_and_die(settings):
    print("a library is missing", flush=True)
    os._exit(3)


def make_one(settings):
    """Return a handler in the first process; kill all others, which leave files."""
    place = Path(settings["place"])
    try:
        (place / "first").touch(exist_ok=False)
    except FileExistsError:
        (place / f"died-{os.getpid()}").touch()
        os._exit(3)
    return OddJobs(settings)
