# SPDX-License-Identifier: Apache-2.0
"""Read files of real gym versions, and let real gym 0.21 read ours.

`legacy/record_gym.py` recorded `data/gym/<version>/<case>/` with that version.
`data/gym/answers.json` has the results of gym's own `load_results` for them and for
`write_ours`, made by `legacy/gym_load_results.py`. `scripts/test --all` asks gym again.
"""

import json
import math
import os
import subprocess
from pathlib import Path

import pytest
from result_files import write_saved

import mjrec
from mjrec.formats.manifest import StatsFile

TESTS = Path(__file__).parent
DATA = TESTS / "data" / "gym"
VERSIONS = ["0.7.4", "0.9.6", "0.12.1", "0.17.3", "0.19.0", "0.21.0", "0.22.0"]
NAN, INF = math.nan, math.inf

# Each case has its lengths, rewards and types.
PLAYED = {
    "plain": ([3, 1, 2], [4.5, -2.0, 0.5], "ttt"),
    "text": ([3, 1, 2], [4.5, -2.0, 0.5], "ttt"),
    "not_finite": ([3, 1, 2], [NAN, INF, -INF], "ttt"),
    "no_spec": ([3], [4.5], "t"),
    "unfinished": ([3, 1], [4.5, -2.0], "ee"),
    "empty": ([], [], None),
    "two_monitors": ([3, 3, 1, 1], [4.5, 4.5, -2.0, -2.0], "tete"),
    # This case was played as "tee", but gym wrote one type for each reset.
    "resets_in_a_row": ([3, 1, 2], [4.5, -2.0, 0.5], "tte"),
}
RECORDED = [f"{version}/{case}" for version in sorted(VERSIONS) for case in PLAYED]
ENV_INFO = {"gym_version": "mjrec-1", "env_id": "Hopper-v5"}


def write_ours(directory):
    """Write two monitors with videos, a key of our own, and infinity."""
    directory.mkdir()
    for monitor, (name, shift) in enumerate([("0.7", 0.0), ("1.7", 0.5)]):
        video = f"openaigym.video.{name}.video000000"
        videos = (f"{video}.mp4", f"{video}.meta.json")
        for each in videos:
            (directory / each).touch()
        start = 1790000000.0 + shift
        rewards = (math.inf, 0.1 + monitor)
        stats = StatsFile(start, (start + 1, start + 2), (10, 20), rewards, ("t", "e"))
        details = {"format": 1, "keys": ["cubic", [True, True]]}
        options = {"env_info": ENV_INFO, "details": details}
        write_saved(directory, name, stats=stats, videos=[videos], **options)


def recorded_answer(name):
    return as_ours(json.loads((DATA / "answers.json").read_text())[name])


def as_ours(answer):
    # JSON has no tuples.
    if answer and answer.get("videos"):
        answer["videos"] = [tuple(pair) for pair in answer["videos"]]
    return answer


def assert_same(ours, gyms, *, but=()):
    """Compare all keys except those in `but`."""
    assert list(ours) == list(gyms)
    for key in [key for key in ours if key not in but]:
        # NaN does not equal itself, but its text does.
        assert repr(ours[key]) == repr(gyms[key]), key


@pytest.mark.parametrize("name", RECORDED)
def test_directories_of_gym_are_read(name, monkeypatch):
    """Results equal gym's except for known errors in gym."""
    monkeypatch.chdir(DATA)
    version, _, case = name.partition("/")
    ours, gyms = mjrec.load_results(Path(name)), recorded_answer(name)
    lengths, rewards, types = PLAYED[case]
    assert ours["episode_lengths"] == lengths
    assert ours["episode_rewards"] == pytest.approx(rewards, nan_ok=True)
    assert ours["episode_types"] == (None if types is None else list(types))
    assert ours["env_info"]["gym_version"] == version
    listed = [episode.length for episode in mjrec.iter_episodes(name)]
    assert sorted(listed) == sorted(lengths)
    match case:
        case "no_spec":
            assert "missing expected key env_id" in gyms["error"]
            assert ours["env_info"] == {"gym_version": version}
        case "two_monitors":
            # Gym lists no start for the idle monitor and shifts the types.
            but = ("initial_reset_timestamps", "episode_types")
            assert_same(ours, gyms, but=but)
            starts = ours["initial_reset_timestamps"]
            assert gyms["initial_reset_timestamps"] == [starts[0], starts[2]]
            assert gyms["episode_types"] == ["t", "t", "t", "e"]
        case "empty":
            assert_same(ours, gyms, but=("initial_reset_timestamps",))
            assert gyms["initial_reset_timestamps"] == []
        case _:
            assert_same(ours, gyms)
    if case == "text":
        first, second, third = mjrec.iter_episodes(name)
        assert second.video is None
        videos = [(str(each.video), str(each.metadata)) for each in (first, third)]
        assert videos == ours["videos"]


def test_recorded_gym_reads_our_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_ours(Path("ours"))
    gyms = recorded_answer("ours")
    assert gyms["episode_types"] == ["t", "t", "e", "e"]
    assert_same(mjrec.load_results(Path("ours")), gyms)


def test_monitor_writes_the_keys_of_gym(tmp_path, corridor, play):
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 1)
    for kind, added in (("manifest", {"mjrec"}), ("stats", set())):
        gyms, ours = (
            json.loads(next(directory.glob(f"*.{kind}.json")).read_text()).keys()
            for directory in (DATA / "0.21.0" / "plain", tmp_path)
        )
        assert ours == gyms | added


@pytest.fixture
def ask_gym():
    """Return a function that calls `load_results` of gym 0.21.0."""
    if "MJREC_TEST_GYM" not in os.environ:
        pytest.skip("no environment with gym 0.21.0: scripts/test --all makes one")
    # Gym must be free to warn.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"}

    def ask(*directories):
        script = TESTS / "legacy" / "gym_load_results.py"
        command = [os.environ["MJREC_TEST_GYM"], script, *directories]
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=240
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return {k: as_ours(v) for k, v in json.loads(done.stdout).items()}

    return ask


@pytest.mark.old_gym
def test_gym_answers_as_recorded(ask_gym, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for version in VERSIONS:
        Path(version).symlink_to(DATA / version)
    write_ours(Path("ours"))
    for name, answer in ask_gym(*RECORDED, "ours").items():
        assert repr(answer) == repr(recorded_answer(name)), name


@pytest.mark.old_gym
def test_gym_reads_files_of_monitors(ask_gym, tmp_path, corridor, make_corridor, play):
    stats = StatsFile(1.0, (2.0, 3.0), (1, 1), (math.nan, 2.5), ("t", "t"))
    write_saved(tmp_path, "0.7", stats=stats, env_info=ENV_INFO)
    [gyms] = ask_gym(tmp_path).values()
    assert gyms["episode_rewards"] == [None, 2.5]
    assert_same(mjrec.load_results(tmp_path), gyms, but=("episode_rewards",))
    mjrec.clear_monitor_files(tmp_path)
    with mjrec.Monitor(corridor, tmp_path) as env:
        play(env, 2)
        env.reset()
        env.step(0)
    again = {"resume": True, "mode": "evaluation"}
    with mjrec.Monitor(make_corridor(length=2), tmp_path, **again) as env:
        play(env, 2)
    [gyms] = ask_gym(tmp_path).values()
    assert gyms["episode_lengths"] == [3, 3, 2, 2]
    assert gyms["episode_types"] == ["t", "t", "e", "e"]
    assert_same(mjrec.load_results(tmp_path), gyms)
