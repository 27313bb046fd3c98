# SPDX-License-Identifier: Apache-2.0
"""What every monitor is: something to be closed, in the process that made it."""

from __future__ import annotations

from typing import Any, Literal, NoReturn, Self, SupportsIndex

from ..errors import NotPicklable

__all__ = ["MonitorLifetime"]


class MonitorLifetime:
    """A context manager that waits for its videos unless it is left by an exception."""

    def close(self, *, wait: bool = True) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: whether to wait until all videos are rendered.
        """
        raise NotImplementedError

    def _note_error(self, error: BaseException) -> None:
        """Note that the environment, or its user, has raised."""
        raise NotImplementedError

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
