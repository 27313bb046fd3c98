# SPDX-License-Identifier: Apache-2.0
"""The command line: one module per command, each a thin layer over a library call."""

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

# The module and the summary of each command. The module is imported when the command
# runs, and its function has the module's name (`list_episodes`, because `list` is a
# builtin).
COMMANDS = {
    "record": ("record", "Record episodes of an environment."),
    "render": ("render", "Render pending videos, or rerender episodes."),
    "recover": ("recover", "Finish what a killed run left behind."),
    "list": ("list_episodes", "List recorded episodes."),
    "strip": ("strip", "Put the frames of an episode side by side."),
    "replay": ("replay", "Show an episode in 3D, in one HTML file."),
    "view": ("view", "Watch a run in a browser while it is running."),
    "evaluate": ("evaluate", "Evaluate a policy on tasks and seeds."),
    "compare": ("compare", "Compare evaluations."),
    "report": ("report", "Make a web page from recordings or results."),
    "pack": ("pack", "Pack a run into one file for others."),
    "verify": ("verify", "Re-run a packed run and compare."),
    "doctor": ("doctor", "Check whether this machine can render."),
    "completion": ("completion", "Print a shell completion script."),
}

_FAILED = 1
_TRACEBACK = "Traceback (most recent call last)"
_INTERRUPTED = 130  # what shells report for a process that Ctrl-C ended


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    0 means success, 1 an error with one message on stderr, and 130 an interruption by
    Ctrl-C. `SystemExit` is raised with 2 for an invalid command line, 143 for SIGTERM
    and 129 for SIGHUP. Files are always closed first. Exceptions that are not mjrec's
    own keep their traceback.

    Args:
        argv: the arguments; None for those of the process.
    """
    with _warnings_on_stderr(), exiting_on_signals():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    name, *arguments = _arguments(argv)
    module, _ = COMMANDS[name]
    try:
        command = importlib.import_module(f".{module}", __name__)
        # Imported only now, because the overview must be quick.
        from .help_text import PARSING, flowing_help

        tyro = importlib.import_module("tyro")
        status: int = tyro.cli(
            flowing_help(getattr(command, module)),
            prog=f"mjrec {name}",
            args=arguments,
            config=PARSING,
        )
        # Flush here, not at exit, so that a closed pipe raises here.
        sys.stdout.flush()
    except Error as error:
        # The only place that turns an error into a message and an exit status.
        print(f"mjrec: {error}", file=sys.stderr)  # noqa: T201
        return _FAILED
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:
        # The program that reads our output has closed the pipe (`mjrec list DIR |
        # head`). Flushing Python's buffer at exit would raise again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _FAILED
    return status


class _Parser(argparse.ArgumentParser):
    """A parser that knows the commands; its help lists them in groups."""

    def format_help(self) -> str:
        return overview(COMMANDS)


def _arguments(argv: Sequence[str] | None) -> Sequence[str]:
    """Return the arguments, beginning with a command.

    Raises:
        SystemExit: the command is unknown or missing, its arguments are missing, or
            help or the version was requested. A message has been printed.
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
    # Show only mjrec's warnings: MuJoCo's remarks on third-party models are noise here.
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
    """A filter that passes each kind of MuJoCo warning, and one traceback, only once.

    Every worker logs its own copy at a different time.
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
