# SPDX-License-Identifier: Apache-2.0
"""What the command line says of an engine."""

import pytest

from mjrec import Error, LocalEngine, RayEngine, SlurmEngine
from mjrec.commands.options import NO_ENGINE, EngineOptions

SLURM = (SlurmEngine, 0.0, False)


def test_without_an_option_there_is_no_engine():
    """All is as it was before there were any."""
    assert NO_ENGINE.chosen(None) is None
    assert NO_ENGINE.chosen(3) is None


@pytest.mark.parametrize(
    ("options", "kind", "gpus", "required"),
    [
        ({"engine": "local"}, LocalEngine, 0.0, False),
        ({"gpus": 0.25}, LocalEngine, 0.25, False),
        ({"engine": "local", "gpus": 2.0, "require_gpu": True}, LocalEngine, 2.0, True),
        ({"engine": "ray"}, RayEngine, 0.0, False),
        ({"engine": "slurm", "engine_option": ("cluster=local",)}, *SLURM),
    ],
)
def test_an_engine_is_meant_by_its_name(options, kind, gpus, required):
    """Or by what each worker is to have of a GPU."""
    engine = EngineOptions(**options).chosen(3)
    assert isinstance(engine, kind)
    assert engine.workers == 3
    assert (engine.share.each, engine.share.required) == (gpus, required)


WRONG = [
    ({"address": "auto"}, "--engine ray"),
    ({"address": "auto", "engine": "local"}, "the engine is local"),
    ({"address": "auto", "engine": "slurm"}, "the engine is slurm"),
    ({"engine": "ray", "engine_option": ("partition=gpu",)}, "partition"),
    ({"address": "auto", "gpus": 0.5}, "--engine ray"),
    ({"engine_option": ("partition=gpu",)}, "--engine slurm"),
    ({"engine_option": ("partition=gpu",), "engine": "local"}, "partition"),
    ({"engine_option": ("partition",), "engine": "slurm"}, "KEY=VALUE"),
    ({"engine_option": ("=gpu",), "engine": "slurm"}, "KEY=VALUE"),
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
