# SPDX-License-Identifier: Apache-2.0
"""What the command line says of an engine and of a camera."""

import pytest
from recordings import metadata_of

from mjrec import Error, InvalidArgument, LocalEngine, RayEngine, SlurmEngine
from mjrec.commands import main
from mjrec.commands.evaluate import evaluate
from mjrec.commands.options import NO_ENGINE, EngineOptions, camera_of

SLURM = (SlurmEngine, 0.0, False)


@pytest.mark.parametrize(
    ("options", "kind", "gpus", "required"),
    [
        ({"gpus": 0.25}, LocalEngine, 0.25, False),
        ({"engine": "local", "gpus": 2.0, "require_gpu": True}, LocalEngine, 2.0, True),
        ({"engine": "ray"}, RayEngine, 0.0, False),
        ({"engine": "slurm", "engine_option": ("cluster=local",)}, *SLURM),
    ],
)
def test_an_engine_is_meant_by_its_name(options, kind, gpus, required):
    """Or by what each worker is to have of a GPU; else there is none."""
    engine = EngineOptions(**options).chosen(3)
    assert isinstance(engine, kind)
    assert engine.workers == 3
    assert (engine.share.each, engine.share.required) == (gpus, required)
    assert NO_ENGINE.chosen(3) is None


WRONG = [
    ({"address": "auto"}, "--engine ray"),
    ({"address": "auto", "engine": "slurm"}, "the engine is slurm"),
    ({"engine": "ray", "engine_option": ("partition=gpu",)}, "partition"),
    ({"engine_option": ("partition=gpu",)}, "--engine slurm"),
    ({"engine_option": ("partition",), "engine": "slurm"}, "KEY=VALUE"),
    ({"engine_option": ("a=1", "a=2"), "engine": "slurm"}, "given twice"),
    ({"gpus": -1.0}, "gpus"),
    ({"engine": "slrum"}, "(?s)slrum.*slurm.*dask:ADDRESS"),
    ({"engine": "dask:tcp://127.0.0.1:8786", "gpus": 1.0}, "belong to the Dask"),
]


@pytest.mark.parametrize(("options", "words"), WRONG)
def test_what_contradicts_itself_is_one_clear_error(options, words):
    """It says what there is, or how it is meant."""
    with pytest.raises(Error, match=words):
        EngineOptions(**options).chosen(None)


PLACE = '{"distance": 3, "azimuth": 90}'


def test_a_camera_is_a_name_a_number_or_json(tmp_path):
    """JSON places one for `record`; `evaluate` says how to get the same."""
    assert [camera_of(text) for text in ("side", "-1", None)] == ["side", -1, None]
    for text, words in [
        ('{"distance": 3', "--camera must be a JSON object"),
        ('{"zoom": 3}', "zoom.*azimuth"),
        ('{"lookat": 3}', "lookat must be three numbers"),
    ]:
        with pytest.raises(Error, match=f"(?s){words}"):
            camera_of(text)
    small = ["InvertedPendulum-v5", "--size", "32x32", "--max-steps", "3"]
    near = ["--camera", PLACE, "--workers", "1", "--out", str(tmp_path)]
    assert main(["record", *small, *near]) == 0
    assert metadata_of(tmp_path, 0)["camera"]["distance"] == 3
    with pytest.raises(InvalidArgument, match="mjrec render DIR"):
        evaluate((), policy="zero", camera=PLACE)
