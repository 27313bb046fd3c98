"""Evaluate in Slurm jobs, or in local processes if there is no Slurm cluster."""

import shutil
from pathlib import Path

import mjrec

PLACE = Path("recordings/slurm_cluster")


def main() -> None:
    shutil.rmtree(PLACE, ignore_errors=True)
    # On a cluster: cluster=None, partition="gpu", gpus=0.25, workers=64 ...
    engine = mjrec.SlurmEngine(workers=2, cluster="local")
    evaluation = mjrec.evaluate(
        ["InvertedPendulum-v5", "Hopper-v5"],
        policy="random",
        # On a cluster: a directory that all machines can see.
        directory=PLACE,
        engine=engine,
        episodes=2,
        num_seeds=2,
        max_steps=50,
        height=120,
        width=160,
    )
    for summary in evaluation.summaries:
        print(f"{summary.task}: mean return {summary.mean:.3g}")
    for video in evaluation.videos:
        print(video)


if __name__ == "__main__":
    main()
