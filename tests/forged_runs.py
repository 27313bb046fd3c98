# SPDX-License-Identifier: Apache-2.0
"""Monitor directories that a liar has edited: all that follows from a lie fits.

A liar has mjrec too. So statistics follow from the journal, hashes from the files, and
what one file says of another is true; `mjrec.pack` then computes the rest.
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
from mjrec.formats.trajectory import PARTS, TrajectoryReader, added_up, row_dtype
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.trajectory_hdf5 import write_hdf5
from mjrec.formats.video_file import content_facts
from mjrec.formats.video_writer import VideoWriter

# Where facts of an episode stand in each kind of file.
_OF_METADATA = ("length", "reward", "terminated", "truncated", "seed", "options")


class ForgedRun:
    """A monitor directory of one monitor, and edits of it.

    Args:
        directory: the copy that is edited.
    """

    def __init__(self, directory):
        self.directory = directory

    # What files there are.

    def the(self, pattern):
        """Return the one file that a pattern stands for."""
        [path] = self.directory.glob(pattern)
        return path

    def trajectory(self, episode):
        """Return the trajectory of an episode."""
        return self.the(f"*.episode{episode:06d}.h5")

    def video(self, episode):
        """Return the video of an episode."""
        return self.the(f"*.video{episode:06d}.mp4")

    def content(self, episode):
        """Return what a trajectory holds."""
        with open_trajectory(self.trajectory(episode)) as reader:
            return content_of(reader)

    def frames(self, episode):
        """Return the frames of an episode, drawn from its trajectory as it is."""
        return list(mjrec.render(self.trajectory(episode)))

    # Edits of one file.

    def edit_json(self, pattern, edit):
        """Change what files of JSON hold."""
        for path in self.directory.glob(pattern):
            content = json.loads(path.read_text())
            edit(content)
            path.write_text(json.dumps(content))

    def edit_journal(self, edit):
        """Change the lines of the journal; statistics and manifest follow."""
        path = self.the("*.jsonl")
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        edit(lines)
        path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
        complete = [line for line in lines if "length" in line]
        self.edit_json(
            "*.stats.json",
            lambda stats: stats.update(
                initial_reset_timestamp=complete[0]["start_time"],
                timestamps=[line["end_time"] for line in complete],
                episode_lengths=[line["length"] for line in complete],
                episode_rewards=[line["reward"] for line in complete],
                episode_types=[line["type"] for line in complete],
            ),
        )

    def rewrite_zip(self, path, change):
        """Change what the sources of a model hold."""
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, change(content))

    def edit_rows(self, episode, **arrays):
        """Write a trajectory anew, with other arrays and facts.

        Args:
            episode: its number.
            arrays: fields of `TrajectoryContent`, or functions that change a copy of
                one in place; `facts`, which are added to its own or to
                `all_facts`; and `action`,
                `state`, `snapshot` and `observation`, their dtypes.
        """
        path, content = self.trajectory(episode), self.content(episode)
        facts = arrays.pop("all_facts", content.facts)
        facts = {**facts, **arrays.pop("facts", {})}
        kinds = {name: content.dtype[name] for name in content.dtype.names[4:]}
        kinds |= {name: arrays.pop(name) for name in PARTS if name in arrays}
        known = {name: kind for name, kind in kinds.items() if kind is not None}
        for name, value in arrays.items():
            if callable(value):
                arrays[name] = np.array(getattr(content, name))
                value(arrays[name])
        forged = dataclasses.replace(
            content, facts=facts, dtype=row_dtype(**known), **arrays
        )
        path.unlink()
        write_hdf5(_in_memory(path, forged), path)

    # Edits of what several files say.

    def say(self, episode, **facts):
        """Say something of an episode wherever such a thing is said."""

        def edit(lines):
            [line] = [each for each in lines if each.get("episode_id") == episode]
            line.update(facts)

        self.edit_journal(edit)
        self.edit_rows(episode, facts=facts)
        known = {name: facts[name] for name in _OF_METADATA if name in facts}
        self.edit_json(
            f"*.video{episode:06d}*.meta.json", lambda said: said.update(known)
        )

    def say_rewards(self, episode, change):
        """Say other rewards of an episode, and the return that follows."""
        rewards = np.asarray(change(self.content(episode).rewards.copy()))
        self.edit_rows(episode, rewards=rewards)
        self.say(episode, reward=added_up(rewards))

    def say_everywhere(self, edit):
        """Edit every object of JSON: in the journal, manifest, metadata and facts."""

        def walk(value):
            if isinstance(value, dict):
                edit(value)
            for item in value.values() if isinstance(value, dict) else ():
                walk(item)
            for item in value if isinstance(value, list) else ():
                walk(item)

        self.edit_journal(walk)
        self.edit_json("*.manifest.json", walk)
        self.edit_json("*.meta.json", walk)
        for path in sorted(self.directory.glob("*.h5")):
            with open_trajectory(path) as reader:
                facts = dict(reader.facts)
                walk(facts)
                reader.facts = facts
                write_hdf5(reader, path)

    # Edits of a video.

    def film(self, episode, frames=None, *, encoder_arguments=(), **metadata):
        """Put frames into the video of an episode, with hashes and metadata.

        Args:
            episode: its number.
            frames: those of its trajectory as it is now, if None.
            encoder_arguments: as of `VideoWriter`.
            metadata: what else is said.
        """
        frames = self.frames(episode) if frames is None else frames
        path = self.video(episode)
        said = json.loads(path.with_suffix(".meta.json").read_text())
        said.update({"frame_count": len(frames), "frame_steps": [[0, len(frames) - 1]]})
        fps = Fraction(metadata.get("fps", said["fps"]))
        more = {"encoder_arguments": encoder_arguments}
        with VideoWriter(path, fps=fps, frame_hashes=True, **more) as writer:
            for frame in frames:
                writer.write(frame)
        height, width = frames[0].shape[:2]
        size = {"height": height, "width": width}
        padded = {f"padded_{name}": side + side % 2 for name, side in size.items()}
        self._note(path, {**said, **size, **padded, **metadata})

    def mux(self, episode, *arguments, inputs=(), metadata="-1"):
        """Pass a video through ffmpeg, whose frames stay what they are."""
        path = self.video(episode)
        changed = path.with_suffix(".changed.mp4")
        sources = [each for one in (path, *inputs) for each in ("-i", str(one))]
        command = [ffmpeg_executable(), "-v", "error", *sources, *arguments]
        # As mjrec does, so that nothing else differs.
        alike = ("-fflags", "+bitexact", "-movflags", "+faststart", "-map_metadata")
        subprocess.run([*command, *alike, metadata, str(changed)], check=True)
        changed.replace(path)
        self.rehash(episode)

    def rehash(self, episode):
        """Let the metadata of a video say the hashes of the file."""
        path = self.video(episode)
        self._note(path, json.loads(path.with_suffix(".meta.json").read_text()))

    def _note(self, path, said):
        """Write the metadata of a video with the hashes of the file."""
        size = {side: said[f"padded_{side}"] for side in ("height", "width")}
        facts = content_facts(path, **size, pixel_format="yuv420p")
        # How many frames there are was said.
        hashes = {key: facts[key] for key in ("file_sha256", "decoded_sha256")}
        path.with_suffix(".meta.json").write_text(json.dumps({**said, **hashes}))

    # Edits of which episodes there are.

    def remove_video(self, episode):
        """Remove a video, and what names it but the journal."""
        for path in self.directory.glob(f"*.video{episode:06d}.*"):
            path.unlink()
        self.edit_json("*.manifest.json", lambda said: _without(said, episode))

    def remove_episode(self, episode):
        """Remove an episode as if it had never been."""
        self.remove_video(episode)
        self.trajectory(episode).unlink(missing_ok=True)
        self.edit_journal(
            lambda lines: lines.__setitem__(
                slice(None),
                [each for each in lines if each.get("episode_id") != episode],
            )
        )
        self.edit_json(
            "*.manifest.json",
            lambda said: said["mjrec"]["schedule"].update(
                recorded=[
                    n for n in said["mjrec"]["schedule"]["recorded"] if n != episode
                ]
            ),
        )

    def renumber(self, old, new):
        """Give an episode another number, in all names and texts."""
        texts = {f"video{old:06d}": f"video{new:06d}"}
        texts[f"episode{old:06d}"] = f"episode{new:06d}"

        def renamed(text):
            for before, after in texts.items():
                text = text.replace(before, after)
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
        self.edit_json(
            "*.manifest.json",
            lambda said: said["mjrec"]["schedule"].update(
                recorded=[
                    new if n == old else n
                    for n in said["mjrec"]["schedule"]["recorded"]
                ]
            ),
        )

    def say_numbers(self, following):
        """Say how many episodes there were."""
        self.edit_json(
            "*.manifest.json",
            lambda said: said["mjrec"].update(next_episode_id=following),
        )
        self.edit_journal(
            lambda lines: [
                line["closed"].update(next_episode_id=following)
                for line in lines
                if "closed" in line
            ]
        )


def _without(manifest, episode):
    stem = f".video{episode:06d}."
    manifest["videos"] = [v for v in manifest["videos"] if stem not in v[0]]


def _in_memory(path, content):
    def read(part, start, stop):
        rows = getattr(content, f"{part}s")[start:stop]
        if part == "state":
            return np.ascontiguousarray(rows).view(content.dtype[part])[:, 0]
        return rows

    return TrajectoryReader(
        path=path,
        facts=content.facts,
        dtype=content.dtype,
        row_count=len(content.states),
        rewards=content.rewards,
        terminated=content.terminated,
        truncated=content.truncated,
        frame_steps=content.frame_steps,
        change_count=len(content.model_changes),
        dropped=content.dropped,
        read=read,
        read_change=content.model_changes.__getitem__,
        release=lambda: None,
    )
