# SPDX-License-Identifier: Apache-2.0
"""Finishing a directory: everything that has ended but is not finished yet.

Closing, rendering, recovering and resuming all run this operation or parts of it. It
finishes each recording (during a simulation, the background process does that for its
monitor), updates manifests and second names, and finishes dead monitors (`recover` and
`resume=True` do everything except the drawing). It may be interrupted or killed at any
point and run again, and any number of processes may run it on one directory.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from pathlib import Path

from ..errors import DirectoryNotWritable, FileNotWritten
from ..formats.second_names import give_all_second_names
from ..formats.spans import log_paths, remove_if_done
from ..results.manifest_writing import update_manifests
from .engine_jobs import do_on_engine
from .finisher import do_jobs
from .jobs import Progress, RecordingKey, RenderedVideos, VideoJob
from .recordings import recordings
from .recovery import recover


def finish(
    directory: Path,
    keys: Iterable[RecordingKey] | None = None,
    *,
    workers: int | None = None,
    engine: Executor | None = None,
    strict: bool = False,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Iterator[RenderedVideos]:
    """Finish what is pending in a directory, and yield the result of each recording.

    Recordings that need nothing yield no result. Recordings that another process is
    working on are left to it.

    Args:
        directory: the monitor directory.
        keys: the recordings to finish. None means all, including the files that killed
            monitors left behind.
        workers: number of processes that draw. None means one for each free CPU.
        engine: an engine whose workers do the work instead.
        strict: whether a blank video is a failure.
        on_progress: called with the progress.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    has_failed = False
    wanted = recordings(directory) if keys is None else keys
    jobs = [VideoJob.finishing(directory, key, strict=strict) for key in wanted]
    if engine is None:
        results = do_jobs(jobs, directory, workers=workers, on_progress=on_progress)
    else:
        results = do_on_engine(engine, jobs, on_progress=on_progress)
    for result in results:
        has_failed = has_failed or bool(result.failures)
        yield result
    try:
        bring_up_to_date(directory)
    except FileNotWritten:
        # On a full disk, a failure has been reported already. The next run writes the
        # manifest.
        if not has_failed:
            raise
        return
    if keys is None:
        for file in recover(directory).failures:
            yield RenderedVideos(directory=directory, failures={file.name: file.what})


def bring_up_to_date(directory: Path) -> None:
    """Give videos their second names, update manifests, and remove idle logs.

    Call this after videos of a directory have been finished. It also completes what
    an earlier run left undone.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    give_all_second_names(directory)
    for log in log_paths(directory):
        # A process may have died after finishing the last recording of a log, before
        # removing the log.
        with contextlib.suppress(DirectoryNotWritable):
            remove_if_done(log)
    update_manifests(directory)
