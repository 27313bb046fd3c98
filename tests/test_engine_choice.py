# SPDX-License-Identifier: Apache-2.0
import pytest

from mjrec.engines.choice import ENGINES, engine_from
from mjrec.engines.local import LocalEngine
from mjrec.engines.ray import RayEngine
from mjrec.engines.slurm import SlurmEngine
from mjrec.errors import InvalidArgument, UnknownName


def test_engines_have_names():
    """Each name is that of one engine; Dask's holds the address of a scheduler."""
    kinds = {
        name: type(engine_from(name, workers=2, options=options))
        for name, options in [
            ("local", {}),
            ("ray", {}),
            ("slurm", {"cluster": "local"}),
        ]
    }
    assert kinds == {"local": LocalEngine, "ray": RayEngine, "slurm": SlurmEngine}
    assert {*kinds, "dask:ADDRESS"} == set(ENGINES)


def test_workers_and_gpus_are_passed_on():
    """An engine takes what it is told."""
    engine = engine_from("local", workers=3, gpus=0.25, require_gpu=True)
    assert isinstance(engine, LocalEngine)
    assert engine.workers == 3
    assert (engine.share.each, engine.share.required) == (0.25, True)


def test_an_unknown_name_is_told_with_those_there_are():
    """So that a slip can be seen."""
    with pytest.raises(UnknownName, match=r"(?s)slrum.*slurm"):
        engine_from("slrum")


@pytest.mark.parametrize("name", ["local", "slurm"])
def test_only_ray_has_an_address(name):
    """It would be ignored elsewhere."""
    with pytest.raises(InvalidArgument, match=f"the engine is {name}"):
        engine_from(name, address="auto")


@pytest.mark.parametrize("name", ["local", "ray"])
def test_only_slurm_has_options(name):
    """They would be ignored elsewhere."""
    with pytest.raises(InvalidArgument, match="partition"):
        engine_from(name, options={"partition": "gpu"})
