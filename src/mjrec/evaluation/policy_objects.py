# SPDX-License-Identifier: Apache-2.0
"""Policies in a form that can be sent to workers: a name or a pickled object.

A digest is stored for each part of a policy: the source file of its module, each file
named in its arguments, and the pickled content of an object. The digests prevent a
resumed evaluation from mixing the results of different policies.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..atomic_files import file_sha256
from ..environments.names import working_directory_importable
from ..errors import PolicyError


def sent_policy(
    policy: Any, kwargs: Mapping[str, Any]
) -> tuple[dict[str, Any], bytes | None]:
    """Convert a policy to a form that can be sent to workers.

    Args:
        policy: a string as in `mjrec record`, a function, an object with `predict`, or
            a class that is built with each environment.
        kwargs: keyword arguments for the policy.

    Returns:
        The plan's fields about the policy, and the pickled object; None if the policy
        is a string.

    Raises:
        PolicyError: `policy` is not a valid policy or cannot be pickled.
    """
    files: dict[str, str | None] = {
        f"the file of its argument {name}": value
        for name, value in kwargs.items()
        if isinstance(value, str)
    }
    if isinstance(policy, str):
        return _fields(policy, _digests({**_source_of(policy), **files})), None
    if not (callable(policy) or callable(getattr(policy, "predict", None))):
        raise PolicyError(
            f"The policy {policy!r:.200} is not callable and has no predict() method. "
            "Give a function, an object with predict(), a class that is built with the "
            "environment, or a string: random, zero, module:name or module:name()."
        )
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    module = inspect.getmodule(named)
    name = str(named.__qualname__)
    name = name if module is None else f"{module.__name__}:{name}"
    payload = _pickled(policy, name)
    content = {"its content": _digest_of_pickle(payload)}
    files = {"its code": getattr(module, "__file__", None), **files}
    fields = _fields(name, {**content, **_digests(files)}, is_object=True)
    return fields, payload


def _fields(
    name: str, digests: Mapping[str, str], *, is_object: bool = False
) -> dict[str, Any]:
    return {"policy": name, "policy_digests": digests, "is_object": is_object}


def _source_of(policy: str) -> dict[str, str | None]:
    """Return the policy file, or the source file of the policy's module."""
    module, colon, _ = policy.partition(":")
    if not colon:
        return {"its file": policy}
    source = getattr(sys.modules.get(module), "__file__", None)
    try:
        if source is None:
            with working_directory_importable():
                found = importlib.util.find_spec(module)
            source = None if found is None else found.origin
    except Exception:
        # The workers will import the module and report the error.
        return {}
    return {"its code": source}


def _digests(files: Mapping[str, str | None]) -> dict[str, str]:
    """Return the SHA-256 of each file that exists."""
    digests = {}
    for what, name in files.items():
        with contextlib.suppress(OSError):
            if name is not None and Path(name).is_file():
                digests[what] = file_sha256(Path(name))
    return digests


def _pickled(policy: Any, name: str) -> bytes:
    # Imported here because only an evaluation with an object needs cloudpickle, which
    # is a dependency of gymnasium. The pickle is sent through our own pipe to our own
    # processes.
    import cloudpickle  # type: ignore[import-untyped]  # it has no types

    try:
        payload: bytes = cloudpickle.dumps(policy)
    except Exception as error:
        raise PolicyError(
            f"The policy {name} cannot be sent to the worker processes: "
            f"{type(error).__name__}: {error}. Pass its name instead "
            "(policy='module:name'). Each process then imports the policy or, if it is "
            "a class, builds it with the environment."
        ) from error
    return payload


def _digest_of_pickle(payload: bytes) -> str:
    from cloudpickle import cloudpickle

    # A class that is pickled by value gets a different random name in each process.
    names = getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_CLASS", {})
    for name in names.values():
        payload = payload.replace(name.encode(), b"0" * len(name))
    return hashlib.sha256(payload).hexdigest()
