# SPDX-License-Identifier: Apache-2.0
"""Commands that take recordings treat an evaluation's directory as one recording."""

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
    """Two tasks with two seeds each, and a video of the best episode."""
    directory = tmp_path_factory.mktemp("evaluations") / "e"
    few = {"policy": "random", "num_seeds": 2, "episodes": 1, "keep": "best"}
    small = {"max_steps": 3, "height": 32, "width": 32, "workers": 1}
    mjrec.evaluate(TASKS, directory=directory, **few, **small)
    return directory


# Takes more than five seconds: five processes, which load simulators.
def test_evaluation_is_packed_and_verified_as_one(evaluation, tmp_path):
    """The archive has a file for each trajectory and one verdict."""
    archive = mjrec.pack(evaluation, tmp_path / "e.zip")
    names = [Path(name).name for name in zipfile.ZipFile(archive).namelist()]
    assert sum(name.startswith("openaigym.trajectory.") for name in names) == 4
    assert not any(name.startswith("openaigym.trajectories.") for name in names)
    assert sum(name.startswith("openaigym.model.") for name in names) == 4
    assert mjrec.verify(archive).verdict is Verdict.PASS
    for path in (archive, evaluation):
        verification = mjrec.verify(path, level="physics")
        assert verification.verdict is Verdict.PARTLY
        assert not verification.excuses
        counts = {str(each.topic): each.count for each in verification.findings}
        assert counts["physics"] == 12


def test_missing_episodes_are_counted(evaluation, tmp_path, caplog):
    """A warning, the README and the first line of a verification name them."""
    directory = shutil.copytree(evaluation, tmp_path / "begun")
    plan = json.loads((directory / "evaluation.json").read_text())
    plan["plan"]["seeds"].append(2)
    (directory / "evaluation.json").write_text(json.dumps(plan))
    (directory / "results.json").unlink()
    archive = mjrec.pack(directory, tmp_path / "e.zip")
    assert "has 4 of 6 episodes" in caplog.text
    with zipfile.ZipFile(archive) as packed:
        assert "**4 of 6 planned episodes" in packed.read("e/data/README.md").decode()
    for path in (archive, directory):
        first, *_ = remarks(mjrec.verify(path, level="stats"))
        assert first.startswith("4 of 6 episodes")


def test_several_directories_need_all_episodes_and_unique_names(evaluation, tmp_path):
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


def test_evaluation_is_listed_and_rendered_as_one(evaluation, capsys):
    """A number selects an episode of each task and seed, a file name one."""
    assert commands.main(["list", str(evaluation), "--json"]) == 0
    listed = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(each["task"], each["seed"]) for each in listed] == [
        (task, seed) for task in TASKS for seed in range(2)
    ]
    assert sum(each["video"] is not None for each in listed) == 2
    options = ["--size", "16x16", "--workers", "1", "--json"]
    render = ["render", str(evaluation), "--episode", "0", *options]
    assert commands.main(render) == 0
    rendered = json.loads(capsys.readouterr().out)
    paths = {Path(rendered["directory"], each["name"]) for each in rendered["videos"]}
    assert len(paths) == 4
    assert all(path.is_file() for path in paths)
    [bundle] = evaluation.glob(f"{TASKS[0]}/seed-001/openaigym.trajectories.*.h5")
    name = bundle.name.replace("trajectories", "trajectory")
    one = bundle.with_name(name.replace(".h5", ".episode000000.h5"))
    for target in (one, bundle):
        command = ["render", str(target), "--size", "8x8", "--out", f"{target}.mp4"]
        assert commands.main([*command, "--workers", "1"]) == 0
        assert Path(f"{target}.mp4").is_file()
