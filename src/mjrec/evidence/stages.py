# SPDX-License-Identifier: Apache-2.0
"""The three processes of a verification, run one after another, each in a sandbox.

- `open` gets the given archive, unpacks it, checks the bag, and reads the inputs.
- `make` gets only the inputs, and recreates the run.
- `compare` gets the two runs.

Each sends messages to `verify`, which started it: `count` (progress), `phase`,
`inputs`, `finding`, `excuses`, `facts`, and at the end `done`, or `failure` with the
reason. `refused` means that the given path cannot be verified, and `error` means that
this machine does not have enough space.
"""

from __future__ import annotations

import dataclasses
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from ..errors import Error, FileNotWritten, UnreadableArchive
from ..formats.json_fields import to_json
from ..sandbox import enter
from .findings import Finding, Level, Outcome, Topic
from .inputs import ARRAYS_FILE, Inputs
from .layout import PAYLOAD, RECORDINGS, SAMPLED

MODULE: Final = "mjrec.evidence.stages"
# Paths below the folder of a verification. Each is in the folder of the stage that
# creates it, because a stage may write only to its own folder.
GIVEN: Final = "open/given"
INPUTS: Final = "open/inputs"
MADE: Final = "make/made"

_SECONDS_BETWEEN_COUNTS = 0.2
_Say = Callable[..., None]


def _counter(say: _Say) -> Callable[[int, int], None]:
    """Return a function that reports progress at a limited rate."""
    said_at = 0.0

    def count(done: int, total: int) -> None:
        nonlocal said_at
        now = time.monotonic()
        if done >= total or now - said_at > _SECONDS_BETWEEN_COUNTS:
            said_at = now
            say(count=[int(done), int(total)])

    return count


def main() -> int:
    """Run the stage that `verify` requests, and return the exit status."""
    request, say = enter()
    stage = {"open": _open, "make": _make, "compare": _compare}[request["stage"]]
    try:
        stage(request, say)
    except UnreadableArchive as error:
        say(refused=str(error.reason))
        return 1
    except FileNotWritten as error:
        say(error=str(error))
        return 1
    except MemoryError:
        say(failure="it needs more memory than the limit")
        return 1
    except Exception as error:
        text = str(error) or type(error).__name__
        say(failure=text if isinstance(error, Error) else f"{error!r:.500}")
        return 1
    say(done=True)
    return 0


# Each stage imports only what it needs: `make` MuJoCo and environments, `open` h5py.


def _open(request: Mapping[str, Any], say: _Say) -> None:
    from .archive import BAG_DECLARATION, bring_in
    from .bag import check_bag, unchanged
    from .honesty import remarks
    from .packed_run import planned_episodes
    from .read_inputs import read_inputs

    given, counter = Path(request["folder"], GIVEN), _counter(say)
    say(facts=dict(bring_in(Path(request["path"]), given)))
    is_bag = (given / BAG_DECLARATION).exists()
    objections = list(check_bag(given, counter)) if is_bag else []
    for finding in objections:
        say(finding=to_json(finding))
    if request["level"] == Level.FILES:
        if is_bag and not objections:
            say(finding=to_json(unchanged(given)))
        return
    inputs, arrays = read_inputs(given / PAYLOAD)
    if not inputs.packing:
        planned = planned_episodes(Path(request["path"]))
        inputs = dataclasses.replace(inputs, planned=planned)
    folder = Path(request["folder"], INPUTS)
    folder.mkdir()
    inputs.write(folder, arrays)
    for recording in inputs.recordings:
        if recording.sources is not None:
            sources = given / PAYLOAD / RECORDINGS / recording.sources
            if sources.exists():
                shutil.copyfile(sources, folder / recording.sources)
    say(inputs=inputs.unusual())
    for finding in remarks(inputs, arrays):
        say(finding=to_json(finding))


def _make(request: Mapping[str, Any], say: _Say) -> None:
    import numpy as np

    from ..environments.recreate import NotRecreated
    from ..formats.monitor_directory import infix_of, iter_monitor_files
    from ..rendering.recovery import recover
    from .evaluation_choice import choose_for_evaluations
    from .excuses import note, write_notes
    from .pack import pack_folder
    from .read_inputs import packing_options
    from .recreate_run import Recreation, play_recording
    from .render_recreated import draw_all, draw_sample

    level, folder = Level(request["level"]), Path(request["folder"], INPUTS)
    made = Path(request["folder"], MADE)
    inputs, counter = Inputs.read(folder), _counter(say)
    notes: list[Finding] = []
    draws_all = level is Level.PIXELS and request["sample"] is None
    is_packed = bool(inputs.packing) and draws_all
    played = made.with_name("played") if is_packed else made / PAYLOAD
    played /= RECORDINGS
    played.mkdir(parents=True)
    steps = sum(e.steps for each in inputs.recordings for e in each.episodes)
    taken = 0

    def count_step() -> None:
        nonlocal taken
        taken += 1
        counter(min(taken, steps - 1), steps)

    with np.load(folder / ARRAYS_FILE, allow_pickle=False) as arrays:
        recreation = Recreation(
            directory=played,
            arrays=arrays,
            trust=frozenset(request["trust"]),
            sources=folder,
            notes=notes,
            on_step=count_step,
        )
        for recording in inputs.recordings:
            try:
                play_recording(recording, recreation)
            except NotRecreated as error:
                # Part of a recording proves nothing.
                for path in iter_monitor_files(played, hidden=True):
                    if infix_of(path.name) == recording.infix:
                        path.unlink()
                name, episodes = recording.name, max(1, len(recording.episodes))
                excuse = error.excuse
                if excuse is not None:
                    # The reason is said below.
                    notes.append(note(name, excuse, recording.env_id, count=episodes))
                lost = Finding(
                    Topic.IDENTITY,
                    name,
                    Outcome.DIFFERENT if excuse is None else Outcome.BELIEVED,
                    f"it cannot be recreated: {error}",
                    excuse=excuse,
                    count=episodes,
                    unit="episode",
                    is_headline=True,
                )
                say(finding=to_json(lost))
    if any(recording.was_killed for recording in inputs.recordings):
        recover(played)
    choose_for_evaluations(inputs.recordings, played, notes)
    say(phase="drawing")
    if not any(played.iterdir()):
        is_packed = False
    elif draws_all:
        draw_all(played, counter)
    elif level is Level.PIXELS:
        sampled = made / SAMPLED
        draw_sample(
            played,
            sampled,
            count=request["sample"],
            seed=request["seed"],
            on_progress=counter,
        )
    if is_packed:
        pack_folder(played, made, packing_options(inputs.packing))
    (made / PAYLOAD / RECORDINGS).mkdir(parents=True, exist_ok=True)
    write_notes(made, notes)


def _compare(request: Mapping[str, Any], say: _Say) -> None:
    from .compare import Comparison

    comparison = Comparison(
        Path(request["folder"], GIVEN),
        Path(request["folder"], MADE),
        level=Level(request["level"]),
        sampled=request["sample"] is not None,
        allow=request["allow"],
        on_progress=_counter(say),
    )
    for finding in comparison:
        say(finding=to_json(finding))
    say(excuses=[to_json(excuse) for excuse in comparison.excuses])


if __name__ == "__main__":
    sys.exit(main())
