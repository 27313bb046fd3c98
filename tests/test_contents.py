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
    return Path(shutil.copytree(recorded, tmp_path / "runs"))


@pytest.fixture
def place(tmp_path):
    """Return where an archive may be put; after the test, nothing is there."""
    folder = tmp_path / "place"
    folder.mkdir()
    yield folder / "run.zip"
    assert list(folder.iterdir()) == []


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


def test_pending_videos_are_to_be_rendered_first(tmp_path, place):
    """The message has the command."""
    runs = tmp_path / "runs"
    honest_runs.pendulum(runs, episodes=1, workers=0)
    message = refusal(mjrec.UnfinishedRecordings, runs, place)
    assert "video000000.mp4" in message
    assert f"mjrec render {runs}" in message


def test_a_killed_monitor_is_to_be_recovered_first(tmp_path, place):
    """The message has the command."""
    runs = tmp_path / "runs"
    runs.mkdir()
    write_log(runs, ended=False)
    message = refusal(mjrec.UnfinishedRecordings, runs, place)
    assert f"mjrec recover {runs}" in message


def test_files_without_a_manifest_are_refused(directory, place):
    """Nothing says what they are."""
    video = the(directory, "*000000.mp4")
    stray = video.with_name("openaigym.video.9.x.video000000.mp4")
    shutil.copy(video, stray)
    message = refusal(mjrec.UnfinishedRecordings, directory, place)
    assert stray.name in message
    assert "manifest" in message


def test_a_deferred_video_that_is_gone_can_be_rendered(directory, place):
    """It counts as pending."""
    the(directory, "*000000.mp4").unlink()
    message = refusal(mjrec.UnfinishedRecordings, directory, place)
    assert f"mjrec render {directory}" in message


def test_a_live_video_that_is_gone_is_missed(tmp_path, place, make_corridor, play):
    """The archive would not be verified."""
    with mjrec.Monitor(make_corridor(), tmp_path / "runs") as env:
        play(env, 1)
    gone = the(tmp_path / "runs", "*.mp4")
    gone.unlink()
    message = refusal(mjrec.PackError, tmp_path / "runs", place)
    assert f"names {gone.name}, which is missing" in message


def test_statistics_that_are_gone_are_to_be_recovered(directory, place):
    """They can be made again of the journal."""
    the(directory, "*.stats.json").unlink()
    message = refusal(mjrec.UnfinishedRecordings, directory, place)
    assert "results are missing" in message


def test_a_damaged_trajectory_is_named(directory, place):
    """The others are as good as before."""
    trajectory = the(directory, "*000001.h5")
    trajectory.write_bytes(trajectory.read_bytes()[:1000])
    message = refusal(mjrec.UnreadableFile, directory, place)
    assert trajectory.name in message


def test_links_that_lead_out_are_refused(directory, tmp_path, place):
    """What is packed never comes from elsewhere."""
    video = the(directory, "*000000.mp4")
    secret = tmp_path / "secret"
    video.rename(secret)
    video.symlink_to(secret)
    message = refusal(mjrec.UnreadableFile, directory, place)
    assert "leads out of its directory" in message


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
    message = refusal(mjrec.InvalidArgument, recorded, path)
    assert "already exists" in message
    assert [p.name for p in tmp_path.iterdir()] == ["run.zip"]


@pytest.mark.parametrize(
    "name", ["run.tar", "run", ".run.zip", "openaigym.zip", "\n.zip"]
)
def test_an_archive_has_a_name_of_its_own(name, recorded, place):
    """Which is not that of a monitor's file."""
    refusal(mjrec.InvalidArgument, recorded, place.with_name(name))


def test_there_must_be_recordings(tmp_path, place):
    """The message says how to make some."""
    message = refusal(mjrec.InvalidArgument, tmp_path / "nothing", place)
    assert "does not exist" in message
    message = refusal(mjrec.InvalidArgument, tmp_path, place)
    assert "mjrec record" in message


