# SPDX-License-Identifier: Apache-2.0
"""What cannot be packed is refused before anything is made, and nothing stays."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from full_disk import file_size_limit
from packed_runs import the, unpacked
from parts import parametrize
from trajectories_by_hand import write_log

import honest_runs
import mjrec
from mjrec.evidence.bag import make_bag
from mjrec.evidence.size_limit import byte_count
from mjrec.evidence.statements import state


@pytest.fixture(scope="module")
def recorded(pendulums):
    """Return a directory with two episodes, each with a video."""
    return pendulums(2, longest=3)


@pytest.fixture
def directory(recorded, tmp_path):
    """Return a copy of it, to be spoilt."""
    return shutil.copytree(recorded, tmp_path / "runs")


@pytest.fixture
def place(tmp_path):
    """Return where an archive may be put; after the test, nothing is there."""
    folder = tmp_path / "place"
    folder.mkdir()
    yield folder / "run.zip"
    assert list(folder.iterdir()) == []


@pytest.fixture
def live(tmp_path, make_corridor, play):
    """Return a directory with one episode, whose video is live."""
    with mjrec.Monitor(make_corridor(), tmp_path / "runs") as env:
        play(env, 1)
    return tmp_path / "runs"


def refusal(kind, directory, path, **options):
    """Return the message with which packing is refused."""
    with pytest.raises(kind) as caught:
        mjrec.pack(directory, path, **options)
    assert type(caught.value) is kind
    return str(caught.value)


def test_an_open_monitor_is_named(tmp_path, place, make_corridor):
    """Its files are still being written."""
    with mjrec.Monitor(make_corridor(), tmp_path / "runs") as env:
        env.reset()
        message = refusal(mjrec.DirectoryInUse, tmp_path / "runs", place)
        assert the(tmp_path / "runs", ".*.lock").name in message
        assert "Close the monitor" in message


def pending(runs):
    honest_runs.pendulum(runs, episodes=1, workers=0)


def killed(runs):
    runs.mkdir()
    write_log(runs, ended=False)


@pytest.mark.parametrize(
    ("record", "command"), [(pending, "render"), (killed, "recover")]
)
def test_recordings_are_to_be_finished_first(record, command, tmp_path, place):
    """The message has the command."""
    record(tmp_path / "runs")
    message = refusal(mjrec.UnfinishedRecordings, tmp_path / "runs", place)
    assert f"mjrec {command} {tmp_path}/runs" in message


def remove(pattern):
    return lambda directory: the(directory, pattern).unlink()


def add_a_stray_video(directory):
    video = the(directory, "*000000.mp4")
    shutil.copy(video, video.with_name("openaigym.video.9.x.video000000.mp4"))


def damage_a_trajectory(directory):
    path = the(directory, "*000001.h5")
    path.write_bytes(path.read_bytes()[:1000])


def lead_out(directory):
    video = the(directory, "*000000.mp4")
    video.rename(directory.with_name("secret"))
    video.symlink_to(directory.with_name("secret"))


@pytest.mark.parametrize(
    ("spoil", "kind", "part"),
    [
        (add_a_stray_video, mjrec.UnfinishedRecordings, "openaigym.video.9.x.*manifes"),
        # It counts as pending.
        (remove("*000000.mp4"), mjrec.UnfinishedRecordings, "mjrec render .*runs"),
        (remove("*.stats.json"), mjrec.UnfinishedRecordings, "results are missing"),
        (damage_a_trajectory, mjrec.UnreadableFile, "000001.h5"),
        (lead_out, mjrec.UnreadableFile, "leads out of its directory"),
    ],
)
def test_what_is_not_whole_is_refused(directory, place, spoil, kind, part):
    """With the file, and with what makes it whole where something can."""
    spoil(directory)
    with pytest.raises(kind, match=f"(?s){part}"):
        mjrec.pack(directory, place)


def test_a_live_video_that_is_gone_is_missed(live, place):
    """The archive would not be verified."""
    gone = the(live, "*.mp4")
    gone.unlink()
    assert f"names {gone.name}, which is missing" in refusal(
        mjrec.PackError, live, place
    )


def test_links_inside_are_packed_as_files(directory, tmp_path):
    """No archive holds a link."""
    video = the(directory, "*000000.mp4")
    video.rename(directory / "elsewhere")
    video.symlink_to("elsewhere")
    folder = unpacked(mjrec.pack(directory, tmp_path / "a.zip"), tmp_path / "x")
    packed = the(folder, video.name)
    assert packed.is_file()
    assert not packed.is_symlink()


def test_unknown_episodes_are_named(recorded, place):
    """With those that there are."""
    message = refusal(mjrec.UnknownName, recorded, place, episodes=[0, 9])
    assert message.endswith("with the number 9. Available: 0, 1.")
    for wrong in ([], [True], ["0"], [0.0]):
        refusal(mjrec.InvalidArgument, recorded, place, episodes=wrong)


def test_an_existing_archive_is_never_replaced(recorded, tmp_path):
    """Also a link that leads nowhere."""
    path = tmp_path / "run.zip"
    path.symlink_to("nowhere")
    assert "already exists" in refusal(mjrec.InvalidArgument, recorded, path)
    assert [p.name for p in tmp_path.iterdir()] == ["run.zip"]


@pytest.mark.parametrize("name", ["run.tar", ".run.zip", "openaigym.zip", "\n.zip"])
def test_an_archive_has_a_name_of_its_own(name, recorded, place):
    """Which is not that of a monitor's file."""
    refusal(mjrec.InvalidArgument, recorded, place.with_name(name))


