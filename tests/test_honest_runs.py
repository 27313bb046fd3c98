# SPDX-License-Identifier: Apache-2.0
"""Verify honest runs of each kind, with their verdicts and excuses."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from parts import parametrize

import honest_runs as honest
import mjrec
from mjrec.commands import main
from mjrec.evidence.findings import Verdict

PASS, PARTLY = Verdict.PASS, Verdict.PARTLY
STATS = {"level": "stats"}
NO_ACTIONS, BROKEN = {"actions not kept"}, {"broken video"}

# Each entry has a run, its verdict and excuses, and options of `pack` and `verify`.
QUICK = [
    (honest.pendulum, PASS, (), {}, {}),
    (honest.suite, PASS, (), {}, {}),
    (honest.kept, PASS, (), {}, {}),
    (honest.killed, PARTLY, {"kill"}, {}, {}),
    (honest.trajectory_lost, PARTLY, {"fault"}, {}, {}),
    (honest.tracker_away, PASS, (), {}, {}),
]
THOROUGH = [
    (honest.cheetah, PASS, (), {}, {}),
    (honest.vector, PASS, (), {}, {}),
    (honest.evaluated, PASS, (), {}, {}),
    (honest.evaluated_in_part, PARTLY, {"exception"}, {}, {}),
    (honest.evaluated_to_death, PARTLY, {"exception", "kill"}, {}, {}),
    (honest.evaluated_again, PARTLY, {"kill"}, {}, {}),
    (honest.extended, PARTLY, {"rule"}, {}, {}),
    (honest.clips, PARTLY, {"schedule"}, {}, {}),
    (honest.kept_in_training, PARTLY, NO_ACTIONS, {}, {}),
    (honest.kept_in_training, PARTLY, NO_ACTIONS, {}, STATS),
    (honest.live, PASS, (), {}, {}),
    (honest.text, PASS, (), {}, {"trust": ["Taxi-v4"]}),
    (honest.several, PARTLY, (), {}, {}),
    (honest.resumed, PARTLY, (), {}, {}),
    (honest.schedule_raises, PARTLY, {"schedule"}, {}, {}),
    (honest.trigger_raises, PARTLY, {"schedule"}, {}, {}),
    (honest.encoder_killed, PARTLY, BROKEN, {}, {}),
    (honest.encoder_killed, PARTLY, BROKEN, {}, STATS),
    (honest.frame_missing, PARTLY, BROKEN, {}, {}),
    (honest.end_lost, PARTLY, {"fault"}, {}, {}),
    (honest.end_written_late, PASS, (), {}, {}),
    (honest.unseeded, PARTLY, {"unseeded beginning"}, {}, {}),
    (honest.early, PARTLY, {"early reset"}, {}, {}),
    (honest.wrapped, PASS, (), {}, {}),
    (honest.wrapped_in_code, PARTLY, {"wrappers"}, {}, {}),
    (honest.mjcf, PASS, (), {}, {}),
    (honest.training, PARTLY, NO_ACTIONS, {}, {}),
    (honest.doubles, PASS, (), {}, {}),
    (honest.views, PARTLY, {"schedule"}, {}, {}),
    (honest.pendulum, PASS, (), {"anonymous": True}, {}),
    (honest.pendulum, PASS, (), {"episodes": [1]}, {}),
    # The whole archive has 121,000 bytes.
    (honest.large, PASS, (), {"max_size": 110_000}, {}),
    (honest.pendulum, PARTLY, (), {}, {"sample": 2}),
    (honest.pendulum, PARTLY, (), {}, STATS),
    (honest.pendulum, PARTLY, (), {}, {"level": "physics"}),
]


def name_of(record, verdict, believed, packing, verifying):
    return " ".join([record.__name__, *packing, *verifying])


# Some take more than five seconds: a run is recorded, packed, recreated and rendered.
@parametrize(
    ("record", "verdict", "believed", "packing", "verifying"),
    [pytest.param(*run, id=name_of(*run)) for run in QUICK + THOROUGH],
    default=len(QUICK),
)
def test_honest_run_comes_out_again(
    record, verdict, believed, packing, verifying, tmp_path
):
    """Nothing contradicts the run, and everything believed has an excuse."""
    record(tmp_path / "recorded")
    archive = mjrec.pack(tmp_path / "recorded", tmp_path / "run.zip", **packing)
    found = mjrec.verify(archive, **verifying)
    said = "\n".join(map(str, found.findings))
    assert found.verdict is verdict, said
    assert {each.name for each in found.excuses} == set(believed), said
    assert ("at a smaller size for packing" in said) == ("max_size" in packing), said


@pytest.mark.thorough
def test_excuse_that_the_reader_accepts_does_not_lower_the_verdict(tmp_path, capsys):
    """An excuse is accepted by value, so another wrapper name is not."""
    honest.wrapped_in_code(tmp_path / "run")
    archive = str(mjrec.pack(tmp_path / "run", tmp_path / "run.zip"))
    for value, status in (("TransformReward", 0), ("ClipReward", 3)):
        assert main(["verify", archive, "--allow", f"wrappers={value}"]) == status
        assert ("allowed" in capsys.readouterr().out) == (status == 0)


def packed_elsewhere(record, into, python=sys.executable, **environ):
    """Record and pack in another process with other environment variables."""
    program = (
        "import honest_runs, mjrec, pathlib, sys\n"
        "into = pathlib.Path(sys.argv[1])\n"
        f"honest_runs.{record.__name__}(into / 'recorded')\n"
        "mjrec.pack(into / 'recorded', into / 'run.zip')\n"
    )
    environ = {**os.environ, "PYTHONPATH": str(Path(__file__).parent), **environ}
    subprocess.run([python, "-c", program, str(into)], env=environ, check=True)
    return into / "run.zip"


NARROW = {"LP_NATIVE_VECTOR_WIDTH": "128", "GALLIUM_OVERRIDE_CPU_CAPS": "sse4.1"}


@pytest.mark.thorough
@pytest.mark.parametrize("environ", [{"MUJOCO_GL": "osmesa"}, NARROW])
def test_run_comes_out_again_with_another_rasterizer(environ, tmp_path):
    """Frames may differ slightly, which the archive claims."""
    found = mjrec.verify(packed_elsewhere(honest.large, tmp_path, **environ))
    said = "\n".join(map(str, [*found.findings, *found.excuses]))
    assert found.verdict in (PASS, PARTLY), said
    assert {each.name for each in found.excuses} <= {"gl"}, said


@pytest.mark.skipif(
    "MJREC_TEST_MUJOCO" not in os.environ, reason="needs a Python with another MuJoCo"
)
@pytest.mark.parametrize("record", [honest.pendulum, honest.cheetah, honest.mjcf])
def test_run_comes_out_again_with_another_mujoco(record, tmp_path):
    """Steps differ slightly, and the compiled model is believed."""
    archive = packed_elsewhere(record, tmp_path, os.environ["MJREC_TEST_MUJOCO"])
    found = mjrec.verify(archive)
    said = "\n".join(map(str, found.findings))
    assert found.verdict is PARTLY, said
    assert "mujoco" in {each.name for each in found.excuses}, said
