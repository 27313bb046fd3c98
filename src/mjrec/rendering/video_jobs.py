# SPDX-License-Identifier: Apache-2.0
"""Rendering as the jobs of an engine: what they say, and who does them.

A job is about one recording, lies in files that all workers see, and is one of::

    {"do": "finish", "directory", "recording", "strict"}
    {"do": "again", "trajectory", "variant", "video", "strict"}

`recording` is the name of one of its files. The settings of the workers may be
`{"models": [sha256, ...]}`: compiled models in these directories that the user whose
jobs they are has stored, and that the workers load. What comes back is
`{"outcome": {...}}`, as `Outcome.as_json` says it; null where nothing was left to do.

A job can be done twice, also by two workers at once. Who finishes a recording holds its
lock, and whoever comes second finds nothing to do; a video that is rendered another way
is the same file from both of them, put in its place at once.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engines.work import JobOutcome
from ..errors import GLError
from ..simulation.model_trust import TRUST_VARIABLE, note_models
from .again import Variant, render_one_again
from .finishing import EpisodeFinisher
from .outcomes import Outcome
from .pending import RecordingKey, key_of
from .pool import WorkerPool

_RASTERISER_THREADS = "LP_NUM_THREADS"


def environ_for_drawing() -> dict[str, str]:
    """Return environment variables of workers that draw, wherever they are."""
    # There are several, and Mesa's rasteriser would start as many threads as there are
    # CPUs in each of them.
    environ = {_RASTERISER_THREADS: os.environ.get(_RASTERISER_THREADS, "1")}
    if TRUST_VARIABLE in os.environ:
        # Those on other machines do not have it from this process.
        environ[TRUST_VARIABLE] = os.environ[TRUST_VARIABLE]
    return environ


def finishing_job(
    directory: Path, key: RecordingKey, *, strict: bool = False
) -> dict[str, Any]:
    """Return the arguments of a job that finishes a recording, see `finish_pending`.

    Args:
        directory: the monitor directory.
        key: which recording.
        strict: whether a video that shows nothing is a failure.
    """
    return {
        "do": "finish",
        "directory": str(directory.absolute()),
        "recording": key.told_name,
        "strict": strict,
    }


def again_job(
    trajectory: Path, variant: Variant, video: Path, *, strict: bool = False
) -> dict[str, Any]:
    """Return the arguments of a job that renders an episode again, see `render_again`.

    Args:
        trajectory: of the episode.
        variant: what is to be other.
        video: what is written, as `videos_of_variant` says.
        strict: whether a video that shows nothing is a failure.
    """
    return {
        "do": "again",
        "trajectory": str(trajectory.absolute()),
        "variant": variant.as_json(),
        "video": str(video.absolute()),
        "strict": strict,
    }


def outcome_of(job: JobOutcome, nothing: Outcome) -> Outcome | None:
    """Return what became of the recording of a job; None where nothing was to be done.

    Args:
        job: what the engine says.
        nothing: names what the job was about, for what the engine has given up.
    """
    if job.failure is not None:
        return replace(nothing, failure=job.failure)
    assert job.value is not None
    said = job.value["outcome"]
    return None if said is None else Outcome.from_json(said)


class VideoWorker:
    """Renders one recording after the other; an `engines.work.Handler`.

    A process of its own draws, which stays from job to job.

    Args:
        settings: see the module.
        payload: there is none.
    """

    def __init__(
        self, settings: Mapping[str, Any] | None = None, payload: bytes | None = None
    ) -> None:
        del payload
        note_models((settings or {}).get("models", ()))
        self._again = _Again()
        self._finishing = _Finishing()
        self._by_name: Mapping[str, Callable[[Mapping[str, Any]], Outcome | None]] = {
            "again": self._again,
            "finish": self._finishing,
        }

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job."""
        outcome = self._by_name[arguments["do"]](arguments)
        return {"outcome": None if outcome is None else outcome.as_json()}

    def close(self) -> None:
        """End the process that draws."""
        with contextlib.closing(self._again):
            self._finishing.close()


class _Finishing:
    """Finishes recordings, of one directory after the other."""

    def __init__(self) -> None:
        self._open = contextlib.ExitStack()
        self._finisher: EpisodeFinisher | None = None
        self._of: tuple[str, bool] | None = None

    def __call__(self, arguments: Mapping[str, Any]) -> Outcome | None:
        key = key_of(arguments["recording"])
        assert key is not None
        finisher = self._finisher_for(arguments["directory"], arguments["strict"])
        if not finisher.add(key):
            return None
        _, outcome = finisher.finish_next()
        return outcome

    def close(self) -> None:
        self._open.close()

    def _finisher_for(self, directory: str, strict: bool) -> EpisodeFinisher:
        if self._finisher is None or self._of != (directory, strict):
            self.close()
            finisher = EpisodeFinisher(Path(directory), workers=1, strict=strict)
            self._finisher = self._open.enter_context(finisher)
            self._of = (directory, strict)
        return self._finisher


class _Again:
    """Renders recorded episodes another way."""

    def __init__(self) -> None:
        self._workers: WorkerPool | None = None
        self._gl_failure: str | None = None

    def __call__(self, arguments: Mapping[str, Any]) -> Outcome:
        video = Path(arguments["video"])
        if self._workers is None:
            self._workers = WorkerPool(1)
        # Where nothing can be drawn, each would take as long to find that out.
        if self._gl_failure is None:
            try:
                return render_one_again(
                    Path(arguments["trajectory"]),
                    Variant.from_json(arguments["variant"]),
                    video,
                    workers=self._workers,
                    strict=arguments["strict"],
                )
            except GLError as error:
                self._gl_failure = str(error)
        return Outcome(
            name=video.name, directory=video.parent, failure=self._gl_failure
        )

    def close(self) -> None:
        if self._workers is not None:
            self._workers.close()
