# SPDX-License-Identifier: Apache-2.0
"""One rendering process for several monitors of a directory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from ..formats.monitor_directory import infix_of
from .progress import Progress
from .render_service import RenderService


class SharedRendering:
    """Renders for several monitors, each of which has a share of one service.

    Args:
        workers: how many processes draw, for all monitors together; None is one for
            each CPU that can be used.
        strict: whether a video that shows nothing counts as one that could not be
            rendered.
    """

    def __init__(self, *, workers: int | None, strict: bool = False) -> None:
        self._workers = workers
        self._strict = strict
        self._service: RenderService | None = None
        self._shares: set[Share] = set()
        self._waits_later = False

    def share(self, directory: Path) -> Share:
        """Return a share for one more monitor.

        Args:
            directory: the monitor directory, the same for all of them.
        """
        if self._service is None:
            self._service = RenderService(
                directory, workers=self._workers, strict=self._strict
            )
        share = Share(self, self._service)
        self._shares.add(share)
        return share

    @contextlib.contextmanager
    def waiting_at_the_end(
        self, on_progress: Callable[[Progress], object] = lambda _: None
    ) -> Iterator[None]:
        """Let no share wait inside the block, and wait for all at its end.

        A service that has been waited for takes nothing more, and whatever comes then
        needs another process: so all say first what there is.
        """
        self._waits_later = True
        try:
            yield
        finally:
            self._waits_later = False
        if self._service is not None:
            self._service.wait(on_progress)

    def stop(self) -> None:
        """Stop for all at once; what is not done stays pending. Idempotent."""
        self._shares.clear()
        if self._service is not None:
            self._service.stop()

    def _leave(self, share: Share) -> None:
        self._shares.discard(share)
        if not self._shares:
            self.stop()


class Share:
    """What one monitor has of a `SharedRendering`; used as a service of its own."""

    def __init__(self, shared: SharedRendering, service: RenderService) -> None:
        self._shared = shared
        self._service = service
        self._infixes: set[str | None] = set()
        self._stopped = False

    @property
    def failures(self) -> Mapping[str, str]:
        """Why videos of this monitor could not be rendered, by their base names."""
        return {
            name: why
            for name, why in self._service.failures.items()
            if infix_of(name) in self._infixes
        }

    def expect(self) -> None:
        """Start all processes: a video will have to be rendered. Idempotent."""
        if not self._stopped:
            self._service.expect()

    def submit(self, trajectory: Path) -> None:
        """Take over an ended trajectory. Never waits; does nothing after `stop`.

        Raises:
            Error: in a process forked from the one that made the service.
        """
        self._infixes.add(infix_of(Path(trajectory).name))
        if not self._stopped:
            self._service.submit(trajectory)

    def wait(self, on_progress: Callable[[Progress], object] = lambda _: None) -> None:
        """Return when all is done that was taken over, from the other monitors too."""
        if not self._shared._waits_later:
            self._service.wait(on_progress)

    def stop(self) -> None:
        """Take no more, and stop the service if all others have stopped. Idempotent."""
        if not self._stopped:
            self._stopped = True
            self._shared._leave(self)
