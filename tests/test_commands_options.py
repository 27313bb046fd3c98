# SPDX-License-Identifier: Apache-2.0
"""Test engines and cameras as command-line options."""

import pytest
from recordings import metadata_of

from mjrec import Error, InvalidArgument, LocalEngine, RayEngine, SlurmEngine
from mjrec.commands.evaluate import evaluate
from mjrec.commands.options import NO_ENGINE, EngineOptions, camera_of


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"gpus": 0.25}, (LocalEngine, 0.25, False)),
        ({"engine": "local", "gpus": 2.0, "require_gpu": True}, (LocalEngine, 2, True)),
        ({"engine": "ray"}, (RayEngine, 0, False)),
        ({"engine": "slurm", "engine_option": ("cluster=local",)}, (SlurmEngine, 0, 0)),
    ],
)
def test_engine_is_chosen_by_name_or_gpu_share(options, expected):
    engine = EngineOptions(**options).chosen(3)
    assert engine.workers == 3
    assert (type(engine), engine.share.each, engine.share.required) == expected
    assert NO_ENGINE.chosen(3) is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"address": "auto"}, "--engine ray"),
        ({"address": "auto", "engine": "slurm"}, "the engine is slurm"),
        ({"engine": "ray", "engine_option": ("partition=gpu",)}, "partition"),
        ({"engine_option": ("partition=gpu",)}, "--engine slurm"),
        ({"engine_option": ("partition",), "engine": "slurm"}, "KEY=VALUE"),
        ({"engine_option": ("a=1", "a=2"), "engine": "slurm"}, "given twice"),
        ({"gpus": -1.0}, "gpus"),
        ({"engine": "slrum"}, "(?s)slrum.*slurm.*dask:ADDRESS"),
        ({"engine": "dask:tcp://127.0.0.1:8786", "gpus": 1.0}, "belong to the Dask"),
    ],
)
def test_contradicting_engine_options_are_one_error(options, words):
    with pytest.raises(Error, match=words):
        EngineOptions(**options).chosen(None)


def test_camera_is_a_name_a_number_or_json(tmp_path, command):
    """`evaluate` accepts no JSON camera, but names the command that renders one."""
    assert [camera_of(text) for text in ("side", "-1", None)] == ["side", -1, None]
    for text, words in [
        ('{"distance": 3', "--camera must be a JSON object"),
        ('{"zoom": 3}', "zoom.*azimuth"),
        ('{"lookat": 3}', "lookat must be three numbers"),
    ]:
        with pytest.raises(Error, match=f"(?s){words}"):
            camera_of(text)
    pose = '{"distance": 3, "azimuth": 90}'
    small = ("InvertedPendulum-v5", "--size", "32x32", "--max-steps", "3")
    command("record", *small, "--camera", pose, "--workers", 1, "--out", tmp_path)
    assert metadata_of(tmp_path, 0)["camera"]["distance"] == 3
    with pytest.raises(InvalidArgument, match="mjrec render DIR"):
        evaluate((), policy="zero", camera=pose)
