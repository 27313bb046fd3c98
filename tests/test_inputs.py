# SPDX-License-Identifier: Apache-2.0
"""The inputs of a run, read from its recordings."""

import dataclasses
import json
import shutil

import gymnasium
import numpy as np
import pytest
from packed_runs import the

import mjrec
from mjrec.errors import Error
from mjrec.evidence.inputs import (
    ARRAYS_FILE,
    OPTIONS,
    EpisodeInputs,
    Inputs,
    RecordingInputs,
    given_actions,
)
from mjrec.evidence.read_inputs import read_inputs
from mjrec.recorder.options import RecorderOptions

# Options of the recorder that are no inputs, with the reason.
OTHERS = {
    "other fields of inputs": "video_callable keep mode trajectory_callable statements",
    "no effect on content": "workers tail_bytes on_error strict trackers resume",
    "conditions of starting": "force uid allow_early_reset",
    "statistics during the run": "write_upon_reset episode_info",
    "manifest": "policy_file",
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The data folder of a packed run with unusual inputs."""
    data = tmp_path_factory.mktemp("inputs")
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=4, frame_skip=3)
    options = {"mode": "evaluation", "fps": 29.97, "workers": 0}
    with mjrec.Monitor(
        env, data / "recordings", lambda episode: episode == 1, **options
    ) as monitor:
        actions = [np.float32([0.1]), [0.25], np.zeros((2, 1)), np.ones(1)]
        monitor.reset(seed=3, options={"a": 1})
        for action in actions[:2]:
            monitor.step(action)
        with pytest.raises(ValueError, match="Action dimension"):
            monitor.step(actions[2])
        monitor.reset()
        for action in (actions[0], actions[0], actions[3], actions[3]):
            monitor.step(action)
    return data


def test_inputs_are_read_from_recordings_and_files(data, tmp_path):
    """A folder keeps them unchanged, without pickles."""
    inputs, arrays = read_inputs(data)
    [recording] = inputs.recordings
    assert recording.options == {"fps": "29.97"}
    first, second = recording.episodes
    assert (first.seed, first.options, first.cut) == (3, {"a": 1}, "exception")
    assert (second.seed, second.cut, second.is_chosen) == (None, None, True)
    assert [a.tolist() for a in arrays[second.arrays]][2:] == [[1.0], [1.0]]
    inputs.write(tmp_path, arrays)
    copy = Inputs.read(tmp_path)
    assert copy.unusual() == inputs.unusual()
    texts = [json.dumps(dataclasses.asdict(each)) for each in (copy, inputs)]
    assert texts[0] == texts[1]
    with np.load(tmp_path / ARRAYS_FILE, allow_pickle=False) as read:
        assert set(read) == set(arrays)


def test_actions_keep_their_type_and_shape(data):
    """Types may change within an episode, and an action may not fit the space."""
    inputs, arrays = read_inputs(data)
    first, second = inputs.recordings[0].episodes
    played = list(given_actions(second, arrays))
    assert [each.dtype.name for each in played] == ["float32"] * 2 + ["float64"] * 2
    assert played[0][0] == np.float32(0.1)
    irregular = {"step": 1, "value": [[1.0], [2.0]], "dtype": "float32"}
    changed = dataclasses.replace(first, irregular=(irregular,))
    action = list(given_actions(changed, arrays))[1]
    assert (action.dtype.name, action.shape) == ("float32", (2, 1))
    # Dictionaries are recorded as one vector.
    parts = {"arrays": "a", "action_parts": [("x", [2]), ("y", [])]}
    vector = {"a": np.array([[1.0, 2.0, 3.0]])}
    [action] = given_actions(EpisodeInputs(episode_id=0, steps=1, **parts), vector)
    assert (action["x"].tolist(), action["y"]) == ([1.0, 2.0], 3.0)


def test_inputs_other_than_defaults_are_listed(data):
    inputs, _ = read_inputs(data)
    packed = dataclasses.replace(inputs, packing={"anonymous": True, "name": "run"})
    unusual = packed.unusual()
    assert unusual.pop("pack") == {"anonymous": True}
    [recording] = unusual.values()
    assert recording["environment: frame_skip"] == 3
    assert recording["max_episode_steps"] == 4
    assert recording["fps"] == "29.97"
    assert "lambda" in recording["schedule"]
    assert recording["options of resets"] == [{"a": 1}]
    assert recording["environment"] == "InvertedPendulum-v5"


@pytest.mark.parametrize(
    ("schedule", "rule"),
    [("disable_videos", None), ("disable_videos", "best:1"), ("record_all", None)],
)
def test_view_options_are_listed_if_there_may_be_videos(schedule, rule):
    kwargs = {"render_mode": "rgb_array", "width": 32, "frame_skip": 3}
    environment = {"id": "A-v0", "framework": "gymnasium", "kwargs": kwargs}
    recording = RecordingInputs(
        infix="0.u",
        env_id="A-v0",
        environment=environment,
        options={"camera": "track", "observations": True},
        schedule=schedule,
        rule=rule,
    )
    [unusual] = Inputs(recordings=[recording]).unusual().values()
    assert {"environment: frame_skip", "observations"} <= unusual.keys()
    view = {"environment: render_mode", "environment: width", "camera"}
    is_listed = (schedule, rule) != ("disable_videos", None)
    assert view & unusual.keys() == (view if is_listed else set())


def test_wrappers_are_listed_with_their_arguments():
    environment = {
        "id": "A-v0",
        "framework": "mjcf",
        "wrappers": ["gymnasium.ClipReward", "mine.Wrapper"],
        "wrapper_arguments": [{"min_reward": 100.0}, None],
    }
    recording = RecordingInputs(infix="0.u", env_id="A-v0", environment=environment)
    [unusual] = Inputs(recordings=[recording]).unusual().values()
    assert unusual["environment"] == "A-v0, the author's own model (MJCF)"
    listed = ["gymnasium.ClipReward(min_reward=100.0)", "mine.Wrapper(...)"]
    assert unusual["wrappers"] == listed


@pytest.mark.parametrize(
    "change",
    [
        lambda run: run["options"].update(no_such=1),
        lambda run: run["options"].update(fps=30),
        lambda run: run.update(first_episode_id=-1),
        lambda run: run.update(first_episode_id="0"),
    ],
)
def test_unknown_options_and_wrong_types_are_refused(change, data, tmp_path):
    shutil.copytree(data / "recordings", tmp_path / "recordings")
    journal = the(tmp_path, "*.jsonl")
    first, *others = journal.read_text().splitlines()
    event = json.loads(first)
    change(event["run"])
    journal.write_text("\n".join([json.dumps(event), *others, ""]))
    with pytest.raises(Error, match="inputs cannot be read"):
        read_inputs(tmp_path)


def test_all_other_options_have_a_reason():
    """An option that changes files, and is not an input, would never verify."""
    fields = {field.name for field in dataclasses.fields(RecorderOptions)}
    others = {name for names in OTHERS.values() for name in names.split()}
    assert fields - OPTIONS.keys() == others
