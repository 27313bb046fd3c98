# SPDX-License-Identifier: Apache-2.0
"""The colours that tendons are drawn in, where they are not those of the model.

MuJoCo mixes the colour of a spatial tendon that is at its limit with the colour of
constraints, by the strength of the limit, unless somebody has chosen a colour or a
material for it. The strength is known only while the constraints of a step are there,
so it does not come back with the arrays of a snapshot; the colour itself is recorded.
"""

from __future__ import annotations

import functools

import mujoco
import numpy as np
from numpy.typing import NDArray

# The colour of a tendon that nobody has given one.
_UNCHOSEN = np.array([0.5, 0.5, 0.5, 1], np.float32)
_LIMIT_TENDON = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)
_JOINT_WRAP = int(mujoco.mjtWrap.mjWRAP_JOINT)
_TENDON_TRANSMISSION = int(mujoco.mjtTrn.mjTRN_TENDON)
_NO_GRAVITY = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
_TENDON = int(mujoco.mjtObj.mjOBJ_TENDON)

_AT_ITS_LIMIT = """
<mujoco>
  <worldbody>
    <site name="a"/>
    <body pos="0 0 1"><freejoint/><geom size=".1"/><site name="b"/></body>
  </worldbody>
  <tendon>
    <spatial limited="true" range="0 .5"><site site="a"/><site site="b"/></spatial>
  </tendon>
</mujoco>
"""

_MINVAL = float(mujoco.mjMINVAL)


def has_limited_tendons(model: mujoco.MjModel) -> bool:
    """Tell whether a tendon may be drawn in another colour than the model's."""
    if not model.ntendon:
        return False
    spatial = model.wrap_type[model.tendon_adr] != _JOINT_WRAP
    plain = model.tendon_matid < 0
    could = spatial & plain & (model.tendon_limited != 0)
    return bool(could.any()) and _mixes_colours()


@functools.cache
def _mixes_colours() -> bool:
    """Tell whether this version of MuJoCo mixes colours; the first ones did not."""
    model = mujoco.MjModel.from_xml_string(_AT_ITS_LIMIT)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, maxgeom=10)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    everything = int(mujoco.mjtCatBit.mjCAT_ALL)
    mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
    tendons = [g for g in scene.geoms[: scene.ngeom] if g.objtype == _TENDON]
    return any(geom.rgba[0] != _UNCHOSEN[0] for geom in tendons)


def has_plastic_tendons(model: mujoco.MjModel) -> bool:
    """Tell whether a tendon's spring can yield, which mujoco 4 brought."""
    addresses = getattr(model, "tendon_plasticadr", None)
    return addresses is not None and bool((addresses >= 0).any())


class TendonColours:
    """The effective colours of a model's tendons.

    Args:
        model: the model.
        data: its data.

    Attributes:
        rgba: `(ntendon, 4) float32`, as of the last `update`; always the same array.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model = model
        self._data = data
        self._own = model.tendon_rgba
        self.rgba = np.array(self._own)

    def update(self) -> None:
        """Bring `rgba` up to date with model and data."""
        self.rgba[:] = self._own
        if self._data.nl:
            self._mix_colours_at_limits()

    def _mix_colours_at_limits(self) -> None:
        data, model = self._data, self._model
        limits = slice(data.ne + data.nf, data.ne + data.nf + data.nl)
        of_tendons = data.efc_type[limits] == _LIMIT_TENDON
        tendons = data.efc_id[limits][of_tendons]
        strengths = data.efc_KBIP.reshape(-1, 4)[limits, 2][of_tendons]
        mixed = self._are_recoloured(tendons)
        if not mixed.any():
            return
        constraint = model.vis.rgba.constraint[:3].astype(np.float64)
        share = strengths[mixed, np.newaxis]
        # In double precision, then rounded, as MuJoCo does. Of two limits of the same
        # tendon the later one counts, also there.
        self.rgba[tendons[mixed], :3] = (1 - share) * 0.5 + share * constraint

    def _are_recoloured(self, tendons: NDArray[np.int32]) -> NDArray[np.bool_]:
        model = self._model
        unchosen = (self._own[tendons] == _UNCHOSEN).all(axis=1)
        plain = model.tendon_matid[tendons] == -1
        mixed: NDArray[np.bool_] = unchosen & plain
        if mixed.any():
            mixed &= ~_are_slack_cables(model, self._data, tendons)
        return mixed


def _are_slack_cables(
    model: mujoco.MjModel, data: mujoco.MjData, tendons: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Tell which tendons are drawn hanging through, and then never recoloured.

    That is how MuJoCo draws a tendon between two sites that nothing but gravity and
    one limit of its length acts on, be it a spring's or a constraint's.
    """
    stiff = _any_nonzero(model, "tendon_stiffness", tendons)
    spring = _spring_lengths(model, data)[tendons]
    at_spring = stiff & (spring[:, 0] == 0) & (spring[:, 1] > 0)
    bounds = model.tendon_range[tendons]
    at_constraint = (
        ~stiff
        & (model.tendon_limited[tendons] == 1)
        & (bounds[:, 0] == 0)
        & (data.ten_length[tendons] < bounds[:, 1])
    )
    return np.asarray(
        (at_spring != at_constraint)
        & (model.tendon_num[tendons] == 2)
        & ~_any_nonzero(model, "tendon_damping", tendons)
        & (model.tendon_frictionloss[tendons] == 0)
        & ~_are_actuated(model, tendons)
        & _has_gravity(model)
    )


def _spring_lengths(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Return between which lengths a tendon's spring does nothing, `(ntendon, 2)`."""
    lengths: NDArray[np.float64] = model.tendon_lengthspring
    if not has_plastic_tendons(model):
        return lengths
    lengths = lengths.copy()
    addresses = model.tendon_plasticadr
    plastic = addresses >= 0
    lengths[plastic] = data.plastic[addresses[plastic, np.newaxis] + [0, 1]]
    return lengths


def _any_nonzero(
    model: mujoco.MjModel, name: str, tendons: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Tell for which tendons a coefficient, or one of its higher orders, is not 0."""
    value: NDArray[np.float64] = getattr(model, name)[tendons]
    # Polynomials are younger than mujoco 3.3.
    higher = getattr(model, f"{name}poly", np.zeros((model.ntendon, 1)))[tendons]
    nonzero: NDArray[np.bool_] = (value != 0) | (higher != 0).any(axis=1)
    return nonzero


def _are_actuated(
    model: mujoco.MjModel, tendons: NDArray[np.int32]
) -> NDArray[np.bool_]:
    by_tendon = model.actuator_trntype == _TENDON_TRANSMISSION
    actuated = model.actuator_trnid[by_tendon, 0]
    found: NDArray[np.bool_] = (tendons[:, np.newaxis] == actuated).any(axis=1)
    return found


def _has_gravity(model: mujoco.MjModel) -> bool:
    enabled = not model.opt.disableflags & _NO_GRAVITY
    return bool(enabled and np.linalg.norm(model.opt.gravity) > _MINVAL)
