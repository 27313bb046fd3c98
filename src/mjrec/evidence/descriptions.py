# SPDX-License-Identifier: Apache-2.0
"""Descriptions of a packed run: table, JSON, README, citation and crate.

The crate is an RO-Crate 1.1 that conforms to the Process Run Crate 0.5 profile. Each
monitor is a `CreateAction`: its instruments are the recording software, its objects are
the environment, the models and the policy, and its results are the monitor's files.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib.metadata
import io
import json
import platform
import shlex
import urllib.parse
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py

from .. import json_text
from ..errors import MissingDependency
from ..formats.json_fields import facts_in, read_object, unreadable
from ..formats.monitor_directory import episode_of
from ..plain_text import listed
from ..results import Episode, iter_episodes
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
from .statements import Author

# Maximum number of rows in the table of videos. The statistics list all videos.
_MOST_VIDEOS = 200
# Maximum number of monitors to name for a value that only some monitors have.
_MOST_MONITORS = 3
_UNKNOWN = "not recorded"
_FORMATS = {
    ".json": "application/json",
    ".jsonl": "application/jsonl",
    ".mp4": "video/mp4",
    ".avi": "video/x-msvideo",
    ".framehash": "text/plain",
    ".h5": "application/x-hdf5",
    ".gz": "application/gzip",
    ".zip": "application/zip",
    ".csv": "text/csv",
    ".md": "text/markdown",
    ".cff": "application/yaml",
}
_DESCRIPTIONS = {
    README: "What this is, and how to verify it",
    CITATION: "How to cite it",
    ENVIRONMENT: "What the recordings were made with",
    STATISTICS: "A row for each complete episode",
}
_HOMES = {
    "mjrec": "https://pypi.org/project/mjrec/",
    "mujoco": "https://mujoco.org/",
    "gymnasium": "https://gymnasium.farama.org/",
    "dm-control": "https://github.com/google-deepmind/dm_control",
    "numpy": "https://numpy.org/",
    "imageio-ffmpeg": "https://pypi.org/project/imageio-ffmpeg/",
    "python": "https://www.python.org/",
}


def descriptions(
    run: PackedRun, recordings: Path, *, packed_with: Mapping[str, str]
) -> dict[str, str]:
    """Return the contents of all descriptions, keyed by file name.

    The descriptions depend only on the recordings and the arguments.

    Args:
        run: the packed run to describe.
        recordings: the folder of the packed recordings.
        packed_with: the versions of the software that packs the run.

    Raises:
        UnreadableFile: a file is damaged.
        MissingDependency: Jinja is not installed.
    """
    texts = {
        README: _rendered("README.md.jinja", run, finalize=_markdown),
        CITATION: _rendered("CITATION.cff.jinja", run, finalize=_json),
        ENVIRONMENT: _json_text(_environment(run, packed_with)),
        STATISTICS: _statistics(recordings),
    }
    files = [_file(name, name, len(text.encode())) for name, text in texts.items()]
    recorded = [
        _file(path.name, _recording_id(path.name), path.stat().st_size)
        for path in sorted(recordings.iterdir())
    ]
    crate: dict[str, Any] = json.loads(
        _rendered(
            f"{CRATE}.jinja", run, finalize=_json, files=files, recordings=recorded
        )
    )
    # Each entity appears once, and unknown values are left out.
    graph: dict[str, Any] = {}
    for entity in crate["@graph"]:
        known = {key: value for key, value in entity.items() if value is not None}
        graph.setdefault(entity["@id"], known)
    return {**texts, CRATE: _json_text({**crate, "@graph": list(graph.values())})}


def packed_with() -> dict[str, str]:
    """Return the versions of the software that packs runs on this machine."""
    return {
        "mjrec": importlib.metadata.version("mjrec"),
        "python": platform.python_version(),
        # These determine the bytes of trajectories and compressed files.
        "hdf5": h5py.version.hdf5_version,
        "zlib": zlib.ZLIB_RUNTIME_VERSION,
    }


def _statistics(recordings: Path) -> str:
    """Return the table of the episodes, in the order of `iter_episodes`.

    The columns are `layout.STATISTICS_COLUMNS`. Numbers round-trip exactly, unknown
    values are empty, booleans are `true` or `false`, and seeds are JSON.
    """
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(STATISTICS_COLUMNS)
    for episode in iter_episodes(recordings):
        cells = _cells(episode)
        row = [cells[column] for column in STATISTICS_COLUMNS]
        # `csv` writes None as an empty cell, and floats exactly.
        writer.writerow(str(c).lower() if isinstance(c, bool) else c for c in row)
    return file.getvalue()


def _environment(run: PackedRun, packed_with: Mapping[str, str]) -> dict[str, Any]:
    """Return the content of `environment.json`.

    Returns:
        `recordings`: for each infix of a monitor, `env_id`, `versions`, `provenance`
        (null if not recorded), and `pictures` and `encoders`, the distinct renderers
        and encoders of its videos. `packed_with`: the versions of the software that
        packed the archive, and the packing options.
    """
    return {
        "recordings": {session.infix: _made_with(session) for session in run.sessions},
        "packed_with": {**packed_with, "options": dataclasses.asdict(run.options)},
    }


def _made_with(session: Session) -> dict[str, Any]:
    frames = ("gl_vendor", "gl_renderer", "gl_version", "rendered_with")
    encoders = [
        {
            "version": facts_in(facts["encoder_version"]).get("version"),
            "ffmpeg_sha256": facts["ffmpeg_sha256"],
        }
        for facts in session.different("encoder_version", "ffmpeg_sha256")
    ]
    return {
        "env_id": session.env_id,
        "versions": dict(session.versions),
        "provenance": session.provenance or None,
        "pictures": session.different(*frames),
        # Encoders that differ only in their command lines count as one here.
        "encoders": [one for n, one in enumerate(encoders) if one not in encoders[:n]],
    }


def _made_with_rows(sessions: Sequence[Session]) -> Iterator[tuple[str, str, str]]:
    """Yield the facts that the README lists, each with its value and its monitors."""
    monitors: dict[str, dict[str, list[str]]] = {}
    for session in sessions:
        for what, value in _shown_facts(session).items():
            monitors.setdefault(what, {}).setdefault(value, []).append(session.infix)
    for what, values in monitors.items():
        for value, infixes in values.items():
            is_of_all = len(infixes) == len(sessions)
            yield what, value, "all" if is_of_all else listed(infixes, _MOST_MONITORS)


def _shown_facts(session: Session) -> dict[str, str]:
    said = session.provenance
    cpu, machine, code, policy = (
        facts_in(said.get(name)) for name in ("cpu", "machine", "code", "policy")
    )
    drawn_with = [str(each["gl_renderer"]) for each in session.different("gl_renderer")]
    versions = [f"{name} {version}" for name, version in session.versions.items()]
    command = said.get("command")
    made_with = [arguments or "its defaults" for arguments in session.made_with]
    shown = {
        "system": said.get("system") or _UNKNOWN,
        "CPU": cpu.get("model") or _UNKNOWN,
        "C library": machine.get("libc") or _UNKNOWN,
        "versions": ", ".join(versions) or _UNKNOWN,
        "OpenGL": ", ".join(drawn_with) or _UNKNOWN,
    }
    if any(session.made_with):
        arguments = "; in other episodes with ".join(made_with)
        shown["environment"] = f"{session.env_id}, made with {arguments}"
    if isinstance(command, list):
        shown["command"] = " ".join(map(str, command))
    if code:
        changed = " with uncommitted changes" if code.get("dirty") else ""
        shown["code"] = f"git commit {code.get('commit')}{changed}"
    if policy:
        shown["policy"] = f"{policy.get('file')}, sha256 {policy.get('sha256')}"
    return {what: str(value) for what, value in shown.items()}


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


def _rendered(
    name: str, run: PackedRun, *, finalize: Callable[[Any], str], **facts: Any
) -> str:
    """Render a template for a run; `finalize` formats each value."""
    # Jinja2 is part of the extra `evidence`, so it is not imported with this module.
    try:
        import jinja2
    except ImportError as error:
        raise MissingDependency(
            "Jinja2", purpose="Packing a run", install='pip install "mjrec[evidence]"'
        ) from error
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("mjrec.evidence"),
        # Any part of the provenance may be missing.
        undefined=jinja2.ChainableUndefined,
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters.update(
        release=_release,
        author_id=_author_id,
        action_id=_action_id,
        environment_id=_environment_id,
        policy_id=_policy_id,
        recording_id=_recording_id,
        instruments=_instruments,
        objects=_objects,
        episode=episode_of,
        shell=lambda text: _Verbatim(shlex.quote(text)),
    )
    return templates.get_template(name).render(
        run=run,
        format=f"{FORMAT_KEY} {FORMAT_VERSION}",
        videos=[video for session in run.sessions for video in session.videos],
        most_videos=_MOST_VIDEOS,
        made_with=_made_with_rows(run.sessions),
        unknown=_UNKNOWN,
        homes=_HOMES,
        references=_references,
        **facts,
    )


class _Verbatim(str):
    """A string that is not escaped."""

    __slots__ = ()


def _markdown(value: object) -> str:
    """Return an untrusted string, escaped so that Markdown shows it as plain text."""
    if isinstance(value, _Verbatim):
        return value
    line = " ".join(str(value).split())
    for sign, written in (("<", "&lt;"), ("|", "\\|"), ("`", "'"), ("[", "\\[")):
        line = line.replace(sign, written)
    return line


def _json(value: object) -> str:
    # A JSON string is also a double-quoted YAML scalar, unless characters are escaped
    # as surrogate pairs.
    return json.dumps(value, ensure_ascii=False)


def _json_text(content: Any) -> str:
    return json_text.dumps(content, indent=2) + "\n"


def _file(name: str, entity_id: str, size: int) -> dict[str, Any]:
    return {
        "id": entity_id,
        "name": name,
        "size": str(size),
        "format": _FORMATS.get(Path(name).suffix),
        "description": _DESCRIPTIONS.get(name),
    }


def _instruments(session: Session) -> list[str]:
    # mjrec comes first. Recordings by gym have no versions.
    versions = sorted(session.versions.items(), key=lambda item: item[0] != "mjrec")
    return [_release(*each) for each in versions or [("gym", "")]]


def _objects(session: Session) -> list[str]:
    policy = _policy_id(session)
    models = map(_recording_id, session.models)
    return [_environment_id(session), *([policy] if policy else []), *models]


def _release(name: str, version: str) -> str:
    """Return the URL of one version of Python or of a package."""
    if name == "python":
        return f"https://docs.python.org/release/{_quoted(version)}/"
    page = f"https://pypi.org/project/{_quoted(name)}/"
    return f"{page}{_quoted(version)}/" if version else page


def _environment_id(session: Session) -> str:
    return f"#environment-{_uuid('environment', session.env_id)}"


def _policy_id(session: Session) -> str | None:
    digest = facts_in(session.provenance.get("policy")).get("sha256")
    return f"#policy-{_uuid('policy', str(digest))}" if digest else None


def _recording_id(name: str) -> str:
    return f"{RECORDINGS}/{urllib.parse.quote(name)}"


def _author_id(author: Author) -> str:
    return author.orcid or f"#author-{_uuid('author', author.name, author.email or '')}"


def _action_id(session: Session) -> str:
    facts = (session.infix, session.env_id, str(session.tally.start), *session.files)
    return f"urn:uuid:{_uuid('recording', *facts)}"


def _uuid(*texts: str) -> uuid.UUID:
    """Return a UUID that is determined by the strings."""
    return uuid.uuid5(uuid.NAMESPACE_URL, "\0".join(["mjrec", *texts]))


def _quoted(text: str) -> str:
    return urllib.parse.quote(text, safe="")


def _references(ids: Iterable[str]) -> Any:
    """Return references to entities: a list, a single reference on its own, or None."""
    references = [{"@id": one} for one in ids]
    return references[0] if len(references) == 1 else references or None
