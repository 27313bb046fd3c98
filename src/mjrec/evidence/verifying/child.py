# SPDX-License-Identifier: Apache-2.0
"""The process that checks what may be anybody's, in a sandbox; run by its parent.

What it says:

- `{"level": L}`: this level's checks begin;
- `{"check": {...}}`: one is done;
- `{"count": [done, total]}`: how much of the level is done;
- `{"failure": text}`: the level's checks ended by an error of ours;
- `{"end": true}`: all levels are done.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path

from ...sandbox import enter
from ..verification import Level
from .carried_checks import check_to_json, task_from_json
from .file_checks import check_files
from .statistics_checks import check_statistics
from .task import Checker

logger = logging.getLogger(__name__)

_SECONDS_BETWEEN_COUNTS = 0.1
_MOST_CHECKS = 100_000


def main() -> int:
    """Do what the parent asks for."""
    request, say = enter()
    bag = request["bag"]
    task = task_from_json(request["task"])
    # What physics has made again, pixels may be drawn from.
    made_again: set[str] = set()
    for level in task.level.included:
        say(level=level.value)
        try:
            checker = _checker(level, None if bag is None else Path(bag), made_again)
            for check in itertools.islice(checker(task, _Counter(say)), _MOST_CHECKS):
                say(check=check_to_json(check))
        except MemoryError:
            say(failure="it needs more memory than it may use")
            return 1
        except Exception as error:
            logger.exception("The checks of the level %s ended.", level)
            say(failure=f"{type(error).__name__}: {error}")
            return 1
    say(end=True)
    return 0


def _checker(level: Level, bag: Path | None, made_again: set[str]) -> Checker:
    # Physics and pixels need MuJoCo, and are loaded where they are asked for.
    match level:
        case Level.FILES:
            return functools.partial(check_files, bag=bag)
        case Level.STATS:
            return functools.partial(check_statistics, is_packed=bag is not None)
        case Level.PHYSICS:
            physics = importlib.import_module(".physics_checks", __package__)
            return functools.partial(physics.check_physics, made_again=made_again)
        case Level.PIXELS:
            pixels = importlib.import_module(".pixel_checks", __package__)
            return functools.partial(pixels.check_pixels, made_again=made_again)


class _Counter:
    """Says how much is done, not too often.

    Args:
        say: says a thing to the parent.
    """

    def __init__(self, say: Callable[..., None]) -> None:
        self._say = say
        self._said_at = 0.0

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done >= total or now - self._said_at > _SECONDS_BETWEEN_COUNTS:
            self._said_at = now
            self._say(count=[int(done), int(total)])


if __name__ == "__main__":
    sys.exit(main())
