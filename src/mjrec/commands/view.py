# SPDX-License-Identifier: Apache-2.0
"""`mjrec view`: a look at a run while it goes on, in a browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from ..viewing.live import LiveView, be_nice


def view(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    port: int = 0,
    trust_models: bool = False,
) -> int:
    """Show a run in a browser while it goes on: newest states in 3D, returns, episodes.

    Prints an address of this machine, with a token that is needed to see anything, and
    serves it until Ctrl-C. It only reads, at a low priority; the run does not wait for
    it. On another machine, forward the port: ssh -L PORT:127.0.0.1:PORT HOST.

    Args:
        directory: a monitor directory.
        port: to listen at; one that is free, if it is not given.
        trust_models: load compiled models also where another user, or another machine,
            has written them. A crafted one can do anything to whoever loads it.
    """
    with LiveView(directory, port=port, trust_models=trust_models) as live:
        be_nice()
        sys.stdout.write(f"{live.url}\nCtrl-C ends it.\n")
        sys.stdout.flush()
        try:
            live.serve()
        except KeyboardInterrupt:
            sys.stdout.write("\n")
    return 0
