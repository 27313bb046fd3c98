"""Evaluate on the Ray cluster in RAY_ADDRESS, or on one that is started locally."""

import shutil
from pathlib import Path

import mjrec

# On a cluster: a directory that all machines can see.
PLACE = Path("recordings/ray_cluster")


def main() -> None:
    shutil.rmtree(PLACE, ignore_errors=True)
    evaluation = mjrec.evaluate(
        ["InvertedPendulum-v5", "Reacher-v5"],
        policy="random",
        directory=PLACE,
        episodes=4,
        num_seeds=2,
        max_steps=50,
        height=120,
        width=160,
        engine=mjrec.RayEngine(2),
    )
    for summary in evaluation.summaries:
        print(f"{summary.task}: mean return {summary.mean:.3g}")
    print(*evaluation.videos, sep="\n")


if __name__ == "__main__":
    main()
