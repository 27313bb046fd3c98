# SPDX-License-Identifier: Apache-2.0
"""An evaluation's directory is one thing for the commands that take recordings."""

import json
import shutil
import zipfile
from pathlib import Path

import pytest

import mjrec
from mjrec import commands
from mjrec.errors import InvalidArgument, PackError, UnfinishedRecordings
from mjrec.evidence.findings import Verdict
from mjrec.evidence.summary import remarks

TASKS = ("InvertedPendulum-v5", "InvertedDoublePendulum-v5")


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """Two tasks with two seeds each, one of which is drawn."""
    directory = tmp_path_factory.mktemp("evaluations") / "e"
    few = {"policy": "random", "num_seeds": 2, "episodes": 1, "keep": "best"}
    small = {"max_steps": 3, "height": 32, "width": 32, "workers": 1}
    mjrec.evaluate(TASKS, directory=directory, **few, **small)
    return directory


# Takes more than five seconds: five processes, which load simulators.
def test_it_is_packed_and_verified_as_one(evaluation, tmp_path):
    """One archive with a file for each trajectory, each model once, one verdict."""
    archive = mjrec.pack(evaluation, tmp_path / "e.zip")
    names = [Path(name).name for name in zipfile.ZipFile(archive).namelist()]
    assert sum(name.startswith("openaigym.trajectory.") for name in names) == 4
    assert not any(name.startswith("openaigym.trajectories.") for name in names)
    assert sum(name.startswith("openaigym.model.") for name in names) == 4
    assert mjrec.verify(archive).verdict is Verdict.PASS
    for given in (archive, evaluation):
        verification = mjrec.verify(given, level="physics")
        assert verification.verdict is Verdict.PARTLY
        assert not verification.excuses
        counts = {str(each.topic): each.count for each in verification.findings}
        assert counts["physics"] == 12


def test_an_unfinished_evaluation_says_so(evaluation, tmp_path, caplog):
    """When it is packed, in the README, and in the first line of a verification."""
    directory = shutil.copytree(evaluation, tmp_path / "begun")
    plan = json.loads((directory / "evaluation.json").read_text())
    plan["plan"]["seeds"].append(2)
    (directory / "evaluation.json").write_text(json.dumps(plan))
    (directory / "results.json").unlink()
    archive = mjrec.pack(directory, tmp_path / "e.zip")
    assert "has 4 of 6 episodes" in caplog.text
    with zipfile.ZipFile(archive) as packed:
        assert "**4 of 6 planned episodes" in packed.read("e/data/README.md").decode()
    for given in (archive, directory):
        first, *_ = remarks(mjrec.verify(given, level="stats"))
        assert first.startswith("4 of 6 episodes")


def test_episodes_of_several_directories_are_not_chosen_from(evaluation, tmp_path):
    """Each directory counts its own; and each has names of its own."""
    with pytest.raises(InvalidArgument, match="contains 4 monitor directories"):
        mjrec.pack(evaluation, tmp_path / "e.zip", episodes=[0])
    folders = sorted(evaluation.glob("*/seed-000"))
    for number in range(2):
        shutil.copytree(folders[0], tmp_path / "both" / str(number))
    with pytest.raises(PackError, match="contain files with the same names"):
        mjrec.pack(tmp_path / "both", tmp_path / "e.zip")
    manifest = next((tmp_path / "both" / "0").glob("*.manifest.json"))
    manifest.unlink()
    with pytest.raises(UnfinishedRecordings, match="mjrec recover"):
        mjrec.pack(tmp_path / "both", tmp_path / "e.zip")


def test_it_is_listed_and_drawn_as_one(evaluation, capsys):
    """Also one episode of each task and seed, another way, and a single one by name."""
    assert commands.main(["list", str(evaluation), "--json"]) == 0
    listed = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(each["task"], each["seed"]) for each in listed] == [
        (task, seed) for task in TASKS for seed in range(2)
    ]
    assert sum(each["video"] is not None for each in listed) == 2
    another = ["--size", "16x16", "--workers", "1", "--json"]
    render = ["render", str(evaluation), "--episode", "0", *another]
    assert commands.main(render) == 0
    drawn = json.loads(capsys.readouterr().out)
    paths = {Path(drawn["directory"], each["name"]) for each in drawn["videos"]}
    assert len(paths) == 4
    assert all(path.is_file() for path in paths)
    [bundle] = evaluation.glob(f"{TASKS[0]}/seed-001/openaigym.trajectories.*.h5")
    name = bundle.name.replace("trajectories", "trajectory")
    one = bundle.with_name(name.replace(".h5", ".episode000000.h5"))
    for target in (one, bundle):
        command = ["render", str(target), "--size", "8x8", "--out", f"{target}.mp4"]
        assert commands.main([*command, "--workers", "1"]) == 0
        assert Path(f"{target}.mp4").is_file()
