"""Report recordings to TensorBoard, Weights & Biases and your own tracker class."""

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
    """A tracker that prints the finished videos."""

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Print the environment, the episode and the file name of the video."""
        print(run.env_id, "episode", video.episode_id, video.path.name)


def main() -> None:
    mjrec.use_gl()
    env = gymnasium.make("Hopper-v5", max_episode_steps=50)
    trackers = [
        # To see the results: tensorboard --logdir recordings/trackers
        TensorBoardTracker(),
        # Nothing is uploaded in offline mode. Without `mode` the run is uploaded.
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
