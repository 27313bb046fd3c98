"""Write your own frames to a video, together with the hash of each frame."""

from pathlib import Path

import numpy as np

import mjrec


def main() -> None:
    Path("recordings").mkdir(exist_ok=True)
    rows, columns = np.mgrid[:120, :161]
    with mjrec.VideoWriter("recordings/own.mp4", fps=30, frame_hashes=True) as video:
        for index in range(60):
            wave = 127 + 127 * np.sin((rows + columns + 4 * index) / 20)
            frame = np.stack([wave, wave[::-1], 255 - wave], axis=-1)
            video.write(frame.astype(np.uint8))
    print(video.result.frame_count, "frames", video.result.file_sha256)


if __name__ == "__main__":
    main()
