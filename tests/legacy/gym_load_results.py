# SPDX-License-Identifier: Apache-2.0
"""Print what gym's own `load_results` returns for directories, as one JSON object.

The keys of the object are the names of the directories. Run the script in an
environment with gym 0.21.0. These commands made `answers.json`::

    cd tests/data/gym
    python ../../legacy/gym_load_results.py [0-9]*/* ours > answers.json

`write_ours` in `test_results_gym.py` wrote the temporary directory `ours`.
If gym raises an error, the value is `{"error": ...}`.
"""

import importlib.metadata
import json
import os
import sys

# Gym finds plugins through an API that Python 3.12 removed.
importlib.metadata.entry_points = dict

from gym.wrappers import monitor  # noqa: E402  needs the line above

# Gym reads files in the order of `os.listdir`, which is arbitrary.
listdir = os.listdir
os.listdir = lambda path: sorted(listdir(path))


def load(directory):
    try:
        return monitor.load_results(directory)
    except Exception as error:  # the error is the result
        return {"error": repr(error)}


results = {directory: load(directory) for directory in sys.argv[1:]}
print(json.dumps(results, indent=1))  # noqa: T201  the tests read it
