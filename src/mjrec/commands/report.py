# SPDX-License-Identifier: Apache-2.0
"""`mjrec report`: a page that shows recordings."""

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
    single_file: bool = False,
    max_single_file_bytes: int = 50_000_000,
    replay: bool = False,
    title: str | None = None,
    verification: tyro.conf.UseAppendAction[tuple[Path, ...]] = (),
    as_json: AsJson = False,
) -> int:
    """Write a page that shows recordings: figures, curves, videos, how they came about.

    It is a folder with an index.html that opens from the disk and needs no network;
    videos are copied into it. It works for what mjrec evaluate and mjrec record have
    written and for any monitor directory, also of old gym, and needs no MuJoCo and no
    OpenGL. What cannot be read is named on the page, and the rest is shown.

    Args:
        directories: evaluations, monitor directories, or folders with such directories
            directly in them.
        out: the folder to write. A report that is there is replaced, another folder
            that is not empty is not.
        single_file: put posters and videos into the page itself, as far as they fit;
            --out may then be the name of the page.
        max_single_file_bytes: the most bytes of that page; videos that do not fit are
            left out, with a note.
        replay: put a page in 3D beside the videos of the best, the median and the worst
            episode; it needs MuJoCo and is loaded when it is opened.
        title: of the page.
        verification: a file that mjrec verify --json has printed. May be given several
            times; a verification.json in a directory is found by itself.
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
