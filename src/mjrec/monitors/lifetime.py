# SPDX-License-Identifier: Apache-2.0
"""What every monitor is: something to be closed, in the process that made it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NoReturn, Self, SupportsIndex

from ..errors import NotPicklable, RenderError
from ..recorder.options import WARN, RecorderOptions

logger = logging.getLogger(__name__)


class MonitorLifetime:
    """A context manager that waits for its videos unless it is left by an exception."""

    _options: RecorderOptions
    _told_failures = False

    @property
    def directory(self) -> Path:
        """The monitor directory, absolute."""
        raise NotImplementedError

    def close(self, *, wait: bool = True) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: whether to wait until all videos are rendered.
        """
        raise NotImplementedError

    def _note_error(self, error: BaseException) -> None:
        """Note that the environment, or its user, has raised."""
        raise NotImplementedError

    def _failures(self) -> Mapping[str, str]:
        """Return why videos could not be rendered, by their names."""
        raise NotImplementedError

    def _raise_failures(self) -> None:
        """Say once which videos could not be rendered.

        Raises:
            RenderError: there are some, and `on_error` is "raise".
        """
        failures = self._failures()
        if not failures or self._told_failures:
            return
        self._told_failures = True
        error = RenderError(self.directory, failures)
        if self._options.on_error != WARN:
            raise error
        logger.warning("%s", error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: Any) -> Literal[False]:
        _, first, _ = exc_info
        if first is not None:
            self._note_error(first)
        try:
            # Whoever leaves by an exception does not wait for videos.
            self.close(wait=first is None)
        except Exception as second:
            if first is None:
                raise
            # What went wrong first is what the user needs to see.
            first.add_note(f"Closing the monitor failed too: {second}")
        return False

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise NotPicklable(
            f"A {type(self).__name__} cannot be pickled or copied: it writes files, "
            "and two would write the same ones. Make it in the process that uses it, "
            "inside the function that makes the environment: "
            "lambda: mjrec.Monitor(gymnasium.make(...), directory, resume=True)."
        )
