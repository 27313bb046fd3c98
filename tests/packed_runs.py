# SPDX-License-Identifier: Apache-2.0
"""Packed runs to verify, and to forge: unpacked, edited, and made to fit again."""

import hashlib
import json
import re
import zipfile

import gymnasium

import mjrec
from mjrec.evidence.compare_descriptions import written_again
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
    """Unpack a packed run of ours, and return its folder."""
    with zipfile.ZipFile(archive) as file:
        file.extractall(into)
    [folder] = into.iterdir()
    return folder


def make_bag_fit(bag):
    """Let the lists of a packed run say what is there, whatever that is."""
    sizes = [path.stat().st_size for path in _files(bag / "data")]
    info, count = bag / "bag-info.txt", f"{sum(sizes)}.{len(sizes)}"
    info.write_text(re.sub(r"(?<=Oxum: )[\d.]+", count, info.read_text()))
    _write_manifest(bag, "manifest-sha512.txt", _files(bag / "data"))
    tags = (p for p in bag.iterdir() if p.is_file() and p.name[:3] != "tag")
    _write_manifest(bag, "tagmanifest-sha512.txt", sorted(tags))


def describe_again(bag):
    """Let all descriptions of a packed run follow from its recordings."""
    # The second time with the sizes that the first has made.
    for _ in range(2):
        for name, text in written_again(bag).items():
            is_tag = (bag / name).exists()
            (bag / name if is_tag else bag / "data" / name).write_text(text)


def the(folder, pattern):
    """Return the one file below a folder that a pattern stands for."""
    [path] = folder.rglob(pattern)
    return path


def edit_json(path, edit):
    """Change what a file of JSON holds, and write it as it was written."""
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
