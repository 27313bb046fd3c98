# SPDX-License-Identifier: Apache-2.0
"""A prototype that shows the minimum cost of saving the state of each step.

It is a yardstick, not a recorder. All arrays of `MjData` are in one block of memory. A
row is one `take` of 64-bit words from that block into a memory-mapped file whose pages
stay in the cache. When the file is full, it is written to the log. The prototype does
not save actions or views, does not notice changes to the model, and has no journal.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import tempfile
from typing import Any

import gymnasium
import numpy as np

_STATE = (
    "qpos qvel act qacc_warmstart plugin_state ctrl qfrc_applied xfrc_applied "
    "mocap_pos mocap_quat userdata"
)
_DRAWN = (
    "geom_xpos geom_xmat site_xpos site_xmat cam_xpos cam_xmat light_xpos light_xdir "
    "subtree_com ten_wrapadr ten_wrapnum ten_length wrap_obj wrap_xpos"
)
_TAIL_BYTES = 256 << 10
_EXTRA = 4


class PrototypeRecorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Saves a row for each step and each reset of a Gymnasium MuJoCo environment."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        self._data = inner.data
        names = f"{_STATE} {_DRAWN}".split()
        spans = [
            (array.__array_interface__["data"][0], array.nbytes)
            for array in (getattr(self._data, name) for name in names)
            if array.nbytes
        ]
        low = min(start for start, _ in spans) & ~7
        count = (max(start + size for start, size in spans) - low + 7) // 8
        memory = (ctypes.c_uint64 * count).from_address(low)
        self._take = np.ctypeslib.as_array(memory).take
        words = [
            np.arange((start - low) // 8, (start - low + size + 7) // 8)
            for start, size in spans
        ]
        self._index = np.unique(np.concatenate(words)).astype(np.intp)
        width = len(self._index) + _EXTRA
        self._capacity = max(4, _TAIL_BYTES // (8 * width))
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  open as long as this
        with tempfile.TemporaryFile() as file:
            os.posix_fallocate(file.fileno(), 0, 4096 + self._capacity * 8 * width)
            self._tail = mmap.mmap(file.fileno(), 4096 + self._capacity * 8 * width)
        rows = np.frombuffer(self._tail, np.uint64, self._capacity * width, 4096)
        self._states = rows.reshape(-1, width)[:, : len(self._index)]
        self._extras = rows.reshape(-1, width)[:, len(self._index) :].view(np.float64)
        self._count = 0

    def reset(self, **options: Any) -> Any:
        """Reset, and save a row."""
        result = self.env.reset(**options)
        self._save(0.0, False, False)
        return result

    def step(self, action: Any) -> Any:
        """Step, and save a row."""
        result = self.env.step(action)
        self._save(result[1], result[2], result[3])
        return result

    def _save(self, reward: Any, terminated: bool, truncated: bool) -> None:
        slot = self._count % self._capacity
        self._take(self._index, None, self._states[slot], "clip")
        extra = self._extras[slot]
        extra[0], extra[1], extra[2], extra[3] = (
            *(reward, terminated, truncated),
            self._data.time,
        )
        self._count += 1
        if self._count % self._capacity == 0:
            self._log.write(memoryview(self._tail)[4096:])
