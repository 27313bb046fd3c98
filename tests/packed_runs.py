# SPDX-License-Identifier: Apache-2.0
"""Packed runs for tests: recorded, unpacked, edited and made consistent again."""

import hashlib
import json
import re
import zipfile

import gymnasium

import mjrec
from mjrec.evidence.compare_descriptions import rewritten
from mjrec.json_text import dumps


def record_pendulum(directory, episodes=3, *, longest=8, **options):
    """Record short episodes with small frames."""
    env = gymnasium.make(
        "InvertedPendulum-v5",
        render_mode="rgb_array",
        width=32,
        height=32,
        max_episode_steps=longest,
    )
    with mjrec.Monitor(env, directory, workers=1, **options) as env:
        env.action_space.seed(5)
        for episode in range(episodes):
            env.reset(seed=episode)
            done = False
            while not done:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                done = terminated or truncated


def unpacked(archive, into):
    """Unpack a packed run, and return its folder."""
    with zipfile.ZipFile(archive) as file:
        file.extractall(into)
    [folder] = into.iterdir()
    return folder


def make_bag_fit(bag):
    """Update the file lists of a packed run."""
    sizes = [path.stat().st_size for path in _files(bag / "data")]
    info, count = bag / "bag-info.txt", f"{sum(sizes)}.{len(sizes)}"
    info.write_text(re.sub(r"(?<=Oxum: )[\d.]+", count, info.read_text()))
    _write_manifest(bag, "manifest-sha512.txt", _files(bag / "data"))
    tags = (p for p in bag.iterdir() if p.is_file() and p.name[:3] != "tag")
    _write_manifest(bag, "tagmanifest-sha512.txt", sorted(tags))


def rewrite_descriptions(bag):
    """Rewrite all descriptions of a packed run from its recordings."""
    # Descriptions contain sizes, which the first round changes.
    for _ in range(2):
        for name, text in rewritten(bag).items():
            is_tag = (bag / name).exists()
            (bag / name if is_tag else bag / "data" / name).write_text(text)


def the(folder, pattern):
    """Return the only file below a folder that matches."""
    [path] = folder.rglob(pattern)
    return path


def edit_json(path, edit):
    """Edit the content of a JSON file, and keep its layout."""
    text = path.read_text()
    content = json.loads(text)
    edit(content)
    indent = 2 if text.startswith("{\n") else None
    path.write_text(dumps(content, indent=indent) + "\n" * text.endswith("\n"))


def _write_manifest(bag, name, paths):
    lines = (
        f"{hashlib.sha512(path.read_bytes()).hexdigest()}  "
        f"{path.relative_to(bag).as_posix()}\n"
        for path in paths
    )
    (bag / name).write_text("".join(lines))


def _files(folder):
    return (path for path in sorted(folder.rglob("*")) if path.is_file())
