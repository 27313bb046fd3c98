# SPDX-License-Identifier: Apache-2.0
"""Record three environments and make the README's picture of their videos.

Run it from the repository's root, with the development environment.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

ENVIRONMENTS = ("dm_control/humanoid-run", "dm_control/cheetah-run", "HalfCheetah-v5")
FRAMES = (0, 12, 24, 36, 48)
SIZE = "256x192"


def record(environment: str, directory: Path) -> None:
    """Record one episode."""
    subprocess.run(
        [
            *(sys.executable, "-m", "mjrec", "record", environment),
            *("--out", str(directory), "--max-steps", str(max(FRAMES))),
            *("--size", SIZE, "--seed", "4"),
        ],
        check=True,
    )


def strip(directory: Path) -> NDArray[np.uint8]:
    """Return some of the frames of the video, side by side."""
    [video] = directory.glob("*.mp4")
    with av.open(str(video)) as container:
        frames = list(itertools.islice(container.decode(video=0), max(FRAMES) + 1))
    return np.hstack([frames[i].to_ndarray(format="rgb24") for i in FRAMES])


def main() -> None:
    """Write the picture beside this file."""
    strips = []
    with tempfile.TemporaryDirectory() as temporary:
        for number, environment in enumerate(ENVIRONMENTS):
            directory = Path(temporary) / str(number)
            record(environment, directory)
            strips.append(strip(directory))
    picture = Image.fromarray(np.vstack(strips)).quantize(128)
    picture.save(Path(__file__).with_name("readme.png"), optimize=True)


if __name__ == "__main__":
    main()
