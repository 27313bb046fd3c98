# SPDX-License-Identifier: Apache-2.0
"""Whether two recorded episodes are the same, number for number."""

from __future__ import annotations

import hashlib
from collections import defaultdict

import numpy as np

from ...formats.trajectory import TrajectoryReader
from ...json_text import dumps
from .findings import Findings

_CHUNK = 4096
_MOST_NAMED = 20


class RepeatedEpisodes:
    """Gathers the recorded episodes of one monitor: of each a hash is kept."""

    def __init__(self) -> None:
        self._alike: dict[bytes, list[int]] = defaultdict(list)

    def note(self, number: int, reader: TrajectoryReader) -> None:
        """Note an episode: its seed, its actions and its rewards.

        Raises:
            UnreadableFile: it is damaged.
        """
        digest = hashlib.sha256()
        digest.update(dumps(reader.facts.get("seed")).encode())
        # What is not recorded is told by the states; they say the controls too.
        rows, total = reader.actions, reader.step_count
        if reader.kind("action") is None:
            rows, total = reader.states, reader.row_count
        for start in range(0, total, _CHUNK):
            values = rows(start, min(start + _CHUNK, total))
            digest.update(np.ascontiguousarray(values).tobytes())
        digest.update(reader.rewards.tobytes())
        self._alike[digest.digest()].append(number)

    def look(self, found: Findings) -> None:
        """Let `found` know of those that are the same, and of those that are not."""
        for numbers in self._alike.values():
            if len(numbers) == 1:
                found.look(f"episode {numbers[0]}")
                continue
            more = " and more" if len(numbers) > _MOST_NAMED else ""
            named = ", ".join(map(str, numbers[:_MOST_NAMED]))
            found.cannot_tell(
                f"episodes {named}{more} have the same seed, actions and rewards: a "
                "policy without chance was begun from one seed again, or one episode "
                "was copied as another; either way it is evidence of one episode"
            )
