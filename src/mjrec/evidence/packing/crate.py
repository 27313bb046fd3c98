# SPDX-License-Identifier: Apache-2.0
"""`ro-crate-metadata.json`: the run as an RO-Crate that programs understand.

RO-Crate 1.1, with the profile Process Run Crate 0.5, which is made for it: one
`CreateAction` for each monitor, whose instrument is what recorded, whose objects are
the environment, the models and the policy, and whose results are its files.
"""

from __future__ import annotations

import hashlib
import urllib.parse
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..layout import (
    CITATION,
    CRATE,
    ENVIRONMENT,
    README,
    RECORDINGS,
    STATISTICS,
)
from .packed_run import PackedRun, Session, iso_time
from .statements import Author

Entity = dict[str, Any]

_CONTEXT = "https://w3id.org/ro/crate/1.1/context"
_SPECIFICATION = "https://w3id.org/ro/crate/1.1"
_PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
_SCHEMA = "http://schema.org"
_NO_LICENSE = "No licence was stated: all rights stay with the authors."

# By the endings of names, the longer ones first.
_FORMATS = (
    (".meta.json", "application/json"),
    (".json", "application/json"),
    (".jsonl", "application/jsonl"),
    (".mp4", "video/mp4"),
    (".avi", "video/x-msvideo"),
    (".framehash", "text/plain"),
    (".h5", "application/x-hdf5"),
    (".gz", "application/gzip"),
    (".zip", "application/zip"),
    (".csv", "text/csv"),
    (".md", "text/markdown"),
    (".cff", "application/yaml"),
)
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


def crate(run: PackedRun, payload: Path) -> Entity:
    """Return the content of the file.

    Args:
        run: what is described.
        payload: the folder of the crate, in which all other files are.
    """
    entities: dict[str, Entity] = {}
    for entity in _entities(run, payload):
        entities.setdefault(entity["@id"], entity)
    return {"@context": _CONTEXT, "@graph": list(entities.values())}


def _entities(run: PackedRun, payload: Path) -> Iterator[Entity]:
    yield {
        "@id": CRATE,
        "@type": "CreativeWork",
        "about": {"@id": "./"},
        "conformsTo": {"@id": _SPECIFICATION},
    }
    yield _root(run)
    yield {
        "@id": _PROFILE,
        "@type": "CreativeWork",
        "name": "Process Run Crate",
        "version": "0.5",
    }
    yield from _stated(run)
    for name, description in _DESCRIPTIONS.items():
        yield {**_file(payload / name, name), "description": description}
    recordings = sorted(path.name for path in (payload / RECORDINGS).iterdir())
    yield {
        "@id": f"{RECORDINGS}/",
        "@type": "Dataset",
        "name": "The monitor directory",
        "description": "Videos, statistics, journals, recorded states and models, as "
        "mjrec wrote them",
        "hasPart": _references(_id(name) for name in recordings),
    }
    for name in recordings:
        yield _file(payload / RECORDINGS / name, _id(name))
    for session in run.sessions:
        yield from _of_session(session, payload / RECORDINGS)


def _root(run: PackedRun) -> Entity:
    license_ = run.statements.license
    root: Entity = {
        "@id": "./",
        "@type": "Dataset",
        "name": run.title,
        "description": _description(run),
        "datePublished": run.date,
        "license": _NO_LICENSE if license_ is None else {"@id": license_.url},
        "conformsTo": {"@id": _PROFILE},
        "hasPart": _references([*_DESCRIPTIONS, f"{RECORDINGS}/"]),
        "mentions": _references(_action_id(session) for session in run.sessions),
    }
    if run.statements.authors:
        root["author"] = _references(map(_author_id, run.statements.authors))
    return root


def _description(run: PackedRun) -> str:
    chosen = (
        ""
        if run.packed_episodes is None
        else " The videos and states of some episodes only were packed, which the "
        "author chose; the statistics are of all."
    )
    return (
        f"{_count(run.episodes, 'recorded episode')} of {', '.join(run.env_ids)} with "
        f"{_count(len(run.videos), 'video')}, the physics states that they were drawn "
        f"from, and checksums of everything. To verify it: mjrec verify.{chosen}"
    )


