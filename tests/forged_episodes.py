# SPDX-License-Identifier: Apache-2.0
"""Recorded episodes, and what a forger makes of them: files that fit in themselves."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import shutil
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from trajectory_contents import TrajectoryContent, content_of

import mjrec
from mjrec.environments.mjcf_environments import MjcfEnvironment
from mjrec.evidence.verification import Check, Level, Verdict
from mjrec.evidence.verifying.physics_checks import check_physics
from mjrec.evidence.verifying.task import Task
from mjrec.formats.trajectory import PARTS, TrajectoryReader, row_dtype
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.trajectory_hdf5 import write_hdf5

_OPTIONS: dict[str, Any] = {
    "video_callable": False,
    "trajectory_callable": lambda _: True,
    "observations": True,
}


def record_gymnasium(
    directory: Path,
    env: gymnasium.Env[Any, Any],
    *,
    episodes: int = 2,
    steps: int = 20,
    seeds: Callable[[int], int | None] = lambda episode: 5 + episode,
    kind: type = np.float32,
    size: float = 0.7,
) -> Path:
    """Record random actions."""
    monitor: Any = mjrec.Monitor(env, directory, **_OPTIONS, allow_early_reset=True)
    monitor.action_space.seed(3)
    for number in range(episodes):
        monitor.reset(seed=seeds(number))
        for _ in range(steps):
            action = monitor.action_space.sample().astype(kind) * kind(size)
            _, _, terminated, truncated, _ = monitor.step(action)
            if terminated or truncated:
                break
    monitor.close()
    return directory


def record_suite(
    directory: Path, domain: str, task: str, *, episodes: int = 2, steps: int = 20
) -> Path:
    """Record random actions in a task of dm_control's suite."""
    from dm_control import suite

    env = suite.load(domain, task)
    name = f"dm_control/{domain}-{task}"
    monitor: Any = mjrec.Monitor(env, directory, **_OPTIONS, env_id=name)
    generator = np.random.default_rng(3)
    for _ in range(episodes):
        monitor.reset()
        for _ in range(steps):
            monitor.step(generator.uniform(-1, 1, monitor.action_spec().shape))
    monitor.close()
    return directory


def record_mjcf(directory: Path, path: Path, xml: str) -> Path:
    """Record the environment of an MJCF file."""
    path.write_text(xml)
    env = gymnasium.wrappers.TimeLimit(MjcfEnvironment(path), 15)
    return record_gymnasium(directory, env, episodes=1)


def episode(directory: Path, number: int = 0) -> Path:
    """Return the file of an episode."""
    [path] = directory.glob(f"*.episode{number:06d}.h5")
    return path


def forge(path: Path, **arrays: Any) -> None:
    """Write an episode anew, with other arrays; `facts` are added to its own.

    Args:
        path: of its file.
        arrays: fields of `TrajectoryContent`, or functions that change a copy of one
            in place; and `action` and `snapshot`, their dtypes.
    """
    with open_trajectory(path) as reader:
        content = content_of(reader)
    facts = {**content.facts, **arrays.pop("facts", {})}
    kinds = {name: content.dtype[name] for name in content.dtype.names[4:]}
    kinds |= {name: arrays.pop(name) for name in PARTS if name in arrays}
    changed: dict[str, Any] = {}
    for name, value in arrays.items():
        changed[name] = value
        if callable(value):
            changed[name] = np.array(getattr(content, name))
            value(changed[name])
    path.unlink()
    forged = dataclasses.replace(content, facts=facts, dtype=row_dtype(**kinds))
    write_hdf5(_in_memory(path, dataclasses.replace(forged, **changed)), path)


def fact(path: Path, name: str) -> Any:
    """Return a fact of an episode."""
    with open_trajectory(path) as reader:
        return reader.facts[name]


def swap_model(directory: Path, number: int, old: str, new: str) -> None:
    """Put another model under a name of its own, and make the facts fit."""
    path = episode(directory, number)
    stored = fact(path, "model")
    source = directory / stored["xml"]
    packed = io.BytesIO()
    with zipfile.ZipFile(source) as before, zipfile.ZipFile(packed, "w") as after:
        for member in before.infolist():
            content = before.read(member)
            if member.filename.startswith("source/"):
                assert old.encode() in content
                content = content.replace(old.encode(), new.encode())
                model = mujoco.MjModel.from_xml_string(content.decode())
            after.writestr(member, content)
    compiled = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    digest = hashlib.sha256(compiled.data).hexdigest()
    name = f"openaigym.model.{digest[:16]}.zip"
    (directory / name).write_bytes(packed.getvalue())
    size = {"sha256": digest, "bytes": len(compiled)}
    model_facts = {**stored, **size, "xml": name, "mjb": None}
    forge(path, facts={"model": model_facts})


def physics_of(directory: Path, *, trust: frozenset[str] = frozenset()) -> list[Check]:
    """Return what the level `physics` says; the directory is as it was before."""
    before = _contents(directory)
    task = Task(recordings=directory, level=Level.PHYSICS, trust=trust)
    checks = list(check_physics(task, lambda done, total: None))
    assert _contents(directory) == before
    return checks


def verdicts(checks: list[Check]) -> Counter[str]:
    """Count verdicts."""
    return Counter(check.verdict.value for check in checks)


def unchecked(checks: list[Check]) -> list[Check]:
    """Return what cannot be checked."""
    return [check for check in checks if check.verdict is Verdict.NOT_CHECKABLE]


def failed(checks: list[Check]) -> list[str]:
    """Return what failed, by what it was checked of."""
    claims = (
        ("the model", "model"),
        ("each recorded state", "steps"),
        ("the environment begins", "start"),
        ("the recorded actions", "states"),
        ("the environment gives the recorded rewards", "rewards"),
        ("the environment ends", "ends"),
        ("the environment gives the recorded observations", "observations"),
        ("the episode's states", "file"),
        ("what the pictures", "pictures"),
        ("the name", "name"),
    )
    short: Mapping[str, str] = dict(claims)
    return [
        next(name for claim, name in short.items() if check.claim.startswith(claim))
        for check in checks
        if check.verdict is Verdict.FAIL
    ]


def copied(directory: Path, to: Path) -> Path:
    """Return a copy of a directory."""
    return Path(shutil.copytree(directory, to))


def _in_memory(path: Path, content: TrajectoryContent) -> TrajectoryReader:
    def read(part: str, start: int, stop: int) -> Any:
        rows = getattr(content, f"{part}s")[start:stop]
        if part == "state":
            return np.ascontiguousarray(rows).view(content.dtype[part])[:, 0]
        return rows

    return TrajectoryReader(
        path=path,
        facts=content.facts,
        dtype=content.dtype,
        row_count=len(content.states),
        rewards=content.rewards,
        terminated=content.terminated,
        truncated=content.truncated,
        frame_steps=content.frame_steps,
        change_count=len(content.model_changes),
        dropped=content.dropped,
        read=read,
        read_change=content.model_changes.__getitem__,
        release=lambda: None,
    )


def _contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}
