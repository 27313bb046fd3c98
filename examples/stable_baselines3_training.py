"""Train PPO from Stable-Baselines3, and record videos of episodes during training."""

import argparse

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import load_results

import mjrec
from mjrec.trackers import MonitorCsvTracker

DIRECTORY = "recordings/stable_baselines3_training"


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="InvertedPendulum-v5")
    parser.add_argument("--steps", type=int, default=5120)
    parser.add_argument("--directory", default=DIRECTORY)
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    env = mjrec.Monitor(
        gymnasium.make(arguments.env, max_episode_steps=200),
        arguments.directory,
        force=True,
        width=240,
        height=160,
        allow_early_reset=True,  # each call to learn() resets the environment
        trackers=MonitorCsvTracker(),
    )
    torch.set_num_threads(1)  # the other cores draw the videos
    with env:
        model = PPO("MlpPolicy", env, n_steps=512, device="cpu", seed=0)
        model.learn(arguments.steps)
    returns = load_results(arguments.directory)["r"]
    print("episodes:", len(returns))
    print("mean return of the first twenty:", returns.head(20).mean())
    print("mean return of the last twenty:", returns.tail(20).mean())


if __name__ == "__main__":
    main()
