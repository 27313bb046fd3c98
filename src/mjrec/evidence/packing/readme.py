# SPDX-License-Identifier: Apache-2.0
"""`README.md` of a packed run: what it is, how to check it, what is in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from ..layout import (
    CITATION,
    CRATE,
    ENVIRONMENT,
    FORMAT_KEY,
    FORMAT_VERSION,
    RECORDINGS,
    STATISTICS,
)
from .packed_run import PackedRun, PackedVideo, Session, iso_time

# Of the table of videos; the statistics have them all.
_MOST_VIDEOS = 200
_NOT_SAID = "not recorded"


def readme(run: PackedRun) -> str:
    """Return the text, in Markdown."""
    parts = (
        _head(run),
        _verifying(run),
        _inside(),
        _recordings(run),
        _choice(run),
        _videos(run),
        _environments(run),
    )
    return "\n".join(line for part in parts for line in (*part, ""))


def _head(run: PackedRun) -> Iterator[str]:
    statements = run.statements
    yield f"# {_text(run.title)}"
    yield ""
    yield (
        f"Recorded episodes of {_text(', '.join(run.env_ids))}, packed as evidence by "
        "[mjrec](https://pypi.org/project/mjrec/): the videos, the physics states and "
        "actions that they were drawn from, the statistics of every episode, and "
        f"checksums of everything. The last episode ended on {run.date} (UTC)."
    )
    yield ""
    if statements.anonymous:
        yield "- Authors: withheld for an anonymous review."
    else:
        names = [
            " ".join(filter(None, [_text(a.name), a.orcid and f"({a.orcid})"]))
            for a in statements.authors
        ]
        yield f"- Authors: {', '.join(names) or 'not stated.'}"
    license_ = statements.license
    yield (
        "- Licence: not stated; ask the authors before you use this otherwise than for "
        "checking it."
        if license_ is None
        else f"- Licence: [{_text(license_.name)}]({license_.url})"
    )
    yield f"- Format: {FORMAT_KEY} {FORMAT_VERSION}"


def _verifying(run: PackedRun) -> Iterator[str]:
    yield "## How to verify it"
    yield ""
    yield "On Linux, with Python 3.11 or newer; neither a screen nor a GPU is needed:"
    yield ""
    yield "    pip install 'mjrec[evidence]'"
    yield f"    mjrec verify {run.name}.zip"
    yield ""
    yield (
        "It says item by item what it has proved: files unchanged, statistics that "
        "follow from the rewards, states that follow from the actions, pictures that "
        "follow from the states. It runs no code from this archive. The checksums "
        "alone can be checked without mjrec, in the unpacked folder:"
    )
    yield ""
    yield "    sha512sum --check manifest-sha512.txt"
    yield ""
    yield "To look at an episode from elsewhere, or as arrays:"
    yield ""
    yield f"    mjrec render data/{RECORDINGS} --episode N --camera NAME"


def _inside() -> Iterator[str]:
    yield "## What is in it"
    yield ""
    yield "| file | what |"
    yield "|---|---|"
    yield "| `README.md` | this |"
    yield f"| `{STATISTICS}` | a row for each complete episode |"
    yield f"| `{ENVIRONMENT}` | what it was recorded, drawn and encoded with |"
    yield f"| `{CRATE}` | the same for programs: an RO-Crate, Process Run Crate |"
    yield f"| `{CITATION}` | how to cite it |"
    yield f"| `{RECORDINGS}/` | the monitor directory, as it was recorded |"


def _recordings(run: PackedRun) -> Iterator[str]:
    yield "## What was recorded"
    yield ""
    yield from _table(
        ("monitor", "environment", "episodes", "steps", "videos", "begin", "end"),
        (
            (
                session.infix,
                session.env_id,
                session.episodes,
                session.steps,
                len(session.videos),
                iso_time(session.start) or _NOT_SAID,
                iso_time(session.end) or _NOT_SAID,
            )
            for session in run.sessions
        ),
    )


def _choice(run: PackedRun) -> Iterator[str]:
    yield "## Which episodes have a video"
    yield ""
    for session in run.sessions:
        yield (
            f"- monitor {_text(session.infix)}: by the rule "
            f"`{_text(session.rule or _NOT_SAID)}`"
        )
    if run.packed_episodes is not None:
        listed = ", ".join(map(str, run.packed_episodes))
        yield ""
        yield (
            "**Of these, the author has chosen some for this archive**: the videos and "
            f"the recorded states of the episodes {listed}. Those of all others were "
            "left out; the statistics are of all episodes."
        )


def _videos(run: PackedRun) -> Iterator[str]:
    yield "## Videos"
    yield ""
    videos = run.videos
    yield from _table(
        ("file", "episode", "return", "steps", "frames", "size", "drawn"),
        (_row(video) for _, video in videos[:_MOST_VIDEOS]),
    )
    if len(videos) > _MOST_VIDEOS:
        yield ""
        yield f"and {len(videos) - _MOST_VIDEOS} more: see `{STATISTICS}`."
    if any("packed_smaller" in video.metadata for _, video in videos):
        yield ""
        yield (
            "Videos that are marked as smaller were drawn again from the recorded "
            "states, frame by frame, to make this archive small enough. Their hashes "
            "are of what is here; the videos of the recording itself have others."
        )


def _row(video: PackedVideo) -> Sequence[object]:
    said = video.metadata
    smaller = said.get("packed_smaller")
    size = f"{said.get('width')}x{said.get('height')}"
    if isinstance(smaller, Mapping):
        height, width = smaller["from"]
        size += f", smaller than {width}x{height}"
    return (
        video.name,
        video.episode_id,
        said.get("reward", ""),
        said.get("length", ""),
        said.get("frame_count", ""),
        size,
        "from recorded states" if said.get("recording") == "deferred" else "live",
    )


def _environments(run: PackedRun) -> Iterator[str]:
    yield "## What it was made with"
    yield ""
    yield f"All of it stands in `{ENVIRONMENT}`; this is what matters most."
    for session in run.sessions:
        yield ""
        yield f"### Monitor {_text(session.infix)}"
        yield ""
        for what, value in _hardware(session):
            yield f"- {what}: {_text(value)}"


def _hardware(session: Session) -> Iterator[tuple[str, str]]:
    around = session.surroundings
    cpu = around.get("cpu")
    machine = around.get("machine")
    arguments = [said or "its defaults" for said in session.made_with]
    if any(session.made_with):
        made = "; in other episodes with ".join(arguments)
        yield "Environment", f"{session.env_id}, made with {made}"
    model = cpu.get("model") if isinstance(cpu, Mapping) else None
    libc = machine.get("libc") if isinstance(machine, Mapping) else None
    yield "System", _said(around.get("system"))
    yield "CPU", _said(model)
    yield "C library", _said(libc)
    yield "Versions", _said(", ".join(f"{k} {v}" for k, v in session.versions.items()))
    drawn = dict.fromkeys(
        str(video.metadata["gl_renderer"])
        for video in session.videos
        if video.metadata.get("gl_renderer")
    )
    yield "OpenGL", _said(", ".join(drawn))
    command = around.get("command")
    if isinstance(command, list) and command:
        yield "Command", " ".join(map(str, command))
    code = around.get("code")
    if isinstance(code, Mapping):
        dirty = " with changes that are in no commit" * bool(code.get("dirty"))
        yield "Code", f"git commit {code.get('commit')}{dirty}"
    policy = around.get("policy")
    if isinstance(policy, Mapping):
        yield "Policy", f"{policy.get('file')}, sha256 {policy.get('sha256')}"


def _said(value: Any) -> str:
    return str(value) if value else _NOT_SAID


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(_text(value) for value in row)} |"


def _text(value: object) -> str:
    """Return what somebody else may have written, such that it is text and no more."""
    line = " ".join(str(value).split())
    return line.replace("<", "&lt;").replace("|", "\\|").replace("`", "'")
