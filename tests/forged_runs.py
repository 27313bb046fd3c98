# SPDX-License-Identifier: Apache-2.0
"""Edit a monitor directory the way a liar would, keeping everything consistent.

A liar has mjrec too, so statistics follow from the journal, hashes match the files,
and files agree with each other; `mjrec.pack` then computes the rest.
"""

import dataclasses
import json
import subprocess
import zipfile
from fractions import Fraction

import numpy as np
from trajectory_contents import content_of

import mjrec
from mjrec.formats.ffmpeg import ffmpeg_executable
from mjrec.formats.trajectory import PARTS, added_up, row_dtype
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.trajectory_hdf5 import write_hdf5
from mjrec.formats.video_file import content_facts
from mjrec.formats.video_writer import VideoWriter

_OF_METADATA = ("length", "reward", "terminated", "truncated", "seed", "options")


class ForgedRun:
    """Edit a directory that one monitor recorded."""

    def __init__(self, directory):
        self.directory = directory

    # Find files.

    def the(self, pattern):
        [path] = self.directory.glob(pattern)
        return path

    def trajectory(self, episode):
        return self.the(f"*.episode{episode:06d}.h5")

    def video(self, episode):
        return self.the(f"*.video{episode:06d}.mp4")

    def metadata(self, episode):
        return self.video(episode).with_suffix(".meta.json")

    def content(self, episode):
        with open_trajectory(self.trajectory(episode)) as reader:
            return content_of(reader)

    def frames(self, episode):
        """Return an episode's frames, rendered from its current trajectory."""
        return list(mjrec.render(self.trajectory(episode)))

    def lines(self):
        """Return the parsed lines of the journal."""
        return [json.loads(x) for x in self.the("*.jsonl").read_text().splitlines()]

    # Edit one file.

    def edit_json(self, pattern, edit=None, **facts):
        """Edit the JSON files that match a pattern."""
        for path in self.directory.glob(pattern):
            content = json.loads(path.read_text())
            if edit is not None:
                edit(content)
            path.write_text(json.dumps({**content, **facts}))

    def edit_details(self, **facts):
        """Change mjrec's part of the manifest."""
        self.edit_json("*.manifest.json", lambda said: said["mjrec"].update(facts))

    def edit_journal(self, edit=lambda lines: None):
        """Edit the lines of the journal and update the statistics to match."""
        lines = self.lines()
        edit(lines)
        text = "".join(f"{json.dumps(line)}\n" for line in lines)
        self.the("*.jsonl").write_text(text)
        complete = [line for line in lines if "length" in line]
        self.edit_json(
            "*.stats.json",
            initial_reset_timestamp=complete[0]["start_time"],
            timestamps=[line["end_time"] for line in complete],
            episode_lengths=[line["length"] for line in complete],
            episode_rewards=[line["reward"] for line in complete],
            episode_types=[line["type"] for line in complete],
        )

    def rewrite_zip(self, change=lambda content: content, beside=lambda info: None):
        """Change the files in a model's source archive or their headers."""
        path = self.the("*.model.*.zip")
        with zipfile.ZipFile(path) as archive:
            members = [(info, archive.read(info)) for info in archive.infolist()]
        with zipfile.ZipFile(path, "w") as archive:
            for info, content in members:
                beside(info)
                archive.writestr(info, change(content))

    def edit_rows(self, episode, *, facts=(), **arrays):
        """Rewrite a trajectory with other facts, arrays, or dtypes of `PARTS`.

        An array may be a function that edits a copy of the current array in place.
        """
        path = self.trajectory(episode)
        with open_trajectory(path) as reader:
            content = content_of(reader)
            kinds = {part: arrays.pop(part, reader.kind(part)) for part in PARTS}
            known = {part: kind for part, kind in kinds.items() if kind is not None}
            for name, value in arrays.items():
                if callable(value):
                    arrays[name] = np.array(getattr(content, name))
                    value(arrays[name])
            content = dataclasses.replace(content, **arrays)

            def read(part, start, stop):
                rows = getattr(content, f"{part}s")[start:stop]
                if part == "state":
                    return np.ascontiguousarray(rows).view(known[part])[:, 0]
                return rows

            for name in ("rewards", "terminated", "truncated", "frame_steps"):
                setattr(reader, name, getattr(content, name))
            reader.facts = {**content.facts, **dict(facts)}
            reader.dtype = row_dtype(**known)
            reader.row_count = len(content.states)
            reader.read = read
            write_hdf5(reader, path)

    # Edit several files consistently.

    def say(self, episode, **facts):
        """Change facts of an episode in every file that states them."""

        def edit(lines):
            [line] = [each for each in lines if each.get("episode_id") == episode]
            line.update(facts)

        self.edit_journal(edit)
        self.edit_rows(episode, facts=facts)
        known = {name: facts[name] for name in _OF_METADATA if name in facts}
        self.edit_json(f"*.video{episode:06d}*.meta.json", **known)

    def say_rewards(self, episode, change):
        """Change the rewards of an episode, and the return to match."""
        rewards = np.asarray(change(self.content(episode).rewards.copy()))
        self.edit_rows(episode, rewards=rewards)
        self.say(episode, reward=added_up(rewards))

    def say_everywhere(self, edit):
        """Edit every JSON object in the journal, manifest, metadata and facts."""

        def walk(value):
            if isinstance(value, dict):
                edit(value)
                value = [*value.values()]
            if isinstance(value, list):
                for item in value:
                    walk(item)

        self.edit_journal(walk)
        self.edit_json("*.manifest.json", walk)
        self.edit_json("*.meta.json", walk)
        for path in sorted(self.directory.glob("*.h5")):
            with open_trajectory(path) as reader:
                reader.facts = dict(reader.facts)
                walk(reader.facts)
                write_hdf5(reader, path)

    def replace_everywhere(self, old, new, *, key=None):
        """Replace a value in every JSON object, for one key or for all keys."""

        def edit(facts):
            for name, value in facts.items():
                if value == old and key in (None, name):
                    facts[name] = new

        self.say_everywhere(edit)

    # Edit a video.

    def film(self, episode, frames=None, *, encoder_arguments=(), **said):
        """Encode frames, by default those of the trajectory, as an episode's video.

        The hashes and metadata are updated, and `said` is added to the metadata.
        """
        frames = self.frames(episode) if frames is None else frames
        path, known = (
            self.video(episode),
            json.loads(self.metadata(episode).read_text()),
        )
        fps = Fraction(said.get("fps", known["fps"]))
        more = {"encoder_arguments": encoder_arguments}
        with VideoWriter(path, fps=fps, frame_hashes=True, **more) as writer:
            for frame in frames:
                writer.write(frame)
        height, width = frames[0].shape[:2]
        sides = {"height": height, "width": width}
        sides |= {f"padded_{name}": side + side % 2 for name, side in sides.items()}
        steps = [[0, len(frames) - 1]]
        counts = {"frame_count": len(frames), "frame_steps": steps}
        self.rehash(episode, **counts, **sides, **said)

    def mux(self, episode, *arguments, inputs=(), metadata="-1"):
        """Remux a video with ffmpeg without changing its frames."""
        path = self.video(episode)
        changed = path.with_suffix(".changed.mp4")
        sources = [each for one in (path, *inputs) for each in ("-i", str(one))]
        command = [ffmpeg_executable(), "-v", "error", *sources, *arguments]
        # These are mjrec's own options, so nothing else differs.
        alike = ("-fflags", "+bitexact", "-movflags", "+faststart", "-map_metadata")
        subprocess.run([*command, *alike, metadata, str(changed)], check=True)
        changed.replace(path)
        self.rehash(episode)

    def rehash(self, episode, **facts):
        """Update the hashes in a video's metadata, and add facts."""
        path = self.metadata(episode)
        said = {**json.loads(path.read_text()), **facts}
        size = {side: said[f"padded_{side}"] for side in ("height", "width")}
        found = content_facts(self.video(episode), **size, pixel_format="yuv420p")
        # The caller has already given the frame count.
        hashes = {key: found[key] for key in ("file_sha256", "decoded_sha256")}
        path.write_text(json.dumps({**said, **hashes}))

    # Edit the set of episodes.

    def remove_video(self, episode):
        """Remove a video and its entry in the manifest."""
        for path in self.directory.glob(f"*.video{episode:06d}.*"):
            path.unlink()
        self.list_no_video(f".video{episode:06d}.")

    def list_no_video(self, part):
        """Remove from the manifest the videos whose file names contain `part`."""

        def edit(said):
            said["videos"] = [pair for pair in said["videos"] if part not in pair[0]]

        self.edit_json("*.manifest.json", edit)

    def remove_episode(self, episode):
        """Remove all traces of an episode."""
        self.remove_video(episode)
        self.trajectory(episode).unlink(missing_ok=True)

        def edit(lines):
            lines[:] = [each for each in lines if each.get("episode_id") != episode]

        self.edit_journal(edit)
        self._edit_recorded(lambda numbers: [n for n in numbers if n != episode])

    def renumber(self, old, new):
        """Give an episode another number in all file names and contents."""

        def renamed(text):
            for kind in ("video", "episode"):
                text = text.replace(f"{kind}{old:06d}", f"{kind}{new:06d}")
            return text

        def walk(value):
            if isinstance(value, dict):
                number = {"episode_id": new} if value.get("episode_id") == old else {}
                return {key: walk(item) for key, item in {**value, **number}.items()}
            if isinstance(value, list):
                return [walk(item) for item in value]
            return renamed(value) if isinstance(value, str) else value

        self.edit_rows(old, facts=walk(self.content(old).facts))
        for path in sorted(self.directory.iterdir()):
            path.rename(path.with_name(renamed(path.name)))
        for pattern in ("*.meta.json", "*.manifest.json"):
            self.edit_json(pattern, lambda said: said.update(walk(said)))
        self.edit_journal(lambda lines: lines.__setitem__(slice(None), walk(lines)))
        self._edit_recorded(lambda numbers: [new if n == old else n for n in numbers])

    def _edit_recorded(self, change):
        def edit(said):
            schedule = said["mjrec"]["schedule"]
            schedule["recorded"] = change(schedule["recorded"])

        self.edit_json("*.manifest.json", edit)

    def say_numbers(self, following):
        """Change the number of episodes."""
        self.edit_details(next_episode_id=following)

        def edit(lines):
            for line in lines:
                if "closed" in line:
                    line["closed"]["next_episode_id"] = following

        self.edit_journal(edit)
