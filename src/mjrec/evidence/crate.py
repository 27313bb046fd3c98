# SPDX-License-Identifier: Apache-2.0
"""What the template of `ro-crate-metadata.json` is given: identifiers and files.

The crate is an RO-Crate 1.1 with the profile Process Run Crate 0.5, which is made for
it: one `CreateAction` for each monitor, whose instrument is what recorded, whose
objects are the environment, the models and the policy, and whose results are its files.
"""

from __future__ import annotations

import json
import urllib.parse
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from .layout import CITATION, ENVIRONMENT, README, RECORDINGS, STATISTICS
from .packed_run import Session
from .statements import Author

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


def crate_facts(payload: Path) -> dict[str, Any]:
    """Return what the template needs besides the run.

    Args:
        payload: the folder of the crate, in which all other files are.
    """
    recordings = sorted((payload / RECORDINGS).iterdir())
    return {
        "files": [_file(payload / name, name) for name in _DESCRIPTIONS],
        "recordings": [_file(path, _recording_id(path.name)) for path in recordings],
        "homes": _HOMES,
        "references": _references,
    }


def crate_filters() -> Mapping[str, Callable[..., Any]]:
    """Return the filters of the template."""
    return {
        "release": _release,
        "author_id": _author_id,
        "action_id": _action_id,
        "environment_id": _environment_id,
        "policy_id": _policy_id,
        "recording_id": _recording_id,
        "instruments": _instruments,
        "objects": _objects,
    }


def finished_crate(text: str) -> dict[str, Any]:
    """Return what the template made: each entity once, without unknown facts."""
    crate: dict[str, Any] = json.loads(text)
    graph: dict[str, Any] = {}
    for entity in crate["@graph"]:
        known = {key: value for key, value in entity.items() if value is not None}
        graph.setdefault(entity["@id"], known)
    return {**crate, "@graph": list(graph.values())}


def _file(path: Path, entity_id: str) -> dict[str, Any]:
    return {
        "id": entity_id,
        "name": path.name,
        # A description of the crate says the sizes of files that are there already.
        "size": str(path.stat().st_size),
        "format": _FORMATS.get(path.suffix),
        "description": _DESCRIPTIONS.get(path.name),
    }


def _instruments(session: Session) -> list[str]:
    # Who recorded, first; recordings of gym have nothing of ours.
    versions = sorted(session.versions.items(), key=lambda item: item[0] != "mjrec")
    return [_release(*each) for each in versions or [("gym", "")]]


def _objects(session: Session) -> list[str]:
    policy = _policy_id(session)
    models = map(_recording_id, session.models)
    return [_environment_id(session), *([policy] if policy else []), *models]


def _release(name: str, version: str) -> str:
    """Return the page of one version of Python or of a package."""
    if name == "python":
        return f"https://docs.python.org/release/{_quoted(version)}/"
    page = f"https://pypi.org/project/{_quoted(name)}/"
    return f"{page}{_quoted(version)}/" if version else page


def _environment_id(session: Session) -> str:
    return f"#environment-{_uuid('environment', session.env_id)}"


def _policy_id(session: Session) -> str | None:
    policy = session.surroundings.get("policy")
    digest = policy.get("sha256") if isinstance(policy, Mapping) else None
    return f"#policy-{_uuid('policy', str(digest))}" if digest else None


def _recording_id(name: str) -> str:
    return f"{RECORDINGS}/{urllib.parse.quote(name)}"


def _author_id(author: Author) -> str:
    return author.orcid or f"#author-{_uuid('author', author.name, author.email or '')}"


def _action_id(session: Session) -> str:
    told = (session.infix, session.env_id, str(session.tally.start), *session.files)
    return f"urn:uuid:{_uuid('recording', *told)}"


def _uuid(*texts: str) -> uuid.UUID:
    """Return what is always the same for the same texts."""
    return uuid.uuid5(uuid.NAMESPACE_URL, "\0".join(["mjrec", *texts]))


def _quoted(text: str) -> str:
    return urllib.parse.quote(text, safe="")


def _references(ids: Iterable[str]) -> Any:
    """Return what leads to entities; to one alone without a list, as JSON-LD has it."""
    references = [{"@id": one} for one in ids]
    return references[0] if len(references) == 1 else references or None
