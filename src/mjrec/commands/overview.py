# SPDX-License-Identifier: Apache-2.0
"""The list of commands, usage examples, and a summary of a directory's recordings."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

# The commands, grouped by purpose.
GROUPS = {
    "Record and render": (
        *("record", "render", "list", "strip", "replay", "view", "recover"),
    ),
    "Evaluate": ("evaluate", "compare", "report"),
    "Share": ("pack", "verify"),
    "Help": ("doctor", "completion"),
}

# Shown when a command is run without arguments.
EXAMPLES = {
    "record": (
        "mjrec record HalfCheetah-v5 --out recordings/first",
        "mjrec record dm_control/walker-walk --out recordings/walker --episodes 10",
    ),
    "render": (
        "mjrec render recordings/first",
        "mjrec render recordings/first --episode 1 --camera side --size 640x480",
    ),
    "list": ("mjrec list recordings/first",),
    "view": ("mjrec view recordings/first",),
    "replay": ("mjrec replay recordings/first --episode 1 --out replay.html",),
    "strip": ("mjrec strip openaigym.video.0.4711.video000001.mp4 -o strip.png",),
    "recover": ("mjrec recover recordings/first",),
    "evaluate": (
        "mjrec evaluate dm_control/walker-walk --policy module:Policy --out results",
        "mjrec evaluate --resume results",
    ),
    "compare": ("mjrec compare results-before results",),
    "report": ("mjrec report results -o report",),
    "pack": ("mjrec pack recordings/first -o run.zip",),
    "verify": ("mjrec verify run.zip",),
}

_MOST_SHOWN = 10


def overview(commands: Mapping[str, tuple[str, str]]) -> str:
    """Return the list of commands in groups, with their summaries."""
    width = max(map(len, commands))
    lines = ["mjrec COMMAND [OPTION ...]: a headless MuJoCo recorder", ""]
    for group, names in GROUPS.items():
        lines.append(group)
        lines += (f"  {name:{width}}  {commands[name][1]}" for name in names)
    lines += ["", "mjrec COMMAND --help shows the options of a command."]
    return "\n".join(lines) + "\n"


def examples(command: str) -> str:
    """Return usage examples for a command that was run without arguments."""
    lines = [f"mjrec {command} needs arguments. For example:"]
    lines += (f"  {example}" for example in EXAMPLES[command])
    lines.append(f"All options: mjrec {command} --help")
    return "\n".join(lines) + "\n"


def recordings_in(directory: Path) -> str:
    """Return a summary of the recordings in a directory, and commands for using them.

    The directory and the two levels below it are searched. The summary is empty if
    nothing is found, or if a directory cannot be listed.
    """
    try:
        places = list(itertools.islice(_places(directory, 2), _MOST_SHOWN + 1))
    except OSError:
        return ""
    lines, pending = [], None
    for place in places[:_MOST_SHOWN]:
        shown = str(place.relative_to(directory))
        summary, has_pending = _summary(place)
        lines.append(f"{shown}: {summary}")
        pending = pending or (shown if has_pending else None)
    if not lines:
        return ""
    if len(places) > _MOST_SHOWN:
        lines.append("and more")
    first = places[0].relative_to(directory)
    steps = {f"mjrec list {first}": "shows its episodes"}
    if pending:
        steps[f"mjrec render {pending}"] = "renders its pending videos"
    steps[f"mjrec report {first}"] = "makes a web page from it"
    steps["mjrec --help"] = "shows all commands"
    width = max(map(len, steps))
    lines += ["", *(f"{command:{width}}  {what}" for command, what in steps.items())]
    return "\n".join(lines) + "\n"


def _places(directory: Path, levels: int) -> Iterator[Path]:
    """Yield the evaluations and monitor directories at and below a directory."""
    # Imported late so that the list of commands appears immediately.
    from ..evaluation.evaluation import is_evaluation
    from ..formats.monitor_directory import iter_monitor_files

    if is_evaluation(directory) or any(iter_monitor_files(directory)):
        yield directory
    elif levels:
        for path in sorted(directory.iterdir()):
            if path.is_dir() and not path.is_symlink() and path.name[0] != ".":
                yield from _places(path, levels - 1)


def _summary(directory: Path) -> tuple[str, bool]:
    """Return a summary of a directory, and whether it has pending videos."""
    from ..errors import Error
    from ..evaluation.evaluation import is_evaluation, results_in
    from ..plain_text import counted
    from ..results import iter_episodes

    try:
        if is_evaluation(directory):
            results = [result for result, _ in results_in(directory)]
            tasks = counted(len({result.task for result in results}), "task")
            failed = sum(result.failure is not None for result in results)
            text = f"evaluation of {tasks}, {counted(len(results), 'episode')}"
            return text + f", {failed} failed" * bool(failed), False
        episodes = list(iter_episodes(directory))
    except Error as error:
        return f"cannot be read: {error}", False
    parts = [counted(len(episodes), "episode")]
    if episodes:
        rewards = [episode.reward for episode in episodes]
        finite = [reward for reward in rewards if math.isfinite(reward)]
        if finite:
            low, high = f"{min(finite):.4g}", f"{max(finite):.4g}"
            parts.append(f"return {low}" if low == high else f"return {low} to {high}")
        if others := len(rewards) - len(finite):
            parts.append(f"{counted(others, 'return')} NaN or infinite")
    pending = sum(episode.pending for episode in episodes)
    videos = sum(episode.video is not None for episode in episodes)
    parts.append(counted(videos, "video") + f" and {pending} pending" * bool(pending))
    return ", ".join(parts), bool(pending)
