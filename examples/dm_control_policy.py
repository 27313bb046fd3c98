"""Evaluate your own policy on dm_control's cheetah, with a video of each episode."""

import mjrec

mjrec.use_gl()  # before dm_control imports MuJoCo

import numpy as np  # noqa: E402
from dm_control import suite  # noqa: E402

DIRECTORY = "recordings/dm_control_policy"


def gallop(time: float, joints: int) -> np.ndarray:
    """Return an action that moves a wave through the joints twice per second."""
    return np.sin(4 * np.pi * time + np.arange(joints))


def main() -> None:
    env = suite.load("cheetah", "run", task_kwargs={"random": 0, "time_limit": 0.3})
    with mjrec.Monitor(
        env,
        DIRECTORY,
        video_callable=lambda episode: True,
        force=True,
        mode="evaluation",
        camera="side",
        env_id="dm_control/cheetah-run",
    ) as env:
        for _ in range(2):
            timestep = env.reset()
            while not timestep.last():
                timestep = env.step(gallop(env.physics.time(), 6))
        print("returns:", env.get_episode_rewards())


if __name__ == "__main__":
    main()
