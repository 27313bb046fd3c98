# SPDX-License-Identifier: Apache-2.0
"""What stands where in a packed run.

::

    run.zip
    └── run/                            one folder, of the zip's name
        ├── bagit.txt                   BagIt 1.0 (RFC 8493)
        ├── bag-info.txt
        ├── manifest-sha512.txt
        ├── tagmanifest-sha512.txt
        └── data/                       the RO-Crate
            ├── ro-crate-metadata.json
            ├── README.md
            ├── CITATION.cff
            ├── environment.json        what the recording was made with
            ├── statistics.csv          a row for each episode
            └── recordings/             the monitor directory
                └── openaigym.*

Packing writes it and verifying reads it.
"""

from __future__ import annotations

from typing import Final

PAYLOAD: Final = "data"
# Below the payload.
CRATE: Final = "ro-crate-metadata.json"
README: Final = "README.md"
CITATION: Final = "CITATION.cff"
ENVIRONMENT: Final = "environment.json"
STATISTICS: Final = "statistics.csv"
RECORDINGS: Final = "recordings"

# In bag-info.txt. It rises when a reader must know of a change.
FORMAT_KEY: Final = "Mjrec-Evidence-Version"
FORMAT_VERSION: Final = 1

# Of the table of episodes, in their order.
STATISTICS_COLUMNS: Final = (
    *("monitor", "episode_id", "type", "length", "reward"),
    *("start_time", "end_time", "seed", "terminated", "truncated"),
    *("video", "video_sha256", "trajectory"),
)

# Packing refuses to make archives of more files, and verifying to read them. That of
# thirty thousand recorded episodes has fewer.
MOST_ENTRIES: Final = 100_000

# Beside the payload of a run that was recreated: the frames that were drawn.
SAMPLED: Final = "sampled"

# In the key `mjrec` of a packed manifest: the episodes that were chosen for packing.
PACKED_EPISODES: Final = "packed_episodes"
# In the facts of a packed trajectory of another episode, whose actions, rewards and
# seeds are packed: its states and snapshots were left out.
STATES_LEFT_OUT: Final = "states_left_out"
