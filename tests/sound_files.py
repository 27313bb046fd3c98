# SPDX-License-Identifier: Apache-2.0
"""One valid file of each kind that mjrec reads, for tests to damage."""

import json

import mujoco
import numpy as np
from result_files import write_journal, write_saved
from trajectories_by_hand import INFIX, add_row, new_logs, write_log

from mjrec.formats.monitor_directory import journal_name, trajectory_prefix
from mjrec.formats.spans import log_paths
from mjrec.formats.trajectory import ModelChange, row_dtype
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.simulation.model_sources import authored_from_file
from mjrec.simulation.model_store import ModelStore

PARTS = (".log", ".tail", ".looks")
SPHERE = '<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>'


def manifest(directory):
    return write_saved(directory, "0.7", 3)


def stats(directory):
    write_saved(directory, "0.7", 3)
    return directory / "openaigym.episode_batch.0.7.stats.json"


def journal(directory):
    return write_journal(directory, "0.7", 3)


def metadata(directory):
    path = directory / "openaigym.video.0.7.video000000.meta.json"
    path.write_text('{"broken": false}')
    return path


def finished(directory):
    return finish_trajectory(write_log(directory))


def store_model(directory, xml=SPHERE):
    source = directory.parent / "main.xml"
    source.write_text(xml)
    store = ModelStore(directory)
    facts = store.add(
        mujoco.MjModel.from_xml_path(str(source)), authored_from_file(source)
    )
    store.finish()
    return facts


def compiled(directory):
    facts = {**store_model(directory), "xml": None}
    (directory / "facts.json").write_text(json.dumps(facts))
    return directory / facts["mjb"]


def source(directory):
    facts = {**store_model(directory), "mujoco": "3.1.4", "mjb": None}
    (directory / "facts.json").write_text(json.dumps(facts))
    return directory / facts["xml"]


def mjcf(directory):
    path = directory / "sphere.xml"
    path.write_text(SPHERE)
    return path


def video(directory):
    path = directory / "openaigym.video.0.7.video000000.mp4"
    path.write_bytes(b"frames")
    metadata(directory)
    return path


def killed(directory):
    """Record an episode that was cut by a kill; return its log."""
    dtype = row_dtype(observation=np.dtype(("<f8", (9,))))
    logs = new_logs(directory, tail_bytes=1)
    span = logs.begin(trajectory_prefix(INFIX, 0), {}, dtype)
    for step in range(10):
        if step == 5:
            span.log.add_change(ModelChange(step=5, fields={"geom_rgba": np.ones(4)}))
        add_row(span, step, observation=step)
    span.note({"rate": "20"})
    logs.release()
    [log] = log_paths(directory)
    return log


def journal_of_killed(directory):
    return killed(directory).with_name(journal_name(INFIX))


def killed_with(part):
    return lambda directory: killed(directory).with_suffix(part)


# The reader of `hostile_reading` and the builder of each kind of file.
FILES = {
    "manifest": ("manifest", manifest),
    "stats": ("stats", stats),
    "journal": ("journal", journal),
    "metadata": ("metadata", metadata),
    "h5": ("trajectory", finished),
    "mjb.gz": ("model", compiled),
    "zip": ("model", source),
    "mjcf": ("mjcf", mjcf),
    "video for an archive": ("archive", video),
    "spans": ("finish", journal_of_killed),
    **{part: ("finish", killed_with(part)) for part in PARTS},
}
