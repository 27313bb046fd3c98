# SPDX-License-Identifier: Apache-2.0
"""The command line: a module for each command, each over one library call."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence

import tyro

from ..errors import Error
from ..signals import exiting_on_signals
from .compare import compare
from .doctor import doctor
from .evaluate import evaluate
from .list_episodes import list_episodes
from .pack import pack
from .record import record
from .recover import recover
from .render import render
from .report import report
from .strip import strip
from .verify import verify

__all__ = ["main"]

_COMMANDS: dict[str, Callable[..., int]] = {
    "record": record,
    "render": render,
    "recover": recover,
    "list": list_episodes,
    "strip": strip,
    "evaluate": evaluate,
    "compare": compare,
    "report": report,
    "pack": pack,
    "verify": verify,
    "doctor": doctor,
}

_FAILED = 1
_INTERRUPTED = 130  # what shells say of a process that Ctrl-C ended


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    0 is success, 1 an error with one message on stderr, 2 (as `SystemExit`) a command
    line that cannot be understood, 130 an interruption, 143 (as `SystemExit`) SIGTERM,
    129 SIGHUP: all of them close the files first. An error that is not one of ours
    keeps its traceback.

    Args:
        argv: the arguments; those of the process, if None.
    """
    with _warnings_on_stderr(), exiting_on_signals():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    try:
        status: int = tyro.extras.subcommand_cli_from_dict(
            _COMMANDS,
            prog="mjrec",
            description="A headless MuJoCo recorder.",
            args=argv,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        # Here, and not at exit, so that a reader who has left is noticed here.
        sys.stdout.flush()
    except Error as error:
        # The one place where an error becomes text and a number.
        print(f"mjrec: {error}", file=sys.stderr)  # noqa: T201
        return _FAILED
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output has left (`mjrec list DIR | head`). What Python still
        # holds back would raise once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _FAILED
    return status


@contextlib.contextmanager
def _warnings_on_stderr() -> Iterator[None]:
    # Only what mjrec says: MuJoCo's remarks on other people's models are not news here.
    logging.getLogger("absl").setLevel(logging.ERROR)
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    logger = logging.getLogger("mjrec")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
