"""Record two runs in the same directory, then read the results of both together."""

import gymnasium

import mjrec

DIRECTORY = "recordings/resume"


def run(*, resume: bool) -> None:
    """Record two episodes, without videos."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=20)
    with mjrec.Monitor(
        env, DIRECTORY, video_callable=False, force=not resume, resume=resume
    ) as env:
        for _ in range(2):
            print("episode", env.episode_id)
            env.reset(seed=env.episode_id)
            done = False
            while not done:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                done = terminated or truncated


def main() -> None:
    run(resume=False)
    run(resume=True)
    results = mjrec.load_results(DIRECTORY)
    print("lengths:", results["episode_lengths"])


if __name__ == "__main__":
    main()
