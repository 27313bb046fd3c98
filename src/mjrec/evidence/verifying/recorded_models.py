# SPDX-License-Identifier: Apache-2.0
"""The model of a recorded episode: from the archive's sources, from the registry.

A compiled model in an archive is never loaded: MuJoCo believes what stands in it, and
it says nothing of where it comes from. What is compared is what the archive's sources
compile to, with the changes that the episode recorded, and what the installed
environment has at the beginning of that episode, field by field.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ...errors import Error, UnreadableFile
from ...formats.trajectory import TrajectoryReader
from ...simulation.fields import changed_model, differing_fields
from ...simulation.model_store import load_model, saved_model

_ZIP = re.compile(r"openaigym\.model\.[0-9a-f]{16}\.zip", re.ASCII)

# What no step depends on.
_PICTURES = re.compile(
    r"(mat|tex|light|cam|skin)_\w+|\w+_(rgba|matid|group)|site_(size|type)"
    r"|(vis|stat|camera|option)\..*"
)
# How large a picture may be, which Gymnasium sets to what was asked for.
_SIZES = frozenset(("vis.global_.offwidth", "vis.global_.offheight"))
_MOST_KEPT = 2


def is_of_pictures(name: str) -> bool:
    """Tell whether a field of a model is one that only pictures depend on."""
    return _PICTURES.fullmatch(name) is not None


def first_changes(reader: TrajectoryReader) -> dict[str, NDArray[Any]]:
    """Return what the episode's model is other in than the stored one, from step 0."""
    fields: dict[str, NDArray[Any]] = {}
    for change in reader.iter_model_changes():
        if change.step > 0:
            break
        fields.update(change.fields)
    return fields


@dataclass(frozen=True)
class ModelComparison:
    """What two models of one episode have in common.

    Attributes:
        differing: the names of fields that are not the same.
        trouble: why no setting of fields makes one of the other; "" if one does.
    """

    differing: tuple[str, ...] = ()
    trouble: str = ""

    @property
    def is_same(self) -> bool:
        """Whether nothing differs."""
        return not self.differing and not self.trouble

    def __str__(self) -> str:
        if self.trouble:
            return self.trouble
        more = f" and {len(self.differing) - 5} more" if len(self.differing) > 5 else ""
        return f"{', '.join(self.differing[:5])}{more} differ"


class RecordedModels:
    """The models of one directory of recordings.

    Args:
        directory: of the recordings, only read.

    Attributes:
        made_again: the sha256 of compiled models that were made again here, byte for
            byte, from what is installed: nobody has crafted what has one of these.
    """

    def __init__(self, directory: Path) -> None:
        self.made_again: set[str] = set()
        self._directory = directory
        # Compiling one takes half a second, and a process; so does being refused.
        self._compiled: dict[tuple[str, int], Any] = {}
        self._known: dict[str, Any] = {}

    def from_sources(self, facts: Mapping[str, Any]) -> Any:
        """Return the model that the archive's sources compile to.

        Raises:
            UnreadableFile: there are none, or they are damaged, dangerous or refused.
        """
        model = facts.get("model")
        if not isinstance(model, Mapping):
            raise UnreadableFile(self._directory, "the recording names no model")
        name, size = model.get("xml"), model.get("bytes")
        if not isinstance(name, str) or not _ZIP.fullmatch(name):
            raise UnreadableFile(
                self._directory, "what the model was made from was not recorded"
            )
        if not (self._directory / name).is_file():
            raise UnreadableFile(self._directory / name, "it is not there")
        found = self._compiled_once(name, size if type(size) is int else 0)
        if isinstance(found, UnreadableFile):
            raise found
        return found

    def note(self, sha256: str, model: Any) -> None:
        """Keep a model that was made here and is, once compiled, of this hash."""
        self.made_again.add(sha256)
        if sha256 not in self._known:
            _make_room(self._known)
            self._known[sha256] = changed_model(model, {})

    def known(self, sha256: str) -> Any:
        """Return the model that was noted, or None."""
        return self._known.get(sha256)

    def _compiled_once(self, name: str, size: int) -> Any:
        key = (name, size)
        if key not in self._compiled:
            _make_room(self._compiled)
            try:
                # Without the compiled model's name: that is never loaded.
                facts = {"xml": name, "bytes": size}
                self._compiled[key] = load_model(self._directory, facts)
            except UnreadableFile as error:
                self._compiled[key] = error
        return self._compiled[key]


def compare_models(
    stored: Any, changes: Mapping[str, NDArray[Any]], present: Any
) -> ModelComparison:
    """Compare a stored model, with an episode's changes, and one that is there.

    The size of pictures does not count.
    """
    if not changes and saved_model(stored).tobytes() == saved_model(present).tobytes():
        return ModelComparison()
    try:
        names = differing_fields(changed_model(stored, changes), present)
    except (Error, ValueError) as error:
        return ModelComparison(trouble=str(error).rstrip("."))
    return ModelComparison(differing=tuple(n for n in names if n not in _SIZES))


def _make_room(kept: dict[Any, Any]) -> None:
    if len(kept) >= _MOST_KEPT:
        del kept[next(iter(kept))]
