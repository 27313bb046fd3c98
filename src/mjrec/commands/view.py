# SPDX-License-Identifier: Apache-2.0
"""`mjrec view`: watch a run in a browser while it is running."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import tyro

_NICENESS = 10


def view(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    port: int = 0,
    trust_models: bool = False,
) -> int:
    """Watch a run in a browser while it is running.

    Shows the latest states in 3D, and the returns and episodes. Prints an address on
    this machine, including a token that the browser needs, and serves it until Ctrl-C.
    The command only reads, at low priority, and never blocks the run. From another
    machine, forward the port: ssh -L PORT:127.0.0.1:PORT HOST.

    Args:
        directory: a monitor directory, or one with several, such as an evaluation.
        port: port to listen on. Default: a free one.
        trust_models: load compiled models that another user or machine wrote. A crafted
            model can run any code, so use it only if you trust the author.
    """
    # Imported here so that --help works without the optional packages.
    from ..viewing.live import LiveView

    with LiveView(directory, port=port, trust_models=trust_models) as live:
        os.nice(_NICENESS)
        sys.stdout.write(f"{live.url}\nPress Ctrl-C to stop.\n")
        sys.stdout.flush()
        try:
            live.serve()
        except KeyboardInterrupt:
            sys.stdout.write("\n")
    return 0
