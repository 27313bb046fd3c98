# SPDX-License-Identifier: Apache-2.0
"""Schedules: functions `(int) -> bool` that choose the episodes that get a video."""

from __future__ import annotations

import functools
import inspect
import operator
from collections.abc import Callable
from numbers import Number
from typing import Any, TypeAlias

import numpy as np

from .errors import InvalidArgument

Schedule: TypeAlias = Callable[[int], Any]

_CAP = 1000


def capped_cubic_video_schedule(episode_id: int) -> bool:
    """Return whether an episode's number is a cube below 1000 or a multiple of 1000.

    Negative numbers are never chosen.

    Examples:
        >>> [n for n in range(3001) if capped_cubic_video_schedule(n)]
        [0, 1, 8, 27, 64, 125, 216, 343, 512, 729, 1000, 2000, 3000]
    """
    if episode_id < 0:
        return False
    if episode_id >= _CAP:
        return bool(episode_id % _CAP == 0)
    return bool(round(episode_id ** (1 / 3)) ** 3 == episode_id)


def disable_videos(episode_id: int) -> bool:
    """Return False: no episode gets a video."""
    return False


def to_schedule(video_callable: object) -> Schedule:
    """Return the schedule for gym's `video_callable` argument.

    None means the capped cubic schedule. False, or a number equal to False, means no
    videos. A function is used as is, and its result is tested for truth.

    Raises:
        InvalidArgument: `video_callable` is anything else, such as True.
    """
    if video_callable is None:
        return capped_cubic_video_schedule
    if callable(video_callable):
        return video_callable
    # gym also accepts 0 and NumPy's False.
    if isinstance(video_callable, Number | np.bool_) and not video_callable:
        return disable_videos
    raise InvalidArgument(
        "video_callable must be a function that takes an episode number and returns "
        "a bool, None (the cubes 0, 1, 8, 27 ... and every 1000th) or False (no "
        f"videos), not {type(video_callable).__name__}: {video_callable!r}. For a "
        "video of every episode, use video_callable=lambda episode_id: True."
    )


def check_takes_one(function: Callable[..., Any], name: str, what: str) -> None:
    """Check that a function can be called with one argument, if its signature is known.

    Args:
        function: the user's function.
        name: the option that the function was given for.
        what: a description of the argument that the function will receive.

    Raises:
        InvalidArgument: the function cannot be called with exactly one argument.
    """
    try:
        signature = inspect.signature(function)
    except ValueError:
        # A function written in C may have no signature.
        return
    try:
        signature.bind(None)
    except TypeError as error:
        raise InvalidArgument(
            f"{name} is called with one argument, {what}, but "
            f"{schedule_name(function)}{signature} cannot be called this way: "
            f"{error}."
        ) from error


def schedule_name(schedule: Schedule) -> str:
    """Return the name that identifies a schedule in the manifest."""
    name = getattr(schedule, "__qualname__", None) or type(schedule).__qualname__
    return str(name)


def record_all(episode_id: int) -> bool:
    """Return True: every episode gets a video."""
    return True


def schedule_from_text(text: str) -> Schedule:
    """Return the schedule that a command-line option names.

    Args:
        text: `cubic`, `all`, `none`, `every:N` or `at:0,5,9`.

    Raises:
        InvalidArgument: `text` is anything else.
    """
    named: dict[str, Schedule] = {
        "cubic": capped_cubic_video_schedule,
        "all": record_all,
        "none": disable_videos,
    }
    if text in named:
        return named[text]
    kind, _, listed = text.partition(":")
    try:
        numbers = sorted({int(number) for number in listed.split(",")})
    except ValueError:
        numbers = []
    if kind == "at" and numbers and numbers[0] >= 0:
        schedule = functools.partial(operator.contains, frozenset(numbers))
    elif kind == "every" and len(numbers) == 1 and numbers[0] > 0:
        schedule = functools.partial(_is_multiple, numbers[0])
    else:
        raise InvalidArgument(
            f"There is no schedule {text!r}. Use cubic, all, none, every:N (every:10) "
            "or at:NUMBERS (at:0,5,9); episodes are numbered from 0."
        )
    schedule.__qualname__ = f"{kind}:{','.join(map(str, numbers))}"  # type: ignore[attr-defined]  # it has attributes
    return schedule


def _is_multiple(n: int, episode_id: int) -> bool:
    return episode_id % n == 0
