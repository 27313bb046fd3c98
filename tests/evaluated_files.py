# SPDX-License-Identifier: Apache-2.0
"""What an evaluation has recorded, whoever ran it and under whatever names."""

import csv

import h5py

from mjrec.formats.bundle import file_of, group_of
from mjrec.formats.trajectory_file import open_trajectory


def recorded_in(evaluation):
    """Return what was recorded of each episode: every dataset, and videos as bytes.

    By task, seed and episode; what differs with each run (names, times, versions) is
    left out.
    """
    with (evaluation.directory / "timing.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for row in rows:
        of = (row["task"], row["seed"], row["episode"])
        folder = evaluation.directory / row["folder"]
        with open_trajectory(folder / row["trajectory"]) as reader:
            promised = (reader.facts.get("video") or {}).get("selection")
        found[*of, "trajectory"] = (datasets_in(folder / row["trajectory"]), promised)
        if row["video"]:
            video = folder / row["video"]
            hashes = video.with_suffix(".framehash").read_text()
            found[*of, "video"] = (video.read_bytes(), hashes)
    return found


def datasets_in(path):
    """Return the datasets of a finished trajectory by name: type, shape, content."""
    found = {}

    def note(name, item):
        if isinstance(item, h5py.Dataset):
            found[name] = (str(item.dtype), item.shape, item[()].tobytes())

    holder = file_of(path)
    with h5py.File(holder) as file:
        (file if holder == path else file[group_of(path)]).visititems(note)
    assert "states" in found
    return found
