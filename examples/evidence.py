"""Evaluate a policy, pack the run for a paper, and verify it like a reader would."""

from pathlib import Path

import gymnasium

import mjrec

directory, archive = Path("recordings/evidence"), Path("recordings/evidence.zip")

# In evaluation mode every episode keeps its actions and its seed, so that readers can
# reproduce all episodes.
env = gymnasium.make("HalfCheetah-v5", max_episode_steps=20)
with mjrec.Monitor(
    env,
    directory,
    force=True,
    mode="evaluation",
    keep="median",
    height=120,
    width=160,
    policy_file=__file__,
) as env:
    env.action_space.seed(0)
    for episode in range(5):
        env.reset(seed=episode)
        done = False
        while not done:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            done = terminated or truncated

archive.unlink(missing_ok=True)
mjrec.pack(directory, archive, title="A random cheetah", license="CC0-1.0")

verification = mjrec.verify(archive, report="recordings/evidence.html")
for finding in verification.findings:
    if finding.outcome != "recreated":
        print(f"{finding.outcome}: {finding.topic}, {finding.item}: {finding.reason}")
print(verification.verdict)
