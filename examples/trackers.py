"""Tell TensorBoard, Weights & Biases and a class of one's own what is recorded."""

import gymnasium

import mjrec
from mjrec.trackers import (
    FinishedVideo,
    Run,
    TensorBoardTracker,
    Tracker,
    WandbTracker,
)

DIRECTORY = "recordings/trackers"


class PrintVideos(Tracker):
    """Overrides the one thing that it wants to be told."""

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Print where the video is, and of what."""
        print(run.env_id, "episode", video.episode_id, video.path.name)


def main() -> None:
    mjrec.use_gl()
    env = gymnasium.make("Hopper-v5", max_episode_steps=50)
    trackers = [
        # tensorboard --logdir recordings/trackers
        TensorBoardTracker(),
        # Offline; without `mode` it is uploaded.
        WandbTracker(project="mjrec", mode="offline", dir="recordings"),
        PrintVideos(),
    ]
    with mjrec.Monitor(
        env, DIRECTORY, force=True, width=240, height=160, trackers=trackers
    ) as env:
        for episode in range(4):
            env.reset(seed=episode)
            done = False
            while not done:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                done = terminated or truncated


if __name__ == "__main__":
    main()
