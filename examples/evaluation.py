"""Evaluate two policies from the same initial states, and report on both."""

import shutil
from pathlib import Path

import numpy as np

import mjrec

PLACE = Path("recordings/evaluation")


class Wave:
    """A policy that moves a wave through the joints and ignores the observations."""

    def __init__(self, env) -> None:
        self.shape = env.action_spec().shape
        self.step = 0

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self.step = 0

    def __call__(self, observation) -> np.ndarray:
        """Return the next action."""
        self.step += 1
        return np.sin(0.3 * self.step + np.arange(self.shape[0]))


def main() -> None:
    shutil.rmtree(PLACE, ignore_errors=True)
    tasks = ["dm_control/cheetah-run", "dm_control/swimmer-swimmer6"]
    for name, policy in {"random": "random", "wave": Wave}.items():
        evaluation = mjrec.evaluate(
            tasks,
            policy=policy,
            directory=PLACE / name,
            episodes=2,
            num_seeds=2,
            max_steps=50,
            height=120,
            width=160,
        )
        for summary in evaluation.summaries:
            print(f"{name}: {summary.task}: mean return {summary.mean:.3g}")
    comparison = mjrec.compare(PLACE / "random", PLACE / "wave")
    better = comparison.figures["probability of improvement"]
    print(f"probability that the wave is better: {better.value:.2f}")
    print(mjrec.write_report([PLACE / "random", PLACE / "wave"], PLACE / "report"))


if __name__ == "__main__":
    main()
