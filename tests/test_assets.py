# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.util
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjrec.simulation.cameras import camera_names, tracking_camera

ASSETS = Path(__file__).parents[1] / "assets"
MODELS = ["showcase", "walker_on_plane", "pendulum"]


def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))


def values(array: np.ndarray) -> set[int]:
    return set(np.ravel(array).tolist())


@pytest.fixture(scope="module")
def showcase() -> mujoco.MjModel:
    return load("showcase")


@pytest.mark.parametrize("name", MODELS)
def test_each_model_steps_without_a_warning(name: str) -> None:
    """Two hundred steps leave finite numbers and no warning of MuJoCo's."""
    model = load(name)
    data = mujoco.MjData(model)
    started = data.qpos.copy()

    mujoco.mj_step(model, data, 100)
    moved = np.abs(data.qpos - started).max()
    mujoco.mj_step(model, data, 100)

    assert [warning.number for warning in data.warning] == [0] * len(data.warning)
    assert np.isfinite(data.qpos).all()
    assert np.isfinite(data.qvel).all()
    assert moved > 0.1


def test_each_model_is_read_here() -> None:
    """A model that is added gets these tests too."""
    models = {path.stem for path in ASSETS.glob("*.xml")} - {"finger_skin"}

    assert models == set(MODELS)


def test_parts_are_what_the_script_writes() -> None:
    """Pictures, mesh and skin can be made again from the committed script."""
    spec = importlib.util.spec_from_file_location(
        "make_parts", ASSETS / "make_parts.py"
    )
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    for name, content in script.parts().items():
        assert (ASSETS / name).read_bytes() == content, name


def test_showcase_has_every_kind_of_asset(showcase: mujoco.MjModel) -> None:
    """Mesh, height field, skin, flex, and textures of each type."""
    texture = mujoco.mjtTexture

    assert showcase.nmesh >= 1
    assert showcase.nhfield >= 1
    assert np.ptp(showcase.hfield_data) > 0.5
    assert showcase.nskin >= 1
    assert showcase.nskinbone >= 2
    assert showcase.nflex >= 1
    assert values(showcase.tex_type) == {
        int(texture.mjTEXTURE_2D),
        int(texture.mjTEXTURE_CUBE),
        int(texture.mjTEXTURE_SKYBOX),
    }


def test_showcase_draws_what_it_has(showcase: mujoco.MjModel) -> None:
    """Geoms wear the textures and the mesh; the materials are the files' ones."""
    worn = {
        int(showcase.tex_type[texture])
        for material in values(showcase.geom_matid) - {-1}
        for texture in values(showcase.mat_texid[material]) - {-1}
    }

    assert {int(mujoco.mjtTexture.mjTEXTURE_2D)} < worn
    geom = mujoco.mjtGeom
    wanted = {geom.mjGEOM_MESH, geom.mjGEOM_HFIELD, geom.mjGEOM_PLANE}
    assert {int(kind) for kind in wanted} < values(showcase.geom_type)


def test_showcase_has_tendons_of_each_kind(showcase: mujoco.MjModel) -> None:
    """One goes round a geom; one is limited in default grey; one hangs slack."""
    wraps = Counter(np.ravel(showcase.wrap_type).tolist())
    stay = showcase.tendon("stay").id
    data = mujoco.MjData(showcase)
    mujoco.mj_step(showcase, data, 300)

    assert wraps[int(mujoco.mjtWrap.mjWRAP_CYLINDER)] >= 1
    assert showcase.tendon_limited[stay]
    assert showcase.tendon_rgba[stay].tolist() == [0.5, 0.5, 0.5, 1]
    limited = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)
    assert stay in data.efc_id[limited], "its limit must act, or its colour is plain"
    cable = showcase.tendon("cable").id
    assert data.ten_length[cable] < showcase.tendon_range[cable, 1] - 0.1


def test_showcase_has_moving_cameras_lights_and_bodies(
    showcase: mujoco.MjModel,
) -> None:
    """Cameras of each mode, a light on a moving body, a mocap body, equalities."""
    mode = mujoco.mjtCamLight
    wanted = {
        mode.mjCAMLIGHT_FIXED,
        mode.mjCAMLIGHT_TRACK,
        mode.mjCAMLIGHT_TRACKCOM,
        mode.mjCAMLIGHT_TARGETBODY,
    }

    assert showcase.ncam >= 3
    assert {int(one) for one in wanted} <= values(showcase.cam_mode)
    assert showcase.light_bodyid.max() > 0
    assert showcase.nmocap >= 1
    equality = mujoco.mjtEq
    kinds = {equality.mjEQ_WELD, equality.mjEQ_CONNECT, equality.mjEQ_FLEX}
    assert {int(kind) for kind in kinds} <= values(showcase.eq_type)


def test_showcase_has_sites_crank_and_range_finder(showcase: mujoco.MjModel) -> None:
    """The range finder sees the floor from the finger's tip."""
    data = mujoco.MjData(showcase)
    mujoco.mj_step(showcase, data, 50)
    finder = showcase.sensor("finger_tip")

    assert int(finder.type[0]) == int(mujoco.mjtSensor.mjSENS_RANGEFINDER)
    assert 0.1 < data.sensordata[finder.adr[0]] < 1
    assert showcase.nsite >= 5
    crank = int(mujoco.mjtTrn.mjTRN_SLIDERCRANK)
    assert crank in values(showcase.actuator_trntype)


def test_walker_walks_on_an_infinite_plane_under_a_camera_that_follows() -> None:
    """The one case in which a picture depends on the picture before."""
    model = load("walker_on_plane")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = model.camera("track").id
    before = data.cam_xpos[camera].copy()

    mujoco.mj_step(model, data, 200)

    planes = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    assert (model.geom_size[planes][:, :2] == 0).all()
    assert data.cam_xpos[camera][0] - before[0] > 0.3
    assert tracking_camera(model) == "track"


def test_pendulum_has_next_to_nothing() -> None:
    """No actuator, no camera, no texture, and still a picture."""
    model = load("pendulum")

    assert (model.nu, model.ncam, model.ntex, model.nsite) == (0, 0, 0, 0)
    assert camera_names(model) == []
    assert tracking_camera(model) is None
