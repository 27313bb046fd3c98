# SPDX-License-Identifier: Apache-2.0

from gymnasium.vector import AsyncVectorEnv
from parts import parametrize
from recordings import hashes_at
from vector_environments import DISABLED, NEXT_STEP, SAME_STEP, play

import mjrec

_STEPS = 3


def monitored_hopper(directory):
    """Return what makes a monitored environment, in whichever process."""

    def make():
        # In here, because a spawned process has imported nothing.
        import gymnasium

        import mjrec

        env = gymnasium.make("Hopper-v5", max_episode_steps=3, width=64, height=64)
        return mjrec.Monitor(env, directory, resume=True, render="deferred", workers=1)

    return make


@parametrize(
    ("context", "mode"),
    [("spawn", NEXT_STEP), ("forkserver", SAME_STEP), ("fork", DISABLED)],
)
def test_each_worker_records_its_own(tmp_path, context, mode):
    """Videos are rendered from states, whole, also in daemonic processes."""
    make = monitored_hopper(tmp_path)
    env = AsyncVectorEnv([make, make], context=context, autoreset_mode=mode)
    workers = {process.pid for process in env.processes}
    play(env, _STEPS + 1, seed=3)
    env.close()
    for worker in workers:
        [hashes] = tmp_path.glob(f"*.{worker}.video000000.framehash")
        assert len(hashes_at(hashes)) == _STEPS + 1
        assert hashes.with_suffix(".mp4").exists()
    results = mjrec.load_results(tmp_path)
    assert list(results["episode_lengths"]) == [_STEPS, _STEPS]
    assert not list(tmp_path.glob(".*"))
