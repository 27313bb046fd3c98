# SPDX-License-Identifier: Apache-2.0
"""Recorded content of evaluations, without the facts that differ between runs."""

import csv

import h5py

from mjrec.formats.bundle import file_of, group_of
from mjrec.formats.trajectory_file import open_trajectory


def recorded_in(evaluation):
    """Return datasets and videos by task, seed and episode.

    Names, times and versions are left out.
    """
    with (evaluation.directory / "timing.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for row in rows:
        key = (row["task"], row["seed"], row["episode"])
        folder = evaluation.directory / row["folder"]
        with open_trajectory(folder / row["trajectory"]) as reader:
            selection = (reader.facts.get("video") or {}).get("selection")
        datasets = datasets_in(folder / row["trajectory"])
        found[*key, "trajectory"] = (datasets, selection)
        if row["video"]:
            video = folder / row["video"]
            hashes = video.with_suffix(".framehash").read_text()
            found[*key, "video"] = (video.read_bytes(), hashes)
    return found


def datasets_in(path):
    """Return type, shape and bytes of a finished trajectory's datasets by name."""
    found = {}

    def note(name, item):
        if isinstance(item, h5py.Dataset):
            found[name] = (str(item.dtype), item.shape, item[()].tobytes())

    holder = file_of(path)
    with h5py.File(holder) as file:
        (file if holder == path else file[group_of(path)]).visititems(note)
    assert "states" in found
    return found
