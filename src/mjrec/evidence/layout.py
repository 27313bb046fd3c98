# SPDX-License-Identifier: Apache-2.0
"""The layout of a packed run.

::

    run.zip
    └── run/                            one folder, named like the zip file
        ├── bagit.txt                   BagIt 1.0 (RFC 8493)
        ├── bag-info.txt
        ├── manifest-sha512.txt
        ├── tagmanifest-sha512.txt
        └── data/                       the RO-Crate
            ├── ro-crate-metadata.json
            ├── README.md
            ├── CITATION.cff
            ├── environment.json        how the recording was made
            ├── statistics.csv          a row for each episode
            └── recordings/             the monitor directory
                └── openaigym.*

`pack` writes this layout, and `verify` reads it.
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

# In bag-info.txt. The version increases when readers must handle a change.
FORMAT_KEY: Final = "Mjrec-Evidence-Version"
FORMAT_VERSION: Final = 1

# The columns of the table of episodes, in order.
STATISTICS_COLUMNS: Final = (
    *("monitor", "episode_id", "type", "length", "reward"),
    *("start_time", "end_time", "seed", "terminated", "truncated"),
    *("video", "video_sha256", "trajectory"),
)

# Archives with more files are neither written nor read. An archive of thirty thousand
# recorded episodes has fewer.
MOST_ENTRIES: Final = 100_000

# The folder of sampled frames, next to the payload of a recreated run.
SAMPLED: Final = "sampled"

# In the key `mjrec` of a packed manifest: the episodes that were chosen for packing.
PACKED_EPISODES: Final = "packed_episodes"
# In the facts of the packed trajectory of an episode that was not chosen: its states
# and snapshots were left out, but its actions, rewards and seeds are packed.
STATES_LEFT_OUT: Final = "states_left_out"
