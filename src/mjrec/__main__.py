# SPDX-License-Identifier: Apache-2.0
"""`python -m mjrec` is the command `mjrec`."""

from __future__ import annotations

import sys

from .commands import main

if __name__ == "__main__":
    sys.exit(main())
