# SPDX-License-Identifier: Apache-2.0
"""What says what is in a packed run: tables, JSON, README and citation."""

from __future__ import annotations

import csv
import dataclasses
import importlib.metadata
import json
import platform
import shlex
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import json_text
from ..errors import MissingDependency
from ..formats.json_fields import read_object, unreadable
from ..formats.monitor_directory import episode_of
from ..results import Episode, iter_episodes
from .crate import crate_facts, crate_filters, finished_crate
from .layout import (
    CITATION,
    CRATE,
    ENVIRONMENT,
    FORMAT_KEY,
    FORMAT_VERSION,
    README,
    RECORDINGS,
    STATISTICS,
    STATISTICS_COLUMNS,
)
from .packed_run import PackedRun, Session

# Of the table of videos; the statistics have them all.
_MOST_VIDEOS = 200


def write_descriptions(run: PackedRun, payload: Path) -> None:
    """Write all of them; the crate last, which names the rest.

    Raises:
        UnreadableFile: a file is damaged.
        MissingDependency: Jinja is not installed.
    """
    write_statistics(payload / RECORDINGS, payload / STATISTICS)
    _write_json(payload / ENVIRONMENT, environment(run))
    _write(payload / README, _rendered("README.md.jinja", run, finalize=_markdown))
    _write(payload / CITATION, _rendered("CITATION.cff.jinja", run, finalize=_json))
    text = _rendered(f"{CRATE}.jinja", run, finalize=_json, **crate_facts(payload))
    _write_json(payload / CRATE, finished_crate(text))


def write_statistics(recordings: Path, path: Path) -> None:
    """Write the table of the episodes of a monitor directory.

    Its columns are `layout.STATISTICS_COLUMNS`. The episodes come in the order of
    `iter_episodes`. Numbers are written so that reading them gives the same bits;
    what is not known is empty; truth is `true` or `false`; a seed is JSON.

    Raises:
        UnreadableFile: a file is damaged.
    """
    with path.open("x", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(STATISTICS_COLUMNS)
        for episode in iter_episodes(recordings):
            cells = _cells(episode)
            writer.writerow(_cell(cells[column]) for column in STATISTICS_COLUMNS)


def environment(run: PackedRun) -> dict[str, Any]:
    """Return the content of `environment.json`.

    Returns:
        `recordings`: for each monitor, by its infix, `env_id`, `versions`,
        `surroundings` (null where the recording says nothing of them), and `pictures`
        and `encoders`, each different one that made a video of it. `packed_with`: the
        versions of what has made this archive, and the options of packing.
    """
    return {
        "recordings": {session.infix: _made_with(session) for session in run.sessions},
        "packed_with": {
            "mjrec": importlib.metadata.version("mjrec"),
            "bagit": importlib.metadata.version("bagit"),
            "python": platform.python_version(),
            # What deflates, to the very byte.
            "zlib": zlib.ZLIB_RUNTIME_VERSION,
            "options": dataclasses.asdict(run.options),
        },
    }


def _made_with(session: Session) -> dict[str, Any]:
    pictures = ("gl_vendor", "gl_renderer", "gl_version", "rendered_with")
    encoders = [
        {
            "version": facts["encoder_version"].get("version")
            if isinstance(facts["encoder_version"], dict)
            else None,
            "ffmpeg_sha256": facts["ffmpeg_sha256"],
        }
        for facts in session.different("encoder_version", "ffmpeg_sha256")
    ]
    return {
        "env_id": session.env_id,
        "versions": dict(session.versions),
        "surroundings": session.surroundings or None,
        "pictures": session.different(*pictures),
        # Which also differ by their command lines.
        "encoders": [one for n, one in enumerate(encoders) if one not in encoders[:n]],
    }


def _cells(episode: Episode) -> dict[str, Any]:
    metadata: Any = {}
    if episode.video is not None and episode.metadata is not None:
        with unreadable(episode.metadata):
            metadata = read_object(episode.metadata)
    return {
        **vars(episode),
        "reward": float(episode.reward),
        "seed": None if episode.seed is None else json_text.dumps(episode.seed),
        "video": episode.video and episode.video.name,
        "video_sha256": metadata.get("file_sha256"),
        "trajectory": episode.trajectory and episode.trajectory.name,
    }


def _cell(value: object) -> str:
    match value:
        case None:
            return ""
        case bool():
            return "true" if value else "false"
        case float():
            return repr(value)
        case _:
            return str(value)


def _rendered(
    name: str, run: PackedRun, *, finalize: Callable[[Any], str], **facts: Any
) -> str:
    """Return what a template makes of a run; each value passes through `finalize`."""
    # Of the extra `evidence`, so it is not imported with this module.
    try:
        import jinja2
    except ImportError as error:
        raise MissingDependency(
            "Jinja2", purpose="Packing a run", install='pip install "mjrec[evidence]"'
        ) from error
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("mjrec.evidence"),
        # What recordings say of their surroundings may lack anything.
        undefined=jinja2.ChainableUndefined,
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters.update(
        crate_filters(),
        episode=episode_of,
        shell=lambda text: _Verbatim(shlex.quote(text)),
    )
    return templates.get_template(name).render(
        run=run,
        format=f"{FORMAT_KEY} {FORMAT_VERSION}",
        videos=[video for session in run.sessions for video in session.videos],
        most_videos=_MOST_VIDEOS,
        unknown="not recorded",
        **facts,
    )


class _Verbatim(str):
    """A text that is not escaped."""

    __slots__ = ()


def _markdown(value: object) -> str:
    """Return a text of a stranger, such that it is text and no more."""
    if isinstance(value, _Verbatim):
        return value
    line = " ".join(str(value).split())
    return line.replace("<", "&lt;").replace("|", "\\|").replace("`", "'")


def _json(value: object) -> str:
    # A JSON string is a double-quoted YAML scalar too, as long as nothing is escaped as
    # a pair of surrogates.
    return json.dumps(value, ensure_ascii=False)


def _write_json(path: Path, content: Any) -> None:
    _write(path, json_text.dumps(content, indent=2) + "\n")


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
