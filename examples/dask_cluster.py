"""Evaluate on a Dask cluster.

Any executor works if all of its workers can see the directory.
"""

import shutil
from pathlib import Path

import distributed

import mjrec

PLACE = Path("recordings/dask_cluster")


def main() -> None:
    shutil.rmtree(PLACE, ignore_errors=True)
    # On a cluster: distributed.Client("tcp://scheduler:8786").
    with (
        distributed.LocalCluster(n_workers=2, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        evaluation = mjrec.evaluate(
            ["InvertedPendulum-v5", "Hopper-v5"],
            policy="random",
            # On a cluster: a directory that all machines can see.
            directory=PLACE,
            # Run every job, even if an identical job has already run.
            engine=client.get_executor(pure=False),
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