def test_there_must_be_recordings(tmp_path, place):
    """The message says how to make some."""
    message = refusal(mjrec.InvalidArgument, tmp_path / "nothing", place)
    assert "does not exist" in message
    assert "mjrec record" in refusal(mjrec.InvalidArgument, tmp_path, place)


@pytest.mark.parametrize(
    ("stated", "part"),
    [
        ({"authors": ["Ada <0000-0002-1825-0098>"]}, "An author must be"),
        ({"authors": ["Ada <not an address>"]}, "An author must be"),
        ({"authors": "Ada"}, "a list of strings"),
        ({"authors": ["A\nB"]}, "one line"),
        ({"license": "my own"}, "SPDX"),
        ({"title": " "}, "title"),
        ({"max_size": "much"}, "max_size"),
        ({"max_size": 0}, "max_size"),
    ],
)
def test_what_is_stated_is_checked(stated, part, recorded, place):
    """Before any work."""
    assert part in refusal(mjrec.InvalidArgument, recorded, place, **stated)


def test_statements_are_understood():
    """Names in both orders; a licence by its URL; a million for each M."""
    authors = ["Plato", "Ludwig van Beethoven <L@b.de>", "van Beethoven, Ludwig"]
    stated = state(title="t", authors=authors, license="https://x.y/l")
    assert [(a.given, a.family, a.email) for a in stated.authors] == [
        ("", "Plato", None),
        ("Ludwig van", "Beethoven", "L@b.de"),
        ("Ludwig", "van Beethoven", None),
    ]
    assert (stated.license.url, stated.license.spdx) == ("https://x.y/l", None)
    sizes = {"50M": 50_000_000, "5MB": 5_000_000, "1.5Gi": 3 << 29, "7": 7, "9k": 9000}
    assert {text: byte_count(text) for text in sizes} == sizes


def test_without_jinja_it_says_what_to_install(recorded, place, monkeypatch):
    """And does nothing."""
    monkeypatch.setitem(sys.modules, "jinja2", None)
    message = refusal(mjrec.MissingDependency, recorded, place)
    assert 'pip install "mjrec[evidence]"' in message


def test_a_full_disk_leaves_nothing(recorded, place):
    """One error that names the archive's file."""
    with file_size_limit(2000):
        message = refusal(mjrec.FileNotWritten, recorded, place)
    assert "pack again" in message


@pytest.mark.usefixtures("no_process_is_left")
def test_ctrl_c_leaves_nothing(recorded, tmp_path, place):
    """Here while videos are drawn smaller; no process goes on either."""
    size = mjrec.pack(recorded, tmp_path / "run.zip").stat().st_size

    def interrupt(progress):
        if progress.frames_done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mjrec.pack(recorded, place, max_size=size - 500, on_progress=interrupt)


def test_too_large_is_refused_with_what_is_large(recorded, place):
    """Nothing is drawn where even no videos at all would not help."""
    told = []
    with pytest.raises(mjrec.ArchiveTooLarge) as caught:
        mjrec.pack(recorded, place, max_size=1000, on_progress=told.append)
    error = caught.value
    assert error.limit == 1000 < error.size
    sizes = [size for _, size in error.largest]
    assert sizes == sorted(sizes, reverse=True)
    assert error.largest[0][0] in str(error)
    assert "--episodes" in str(error)
    assert told == []


def test_live_videos_are_never_encoded_again(live, place):
    """There is nothing to draw them from."""
    video = the(live, "*.mp4").read_bytes()
    message = refusal(mjrec.ArchiveTooLarge, live, place, max_size=1000)
    assert "never re-encoded" in message
    assert the(live, "*.mp4").read_bytes() == video


@parametrize("case", ["0.7.4/plain", "0.21.0/two_monitors", "0.12.1/text"])
def test_what_gym_wrote_can_be_packed(case, tmp_path):
    """It has less to say, and nothing of it is wrong; episodes cannot be chosen."""
    directory = Path(__file__).parent / "data/gym" / case
    archive = mjrec.pack(directory, tmp_path / "run.zip")
    assert mjrec.verify(archive, level="files").failures == ()
    other = tmp_path / "b.zip"
    assert "gym's own" in refusal(mjrec.InvalidArgument, directory, other, episodes=[0])


def test_names_with_a_percent_sign_make_an_older_bag(tmp_path):
    """Which the `bagit` package, and sha512sum, read as they are."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/video.front%2Fleft.mp4").write_bytes(b"1")
    make_bag(tmp_path, date="2026-11-24", title="Recordings")
    assert (tmp_path / "bagit.txt").read_text().startswith("BagIt-Version: 0.97\n")
    listed = (tmp_path / "manifest-sha512.txt").read_text()
    assert "data/video.front%2Fleft.mp4\n" in listed


def test_anonymous_names_no_author(recorded, tmp_path):
    """Also where one was given; and what cannot be taken out is an error."""
    options = {"anonymous": True, "authors": ["Zebulon Quackenbush"]}
    archive = mjrec.pack(recorded, tmp_path / "a.zip", **options)
    folder = unpacked(archive, tmp_path / "x")
    held = b"".join(p.read_bytes() for p in folder.rglob("*") if p.is_file())
    assert b"uackenbush" not in held
    assert "withheld" in (folder / "data/README.md").read_text()
    crate = json.loads((folder / "data/ro-crate-metadata.json").read_text())
    assert not [e for e in crate["@graph"] if e["@type"] == "Person"]
    options["title"] = "By Zebulon Quackenbush"
    message = refusal(mjrec.IdentityLeft, recorded, tmp_path / "b.zip", **options)
    assert "README.md" in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "x"]