@pytest.mark.parametrize(
    ("stated", "part"),
    [
        ({"authors": ["Ada <0000-0002-1825-0098>"]}, "An author must be"),
        ({"authors": ["Ada <not an address>"]}, "An author must be"),
        ({"authors": "Ada"}, "a list of strings"),
        ({"authors": ["A\nB"]}, "one line"),
        ({"license": "my own"}, "SPDX"),
        ({"license": "MIT OR Apache-2.0"}, "SPDX"),
        ({"title": " "}, "title"),
        ({"max_size": "much"}, "max_size"),
        ({"max_size": 0}, "max_size"),
    ],
)
def test_what_is_stated_is_checked(stated, part, recorded, place):
    """Before any work."""
    assert part in refusal(mjrec.InvalidArgument, recorded, place, **stated)


def test_statements_are_understood():
    """Names in both orders; a licence by its URL."""
    authors = ["Plato", "Ludwig van Beethoven <L@b.de>", "van Beethoven, Ludwig"]
    known = state(title=None, authors=authors, license=None).authors
    assert [(a.given, a.family) for a in known] == [
        ("", "Plato"),
        ("Ludwig van", "Beethoven"),
        ("Ludwig", "van Beethoven"),
    ]
    assert [a.email for a in known] == [None, "L@b.de", None]
    stated = state(title="t", authors=[], license="https://x.y/l")
    assert stated.license is not None
    assert stated.license.url == "https://x.y/l"
    assert stated.license.spdx is None


def test_sizes_are_read_as_people_write_them():
    """A million each, as those count who limit uploads."""
    sizes = {
        "50M": 50_000_000,
        "50MB": 50_000_000,
        "1.5Gi": 3 << 29,
        "7": 7,
        "9k": 9000,
    }
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
    options = {"max_size": 1000, "on_progress": told.append}
    with pytest.raises(mjrec.ArchiveTooLarge) as caught:
        mjrec.pack(recorded, place, **options)
    error = caught.value
    assert error.limit == 1000 < error.size
    sizes = [size for _, size in error.largest]
    assert sizes == sorted(sizes, reverse=True)
    assert error.largest[0][0] in str(error)
    assert "--episodes" in str(error)
    assert told == []


def test_live_videos_are_never_encoded_again(tmp_path, place, make_corridor, play):
    """There is nothing to draw them from."""
    runs = tmp_path / "runs"
    with mjrec.Monitor(make_corridor(), runs) as env:
        play(env, 1)
    video = the(runs, "*.mp4").read_bytes()
    message = refusal(mjrec.ArchiveTooLarge, runs, place, max_size=1000)
    assert "never re-encoded" in message
    assert the(runs, "*.mp4").read_bytes() == video


@parametrize("case", ["0.7.4/plain", "0.21.0/two_monitors", "0.12.1/text"])
def test_what_gym_wrote_can_be_packed(case, tmp_path):
    """It has less to say, and nothing of it is wrong; episodes cannot be chosen."""
    directory = Path(__file__).parent / "data/gym" / case
    archive = mjrec.pack(directory, tmp_path / "run.zip")
    assert mjrec.verify(archive, level="files").failures == ()
    message = refusal(
        mjrec.InvalidArgument, directory, tmp_path / "b.zip", episodes=[0]
    )
    assert "gym's own" in message


def test_names_with_a_percent_sign_make_an_older_bag(tmp_path):
    """Which the `bagit` package, and sha512sum, read as they are."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/video.front%2Fleft.mp4").write_bytes(b"1")
    make_bag(tmp_path, date="2026-11-24", title="Recordings")
    assert (tmp_path / "bagit.txt").read_text().startswith("BagIt-Version: 0.97\n")
    assert "data/video.front%2Fleft.mp4\n" in (
        (tmp_path / "manifest-sha512.txt").read_text()
    )


def test_anonymous_names_no_author(recorded, tmp_path):
    """Also where one was given; and what cannot be taken out is an error."""
    options = {"anonymous": True, "authors": ["Zebulon Quackenbush"]}
    folder = unpacked(
        mjrec.pack(recorded, tmp_path / "a.zip", **options), tmp_path / "x"
    )
    held = b"".join(p.read_bytes() for p in folder.rglob("*") if p.is_file())
    assert b"uackenbush" not in held
    assert "withheld" in (folder / "data/README.md").read_text()
    crate = json.loads((folder / "data/ro-crate-metadata.json").read_text())
    assert not [e for e in crate["@graph"] if e["@type"] == "Person"]
    message = refusal(
        mjrec.IdentityLeft,
        recorded,
        tmp_path / "b.zip",
        title="By Zebulon Quackenbush",
        **options,
    )
    assert "README.md" in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "x"]
