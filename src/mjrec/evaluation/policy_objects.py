# SPDX-License-Identifier: Apache-2.0
"""Policies on their way to the workers: as a text, or as an object's bytes.

What a policy is made of has a digest each, so that nothing is added to the results of
another one: the source of its module, the files that its arguments name, an object's
pickled content.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..atomic_files import file_sha256
from ..environments.names import working_directory_importable
from ..errors import PolicyError


@dataclass(frozen=True)
class SentPolicy:
    """A policy that can be sent.

    Attributes:
        name: what was given as a text, or what the object is called.
        payload: the object's bytes; None for a text.
        digests: SHA-256 of its parts, by what they are.
    """

    name: str
    payload: bytes | None = None
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_object(self) -> bool:
        """Whether it is an object."""
        return self.payload is not None


def sent_policy(policy: Any, kwargs: Mapping[str, Any]) -> SentPolicy:
    """Return a policy as it is sent.

    Args:
        policy: a text as in `mjrec record`; or a function, something with `predict`,
            or a class that is built with each environment.
        kwargs: more arguments for it.

    Raises:
        PolicyError: it can be no policy, or cannot be pickled.
    """
    arguments = {
        f"the file of its argument {name}": digest
        for name, value in kwargs.items()
        if isinstance(value, str) and (digest := _file_digest(Path(value)))
    }
    if isinstance(policy, str):
        return SentPolicy(policy, None, {**_digests_of_text(policy), **arguments})
    if not (callable(policy) or callable(getattr(policy, "predict", None))):
        raise PolicyError(
            f"The policy {policy!r:.200} neither can be called nor has predict(). Give "
            "such an object, a class that is built with the environment, or a text: "
            "random, zero, module:name or module:name()."
        )
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    module = inspect.getmodule(named)
    name = str(named.__qualname__)
    name = name if module is None else f"{module.__name__}:{name}"
    payload = _pickled(policy, name)
    digests = {"its content": _digest_of_pickle(payload)}
    source = getattr(module, "__file__", None)
    if source is not None and (digest := _file_digest(Path(source))):
        digests["its code"] = digest
    return SentPolicy(name, payload, {**digests, **arguments})


def _digests_of_text(policy: str) -> dict[str, str]:
    """Return the digest of the file that a text names, or of its module's source."""
    module, colon, _ = policy.partition(":")
    if not colon:
        digest = _file_digest(Path(policy))
        return {} if digest is None else {"its file": digest}
    source = getattr(sys.modules.get(module), "__file__", None)
    try:
        if source is None:
            with working_directory_importable():
                found = importlib.util.find_spec(module)
            source = None if found is None else found.origin
    except Exception:
        # Importing it, which the workers do, says what is wrong with it.
        return {}
    digest = None if source is None else _file_digest(Path(source))
    return {} if digest is None else {"its code": digest}


def _file_digest(path: Path) -> str | None:
    try:
        return file_sha256(path) if path.is_file() else None
    except OSError:
        return None


def _pickled(policy: Any, name: str) -> bytes:
    # Not at the top: it is gymnasium's, which is only needed where things are run.
    # What is pickled goes through our own pipe, to processes of ours.
    import cloudpickle  # type: ignore[import-untyped]  # it has no types

    try:
        payload: bytes = cloudpickle.dumps(policy)
    except Exception as error:
        raise PolicyError(
            f"The policy {name} cannot be sent to the processes that run it: "
            f"{type(error).__name__}: {error}. Give its name instead, "
            "policy='module:name': each process then imports it, and builds a class "
            "with its environment."
        ) from error
    return payload


def _digest_of_pickle(payload: bytes) -> str:
    from cloudpickle import cloudpickle

    # Classes that are sent whole get a random name in each process.
    names = getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_CLASS", {})
    for name in names.values():
        payload = payload.replace(name.encode(), b"0" * len(name))
    return hashlib.sha256(payload).hexdigest()
