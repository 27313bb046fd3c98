# SPDX-License-Identifier: Apache-2.0
"""The monitors of the sub-environments of a vector environment, together."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

from ..formats.monitor_directory import infix_of, iter_monitor_files
from ..recorder.options import RecorderOptions
from ..rendering.background import Background
from .controls import MonitorControls

T = TypeVar("T")


class VectorRecording:
    """What the ways of recording a vector environment have in common.

    Args:
        monitors: of the sub-environments.
        shared: whoever renders for all of them.
        clock: returns the simulated time of the first, or None.
        declared: returns the rate to take where there is no simulated time.
    """

    def __init__(
        self,
        monitors: Iterable[MonitorControls],
        *,
        shared: Background | None = None,
        clock: Callable[[], float | None] = lambda: None,
        declared: Callable[[], Fraction],
    ) -> None:
        self.monitors = tuple(monitors)
        self.clock = clock
        self.declared = declared
        self._shared = shared

    def reset(
        self, which: list[int], *, seed: Any, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the vector environment, and record that.

        Args:
            which: the sub-environments that the options choose.
            seed: for the vector environment's reset.
            options: likewise.
        """
        raise NotImplementedError

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the vector environment, and record what happened."""
        raise NotImplementedError

    def restore(self) -> None:
        """Leave the vector environment as it was before it was recorded."""

    def note_error(self, error: BaseException) -> None:
        """Note in every running episode what was raised."""
        for monitor in self.monitors:
            monitor._note_error(error)

    def finish(self, on_progress: Callable[[Any], None]) -> None:
        """End all episodes, then wait until all videos are rendered."""
        with contextlib.ExitStack() as waiting:
            if self._shared is not None:
                waiting.enter_context(self._shared.waiting_at_the_end(on_progress))
            for_each(lambda monitor: monitor._recorder.finish(), self.monitors)

    def failures(self) -> dict[str, str]:
        """Return why videos could not be rendered, by their names."""
        return {
            name: why
            for monitor in self.monitors
            for name, why in monitor._recorder.failures().items()
        }

    def close(self) -> None:
        """Finish the recordings, without waiting for videos. Idempotent."""
        if self._shared is not None:
            # Before anything is closed: what is done by then, all manifests say.
            self._shared.stop()
        for_each(lambda monitor: monitor._guard.close(), self.monitors)


def for_each(call: Callable[[T], object], items: Iterable[T]) -> None:
    """Call for all, also where one raises; then raise what the first has raised."""
    first: Exception | None = None
    for item in items:
        try:
            call(item)
        except Exception as error:
            first = first or error
    if first is not None:
        raise first


def options_of(index: int, options: RecorderOptions) -> RecorderOptions:
    """Return the options of one sub-environment's monitor.

    The first opens the directory as was asked for, and the others come to it.
    """
    changed: dict[str, Any] = {}
    if index > 0:
        changed.update(force=False, resume=options.resume or True)
    if options.name_prefix is not None:
        # One name for all would be one file for all.
        changed["name_prefix"] = f"{options.name_prefix}-env-{index}"
    return dataclasses.replace(options, **changed) if changed else options


@contextlib.contextmanager
def opened_together(
    directory: str | os.PathLike[str],
) -> Iterator[list[MonitorControls]]:
    """Yield a list for monitors that are opened one by one; undo all if one fails.

    Their files are removed, and the directories made for them.
    """
    path = Path(directory).absolute()
    missing = [each for each in (path, *path.parents) if not each.exists()]
    opened: list[MonitorControls] = []
    try:
        yield opened
    except BaseException:
        for monitor in opened:
            # What was raised first is what the user needs to see.
            with contextlib.suppress(Exception):
                monitor._guard.close()
        _remove_files(path, {monitor.infix for monitor in opened})
        for made in missing:
            # Somebody else's files may have come into it meanwhile.
            with contextlib.suppress(OSError):
                made.rmdir()
        raise


def _remove_files(directory: Path, infixes: set[str]) -> None:
    for file in iter_monitor_files(directory, hidden=True):
        if infix_of(file.name) in infixes:
            file.unlink(missing_ok=True)
