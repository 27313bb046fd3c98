# SPDX-License-Identifier: Apache-2.0
"""Finishing a directory: whatever is over and not finished yet.

One operation; everything else is a part of it. It does what is left of each
recording (the process beside a simulation does that for its monitor's), keeps manifests
and second names true, and puts dead monitors in order (`recover`, and `resume=True`,
are all of it but the drawing). It may be interrupted or killed at any point and run
again, and any number of processes may run it on one directory.
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

    Nothing is yielded of one that nothing was to be done about. What another process
    is at is left to it.

    Args:
        directory: the monitor directory.
        keys: which recordings; if None all, and what killed monitors have left.
        workers: how many processes draw; None is one for each free CPU.
        engine: whose workers do it instead.
        strict: whether a video that shows nothing is a failure.
        on_progress: called with how far it is.

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
        # On a full disk, what failed has said so; the manifest comes with the next try.
        if not has_failed:
            raise
        return
    if keys is None:
        for file in recover(directory).failures:
            yield RenderedVideos(directory=directory, failures={file.name: file.what})


def bring_up_to_date(directory: Path) -> None:
    """Give videos their second names, keep manifests true, and remove idle logs.

    To be called when videos of a directory have been finished. It also does what an
    earlier run could not.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    give_all_second_names(directory)
    for log in log_paths(directory):
        # Those of a process that died between finishing the last and removing them.
        with contextlib.suppress(DirectoryNotWritable):
            remove_if_done(log)
    update_manifests(directory)
