# SPDX-License-Identifier: Apache-2.0
"""`mjrec completion`: what a shell needs to complete commands and options."""

from __future__ import annotations

import importlib
from typing import Annotated, Literal

import tyro


def completion(
    shell: Annotated[
        tyro.conf.Positional[Literal["bash", "zsh", "tcsh"]],
        tyro.conf.arg(metavar="bash|zsh|tcsh"),
    ] = "bash",
    /,
) -> int:
    """Print tab completion for a shell.

    For bash, put this into ~/.bashrc: eval "$(mjrec completion bash)". For zsh, write
    the output into a file _mjrec in a folder of $fpath.

    Args:
        shell: whose completion.
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
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    return 0
