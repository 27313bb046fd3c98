# SPDX-License-Identifier: Apache-2.0
"""Write the pictures, the mesh and the skin that the models in this folder use.

Run as `python assets/make_parts.py` from the top of the repository. It needs only
NumPy, and always writes the same bytes; a test checks that they are the ones here.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).parent

Picture = NDArray[np.uint8]


def parts() -> dict[str, bytes]:
    """Return the content of each file, by name."""
    return {
        "tiles.png": png(tiles()),
        "die.png": png(die()),
        "hills.png": png(hills()),
        "gem.obj": gem().encode(),
        "finger_skin.xml": finger_skin().encode(),
    }


def tiles(side: int = 64) -> Picture:
    """Return bricks that say which way is up: the lower left one is red."""
    rows, columns = np.mgrid[:side, :side]
    courses = rows // 16
    shifted = columns + 16 * (courses % 2)
    mortar = (rows % 16 < 2) | (shifted % 32 < 2)
    picture = np.empty((side, side, 3), np.uint8)
    picture[:] = (196, 120, 72)
    picture[(courses + shifted // 32) % 2 == 0] = (214, 146, 92)
    picture[(rows > 48) & (columns < 16)] = (200, 40, 40)
    picture[mortar] = (225, 215, 200)
    return picture


def die(side: int = 32) -> Picture:
    """Return the six faces of a die, one beside the other."""
    layouts = {
        1: [(1, 1)],
        2: [(0, 0), (2, 2)],
        3: [(0, 0), (1, 1), (2, 2)],
        4: [(0, 0), (0, 2), (2, 0), (2, 2)],
        5: [(0, 0), (0, 2), (1, 1), (2, 0), (2, 2)],
        6: [(0, 0), (0, 2), (1, 0), (1, 2), (2, 0), (2, 2)],
    }
    return np.concatenate(
        # Opposite faces make seven: right, left, up, down, front, back.
        [_face(layouts[pips], side) for pips in (1, 6, 2, 5, 3, 4)],
        axis=1,
    )


def _face(pips: list[tuple[int, int]], side: int) -> Picture:
    rows, columns = np.mgrid[:side, :side]
    picture = np.full((side, side, 3), (245, 240, 225), np.uint8)
    for row, column in pips:
        centre = np.array([row, column]) * side // 4 + side // 4
        near = (rows - centre[0]) ** 2 + (columns - centre[1]) ** 2 < (side // 10) ** 2
        picture[near] = (30, 30, 60)
    return picture


def hills(side: int = 24) -> Picture:
    """Return heights, white is high: a ring of hills around a valley."""
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    distance = np.hypot(x, y)
    ring = np.exp(-(((distance - 0.7) / 0.22) ** 2))
    waves = 0.8 + 0.2 * np.cos(5 * np.arctan2(y, x))
    return np.round(255 * ring * waves).astype(np.uint8)


def png(picture: Picture) -> bytes:
    """Return a grey `(height, width)` or colour `(height, width, 3)` picture as PNG."""
    height, width = picture.shape[:2]
    colour_type = 2 if picture.ndim == 3 else 0
    rows = b"".join(b"\0" + row.tobytes() for row in picture)
    header = struct.pack(">IIBBBBB", width, height, 8, colour_type, 0, 0, 0)
    # Not compressed, so that every version of zlib writes the same bytes.
    content = zlib.compress(rows, level=0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        _chunk(kind, data)
        for kind, data in ((b"IHDR", header), (b"IDAT", content), (b"IEND", b""))
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


def gem(corners: int = 8) -> str:
    """Return a cut stone of radius 1 as Wavefront OBJ, every face flat."""
    table = _ring(corners, radius=0.55, height=0.45)
    girdle = _ring(corners, radius=1.0, height=0.1, turn=0.5)
    points = [*table, *girdle, (0.0, 0.0, 0.45), (0.0, 0.0, -1.0)]
    top, bottom = 2 * corners, 2 * corners + 1
    faces = []
    for this in range(corners):
        after = (this + 1) % corners
        faces += [
            (top, this, after),
            (this, corners + this, after),
            (after, corners + this, corners + after),
            (bottom, corners + after, corners + this),
        ]
    lines = ["# Written by make_parts.py"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in points]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    return "\n".join(lines) + "\n"


def _ring(
    corners: int, *, radius: float, height: float, turn: float = 0.0
) -> list[tuple[float, float, float]]:
    angles = 2 * np.pi * (np.arange(corners) + turn) / corners
    return [
        (float(radius * np.cos(angle)), float(radius * np.sin(angle)), height)
        for angle in angles
    ]


def finger_skin(rings: int = 9, corners: int = 10) -> str:
    """Return an MJCF skin over the bodies finger_upper and finger_lower.

    The finger hangs down from its root, is 0.6 long, and bends in the middle.
    """
    depth = np.linspace(0.02, -0.62, rings)
    radius = 0.055 * np.sqrt(np.clip(1 - ((depth + 0.3) / 0.34) ** 4, 0.04, None))
    points = [
        point
        for z, r in zip(depth, radius, strict=True)
        for point in _ring(corners, radius=float(r), height=float(z))
    ]
    faces = []
    for ring in range(rings - 1):
        for this in range(corners):
            after = (this + 1) % corners
            a, b = ring * corners + this, ring * corners + after
            c, d = a + corners, b + corners
            faces += [(a, c, b), (b, c, d)]
    lower = np.repeat(1 / (1 + np.exp((depth + 0.3) / 0.03)), corners)
    text = [
        "<mujoco>",
        "  <!-- Written by make_parts.py -->",
        "  <deformable>",
        '    <skin name="finger" material="glove"',
        f'      vertex="{_numbers(points)}"',
        f'      face="{_numbers(faces)}">',
        _bone("finger_upper", height=0.0, weights=1 - lower),
        _bone("finger_lower", height=-0.3, weights=lower),
        "    </skin>",
        "  </deformable>",
        "</mujoco>",
    ]
    return "\n".join(text) + "\n"


def _bone(body: str, *, height: float, weights: NDArray[np.float64]) -> str:
    moved = np.flatnonzero(weights > 1e-3)
    return (
        f'      <bone body="{body}" bindpos="0 0 {height:g}" bindquat="1 0 0 0"\n'
        f'        vertid="{_numbers([moved])}"\n'
        f'        vertweight="{_numbers([np.round(weights[moved], 4)])}"/>'
    )


def _numbers(rows: object) -> str:
    values = np.concatenate([np.ravel(row) for row in rows])  # type: ignore[attr-defined]  # any nesting
    # Rounded, so that the last bits of a machine's sines do not show; no minus zero.
    return " ".join(f"{value:g}" for value in np.round(values, 4) + 0.0)


if __name__ == "__main__":
    for name, content in parts().items():
        (FOLDER / name).write_bytes(content)