def _stated(run: PackedRun) -> Iterator[Entity]:
    for author in run.statements.authors:
        person: Entity = {
            "@id": _author_id(author),
            "@type": "Person",
            "name": author.name,
            "familyName": author.family,
        }
        if author.given:
            person["givenName"] = author.given
        if author.email is not None:
            person["email"] = author.email
        yield person
    license_ = run.statements.license
    if license_ is not None:
        yield {
            "@id": license_.url,
            "@type": "CreativeWork",
            "name": license_.name,
            "description": "The licence of these recordings",
            "url": license_.url,
        }


def _of_session(session: Session, recordings: Path) -> Iterator[Entity]:
    """Yield how something was recorded, and what with."""
    software = list(_software(session.versions))
    yield from software
    objects = [
        {
            "@id": f"#environment-{_uuid('environment', session.env_id)}",
            "@type": "PropertyValue",
            "name": "environment",
            "value": session.env_id,
        },
        *_policy(session),
    ]
    yield from objects
    inputs = [*(entity["@id"] for entity in objects), *map(_id, session.models)]
    action: Entity = {
        "@id": _action_id(session),
        "@type": "CreateAction",
        "name": f"Recording of {session.env_id} (monitor {session.infix})",
        "description": f"{_count(session.episodes, 'complete episode')} of "
        f"{_count(session.steps, 'step')} in all; episodes with a video were chosen by "
        f"the rule {session.rule or '(not recorded)'}",
        "instrument": _references(entity["@id"] for entity in software),
        "object": _references(inputs),
        "result": _references(
            _id(name) for name in session.files if name not in session.models
        ),
        "actionStatus": f"{_SCHEMA}/CompletedActionStatus",
    }
    for key, time in (("startTime", session.start), ("endTime", session.end)):
        if iso_time(time) is not None:
            action[key] = iso_time(time)
    if session.was_killed:
        action["actionStatus"] = f"{_SCHEMA}/FailedActionStatus"
        action["error"] = "Its process was killed; what it had written was recovered."
    yield action


def _software(versions: Mapping[str, str]) -> Iterator[Entity]:
    # Who recorded, first; recordings of gym have nothing of ours.
    names = sorted(versions, key=lambda name: (name != "mjrec", name))
    for name in names or ["gym"]:
        version = versions.get(name, "unknown")
        software: Entity = {
            "@id": _release(name, version),
            "@type": "SoftwareApplication",
            "name": name,
            "softwareVersion": version,
        }
        if name in _HOMES:
            software["url"] = _HOMES[name]
        yield software


def _release(name: str, version: str) -> str:
    """Return the URL of one version of Python or of a package."""
    quoted = urllib.parse.quote(version, safe="")
    if name == "python":
        return f"https://docs.python.org/release/{quoted}/"
    return f"https://pypi.org/project/{urllib.parse.quote(name, safe='')}/{quoted}/"


def _policy(session: Session) -> Iterator[Entity]:
    policy = session.surroundings.get("policy")
    digest = policy.get("sha256") if isinstance(policy, Mapping) else None
    if isinstance(policy, Mapping) and isinstance(digest, str):
        yield {
            "@id": f"#policy-{_uuid('policy', digest)}",
            "@type": "CreativeWork",
            "name": str(policy.get("file") or "policy"),
            "description": "The file of the policy, which is not in this archive",
            "identifier": f"sha256:{digest}",
        }


def _file(path: Path, entity_id: str) -> Entity:
    entity: Entity = {
        "@id": entity_id,
        "@type": "File",
        "name": path.name,
        # A description of the crate says the sizes of files that are there already.
        "contentSize": str(path.stat().st_size),
    }
    for ending, kind in _FORMATS:
        if path.name.endswith(ending):
            entity["encodingFormat"] = kind
            break
    return entity


def _id(name: str) -> str:
    return f"{RECORDINGS}/{urllib.parse.quote(name)}"


def _author_id(author: Author) -> str:
    return author.orcid or f"#author-{_uuid('author', author.name, author.email or '')}"


def _action_id(session: Session) -> str:
    digest = hashlib.sha256(
        "\0".join([session.env_id, repr(session.start), *session.files]).encode()
    ).hexdigest()
    return f"urn:uuid:{_uuid('recording', session.infix, digest)}"


def _uuid(*texts: str) -> uuid.UUID:
    """Return what is always the same for the same texts."""
    return uuid.uuid5(uuid.NAMESPACE_URL, "\0".join(["mjrec", *texts]))


def _references(ids: Iterable[str]) -> Entity | list[Entity]:
    """Return what leads to entities; to one alone without a list, as JSON-LD has it."""
    references = [{"@id": one} for one in ids]
    return references[0] if len(references) == 1 else references


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
