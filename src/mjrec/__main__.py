# SPDX-License-Identifier: Apache-2.0
"""Entry point for `python -m mjrec`, which does the same as the command `mjrec`."""

from __future__ import annotations

import sys

from .commands import main

if __name__ == "__main__":
    sys.exit(main())
