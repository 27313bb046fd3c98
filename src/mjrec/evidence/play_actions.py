# SPDX-License-Identifier: Apache-2.0
"""The actions of an episode as they were given to the environment."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .inputs import EpisodeInputs


def given_actions(
    episode: EpisodeInputs, arrays: Mapping[str, NDArray[Any]]
) -> Iterator[Any]:
    """Yield the actions of an episode, each of the dtype that it was given in.

    A float32 action may give another reward than the same number as float64 does.

    Args:
        episode: its inputs.
        arrays: recorded actions by the names in the inputs.
    """
    irregular = {int(each["step"]): each for each in episode.irregular}
    recorded = arrays.get(episode.actions or "")
    for step, action in enumerate(_regular(episode, recorded)):
        yield _whole(irregular[step]) if step in irregular else action


def _regular(episode: EpisodeInputs, recorded: NDArray[Any] | None) -> Iterator[Any]:
    if recorded is None:
        yield from itertools.repeat(None, episode.steps)
    elif episode.parts is not None:
        yield from (_split(action, episode.parts) for action in recorded)
    else:
        bounds = [*(step for step, _ in episode.dtypes), len(recorded)]
        names = [name for _, name in episode.dtypes]
        yield from recorded[: bounds[0]]
        for name, (start, stop) in zip(names, itertools.pairwise(bounds), strict=True):
            yield from recorded[start:stop].astype(name)


def _split(action: NDArray[Any], parts: Any) -> dict[str, NDArray[Any]]:
    """Return the dictionary of arrays that one vector was made from."""
    taken: dict[str, NDArray[Any]] = {}
    offset = 0
    for name, shape in parts:
        size = int(np.prod(shape))
        taken[name] = action[offset : offset + size].reshape(shape)
        offset += size
    return taken


def _whole(said: Mapping[str, Any]) -> Any:
    value = said.get("value")
    return value if "dtype" not in said else np.asarray(value, said["dtype"])
