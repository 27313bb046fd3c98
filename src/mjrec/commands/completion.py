# SPDX-License-Identifier: Apache-2.0
"""`mjrec completion`: a shell script that completes commands and options."""

from __future__ import annotations

import importlib
from typing import Annotated, Literal

import tyro

from .help_text import PARSING


def completion(
    shell: Annotated[
        tyro.conf.Positional[Literal["bash", "zsh", "tcsh"]],
        tyro.conf.arg(metavar="bash|zsh|tcsh"),
    ] = "bash",
    /,
) -> int:
    """Print a shell completion script.

    For bash, add this line to ~/.bashrc: eval "$(mjrec completion bash)". For zsh,
    write the output to a file named _mjrec in a folder on $fpath.

    Args:
        shell: the shell to complete for.
    """
    from . import COMMANDS

    commands = {
        name: getattr(importlib.import_module(f".{module}", __package__), module)
        for name, (module, _) in COMMANDS.items()
    }
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="mjrec",
        args=["--tyro-print-completion", shell],
        config=PARSING,
    )
    return 0
