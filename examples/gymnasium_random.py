"""Record ten short episodes of HalfCheetah, with videos of episodes 0, 1 and 8."""

import gymnasium

import mjrec


def main() -> None:
    mjrec.use_gl()
    env = gymnasium.make(
        "HalfCheetah-v5", render_mode="rgb_array", max_episode_steps=20
    )
    with mjrec.Monitor(env, "recordings/gymnasium_random", force=True) as env:
        for episode in range(10):
            env.reset(seed=episode)
            done = False
            while not done:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                done = terminated or truncated
    for episode in mjrec.iter_episodes("recordings/gymnasium_random"):
        print(episode.episode_id, episode.length, round(episode.reward, 3))


if __name__ == "__main__":
    main()
