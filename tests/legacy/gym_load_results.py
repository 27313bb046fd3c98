# SPDX-License-Identifier: Apache-2.0
"""Prints what gym's own `load_results` makes of directories, as one JSON object.

Run in an environment that holds gym 0.21.0, beside the directories, whose names are the
object's keys. So `answers.json` was made::

    cd tests/data/gym
    python ../../legacy/gym_load_results.py [0-9]*/* ours > answers.json

`ours` was written by `write_ours` of `test_results_gym.py`, and removed again.
Where gym raises, the value is `{"error": ...}`.
"""

import importlib.metadata
import json
import os
import sys

# Gym looks for plugins in a way that Python 3.12 does not know any more.
importlib.metadata.entry_points = dict

from gym.wrappers import monitor  # noqa: E402  after the line above

# Gym takes the order in which the file system lists the files, which is any.
listdir = os.listdir
os.listdir = lambda path: sorted(listdir(path))


def load(directory):
    try:
        return monitor.load_results(directory)
    except Exception as error:  # the error is the result
        return {"error": repr(error)}


results = {directory: load(directory) for directory in sys.argv[1:]}
print(json.dumps(results, indent=1))  # noqa: T201  read by the test
