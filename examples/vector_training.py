"""Train a linear policy on eight pendulums in parallel, each with its own videos."""

import gymnasium
import numpy as np

import mjrec

DIRECTORY = "recordings/vector_training"
PENDULUMS = 8


def main(rounds: int = 8) -> None:
    random = np.random.default_rng(0)
    envs = gymnasium.make_vec("InvertedPendulum-v5", PENDULUMS, max_episode_steps=60)
    mean, spread = np.zeros(4), np.ones(4)
    with mjrec.Monitor(
        envs, DIRECTORY, force=True, height=96, width=128, max_fps=25
    ) as envs:
        for number in range(rounds):
            # Each pendulum tries different gains. The best three determine the
            # distribution for the next round.
            gains = mean + spread * random.normal(size=(PENDULUMS, 4))
            returns = episode_returns(envs, gains, seed=number)
            best = gains[np.argsort(-returns)[:3]]
            mean, spread = best.mean(0), best.std(0) + 0.1
            print(f"round {number}: {returns.mean():.1f} of 60 steps upright")


def episode_returns(envs, gains, seed):
    """Run one episode per pendulum, and return the return for each row of gains."""
    observations, _ = envs.reset(seed=seed)
    returns, running = np.zeros(len(gains)), np.ones(len(gains), bool)
    while running.any():
        actions = np.sum(gains * observations, axis=1, keepdims=True)
        actions = np.clip(actions, -3, 3).astype(np.float32)
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        returns += np.where(running, rewards, 0)
        running &= ~(terminated | truncated)
    return returns


if __name__ == "__main__":
    main()
