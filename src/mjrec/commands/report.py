# SPDX-License-Identifier: Apache-2.0
"""`mjrec report`: make a web page from recordings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import rich.console
import tyro

from ..monitors.progress import progress_bar
from ..reporting.report_folder import write_report
from .options import AsJson
from .terminal import print_json


def report(
    directories: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="DIR")
    ],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("report"),
    title: str | None = None,
    single_file: bool = False,
    replay: bool = False,
    verification: tyro.conf.UseAppendAction[tuple[Path, ...]] = (),
    max_single_file_bytes: int = 50_000_000,
    as_json: AsJson = False,
) -> int:
    """Make a web page from recordings: figures, curves, videos and their provenance.

    The result is a folder with index.html and copies of the videos. The page opens from
    disk without a network; creating it requires neither MuJoCo nor OpenGL. Directories
    written by old versions of gym work too. Unreadable files are listed on the page.

    Args:
        directories: evaluations, monitor directories, or folders that contain them.
        out: the folder to write. An existing report is replaced; any other non-empty
            folder is left alone.
        title: title of the page.
        single_file: embed images and videos in the page itself. --out may then name
            the page.
        replay: add a 3D page next to the videos of the best, median and worst episodes.
            Creating that page requires MuJoCo. It is loaded only when opened.
        verification: output of mjrec verify --json. May be repeated. A
            verification.json in a directory is found automatically.
        max_single_file_bytes: size limit of a single file. Videos that do not fit are
            left out, with a note.
        as_json: print one JSON object at the end.
    """
    console = rich.console.Console(stderr=True)
    with progress_bar(console) as show:
        page = write_report(
            directories,
            out,
            title=title,
            single_file=single_file,
            max_single_file_bytes=max_single_file_bytes,
            replays=replay,
            verifications=verification,
            on_progress=lambda progress: show(
                progress.what,
                progress.done,
                progress.total,
                f"{progress.done}/{progress.total}",
            ),
        )
    if as_json:
        print_json({"page": str(page.absolute())})
    else:
        sys.stdout.write(f"{page.absolute()}\n")
    return 0
