# SPDX-License-Identifier: Apache-2.0
"""The command line: a module for each command, each over one library call."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.metadata
import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..errors import Error
from ..signals import exiting_on_signals
from .overview import EXAMPLES, examples, overview, recordings_in

__all__ = ["main"]

# Each command: its module, which is imported when it is chosen, and has a function that
# is called like the command (`list_episodes`, because `list` is Python's), and what it
# does.
COMMANDS = {
    "record": ("record", "Record episodes of an environment."),
    "render": ("render", "Render pending videos, or episodes once more."),
    "recover": ("recover", "Finish what a killed run left."),
    "list": ("list_episodes", "List recorded episodes."),
    "strip": ("strip", "Put frames of an episode side by side."),
    "replay": ("replay", "Show an episode in 3D, in one HTML file."),
    "view": ("view", "Show a run in a browser while it goes on."),
    "evaluate": ("evaluate", "Evaluate a policy on tasks and seeds."),
    "compare": ("compare", "Compare evaluations."),
    "report": ("report", "Make a web page of recordings or results."),
    "pack": ("pack", "Pack a run into one file for others."),
    "verify": ("verify", "Run a packed run again and compare."),
    "doctor": ("doctor", "Check whether this machine can render."),
    "completion": ("completion", "Print tab completion for a shell."),
}

_FAILED = 1
_TRACEBACK = "Traceback (most recent call last)"
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
    name, *arguments = _arguments(argv)
    module, _ = COMMANDS[name]
    try:
        command = importlib.import_module(f".{module}", __name__)
        # Later than the overview, which must be quick.
        from .help_text import flowing_help

        tyro = importlib.import_module("tyro")
        status: int = tyro.cli(
            flowing_help(getattr(command, module)),
            prog=f"mjrec {name}",
            args=arguments,
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
        # The reader of our output has left (`mjrec list DIR | head`). What Python still
        # holds back would raise once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _FAILED
    return status


class _Parser(argparse.ArgumentParser):
    """Knows the commands; the help is a list in groups."""

    def format_help(self) -> str:
        return overview(COMMANDS)


def _arguments(argv: Sequence[str] | None) -> Sequence[str]:
    """Return the arguments, which begin with a command.

    Raises:
        SystemExit: there is no such command, or help was asked for; that is printed.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    if not given:
        found = recordings_in(Path.cwd())
        sys.stdout.write(found or overview(COMMANDS))
        raise SystemExit(0 if found else 2)
    parser = _Parser(prog="mjrec", usage="mjrec COMMAND [OPTION ...]")
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(metavar="COMMAND", required=True, dest="command")
    for name in COMMANDS:
        commands.add_parser(name, add_help=False, prefix_chars="\0")
    parser.parse_args(given[:1])
    if len(given) == 1 and given[0] in EXAMPLES:
        sys.stderr.write(examples(given[0]))
        raise SystemExit(2)
    return given


def _version() -> str:
    return f"mjrec {importlib.metadata.version('mjrec')}"


@contextlib.contextmanager
def _warnings_on_stderr() -> Iterator[None]:
    # Only what mjrec says: MuJoCo's remarks on other people's models are not news here.
    logging.getLogger("absl").setLevel(logging.ERROR)
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    handler.addFilter(_OnceInARun())
    logger = logging.getLogger("mjrec")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _OnceInARun(logging.Filter):
    """Lets MuJoCo's warnings pass once of each kind, and one traceback.

    Each worker has its own, at its own time.
    """

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        if _TRACEBACK in text:
            kind = _TRACEBACK
        elif text.startswith("MuJoCo:"):
            kind = re.sub(r"[\d.]+", "", text)
        else:
            return True
        is_new = kind not in self._said
        self._said.add(kind)
        return is_new
